"""Stored objects of the telemetry displays: layouts, folders, plots and notebooks that operators make in Open MCT."""
