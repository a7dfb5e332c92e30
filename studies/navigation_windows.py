"""Recordings of the inputs of the anchored estimator over a session, and the estimator repeated on them.

Rendering and detection take nearly all of the time of a session and do not depend on the estimator. A recording holds
detections, attitudes, tables and truth of every frame: variants of catalogue and parameters see the same frames.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.evaluation.navigation.smoothed_series import smoother_model
from ground_service.evaluation.navigation.smoother import FilterStates, smooth
from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.frames import (
    Orientation,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rtn_from_inertial,
    spherical_from_mcmf,
)
from lunar.gravity import GravityField
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.errors import RecordError
from payload_emulator.flight.navigation import anchored
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.anchored import Observation
from payload_emulator.flight.navigation.anchored_parameters import AnchoredParameters
from payload_emulator.flight.navigation.prediction import predicted
from payload_emulator.flight.navigation.sighting import turned_by
from payload_emulator.flight.onboard.loads import FlightTables
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.emulator import load_scenario_payload
from payload_emulator.session.loading import network_octets
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.scoring import halves, normalised_squares, rtn_errors, turned, turns
from payload_emulator.session.world import build_world, exposures
from tmtc.tables import (
    CatalogueTable,
    no_burns,
    unpack_burn_table,
    unpack_catalogue_table,
    unpack_gravity_table,
    unpack_initial_state,
    unpack_orientation_table,
)

_TABLES = tuple(item.name for item in fields(FlightTables))
_COLUMNS = ("u_px", "v_px", "diameter_px", "score", "sigma_px")
_CATALOGUE = ("ids", "latitude_rad", "longitude_rad", "diameter_m", "rim_height_m", "depth_m", "complete")
_ARC_GAP_NS = 600 * 1_000_000_000
# Camera of the recorded scenarios.
CAMERA_PX, CAMERA_FOV_RAD = 512, float(np.radians(120.0))
Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Inputs of the estimator in every frame of a session, and the truth that judges it.

    Attributes
    ----------
    name, seed
        Scenario.
    utc_ns, ticks
        Time of each frame and on-board time, shape (n,).
    attitude
        Messages of the ADCS, shape (n, 7).
    camera_from_mcmf
        True attitude, shape (n, 3, 3).
    truth
        Position (m) and velocity (m/s), ICRF, shape (n, 6).
    mcmf_from_icrf
        True orientation of the Moon, shape (n, 3, 3).
    usable
        Whether the detector accepted the image, shape (n,).
    first
        First detection of each frame and the end of the last, shape (n + 1,).
    detections
        All detections, columns u, v, diameter, score, sigma in pixels, and the lasting share of the variance (NaN where
        the network states none), shape (m, 6); without the last column, (m, 5), it is not known.
    catalogue
        True craters near the track with the heights of their rims.
    tables
        As uploaded.
    shift_m
        Registration that the craters of the uploaded catalogue contain, east and north, (c, 2); zero where unknown.
    network_sha256
        Network that searched the frames.
    """

    name: str
    seed: int
    utc_ns: IntArray
    ticks: IntArray
    attitude: FloatArray
    camera_from_mcmf: FloatArray
    truth: FloatArray
    mcmf_from_icrf: FloatArray
    usable: Any
    first: IntArray
    detections: FloatArray
    catalogue: CraterCatalogue
    tables: FlightTables
    shift_m: FloatArray
    network_sha256: str

    def found(self, number: int) -> Detections | None:
        """Return the detections of a frame; None where the image was not usable."""
        if not self.usable[number]:
            return None
        columns = self.detections[self.first[number] : self.first[number + 1]].T.copy()
        count = len(_COLUMNS)
        lasts = len(columns) > count and not np.isnan(columns[count]).any()
        found = Detections(*columns[:count])
        return replace(found, persistence=columns[count]) if lasts else found


def record(scenario: Scenario, data: DataFolder, progress: Progress | None = None) -> Recording:
    """Return the recording of a scenario: its frames rendered and searched by the network of the scenario."""
    world = build_world(scenario, data)
    loaded, _, catalogue = load_scenario_payload(world, data)
    total = int(world.frame_utc_ns.size)
    usable = np.zeros(total, dtype=np.bool_)
    ticks, attitude, rotation, rows = [], [], [], []
    frames: Iterable[Any] = exposures(world)
    for number, exposure in enumerate(progress(frames, total) if progress else frames):
        quality, found = loaded.detector.examine(exposure.image, exposure.attitude[4:7])
        usable[number] = quality is ImageQuality.OK
        ticks.append(exposure.clock_ticks)
        attitude.append(exposure.attitude)
        rotation.append(exposure.camera_from_mcmf)
        lasting = np.full(len(found), np.nan) if found.persistence is None else found.persistence
        rows.append(np.stack([*(getattr(found, name) for name in _COLUMNS), lasting], axis=1))
    table, registration = unpack_catalogue_table(loaded.tables.catalogue), world.terrain.registration
    shift_m = np.zeros((len(table), 2))
    if registration is not None:
        shift_m, _ = registration.at(table.latitude_rad, table.longitude_rad)
    position, velocity = world.truth.states(world.frame_utc_ns)
    tdb_s = np.asarray(tdb_s_from_utc_ns(world.frame_utc_ns), dtype=np.float64)
    return Recording(
        scenario.name,
        scenario.seed,
        world.frame_utc_ns,
        np.array(ticks, dtype=np.int64),
        np.array(attitude),
        np.array(rotation),
        np.concatenate([position, velocity], axis=1),
        np.asarray(world.truth.orientation.mcmf_from_icrf(tdb_s)),
        usable,
        np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64),
        np.concatenate(rows),
        catalogue,
        loaded.tables,
        shift_m,
        hashlib.sha256(network_octets(scenario.detector.network)).hexdigest(),
    )


def save_recording(path: Path, recording: Recording) -> None:
    """Write a recording (NumPy archive)."""
    arrays = {
        name: getattr(recording, name)
        for name in ("utc_ns", "ticks", "attitude", "camera_from_mcmf", "truth", "mcmf_from_icrf", "usable")
    }
    arrays |= {"first": recording.first, "detections": recording.detections, "shift_m": recording.shift_m}
    arrays |= {f"catalogue_{name}": getattr(recording.catalogue, name) for name in _CATALOGUE}
    arrays |= {
        f"table_{name}": np.frombuffer(getattr(recording.tables, name), dtype=np.uint8) for name in _TABLES
    }
    named = {"name": np.array(recording.name), "source": np.array(recording.catalogue.source)}
    named["network_sha256"] = np.array(recording.network_sha256)
    np.savez_compressed(path, allow_pickle=False, **arrays, **named, seed=np.array(recording.seed))


def load_recording(path: Path) -> Recording:
    """Return a recording.

    Raises
    ------
    RecordError
        The file is missing or no recording.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            values = {name: stored[name] for name in stored.files}
        columns = {name: values[f"catalogue_{name}"] for name in _CATALOGUE}
        tables = {name: values[f"table_{name}"].tobytes() for name in _TABLES}
        return Recording(
            str(values["name"]),
            int(values["seed"]),
            values["utc_ns"],
            values["ticks"],
            values["attitude"],
            values["camera_from_mcmf"],
            values["truth"],
            values["mcmf_from_icrf"],
            values["usable"],
            values["first"],
            values["detections"],
            CraterCatalogue(**columns, source=str(values["source"])),
            FlightTables(**tables),
            values["shift_m"],
            str(values["network_sha256"]),
        )
    except (OSError, KeyError, ValueError) as error:
        raise RecordError(f"{path}: expected a recording of navigation windows, found {error}") from None


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Estimates of the estimator over a recording against the truth, a row per frame.

    Attributes
    ----------
    error_rtn
        Estimate minus truth, position (m) and velocity (m/s), shape (n, 6).
    nees
        Normalised estimation error squared, 6 degrees of freedom.
    coast_end_m
        Position error immediately before the first image of an arc; NaN elsewhere.
    nis, degrees
        Normalised innovation squared of the fix and its degrees of freedom; NaN and 0 without one.
    state, covariance
        Orbit as downlinked, shapes (n, 9) and (n, 9, 9), ICRF axes of the payload.
    attitude_noise_rad
        Noise of the attitude that the monitor estimates; 0 while it is as declared.
    """

    error_rtn: FloatArray
    nees: FloatArray
    coast_end_m: FloatArray
    nis: FloatArray
    degrees: IntArray
    state: FloatArray
    covariance: FloatArray
    attitude_noise_rad: FloatArray

    @property
    def position_m(self) -> FloatArray:
        return np.asarray(np.linalg.norm(self.error_rtn[:, :3], axis=1), dtype=np.float64)


def arcs(recording: Recording) -> list[slice]:
    """Return the frames of each window."""
    cuts = np.flatnonzero(np.diff(recording.utc_ns) > _ARC_GAP_NS) + 1
    edges = [0, *cuts.tolist(), recording.utc_ns.size]
    return [slice(first, stop) for first, stop in itertools.pairwise(edges)]


def with_attitude_noise(recording: Recording, noise_rad: float, seed: int) -> Recording:
    """Return the recording with more noise in the attitude messages, one sigma per axis in each frame."""
    rng, attitude = np.random.default_rng(seed), recording.attitude.copy()
    for row in attitude:
        known = matrix_from_quaternion(row[:4] / np.linalg.norm(row[:4]))
        row[:4] = quaternion_from_matrix(turned_by(noise_rad * rng.standard_normal(3)) @ known)
    return replace(recording, attitude=attitude)


def fly(
    recording: Recording, parameters: AnchoredParameters, catalogue: CatalogueTable | None = None
) -> Flight:
    """Return what the estimator makes of a recording; `catalogue` in place of the table that was uploaded."""
    tables = recording.tables
    gravity, orientation = unpack_gravity_table(tables.gravity), unpack_orientation_table(tables.orientation)
    camera = PinholeCamera(CAMERA_PX, CAMERA_PX, CAMERA_FOV_RAD)
    setup, state = anchored.start(
        unpack_catalogue_table(tables.catalogue) if catalogue is None else catalogue,
        gravity,
        orientation,
        unpack_initial_state(tables.initial_state),
        camera,
        parameters,
        unpack_burn_table(tables.burns) if tables.burns else no_burns(),
    )
    total = recording.ticks.size
    own, covariance, noise_rad = np.zeros((total, 9)), np.zeros((total, 9, 9)), np.zeros(total)
    nis, degrees, before = np.full(total, np.nan), np.zeros(total, np.int64), np.full((total, 6), np.nan)
    starts = {part.start for part in arcs(recording)} - {0}
    for number, tick in enumerate(recording.ticks.tolist()):
        if number in starts:
            prior = predicted(state.estimate, tick, setup.model, setup.burns, parameters.errors)
            if prior is not None:
                before[number] = prior.mean[:6]
        message = recording.attitude[number]
        known = matrix_from_quaternion(message[:4] / np.linalg.norm(message[:4]))
        state, report = anchored.step(state, Observation(tick, recording.found(number), known), setup)
        own[number] = state.estimate.mean[kalman.ORBIT]
        covariance[number] = state.estimate.covariance[kalman.ORBIT, kalman.ORBIT]
        nis[number], degrees[number] = report.nis, 2 * report.matched
        noise_rad[number] = report.attitude_noise_rad
    to_truth = turns(recording.mcmf_from_icrf, orientation, recording.ticks)
    rtn = rtn_from_inertial(recording.truth[:, :3], recording.truth[:, 3:])
    error = rtn_errors(own[:, :6], recording.truth, to_truth, rtn)
    own_error = np.einsum("nji,nkj->nki", to_truth, halves(turned(own[:, :6], to_truth) - recording.truth))
    coast = np.linalg.norm(rtn_errors(before, recording.truth, to_truth, rtn)[:, :3], axis=1)
    squares = normalised_squares(own_error.reshape(-1, 6), covariance[:, :6, :6])
    return Flight(error, squares, coast, nis, degrees, own, covariance, noise_rad)


def smoothed_position_m(recording: Recording, flight: Flight, orientation: Orientation) -> FloatArray:
    """Return the position errors (n,) of a flight smoothed on the ground, as the evaluation of a pass does."""
    tables = recording.tables
    table = unpack_gravity_table(tables.gravity)
    gravity = GravityField(table.name, table.gm_m3_s2, table.radius_m, table.c_bar, table.s_bar)
    states = FilterStates(recording.utc_ns, flight.state, flight.covariance)
    state = smooth(states, smoother_model(gravity, orientation, ())).state[:, :6]
    to_truth = turns(recording.mcmf_from_icrf, unpack_orientation_table(tables.orientation), recording.ticks)
    rtn = rtn_from_inertial(recording.truth[:, :3], recording.truth[:, 3:])
    error = rtn_errors(state, recording.truth, to_truth, rtn)
    return np.asarray(np.linalg.norm(error[:, :3], axis=1), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class SmootherRow:
    """Root mean square of the position error (m) of filter and smoother at the start of a window and over all of it."""

    recording: str
    start_m: tuple[float, float]
    whole_m: tuple[float, float]


def smoother_rows(
    recording: Recording, flight: Flight, smoothed_m: FloatArray, skipped: int = 20, start: int = 20
) -> list[SmootherRow]:
    """Return a row for each window; the start of the first, which follows no coast, is NaN.

    Parameters
    ----------
    skipped
        Frames of the first window that count nowhere.
    start
        Frames at the start of a window.
    """

    def rms(part: slice) -> tuple[float, float]:
        return (
            float(np.sqrt(np.mean(flight.position_m[part] ** 2))),
            float(np.sqrt(np.mean(smoothed_m[part] ** 2))),
        )

    rows = []
    for number, part in enumerate(arcs(recording)):
        whole = slice(part.start + (skipped if number == 0 else 0), part.stop)
        first = rms(slice(part.start, part.start + start)) if number else (np.nan, np.nan)
        rows.append(SmootherRow(recording.name, first, rms(whole)))
    return rows


@dataclass(frozen=True, slots=True)
class WindowRow:
    """Figures of one window; errors of the position in metres, in three dimensions unless an axis is named."""

    recording: str
    longitude_deg: float
    altitude_km: tuple[float, float]
    frames: int
    fixed: int
    median_m: float
    p95_m: float
    bias_rtn_m: tuple[float, float, float]
    nees6: float
    nis_per_degree: float
    coast_end_m: float


def window_rows(recording: Recording, flight: Flight, skipped: int = 20) -> list[WindowRow]:
    """Return the figures of the windows; of the first, which starts with a large error, after some frames."""
    rows = []
    position = np.einsum("nij,nj->ni", recording.mcmf_from_icrf, recording.truth[:, :3])
    _, longitude, altitude = spherical_from_mcmf(position)
    for number, part in enumerate(arcs(recording)):
        chosen = slice(part.start + (skipped if number == 0 else 0), part.stop)
        fixed = flight.degrees[chosen] > 0
        rows.append(
            WindowRow(
                recording.name,
                round(float(np.degrees(longitude[(part.start + part.stop) // 2])) % 360.0, 1),
                (round(float(altitude[part].min()) / 1e3, 1), round(float(altitude[part].max()) / 1e3, 1)),
                int(fixed.size),
                int(np.count_nonzero(fixed)),
                float(np.median(flight.position_m[chosen])),
                float(np.percentile(flight.position_m[chosen], 95.0)),
                tuple(flight.error_rtn[chosen, :3].mean(axis=0).tolist()),
                float(flight.nees[chosen].mean()),
                float(np.nansum(flight.nis[chosen]) / max(int(flight.degrees[chosen].sum()), 1)),
                float(flight.coast_end_m[part.start]),
            )
        )
    return rows


def moved(table: CatalogueTable, east_m: FloatArray, north_m: FloatArray) -> CatalogueTable:
    """Return the table with its craters moved, (n,) each."""
    return replace(
        table,
        latitude_rad=table.latitude_rad + north_m / MOON_RADIUS_M,
        longitude_rad=table.longitude_rad + east_m / (MOON_RADIUS_M * np.cos(table.latitude_rad)),
    )
