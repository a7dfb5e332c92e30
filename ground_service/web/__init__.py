"""Pages of the ground service for a browser: static files, no build step, nothing from another host."""
