"""Effects of the telecommands. A function returns the code of the reason why nothing was done; 0 or None: it was."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from payload_emulator.flight.onboard.commanding import Command, failure, parse_commands
from payload_emulator.flight.onboard.housekeeping import FIRST_DEFINED, MOST_DEFINED, STATE, Structure
from payload_emulator.flight.onboard.housekeeping_packets import send_large_data, send_structure
from payload_emulator.flight.onboard.loads import TABLE_NUMBERS, UNPACKERS
from payload_emulator.flight.onboard.machine import Machine
from payload_emulator.flight.onboard.modes import PayloadMode, allows, may_change
from payload_emulator.flight.onboard.schedule import Activity
from payload_emulator.flight.ports import ResetCause
from payload_emulator.flight.telemetry.packets import map_octets
from tmtc.dictionary.arguments import FUNCTION_ARGUMENTS
from tmtc.dictionary.fields import Field, find_parameter
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import TableError
from tmtc.packets.pus import TICKS_PER_SECOND

Values = Mapping[str, Any]
_FUNCTIONS = DICTIONARY.labels("perform_function", "function_id")


def name_of(command: Command) -> str:
    """Return the name of a command in the table of modes: its function if it performs one."""
    if command.name == "perform_function":
        return _FUNCTIONS.get(int(command.values["function_id"]), "")
    return command.name


def check(machine: Machine, command: Command) -> int:
    """Return whether a command could be carried out at all: it exists, and its values lie within their ranges."""
    values, name = command.values, name_of(command)
    if name not in _FUNCTION_HANDLERS and name not in _HANDLERS:
        return failure("unknown_function")
    if command.name == "perform_function":
        return 0 if _arguments_hold(name, values) else failure("value_out_of_range")
    for field in DICTIONARY.packet(command.name).fields:
        if not _is_within(field, values[field.name]):
            return failure("value_out_of_range")
    if command.name in ("set_parameter", "request_parameter"):
        parameter = find_parameter(int(values["parameter_id"]))
        if parameter is None:
            return failure("unknown_parameter")
        if command.name == "set_parameter" and not parameter.accepts(float(values["value"])):
            return failure("value_out_of_range")
    if command.name == "create_housekeeping":
        known = DICTIONARY.labels(command.name, "quantity")
        if any(int(code) not in known for code in values["items"]["quantity"]):
            return failure("value_out_of_range")
    return _check_activity(machine, values) if command.name == "insert_activity" else 0


def execute(machine: Machine, command: Command) -> int:
    """Carry out a command that `check` has passed, if the mode allows it."""
    name = name_of(command)
    if not allows(machine.mode, name):
        return failure("wrong_mode")
    machine.changed = True
    if command.name == "perform_function":
        first, second = float(command.values["argument_1"]), float(command.values["argument_2"])
        return _FUNCTION_HANDLERS[name](machine, first, second) or 0
    return _HANDLERS[name](machine, command.values) or 0


def _arguments_hold(name: str, values: Values) -> bool:
    numbers = (float(values["argument_1"]), float(values["argument_2"]))
    fields = FUNCTION_ARGUMENTS.get(name, ())
    return all(map(math.isfinite, numbers)) and all(map(_is_within, fields, numbers))


def _is_within(field: Field, value: float) -> bool:
    low = -math.inf if field.minimum is None else field.minimum
    high = math.inf if field.maximum is None else field.maximum
    return low <= value <= high and (not field.labels or value in dict(field.labels))


def _check_activity(machine: Machine, values: Values) -> int:
    release_ticks = int(values["release_ticks"])
    inner = list(parse_commands(_octets(values)))
    if len(inner) != 1:
        return failure("bad_length")
    command = inner[0]
    if not isinstance(command, Command):
        return command.failure_code
    if command.name == "insert_activity":
        return failure("unknown_function")
    if release_ticks <= machine.telemetry.ticks:
        return failure("expired")
    if machine.schedule.full:
        return failure("schedule_full")
    # A scheduled command is known from its insertion on: neither it nor its copy is ever carried out again.
    return machine.history.judge(command.packet, in_sequence=False) or check(machine, command)


def _octets(values: Values) -> bytes:
    octets: bytes = values["items"]["octet"].astype("u1").tobytes()
    return octets


# Services 3 and 5


def _structure(machine: Machine, values: Values) -> Structure | None:
    return machine.housekeeping.structures.get(int(values["structure_id"]))


def _switch_housekeeping(enabled: bool) -> Callable[[Machine, Values], int]:
    def switch(machine: Machine, values: Values) -> int:
        structure = _structure(machine, values)
        if structure is None:
            return failure("unknown_structure")
        structure.enabled = enabled
        return 0

    return switch


def _set_interval(machine: Machine, values: Values) -> int:
    structure = _structure(machine, values)
    if structure is None:
        return failure("unknown_structure")
    structure.interval_s, structure.next_ticks = float(values["interval_s"]), None
    return 0


def _request_housekeeping(machine: Machine, values: Values) -> int:
    if _structure(machine, values) is None:
        return failure("unknown_structure")
    send_structure(machine, int(values["structure_id"]))
    return 0


def _create_housekeeping(machine: Machine, values: Values) -> int:
    number = int(values["structure_id"])
    defined = machine.housekeeping.defined
    if number not in defined and len(defined) >= MOST_DEFINED:
        return failure("structures_full")
    codes = tuple(int(code) for code in values["items"]["quantity"])
    machine.housekeeping.structures[number] = Structure(float(values["interval_s"]), codes)
    machine.telemetry.event("info", "report_definition_changed", float(number), float(len(codes)))
    return 0


def _delete_housekeeping(machine: Machine, values: Values) -> int:
    number = int(values["structure_id"])
    if number < FIRST_DEFINED or machine.housekeeping.structures.pop(number, None) is None:
        return failure("unknown_structure")
    machine.telemetry.event("info", "report_definition_changed", float(number), 0.0)
    return 0


def _report_definition(machine: Machine, values: Values) -> int:
    structure = _structure(machine, values)
    if structure is None:
        return failure("unknown_structure")
    machine.telemetry.send(
        "housekeeping_definition",
        {
            "structure_id": int(values["structure_id"]),
            "interval_s": int(structure.interval_s) if structure.enabled else 0,
            "items": {"quantity": list(structure.quantities)},
        },
    )
    return 0


def _switch_event(disable: bool) -> Callable[[Machine, Values], int]:
    def switch(machine: Machine, values: Values) -> int:
        code, disabled = int(values["event_id"]), machine.telemetry.disabled
        if disable:
            machine.telemetry.event("info", "event_reporting_changed", float(code), 0.0)
        (disabled.add if disable else disabled.discard)(code)
        if not disable:
            machine.telemetry.event("info", "event_reporting_changed", float(code), 1.0)
        return 0

    return switch


def _report_disabled_events(machine: Machine, values: Values) -> int:
    codes = sorted(machine.telemetry.disabled)[:255]
    machine.telemetry.send("disabled_events", {"items": {"event_id": codes}})
    return 0


# Services 9 and 11


def _set_time_rate(machine: Machine, values: Values) -> int:
    machine.time_exponent = int(values["rate_exponent"])
    return 0


def _switch_schedule(enabled: bool) -> Callable[[Machine, Values], int]:
    def switch(machine: Machine, values: Values) -> int:
        machine.schedule.enabled = enabled
        return 0

    return switch


def _reset_schedule(machine: Machine, values: Values) -> int:
    machine.schedule.activities = []
    return 0


def _insert_activity(machine: Machine, values: Values) -> int:
    activity = Activity(int(values["release_ticks"]), _octets(values))
    machine.history.note(activity.packet, in_sequence=False)
    machine.schedule.insert(activity)
    return 0


def _report_schedule(machine: Machine, values: Values) -> int:
    activities = machine.schedule.activities
    machine.telemetry.send(
        "schedule_report",
        {
            "enabled": int(machine.schedule.enabled),
            "items": {
                "release_ticks": [activity.release_ticks for activity in activities],
                "request_id": [activity.request_id for activity in activities],
            },
        },
    )
    return 0


# Services 13 and 15


def _uplink(name: str) -> Callable[[Machine, Values], int]:
    def accept(machine: Machine, values: Values) -> int:
        whole = machine.uplink.accept(name, values)
        if whole is None:
            return 0
        kind = next((key for key, number in TABLE_NUMBERS.items() if number == whole.table), None)
        if kind is None:
            return failure("value_out_of_range")
        try:
            UNPACKERS[kind](whole.octets)
        except TableError:
            machine.telemetry.event("high", "table_refused", float(whole.table), float(len(whole.octets)))
            return failure("table_corrupt")
        machine.memory.load(whole.table, whole.octets)
        machine.tables = dataclasses.replace(machine.tables, **{kind: whole.octets})
        machine.observer.load_tables(machine.tables)
        return 0

    return accept


def _replay(machine: Machine, values: Values) -> int:
    start, stop = int(values["start_ticks"]), int(values["stop_ticks"])
    if stop <= start:
        return failure("value_out_of_range")
    machine.store.replay(start, stop)
    return 0


def _delete_stored(machine: Machine, stop_ticks: int) -> int:
    machine.store.delete(stop_ticks)
    return 0


def _report_store(machine: Machine, values: Values) -> int:
    contents = machine.store.report()
    machine.telemetry.send(
        "store_report",
        {
            "items": [
                {
                    "store_class": int(item.store_class),
                    "packets": item.packets,
                    "unsent": item.unsent,
                    "octets": item.octets,
                    "oldest_ticks": item.oldest_ticks,
                    "newest_ticks": item.newest_ticks,
                }
                for item in contents
            ]
        },
    )
    return 0


# Services 17 and 20


def _request_parameter(machine: Machine, values: Values) -> int:
    parameter = find_parameter(int(values["parameter_id"]))
    assert parameter is not None
    machine.telemetry.send(
        "parameter_report", {"parameter_id": parameter.number, "value": machine.parameters[parameter.name]}
    )
    return 0


def _set_parameter(machine: Machine, values: Values) -> int:
    parameter, value = find_parameter(int(values["parameter_id"])), float(values["value"])
    assert parameter is not None
    machine.parameters.set(parameter, value)
    machine.protect_parameters()
    machine.telemetry.event("info", "parameter_changed", float(parameter.number), value)
    if parameter.name == "housekeeping_interval_s":
        machine.housekeeping.structures[STATE].interval_s = value
        machine.housekeeping.structures[STATE].next_ticks = None
    elif parameter.name == "store_overwrite":
        machine.store.overwrite = bool(value)
    return 0


# Service 8


def _set_mode(machine: Machine, first: float, second: float) -> int:
    wanted = PayloadMode(int(first))
    if not may_change(machine.mode, wanted):
        return failure("wrong_mode")
    if wanted is PayloadMode.observing and machine.mode is not wanted:
        machine.observe(0, 0)
    machine.enter(wanted)
    return 0


def _manual_step(machine: Machine, first: float, second: float) -> int:
    machine.observer.manual_step = True
    return 0


def _reboot(machine: Machine, first: float, second: float) -> int:
    machine.reset_wanted = ResetCause.commanded
    return 0


def _synchronise_clock(machine: Machine, first: float, second: float) -> int:
    machine.counts["clock_status"] = 1
    machine.telemetry.event("info", "clock_synchronised", float(machine.telemetry.ticks))
    return 0


def _thumbnail(machine: Machine, first: float, second: float) -> int:
    machine.thumbnail_wanted = True
    return 0


_HANDLERS: dict[str, Callable[[Machine, Values], int | None]] = {
    "enable_housekeeping": _switch_housekeeping(True),
    "disable_housekeeping": _switch_housekeeping(False),
    "request_housekeeping": _request_housekeeping,
    "set_housekeeping_interval": _set_interval,
    "create_housekeeping": _create_housekeeping,
    "delete_housekeeping": _delete_housekeeping,
    "report_housekeeping_definition": _report_definition,
    "enable_event": _switch_event(False),
    "disable_event": _switch_event(True),
    "report_disabled_events": _report_disabled_events,
    "set_time_report_rate": _set_time_rate,
    "enable_schedule": _switch_schedule(True),
    "disable_schedule": _switch_schedule(False),
    "reset_schedule": _reset_schedule,
    "insert_activity": _insert_activity,
    "delete_activity": lambda machine, values: (
        0 if machine.schedule.delete(int(values["request_id"])) else failure("no_such_activity")
    ),
    "report_schedule": _report_schedule,
    "uplink_first": _uplink("uplink_first"),
    "uplink_middle": _uplink("uplink_middle"),
    "uplink_last": _uplink("uplink_last"),
    "replay_store": _replay,
    "delete_store": lambda machine, values: _delete_stored(machine, int(values["stop_ticks"])),
    "report_store": _report_store,
    "test_connection": lambda machine, values: machine.telemetry.send("connection_report", {}),
    "request_parameter": _request_parameter,
    "set_parameter": _set_parameter,
}
_FUNCTION_HANDLERS: dict[str, Callable[[Machine, float, float], int | None]] = {
    "set_mode": _set_mode,
    "start_observation": lambda machine, duration_s, cadence_s: machine.observe(
        round(duration_s * TICKS_PER_SECOND), round(cadence_s * TICKS_PER_SECOND)
    ),
    "stop_observation": lambda machine, *_: machine.enter(PayloadMode.standby),
    "manual_step": _manual_step,
    "reset_estimators": lambda machine, *_: machine.observer.reset(),
    "clear_store": lambda machine, *_: _delete_stored(machine, 1 << 62),
    "reboot": _reboot,
    "check_tables": lambda machine, *_: failure("table_corrupt") if machine.memory.damaged() else 0,
    "synchronise_clock": _synchronise_clock,
    "abort_uplink": lambda machine, table, _: machine.uplink.abort(int(table)),
    "widen_estimate": lambda machine, position_m, velocity_m_s: machine.observer.widen(position_m, velocity_m_s),
    # The own count of the command, whatever it is, has become the newest when it was accepted.
    "resynchronise_commands": lambda *_: 0,
    "downlink_thumbnail": _thumbnail,
    "downlink_map": lambda machine, *_: send_large_data(
        machine, "landmark_map", map_octets(machine.observer.sightings)
    ),
}
