"""A replay's downlink read with the dictionary of its archive, as frame samples for the gates."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import InvalidInput
from ground_service.evaluation.alignment import reference_states
from ground_service.evaluation.extras import sun_angles
from ground_service.evaluation.inputs import evidence_of_frames, orientation_of
from ground_service.evaluation.recall import Viewing
from ground_service.missions.ephemerides.service import ATTITUDE_FILES, attitude_file, load_attitudes, no_attitudes
from ground_service.missions.frames import camera_of
from ground_service.missions.model import Camera, Evidence, Mission
from ground_service.passes.archive_import import archived_mission
from ground_service.regression.archives import PassArchive, frame_inputs
from ground_service.regression.builds import flat
from ground_service.regression.gates.samples import KINDS, CraterRows, PassFrames, TimeTags, pass_frames
from ground_service.telemetry.samples import DetectionSamples, NavigationSamples, no_detections
from ground_service.toml import read_table
from lunar.arrays import IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue, load_catalogue
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation
from lunar.messages.ephemeris_files import load_orbit
from lunar.timescales import TICKS_PER_SECOND, utc_ns_from_ticks
from tmtc.dictionary.definitions import parse_dictionary
from tmtc.dictionary.schema import Dictionary, Table
from tmtc.downlink import DownlinkDecode, decode
from tmtc.errors import TmtcError

FRAME_TIMES = "frame_times.csv"
NAVIGATION_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "sigma_rtn_m", "nis", "matched")
LOW_KM, LOW_SUN_DEG = 25.0, 20.0
"""Altitude and elevation of the Sun that divide the passes into conditions."""


@dataclass(frozen=True, slots=True, eq=False)
class PassContext:
    """Data of an archived pass that are independent of the build: read once, used for every build.

    `mission` is the revision of the mission description of the archive, `step_ticks` the on-board time of every step of
    the payload, those without an image included.
    """

    name: str
    manifest: Mapping[str, Any]
    frame_ticks: IntArray
    frame_utc_ns: IntArray
    frame_names: tuple[str, ...]
    dictionary: Dictionary
    reference: Ephemeris
    catalogue: CraterCatalogue
    camera: PinholeCamera
    orientation: Orientation
    viewing: Viewing
    evidence: Evidence
    mission: str = ""
    flown: Mapping[str, Any] = field(default_factory=dict)
    step_ticks: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class ReadDownlink:
    """A downlink as samples whose frame numbers are rows of the archive's frames."""

    detections: DetectionSamples
    frames: PassFrames


def pass_context(archive: PassArchive, data: DataFolder) -> PassContext:
    """Return the context of an archived pass, in its declared lunar orientation.

    Raises
    ------
    EvaluationError
        The archive does not declare its lunar orientation, or it is not available on this machine.
    """
    folder = archive.folder
    mission = archived_mission(folder, archive.manifest)
    rows = frame_inputs(folder)
    ticks = np.array([row["ticks"] for row in rows], dtype=np.int64)
    text = (folder / "payload/dictionary.json").read_text(encoding="utf-8")
    utc_ns = _frame_times(folder, [row["frame"] for row in rows], ticks)
    camera = camera_of(mission.camera)
    orientation, reference = orientation_of(mission, data), load_orbit(folder / "reference.oem")
    return PassContext(
        name=archive.name,
        manifest=archive.manifest,
        frame_ticks=ticks,
        frame_utc_ns=utc_ns,
        frame_names=tuple(row["image"] or "" for row in rows),
        dictionary=parse_dictionary(text, str(folder / "payload/dictionary.json")),
        reference=reference,
        catalogue=load_catalogue(folder / "catalogue.csv"),
        camera=camera,
        orientation=orientation,
        viewing=_viewing(folder, mission.camera, camera, ticks, utc_ns),
        evidence=evidence_of_frames(mission.evidence, camera, reference_states(reference, orientation, utc_ns)),
        mission=mission.revision,
        flown=_flown_parameters(folder, mission),
        step_ticks=np.array([row["ticks"] for row in frame_inputs(folder, steps=True)], dtype=np.int64),
    )


def _flown_parameters(folder: Path, mission: Mission) -> dict[str, Any]:
    """Return the parameters of the flight code as they were flown, by dotted name."""
    threshold = mission.detector.score_threshold
    own = {} if threshold is None else {"detector.score_threshold": threshold}
    path = folder / "payload/parameters.toml"
    return own | flat(read_table(path.read_bytes(), str(path), "parameters (TOML)"))


def _viewing(folder: Path, declared: Camera, camera: PinholeCamera, ticks: IntArray, utc_ns: IntArray) -> Viewing:
    """Return the pointing of the camera for the frames of an archive."""
    present = [name for name in ATTITUDE_FILES if (folder / name).is_file()]
    name = attitude_file(present, str(folder))
    table = no_attitudes() if name is None else load_attitudes(folder / name, str(folder / name))
    mounting = (math.radians(declared.tilt_deg or 0.0), math.radians(declared.yaw_deg or 0.0))
    if table.utc_ns is not None:
        return Viewing(camera, *mounting, table.utc_ns, table.q_wxyz, interpolated=True)
    order = np.argsort(ticks, kind="stable")
    rows = np.searchsorted(ticks[order], table.image_ticks)
    known = rows < len(ticks)
    known[known] = ticks[order][rows[known]] == table.image_ticks[known]
    frames = order[rows[known]]
    in_time = np.argsort(utc_ns[frames], kind="stable")
    return Viewing(camera, *mounting, utc_ns[frames][in_time], table.q_wxyz[known][in_time])


def read_downlink(
    context: PassContext,
    octets: bytes,
    performance: Mapping[str, Any] | None = None,
    memory_mib: float = math.nan,
    cpu_s: float = math.nan,
) -> ReadDownlink:
    """Return the received telemetry by frame of the archive.

    Raises
    ------
    InvalidInput
        If there is no packet of the dictionary among the octets.
    """
    try:
        decoded = decode(octets, dictionary=context.dictionary)
    except TmtcError as error:
        raise InvalidInput("downlink", "", "telemetry of the dictionary of its archive", str(error)) from None
    tables = decoded.tables(context.dictionary)
    if not any(len(table) for table in tables.values()):
        raise InvalidInput(
            "downlink",
            "",
            f"packets of dictionary version {context.dictionary.version}",
            f"none among {len(octets)} octets",
        )
    detections = _detections(tables.get("detections"), context)
    outcomes = _outcomes(tables.get("frame_outcome"), context)
    good = decoded.cut.crc_ok
    ticks = _packet_ticks(tables, len(decoded.cut))
    frames = _frames(
        context,
        detections,
        _navigation(tables.get("navigation_state"), context),
        outcomes,
        ticks[good],
        decoded.cut.lengths[good],
    )
    latency_ms = _latency_ms(performance, len(context.frame_ticks))
    return ReadDownlink(
        detections,
        replace(
            frames,
            latency_ms=latency_ms,
            cpu_s=cpu_s,
            undecodable=decoded.unknown + decoded.crc_errors + _meaningless(decoded, tables, context.dictionary),
            memory_mib=memory_mib,
            digests=_digests(decoded, ticks, context.frame_ticks),
            times=_time_tags(decoded, tables, ticks, context),
        ),
    )


def expected_rows(context: PassContext) -> CraterRows:
    """Return the craters that the frames of a pass should show, whatever a build finds."""
    nothing = np.zeros(0, np.int64)
    return _frames(context, no_detections(), {}, {}, nothing, nothing).craters


def condition_of(context: PassContext) -> str:
    """Return terrain, altitude and, where it is that of the ephemeris, elevation of the Sun of a pass in words."""
    kind = KINDS[int(np.mean(np.append(expected_rows(context).kind, 0)) > 0.5)]
    track = reference_states(context.reference, context.orientation, context.frame_utc_ns)
    limits = [(float(np.nanmedian(track.altitude_m)) / 1e3, LOW_KM, "km")]
    if context.manifest.get("light", "real") == "real":
        limits.append((float(np.nanmedian(sun_angles(track).elevation_deg)), LOW_SUN_DEG, "degrees of Sun"))
    return ", ".join(
        [kind, *(f"{'below' if value < limit else 'above'} {limit:g} {unit}" for value, limit, unit in limits)]
    )


def _frames(context: PassContext, *received: Any) -> PassFrames:
    """Return the frames of a pass with what was received."""
    known = (context.reference, context.catalogue, context.camera, context.orientation, context.viewing)
    arguments: tuple[Any, ...] = (context.frame_ticks, context.frame_utc_ns, *received, *known)
    return pass_frames(*arguments)


def _digests(decoded: DownlinkDecode, ticks: IntArray, frame_ticks: IntArray) -> tuple[bytes, ...]:
    hashes = [hashlib.sha256() for _ in range(len(frame_ticks) + 1)]
    rows = np.searchsorted(frame_ticks, ticks[decoded.cut.crc_ok], side="right").tolist()
    for row, packet in zip(rows, decoded.cut.packets(decoded.buffer), strict=True):
        hashes[row].update(packet)
    return tuple(one.digest() for one in hashes)


def _time_tags(decoded: DownlinkDecode, tables: Mapping[str, Table], ticks: IntArray, context: PassContext) -> TimeTags:
    unknown: dict[str, int] = {}
    delays: dict[str, NDArray[np.float64]] = {}
    steps = np.unique(np.concatenate((context.step_ticks, context.frame_ticks)))
    for name, table in tables.items():
        if len(table) == 0 or len(steps) == 0:
            continue
        since = steps[np.maximum(np.searchsorted(steps, table.ticks, side="right") - 1, 0)]
        if "image_ticks" in table.columns:
            named = np.asarray(table.columns["image_ticks"], dtype=np.int64)
            known = _rows(table, context)[1]
            unknown[name] = int(np.count_nonzero(~known))
            since = np.where(known, named, since)
        delays[name] = (table.ticks - since) / TICKS_PER_SECOND
    backwards = 0
    for apid in np.unique(decoded.headers.apid).tolist():
        backwards += int(np.count_nonzero(np.diff(ticks[decoded.headers.apid == apid]) < 0))
    return TimeTags({name: len(table) for name, table in tables.items()}, unknown, delays, backwards)


def _frame_times(folder: Path, numbers: list[int], ticks: IntArray) -> IntArray:
    """UTC of every frame: as the archive correlates it, else by an ideal clock."""
    path = folder / FRAME_TIMES
    if not path.is_file():
        return np.asarray(utc_ns_from_ticks(ticks), dtype=np.int64)
    try:
        rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()[1:]]
        times = {int(number): int(utc) for number, utc in rows}
        return np.array([times[number] for number in numbers], dtype=np.int64)
    except (ValueError, KeyError) as error:
        raise InvalidInput(str(path), "", "the UTC of every frame in ns", str(error)) from None


def _rows(table: Table, context: PassContext) -> tuple[IntArray, NDArray[np.bool_]]:
    """Row of the archive's frame that each packet speaks of, by on-board time, and which of them speak of one."""
    ticks = np.asarray(table.columns["image_ticks"], dtype=np.int64)
    order = np.argsort(context.frame_ticks, kind="stable")
    if len(order) == 0:
        return ticks, np.zeros(len(ticks), dtype=np.bool_)
    at = np.minimum(np.searchsorted(context.frame_ticks[order], ticks), len(order) - 1)
    row = order[at]
    return row, context.frame_ticks[row] == ticks


def _detections(table: Table | None, context: PassContext) -> DetectionSamples:
    if table is None or len(table) == 0:
        return no_detections()
    row, known = _rows(table, context)
    packets = np.flatnonzero(known)
    packets = packets[np.unique(row[packets], return_index=True)[1]]
    owners = table.item_owner
    items = np.concatenate([np.flatnonzero(owners == packet) for packet in packets] or [owners[:0]])
    counts = np.bincount(owners, minlength=len(table))[packets]
    return DetectionSamples(
        frame_number=row[packets],
        utc_ns=context.frame_utc_ns[row[packets]],
        usable=np.asarray(table.columns["image_quality"][packets] == 0, dtype=np.bool_),
        quality=(),
        offsets=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        u_px=table.items["u_px"][items],
        v_px=table.items["v_px"][items],
        diameter_px=table.items["diameter_px"][items],
        score=table.items["score"][items],
        size_class=table.items["size_class"][items].astype(np.int64),
    )


def _navigation(table: Table | None, context: PassContext) -> dict[str, NavigationSamples]:
    if table is None or len(table) == 0:
        return {}
    row, known = _rows(table, context)
    names = context.dictionary.labels("navigation_state", "estimator")
    estimator = np.asarray(table.columns["estimator"], dtype=np.int64)
    samples = {}
    for code, name in names.items():
        chosen = np.flatnonzero(known & (estimator == code))
        chosen = chosen[np.unique(row[chosen], return_index=True)[1]]
        if len(chosen) == 0:
            continue
        columns = {key: table.columns[key][chosen] for key in NAVIGATION_COLUMNS}
        utc_ns = context.frame_utc_ns[row[chosen]]
        samples[name] = NavigationSamples(name, row[chosen], utc_ns, **columns, outcome=())
    return samples


def _outcomes(table: Table | None, context: PassContext) -> dict[str, dict[int, str]]:
    if table is None:
        return {}
    row, known = _rows(table, context)
    estimators = context.dictionary.labels("frame_outcome", "estimator")
    outcomes = context.dictionary.labels("frame_outcome", "outcome")
    found: dict[str, dict[int, str]] = {}
    for i in np.flatnonzero(known).tolist():
        estimator = estimators.get(int(table.columns["estimator"][i]), "")
        outcome = outcomes.get(int(table.columns["outcome"][i]), "")
        found.setdefault(estimator, {}).setdefault(int(row[i]), outcome)
    return found


def _packet_ticks(tables: Mapping[str, Table], packets: int) -> IntArray:
    """On-board time of every packet of the stream; those that could not be decoded take that of the one before."""
    ticks = np.full(packets, -1, dtype=np.int64)
    for table in tables.values():
        ticks[table.packet_index] = table.ticks
    known = ticks >= 0
    if not known.any():
        return np.zeros(packets, dtype=np.int64)
    last = np.maximum.accumulate(np.where(known, np.arange(packets), -1))
    return np.where(last >= 0, ticks[np.maximum(last, 0)], ticks[known][0])


def _meaningless(decoded: DownlinkDecode, tables: Mapping[str, Table], dictionary: Dictionary) -> int:
    """Packets that have the length and checksum of their kind but hold codes or places that mean nothing."""
    bad = np.zeros(len(decoded.cut), dtype=np.bool_)
    for name, table in tables.items():
        if len(table) == 0:
            continue
        wrong = np.zeros(len(table), dtype=np.bool_)
        for item in dictionary.packet(name).fields:
            if item.labels and item.name in table.columns:
                wrong |= ~np.isin(table.raw[item.name], [code for code, _ in item.labels])
        if name == "navigation_state":
            wrong |= ~(np.abs(np.nan_to_num(table.columns["latitude_deg"])) <= 90.0)
        bad[table.packet_index[wrong]] = True
    return int(np.count_nonzero(bad))


def _latency_ms(performance: Mapping[str, Any] | None, frames: int) -> dict[str, NDArray[np.float64]]:
    """Return the CPU time of each stage that is reported for every frame."""
    stages = {} if performance is None else performance["stages"]
    # A stage that took no time did not run: a frame without an image says nothing about the network.
    return {
        name: np.where(np.array(values) > 0.0, values, np.nan)
        for name, values in stages.items()
        if len(values) == frames
    }
