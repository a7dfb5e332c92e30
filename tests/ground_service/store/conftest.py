from collections.abc import Iterator
from pathlib import Path

import pytest

from ground_service.store.database import Database, prepare_database


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    if request.param == "sqlite":
        url = f"sqlite:///{tmp_path / 'linna.db'}"
    else:
        url = request.getfixturevalue("migrated_postgres")()
    opened = prepare_database(url)
    yield opened
    opened.engine.dispose()
