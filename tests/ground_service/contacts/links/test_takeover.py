"""Two processes on PostgreSQL: one operates the link; after it is killed, the other takes over and sends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ground_service.contacts.links import service
from ground_service.ground import open_ground
from tests.ground_service.contacts.links.conftest import Station, declare
from tests.ground_service.contacts.links.test_links import hash_of, octets_of, packets_of, released
from tests.serving import wait_for

CADU = 1279


@pytest.mark.campaign
def test_a_killed_owner_is_replaced_and_nothing_is_lost_or_sent_twice(
    migrated_postgres: Callable[[], str], tmp_path: Path, station: Station, synthetic_pass: Any
) -> None:
    url = migrated_postgres()
    stream = (synthetic_pass.folder / "downlink.cadu").read_bytes()
    environment = os.environ | {
        "LINNA_DATABASE_URL": url,
        "LINNA_HOME": str(tmp_path / "home"),
        "LINNA_ALLOW_DATABASE_OWNER": "true",
    }
    with open_ground(tmp_path / "home", database_url=url) as ground:
        declare(ground, station.link("acknowledge = true"))
        command = [sys.executable, "-m", "linna", "link", "run"]
        processes = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE) for _ in range(2)]
        try:
            first = station.accept(60.0)
            wait_for(lambda: service.get_link(ground, "lab").owner is not None, "an owner")
            owner = service.get_link(ground, "lab").owner or ""
            (killed,) = [one for one in processes if f":{one.pid}:" in owner]
            before = released(ground, 2)
            first.sendall(stream[: 6 * CADU + 100])
            first.settimeout(20.0)
            stored = 0
            while stored < 6 * CADU + 100:
                stored = int.from_bytes(first.recv(8), "big")
            wait_for(
                lambda: packets_of(bytes(station.telecommands)) == octets_of(ground, before),
                "the telecommands",
            )
            os.kill(killed.pid, signal.SIGKILL)
            killed.wait(20)
            after = released(ground)
            second = station.accept(60.0)
            second.sendall(stream[stored:])
            wait_for(
                lambda: hash_of(ground) == expected_hash(tmp_path, synthetic_pass), "the same archive", 60.0
            )
            wait_for(
                lambda: packets_of(bytes(station.telecommands))[2:] == octets_of(ground, after),
                "the later telecommand",
            )
            assert f":{killed.pid}:" not in (service.get_link(ground, "lab").owner or "")
        finally:
            for one in processes:
                one.terminate()
                one.communicate(timeout=60)


def expected_hash(tmp_path: Path, synthetic_pass: Any) -> str:
    from ground_service.ingest.service import ingest_file

    with open_ground(tmp_path / "whole") as ground:
        if not hash_of(ground):
            ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
        return hash_of(ground)
