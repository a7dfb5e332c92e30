"""Detections against the catalogue: viewing geometry, recall, identifications, mapped craters."""
