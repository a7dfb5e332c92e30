"""Monte Carlo of anchored navigation with simulated detections: no images, so that thousands of frames take seconds.

A case is a world (true gravity and orientation, true craters), what was uploaded (another gravity field, a catalogue
with errors), and how the instruments err. One seed draws one run. Statistics compare the errors with the
covariances that the filter claims: a filter whose noise is mistuned looks fine in its errors and fails here.
"""

import math
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M, NS
from lunar.frames import Orientation, matrix_from_quaternion, rtn_from_inertial
from lunar.gravity import GravityField
from lunar.propagation import ForceModel, propagate
from lunar.timescales import tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.flight.navigation.anchored import anchored
from payload_emulator.flight.navigation.anchored.anchored import (
    AnchoredReport,
    AnchoredSetup,
    AnchoredState,
    Observation,
)
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.landmark_map import FIRST_LANDMARK_ID
from payload_emulator.flight.navigation.outcomes import Outcome
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, in_view, landmark_map, look
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.session.world.regions import regional_field
from payload_emulator.sim.detector import SimulatedDetector
from tmtc.dictionary import tables

_ORIENTATION_STEP_NS = 7_200 * NS
_PUSH_S = 60.0
_ORIENTATION_MARGIN_NS = 5 * _ORIENTATION_STEP_NS


@dataclass(frozen=True, slots=True)
class CatalogueErrors:
    """Errors of the uploaded catalogue, one sigma, drawn once per run.

    `regional_sigma_m` is the size of a shift east, north, up that is similar over `regional_rad` (1/e, angle at the
    Moon's centre).
    `wrong_share` is the share of entries where there is no crater at all.
    """

    centre_of_diameter: float = 0.03
    height_m: float = 100.0
    regional_sigma_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    regional_rad: float = 1.0
    wrong_share: float = 0.0


@dataclass(frozen=True, slots=True)
class Kidnap:
    """At a frame the spacecraft is found elsewhere: turned about the Moon's centre by a distance on the ground."""

    frame: int
    distance_m: float
    announced: bool


@dataclass(frozen=True, eq=False)
class NavigationCase:
    """Inputs of one run, given a seed; all of them can be pickled.

    Attributes
    ----------
    position_icrf_m, velocity_icrf_m_s
        True state at `epoch_utc_ns`.
    frame_utc_ns, imaging
        Times of the frames, and whether there is an image (n,).
    gravity, gravity_degree, orientation
        Of the truth.
    filter_gravity, filter_orientation
        As uploaded.
    craters
        True craters with rim heights.
    start_position_m, start_velocity_m_s
        Size (3-D, one sigma) of the error of the state that starts the filter.
    attitude_noise_rad, attitude_bias_rad, attitude_correlation_s
        Errors of the ADCS message, per axis, 1 sigma; the bias is a first-order Gauss-Markov process with this
        correlation time (infinite: constant for a run).
    on_board
        Mask of the craters in the uploaded catalogue; None for all.
    lasting_m_s2, lasting_correlation_s
        Slowly varying acceleration of the truth, such as solar radiation pressure: first-order Gauss-Markov process,
        radial, transverse, normal, 1 sigma.
    any_node, node_longitudes_deg
        Each run rotates the orbit about the Moon's axis by a random angle, such that the longitude of the ascending
        node at the epoch lies between two values, if they are given.
    """

    epoch_utc_ns: int
    position_icrf_m: FloatArray
    velocity_icrf_m_s: FloatArray
    frame_utc_ns: IntArray
    imaging: BoolArray
    gravity: GravityField
    gravity_degree: int
    orientation: Orientation
    filter_gravity: GravityField
    filter_orientation: Orientation
    craters: CraterCatalogue
    camera: PinholeCamera = field(default_factory=PinholeCamera)
    detector: SimulatedDetector = field(default_factory=SimulatedDetector)
    catalogue_errors: CatalogueErrors = field(default_factory=CatalogueErrors)
    start_position_m: float = 1_000.0
    start_velocity_m_s: float = 1.0
    attitude_noise_rad: float = float(np.radians(0.01))
    attitude_bias_rad: float = float(np.radians(0.01))
    attitude_correlation_s: float = float("inf")
    kidnap: Kidnap | None = None
    on_board: BoolArray | None = None
    lasting_m_s2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lasting_correlation_s: float = 900.0
    any_node: bool = False
    node_longitudes_deg: tuple[float, float] | None = None
    parameters: AnchoredParameters = field(default_factory=AnchoredParameters)


@dataclass(frozen=True, slots=True, eq=False)
class NavigationRun:
    """Errors and claims of one run, a row per frame.

    Attributes
    ----------
    error_rtn_m, sigma_rtn_m
        Estimate minus truth, and one sigma, radial, transverse, normal.
    nees
        Of position and velocity: 6 degrees of freedom.
    nis, degrees
        Of each fix; NaN and 0 without one.
    innovation
        Mean innovation of each fix, right and down, over its standard deviation; NaN without one.
    matched, wrong
        Craters of the fix, and how many of them were taken for another.
    own
        Craters of the fix that the payload mapped itself.
    findable
        Detections in the frame of craters that are in the catalogue.
    attitude_noise_rad
        Noise of the attitude that the monitor estimates; 0 while it is as declared.
    """

    frame_utc_ns: IntArray
    imaging: BoolArray
    outcome: IntArray
    error_rtn_m: FloatArray
    sigma_rtn_m: FloatArray
    nees: FloatArray
    nis: FloatArray
    degrees: IntArray
    innovation: FloatArray
    matched: IntArray
    wrong: IntArray
    own: IntArray
    findable: IntArray
    attitude_noise_rad: FloatArray

    @property
    def error_m(self) -> FloatArray:
        """Length of the position error."""
        return np.asarray(np.linalg.norm(self.error_rtn_m, axis=1), dtype=np.float64)

    @property
    def fixed(self) -> BoolArray:
        return np.asarray(self.outcome == Outcome.fixed, dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of errors and claims of some runs; imaging frames after the settling time.

    Attributes
    ----------
    anees
        Average normalised estimation error squared of position and velocity: 6 for a filter that knows its errors.
    nis_per_degree
        Average normalised innovation squared per degree of freedom: 1.
    contained_95
        Share of frames inside 1.96 sigma in radial, transverse, normal: 0.95.
    innovation_correlation
        Correlation of the mean innovations of neighbouring frames: 0 for white innovations.
    median_m, p95_m, largest_m
        Position error, 3-D.
    fixed_share, wrong_share
        Frames fixed, of those with at least four findable craters; craters taken for others, of those matched.
    own_share
        Craters that the payload mapped itself, of those matched.
    degraded_share
        Frames in which the monitor judges the attitude noisier than declared.
    """

    anees: float
    nis_per_degree: float
    contained_95: tuple[float, float, float]
    innovation_correlation: float
    median_m: float
    p95_m: float
    largest_m: float
    fixed_share: float
    wrong_share: float
    own_share: float = 0.0
    degraded_share: float = 0.0


def fly(case: NavigationCase, seed: int) -> NavigationRun:
    """Return one run of a case: the same seed, the same run."""
    rng, given_px = np.random.default_rng(seed), np.array(case.detector.bias_px)
    case = _with_drawn_biases(case, np.random.default_rng((seed, 1)))
    if case.any_node:
        case = _with_drawn_node(case, np.random.default_rng((seed, 2)))
    true_map = landmark_map(catalogue_table(case.craters))
    table = _with_errors(catalogue_table(case.craters), case.catalogue_errors, rng)
    if case.on_board is not None:
        table = table.select(case.on_board)
    states, rotations = _truth(case, rng, np.random.default_rng((seed, 4)))
    ticks = np.asarray(ticks_from_utc_ns(case.frame_utc_ns), dtype=np.int64)
    setup, state = _started(case, table, states[0], int(ticks[0]), rng)
    bias_rad = case.attitude_bias_rad * rng.standard_normal(3)
    lasting = rng.standard_normal((len(true_map), 2))
    detector, slow = case.detector, np.random.default_rng((seed, 3))
    elapsed_s = np.diff(case.frame_utc_ns) / NS
    tilts_rad = _wandering(bias_rad, case.attitude_bias_rad, case.attitude_correlation_s, elapsed_s, slow)
    first_px, sigma_px = np.array(detector.bias_px) - given_px, detector.bias_sigma_px
    shifts_px = given_px + _wandering(first_px, sigma_px, detector.bias_correlation_s, elapsed_s, slow)
    rows = []
    for k in range(ticks.size):
        camera_from_icrf = nadir_camera_from_mcmf(rotations[k] @ states[k, :3]) @ rotations[k]
        found, truth = _detect(
            case, true_map, states[k, :3], camera_from_icrf, rotations[k], lasting, shifts_px[k], rng
        )
        tilt_rad = tilts_rad[k] + case.attitude_noise_rad * rng.standard_normal(3)
        measured = np.asarray(_rotation(tilt_rad) @ camera_from_icrf, dtype=np.float64)
        if case.kidnap is not None and case.kidnap.announced and k == case.kidnap.frame:
            state = anchored.widened(state, case.kidnap.distance_m, 1e-3 * case.kidnap.distance_m)
        shown = bool(case.imaging[k])
        observation = Observation(int(ticks[k]), found if shown else None, measured)
        state, report = anchored.step(state, observation, setup)
        rows.append(_row(state, report, states[k], truth if shown else truth[:0]))
    return NavigationRun(case.frame_utc_ns, case.imaging, *map(np.array, zip(*rows, strict=True)))


def fly_many(case: NavigationCase, seeds: Sequence[int], workers: int | None = None) -> list[NavigationRun]:
    """Return the runs of some seeds, in their order, in several processes if more than one is requested."""
    workers = min(len(seeds), workers or os.cpu_count() or 1)
    if workers <= 1:
        return [fly(case, seed) for seed in seeds]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(fly, [case] * len(seeds), seeds))


def consistency(runs: Iterable[NavigationRun], settle_frames: int = 20) -> Consistency:
    """Return how errors and claims of some runs agree, over imaging frames after the first few."""
    used = [(run, run.imaging & (np.arange(run.imaging.size) >= settle_frames)) for run in runs]

    def joined(name: str) -> FloatArray:
        return np.concatenate([np.asarray(getattr(run, name), dtype=np.float64)[mask] for run, mask in used])

    error, sigma, length = joined("error_rtn_m"), joined("sigma_rtn_m"), joined("error_m")
    fixed, matched, findable = joined("fixed") > 0.0, joined("matched"), joined("findable")
    inside = np.mean(np.abs(error) < 1.96 * sigma, axis=0)
    return Consistency(
        anees=float(np.mean(joined("nees"))),
        nis_per_degree=float(np.nansum(joined("nis")) / max(np.sum(joined("degrees")), 1.0)),
        contained_95=(float(inside[0]), float(inside[1]), float(inside[2])),
        innovation_correlation=_neighbour_correlation([run.innovation for run, _ in used]),
        median_m=float(np.median(length)),
        p95_m=float(np.percentile(length, 95.0)),
        largest_m=float(np.max(length)),
        fixed_share=float(np.mean(fixed[findable >= 4.0])),
        wrong_share=float(np.sum(joined("wrong")) / max(np.sum(matched), 1.0)),
        own_share=float(np.sum(joined("own")) / max(np.sum(matched), 1.0)),
        degraded_share=float(np.mean(joined("attitude_noise_rad") > 0.0)),
    )


def anees_bounds(runs: int) -> tuple[float, float]:
    """Return the 95 % bounds of the average over independent runs of a chi-square of 6 degrees (normal limit)."""
    width = 1.96 * math.sqrt(12.0 / runs)
    return 6.0 - width, 6.0 + width


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on the claims of a filter over independent runs."""

    consistent: bool
    anees_bounds: tuple[float, float]
    reasons: tuple[str, ...]


def verdict(result: Consistency, runs: int) -> Verdict:
    """Return whether ANEES lies in its bounds, NIS in 0.9 to 1.1, innovations are white and sigmas contain errors.

    Errors last over many frames, so that a run counts as one independent draw: the share inside 1.96 sigma of one
    axis is then known to 0.22 over the root of the runs (1 sigma), and three of those are allowed.
    """
    low, high = anees_bounds(runs)
    slack = 3.0 * np.sqrt(0.95 * 0.05 / runs)
    worst = max(abs(share - 0.95) for share in result.contained_95)
    checks = (
        (low <= result.anees <= high, f"ANEES {result.anees:.2f} outside {low:.2f} to {high:.2f}"),
        (0.9 <= result.nis_per_degree <= 1.1, f"NIS per degree {result.nis_per_degree:.3f} outside 0.9 to 1.1"),
        (
            abs(result.innovation_correlation) <= 0.1,
            f"innovations correlated by {result.innovation_correlation:.3f}, over 0.1",
        ),
        (worst <= slack, f"share inside 1.96 sigma {worst:.3f} from 0.95, over {slack:.3f}"),
    )
    reasons = tuple(text for holds, text in checks if not holds)
    return Verdict(not reasons, (low, high), reasons)


def catalogue_table(craters: CraterCatalogue) -> tables.CatalogueTable:
    """Return craters as a table without uncertainty; those without a rim height stand on the sphere."""
    return tables.CatalogueTable(
        np.arange(len(craters), dtype=np.int64),
        craters.latitude_rad,
        craters.longitude_rad,
        craters.diameter_m,
        np.nan_to_num(craters.rim_height_m),
        np.zeros((len(craters), 3)),
    )


def _with_drawn_biases(case: NavigationCase, rng: np.random.Generator) -> NavigationCase:
    """The case with the errors of the detector that last for a run drawn into its given ones."""
    detector, drawn = case.detector, rng.standard_normal(3)
    right, down = np.array(detector.bias_px) + detector.bias_sigma_px * drawn[:2]
    scale = detector.scale + detector.scale_sigma * drawn[2]
    return replace(case, detector=replace(detector, bias_px=(right, down), scale=scale))


def _wandering(
    first: FloatArray, sigma: float | FloatArray, correlation_s: float, elapsed_s: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return a stationary first-order Gauss-Markov process (n + 1, k) from its first value over n steps."""
    decay = np.exp(-elapsed_s / correlation_s)
    fresh = sigma * np.sqrt(1.0 - decay**2)[:, None] * rng.standard_normal((elapsed_s.size, first.size))
    values = np.empty((elapsed_s.size + 1, first.size))
    values[0] = first
    for k in range(elapsed_s.size):
        values[k + 1] = decay[k] * values[k] + fresh[k]
    return values


def _with_drawn_node(case: NavigationCase, rng: np.random.Generator) -> NavigationCase:
    """The case with its orbit turned about the Moon's axis."""
    rotation = case.orientation.mcmf_from_icrf(float(tdb_s_from_utc_ns(case.epoch_utc_ns)))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    if case.node_longitudes_deg is not None:
        normal = rotation @ np.cross(case.position_icrf_m, case.velocity_icrf_m_s)
        low, high = case.node_longitudes_deg
        # The direction of the ascending node is axis x normal.
        now = float(np.arctan2(normal[0], -normal[1]))
        angle = float(np.radians(low + (high - low) * angle / (2.0 * np.pi))) - now
    turn = _rotation(angle * rotation[2])
    return replace(case, position_icrf_m=turn @ case.position_icrf_m, velocity_icrf_m_s=turn @ case.velocity_icrf_m_s)


def _with_errors(
    table: tables.CatalogueTable, errors: CatalogueErrors, rng: np.random.Generator
) -> tables.CatalogueTable:
    centre_m = errors.centre_of_diameter * table.diameter_m
    sigma_m = np.stack([centre_m, centre_m, np.full(len(table), errors.height_m)], axis=1)
    shift_m = sigma_m * rng.standard_normal(sigma_m.shape)
    if any(errors.regional_sigma_m):
        field = regional_field(table.latitude_rad, table.longitude_rad, errors.regional_rad, rng)
        shift_m = shift_m + np.array(errors.regional_sigma_m) * field
    wrong = rng.uniform(size=len(table)) < errors.wrong_share
    turned = np.where(wrong, rng.uniform(0.0, 2.0 * np.pi, len(table)), 0.0)
    moved = tables.CatalogueTable(
        table.ids,
        table.latitude_rad + shift_m[:, 1] / MOON_RADIUS_M,
        table.longitude_rad + turned + shift_m[:, 0] / (MOON_RADIUS_M * np.cos(table.latitude_rad)),
        table.diameter_m,
        table.rim_height_m + shift_m[:, 2],
        sigma_m,
    )
    return tables.unpack_catalogue_table(tables.pack_catalogue_table(moved))


def _truth(case: NavigationCase, rng: np.random.Generator, slow: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return true states (n, 6) and rotations mcmf_from_icrf (n, 3, 3) at the frames."""
    model = ForceModel(case.gravity, case.orientation, case.gravity_degree)
    tdb_s = np.asarray(tdb_s_from_utc_ns(case.frame_utc_ns), dtype=np.float64)
    epoch_s = float(tdb_s_from_utc_ns(case.epoch_utc_ns))
    last_s = float(tdb_s[-1]) - epoch_s + 1.0
    if any(case.lasting_m_s2):
        states = _pushed(case, model, epoch_s, tdb_s, slow)
    else:
        flown = propagate(epoch_s, case.position_icrf_m, case.velocity_icrf_m_s, last_s, model)
        states = flown.state(tdb_s)
    if case.kidnap is not None:
        k = case.kidnap.frame
        heading = rng.uniform(0.0, 2.0 * np.pi)
        _, along, normal = rtn_from_inertial(states[k, :3], states[k, 3:])
        axis = np.cos(heading) * normal + np.sin(heading) * along
        turn = _rotation(axis * case.kidnap.distance_m / float(np.linalg.norm(states[k, :3])))
        moved = propagate(
            float(tdb_s[k]), turn @ states[k, :3], turn @ states[k, 3:], float(tdb_s[-1] - tdb_s[k]) + 1.0, model
        )
        states = np.concatenate([states[:k], moved.state(tdb_s[k:])])
    return states, case.orientation.mcmf_from_icrf(tdb_s)


def _pushed(
    case: NavigationCase, model: ForceModel, epoch_s: float, tdb_s: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return true states at times (n,) with a slowly varying acceleration, applied as one impulse per minute.

    An impulse at the beginning of a minute in place of 2e-6 m/s^2 throughout moves the orbit by 4 mm.
    """
    starts = np.arange(epoch_s, float(tdb_s[-1]) + 1.0, _PUSH_S)
    sigma = np.array(case.lasting_m_s2)
    lasting = _wandering(sigma * rng.standard_normal(3), sigma, case.lasting_correlation_s, np.diff(starts), rng)
    state = np.concatenate([case.position_icrf_m, case.velocity_icrf_m_s])
    states = np.empty((tdb_s.size, 6))
    for start, push in zip(starts, lasting, strict=True):
        velocity = state[3:] + rtn_from_inertial(state[:3], state[3:]).T @ (push * _PUSH_S)
        arc = propagate(float(start), state[:3], velocity, _PUSH_S + 1.0, model)
        within = (tdb_s >= start) & (tdb_s < start + _PUSH_S)
        states[within] = arc.state(tdb_s[within])
        state = arc.state(float(start) + _PUSH_S)
    return states


def _started(
    case: NavigationCase, table: tables.CatalogueTable, state: FloatArray, ticks: int, rng: np.random.Generator
) -> tuple[AnchoredSetup, AnchoredState]:
    times = np.arange(
        int(case.frame_utc_ns[0]) - _ORIENTATION_MARGIN_NS,
        int(case.frame_utc_ns[-1]) + _ORIENTATION_MARGIN_NS,
        _ORIENTATION_STEP_NS,
    )
    tdb_s = np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64)
    rotations = case.filter_orientation.mcmf_from_icrf(tdb_s)
    pa_from_mcmf = case.filter_orientation.pa_from_icrf(tdb_s[0]) @ rotations[0].T
    gravity = case.filter_gravity
    start = tables.InitialState(
        ticks,
        state[:3] + case.start_position_m / np.sqrt(3.0) * rng.standard_normal(3),
        state[3:] + case.start_velocity_m_s / np.sqrt(3.0) * rng.standard_normal(3),
        max(case.start_position_m / np.sqrt(3.0), 1.0),
        max(case.start_velocity_m_s / np.sqrt(3.0), 1e-3),
    )
    return anchored.start(
        table,
        tables.unpack_gravity_table(
            tables.pack_gravity_table(
                tables.GravityTable(gravity.name, gravity.gm_m3_s2, gravity.radius_m, gravity.c_bar, gravity.s_bar)
            )
        ),
        tables.unpack_orientation_table(
            tables.pack_orientation_table(np.asarray(ticks_from_utc_ns(times)), rotations, pa_from_mcmf)
        ),
        start,
        case.camera,
        case.parameters,
    )


def _detect(
    case: NavigationCase,
    craters: LandmarkMap,
    position_icrf_m: FloatArray,
    camera_from_icrf: FloatArray,
    mcmf_from_icrf: FloatArray,
    lasting: FloatArray,
    bias_px: FloatArray,
    rng: np.random.Generator,
) -> tuple[Detections, IntArray]:
    """Return the detections of a frame and the crater that each is of, -1 for none."""
    detector, camera = case.detector, case.camera
    pose = Pose(
        position_icrf_m, camera_from_icrf, mcmf_from_icrf, np.zeros(3), np.zeros(2), np.zeros(3), detector.scale
    )
    index = in_view(craters, pose, camera, 0.0).index
    index = index[detector.found(craters.diameter_m[index], rng)]
    seen = look(craters, index, pose, camera)
    corner = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    uv, diameter = detector.detect(seen.uv_px, seen.diameter_px, corner, rng, lasting[index], bias_px)
    truth = np.concatenate([index, np.full(diameter.size - index.size, -1, dtype=np.int64)])
    order = rng.permutation(truth.size)
    order = order[np.all((uv[order] >= -0.5) & (uv[order] <= corner + 0.5), axis=1)]
    found = Detections(
        uv[order, 0], uv[order, 1], diameter[order], np.ones(order.size), np.full(order.size, detector.stated_sigma_px)
    )
    return found, craters.ids[truth[order]] * (truth[order] >= 0) - (truth[order] < 0)


def _row(state: AnchoredState, report: AnchoredReport, true_state: FloatArray, truth: IntArray) -> tuple[object, ...]:
    mean, covariance = state.estimate.mean, state.estimate.covariance
    error = mean[:6] - true_state
    rtn = rtn_from_inertial(true_state[:3], true_state[3:])
    sigma = np.sqrt(np.diag(rtn @ covariance[:3, :3] @ rtn.T))
    matched = wrong = own = 0
    innovation = np.full(2, np.nan)
    fix = report.fix
    if fix is not None:
        matched = int(fix.index.size)
        # Landmarks of the navigator's own map have identities that no true crater has.
        used = state.landmarks.ids[fix.index]
        mapped = used >= FIRST_LANDMARK_ID
        own = int(np.count_nonzero(mapped))
        wrong = int(np.count_nonzero((truth[fix.identification.detection] != used) & ~mapped))
        innovation = fix.update.mean_innovation
    return (
        int(report.outcome),
        rtn @ error[:3],
        sigma,
        float(error @ np.linalg.solve(covariance[:6, :6], error)),
        report.nis,
        2 * matched,
        innovation,
        matched,
        wrong,
        own,
        int(np.count_nonzero(np.isin(truth, state.landmarks.ids))),
        report.attitude_noise_rad,
    )


def _neighbour_correlation(series: Iterable[FloatArray]) -> float:
    """Return the correlation of values with those of the next frame, over all series and both axes."""
    pairs = [np.stack([values[:-1].reshape(-1), values[1:].reshape(-1)]) for values in series]
    joined = np.concatenate(pairs, axis=1)
    joined = joined[:, np.all(np.isfinite(joined), axis=0)]
    if joined.shape[1] < 3:
        return float("nan")
    return float(np.mean(joined[0] * joined[1]) / np.mean(joined[0] ** 2))


def _rotation(vector_rad: FloatArray) -> FloatArray:
    angle = float(np.linalg.norm(vector_rad))
    if angle == 0.0:
        return np.eye(3)
    quaternion = np.concatenate([[np.cos(0.5 * angle)], np.sin(0.5 * angle) / angle * vector_rad])
    return matrix_from_quaternion(quaternion)
