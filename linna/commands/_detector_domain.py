"""`linna detector domain`: one network on the same scenes by several renderers."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.commands._detector_common import add_model, model_octets


def configure(verbs: Any) -> None:
    """Add the verb."""
    from linna.output import add_json_flag

    domain = verbs.add_parser(
        "domain", help="the same scenes by several renderers, scored against the same labels"
    )
    add_model(domain)
    domain.add_argument(
        "--dataset",
        type=Path,
        nargs="+",
        required=True,
        metavar="DIR",
        help="data sets of one recipe, one per renderer; the first is the reference",
    )
    domain.add_argument("--split", choices=("train", "val", "test"), default="test")
    domain.add_argument("--threshold", type=float, default=None, help="instead of the model's own")
    domain.add_argument(
        "--within",
        type=float,
        default=None,
        metavar="F1",
        help="exit with 1 where a renderer's strict F1 falls short of the reference's by more",
    )
    add_json_flag(domain)
    domain.set_defaults(handler=_domain)


def _domain(arguments: argparse.Namespace) -> int:
    from linna.output import emit, log, progress
    from payload_emulator.training.data.dataset import Dataset
    from studies.domain import compare_renderers, format_domains

    figures = compare_renderers(
        model_octets(arguments.model),
        [Dataset(folder) for folder in arguments.dataset],
        arguments.split,
        arguments.threshold,
        lambda jobs: progress(jobs, len(jobs), "domain", "pictures"),
    )
    emit(arguments, figures, format_domains(figures))
    if arguments.within is None:
        return 0
    short = [
        row
        for row in figures["renderers"]
        if not row["all"]["strict"]["f1_less_reference"] >= -arguments.within
    ]
    for row in short:
        difference = row["all"]["strict"]["f1_less_reference"]
        log(
            f"{row['renderer']}: F1 expected within {arguments.within:g} of the reference, found {difference:+.3f}"
        )
    return 1 if short else 0
