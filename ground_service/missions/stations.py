"""Ground stations assumed where a mission names none."""

from __future__ import annotations

import math

from lunar.visibility import GroundStation

STATIONS = (
    GroundStation("Goldstone", math.radians(35.4267), math.radians(243.1100), 1000.0),
    GroundStation("Canberra", math.radians(-35.4024), math.radians(148.9813), 690.0),
    GroundStation("Madrid", math.radians(40.4314), math.radians(355.7520), 830.0),
)
"""Sites of the Deep Space Network, to a kilometre (DSN 810-005, module 301); the Moon is always visible from one."""
