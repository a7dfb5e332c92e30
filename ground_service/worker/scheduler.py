"""Recurring work and watching of a deployment, done by the one process that has the lease `scheduler`.

Every API process and every `linna scheduler` takes part. If the process with the lease is killed, another one continues
after `LEASE_NS`. All work may be done twice without harm: a process that was stopped for longer than its lease, and the
next one, can briefly act at the same time.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass, field
from typing import Any

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding.service import note_timeouts
from ground_service.contacts.links.service import list_links
from ground_service.contacts.links.supervisor import process_name
from ground_service.errors import GroundError, fault_of
from ground_service.ground import Ground
from ground_service.jobs.service import Dispatcher, repeat_failed
from ground_service.missions.store import missions_in_force
from ground_service.passes.alarms.service import note_operations
from ground_service.planning import store
from ground_service.planning.standing import fail_late, needs_plan
from ground_service.planning.store import WINDOWS, records_where
from ground_service.regression.jobs import nightly_placebo
from ground_service.store import leases
from ground_service.worker.upkeep import nightly_job_id, plan_job_id
from kernels.memory import give_back
from lunar.constants import DAY_NS

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


log = logging.getLogger(__name__)

LEASE = "scheduler"
LEASE_NS = 8_000_000_000
TICK_S = 2.0
"""Interval of the work; the work of a killed process is continued after `LEASE_NS` and at most one interval."""

NIGHT_NS = 1_800_000_000_000
"""The nightly job is entered at 00:30 UTC."""

WATCH_S = 30.0
"""Interval of the search for what stops operations."""

CATCH_UP_S = 60.0
"""A process that was not running then enters it so long after its start."""


class Scheduler:
    """Recurring work in a thread of this process, while it has the lease.

    Parameters
    ----------
    drain
        Function that handles events that other processes have left.
    kept
        Arguments of the nightly job: for how long what is kept (`upkeep.nightly`).
    plan_hourly
        Whether windows that can no longer begin fail, and the job of the plan is entered once an hour of mission time.
    """

    def __init__(
        self,
        ground: Ground,
        dispatcher: Dispatcher,
        drain: Callable[[], object],
        kept: Mapping[str, Any],
        *,
        plan_hourly: bool = True,
    ) -> None:
        self.owner = process_name()
        self._ground, self._dispatcher, self._drain = ground, dispatcher, drain
        self._kept, self._plan_hourly = dict(kept), plan_hourly
        self._catch_up_s = time.monotonic() + CATCH_UP_S
        self._watch, self._watch_s = Watch(ground), time.monotonic() + WATCH_S
        self._plan: str | None = None
        self._night: str | None = None
        self._since_utc_ns: int | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self.run, name="scheduler", daemon=True)

    def start(self) -> None:
        """Work in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, and give the lease back."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def run(self, stopping: threading.Event | None = None, first_s: float | None = None) -> None:
        """Work in this thread until stopped, for the first time after `first_s` (default: one interval)."""
        stop = stopping or self._stopping
        wait_s = TICK_S if first_s is None else first_s
        while not stop.wait(wait_s):
            wait_s = TICK_S
            try:
                self.tick()
            except GroundError as error:
                log.warning("recurring work could not be done: %s", error)
            except Exception:  # outermost loop of the thread
                log.exception("recurring work could not be done")
            give_back()
        self._release()

    def tick(self) -> bool:
        """Do the work that is due if this process has the lease or gets it now; return whether it has."""
        mine = self._ground.write(leases.acquire, LEASE, self.owner, LEASE_NS)
        if not mine:
            self._since_utc_ns = None
            return False
        if self._since_utc_ns is None:
            log.info("this process does the recurring work", extra={"owner": self.owner})
        self._do("failed jobs", self._repeat_failed)
        self._do("unfinished jobs", self._dispatcher.resume)
        self._do("events of other processes", self._drain)
        self._do("overdue telecommands", self._note_timeouts)
        if time.monotonic() >= self._watch_s:
            self._watch_s = time.monotonic() + WATCH_S
            self._do("watch", self._watch.tick)
        if self._plan_hourly:
            self._do("windows that did not begin", lambda: fail_late(self._ground))
            self._do("plan", self._enter_plan)
        self._do("nightly job", self._enter_night)
        return True

    def _do(self, name: str, work: Callable[[], object]) -> None:
        with fault_of(f"recurring work ({name})", passing=()):
            work()

    def _repeat_failed(self) -> None:
        self._ground.write(repeat_failed, utc_now_ns())

    def _note_timeouts(self) -> None:
        until = utc_now_ns()
        since = until - DAY_NS if self._since_utc_ns is None else self._since_utc_ns
        for command in note_timeouts(self._ground, since, until):
            log.warning("telecommand %d: its end is overdue", command, extra={"telecommand": command})
        self._since_utc_ns = until

    def _enter_plan(self) -> None:
        """Enter the job of the plan once an hour of mission time."""
        identity = plan_job_id(mission_now_ns())
        if identity != self._plan and needs_plan(self._ground):
            self._dispatcher.submit("plan", {}, job_id=identity)
            self._plan = identity

    def _enter_night(self) -> None:
        """Enter the nightly job once a day; it is one job however many processes enter it."""
        now = utc_now_ns()
        identity = nightly_job_id(now)
        late = time.monotonic() < self._catch_up_s and now % DAY_NS > NIGHT_NS + LEASE_NS
        if now % DAY_NS < NIGHT_NS or identity == self._night or late:
            return
        self._dispatcher.submit("nightly", self._kept, job_id=identity)
        self._night = identity
        if placebo := nightly_placebo(self._ground, int(self._kept.get("placebo_passes", 0))):
            self._dispatcher.submit("regression", placebo, job_id=nightly_job_id(now, "placebo"))

    def _release(self) -> None:
        try:
            self._ground.write(leases.release, LEASE, self.owner)
        except GroundError as error:
            log.warning("the lease of the recurring work ends by itself: %s", error)


def has_scheduler(ground: Ground) -> bool:
    """Return whether a process of the deployment has the lease of the recurring work now."""
    with ground.database.reading() as connection:
        return leases.owner_of(connection, LEASE) is not None
