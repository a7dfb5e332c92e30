"""Landmarks learned from flight: persistent detections that no catalogued crater explains."""
