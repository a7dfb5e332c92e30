"""Processes of a deployment compare what they work with, and `linna doctor` names what is wrong."""

import json
import time
from contextlib import ExitStack
from dataclasses import replace

import pytest

from ground_service.errors import ServerError
from ground_service.ground import ground_from_settings
from ground_service.ingest.service import ingest_file
from ground_service.missions.service import add_mission
from ground_service.settings import Settings
from ground_service.store import leases
from ground_service.store.files import file_names
from ground_service.worker import condition
from ground_service.worker.condition import (
    all_disagreements,
    complaints,
    present,
    read_condition,
    running_processes,
    statement_of,
)
from ground_service.worker.doctor import examine
from linna import cli
from tests.ground_service.access.openid import running_provider


@pytest.fixture
def settings(tmp_path, migrated_postgres):
    return Settings(home=tmp_path / "home", database_url=migrated_postgres(), allow_database_owner=True)


@pytest.fixture
def opened(settings):
    with ground_from_settings(settings) as ground:
        yield ground


def changed(settings, **fields):
    return Settings(**settings.model_dump() | fields)


def test_a_process_is_known_while_it_runs(opened, settings, monkeypatch):
    monkeypatch.setattr(condition, "BEAT_S", 0.05)
    assert not running_processes(opened.database)
    with present(opened, settings, "worker"):
        [one] = running_processes(opened.database)
        assert one.kind == "worker" and one.statement
        assert replace(one.statement, clock_ms=0) == statement_of(opened, settings)
        assert abs(one.statement.clock_ms) < condition.CLOCK_LIMIT_MS
        assert read_condition(opened, None).processes == {"worker": 1}
        with opened.database.writing() as connection:  # of a process that was killed
            leases.state(connection, f"{condition.PREFIX}api gone:1", one.statement.text(), 0)
        time.sleep(0.2)
        assert str(*running_processes(opened.database)) == str(one)
    assert not running_processes(opened.database)
    assert complaints(read_condition(opened, None, "redis://127.0.0.1:1/0"))[:2] == [
        "No process does the recurring work.",
        "The broker does not answer.",
    ]


@pytest.mark.parametrize(
    ("change", "group"),
    [
        ({"objects": "s3://linna/operations"}, "files"),
        ({"broker_url": "redis://elsewhere:6379/0"}, "broker"),
        ({"oidc_issuer": "https://login.example", "oidc_client_id": "linna"}, "provider"),
        ({"retention_days": 7}, "settings"),
    ],
)
def test_a_start_with_disagreeing_peers_fails(opened, settings, change, group):
    """An upload acknowledged by one process must not be invisible to the other."""
    other = changed(settings, **change)
    with present(opened, settings, "api"):
        with present(opened, changed(settings, port=9, host="0.0.0.0"), "worker"):
            pass  # what one process has for itself
        refused = pytest.raises(ServerError, match=f"expected the same .*: other {group} than here")
        with refused, present(opened, other, "worker"):
            raise AssertionError
        assert len(running_processes(opened.database)) == 1


def test_another_home_folder_and_other_data_are_noticed(opened, settings, tmp_path):
    mine = statement_of(opened, settings)
    (tmp_path / "elsewhere").mkdir()
    other = replace(opened, home=tmp_path / "elsewhere")
    assert [a == b for a, b in zip(mine.digests, statement_of(other, settings).digests, strict=True)] == [
        group != "files" for group in condition.GROUPS
    ]
    processes = [
        condition.Process("api", "a:1", mine),
        condition.Process("worker", "b:2", statement_of(other, settings)),
        condition.Process("worker", "c:3", None),
    ]
    assert all_disagreements(processes) == ["worker b:2: other files than api a:1"]


def faults(ground, settings):
    return {one.name: one.found for one in examine(ground, settings) if not one.ok}


def test_the_doctor_finds_a_healthy_deployment_and_names_each_fault(
    opened, settings, redis_url, synthetic_pass, tmp_path
):
    given = changed(settings, broker_url=redis_url)
    ingest_file(opened, synthetic_pass.folder / "downlink.cadu")
    with opened.database.writing() as connection:
        leases.acquire(connection, "scheduler", "somebody", 60_000_000_000)
    with ExitStack() as running:
        for kind in ("api", "worker"):
            running.enter_context(present(opened, given, kind))
        assert faults(opened, given) == {}
        names = {one.name for one in examine(opened, given)}
        assert names == {*("schema", "processes", "clocks", "recurring work", "broker", "archive", "files")}

        # 1. A file that a row names is missing, another one cannot be read.
        with opened.database.reading() as connection:
            [sha256] = file_names(connection)
        place = opened.files.place(sha256)
        place.rename(tmp_path / "moved")
        assert faults(opened, given) == {"files": f"{sha256[:16]}: expected the file, found none"}
        (tmp_path / "moved").rename(place)

        # 2. This process has another broker, which does not answer.
        found = faults(opened, changed(given, broker_url="redis://127.0.0.1:1/0"))
        assert set(found) == {"processes", "broker"} and "other broker than here" in found["processes"]

        # 3. The provider is down.
        with running_provider() as provider:
            oidc = {"oidc_issuer": provider.issuer, "oidc_client_id": "linna", "oidc_roles": ("admin=a",)}
            signed = given.model_copy(update=oidc)
            assert "provider" not in faults(opened, signed)
        assert "provider" in faults(opened, signed)

        # 4. A clock is wrong, and a worker sees no runner.
        [api, _] = running_processes(opened.database)
        with opened.database.writing() as connection:
            late = replace(api.statement, clock_ms=90_000, runner="no")
            leases.state(connection, f"{condition.PREFIX}worker late:1", late.text(), 60_000_000_000)
        found = faults(opened, given)
        assert found["clocks"] == "worker late:1: expected within 2000 ms of the database, found 90000 ms"
        assert "expected a runner" in found["processes"]
        with opened.database.writing() as connection:
            leases.remove(connection, f"{condition.PREFIX}worker late:1")

        # 5. A channel leads to an address that is not permitted.
        text = 'name = "m"\n[spacecraft]\nid = 76\n[notify.people]\nemail = ["a@b.example"]\n'
        add_mission(opened, text.encode())
        assert (
            "channel people of spacecraft 76: localhost: expected a public address"
            in (faults(opened, given)["notifications"])
        )
        opened_to_people = given.model_copy(update={"audit_heads": "channel:people"})
        assert "audit heads" not in faults(opened, opened_to_people)

        # 6. Audit heads go to a channel that no mission description has, or to a folder that does not exist.
        for target, fault in (("channel:nobody", "found nobody"), (str(tmp_path / "none"), "a folder that can")):
            given_heads = given.model_copy(update={"audit_heads": target})
            assert fault in faults(opened, given_heads)["audit heads"]
    found = faults(opened, given)
    assert "expected a running api, found none; expected a running worker" in found["processes"]


def test_the_command_has_an_exit_status_and_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "home"))
    assert cli.run(["doctor", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "broken"
    assert [one["name"] for one in report["checks"] if not one["ok"]] == ["recurring work"]


def test_the_statement_fits_into_its_column():
    digests = tuple("f" * condition.DIGITS for _ in condition.GROUPS)
    text = condition.Statement("10.10.10.dev1000", digests, -86_400_000, "yes").text()
    assert len(text) <= 96 and condition.Statement.of_text(text).digests == digests
    assert condition.Statement.of_text("1.0 aa bb 0 -") is None
