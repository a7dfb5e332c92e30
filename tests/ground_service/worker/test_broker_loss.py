"""No job is lost when the broker is killed and comes back empty: jobs are rows of the database first."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ground_service.ground import open_ground
from ground_service.jobs.service import get_job, unfinished_jobs
from ground_service.settings import Settings
from ground_service.worker.app import queued_jobs
from ground_service.worker.dispatch import dispatcher_for
from ground_service.worker.scheduler import Scheduler
from studies.harness.parts import RedisServer
from tests.serving import wait_for


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[RedisServer]:
    if shutil.which("redis-server") is None:
        pytest.skip("redis-server is not installed")
    server = RedisServer(tmp_path)
    yield server
    server.part.end()


def test_jobs_survive_a_broker_that_is_killed(
    migrated_postgres: Callable[[], str], broker: RedisServer, tmp_path: Path
) -> None:
    url = migrated_postgres()
    settings = Settings(home=tmp_path / "home", database_url=url, broker_url=broker.url)
    with open_ground(settings.home, database_url=url) as ground:
        dispatcher = dispatcher_for(ground, settings)
        jobs = [dispatcher.submit("plan", {}) for _ in range(5)]
        assert sorted(queued_jobs(settings)) == sorted(jobs)
        broker.part.kill()
        jobs.append(dispatcher.submit("plan", {}))  # accepted while there is no broker
        broker.part.start()
        jobs.append(dispatcher.submit("plan", {}))  # the queue is not empty
        assert queued_jobs(settings) == jobs[-1:]
        Scheduler(ground, dispatcher, lambda: None, {"retention_days": 90}).tick()
        assert sorted(queued_jobs(settings)) == sorted(jobs)
        environment = {
            **os.environ,
            "LINNA_HOME": str(settings.home),
            "LINNA_DATABASE_URL": url,
            "LINNA_BROKER_URL": broker.url,
            "LINNA_ALLOW_DATABASE_OWNER": "true",
        }
        with (tmp_path / "worker.log").open("wb") as log:
            worker = subprocess.Popen(
                [sys.executable, "-m", "linna", "worker"], env=environment, stdout=log, stderr=log
            )
            try:
                wait_for(lambda: not unfinished_jobs(ground), "every job", 180.0)
            finally:
                worker.terminate()
                try:
                    worker.wait(60)
                except subprocess.TimeoutExpired:
                    worker.kill()
                    worker.wait()
        assert {(get_job(ground, job).state, get_job(ground, job).attempts) for job in jobs} == {("done", 1)}
