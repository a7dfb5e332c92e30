"""`linna automation rules | list | approve | refuse | repeat`: rules of the mission descriptions and their actions."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from linna.commands._table import Command, Option, add_commands

if TYPE_CHECKING:
    from ground_service.worker.automation.model import AutomationAction, RuleInForce


def _rule(rule: RuleInForce) -> str:
    owner = "all other spacecraft" if rule.spacecraft_id is None else f"spacecraft {rule.spacecraft_id}"
    approval = " after approval" if rule.approval else ""
    default = " (default)" if rule.default else ""
    return f"{owner}: {rule.name}: on {rule.on}{_conditions(rule.when)} do {', '.join(rule.do)}{approval}{default}"


def _conditions(when: dict[str, Any]) -> str:
    stated = [
        f"{name} {' or '.join(value) if isinstance(value, list) else value}" for name, value in when.items()
    ]
    return f" if {' and '.join(stated)}" if stated else ""


def _action(action: AutomationAction) -> str:
    subject = f" {action.subject}" if action.subject else ""
    ending = f": {action.error}" if action.error else ""
    return (
        f"{action.id:>6}  {action.created[:19]}Z  {action.state:<8} {action.action}{subject}  "
        f"({action.rule}; event {action.event}: {action.text}){ending}"
    )


COMMANDS = {
    "rules": Command("list_automation_rules", "list the rules in force", _rule, "rules"),
    "list": Command(
        "list_automation_actions",
        "list the actions with their causes and results, newest first",
        _action,
        "actions",
        "no actions",
        options={
            "state": "only actions in this state; waiting: for approval",
            "pass_id": Option("only actions on this pass", "ID", "--pass"),
        },
    ),
    "approve": Command("approve_automation_action", "approve an action that waits for approval", _action),
    "refuse": Command("refuse_automation_action", "refuse an action that waits for approval", _action),
    "repeat": Command(
        "repeat_automation_action",
        "do a failed action again, and those of its rule that were skipped after it",
        _action,
    ),
}


def configure(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, COMMANDS)
