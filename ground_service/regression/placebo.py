"""Placebos: a build compared with itself over kept archives, with noise of two seeds in the images."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ground_service.ground import Ground
from ground_service.regression import store
from ground_service.regression.archives import remove_unheld
from ground_service.regression.builds import Build
from ground_service.regression.gates.calibration import gate_noise, pass_noise
from ground_service.regression.gates.policy import PolicyFile
from ground_service.regression.outcome import JUDGED, RegressionOutcome
from ground_service.regression.replay_samples import condition_of
from ground_service.regression.service import run_regression


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
    outcome = run_regression(ground, archives, sides[1], sides[0], policy, **options)
    remove_unheld(ground, ground.write(store.remove_replays, [one.digest for one in sides]))
    noise = gate_noise(outcome.gates, policy.policy)
    for one in outcome.passes:
        if one.state == JUDGED and one.context and one.baseline_read and one.candidate_read:
            frames = (one.baseline_read.frames, one.candidate_read.frames)
            noise += pass_noise(*frames, policy.policy, condition_of(one.context))
    told = f"placebo: the baseline against itself with other noise in the images, seed {seed}"
    return replace(
        outcome, baseline=build, candidate=build, noise=tuple(noise), remarks=(*outcome.remarks, told)
    )
