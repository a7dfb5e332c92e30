"""Visual odometry of the paper (section VI), in two geometries on one matcher.

`paper`: planar pinhole, three unknowns by linear least squares, the altitude of the anchor ephemeris as
the scale. `spherical`: the same matcher and the same error bounding, but detections are back-projected
onto the sphere and the motion is the one that reprojects them exactly.

Both assume a nadir camera with image up to the north, as the paper does. Both read the anchor ephemeris: its
altitude at every frame, and its full position at a reset. Every read is counted.

What the paper leaves open is settled so:

- Direction of motion. The paper's bounds are for a pass to the north. The sign is read from the anchor
  ephemeris at each reset, with the position, and mirrors the bounds for a pass to the south.
- Scale. `h` is the anchor altitude at the later frame: on a plane the equations are then exact, not
  linearised.
- Prediction repeats the last successful motion whole, altitude included, scaled by the time between frames.
- A rejected frame is predicted like one without a match, and keeps the name `rejected`.
- Motion per frame becomes latitude and longitude on the sphere of the maps.

References
----------
Paper section VI (equations), VI-A (matching), VI-B (altitude), VI-C (error bounding), VII-A (outcomes).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import size_class
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.odometry.matcher import GroundFeatures, Match, MatcherParameters, match_frames
from payload_emulator.flight.navigation.outcomes import Mode, Outcome, ResetTrigger
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import AnchorTable
from tmtc.packets.pus import TICKS_PER_SECOND

PAPER_CLASSES = 3
_NAN = float("nan")
_GAUSS_NEWTON_STEPS = 6
# Steps of the numerical derivatives: 1.7 m on the ground and 1 m of altitude, small against a pixel of 95 m and more.
_DERIVATIVE_STEP_RAD, _DERIVATIVE_STEP_M = 1e-6, 1.0
# A change of 0.2 mm on the ground ends the iteration.
_CONVERGED_RAD = 1e-10
# Poleward of this latitude a step in longitude means nothing; the state is held at it.
_POLE_COSINE = 1e-6


@dataclass(frozen=True, slots=True)
class OdometryParameters:
    """Error bounding of section VI-C; the values are the paper's.

    Attributes
    ----------
    prediction_limit_frames
        K: frames that the last motion may be extrapolated over.
    time_gap_s
        T_gap: longer intervals between frames re-anchor.
    safety_timeout_s
        T_timeout: re-anchor when nothing has matched for so long; None leaves this optional layer off.
    matcher
        Orbital prior and cluster rule.
    """

    prediction_limit_frames: int = 20
    time_gap_s: float = 60.0
    safety_timeout_s: float | None = None
    matcher: MatcherParameters = field(default_factory=MatcherParameters)


@dataclass(frozen=True, slots=True, eq=False)
class FrameFeatures:
    """Features of a frame for the next one: pixels, ground places and the altitude they were scaled with."""

    u_px: FloatArray
    v_px: FloatArray
    ground: GroundFeatures
    altitude_m: float


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the spacecraft over one interval: metres east, north (on the sphere of the maps) and up."""

    east_m: float
    north_m: float
    up_m: float
    interval_s: float


@dataclass(frozen=True, slots=True, eq=False)
class OdometryState:
    """Estimated position of the odometry, and its memory.

    Attributes
    ----------
    direction
        +1 on a pass to the north, -1 to the south, from the last reset.
    last_motion
        Last motion that came from a match, None since the last reset before any match.
    frames_since_motion
        Frames since `last_motion`.
    last_match_ticks
        Time of the last match or reset.
    altitude_reads, resets
        Uses of the anchor ephemeris so far.
    """

    ticks: int
    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    direction: int
    last_motion: Motion | None
    frames_since_motion: int
    last_match_ticks: int
    features: FrameFeatures
    altitude_reads: int
    resets: int


@dataclass(frozen=True, slots=True)
class OdometryReport:
    """Outcome of one frame."""

    outcome: Outcome
    reset_trigger: ResetTrigger
    candidate_pairs: int
    pairs: int
    shift_east_m: float
    shift_north_m: float


def step(
    state: OdometryState | None,
    ticks: int,
    detections: Detections,
    anchor: AnchorTable,
    camera: PinholeCamera,
    mode: Mode,
    parameters: OdometryParameters = OdometryParameters(),
    *,
    manual_step: bool = False,
) -> tuple[OdometryState | None, OdometryReport]:
    """Return the state after one frame and the outcome of the frame.

    A frame that needs a reset where the anchor ephemeris has nothing is `missed`: before the first reset the
    state stays None, afterwards it is held and the reset stays due.
    """
    features = frame_features(detections, anchor.altitude_m(ticks), camera, mode)
    trigger = _reset_trigger(state, ticks, parameters, manual_step)
    if trigger is not ResetTrigger.none or state is None:
        return _reset(state, ticks, features, anchor, trigger)
    state = replace(state, altitude_reads=state.altitude_reads + 1)
    interval_s = (ticks - state.ticks) / TICKS_PER_SECOND
    match = match_frames(state.features.ground, features.ground, interval_s, state.direction, parameters.matcher)
    motion = None
    if len(match):
        if mode is Mode.paper:
            motion = solve_planar(state.features, features, match, camera, interval_s)
        else:
            motion = solve_spherical(state.features, features, match, camera, state.latitude_rad, interval_s)
    if motion is None:
        return _extrapolate(state, ticks, features, match, Outcome.predicted, parameters)
    previous = state.direction if state.last_motion is None else state.last_motion.north_m
    if motion.north_m * previous < 0.0:
        return _extrapolate(state, ticks, features, match, Outcome.rejected, parameters)
    moved = replace(
        _moved(state, motion),
        ticks=ticks,
        last_motion=motion,
        frames_since_motion=0,
        last_match_ticks=ticks,
        features=features,
    )
    outcome = Outcome.multi if len(match) >= 2 else Outcome.single
    return moved, OdometryReport(
        outcome, ResetTrigger.none, match.candidate_pairs, len(match), motion.east_m, motion.north_m
    )


def frame_features(detections: Detections, altitude_m: float, camera: PinholeCamera, mode: Mode) -> FrameFeatures:
    """Return the detections placed on the ground: on the tangent plane (`paper`) or on the sphere
    (`spherical`).

    Detections whose ray misses the ground, or with any NaN, belong to no size class and match nothing.
    """
    x, y = _tangents(detections.u_px, detections.v_px, camera)
    if mode is Mode.paper:
        depth = np.full_like(x, altitude_m)
        east, north = x * altitude_m, -y * altitude_m
    else:
        east, north, depth = _sphere_places(x, y, altitude_m)
    size_class = (
        _size_class(detections.diameter_px * depth / camera.focal_px)
        if detections.size_class is None
        else detections.size_class
    )
    size_class = np.where(np.isfinite(east) & np.isfinite(north), size_class, -1)
    return FrameFeatures(detections.u_px, detections.v_px, GroundFeatures(east, north, size_class), altitude_m)


def depth_on_sphere(u_px: FloatArray, v_px: FloatArray, altitude_m: float, camera: PinholeCamera) -> FloatArray:
    """Return the depth along the boresight of the ground behind pixels, nadir camera, NaN beyond the limb."""
    x, y = _tangents(u_px, v_px, camera)
    return _depth(x * x + y * y, altitude_m)


def solve_planar(
    earlier: FrameFeatures, later: FrameFeatures, match: Match, camera: PinholeCamera, interval_s: float
) -> Motion | None:
    """Return the motion by the paper's least squares (section VI-B), None where the system has no solution.

    One pair locks the change of altitude to zero and solves the remaining two equations.
    """
    cx, cy = camera.centre_px
    f = camera.focal_px
    h = later.altitude_m
    u, v = earlier.u_px[match.earlier], earlier.v_px[match.earlier]
    du, dv = later.u_px[match.later] - u, later.v_px[match.later] - v
    if len(match) == 1:
        east, north, up = -h * float(du[0]) / f, h * float(dv[0]) / f, 0.0
    else:
        zero, one = np.zeros_like(u), np.ones_like(u)
        design = np.empty((2 * u.size, 3))
        design[0::2] = np.stack([-f * one, zero, -(u - cx)], axis=1)
        design[1::2] = np.stack([zero, f * one, -(v - cy)], axis=1)
        right = np.empty(2 * u.size)
        right[0::2], right[1::2] = h * du, h * dv
        solution = np.linalg.lstsq(design, right, rcond=None)[0]
        east, north, up = (float(value) for value in solution)
    if not np.isfinite(east + north + up):
        return None
    return Motion(east, north, up, interval_s)


def solve_spherical(
    earlier: FrameFeatures,
    later: FrameFeatures,
    match: Match,
    camera: PinholeCamera,
    latitude_rad: float,
    interval_s: float,
) -> Motion | None:
    """Return the motion that reprojects the earlier craters onto the later ones exactly, None without a
    solution.

    The craters are placed on the sphere from the earlier frame and its anchor altitude; latitude,
    longitude and altitude of the later frame are found by Gauss-Newton iteration. One pair alone cannot
    give the altitude: the camera is then put at the anchor altitude of the later frame, and the change
    reported is zero.
    """
    x, y = _tangents(earlier.u_px[match.earlier], earlier.v_px[match.earlier], camera)
    ray = np.stack([x, -y, -np.ones_like(x)], axis=1)
    points = _on_sphere(ray, latitude_rad, earlier.altitude_m)
    seen = np.stack(_tangents(later.u_px[match.later], later.v_px[match.later], camera), axis=1)
    locked = len(match) == 1
    shift = earlier.ground, later.ground
    north = float(np.mean(shift[0].north_m[match.earlier] - shift[1].north_m[match.later]))
    east = float(np.mean(shift[0].east_m[match.earlier] - shift[1].east_m[match.later]))
    cosine = max(np.cos(latitude_rad), _POLE_COSINE)
    unknowns = np.array([latitude_rad + north / MOON_RADIUS_M, east / (MOON_RADIUS_M * cosine), later.altitude_m])
    steps = np.array([_DERIVATIVE_STEP_RAD, _DERIVATIVE_STEP_RAD / cosine, _DERIVATIVE_STEP_M])
    columns = 2 if locked else 3
    for _ in range(_GAUSS_NEWTON_STEPS):
        predicted = _see(points, unknowns)
        jacobian = np.stack(
            [
                ((_see(points, unknowns + np.eye(3)[k] * steps[k]) - predicted) / steps[k]).reshape(-1)
                for k in range(columns)
            ],
            axis=1,
        )
        residual = (seen - predicted).reshape(-1)
        if not (np.all(np.isfinite(jacobian)) and np.all(np.isfinite(residual))):
            return None
        change = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
        unknowns[:columns] += change
        if abs(change[0]) < _CONVERGED_RAD and abs(change[1]) * cosine < _CONVERGED_RAD:
            break
    return Motion(
        float(unknowns[1]) * MOON_RADIUS_M * cosine,
        float(unknowns[0] - latitude_rad) * MOON_RADIUS_M,
        0.0 if locked else float(unknowns[2]) - earlier.altitude_m,
        interval_s,
    )


def _reset_trigger(
    state: OdometryState | None, ticks: int, parameters: OdometryParameters, manual_step: bool
) -> ResetTrigger:
    if state is None:
        return ResetTrigger.initialization
    if manual_step:
        return ResetTrigger.manual_step
    elapsed_s = (ticks - state.ticks) / TICKS_PER_SECOND
    # A clock that stands or runs backwards leaves no interval to scale with: the same remedy as a gap.
    if elapsed_s > parameters.time_gap_s or elapsed_s <= 0.0:
        return ResetTrigger.time_gap
    timeout = parameters.safety_timeout_s
    if timeout is not None and (ticks - state.last_match_ticks) / TICKS_PER_SECOND > timeout:
        return ResetTrigger.safety_timeout
    return ResetTrigger.none


def _reset(
    state: OdometryState | None, ticks: int, features: FrameFeatures, anchor: AnchorTable, trigger: ResetTrigger
) -> tuple[OdometryState | None, OdometryReport]:
    """Return the state put onto the anchor ephemeris."""
    sample = anchor.at(ticks)
    if sample is None:
        return state, OdometryReport(Outcome.missed, ResetTrigger.none, 0, 0, _NAN, _NAN)
    reads, resets = (0, 0) if state is None else (state.altitude_reads, state.resets)
    anchored = OdometryState(
        ticks=ticks,
        latitude_rad=sample.latitude_rad,
        longitude_rad=sample.longitude_rad,
        altitude_m=sample.altitude_m,
        direction=sample.direction,
        last_motion=None,
        frames_since_motion=0,
        last_match_ticks=ticks,
        features=features,
        altitude_reads=reads + 1,
        resets=resets + 1,
    )
    return anchored, OdometryReport(Outcome.anchored, trigger, 0, 0, _NAN, _NAN)


def _extrapolate(
    state: OdometryState,
    ticks: int,
    features: FrameFeatures,
    match: Match,
    outcome: Outcome,
    parameters: OdometryParameters,
) -> tuple[OdometryState, OdometryReport]:
    """Return the state moved by the last successful motion, or held where there is none left to repeat."""
    frames = state.frames_since_motion + 1
    held = replace(state, ticks=ticks, features=features, frames_since_motion=frames)
    pairs = len(match) if outcome is Outcome.rejected else 0
    last = state.last_motion
    if last is None or frames > parameters.prediction_limit_frames:
        name = Outcome.rejected if outcome is Outcome.rejected else Outcome.missed
        return held, OdometryReport(name, ResetTrigger.none, match.candidate_pairs, pairs, _NAN, _NAN)
    interval_s = (ticks - state.ticks) / TICKS_PER_SECOND
    ratio = interval_s / last.interval_s
    motion = Motion(last.east_m * ratio, last.north_m * ratio, last.up_m * ratio, interval_s)
    moved = _moved(held, motion)
    return moved, OdometryReport(
        outcome, ResetTrigger.none, match.candidate_pairs, pairs, motion.east_m, motion.north_m
    )


def _moved(state: OdometryState, motion: Motion) -> OdometryState:
    cosine = max(float(np.cos(state.latitude_rad)), _POLE_COSINE)
    latitude = state.latitude_rad + motion.north_m / MOON_RADIUS_M
    longitude = state.longitude_rad + motion.east_m / (MOON_RADIUS_M * cosine)
    return replace(
        state,
        latitude_rad=float(np.clip(latitude, -np.pi / 2, np.pi / 2)),
        longitude_rad=float(np.mod(longitude + np.pi, 2.0 * np.pi) - np.pi),
        altitude_m=state.altitude_m + motion.up_m,
    )


def _tangents(u_px: FloatArray, v_px: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, FloatArray]:
    cx, cy = camera.centre_px
    return (u_px - cx) / camera.focal_px, (v_px - cy) / camera.focal_px


def _sphere_places(x: FloatArray, y: FloatArray, altitude_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return arcs east and north of the sub-satellite point, and depth along the boresight, on the sphere."""
    radius = MOON_RADIUS_M + altitude_m
    depth = _depth(x * x + y * y, altitude_m)
    lateral = depth * np.hypot(x, y)
    arc = MOON_RADIUS_M * np.arctan2(lateral, radius - depth)
    with np.errstate(invalid="ignore", divide="ignore"):
        stretch = np.where(lateral > 0.0, arc / lateral, MOON_RADIUS_M / radius) * depth
    return x * stretch, -y * stretch, depth


def _depth(tangent_squared: FloatArray, altitude_m: float) -> FloatArray:
    """Return the depth at which rays from a nadir camera meet the sphere, NaN on a miss.

    With d the depth and t the tangent of the angle off nadir: (r - d)^2 + (t d)^2 = R^2, the nearer root.
    """
    radius = MOON_RADIUS_M + altitude_m
    constant = radius * radius - MOON_RADIUS_M * MOON_RADIUS_M
    with np.errstate(invalid="ignore"):
        root = np.sqrt(radius * radius - (1.0 + tangent_squared) * constant)
    return np.asarray(constant / (radius + root), dtype=np.float64)


def _on_sphere(ray_enu: FloatArray, latitude_rad: float, altitude_m: float) -> FloatArray:
    """Return where rays (n, 3) of unit depth meet the sphere; axes: x at the own meridian, z north pole."""
    depth = _depth(ray_enu[:, 0] ** 2 + ray_enu[:, 1] ** 2, altitude_m)
    enu = ray_enu * depth[:, None]
    sine, cosine = np.sin(latitude_rad), np.cos(latitude_rad)
    up = enu[:, 2] + MOON_RADIUS_M + altitude_m
    return np.stack([up * cosine - enu[:, 1] * sine, enu[:, 0], up * sine + enu[:, 1] * cosine], axis=1)


def _see(points: FloatArray, unknowns: FloatArray) -> FloatArray:
    """Return tangents (right, down) of points seen by a nadir camera at (latitude, longitude, altitude)."""
    latitude, longitude, altitude = unknowns
    sl, cl = np.sin(longitude), np.cos(longitude)
    sp, cp = np.sin(latitude), np.cos(latitude)
    along = points[:, 0] * cl + points[:, 1] * sl
    east = points[:, 1] * cl - points[:, 0] * sl
    north = points[:, 2] * cp - along * sp
    depth = MOON_RADIUS_M + altitude - (along * cp + points[:, 2] * sp)
    return np.stack([east / depth, -north / depth], axis=1)


def _size_class(diameter_m: FloatArray) -> IntArray:
    """Return the paper's classes 0, 1, 2; -1 outside 5 to 30 km (also 3 to 5 km) and for NaN."""
    classes = size_class(diameter_m).astype(np.int64)
    return np.where(classes < PAPER_CLASSES, classes, -1)
