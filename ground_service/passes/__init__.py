"""Passes and their telemetry: definition, import of archives, series, trends, packet accounting."""
