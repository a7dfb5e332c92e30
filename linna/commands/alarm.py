"""`linna alarm list | show | acknowledge | shelve`: alarms of the spacecraft."""

from __future__ import annotations

import argparse

from ground_service.alarms.model import Alarm, AlarmDetail
from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit

STATES = ("raised", "acknowledged", "shelved", "cleared")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="list alarms, open ones first")
    listing.add_argument(
        "--state", action="append", choices=STATES, help="only alarms in this state; can be repeated"
    )
    listing.add_argument("--severity", choices=("warning", "alarm"), help="only alarms of this severity")
    listing.add_argument(
        "--limit", type=int, default=50, metavar="N", help="largest number of alarms (default: 50)"
    )
    listing.set_defaults(handler=list_alarms)
    showing = actions.add_parser("show", help="show an alarm with its history")
    showing.set_defaults(handler=show_alarm)
    acknowledging = actions.add_parser("acknowledge", help="acknowledge an alarm")
    acknowledging.set_defaults(handler=acknowledge_alarm)
    shelving = actions.add_parser("shelve", help="suppress an alarm until a time")
    shelving.add_argument(
        "--until",
        required=True,
        metavar="UTC",
        help="end of the suppression (RFC 3339); in the past: end it now",
    )
    shelving.set_defaults(handler=shelve_alarm)
    for action in (showing, acknowledging, shelving):
        action.add_argument("alarm_id", type=int, metavar="ID")
    for action in (acknowledging, shelving):
        action.add_argument("--comment", default="", metavar="TEXT", help="comment for the history")
    for action in (listing, showing, acknowledging, shelving):
        add_operator_options(action)
        add_json_flag(action)


def list_alarms(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        page = service.list_alarms(state=arguments.state, severity=arguments.severity).page(arguments.limit)
    lines = [_line(one) for one in page.items]
    alarms = [one.model_dump(mode="json") for one in page.items]
    emit(arguments, {"alarms": alarms, "total": page.total}, text="\n".join(lines) or "no alarms")
    return 0


def show_alarm(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        return _show(arguments, service.get_alarm(arguments.alarm_id))


def acknowledge_alarm(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        return _show(arguments, service.acknowledge_alarm(arguments.alarm_id, comment=arguments.comment))


def shelve_alarm(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        alarm = service.shelve_alarm(arguments.alarm_id, arguments.until, comment=arguments.comment)
    return _show(arguments, alarm)


def _show(arguments: argparse.Namespace, alarm: AlarmDetail) -> int:
    lines = [_line(alarm)]
    lines += [
        f"        {one.time[:19]}Z  {one.actor}: {one.change} {one.comment}".rstrip() for one in alarm.history
    ]
    emit(arguments, alarm.model_dump(mode="json"), text="\n".join(lines))
    return 0


def _line(alarm: Alarm) -> str:
    value = "" if alarm.value is None else f", last {alarm.value:g} {alarm.unit} (limits {alarm.limits})"
    return (
        f"{alarm.id:>6}  {alarm.last[:19]}Z  {alarm.severity:<7} {alarm.state:<12} "
        f"{alarm.name.replace('_', ' ')}, {alarm.count} packets{value}"
    )
