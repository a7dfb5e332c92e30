"""Comparison of the Sun in external images with the Sun of the ephemeris at their times."""

from __future__ import annotations

import numpy as np

from lunar.timescales import format_utc
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.picture_search import find_sun
from payload_emulator.flight.vision.preprocess import prepare_image
from payload_emulator.session.world.camera import expose, true_sun_direction
from payload_emulator.session.world.world import World

_FRAMES = 3
_WIDEST_DEG = 45.0  # a quarter turn of the image brings no other Sun within 45 degrees of its top


def sun_warnings(world: World, detector: OnnxDetector) -> list[str]:
    """Return a line for each of three external frames whose Sun differs from that of the ephemeris.

    A frame whose craters leave the direction of the Sun undetermined is not compared.
    """
    warnings = []
    rows = np.linspace(0, world.frame_utc_ns.size - 1, _FRAMES, dtype=int)
    for utc_ns in world.frame_utc_ns[np.unique(rows)].tolist():
        exposure = expose(world, utc_ns)
        seen = find_sun(detector, prepare_image(exposure.image, detector.preparation).gray)
        if seen is None or not seen.determined:
            continue
        right, down = exposure.attitude[4:6]
        azimuth_deg = float(np.degrees(np.arctan2(right, -down))) % 360.0
        position = world.truth.positions_mcmf(utc_ns)[0]
        sun = true_sun_direction(world, position, utc_ns, np.random.default_rng(0))
        elevation_deg = float(np.degrees(np.arcsin(position @ sun / np.linalg.norm(position))))
        apart_deg = abs((seen.azimuth_deg - azimuth_deg + 180.0) % 360.0 - 180.0)
        if apart_deg > _WIDEST_DEG or elevation_deg < 0.0:
            warnings.append(
                f"frame of {format_utc(utc_ns, 0)}: the image shows the Sun at azimuth {seen.azimuth_deg:.0f} deg "
                f"(clockwise from its top), the ephemeris has it at {azimuth_deg:.0f} deg, elevation "
                f"{elevation_deg:.0f} deg; the detector turns images by the ephemeris: check times and attitudes"
            )
    return warnings
