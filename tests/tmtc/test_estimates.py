"""Estimates of the filter in packets of old payloads (lower triangle) and of today (upper triangle)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tmtc.dictionary.estimates import filter_estimates
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.stream import cut_packets

RNG = np.random.default_rng(3)
STATES = RNG.standard_normal((2, 9)) * np.repeat([1.7e6, 1.6e3, 1e-6], 3)
_ROOTS = RNG.standard_normal((2, 9, 9)) * np.repeat([40.0, 0.05, 1e-6], 3)[:, None]
COVARIANCES = _ROOTS @ np.swapaxes(_ROOTS, 1, 2)


def packet(name: str, row: int, ticks: int) -> bytes:
    covariance = COVARIANCES[row]
    # Element by element, so that the order of the triangle is that of the interface and not of a library.
    if name == "filter_state":
        extra: dict[str, Any] = {"covariance": [covariance[i, j] for i in range(9) for j in range(i + 1)]}
    else:
        triangle = [covariance[i, j] for i in range(9) for j in range(i, 9)]
        extra = {"covariance": triangle, "innovation_degrees": 22}
    values = {
        "frame_number": 5 + row,
        "image_ticks": ticks,
        "position_icrf_m": STATES[row, :3],
        "velocity_icrf_m_s": STATES[row, 3:6],
        "acceleration_rtn_m_s2": STATES[row, 6:],
        **extra,
    }
    return DICTIONARY.pack(name, values, ticks=ticks + 9, sequence_count=row)


def estimates_of(octets: bytes) -> Any:
    return filter_estimates(DICTIONARY.unpack_many(octets, cut_packets(octets)))


@pytest.mark.parametrize("name, degrees", [("filter_state", -1), ("filter_estimate", 22)])
def test_state_and_covariance_come_back_within_single_precision(name: str, degrees: int) -> None:
    octets = b"".join(packet(name, row, 100 + row) for row in (0, 1))
    found = estimates_of(octets)
    assert found.image_ticks.tolist() == [100, 101] and found.packet_ticks.tolist() == [109, 110]
    assert found.frame_number.tolist() == [5, 6] and found.packet_index.tolist() == [0, 1]
    assert found.innovation_degrees.tolist() == [degrees, degrees]
    np.testing.assert_array_equal(found.state[:, :6], STATES[:, :6])
    np.testing.assert_allclose(found.state[:, 6:], STATES[:, 6:], rtol=1e-7)
    np.testing.assert_allclose(found.covariance, COVARIANCES, rtol=1.2e-7)


def test_a_stream_may_hold_packets_of_both_versions_and_other_ones() -> None:
    other = DICTIONARY.pack("connection_report", {}, ticks=1, sequence_count=1)
    octets = packet("filter_estimate", 0, 7) + other + packet("filter_state", 1, 8)
    found = estimates_of(octets)
    assert dict(zip(found.image_ticks.tolist(), found.packet_index.tolist(), strict=True)) == {7: 0, 8: 2}
    assert len(estimates_of(other)) == 0 and estimates_of(other).covariance.shape == (0, 9, 9)


def test_single_precision_keeps_the_normalised_error_and_half_precision_does_not() -> None:
    """The choice of the interface, on a covariance of a fix: position 20 to 40 m, velocity 2 to 5 cm/s, correlated."""
    sigma = np.array([22.0, 43.0, 33.0, 0.03, 0.02, 0.05])
    correlation = np.eye(6)
    for i, j, value in ((0, 4, -0.93), (1, 3, -0.95), (0, 1, 0.2), (2, 5, 0.6)):
        correlation[i, j] = correlation[j, i] = value
    covariance = correlation * sigma[:, None] * sigma[None]
    error = sigma * np.array([1.0, -1.0, 0.5, 1.5, -0.5, 1.0])

    def squared(matrix: np.ndarray) -> float:
        return float(error @ np.linalg.solve(matrix, error))

    exact = squared(covariance)
    single = covariance.astype(np.float32).astype(np.float64)
    half = correlation.astype(np.float16).astype(np.float64) * sigma[:, None] * sigma[None]
    assert abs(squared(single) / exact - 1.0) < 1e-6
    assert abs(squared(half) / exact - 1.0) > 1e-4
