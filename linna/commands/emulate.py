"""`linna emulate`: run the payload over a scenario and write a pass archive."""

from __future__ import annotations

import argparse
from pathlib import Path

from linna.output import add_json_flag, emit, progress


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", help="scenario file, or the name of a shipped one")
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DIR", help="folder of the pass archive to write"
    )
    parser.add_argument(
        "--mode",
        action="append",
        choices=("paper", "spherical", "anchored"),
        help="estimator to run (may be repeated); default: those of the scenario",
    )
    parser.add_argument("--seed", type=int, help="another seed than the scenario's")
    parser.add_argument(
        "--frames",
        choices=("none", "some", "all"),
        default="some",
        help="images kept in the archive (default: eight of them)",
    )
    add_json_flag(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from payload_emulator.emulator import emulate
    from payload_emulator.scenario import load_scenario

    scenario = load_scenario(arguments.scenario).with_choices(modes=arguments.mode, seed=arguments.seed)
    kept = {"none": 0, "some": 8, "all": None}[arguments.frames]
    summary = emulate(
        scenario,
        data_folder(),
        arguments.out,
        frames_kept=kept,
        progress=lambda frames, total: progress(frames, total, "frames", "frame"),
    )
    emit(arguments, summary, text=describe(summary, arguments.out))
    return 0


def describe(summary: dict, out: Path) -> str:
    """A few lines about an emulated window, for people."""
    altitude = summary["altitude_km"]
    outcomes = ", ".join(f"{name} {count}" for name, count in summary["outcomes"].items() if count)
    return "\n".join(
        [
            f"{summary['frames']} frames, {summary['start_utc']} to {summary['stop_utc']}, altitude "
            f"{altitude['min']:.1f} to {altitude['max']:.1f} km",
            f"{summary['packets']} packets, {summary['downlink_octets']} octets of downlink",
            f"outcomes: {outcomes}",
            f"data: {'; '.join(summary['data'])}",
            f"archive: {out}",
        ]
    )
