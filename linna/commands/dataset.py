"""`linna dataset`: build and check detector data sets."""

import argparse
from pathlib import Path
from typing import Any

from linna.data import blender_python, data_folder
from linna.output import emit, finish, log
from linna.parser import option

_CLASSES = ("5-10 km", "10-15 km", "15-30 km")


def configure_dataset(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", required=True)
    build = verbs.add_parser("build", help="render frames with labels; resumes an unfinished data set")
    option(build, "recipe SCENARIO", Path, "TOML with a [dataset] table, or the name of a shipped scenario")
    option(build, "--out DIR", Path, required=True)
    option(build, "--frames N", int, required=True)
    option(build, "--workers W", int, "processes; the frames do not depend on it", 1)
    option(build, "--seed", int, "instead of the recipe's", None)
    option(build, "--bits", int, "of the PNG files", None, choices=(8, 16))
    option(build, "--renderer NAME", str, "fast (default), raymarch or cycles", None)
    finish(build, _build)
    check = verbs.add_parser("check", help="find missing and damaged files; frames and craters compared with the paper")
    option(check, "folder DIR", Path)
    finish(check, _check)
    stats = verbs.add_parser("stats", help="frames by split, crater instances by class, compared with the paper")
    option(stats, "folder DIR", Path)
    finish(stats, _stats)


def _build(arguments: argparse.Namespace) -> int:
    import dataclasses
    import resource
    import time

    from payload_emulator.session.world.recipe import load_recipe
    from payload_emulator.training.data.build import build
    from payload_emulator.training.data.integrity import summarise

    chosen = {key: getattr(arguments, key) for key in ("seed", "bits", "renderer")}
    recipe = dataclasses.replace(
        load_recipe(arguments.recipe), **{key: value for key, value in chosen.items() if value is not None}
    )
    began = time.monotonic()
    first: int | None = None
    done = 0
    for done, total in build(
        recipe, arguments.out, arguments.frames, data_folder(), max(1, arguments.workers), blender_python()
    ):
        first = done if first is None else first
        rate = (done - first) / max(time.monotonic() - began, 1e-9)
        left = f", {(total - done) / rate:.0f} s left" if rate > 0 else ""
        log(f"dataset: {done}/{total} frames ({rate:.1f}/s{left})")
    made = done - (first or 0)
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu_s = sum(used.ru_utime + used.ru_stime for used in usage)
    figures = summarise(arguments.out) | {
        "frames_made": made,
        "frames_per_s": made / max(time.monotonic() - began, 1e-9),
        "cpu_ms_per_frame": 1e3 * cpu_s / made if made else None,
        "peak_rss_mb": max(used.ru_maxrss for used in usage) / 1024.0,
        "workers": max(1, arguments.workers),
    }
    return emit(arguments, figures, _text(figures))


def _check(arguments: argparse.Namespace) -> int:
    from payload_emulator.training.data.integrity import check, summarise

    problems = check(arguments.folder)
    for problem in problems:
        log(problem)
    if problems:
        emit(arguments, {"whole": False, "problems": problems}, f"{len(problems)} problems")
        return 1
    figures = summarise(arguments.folder)
    return emit(arguments, figures | {"whole": True, "problems": []}, f"{_text(figures)}\nwhole")


def _stats(arguments: argparse.Namespace) -> int:
    from payload_emulator.training.data.integrity import summarise

    figures = summarise(arguments.folder)
    return emit(arguments, figures, _text(figures))


def _text(figures: dict[str, Any]) -> str:
    paper = figures["paper"]
    splits = ", ".join(f"{name} {count}" for name, count in figures["split"].items())
    lines = [
        f"{figures['frames']} frames: {splits}",
        f"{'craters in view':<16}{'here':>10}{'share':>8}{'a frame':>9}{'paper':>10}{'share':>8}{'a frame':>9}",
    ]
    for k, name in enumerate(_CLASSES):
        ours, theirs = (
            f"{of['instances'][k]:>10}{100 * of['shares'][k]:>6.1f} %{of['instances_per_frame'][k]:>9.2f}"
            for of in (figures, paper)
        )
        lines.append(f"{name:<16}{ours}{theirs}")
    lines.append(f"{'frames':<16}{figures['frames']:>10}{'':17}{paper['frames']:>10}")
    return "\n".join(lines)
