"""On-board telemetry: packets, the packet store, files sent as large data."""
