"""Which actions follow an event."""

from __future__ import annotations

import pytest

from ground_service.missions.rules import DEFAULT_RULES, Conditions, Rule
from ground_service.worker.automation.core import Occurrence, fulfils, planned_actions


@pytest.mark.parametrize(
    ("conditions", "occurrence", "expected"),
    [
        (Conditions(), Occurrence("alarm"), True),
        (Conditions(window_state=("failed",)), Occurrence("window ended", window_state="failed"), True),
        (Conditions(window_state=("failed",)), Occurrence("window ended", window_state="executed"), False),
        (Conditions(window_state=("failed",)), Occurrence("window ended"), False),
        (Conditions(min_frames=3), Occurrence("report done", frames=3), True),
        (Conditions(min_frames=3), Occurrence("report done", frames=2), False),
        (Conditions(min_frames=3), Occurrence("report done"), False),
        (Conditions(reevaluation=False), Occurrence("report done", reevaluation=False), True),
        (Conditions(reevaluation=False), Occurrence("report done", reevaluation=True), False),
        (Conditions(requirement_failed=True), Occurrence("report done"), False),
        (
            Conditions(verdict=("not met",), requirement_failed=True),
            Occurrence("report done", verdict="not met", requirement_failed=False),
            False,
        ),
    ],
)
def test_all_conditions_must_hold_and_unknown_values_fulfil_none(
    conditions: Conditions, occurrence: Occurrence, expected: bool
) -> None:
    assert fulfils(conditions, occurrence) is expected


def named(rules: tuple[Rule, ...], *occurrences: Occurrence) -> list[tuple[str, str, int | None]]:
    return [
        (one.rule.name, one.action, one.occurrence.pass_id) for one in planned_actions(rules, occurrences)
    ]


def test_actions_follow_in_the_order_of_their_rule() -> None:
    ended = Occurrence("window ended", 1, pass_id=7, window_state="downlinked")
    assert named(DEFAULT_RULES, ended) == [
        ("report of a complete window", "align", 7),
        ("report of a complete window", "report", 7),
    ]
    assert [one.position for one in planned_actions(DEFAULT_RULES, [ended])] == [0, 1]


def test_a_window_without_telemetry_has_no_pass_to_act_on() -> None:
    rule = Rule(name="r", on="window ended", do=("report", "compute_trends"))
    assert named((rule,), Occurrence("window ended", 1, window_state="failed")) == [
        ("r", "compute_trends", None)
    ]


def test_a_contact_acts_on_each_delivered_window_and_once_for_itself() -> None:
    rule = Rule(
        name="r",
        on="contact ended",
        when=Conditions(window_state=("executed",)),
        do=("report", "compute_trends"),
    )
    contact = Occurrence("contact ended", 1)
    windows = [
        Occurrence("contact ended", 1, pass_id=key, of_contact=True, window_state=state)
        for key, state in ((3, "executed"), (4, "downlinked"), (5, "executed"))
    ]
    assert named((rule,), contact, *windows) == [
        ("r", "compute_trends", None),
        ("r", "report", 3),
        ("r", "report", 5),
    ]
