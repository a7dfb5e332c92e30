"""Correction of a predicted estimate with identified craters, and the tests that a correction must pass."""

from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.anchored.parameters import AnchoredLimits, AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel
from payload_emulator.flight.navigation.filter.filter import CommonErrors, FilterState, KalmanFilter, Update
from payload_emulator.flight.navigation.search.identification import GATE, Identification, identify
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, Sighting, ground_scale
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import BurnTable


def detection_variance_px2(found: Detections, parameters: AnchoredParameters) -> FloatArray:
    """Return the variance of each detection per axis, shape (n,)."""
    sigma = np.where(np.isfinite(found.sigma_px), found.sigma_px, parameters.detection_sigma_px)
    sigma = np.maximum(sigma * parameters.detection_sigma_scale, parameters.detection_sigma_floor_px)
    return np.asarray(sigma**2, dtype=np.float64)


def altitude_above_sphere_m(estimate: FilterState) -> float:
    """Return the altitude of an estimate above the sphere of the maps."""
    return float(np.linalg.norm(estimate.mean[kalman.POSITION])) - MOON_RADIUS_M


def search_margin_px(prior: FilterState, camera: PinholeCamera, limits: AnchoredLimits) -> float:
    """Return how far outside the predicted image craters are searched: the position sigma seen from the altitude."""
    altitude_m = max(altitude_above_sphere_m(prior), limits.lowest_altitude_m)
    wanted = limits.search_sigmas * prior.position_sigma_m / altitude_m * camera.focal_px
    return min(wanted, limits.search_margin_px)


def tracking_limit_m(prior: FilterState, parameters: AnchoredParameters) -> float:
    """Return the largest position sigma with which the search uses a linear prediction."""
    return parameters.tracking_limit_m * ground_scale(altitude_above_sphere_m(prior))


def associate(
    prior: FilterState,
    sighting: Sighting,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
) -> Identification:
    """Return the craters of a sighting that detections belong to.

    A crater among the states brings its own uncertainty; the others have that of the catalogue. The detector's error
    counts in full for both, because the crater of a detection is not known yet.
    """
    count = len(sighting)
    design = kalman.design_matrix(sighting, prior).reshape(2 * count, prior.mean.size)
    tilt = sighting.by_attitude.reshape(2 * count, 3) * parameters.errors.attitude_noise_rad
    spread = (design @ prior.covariance @ design.T + tilt @ tilt.T).reshape(count, 2, count, 2)
    place = (
        sighting.by_position
        @ prior.covariance[kalman.POSITION, kalman.POSITION]
        @ np.swapaxes(sighting.by_position, 1, 2)
    )
    scaled = sighting.by_offset * landmarks.sigma_m[sighting.index][:, None, :]
    own = scaled @ np.swapaxes(scaled, 1, 2)
    own[prior.slots(sighting.index) >= 0] = 0.0
    return identify(
        found,
        sighting,
        spread,
        own,
        detection_variance_px2(found, parameters),
        float(camera.width_px * camera.height_px),
        parameters.identification,
        place,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Identified craters of a frame with the update they gave.

    Attributes
    ----------
    index
        Craters, into the map, shape (n,).
    reacquired
        The fix came from a widened search.
    """

    identification: Identification
    index: IntArray
    update: Update
    reacquired: bool


def correct(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    identification: Identification,
    sighting: Sighting,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    altitude_m: float,
    *,
    reacquired: bool,
    method: KalmanFilter = kalman,
) -> Fix | None:
    """Return the fix of identified craters; None where it contradicts the prediction as a whole.

    Pairs of a reacquisition that all others contradict are left out, worst first, as long as enough remain.

    Parameters
    ----------
    altitude_m
        Predicted altitude, which scales the lasting part of the detector's error to the ground.
    """
    variance = detection_variance_px2(found, parameters)
    if len(identification) > parameters.crater_limit:
        surest = np.argsort(variance[identification.detection], kind="stable")
        identification = identification.select(np.sort(surest[: parameters.crater_limit]))
    while identification.believed or not reacquired:
        index = sighting.index[identification.sighted]
        uv = np.stack([found.u_px, found.v_px], axis=1)[identification.detection]
        variance = detection_variance_px2(found, parameters)[identification.detection]
        persistence = detection_persistence(found, parameters)[identification.detection]
        fresh, lasting = split_variance_px2(variance, persistence, parameters)
        sigma_m = crater_sigma_m(landmarks.sigma_m[index], lasting, altitude_m, camera, parameters)
        update = method.update(
            prior.with_craters(index, sigma_m),
            pose.camera_from_icrf,
            pose.mcmf_from_icrf,
            landmarks,
            index,
            uv,
            fresh,
            camera,
            parameters.errors,
        )
        if update is None:
            return None
        state = kalman.widened(update.state, 0.0, curvature_m_s(prior, update.state))
        fix = Fix(identification, index, replace(update, state=state), reacquired)
        worst = int(np.argmax(fix.update.contradiction))
        # Pairs of a search by association were tested in this way already, those of votes were not.
        if not reacquired or fix.update.contradiction[worst] < GATE:
            return fix if _is_credible(prior, fix, parameters.limits) else None
        identification = identification.select(np.delete(np.arange(len(identification)), worst))
    return None


def _is_credible(prior: FilterState, fix: Fix, limits: AnchoredLimits) -> bool:
    """Return whether a fix agrees with the prediction as a whole."""
    limit = frame_limit(2 * len(fix.index), limits.frame_gate_sigmas)
    return fix.update.nis <= limit and is_plausible(prior, fix.update.state, limits)


def curvature_m_s(prior: FilterState, posterior: FilterState) -> float:
    """Return the error of the velocity that a linear correction leaves: v (d / r)^2 / 2 for a position moved by d.

    The velocity turns with the position about the Moon's centre. A correction of 60 km leaves 1 m/s, one of 1 km 0.3
    mm/s.
    """
    position = prior.mean[kalman.POSITION]
    turned = float(np.linalg.norm(posterior.mean[kalman.POSITION] - position) / np.linalg.norm(position))
    return 0.5 * turned**2 * float(np.linalg.norm(prior.mean[kalman.VELOCITY]))


def crater_sigma_m(
    catalogue_sigma_m: FloatArray,
    lasting_variance_px2: FloatArray,
    altitude_m: float,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
) -> FloatArray:
    """Return the uncertainty of the place at which each crater is detected, east, north, up, shape (n, 3).

    It is that of the catalogue (n, 3) and the part of the detector's error that is the same in every frame.
    """
    altitude_m = max(altitude_m, parameters.limits.lowest_altitude_m)
    lasting_px = np.sqrt(lasting_variance_px2)
    sigma_m = catalogue_sigma_m.copy()
    sigma_m[:, :2] = np.hypot(sigma_m[:, :2], (lasting_px * altitude_m / camera.focal_px)[:, None])
    return sigma_m


def detection_persistence(found: Detections, parameters: AnchoredParameters) -> FloatArray:
    """Return the share of each detection's variance that is the same in every frame of its crater, shape (n,)."""
    if found.persistence is None:
        return np.full(len(found), parameters.detection_persistence)
    return found.persistence


def split_variance_px2(
    variance_px2: FloatArray, persistence: FloatArray, parameters: AnchoredParameters
) -> tuple[FloatArray, FloatArray]:
    """Return the parts of variances (n,) that are new in every frame and that last.

    The first is scaled as learned, not below the repeatability of any detector. What it loses lasts: the detector's
    variance is calibrated, the share that lasts depends on the interval of the frames.
    """
    fresh = variance_px2 * (1.0 - persistence) * parameters.errors.noise_factor**2
    fresh = np.maximum(fresh, parameters.limits.smallest_variance_px2)
    return fresh, np.maximum(variance_px2 - fresh, variance_px2 * persistence)


def is_plausible(prior: FilterState, posterior: FilterState, limits: AnchoredLimits) -> bool:
    """Return whether the prediction's uncertainty allows a correction, and whether it leads to a usable estimate."""
    change = float(np.linalg.norm(posterior.mean[kalman.POSITION] - prior.mean[kalman.POSITION]))
    positive = bool(np.all(np.diag(posterior.covariance) >= 0.0))
    return is_usable(posterior, limits) and positive and change < limits.correction_sigmas * prior.position_sigma_m


def frame_limit(degrees: int, sigmas: float) -> float:
    """Return the chi-square quantile at the probability of a normal quantile.

    Cube-root approximation: too large by 7 % at two degrees of freedom and by 2 % at ten.

    References
    ----------
    Wilson, Hilferty (1931), The distribution of chi-square, PNAS 17.
    """
    share = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - share + sigmas * np.sqrt(share)) ** 3)


def predicted(
    estimate: FilterState,
    ticks: int,
    model: OrbitModel,
    burns: BurnTable,
    errors: CommonErrors,
    method: KalmanFilter = kalman,
) -> FilterState | None:
    """Return the estimate at another on-board time; None outside the orientation table.

    Burns between the two times are applied, in reverse where the prediction goes back in time.
    """
    sense = 1.0 if ticks >= estimate.ticks else -1.0
    low, high = np.searchsorted(burns.ticks, sorted((estimate.ticks, ticks)), side="right")
    for k in range(low, high)[:: int(sense)]:
        reached = method.predict(estimate, int(burns.ticks[k]), model, errors)
        if reached is None:
            return None
        estimate = kalman.burn(reached, sense * burns.delta_v_icrf_m_s[k], float(burns.sigma_m_s[k]))
    return method.predict(estimate, ticks, model, errors)


def is_usable(estimate: FilterState, limits: AnchoredLimits) -> bool:
    """Return whether an estimate is finite and within the allowed distances from the Moon's centre."""
    radius_m = float(np.linalg.norm(estimate.mean[kalman.POSITION]))
    return estimate.finite and limits.lowest_radius_m < radius_m < limits.highest_radius_m
