"""Export and import: equal archives with both databases, detection of damage, and databases before version 1.0."""

import json
import sqlite3
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from ground_service.access.audit_log import list_entries
from ground_service.access.service import add_user, authenticate, token_sha256, token_valid
from ground_service.commanding.service import get_command, release_command
from ground_service.errors import Conflict, DatabaseTooNew, DatabaseTooOld, FileDamaged, InvalidInput
from ground_service.ground import Ground, open_ground
from ground_service.ingest.listing import get_ingest
from ground_service.ingest.packets import batch_of_cut
from ground_service.ingest.service import ingest_file
from ground_service.ingest.store import results_of_vehicle
from ground_service.passes.archive_import import import_archive
from ground_service.planning.service import WindowEntry, add_window, change_window
from ground_service.store import repository
from ground_service.store.database import open_database, prepare_database
from ground_service.store.files import FileArchive
from ground_service.store.models import METADATA
from ground_service.worker.exchange import export_database, import_database
from ground_service.worker.integrity import verify
from lunar.timescales import parse_utc
from tests.ground_service.archive_hash import archive_hash
from tmtc.downlink import decode

NS = 1_000_000_000
START = parse_utc("2029-08-07T06:00:00Z")
OLD_SCHEMA = Path(__file__).with_name("schema_0011.sql")


def counts(ground: Ground) -> dict[str, int]:
    with ground.database.reading() as connection:
        return {
            name: len(connection.execute(select(table)).all())
            for name, table in METADATA.tables.items()
            if name != "row_digests"
        }


def hashes(ground: Ground) -> list[str]:
    with ground.database.reading() as connection:
        keys = connection.execute(
            select(repository.VEHICLES.c.id).order_by(repository.VEHICLES.c.id)
        ).scalars()
        return [archive_hash(connection, key) for key in keys.all()]


def export(ground: Ground, out: Path, **how: Any) -> Any:
    return export_database(ground.database, ground.files, out, now_utc_ns=START, **how)


@pytest.fixture(scope="module")
def exported(
    synthetic_pass: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Ground, Path, str]]:
    """Return a filled service, its export, and the token of a user."""
    folder = tmp_path_factory.mktemp("exported")
    with open_ground(folder / "home") as ground:
        import_archive(ground, synthetic_pass.folder)
        for k in (2, 1):
            entry = WindowEntry(f"w{k}", START + k * 100 * NS, START + (k * 100 + 50) * NS, 15.0, 76)
            add_window(ground, entry, actor="ann")
        change_window(ground, 1, actor="ann", changes={"predecessor_id": 2})
        token = add_user(ground, "ann", "operator")
        export(ground, folder / "all.zip")
        yield ground, folder / "all.zip", token


def test_an_export_goes_into_either_database_and_back(
    exported: tuple[Ground, Path, str], tmp_path: Path, new_postgres_database: Callable[[], str]
) -> None:
    ground, path, token = exported
    url = new_postgres_database()
    prepare_database(url, upgrade=True).engine.dispose()
    tables = json.loads(zipfile.ZipFile(path).read("manifest.json"))["tables"]
    with open_ground(tmp_path / "pg", database_url=url) as other:
        result = import_database(other, path)
        assert (sum(result.rows.values()), result.left_out) == (sum(counts(ground).values()), {})
        assert (counts(other), hashes(other)) == (counts(ground), hashes(ground))
        assert authenticate(other, token).name == "ann"
        assert list_entries(other)[0] == list_entries(ground)[0]
        assert verify(other, rebuild=True).damaged == []
        add_window(other, WindowEntry("new", START, START + NS, 1.0, 76), actor="bob")  # keys go on behind
        with pytest.raises(Conflict, match="expected an empty service, found"):
            import_database(other, path)
    with open_ground(tmp_path / "pg2", database_url=url) as other:
        other.database.engine.dispose()
    url = new_postgres_database()
    prepare_database(url, upgrade=True).engine.dispose()
    with open_ground(tmp_path / "third", database_url=url) as other, open_ground(tmp_path / "back") as back:
        import_database(other, path)
        again = export(other, tmp_path / "again.zip")
        assert {name: table.model_dump(mode="json") for name, table in again.tables.items()} == tables
        import_database(back, tmp_path / "again.zip")
        assert (counts(back), hashes(back)) == (counts(ground), hashes(ground))


def test_an_export_without_files_needs_the_files(exported: tuple[Ground, Path, str], tmp_path: Path) -> None:
    ground, path, _ = exported
    export(ground, tmp_path / "rows.zip", with_files=False)
    assert (tmp_path / "rows.zip").stat().st_size < path.stat().st_size
    with open_ground(tmp_path / "again") as other:
        with pytest.raises(InvalidInput, match="expected the file in"):
            import_database(other, tmp_path / "rows.zip")
        for file in (one for one in ground.files.root.rglob("*") if one.is_file()):
            other.files.put_file(file)
        import_database(other, tmp_path / "rows.zip")
        assert hashes(other) == hashes(ground)
    with pytest.raises(Conflict, match="does not exist yet"):
        export(ground, path)


def altered(path: Path, out: Path, change: Callable[[str, bytes], bytes | None]) -> Path:
    """Return the export with changed entries, without those for which `change` returns None."""
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(out, "w") as target:
        for name in source.namelist():
            octets = change(name, source.read(name))
            if octets is not None:
                target.writestr(name, octets)
    return out


def flipped(octets: bytes) -> bytes:
    middle = len(octets) // 2
    return octets[:middle] + bytes([octets[middle] ^ 1]) + octets[middle + 1 :]


def test_a_changed_export_is_not_imported(exported: tuple[Ground, Path, str], tmp_path: Path) -> None:
    _, path, _ = exported
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if archive.getinfo(name).file_size]
    chosen = [name for name in names if name.startswith("tables/")] + names[-2:]
    with open_ground(tmp_path / "again") as other:
        for number, damaged in enumerate(chosen):
            for how in (flipped, lambda _octets: None):
                file = altered(
                    path, tmp_path / f"{number}.zip", lambda n, o, d=damaged, h=how: h(o) if n == d else o
                )
                with pytest.raises((InvalidInput, FileDamaged)) as caught:
                    import_database(other, file)
                assert "\\n" not in str(caught.value)
        assert {name for name, count in counts(other).items() if count} == {"audit_head"}
        assert not [one for one in other.files.root.rglob("*") if one.is_file()]


@pytest.mark.parametrize(
    ("octets", "reason"), [(None, "nothing there"), (b"PK but no zip", "another file"), (b"", "another file")]
)
def test_a_file_that_is_no_export_is_refused_in_one_line(
    ground: Ground, tmp_path: Path, octets: bytes | None, reason: str
) -> None:
    path = tmp_path / "x.zip"
    if octets is not None:
        path.write_bytes(octets)
    with pytest.raises(InvalidInput, match=f"linna db export' wrote, found {reason}"):
        import_database(ground, path)


def test_a_later_form_of_export_is_named(
    exported: tuple[Ground, Path, str], ground: Ground, tmp_path: Path
) -> None:
    def change(name: str, octets: bytes) -> bytes:
        if name != "manifest.json":
            return octets
        return json.dumps({**json.loads(octets), "version": 2}).encode()

    with pytest.raises(InvalidInput, match="expected linna-export version 1, found version 2"):
        import_database(ground, altered(exported[1], tmp_path / "later.zip", change))


@pytest.fixture
def earlier(tmp_path: Path, synthetic_pass: Any) -> Path:
    """Return the home of a service whose filled database has the last revision before version 1.0."""
    home = tmp_path / "earlier"
    home.mkdir()
    stored = FileArchive(home / "files").put_file(synthetic_pass.folder / "downlink.cadu")
    found = decode(stored.path.read_bytes())
    batch = batch_of_cut(found.buffer, found.cut, spacecraft_id=76)
    with sqlite3.connect(home / "linna.db") as connection:
        connection.executescript(OLD_SCHEMA.read_text())
        connection.execute("INSERT INTO alembic_version VALUES ('0011')")
        connection.execute(
            "INSERT INTO files VALUES (?, 'downlink', 'd.cadu', ?, 5)", (stored.sha256, stored.octets)
        )
        connection.execute(
            "INSERT INTO vehicles (id, ccsds_id, instance, decoded_version) VALUES (3, 76, 'flight', 1)"
        )
        connection.execute(
            "INSERT INTO ingests VALUES (4, 3, ?, 'done', NULL, 1, 5, 6, '{\"packets\": 9}')",
            (stored.sha256,),
        )
        connection.executemany(
            "INSERT INTO packets (vehicle_id, apid, sequence_count, ticks, digest, octets) VALUES (3, ?, ?, ?, ?, ?)",
            list(
                zip(
                    batch.apid.tolist(),
                    batch.sequence_count.tolist(),
                    batch.ticks.tolist(),
                    batch.digest,
                    batch.octets,
                    strict=True,
                )
            ),
        )
        connection.execute("INSERT INTO users (id, name, role, created_utc_ns) VALUES (2, 'ann', 'admin', 7)")
        connection.execute(
            "INSERT INTO tokens (user_id, token_sha256, created_utc_ns) VALUES (2, ?, 8)",
            (token_sha256("secret"),),
        )
        for key in (3, 9):  # numbers with gaps, as sequences leave them
            connection.execute(
                "INSERT INTO audit VALUES (?, ?, 'ann', 'look', 'x', '{\"a\": 0.5}')", (key, key)
            )
        for count in (0, 1, None):
            connection.execute(
                "INSERT INTO telecommands (vehicle_id, name, arguments, state, critical, timeout_s, requested_by, "
                "created_utc_ns, sequence_count) VALUES (3, 'test_connection', '{}', 'queued', 0, 5, 'ann', 1, ?)",
                (count,),
            )
        connection.execute(
            "INSERT INTO windows (vehicle_id, name, start_utc_ns, stop_utc_ns, cadence_s, decision, state, "
            "data_octets, predicted, version, created_by, created_utc_ns, changed_utc_ns) "
            "VALUES (3, 'w', 1, 2, 15.0, 'draft', 'draft', 5, '{}', 1, 'bob', 1, 1)"
        )
        connection.execute("INSERT INTO events VALUES (3, 1, 5, 1, 1, 2, 3, 0.5, NULL)")
    connection.close()
    return home


def test_a_database_before_version_1_is_carried_over(earlier: Path, tmp_path: Path, make_pass: Any) -> None:
    database = open_database(f"sqlite:///{earlier / 'linna.db'}")
    manifest = export_database(
        database, FileArchive(earlier / "files"), tmp_path / "old.zip", now_utc_ns=START
    )
    database.engine.dispose()
    assert (manifest.revision, manifest.audit_head) == ("0011", None)
    with open_ground(tmp_path / "new") as ground:
        result = import_database(ground, tmp_path / "old.zip")
        assert result.left_out == {"events": 1}
        assert result.decoded > 100
        assert [(one.number, one.time[:4]) for one in list_entries(ground)[0]] == [(2, "1970"), (1, "1970")]
        assert token_valid(ground, "secret")
        with ground.database.reading() as connection:
            row = repository.get(connection, repository.VEHICLES, 3, "vehicle")
            window = repository.get(connection, repository.WINDOWS, 1, "window")
        assert row["decoded_version"] is not None
        assert get_ingest(ground, 4).accounting is None  # the earlier one states too little
        with ground.database.reading() as connection:
            assert [result for _, _, result in results_of_vehicle(connection, 3, 0, 1)] == [None]
        assert (window["edited_by"], window["decided_by"]) == ("bob", None)
        release_command(ground, 3, actor="eve")
        assert get_command(ground, 3).record.sequence_count == 2  # two had counts: the next is the third
        assert verify(ground, rebuild=True).damaged == []
        with open_ground(tmp_path / "fresh") as fresh:
            ingest_file(fresh, ground.files.path(next(iter(result_files(ground)))))
            assert hashes(fresh) == hashes(ground)


def result_files(ground: Ground) -> list[str]:
    with ground.database.reading() as connection:
        return list(connection.execute(select(repository.FILES.c.sha256)).scalars())


@pytest.mark.parametrize(("revision", "kind"), [("0010", DatabaseTooOld), ("9.9", DatabaseTooNew)])
def test_a_schema_that_cannot_be_read_is_not_exported(
    earlier: Path, tmp_path: Path, revision: str, kind: type[Exception]
) -> None:
    with sqlite3.connect(earlier / "linna.db") as connection:
        connection.execute("UPDATE alembic_version SET version_num = ?", (revision,))
    connection.close()
    database = open_database(f"sqlite:///{earlier / 'linna.db'}")
    with pytest.raises(kind, match=f"found {revision}"):
        export_database(database, FileArchive(earlier / "files"), tmp_path / "old.zip", now_utc_ns=START)
    database.engine.dispose()
    assert not (tmp_path / "old.zip").exists()
