"""Where two builds differ, and why: passes ordered by their differences, and the change that moved a figure."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.regression.builds import BUILD_FILE, Build, load_build, register_build
from ground_service.regression.gates.metrics import Figure, figures_of, joined
from ground_service.regression.gates.policy import PolicyFile
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.outcome import RegressionOutcome
from ground_service.regression.service import run_regression

MODEL = "model"
SHARE_OF_MOVE = 0.2
"""A group of changes that moves the figure by less than this share of the whole move is not looked into."""


@dataclass(frozen=True, slots=True)
class PassDifference:
    """How much two builds differ on a pass; `error_m` is the median change of the length of the position error."""

    name: str
    frames: int
    frames_changed: int
    craters_changed: int
    error_m: float
    score: float


@dataclass(frozen=True, slots=True)
class Culprit:
    """Changes that together move a figure, and what it becomes with them alone."""

    changes: tuple[str, ...]
    value: float


@dataclass(frozen=True, slots=True)
class Bisection:
    """What was found between two builds."""

    figure: str
    good: float
    bad: float
    changes: tuple[str, ...]
    culprits: tuple[Culprit, ...]
    runs: int


def differences(outcome: RegressionOutcome) -> list[PassDifference]:
    """Passes by how much the builds differ on them, the most different first.

    The score is the share of frames whose detections changed plus the median change of the position error over a
    hundred metres.
    """
    found = []
    for one in outcome.passes:
        if one.baseline_read is None or one.candidate_read is None:
            continue
        old, new = one.baseline_read.frames, one.candidate_read.frames
        craters = np.abs(new.hits - old.hits) + np.abs(new.alarms - old.alarms)
        changed = (craters > 0.0) | (new.shift_u_px != old.shift_u_px) | (new.shift_v_px != old.shift_v_px)
        apart = {
            name: float(np.nanmedian(np.abs(new.estimators[name].error_m - estimator.error_m)))
            for name, estimator in old.estimators.items()
            if name in new.estimators and np.isfinite(new.estimators[name].error_m - estimator.error_m).any()
        }
        # The estimator that claims an accuracy is the one that navigates; the others drift by kilometres anyway.
        error_m = apart.get("anchored", min(apart.values(), default=float("nan")))
        score = float(changed.mean()) + (error_m / 100.0 if apart else 0.0)
        found.append(
            PassDifference(one.name, len(old), int(changed.sum()), int(craters.sum()), error_m, score)
        )
    return sorted(found, key=lambda item: (-item.score, item.name))


def bisect(
    ground: Ground,
    archives: Sequence[Path | str],
    good: Build,
    bad: Build,
    figure: str,
    policy: PolicyFile,
    *,
    workers: int | None = None,
    tell: Callable[[str], None] = lambda _text: None,
) -> Bisection:
    """The changes between two builds on the flight code that moved a figure.

    Changes are the network and every parameter that the two files give differently. Groups of changes are tried on top
    of the good build and halved where they move the figure; changes that move it only together are named together.

    Raises
    ------
    InvalidInput
        A build is a command (its inside is not known), the builds do not differ, or the figure does not move.
    """
    for build in (good, bad):
        if build.command:
            raise InvalidInput(build.title, "", "a build of a model and parameters", "one with a command")
    changes = _changes(good, bad)
    if not changes:
        raise InvalidInput("builds", "", "two that differ in model or parameters", "none that differ")
    runs = 0
    known: dict[tuple[str, ...], float] = {}

    def value_with(applied: Sequence[str]) -> float:
        nonlocal runs
        key = tuple(sorted(applied))
        if key not in known:
            build = good if not key else _mixed(ground, good, bad, changes, key)
            tell(f"flying the good build with {', '.join(key) or 'no change'}")
            outcome = run_regression(ground, archives, build, good, policy, workers=workers)
            known[key] = _value(outcome, figure)
            runs += 1
        return known[key]

    start, end = value_with(()), value_with(tuple(changes))
    if not abs(end - start) > 0.0:
        raise InvalidInput(figure, "", "a figure that differs between the builds", f"{start:.6g} with both")

    def moves(applied: Sequence[str]) -> bool:
        return abs(value_with(applied) - start) >= SHARE_OF_MOVE * abs(end - start)

    def search(group: tuple[str, ...]) -> list[Culprit]:
        if len(group) == 1:
            return [Culprit(group, value_with(group))]
        halves = group[: len(group) // 2], group[len(group) // 2 :]
        found = [culprit for half in halves if moves(half) for culprit in search(half)]
        return found or [Culprit(group, value_with(group))]

    culprits = sorted(search(tuple(changes)), key=lambda item: -abs(item.value - start))
    return Bisection(figure, start, end, tuple(changes), tuple(culprits), runs)


def figure_value(passes: Mapping[str, PassFrames], name: str) -> float:
    """A figure over some passes.

    Raises
    ------
    InvalidInput
        There is no figure of this name.
    """
    frames = list(passes.values())
    figures: dict[str, Figure] = {figure.name: figure for figure in figures_of(frames)}
    if name not in figures:
        raise InvalidInput("figure", "", " or ".join(sorted(figures)) or "a pass that was flown", name)
    whole = joined(frames)
    return float(figures[name].compute(whole, np.ones((1, len(whole))))[0])


def _value(outcome: RegressionOutcome, figure: str) -> float:
    read = {one.name: one.candidate_read.frames for one in outcome.passes if one.candidate_read is not None}
    if len(read) < len(outcome.passes):
        told = "; ".join(f"{one.name}: {one.detail}" for one in outcome.passes if one.candidate_read is None)
        raise InvalidInput("archives", "", "passes that both builds can fly", told)
    return figure_value(read, figure)


def _changes(good: Build, bad: Build) -> dict[str, tuple[Any, Any]]:
    """Every change by name: the value in the good and in the bad build, None where the pass's own value stays."""
    old, new = _parameters(good), _parameters(bad)
    changes: dict[str, tuple[Any, Any]] = {
        key: (old.get(key), new.get(key)) for key in sorted({*old, *new}) if old.get(key) != new.get(key)
    }
    models = [_table(build).get(MODEL) for build in (good, bad)]
    hashes = [
        dict(build.files).get(str(model)) if model else None
        for build, model in zip((good, bad), models, strict=True)
    ]
    if hashes[0] != hashes[1]:
        changes = {MODEL: (models[0], models[1]), **changes}
    return changes


def _mixed(
    ground: Ground, good: Build, bad: Build, changes: Mapping[str, tuple[Any, Any]], applied: Sequence[str]
) -> Build:
    """The good build with some of the changes of the bad one, registered."""
    parameters = {**_parameters(good)}
    for key in applied:
        if key == MODEL:
            continue
        value = changes[key][1]
        if value is None:
            parameters.pop(key, None)
        else:
            parameters[key] = value
    source = bad if MODEL in applied else good
    model = _table(source).get(MODEL)
    folder = ground.home / "regression" / "scratch" / "bisect"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    lines = [f'name = "{good.name} with changes"', f"description = {json.dumps(', '.join(applied))}"]
    if model:
        shutil.copy(source.folder / str(model), folder / "model.onnx")
        lines.append('model = "model.onnx"')
    if parameters:
        (folder / "parameters.toml").write_text(_toml(parameters))
        lines.append('parameters = "parameters.toml"')
    (folder / BUILD_FILE).write_text("\n".join(lines) + "\n")
    registered = register_build(ground, load_build(folder))
    return replace(registered)


def _table(build: Build) -> dict[str, Any]:
    return tomllib.loads(build.file.read_text(encoding="utf-8")) if build.file.is_file() else {}


def _parameters(build: Build) -> dict[str, Any]:
    """The parameters that a build changes, by dotted name."""
    name = _table(build).get("parameters")
    if not name:
        return {}
    return _flat(tomllib.loads((build.folder / str(name)).read_text(encoding="utf-8")), "")


def _flat(table: Mapping[str, Any], path: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        found |= _flat(value, name) if isinstance(value, dict) else {name: value}
    return found


def _toml(parameters: Mapping[str, Any]) -> str:
    """Dotted names and plain values as TOML; JSON writes texts, numbers, truths and lists the way TOML reads them."""
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in sorted(parameters.items()))
