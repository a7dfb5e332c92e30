"""`linna command …`: telecommands of the ground service, holds and notes of shifts."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._ground import add_operator_options, ground_client
from linna.commands._table import Command, Commands, CustomCommand, Option
from linna.errors import UsageError
from linna.output import emit, finish
from linna.parser import option

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.contacts.commanding.model import Handover, Telecommand, UplinkChannel, UplinkState
    from linna.parser import LinnaParser

SHOWN = {"id", "name", "arguments", "text", "state", "critical", "timed_out", "requested_by", "decided_by", "remark"}


def _enter(
    service: Client,
    name: str,
    arguments: list[str] = (),  # type: ignore[assignment]  # none
    *,
    spacecraft_id: int,
    instance: str = "flight",
    timeout_s: int = 600,
) -> Telecommand:
    values = dict(map(_argument, arguments))
    return service.enter_telecommand(name, spacecraft_id, arguments=values, instance=instance, timeout_s=timeout_s)


def _argument(text: str) -> tuple[str, object]:
    name, separator, value = text.partition("=")
    if not separator:
        raise UsageError(f"argument {text!r}: expected FIELD=VALUE")
    for kind in (int, float):
        try:
            return name, kind(value)
        except ValueError:
            continue
    return name, value


def _configure_uplink(parser: LinnaParser) -> None:
    option(parser, "--spacecraft-id N", int, required=True)
    option(parser, "--instance", str, "instance of the spacecraft", "flight")
    option(parser, "--format", ("cltu", "packets"), "", "cltu")
    option(parser, "--out FILE", Path, "file for the octets", required=True)
    add_operator_options(parser)
    finish(parser, _uplink)


def _uplink(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out
    out.parent.mkdir(parents=True, exist_ok=True)
    # The file comes first: telecommands count as sent from the moment they are taken.
    with out.open("wb") as file, ground_client(arguments) as service:
        taken = service.take_uplink(arguments.spacecraft_id, instance=arguments.instance, format=arguments.format)
        file.write(taken.octets)
    figures = {"file": str(out), "octets": len(taken.octets), "telecommands": list(taken.telecommands)}
    text = f"{out}: {len(taken.telecommands)} telecommands, {len(taken.octets)} octets"
    if not taken.octets:
        out.unlink()
        text = f"{out}: not written, no released telecommand waits"
    return emit(arguments, figures, text=text) or int(not taken.octets)


def _figures(telecommand: Telecommand) -> dict[str, Any]:
    return {**telecommand.model_dump(mode="json", include=SHOWN), "reports": len(telecommand.reports)}


def _text(telecommand: Telecommand) -> str:
    remark = f", {telecommand.remark}" if telecommand.remark else ""
    named = f", {telecommand.text}" if telecommand.text else ""
    return f"telecommand {telecommand.id} ({telecommand.name}{named}): {telecommand.state}{remark}"


def _receiver(state: UplinkState) -> str:
    lines = map(_channel, state.channels)
    return "\n".join(lines) or "no telemetry with the state of the telecommand receiver"


def _channel(channel: UplinkChannel) -> str:
    flags = ("no_rf_available", "no_bit_lock", "lockout", "wait", "retransmit")
    states = ", ".join(flag.replace("_", " ") for flag in flags if getattr(channel, flag)) or "ready"
    return (
        f"channel {channel.virtual_channel}: {states}; expects frame {channel.report_value}, "
        f"expedited frames {channel.farm_b_counter} (modulo 4); received {channel.received}"
    )


def _handover(one: Handover) -> str:
    hold = f"on hold by {one.held_by} since {one.held}: {one.hold_reason}" if one.held_by else "not on hold"
    return f"spacecraft {one.spacecraft_id} ({one.instance}): {hold}; {one.note or 'no note'}"


COMMAND: Commands = {
    "enter": Command(
        _enter,
        "queue a telecommand",
        _text,
        figures=_figures,
        options={
            "name": Option("telecommand of the dictionary (see linna tm icd)", "name"),
            "arguments": Option(metavar="FIELD=VALUE"),
            "timeout_s": "time limit for its completion report, in seconds",
        },
        positional=["arguments"],
    ),
    "list": Command(
        "list_telecommands",
        "list telecommands and their states, newest first",
        lambda one: f"{one.id:>6}  {one.state:<10} {one.name}  {one.requested_by}  {one.text}",
        "telecommands",
        "no telecommands",
        _figures,
        options={"state": "only telecommands in this stored state"},
    ),
    "show": Command(
        "get_telecommand", "show a telecommand, its verification, and why it failed", _text, figures=_figures
    ),
    "release": Command("release_telecommand", "release a queued telecommand", _text, figures=_figures),
    "reject": Command("reject_telecommand", "remove a queued telecommand from the queue", _text, figures=_figures),
    "hold": Command(
        "hold_spacecraft",
        "stop release and transmission of telecommands of a spacecraft at once",
        lambda one: f"spacecraft {one.spacecraft_id} ({one.instance}): on hold by {one.held_by} since {one.held}",
        options={"reason": "why, for the other operators"},
    ),
    "resume": Command("resume_spacecraft", "end the hold of a spacecraft", _handover),
    "note": Command(
        "change_handover", "write the note for the next shift", _handover, options={"note": "replaces the one before"}
    ),
    "handovers": Command(
        "list_handovers", "list notes of the last shift and holds", _handover, "handovers", "no notes, no holds"
    ),
    "uplink": CustomCommand(
        "take the released telecommands and write them to a file; they count as sent from then on", _configure_uplink
    ),
    "receiver": Command(
        "get_uplink_state", "show the state of the telecommand receiver according to the newest telemetry", _receiver
    ),
}
