"""Telemetry and telecommand octets to values and back: CADUs, frames, space packets, PUS, one dictionary."""
