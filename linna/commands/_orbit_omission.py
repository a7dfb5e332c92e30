"""`linna orbit omission`: errors of a filter's gravity field relative to a better one, as process noise."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from linna.output import add_json_flag, emit

_MGAL = 1e-5


def configure_omission(commands: Any) -> None:
    """Add `omission` to the subparsers of `linna orbit`."""
    omission = commands.add_parser(
        "omission", help="slow part of the acceleration that a gravity field lacks: a filter's process noise"
    )
    omission.add_argument("--degree", type=int, default=100, metavar="N", help="degree flown (default 100)")
    omission.add_argument(
        "--flown",
        type=Path,
        metavar="FILE",
        help="field flown (default: that of the truth, cut at the degree)",
    )
    omission.add_argument(
        "--truth", type=Path, metavar="FILE", help="field of the truth (default: GRAIL's of the data folder)"
    )
    omission.add_argument(
        "--truth-degree", type=int, metavar="N", help="its degree (default 150; as flown with --flown)"
    )
    omission.add_argument("--revolutions", type=int, default=16, metavar="N", help="revolutions (default 16)")
    omission.add_argument(
        "--inclination-deg", type=float, default=90.0, metavar="I", help="inclination (default 90)"
    )
    omission.add_argument("--seed", type=int, default=1, help="seed of nodes and perilunes (default 1)")
    add_json_flag(omission)
    omission.set_defaults(handler=run_omission)


def run_omission(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from lunar.gravity import load_gravity
    from lunar.gravity_omission import field_psd_m2_s3, measured_omission

    for name, value in (("--degree", arguments.degree), ("--revolutions", arguments.revolutions)):
        if value < 1:
            raise UsageError(f"{name}: expected a number from 1, found {value}")
    named = arguments.truth or data_folder().gravity
    if named is None:
        raise UsageError("--truth: expected a coefficient file, found none named and none in the data folder")
    full = load_gravity(named)
    highest = arguments.truth_degree or (150 if arguments.flown is None else arguments.degree)
    truth = full.truncated(min(highest, full.degree))
    other = full if arguments.flown is None else load_gravity(arguments.flown)
    flown = other.truncated(min(arguments.degree, other.degree))
    inclination_rad = math.radians(arguments.inclination_deg)
    found = measured_omission(truth, flown, arguments.revolutions, arguments.seed, inclination_rad)
    near, far = field_psd_m2_s3(flown.name, flown.degree, inclination_rad)
    figures = {
        "truth": {"name": truth.name, "degree": truth.degree},
        "flown": {"name": flown.name, "degree": flown.degree},
        "revolutions": found.revolutions,
        "seed": arguments.seed,
        "inclination_deg": arguments.inclination_deg,
        "psd_m2_s3": found.psd_m2_s3.tolist(),
        "near_psd_m2_s3": found.near_psd_m2_s3.tolist(),
        "far_psd_m2_s3": found.far_psd_m2_s3.tolist(),
        "rms_mgal": (found.rms_m_s2 / _MGAL).tolist(),
        "near_rms_mgal": (found.near_rms_m_s2 / _MGAL).tolist(),
        "far_rms_mgal": (found.far_rms_m_s2 / _MGAL).tolist(),
        "filter_near_psd_m2_s3": list(near),
        "filter_far_psd_m2_s3": list(far),
    }

    def row(label: str, values: Any, form: str) -> str:
        return f"{label:<34}" + "".join(f"{format(value, form):>11}" for value in values)

    lines = [
        f"{truth.name} to degree {truth.degree} less {flown.name} to degree {flown.degree}, "
        f"{found.revolutions} revolutions",
        f"{'':<34}{'radial':>11}{'transverse':>11}{'normal':>11}",
        row("density of slow waves, m^2/s^3", found.psd_m2_s3, ".2e"),
        row("  near side", found.near_psd_m2_s3, ".2e"),
        row("  far side", found.far_psd_m2_s3, ".2e"),
        row("what the filter takes, near side", near, ".2e"),
        row("  far side", far, ".2e"),
        row("root mean square, mGal", found.rms_m_s2 / _MGAL, ".2f"),
        row("  near side", found.near_rms_m_s2 / _MGAL, ".2f"),
        row("  far side", found.far_rms_m_s2 / _MGAL, ".2f"),
    ]
    emit(arguments, figures, text="\n".join(lines))
    return 0
