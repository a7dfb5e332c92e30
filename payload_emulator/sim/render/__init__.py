"""Renderers and camera: illumination, photometry, lens, sensor, labels."""
