"""A batch of packets as the store takes it: headers, octets and digests, and decoded rows as columns."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import IntArray
from lunar.constants import NS
from lunar.timescales import utc_ns_from_ticks
from tmtc.arrays import Octets, as_octets
from tmtc.dictionary.estimates import ESTIMATE_PACKETS, filter_estimates
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary, Table, gather
from tmtc.packets.pus import NO_TICKS, onboard_ticks
from tmtc.packets.stream import PacketCut, primary_headers

Columns = dict[str, Any]

DIGEST_OCTETS = 16

CLOCKS_AGREE_NS = 60 * NS
"""Largest difference of the on-board clock from the reception time of its report, light time included.

Two independent clocks that agree are believed. A larger difference is a wrong clock of the station, or a report that
was played back from the store."""

NO_TIME = -1
"""Reception time of a CADU whose record states none."""

_TIMED_HEADER = np.dtype(
    [("primary", "V6"), ("pus", "u1"), ("kind", "V6"), ("p_field", "u1"), ("coarse", ">u4"), ("fine", ">u2")]
)
_PUS_C = 2
_CUC_AGENCY_4_2 = 0x2E


@dataclass(frozen=True, slots=True, eq=False)
class PacketBatch:
    """Checked packets of one stretch of a downlink, arrays and lists (n,).

    `spacecraft_id` is None where the stream does not say whose the packets are. `ticks` is the on-board time of the
    packet, `NO_TICKS` where it carries none. `rows` holds, per kind of sample,
    the decoded columns and in ``"packet"`` the index of each row's packet in this batch. `received_utc_ns` is the
    reception time in the records of the station, `NO_TIME` where there is none; None: no such times.
    """

    apid: IntArray
    sequence_count: IntArray
    ticks: IntArray
    octets: list[bytes]
    digest: list[bytes]
    spacecraft_id: int | None
    dictionary_version: int
    rows: Mapping[str, Columns]
    unknown: int
    received_utc_ns: IntArray | None = None

    def __len__(self) -> int:
        return len(self.octets)

    def count_of(self, index: int) -> int:
        """Return the sequence count of a packet."""
        return int(self.sequence_count[index])


def batch_of_cut(
    buffer: Octets,
    cut: PacketCut,
    dictionary: Dictionary = DICTIONARY,
    spacecraft_id: int | None = None,
    received_utc_ns: IntArray | None = None,
) -> PacketBatch:
    """The packets of `cut` whose checksum holds, with what the dictionary decodes from them.

    `received_utc_ns` (n,) are the reception times of the packets of `cut`.
    """
    good = np.flatnonzero(cut.crc_ok)
    headers = primary_headers(buffer, cut)
    tables = dictionary.unpack_many(buffer, cut)
    place = np.full(len(cut), -1, dtype=np.int64)
    place[good] = np.arange(len(good))
    view = as_octets(buffer).data
    octets = [
        bytes(view[start : start + length])
        for start, length in zip(cut.offsets[good].tolist(), cut.lengths[good].tolist(), strict=True)
    ]
    known = sum(len(table) for table in tables.values())
    return PacketBatch(
        apid=headers.apid[good],
        sequence_count=headers.sequence_count[good],
        ticks=packet_ticks(buffer, cut, good, headers.secondary_header[good]),
        octets=octets,
        digest=[hashlib.blake2b(packet, digest_size=DIGEST_OCTETS).digest() for packet in octets],
        spacecraft_id=spacecraft_id,
        dictionary_version=dictionary.version,
        rows=decoded_rows(tables, place),
        unknown=len(good) - known,
        received_utc_ns=None if received_utc_ns is None else received_utc_ns[good],
    )


def time_receptions(batch: PacketBatch) -> dict[tuple[int, int], int]:
    """Return the reception times (UTC, ns) of the time reports of a batch, by packet time and sequence count.

    Left out are reports without a reception time, and those from whose reception the on-board clock differs by more
    than `CLOCKS_AGREE_NS`.
    """
    reports = batch.rows.get("time_reports")
    if reports is None or batch.received_utc_ns is None:
        return {}
    packet = reports["packet"]
    received = batch.received_utc_ns[packet]
    shown = np.asarray(utc_ns_from_ticks(reports["reported_ticks"]))
    live = (received != NO_TIME) & (np.abs(received - shown) <= CLOCKS_AGREE_NS)
    found: dict[tuple[int, int], int] = {}
    for index, time in zip(packet[live].tolist(), received[live].tolist(), strict=True):
        key = int(batch.ticks[index]), int(batch.sequence_count[index])
        found[key] = min(found.get(key, time), time)
    return found


def decoded_rows(tables: Mapping[str, Table], place: IntArray) -> dict[str, Columns]:
    """Columns of each kind of sample; `place` maps the packet index of a table to the index in the batch."""
    rows: dict[str, Columns] = {}
    for kind, names, translate in _KINDS:
        pieces = [translate(table, place) for name, table in tables.items() if name in names]
        if pieces:
            rows[kind] = pieces[0] if len(pieces) == 1 else _joined(pieces)
    return rows


def _joined(pieces: list[Columns]) -> Columns:
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def packet_ticks(buffer: Octets, cut: PacketCut, good: IntArray, secondary_header: NDArray[np.bool_]) -> IntArray:
    """Return the on-board time (n,) of PUS-C packets with CUC 4+2 time (agency epoch); `NO_TICKS` for all others."""
    ticks = np.full(len(good), NO_TICKS, dtype=np.int64)
    long_enough = np.flatnonzero(secondary_header & (cut.lengths[good] >= _TIMED_HEADER.itemsize))
    header = gather(as_octets(buffer), cut.offsets[good[long_enough]], _TIMED_HEADER)
    timed = (header["pus"] >> 4 == _PUS_C) & (header["p_field"] == _CUC_AGENCY_4_2)
    ticks[long_enough[timed]] = header["coarse"][timed].astype(np.int64) << 16 | header["fine"][timed]
    return ticks


def _housekeeping(table: Table, place: IntArray) -> Columns:
    columns = {name: column for name, column in table.columns.items() if name != "structure_id"}
    return {"packet": place[table.packet_index], "ticks": table.ticks, **columns}


def _frame_columns(table: Table, place: IntArray) -> Columns:
    """Columns that every sample of an image has; its time is that of the image, not of the packet."""
    return {
        "packet": place[table.packet_index],
        "ticks": onboard_ticks(table.columns["image_ticks"]),
        "packet_ticks": table.ticks,
        "frame_number": table.columns["frame_number"],
    }


def _detections(table: Table, place: IntArray) -> Columns:
    return {**_identifications(table, place), "image_quality": table.columns["image_quality"]}


def _navigation(table: Table, place: IntArray) -> Columns:
    columns = table.columns
    velocity, sigma = columns["velocity_icrf_m_s"], columns["sigma_rtn_m"]
    return {
        **_frame_columns(table, place),
        **{name: columns[name] for name in ("estimator", "outcome", "latitude_deg", "longitude_deg", "altitude_m")},
        **{f"velocity_{axis}_m_s": velocity[:, i] for i, axis in enumerate("xyz")},
        **{f"sigma_{axis}_m": sigma[:, i] for i, axis in enumerate("rtn")},
        "nis": columns["nis"],
        "matched": columns["matched"],
    }


def _outcomes(table: Table, place: IntArray) -> Columns:
    names = (
        "estimator",
        "outcome",
        "reset_trigger",
        "detections",
        "candidate_pairs",
        "pairs",
        "shift_east_m",
        "shift_north_m",
        "anchor_reads",
    )
    return {**_frame_columns(table, place), **{name: table.columns[name] for name in names}}


def _filter_states(table: Table, place: IntArray) -> Columns:
    estimates = filter_estimates({table.name: table})
    degrees = estimates.innovation_degrees.astype(np.float64)
    return {
        **_frame_columns(table, place),
        "state": estimates.state,
        "covariance": estimates.covariance,
        "innovation_degrees": _optional(np.where(degrees >= 0.0, degrees, np.nan)),
    }


def _identifications(table: Table, place: IntArray) -> Columns:
    counts = table.columns["count"]
    return {
        **_frame_columns(table, place),
        "count": counts,
        "items": table.items,
        "offsets": np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
    }


_SEVERITIES = {"event_info": 1, "event_low": 2, "event_medium": 3, "event_high": 4}


def _events(table: Table, place: IntArray) -> Columns:
    return {
        "packet": place[table.packet_index],
        "ticks": table.ticks,
        "severity": np.full(len(table), _SEVERITIES[table.name], dtype=np.int64),
        **{name: table.columns[name] for name in ("event_id", "frame_number", "value_1", "value_2")},
    }


def _time_reports(table: Table, place: IntArray) -> Columns:
    return {
        "packet": place[table.packet_index],
        "ticks": table.ticks,
        "reported_ticks": onboard_ticks(table.columns["reported_ticks"]),
        "rate_exponent": table.columns["rate_exponent"],
    }


_VERIFICATION_SUBTYPES = {
    definition.name: definition.subtype for definition in DICTIONARY.telemetry if definition.service == 1
}


def _verifications(table: Table, place: IntArray) -> Columns:
    unknown = np.full(len(table), np.nan)
    return {
        "packet": place[table.packet_index],
        "ticks": table.ticks,
        "subtype": np.full(len(table), _VERIFICATION_SUBTYPES[table.name], dtype=np.int64),
        "request_id": table.columns["request_id"],
        "step": _optional(table.columns.get("step", unknown)),
        "failure_code": _optional(table.columns.get("failure_code", unknown)),
    }


def _optional(column: NDArray[Any]) -> NDArray[np.object_]:
    """Whole numbers or None, for a column that not every packet of the kind has."""
    values = [None if value != value else int(value) for value in column.tolist()]
    result = np.empty(len(values), dtype=object)
    result[:] = values
    return result


_Translation = Callable[[Table, IntArray], Columns]

_KINDS: tuple[tuple[str, frozenset[str], _Translation], ...] = (
    ("housekeeping", frozenset({"housekeeping"}), _housekeeping),
    ("detections", frozenset({"detections"}), _detections),
    ("navigation_states", frozenset({"navigation_state"}), _navigation),
    ("frame_outcomes", frozenset({"frame_outcome"}), _outcomes),
    ("events", frozenset(_SEVERITIES), _events),
    ("time_reports", frozenset({"time_report"}), _time_reports),
    ("verifications", frozenset(_VERIFICATION_SUBTYPES), _verifications),
    ("filter_states", frozenset(ESTIMATE_PACKETS), _filter_states),
    ("identifications", frozenset({"identifications"}), _identifications),
)
"""Kinds of samples, the packets they come from, and how."""
