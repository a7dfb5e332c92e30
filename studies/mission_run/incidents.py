"""Incidents of a mission run and their recovery, from the archive of the ground."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from ground_service.events import (
    ContactMissed,
    ContactStarted,
    FollowUpFailed,
    LinkChanged,
    PlanChanged,
    WindowChanged,
)
from ground_service.planning.model import Window
from ground_service.store.events import LoggedEvent, read_events
from lunar.timescales import format_utc
from studies.mission_run.ground import MissionGround

LIMIT = 1_000_000
KINDS = frozenset(
    one.event_kind
    for one in (ContactMissed, ContactStarted, FollowUpFailed, LinkChanged, PlanChanged, WindowChanged)
)
DOWN = ("waiting", "failed")


def find_incidents(ground: MissionGround, windows: Sequence[Window]) -> list[dict[str, Any]]:
    """Return what went wrong with its recovery (None: none), in order of time.

    Times of links and of failed work are those of the wall clock, others are mission time.
    """
    with ground.ground.database.reading() as connection:
        events = read_events(connection, 0, LIMIT, KINDS)
    found = [
        *_failed_windows(windows, events),
        *_missed_contacts(events),
        *_link_drops(events),
        *_failed_work(ground, events),
        *(
            _incident(
                str(one.first),
                "alarm",
                f"{one.name} ({one.severity}), {one.count} packets",
                None if one.cleared is None and one.active else "its condition has ended",
            )
            for one in ground.client.list_alarms()
        ),
    ]
    return sorted(found, key=lambda one: str(one["utc"]))


def _incident(utc: str, kind: str, text: str, recovery: str | None) -> dict[str, Any]:
    return {"utc": utc, "kind": kind, "text": text, "recovery": recovery}


def _failed_windows(windows: Sequence[Window], events: Sequence[LoggedEvent]) -> Iterable[dict[str, Any]]:
    """Yield the windows that have failed, also those that telemetry has shown as flown afterwards."""
    plans = [PlanChanged.of(one) for one in events if one.kind == PlanChanged.event_kind]
    changes = [WindowChanged.of(one) for one in events if one.kind == WindowChanged.event_kind]
    ever_failed = {one.id for one in changes if one.state == "failed"}
    for window in windows:
        is_failed = window.state == "failed"
        if not is_failed and window.id not in ever_failed:
            continue
        after = next((one for one in plans if window.id in one.windows_failed), None)
        recovered = []
        if after is not None:
            recovered.append(f"planned instead: {', '.join(f'window {key}' for key in after.windows_added)}")
        if not is_failed:
            recovered.append(f"{window.state} by later telemetry")
        why = window.reason or "unknown" if is_failed else "concluded before all its telemetry was there"
        yield _incident(
            str(window.start), "window failed", f"window {window.id}: {why}", "; ".join(recovered) or None
        )


def _missed_contacts(events: Sequence[LoggedEvent]) -> Iterable[dict[str, Any]]:
    started = [ContactStarted.of(one) for one in events if one.kind == ContactStarted.event_kind]
    for logged in events:
        if logged.kind != ContactMissed.event_kind:
            continue
        missed = ContactMissed.of(logged)
        following = next((one for one in started if one.start_utc_ns >= missed.stop_utc_ns), None)
        yield _incident(
            format_utc(missed.start_utc_ns),
            "contact missed",
            f"{missed.station}: {missed.reason}",
            None
            if following is None
            else f"contact with {following.station} at {format_utc(following.start_utc_ns)}",
        )


def _link_drops(events: Sequence[LoggedEvent]) -> Iterable[dict[str, Any]]:
    """Yield the losses of links that were connected before."""
    up: set[str] = set()
    down: dict[str, tuple[LoggedEvent, LinkChanged]] = {}
    for logged in events:
        if logged.kind != LinkChanged.event_kind:
            continue
        event = LinkChanged.of(logged)
        if event.state not in DOWN:
            up.add(event.link)
            if event.link in down:
                first, lost = down.pop(event.link)
                yield _dropped(
                    first, lost, f"{event.state} after {(logged.utc_ns - first.utc_ns) / 1e9:.1f} s"
                )
        elif event.link in up and event.link not in down:
            down[event.link] = (logged, event)
    yield from (_dropped(first, lost, None) for first, lost in down.values())


def _dropped(logged: LoggedEvent, event: LinkChanged, recovery: str | None) -> dict[str, Any]:
    return _incident(
        format_utc(logged.utc_ns), "link", f"{event.link}: {event.reason or event.state}", recovery
    )


def _failed_work(ground: MissionGround, events: Sequence[LoggedEvent]) -> Iterable[dict[str, Any]]:
    for logged in events:
        if logged.kind == FollowUpFailed.event_kind:
            failed = FollowUpFailed.of(logged)
            yield _incident(format_utc(logged.utc_ns), "work failed", f"{failed.work}: {failed.error}", None)
    for action in ground.client.list_automation_actions(state="failed"):
        text = f"{action.action} of {action.subject}: {action.error}"
        yield _incident(str(action.changed), "action failed", text, None)
    for job in ground.client.list_jobs():
        if job.state == "failed":
            yield _incident(str(job.created), "job failed", f"{job.kind}: {job.error}", None)
