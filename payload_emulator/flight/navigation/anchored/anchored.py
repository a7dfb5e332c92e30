"""Absolute navigation: craters of an on-board catalogue anchor a dynamical orbit estimate.

It reads neither truth nor the anchor ephemeris. `step` is a function from a frozen state and the observation of one
frame to a new state and a report of all decisions:

1. predict the orbit to the time of the frame (`correction`, `dynamics`);
2. associate detections with craters of the map and correct the estimate (`correction`);
3. where image and map keep disagreeing, widen the search, then search without a prior (`recovery`);
4. monitor the noise of the attitude (`attitude_monitor`);
5. map craters that the catalogue does not contain (`landmark_map`).

A fix that fails its tests is refused: the orbit is then coasted on dynamics alone, and its uncertainty grows.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import rtn_from_inertial
from payload_emulator.flight.navigation import landmark_map as mapping
from payload_emulator.flight.navigation.anchored import recovery
from payload_emulator.flight.navigation.anchored.correction import (
    Fix,
    altitude_above_sphere_m,
    associate,
    correct,
    detection_variance_px2,
    is_usable,
    predicted,
    search_margin_px,
    tracking_limit_m,
)
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.attitude_monitor import (
    AttitudeMonitor,
    RotationEvidence,
    is_examined,
    monitored,
)
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel, process_noise
from payload_emulator.flight.navigation.filter.filter import FilterState, KalmanFilter
from payload_emulator.flight.navigation.filter.map_offset import OffsetSize, first_size, learned
from payload_emulator.flight.navigation.landmark_map import FIRST_LANDMARK_ID, Landmark, MapState, View, unclaimed
from payload_emulator.flight.navigation.outcomes import Outcome
from payload_emulator.flight.navigation.search.acquisition import SEARCHABLE_DETECTIONS
from payload_emulator.flight.navigation.search.lost_in_space import PlaceIndex, place_index
from payload_emulator.flight.navigation.sighting import (
    LandmarkMap,
    Pose,
    in_view,
    inside_image,
    landmark_map,
    look,
    turned_by,
)
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import BurnTable, CatalogueTable, GravityTable, InitialState, OrientationTable, no_burns
from tmtc.packets.pus import TICKS_PER_SECOND

_NAN = float("nan")
_NO_CRATERS = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class AnchoredSetup:
    """Parts of the estimator that stay from one start to the next.

    Attributes
    ----------
    camera
        The camera as calibrated.
    catalogue
        The catalogue as uploaded.
    model
        Dynamics with the uploaded gravity and orientation.
    markov_sigma_m_s2
        Standard deviation of the empirical acceleration, radial, transverse, normal.
    burns
        Planned burns.
    initial
        Estimate that starts the filter.
    method
        Filter that predicts and corrects.
    """

    parameters: AnchoredParameters
    camera: PinholeCamera
    catalogue: CatalogueTable
    model: OrbitModel
    markov_sigma_m_s2: tuple[float, float, float]
    burns: BurnTable
    initial: FilterState
    method: KalmanFilter


@dataclass(frozen=True, slots=True, eq=False)
class AnchoredState:
    """State of the estimator between two frames.

    Attributes
    ----------
    estimate
        Orbit, common errors and craters with their covariance.
    landmarks
        Map in use: the catalogue, and the landmarks of finished passes.
    mapped
        Map under construction.
    image_ticks
        Time of the last image.
    surface_m
        Height of the ground in view above the sphere of the maps, according to the catalogue.
    disagreements
        Consecutive frames in which image and map disagree.
    fixed_ticks
        Time of the last fix; None before the first.
    attitude
        Monitor of the attitude.
    trusted
        Predictions for the frames in the window of the monitor since the last reset of the filter, oldest first,
        without craters; none while the attitude is degraded.
    places
        Search index of `landmarks`; None before the first search.
    offset
        Size of the catalogue's common offset as learned; None where it is not.
    """

    estimate: FilterState
    landmarks: LandmarkMap
    mapped: MapState
    image_ticks: int
    surface_m: float = 0.0
    disagreements: int = 0
    fixed_ticks: int | None = None
    attitude: AttitudeMonitor = field(default_factory=AttitudeMonitor)
    trusted: tuple[FilterState, ...] = ()
    places: PlaceIndex | None = None
    offset: OffsetSize | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Input of one frame.

    Attributes
    ----------
    found
        Detections; None where there was no usable image.
    camera_from_icrf
        Attitude, shape (3, 3); None where the ADCS gave none: the frame is then coasted over.
    """

    ticks: int
    found: Detections | None
    camera_from_icrf: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class AnchoredReport:
    """Outcome of one frame with the decisions that led to it, and the estimate in geographic terms.

    Attributes
    ----------
    sigma_rtn_m
        Standard deviations radial, transverse, normal.
    nis, matched
        Normalised innovation squared and number of craters of the fix (NaN and 0 without one).
    candidates
        Pairs of detection and crater that were considered.
    expected
        Craters of the catalogue that the predicted image holds.
    reacquired
        The fix came from a widened search.
    lost
        The estimate is too uncertain to be of use.
    fix
        The fix; None without one.
    new_landmarks
        Landmarks that were made or improved.
    attitude_declared_rad, attitude_noise_rad
        Standard deviation of the attitude per axis as declared, and as estimated if it is noisier, else 0.
    offset
        Size of the catalogue's common offset; None where it is not learned.
    """

    outcome: Outcome
    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    velocity_icrf_m_s: tuple[float, float, float]
    sigma_rtn_m: tuple[float, float, float]
    nis: float
    matched: int
    candidates: int
    expected: int
    reacquired: bool
    lost: bool = False
    fix: Fix | None = None
    new_landmarks: tuple[Landmark, ...] = ()
    attitude_declared_rad: float = 0.0
    attitude_noise_rad: float = 0.0
    offset: OffsetSize | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Result of the search for craters around a prediction.

    Attributes
    ----------
    prior
        Prediction, without the craters that are out of view.
    fix
        None where nothing was identified safely.
    """

    prior: FilterState
    fix: Fix | None
    candidates: int
    expected: int


@dataclass(frozen=True, slots=True)
class _Decisions:
    """Decisions of a frame as far as they go, for its report."""

    candidates: int = 0
    expected: int = 0
    attitude_declared_rad: float = 0.0
    fix: Fix | None = None
    new_landmarks: tuple[Landmark, ...] = field(default=())


def start(
    catalogue: CatalogueTable,
    gravity: GravityTable,
    orientation: OrientationTable,
    initial_state: InitialState,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    burns: BurnTable | None = None,
    method: KalmanFilter = kalman,
    offset: OffsetSize | None = None,
) -> tuple[AnchoredSetup, AnchoredState]:
    """Return set-up and first state from uploaded tables, the calibrated camera and the parameters.

    `offset` is what was learned of the same catalogue before; None starts from the prior.
    """
    if parameters.offset is None:
        offset = None
    elif offset is None:
        offset = first_size(parameters.offset)
    parameters = _with_errors(parameters, parameters.errors.attitude_noise_rad, offset)
    degree = min(parameters.gravity_degree, gravity.c_bar.shape[0] - 1)
    noise = process_noise(degree, gravity.name) if parameters.noise is None else parameters.noise
    model = OrbitModel(gravity, orientation, degree, noise)
    estimate = kalman.initial_filter_state(
        initial_state.ticks,
        initial_state.position_icrf_m,
        initial_state.velocity_icrf_m_s,
        initial_state.sigma_position_m,
        initial_state.sigma_velocity_m_s,
        noise.markov_sigma_m_s2,
        parameters.errors,
        offset is not None,
    )
    setup = AnchoredSetup(
        parameters,
        camera,
        catalogue,
        model,
        noise.markov_sigma_m_s2,
        no_burns() if burns is None else burns,
        estimate,
        method,
    )
    landmarks = landmark_map(catalogue)
    return setup, AnchoredState(estimate, landmarks, MapState(), initial_state.ticks, offset=offset)


def step(state: AnchoredState, observation: Observation, setup: AnchoredSetup) -> tuple[AnchoredState, AnchoredReport]:
    """Return the state after one frame and the report of its decisions.

    Outside the orientation table neither dynamics nor catalogue can be used: the state then stays as it is. An estimate
    that left the plausible distances from the Moon is replaced by the uploaded initial state.
    """
    found, camera_from_icrf = observation.found, observation.camera_from_icrf
    declared_rad = setup.parameters.errors.attitude_noise_rad
    parameters = _with_errors(setup.parameters, state.attitude.sigma_rad(declared_rad), state.offset)
    setup = replace(setup, parameters=parameters)
    mcmf_from_icrf = setup.model.mcmf_from_icrf(observation.ticks)
    prior = predicted(state.estimate, observation.ticks, setup.model, setup.burns, parameters.errors, setup.method)
    if prior is not None and not is_usable(prior, parameters.limits):
        state = replace(state, estimate=setup.initial, fixed_ticks=None, trusted=())
        prior = predicted(setup.initial, observation.ticks, setup.model, setup.burns, parameters.errors, setup.method)
    if prior is None or mcmf_from_icrf is None or not is_usable(prior, parameters.limits):
        return state, _report(state, setup, Outcome.refused, None, _Decisions())
    state, decided = _entered(state, prior, observation, setup)
    decided = replace(decided, attitude_declared_rad=declared_rad)
    if found is None:
        return state, _report(state, setup, Outcome.no_image, mcmf_from_icrf, decided)
    if camera_from_icrf is None or not len(found):
        return state, _report(state, setup, Outcome.coasted, mcmf_from_icrf, decided)
    pose = kalman.pose_of(state.estimate, camera_from_icrf, mcmf_from_icrf)
    search = search_around(state, pose, found, setup)
    before = state.disagreements
    state = replace(
        state,
        estimate=search.prior,
        disagreements=recovery.disagreements(before, search.fix, search.expected, len(found), parameters),
    )
    evidence = rotation_evidence(state, search, state.disagreements > before, pose, found, setup)
    judged = monitored(state.attitude, evidence, declared_rad, setup.camera.focal_px, parameters.monitor)
    fix = search.fix
    if fix is None and not (evidence is not None and is_examined(judged, parameters.monitor)):
        state, fix = recovered(state, pose, found, setup)
    if fix is not None:
        state = replace(state, estimate=fix.update.state, fixed_ticks=observation.ticks)
        state = replace(state, trusted=()) if fix.reacquired else _with_learned_offset(state, fix, parameters)
    state = with_judged_attitude(state, judged, None if evidence is None else search.prior, setup)
    decided = replace(decided, candidates=search.candidates, expected=search.expected, fix=fix)
    if parameters.map_landmarks:
        state, made = map_frame(state, fix, found, camera_from_icrf, mcmf_from_icrf, setup)
        decided = replace(decided, new_landmarks=decided.new_landmarks + made)
    outcome = Outcome.fixed
    if fix is None:
        outcome = Outcome.refused if search.candidates else Outcome.coasted
    return state, _report(state, setup, outcome, mcmf_from_icrf, decided)


def widened(state: AnchoredState, sigma_position_m: float, sigma_velocity_m_s: float) -> AnchoredState:
    """Return the state with more uncertainty per axis, after an event outside dynamics and burns such as a restart."""
    estimate = kalman.widened(state.estimate, sigma_position_m, sigma_velocity_m_s)
    return replace(state, estimate=estimate, trusted=())


def is_lost(state: AnchoredState, parameters: AnchoredParameters) -> bool:
    """Return whether the estimate is too uncertain to be of use."""
    return not state.estimate.finite or state.estimate.position_sigma_m > parameters.divergence_limit_m


def _with_errors(parameters: AnchoredParameters, attitude_rad: float, offset: OffsetSize | None) -> AnchoredParameters:
    """Return the parameters with the noise of attitude and detections and the offset that are in use."""
    errors = replace(parameters.errors, attitude_noise_rad=attitude_rad)
    if offset is not None and parameters.offset is not None:
        size_m = (offset.sigma_m, offset.sigma_m, errors.catalogue_offset_m[2])
        memory_rad = parameters.offset.correlation_rad
        errors = replace(
            errors, catalogue_offset_m=size_m, catalogue_correlation_rad=memory_rad, noise_factor=offset.noise_factor
        )
    return replace(parameters, errors=errors)


def _with_learned_offset(state: AnchoredState, fix: Fix, parameters: AnchoredParameters) -> AnchoredState:
    """Return the state after the size of the catalogue's offset was learned from a fix."""
    if state.offset is None or parameters.offset is None or state.estimate.slope is None:
        return state
    offset = learned(state.offset, fix.update.score, fix.update.noise_score, parameters.offset)
    estimate = state.estimate.with_offset(state.offset.sigma_m, offset.sigma_m)
    return replace(state, estimate=estimate, offset=offset)


def _entered(
    state: AnchoredState, prior: FilterState, observation: Observation, setup: AnchoredSetup
) -> tuple[AnchoredState, _Decisions]:
    """Return the state at the time of the frame; after a gap without its craters, and with the pass ended."""
    memory_s = setup.parameters.limits.crater_memory_s
    elapsed_s = (observation.ticks - state.estimate.ticks) / TICKS_PER_SECOND
    if elapsed_s > memory_s or elapsed_s <= 0.0:
        prior = prior.only_craters(_NO_CRATERS)
    made: tuple[Landmark, ...] = ()
    if observation.found is not None:
        unseen_s = (observation.ticks - state.image_ticks) / TICKS_PER_SECOND
        if unseen_s > memory_s or unseen_s < 0.0:
            prior = prior.only_craters(_NO_CRATERS)
            state, made = end_pass(state, setup)
        state = replace(state, image_ticks=observation.ticks)
    return replace(state, estimate=prior), _Decisions(new_landmarks=made)


def end_pass(state: AnchoredState, setup: AnchoredSetup) -> tuple[AnchoredState, tuple[Landmark, ...]]:
    """Return the state with the map of the pass finished and in use, and the landmarks that this made or improved."""
    mapped, made = mapping.close(state.mapped, setup.camera, setup.parameters.mapping)
    state = replace(state, mapped=mapped)
    if mapped.landmarks:
        landmarks = mapping.with_catalogue(mapped.landmarks, setup.catalogue)
        state = replace(state, landmarks=landmarks, places=None)
    return state, made


def search_around(state: AnchoredState, pose: Pose, found: Detections, setup: AnchoredSetup) -> Search:
    """Return the fix around the prediction: by votes where it is uncertain, by association where it is not."""
    prior, landmarks, camera, parameters = state.estimate, state.landmarks, setup.camera, setup.parameters
    sigma_m = prior.position_sigma_m
    if sigma_m > tracking_limit_m(prior, parameters):
        expected = len(in_view(landmarks, pose, camera, 0.0))
        fix = recovery.search_by_votes(prior, pose, found, landmarks, camera, parameters, sigma_m, method=setup.method)
        # A search that found no safe place is a fix refused, and counts the detections it was tried with.
        tried = len(found) if len(found) >= SEARCHABLE_DETECTIONS else 0
        return Search(prior, fix, tried if fix is None else fix.identification.candidates, expected)
    sighting = in_view(landmarks, pose, camera, search_margin_px(prior, camera, parameters.limits))
    prior = prior.only_craters(sighting.index)
    sighting = look(landmarks, sighting.index, pose, camera, prior.shifts(sighting.index))
    if not len(sighting):
        return Search(prior, None, 0, 0)
    expected = int(np.count_nonzero(inside_image(sighting, camera)))
    identification = associate(prior, sighting, found, landmarks, camera, parameters)
    fix = None
    if identification.believed:
        fix = correct(
            prior, pose, found, identification, sighting, landmarks, camera, parameters,
            altitude_above_sphere_m(prior), reacquired=False, method=setup.method,
        )  # fmt: skip
    return Search(prior, fix, identification.candidates, expected)


def rotation_evidence(
    state: AnchoredState, search: Search, disagrees: bool, pose: Pose, found: Detections, setup: AnchoredSetup
) -> RotationEvidence | None:
    """Return what a frame says about a rotation of the camera; None without enough craters.

    Where image and map disagree, craters are associated once more as if the attitude were uncertain by `trial_rad`. The
    result is evidence of the attitude only: it corrects nothing.
    """
    parameters, fix = setup.parameters, search.fix
    trial_rad = parameters.monitor.trial_rad
    if disagrees:
        prior = search.prior
        if trial_rad <= parameters.errors.attitude_noise_rad or prior.position_sigma_m > tracking_limit_m(
            prior, parameters
        ):
            return None
        tried = _with_errors(parameters, trial_rad, state.offset)
        fix = search_around(state, pose, found, replace(setup, parameters=tried)).fix
    if fix is None or len(fix.index) < parameters.monitor.least_craters:
        return None
    return replace(fix.update.rotation, trial=disagrees)


def with_judged_attitude(
    state: AnchoredState, judged: AttitudeMonitor, prior: FilterState | None, setup: AnchoredSetup
) -> AnchoredState:
    """Return the state with the noise of the attitude as judged after a frame.

    Fixes before the detection trusted the attitude too much: with it, the estimate is replaced by the prediction from
    the beginning of the window. If the filter was reset within the window, its uncertainty grows by what one frame
    with such an attitude can displace it.

    Parameters
    ----------
    prior
        Prediction for the frame if the monitor got evidence from it, else None.
    """
    parameters, before = setup.parameters, state.attitude
    trusted = state.trusted
    if prior is not None:
        trusted = (*trusted, prior.only_craters(_NO_CRATERS))[-parameters.monitor.window_frames :]
    if not judged.degraded or before.degraded:
        return replace(state, attitude=judged, trusted=() if judged.degraded else trusted)
    estimate = state.estimate
    if trusted:
        carried = predicted(trusted[0], estimate.ticks, setup.model, setup.burns, parameters.errors, setup.method)
        if carried is not None and is_usable(carried, parameters.limits):
            estimate = carried
    if len(trusted) <= len(before.window) and len(trusted) < parameters.monitor.window_frames:
        height_m = max(altitude_above_sphere_m(estimate), parameters.limits.lowest_altitude_m)
        shift_m = judged.noise_rad * height_m
        estimate = kalman.widened(estimate.only_craters(_NO_CRATERS), shift_m, recovery.ORBITAL_RATE_RAD_S * shift_m)
    return replace(state, estimate=estimate, attitude=judged, trusted=())


def recovered(
    state: AnchoredState, pose: Pose, found: Detections, setup: AnchoredSetup
) -> tuple[AnchoredState, Fix | None]:
    """Return the fix of a wider search where enough frames disagree, and the state with the search index it needed."""
    parameters, camera, prior = setup.parameters, setup.camera, state.estimate
    if not recovery.is_widened_search_due(state.disagreements, parameters):
        return state, None
    unseen_s = math.inf
    if state.fixed_ticks is not None:
        unseen_s = (prior.ticks - state.fixed_ticks) / TICKS_PER_SECOND
    fix = recovery.search_widely(prior, pose, found, state.landmarks, camera, parameters, unseen_s, setup.method)
    if fix is None and recovery.is_lost_search_due(state.disagreements, parameters):
        places = place_index(state.landmarks) if state.places is None else state.places
        state = replace(state, places=places)
        fix = recovery.search_everywhere(
            prior, pose, found, state.landmarks, camera, parameters, setup.markov_sigma_m_s2, places, setup.method
        )
    return state, fix


def map_frame(
    state: AnchoredState,
    fix: Fix | None,
    found: Detections,
    camera_from_icrf: FloatArray,
    mcmf_from_icrf: FloatArray,
    setup: AnchoredSetup,
) -> tuple[AnchoredState, tuple[Landmark, ...]]:
    """Return the state with the detections mapped that the catalogue does not explain, and the landmarks of this.

    The map gets the frame as corrected: the attitude turned by its estimated error, pixels without their bias.
    """
    parameters, landmarks, mean = setup.parameters, state.landmarks, state.estimate.mean
    pose = kalman.pose_of(state.estimate, camera_from_icrf, mcmf_from_icrf)
    seen = in_view(landmarks, pose, setup.camera, parameters.limits.map_margin_px)
    listed = landmarks.ids[seen.index] < FIRST_LANDMARK_ID
    used, turn_rad = _NO_CRATERS, mean[kalman.ATTITUDE]
    sigma_rad = math.hypot(parameters.errors.attitude_bias_rad, parameters.errors.attitude_noise_rad)
    if fix is not None:
        used = fix.identification.detection[landmarks.ids[fix.index] < FIRST_LANDMARK_ID]
        turn_rad = mean[kalman.ATTITUDE] + fix.update.attitude_rad
        sigma_rad = fix.update.attitude_sigma_rad
    surface_m = state.surface_m
    if listed.any():
        places = landmarks.position_mcmf_m[seen.index[listed]]
        surface_m = float(np.median(np.linalg.norm(places, axis=1))) - MOON_RADIUS_M
    position = state.estimate.covariance[kalman.POSITION, kalman.POSITION]
    view = View(
        state.estimate.ticks,
        turned_by(-turn_rad) @ camera_from_icrf @ mcmf_from_icrf.T,
        mcmf_from_icrf @ mean[kalman.POSITION],
        mcmf_from_icrf @ position @ mcmf_from_icrf.T,
        sigma_rad,
    )
    shift_u_px, shift_v_px = mean[kalman.PIXEL]
    mapped, made = mapping.observe(
        state.mapped,
        view,
        replace(found, u_px=found.u_px - shift_u_px, v_px=found.v_px - shift_v_px),
        detection_variance_px2(found, parameters),
        unclaimed(found, seen.select(listed), used),
        surface_m,
        setup.camera,
        parameters.mapping,
    )
    return replace(state, mapped=mapped, surface_m=surface_m), made


def _report(
    state: AnchoredState, setup: AnchoredSetup, outcome: Outcome, mcmf_from_icrf: FloatArray | None, decided: _Decisions
) -> AnchoredReport:
    """Return the report of a frame; latitude, longitude and altitude are NaN without the Moon's orientation."""
    mean, fix = state.estimate.mean, decided.fix
    position, velocity = mean[kalman.POSITION], mean[kalman.VELOCITY]
    latitude = longitude = altitude = _NAN
    if mcmf_from_icrf is not None:
        fixed = mcmf_from_icrf @ position
        radius = float(np.linalg.norm(fixed))
        latitude, longitude = float(np.arcsin(fixed[2] / radius)), float(np.arctan2(fixed[1], fixed[0]))
        altitude = radius - MOON_RADIUS_M
    rtn = rtn_from_inertial(position, velocity)
    covariance = state.estimate.covariance[kalman.POSITION, kalman.POSITION]
    sigma = np.sqrt(np.maximum(np.diag(rtn @ covariance @ rtn.T), 0.0))
    return AnchoredReport(
        outcome,
        latitude,
        longitude,
        altitude,
        (float(velocity[0]), float(velocity[1]), float(velocity[2])),
        (float(sigma[0]), float(sigma[1]), float(sigma[2])),
        _NAN if fix is None else fix.update.nis,
        0 if fix is None else len(fix.index),
        decided.candidates,
        decided.expected,
        fix is not None and fix.reacquired,
        is_lost(state, setup.parameters),
        fix,
        decided.new_landmarks,
        decided.attitude_declared_rad,
        state.attitude.noise_rad,
        state.offset,
    )
