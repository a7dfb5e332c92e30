"""`linna audit list | head`: the audit log of the ground service."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from linna.commands._table import Command, Option, add_commands

if TYPE_CHECKING:
    from ground_service.access.model import AuditEntry


def _line(one: AuditEntry) -> str:
    text = one.detail.get("text", "")
    return f"{one.number:>6}  {one.time[:19]}Z  {one.actor:<12} {one.action} {one.target} {text}".rstrip()


COMMANDS = {
    "list": Command(
        "list_audit",
        "list the entries, newest first",
        _line,
        "entries",
        "no entries",
        options={
            "actor": Option("only entries of this user", "NAME"),
            "action": "only actions that contain this text",
            "target": "only entries with this target",
        },
    ),
    "head": Command(
        "get_audit_head",
        "show number and hash of the newest entry, to be stored elsewhere",
        lambda head: f"{head.number}:{head.sha256}",
    ),
}


def configure(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, COMMANDS)
