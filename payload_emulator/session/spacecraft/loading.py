"""Uploads to the payload before a window: model, parameters, tables.

It is made by the ground from the ground's own knowledge (reference ephemeris, catalogue, gravity field). Nothing of the
simulated truth passes through here except what a scenario declares to be known.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue, load_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris
from lunar.frames import IauOrientation, Orientation
from lunar.gravity import GravityField, builtin_gravity, load_gravity
from lunar.timescales import format_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.errors import ModelError
from payload_emulator.flight.models import NETWORKS, load_shipped_model
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.filter.filter import CommonErrors
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule
from payload_emulator.flight.navigation.odometry.odometry import OdometryParameters
from payload_emulator.flight.navigation.outcomes import Mode
from payload_emulator.flight.payload import FlightParameters, FlightTables, Payload, PayloadMode
from payload_emulator.flight.ports import Board
from payload_emulator.flight.vision.detections import Detector
from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.spacecraft.parameter_file import BuildParameters, format_parameters, parse_parameters
from payload_emulator.session.world.regions import displaced, observed_craters
from payload_emulator.session.world.world import (
    World,
    catalogue_near_track,
    open_world,
    sample_truth,
    with_reference_error,
)
from payload_emulator.sim.orbit.truth import TrueBurn
from tmtc.dictionary.tables import (
    BurnTable,
    CatalogueTable,
    GravityTable,
    InitialState,
    pack_anchor_table,
    pack_burn_table,
    pack_catalogue_table,
    pack_gravity_table,
    pack_initial_state,
    pack_orientation_table,
    unpack_catalogue_table,
)
from tmtc.errors import TableError

# Memory of a launched spacecraft is checked at this interval, which a mission of months can afford.
_SCRUB_S = 600.0
_ANCHOR_STEP_NS = 15_000_000_000
_ORIENTATION_STEP_NS = 3_600_000_000_000
_ORIENTATION_MARGIN_NS = 4 * _ORIENTATION_STEP_NS

# Without a second available field the filter flies the built-in one cut to this degree: never the field of the truth.
_CUT_DEGREE = 8
# Craters shallower than this share of their diameter can hardly be seen by anyone; a quarter of a real list is so.
_VISIBLE_DEPTH_RATIO = 0.025
# Error of rim heights taken from a raster of 128 pixels per degree, 1 sigma. That of a real list's centres is part of
# what the detector states for its own: it was calibrated against the list.
_HEIGHT_SIGMA_M = 50.0
# Where the network places the centres of real craters: this far below the mean height of the listed rim circle, after
# its correction of the parallax of the walls. Weighted mean of 16 +- 2 and 23 +- 3 m (1 sigma) on two sets of windows
# of validation and training ground, in a finished study (commit 1bb3d7b). Craters of the procedural Moon are seen on
# their rims.
SEEN_BELOW_RIM_M = 18.0
# No place of a crater is better known than this.
_SMALLEST_SIGMA_M = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class LoadedPayload:
    """A payload ready to observe, what it can be restarted from, and what the archive records of its loading."""

    payload: Payload
    parameters: BuildParameters
    tables: FlightTables
    build: dict[str, str]
    start_state: dict[str, Any]
    table_hashes: dict[str, str]
    gravity: dict[str, Any]
    model: bytes
    detector: OnnxDetector

    def boot(self, board: Board, detector: Detector | None = None) -> Payload:
        """Flight software started on a board, in standby; `detector` in place of the network."""

        return Payload(
            self.detector if detector is None else detector,
            self.parameters.flight,
            self.tables,
            model_hash=self.detector.model_hash,
            model_octets=self.model,
            board=board,
            mode=PayloadMode.standby,
            make_detector=_DetectorMaker(self.parameters.detector, detector),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _DetectorMaker:
    """Function from the octets of a network to its detector; `detector` stands for all networks if it is given."""

    parameters: DetectorParameters
    detector: Detector | None

    def __call__(self, octets: bytes) -> Detector:
        return OnnxDetector(octets, self.parameters) if self.detector is None else self.detector


def load_payload(
    scenario: Scenario,
    camera: PinholeCamera,
    reference: Ephemeris,
    catalogue: CraterCatalogue,
    orientation: Orientation,
    data: DataFolder,
    first_frame_utc_ns: int,
    burns: Sequence[TrueBurn] = (),
) -> LoadedPayload:
    """Flight software with its tables, for a window that starts at `first_frame_utc_ns`.

    Raises
    ------
    ModelError
        The detector model is missing or no network of this project.
    """
    build = _build(scenario, camera, data)
    start, stop = reference.start_utc_ns, reference.stop_utc_ns
    flight_orientation = IauOrientation()
    position, velocity = reference.at(np.array([first_frame_utc_ns]))
    start_state = _initial_state(scenario, first_frame_utc_ns, position[0], velocity[0])
    tables = FlightTables(
        anchor_ephemeris=_anchor_table(reference, orientation),
        catalogue=_catalogue_octets(scenario, catalogue),
        gravity=_gravity_octets(build.field),
        orientation=_orientation_table(flight_orientation, start, stop),
        initial_state=pack_initial_state(start_state),
        burns=_burn_table([burn for burn in burns if burn.declared and start <= burn.utc_ns <= stop]),
    )
    described = {
        "utc": format_utc(first_frame_utc_ns, 9),
        "position_icrf_m": start_state.position_icrf_m.tolist(),
        "velocity_icrf_m_s": start_state.velocity_icrf_m_s.tolist(),
    }
    return _loaded(build, tables, described, flight_orientation)


def launch_payload(
    scenario: Scenario, camera: PinholeCamera, data: DataFolder, catalogue: CraterCatalogue | None = None
) -> LoadedPayload:
    """Flight software as launched: model, parameters, gravity field and catalogue; other tables are uploaded in flight.

    It reports its time and the checksums of each image, so that the ground can correlate its clock and check images
    that it renders again.

    Raises
    ------
    ModelError
        The detector model is missing or no network of this project.
    """
    build = _build(scenario, camera, data, is_launched=True)
    craters = b"" if catalogue is None else _catalogue_octets(scenario, catalogue)
    tables = FlightTables(gravity=_gravity_octets(build.field), catalogue=craters)
    return _loaded(build, tables, {}, IauOrientation())


@dataclass(frozen=True, slots=True, eq=False)
class _Build:
    """Model and parameters, and the gravity field of the filter."""

    model: bytes
    parameters: BuildParameters
    detector: OnnxDetector
    field: GravityField


def _build(scenario: Scenario, camera: PinholeCamera, data: DataFolder, is_launched: bool = False) -> _Build:
    model_octets = network_octets(scenario.detector.network)
    navigation = scenario.navigation
    field = filter_field(navigation.filter_gravity, navigation.filter_degree, data)
    chosen = BuildParameters(
        detector_parameters(scenario),
        FlightParameters(
            camera=camera,
            modes=tuple(Mode[name] for name in navigation.estimators),
            odometry=OdometryParameters(safety_timeout_s=navigation.safety_timeout_s or None),
            anchored=AnchoredParameters(
                gravity_degree=field.degree, errors=_attitude_errors(scenario), offset=OffsetRule()
            ),
            image_reports=is_launched,
            time_reports=is_launched,
            scrub_interval_s=_SCRUB_S if is_launched else FlightParameters().scrub_interval_s,
        ),
    )
    # Flight is given what the parameter file of the archive says, so that a replay is given the same.
    loaded = parse_parameters(format_parameters(chosen))
    return _Build(model_octets, loaded, OnnxDetector(model_octets, loaded.detector), field)


def _loaded(
    build: _Build, tables: FlightTables, start_state: dict[str, Any], orientation: Orientation
) -> LoadedPayload:
    """Return the payload of a build with tables, described for the archive."""
    parameters, detector, field = build.parameters.flight, build.detector, build.field
    payload = Payload(detector, parameters, tables, model_hash=detector.model_hash, model_octets=len(build.model))
    return LoadedPayload(
        payload,
        build.parameters,
        tables,
        build={
            "name": "linna-flight",
            "version": "0.1.0",
            "model_sha256": detector.sha256,
            "parameters_sha256": parameters.sha256,
        },
        start_state=start_state,
        table_hashes={item.name: hashlib.sha256(getattr(tables, item.name)).hexdigest() for item in fields(tables)},
        gravity={"filter": field.name, "filter_degree": field.degree, "filter_orientation": orientation.name},
        model=build.model,
        detector=detector,
    )


def _gravity_octets(field: GravityField) -> bytes:
    return pack_gravity_table(GravityTable(field.name, field.gm_m3_s2, field.radius_m, field.c_bar, field.s_bar))


def _attitude_errors(scenario: Scenario) -> CommonErrors:
    """Return the attitude errors of the ADCS by its data sheet: as flown, at least those of the shipped parameters."""
    errors, attitude = CommonErrors(), scenario.attitude
    noise_deg = attitude.declared_noise_deg
    if noise_deg < 0.0:
        noise_deg = attitude.knowledge_noise_deg
    bias_deg = attitude.declared_bias_deg
    if bias_deg < 0.0:
        bias_deg = attitude.knowledge_bias_deg
    return replace(
        errors,
        attitude_noise_rad=max(errors.attitude_noise_rad, float(np.radians(noise_deg))),
        attitude_bias_rad=max(errors.attitude_bias_rad, float(np.radians(bias_deg))),
    )


def _catalogue_octets(scenario: Scenario, catalogue: CraterCatalogue) -> bytes:
    """Return the anchoring catalogue as uploaded: the table the scenario names, else one of the terrain's craters."""
    navigation = scenario.navigation
    octets = _named_catalogue(scenario) or pack_catalogue_table(onboard_catalogue(scenario, catalogue))
    table = unpack_catalogue_table(octets)
    if not (distortion_m := navigation.catalogue_distortion_m):
        return octets
    correlation_deg = navigation.catalogue_distortion_deg
    return pack_catalogue_table(displaced(table, distortion_m, correlation_deg, scenario.seed))


def _named_catalogue(scenario: Scenario) -> bytes:
    """Return the table that the scenario names; no octets if it names none."""
    if not (named := scenario.navigation.anchoring_catalogue):
        return b""
    try:
        return Path(named).read_bytes()
    except OSError as error:
        raise TableError(
            f"navigation.anchoring_catalogue {named}: expected a table made by linna catalogue curate, "
            f"found {error.strerror}"
        ) from None


def check_payload_files(scenario: Scenario) -> None:
    """Refuse a scenario whose network or table of craters cannot be read.

    Raises
    ------
    ModelError, TableError
        There is none, or it is damaged.
    """
    OnnxDetector(network_octets(scenario.detector.network), detector_parameters(scenario))
    if octets := _named_catalogue(scenario):
        unpack_catalogue_table(octets)


def onboard_catalogue(scenario: Scenario, catalogue: CraterCatalogue) -> CatalogueTable:
    """Return the anchoring catalogue: craters deep enough to be seen, with sizes of errors and (seeded) errors."""
    with np.errstate(invalid="ignore"):
        depth_ratio = catalogue.depth_m / catalogue.diameter_m
    known = np.isfinite(catalogue.rim_height_m) & ~(depth_ratio < _VISIBLE_DEPTH_RATIO)
    known &= not scenario.has_flat_ground
    chosen = catalogue.select(known)
    navigation = scenario.navigation
    rng = np.random.default_rng((scenario.seed, 2**34))
    horizontal_m = navigation.catalogue_error_fraction_of_diameter * chosen.diameter_m
    north_m, east_m = horizontal_m * rng.standard_normal((2, len(chosen)))
    height_m = navigation.catalogue_height_error_m * rng.standard_normal(len(chosen))
    # Craters of the procedural Moon lie where their list says, but for the errors that the scenario adds.
    made = catalogue.source.startswith("synthetic")
    if not made:
        height_m -= SEEN_BELOW_RIM_M
    centre_sigma_m = np.maximum(horizontal_m, _SMALLEST_SIGMA_M)
    height_sigma_m = np.hypot(_SMALLEST_SIGMA_M if made else _HEIGHT_SIGMA_M, navigation.catalogue_height_error_m)
    return CatalogueTable(
        chosen.ids,
        chosen.latitude_rad + north_m / MOON_RADIUS_M,
        chosen.longitude_rad + east_m / (MOON_RADIUS_M * np.cos(chosen.latitude_rad)),
        chosen.diameter_m,
        chosen.rim_height_m + height_m,
        np.stack([centre_sigma_m, centre_sigma_m, np.full(len(chosen), height_sigma_m)], axis=1),
    )


def _initial_state(
    scenario: Scenario, utc_ns: int, position_icrf_m: FloatArray, velocity_icrf_m_s: FloatArray
) -> InitialState:
    """Return the state that starts the filter: the reference, displaced by a (seeded) error of the declared size."""
    navigation = scenario.navigation
    directions = np.random.default_rng((scenario.seed, 2**35)).standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    position_error_m = max(navigation.initial_position_error_m, 1.0)
    velocity_error_m_s = max(navigation.initial_velocity_error_m_s, 1e-3)
    return InitialState(
        int(ticks_from_utc_ns(utc_ns)),
        position_icrf_m + navigation.initial_position_error_m * directions[0],
        velocity_icrf_m_s + navigation.initial_velocity_error_m_s * directions[1],
        position_error_m,
        velocity_error_m_s,
    )


def _burn_table(burns: Sequence[TrueBurn]) -> bytes:
    """Pack the planned burns; no octets without any."""
    if not burns:
        return b""
    return pack_burn_table(
        BurnTable(
            np.array([int(ticks_from_utc_ns(burn.utc_ns)) for burn in burns], dtype=np.int64),
            np.stack([burn.planned_m_s for burn in burns]),
            np.array([burn.sigma_m_s for burn in burns]),
        )
    )


def filter_field(name: str, degree: int, data: DataFolder) -> GravityField:
    """Return the gravity field of the on-board filter; by default it differs from that of the truth."""
    if name == "auto":
        if data.gravity_alternative is None:
            return builtin_gravity().truncated(min(degree, _CUT_DEGREE))
        field = load_gravity(data.gravity_alternative)
    else:
        field = builtin_gravity() if name == "builtin" else load_gravity(Path(name))
    return field.truncated(min(degree, field.degree))


def _orientation_table(orientation: Orientation, start_utc_ns: int, stop_utc_ns: int) -> bytes:
    """Pack the rotation of the Moon as uploaded, an hour between samples, with a margin for interpolation."""
    times = np.arange(
        np.int64(start_utc_ns - _ORIENTATION_MARGIN_NS),
        np.int64(stop_utc_ns + _ORIENTATION_MARGIN_NS),
        np.int64(_ORIENTATION_STEP_NS),
    )
    tdb_s = np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64)
    mcmf_from_icrf = orientation.mcmf_from_icrf(tdb_s)
    pa_from_mcmf = orientation.pa_from_icrf(tdb_s[0]) @ mcmf_from_icrf[0].T
    return pack_orientation_table(np.asarray(ticks_from_utc_ns(times)), mcmf_from_icrf, pa_from_mcmf)


def _anchor_table(reference: Ephemeris, orientation: Orientation) -> bytes:
    """Pack the anchor ephemeris as uploaded: positions in MCMF against on-board time."""
    times = np.arange(reference.start_utc_ns, reference.stop_utc_ns + 1, _ANCHOR_STEP_NS, dtype=np.int64)
    position, _ = reference.at(times)
    rotation = orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64))
    return pack_anchor_table(np.asarray(ticks_from_utc_ns(times)), np.einsum("nij,nj->ni", rotation, position))


def detector_parameters(scenario: Scenario) -> DetectorParameters:
    """Return the parameters of the detector that a scenario states."""
    section, camera = scenario.detector, scenario.camera
    return DetectorParameters(
        score_threshold=None if section.score_threshold < 0.0 else section.score_threshold,
        max_detections=section.max_detections,
        width_px=camera.width_px,
        height_px=camera.height_px,
    )


def network_octets(name: str) -> bytes:
    """Return the octets of the network that a scenario names: a shipped one, or an ONNX file.

    Raises
    ------
    ModelError
        The name is neither.
    """
    if name in NETWORKS:
        return load_shipped_model(name)
    try:
        return Path(name).read_bytes()
    except OSError as error:
        raise ModelError(
            f"detector.network: expected {', '.join(NETWORKS)} or an ONNX file, found {name!r} ({error.strerror})"
        ) from None


def load_scenario_payload(world: World, data: DataFolder) -> tuple[LoadedPayload, Ephemeris, CraterCatalogue]:
    """Load the payload for a world; return it with the reference and the catalogue of the tables of the ground."""
    scenario = world.scenario
    truth_ephemeris = sample_truth(world.truth, world.frame_utc_ns, scenario.spacecraft.upper())
    reference = with_reference_error(truth_ephemeris, scenario.reference, scenario.seed)
    catalogue = catalogue_near_track(world)
    loaded = load_payload(
        scenario,
        world.camera,
        reference,
        catalogue,
        world.truth.orientation,
        data,
        int(world.frame_utc_ns[0]),
        world.burns,
    )
    return loaded, reference, catalogue


def launch(scenario: Scenario, data: DataFolder, craters: Path | None = None) -> tuple[World, LoadedPayload]:
    """Return the world from the epoch on and the payload as launched; the ground uploads the tables of each window.

    Parameters
    ----------
    craters
        Catalogue on board, written if the file does not exist; None: none is kept, and none is on board unless an
        estimator needs it.
    """
    world = open_world(scenario, data)
    catalogue = None
    if craters is None and "anchored" not in scenario.navigation.estimators:
        pass
    elif craters is not None and craters.is_file():
        catalogue = load_catalogue(craters)
    else:
        catalogue = observed_craters(world)
        if craters is not None:
            save_catalogue(catalogue, craters)
            # The ground makes its tables of the file, in which numbers are rounded.
            catalogue = load_catalogue(craters)
    return world, launch_payload(world.scenario, world.camera, data, catalogue)
