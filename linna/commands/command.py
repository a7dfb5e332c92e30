"""`linna command enter | list | show | release | reject | uplink | receiver`: telecommands of the ground service."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from ground_service.commanding.model import Telecommand, UplinkChannel


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    entering = actions.add_parser("enter", help="queue a telecommand")
    entering.add_argument("name", help="telecommand of the dictionary (see linna tm icd)")
    entering.add_argument("arguments", nargs="*", metavar="FIELD=VALUE")
    entering.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    entering.add_argument(
        "--timeout-s",
        type=int,
        default=600,
        help="time limit for its completion report, in seconds (default: 600)",
    )
    entering.set_defaults(handler=enter)
    listing = actions.add_parser("list", help="list telecommands and their states, newest first")
    listing.add_argument("--limit", type=int, default=50)
    listing.set_defaults(handler=list_all)
    showing = actions.add_parser("show", help="show a telecommand, its verification, and why it failed")
    showing.set_defaults(handler=show)
    releasing = actions.add_parser("release", help="release a queued telecommand")
    releasing.set_defaults(handler=release)
    rejecting = actions.add_parser("reject", help="remove a queued telecommand from the queue")
    rejecting.add_argument("--reason", required=True)
    rejecting.set_defaults(handler=reject)
    for action in (showing, releasing, rejecting):
        action.add_argument("command_id", type=int, metavar="ID")
    taking = actions.add_parser(
        "uplink",
        help="take the released telecommands and write or send them; they count as sent from then on",
    )
    taking.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    taking.add_argument("--format", choices=("cltu", "packets"), default="cltu")
    taking.add_argument("--out", type=Path, metavar="FILE", help="file for the octets")
    taking.add_argument("--tcp", metavar="HOST:PORT", help="TCP address to send the octets to")
    taking.set_defaults(handler=uplink)
    looking = actions.add_parser(
        "receiver", help="show the state of the telecommand receiver according to the newest telemetry"
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
    with ground_client(arguments) as service:
        telecommand = service.enter_telecommand(
            arguments.name,
            arguments.spacecraft_id,
            arguments=dict(_argument(text) for text in arguments.arguments),
            instance=arguments.instance,
            timeout_s=arguments.timeout_s,
        )
    return _show(arguments, telecommand)


def list_all(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        page = service.list_telecommands().page(arguments.limit)
    rows = [_figures(one) for one in page.items]
    lines = [f"{row['id']:>6}  {row['state']:<10} {row['name']}  {row['requested_by']}" for row in rows]
    emit(arguments, {"telecommands": rows, "total": page.total}, text="\n".join(lines) or "no telecommands")
    return 0


def show(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        return _show(arguments, service.get_telecommand(arguments.command_id))


def release(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        return _show(arguments, service.release_telecommand(arguments.command_id))


def reject(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        return _show(arguments, service.reject_telecommand(arguments.command_id, arguments.reason))


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
        service = opened.enter_context(ground_client(arguments))
        taken = service.take_uplink(
            arguments.spacecraft_id, instance=arguments.instance, format=arguments.format
        )
        if file is not None:
            file.write(taken.octets)
        if link is not None:
            link.sendall(taken.octets)
    where = str(arguments.out or arguments.tcp)
    figures = {"file": where, "octets": len(taken.octets), "telecommands": list(taken.telecommands)}
    emit(
        arguments,
        figures,
        text=f"{where}: {len(taken.telecommands)} telecommands, {len(taken.octets)} octets",
    )
    return 0


def receiver(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        state = service.get_uplink_state(arguments.spacecraft_id, instance=arguments.instance)
    lines = [_channel_line(channel) for channel in state.channels]
    emit(
        arguments,
        state.model_dump(mode="json"),
        text="\n".join(lines) or "no telemetry with the state of the telecommand receiver",
    )
    return 0


def _channel_line(channel: UplinkChannel) -> str:
    flags = ("no_rf_available", "no_bit_lock", "lockout", "wait", "retransmit")
    states = ", ".join(flag.replace("_", " ") for flag in flags if getattr(channel, flag)) or "ready"
    return (
        f"channel {channel.virtual_channel}: {states}; expects frame {channel.report_value}, "
        f"expedited frames {channel.farm_b_counter} (modulo 4); received {channel.received}"
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
        raise UsageError(
            f"--tcp {address}: expected a TCP server that accepts telecommands, found {error}"
        ) from None


def _show(arguments: argparse.Namespace, telecommand: Telecommand) -> int:
    remark = f", {telecommand.remark}" if telecommand.remark else ""
    text = f"telecommand {telecommand.id} ({telecommand.name}): {telecommand.state}{remark}"
    emit(arguments, _figures(telecommand), text=text)
    return 0


def _figures(telecommand: Telecommand) -> dict[str, Any]:
    kept = {
        "id",
        "name",
        "arguments",
        "state",
        "critical",
        "timed_out",
        "requested_by",
        "decided_by",
        "remark",
    }
    return {**telecommand.model_dump(mode="json", include=kept), "reports": len(telecommand.reports)}


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
