"""Orientations for tests: a Moon that does not turn, and one that is turned against the IAU series."""

import numpy as np

from lunar.frames import IauOrientation, axis_rotation


class Still:
    """Mean-Earth and principal axes are those of ICRF."""

    name = "still"

    def mcmf_from_icrf(self, tdb_s):
        return np.broadcast_to(np.eye(3), (*np.shape(tdb_s), 3, 3)).copy()

    def pa_from_icrf(self, tdb_s):
        return self.mcmf_from_icrf(tdb_s)


class TurnedOrientation:
    """An orientation that turns the ground by 0.01 degrees (300 m) from the IAU series."""

    def __init__(self, name="DE421"):
        self.name = name

    def mcmf_from_icrf(self, tdb_s):
        return axis_rotation(3, np.radians(0.01)) @ IauOrientation().mcmf_from_icrf(tdb_s)

    def pa_from_icrf(self, tdb_s):
        return IauOrientation().pa_from_icrf(tdb_s)
