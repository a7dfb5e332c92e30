"""Housekeeping and large data as packets."""

from payload_emulator.flight.onboard.housekeeping import PERFORMANCE, STATE
from payload_emulator.flight.onboard.loads import TABLE_NUMBERS
from payload_emulator.flight.onboard.machine import Machine
from payload_emulator.flight.ports import Stage
from payload_emulator.flight.telemetry.store import StoreClass
from tmtc.dictionary.payload import DICTIONARY, STRUCTURES
from tmtc.packets.large_data import split

_POOL = DICTIONARY.labels("housekeeping_report", "quantity")
_STAGES = (Stage.commands, Stage.detector, Stage.navigation, Stage.telemetry, Stage.monitoring)


def send_structure(machine: Machine, number: int) -> None:
    """Send one housekeeping structure."""
    pool = _pool(machine)
    if number in STRUCTURES:
        definition = STRUCTURES[number]
        values = {field.name: pool[field.name] for field in definition.fields[1:]}
        machine.telemetry.send(definition.name, {"structure_id": number, **values})
    else:
        codes = machine.housekeeping.structures[number].quantities
        items = {"quantity": list(codes), "value": [float(pool[_POOL[code]]) for code in codes]}
        machine.telemetry.send("housekeeping_report", {"structure_id": number, "items": items})
    if number == STATE and machine.counts["clock_status"] == _SUSPECT:
        machine.counts["clock_status"] = 0
    if number == PERFORMANCE:
        machine.timer.restart()


def send_large_data(machine: Machine, table: str, octets: bytes) -> None:
    """Send octets in parts, under a separate transaction number."""
    parts = split(
        octets, transaction=machine.transaction, table=table, part_length=int(machine.parameters["large_data_part"])
    )
    for name, values in parts:
        machine.telemetry.send(name, values)
    machine.transaction = (machine.transaction + 1) & 0xFFFF
    machine.changed = True


def _pool(machine: Machine) -> dict[str, float]:
    """Return the values of all structures by name."""
    memory, levels = machine.memory, machine.store.levels()
    return {
        **machine.quantities(),
        "model_hash": machine.model_identity,
        "parameters_hash": machine.parameters_hash,
        "catalogue_hash": memory.hash_of(TABLE_NUMBERS["catalogue"]),
        "anchor_table_hash": memory.hash_of(TABLE_NUMBERS["anchor_ephemeris"]),
        **{f"cpu_{stage.name}_ms": machine.timer.mean_ms(stage) for stage in _STAGES},
        **{f"queue_{kind.name}": levels[kind][0] for kind in StoreClass},
        **{f"store_{kind.name}_permille": levels[kind][1] for kind in StoreClass},
    }


_SUSPECT = 2
