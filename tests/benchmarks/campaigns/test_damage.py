"""Short damage campaign: one damage of each kind to every table, and every damage to files."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.campaigns.damage import (
    ALONE,
    CHANGES,
    ELSEWHERE,
    PROTECTED,
    SOURCES,
    Harm,
    SqliteCopies,
    harms,
    outside,
)
from ground_service.worker.integrity import verify


@pytest.fixture(scope="module")
def copies(tmp_path_factory: pytest.TempPathFactory) -> SqliteCopies:
    return SqliteCopies(tmp_path_factory.mktemp("damage"), packets=40)


@pytest.fixture(scope="module")
def wanted(copies: SqliteCopies) -> Iterator[list[Harm]]:
    with copies.pristine as ground:
        assert verify(ground, rebuild=True).damaged == []
        yield list(harms(ground.database.engine, ground.home))


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("sources", [True, False])
def test_damage_to_every_table_is_found(
    copies: SqliteCopies, wanted: list[Harm], change: str, sources: bool
) -> None:
    """The last column of each row is changed."""
    chosen = {
        harm.kind: harm
        for harm in wanted
        if harm.change == change and (harm.kind in SOURCES) == sources and harm.kind not in ALONE
    }
    assert set(chosen) == (SOURCES if sources else {table.name for table in PROTECTED} - SOURCES - ALONE)
    with copies.copy() as ground:
        for harm in chosen.values():
            with outside(ground.database.engine.url) as connection:
                harm.do(connection, ground.home)
        result = verify(ground, rebuild=not sources)
    told = {name for name, harm in chosen.items() if (name, harm.place) not in ELSEWHERE}
    assert {one.kind for one in result.damaged} >= told
    assert result.verdict == "damaged"


def test_damage_to_every_file_is_found(copies: SqliteCopies, wanted: list[Harm]) -> None:
    on_disk = [harm for harm in wanted if harm.kind == "files on disk"]
    assert {harm.place for harm in on_disk} == {
        "one bit", "one octet less", "one octet more", "all octets", "the file", "a file of another name",
    }  # fmt: skip
    with copies.pristine as ground:
        names = sorted(path.name for path in (ground.home / "files").rglob("*") if path.is_file())
    each = len(on_disk) // len(names)
    for k in range(each):  # the kth damage to every file, each of another file
        with copies.copy() as ground:
            for harm in on_disk[k:-1:each]:
                with outside(ground.database.engine.url) as connection:
                    harm.do(connection, ground.home)
            found = {one.key for one in verify(ground).damaged if one.kind == "files"}
        assert found == set(names), on_disk[k]
    with copies.copy() as ground:
        with outside(ground.database.engine.url) as connection:
            on_disk[-1].do(connection, Path(ground.home))
        assert [one.key for one in verify(ground).damaged] == ["notes.txt"]


def test_packets_removed_with_their_values_are_found_by_ingesting_again(copies: SqliteCopies) -> None:
    """Without packets and their values the database is consistent, but the raw file still has the packets."""
    with copies.copy() as ground:
        with outside(ground.database.engine.url) as connection:
            connection.exec_driver_sql(
                "DELETE FROM events WHERE packet_id = (SELECT max(packet_id) FROM events)"
            )
            connection.exec_driver_sql(
                "DELETE FROM packets WHERE apid = 164 AND id NOT IN (SELECT packet_id FROM events)"
            )
        assert verify(ground).verdict == "intact"
        assert {one.kind for one in verify(ground, rebuild=True).damaged} == {"packets", "events"}


def test_a_packet_under_another_number_is_found_in_its_values(
    copies: SqliteCopies, wanted: list[Harm]
) -> None:
    (harm,) = [one for one in wanted if (one.kind, one.change, one.place) == ("packets", "changed", "id")]
    with copies.copy() as ground:
        with outside(ground.database.engine.url) as connection:
            harm.do(connection, ground.home)
        assert {one.kind for one in verify(ground, rebuild=True).damaged} == {"housekeeping"}
