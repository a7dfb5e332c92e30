"""Execution of a scenario: world, flight, live payload, recording, replay."""
