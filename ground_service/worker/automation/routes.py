"""HTTP operations on automation rules and recorded actions."""

from __future__ import annotations

from ground_service.access.security import Operator, Viewer, add_list
from ground_service.http.common import GroundOf, RowId
from ground_service.http.model import PageOf
from ground_service.http.requests import operations, problems
from ground_service.worker.automation import service, store
from ground_service.worker.automation.model import AutomationAction, RuleInForce

automation = operations("automation")


@automation.get("/automation/rules")
def list_automation_rules(ground: GroundOf, caller: Viewer) -> PageOf[RuleInForce]:
    """List the rules in force by spacecraft, and the default rules of spacecraft without a mission description."""
    return PageOf.all_of(caller.own(service.list_rules(ground)))


add_list(automation, "/automation/actions", store.list_automation_actions)


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
    """Queue a failed action again for three attempts, and those of its rule that were skipped after it.

    An action that is queued already stays as it is.
    """
    return service.repeat(ground, action_id, actor=caller.name)
