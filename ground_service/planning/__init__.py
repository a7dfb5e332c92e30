"""Observation windows: search, prediction, conflicts, approval, uplink, progress."""
