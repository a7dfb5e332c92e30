"""Trajectory errors and TUM text against the evaluators' definitions, written out here with 4 x 4 matrices."""

from __future__ import annotations

import numpy as np
import pytest

from ground_service.evaluation.navigation.trajectory import absolute_error, format_tum, relative_error

COUNT = 60
UTC_NS = 1_881_735_115_000_000_000 + np.arange(COUNT) * 15 * 10**9


def orbit() -> np.ndarray:
    angle = 1e-3 * 15.0 * np.arange(COUNT)
    flat = 1_768e3 * np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(angle)], axis=1)
    return np.asarray(flat)


def estimate() -> np.ndarray:
    return orbit() + np.cumsum(np.random.default_rng(2).normal(0.0, 30.0, (COUNT, 3)), axis=0)


def poses(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) and 4 x 4 poses (n, 4, 4) of TUM text, from the definition of a quaternion's rotation."""
    rows = np.array([[float(word) for word in line.split()] for line in text.splitlines() if line[0] != "#"])
    matrices = np.zeros((len(rows), 4, 4))
    x, y, z, w = rows[:, 4:].T
    matrices[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1)
    matrices[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)
    matrices[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
    matrices[:, :3, 3], matrices[:, 3, 3] = rows[:, 1:4], 1.0
    return rows[:, 0], matrices


def test_absolute_and_relative_errors_are_those_of_the_poses_in_the_files() -> None:
    times, flown = poses(format_tum(UTC_NS, estimate(), orbit()))
    _, true = poses(format_tum(UTC_NS, orbit(), orbit()))
    np.testing.assert_allclose(np.diff(times), 15.0, atol=1e-6)
    apart = np.array([np.linalg.inv(q) @ p for q, p in zip(true, flown, strict=True)])
    length = np.linalg.norm(apart[:, :3, 3], axis=1)
    ate = absolute_error(estimate(), orbit())
    # Quaternions are written to 1e-12: over 1,768 km that is some micrometres.
    assert ate.rmse_m == pytest.approx(np.sqrt(np.mean(length**2)), abs=1e-4)
    assert ate.median_m == pytest.approx(np.median(length), abs=1e-4)
    assert ate.max_m == pytest.approx(length.max(), abs=1e-4)
    for frames in (1, 4):
        pairs = [
            np.linalg.inv(np.linalg.inv(true[i]) @ true[i + frames])
            @ (np.linalg.inv(flown[i]) @ flown[i + frames])
            for i in range(COUNT - frames)
        ]
        lengths = np.array([np.linalg.norm(pair[:3, 3]) for pair in pairs])
        rpe = relative_error(estimate(), orbit(), frames)
        assert rpe.rmse_m == pytest.approx(np.sqrt(np.mean(lengths**2)), abs=1e-3)
        assert rpe.samples == COUNT - frames


def test_orientations_are_those_of_the_orbit() -> None:
    _, true = poses(format_tum(UTC_NS, orbit(), orbit()))
    radial, normal = true[:, :3, 0], true[:, :3, 2]
    np.testing.assert_allclose(radial, orbit() / np.linalg.norm(orbit(), axis=1)[:, None], atol=1e-9)
    # The plane of the made orbit is tilted by atan 0.1 about x.
    np.testing.assert_allclose(normal, [[0.0, -0.0995037, 0.9950372]] * COUNT, atol=1e-4)


def test_times_keep_their_nanoseconds() -> None:
    line = format_tum(UTC_NS[:2] + 123_456_789, orbit()[:2], orbit()[:2]).splitlines()[1]
    assert line.split()[0] == "1881735115.123456789"


def test_no_positions_have_no_error() -> None:
    nothing = absolute_error(np.zeros((0, 3)), np.zeros((0, 3)))
    assert nothing.samples == 0 and np.isnan(nothing.rmse_m)
