"""`linna dataset`: build, check and summarise detector data sets."""

from __future__ import annotations

import argparse
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    from linna.output import add_json_flag

    verbs = parser.add_subparsers(title="verbs", required=True)
    build = verbs.add_parser("build", help="render frames with labels; resumes an unfinished data set")
    build.add_argument("recipe", type=Path, metavar="SCENARIO", help="TOML with a [dataset] table")
    build.add_argument("--out", type=Path, required=True, metavar="DIR")
    build.add_argument("--frames", type=int, required=True, metavar="N")
    build.add_argument(
        "--workers", type=int, default=1, metavar="W", help="processes; the frames do not depend on it"
    )
    build.add_argument("--seed", type=int, default=None, help="instead of the recipe's")
    build.add_argument("--renderer", choices=("fast",), default="fast")
    add_json_flag(build)
    build.set_defaults(handler=_build)
    for name, handler, text in (
        ("check", _check, "verify every file of a data set"),
        ("stats", _stats, "frames by split, crater instances by class"),
    ):
        verb = verbs.add_parser(name, help=text)
        verb.add_argument("folder", type=Path, metavar="DIR")
        add_json_flag(verb)
        verb.set_defaults(handler=handler)


def _build(arguments: argparse.Namespace) -> int:
    import dataclasses
    import time

    from linna.data import data_folder
    from linna.output import emit, log
    from payload_emulator.training.build import build
    from payload_emulator.training.recipe import load_recipe

    recipe = load_recipe(arguments.recipe)
    if arguments.seed is not None:
        recipe = dataclasses.replace(recipe, seed=arguments.seed)
    began = time.monotonic()
    first: int | None = None
    done = 0
    for done, total in build(
        recipe, arguments.out, arguments.frames, data_folder(), max(1, arguments.workers)
    ):
        first = done if first is None else first
        elapsed = max(time.monotonic() - began, 1e-9)
        rate = (done - first) / elapsed
        left = f", {(total - done) / rate:.0f} s left" if rate > 0 else ""
        log(f"dataset: {done}/{total} frames ({rate:.1f}/s{left})")
    rate = (done - (first or 0)) / max(time.monotonic() - began, 1e-9)
    figures = _summary(arguments.out) | {"frames_per_s": rate}
    emit(arguments, figures, _text(figures))
    return 0


def _check(arguments: argparse.Namespace) -> int:
    from linna.output import emit, log
    from payload_emulator.training.integrity import check

    problems = check(arguments.folder)
    for problem in problems:
        log(problem)
    figures = _summary(arguments.folder) | {"problems": problems}
    emit(
        arguments,
        figures,
        f"{_text(figures)}\n{len(problems)} problems" if problems else f"{_text(figures)}\nwhole",
    )
    return 1 if problems else 0


def _stats(arguments: argparse.Namespace) -> int:
    from linna.output import emit

    figures = _summary(arguments.folder)
    emit(arguments, figures, _text(figures))
    return 0


def _summary(folder: Path) -> dict[str, object]:
    from payload_emulator.training.dataset import Dataset, count_instances
    from payload_emulator.training.recipe import SPLITS

    dataset = Dataset(folder)
    frames = dataset.frames()
    instances = count_instances(frames, dataset.width_px, dataset.height_px)
    total = max(sum(instances), 1)
    return {
        "frames": len(frames),
        "instances": instances,
        "shares": [count / total for count in instances],
        "split": {split: len(dataset.frames(split)) for split in SPLITS},
        "sources": {
            name: sum(f.source == name for f in frames) for name in sorted({f.source for f in frames})
        },
        "labels_sha256": dataset.digest,
        "data": dataset.index["data"],
    }


def _text(figures: dict[str, object]) -> str:
    split = figures["split"]
    instances, shares = figures["instances"], figures["shares"]
    assert isinstance(split, dict) and isinstance(instances, list) and isinstance(shares, list)
    classes = ", ".join(
        f"{name} {count} ({100 * share:.1f} %)"
        for name, count, share in zip(("5-10 km", "10-15 km", "15-30 km"), instances, shares, strict=True)
    )
    splits = ", ".join(f"{name} {count}" for name, count in split.items())
    return f"{figures['frames']} frames: {splits}\ncraters in view: {classes}"
