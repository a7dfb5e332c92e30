"""The systemd units: they pass the checker of systemd, and expose little."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

UNITS = Path(__file__).resolve().parents[2] / "deploy" / "systemd"
SERVICES = sorted(path.name for path in UNITS.glob("*.service"))
EXPOSURE = 2.5
"""Highest exposure of a service by `systemd-analyze security`: 0 none, 10 that of a service without restrictions."""

PRIVATE_PIDS_SINCE = 257
"""First version of systemd that knows PrivatePIDs."""

CREDENTIALS_FOLDER_SINCE = 251
"""First version of systemd that replaces %d by the folder of the credentials."""


@pytest.fixture
def units(tmp_path: Path) -> Path:
    """Copies of the units whose program exists."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    told = subprocess.run(["systemd-analyze", "--version"], capture_output=True, text=True, check=True).stdout
    version = int(told.split()[1])
    for path in UNITS.glob("linna*.*"):
        text = path.read_text().replace("/opt/linna/bin/linna", "/bin/true")
        if version < PRIVATE_PIDS_SINCE:
            text = text.replace("PrivatePIDs=yes\n", "")
        (tmp_path / path.name).write_text(text)
    return tmp_path


def test_systemd_accepts_every_unit(units: Path) -> None:
    files = sorted(str(path) for path in units.iterdir() if path.suffix in (".service", ".timer"))
    assert len(files) == 7
    (units / "linna-worker@1.service").symlink_to(units / "linna-worker@.service")
    done = subprocess.run(["systemd-analyze", "verify", *files], capture_output=True, text=True, check=False)
    complaints = [line for line in done.stderr.splitlines() if "linna" in line]
    assert complaints == [] and done.returncode == 0, done.stderr


def test_a_wrong_directive_is_noticed(units: Path) -> None:
    unit = units / "linna-api.service"
    unit.write_text(unit.read_text().replace("ProtectHome=yes", "ProtectHom=yes"))
    done = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False
    )
    assert "ProtectHom" in done.stderr


def test_the_documentation_states_the_versions_that_the_units_need() -> None:
    text = (UNITS.parents[1] / "docs/deployment.md").read_text()
    assert (
        f"The units need systemd {CREDENTIALS_FOLDER_SINCE} or later, the runner {PRIVATE_PIDS_SINCE} or later"
        in text
    )
    newer = {name for name in SERVICES if "PrivatePIDs" in settings(name)}
    assert newer == {"linna-runner.service"}
    assert "%d" in settings("linna-api.service")["Environment"]


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_exposes_little(units: Path, name: str) -> None:
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(units / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (score,) = re.findall(r"Overall exposure level for .*: ([0-9.]+)", done.stdout)
    assert float(score) <= EXPOSURE, done.stdout


@pytest.mark.parametrize("name", SERVICES)
def test_secrets_are_credentials_of_the_units_that_need_them(name: str) -> None:
    text = (UNITS / name).read_text()
    loaded = set(re.findall(r"LoadCredential=(\w+):", text))
    assert (
        loaded
        == {
            "linna-api.service": {"database_password", "broker_password"},
            "linna-worker@.service": {"database_password", "broker_password"},
            "linna-scheduler.service": {"database_password", "broker_password"},
            "linna-migrate.service": {"database_password", "database_owner_password"},
            "linna-backup.service": {"database_backup_password"},
            "linna-runner.service": set(),
        }[name]
    )
    assert not re.search(r"(PASSWORD|TOKEN)=", text)


def settings(name: str) -> dict[str, str]:
    """Settings of a unit; of a repeated one, the last."""
    lines = (UNITS / name).read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))


def test_the_runner_gets_what_it_requires() -> None:
    """Requirements of `runner_faults`, as far as a unit states them."""
    runner = settings("linna-runner.service")
    assert runner["PrivateTmp"] == "no"
    places = dict(place.split(":", 1) for place in runner["TemporaryFileSystem"].split())
    assert places == {"/tmp": "size=2G,mode=1777", "/var/tmp": "size=1M,mode=1777"}
    assert (runner["ProtectProc"], runner["ProcSubset"], runner["PrivatePIDs"]) == ("default", "all", "yes")
    assert set(runner["CapabilityBoundingSet"].split()) == {"CAP_KILL", "CAP_SETGID", "CAP_SETUID"}
    assert runner["NoNewPrivileges"] == runner["PrivateNetwork"] == runner["RestrictNamespaces"] == "yes"
    assert runner["ProtectSystem"] == "strict" and "ReadWritePaths" not in runner
    assert runner["StateDirectoryMode"] == "2770"
    assert not {"EnvironmentFile", "LoadCredential"} & set(runner)


@pytest.mark.parametrize("name", SERVICES)
def test_only_users_of_the_exchange_may_set_the_group_bit(name: str) -> None:
    expected = "no" if name in ("linna-runner.service", "linna-worker@.service") else "yes"
    assert settings(name)["RestrictSUIDSGID"] == expected
