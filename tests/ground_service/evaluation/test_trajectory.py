"""TUM text against the evaluators' definitions, written out here with 4 x 4 matrices."""

from __future__ import annotations

import numpy as np

from ground_service.evaluation.navigation.trajectory import format_tum

COUNT = 60
UTC_NS = 1_881_735_115_000_000_000 + np.arange(COUNT) * 15 * 10**9


def orbit() -> np.ndarray:
    angle = 1e-3 * 15.0 * np.arange(COUNT)
    flat = 1_768e3 * np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(angle)], axis=1)
    return np.asarray(flat)


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


def test_orientations_are_those_of_the_orbit() -> None:
    _, true = poses(format_tum(UTC_NS, orbit(), orbit()))
    radial, normal = true[:, :3, 0], true[:, :3, 2]
    np.testing.assert_allclose(radial, orbit() / np.linalg.norm(orbit(), axis=1)[:, None], atol=1e-9)
    # The plane of the made orbit is tilted by atan 0.1 about x.
    np.testing.assert_allclose(normal, [[0.0, -0.0995037, 0.9950372]] * COUNT, atol=1e-4)


def test_times_keep_their_nanoseconds() -> None:
    line = format_tum(UTC_NS[:2] + 123_456_789, orbit()[:2], orbit()[:2]).splitlines()[1]
    assert line.split()[0] == "1881735115.123456789"
