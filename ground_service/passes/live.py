"""Newest values of the parameters of a spacecraft."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import mission_now_ns
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.missions.store import mission_of_vehicle
from ground_service.missions.timekeeping.core import TimeCorrelation, utc_ns_of_ticks
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes.model import LiveParameter, LiveValue, NewestPacket, ParameterInfo, SpacecraftInstance
from ground_service.passes.parameters import DeclaredParameter, declared_reading
from ground_service.store.vehicles import FLOWN, Vehicle, find_vehicle, get_vehicle, used_vehicles
from ground_service.telemetry import store as telemetry
from ground_service.telemetry import values as declared_values
from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY, STRUCTURES
from tmtc.dictionary.schema import DecodedPacket, limit_states

LIVE_PACKETS = (*(one.name for one in STRUCTURES.values()), "navigation_state", "frame_outcome", "detections")
"""Packets whose newest values are shown; the others report single occurrences."""

Correlations = Sequence[TimeCorrelation]

LimitState = Literal["none", "within", "warning", "alarm"]
LIMIT_STATES: tuple[LimitState, ...] = ("within", "warning", "alarm")


def list_spacecraft(ground: Ground) -> list[SpacecraftInstance]:
    with ground.database.reading() as connection:
        found = [
            SpacecraftInstance(
                spacecraft_id=one.ccsds_id,
                instance=one.instance,
                name=None if (mission := mission_of_vehicle(connection, one.id)) is None else mission.spacecraft.name,
            )
            for one in used_vehicles(connection)
        ]
    return sorted(found, key=lambda one: (one.instance != FLOWN, one.spacecraft_id, one.instance))


def live_parameters(ground: Ground, spacecraft_id: int, instance: str) -> list[LiveParameter]:
    """Return the newest value of every parameter."""
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance)
        newest, reading = _newest(connection, vehicle), declared_reading(connection, vehicle.id)
    declared = {} if reading is None else {(one.container, one.name): one.info for one in reading.parameters.values()}
    return [
        _described(packet, value, declared.get((packet.packet, value.name)))
        for packet in newest
        for value in packet.values
    ]


def newest_packets(ground: Ground, vehicle_id: int) -> list[NewestPacket]:
    """Return the values of the newest packet of each kind of a vehicle."""
    with ground.database.reading() as connection:
        return _newest(connection, get_vehicle(connection, vehicle_id))


def _newest(connection: Connection, vehicle: Vehicle) -> list[NewestPacket]:
    correlations = load_correlations(connection, vehicle.id)
    found = list(_newest_declared(connection, vehicle, correlations))
    for name in LIVE_PACKETS:
        octets = telemetry.newest_packet(connection, vehicle.id, DICTIONARY.packet(name).apid)
        if octets is None:
            continue
        packet = DICTIONARY.unpack_packet(octets)
        found.append(_packet(vehicle, packet.name, packet.ticks, correlations, _values(packet)))
    # A clock behind the telemetry is not that of the mission, which is simulated at another time.
    now = max([mission_now_ns(), *(one.time.utc_ns for one in found)])
    return [one.model_copy(update={"age_s": (now - one.time.utc_ns) / 1e9}) for one in found]


def _newest_declared(connection: Connection, vehicle: Vehicle, correlations: Correlations) -> Iterator[NewestPacket]:
    """Yield the newest packets that the mission description defines, in the time of their clock."""
    reading = declared_reading(connection, vehicle.id)
    containers: dict[int, list[DeclaredParameter]] = {}
    for one in () if reading is None else reading.parameters.values():
        containers.setdefault(one.declared.numbers[one.container], []).append(one)
    for number, parameters in containers.items():
        assert reading is not None
        definition = reading.decoding.definition_id
        row = declared_values.newest_values(connection, vehicle.id, definition, number)
        if row is not None:
            ticks, numbers = row
            first, clock = parameters[0], parameters[0].declared.source.time
            lines = correlations if clock is None or clock.clock == "payload" else ()
            values = (_declared_value(one.info, float(numbers[one.index])) for one in parameters)
            yield _packet(vehicle, first.container, ticks, lines, values)


def _declared_value(info: ParameterInfo, value: float) -> LiveValue:
    state: LimitState = "none" if info.warning is None and info.alarm is None else "within"
    for name, limits in zip(LIMIT_STATES[1:], (info.warning, info.alarm), strict=True):
        low, high = limits or (None, None)
        if (low is not None and value < low) or (high is not None and value > high):
            state = name
    text = info.labels.get(f"{value:g}", f"{value:.6g}")
    return LiveValue(name=info.name, value=value, text=text, limit_state=state)


def _packet(
    vehicle: Vehicle, name: str, ticks: int, correlations: Correlations, values: Iterable[LiveValue]
) -> NewestPacket:
    utc_ns = int(utc_ns_of_ticks(np.array([ticks]), correlations)[0][0])
    return NewestPacket(
        spacecraft_id=vehicle.ccsds_id,
        instance=vehicle.instance,
        packet=name,
        time=UtcTime(utc_ns),
        age_s=0.0,
        values=tuple(values),
    )


def _values(packet: DecodedPacket) -> Iterator[LiveValue]:
    for field in DICTIONARY.packet(packet.name).fields:
        if field.size == 1:
            value = float(packet.values[field.name])
            limited = field.warning is not None or field.alarm is not None
            yield LiveValue(
                name=field.name,
                value=value,
                text=_text(field, packet.raw[field.name], value),
                limit_state=LIMIT_STATES[int(limit_states(field, value))] if limited else "none",
            )


def _described(packet: NewestPacket, value: LiveValue, declared: ParameterInfo | None) -> LiveParameter:
    field = declared or DICTIONARY.packet(packet.packet).field(value.name)
    limits = field.warning or field.alarm
    return LiveParameter(
        **dict(value),
        packet=packet.packet,
        description=field.description,
        unit=field.unit,
        limits="" if limits is None else " to ".join("…" if one is None else f"{one:g}" for one in limits),
        time=packet.time,
        age_s=packet.age_s,
    )


def _text(field: Field, raw: Any, value: float) -> str:
    if field.labels:
        return field.label(int(raw)).replace("_", " ")
    if field.name.endswith("_hash"):
        return f"{int(raw):08x}"
    return f"{value:.0f}" if value.is_integer() else f"{value:.6g}"
