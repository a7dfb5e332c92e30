"""Packets whose on-board time is implausible: kept apart from the archive, so that they decide nothing.

A batch is judged before it is stored. What follows can change the judgement: packets are put back when later telemetry
supports their time, and taken out of the archive when telemetry that came later shows that it was wrong.
"""

from dataclasses import replace

import numpy as np
from sqlalchemy import Connection, delete, func, insert, select

from ground_service.clock import independent_now_ns, is_stated
from ground_service.ground import Ground
from ground_service.http.model import PageOf
from ground_service.ingest import store
from ground_service.ingest.core import (
    LONGEST_STEP,
    SIMULATED_AHEAD,
    UNSET_TICKS,
    fits_between,
    implausible_times,
    span_words,
)
from ground_service.ingest.model import ImplausibleFilter, ImplausiblePacket
from ground_service.store import repository
from ground_service.store.event_kinds import TelemetryWithdrawn, TimesDoubted, publish
from ground_service.store.vehicles import get_vehicle, lock_vehicle
from ground_service.telemetry import store as telemetry
from ground_service.telemetry.packets import NO_TIME, PacketBatch, batch_of_cut
from ground_service.telemetry.values import newest_declared_ticks
from lunar.arrays import IntArray
from lunar.plausible import AGREEING_PACKETS
from lunar.timescales import ticks_from_utc_ns, utc_ns_from_ticks
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.pus import NO_TICKS
from tmtc.packets.stream import whole_packets

_DOUBTED, _PACKETS, _VEHICLES = repository.IMPLAUSIBLE_PACKETS, repository.PACKETS, repository.VEHICLES


def plausible_part(
    connection: Connection, vehicle: int, ingest_id: int, batch: PacketBatch, *, judged: bool
) -> PacketBatch:
    """Return a batch without the packets whose time is implausible, which are kept apart in the same transaction.

    `judged`: only packets that are kept apart already are left out.
    """
    newest, is_doubted = telemetry.newest_and_doubted(connection, vehicle, batch.apid)
    known: set[bytes] = set()
    if is_doubted:
        digests = connection.execute(select(_DOUBTED.c.digest).where(_DOUBTED.c.vehicle_id == vehicle))
        known = {bytes(digest) for digest in digests.scalars()}
    doubts = {} if judged else _doubts(connection, vehicle, batch, newest) | _image_doubts(batch)
    new = {k: reason for k, reason in doubts.items() if batch.digest[k] not in known}
    if not new and not known:
        return batch
    if new:
        _keep_apart(connection, vehicle, ingest_id, batch, new)
    keep = [k for k in range(len(batch)) if k not in doubts and batch.digest[k] not in known]
    if len(keep) == len(batch):
        return batch
    received = None if batch.received_utc_ns is None else batch.received_utc_ns[keep]
    return _batch([batch.octets[k] for k in keep], batch.spacecraft_id, received)


def _doubts(connection: Connection, vehicle: int, batch: PacketBatch, newest: int | None) -> dict[int, str]:
    """Return the packets of a batch with an implausible time, with the reason."""
    timed = batch.ticks[batch.ticks != NO_TICKS]
    if not timed.size:
        return {}
    if newest is not None:
        is_new = timed.max() > newest + LONGEST_STEP
        is_old = timed.min() < newest - LONGEST_STEP
        if not is_new and not is_old:
            return {}
        if is_new and not _is_firm(connection, vehicle):
            newest = None
    received = None
    if batch.received_utc_ns is not None:
        shown = np.asarray(ticks_from_utc_ns(np.maximum(batch.received_utc_ns, 0)))
        received = np.where(batch.received_utc_ns == NO_TIME, NO_TICKS, shown)
    doubts = implausible_times(batch.ticks, received, newest, latest_ticks(newest))
    if newest is None:
        return doubts
    late = np.flatnonzero((batch.ticks != NO_TICKS) & (batch.ticks < newest - LONGEST_STEP))
    if 0 < late.size < AGREEING_PACKETS:
        for k in late.tolist():
            if not _fits(connection, vehicle, int(batch.apid[k]), int(batch.ticks[k]), batch.count_of(k)):
                doubts.setdefault(k, "its sequence count belongs to another time")
    return doubts


def _image_doubts(batch: PacketBatch) -> dict[int, str]:
    """Return the packets of a batch whose image was taken long after them, or before the clock was set."""
    doubts: dict[int, str] = {}
    for columns in batch.rows.values():
        if "packet_ticks" not in columns:
            continue
        image, packet = columns["ticks"], columns["packet_ticks"]
        late = image > packet + LONGEST_STEP
        unset = (image > 0) & (image < UNSET_TICKS) & (packet > 2 * UNSET_TICKS)
        for k in np.flatnonzero((late | unset) & (packet != NO_TICKS)).tolist():
            words = f"{span_words(int(image[k] - packet[k]))} after it" if late[k] else "from a clock that was not set"
            doubts[int(columns["packet"][k])] = f"the time of its image is {words}"
    return doubts


def withdraw_doubted(
    connection: Connection, vehicle: int, ids: IntArray, ticks: IntArray, newest_declared: int | None
) -> IntArray:
    """Keep stored packets (n,) apart whose declared time is implausible; return their ids.

    `newest_declared` is the greatest declared time in the archive; the caller holds the lock of the vehicle.
    """
    known = [one for one in (telemetry.newest_ticks(connection, vehicle), newest_declared) if one is not None]
    newest = max(known, default=None)
    timed = ticks[ticks != NO_TICKS]
    if not timed.size or (newest is not None and timed.max() <= newest + LONGEST_STEP and timed.min() > UNSET_TICKS):
        return np.zeros(0, dtype=np.int64)
    if newest is not None and not _is_firm(connection, vehicle):
        newest = None
    doubts = implausible_times(ticks, None, newest, latest_ticks(newest))
    found = {int(ids[k]): (int(ticks[k]), reason) for k, reason in doubts.items()}
    if found:
        rows = select(_PACKETS.c.octets).where(_PACKETS.c.id.in_(found)).order_by(_PACKETS.c.id)
        batch = _batch([bytes(octets) for octets in connection.execute(rows).scalars()], None)
        withdraw_packets(connection, vehicle, list(found))
        shown = [found[key] for key in sorted(found)]
        times = np.array([time for time, _ in shown], dtype=np.int64)
        reasons = {k: reason for k, (_, reason) in enumerate(shown)}
        ingest_id = store.newest_ingest(connection, vehicle)
        _keep_apart(connection, vehicle, ingest_id, replace(batch, ticks=times), reasons)
    return np.array(sorted(found), dtype=np.int64)


def latest_ticks(newest: int | None) -> int | None:
    """Return the greatest on-board time that the mission clock allows.

    None if only telemetry states the time, or if the archive is from after it, as recordings of simulated flights are.
    """
    now = independent_now_ns()
    if now is None:
        return None
    latest = int(ticks_from_utc_ns(now)) + LONGEST_STEP
    if newest is None and not is_stated():
        return latest + SIMULATED_AHEAD
    return latest if newest is None or newest <= latest else None


def _is_firm(connection: Connection, vehicle: int) -> bool:
    """Return whether the archive of a vehicle has enough packets to compare others with."""
    few = select(_PACKETS.c.id).where(_PACKETS.c.vehicle_id == vehicle).limit(AGREEING_PACKETS)
    return len(connection.execute(few).all()) == AGREEING_PACKETS


def _fits(connection: Connection, vehicle: int, apid: int, ticks: int, count: int) -> bool:
    """Return whether the sequence count of a packet fits those of the packets of its APID around it."""
    mine = (_PACKETS.c.vehicle_id == vehicle, _PACKETS.c.apid == apid)
    query = select(_PACKETS.c.sequence_count).where(*mine)
    before = query.where(_PACKETS.c.ticks < ticks, _PACKETS.c.ticks >= 0).order_by(_PACKETS.c.ticks.desc())
    after = query.where(_PACKETS.c.ticks > ticks).order_by(_PACKETS.c.ticks)
    around = [connection.execute(one.limit(1)).scalar() for one in (before, after)]
    return fits_between(count, *around)


def _keep_apart(
    connection: Connection, vehicle: int, ingest_id: int, batch: PacketBatch, doubts: dict[int, str]
) -> None:
    rows = {
        batch.digest[k]: {
            "vehicle_id": vehicle,
            "ingest_id": ingest_id,
            "apid": int(batch.apid[k]),
            "sequence_count": batch.count_of(k),
            "ticks": int(batch.ticks[k]),
            "digest": batch.digest[k],
            "octets": batch.octets[k],
            "reason": reason,
        }
        for k, reason in doubts.items()
    }
    connection.execute(insert(_DOUBTED), list(rows.values()))
    publish(connection, TimesDoubted(vehicle_id=vehicle, ingest_id=ingest_id, packets=len(rows)))


def _batch(octets: list[bytes], spacecraft_id: int | None, received: IntArray | None = None) -> PacketBatch:
    cut = whole_packets(np.array([len(one) for one in octets], dtype=np.int64))
    return batch_of_cut(b"".join(octets), cut, DICTIONARY, spacecraft_id, received)


def count_implausible(connection: Connection, ingest_id: int) -> int:
    """Return the number of packets of an ingest that are kept apart."""
    query = select(func.count()).select_from(_DOUBTED).where(_DOUBTED.c.ingest_id == ingest_id)
    return int(connection.execute(query).scalar_one())


def list_implausible(connection: Connection, asked: ImplausibleFilter) -> PageOf[ImplausiblePacket]:
    """List the packets that are kept apart because their on-board time is implausible, newest first."""
    columns = [one for one in _DOUBTED.c if one.name != "octets"]
    query = select(*columns, _VEHICLES.c.ccsds_id.label("spacecraft_id"), _VEHICLES.c.instance)
    query = query.join(_VEHICLES, _VEHICLES.c.id == _DOUBTED.c.vehicle_id)
    rows, total = repository.page(connection, query, asked, _DOUBTED.c.id.desc())
    return asked.page((ImplausiblePacket.of(row, time=utc_ns_from_ticks(row["ticks"])) for row in rows), total)


def needs_review(connection: Connection, vehicle: int, first_ticks: int | None) -> bool:
    """Return whether new telemetry, from this time on, can change a judgement."""
    newest, is_doubted = telemetry.newest_and_doubted(connection, vehicle)
    is_old = newest is not None and first_ticks is not None and first_ticks < newest - LONGEST_STEP
    return is_doubted or is_old


def review_times(ground: Ground, vehicle: int) -> None:
    """Put back packets that later telemetry supports, and take out those that it contradicts."""
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        if _is_firm(connection, vehicle):
            while found := _contradicted(connection, vehicle):
                _take_out(connection, vehicle, *found)
        _put_back(connection, vehicle)


def _contradicted(connection: Connection, vehicle: int) -> tuple[list[int], str] | None:
    """Return packets of the archive whose time is implausible compared with the others, and the reason."""
    newest = telemetry.newest_ticks(connection, vehicle)
    if newest is None:
        return None
    if newest > 2 * UNSET_TICKS and (unset := telemetry.packets_before(connection, vehicle, UNSET_TICKS)):
        return unset, "the clock was not set"
    last = telemetry.last_packets(connection, vehicle, AGREEING_PACKETS + 1)
    ends = np.flatnonzero(np.diff(last[:, 0]) < -LONGEST_STEP)
    if not ends.size or ends[0] + 1 >= AGREEING_PACKETS:
        return None
    ticks, before = last[: ends[0] + 1, 0], int(last[ends[0] + 1, 0])
    doubts = implausible_times(ticks, None, before, latest_ticks(before))
    chosen = [int(last[k, 1]) for k in doubts]
    return (chosen, next(iter(doubts.values()))) if chosen else None


def _take_out(connection: Connection, vehicle: int, ids: list[int], reason: str) -> None:
    rows = connection.execute(select(_PACKETS.c.octets).where(_PACKETS.c.id.in_(ids))).scalars()
    batch = _batch([bytes(octets) for octets in rows], None)
    withdraw_packets(connection, vehicle, ids)
    ingest_id = store.newest_ingest(connection, vehicle)
    _keep_apart(connection, vehicle, ingest_id, batch, dict.fromkeys(range(len(batch)), reason))


def withdraw_packets(connection: Connection, vehicle: int, ids: list[int]) -> None:
    """Remove packets and what was decoded from them, and publish it; the caller holds the lock of the vehicle."""
    first, last = store.forget_packets(connection, vehicle, ids)
    store.limit_extents(connection, vehicle, telemetry.newest_ticks(connection, vehicle))
    event = TelemetryWithdrawn(vehicle_id=vehicle, packets=len(ids), first_ticks=first, last_ticks=last)
    publish(connection, event)


def _put_back(connection: Connection, vehicle: int) -> None:
    rows = connection.execute(select(_DOUBTED).where(_DOUBTED.c.vehicle_id == vehicle).order_by(_DOUBTED.c.ticks))
    found = rows.mappings().all()
    if not found:
        return
    known = (telemetry.newest_ticks(connection, vehicle), newest_declared_ticks(connection, vehicle))
    newest = max((one for one in known if one is not None), default=None)
    ticks = np.array([row["ticks"] for row in found], dtype=np.int64)
    doubts = implausible_times(ticks, None, newest, latest_ticks(newest))
    doubts |= _image_doubts(_batch([bytes(row["octets"]) for row in found], None))
    supported = [
        row
        for k, row in enumerate(found)
        if k not in doubts and _fits(connection, vehicle, row["apid"], row["ticks"], row["sequence_count"])
    ]
    if not supported:
        return
    connection.execute(delete(_DOUBTED).where(_DOUBTED.c.id.in_([row["id"] for row in supported])))
    for row in supported:
        store.widen_extent(connection, row["ingest_id"], row["ticks"])
    spacecraft = get_vehicle(connection, vehicle).ccsds_id
    store.store_batch(connection, vehicle, _batch([bytes(row["octets"]) for row in supported], spacecraft))
