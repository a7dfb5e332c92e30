"""Decoding of packets that the mission description defines, after ingest and again after a new revision.

Each block of packets is one transaction with the note of the last packet, so a decoding that is cut off continues
where it was. A new definition decodes all packets from the first one on. Until it has reached the last one, the values
of the definition before it are read. Packets of APIDs without a definition stay stored as they are.
"""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from sqlalchemy import Connection

from ground_service.ground import Ground
from ground_service.missions import store as missions
from ground_service.missions.definitions import PacketDefinitions, packet_definitions
from ground_service.missions.model import EPOCH_TAI, PacketTime
from ground_service.store.vehicles import (
    Vehicle,
    all_vehicles,
    change_vehicle,
    decoded_version,
    get_vehicle,
    lock_vehicle,
)
from ground_service.telemetry import values as parameters
from ground_service.telemetry import writing
from ground_service.telemetry.packets import batch_of_cut
from ground_service.telemetry.values import Decoding, StoredPackets, last_packet
from lunar.arrays import FloatArray, IntArray
from lunar.constants import DAY_NS, NS
from lunar.timescales import ONBOARD_EPOCH_TAI_NS, TICKS_PER_SECOND, parse_utc, tai_ns_from_utc_ns, ticks_from_utc_ns
from tmtc.arrays import Octets
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary
from tmtc.packets.pus import NO_TICKS, TICKS_LIMIT, TimeCode, elapsed
from tmtc.packets.stream import PacketCut, primary_headers, whole_packets
from tmtc.xtce.decode import DECODED, VERDICTS
from tmtc.xtce.series import series_matrix

BLOCK_PACKETS = 20_000

Samples = dict[int, tuple[IntArray, IntArray, FloatArray]]
"""Times (n,), packet ids (n,) and values (n, v) by container number."""


Judge = Callable[[Connection, int, IntArray, IntArray, int | None], IntArray]
"""Keeps some packets apart, by their ids (n,), times (n,) and the newest declared time, and returns their ids."""


def decode_declared(ground: Ground, vehicle: int, judge: Judge | None = None) -> int:
    """Decode the packets of a vehicle that the definition in force has not decoded; return the number of samples.

    `judge` keeps packets with an implausible time apart; None: all are believed.
    """
    stored = 0
    while True:
        ground.check_stopping()
        with ground.database.reading() as connection:
            definitions, _ = definitions_in_force(connection, vehicle)
            if not definitions.declared and parameters.readable_decoding(connection, vehicle) is None:
                return stored
        with ground.database.writing() as connection:
            found = _next_block(connection, vehicle, judge)
        if found is None:
            return stored
        stored += found


def definitions_in_force(connection: Connection, vehicle: int) -> tuple[PacketDefinitions, int]:
    """Return the packets that are declared for a vehicle, and the id of the revision that declares them."""
    found = get_vehicle(connection, vehicle)
    return definitions_of_spacecraft(connection, found.ccsds_id, found.instance)


def definitions_of_spacecraft(connection: Connection, spacecraft: int, instance: str) -> tuple[PacketDefinitions, int]:
    """As `definitions_in_force`, by spacecraft id and instance."""
    mission_id = missions.packets_in_force(connection, spacecraft, instance)
    if mission_id is None:
        return PacketDefinitions(), 0
    return packet_definitions(missions.get_mission(connection, mission_id)), mission_id


def _next_block(connection: Connection, vehicle: int, judge: Judge | None = None) -> int | None:
    """Decode the next packets; None if none are left."""
    lock_vehicle(connection, vehicle)
    definitions, mission_id = definitions_in_force(connection, vehicle)
    if not definitions.declared:
        parameters.forget_others(connection, vehicle, None)
        return None
    definition = parameters.definition_id(connection, definitions.digest, mission_id)
    progress = parameters.decoding(connection, vehicle, definition)
    if progress is None:
        earlier = _readable_definitions(connection, vehicle)
        new = definitions.form.unchecked - earlier.form.unchecked
        progress = parameters.begin(connection, vehicle, definition, read_again=bool(new))
    packets = parameters.packets_after(connection, vehicle, progress.decoded_to, definitions.apids, BLOCK_PACKETS)
    if not packets.ids:
        end = replace(progress, decoded_to=parameters.last_packet(connection, vehicle), complete=True)
        if end != progress:
            parameters.change(connection, vehicle, end)
        parameters.forget_others(connection, vehicle, definition)
        return None
    samples, counts = decoded_values(definitions, packets)
    if judge is not None and samples:
        ids, ticks = (np.concatenate([one[k] for one in samples.values()]) for k in (1, 0))
        newest = parameters.newest_declared_ticks(connection, vehicle, definition, samples)
        apart = judge(connection, vehicle, ids, ticks, newest)
        for number, columns in samples.items() if apart.size else ():
            kept = ~np.isin(columns[1], apart)
            samples[number] = (columns[0][kept], columns[1][kept], columns[2][kept])
        for apid in (packets.apids[packets.ids.index(one)] for one in apart.tolist()):
            counts[apid][VERDICTS[DECODED]] -= 1
    stored = parameters.store_values(connection, vehicle, definition, samples)
    parameters.change(connection, vehicle, _with_counts(progress, packets.ids[-1], counts))
    return stored


def _readable_definitions(connection: Connection, vehicle: int) -> PacketDefinitions:
    """Return the packets of the definition that the values of a vehicle are read with."""
    decoding = parameters.readable_decoding(connection, vehicle)
    if decoding is None:
        return PacketDefinitions()
    mission_id = parameters.mission_of_definition(connection, decoding.definition_id)
    return packet_definitions(missions.get_mission(connection, mission_id))


def _with_counts(progress: Decoding, decoded_to: int, counts: dict[int, dict[str, int]]) -> Decoding:
    merged = {apid: dict(found) for apid, found in progress.counts.items()}
    for apid, found in counts.items():
        mine = merged.setdefault(str(apid), {})
        for verdict, number in found.items():
            mine[verdict] = mine.get(verdict, 0) + number
    return replace(progress, decoded_to=decoded_to, counts=merged)


def decoded_values(definitions: PacketDefinitions, packets: StoredPackets) -> tuple[Samples, dict[int, dict[str, int]]]:
    """Return the values of packets, and the number of packets by APID and outcome of decoding."""
    apids = np.array(packets.apids, dtype=np.int64)
    ids = np.array(packets.ids, dtype=np.int64)
    samples: Samples = {}
    counts: dict[int, dict[str, int]] = {}
    for declared in definitions.declared:
        rows = np.flatnonzero(np.isin(apids, declared.source.apids))
        if declared.decoder is None or not rows.size:
            continue
        octets = [packets.octets[row] for row in rows.tolist()]
        buffer = b"".join(octets)
        cut = whole_packets(np.array([len(one) for one in octets], dtype=np.int64))
        found = declared.decoder.decode(buffer, cut, primary_headers(buffer, cut))
        ticks = packet_times(buffer, cut, declared.source.time)
        numbers = declared.numbers
        for name, table in found.tables.items():
            index = table.packet_index
            values = series_matrix(table, declared.layouts[name])
            samples[numbers[name]] = (ticks[index], ids[rows][index], values)
        for apid in np.unique(apids[rows]).tolist():
            outcome = np.bincount(found.verdict[apids[rows] == apid], minlength=len(VERDICTS))
            counts[apid] = {VERDICTS[k]: int(outcome[k]) for k in np.flatnonzero(outcome).tolist()}
    return samples, counts


def packet_times(buffer: Octets, cut: PacketCut, time: PacketTime | None) -> IntArray:
    """Return the on-board time (n,) of packets as ticks; `NO_TICKS` where a packet has none that is possible.

    A packet has none without a secondary header, and as a later part of a segmented packet.
    """
    if time is None:
        return np.full(len(cut), NO_TICKS, dtype=np.int64)
    code = TimeCode(time.code, time.offset, time.whole_octets, time.fraction_octets, time.p_field)
    whole, part, known = elapsed(buffer, cut.offsets, cut.lengths, code)
    known &= primary_headers(buffer, cut).secondary_header
    epoch_ns = parse_utc(time.epoch.removesuffix(EPOCH_TAI))
    if time.code == "cds":
        ticks = np.asarray(ticks_from_utc_ns(epoch_ns + whole * DAY_NS + part))
    elif time.clock == "unix":
        ticks = np.asarray(ticks_from_utc_ns(epoch_ns + whole * NS + part * NS // TICKS_PER_SECOND))
    else:
        epoch_tai_ns = epoch_ns if time.epoch.endswith(EPOCH_TAI) else int(tai_ns_from_utc_ns(epoch_ns))
        since = (epoch_tai_ns - ONBOARD_EPOCH_TAI_NS) * TICKS_PER_SECOND // NS
        ticks = whole * TICKS_PER_SECOND + part + since
    return np.where(known & (ticks >= 0) & (ticks < TICKS_LIMIT), ticks, NO_TICKS)


def redecode(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    """Decode all packets of a vehicle with `dictionary`; how many rows that gave here.

    Rows that this dictionary version gave before are replaced, so running it again changes nothing.
    """
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        _begin(connection, vehicle, dictionary.version)
    return _go_on(ground, vehicle, dictionary)


def catch_up(ground: Ground, vehicle: int) -> int:
    """Decode a vehicle that an older dictionary decoded with that of this version; how many rows that gave."""
    with ground.database.reading() as connection:
        if not _behind(get_vehicle(connection, vehicle)):
            return 0
    with ground.database.writing() as connection:
        found = lock_vehicle(connection, vehicle)
        if not _behind(found):
            return 0
        if found.redecoding_version != DICTIONARY.version:
            _begin(connection, vehicle, DICTIONARY.version)
    return _go_on(ground, vehicle, DICTIONARY)


def note_dictionary(connection: Connection, vehicle: int) -> None:
    """Record the dictionary version that decodes packets, before they are stored in the same transaction.

    Packets of the vehicle that an older version decoded must be decoded again up to this point; later packets are
    already decoded. The row is locked only if something must be recorded, so that several transactions can store
    packets.
    """
    found = get_vehicle(connection, vehicle)
    if found.decoded_version is not None and not _behind(found):
        return
    found = lock_vehicle(connection, vehicle)
    if found.decoded_version is None:
        change_vehicle(connection, vehicle, decoded_version=DICTIONARY.version)
    elif _behind(found) and found.redecoding_version != DICTIONARY.version:
        _begin(connection, vehicle, DICTIONARY.version)


def vehicles_behind(ground: Ground) -> list[int]:
    """Vehicles whose archive is not decoded with the dictionary of this version."""
    with ground.database.reading() as connection:
        return [one.id for one in all_vehicles(connection) if _behind(one)]


def redecode_job_id(vehicle: int) -> str:
    """Id of the job that decodes a vehicle with the dictionary of this version."""
    return hashlib.blake2b(f"redecode {vehicle} {DICTIONARY.version}".encode(), digest_size=16).hexdigest()


def _behind(vehicle: Vehicle) -> bool:
    return vehicle.decoded_version is not None and vehicle.decoded_version < DICTIONARY.version


def _begin(connection: Connection, vehicle: int, version: int) -> None:
    """Take away what this version gave, and note what is to be decoded: the packets that are there now."""
    writing.forget_samples(connection, vehicle, version)
    last = last_packet(connection, vehicle)
    change_vehicle(connection, vehicle, redecoding_version=version, redecoded_to=0, redecode_until=last)


def _go_on(ground: Ground, vehicle: int, dictionary: Dictionary) -> int:
    rows = 0
    while True:
        ground.check_stopping()
        with ground.database.writing() as connection:
            found = lock_vehicle(connection, vehicle)
            if found.redecoding_version != dictionary.version:
                return rows  # another process has finished it
            done = _block(connection, found, dictionary)
            if done is None:
                return rows
            rows += done


def _block(connection: Connection, vehicle: Vehicle, dictionary: Dictionary) -> int | None:
    """Decode the next packets; None when there are none left, which ends the re-decoding."""
    ids, packets = writing.packets_between(
        connection, vehicle.id, vehicle.redecoded_to or 0, vehicle.redecode_until or 0, BLOCK_PACKETS
    )
    if not packets:
        ended: dict[str, int | None] = dict.fromkeys(("redecoding_version", "redecoded_to", "redecode_until"))
        if dictionary.version == DICTIONARY.version:
            ended["decoded_version"] = dictionary.version
        change_vehicle(connection, vehicle.id, **ended)
        return None
    cut = whole_packets(np.array([len(octets) for octets in packets], dtype=np.int64))
    batch = batch_of_cut(b"".join(packets), cut, dictionary)
    rows = writing.store_samples(connection, vehicle.id, dictionary.version, batch.rows, ids)
    change_vehicle(connection, vehicle.id, redecoded_to=int(ids[-1]))
    return rows


def readable_version(connection: Connection, vehicle: int) -> int:
    """The dictionary version that a vehicle is to be read in: an older one until all is decoded with this one."""
    return decoded_version(connection, vehicle, DICTIONARY.version)
