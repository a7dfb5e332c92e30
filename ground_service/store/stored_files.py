"""SQL of the files of the archive."""

from __future__ import annotations

from sqlalchemy import Connection, select

from ground_service.store import repository
from ground_service.store.files import StoredFile


def register_file(connection: Connection, stored: StoredFile, kind: str, name: str, now_utc_ns: int) -> None:
    """Enter a file of the archive into the database; entering it again changes nothing."""
    repository.add_new(
        connection,
        repository.FILES,
        sha256=stored.sha256,
        kind=kind,
        name=name,
        octets=stored.octets,
        received_utc_ns=now_utc_ns,
    )


def file_names(connection: Connection) -> list[str]:
    """Return the SHA-256 of all files, ascending."""
    return sorted(connection.execute(select(repository.FILES.c.sha256)).scalars())


def files_beginning(connection: Connection, prefix: str) -> list[str]:
    """Return the SHA-256 of the files whose SHA-256 begins so."""
    query = select(repository.FILES.c.sha256).where(repository.FILES.c.sha256.startswith(prefix))
    return list(connection.execute(query).scalars())


def recorded_name(connection: Connection, sha256: str) -> str:
    """Return the name of a file of the archive."""
    return str(repository.get(connection, repository.FILES, sha256, "file")["name"])
