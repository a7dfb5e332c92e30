"""`linna audit list | head`: the audit log of the ground service."""

from __future__ import annotations

import argparse

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="list the entries, newest first")
    listing.add_argument("--actor", metavar="NAME", help="only entries of this user")
    listing.add_argument("--action", metavar="TEXT", help="only actions that contain this text")
    listing.add_argument("--target", metavar="TEXT", help="only entries with this target")
    listing.add_argument("--since", metavar="UTC", help="from this time on (RFC 3339)")
    listing.add_argument("--until", metavar="UTC", help="before this time (RFC 3339)")
    listing.add_argument(
        "--limit", type=int, default=50, metavar="N", help="largest number of entries (default: 50)"
    )
    listing.set_defaults(handler=list_entries)
    head = actions.add_parser("head", help="show number and hash of the newest entry, to be stored elsewhere")
    head.set_defaults(handler=show_head)
    for action in (listing, head):
        add_operator_options(action)
        add_json_flag(action)


def list_entries(arguments: argparse.Namespace) -> int:
    chosen = {
        name: getattr(arguments, name)
        for name in ("actor", "action", "target", "since", "until")
        if getattr(arguments, name) is not None
    }
    with ground_client(arguments) as service:
        page = service.list_audit(**chosen).page(arguments.limit)
    lines = [
        f"{one.number:>6}  {str(one.time)[:19]}Z  {one.actor:<12} {one.action} {one.target}"
        for one in page.items
    ]
    entries = [one.model_dump(mode="json") for one in page.items]
    emit(arguments, {"entries": entries, "total": page.total}, text="\n".join(lines) or "no entries")
    return 0


def show_head(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        head = service.get_audit_head()
    emit(arguments, head.model_dump(mode="json"), text=f"{head.number}:{head.sha256}")
    return 0
