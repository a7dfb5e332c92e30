"""Pictures of bowl-shaped craters, drawn without any renderer."""

import numpy as np
from numpy import cos, radians, sin

BOWL_CENTRES = [(130.0, 140.0), (300.0, 210.0), (220.0, 380.0), (400.0, 390.0)]


def bowl_image(centres=BOWL_CENTRES, radius=20.0, sun_azimuth_deg=0.0):
    """Bowls of spherical section under a Sun at an image azimuth (clockwise from the top), Lambert, 15 degrees up."""
    row, column = np.mgrid[0:512, 0:512].astype(float)
    azimuth, elevation = radians(sun_azimuth_deg), radians(15.0)
    sun = np.array([sin(azimuth) * cos(elevation), -cos(azimuth) * cos(elevation), sin(elevation)])
    height = np.zeros((512, 512))
    for u, v in centres:
        s = np.hypot(column - u, row - v) / radius
        inside = s < 1
        height += np.where(inside, 0.36 * radius * (s**2 - 1) + 0.08 * radius, 0.08 * radius * np.maximum(s, 1) ** -4)
    down, right = np.gradient(height)
    shade = (-right * sun[0] - down * sun[1] + sun[2]) / np.sqrt(1 + right**2 + down**2)
    noise = np.random.default_rng(0).normal(0, 0.004, shade.shape)
    return np.clip((np.maximum(shade, 0) * 0.8 + 0.02 + noise) * 255, 0, 255).astype(np.uint8)
