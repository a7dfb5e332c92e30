"""SQL of telecommands."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, select, update

from ground_service.store.states import TELECOMMAND, move_all

TELECOMMANDS = TELECOMMAND.table


def ids_of_windows(connection: Connection, windows: Sequence[int]) -> dict[int, list[int]]:
    """Return the ids of the telecommands of each of these windows, ascending."""
    query = select(TELECOMMANDS.c.window_id, TELECOMMANDS.c.id).where(TELECOMMANDS.c.window_id.in_(windows))
    found: dict[int, list[int]] = {window: [] for window in windows}
    for window, command in connection.execute(query.order_by(TELECOMMANDS.c.id)):
        found[window].append(int(command))
    return found


def carriers_of_window(connection: Connection, window_id: int) -> list[int]:
    """Return the ids of the telecommands that uplink a window, without rejected and carried ones."""
    query = select(TELECOMMANDS.c.id).where(
        TELECOMMANDS.c.window_id == window_id,
        TELECOMMANDS.c.carrier_id.is_(None),
        TELECOMMANDS.c.state != "rejected",
    )
    return [int(key) for key in connection.execute(query.order_by(TELECOMMANDS.c.id)).scalars()]


def states_of_window(connection: Connection, window_id: int) -> set[str]:
    """Return the stored states of the telecommands of a window."""
    query = select(TELECOMMANDS.c.state).where(TELECOMMANDS.c.window_id == window_id)
    return set(connection.execute(query).scalars())


def withdraw_window(connection: Connection, window_id: int, *, actor: str, now_utc_ns: int) -> None:
    """Reject the telecommands of a window that were not sent."""
    move_all(
        connection,
        TELECOMMAND,
        [TELECOMMANDS.c.window_id == window_id],
        "rejected",
        decided_by=actor,
        decided_utc_ns=now_utc_ns,
        reason="the window was withdrawn",
    )


def unlink_window(connection: Connection, window_id: int) -> None:
    """Remove the reference to a window from its telecommands."""
    connection.execute(
        update(TELECOMMANDS).where(TELECOMMANDS.c.window_id == window_id).values(window_id=None)
    )
