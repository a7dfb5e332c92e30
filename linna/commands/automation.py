"""`linna automation rules | list | approve | refuse | repeat`: rules of the mission descriptions and their actions."""

from __future__ import annotations

import argparse
from typing import Any

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    rules = actions.add_parser("rules", help="list the rules in force")
    rules.set_defaults(handler=list_rules)
    listing = actions.add_parser("list", help="list the actions with their causes and results, newest first")
    listing.add_argument(
        "--state",
        metavar="STATE",
        help="only actions in this state, such as waiting (for approval) or failed",
    )
    listing.add_argument("--pass", dest="pass_id", type=int, metavar="ID", help="only actions on this pass")
    listing.add_argument(
        "--limit", type=int, default=50, metavar="N", help="largest number of actions (default: 50)"
    )
    listing.set_defaults(handler=list_actions)
    approving = actions.add_parser("approve", help="approve an action that waits for approval")
    refusing = actions.add_parser("refuse", help="refuse an action that waits for approval")
    repeating = actions.add_parser(
        "repeat", help="do a failed action again, and those of its rule that were skipped after it"
    )
    for action, decision in ((approving, "approve"), (refusing, "refuse"), (repeating, "repeat")):
        action.add_argument("action_id", type=int, metavar="ID")
        action.set_defaults(handler=decide, decision=decision)
    for action in (rules, listing, approving, refusing, repeating):
        add_operator_options(action)
        add_json_flag(action)


def list_rules(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        rules = list(service.list_automation_rules())
    lines = [
        f"{_owner(one)}: {one.name}: on {one.on}{_conditions(one.when)} do {', '.join(one.do)}"
        + (" after approval" if one.approval else "")
        + (" (default)" if one.default else "")
        for one in rules
    ]
    figures = {"rules": [one.model_dump(mode="json") for one in rules]}
    emit(arguments, figures, text="\n".join(lines))
    return 0


def list_actions(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        listing = service.list_automation_actions(state=arguments.state, pass_id=arguments.pass_id)
        page = listing.page(arguments.limit)
    figures = {"actions": [one.model_dump(mode="json") for one in page.items], "total": page.total}
    emit(arguments, figures, text="\n".join(_line(one) for one in page.items) or "no actions")
    return 0


def decide(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        decided = {
            "approve": service.approve_automation_action,
            "refuse": service.refuse_automation_action,
            "repeat": service.repeat_automation_action,
        }[arguments.decision](arguments.action_id)
    emit(arguments, decided.model_dump(mode="json"), text=_line(decided))
    return 0


def _owner(rule: Any) -> str:
    return "all other spacecraft" if rule.spacecraft_id is None else f"spacecraft {rule.spacecraft_id}"


def _conditions(when: dict[str, Any]) -> str:
    stated = [
        f"{name} {' or '.join(value) if isinstance(value, list) else value}" for name, value in when.items()
    ]
    return f" if {' and '.join(stated)}" if stated else ""


def _line(action: Any) -> str:
    subject = f" {action.subject}" if action.subject else ""
    ending = f": {action.error}" if action.error else ""
    return (
        f"{action.id:>6}  {str(action.created)[:19]}Z  {action.state:<8} {action.action}{subject}  "
        f"({action.rule}; event {action.event}: {action.text}){ending}"
    )
