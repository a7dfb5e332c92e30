"""Accounting of the packets, frames and octets of one pass: received, missing, damaged and duplicate.

Missing packets follow from sequence counts and from the planned frames. Frames and octets are those of the recordings
with on-board times in the pass (`passes.downlink_accounting`); other passes of the spacecraft have no influence.
"""

import threading
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.ingest.link_settings import packet_form
from ground_service.ingest.model import ReceivedLink
from ground_service.ingest.store import Received, recordings_of_vehicle
from ground_service.passes import sample_store
from ground_service.passes.downlink_accounting import Gap, RawAccount, RawFile, account_raw, account_sequence, read_raw
from ground_service.passes.model import PassRecord
from ground_service.passes.span import STARTED, STOPPED, PassSpan
from ground_service.store.files import FileArchive
from ground_service.store.vehicles import get_vehicle
from ground_service.telemetry import store as telemetry
from lunar.arrays import IntArray
from reports.values import ApidAccounting, CompletenessSeries, PacketAccounting, ReceptionQuality
from tmtc.dictionary.payload import APID_DETECTIONS, DICTIONARY
from tmtc.link.link_plan import LinkSection
from tmtc.link.settings import LinkSettings
from tmtc.packets.stream import PacketForm

COMPLETENESS_BINS = 60
GAP_POINTS = 256

KEPT_OCTETS = 64 << 20
"""Memory of the contents of raw files that are kept: those of about a million packets, in files of any size."""

RAW_LIMIT_OCTETS = 128 << 20
"""Largest size of recordings that are read again for a report; above it, the dependent values are not computed."""


def packet_accounting(
    files: FileArchive, connection: Connection, record: PassRecord, span: PassSpan
) -> PacketAccounting:
    """Return the packet and octet accounting of a pass."""
    headers = telemetry.packet_headers(connection, span.vehicle, span.start_ticks, span.stop_ticks)
    recordings = recordings_of_vehicle(connection, span.vehicle, span.start_ticks, span.stop_ticks)
    runs = [run for pieces in recordings for run in _runs(pieces)]
    vehicle = get_vehicle(connection, span.vehicle)
    own = vehicle.ccsds_id, vehicle.instance
    forms = {one: packet_form(connection, *own, one) for one in {run.station for run in runs}}
    raw = _raw_account(files, vehicle.ccsds_id, runs, forms, span)
    names = _apid_names()
    by_apid: dict[int, ApidAccounting] = {}
    lost = np.zeros((0, 2), dtype=np.float64)
    accounts = {}
    for apid in np.unique(headers["apid"]).tolist():
        here = headers["apid"] == apid
        accounts[apid] = account_sequence(headers["ticks"][here], headers["sequence_count"][here])
        lost = np.concatenate([lost, *(_spread(gap) for gap in accounts[apid].gaps)])
    images = _images(connection, span)
    in_gaps = accounts[APID_DETECTIONS].lost if APID_DETECTIONS in accounts else 0
    edges = _frames_at_edges(record.manifest.get("frames_expected"), images, in_gaps)
    damaged = {} if raw is None else raw.crc_errors
    for apid in sorted({*accounts, *(apid for apid in damaged if apid in names)}):
        account = accounts.get(apid)
        packets = 0 if account is None else len(account.order)
        missing = 0 if account is None else account.lost
        by_apid[apid] = ApidAccounting(
            name=names.get(apid, "unknown"),
            packets=packets,
            lost=missing,
            duplicates=None if raw is None else raw.duplicates.get(apid, 0),
            conflicts=0 if account is None else account.conflicts,
            crc_errors=None if raw is None else damaged.get(apid, 0),
            lost_at_edges=_packets_at_edges(apid, edges, packets + missing, images.count + in_gaps),
        )
    return PacketAccounting(
        packets=len(headers["apid"]),
        lost=sum(apid.lost for apid in by_apid.values()),
        duplicates=None if raw is None else sum(raw.duplicates.values()),
        conflicts=sum(apid.conflicts for apid in by_apid.values()),
        crc_errors=None if raw is None else sum(damaged.values()),
        octets_skipped=None if raw is None else raw.octets_skipped,
        frames=None if raw is None else raw.frames,
        frames_bad=None if raw is None else raw.frames_bad,
        symbols_corrected=None if raw is None else raw.symbols_corrected,
        lost_at_edges=None if edges is None else sum(apid.lost_at_edges or 0 for apid in by_apid.values()),
        octets=None if raw is None else raw.octets,
        receptions=_receptions(recordings),
        by_apid=by_apid,
        completeness=_completeness(record, span, headers["ticks"], lost),
    )


@dataclass(frozen=True, slots=True)
class _Part:
    """Octets [start, stop) of a file."""

    sha256: str
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class _Run:
    """Contiguous octets of a recording of a station.

    `sections` are those of its link settings; none: they follow from the octets.
    """

    station: str
    parts: tuple[_Part, ...]
    sections: tuple[LinkSection, ...]

    @property
    def octets(self) -> int:
        """Number of octets."""
        return sum(one.stop - one.start for one in self.parts)


def _raw_account(
    files: FileArchive, spacecraft: int, runs: list[_Run], forms: dict[str, PacketForm], span: PassSpan
) -> RawAccount | None:
    """Return sums over the recordings of the vehicle; None without any, or if one is too large.

    `forms`: of its packets, by station.
    """
    if not runs or any(one.octets > RAW_LIMIT_OCTETS for one in runs):
        return None
    found = [_RAW_FILES.get(files, one, spacecraft, forms[one.station]) for one in runs]
    return account_raw(found, span.start_ticks, span.stop_ticks)


def _runs(pieces: list[Received]) -> list[_Run]:
    """Return the contiguous octets of a recording, each octet once."""
    runs: list[list[tuple[Received, _Part]]] = []
    reached = -1
    for one in pieces:
        start = max(reached - one.position, 0)
        if one.position > reached:
            runs.append([])
        if start < one.octets or not runs[-1]:
            runs[-1].append((one, _Part(one.sha256, start, one.octets)))
            reached = one.position + one.octets
    return [_Run(run[0][0].station, tuple(part for _, part in run), _sections([one for one, _ in run])) for run in runs]


def _sections(pieces: list[Received]) -> tuple[LinkSection, ...]:
    """Return the sections of a run; none if they are not known, or are different in its pieces."""
    names = {one.name for one in fields(LinkSettings)}
    receptions = [one.result.reception for one in pieces if one.result and one.result.reception]
    found = [
        LinkSection(one.start, one.stop, LinkSettings(**one.model_dump(include=names, exclude_none=True)))
        for reception in receptions
        for one in reception.sections
    ]
    if len(pieces) == 1:
        return tuple(found)
    octets = pieces[-1].position + pieces[-1].octets - pieces[0].position
    same = {one.settings for one in found}
    return (LinkSection(0, octets, same.pop()),) if len(same) == 1 else ()


def _receptions(recordings: list[list[Received]]) -> tuple[ReceptionQuality, ...]:
    """Return the link quality of the recordings of the pass, by station and time."""
    found = []
    for pieces in recordings:
        received = [one.result.reception for one in pieces if one.result and one.result.reception]
        if received:
            octets = sum(run.octets for run in _runs(pieces))
            found.append(_reception(received, octets))
    return tuple(sorted(found, key=lambda one: (one.station, one.first_utc_ns or 0, one.octets)))


def _reception(received: list[ReceivedLink], octets: int) -> ReceptionQuality:
    """Return the link quality of a recording of this number of octets from that of its pieces."""

    def total(name: str) -> int:
        return sum(getattr(one, name) for one in received)

    checked = total("checked_bits")
    firsts = [one.first_utc_ns for one in received if one.first_utc_ns is not None]
    lasts = [one.last_utc_ns for one in received if one.last_utc_ns is not None]
    return ReceptionQuality(
        station=received[0].station,
        source=", ".join(sorted({section.source for one in received for section in one.sections})),
        frames=total("frames"),
        frames_good=total("frames_good"),
        symbols_corrected=total("symbols_corrected"),
        bit_error_rate=total("wrong_bits") / checked if checked else None,
        lock_losses=total("lock_losses"),
        octets=octets,
        # frames that cannot be used may be counted with both pieces at a border
        octets_other=max(octets - total("octets_frames") - total("octets_records"), 0),
        first_utc_ns=min(firsts, default=None),
        last_utc_ns=max(lasts, default=None),
    )


class _RawFiles:
    """Content of recordings, of which the last ones used are kept: the file of a hash never changes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[Hashable, RawFile] = OrderedDict()
        self._octets = 0

    def get(self, files: FileArchive, run: _Run, spacecraft_id: int, form: PacketForm) -> RawFile:
        """Return the content of a run."""
        key = (files.root, run, spacecraft_id, form)
        with self._lock:
            if (found := self._kept.get(key)) is not None:
                self._kept.move_to_end(key)
                return found
        octets = b"".join(files.get(one.sha256)[one.start : one.stop] for one in run.parts)
        found = read_raw(octets, spacecraft_id, run.sections, form)
        with self._lock:
            if key not in self._kept:
                self._kept[key] = found
                self._octets += found.octets
            while self._octets > KEPT_OCTETS:
                self._octets -= self._kept.popitem(last=False)[1].octets
        return found


_RAW_FILES = _RawFiles()


@dataclass(frozen=True, slots=True)
class _Images:
    """Reported images: number, first and last frame number; and the frame counter of the payload.

    `first_made` and `after_last_made` are the frame counter at the start and at the end of the observation, None if
    the event with the counter was not received.
    """

    count: int
    first: int
    last: int
    first_made: int | None
    after_last_made: int | None


def _images(connection: Connection, span: PassSpan) -> _Images:
    images = sample_store.sample_arrays(connection, span, "detections", ("ticks", "frame_number"))
    events = sample_store.sample_arrays(connection, span, "events", ("event_id", "frame_number"))
    started = events["frame_number"][events["event_id"] == STARTED]
    stopped = events["frame_number"][events["event_id"] == STOPPED]
    return _Images(
        np.unique(images["ticks"]).size,
        int(images["frame_number"].min()) if images["ticks"].size else 0,
        int(images["frame_number"].max(initial=-1)),
        int(started.min()) if started.size else None,
        int(stopped.max()) if stopped.size else None,
    )


def _frames_at_edges(planned: object, images: _Images, in_gaps: int) -> int | None:
    """Return the number of frames missing before the first or after the last received frame; None if unknown.

    It follows from the frame counter at start and end of the observation; without both, from the plan.
    """
    start, stop = images.first_made, images.after_last_made
    if images.count and start is not None and stop is not None and start <= images.first and images.last < stop:
        return images.first - start + stop - 1 - images.last
    if not isinstance(planned, int) or isinstance(planned, bool):
        return None
    return max(planned - images.count - in_gaps, 0)


def _packets_at_edges(apid: int, frames: int | None, packets: int, of_frames: int) -> int | None:
    """Return the expected packets of an application process for the frames at the edges; None if unknown."""
    if frames is None or apid not in _IMAGE_APIDS:
        return None
    if frames == 0:
        return 0
    return frames * round(packets / of_frames) if of_frames else None


_IMAGE_APIDS = frozenset(
    definition.apid
    for definition in DICTIONARY.telemetry
    if any(field.name == "image_ticks" for field in definition.fields)
)
"""Application processes whose packets are generated for images."""


def _apid_names() -> dict[int, str]:
    names: dict[int, str] = {}
    for definition in DICTIONARY.telemetry:
        names.setdefault(definition.apid, definition.name.split("_info")[0].replace("_", " "))
    return names


def _completeness(
    record: PassRecord, span: PassSpan, ticks: IntArray, lost: NDArray[np.float64]
) -> CompletenessSeries | None:
    if len(ticks) == 0:
        return None
    edges = np.linspace(record.start_utc_ns, record.stop_utc_ns, COMPLETENESS_BINS + 1).astype(np.int64)
    received = np.histogram(np.clip(span.utc_ns(ticks), edges[0], edges[-1]), edges)[0]
    when = np.clip(span.utc_ns(lost[:, 0].astype(np.int64)), edges[0], edges[-1])
    missing = np.histogram(when, edges, weights=lost[:, 1])[0]
    return CompletenessSeries(edges, received + np.rint(missing).astype(np.int64), received.astype(np.int64))


def _spread(gap: Gap) -> NDArray[np.float64]:
    """Return the on-board times (k, 2) over which the packets of a gap are distributed, and their numbers."""
    points = min(gap.missing, GAP_POINTS)
    ticks = np.linspace(gap.before_ticks, gap.after_ticks, points + 2)[1:-1]
    return np.column_stack([ticks, np.full(points, gap.missing / points)])
