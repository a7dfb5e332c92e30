"""LINNA payload and its environment: `sim` (truth), `flight` (flight software) and `training` (detector)."""
