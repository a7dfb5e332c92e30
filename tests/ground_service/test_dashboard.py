"""Every query of the dashboard has data of a real Prometheus that scrapes the service."""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from benchmarks.campaigns._deployment import ManyApis
from benchmarks.dashboard import Prometheus, fill, panels
from ground_service.ground import open_ground
from ground_service.jobs.service import enter_job
from tests.ground_service.conftest import wait_for


@pytest.mark.campaign
def test_every_query_of_the_dashboard_has_data(tmp_path: Path, migrated_postgres: Callable[[], str]) -> None:
    for program in ("prometheus", "redis-server"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    backups = tmp_path / "backups"
    url = migrated_postgres()
    with open_ground(tmp_path / "home", database_url=url) as ground:
        fill(ground, tmp_path, backups)
        enter_job(ground, "plan", {})  # waits: there is no worker
    with ManyApis(tmp_path, url, count=1, LINNA_BACKUPS=str(backups)) as service:
        prometheus = Prometheus(tmp_path, service.ports)
        service.parts["prometheus"] = prometheus.part
        empty = {target["expr"] for panel in panels() for target in panel["targets"]}
        assert len(empty) == 15

        def all_have_data() -> bool:
            with contextlib.suppress(httpx.HTTPError):
                httpx.get(f"http://127.0.0.1:{service.ports[0]}/api/v1/passes", timeout=30.0)
                empty.difference_update({one for one in empty if prometheus.query(one)})
            return not empty

        wait_for(all_have_data, f"data of {sorted(empty)}", 120.0)
        assert prometheus.query("linna_no_such_metric") == []
