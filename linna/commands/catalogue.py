"""`linna catalogue`: size classes of a crater catalogue."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from lunar.catalogue import CraterCatalogue

SYNTHETIC = ("paper-density", "paper-density-synthetic", "paper-density-uniform")
CATALOGUE_HELP = (
    "catalogue (CSV, plain or gzip), or paper-density: the paper's class counts, from the real catalogue at hand "
    "completed with random craters where it is silent (paper-density-synthetic: all random, few in the maria; "
    "paper-density-uniform: all random); default: the catalogue of the data at hand"
)


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    stats = commands.add_parser("stats", help="size classes of a crater catalogue")
    stats.add_argument(
        "catalogue",
        nargs="?",
        metavar="FILE",
        help=CATALOGUE_HELP,
    )
    stats.add_argument("--seed", type=int, default=1, help="seed of a synthetic catalogue (default: 1)")
    stats.add_argument("--plot", type=Path, metavar="FILE", help="histogram of diameters (png, svg or pdf)")
    add_json_flag(stats)
    stats.set_defaults(handler=run_stats)


def run_stats(arguments: argparse.Namespace) -> int:
    from lunar.catalogue import PAPER_CLASS_COUNTS, class_counts

    catalogue = open_catalogue(arguments.catalogue, arguments.seed)
    counts = [int(count) for count in class_counts(catalogue)]
    complete = catalogue.select(catalogue.complete)
    figures = {
        "class_counts": counts,
        "class_counts_complete": [int(count) for count in class_counts(complete)],
        "class_counts_paper": list(PAPER_CLASS_COUNTS),
        "class_share": [count / max(sum(counts), 1) for count in counts],
        "total": len(catalogue),
        "diameter_km": _range(catalogue.diameter_m / 1e3),
        "source": catalogue.source,
        "data": [f"crater catalogue {catalogue.source}"],
    }
    if arguments.plot is not None:
        from reports.studies import save_class_histogram

        save_class_histogram(arguments.plot, catalogue.diameter_m / 1e3, f"Catalogue: {catalogue.source}")
        figures["plot"] = str(arguments.plot)
    lines = [f"{catalogue.source}: {len(catalogue)} craters"]
    names = ("5-10 km", "10-15 km", "15-30 km")
    lines += [
        f"class {k} ({name}): {count} (paper {paper})"
        for k, (name, count, paper) in enumerate(zip(names, counts, PAPER_CLASS_COUNTS, strict=True))
    ]
    emit(arguments, figures, text="\n".join(lines))
    return 0


def open_catalogue(name: str | None, seed: int) -> CraterCatalogue:
    """The catalogue of a file or of one of `SYNTHETIC`; without a name, the most complete of the data at hand.

    The paper's density comes from the real catalogue, completed with random craters where it is silent, or is all
    synthetic where there is none at hand.
    """
    from linna.data import data_folder
    from lunar.catalogue import completed_to_paper, load_catalogue, paper_density_catalogue

    if name is not None and name not in SYNTHETIC:
        return load_catalogue(name)
    data = data_folder()
    if name == SYNTHETIC[0] and data.catalogue_lu is not None:
        return completed_to_paper(load_catalogue(data.catalogue_lu), seed)
    found = data.catalogue_composite or data.catalogue_lu or data.catalogue_robbins
    if name is not None or found is None:
        return paper_density_catalogue(seed, uniform=name == SYNTHETIC[2])
    return load_catalogue(found)


def _range(values) -> dict[str, float]:
    if len(values) == 0:
        return {"min": float("nan"), "max": float("nan")}
    return {"min": float(values.min()), "max": float(values.max())}
