"""Sources of terrain behind one small interface: a procedural Moon and georeferenced rasters."""
