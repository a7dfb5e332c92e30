"""Recordings of navigation windows: noise added to attitudes, and the rows of the smoother."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from studies import navigation_windows


def test_noise_is_added_to_the_attitude_of_each_frame(monkeypatch: Any) -> None:
    monkeypatch.setattr(
        navigation_windows, "replace", lambda one, **new: SimpleNamespace(**{**vars(one), **new})
    )
    given = Rotation.random(400, rng=np.random.default_rng(1)).as_quat(scalar_first=True)
    recording: Any = SimpleNamespace(attitude=np.concatenate([given, np.ones((400, 3))], axis=1))
    noisy = navigation_windows.with_attitude_noise(recording, 0.01, seed=3)
    np.testing.assert_array_equal(recording.attitude[:, :4], given)
    np.testing.assert_array_equal(noisy.attitude[:, 4:], 1.0)
    turned = (
        Rotation.from_quat(noisy.attitude[:, :4], scalar_first=True)
        * Rotation.from_quat(given, scalar_first=True).inv()
    )
    assert abs(np.std(turned.as_rotvec()) / 0.01 - 1.0) < 0.1
    again = navigation_windows.with_attitude_noise(recording, 0.01, seed=3)
    np.testing.assert_array_equal(again.attitude, noisy.attitude)


def test_the_smoother_is_compared_from_the_second_window_on() -> None:
    minute = 60 * 10**9
    times = np.concatenate([np.arange(30), 1_000 + np.arange(25)]) * minute
    recording: Any = SimpleNamespace(name="two", utc_ns=times)
    filtered = np.concatenate([np.full(20, 900.0), np.full(10, 6.0), np.full(20, 8.0), np.full(5, 2.0)])
    smoothed = np.concatenate([np.full(20, 900.0), np.full(10, 3.0), np.full(20, 2.0), np.full(5, 2.0)])
    flight: Any = SimpleNamespace(position_m=filtered)
    first, second = navigation_windows.smoother_rows(recording, flight, smoothed)
    assert np.isnan(first.start_m).all() and first.whole_m == (6.0, 3.0)
    assert second.start_m == (8.0, 2.0)
    np.testing.assert_allclose(second.whole_m, [np.sqrt((20 * 64 + 5 * 4) / 25), 2.0])
