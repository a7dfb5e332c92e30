"""State machines of stored entities. Every state change is one compare-and-set statement in the database.

A transition is `UPDATE ... SET state = new WHERE id = ... AND state IN (states from which new can be entered)`. The
number of changed rows decides: of several concurrent requests, in any number of processes, one changes the row and all
others receive a conflict with the state found. No state is read first and written afterwards.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Table, update

from ground_service.errors import StateConflict
from ground_service.store import repository
from ground_service.store.repository import Row


@dataclass(frozen=True, slots=True, eq=False)
class StateMachine:
    """States of one kind of row, in its column ``state``.

    Attributes
    ----------
    kind
        Name of the entity in messages.
    moves
        The states that can follow each state; a state that is missing is final.
    """

    kind: str
    table: Table
    moves: Mapping[str, tuple[str, ...]]

    def before(self, state: str) -> tuple[str, ...]:
        """Return the states from which `state` can be entered."""
        return tuple(one for one, following in self.moves.items() if state in following)


TELECOMMAND = StateMachine(
    "telecommand",
    repository.TELECOMMANDS,
    {
        "queued": ("released", "rejected"),
        "released": ("sent", "rejected"),
        # part of another telecommand, with the same outcome
        "carried": ("sent", "rejected"),
    },
)
JOB = StateMachine(
    "job",
    repository.JOBS,
    # A job whose process ended prematurely is still "running" and is started again.
    {"queued": ("running",), "running": ("running", "queued", "done", "failed"), "failed": ("queued",)},
)
LANDMARK = StateMachine(
    "landmark",
    repository.LANDMARKS,
    # Sightings decide between seen and proposed, a person about the rest, who may change the decision.
    {"proposed": ("accepted", "rejected"), "accepted": ("rejected",), "rejected": ("accepted",)},
)


def move(
    connection: Connection,
    machine: StateMachine,
    key: Any,
    state: str,
    *,
    expected: tuple[str, ...] = (),
    where: Mapping[str, Any] | None = None,
    **values: Any,
) -> None:
    """Change the state of one row, and other columns in the same statement.

    Parameters
    ----------
    expected
        States in which the row may be found; by default all from which `state` can be entered.
    where
        Further required column values, such as the number of the attempt that ends.

    Raises
    ------
    NotFound
        If there is no such row.
    StateConflict
        If its state does not permit the transition, or `where` does not match; nothing is changed then.
    """
    table, column = machine.table, next(iter(machine.table.primary_key.columns))
    expected = expected or machine.before(state)
    others = (table.c[name] == value for name, value in (where or {}).items())
    changed = connection.execute(
        update(table).where(column == key, table.c.state.in_(expected), *others).values(state=state, **values)
    )
    if changed.rowcount != 1:
        found = repository.get(connection, table, key, machine.kind)["state"]
        raise StateConflict(machine.kind, key, " or ".join(expected), str(found))


def move_all(
    connection: Connection, machine: StateMachine, conditions: Sequence[Any], state: str, **values: Any
) -> list[Row]:
    """Change the state of all rows that match the conditions and may enter it; return the changed rows.

    Two concurrent processes never get the same row. The caller holds a lock (`counters.lock_spacecraft`), which
    prevents deadlocks between processes.
    """
    table = machine.table
    rows = connection.execute(
        update(table)
        .where(*conditions, table.c.state.in_(machine.before(state)))
        .values(state=state, **values)
        .returning(*table.c)
    ).mappings()
    return [dict(row) for row in rows]


def change_if(connection: Connection, table: Table, key: Any, found: Mapping[str, Any], **values: Any) -> bool:
    """Change columns of a row if it still has the expected values; return whether it was changed."""
    column = next(iter(table.primary_key.columns))
    unchanged = (table.c[name].is_(None) if value is None else table.c[name] == value for name, value in found.items())
    changed = connection.execute(update(table).where(column == key, *unchanged).values(**values))
    return changed.rowcount == 1
