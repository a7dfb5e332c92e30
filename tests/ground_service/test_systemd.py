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


@pytest.fixture
def units(tmp_path: Path) -> Path:
    """Copies of the units whose program exists."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    for path in UNITS.glob("linna*.*"):
        text = path.read_text().replace("/opt/linna/bin/linna", "/bin/true")
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
