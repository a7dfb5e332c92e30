"""Benchmark of ephemeris files and interpolation, compared with alternatives: python -m benchmarks ephemeris."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._rows import Row
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import save_oem
from lunar.messages.stk import format_stk
from lunar.timescales import NS, format_utc, parse_utc

STATES = 86_400
EPOCHS = 1_000_000
START = parse_utc("2029-08-07T00:00:00")


def example(states: int = STATES) -> Ephemeris:
    """A month of states every 30 s on an inclined circle, for which interpolation errors are known."""
    elapsed_s = np.arange(states) * 30.0
    position, velocity = _circle(elapsed_s)
    return ephemeris_from_states(START + np.rint(elapsed_s * NS).astype(np.int64), position, velocity)


def bench() -> dict[str, Any]:
    """Seconds and rates, best of three, of ours and of the rivals."""
    month = example()
    rng = np.random.default_rng(1)
    epochs = np.sort(START + rng.integers(0, (STATES - 1) * 30 * NS, EPOCHS))
    shuffled = rng.permutation(epochs)
    position, _ = month.at(epochs)
    error_m = float(np.max(np.abs(position - _circle((epochs - START) / NS)[0])))
    with tempfile.TemporaryDirectory() as folder:
        oem_path, stk_path = Path(folder, "month.oem"), Path(folder, "month.e")
        figures: dict[str, Any] = {
            "oem_write_s": _best(lambda: save_oem(month, oem_path)),
            "oem_read_s": _best(lambda: load_ephemeris(oem_path)),
            "stk_write_s": _best(lambda: stk_path.write_text(format_stk(month))),
            "stk_read_s": _best(lambda: load_ephemeris(stk_path)),
            "states": STATES,
            "interpolation_epochs_per_s": EPOCHS / _best(lambda: month.at(epochs)),
            "interpolation_shuffled_epochs_per_s": EPOCHS / _best(lambda: month.at(shuffled)),
            "interpolation_error_m": error_m,
            "one_epoch_s": _best(lambda: month.at(int(epochs[0]))),
        }
        figures["rivals"] = _rivals(month, epochs, Path(folder))
    return figures


def rows() -> Iterator[Row]:
    """Yield times of files and interpolation beside the oem package and a spline of SciPy."""
    figures = bench()
    rivals = figures.pop("rivals")
    read = rivals["oem package: read, s per 86,400 states (from 5,000)"]
    rate, error = (rivals[f"scipy CubicHermiteSpline (degree 3): {key}"] for key in ("epochs/s", "error, m"))
    slow = rivals["oem package: interpolation, epochs/s"]
    quick = figures["interpolation_epochs_per_s"]
    found_m = figures["interpolation_error_m"]
    wrong = "" if found_m < 1e-3 else "interpolation is wrong by more than 1 mm"
    yield Row("OEM of 86,400 states: read", figures["oem_read_s"], "s", "oem package", read)
    yield Row("OEM of 86,400 states: write", figures["oem_write_s"], "s")
    yield Row("interpolation", quick, "epochs/s", "SciPy cubic spline", rate, wrong)
    yield Row("interpolation", quick, "epochs/s", "oem package", slow, wrong)
    yield Row("interpolation error", found_m, "m", "SciPy cubic spline", error, wrong)


def _rivals(month: Ephemeris, epochs: np.ndarray, folder: Path) -> dict[str, Any]:
    import oem
    from astropy.time import Time
    from scipy.interpolate import CubicHermiteSpline

    figures: dict[str, Any] = {}
    with warnings.catch_warnings():
        # ERFA warns of UTC far in the future.
        warnings.simplefilter("ignore")
        few = example(5_000)
        path = folder / "few.oem"
        save_oem(few, path)
        seconds = _best(lambda: oem.OrbitEphemerisMessage.open(path), 1)
        figures["oem package: read, s per 86,400 states (from 5,000)"] = seconds * STATES / 5_000
        theirs = oem.OrbitEphemerisMessage.open(path)
        when = Time(format_utc(START + 50_000 * NS).rstrip("Z"), scale="utc")
        theirs(when)
        figures["oem package: interpolation, epochs/s"] = 1.0 / _best(lambda: theirs(when))
    segment = month.segments[0]
    knots = (segment.utc_ns - START) / NS
    asked = (epochs - START) / NS

    def cubic() -> None:
        spline = CubicHermiteSpline(knots, segment.position_m, segment.velocity_m_s)
        spline(asked)
        spline(asked, 1)

    figures["scipy CubicHermiteSpline (degree 3): epochs/s"] = EPOCHS / _best(cubic)
    spline = CubicHermiteSpline(knots, segment.position_m, segment.velocity_m_s)
    figures["scipy CubicHermiteSpline (degree 3): error, m"] = float(
        np.max(np.abs(spline(asked) - _circle(asked)[0]))
    )
    return figures


def _circle(elapsed_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rate, radius = 2 * np.pi / 6672.0, 1_768_180.0
    angle = rate * elapsed_s
    position = radius * np.stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)], -1)
    return position, radius * rate * np.stack([-np.sin(angle), 0.6 * np.cos(angle), 0.8 * np.cos(angle)], -1)


def _best(action: Callable[[], Any], times: int = 3) -> float:
    seconds = []
    for _ in range(times):
        started = time.perf_counter()
        action()
        seconds.append(time.perf_counter() - started)
    return min(seconds)
