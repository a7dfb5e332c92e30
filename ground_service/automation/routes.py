"""HTTP operations on automation rules and recorded actions."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query

from ground_service.access.security import Operator, Viewer
from ground_service.automation import service
from ground_service.automation.model import ActionState, AutomationAction, RuleInForce
from ground_service.http.common import GroundOf, PagingOf, RowId
from ground_service.http.model import PageOf
from ground_service.http.requests import operations, problems

automation = operations("automation")


@automation.get("/automation/rules")
def list_automation_rules(ground: GroundOf, _: Viewer) -> PageOf[RuleInForce]:
    """List the rules in force by spacecraft, and the default rules of spacecraft that have no mission description."""
    return PageOf.all_of(service.list_rules(ground))


@automation.get("/automation/actions")
def list_automation_actions(
    ground: GroundOf,
    _: Viewer,
    paging: PagingOf,
    state: Annotated[ActionState | None, Query()] = None,
    pass_id: Annotated[int | None, Query(ge=1, le=2**31 - 1)] = None,
) -> PageOf[AutomationAction]:
    """List the actions of rules with their causes and results, newest first."""
    items, total = service.list_actions(
        ground, state=state, pass_id=pass_id, limit=paging.limit, offset=paging.offset
    )
    return paging.page(items, total)


@automation.post("/automation/actions/{action_id}/approve", responses=problems(404, 409))
def approve_automation_action(ground: GroundOf, caller: Operator, action_id: RowId) -> AutomationAction:
    """Approve an action that waits for approval, and those after it in its rule; they are done then."""
    return service.decide(ground, action_id, approve=True, actor=caller.name)


@automation.post("/automation/actions/{action_id}/refuse", responses=problems(404, 409))
def refuse_automation_action(ground: GroundOf, caller: Operator, action_id: RowId) -> AutomationAction:
    """Refuse an action that waits for approval, and those after it in its rule."""
    return service.decide(ground, action_id, approve=False, actor=caller.name)


@automation.post("/automation/actions/{action_id}/repeat", responses=problems(404, 409))
def repeat_automation_action(ground: GroundOf, caller: Operator, action_id: RowId) -> AutomationAction:
    """Queue a failed action again, and those of its rule that were skipped after it; it has three attempts again.

    An action that is queued already stays as it is.
    """
    return service.repeat(ground, action_id, actor=caller.name)
