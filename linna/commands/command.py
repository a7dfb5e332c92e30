"""`linna command enter | list | show | release | reject | uplink`: telecommands of the ground service."""

from __future__ import annotations

import argparse
import getpass
from pathlib import Path
from typing import Any

from linna.commands._ground import add_service_options, open_service
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    entering = actions.add_parser("enter", help="queue a telecommand")
    entering.add_argument("name", help="telecommand of the dictionary (see linna tm icd)")
    entering.add_argument("arguments", nargs="*", metavar="FIELD=VALUE")
    entering.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    entering.add_argument(
        "--timeout-s", type=int, default=600, help="time in which its end is expected (default: 600)"
    )
    entering.set_defaults(handler=enter)
    listing = actions.add_parser("list", help="telecommands and their state, the newest first")
    listing.add_argument("--limit", type=int, default=50)
    listing.set_defaults(handler=list_all)
    showing = actions.add_parser("show", help="one telecommand and the reports about it")
    showing.set_defaults(handler=show)
    releasing = actions.add_parser("release", help="release a queued telecommand")
    releasing.set_defaults(handler=release)
    rejecting = actions.add_parser("reject", help="take a queued telecommand out of the queue")
    rejecting.add_argument("--reason", required=True)
    rejecting.set_defaults(handler=reject)
    for action in (showing, releasing, rejecting):
        action.add_argument("command_id", type=int, metavar="ID")
    taking = actions.add_parser("uplink", help="write what is to be sent now; it counts as sent from then on")
    taking.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    taking.add_argument("--format", choices=("cltu", "packets"), default="cltu")
    taking.add_argument("--out", type=Path, required=True, metavar="FILE")
    taking.set_defaults(handler=uplink)
    for action in (entering, taking):
        action.add_argument(
            "--instance", default="flight", help="instance of the spacecraft (default: flight)"
        )
    for action in (entering, listing, showing, releasing, rejecting, taking):
        action.add_argument(
            "--as", dest="actor", default=None, metavar="NAME", help="who does it (default: you)"
        )
        add_service_options(action)
        add_json_flag(action)


def enter(arguments: argparse.Namespace) -> int:
    from ground_service.services.commanding import enter_command

    with open_service(arguments) as ground:
        command_id = enter_command(
            ground,
            arguments.name,
            dict(_argument(text) for text in arguments.arguments),
            spacecraft_id=arguments.spacecraft_id,
            instance=arguments.instance,
            timeout_s=arguments.timeout_s,
            actor=_actor(arguments),
        )
    return _show(arguments, command_id)


def list_all(arguments: argparse.Namespace) -> int:
    from ground_service.services.commanding import list_commands

    with open_service(arguments) as ground:
        views, total = list_commands(ground, limit=max(arguments.limit, 1))
    rows = [_figures(view) for view in views]
    lines = [f"{row['id']:>6}  {row['state']:<10} {row['name']}  {row['requested_by']}" for row in rows]
    emit(arguments, {"telecommands": rows, "total": total}, text="\n".join(lines) or "no telecommands")
    return 0


def show(arguments: argparse.Namespace) -> int:
    return _show(arguments, arguments.command_id)


def release(arguments: argparse.Namespace) -> int:
    from ground_service.services.commanding import release_command

    with open_service(arguments) as ground:
        release_command(ground, arguments.command_id, actor=_actor(arguments))
    return _show(arguments, arguments.command_id)


def reject(arguments: argparse.Namespace) -> int:
    from ground_service.services.commanding import reject_command

    with open_service(arguments) as ground:
        reject_command(ground, arguments.command_id, actor=_actor(arguments), reason=arguments.reason)
    return _show(arguments, arguments.command_id)


def uplink(arguments: argparse.Namespace) -> int:
    from ground_service.services.commanding import take_uplink

    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with open_service(arguments) as ground, arguments.out.open("wb") as file:
        stream, ids = take_uplink(
            ground,
            spacecraft_id=arguments.spacecraft_id,
            instance=arguments.instance,
            framed=arguments.format == "cltu",
            actor=_actor(arguments),
        )
        file.write(stream)
    figures = {"file": str(arguments.out), "octets": len(stream), "telecommands": ids}
    emit(arguments, figures, text=f"{arguments.out}: {len(ids)} telecommands, {len(stream)} octets")
    return 0


def _show(arguments: argparse.Namespace, command_id: int) -> int:
    from ground_service.services.commanding import get_command

    with open_service(arguments) as ground:
        figures = _figures(get_command(ground, command_id))
    emit(arguments, figures, text=f"telecommand {command_id} ({figures['name']}): {figures['state']}")
    return 0


def _figures(view: Any) -> dict[str, Any]:
    row, fate = view.row, view.fate
    return {
        "id": row["id"],
        "name": row["name"],
        "arguments": row["arguments"],
        "state": view.state,
        "critical": bool(row["critical"]),
        "timed_out": fate is not None and fate.timed_out,
        "requested_by": row["requested_by"],
        "decided_by": row["decided_by"],
        "reports": len(fate.reports) if fate is not None else 0,
    }


def _argument(text: str) -> tuple[str, object]:
    from linna.errors import UsageError

    name, separator, value = text.partition("=")
    if not separator:
        raise UsageError(f"argument {text!r}: expected FIELD=VALUE")
    for kind in (int, float):
        try:
            return name, kind(value)
        except ValueError:
            continue
    return name, value


def _actor(arguments: argparse.Namespace) -> str:
    return str(arguments.actor or getpass.getuser())
