"""Links to ground stations: telemetry in, released telecommands out, contacts."""
