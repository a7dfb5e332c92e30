"""Incidents of a mission run: windows that have failed, also for a while."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from ground_service.events import PlanChanged, WindowChanged
from ground_service.store.events import LoggedEvent
from studies.mission_run.incidents import KINDS, find_incidents


def logged(events: list[Any]) -> list[LoggedEvent]:
    return [
        LoggedEvent(number, number, event.event_kind, event.model_dump(mode="json"))
        for number, event in enumerate(events, 1)
        if event.event_kind in KINDS
    ]


def window(key: int, state: str, reason: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(id=key, state=state, reason=reason, start=f"2029-08-20T0{key}:00:00Z")


def test_a_window_that_failed_for_a_while_is_an_incident(monkeypatch: pytest.MonkeyPatch) -> None:
    events = [
        WindowChanged(id=1, state="failed"),
        PlanChanged(request_id=1, windows_added=(3,), windows_failed=(1,)),
        WindowChanged(id=1, state="processed"),
        WindowChanged(id=2, state="failed"),
        WindowChanged(id=3, state="processed"),
    ]
    monkeypatch.setattr("studies.mission_run.incidents.read_events", lambda *_: logged(events))
    none = SimpleNamespace(list_alarms=list, list_automation_actions=lambda **_: [], list_jobs=list)
    ground: Any = SimpleNamespace(
        ground=SimpleNamespace(database=SimpleNamespace(reading=nullcontext)), client=none
    )
    windows: Any = [
        window(1, "processed"),
        window(2, "failed", "its predecessor failed"),
        window(3, "processed"),
    ]
    assert [(one["text"], one["recovery"]) for one in find_incidents(ground, windows)] == [
        (
            "window 1: concluded before all its telemetry was there",
            "planned instead: window 3; processed by later telemetry",
        ),
        ("window 2: its predecessor failed", None),
    ]
