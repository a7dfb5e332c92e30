"""Newest values of the parameters of a spacecraft."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import mission_now_ns
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes.model import LiveParameter, LiveValue, NewestPacket, SpacecraftInstance
from ground_service.store import telemetry
from ground_service.store.vehicles import FLOWN, Vehicle, all_vehicles, find_vehicle, get_vehicle
from tmtc.dictionary import DICTIONARY, STRUCTURES
from tmtc.schema import DecodedPacket, Field

LIVE_PACKETS = (
    *(one.name for one in STRUCTURES.values()),
    "navigation_state",
    "frame_outcome",
    "detections",
)
"""Packets whose newest values are shown; the others report single occurrences."""

LIMIT_STATES: tuple[Literal["within", "warning", "alarm"], ...] = ("within", "warning", "alarm")


def list_spacecraft(ground: Ground) -> list[SpacecraftInstance]:
    """Return all spacecraft in all instances."""
    with ground.database.reading() as connection:
        found = [
            SpacecraftInstance(spacecraft_id=one.ccsds_id, instance=one.instance)
            for one in all_vehicles(connection)
        ]
    return sorted(found, key=lambda one: (one.instance != FLOWN, one.spacecraft_id, one.instance))


def live_parameters(ground: Ground, spacecraft_id: int, instance: str) -> list[LiveParameter]:
    """Return the newest value of every parameter."""
    with ground.database.reading() as connection:
        newest = _newest(connection, find_vehicle(connection, spacecraft_id, instance))
    return [_described(packet, value) for packet in newest for value in packet.values]


def newest_packets(ground: Ground, vehicle_id: int) -> list[NewestPacket]:
    """Return the values of the newest packet of each kind of a vehicle."""
    with ground.database.reading() as connection:
        return _newest(connection, get_vehicle(connection, vehicle_id))


def _newest(connection: Connection, vehicle: Vehicle) -> list[NewestPacket]:
    correlations = load_correlations(connection, vehicle.id)
    found = []
    for name in LIVE_PACKETS:
        octets = telemetry.newest_packet(connection, vehicle.id, DICTIONARY.packet(name).apid)
        if octets is None:
            continue
        packet = DICTIONARY.unpack_packet(octets)
        utc_ns = int(utc_ns_of_ticks(np.array([packet.ticks]), correlations)[0][0])
        age_s = (mission_now_ns() - utc_ns) / 1e9
        found.append(
            NewestPacket(
                spacecraft_id=vehicle.ccsds_id,
                instance=vehicle.instance,
                packet=packet.name,
                time=UtcTime(utc_ns),
                age_s=age_s if age_s >= 0.0 else None,
                values=tuple(_values(packet)),
            )
        )
    return found


def _values(packet: DecodedPacket) -> Iterator[LiveValue]:
    for field in DICTIONARY.packet(packet.name).fields:
        if field.size == 1:
            value = float(packet.values[field.name])
            limited = field.warning is not None or field.alarm is not None
            yield LiveValue(
                name=field.name,
                value=value,
                text=_text(field, packet.raw[field.name], value),
                limit_state=LIMIT_STATES[int(field.limit_states(value))] if limited else "none",
            )


def _described(packet: NewestPacket, value: LiveValue) -> LiveParameter:
    field = next(one for one in DICTIONARY.packet(packet.packet).fields if one.name == value.name)
    limits = field.warning or field.alarm
    return LiveParameter(
        **dict(value),
        packet=packet.packet,
        description=field.description,
        unit=field.unit,
        limits="" if limits is None else f"{limits[0]:g} to {limits[1]:g}",
        time=packet.time,
        age_s=packet.age_s,
    )


def _text(field: Field, raw: Any, value: float) -> str:
    if field.labels:
        return field.label(int(raw)).replace("_", " ")
    if field.name.endswith("_hash"):
        return f"{int(raw):08x}"
    return f"{value:.0f}" if value.is_integer() else f"{value:.6g}"
