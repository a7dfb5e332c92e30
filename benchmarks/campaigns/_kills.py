"""Kills of parts of a deployment at seeded points, and the supervision that starts ended parts again."""

import json
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError
from lunar.timescales import format_utc
from studies.harness.parts import Part

SPACECRAFT = "spacecraft"
PHASES = ("started", "ended", "settled")
"""Stops of simulated time: start of a contact, end of a contact, and when the ground has noticed this end."""

LONGEST_DELAY_S = 2.0
"""Wall time from a stop to a kill."""

LONGEST_DOWN_S = 2.0
"""Wall time from a kill to the start of the part."""

LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class PlannedKill:
    """A kill at the first stop of a phase after a mission time, some wall time after the stop."""

    utc_ns: int
    phase: str
    part: str
    delay_s: float
    down_s: float


@dataclass(frozen=True, slots=True)
class Kill:
    """A kill (SIGKILL) that was carried out: mission time, wall time, and time until the part worked again."""

    part: str
    mission_utc: str
    phase: str
    wall_utc: str
    recovery_s: float


def plan_kills(
    seed: int, parts: Sequence[str], start_utc_ns: int, stop_utc_ns: int, count: int
) -> tuple[PlannedKill, ...]:
    """Return kills at random points of equal parts of a span; each part of the deployment in turn, in random order."""
    rng = np.random.default_rng(seed)
    found = []
    order: list[str] = []
    for k in range(count):
        if not order:
            order = [str(one) for one in rng.permutation(sorted(parts))]
        share = (k + rng.random()) / count
        found.append(
            PlannedKill(
                start_utc_ns + round(share * (stop_utc_ns - start_utc_ns)),
                str(rng.choice(PHASES)),
                order.pop(),
                float(rng.uniform(0.0, LONGEST_DELAY_S)),
                float(rng.uniform(0.0, LONGEST_DOWN_S)),
            )
        )
    return tuple(found)


class Keeper:
    """Thread that kills parts at planned points, starts them again, and starts parts that have ended by themselves.

    Parameters
    ----------
    parts
        Processes by name.
    kill_spacecraft
        Function that kills the spacecraft, which the run starts again; it calls `recovered` then.
    file
        Where the kills are recorded, so that a run that is continued does not repeat them.
    """

    def __init__(
        self,
        parts: Mapping[str, Part],
        planned: Sequence[PlannedKill],
        kill_spacecraft: Callable[[], object],
        changed: Callable[[], object],
        file: Path,
        say: Callable[[str], None],
    ) -> None:
        self._parts, self._kill_spacecraft, self._changed = parts, kill_spacecraft, changed
        self._file, self._say = file, say
        known = json.loads(file.read_text()) if file.exists() else {"kills": [], "ended": []}
        self.kills = [Kill(**one) for one in known["kills"]]
        self.ended: list[tuple[str, str]] = [(wall, part) for wall, part in known["ended"]]
        self.planned = len(planned)
        done = Counter((one.part, one.phase) for one in self.kills)
        self._left = list(planned)
        for one in planned:
            if done[one.part, one.phase]:
                done[one.part, one.phase] -= 1
                self._left.remove(one)
        self._due: queue.Queue[tuple[PlannedKill, str]] = queue.Queue()
        self._stopping, self._back = threading.Event(), threading.Event()
        self._spacecraft_is_down = False
        self._fault: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)

    def start(self) -> None:
        """Look after the parts in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop after the current kill, with every part started again."""
        self._stopping.set()
        self._back.set()
        if self._thread.ident is not None:
            self._thread.join()
        self.check()

    def check(self) -> None:
        """Raise the error that has ended the thread, if there is one."""
        if self._fault is not None:
            raise GroundError(f"mission run: supervision of its parts: {self._fault}") from self._fault

    def at_stop(self, phase: str, utc_ns: int) -> None:
        """Carry out the kills that are due at this stop of simulated time, one after the other; return at once."""
        self.check()
        due = [one for one in self._left if one.phase == phase and one.utc_ns <= utc_ns]
        for one in due:
            self._left.remove(one)
            self._due.put((one, format_utc(utc_ns)))

    def wait(self) -> bool:
        """Wait until the ordered kills are carried out; return False at once if the spacecraft is killed."""
        while self._due.unfinished_tasks:
            self.check()
            if self._spacecraft_is_down:
                return False
            time.sleep(LOOK_S / 10.0)
        return True

    def recovered(self) -> None:
        """Note that the spacecraft runs again."""
        self._back.set()

    def figures(self) -> dict[str, Any]:
        """Return the numbers of kills and the recovery times for the closing report."""
        times: dict[str, list[float]] = {}
        for one in self.kills:
            times.setdefault(one.part, []).append(one.recovery_s)
        return {
            "planned": self.planned,
            "done": len(self.kills),
            "by_part": dict(sorted(Counter(one.part for one in self.kills).items())),
            "by_phase": dict(sorted(Counter(one.phase for one in self.kills).items())),
            "recovery_s": {
                name: {"median": round(float(np.median(found)), 1), "longest": round(max(found), 1)}
                for name, found in sorted(times.items())
            },
            "ended_by_themselves": dict(Counter(part for _, part in self.ended)),
            "list": [asdict(one) for one in self.kills],
        }

    def _run(self) -> None:
        try:
            while not (self._stopping.is_set() and self._due.empty()):
                try:
                    planned, utc = self._due.get(timeout=LOOK_S)
                except queue.Empty:
                    self._revive()
                    continue
                time.sleep(planned.delay_s)
                self._kill(planned, utc)
                self._due.task_done()
        except Exception as error:  # outermost loop of the thread; `check` raises it in the run
            self._fault = error

    def _kill(self, planned: PlannedKill, utc: str) -> None:
        wall, begun = format_utc(utc_now_ns()), time.monotonic()
        if planned.part == SPACECRAFT:
            if self._stopping.is_set():
                return  # the run has ended, or was stopped
            self._back.clear()
            self._spacecraft_is_down = True
            self._kill_spacecraft()
            # The run may wait for another part before it starts the spacecraft again.
            while not self._back.wait(LOOK_S):
                self._revive()
            self._spacecraft_is_down = False
        else:
            part = self._parts[planned.part]
            part.kill()
            time.sleep(planned.down_s)
            part.start()
            self._changed()
        took = time.monotonic() - begun
        self.kills.append(Kill(planned.part, utc, planned.phase, wall, round(took, 2)))
        self._save()
        self._say(f"kill {len(self.kills)} of {self.planned}: {planned.part} works again after {took:.1f} s")

    def _revive(self) -> None:
        for name, part in self._parts.items():
            if part.has_ended:
                self.ended.append((format_utc(utc_now_ns()), name))
                self._save()
                part.revive()
                self._changed()

    def _save(self) -> None:
        new = self._file.with_name(self._file.name + ".new")
        new.write_text(json.dumps({"kills": [asdict(one) for one in self.kills], "ended": self.ended}))
        new.replace(self._file)
