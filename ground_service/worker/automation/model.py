"""Entities of the automation: rules in force, and recorded actions with their causes."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from ground_service.http.model import Entity, Paging
from ground_service.http.times import UtcTime

ActionState = Literal["waiting", "queued", "done", "failed", "refused", "skipped"]

OPEN_STATES: tuple[ActionState, ...] = ("waiting", "queued")


class RuleInForce(Entity):
    """A rule that applies to a spacecraft now."""

    spacecraft_id: int | None = Field(description="Null: spacecraft without a mission description")
    mission: str | None
    default: bool = Field(
        description="Whether it is a default rule, which the mission description does not state"
    )
    name: str = Field(examples=["report of a complete window"])
    on: str = Field(description="Event", examples=["window ended"])
    when: dict[str, Any] = Field(description="Conditions")
    do: list[str] = Field(description="Actions in their order", examples=[["align", "report"]])
    approval: bool = Field(description="Whether the actions wait for approval")
    notify: list[str] = Field(description="Channels of notifications")


class AutomationAction(Entity):
    """An action of a rule, its cause and its result."""

    id: int
    event: int = Field(description="Number of the event that caused it")
    trigger: str = Field(examples=["window ended"])
    rule: str = Field(examples=["report of a complete window"])
    position: int = Field(description="Place of the action in its rule, from 0")
    action: str = Field(examples=["report"])
    subject: str = Field(examples=["pass 3"])
    vehicle_id: int | None
    pass_id: int | None
    window_id: int | None
    mission_id: int | None = Field(description="Revision of the mission description that states the rule")
    text: str = Field(description="The event in words", examples=["window 4 (mare) downlinked"])
    state: ActionState = Field(
        description="waiting: for approval; queued; done; failed; refused; skipped: after an action that failed"
    )
    result: dict[str, Any] | None = Field(description="What the action has produced or changed")
    error: str | None = Field(description="Reason of the last failed attempt, or why it was skipped")
    attempts: int = Field(description="Number of failed attempts")
    next_attempt: UtcTime | None = Field(description="Earliest time of the next attempt after a failed one")
    decided_by: str | None = Field(description="Person who approved or refused it")
    created: UtcTime
    changed: UtcTime


class ActionFilter(Paging):
    """Actions to list."""

    state: ActionState | None = None
    pass_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
