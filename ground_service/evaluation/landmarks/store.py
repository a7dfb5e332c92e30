"""Database access for landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, delete, func, select

from ground_service.evaluation.landmarks.model import Landmark, LandmarkDetail, LandmarkFilter, PassSightings
from ground_service.http.model import PageOf
from ground_service.store import repository
from ground_service.store.states import LANDMARK, change_if, move
from ground_service.store.vehicles import lock_spacecraft

_LANDMARKS, _VEHICLES = repository.LANDMARKS, repository.VEHICLES


def lock_landmarks(connection: Connection, spacecraft_id: int) -> None:
    """Keep other processes from changing the landmarks of a spacecraft until the transaction ends."""
    query = select(func.min(_VEHICLES.c.id)).where(_VEHICLES.c.ccsds_id == spacecraft_id)
    lock_spacecraft(connection, int(connection.execute(query).scalar_one()))


def landmarks_of_spacecraft(connection: Connection, spacecraft_id: int) -> list[LandmarkDetail]:
    """Return all landmarks of a spacecraft with their sightings, in the order in which they were found."""
    query = select(_LANDMARKS).where(_LANDMARKS.c.spacecraft_id == spacecraft_id).order_by(_LANDMARKS.c.id)
    return [LandmarkDetail.of(row) for row in connection.execute(query).mappings()]


def get_landmark(connection: Connection, landmark_id: int) -> LandmarkDetail:
    """Return a landmark with its sightings."""
    return LandmarkDetail.of(repository.get(connection, _LANDMARKS, landmark_id, "landmark"))


def list_landmarks(connection: Connection, asked: LandmarkFilter) -> PageOf[Landmark]:
    """List the landmarks learned from flight, most passes first."""
    query = select(*(one for one in _LANDMARKS.c if one.name != "evidence"))
    order = (_LANDMARKS.c.passes.desc(), _LANDMARKS.c.sightings.desc(), _LANDMARKS.c.id)
    rows, total = repository.page(connection, query, asked, *order)
    return asked.page(map(Landmark.of, rows), total)


def add_landmark(
    connection: Connection,
    spacecraft_id: int,
    state: str,
    evidence: Sequence[PassSightings],
    now_utc_ns: int,
    **figures: Any,
) -> int:
    """Add a landmark; return its id."""
    values = {"created_utc_ns": now_utc_ns, "changed_utc_ns": now_utc_ns, **figures}
    key = repository.add(
        connection, _LANDMARKS, spacecraft_id=spacecraft_id, state=state, evidence=_rows(evidence), **values
    )
    return int(key)


def change_landmark(
    connection: Connection,
    landmark_id: int,
    found: str,
    state: str,
    evidence: Sequence[PassSightings],
    now_utc_ns: int,
    **figures: Any,
) -> None:
    """Replace the sightings of a landmark; one that was decided since it was found in a state stays decided."""
    values = {"evidence": _rows(evidence), "changed_utc_ns": now_utc_ns, **figures}
    if not change_if(connection, _LANDMARKS, landmark_id, {"state": found}, state=state, **values):
        repository.change(connection, _LANDMARKS, landmark_id, **values)


def delete_landmark(connection: Connection, landmark_id: int) -> None:
    """Delete a landmark without sightings."""
    connection.execute(delete(_LANDMARKS).where(_LANDMARKS.c.id == landmark_id))


def decide_landmark(
    connection: Connection, landmark_id: int, state: str, *, actor: str, reason: str, now_utc_ns: int
) -> None:
    """Accept or reject a landmark.

    Raises
    ------
    StateConflict
        It is not proposed, or decided in the same way already.
    """
    move(
        connection,
        LANDMARK,
        landmark_id,
        state,
        decided_by=actor,
        decided_utc_ns=now_utc_ns,
        reason=reason,
        changed_utc_ns=now_utc_ns,
    )


def count_proposed(connection: Connection, spacecraft_id: int) -> int:
    """Return the number of landmarks that wait for a decision."""
    query = select(func.count()).where(
        _LANDMARKS.c.spacecraft_id == spacecraft_id, _LANDMARKS.c.state == "proposed"
    )
    return int(connection.execute(query).scalar_one())


def _rows(evidence: Sequence[PassSightings]) -> list[dict[str, Any]]:
    return [one.model_dump(mode="json") for one in evidence]
