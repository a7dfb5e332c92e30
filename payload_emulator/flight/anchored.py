"""Absolute navigation: craters of an on-board catalogue anchor a dynamical orbit estimate. No truth, no anchor reads.

Each frame the orbit is predicted, the catalogue is projected, detections are identified and the estimate is
corrected. Where the tests of a fix fail it is refused and the orbit is coasted on dynamics alone: the estimate then
only grows less certain, and says so. If the map keeps disagreeing with what is seen, the search is widened.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import rtn_from_inertial
from payload_emulator.flight import navigation_filter as kalman
from payload_emulator.flight.acquisition import AcquisitionParameters, acquire
from payload_emulator.flight.detections import Detections
from payload_emulator.flight.dynamics import OrbitModel, ProcessNoise
from payload_emulator.flight.identification import Identification, IdentificationParameters, identify
from payload_emulator.flight.navigation_filter import CommonErrors, FilterState, Update
from payload_emulator.flight.outcomes import Outcome
from payload_emulator.flight.sighting import (
    LandmarkMap,
    Pose,
    Sighting,
    in_view,
    inside_image,
    landmark_map,
    look,
)
from payload_emulator.flight.tables import (
    TICKS_PER_SECOND,
    CatalogueTable,
    GravityTable,
    InitialState,
    OrientationTable,
)

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_NAN = float("nan")
_UNKNOWN = (_NAN, _NAN, _NAN)


@dataclass(frozen=True, slots=True)
class AnchoredParameters:
    """Everything of the anchored mode that may be tuned.

    Attributes
    ----------
    gravity_degree
        Degree to which the gravity table is used.
    detection_sigma_px, detection_sigma_floor_px, detection_sigma_scale
        Sigma per axis of a detection where the detector gives none; smallest believed; factor on what it gives.
    detection_persistence
        Share of a detection's variance that stays with its crater from frame to frame.
    frames_in_view_recall
        Part of the frames in which a crater in view is detected: with the time in view it tells how often the
        same crater's error is met, and its variance is raised by that number.
    tracking_limit_m
        Largest position sigma around which a linear prediction is searched; beyond, the search is by votes.
    search_radius_m
        Half width of the widened search after the map has disagreed with the images.
    divergence_limit_m
        Position sigma beyond which the estimate counts as lost.
    suspicion_frames
        Frames in a row that must disagree before the search is widened.
    """

    gravity_degree: int = 100
    noise: ProcessNoise = field(default_factory=ProcessNoise)
    errors: CommonErrors = field(default_factory=CommonErrors)
    identification: IdentificationParameters = field(default_factory=IdentificationParameters)
    acquisition: AcquisitionParameters = field(default_factory=AcquisitionParameters)
    detection_sigma_px: float = 1.5
    detection_sigma_floor_px: float = 0.5
    detection_sigma_scale: float = 1.0
    detection_persistence: float = 0.3
    frames_in_view_recall: float = 0.6
    tracking_limit_m: float = 1_500.0
    search_radius_m: float = 25_000.0
    divergence_limit_m: float = 5_000.0
    suspicion_frames: int = 4


@dataclass(frozen=True, slots=True)
class AnchoredReport:
    """What became of one frame, and where the spacecraft is believed to be.

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
    index: Index
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
    """

    def __init__(
        self,
        catalogue: CatalogueTable,
        gravity: GravityTable,
        orientation: OrientationTable,
        initial_state: InitialState,
        camera: PinholeCamera,
        parameters: AnchoredParameters = AnchoredParameters(),
    ) -> None:
        self.parameters = parameters
        self.landmarks: LandmarkMap = landmark_map(catalogue)
        self.model = OrbitModel(gravity, orientation, parameters.gravity_degree, parameters.noise)
        self.state: FilterState = kalman.initial_filter_state(
            initial_state.ticks,
            initial_state.position_icrf_m,
            initial_state.velocity_icrf_m_s,
            initial_state.sigma_position_m,
            initial_state.sigma_velocity_m_s,
            parameters.noise.markov_sigma_m_s2,
            parameters.errors,
        )
        self.last_fix: Fix | None = None
        self._camera = camera
        self._interval_s = 15.0
        self._disagreements = 0

    def step(self, ticks: int, found: Detections | None, camera_from_icrf: Float | None) -> AnchoredReport:
        """Return what became of one frame.

        Parameters
        ----------
        found
            Detections of the frame; None where there was no usable image.
        camera_from_icrf
            Attitude, shape (3, 3); None where the ADCS gave none: the frame is then coasted over.
        """
        self.last_fix = None
        elapsed_s = (ticks - self.state.ticks) / TICKS_PER_SECOND
        mcmf_from_icrf = self.model.mcmf_from_icrf(ticks)
        prior = kalman.predict(self.state, ticks, self.model, self.parameters.errors)
        if prior is None or mcmf_from_icrf is None or not prior.finite:
            # Without the Moon's orientation neither dynamics nor catalogue can be used: the old state is all there is.
            return self._report(Outcome.refused, None, 0, 0)
        if elapsed_s > 0.0:
            self._interval_s = elapsed_s
        self.state = prior
        if found is None:
            return self._report(Outcome.no_image, mcmf_from_icrf, 0, 0)
        if camera_from_icrf is None or not len(found):
            return self._report(Outcome.coasted, mcmf_from_icrf, 0, 0)
        pose = kalman.pose_of(prior.mean, camera_from_icrf, mcmf_from_icrf)
        fix, candidates, expected = self._fix(prior, pose, found)
        self._judge(fix, expected, len(found))
        if fix is None and self._disagreements >= self.parameters.suspicion_frames:
            fix = self._reacquire(prior, pose, found)
        if fix is None:
            return self._report(
                Outcome.refused if candidates else Outcome.coasted, mcmf_from_icrf, candidates, expected
            )
        self.state, self.last_fix = fix.update.state, fix
        return self._report(Outcome.fixed, mcmf_from_icrf, candidates, expected, fix)

    @property
    def lost(self) -> bool:
        """Whether the estimate is too uncertain to be of use."""
        return self.state.position_sigma_m > self.parameters.divergence_limit_m

    def _fix(self, prior: FilterState, pose: Pose, found: Detections) -> tuple[Fix | None, int, int]:
        """Return a fix around the prediction, the number of candidate pairs and of craters expected in view."""
        sigma_m = prior.position_sigma_m
        if sigma_m > self.parameters.tracking_limit_m:
            expected = len(in_view(self.landmarks, pose, self._camera, 0.0))
            fix = self._acquired(prior, pose, found, sigma_m)
            return fix, 0 if fix is None else fix.identification.candidates, expected
        altitude_m = float(np.linalg.norm(prior.mean[:3])) - MOON_RADIUS_M
        margin_px = min(3.5 * sigma_m / max(altitude_m, 1_000.0) * self._camera.focal_px, 200.0)
        sighting = in_view(self.landmarks, pose, self._camera, margin_px)
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
        design = kalman.design_matrix(sighting).reshape(2 * count, kalman.SIZE)
        tilt = sighting.by_attitude.reshape(2 * count, 3) * self.parameters.errors.attitude_noise_rad
        spread = (design @ prior.covariance @ design.T + tilt @ tilt.T).reshape(count, 2, count, 2)
        return identify(
            found,
            sighting,
            spread,
            self._crater_noise(sighting),
            self._detection_variance(found),
            float(self._camera.width_px * self._camera.height_px),
            self.parameters.identification,
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
        chosen = sighting.select(identification.sighted)
        variance = self._detection_variance(found)[identification.detection]
        test_noise = self._crater_noise(chosen) + variance[:, None, None] * np.eye(2)
        share = self.parameters.detection_persistence
        times = self._sightings_per_crater()
        lasting = variance * (1.0 - share + share * times)
        noise = times * self._crater_noise(chosen) + lasting[:, None, None] * np.eye(2)
        uv = np.stack([found.u_px, found.v_px], axis=1)[identification.detection]
        update = kalman.update(
            prior,
            pose.camera_from_icrf,
            pose.mcmf_from_icrf,
            self.landmarks,
            chosen.index,
            uv,
            noise,
            test_noise,
            self._camera,
            self.parameters.errors,
        )
        if update is None or update.nis > _frame_limit(2 * len(identification)):
            return None
        return Fix(identification, chosen.index, update, reacquired)

    def _acquired(self, prior: FilterState, pose: Pose, found: Detections, radius_m: float) -> Fix | None:
        """Return a fix from a search by votes, None where none is safe."""
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
        extra = self.parameters.search_radius_m / 3.0
        wide[:3, :3] += np.eye(3) * extra**2
        # A jump of position by Kepler motion comes with one of velocity: 1e-3 rad/s times the distance.
        wide[3:6, 3:6] += np.eye(3) * (1e-3 * extra) ** 2
        return self._acquired(FilterState(prior.ticks, prior.mean, wide), pose, found, extra)

    def _judge(self, fix: Fix | None, expected: int, detections: int) -> None:
        """Count frames in a row in which the map and the image disagree."""
        usable = min(expected, detections)
        if fix is not None and len(fix.index) >= max(1, 0.25 * usable):
            self._disagreements = 0
        elif usable >= 4:
            self._disagreements += 1

    def _crater_noise(self, sighting: Sighting) -> Float:
        """Return the covariance of each crater's catalogued place in pixels."""
        sigma = self.landmarks.sigma_m[sighting.index]
        scaled = sighting.by_offset * sigma[:, None, :]
        return np.asarray(scaled @ np.swapaxes(scaled, 1, 2), dtype=np.float64)

    def _detection_variance(self, found: Detections) -> Float:
        """Return the variance of each detection, per axis."""
        parameters = self.parameters
        sigma = np.where(np.isfinite(found.sigma_px), found.sigma_px, parameters.detection_sigma_px)
        sigma = np.maximum(sigma * parameters.detection_sigma_scale, parameters.detection_sigma_floor_px)
        return np.asarray(sigma**2, dtype=np.float64)

    def _sightings_per_crater(self) -> float:
        """Return how often the same crater is used on one pass: its error is not fresh each time."""
        position, velocity = self.state.mean[:3], self.state.mean[3:6]
        radius = float(np.linalg.norm(position))
        altitude_m: float = max(radius - MOON_RADIUS_M, 1_000.0)
        ground_speed = float(np.linalg.norm(velocity)) * MOON_RADIUS_M / radius
        length = 2.0 * altitude_m * float(np.tan(0.5 * self._camera.fov_rad))
        frames = length / (ground_speed * max(self._interval_s, 1.0))
        return max(1.0, self.parameters.frames_in_view_recall * frames)

    def _report(
        self,
        outcome: Outcome,
        mcmf_from_icrf: Float | None,
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


def _frame_limit(degrees: int) -> float:
    """Return the chi-square quantile at 1 - 1e-5 (Wilson and Hilferty's cube-root approximation)."""
    share = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - share + 4.265 * np.sqrt(share)) ** 3)
