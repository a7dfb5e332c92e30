"""`linna render`: a frame of a scenario as a picture, or several on a labelled contact sheet."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from linna.data import blender_python, data_folder
from linna.errors import UsageError
from linna.output import emit, finish, log, progress
from linna.parser import number, option

RENDERERS = ("fast", "raymarch", "cycles")
LAWS = ("lunar-lambert", "lambert", "hapke", "matt")
TERRAINS = ("auto", "raster", "procedural")
SHEET_COLUMNS = 3


def configure_render(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Render one frame; with --sheet several frames on one picture. Sheets take the epochs named, or --views "
        "frames spread over the scenario's observation windows."
    )
    option(parser, "scenario SCENARIO", Path, "scenario file, or the name of a shipped one")
    option(parser, "--epoch UTC", str, "when, as 2029-08-07T12:00:00Z; may be repeated", [], action="append")
    option(parser, "--out F.png", Path, "RGB picture to write", required=True)
    option(parser, "--renderer", RENDERERS, "", "fast")
    option(parser, "--sheet", bool, "a contact sheet of several frames")
    option(parser, "--views N", number(int, least=1, most=60), "frames of a sheet", 6)
    option(parser, "--draw-labels", bool, "draw the labels: cyan, lime, yellow by class (paper, Fig. 5)")
    option(parser, "--terrain", TERRAINS, "instead of the scenario's")
    option(parser, "--photometry", LAWS, "instead of the scenario's; matt is the paper's Principled BSDF")
    finish(parser, run_render)


def run_render(arguments: argparse.Namespace) -> int:

    if arguments.out.suffix.lower() != ".png":
        raise UsageError(f"--out: expected a .png file, found {arguments.out.name}")
    if not arguments.out.parent.is_dir():
        raise UsageError(f"--out: expected an existing folder, found {arguments.out.parent}")
    if arguments.sheet:
        return _run_sheet(arguments)
    if len(arguments.epoch) != 1:
        raise UsageError(f"--epoch: expected one for one frame, found {len(arguments.epoch)} (see --sheet)")
    return _run_frame(arguments)


def _run_frame(arguments: argparse.Namespace) -> int:
    from lunar.timescales import parse_utc
    from payload_emulator.session.world.frame import render_frame
    from payload_emulator.training.data.dataset import write_whole
    from payload_emulator.training.evaluate.sheets import draw_labels, save_png

    frame = render_frame(
        _scenario(arguments), data_folder(), parse_utc(arguments.epoch[0]), arguments.renderer, blender_python()
    )
    save_png(draw_labels(frame.image, frame.labels) if arguments.draw_labels else frame.image, arguments.out)
    figures: dict[str, Any] = {
        "image": str(arguments.out),
        "metadata": frame.metadata,
        "labels": frame.labels,
        "data": list(frame.data_names),
    }
    if frame.filmic_png:
        filmic = arguments.out.with_name(f"{arguments.out.stem}-filmic.png")
        write_whole(filmic, frame.filmic_png)
        figures["filmic"] = str(filmic)
    log(f"{arguments.out}: {len(frame.labels)} craters; data: {'; '.join(frame.data_names)}")
    metadata = frame.metadata
    text = (
        f"{arguments.out}\n{metadata['epoch']}  latitude {metadata['latitude_deg']:.3f} deg, longitude "
        f"{metadata['longitude_deg']:.3f} deg E, altitude {metadata['altitude_km']:.2f} km, Sun "
        f"{metadata['sun_elevation_deg']:.1f} deg up, azimuth {metadata['sun_azimuth_deg']:.1f} deg; "
        f"{len(frame.labels)} craters labelled"
    )
    return emit(arguments, figures, text)


def _run_sheet(arguments: argparse.Namespace) -> int:
    from payload_emulator.session.world.frame import take_frame, view_at
    from payload_emulator.training.evaluate.sheets import contact_sheet, draw_labels, eight_bits, save_png

    world, epochs = _views(arguments)
    views = [view_at(world, utc_ns) for utc_ns in epochs]
    frames = [
        take_frame(world, view, arguments.renderer, blender_python())
        for view in progress(views, len(views), "render", "frames")
    ]
    pictures = [
        draw_labels(frame.image, frame.labels) if arguments.draw_labels else eight_bits(frame.image) for frame in frames
    ]
    captions = [_caption(world, view) for view in views]
    save_png(contact_sheet(pictures, captions, min(SHEET_COLUMNS, len(pictures))), arguments.out)
    labels = [label for frame in frames for label in frame.labels if label["inside"]]
    counts = [sum(label["class"] == size for label in labels) for size in range(3)]
    figures = {
        "image": str(arguments.out),
        "views": [frame.metadata | {"labels": len(frame.labels)} for frame in frames],
        "instances": counts,
        "data": list(world.data_names),
    }
    text = f"{arguments.out}: {len(frames)} frames; craters of classes 0, 1, 2: {', '.join(map(str, counts))}"
    return emit(arguments, figures, text)


def _scenario(arguments: argparse.Namespace) -> Any:
    """The scenario with what the command line says otherwise."""
    from payload_emulator.session.scenario import load_scenario

    scenario = load_scenario(arguments.scenario)
    replaced = {"terrain": {"source": arguments.terrain}, "light": {"photometry": arguments.photometry}}
    sections = {
        name: dataclasses.replace(
            getattr(scenario, name), **{key: value for key, value in keys.items() if value is not None}
        )
        for name, keys in replaced.items()
    }
    return dataclasses.replace(scenario, **sections)


def _views(arguments: argparse.Namespace) -> tuple[Any, list[int]]:
    """The world, and the epochs named or those spread over its observation windows."""
    from lunar.timescales import parse_utc
    from payload_emulator.session.world.frame import window_epochs, world_at

    if not arguments.epoch:
        return window_epochs(_scenario(arguments), data_folder(), arguments.views)
    epochs = [parse_utc(text) for text in arguments.epoch]
    return world_at(_scenario(arguments), data_folder(), epochs), epochs


def _caption(world: Any, view: Any) -> str:
    from payload_emulator.session.world.frame import metadata_of

    row = metadata_of(world, view)
    return (
        f"{row['latitude_deg']:.1f} N {row['longitude_deg']:.1f} E, {row['altitude_km']:.1f} km, "
        f"Sun {row['sun_elevation_deg']:.1f} deg"
    )
