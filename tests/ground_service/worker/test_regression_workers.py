"""A regression spread over a real worker: a job for each replay, one for the verdict."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from ground_service.ground import open_ground
from ground_service.regression.archives import keep_archive
from ground_service.regression.builds import build_of
from ground_service.regression.jobs import missing_replays, prepared
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.worker.dispatch import dispatcher_for


def test_replays_are_spread_over_workers_and_the_verdict_follows(
    redis_url: str, make_flyable: Callable, make_build: Callable, tmp_path: Path
) -> None:
    flown = {f"synthetic pass {seed}": make_flyable(frames=10, seed=seed) for seed in (61, 62)}
    packets = {name: one.packets for name, one in flown.items()}
    home = tmp_path / "home"
    with open_ground(home) as ground:
        archives = [keep_archive(ground, one.folder).digest for one in flown.values()]
        builds = [
            build_of(ground, str(make_build(name, packets, network_ms=cost))).digest
            for name, cost in (("old", 10.0), ("new", 10.1))
        ]
        dispatcher = dispatcher_for(ground, Settings(home=home, broker_url=redis_url))
        arguments = prepared(ground, builds[1], builds[0], archives)
        replays = [dispatcher.submit("replay", replay) for replay in missing_replays(ground, arguments)]
        assert len(replays) == 4
        verdict = dispatcher.submit("regression", arguments)
        environment = {**os.environ, "LINNA_HOME": str(home), "LINNA_BROKER_URL": redis_url, "LINNA_DATA": ""}
        worker = subprocess.Popen(
            [sys.executable, "-m", "linna", "worker", "--concurrency", "2"],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            until = time.monotonic() + 200.0
            states: list[str] = []
            while (time.monotonic() < until and set(states) - {"done"}) or not states:
                time.sleep(0.3)
                with ground.database.reading() as connection:
                    rows = [
                        repository.get(connection, repository.JOBS, key, "job") for key in (*replays, verdict)
                    ]
                states = [row["state"] for row in rows]
        finally:
            worker.terminate()
            worker.wait(30)
        assert states == ["done"] * 5
        assert rows[-1]["result"] == {"regression_id": verdict, "verdict": "pass"}
        assert [row["result"]["outcome"] for row in rows[:-1]] == ["ok"] * 4
        with ground.database.reading() as connection:
            kept = repository.get(connection, repository.REGRESSIONS, verdict, "regression")
        assert [one["state"] for one in kept["result"]["passes"]] == ["judged", "judged"]
