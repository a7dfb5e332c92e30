"""Alarms for what stops the operation of a spacecraft, found in the state of the service instead of in telemetry."""

from __future__ import annotations

import time
from collections.abc import Iterator, Set
from dataclasses import dataclass, field

from ground_service.clock import mission_now_ns
from ground_service.contacts.links.service import list_links
from ground_service.ground import Ground
from ground_service.missions.store import missions_in_force
from ground_service.passes.alarms.service import note_operations
from ground_service.planning import store
from ground_service.planning.store import WINDOWS, records_where

HOLDS_S = 300.0
"""A condition is an alarm when it has held for so long."""

OVERDUE_NS = 24 * 3600 * 10**9
"""A window without a report so long after its end is overdue."""


@dataclass(slots=True)
class Watch:
    """Conditions (spacecraft, name), and since when each of them holds (monotonic clock, s)."""

    ground: Ground
    holds_s: float = HOLDS_S
    _since: dict[tuple[int, str], float] = field(default_factory=dict)
    _clock: int = 0

    def tick(self) -> None:
        """Look at all spacecraft; raise alarms, or end their conditions.

        A process that has just begun knows no ages: it raises nothing, and ends only what no longer holds.
        """
        now = time.monotonic()
        unknown = {"mission_time_stopped", "spacecraft_gone"} if self._clock == 0 else set()
        with self.ground.database.reading() as connection:
            spacecraft = set(missions_in_force(connection))
        self._since = {one: self._since.get(one, now) for one in self._conditions(spacecraft)}
        for number in spacecraft:
            mine = {name: since for (own, name), since in self._since.items() if own == number}
            lasting = {name for name, since in mine.items() if now - since >= self.holds_s}
            note_operations(self.ground, number, lasting, mine.keys() | unknown)

    def _conditions(self, spacecraft: Set[int]) -> Iterator[tuple[int, str]]:
        now, before = mission_now_ns(), self._clock
        self._clock = now
        links = list_links(self.ground)
        waiting = self.ground.read(records_where, WINDOWS.c.state.in_(("uplinked", "executing")))
        awaited = {one.spacecraft_id for one in waiting}
        for number in spacecraft:
            mine = [one for one in links if one.spacecraft_id == number]
            is_silent = bool(mine) and not any(one.state in ("connected", "contact") for one in mine)
            is_operated = any(one.owner for one in mine)
            if mine and now == before:
                yield number, "mission_time_stopped"
            if is_silent:
                yield number, "no_link" if is_operated else "link_process_gone"
            if is_silent and is_operated and now == before and number in awaited:
                yield number, "spacecraft_gone"
        with self.ground.database.reading() as connection:
            refused = records_where(connection, WINDOWS.c.state == "approved", WINDOWS.c.reason.is_not(None))
            yield from ((one.spacecraft_id, "window_not_released") for one in refused)
            late = WINDOWS.c.state.in_(("executed", "downlinked")), WINDOWS.c.stop_utc_ns < now - OVERDUE_NS
            yield from ((one.spacecraft_id, "report_overdue") for one in records_where(connection, *late))
            for key in store.active_requests(connection):
                plan = store.get_plan(connection, key)
                if plan.planned is not None and not plan.candidates:
                    yield store.get_request_record(connection, key).spacecraft_id, "plan_empty"
