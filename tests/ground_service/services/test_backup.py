"""Backup and restore: everything comes back, damage is told, nothing is overwritten."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from ground_service.errors import Conflict, FileDamaged, InvalidInput
from ground_service.services.archive_import import import_archive
from ground_service.services.backup import backup, restore
from ground_service.services.ground import Ground, open_ground
from ground_service.services.planning import WindowEntry, add_window, change_window
from ground_service.services.reports import pass_summary
from ground_service.services.users import add_user, authenticate
from ground_service.store.models import Base

NS = 1_000_000_000
START = 2_000_000_000 * NS


def everything(ground: Ground) -> dict[str, list[Any]]:
    with ground.database.reading() as connection:
        return {
            table.name: [
                tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key.columns))
            ]
            for table in Base.metadata.sorted_tables
        }


@pytest.fixture
def filled(ground: Ground, synthetic_pass: Any) -> tuple[Ground, str]:
    import_archive(ground, synthetic_pass.folder)
    for k in (2, 1):
        add_window(
            ground,
            WindowEntry(f"w{k}", START + k * 100 * NS, START + (k * 100 + 50) * NS, 15.0, 76),
            actor="ann",
        )
    change_window(
        ground, 1, actor="ann", changes={"predecessor_id": 2}
    )  # it names a window with a greater key
    return ground, add_user(ground, "ann", "operator")


@pytest.fixture
def saved(filled: tuple[Ground, str], tmp_path: Path) -> Iterator[Path]:
    manifest = backup(filled[0], tmp_path / "saved", now_utc_ns=START)
    assert manifest["made_utc"] == "2033-05-18T03:33:20.000Z"
    yield tmp_path / "saved"


def test_everything_comes_back(filled: tuple[Ground, str], saved: Path, tmp_path: Path) -> None:
    ground, token = filled
    with open_ground(tmp_path / "again") as other:
        restore(saved, other)
        assert everything(other) == everything(ground)
        assert authenticate(other, token).name == "ann"
        assert pass_summary(other, 1) == pass_summary(ground, 1)
        add_window(other, WindowEntry("new", START, START + NS, 1.0, 76), actor="bob")  # keys go on behind
        with pytest.raises(Conflict, match="expected an empty service, found"):
            restore(saved, other)


def test_a_backup_overwrites_nothing(filled: tuple[Ground, str], saved: Path) -> None:
    before = (saved / "linna.db").read_bytes()
    with pytest.raises(Conflict, match="expected a folder that is new or empty"):
        backup(filled[0], saved, now_utc_ns=START)
    assert (saved / "linna.db").read_bytes() == before


def test_damage_is_found(saved: Path, tmp_path: Path) -> None:
    damaged = next(path for path in (saved / "files").rglob("*") if path.is_file())
    damaged.chmod(0o644)
    damaged.write_bytes(b"x" + damaged.read_bytes())
    with open_ground(tmp_path / "again") as other:
        with pytest.raises(FileDamaged):
            restore(saved, other)
        assert not any(everything(other).values())
    (saved / "backup.json").write_text(json.dumps({"schema_version": 99}))
    with (
        open_ground(tmp_path / "third") as other,
        pytest.raises(InvalidInput, match="schema_version: expected 1"),
    ):
        restore(saved, other)
    with open_ground(tmp_path / "fourth") as other, pytest.raises(InvalidInput, match="expected a backup"):
        restore(tmp_path, other)
