"""`linna catalogue landmarks`: the payload's own map, from a downlink, compared with a catalogue."""

import argparse
from pathlib import Path

from linna.output import add_json_flag, emit
from linna.parser import option


def configure(landmarks: argparse.ArgumentParser) -> None:
    option(landmarks, "downlink FILE", Path, "downlink (CADUs or packets)")
    option(landmarks, "--catalogue F", str, "catalogue to compare with (default: the available one)")
    add_json_flag(landmarks)
    landmarks.set_defaults(handler=run, seed=1)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.evaluation.fixes import compare_map, latest, mapped_craters
    from linna.commands._choices import open_catalogue
    from tmtc.dictionary.payload import DICTIONARY
    from tmtc.downlink import decode

    decoded = decode(arguments.downlink.read_bytes())
    table = DICTIONARY.unpack_many(decoded.buffer, decoded.cut).get("landmarks")
    catalogue = open_catalogue(arguments.catalogue, arguments.seed)
    reports = mapped_craters(table)
    mapped = latest(reports)
    result = compare_map(mapped, catalogue)
    figures = {
        "landmarks": len(mapped),
        "reports": len(reports),
        "in_catalogue": result.known,
        "new": len(mapped) - result.known,
        "median_horizontal_m": result.median_horizontal_m,
        "median_offset_m": dict(zip(("east", "north", "up"), result.median_offset_m, strict=True)),
        "normalised_square": result.normalised_square,
        "catalogue": catalogue.source,
    }
    text = f"{len(mapped)} landmarks mapped on board; {result.known} of them in {catalogue.source}"
    if result.known:
        text += (
            f", {result.median_horizontal_m:.0f} m from it (median); east and north squared over the claimed sigma: "
            f"{result.normalised_square:.2f}"
        )
    return emit(arguments, figures, text=text)
