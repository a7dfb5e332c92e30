"""The nightly job: trends with limits, and what is taken away and what never is."""

import os
import re
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from sqlalchemy import func, select

from ground_service.access import service as users
from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.evaluation.service import make_report
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import enter_job
from ground_service.passes import service as passes
from ground_service.passes.archive_import import import_archive
from ground_service.passes.core import downsample
from ground_service.passes.service import spacecraft_trends, trend_of
from ground_service.regression.archives import working_folder
from ground_service.store import repository
from ground_service.store.event_kinds import read_events
from ground_service.store.events import publish
from ground_service.store.models import METADATA
from ground_service.worker.jobs import run_job
from ground_service.worker.upkeep import nightly, nightly_job_id, tidy
from tests.serving import token_valid
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

DAY_NS = 86_400_000_000_000


def test_a_trend_has_the_slope_of_its_line():
    field = DICTIONARY.packet("housekeeping").field("temperature_c")
    utc_ns = np.arange(200, dtype=np.int64) * (DAY_NS // 40)
    trend = trend_of(field, downsample(utc_ns, 20.0 + 3.0 * utc_ns / DAY_NS, 50))
    assert trend.slope_per_day == pytest.approx(3.0, rel=1e-9)
    assert (trend.samples, trend.limit_state) == (200, "within")
    # 62 degrees is above the warning limit of 60 of the dictionary, 90 above the alarm limit of 85
    for value, state in ((62.0, "warning"), (90.0, "alarm")):
        hot = trend_of(field, downsample(utc_ns[:2], np.array([20.0, value]), 50))
        assert hot.limit_state == state
    assert trend_of(field, downsample(utc_ns[:0], np.zeros(0), 5)) is None


def test_the_night_tells_trends_and_broken_limits(ground, synthetic_pass):
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    trends = {trend.parameter: trend for trend in spacecraft_trends(ground, 76, "flight")}
    # 0.1 degrees more every 15 s: 576 degrees a day
    assert trends["temperature_c"].slope_per_day == pytest.approx(576.0, rel=1e-6)
    job = enter_job(ground, "nightly", {}, job_id=nightly_job_id(DAY_NS + 5))
    assert job == enter_job(ground, "nightly", {}, job_id=nightly_job_id(DAY_NS + 99))
    assert job != nightly_job_id(2 * DAY_NS)
    done = run_job(ground, job)
    assert done.state == "done", done.error
    assert (done.result["spacecraft"][0]["spacecraft_id"], done.result["limits_broken"]) == (76, [])


def test_what_is_old_goes_and_the_record_stays(ground, monkeypatch):
    with ground.database.writing() as connection:
        for _ in range(3):
            publish(connection, "note", {})
        with monkeypatch.context() as long_ago:
            long_ago.setattr("ground_service.access.service.utc_now_ns", lambda: 0)
            audit(connection, "ann", "look", "", {})
    with ground.database.writing() as connection:
        connection.execute(repository.EVENT_LOG.update().values(utc_ns=0))
        connection.execute(repository.ANSWERS.insert().values(key="k", request="r", answer={"id": 1}, created_utc_ns=0))
    for name in (".incoming-old", ".incoming-new"):
        ground.files.root.mkdir(exist_ok=True)
        (ground.files.root / name).write_bytes(b"")
    os.utime(ground.files.root / ".incoming-old", (0, 0))
    regression = ground.home / "regression"
    (regression / "files").mkdir(parents=True)
    (regression / "files/.incoming-old").write_bytes(b"")
    (regression / "scratch/.working-old/archive").mkdir(parents=True)
    for name in ("files/.incoming-old", "scratch/.working-old"):
        os.utime(regression / name, (0, 0))
    with working_folder(ground) as in_use:
        removed = tidy(ground, 90)
        assert in_use.is_dir()
    assert removed == {"events": 2, "jobs": 0, "answers": 1, "sessions": 0, "files": 3}
    assert [path.name for path in (regression / "scratch").iterdir()] == []
    assert [item.number for item in read_events(ground.database, 0)] == [3]
    assert ground.read(repository.newest, repository.AUDIT, Paging())[1] == 1


def test_nothing_is_removed_in_the_first_night_after_a_jump_of_the_clock(ground, monkeypatch):
    enter_job(ground, "plan", {})
    now = utc_now_ns() + 400 * DAY_NS
    monkeypatch.setattr("ground_service.worker.upkeep.utc_now_ns", lambda: now)
    assert nightly(ground, {})["removed"] == {}
    enter_job(ground, "nightly", {}, job_id=nightly_job_id(now))
    now += DAY_NS
    assert "events" in nightly(ground, {})["removed"]


def counts(ground):
    with ground.database.reading() as connection:
        return {
            name: connection.execute(select(func.count()).select_from(table)).scalar_one()
            for name, table in METADATA.tables.items()
        }


def test_ten_years_later_the_record_is_complete_and_the_operation_is_gone(ground, synthetic_pass, monkeypatch):
    """The documented policy names every table, and the nightly job deletes from no other one."""
    text = (Path(__file__).parents[3] / "docs/archive.md").read_text()
    rows = text.partition("## Retention")[2].partition("## Schema")[0].splitlines()
    policy = {table: row.split("|")[1].strip() for row in rows for table in re.findall(r"`([a-z_]+)`", row)}
    assert set(policy) == set(METADATA.tables)
    make_report(ground, import_archive(ground, synthetic_pass.folder))
    run_job(ground, enter_job(ground, "plan", {}))
    before, files = counts(ground), sorted(ground.files.root.rglob("*"))
    later = utc_now_ns() + 3653 * DAY_NS
    for module in ("upkeep", "jobs"):
        monkeypatch.setattr(f"ground_service.worker.{module}.utc_now_ns", lambda: later)
    removed = tidy(ground, 90)
    after = counts(ground)
    assert {policy[name] for name in before if before[name] != after[name]} == {"operation"}
    assert removed["jobs"] == before["jobs"] >= 1 and after["event_log"] < before["event_log"]
    assert files == sorted(ground.files.root.rglob("*"))


def test_expired_sessions_are_deleted_and_tokens_are_kept(ground, monkeypatch):
    token = users.add_user(ground, "ann", "operator", days_valid=0.001)
    old, _ = users.start_session(ground, token)
    later = utc_now_ns() + DAY_NS
    for module in ("ground_service.access.service", "ground_service.worker.upkeep"):
        monkeypatch.setattr(f"{module}.utc_now_ns", lambda: later)
    new, _ = users.start_session(ground, users.add_token(ground, "ann"))
    tokens = {one.id for one in users.list_tokens(ground)}
    assert tidy(ground, 90)["sessions"] == 1
    assert tidy(ground, 90)["sessions"] == 0
    # The expired token of the user remains listed; the new session and its token are in force.
    assert len(tokens) == 4 and len({one.id for one in users.list_tokens(ground)}) == 3
    assert token_valid(ground, new) and not token_valid(ground, old)


def test_answers_are_kept_until_telemetry_is_new(ground, synthetic_pass, monkeypatch, tmp_path):
    half = len(synthetic_pass.packets) // 2
    (tmp_path / "a.cadu").write_bytes(encode_cadus(synthetic_pass.packets[:half], spacecraft_id=76))
    vehicle = ingest_file(ground, tmp_path / "a.cadu").vehicle_id
    read = Mock(wraps=passes._trends)
    monkeypatch.setattr(passes, "_trends", read)
    first = passes.vehicle_trends(ground, vehicle)
    assert passes.vehicle_trends(ground, vehicle) == first and read.call_count == 1
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    second = passes.vehicle_trends(ground, vehicle)
    assert read.call_count == 2
    assert {one.parameter: one.samples for one in second} != {one.parameter: one.samples for one in first}
