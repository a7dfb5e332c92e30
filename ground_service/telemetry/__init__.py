"""Telemetry archive: packets, samples, roll-ups and values of declared packets."""
