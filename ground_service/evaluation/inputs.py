"""Stored data of a pass, prepared and read into the plain arrays of the evaluation."""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import EvaluationError, GroundError, InvalidInput
from ground_service.evaluation.alignment import ReferenceStates, reference_states
from ground_service.evaluation.core import PassInputs
from ground_service.evaluation.fixes import IdentificationSamples, MappedCraters, mapped_craters
from ground_service.evaluation.model import changed_figures
from ground_service.evaluation.recall import Viewing
from ground_service.evaluation.smoother import ONBOARD, SIZE, CommandedBurn, FilterStates, MapOffset, StartState
from ground_service.evaluation.verdict import StartOrbit
from ground_service.ground import Ground
from ground_service.missions.catalogues import catalogue_of, read_catalogue
from ground_service.missions.ephemerides import service
from ground_service.missions.ephemerides.model import Ephemeris as EphemerisEntry
from ground_service.missions.frames import DeclaredFrames, assumed_camera, camera_of, declared_frames
from ground_service.missions.model import Camera, Catalogue, Evidence, Mission
from ground_service.missions.service import mission_of_pass
from ground_service.missions.timekeeping.core import largest_step_s
from ground_service.missions.timekeeping.model import Correlation
from ground_service.missions.timekeeping.store import correlations_in_force, load_correlations
from ground_service.passes import sample_store
from ground_service.passes import store as passes
from ground_service.passes.model import PassRecord
from ground_service.passes.packet_accounting import packet_accounting
from ground_service.passes.sample_store import code_labels, detection_samples, event_list, learned_offset_m
from ground_service.passes.span import PassSpan, pass_span
from ground_service.store.files import FileArchive, register_file
from ground_service.store.vehicles import Vehicle, get_vehicle
from ground_service.telemetry.samples import NavigationSamples, OutcomeSamples
from ground_service.telemetry.store import unpack_filter_states, unpack_identifications
from ground_service.toml import read_table
from lunar.boxes import share_outside
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue, format_catalogue
from lunar.constants import MOON_RADIUS_M, NS
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation
from lunar.messages.ephemeris_files import load_arcs
from lunar.timescales import format_utc, parse_utc
from reports.values import HousekeepingParameter, SettingsComparison
from tmtc.dictionary.payload import APID_DETECTIONS, APID_PERFORMANCE, DICTIONARY, DRAWN, STRUCTURES
from tmtc.packets.stream import cut_packets

_UNITS = {"degC": "°C", "1/1000": "‰", "": "packets"}
"""Units of the dictionary as reports write them; a count without a unit is of packets."""


_COMPARED_SECTIONS = {
    "camera", "catalogue", "detector", "dictionary", "experiment", "frames", "link", "observation", "reference",
    "requirements", "time",
}  # fmt: skip
"""Sections of the mission description that a report compares with those of the previous pass: none with addresses."""


class ArchivedImages(Mapping[int, NDArray[np.uint8]]):
    """Archived images of a pass, read from the archive on demand."""

    def __init__(self, files: FileArchive, sha256_by_frame: Mapping[int, str]) -> None:
        self._files = files
        self._sha256 = dict(sha256_by_frame)

    def __getitem__(self, frame_number: int) -> NDArray[np.uint8]:
        return read_image(self._files.get(self._sha256[frame_number]), f"frame {frame_number}")

    def __contains__(self, frame_number: object) -> bool:
        return frame_number in self._sha256

    def __iter__(self) -> Iterator[int]:
        return iter(self._sha256)

    def __len__(self) -> int:
        return len(self._sha256)


def read_image(octets: bytes, name: str) -> NDArray[np.uint8]:
    """An 8-bit image (H, W) or (H, W, 3) from PNG octets.

    Raises
    ------
    InvalidInput
        If the octets are no such image.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(octets)) as image:
            return np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB"), dtype=np.uint8)
    except (UnidentifiedImageError, OSError, ValueError) as error:
        raise InvalidInput(name, "", "a PNG image", str(error)) from None


def load_pass_inputs(ground: Ground, pass_id: int, *, created_utc: str = "") -> PassInputs:
    """Everything that the evaluation of a pass needs, as stored now."""
    with ground.database.reading() as connection:
        record = passes.get_pass(connection, pass_id)
        span = pass_span(connection, record)
        manifest: dict[str, Any] = record.manifest
        mission = mission_of_pass(connection, record.mission_id, record.manifest)
        declared = declared_frames(mission.frames, ground.data)
        viewing = viewing_of(mission.camera, attitude_table(ground.files, record), span)
        vehicle = get_vehicle(connection, record.vehicle_id)
        ephemeris = reference_of(connection, record)
        reference = None if ephemeris is None else load_arcs(ground.files.path(ephemeris.sha256))
        detections = detection_samples(connection, span)
        imaged = reference_states(reference, declared.orientation, detections.utc_ns[detections.usable])
        return PassInputs(
            pass_id=str(pass_id),
            title=record.name,
            start_utc_ns=record.start_utc_ns,
            stop_utc_ns=record.stop_utc_ns,
            packets=packet_accounting(ground.files, connection, record, span),
            viewing=viewing,
            orientation=declared.orientation,
            reference=reference,
            catalogue=_catalogue(ground, record),
            detections=detections,
            navigation=navigation_samples(connection, span),
            outcomes=outcome_samples(connection, span),
            start_state=start_state_of(manifest),
            filter_states=filter_states(connection, span),
            identifications=identification_samples(connection, span),
            landmarks=landmark_reports(connection, span),
            sun_known=manifest.get("light", "real") == "real" and mission.observation.needs_daylight is not False,
            burns=burns_of(manifest),
            onboard_orientation=declared.onboard_orientation,
            gravity=declared.gravity,
            onboard_gravity=declared.onboard_gravity,
            refused=_refused(declared, mission.camera),
            reference_sigma_rtn_m=mission.reference.sigma_rtn_m,
            map_offset=_map_offset(mission.catalogue, learned_offset_m(connection, span)),
            limits=mission.requirements,
            experiment=_experiment(mission, manifest),
            clock_step_s=_clock_step_s(connection, record, span),
            no_mission="" if record.mission_id is not None else _no_mission(vehicle.ccsds_id),
            build=_onboard_build(connection, span),
            cpu_percent=_cpu_percent(connection, span, manifest.get("cadence_s")),
            frames_expected=manifest.get("frames_expected"),
            cadence_s=manifest.get("cadence_s"),
            housekeeping=_housekeeping(connection, span),
            events=event_list(connection, span),
            images=ArchivedImages(ground.files, passes.frame_files(connection, pass_id)),
            provenance=_provenance(
                mission,
                declared,
                manifest,
                record,
                vehicle,
                ephemeris,
                span,
                correlations_in_force(connection, span.vehicle),
            ),
            data_sources=tuple(str(name) for name in manifest.get("data_sources", ())),
            evidence_level=evidence_of_frames(mission.evidence, viewing.camera, imaged).text,
            configuration=_configuration(record, mission),
            comparison=_comparison(connection, record, mission, vehicle),
            scenario_text=_scenario_text(record, mission),
            generated_for="",
            created_utc=created_utc,
        )


def evidence_of_frames(stated: Evidence, camera: PinholeCamera, frames: ReferenceStates) -> Evidence:
    """Return the evidence of a pass: the share of its frames over unseen terrain follows from their ground track.

    Without a reference of any frame the share is unknown. A description without the ground used in training states
    the share itself.
    """
    ground = stated.trained_regions
    if ground is None:
        return stated
    share = share_outside(ground, camera, frames.latitude_rad, frames.longitude_rad, frames.altitude_m)
    return stated.model_copy(update={"unseen_share": share})


def navigation_samples(connection: Connection, span: PassSpan) -> tuple[NavigationSamples, ...]:
    """States of every estimator, in time order."""
    names = (
        "ticks", "estimator", "frame_number", "outcome", "latitude_deg", "longitude_deg", "altitude_m",
        "sigma_r_m", "sigma_t_m", "sigma_n_m", "nis", "matched",
    )  # fmt: skip
    columns = sample_store.sample_arrays(connection, span, "navigation_states", names)
    outcomes = DICTIONARY.labels("navigation_state", "outcome")
    return tuple(
        NavigationSamples(
            estimator=name,
            frame_number=part["frame_number"],
            utc_ns=span.utc_ns(part["ticks"]),
            latitude_deg=part["latitude_deg"],
            longitude_deg=part["longitude_deg"],
            altitude_m=part["altitude_m"],
            sigma_rtn_m=np.column_stack([part["sigma_r_m"], part["sigma_t_m"], part["sigma_n_m"]]),
            nis=part["nis"],
            matched=part["matched"],
            outcome=code_labels(outcomes, part["outcome"]),
        )
        for name, part in _by_estimator(columns, "navigation_state")
    )


def filter_states(connection: Connection, span: PassSpan) -> FilterStates | None:
    """Return the estimates of the navigation filter with their covariances, in time order; None without any."""
    rows = sample_store.samples(connection, span, "filter_states", ("ticks", "values", "innovation_degrees"))
    if not rows["ticks"]:
        return None
    ticks, first = np.unique(np.array(rows["ticks"], dtype=np.int64), return_index=True)
    state, covariance = unpack_filter_states([bytes(rows["values"][i]) for i in first.tolist()], SIZE)
    degrees = [rows["innovation_degrees"][i] for i in first.tolist()]
    return FilterStates(
        span.utc_ns(ticks),
        state,
        covariance,
        ONBOARD,
        np.array([-1 if known is None else known for known in degrees], dtype=np.int64),
    )


def identification_samples(connection: Connection, span: PassSpan) -> IdentificationSamples | None:
    """Return the identified crater of each used detection, in time order; None without telemetry about it."""
    rows = sample_store.samples(connection, span, "identifications", ("ticks", "items"))
    if not rows["ticks"]:
        return None
    by_image = dict(zip(reversed(rows["ticks"]), reversed(rows["items"]), strict=True))
    ticks = sorted(by_image)
    items, offsets = unpack_identifications([bytes(by_image[tick]) for tick in ticks])
    return IdentificationSamples(
        utc_ns=np.repeat(span.utc_ns(ticks), np.diff(offsets)),
        detection=items["detection"].astype(np.int64),
        crater_id=items["crater_id"].astype(np.int64),
    )


def landmark_reports(connection: Connection, span: PassSpan) -> MappedCraters:
    """Every report of a crater that the payload mapped itself, in time order, out of the packets."""
    octets = sample_store.packet_octets(connection, span, APID_DETECTIONS)
    tables = DICTIONARY.unpack_many(octets, cut_packets(octets))
    return mapped_craters(tables.get("landmarks"))


def outcome_samples(connection: Connection, span: PassSpan) -> tuple[OutcomeSamples, ...]:
    """Return the outcome of every estimator by frame, in time order."""
    names = (
        "ticks", "estimator", "frame_number", "outcome", "reset_trigger", "candidate_pairs", "anchor_reads",
    )  # fmt: skip
    columns = sample_store.sample_arrays(connection, span, "frame_outcomes", names)
    outcomes = DICTIONARY.labels("frame_outcome", "outcome")
    triggers = DICTIONARY.labels("frame_outcome", "reset_trigger")
    return tuple(
        OutcomeSamples(
            estimator=name,
            frame_number=part["frame_number"],
            utc_ns=span.utc_ns(part["ticks"]),
            outcome=code_labels(outcomes, part["outcome"]),
            reset_trigger=code_labels(triggers, part["reset_trigger"]),
            candidate_pairs=part["candidate_pairs"],
            anchor_reads=part["anchor_reads"],
        )
        for name, part in _by_estimator(columns, "frame_outcome")
    )


def viewing_of(camera: Camera, attitudes: service.AttitudeTable, span: PassSpan) -> Viewing:
    """Return the pointing of the camera during a pass."""
    message = attitudes.utc_ns
    utc_ns = span.utc_ns(attitudes.image_ticks.tolist()) if message is None else message
    order = np.argsort(utc_ns, kind="stable")
    return Viewing(
        camera_of(camera),
        math.radians(camera.tilt_deg or 0.0),
        math.radians(camera.yaw_deg or 0.0),
        utc_ns[order],
        attitudes.q_wxyz[order],
        interpolated=message is not None,
    )


def attitude_table(files: FileArchive, record: PassRecord) -> service.AttitudeTable:
    """Return the attitude of each frame of a pass from its archive."""
    sha256 = record.attitude_sha256
    return service.no_attitudes() if sha256 is None else service.load_attitudes(files.path(sha256))


def orientation_of(mission: Mission, data: DataFolder) -> Orientation:
    """Return the lunar orientation for the evaluation of a pass.

    Raises
    ------
    EvaluationError
        The mission does not state it, or it is not available on this machine.
    """
    declared = declared_frames(mission.frames, data)
    if declared.orientation is None:
        raise EvaluationError(declared.refused["orientation"])
    return declared.orientation


def _refused(declared: DeclaredFrames, camera: Camera) -> dict[str, str]:
    missing = [name for name in ("pointing", "k1") if getattr(camera, name) is None]
    refused = dict(declared.refused)
    if missing:
        words = {"pointing": "pointing", "k1": "lens"}
        refused["camera"] = (
            f"the mission description does not state the {' and '.join(words[name] for name in missing)} of the "
            "camera: a nadir camera without distortion is assumed for frames without attitude"
        )
    if assumed := assumed_camera(camera):
        refused["camera sizes"] = assumed
    return refused


def _no_mission(spacecraft: int) -> str:
    return (
        f"no mission description of spacecraft {spacecraft} was registered when this pass was planned or defined. "
        "Write one (linna mission write SCENARIO), enter it (linna mission add FILE), then define the pass again."
    )


def _clock_step_s(connection: Connection, record: PassRecord, span: PassSpan) -> float | None:
    """Return the largest step of the clock from the pass before to the end of this one; None without correlation."""
    runs = load_correlations(connection, span.vehicle)
    if not runs:
        return None
    others = passes.passes_of_vehicle(connection, record.vehicle_id)
    before = max((one.stop_utc_ns for one in others if one.stop_utc_ns <= record.start_utc_ns), default=0)
    return largest_step_s(runs, before, record.stop_utc_ns)


def _experiment(mission: Mission, manifest: Mapping[str, Any]) -> StartOrbit | None:
    """Return the orbit that a pass of the experiment starts from; an archive belongs to it if the mission has one."""
    if "window_id" in manifest or "experiment" in manifest:
        stated = manifest.get("experiment") or {}
    else:
        stated = mission.experiment.model_dump(include={"orbit_error_m", "orbit_age_h"})
    return StartOrbit(**stated) if stated.get("orbit_error_m") else None


def start_state_of(manifest: Mapping[str, Any]) -> StartState | None:
    """The state that the estimators were started from, where the manifest names it."""
    given = manifest.get("start_state")
    if not given:
        return None
    return StartState(
        utc_ns=parse_utc(given["utc"]),
        position_icrf_m=np.array(given["position_icrf_m"], dtype=np.float64),
        velocity_icrf_m_s=np.array(given["velocity_icrf_m_s"], dtype=np.float64),
    )


def burns_of(manifest: Mapping[str, Any]) -> tuple[CommandedBurn, ...]:
    """The burns that were commanded during a pass, as the manifest names them."""
    return tuple(
        CommandedBurn(
            parse_utc(burn["utc"]), np.array(burn["delta_v_icrf_m_s"], dtype=np.float64), float(burn["sigma_m_s"])
        )
        for burn in manifest.get("burns", ())
    )


def _by_estimator(columns: dict[str, NDArray[Any]], packet: str) -> list[tuple[str, dict[str, NDArray[Any]]]]:
    """The columns of each estimator by name, one row per frame and time, in an order of content."""
    names = DICTIONARY.labels(packet, "estimator")
    keys = [column for name, column in columns.items() if name not in ("ticks", "frame_number", "estimator")]
    order = np.lexsort([*keys, columns["frame_number"], columns["ticks"], columns["estimator"]])
    identity = np.column_stack([columns[name][order] for name in ("estimator", "ticks", "frame_number")])
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = (np.diff(identity, axis=0) != 0).any(axis=1)
    order = order[first]
    parts = []
    for code in np.unique(columns["estimator"]).tolist():
        rows = order[columns["estimator"][order] == code]
        parts.append((names.get(code, f"estimator {code}"), {name: column[rows] for name, column in columns.items()}))
    return parts


def _housekeeping(connection: Connection, span: PassSpan) -> tuple[HousekeepingParameter, ...]:
    found = []
    for packet in STRUCTURES.values():
        drawn = [field for field in packet.fields if field.name in DRAWN]
        names = ("ticks", *(field.name for field in drawn))
        if packet.name == "housekeeping":
            columns = sample_store.sample_arrays(connection, span, packet.name, names)
        else:
            columns = {}
            for field in drawn:
                columns["ticks"], columns[field.name] = sample_store.packet_values(connection, span, packet, field.name)
        if drawn and len(columns["ticks"]):
            utc_ns = span.utc_ns(columns["ticks"].tolist())
            found += [
                HousekeepingParameter(
                    field.name, _UNITS.get(field.unit, field.unit), utc_ns, columns[field.name].astype(np.float64)
                )
                for field in drawn
            ]
    return tuple(found)


def _onboard_build(connection: Connection, span: PassSpan) -> str:
    """Return the hashes of model and parameters in the last housekeeping packet of a pass; empty without any."""
    columns = sample_store.sample_arrays(connection, span, "housekeeping", ("model_hash", "parameters_hash"))
    if len(columns["model_hash"]) == 0:
        return ""
    model, parameters = int(columns["model_hash"][-1]), int(columns["parameters_hash"][-1])
    return f"model {model:08x}, parameters {parameters:08x}"


def _cpu_percent(connection: Connection, span: PassSpan, cadence_s: float | None) -> float | None:
    """Return the largest processor time of a step over the cadence, in percent of one core; None if unknown."""
    octets = sample_store.packet_octets(connection, span, APID_PERFORMANCE)
    table = DICTIONARY.unpack_many(octets, cut_packets(octets)).get("performance")
    if table is None or not len(table) or not cadence_s:
        return None
    stages = [name for name in table.columns if name.startswith("cpu_") and name.endswith("_ms")]
    total_ms = np.sum([np.asarray(table.columns[name], dtype=np.float64) for name in stages], axis=0)
    known = total_ms[np.isfinite(total_ms)]
    return float(known.max()) / (10.0 * cadence_s) if len(known) else None


def reference_of(connection: Connection, record: PassRecord) -> EphemerisEntry | None:
    if record.ephemeris_id is not None:
        return service.get_ephemeris(connection, record.ephemeris_id)
    spacecraft = get_vehicle(connection, record.vehicle_id, "spacecraft").ccsds_id
    covering = service.covering_ephemerides(connection, record.start_utc_ns, record.stop_utc_ns, spacecraft)
    return covering[0] if covering else None


def _catalogue(ground: Ground, record: PassRecord) -> CraterCatalogue | None:
    sha256 = record.catalogue_sha256
    if sha256 is None:
        return None
    sources = [name for name in record.manifest.get("data_sources", ()) if "catalogue" in str(name)]
    return replace(read_catalogue(ground.files.path(sha256)), source="; ".join(sources) or "catalogue of the pass")


def _correlation_text(lines: Sequence[Correlation]) -> str:
    """Return the time correlations in force of a spacecraft with their residuals."""
    texts = []
    for one in lines:
        residuals = ""
        if one.residual_rms_ns is not None and one.residual_max_ns is not None:
            rms_us, max_us = one.residual_rms_ns * 1e-3, one.residual_max_ns * 1e-3
            residuals = f", residuals {rms_us:.0f} us rms, {max_us:.0f} us at most"
        texts.append(f"{one.id} ({one.points} time reports, drift {one.drift_ppb:.0f} ppb{residuals})")
    return "; ".join(texts) or "0 (ideal clock)"


def _provenance(
    mission: Mission,
    declared: DeclaredFrames,
    manifest: Mapping[str, Any],
    record: PassRecord,
    vehicle: Vehicle,
    ephemeris: EphemerisEntry | None,
    span: PassSpan,
    correlations: Sequence[Correlation],
) -> dict[str, str]:
    build = manifest.get("build") or {}
    gravity = manifest.get("gravity") or {}
    entries = {
        "spacecraft": f"{vehicle.ccsds_id} ({vehicle.instance})",
        "payload build": " ".join(str(build[key]) for key in ("name", "version") if key in build),
        "detector model SHA-256": str(build.get("model_sha256", "")),
        "parameters SHA-256": str(build.get("parameters_sha256", "")),
        "scenario": str(manifest.get("scenario", "")),
        "seed": str(manifest.get("seed", "")),
        "light": str(manifest.get("light", "")),
        "gravity of the truth": f"{gravity['truth']}, degree {gravity.get('degree', '?')}"
        if "truth" in gravity
        else "",
        "mission description": (
            "none registered" if record.mission_id is None else f"{mission.name}, revision {mission.revision[:16]}"
        ),
        "lunar orientation": declared.orientation.name if declared.orientation is not None else "",
        "registration of the crater list": _registration_text(mission.catalogue),
        "dictionary": _dictionary_text(span.dictionary_version),
        "time correlation": _correlation_text(correlations),
        "reference ephemeris": (
            f"{ephemeris.object_name}, {ephemeris.frame}, SHA-256 {ephemeris.sha256[:16]}" if ephemeris else ""
        ),
        "crater catalogue SHA-256": str(record.catalogue_sha256 or "")[:16],
        "archive": str(record.archive_digest or "")[:16],
    }
    return {name: value for name, value in entries.items() if value}


def _map_offset(stated: Catalogue, learned_m: float | None) -> MapOffset | None:
    """Return the offset of the crater list as stated, with the size that the payload learned by the end of the pass."""
    if stated.offset_sigma_m is None or stated.offset_correlation_deg is None:
        return None
    east_m, north_m, up_m = stated.offset_sigma_m
    if learned_m is not None:
        east_m = north_m = learned_m
    return MapOffset((east_m, north_m, up_m), stated.offset_correlation_deg)


def _registration_text(catalogue: Catalogue) -> str:
    """Return where the crater list is registered to the terrain, and its shift; empty if it is not stated."""
    if catalogue.registered_share is None:
        return ""
    if not catalogue.registered_share:
        return "not registered to the terrain: errors of tens of metres are common to all craters"
    return (
        f"in {100.0 * catalogue.registered_share:.0f} % of the frames, mean {catalogue.registration_north_m} m north, "
        f"{catalogue.registration_east_m} m east, sigma {catalogue.registration_sigma_m} m, "
        f"{catalogue.registration_rims} rims"
    )


def _dictionary_text(version: int) -> str:
    if version != DICTIONARY.version:
        return f"version {version}, until the archive is decoded again with version {DICTIONARY.version}"
    return f"version {version}, {DICTIONARY.hash[:16]}"


def _configuration(record: PassRecord, mission: Mission) -> dict[str, dict[str, Any]]:
    camera = record.manifest.get("camera") or mission.camera.model_dump(mode="json", exclude_none=True)
    times = {"start_utc": format_utc(record.start_utc_ns), "stop_utc": format_utc(record.stop_utc_ns)}
    return {**({"camera": camera} if camera else {}), "observation": {**times, **_observation(record)}}


def _observation(record: PassRecord) -> dict[str, Any]:
    keys = ("cadence_s", "frames_expected", "light")
    return {key: record.manifest[key] for key in keys if key in record.manifest}


def _scenario_text(record: PassRecord, mission: Mission) -> str:
    """Return the scenario of an emulated pass: that of its archive, or of the mission description of a live pass."""
    return str(record.manifest.get("scenario_toml") or mission.world.scenario or "")


def _comparison(
    connection: Connection, record: PassRecord, mission: Mission, vehicle: Vehicle
) -> SettingsComparison | None:
    """Return the settings that differ from those of the previous pass of the spacecraft; None for its first pass."""
    previous = passes.previous_pass(connection, record, vehicle.ccsds_id)
    if previous is None:
        return None
    before = _settings(previous, mission_of_pass(connection, previous.mission_id, previous.manifest))
    changes = changed_figures(before, _settings(record, mission))
    return SettingsComparison(previous.name, tuple((one.figure, one.before, one.after) for one in changes))


def _settings(record: PassRecord, mission: Mission) -> dict[str, Any]:
    text = _scenario_text(record, mission)
    try:
        scenario: Any = read_table(text, "scenario", "TOML")
    except InvalidInput:
        scenario = text
    declared = mission.model_dump(mode="json", include=_COMPARED_SECTIONS)
    return {"observation": _observation(record), "mission": declared, "scenario": scenario}


TRACK_STEP_S = 15.0
MARGIN_M = 10_000.0
"""Added to the view of the camera, for errors of pointing and of the reference."""

REACH_LIMIT = 0.1
"""Largest reach as a share of the lunar radius: beyond it craters are foreshortened at the limb."""


def align_pass(ground: Ground, pass_id: int) -> dict[str, Any]:
    """Relate a pass to its reference, correlations and crater catalogue; return what was found and what is missing.

    The catalogue of a live pass is cut from the one that its mission description names and stored with the pass, once.
    What is missing is no error: the pass is evaluated without it, and again when it arrives.
    """
    with ground.database.reading() as connection:
        record = passes.get_pass(connection, pass_id)
        mission = mission_of_pass(connection, record.mission_id, record.manifest)
        span = pass_span(connection, record)
        reference = reference_of(connection, record)
    missing: dict[str, str] = {}
    if reference is None:
        missing["reference"] = "no reference ephemeris covers the pass"
    if not span.correlations:
        missing["correlation"] = "no time correlation: the on-board clock is taken as ideal"
    if not record.manifest.get("start_state"):
        missing["start_state"] = "no start state was uploaded"
    if assumed := assumed_camera(mission.camera):
        missing["camera"] = assumed
    sha256 = record.catalogue_sha256
    if sha256 is None and record.archive_digest is None and reference is not None:
        try:
            ephemeris = load_arcs(ground.files.path(reference.sha256))
            sha256 = _store_catalogue(ground, mission, ephemeris, record)
        except GroundError as error:
            missing["catalogue"] = str(error)
    elif sha256 is None:
        missing["catalogue"] = "no reference to cut the catalogue along" if reference is None else "none archived"
    return {
        "reference": None if reference is None else reference.name,
        "correlations": [one.id for one in span.correlations],
        "catalogue_sha256": sha256,
        "missing": missing,
    }


def _store_catalogue(ground: Ground, mission: Mission, reference: Ephemeris, record: PassRecord) -> str:
    """Cut the catalogue of a mission to the track of a pass, and store it with the pass; return its SHA-256."""
    catalogue = catalogue_of(ground, mission)
    orientation = declared_frames(mission.frames, ground.data).orientation
    if orientation is None:
        raise InvalidInput(mission.name, "frames.orientation", "an available lunar orientation", "none")
    half_diagonal = math.sqrt(2.0) * math.tan(camera_of(mission.camera).fov_rad / 2.0)
    reach = half_diagonal + math.tan(math.radians(abs(mission.camera.tilt_deg or 0.0)))
    step_ns = round(TRACK_STEP_S * NS)
    utc_ns = np.arange(record.start_utc_ns, record.stop_utc_ns + step_ns, step_ns, dtype=np.int64)
    track = reference_states(reference, orientation, utc_ns)
    octets = format_catalogue(along_track(catalogue, track, reach)).encode("ascii")
    stored = ground.files.put_octets(octets)
    with ground.database.writing() as connection:
        register_file(connection, stored, "pass catalogue", catalogue.source, utc_now_ns())
        passes.set_catalogue(connection, record, stored.sha256, catalogue.source)
    return stored.sha256


def along_track(catalogue: CraterCatalogue, track: ReferenceStates, reach: float) -> CraterCatalogue:
    """Return the craters that a camera can see from any covered position of a track.

    Parameters
    ----------
    reach
        Distance on the ground from the sub-satellite point to the edge of the view, over the altitude.
    """
    near = [
        catalogue.near(
            float(track.latitude_rad[i]),
            float(track.longitude_rad[i]),
            float(min(reach * track.altitude_m[i], REACH_LIMIT * MOON_RADIUS_M)) + MARGIN_M,
        )
        for i in np.flatnonzero(track.covered)
    ]
    return catalogue.select(np.unique(np.concatenate(near)) if near else np.zeros(0, dtype=np.int64))
