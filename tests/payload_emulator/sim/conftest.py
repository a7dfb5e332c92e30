"""Terrains of known shape."""

import numpy as np
from pytest import fixture

from lunar.catalogue import make_catalogue
from payload_emulator.sim.terrain.procedural import ProceduralTerrain
from payload_emulator.sim.terrain.tiles import Terrain


class FormulaTerrain(Terrain):
    """Heights from a formula of latitude and longitude, one albedo."""

    def __init__(self, formula, catalogue=None):
        empty = make_catalogue(np.empty(0), np.empty(0), np.empty(0), source="none")
        super().__init__("formula", ("formula",), catalogue or empty, 256, 64)
        self._formula = formula

    def make_heights(self, latitude_rad, longitude_rad):
        heights = self._formula(latitude_rad[:, None], longitude_rad[None, :])
        return np.ascontiguousarray(np.broadcast_to(heights, (latitude_rad.size, longitude_rad.size)), dtype=np.float32)

    def make_albedo(self, latitude_rad, longitude_rad):
        return np.full((latitude_rad.size, longitude_rad.size), 0.12, np.float32)

    def covers(self, latitude_rad, longitude_rad):
        return np.ones(np.broadcast_shapes(np.shape(latitude_rad), np.shape(longitude_rad)), dtype=bool)


@fixture
def formula_terrain():
    return FormulaTerrain


@fixture(scope="session")
def procedural():
    """A world shared by tests that only read it."""
    return ProceduralTerrain(3)
