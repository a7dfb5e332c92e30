"""The time-tagged schedule (PUS service 11): telecommands that wait for their on-board time."""

from collections.abc import Iterable
from dataclasses import dataclass, field

MOST_ACTIVITIES = 64


@dataclass(frozen=True, slots=True, order=True)
class Activity:
    """A telecommand packet and when it is to be released; `request_id` is its first four octets."""

    release_ticks: int
    packet: bytes

    @property
    def request_id(self) -> int:
        return int.from_bytes(self.packet[:4], "big")


@dataclass(slots=True)
class Schedule:
    """Activities by release time; released only while enabled."""

    enabled: bool = True
    activities: list[Activity] = field(default_factory=list)

    @property
    def full(self) -> bool:
        return len(self.activities) >= MOST_ACTIVITIES

    def insert(self, activity: Activity) -> None:
        self.activities.append(activity)
        self.activities.sort()

    def delete(self, request_id: int) -> bool:
        """Take an activity out; False where there is no such one."""
        kept = [activity for activity in self.activities if activity.request_id != request_id]
        found = len(kept) < len(self.activities)
        self.activities = kept
        return found

    def due(self, ticks: int) -> list[Activity]:
        """Take out the activities whose time has come, the earliest first."""
        if not self.enabled:
            return []
        ready = [activity for activity in self.activities if activity.release_ticks <= ticks]
        self.activities = self.activities[len(ready) :]
        return ready

    def to_plain(self) -> list[list[int | str]]:
        """The activities as numbers and texts, for non-volatile memory."""
        return [[activity.release_ticks, activity.packet.hex()] for activity in self.activities]

    def restore(self, plain: Iterable[Iterable[int | str]]) -> None:
        """Take the activities that `to_plain` gave."""
        self.activities = sorted(Activity(int(ticks), bytes.fromhex(str(octets))) for ticks, octets in plain)
