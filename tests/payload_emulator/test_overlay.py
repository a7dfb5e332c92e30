"""Rings of catalogued craters over live images: projected at the heights of their rims."""

from dataclasses import replace

import numpy as np
import pytest

from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world.camera import Exposure, craters_in_view
from payload_emulator.session.world.world import build_world
from tests.scenarios import still_scenario

SCENARIO = (
    still_scenario("overlay", 30.0, 1)
    + """[camera]
tilt_deg = 12.0
k1 = -0.02
"""
)
RIM_M = 5_000.0


def test_rings_lie_where_rims_on_high_ground_are_seen_by_a_tilted_distorted_camera():
    world = build_world(parse_scenario(SCENARIO), DataFolder())
    utc_ns = int(world.frame_utc_ns[0])
    position = world.truth.positions_mcmf(utc_ns)[0]
    rotation = world.camera_from_mcmf(position)
    exposure = Exposure(utc_ns, np.zeros((8, 8, 3), dtype=np.uint8), np.zeros(7), 0, rotation)
    craters = world.terrain.catalogue
    world.terrain.catalogue = replace(craters, rim_height_m=np.full(len(craters), RIM_M))
    index, uv, _ = craters_in_view(world, exposure, 6.0)
    assert len(index) > 5

    latitude, longitude = craters.latitude_rad[index], craters.longitude_rad[index]
    unit = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )
    focal_px = 256.0 / np.tan(np.radians(60.0))

    def pixels(height_m):
        seen = ((1_737_400.0 + height_m) * unit - position) @ rotation.T
        plane = seen[:, :2] / seen[:, 2:]
        return 255.5 + focal_px * plane * (1.0 - 0.02 * np.sum(plane**2, axis=1, keepdims=True))

    assert uv == pytest.approx(pixels(RIM_M), abs=1e-6)
    assert np.max(np.linalg.norm(uv - pixels(0.0), axis=1)) > 10.0
