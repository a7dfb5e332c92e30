"""The interpolation of the independent recomputation, against a circle."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.recomputation import position_m, segments_of


def test_an_ephemeris_is_interpolated_to_a_millimetre_inside_its_segments_only() -> None:
    rate, radius_km, start = 1.6 / 1800.0, 1800.0, 1_893_456_000

    def rows(first: int) -> str:
        found = []
        for second in range(first, first + 300, 10):
            cosine, sine = np.cos(rate * second), np.sin(rate * second)
            state = radius_km * np.array([cosine, sine, 0.0, -rate * sine, rate * cosine, 0.0])
            time = f"2030-01-01T00:{second // 60:02d}:{second % 60:02d}.000000"
            found.append(f"{time} {' '.join(f'{one:.12f}' for one in state)}")
        return "\n".join(found)

    segments = segments_of(f"META_START\nMETA_STOP\n{rows(0)}\nMETA_START\nMETA_STOP\n{rows(600)}\n")
    for second in (0.0, 3.7, 287.2, 605.0, 890.0):
        angle = rate * second
        circle = 1e3 * radius_km * np.array([np.cos(angle), np.sin(angle), 0.0])
        found = position_m(segments, start * 10**9 + round(second * 1e9))
        assert found == pytest.approx(circle, abs=1e-3)
    with pytest.raises(ValueError, match="expected an OEM that contains"):
        position_m(segments, (start + 400) * 10**9)
