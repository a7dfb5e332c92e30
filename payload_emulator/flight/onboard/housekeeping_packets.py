"""Housekeeping and large data as packets."""

from __future__ import annotations

from payload_emulator.flight.onboard.housekeeping import PERFORMANCE, STATE
from payload_emulator.flight.onboard.loads import TABLE_NUMBERS
from payload_emulator.flight.onboard.machine import Machine
from payload_emulator.flight.ports import Stage
from payload_emulator.flight.telemetry.store import StoreClass
from tmtc.dictionary import DICTIONARY
from tmtc.large_data import split

_STATE_FIELDS = tuple(
    field.name for field in DICTIONARY.packet("housekeeping").fields if not field.name.endswith("_hash")
)[1:]
_POOL = DICTIONARY.labels("housekeeping_report", "quantity")
_STAGES = (Stage.commands, Stage.detector, Stage.navigation, Stage.telemetry, Stage.monitoring)


def send_structure(machine: Machine, number: int) -> None:
    """Send one housekeeping structure."""
    if number == STATE:
        _send_state(machine)
    elif number == PERFORMANCE:
        _send_performance(machine)
    else:
        pool = {**machine.quantities(), **_stage_times(machine)}
        codes = machine.housekeeping.structures[number].quantities
        items = {"quantity": list(codes), "value": [float(pool[_POOL[code]]) for code in codes]}
        machine.telemetry.send("housekeeping_report", {"structure_id": number, "items": items})


def send_large_data(machine: Machine, table: str, octets: bytes) -> None:
    """Send octets in parts, under a separate transaction number."""
    parts = split(
        octets,
        transaction=machine.transaction,
        table=table,
        part_length=int(machine.parameters["large_data_part"]),
    )
    for name, values in parts:
        machine.telemetry.send(name, values)
    machine.transaction = (machine.transaction + 1) & 0xFFFF
    machine.changed = True


def _send_state(machine: Machine) -> None:
    pool, memory = machine.quantities(), machine.memory
    machine.telemetry.send(
        "housekeeping",
        {
            "structure_id": STATE,
            **{name: pool[name] for name in _STATE_FIELDS},
            "model_hash": machine.model_identity,
            "parameters_hash": machine.parameters_hash,
            "catalogue_hash": memory.hash_of(TABLE_NUMBERS["catalogue"]),
            "anchor_table_hash": memory.hash_of(TABLE_NUMBERS["anchor_ephemeris"]),
        },
    )
    if machine.counts["clock_status"] == _SUSPECT:
        machine.counts["clock_status"] = 0


def _send_performance(machine: Machine) -> None:
    pool, levels = machine.quantities(), machine.store.levels()
    machine.telemetry.send(
        "performance",
        {
            "structure_id": PERFORMANCE,
            **_stage_times(machine),
            **{name: pool[name] for name in _PERFORMANCE_FIELDS},
            **{f"queue_{kind.name}": levels[kind][0] for kind in StoreClass},
            **{f"store_{kind.name}_permille": levels[kind][1] for kind in StoreClass},
        },
    )
    machine.timer.restart()


def _stage_times(machine: Machine) -> dict[str, float]:
    return {f"cpu_{stage.name}_ms": machine.timer.mean_ms(stage) for stage in _STAGES}


_SUSPECT = 2
_PERFORMANCE_FIELDS = (
    "detector_latency_max_ms",
    "detector_timeouts",
    "camera_temperature_c",
    "bus_current_a",
    "store_overwritten",
    "storage_errors",
    "memory_repairs",
    "activities",
    "last_command_count",
)
