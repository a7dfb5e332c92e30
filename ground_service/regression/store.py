"""SQL of payload builds, kept pass archives, replays and regressions."""

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import Connection, delete, func, or_, select, update

from ground_service.errors import NotFound
from ground_service.http.model import PageOf, Paging
from ground_service.regression.model import (
    OK,
    TELEMETRY_ONLY,
    ArchiveRecord,
    Build,
    KeptReplay,
    Noise,
    Regression,
    RegressionSummary,
)
from ground_service.store import repository
from ground_service.store.states import change_if

BUILDS, ARCHIVES = repository.BUILDS, repository.REGRESSION_ARCHIVES
PLACEBOS = 100
"""Placebos whose noise counts: a quarter of a year of nights."""

REPLAYS, REGRESSIONS = repository.REPLAYS, repository.REGRESSIONS


def add_build(connection: Connection, build: Build, file_sha256: str) -> None:
    """Add a build with the zip file of its files; adding it again changes nothing."""
    values = build.model_dump(exclude={"registered"}) | {"file_sha256": file_sha256}
    repository.add_new(connection, BUILDS, **values, created_utc_ns=build.registered.utc_ns)


def file_of_build(connection: Connection, digest: str) -> str:
    """Return the SHA-256 of the zip file with the files of a build.

    Raises
    ------
    NotFound
        An earlier version registered the build, without this file.
    """
    sha256 = repository.get(connection, BUILDS, digest, "build")["file_sha256"]
    if sha256 is None:
        raise NotFound("files of build", digest)
    return str(sha256)


def get_build(connection: Connection, digest: str) -> Build:
    """Return a registered build."""
    return _build(repository.get(connection, BUILDS, digest, "build"))


def find_build(connection: Connection, beginning: str) -> str | None:
    """Return the identity of the only build whose identity begins so; None if there is none, or several."""
    query = select(BUILDS.c.digest).where(BUILDS.c.digest.startswith(beginning)).limit(2)
    found = connection.execute(query).scalars().all()
    return str(found[0]) if len(found) == 1 else None


def list_builds(connection: Connection, asked: Paging) -> PageOf[Build]:
    """List the registered builds, newest first."""
    rows, total = repository.newest(connection, BUILDS, asked)
    return asked.page(map(_build, rows), total)


def keep_archive(connection: Connection, archive: ArchiveRecord) -> None:
    """Add a kept archive; adding it again notes its use, pins it if requested, and adds its pass."""
    values = archive.model_dump(exclude={"kept_since", "pinned"})
    now, pinned = archive.kept_since.utc_ns, int(archive.pinned)
    added = repository.add_new(connection, ARCHIVES, **values, pinned=pinned, used_utc_ns=now, created_utc_ns=now)
    if not added:
        changed: dict[str, int] = {"pinned": 1} if pinned else {}
        if archive.pass_id is not None:
            changed["pass_id"] = archive.pass_id
        repository.change(connection, ARCHIVES, archive.digest, used_utc_ns=now, **changed)


def restock_archive(
    connection: Connection, archive: ArchiveRecord, *, manifest_sha256: str, **values: str | int
) -> bool:
    """Replace the files of a kept archive, and remove its replays; return False if it has changed meanwhile."""
    expected = {"manifest_sha256": archive.manifest_sha256}
    changed = change_if(connection, ARCHIVES, archive.digest, expected, manifest_sha256=manifest_sha256, **values)
    if changed:
        connection.execute(delete(REPLAYS).where(REPLAYS.c.archive_digest == archive.digest))
    return changed


def archives_of_pass(connection: Connection, pass_id: int) -> list[ArchiveRecord]:
    """Return the kept archives of a pass, newest first."""
    return [one for one in reversed(list_archives(connection)) if one.pass_id == pass_id]


def remove_replaced(connection: Connection, pass_id: int, digest: str) -> list[ArchiveRecord]:
    """Delete the archives that were made of a pass, except one and those that are pinned; return them."""
    query = delete(ARCHIVES).where(ARCHIVES.c.pass_id == pass_id, ARCHIVES.c.digest != digest, ARCHIVES.c.pinned == 0)
    return [_archive(row) for row in connection.execute(query.returning(*ARCHIVES.c)).mappings()]


def get_archive(connection: Connection, digest: str) -> ArchiveRecord:
    """Return a kept archive."""
    return _archive(repository.get(connection, ARCHIVES, digest, "archive"))


def find_archive(connection: Connection, digest: str) -> ArchiveRecord | None:
    """Return a kept archive; None if there is no such archive."""
    row = repository.find(connection, ARCHIVES, digest=digest)
    return None if row is None else _archive(row)


def list_archives(connection: Connection) -> list[ArchiveRecord]:
    """Return all kept archives, oldest first."""
    passes = repository.PASSES
    query = (
        select(
            *(one for one in ARCHIVES.c if one is not ARCHIVES.c.pass_id),
            func.coalesce(ARCHIVES.c.pass_id, passes.c.id).label("pass_id"),
        )
        .select_from(ARCHIVES)
        .outerjoin(passes, passes.c.archive_digest == ARCHIVES.c.digest)
        .order_by(ARCHIVES.c.created_utc_ns, ARCHIVES.c.digest)
    )
    return [_archive(row) for row in connection.execute(query).mappings()]


def use_archive(connection: Connection, digest: str, now_utc_ns: int) -> None:
    """Note the use of a kept archive, which postpones its removal."""
    change_if(connection, ARCHIVES, digest, {}, used_utc_ns=now_utc_ns)


def pin_archive(connection: Connection, digest: str, pinned: bool) -> None:
    """Exclude an archive from removal, or include it again."""
    if not change_if(connection, ARCHIVES, digest, {}, pinned=int(pinned)):
        raise NotFound("archive", digest)


def remove_unused(connection: Connection, used_before_utc_ns: int) -> list[ArchiveRecord]:
    """Delete the archives that are not pinned and were last used at this time or earlier; return them.

    It is one statement, so that an archive that is used or pinned concurrently is kept.
    """
    query = delete(ARCHIVES).where(ARCHIVES.c.pinned == 0, ARCHIVES.c.used_utc_ns <= used_before_utc_ns)
    return [_archive(row) for row in connection.execute(query.returning(*ARCHIVES.c)).mappings()]


def remove_above(connection: Connection, limit_octets: int, conditions: Mapping[str, str]) -> list[ArchiveRecord]:
    """Delete archives that are not pinned down to a total size; return them.

    Those without frames go first, because they say nothing about a detector; then the longest unused of the condition
    that most archives have, pinned ones included.
    """
    columns = (ARCHIVES.c.digest, ARCHIVES.c.octets, ARCHIVES.c.pinned, ARCHIVES.c.state)
    query = select(*columns).order_by(ARCHIVES.c.used_utc_ns, ARCHIVES.c.digest)
    left = {row.digest: row for row in connection.execute(query)}
    chosen = []
    while sum(row.octets for row in left.values()) > limit_octets:
        counts = Counter(conditions.get(digest) for digest in left)
        free = [digest for digest, row in left.items() if not row.pinned]
        if not free:
            break
        chosen.append(min(free, key=lambda one: (left[one].state != TELEMETRY_ONLY, -counts[conditions.get(one)])))
        del left[chosen[-1]]
    removal = delete(ARCHIVES).where(ARCHIVES.c.pinned == 0, ARCHIVES.c.digest.in_(chosen))
    return [_archive(row) for row in connection.execute(removal.returning(*ARCHIVES.c)).mappings()]


def keep_replay(
    connection: Connection, archive: str, build: str, replay: KeptReplay, now_utc_ns: int, *, manifest_sha256: str
) -> bool:
    """Store a replay of a build over an archive; an unsuccessful one does not replace a successful one.

    Returns
    -------
    bool
        Whether the kept archive still has this manifest; nothing is stored otherwise. The row is locked until the
        transaction ends, so that `restock_archive` either precedes the replay or removes it.
    """
    found = {"manifest_sha256": manifest_sha256}
    if not change_if(connection, ARCHIVES, archive, found, used_utc_ns=now_utc_ns):
        return False
    identity, values = replay_id(archive, build), replay.model_dump(exclude={"created_utc_ns"})
    added = repository.add_new(
        connection,
        REPLAYS,
        id=identity,
        archive_digest=archive,
        build_digest=build,
        created_utc_ns=now_utc_ns,
        **values,
    )
    if not added:
        replaceable = [] if replay.outcome == OK else [REPLAYS.c.outcome != OK]
        query = update(REPLAYS).where(REPLAYS.c.id == identity, *replaceable)
        connection.execute(query.values(**values, created_utc_ns=now_utc_ns))
    return True


def find_replay(connection: Connection, archive: str, build: str) -> KeptReplay | None:
    """Return the stored replay of a build over an archive; None without any."""
    row = repository.find(connection, REPLAYS, id=replay_id(archive, build))
    return None if row is None else KeptReplay.of(row)


def remove_replays(connection: Connection, builds: Collection[str]) -> set[str]:
    """Delete the replays of builds; return the hashes of their files that no other replay has."""
    names = (REPLAYS.c.downlink_sha256, REPLAYS.c.performance_sha256)
    removed = delete(REPLAYS).where(REPLAYS.c.build_digest.in_(builds)).returning(*names)
    found = {one for row in connection.execute(removed) for one in row if one}
    left = select(*names).where(or_(*(name.in_(found) for name in names)))
    return found - {one for row in connection.execute(left) for one in row}


def replay_id(archive: str, build: str) -> str:
    """Return the identity of a replay: the hash of the identities of archive and build."""
    return hashlib.sha256(f"{archive} {build}".encode()).hexdigest()


def add_regression(connection: Connection, regression: Regression, *, missions: list[str], html_sha256: str) -> bool:
    """Add a regression; return False if its id exists, because a stored verdict is not replaced."""
    verdict = regression.result
    added = repository.add_new(
        connection,
        REGRESSIONS,
        id=regression.id,
        baseline_digest=verdict.baseline.digest,
        candidate_digest=verdict.candidate.digest,
        verdict=regression.verdict,
        result=verdict.document(),
        missions=missions,
        html_sha256=html_sha256,
        created_utc_ns=regression.created.utc_ns,
    )
    return added is not None


def get_regression(connection: Connection, regression_id: str) -> Regression:
    return Regression.of(repository.get(connection, REGRESSIONS, regression_id, "regression"))


def placebo_noise(connection: Connection, policy_version: str) -> list[Noise]:
    """Return the noise of the newest placebos that this version of a policy judged."""
    query = select(REGRESSIONS.c.result).where(REGRESSIONS.c.baseline_digest == REGRESSIONS.c.candidate_digest)
    newest = query.order_by(REGRESSIONS.c.created_utc_ns.desc(), REGRESSIONS.c.id).limit(PLACEBOS)
    return [
        Noise.model_validate(row)
        for result in connection.execute(newest).scalars()
        if result["policy"]["version"] == policy_version
        for row in result.get("noise", ())
    ]


def get_report(connection: Connection, regression_id: str) -> str:
    """Return the SHA-256 of the report of a regression."""
    return str(repository.get(connection, REGRESSIONS, regression_id, "regression")["html_sha256"])


def list_regressions(connection: Connection, asked: Paging) -> PageOf[RegressionSummary]:
    """List the verdicts, newest first."""
    rows, total = repository.newest(connection, REGRESSIONS, asked)
    return asked.page((Regression.of(row).summary() for row in rows), total)


def _build(row: Mapping[Any, Any]) -> Build:
    return Build.of(row, registered=row["created_utc_ns"])


def _archive(row: Mapping[Any, Any]) -> ArchiveRecord:
    return ArchiveRecord.of(row, kept_since=row["created_utc_ns"])
