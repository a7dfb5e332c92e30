"""Craters projected from the on-board catalogue, and the derivatives the filter lives on."""

from __future__ import annotations

from typing import Any

import numpy as np

from lunar.camera import PinholeCamera, project_mcmf
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, in_view, landmark_map, look
from tmtc.dictionary.tables import CatalogueTable

CAMERA = PinholeCamera()
NADIR_AT_ORIGIN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
POSITION = np.array([1_767e3, 5e3, -4e3])
INDEX = np.arange(20)


def craters() -> LandmarkMap:
    rng = np.random.default_rng(0)
    place = rng.uniform(-0.02, 0.02, (2, 20))
    return landmark_map(
        CatalogueTable(
            INDEX, place[0], place[1], np.full(20, 5e3), rng.uniform(-3e3, 3e3, 20), np.full((20, 3), 90.0)
        )
    )


def pose(change: Any) -> Pose:
    return Pose(POSITION + change[:3], NADIR_AT_ORIGIN, np.eye(3), change[3:6], change[6:8], change[8:11])


def test_derivatives_are_those_of_the_projection() -> None:
    landmarks, nothing = craters(), np.zeros(11)
    seen = look(landmarks, INDEX, pose(nothing), CAMERA)
    analytic = np.zeros((20, 2, 11))
    analytic[:, :, 0:3], analytic[:, :, 3:6], analytic[:, :, 8:11] = (
        seen.by_position,
        seen.by_attitude,
        seen.by_offset,
    )
    analytic[:, 0, 6] = analytic[:, 1, 7] = 1.0
    for k, step in enumerate([1.0] * 3 + [1e-6] * 3 + [1e-3] * 2 + [1.0] * 3):
        change = np.zeros(11)
        change[k] = step
        ahead = look(landmarks, INDEX, pose(change), CAMERA).uv_px
        behind = look(landmarks, INDEX, pose(-change), CAMERA).uv_px
        numeric = (ahead - behind) / (2.0 * step)
        # Central differences: curvature over the step is a part in 1e8 of the largest derivative.
        np.testing.assert_allclose(numeric, analytic[:, :, k], atol=1e-7 * np.abs(analytic[:, :, k]).max())


def test_the_projection_is_that_of_the_camera_of_the_library() -> None:
    landmarks = craters()
    seen = look(landmarks, INDEX, pose(np.zeros(11)), CAMERA)
    expected = project_mcmf(CAMERA, NADIR_AT_ORIGIN, POSITION, landmarks.position_mcmf_m)
    np.testing.assert_allclose(seen.uv_px, expected, atol=1e-9)


def test_what_is_in_view_is_all_that_projects_into_the_image_and_is_above_the_limb() -> None:
    rng = np.random.default_rng(1)
    count = 4_000
    table = CatalogueTable(
        np.arange(count),
        rng.uniform(-0.2, 0.2, count),
        rng.uniform(-0.2, 0.2, count),
        np.full(count, 5e3),
        rng.uniform(-4e3, 4e3, count),
        np.full((count, 3), 90.0),
    )
    landmarks = landmark_map(table)
    for margin_px in (0.0, 60.0):
        found = in_view(landmarks, pose(np.zeros(11)), CAMERA, margin_px).index
        uv = project_mcmf(CAMERA, NADIR_AT_ORIGIN, POSITION, landmarks.position_mcmf_m)
        inside = np.all(np.abs(uv - 255.5) < 256.0 + margin_px, axis=1)
        away = POSITION - landmarks.position_mcmf_m
        height = np.einsum("ij,ij->i", away, landmarks.enu_from_mcmf[:, 2]) / np.linalg.norm(away, axis=1)
        expected = np.flatnonzero(inside & (height > np.sin(np.radians(5.0))))
        assert set(expected.tolist()) == set(found.tolist())
    below_ground = Pose(POSITION * 0.5, NADIR_AT_ORIGIN, np.eye(3), np.zeros(3), np.zeros(2), np.zeros(3))
    assert len(in_view(landmarks, below_ground, CAMERA, 0.0)) == 0
