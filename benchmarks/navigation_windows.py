"""Navigation over windows of real terrain, with and without registration: python -m benchmarks.navigation_windows.

Frames of several windows are rendered and searched once; then each variant of catalogue and filter runs on the same
detections (level 3s on tuning and training terrain, level 3 on the strip and the block that no detector has learned).
Parameters of the filter were chosen on `tuning` only; the height of the craters also on `training`.

- `list`: the crater list as published, filter as before.
- `constant`: the list 59 m farther north, which was the constant of former versions.
- `registered`: the list registered by place, filter as before.
- `rims`: the list registered by place, filter as shipped, craters at the mean height of their rims.
- `shipped`: craters at the height at which the network sees their centres, filter as shipped.

The filter as before has a pixel bias of 0.25 px (1 sigma) and a catalogue offset that never changes. The first three
variants have the craters at the mean height of their rims, too.

A second table compares the shipped filter with the smoother of the ground (`--smoother`), a third shows the filter with
attitudes that are noisier than declared (`--attitude-noise-deg`). `--crater-height` fits the height at which the
network sees the centres of craters, from which the height of the craters on board follows.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from linna.data import data_folder
from lunar.datafolder import default_orientation
from payload_emulator.errors import ModelError, RecordError
from payload_emulator.flight.models import DEFAULT_NETWORK
from payload_emulator.flight.navigation.anchored_parameters import AnchoredParameters
from payload_emulator.session.loading import SEEN_BELOW_RIM_M, network_octets
from payload_emulator.session.scenario import Scenario, load_scenario
from studies.crater_heights import fit_height, sightings
from studies.navigation_windows import (
    Recording,
    SmootherRow,
    WindowRow,
    fly,
    load_recording,
    moved,
    record,
    save_recording,
    smoothed_position_m,
    smoother_rows,
    window_rows,
    with_attitude_noise,
)
from tmtc.tables import CatalogueTable, unpack_catalogue_table

# Name, west, east, south, north (degrees), windows, direction, seed.
PLACES = {
    "tuning": (("tuning", 315.0, 330.0, -60.0, 60.0, 5, "ascending", 3040),),
    "training": (("training", 300.0, 315.0, -60.0, 60.0, 3, "descending", 3043),),
    "test": (
        ("strip-up", 285.0, 300.0, -60.0, 60.0, 6, "ascending", 2041),
        ("strip-down", 285.0, 300.0, -60.0, 60.0, 5, "descending", 2042),
        ("block", 25.0, 45.0, 0.0, 30.0, 6, "ascending", 2043),
    ),
}
VARIANTS = ("list", "constant", "registered", "rims", "shipped")


def main(words: Sequence[str]) -> int:
    """Print a table of the windows and one of their figures together."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.navigation_windows")
    parser.add_argument("--set", choices=PLACES, default="tuning", help="default: tuning")
    parser.add_argument(
        "--recordings", type=Path, required=True, help="folder of recordings, made where missing"
    )
    parser.add_argument(
        "--network",
        default=DEFAULT_NETWORK,
        metavar="NAME|FILE",
        help="network that searches the frames: a shipped one or an ONNX file (default: craters)",
    )
    table = parser.add_mutually_exclusive_group()
    table.add_argument("--smoother", action="store_true", help="only the table of the smoother")
    table.add_argument(
        "--attitude-noise-deg",
        type=float,
        nargs="+",
        metavar="A",
        help="only the table of attitudes with this noise in addition to the declared 0.01 degrees",
    )
    table.add_argument(
        "--crater-height",
        action="store_true",
        help="only the height of the craters, fitted to true positions",
    )
    parser.add_argument(
        "--no-monitor", action="store_true", help="attitudes without the monitor of the attitude"
    )
    arguments = parser.parse_args(words)
    arguments.recordings.mkdir(parents=True, exist_ok=True)
    try:
        recordings = [
            _recording(arguments.recordings, place, arguments.network) for place in PLACES[arguments.set]
        ]
    except (ModelError, RecordError) as error:
        print(f"navigation_windows: {error}", file=sys.stderr)
        return 2
    if arguments.smoother:
        _print_smoother(recordings)
    elif arguments.crater_height:
        _print_crater_height(recordings)
    elif arguments.attitude_noise_deg:
        _print_attitudes(recordings, arguments.attitude_noise_deg, not arguments.no_monitor)
    else:
        _print_variants(recordings)
    return 0


def _print_variants(recordings: Sequence[Recording]) -> None:
    rows: dict[str, list[WindowRow]] = {name: [] for name in VARIANTS}
    for recording in recordings:
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


def _print_smoother(recordings: Sequence[Recording]) -> None:
    """Print the errors of filter and smoother at the start of the windows (20 frames) and over all of them."""
    orientation = default_orientation(data_folder())
    rows: list[SmootherRow] = []
    print("| window | start, filter m | smoother m | ratio | whole window, filter m | smoother m | ratio |")
    print("|" + "---|" * 7)
    for recording in recordings:
        flight = fly(recording, AnchoredParameters())
        found = smoother_rows(recording, flight, smoothed_position_m(recording, flight, orientation))
        rows += found
        for number, row in enumerate(found, 1):
            print(f"| {row.recording} {number} | {_pair(*row.start_m)} | {_pair(*row.whole_m)} |", flush=True)
    for name, pairs in (
        ("start of windows", np.array([row.start_m for row in rows if np.isfinite(row.start_m[0])])),
        ("whole windows", np.array([row.whole_m for row in rows])),
    ):
        ratios, (filtered, smoothed) = pairs[:, 0] / pairs[:, 1], np.sqrt(np.mean(pairs**2, axis=0))
        print(
            f"\n{name}: {len(pairs)} windows, root mean square {filtered:.0f} m and {smoothed:.0f} m, ratio "
            f"{filtered / smoothed:.2f}; median ratio {np.median(ratios):.2f}, {ratios.min():.2f} to {ratios.max():.2f}"
        )


def _print_crater_height(recordings: Sequence[Recording]) -> None:
    """Print the fitted height of seen centres against the rims, for all craters and by their depth over diameter."""
    seen = sightings(recordings)
    low, high = (round(float(f(seen.altitude_m)) / 1e3) for f in (np.min, np.max))
    print(
        f"detections at {low} to {high} km\n\n| depth/diameter | craters | detections | height relative to the rim m |"
    )
    print("|" + "---|" * 4)
    for name, rows in (
        ("all", np.ones(seen.crater.size, dtype=bool)),
        ("below 0.06", seen.depth_ratio < 0.06),
        ("0.06 and more", seen.depth_ratio >= 0.06),
    ):
        fit = fit_height(seen.chosen(rows))
        height = f"{fit.height_m:.0f} ± {fit.sigma_m:.0f}" if math.isfinite(fit.height_m) else "unknown"
        print(f"| {name} | {fit.craters:,} | {fit.detections:,} | {height} |")


def _print_attitudes(recordings: Sequence[Recording], noises_deg: Sequence[float], monitored: bool) -> None:
    """Print the figures of the shipped filter with noisier attitudes."""
    print("| added noise deg | degraded from frame | estimated noise deg | " + " | ".join(_TOGETHER) + " |")
    print("|" + "---|" * (3 + len(_TOGETHER)))
    parameters = AnchoredParameters()
    if not monitored:
        never = replace(parameters.monitor, least_frames=1_000_000)
        parameters = replace(parameters, monitor=never)
    for noise_deg in noises_deg:
        rows: list[WindowRow] = []
        first, estimates = [], []
        for recording in recordings:
            noisy = with_attitude_noise(recording, math.radians(noise_deg), recording.seed)
            flight = fly(noisy, parameters)
            rows += window_rows(noisy, flight)
            degraded = np.flatnonzero(flight.attitude_noise_rad)
            first.append(str(degraded[0]) if degraded.size else "never")
            if degraded.size:
                estimates.append(f"{np.degrees(np.median(flight.attitude_noise_rad[degraded])):.2f}")
        cells = " | ".join(together(rows).values())
        print(f"| {noise_deg:g} | {', '.join(first)} | {', '.join(estimates)} | {cells} |", flush=True)


def _pair(filtered_m: float, smoothed_m: float) -> str:
    if not math.isfinite(filtered_m):
        return " | | "
    return f"{filtered_m:.0f} | {smoothed_m:.0f} | {filtered_m / smoothed_m:.2f}"


def variant(name: str, recording: Recording) -> tuple[CatalogueTable, AnchoredParameters]:
    """Return on-board catalogue and parameters of a variant."""
    table = unpack_catalogue_table(recording.tables.catalogue)
    parameters = AnchoredParameters()
    if name != "shipped":
        table = replace(table, rim_height_m=table.rim_height_m + SEEN_BELOW_RIM_M)
    if name not in ("rims", "shipped"):
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


def _recording(folder: Path, place: tuple[Any, ...], network: str) -> Recording:
    """Return the recording of a place with a network, made where it is missing.

    Raises
    ------
    ModelError
        There is no such network.
    RecordError
        The file is no recording, or one of another network.
    """
    path, sha256 = folder / f"{place[0]}.npz", hashlib.sha256(network_octets(network)).hexdigest()
    if not path.is_file():
        save_recording(path, record(_scenario(place, network), data_folder(), _told))
    recording = load_recording(path)
    if recording.network_sha256 != sha256:
        raise RecordError(
            f"{path}: expected a recording with the network {sha256[:12]} ({network}), found one with "
            f"{recording.network_sha256[:12]}; remove it or name another folder"
        )
    return recording


def _scenario(place: tuple[Any, ...], network: str) -> Scenario:
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
    detector = replace(scenario.detector, network=network)
    return replace(scenario, name=name, seed=seed, window=window, detector=detector)


def _told(frames: Iterable[Any], total: int) -> Iterable[Any]:
    for number, frame in enumerate(frames):
        if number % 50 == 0:
            print(f"frame {number} of {total}", file=sys.stderr, flush=True)
        yield frame


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
