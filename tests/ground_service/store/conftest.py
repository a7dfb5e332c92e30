from pytest import fixture

from ground_service.store.database import prepare_database


@fixture(params=["sqlite", "postgresql"])
def database(request, tmp_path):
    if request.param == "sqlite":
        url = f"sqlite:///{tmp_path / 'linna.db'}"
    else:
        url = request.getfixturevalue("migrated_postgres")()
    opened = prepare_database(url)
    yield opened
    opened.engine.dispose()
