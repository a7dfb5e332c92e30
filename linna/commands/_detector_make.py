"""`linna detector make`: from a recipe to the shipped model in one command."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def configure(verbs: Any) -> None:
    """Add the verb."""
    from linna.output import add_json_flag

    make = verbs.add_parser(
        "make",
        help="data set, training, export and evaluation in one go; the same command goes on after a kill",
    )
    make.add_argument("recipe", type=Path, metavar="RECIPE.toml", help="as for `linna dataset build`")
    make.add_argument("--out", type=Path, required=True, metavar="DIR", help="where everything goes")
    make.add_argument("--frames", type=int, default=5000, help="of the data set (default: 5000)")
    make.add_argument("--minutes", type=float, default=90.0, help="of training (default: 90)")
    make.add_argument("--steps", type=int, default=0, help="budget of the training in steps instead")
    make.add_argument("--seed", type=int, default=1, help="of the training")
    make.add_argument("--crop", type=int, default=384, metavar="PX")
    make.add_argument("--batch", type=int, default=8)
    make.add_argument("--workers", type=int, default=1, help="processes that render")
    make.add_argument("--replicas", type=int, default=0, help="threads that train (0: one per core)")
    make.add_argument("--dataset", type=Path, default=None, metavar="DIR", help="take this data set as it is")
    make.add_argument("--run", type=Path, default=None, metavar="DIR", help="take this training run as it is")
    make.add_argument(
        "--rims", type=Path, default=None, metavar="TABLE", help="rims from `linna catalogue curate`"
    )
    make.add_argument("--revision", default="", help="source revision for the model's metadata")
    make.add_argument("--note", default="", help="a remark on the training for the model's metadata")
    add_json_flag(make)
    make.set_defaults(handler=_make)


def _make(arguments: argparse.Namespace) -> int:
    from linna.commands._detector_common import need_torch, restart_for_training, write_text
    from linna.data import data_folder
    from linna.errors import UsageError
    from linna.output import as_json, emit, log, progress

    need_torch()
    from payload_emulator.session.recipe import load_recipe
    from payload_emulator.training.data.feeder import TrainParameters
    from studies.pipeline import Job, format_comparison, make_dataset, make_model

    if arguments.run is not None and arguments.dataset is None:
        raise UsageError("--run: expected the data set it was trained on (--dataset), found none")
    job = Job(
        out=arguments.out,
        recipe=load_recipe(arguments.recipe),
        frames=arguments.frames,
        parameters=TrainParameters(
            minutes=0.0 if arguments.steps else arguments.minutes,
            steps=arguments.steps,
            batch=arguments.batch,
            crop_px=arguments.crop,
            seed=arguments.seed,
            replicas=arguments.replicas,
        ),
        data=data_folder(),
        workers=max(1, arguments.workers),
        dataset=arguments.dataset,
        run=arguments.run,
        rims=arguments.rims,
        revision=arguments.revision,
        note=arguments.note,
    )
    make_dataset(job, log)
    restart_for_training()  # after the rendering, whose processes would inherit the trainer's hunger for memory
    document = make_model(job, log, lambda frames: progress(frames, len(frames), "evaluate", "frames"))
    write_text(arguments.out / "figures.json", as_json(document))
    emit(arguments, document, format_comparison(document))
    return 0
