"""`linna render`: one frame of a scenario as a picture, with its metadata and labels."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.output import add_json_flag, emit, log

RENDERERS = ("fast", "raymarch")


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", type=Path, metavar="SCENARIO", help="scenario file (TOML)")
    parser.add_argument("--epoch", required=True, metavar="UTC", help="when, as 2029-08-07T12:00:00Z")
    parser.add_argument("--out", required=True, type=Path, metavar="F.png", help="8-bit RGB picture to write")
    parser.add_argument("--renderer", choices=RENDERERS, default="fast", help="default: fast")
    add_json_flag(parser)
    parser.set_defaults(handler=run_render)


def run_render(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from lunar.timescales import parse_utc
    from payload_emulator.frame import render_frame
    from payload_emulator.scenario import load_scenario

    if arguments.out.suffix.lower() != ".png":
        raise UsageError(f"--out: expected a .png file, found {arguments.out.name}")
    if not arguments.out.parent.is_dir():
        raise UsageError(f"--out: expected an existing folder, found {arguments.out.parent}")
    utc_ns = parse_utc(arguments.epoch)
    frame = render_frame(load_scenario(arguments.scenario), data_folder(), utc_ns, arguments.renderer)
    _save_picture(frame.image, arguments.out)
    figures: dict[str, Any] = {
        "image": str(arguments.out),
        "metadata": frame.metadata,
        "labels": frame.labels,
        "data": list(frame.data_names),
    }
    log(f"{arguments.out}: {len(frame.labels)} craters; data: {'; '.join(frame.data_names)}")
    metadata = frame.metadata
    text = (
        f"{arguments.out}\n{metadata['epoch']}  latitude {metadata['latitude_deg']:.3f} deg, longitude "
        f"{metadata['longitude_deg']:.3f} deg E, altitude {metadata['altitude_km']:.2f} km, Sun "
        f"{metadata['sun_elevation_deg']:.1f} deg up, azimuth {metadata['sun_azimuth_deg']:.1f} deg; "
        f"{len(frame.labels)} craters labelled"
    )
    emit(arguments, figures, text)
    return 0


def _save_picture(image: Any, path: Path) -> None:
    """Write the whole file or none of it."""
    import cv2

    done, octets = cv2.imencode(".png", image[..., ::-1])
    assert done
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(octets.tobytes())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
