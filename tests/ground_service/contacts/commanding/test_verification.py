"""The fate of a telecommand for every set of reports that can come down about it (ECSS-E-ST-70-41C, service 1)."""

from __future__ import annotations

from itertools import combinations

import pytest

from ground_service.contacts.commanding.core import (
    FAILURES,
    STAGES,
    SentCommand,
    VerificationReport,
    fate_of,
)

REQUEST = 0x18A0C005
SENT_NS, TIMEOUT_NS = 5_000, 600
COMMAND = SentCommand(REQUEST, SENT_NS, 100, 200, TIMEOUT_NS)


def report(
    subtype: int, ticks: int = 150, request: int = REQUEST, step: int | None = None
) -> VerificationReport:
    return VerificationReport(subtype, request, ticks, step, None)


def test_the_subtypes_are_those_of_the_standard() -> None:
    assert STAGES == {
        1: "accepted", 2: "not accepted", 3: "started", 4: "not started", 5: "progress", 6: "progress failed",
        7: "completed", 8: "not completed", 10: "not routed",
    }  # fmt: skip
    assert FAILURES == (2, 4, 6, 8, 10)


def test_every_set_of_reports_has_the_state_of_its_worst_or_furthest_one() -> None:
    for count in range(len(STAGES) + 1):
        for subtypes in combinations(STAGES, count):
            seen = set(subtypes)
            if seen & {2, 4, 6, 8, 10}:
                expected = "failed"
            elif 7 in seen:
                expected = "completed"
            elif 3 in seen or 5 in seen:
                expected = "started"
            else:
                expected = "accepted" if 1 in seen else "sent"
            found = fate_of(COMMAND, [report(subtype) for subtype in subtypes], SENT_NS + TIMEOUT_NS + 1)
            assert found.state == expected, subtypes
            assert found.timed_out is (expected not in ("failed", "completed")), subtypes


@pytest.mark.parametrize(
    ("now_ns", "overdue"), [(SENT_NS + TIMEOUT_NS, False), (SENT_NS + TIMEOUT_NS + 1, True)]
)
def test_a_command_is_overdue_after_its_time_out_and_not_at_it(now_ns: int, overdue: bool) -> None:
    assert fate_of(COMMAND, [], now_ns).timed_out is overdue


@pytest.mark.parametrize(("ticks", "counts"), [(100, False), (101, True), (200, True), (201, False)])
def test_reports_made_between_sending_and_sending_again_count(ticks: int, counts: bool) -> None:
    assert (fate_of(COMMAND, [report(7, ticks)], 0).state == "completed") is counts
    assert (fate_of(COMMAND, [report(7, ticks)], 0).reports == (report(7, ticks),)) is counts


def test_a_command_that_was_not_sent_again_has_no_last_report() -> None:
    once = SentCommand(REQUEST, SENT_NS, 100, None, TIMEOUT_NS)
    assert fate_of(once, [report(7, 10**12)], 0).state == "completed"


def test_reports_of_other_requests_do_not_count() -> None:
    assert fate_of(COMMAND, [report(7, request=REQUEST + 1)], 0).reports == ()


def test_reports_are_in_order_of_time_stage_and_step() -> None:
    ordered = [
        report(1, 110),
        report(3, 110),
        report(5, 120),
        report(5, 120, step=1),
        report(5, 120, step=2),
        report(7, 130),
    ]
    assert fate_of(COMMAND, ordered[::-1], 0).reports == tuple(ordered)
