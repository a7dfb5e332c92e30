"""Navigation over windows of real terrain, with and without registration: python -m benchmarks.navigation_windows.

Frames of several windows are rendered and searched once; then each variant of catalogue and filter runs on the same
detections (level 3s on tuning terrain, level 3 on the strip and the block that no detector was trained on).
Parameters of the filter were chosen on `tuning` only.

- `list`: the crater list as published, filter as before.
- `constant`: the list 59 m farther north, which was the constant of former versions.
- `registered`: the list registered by place, filter as before.
- `shipped`: the list registered by place, filter as shipped.

The filter as before has a pixel bias of 0.25 px (1 sigma) and a catalogue offset that never changes.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from linna.data import data_folder
from payload_emulator.flight.navigation.anchored_parameters import AnchoredParameters
from payload_emulator.session.scenario import Scenario, load_scenario
from studies.navigation_windows import (
    Recording,
    WindowRow,
    fly,
    load_recording,
    moved,
    record,
    save_recording,
    window_rows,
)
from tmtc.tables import CatalogueTable, unpack_catalogue_table

# Name, west, east, south, north (degrees), windows, direction, seed.
PLACES = {
    "tuning": (("tuning", 315.0, 330.0, -60.0, 60.0, 5, "ascending", 3040),),
    "test": (
        ("strip-up", 285.0, 300.0, -60.0, 60.0, 6, "ascending", 2041),
        ("strip-down", 285.0, 300.0, -60.0, 60.0, 5, "descending", 2042),
        ("block", 25.0, 45.0, 0.0, 30.0, 6, "ascending", 2043),
    ),
}
VARIANTS = ("list", "constant", "registered", "shipped")


def main(words: Sequence[str]) -> int:
    """Print a table of the windows and one of their figures together."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.navigation_windows")
    parser.add_argument("--set", choices=PLACES, default="tuning", help="default: tuning")
    parser.add_argument(
        "--recordings", type=Path, required=True, help="folder of recordings, made where missing"
    )
    arguments = parser.parse_args(words)
    arguments.recordings.mkdir(parents=True, exist_ok=True)
    rows: dict[str, list[WindowRow]] = {name: [] for name in VARIANTS}
    for place in PLACES[arguments.set]:
        recording = _recording(arguments.recordings, place)
        for name in VARIANTS:
            table, parameters = variant(name, recording)
            rows[name] += window_rows(recording, fly(recording, parameters, table))
    print("| window | altitude km | frames fixed | " + " | ".join(VARIANTS) + " |")
    print("|" + "---|" * (3 + len(VARIANTS)))
    for k, one in enumerate(rows["shipped"]):
        low, high = one.altitude_km
        cells = " | ".join(
            f"{row.median_m:.0f} / {row.p95_m:.0f} / {row.nees6:.1f} / {_signed(row.bias_rtn_m)}"
            for row in (rows[name][k] for name in VARIANTS)
        )
        print(
            f"| {one.recording} {one.longitude_deg:.0f}° E | {low:.0f} to {high:.0f} "
            f"| {one.fixed} of {one.frames} | {cells} |"
        )
    print()
    print("| variant | " + " | ".join(_TOGETHER) + " |")
    print("|" + "---|" * (1 + len(_TOGETHER)))
    for name in VARIANTS:
        print(f"| {name} | " + " | ".join(together(rows[name]).values()) + " |")
    return 0


def variant(name: str, recording: Recording) -> tuple[CatalogueTable, AnchoredParameters]:
    """Return on-board catalogue and parameters of a variant."""
    table = unpack_catalogue_table(recording.tables.catalogue)
    parameters = AnchoredParameters()
    if name != "shipped":
        before = replace(parameters.errors, pixel_bias_px=0.25, catalogue_correlation_rad=math.inf)
        parameters = replace(parameters, errors=before)
    if name in ("list", "constant"):
        north_m = 59.0 if name == "constant" else 0.0
        table = moved(table, -recording.shift_m[:, 0], north_m - recording.shift_m[:, 1])
    return table, parameters


_TOGETHER = (
    "windows",
    "median of medians m",
    "largest median m",
    "largest 95 % m",
    "NEES(6)",
    "windows with NEES 4.5 to 7.5",
    "largest radial bias m",
    "along, across rms of biases m",
    "NIS per degree",
    "end of coast 95 % m",
)


def together(rows: Sequence[WindowRow]) -> dict[str, str]:
    """Return the figures of all windows together, as text."""
    median, p95, nees, nis, coast = (
        np.array([getattr(row, name) for row in rows])
        for name in ("median_m", "p95_m", "nees6", "nis_per_degree", "coast_end_m")
    )
    bias = np.array([row.bias_rtn_m for row in rows])
    along, across = np.sqrt(np.mean(bias[:, 1:] ** 2, axis=0))
    # The first window of a session starts with 1 km: its coast ends before it is known.
    settled = coast[np.isfinite(coast) & (np.roll(np.isnan(coast), 1) == 0)]
    values = (
        f"{len(rows)}",
        f"{np.median(median):.0f}",
        f"{median.max():.0f}",
        f"{p95.max():.0f}",
        f"{nees.min():.1f} to {nees.max():.1f}",
        f"{np.count_nonzero((nees >= 4.5) & (nees <= 7.5))}",
        f"{np.abs(bias[:, 0]).max():.0f}",
        f"{along:.0f}, {across:.0f}",
        f"{nis.min():.2f} to {nis.max():.2f}",
        f"{np.percentile(settled, 95.0):.0f}" if settled.size else "",
    )
    return dict(zip(_TOGETHER, values, strict=True))


def _signed(bias_rtn_m: tuple[float, float, float]) -> str:
    return ", ".join(f"{value:.0f}" for value in bias_rtn_m)


def _recording(folder: Path, place: tuple[Any, ...]) -> Recording:
    path = folder / f"{place[0]}.npz"
    if not path.is_file():
        save_recording(path, record(_scenario(place), data_folder(), _told))
    return load_recording(path)


def _scenario(place: tuple[Any, ...]) -> Scenario:
    name, west, east, south, north, passes, direction, seed = place
    scenario = load_scenario("unseen-strip")
    window = replace(
        scenario.window,
        passes=passes,
        direction=direction,
        longitude_min_deg=west,
        longitude_max_deg=east,
        latitude_min_deg=south,
        latitude_max_deg=north,
    )
    return replace(scenario, name=name, seed=seed, window=window)


def _told(frames: Iterable[Any], total: int) -> Iterable[Any]:
    for number, frame in enumerate(frames):
        if number % 50 == 0:
            print(f"frame {number} of {total}", file=sys.stderr, flush=True)
        yield frame


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
