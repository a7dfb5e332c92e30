"""A regression as jobs, one for each replay and one for the verdict."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ground_service.ground import Ground, open_ground
from ground_service.regression.archives import keep_archive
from ground_service.regression.builds import load_build, register_build
from ground_service.regression.jobs import missing_replays, prepared
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.worker.dispatch import dispatcher_for
from ground_service.worker.jobs import run_job


def rows_of(ground: Ground, jobs: list[str]) -> list[dict[str, Any]]:
    with ground.database.reading() as connection:
        return [repository.get(connection, repository.JOBS, job, "job") for job in jobs]


def test_replays_are_separate_jobs_and_the_verdict_follows(
    redis_url: str, make_flyable: Callable, make_build: Callable, tmp_path: Path
) -> None:
    flown = {f"synthetic pass {seed}": make_flyable(frames=10, seed=seed) for seed in (61, 62)}
    packets = {name: one.packets for name, one in flown.items()}
    home = tmp_path / "home"
    with open_ground(home) as ground:
        archives = [keep_archive(ground, one.folder).digest for one in flown.values()]
        builds = [
            register_build(ground, load_build(make_build(name, packets, network_ms=cost))).digest
            for name, cost in (("old", 10.0), ("new", 10.1))
        ]
        dispatcher = dispatcher_for(ground, Settings(home=home, broker_url=redis_url))
        arguments = prepared(ground, builds[1], builds[0], archives)
        replays = [dispatcher.submit("replay", replay) for replay in missing_replays(ground, arguments)]
        assert len(replays) == 4
        verdict = dispatcher.submit("regression", arguments)
        for job in (*replays, verdict):
            run_job(ground, job)
        rows = rows_of(ground, [*replays, verdict])
        assert [row["state"] for row in rows] == ["done"] * 5
        assert rows[-1]["result"] == {"regression_id": verdict, "verdict": "pass"}
        assert [row["result"]["outcome"] for row in rows[:-1]] == ["ok"] * 4
        kept = ground.read(repository.get, repository.REGRESSIONS, verdict, "regression")
        assert [one["state"] for one in kept["result"]["passes"]] == ["judged", "judged"]
