"""`linna replay`: a payload build over an archived pass."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from linna.commands.emulate import outcomes_line
from linna.data import data_folder
from linna.errors import UsageError
from linna.output import emit, finish, progress
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "archive", Path, "pass archive: a folder or a zip file", nargs="?")
    option(parser, "--build", str, "build file (TOML), or 'current': this flight code and its network", "current")
    option(parser, "--out DIR", Path, "output folder for downlink and summary")
    option(parser, "--check-build BUILD", Path, "only check a build file, and its parameters against this flight code")
    option(
        parser,
        "--complete",
        bool,
        "fly nothing; write to --out a copy of the archive with all its frames, rendered from its scenario",
    )
    option(
        parser,
        "--recorded-only",
        bool,
        "refuse an archive that lacks frames instead of rendering them from its scenario",
    )
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    if arguments.check_build is not None:
        return _check(arguments)
    if arguments.archive is None or arguments.out is None:
        lacking = "ARCHIVE" if arguments.archive is None else "--out DIR"
        raise UsageError(f"replay: expected {lacking}, or --check-build BUILD, found neither")
    if arguments.archive.is_dir():
        return _fly(arguments, arguments.archive)
    from ground_service.regression.archives import opened_archive

    with opened_archive(arguments.archive) as archive:
        return _fly(arguments, archive)


def _fly(arguments: argparse.Namespace, archive: Path) -> int:
    if arguments.complete:
        return _complete(arguments, archive)
    from payload_emulator.session.archive.replay import FlightBuild, load_flight_build, names_command, replay_archive

    current = arguments.build == "current"
    if not current and names_command(Path(arguments.build)):
        return _run_command(arguments, archive)
    flight = FlightBuild() if current else load_flight_build(Path(arguments.build))
    data = None
    if not arguments.recorded_only:
        data = data_folder()
    summary = replay_archive(archive, flight, arguments.out, data=data, progress=_bar)
    return emit(arguments, summary, text=_describe(summary, arguments.out))


def _check(arguments: argparse.Namespace) -> int:
    from ground_service.errors import InvalidInput
    from ground_service.regression.builds import load_build
    from payload_emulator.errors import ParameterError
    from payload_emulator.session.archive.replay import check_parameters

    fault: InvalidInput | ParameterError
    try:
        load_build(arguments.check_build)
        check_parameters(arguments.check_build)
    except InvalidInput as error:
        fault, place = error, (error.what, error.where)
    except ParameterError as error:
        fault, place = error, (error.file, error.key)
    else:
        return emit(arguments, {"fault": None}, text=f"{arguments.check_build}: the build is valid")
    names = ("file", "key", "expected", "found")
    figures = {"fault": dict(zip(names, (*place, fault.expected, fault.found), strict=True))}
    emit(arguments, figures, text=str(fault))
    return 2


def _complete(arguments: argparse.Namespace, archive: Path) -> int:
    from payload_emulator.session.archive.replay import complete_archive

    manifest = complete_archive(archive, arguments.out, data_folder(), progress=_bar)
    frames = sum(name.startswith("frames/") for name in manifest["files"])
    return emit(
        arguments, {"archive": str(arguments.out), "frames": frames}, text=f"{frames} frames, archive: {arguments.out}"
    )


def _run_command(arguments: argparse.Namespace, archive: Path) -> int:
    from ground_service.regression.build_runs import run_build
    from ground_service.regression.builds import load_build
    from ground_service.settings import load_settings

    runner = load_settings().runner_exchange
    summary = run_build(load_build(arguments.build), archive, arguments.out, runner=runner).summary()
    emit(arguments, summary, text=summary["text"])
    return 0 if summary["outcome"] == "ok" else 1


def _bar(items: Iterable[Any], total: int) -> Any:
    return progress(items, total, "frames", "frame")


def _describe(summary: dict[str, Any], out: Path) -> str:
    return "\n".join(
        [
            f"{summary['frames']} frames flown again, {summary['packets']} packets, "
            f"{summary['downlink_octets']} octets of downlink",
            outcomes_line(summary),
            f"CPU time: {summary['cpu_ms_per_frame']:.1f} ms per frame",
            f"downlink: {out / 'downlink.cadu'}",
        ]
    )
