"""Regressions as jobs: a replay for every archive and build, distributed over the workers, and then the verdict.

The verdict's own job does what replays are still missing, so nothing hangs on another worker: a replay that two workers
do at the same time is kept once.
"""

import hashlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.jobs.service import set_progress
from ground_service.regression import service, store
from ground_service.regression.archives import kept_archives, remove_unheld
from ground_service.regression.builds import CURRENT, Build, load_build, register_build, registered_build
from ground_service.regression.gates.calibration import gate_noise, pass_noise
from ground_service.regression.gates.policy import PolicyFile, load_policy, read_policy
from ground_service.regression.model import COMPLETE, Comparison
from ground_service.regression.outcome import JUDGED, RegressionOutcome
from ground_service.regression.pass_archives import archive_of_pass
from ground_service.regression.rendering import settle_archive
from ground_service.regression.replay_samples import condition_of


def run_placebo(
    ground: Ground, archives: Sequence[str], build: Build, policy: PolicyFile, seed: int, **options: Any
) -> RegressionOutcome:
    """Replay kept archives twice with one build, with noise of two seeds in the images, and judge.

    The outcome has the noise of each metric. No replay is kept. `options` are those of `run_regression`.
    """
    # Seeds of one placebo are of no other.
    sides = [
        replace(build, noise=one, digest=hashlib.sha256(f"{build.digest} noise {one}".encode()).hexdigest())
        for one in (2 * seed, 2 * seed + 1)
    ]
    outcome = service.run_regression(ground, archives, sides[1], sides[0], policy, **options)
    remove_unheld(ground, ground.write(store.remove_replays, [one.digest for one in sides]))
    noise = gate_noise(outcome.gates, policy.policy)
    for one in outcome.passes:
        if one.state == JUDGED and one.context and one.baseline_read and one.candidate_read:
            frames = (one.baseline_read.frames, one.candidate_read.frames)
            noise += pass_noise(*frames, policy.policy, condition_of(one.context))
    remark = f"placebo: the baseline against itself with other noise in the images, seed {seed}"
    return replace(outcome, baseline=build, candidate=build, noise=tuple(noise), remarks=(*outcome.remarks, remark))


log = logging.getLogger(__name__)


def prepared(ground: Ground, candidate: str, baseline: str, archives: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of the job of a regression: identities of existing builds and archives.

    Parameters
    ----------
    candidate, baseline
        Identities of registered builds, or "current".
    archives
        Identities of kept archives; all that are kept when empty.

    Raises
    ------
    NotFound, InvalidInput
        A build or an archive is not known, or none is kept.
    """
    kept = {one.digest for one in kept_archives(ground)}
    for digest in archives:
        if digest not in kept:
            raise InvalidInput("archives", "", "identities of archives that are kept", digest[:64])
    chosen = list(archives) or sorted(kept)
    if not chosen:
        raise InvalidInput("archives", "", "at least one archive that is kept", "none")
    return {
        "candidate": named_build(ground, candidate).digest,
        "baseline": named_build(ground, baseline).digest,
        "archives": chosen,
    }


def compared(ground: Ground, given: Comparison) -> dict[str, Any]:
    """Return the arguments of the job of a comparison."""
    of_passes = [archive_of_pass(ground, pass_id).digest for pass_id in given.passes]
    archives = list(dict.fromkeys([*given.archives, *of_passes]))
    return {**prepared(ground, given.candidate, given.baseline, archives), "workers": given.workers}


def named_build(ground: Ground, name: str) -> Build:
    """Return a registered build by its identity, or the installed flight code."""
    if name == CURRENT:
        return register_build(ground, load_build(CURRENT))
    return registered_build(ground, name)


def missing_replays(ground: Ground, arguments: Mapping[str, Any]) -> list[dict[str, str]]:
    """Arguments of the jobs of the replays that a regression needs and that were not done yet."""
    builds = [registered_build(ground, arguments[side]) for side in ("baseline", "candidate")]
    chosen = set(arguments["archives"])
    archives = {one.digest for one in kept_archives(ground) if one.digest in chosen and service.may_be_replayed(one)}
    return [
        {"archive": digest, "build": build.digest}
        for digest in arguments["archives"]
        if digest in archives
        for build in dict.fromkeys(builds)
        if not service.is_done(service.find_replay(ground, digest, build))
    ]


def nightly_placebo(ground: Ground, passes: int) -> dict[str, Any] | None:
    """Return the arguments of the placebo of this night over so many archives by turns; None without any."""
    kept = [one.digest for one in kept_archives(ground) if one.state == COMPLETE]
    if not kept or not passes:
        return None
    night = utc_now_ns() // 86_400_000_000_000
    chosen = dict.fromkeys(kept[(night * passes + k) % len(kept)] for k in range(passes))
    return {**prepared(ground, CURRENT, CURRENT, list(chosen)), "placebo": night}


def replay_job(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    """One build over one archive."""
    replay = service.do_replay(ground, str(arguments["archive"]), registered_build(ground, str(arguments["build"])))
    return {"outcome": replay.outcome, "detail": replay.detail, "cpu_s": replay.cpu_s}


def rendering_job(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    """Render the missing frames of a kept archive; an archive that could not be rendered is tried again."""
    kept = settle_archive(ground, str(arguments["digest"]), again=True)
    return kept.model_dump(mode="json", include={"digest", "frames", "frames_stored", "state", "reason"})


def regression_job(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    """A verdict; its id is that of the job."""
    text = arguments.get("policy")
    policy = load_policy() if text is None else read_policy(text.encode(), str(arguments["policy_name"]))
    outcome = _outcome(ground, arguments, job_id, policy)
    service.keep_regression(ground, outcome, regression_id=job_id)
    return {"regression_id": job_id, "verdict": outcome.verdict}


def analysis_job(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    """Return the metrics of one build over archives."""
    return service.baseline_figures(_outcome(ground, arguments, job_id, load_policy()))


def _outcome(ground: Ground, arguments: Mapping[str, Any], job_id: str, policy: PolicyFile) -> RegressionOutcome:
    def progress(items: Any, total: int) -> Iterator[Any]:
        for number, item in enumerate(items, start=1):
            yield item
            ground.check_stopping()
            share = 0.95 * number / total
            ground.write(set_progress, job_id, share)

    archives = list(arguments["archives"])
    candidate, baseline = (registered_build(ground, str(arguments[side])) for side in ("candidate", "baseline"))
    options: dict[str, Any] = {"workers": arguments.get("workers"), "progress": progress}
    if seed := arguments.get("placebo"):
        return run_placebo(ground, archives, baseline, policy, int(seed), **options)
    repeated = bool(arguments.get("repeat_baseline"))
    return service.run_regression(ground, archives, candidate, baseline, policy, repeated=repeated, **options)
