"""Matching of events with automation rules."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ground_service.missions.rules import PASS_ACTIONS, Conditions, Rule


@dataclass(frozen=True, slots=True)
class Occurrence:
    """An event as rules see it: the trigger, its subject, and the values of conditions; None if not known.

    Attributes
    ----------
    of_contact
        Whether this is a window whose telemetry a contact has delivered. Of a rule on the end of a contact, the actions
        on passes follow for each such window, and the other actions once for the contact.
    """

    trigger: str
    vehicle_id: int | None = None
    pass_id: int | None = None
    window_id: int | None = None
    of_contact: bool = False
    window_state: str | None = None
    verdict: str | None = None
    requirement_failed: bool | None = None
    reevaluation: bool | None = None
    frames: int | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class PlannedAction:
    """Action of a rule that follows an occurrence; `position` is its place in the rule."""

    rule: Rule
    position: int
    action: str
    occurrence: Occurrence


def fulfils(conditions: Conditions, occurrence: Occurrence) -> bool:
    """Return whether an occurrence fulfils all stated conditions; an unknown value fulfils none."""
    for name in conditions.stated:
        wanted = getattr(conditions, name)
        if name == "min_frames":
            if occurrence.frames is None or occurrence.frames < wanted:
                return False
            continue
        found = getattr(occurrence, name)
        if found is None or (found not in wanted if isinstance(wanted, tuple) else found != wanted):
            return False
    return True


def planned_actions(rules: Sequence[Rule], occurrences: Sequence[Occurrence]) -> Iterator[PlannedAction]:
    """Yield the actions that follow the occurrences of one event, in the order of the rules."""
    for rule in rules:
        for occurrence in occurrences:
            if rule.on != occurrence.trigger:
                continue
            as_whole = rule.on == "contact ended" and not occurrence.of_contact
            if not as_whole and not fulfils(rule.when, occurrence):
                continue
            for position, action in enumerate(rule.do):
                on_pass = action in PASS_ACTIONS
                if on_pass and occurrence.pass_id is None:
                    continue
                if rule.on == "contact ended" and on_pass != occurrence.of_contact:
                    continue
                yield PlannedAction(rule, position, action, occurrence)
