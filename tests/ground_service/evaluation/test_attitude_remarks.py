"""Remarks of a report on the attitude, from events of the payload."""

from __future__ import annotations

from ground_service.evaluation.core import attitude_remarks
from lunar.timescales import parse_utc
from reports.values import PassEvent

START = parse_utc("2029-08-07T00:00:00Z")


def event(seconds: int, name: str, detail: str = "") -> PassEvent:
    return PassEvent(START + seconds * 10**9, "medium", name, detail)


def test_times_with_a_degraded_attitude_are_remarks() -> None:
    noise = "noise 0.2 deg per axis, declared 0.01 deg"
    events = (
        event(5, "attitude_restored"),
        event(300, "attitude_degraded", noise),
        event(30, "attitude_degraded", noise),
        event(40, "boot"),
        event(90, "attitude_restored"),
        event(95, "attitude_restored"),
    )
    text = f"on ({noise}): the payload used the estimated noise"
    assert attitude_remarks(events) == [
        f"attitude judged noisier than declared from 2029-08-07T00:00:30.000Z {text}, until 2029-08-07T00:01:30.000Z",
        f"attitude judged noisier than declared from 2029-08-07T00:05:00.000Z {text}",
    ]
    assert attitude_remarks(()) == []
