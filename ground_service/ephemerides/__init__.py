"""Reference ephemerides and attitudes."""
