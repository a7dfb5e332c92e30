"""Values that a database cannot hold are refused in one line on both databases, without the address of the database."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ground_service.errors import DatabaseBusy, InvalidInput, public_text
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.store import repository
from ground_service.store.database import database_error


@pytest.mark.parametrize(
    "values",
    [
        {"result": {"value": float("nan")}},
        {"result": {"value": [1.0, float("inf")]}},
        {"attempts": 10**20},
        {"created_utc_ns": -(2**70)},
        {"error": "half of a pair \ud800"},
    ],
)
def test_a_value_that_no_database_can_hold_is_refused(either: Ground, values: dict[str, Any]) -> None:
    row = {
        "id": "j", "kind": "report", "state": "queued", "arguments": {}, "progress": 0.0, "attempts": 0,
        "created_utc_ns": 1, **values,
    }  # fmt: skip
    with (
        pytest.raises(
            InvalidInput, match="request: expected text and numbers that the database can hold"
        ) as refused,
        either.database.writing() as connection,
    ):
        repository.add(connection, repository.JOBS, **row)
    assert "://" not in public_text(refused.value)
    with either.database.reading() as connection:
        assert repository.newest(connection, repository.JOBS, Paging())[1] == 0


def test_text_with_nul_is_refused_by_postgresql_as_input(migrated_postgres: Any, tmp_path: Path) -> None:
    url = migrated_postgres()
    with (
        open_ground(tmp_path, database_url=url) as ground,
        pytest.raises(InvalidInput, match="can hold"),
        ground.database.reading() as connection,
    ):
        repository.find(connection, repository.JOBS, id="a\x00")


@pytest.mark.parametrize("sqlstate", ["40001", "40P01", "55P03"])
def test_a_transaction_that_the_database_gave_up_may_be_tried_again(sqlstate: str) -> None:
    class Original(Exception):
        pass

    from sqlalchemy.exc import DBAPIError

    original = Original("deadlock detected")
    original.sqlstate = sqlstate
    error = database_error(DBAPIError("UPDATE", {}, original), "postgresql://secret@db/linna")
    assert isinstance(error, DatabaseBusy)
    assert "secret" not in str(error)
