"""A candidate build against a baseline over archived passes: replays, gates, verdict.

A replay is done once for an archive and a build and kept under the identity of both, so that a run that was interrupted
goes on where it stopped and a baseline is not flown again. What goes wrong with one pass is said of that pass; the rest
goes on.
"""

import math
import os
import platform
import re
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError, InvalidInput, Stopping
from ground_service.evaluation.service import plain
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.regression import model, replay_samples, store
from ground_service.regression.archives import (
    DETECTIONS,
    PassArchive,
    archive_of,
    check_out,
    keep_archive,
    store_of,
    working_folder,
)
from ground_service.regression.build_runs import OUTCOMES, read_performance, run_build
from ground_service.regression.builds import Build, changes
from ground_service.regression.documents import regression_html, verdict_document
from ground_service.regression.gates.calibration import calibrations
from ground_service.regression.gates.core import NOT_JUDGED, judge
from ground_service.regression.gates.metrics import first_difference, metrics_of
from ground_service.regression.gates.policy import PolicyFile, load_policy
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.gates.statistics import joined_sums, ratio_error
from ground_service.regression.outcome import JUDGED, TELEMETRY_JUDGED, PassVerdict, RegressionOutcome, pass_figures
from ground_service.regression.pass_archives import NO_INPUTS
from ground_service.regression.rendering import LIVE_BEGINNING, settle_archive
from ground_service.regression.runner import PERFORMANCE
from ground_service.store.event_kinds import RegressionJudged, publish
from ground_service.store.files import register_file
from lunar.errors import LunarError
from reports.text import counted

Progress = Callable[[Iterable[Any], int], Iterator[Any]]


def run_regression(
    ground: Ground,
    archives: Sequence[Path | str],
    candidate: Build,
    baseline: Build,
    policy: PolicyFile,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    repeated: bool = False,
) -> RegressionOutcome:
    """Fly archives with both builds, where that was not done before, and judge.

    Parameters
    ----------
    archives
        Folders and zips, or identities of archives that are kept.
    workers
        Number of parallel replays, each in a separate process. Default: one for each core.
    progress
        Wraps the iteration over replays (items, total), for a progress bar.
    repeated
        Whether to replay both builds although replays are kept, so that their processor times are of the same time.
    """
    if not archives:
        raise InvalidInput("archives", "", "at least one pass archive", "none")
    with ThreadPoolExecutor(workers or os.cpu_count() or 1, "archives") as pool:
        kept = list(pool.map(lambda given: _kept(ground, given), archives))
    builds = tuple(dict.fromkeys((baseline, candidate)))
    usable = [one.digest for one in kept if isinstance(one, PassArchive) and not _unreplayable(one, builds)]
    shards = [(digest, build) for digest in dict.fromkeys(usable) for build in builds]
    missing = [shard for shard in shards if repeated or not is_done(find_replay(ground, *shard))]
    fly_shards(ground, missing, workers=workers, progress=progress, again=repeated)
    return judge_regression(ground, kept, candidate, baseline, policy)


def _context(ground: Ground, digest: str) -> replay_samples.PassContext:
    with working_folder(ground) as folder:
        return replay_samples.pass_context(check_out(ground, digest, folder / "a", images=False), ground.data)


def condition_of_archive(ground: Ground, digest: str) -> str:
    """Return the condition of a kept archive; empty if it cannot be read."""
    try:
        return replay_samples.condition_of(_context(ground, digest))
    except (GroundError, LunarError):
        return ""


def fly_shards(
    ground: Ground,
    shards: Sequence[tuple[str, Build]],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    again: bool = False,
) -> None:
    """Do replays, several at a time: every one is a process, the threads here only wait for them."""
    if not shards:
        return
    # Both builds of an archive run at the same time, so that other load changes their processor times alike.
    together = {digest: [build for of, build in shards if of == digest] for digest, _ in shards}
    threads = workers or os.cpu_count() or 1
    size = min(threads, max(map(len, together.values())))

    def replays(digest: str, builds: Sequence[Build]) -> None:
        with ThreadPoolExecutor(size, "replay") as pair:
            list(pair.map(lambda build: do_replay(ground, digest, build, again=again), builds))

    with ThreadPoolExecutor(max(threads // size, 1), "replays") as pool:
        futures = [pool.submit(replays, digest, builds) for digest, builds in together.items()]
        try:
            done = as_completed(futures)
            for future in progress(done, len(futures)) if progress else done:
                future.result()
        except BaseException:
            for future in futures:
                future.cancel()
            raise


def do_replay(ground: Ground, digest: str, build: Build, *, again: bool = False) -> model.KeptReplay:
    """Replay a kept archive with a build, or return what was kept of an earlier time unless `again` is set.

    A replay of an archive that was completed meanwhile is done again.
    """
    while True:
        known = None if again else find_replay(ground, digest, build)
        if known is not None and is_done(known):
            return known
        settle_archive(ground, digest)
        replay, manifest_sha256 = _replayed(ground, digest, build)
        with ground.database.writing() as connection:
            # A successful replay is never replaced by a concurrent one of another worker.
            if store.keep_replay(
                connection, digest, build.digest, replay, utc_now_ns(), manifest_sha256=manifest_sha256
            ):
                return replay
        with ground.database.reading() as connection:
            if store.find_archive(connection, digest) is None:
                return replay  # removed meanwhile, which the verdict reports
        ground.check_stopping()


def _replayed(ground: Ground, digest: str, build: Build) -> tuple[model.KeptReplay, str]:
    """Replay a kept archive; return the result, and the hash of the manifest that the archive had."""
    with working_folder(ground) as folder:
        archive = check_out(ground, digest, folder / "archive")
        refusal = _other_camera(build, archive) or _unreplayable(archive, (build,))
        if refusal:
            refused = model.KeptReplay(outcome="refused", detail=refusal, machine=_machine())
            return refused, archive.manifest_sha256
        run = run_build(build, archive.folder, folder / "out", runner=ground.runner, private=(ground.home,))
        outcome, detail = run.outcome, run.detail
        stored: dict[str, str | None] = {"downlink": None, "performance": None}
        if run.downlink is not None:
            octets = run.downlink.read_bytes()
            try:
                context = replay_samples.pass_context(archive, ground.data)
            except (GroundError, LunarError):
                pass  # a fault of the archive or of ground data, not of the build; the verdict reports it
            else:
                try:
                    replay_samples.read_downlink(context, octets)
                except InvalidInput as error:
                    outcome, detail = "garbage", str(error)
            stored["downlink"] = store_of(ground).put_octets(octets).sha256
        if run.performance is not None:
            stored["performance"] = store_of(ground).put_file(folder / "out" / PERFORMANCE).sha256
        replay = model.KeptReplay(
            outcome=outcome,
            detail=detail,
            downlink_sha256=stored["downlink"],
            performance_sha256=stored["performance"],
            wall_s=run.wall_s,
            cpu_s=run.cpu_s,
            peak_rss_mib=run.peak_rss_mib,
            isolation=run.isolation,
            printed=run.printed or None,
            machine=_machine(),
        )
        return replay, archive.manifest_sha256


def find_replay(ground: Ground, digest: str, build: Build) -> model.KeptReplay | None:
    """Return the stored replay; None if it was not done, or a part of it is lost."""
    replay = ground.read(store.find_replay, digest, build.digest)
    if replay is None:
        return None
    files = store_of(ground)
    stored = [sha256 for sha256 in (replay.downlink_sha256, replay.performance_sha256) if sha256]
    return replay if all(files.path(sha256).exists() for sha256 in stored) else None


def is_done(replay: model.KeptReplay | None) -> bool:
    """Return whether a replay need not be done again: what failed once may have failed for want of time or space."""
    return replay is not None and replay.outcome == model.OK


def judge_regression(
    ground: Ground, kept: Sequence[PassArchive | PassVerdict], candidate: Build, baseline: Build, policy: PolicyFile
) -> RegressionOutcome:
    """The gates over replays that were done."""
    passes = tuple(
        one if isinstance(one, PassVerdict) else _pass_verdict(ground, one, candidate, baseline) for one in kept
    )
    judged = [one for one in passes if one.baseline_read is not None and one.candidate_read is not None]
    flown = [one.context.flown for one in judged if one.context]
    changed = changes(baseline, candidate, flown or ({},))
    remarks = [f"changed from baseline to candidate: {', '.join(changed)}"] if changed else []
    names = _unique_names(judged)
    before: dict[str, PassFrames] = {}
    after: dict[str, PassFrames] = {}
    apart = 0
    for name, one in zip(names, judged, strict=True):
        assert one.baseline_read and one.candidate_read and one.baseline and one.candidate
        old, new = one.baseline_read.frames, one.candidate_read.frames
        if not one.baseline.overlaps(one.candidate):
            apart += baseline != candidate
            old, new = (replace(frames, latency_ms={}, cpu_s=math.nan) for frames in (old, new))
        before[name], after[name] = old, new
    if apart:
        remarks.append(
            f"no latency is compared on {apart} of {len(judged)} passes: the builds were not replayed at the same time"
        )
    whole = {name for name, one in zip(names, judged, strict=True) if one.state == JUDGED}
    doubts = {one.metric: one.text for one in calibrations_of(ground) if not (one.calibrated or one.condition)}
    gates = [
        replace(gate, reason="; ".join(filter(None, (gate.reason, doubts.get(gate.name)))))
        for gate in judge(before, after, policy.policy, imaged=whole)
    ]
    remarks += doubts.values()
    rows = {name: first_difference(before[name], after[name]) for name in before}
    differing = [f"{name}, frame {row}" for name, row in rows.items() if row is not None]
    if differing:
        same = f"; {len(before) - len(differing)} of {len(before)} passes are identical in every octet"
        remarks.append(f"first different packets: {differing[0]}{same if len(before) > 1 else ''}")
    isolations = sorted(
        {
            re.sub(r"user \d+", "a user of its own", replay.isolation)
            for one in passes
            for replay in (one.baseline, one.candidate)
            if replay and replay.isolation
        }
    )
    remarks += [f"builds were isolated by: {name}" for name in isolations]
    return RegressionOutcome(baseline, candidate, policy, tuple(gates), passes, tuple(remarks))


def calibrations_of(ground: Ground) -> list[model.Calibration]:
    """Return the noise of each metric in the placebos that the shipped policy judged."""
    return calibrations(ground.read(store.placebo_noise, load_policy().policy.version))


def keep_regression(ground: Ground, outcome: RegressionOutcome, *, regression_id: str | None = None) -> str:
    """Keep a verdict with the service; its id."""
    identity = regression_id or uuid.uuid4().hex
    html = ground.files.put_octets(regression_html(ground, outcome, identity).encode())
    now = utc_now_ns()
    with ground.database.writing() as connection:
        register_file(connection, html, "report", f"regression {identity}", now)
        regression = model.Regression(
            id=identity, verdict=outcome.verdict, created=UtcTime(now), result=verdict_document(outcome)
        )
        flown = {one.context.mission for one in outcome.passes if one.context is not None}
        added = store.add_regression(connection, regression, missions=sorted(flown), html_sha256=html.sha256)
        if added and outcome.noise is None:
            publish(connection, RegressionJudged(id=identity, verdict=outcome.verdict))
    return identity


def report_of(ground: Ground, regression_id: str) -> bytes:
    """Return the HTML report of a regression."""
    return ground.files.get(ground.read(store.get_report, regression_id))


def _kept(ground: Ground, given: Path | str) -> PassArchive | PassVerdict:
    """An archive as it is kept, or the verdict on one that cannot be used."""
    path = Path(given)
    try:
        if path.exists():
            return _settled(ground, keep_archive(ground, path).digest, path)
        record = ground.read(store.find_archive, str(given))
        if record is None:
            raise InvalidInput(
                str(given), "", "a pass archive, or the identity or the pass of one that is kept", "neither"
            )
        return _settled(ground, record.digest, path)
    except Stopping:
        raise
    except (GroundError, LunarError) as error:
        return PassVerdict(path.name, "", "unusable", str(error))


def may_be_replayed(archive: model.KeptArchive) -> bool:
    """Return whether a kept archive has frames, or inputs of the payload from which it can be replayed."""
    return archive.state != model.TELEMETRY_ONLY or not archive.reason.startswith((LIVE_BEGINNING, NO_INPUTS))


def _settled(ground: Ground, digest: str, path: Path) -> PassArchive:
    """Return a kept archive, whose missing frames are rendered first."""
    settle_archive(ground, digest)
    with ground.database.reading() as connection:
        return archive_of(ground, store.get_archive(connection, digest), path)


def _unreplayable(archive: PassArchive, builds: Sequence[Build]) -> str:
    """Return why builds cannot replay an archive; empty if they can."""
    if archive.state == model.COMPLETE:
        return ""
    if DETECTIONS not in archive.manifest["files"]:
        return archive.reason
    programs = [build.name for build in builds if build.command]
    return f"{programs[0]} is a program, which needs frames: {archive.reason}" if programs else ""


def _pass_verdict(ground: Ground, archive: PassArchive, candidate: Build, baseline: Build) -> PassVerdict:
    try:
        # The state that the replays belong to: the archive may have been completed since it was kept.
        with ground.database.reading() as connection:
            archive = archive_of(ground, store.get_archive(connection, archive.digest), archive.folder)
    except GroundError as error:
        return PassVerdict(archive.name, archive.digest, "unusable", str(error))
    reason = _unreplayable(archive, (baseline, candidate))
    if reason:
        return PassVerdict(archive.name, archive.digest, NOT_JUDGED, reason)
    old, new = (find_replay(ground, archive.digest, one) for one in (baseline, candidate))
    if old is None or new is None:
        return PassVerdict(archive.name, archive.digest, "unusable", "it was not flown", old, new)
    for replay, build, state in ((new, candidate, "candidate failed"), (old, baseline, "baseline failed")):
        if replay.outcome != model.OK:
            message = f"{build.name} {OUTCOMES[replay.outcome]}" + (f": {replay.detail}" if replay.detail else "")
            return PassVerdict(archive.name, archive.digest, state, message, old, new)
    try:
        context = _context(ground, archive.digest)
        read = [_read(ground, context, replay) for replay in (old, new)]
    except (GroundError, LunarError) as error:
        return PassVerdict(archive.name, archive.digest, "unusable", str(error), old, new)
    state = JUDGED if archive.state == model.COMPLETE else TELEMETRY_JUDGED
    return PassVerdict(archive.name, archive.digest, state, archive.reason, old, new, context, read[0], read[1])


def _read(ground: Ground, context: replay_samples.PassContext, replay: model.KeptReplay) -> replay_samples.ReadDownlink:
    files = store_of(ground)
    assert replay.downlink_sha256 is not None
    performance = read_performance(files.path(replay.performance_sha256)) if replay.performance_sha256 else None
    octets = files.get(replay.downlink_sha256)
    return replay_samples.read_downlink(context, octets, performance, replay.peak_rss_mib, replay.cpu_s)


def _other_camera(build: Build, archive: PassArchive) -> str:
    """Return why a build made for one camera cannot fly this archive; empty where it can."""
    given: Mapping[str, Any] = archive.manifest.get("camera") or {}
    for key, value in build.camera:
        if key in given and abs(float(given[key]) - value) > 1e-6:
            return f"made for another camera: expected {key} {value:g}, found {float(given[key]):g}"
    return ""


def _unique_names(passes: Sequence[PassVerdict]) -> list[str]:
    names = [one.name for one in passes]
    return [
        name if names.count(name) == 1 else f"{name} {one.digest[:8]}" for name, one in zip(names, passes, strict=True)
    ]


def _machine() -> str:
    """Return the machine on which a latency was measured."""
    return f"{platform.node()}, {platform.machine()}"


def baseline_figures(outcome: RegressionOutcome) -> dict[str, Any]:
    """Every metric over the suite and over each pass; ratios with the 95 % interval by units of the evidence."""
    judged = [(one.name, one.baseline_read.frames) for one in outcome.passes if one.baseline_read is not None]
    result: dict[str, Any] = plain(
        {
            "build": {"name": outcome.baseline.name, "digest": outcome.baseline.digest},
            "suite": _figures([frames for _, frames in judged]) if judged else {},
            "passes": [
                {"name": name, "frames": len(frames), "figures": _figures([frames]), **pass_figures(frames)}
                for name, frames in judged
            ],
            "not_flown": [
                {"name": one.name, "detail": one.detail} for one in outcome.passes if one.baseline_read is None
            ],
        }
    )
    return result


def baseline_text(figures: dict[str, Any]) -> str:
    """The figures of the suite as lines."""
    lines = [f"{figures['build']['name']} over {counted(len(figures['passes']), 'passes')}"]
    for name, row in figures["suite"].items():
        if row["value"] is None:
            continue
        low, high = row["interval_95"]
        between = "" if low is None else f"  ({low:.4g} to {high:.4g})"
        lines.append(f"  {name:<34}{row['value']:>12.4g} {row['unit']}{between}")
    lines += [f"  {one['name']}: {one['detail']}" for one in figures["not_flown"]]
    return "\n".join(lines)


def _figures(passes: list[PassFrames]) -> dict[str, Any]:
    found = {}
    for metric in metrics_of(passes):
        value, low, high = metric.over(passes), math.nan, math.nan
        if metric.sums is not None:
            sums = joined_sums([metric.sums(one) for one in passes])
            reach = 1.96 * ratio_error(sums)
            low, high = value - reach, value + reach
        found[metric.name] = {"value": value, "interval_95": [low, high], "unit": metric.unit}
    return found
