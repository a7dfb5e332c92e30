"""Absolute navigation: craters of an on-board catalogue anchor a dynamical orbit estimate. No truth, no anchor reads.

Each frame the orbit is predicted, the catalogue is projected, detections are identified and the estimate is
corrected. Where the tests of a fix fail it is refused and the orbit is coasted on dynamics alone: the estimate then
only grows less certain, and says so. If the map keeps disagreeing with what is seen, the search is widened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import rtn_from_inertial
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.acquisition import (
    SEARCHABLE_DETECTIONS,
    AcquisitionParameters,
    acquire,
)
from payload_emulator.flight.navigation.dynamics import OrbitModel, ProcessNoise, process_noise
from payload_emulator.flight.navigation.filter import CommonErrors, FilterState, Update
from payload_emulator.flight.navigation.identification import (
    Identification,
    IdentificationParameters,
    identify,
)
from payload_emulator.flight.navigation.landmark_map import (
    FIRST_LANDMARK_ID,
    Landmark,
    LandmarkMapper,
    MappingParameters,
    View,
    unclaimed,
)
from payload_emulator.flight.navigation.lost_in_space import (
    LostParameters,
    PlaceIndex,
    find_place,
    place_index,
)
from payload_emulator.flight.navigation.outcomes import Outcome
from payload_emulator.flight.navigation.relative import (
    RelativeParameters,
    Remembered,
    tie,
    with_clone,
    without_clone,
)
from payload_emulator.flight.navigation.sighting import (
    LandmarkMap,
    Pose,
    Sighting,
    in_view,
    inside_image,
    landmark_map,
    look,
    turned_by,
)
from payload_emulator.flight.vision.detections import Detections
from tmtc.cuc import TICKS_PER_SECOND
from tmtc.tables import (
    BurnTable,
    CatalogueTable,
    GravityTable,
    InitialState,
    OrientationTable,
    no_burns,
)

_NAN = float("nan")
_NO_CRATERS = np.empty(0, dtype=np.int64)
# Angular rate of a low orbit (2 pi in 111 minutes): an along-track position error implies a velocity error of this rate
# times the position error.
_ORBITAL_RATE_RAD_S = 1e-3


@dataclass(frozen=True, slots=True)
class AnchoredLimits:
    """Plausibility limits, gap limits and gates of the anchored mode, each with its reason.

    Attributes
    ----------
    lowest_radius_m, highest_radius_m
        Distances from the Moon's centre outside which an estimate is invalid: 10 km below the reference sphere, below
        all terrain, and 1,000 km above it, far above the altitudes at which craters are resolved.
    correction_sigmas
        A position correction larger than this number of predicted standard deviations is rejected: a correct fix
        exceeds 7 once in 1e10 fixes (chi-square of 3 degrees above 49), so the cause is a wrong identification.
    crater_memory_s
        Longest gap over which craters remain in the state vector. At 50 km altitude a crater crosses the image in 105
        s, at 100 km in 215 s; after that it is out of view.
    search_sigmas, search_margin_px
        Craters outside the predicted image are searched up to this number of standard deviations of the position (3.5
        misses 1 in 2,000 per axis), and at most this distance outside: with 200 px around a 512 px image the search
        area, and therefore the number of chance matches, is three times that of the image.
    map_margin_px
        Craters up to this distance outside the predicted image are matched to detections at its edge before these are
        mapped as new landmarks.
    lowest_altitude_m
        Lower bound of the altitude that scales pixels to metres, so that a poor prediction does not divide by zero.
    smallest_variance_px2
        The repeatability of a detector is not better than 0.2 px: without a floor, two sightings of a crater would give
        the same equation twice.
    frame_gate_sigmas
        Normal quantile of the probability that the NIS of a correct fix passes: 4.265 is 1 - 1e-5, one correct fix
        rejected in 35 days with a frame every 15 s for half of the time.
    agreement_share
        A fix must explain this share of the possible detections or craters, whichever are fewer; otherwise image and
        map disagree. A correct fix explains a share equal to the detector's recall, 0.6, a chance match a few craters.
    judged_craters
        With fewer craters or detections a frame does not show whether image and map agree.
    lost_search_every
        Search without a prior only in every n-th frame: a search takes up to a second.
    search_radius_sigmas
        Number of standard deviations that the half width of the widened search represents.
    found_sigmas, found_position_m, found_velocity_m_s
        Initial uncertainty of the filter after a search without a prior: this multiple of the standard deviation of the
        position plus a floor, which covers the offset of the catalogue, and a floor of the velocity.
    """

    lowest_radius_m: float = MOON_RADIUS_M - 10e3
    highest_radius_m: float = MOON_RADIUS_M + 1_000e3
    correction_sigmas: float = 7.0
    crater_memory_s: float = 240.0
    search_sigmas: float = 3.5
    search_margin_px: float = 200.0
    map_margin_px: float = 20.0
    lowest_altitude_m: float = 1_000.0
    smallest_variance_px2: float = 0.04
    frame_gate_sigmas: float = 4.265
    agreement_share: float = 0.25
    judged_craters: int = 4
    lost_search_every: int = 3
    search_radius_sigmas: float = 3.0
    found_sigmas: float = 3.0
    found_position_m: float = 200.0
    found_velocity_m_s: float = 1.0


@dataclass(frozen=True, slots=True)
class AnchoredParameters:
    """Tunable parameters of the anchored mode.

    Attributes
    ----------
    gravity_degree
        Degree to which the gravity table is used.
    noise
        Process noise; None uses the noise that belongs to the gravity table and the degree.
    detection_sigma_px, detection_sigma_floor_px, detection_sigma_scale
        Sigma per axis of a detection if the detector gives none; smallest accepted sigma; factor on the detector's
        sigma.
    detection_persistence
        Share of a detection's variance that is common to all frames of a crater.
    tracking_limit_m
        Largest position sigma with which the search uses a linear prediction; above it, the search uses votes.
    search_radius_m
        Half width of the widened search after a disagreement between map and images.
    divergence_limit_m
        Position sigma beyond which the estimate counts as lost.
    suspicion_frames
        Number of consecutive disagreeing frames before the search is widened.
    lost_frames, lost
        Number of consecutive disagreeing frames before the position is searched without a prior, and the parameters of
        that search.
    map_landmarks, mapping
        Whether craters that are not in the catalogue are mapped and used on later passes, and the parameters of this.
    relative
        Whether the motion between two frames is measured with uncatalogued detections, and the parameters of this.
    limits
        Plausibility limits, gap limits and gates.
    crater_limit
        Largest number of craters used in one frame, the most certain first. More craters add little, because the errors
        of attitude and catalogue are common to all.
    """

    gravity_degree: int = 100
    noise: ProcessNoise | None = None
    errors: CommonErrors = field(default_factory=CommonErrors)
    identification: IdentificationParameters = field(default_factory=IdentificationParameters)
    acquisition: AcquisitionParameters = field(default_factory=AcquisitionParameters)
    detection_sigma_px: float = 1.5
    detection_sigma_floor_px: float = 0.5
    detection_sigma_scale: float = 1.0
    detection_persistence: float = 0.3
    tracking_limit_m: float = 1_500.0
    search_radius_m: float = 25_000.0
    divergence_limit_m: float = 5_000.0
    suspicion_frames: int = 4
    lost_frames: int = 6
    lost: LostParameters = field(default_factory=LostParameters)
    map_landmarks: bool = True
    mapping: MappingParameters = field(default_factory=MappingParameters)
    crater_limit: int = 32
    relative: RelativeParameters = field(default_factory=RelativeParameters)
    limits: AnchoredLimits = field(default_factory=AnchoredLimits)


@dataclass(frozen=True, slots=True)
class AnchoredReport:
    """Outcome of one frame, and where the spacecraft is believed to be.

    Attributes
    ----------
    sigma_rtn_m
        Standard deviations radial, transverse, normal.
    nis, matched
        Normalised innovation squared and number of craters of the fix (NaN and 0 without one).
    expected
        Craters of the catalogue that the predicted image holds.
    reacquired
        The fix came from a widened search.
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


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Identified craters of a frame with the update they gave."""

    identification: Identification
    index: IntArray
    update: Update
    reacquired: bool


class AnchoredNavigator:
    """The anchored estimator: owns its state, takes frames in order of time.

    Parameters
    ----------
    catalogue, gravity, orientation, initial_state
        Uploaded tables.
    camera
        The camera as calibrated.
    burns
        Planned burns; `burns` may be replaced at any time.
    """

    def __init__(
        self,
        catalogue: CatalogueTable,
        gravity: GravityTable,
        orientation: OrientationTable,
        initial_state: InitialState,
        camera: PinholeCamera,
        parameters: AnchoredParameters = AnchoredParameters(),
        burns: BurnTable | None = None,
    ) -> None:
        self.parameters = parameters
        self.burns = no_burns() if burns is None else burns
        self.landmarks: LandmarkMap = landmark_map(catalogue)
        degree = min(parameters.gravity_degree, gravity.c_bar.shape[0] - 1)
        noise = process_noise(degree, gravity.name) if parameters.noise is None else parameters.noise
        self.model = OrbitModel(gravity, orientation, degree, noise)
        self.state: FilterState = kalman.initial_filter_state(
            initial_state.ticks,
            initial_state.position_icrf_m,
            initial_state.velocity_icrf_m_s,
            initial_state.sigma_position_m,
            initial_state.sigma_velocity_m_s,
            noise.markov_sigma_m_s2,
            parameters.errors,
        )
        self.last_fix: Fix | None = None
        self.new_landmarks: tuple[Landmark, ...] = ()
        self.mapper = LandmarkMapper(camera, parameters.mapping)
        self._catalogue = catalogue
        self._surface_m = 0.0
        self._image_ticks = initial_state.ticks
        self.ties = 0
        self._before: Remembered | None = None
        self._camera = camera
        self._disagreements = 0
        self._markov_sigma_m_s2 = noise.markov_sigma_m_s2
        self._places: PlaceIndex | None = None

    def step(
        self, ticks: int, found: Detections | None, camera_from_icrf: FloatArray | None
    ) -> AnchoredReport:
        """Return the outcome of one frame.

        Parameters
        ----------
        found
            Detections of the frame; None where there was no usable image.
        camera_from_icrf
            Attitude, shape (3, 3); None where the ADCS gave none: the frame is then coasted over.
        """
        limits = self.parameters.limits
        self.last_fix = None
        elapsed_s = (ticks - self.state.ticks) / TICKS_PER_SECOND
        mcmf_from_icrf = self.model.mcmf_from_icrf(ticks)
        prior = self._predict(ticks)
        if prior is None or mcmf_from_icrf is None or not _usable(prior, limits):
            # Without the Moon's orientation neither dynamics nor catalogue can be used: the old state is all there is.
            return self._report(Outcome.refused, None, 0, 0)
        self.new_landmarks = ()
        if elapsed_s > limits.crater_memory_s or elapsed_s <= 0.0:
            prior = prior.only_craters(_NO_CRATERS)
        if found is not None:
            unseen_s = (ticks - self._image_ticks) / TICKS_PER_SECOND
            if unseen_s > limits.crater_memory_s or unseen_s < 0.0:
                prior = prior.only_craters(_NO_CRATERS)
                self._end_pass()
            self._image_ticks = ticks
        self.state = prior
        if found is None:
            return self._report(Outcome.no_image, mcmf_from_icrf, 0, 0)
        if camera_from_icrf is None or not len(found):
            return self._report(Outcome.coasted, mcmf_from_icrf, 0, 0)
        if self.parameters.relative.enabled:
            prior = self.state = self._tied(prior, found, camera_from_icrf, mcmf_from_icrf)
        pose = kalman.pose_of(prior.mean, camera_from_icrf, mcmf_from_icrf)
        fix, candidates, expected = self._fix(prior, pose, found)
        self._judge(fix, expected, len(found))
        if fix is None and self._disagreements >= self.parameters.suspicion_frames:
            fix = self._reacquire(prior, pose, found)
            since = self._disagreements - self.parameters.lost_frames
            if fix is None and since >= 0 and since % limits.lost_search_every == 0:
                fix = self._found_anywhere(prior, pose, found)
        if fix is not None:
            self.state, self.last_fix = fix.update.state, fix
        if self.parameters.map_landmarks:
            self._map(found, camera_from_icrf, mcmf_from_icrf)
        if self.parameters.relative.enabled:
            self._remember(found, camera_from_icrf, mcmf_from_icrf)
        if fix is None:
            return self._report(
                Outcome.refused if candidates else Outcome.coasted, mcmf_from_icrf, candidates, expected
            )
        return self._report(Outcome.fixed, mcmf_from_icrf, candidates, expected, fix)

    def _tied(
        self, prior: FilterState, found: Detections, camera_from_icrf: FloatArray, mcmf_from_icrf: FloatArray
    ) -> FilterState:
        """Return the prediction after the move since the frame before was measured."""
        before, self._before, self.ties = self._before, None, 0
        if before is None or prior.position_sigma_m > self.parameters.tracking_limit_m:
            return without_clone(prior)
        now = Remembered(found, self._detection_variance(found), camera_from_icrf, mcmf_from_icrf)
        tied, self.ties = tie(
            prior,
            before,
            now,
            self._camera,
            self._surface_m,
            self.parameters.errors.attitude_noise_rad,
            self.parameters.relative,
        )
        return tied if _usable(tied, self.parameters.limits) else without_clone(prior)

    def _remember(self, found: Detections, camera_from_icrf: FloatArray, mcmf_from_icrf: FloatArray) -> None:
        """Keep the detections that no catalogue explains, and the position that they were seen from."""
        free = np.ones(len(found), dtype=bool)
        if self.last_fix is not None:
            free[self.last_fix.identification.detection] = False
        left = found.select(free)
        self._before = Remembered(left, self._detection_variance(left), camera_from_icrf, mcmf_from_icrf)
        self.state = with_clone(self.state)

    def widen(self, sigma_position_m: float, sigma_velocity_m_s: float) -> None:
        """Widen the estimate after something that neither dynamics nor burns know of: a restart, an old state."""
        self.state = kalman.widened(self.state, sigma_position_m, sigma_velocity_m_s)

    @property
    def lost(self) -> bool:
        """Whether the estimate is too uncertain to be of use."""
        return self.state.position_sigma_m > self.parameters.divergence_limit_m

    def _map(self, found: Detections, camera_from_icrf: FloatArray, mcmf_from_icrf: FloatArray) -> None:
        """Give the map what the catalogue does not explain."""
        mean, fix = self.state.mean, self.last_fix
        pose = kalman.pose_of(mean, camera_from_icrf, mcmf_from_icrf)
        seen = in_view(self.landmarks, pose, self._camera, self.parameters.limits.map_margin_px)
        listed = self.landmarks.ids[seen.index] < FIRST_LANDMARK_ID
        used = _NO_CRATERS
        if fix is not None:
            used = fix.identification.detection[self.landmarks.ids[fix.index] < FIRST_LANDMARK_ID]
        if listed.any():
            places = self.landmarks.position_mcmf_m[seen.index[listed]]
            self._surface_m = float(np.median(np.linalg.norm(places, axis=1))) - MOON_RADIUS_M
        errors = self.parameters.errors
        turn_rad, sigma_rad = (
            mean[kalman.ATTITUDE],
            math.hypot(errors.attitude_bias_rad, errors.attitude_noise_rad),
        )
        if fix is not None:
            turn_rad, sigma_rad = turn_rad + fix.update.attitude_rad, fix.update.attitude_sigma_rad
        turned = turned_by(-turn_rad) @ camera_from_icrf
        position = self.state.covariance[kalman.POSITION, kalman.POSITION]
        view = View(
            self.state.ticks,
            turned @ mcmf_from_icrf.T,
            mcmf_from_icrf @ mean[kalman.POSITION],
            mcmf_from_icrf @ position @ mcmf_from_icrf.T,
            sigma_rad,
        )
        free = unclaimed(found, seen.select(listed), used)
        shifted = replace(
            found,
            u_px=found.u_px - mean[kalman.PIXEL][0],
            v_px=found.v_px - mean[kalman.PIXEL][1],
        )
        self.new_landmarks += self.mapper.observe(
            view, shifted, self._detection_variance(found), free, self._surface_m
        )

    def _end_pass(self) -> None:
        """Finish the map of a pass; its landmarks serve from now on."""
        self.new_landmarks = self.mapper.close()
        if len(self.mapper):
            self.landmarks = self.mapper.with_catalogue(self._catalogue)
            self._places = None

    def _predict(self, ticks: int) -> FilterState | None:
        """Return the state carried to a time over the burns on the way, undoing them on the way back."""
        state, table, errors = self.state, self.burns, self.parameters.errors
        sense = 1.0 if ticks >= state.ticks else -1.0
        low, high = np.searchsorted(table.ticks, sorted((state.ticks, ticks)), side="right")
        for k in range(low, high)[:: int(sense)]:
            reached = kalman.predict(state, int(table.ticks[k]), self.model, errors)
            if reached is None:
                return None
            state = kalman.burn(reached, sense * table.delta_v_icrf_m_s[k], float(table.sigma_m_s[k]))
        return kalman.predict(state, ticks, self.model, errors)

    def _fix(self, prior: FilterState, pose: Pose, found: Detections) -> tuple[Fix | None, int, int]:
        """Return a fix around the prediction, the number of candidate pairs and of craters expected in view."""
        sigma_m = prior.position_sigma_m
        if sigma_m > self.parameters.tracking_limit_m:
            expected = len(in_view(self.landmarks, pose, self._camera, 0.0))
            fix = self._acquired(prior, pose, found, sigma_m)
            # A search that found no safe place is a fix refused, and counts the detections it was tried with.
            tried = len(found) if len(found) >= SEARCHABLE_DETECTIONS else 0
            return fix, tried if fix is None else fix.identification.candidates, expected
        altitude_m = float(np.linalg.norm(prior.mean[:3])) - MOON_RADIUS_M
        limits = self.parameters.limits
        margin_px = min(
            limits.search_sigmas
            * sigma_m
            / max(altitude_m, limits.lowest_altitude_m)
            * self._camera.focal_px,
            limits.search_margin_px,
        )
        sighting = in_view(self.landmarks, pose, self._camera, margin_px)
        prior = prior.only_craters(sighting.index)
        self.state = prior
        sighting = look(self.landmarks, sighting.index, pose, self._camera, prior.shifts(sighting.index))
        expected = int(np.count_nonzero(inside_image(sighting, self._camera)))
        if not len(sighting):
            return None, 0, 0
        identification = self._identify(prior, sighting, found)
        if not identification.believed:
            return None, identification.candidates, expected
        fix = self._updated(prior, pose, found, identification, sighting, reacquired=False)
        return fix, identification.candidates, expected

    def _identify(self, prior: FilterState, sighting: Sighting, found: Detections) -> Identification:
        count = len(sighting)
        design = kalman.design_matrix(sighting, prior).reshape(2 * count, prior.mean.size)
        tilt = sighting.by_attitude.reshape(2 * count, 3) * self.parameters.errors.attitude_noise_rad
        spread = (design @ prior.covariance @ design.T + tilt @ tilt.T).reshape(count, 2, count, 2)
        place = (
            sighting.by_position
            @ prior.covariance[kalman.POSITION, kalman.POSITION]
            @ np.swapaxes(sighting.by_position, 1, 2)
        )
        # Craters among the states bring their own uncertainty with them, the others that of the catalogue. What the
        # detector errs by is taken whole for both: which detection is of which crater is not known yet.
        scaled = sighting.by_offset * self.landmarks.sigma_m[sighting.index][:, None, :]
        own = scaled @ np.swapaxes(scaled, 1, 2)
        own[prior.slots(sighting.index) >= 0] = 0.0
        return identify(
            found,
            sighting,
            spread,
            own,
            self._detection_variance(found),
            float(self._camera.width_px * self._camera.height_px),
            self.parameters.identification,
            place,
        )

    def _updated(
        self,
        prior: FilterState,
        pose: Pose,
        found: Detections,
        identification: Identification,
        sighting: Sighting,
        *,
        reacquired: bool,
    ) -> Fix | None:
        """Return the fix of identified craters, None where it contradicts the prediction as a whole."""
        if len(identification) > self.parameters.crater_limit:
            surest = np.argsort(self._detection_variance(found)[identification.detection], kind="stable")
            identification = identification.select(np.sort(surest[: self.parameters.crater_limit]))
        index = sighting.index[identification.sighted]
        uv = np.stack([found.u_px, found.v_px], axis=1)[identification.detection]
        variance = self._detection_variance(found)[identification.detection]
        update = kalman.update(
            prior.with_craters(index, self._crater_sigma_m(index, variance)),
            pose.camera_from_icrf,
            pose.mcmf_from_icrf,
            self.landmarks,
            index,
            uv,
            self._fresh(variance),
            self._camera,
            self.parameters.errors,
        )
        limits = self.parameters.limits
        if update is None or update.nis > frame_limit(2 * len(identification), limits.frame_gate_sigmas):
            return None
        if not _plausible(prior, update.state, limits):
            return None
        return Fix(identification, index, update, reacquired)

    def _acquired(self, prior: FilterState, pose: Pose, found: Detections, radius_m: float) -> Fix | None:
        """Return a fix from a search by votes, None where none is safe."""
        prior = prior.only_craters(_NO_CRATERS)
        pairs = acquire(
            found,
            self.landmarks,
            pose,
            self._camera,
            radius_m,
            np.sqrt(self._detection_variance(found)),
            self.parameters.errors.attitude_noise_rad + self.parameters.errors.attitude_bias_rad,
            self.parameters.acquisition,
        )
        if pairs is None:
            return None
        sighting = look(self.landmarks, pairs.index, pairs.pose, self._camera)
        everything = np.arange(pairs.index.size)
        identification = Identification(pairs.detection, everything, pairs.candidates, pairs.needed)
        return self._updated(prior, pose, found, identification, sighting, reacquired=True)

    def _reacquire(self, prior: FilterState, pose: Pose, found: Detections) -> Fix | None:
        """Return a fix from a search far beyond what the estimate believes of itself."""
        wide = prior.covariance.copy()
        extra = self.parameters.search_radius_m / self.parameters.limits.search_radius_sigmas
        wide[:3, :3] += np.eye(3) * extra**2
        wide[3:6, 3:6] += np.eye(3) * (_ORBITAL_RATE_RAD_S * extra) ** 2
        return self._acquired(replace(prior, covariance=wide), pose, found, extra)

    def _found_anywhere(self, prior: FilterState, pose: Pose, found: Detections) -> Fix | None:
        """Return a fix from a search over the whole map by a camera that looks down; the orbit turns with the place."""
        if self._places is None:
            self._places = place_index(self.landmarks)
        sigma_px = np.sqrt(self._detection_variance(found))
        place = find_place(found, sigma_px, self._places, self._camera, self.parameters.lost)
        if place is None:
            return None
        old, new = prior.mean[kalman.POSITION], pose.mcmf_from_icrf.T @ place.position_mcmf_m
        # The shortest turn from the old place to the new one; a plane of the orbit that has turned is in the sigma.
        axis = np.cross(old, new) / (np.linalg.norm(old) * np.linalg.norm(new))
        velocity = prior.mean[kalman.VELOCITY]
        cosine = math.sqrt(max(1.0 - float(axis @ axis), 0.0))
        velocity = (
            velocity + np.cross(axis, velocity) + np.cross(axis, np.cross(axis, velocity)) / (1.0 + cosine)
        )
        limits = self.parameters.limits
        fresh = kalman.initial_filter_state(
            prior.ticks,
            new,
            velocity,
            limits.found_sigmas * float(place.sigma_m.max()) + limits.found_position_m,
            _ORBITAL_RATE_RAD_S * float(np.linalg.norm(new - old)) + limits.found_velocity_m_s,
            self._markov_sigma_m_s2,
            self.parameters.errors,
        )
        there = replace(pose, position_icrf_m=new)
        sighting = look(self.landmarks, place.index, there, self._camera)
        everything = np.arange(place.index.size)
        identification = Identification(place.detection, everything, len(found), len(place))
        return self._updated(fresh, there, found, identification, sighting, reacquired=True)

    def _judge(self, fix: Fix | None, expected: int, detections: int) -> None:
        """Count frames in a row in which the map and the image disagree."""
        usable, limits = min(expected, detections), self.parameters.limits
        if fix is not None and len(fix.index) >= max(1, limits.agreement_share * usable):
            self._disagreements = 0
        elif usable >= limits.judged_craters:
            self._disagreements += 1

    def _crater_sigma_m(self, index: IntArray, variance_px2: FloatArray) -> FloatArray:
        """Return the uncertainty of where each crater is detected, east, north, up.

        That is the catalogue's, and the part of the detector's error that stays with the crater.
        """
        altitude_m = max(
            float(np.linalg.norm(self.state.mean[:3])) - MOON_RADIUS_M,
            self.parameters.limits.lowest_altitude_m,
        )
        lasting_px = np.sqrt(variance_px2 * self.parameters.detection_persistence)
        sigma_m = self.landmarks.sigma_m[index].copy()
        sigma_m[:, :2] = np.hypot(sigma_m[:, :2], (lasting_px * altitude_m / self._camera.focal_px)[:, None])
        return sigma_m

    def _detection_variance(self, found: Detections) -> FloatArray:
        """Return the variance of each detection, per axis."""
        parameters = self.parameters
        sigma = np.where(np.isfinite(found.sigma_px), found.sigma_px, parameters.detection_sigma_px)
        sigma = np.maximum(sigma * parameters.detection_sigma_scale, parameters.detection_sigma_floor_px)
        return np.asarray(sigma**2, dtype=np.float64)

    def _fresh(self, variance_px2: FloatArray) -> FloatArray:
        """Return the part of each detection's variance that is new in every frame."""
        fresh = variance_px2 * (1.0 - self.parameters.detection_persistence)
        return np.maximum(fresh, self.parameters.limits.smallest_variance_px2)

    def _report(
        self,
        outcome: Outcome,
        mcmf_from_icrf: FloatArray | None,
        candidates: int,
        expected: int,
        fix: Fix | None = None,
    ) -> AnchoredReport:
        position, velocity = self.state.mean[:3], self.state.mean[3:6]
        if mcmf_from_icrf is None:
            latitude = longitude = altitude = _NAN
        else:
            fixed = mcmf_from_icrf @ position
            radius = float(np.linalg.norm(fixed))
            latitude, longitude = float(np.arcsin(fixed[2] / radius)), float(np.arctan2(fixed[1], fixed[0]))
            altitude = radius - MOON_RADIUS_M
        rtn = rtn_from_inertial(position, velocity)
        sigma = np.sqrt(np.maximum(np.diag(rtn @ self.state.covariance[:3, :3] @ rtn.T), 0.0))
        return AnchoredReport(
            outcome,
            latitude,
            longitude,
            altitude,
            (float(velocity[0]), float(velocity[1]), float(velocity[2])),
            (float(sigma[0]), float(sigma[1]), float(sigma[2])),
            _NAN if fix is None else fix.update.nis,
            0 if fix is None else len(fix.index),
            candidates,
            expected,
            fix is not None and fix.reacquired,
        )


def _usable(state: FilterState, limits: AnchoredLimits) -> bool:
    """Return whether a state is finite and somewhere near the Moon."""
    radius_m = float(np.linalg.norm(state.mean[:3]))
    return state.finite and limits.lowest_radius_m < radius_m < limits.highest_radius_m


def _plausible(prior: FilterState, posterior: FilterState, limits: AnchoredLimits) -> bool:
    """Return whether a correction is one that the prediction's uncertainty allows, to a place near the Moon."""
    change = float(np.linalg.norm(posterior.mean[:3] - prior.mean[:3]))
    positive = bool(np.all(np.diag(posterior.covariance) >= 0.0))
    return (
        _usable(posterior, limits) and positive and change < limits.correction_sigmas * prior.position_sigma_m
    )


def frame_limit(degrees: int, sigmas: float) -> float:
    """Return the chi-square quantile at the probability of a normal quantile.

    Wilson and Hilferty's cube-root approximation: too large by 7 % at two degrees of freedom and by 2 % at ten.
    """
    share = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - share + sigmas * np.sqrt(share)) ** 3)
