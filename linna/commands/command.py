"""`linna command enter | list | show | release | reject | uplink | receiver`: telecommands of the ground service."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import Any

from linna.commands._ground import add_operator_options, operations
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
    taking.add_argument("--out", type=Path, metavar="FILE", help="file to write them to")
    taking.add_argument("--tcp", metavar="HOST:PORT", help="send them there, too")
    taking.set_defaults(handler=uplink)
    looking = actions.add_parser(
        "receiver", help="state of the telecommand receiver, by the newest telemetry"
    )
    looking.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    looking.set_defaults(handler=receiver)
    for action in (entering, taking, looking):
        action.add_argument(
            "--instance", default="flight", help="instance of the spacecraft (default: flight)"
        )
    for action in (entering, listing, showing, releasing, rejecting, taking, looking):
        add_operator_options(action)
        add_json_flag(action)


def enter(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        view = service.enter_command(
            arguments.name,
            dict(_argument(text) for text in arguments.arguments),
            spacecraft_id=arguments.spacecraft_id,
            instance=arguments.instance,
            timeout_s=arguments.timeout_s,
        )
    return _show(arguments, view)


def list_all(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        page = service.list_commands(max(arguments.limit, 1))
    rows = [_figures(view) for view in page["items"]]
    lines = [f"{row['id']:>6}  {row['state']:<10} {row['name']}  {row['requested_by']}" for row in rows]
    emit(
        arguments, {"telecommands": rows, "total": page["total"]}, text="\n".join(lines) or "no telecommands"
    )
    return 0


def show(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        return _show(arguments, service.get_command(arguments.command_id))


def release(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        return _show(arguments, service.release_command(arguments.command_id))


def reject(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        return _show(arguments, service.reject_command(arguments.command_id, arguments.reason))


def uplink(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError

    if arguments.out is None and arguments.tcp is None:
        raise UsageError("uplink: expected --out FILE or --tcp HOST:PORT, found neither")
    with contextlib.ExitStack() as opened:
        # Connection and file come first: telecommands count as sent from the moment they are taken.
        link = opened.enter_context(_connection(arguments.tcp)) if arguments.tcp else None
        file = None
        if arguments.out is not None:
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            file = opened.enter_context(arguments.out.open("wb"))
        service = opened.enter_context(operations(arguments))
        stream, ids = service.take_uplink(arguments.spacecraft_id, arguments.instance, arguments.format)
        if file is not None:
            file.write(stream)
        if link is not None:
            link.sendall(stream)
    where = str(arguments.out or arguments.tcp)
    figures = {"file": where, "octets": len(stream), "telecommands": ids}
    emit(arguments, figures, text=f"{where}: {len(ids)} telecommands, {len(stream)} octets")
    return 0


def receiver(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        state = service.uplink_state(arguments.spacecraft_id, arguments.instance)
    lines = [_channel_line(channel) for channel in state["channels"]]
    emit(arguments, state, text="\n".join(lines) or "no telemetry that tells of the telecommand receiver")
    return 0


def _channel_line(channel: dict[str, Any]) -> str:
    flags = ("no_rf_available", "no_bit_lock", "lockout", "wait", "retransmit")
    said = ", ".join(flag.replace("_", " ") for flag in flags if channel[flag]) or "ready"
    return (
        f"channel {channel['virtual_channel']}: {said}; expects frame {channel['report_value']}, "
        f"expedited frames {channel['farm_b_counter']} (modulo 4); received {channel['received']}"
    )


def _connection(address: str) -> Any:
    import socket

    from linna.errors import UsageError

    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise UsageError(f"--tcp: expected HOST:PORT, found {address!r}")
    try:
        return socket.create_connection((host.strip("[]"), int(port)), timeout=10.0)
    except OSError as error:
        raise UsageError(f"--tcp {address}: expected a receiver of telecommands, found {error}") from None


def _show(arguments: argparse.Namespace, view: dict[str, Any]) -> int:
    figures = _figures(view)
    emit(arguments, figures, text=f"telecommand {figures['id']} ({figures['name']}): {figures['state']}")
    return 0


def _figures(view: dict[str, Any]) -> dict[str, Any]:
    kept = ("id", "name", "arguments", "state", "critical", "timed_out", "requested_by", "decided_by")
    return {**{name: view[name] for name in kept}, "reports": len(view["reports"])}


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
