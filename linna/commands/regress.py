"""`linna regress`: gate a payload build against a baseline over archived passes."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Container
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._ground import add_operator_options, ground_client, server_of
from linna.data import data_folder
from linna.errors import UsageError
from linna.output import emit, finish, log, progress
from linna.parser import option

PROGRESS_STEP = 0.05
LISTED = 16
"""Digits of an identity in lists; commands accept them."""

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.jobs.service import Job
    from ground_service.regression.model import Build


def configure_regress(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="what", metavar="COMMAND", required=True)
    run = commands.add_parser(
        "run",
        help="replay archives with two builds and judge the candidate",
        description="Replay archives with two builds and judge the candidate. Exit status: 0 pass, 1 fail, "
        "3 inconclusive (the frames do not decide), 2 bad usage, or an archive or a baseline that cannot be used.",
    )
    _archives(run)
    option(run, "--build BUILD", str, "candidate: build file, 'current' or identity", required=True)
    option(run, "--baseline BUILD", str, "baseline", "current")
    option(run, "--policy FILE", Path, "policy of the gates: a file, or a shipped one by name", Path("ci"))
    option(run, "--repeat-baseline", bool, "replay kept baselines again, so that processor times are compared")
    option(run, "--junit FILE", Path, "write JUnit XML")
    option(run, "--report FILE", Path, "write the report as HTML")
    _finish(run, _run)
    baseline = commands.add_parser(
        "baseline", help="replay archives with one build and show its metrics with confidence intervals"
    )
    _archives(baseline)
    option(baseline, "--build BUILD", str, "build", "current")
    _finish(baseline, _baseline)
    placebo = commands.add_parser(
        "placebo", help="compare a build with itself, with other noise in the images: do gates reject equal builds?"
    )
    _archives(placebo)
    option(placebo, "--build BUILD", str, "build", "current")
    option(placebo, "--runs N", int, "number of placebos", 1)
    option(placebo, "--seed S", int, "seed of the first one (default: the time)", int(time.time()))
    _finish(placebo, _placebo)
    suite = commands.add_parser(
        "suite", help="show what the passes of the regression suite can detect, or write their archives"
    )
    option(suite, "scenario", str, "names of shipped passes, or scenario files (default: all shipped)", nargs="*")
    option(suite, "--out DIR", Path, "folder for the archives; without it nothing is written")
    option(suite, "--frames N", int, "frames of each pass (default: the scenario's)")
    option(suite, "--seeds K", int, "passes of each scenario", 1)
    finish(suite, _suite)
    archive = commands.add_parser(
        "archive", help="list, add, render, pin, pack or remove the archives kept for replays"
    )
    option(archive, "action", ("list", "add", "render", "pin", "unpin", "pack", "prune"))
    option(
        archive,
        "target",
        str,
        "archive to add or pack; pass to add or render; identity to render, pin or unpin",
        nargs="?",
    )
    option(archive, "--out FILE", Path, "zip to write (pack)")
    option(archive, "--unused-days", float, "prune: remove archives that were not used for this time", 90.0)
    _finish(archive, _archive)
    build = commands.add_parser("build", help="register a build, or list those registered")
    option(build, "action", ("register", "list"))
    option(build, "file", str, "build file", nargs="?")
    _finish(build, _build)
    sandbox = commands.add_parser("sandbox", help="show which sandbox isolates builds here, or why builds are refused")
    finish(sandbox, _sandbox)


def _archives(parser: argparse.ArgumentParser) -> None:
    option(
        parser,
        "--archive ARCHIVE",
        str,
        "pass archives: folders, zips, folders of archives, or identities of kept archives",
        [],
        nargs="+",
        action="extend",
    )
    option(
        parser, "--pass ID", int, "passes whose archives are replayed", [], dest="passes", nargs="+", action="extend"
    )
    option(parser, "--workers N", int, "simultaneous replays (default: one for each core)")


def _finish(parser: argparse.ArgumentParser, handler: Callable[[argparse.Namespace], int]) -> None:
    add_operator_options(parser)
    finish(parser, handler)


def _run(arguments: argparse.Namespace) -> int:
    from ground_service.regression.documents import regression_text
    from ground_service.regression.gates.policy import SHIPPED, load_policy

    request: dict[str, Any] = {}
    load_policy(arguments.policy)
    if str(arguments.policy) not in SHIPPED:
        text = arguments.policy.read_text(encoding="utf-8")
        request = {"policy": text, "policy_name": str(arguments.policy)}
    with ground_client(arguments, background=True) as service:
        request |= _comparison(service, arguments, arguments.build, arguments.baseline)
        request["repeat_baseline"] = bool(arguments.repeat_baseline)
        job = service.wait(service.start_regression(request).id, progress=_percent())
        found = service.get_regression(job.id)
        if arguments.report:
            service.get_regression_report(found.id, arguments.report, format="html")
        if arguments.junit:
            service.get_regression_report(found.id, arguments.junit, format="junit")
    emit(arguments, {"id": found.id, **found.result.document()}, text=regression_text(found.result))
    return found.result.exit_status


def _sandbox(arguments: argparse.Namespace) -> int:
    from ground_service.regression.runner import alive
    from ground_service.regression.sandbox import SandboxRefused, protection
    from ground_service.settings import load_settings

    exchange = load_settings().runner_exchange
    isolation = refusal = ""
    try:
        isolation = protection()
    except SandboxRefused as error:
        refusal = str(error)
    text = f"builds are isolated by: {isolation}"
    if exchange is not None:
        text = f"builds run in the runner at {exchange}"
        refusal = "" if alive(exchange) else f"runner exchange {exchange}: expected a runner, found none that responds"
    figures = {
        "confined": not refusal,
        "isolation": isolation,
        "refusal": refusal,
        "runner": str(exchange) if exchange else None,
    }
    emit(arguments, figures, text=f"builds are refused: {refusal}" if refusal else text)
    return 1 if refusal else 0


def _baseline(arguments: argparse.Namespace) -> int:
    from ground_service.regression.service import baseline_text

    with ground_client(arguments, background=True) as service:
        request = _comparison(service, arguments, arguments.build, arguments.build)
        figures = service.wait(service.start_analysis(**request).id, progress=_percent()).result or {}
    emit(arguments, figures, text=baseline_text(figures))
    return 2 if figures["not_flown"] else 0


def _placebo(arguments: argparse.Namespace) -> int:
    verdicts = []
    with ground_client(arguments, background=True) as service:
        request = _comparison(service, arguments, arguments.build, arguments.build)
        for seed in range(arguments.seed, arguments.seed + arguments.runs):
            job = service.wait(service.start_regression({**request, "placebo": seed}).id)
            verdicts.append(service.get_regression(job.id).verdict)
            log(f"placebo {len(verdicts)} of {arguments.runs}: {verdicts[-1]}")
        noise = service.list_calibrations()
    counts = {name: verdicts.count(name) for name in ("fail", "pass", "inconclusive")}
    totals = ", ".join(f"{count} {name}" for name, count in counts.items())
    figures = {"placebos": counts, "calibrations": [one.model_dump() for one in noise]}
    return emit(
        arguments,
        figures,
        text="\n".join([totals, *(one.text for one in noise if not (one.condition and one.calibrated))]),
    )


def _suite(arguments: argparse.Namespace) -> int:
    from ground_service.regression.gates.core import detectable, power_text
    from ground_service.regression.gates.policy import load_policy
    from payload_emulator.session.archive.suite import suite_scenarios, write_suite

    scenarios = suite_scenarios(arguments.scenario, frames=arguments.frames, seeds=arguments.seeds)
    if arguments.out is None:
        frames = {
            one.name.removeprefix("suite-"): round(one.window.duration_s / one.camera.frame_interval_s)
            for one in scenarios
        }
        rows = [{"scenario": name, "frames": count} for name, count in frames.items()]
        lines = [f"{name}: about {count} frames" for name, count in frames.items()]
        found = detectable(load_policy().policy, sum(frames.values()), len(frames))
        lines.append(power_text(found))
        return emit(arguments, {"passes": rows, "detectable": found}, text="\n".join(lines))
    written = write_suite(
        scenarios, data_folder(), arguments.out, progress=lambda items, total: progress(items, total, "frames", "frame")
    )
    keys = ("scenario", "frames", "altitude_km")
    passes = [{"archive": str(one.folder)} | {key: getattr(one, key) for key in keys} for one in written]
    lines = [
        f"{one.folder}: {one.frames} frames, {one.altitude_km[0]:.0f} to {one.altitude_km[1]:.0f} km" for one in written
    ]
    return emit(arguments, {"passes": passes}, text="\n".join(lines))


def _comparison(service: Client, arguments: argparse.Namespace, candidate: str, baseline: str) -> dict[str, Any]:
    """Return a request to compare two builds over archives, which are uploaded if needed."""

    if not arguments.archive and not arguments.passes:
        raise UsageError(f"regress {arguments.what}: expected --archive ARCHIVE or --pass ID, found neither")
    workers = arguments.workers
    if workers is None and server_of(arguments) is None:
        workers = os.cpu_count() or 1
    builds = {name: _identity(service, name) for name in (candidate, baseline)}
    archives = _kept(service, _listed(arguments.archive))
    return {
        "candidate": builds[candidate],
        "baseline": builds[baseline],
        "archives": archives,
        "passes": arguments.passes,
        "workers": workers,
    }


def _identity(service: Client, given: str) -> str:
    """Return the identity of a build by file, by "current", or by identity; a file is registered."""
    is_file = Path(given).exists() or Path(given).suffix == ".toml"
    return _registered(service, given).digest if is_file and given != "current" else given


def _kept(service: Client, given: list[str]) -> list[str]:
    """Return the identities of archives; those that are not kept are uploaded."""
    from ground_service.errors import InvalidInput

    known, digests = _known(service), list[str]()
    for item in given:
        path = Path(item)
        if path.exists():
            log(f"checking {item} ...")
            digests.append(_upload(service, path, known))
        elif item in known:
            digests.append(known[item])
        else:
            raise InvalidInput(
                f"--archive {item}",
                "",
                "a pass archive, or the identity or the pass of one that is kept",
                "nothing there",
            )
    return digests


def _known(service: Client) -> dict[str, str]:
    """Return the identities of the kept archives by identity, by its beginning as it is listed, and by pass."""
    kept = list(service.list_kept_archives())
    return {key: one.digest for one in kept for key in (one.digest, one.digest[:LISTED], str(one.pass_id or ""))}


def _upload(service: Client, path: Path, known: Container[str]) -> str:
    """Check an archive, upload it if it is not kept, and return its identity."""
    from ground_service.regression.archives import check_archive, opened_archive, pack_archive

    with opened_archive(path) as folder, tempfile.TemporaryDirectory() as scratch:
        digest = check_archive(folder).digest
        if digest not in known:
            packed = Path(scratch) / f"{folder.name}.zip"
            pack_archive(folder, packed)
            service.keep_archive(packed)
        return digest


def _percent() -> Callable[[Job], None]:
    """Return a function that logs the progress of a job when it has changed."""
    shown = -PROGRESS_STEP

    def show(job: Job) -> None:
        nonlocal shown
        if job.progress >= shown + PROGRESS_STEP and job.state == "running":
            shown = job.progress
            log(f"replays: {100 * shown:.0f} %")

    return show


def _archive(arguments: argparse.Namespace) -> int:
    from ground_service.regression import archives

    if arguments.action in ("add", "render", "pin", "unpin", "pack") and not arguments.target:
        raise UsageError(f"regress archive {arguments.action}: expected an archive, found none")
    if arguments.action == "pack":
        if arguments.out is None:
            raise UsageError("regress archive pack: expected --out FILE, found none")
        archives.pack_archive(Path(arguments.target), arguments.out)
        return emit(arguments, {"archive": str(arguments.out)}, text=f"archive: {arguments.out}")
    removed: list[str] = []
    with ground_client(arguments) as service:
        identity = _known(service).get(arguments.target, arguments.target)
        if arguments.action == "add" and _is_pass(arguments.target):
            service.keep_pass_archive(int(arguments.target))
        elif arguments.action == "add":
            _upload(service, Path(arguments.target), ())
        elif arguments.action == "render":
            target = arguments.target
            digest = service.keep_pass_archive(int(target)).digest if _is_pass(target) else identity
            log("rendering the missing frames ...")
            service.wait(service.render_kept_archive(digest).id)
        elif arguments.action in ("pin", "unpin"):
            service.change_kept_archive(identity, pinned=arguments.action == "pin")
        elif arguments.action == "prune":
            removed = service.delete_kept_archives(unused_days=arguments.unused_days).removed
        kept = service.list_kept_archives()
    shown = {
        "digest", "name", "frames", "frames_stored", "state", "reason", "octets", "pinned", "pass_id",
    }  # fmt: skip
    lines = [
        f"{one.digest[:LISTED]}  {one.frames_stored:5} of {one.frames:5} frames  {one.octets / 1e6:8.1f} MB  {one.name}"
        f"{'' if one.pass_id is None else f'  pass {one.pass_id}'}{'  pinned' if one.pinned else ''}"
        f"{'' if one.state == 'complete' else f'  {one.state}'}{f': {one.reason}' if one.reason else ''}"
        for one in kept
    ]
    rows = [one.model_dump(mode="json", include=shown) for one in kept]
    return emit(arguments, {"archives": rows, "removed": removed}, text="\n".join(lines) or "no archive is kept")


def _is_pass(target: str) -> bool:
    """Return whether a target is the number of a pass and no file."""
    return target.isascii() and target.isdigit() and len(target) < 10 and not Path(target).exists()


def _build(arguments: argparse.Namespace) -> int:

    if arguments.action == "register":
        if not arguments.file:
            raise UsageError("regress build register: expected a build file, found none")
        with ground_client(arguments) as service:
            build = _registered(service, arguments.file)
        figures = build.model_dump(mode="json", include={"digest", "name", "version"})
        parts = (build.name, build.version, f"({build.digest[:12]})")
        return emit(arguments, figures, text=" ".join(filter(None, parts)))
    with ground_client(arguments) as service:
        builds = list(service.list_builds())
    shown = {"digest", "name", "version", "kind", "provenance"}
    lines = [f"{one.digest[:16]}  {one.kind:<8} {one.name} {one.version}".rstrip() for one in builds]
    rows = [one.model_dump(mode="json", include=shown) for one in builds]
    return emit(arguments, {"builds": rows}, text="\n".join(lines) or "no build is registered")


def _registered(service: Client, given: str) -> Build:
    """Register a build file, or the flight code of the service ("current")."""
    from ground_service.regression.builds import CURRENT, load_build, packed_build

    if given == CURRENT:
        return service.add_current_build()
    build = load_build(given)
    with tempfile.TemporaryDirectory() as scratch:
        packed = Path(scratch) / "build.zip"
        packed.write_bytes(packed_build(build))
        return service.add_build(packed)


def _listed(given: list[str]) -> list[str]:
    """Return the given archives, with the archives in place of a folder that contains several."""
    found = []
    for item in given:
        folder = Path(item)
        inside = sorted(path.parent for path in folder.glob("*/manifest.json")) if folder.is_dir() else []
        packed = sorted(folder.glob("*.zip")) if folder.is_dir() else []
        if (folder / "manifest.json").is_file() or not (inside or packed):
            found.append(item)
        else:
            found += [str(path) for path in (*inside, *packed)]
    return found
