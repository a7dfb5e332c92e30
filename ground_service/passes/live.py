"""Newest values of the parameters of a spacecraft."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from ground_service.clock import mission_now_ns
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.passes.model import LiveParameter, SpacecraftInstance
from ground_service.store import telemetry
from ground_service.store.vehicles import FLOWN, all_vehicles, find_vehicle
from ground_service.timekeeping.core import utc_ns_of_ticks
from ground_service.timekeeping.store import load_correlations
from tmtc.dictionary import DICTIONARY
from tmtc.schema import DecodedPacket, Field

LIVE_PACKETS = ("housekeeping", "navigation_state", "frame_outcome", "detections")
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
    """Return the newest value of every parameter.

    Raises
    ------
    NotFound
        There is no such spacecraft.
    """
    found: list[LiveParameter] = []
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance)
        correlations = load_correlations(connection, vehicle.id)
        for name in LIVE_PACKETS:
            octets = telemetry.newest_packet(connection, vehicle.id, DICTIONARY.packet(name).apid)
            if octets is not None:
                packet = DICTIONARY.unpack_packet(octets)
                utc_ns = int(utc_ns_of_ticks(np.array([packet.ticks]), correlations)[0][0])
                found.extend(_values(packet, utc_ns))
    return found


def _values(packet: DecodedPacket, utc_ns: int) -> Iterator[LiveParameter]:
    age_s = (mission_now_ns() - utc_ns) / 1e9
    known_age_s = age_s if age_s >= 0.0 else None
    for field in DICTIONARY.packet(packet.name).fields:
        if field.size == 1:
            value = float(packet.values[field.name])
            limits = field.warning or field.alarm
            state = LIMIT_STATES[int(field.limit_states(value))]
            yield LiveParameter(
                name=field.name,
                packet=packet.name,
                description=field.description,
                unit=field.unit,
                value=value,
                text=_text(field, packet.raw[field.name], value),
                limit_state="none" if limits is None else state,
                limits="" if limits is None else f"{limits[0]:g} to {limits[1]:g}",
                time=UtcTime(utc_ns),
                age_s=known_age_s,
            )


def _text(field: Field, raw: Any, value: float) -> str:
    if field.labels:
        return field.label(int(raw)).replace("_", " ")
    if field.name.endswith("_hash"):
        return f"{int(raw):08x}"
    return f"{value:.0f}" if value.is_integer() else f"{value:.6g}"
