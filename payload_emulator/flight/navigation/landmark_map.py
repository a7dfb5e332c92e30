"""Craters that no catalogue holds: tracked over a pass, triangulated, kept in a map, used on later passes.

A detection that belongs to no catalogued crater begins a track. Later detections join it where a point standing still
on the ground would be seen; a track of enough of them becomes a landmark, placed by least squares on its sightings.
False detections do not stand still and never get so far.

The errors of a landmark are its own, from the noise of its sightings, and those of the spacecraft while it was seen.
The latter do not average out over a pass, are shared by all landmarks of the pass, and are still in the filter: they
are added in full to the landmark's covariance, and a landmark is used only on later passes, as one more uncertain
crater (Schmidt). Sightings of several passes are joined by covariance intersection (Julier and Uhlmann 1997), which
holds whatever the correlation of their errors: nothing is counted twice.

Frame: MCMF (ME). Memory is bounded: tracks, sightings per track and landmarks have limits, the poorest give way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import enu_from_mcmf
from payload_emulator.flight.navigation.sighting import LandmarkMap, Sighting, landmark_map
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import CatalogueTable
from tmtc.packets.pus import TICKS_PER_SECOND

FIRST_LANDMARK_ID = 3_000_000_000
"""Identities of landmarks begin here; catalogues stay below."""

# Chi-square of 2 and of 3 degrees of freedom at 0.99: one correct sighting, one correct mapping in a hundred is lost.
_GATE_2, _GATE_3 = 9.2, 11.3
# Largest mean square of a track's residuals per degree of freedom, far in the tail of its distribution.
_RESIDUAL_LIMIT = 3.0
# Two mappings of one crater are within this distance on each axis, or within its diameter, whatever their covariances.
_SAME_CRATER_M = 4_000.0
# Gauss-Newton steps of a placement, which starts from the place before the last sighting.
_PLACEMENT_ITERATIONS = 2
# Weights of the covariance intersection that are tried, 0 to 1 in steps of 0.05; the one of least trace is taken.
_INTERSECTION_WEIGHTS = 21
# A detection this close to a catalogued crater and of a diameter within a factor exp(0.5) may be of that crater.
_CLAIMED_PX = 12.0
_CLAIMED_LOG_DIAMETER = 0.5


@dataclass(frozen=True, slots=True)
class MappingParameters:
    """Rules of the map.

    Attributes
    ----------
    sightings
        Sightings in one pass that make a track a landmark.
    height_sigma_m
        How far craters lie from the height of their surroundings, before parallax tells.
    log_diameter_gate
        Largest difference of the logarithms of the diameters of a track and a detection.
    position_limit_m
        Position sigma above which nothing is mapped.
    track_memory_s
        A track not seen for this long is closed.
    tracks, sightings_kept, landmarks
        Limits of memory.
    diameter_limits_m
        Diameters that are mapped.
    """

    sightings: int = 3
    height_sigma_m: float = 800.0
    log_diameter_gate: float = 0.3
    position_limit_m: float = 600.0
    track_memory_s: float = 50.0
    tracks: int = 150
    sightings_kept: int = 8
    landmarks: int = 3_000
    diameter_limits_m: tuple[float, float] = (1_500.0, 30_000.0)


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A crater of the map.

    Attributes
    ----------
    position_mcmf_m, covariance_m2
        Shapes (3,) and (3, 3), spacecraft error included.
    sightings, passes
        Sightings in all, and passes on which it was mapped.
    ticks
        When it was last mapped.
    """

    identity: int
    position_mcmf_m: FloatArray
    covariance_m2: FloatArray
    diameter_m: float
    sightings: int
    passes: int
    ticks: int


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """From where and how a frame was seen, as estimated: MCMF.

    Attributes
    ----------
    camera_from_mcmf
        Shape (3, 3).
    position_mcmf_m, covariance_m2
        Of the camera, shapes (3,) and (3, 3).
    attitude_sigma_rad
        What is uncertain of the attitude, per axis.
    """

    ticks: int
    camera_from_mcmf: FloatArray
    position_mcmf_m: FloatArray
    covariance_m2: FloatArray
    attitude_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Sightings of what may be one crater: views, pixels (n, 2), variances (n,), and the place they give."""

    views: tuple[View, ...]
    uv_px: FloatArray
    variance_px2: FloatArray
    diameter_m: float
    position_mcmf_m: FloatArray
    own_covariance_m2: FloatArray
    surface_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MapState:
    """Map under construction: what each frame's fix left over.

    Attributes
    ----------
    landmarks
        In the order in which they were first mapped.
    places_mcmf_m
        Places of the landmarks, shape (n, 3), for the search.
    tracks
        Tracks that may still grow.
    next_identity
        Identity of the next new landmark.
    """

    landmarks: tuple[Landmark, ...] = ()
    places_mcmf_m: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    tracks: tuple[Track, ...] = ()
    next_identity: int = FIRST_LANDMARK_ID


def observe(
    state: MapState,
    view: View,
    found: Detections,
    variance_px2: FloatArray,
    free: BoolArray,
    surface_m: float,
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> tuple[MapState, tuple[Landmark, ...]]:
    """Return the map after a frame, and the landmarks that closed tracks made or improved.

    Parameters
    ----------
    free
        Detections that belong to no crater of the catalogue, shape (n,).
    surface_m
        Height of the ground in view, according to the catalogue.
    """
    spread = float(np.sqrt(np.trace(view.covariance_m2) / 3.0))
    usable = (
        free & np.isfinite(found.u_px) & np.isfinite(found.v_px) & (found.diameter_px > 0.0) & np.isfinite(variance_px2)
    )
    state, ready = _closed(state, view.ticks, camera, parameters)
    if not (np.isfinite(spread) and spread < parameters.position_limit_m):
        return state, ready
    uv = np.stack([found.u_px, found.v_px], axis=1)
    size_m = _ground_diameter(view, uv, found.diameter_px, surface_m, camera)
    low, high = parameters.diameter_limits_m
    usable &= (size_m >= low) & (size_m <= high)
    tracks, joined = _joined(state.tracks, view, uv, variance_px2, size_m, usable, camera, parameters)
    rows = np.flatnonzero(usable & ~joined)
    begun = _begun(view, uv, variance_px2, size_m, rows, surface_m, camera, parameters)
    return replace(state, tracks=_best_tracks((*tracks, *begun), parameters.tracks)), ready


def close(
    state: MapState, camera: PinholeCamera, parameters: MappingParameters
) -> tuple[MapState, tuple[Landmark, ...]]:
    """Return the map after the end of all tracks, as before a gap, and the landmarks that these made or improved."""
    return _closed(state, None, camera, parameters)


def with_catalogue(landmarks: Sequence[Landmark], catalogue: CatalogueTable) -> LandmarkMap:
    """Return the catalogue with landmarks added, ready for use."""
    if not landmarks:
        return landmark_map(catalogue)
    rows = map_rows(landmarks)
    return landmark_map(
        CatalogueTable(
            np.concatenate([catalogue.ids, rows.identity]),
            np.concatenate([catalogue.latitude_rad, rows.latitude_rad]),
            np.concatenate([catalogue.longitude_rad, rows.longitude_rad]),
            np.concatenate([catalogue.diameter_m, rows.diameter_m]),
            np.concatenate([catalogue.rim_height_m, rows.height_m]),
            np.concatenate([catalogue.sigma_m, rows.sigma_m]),
        )
    )


def _ground_diameter(
    view: View, uv: FloatArray, diameter_px: FloatArray, surface_m: float, camera: PinholeCamera
) -> FloatArray:
    """Return diameters of detections on the ground in metres, -1 for lines of sight that miss it."""
    points = _on_sphere(view, uv, surface_m, camera)
    depth = (points - view.position_mcmf_m) @ view.camera_from_mcmf[2]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nan_to_num(diameter_px * depth / camera.focal_px, nan=-1.0))


def _on_sphere(view: View, uv: FloatArray, height_m: float, camera: PinholeCamera) -> FloatArray:
    """Return where lines of sight meet a sphere (n, 3), NaN where they do not."""
    sight = camera.rays(uv) @ view.camera_from_mcmf
    along = -(sight @ view.position_mcmf_m)
    below = view.position_mcmf_m @ view.position_mcmf_m - (MOON_RADIUS_M + height_m) ** 2
    with np.errstate(invalid="ignore"):
        reach = along - np.sqrt(along**2 - below)
    return np.asarray(view.position_mcmf_m + reach[:, None] * sight)


def _begun(
    view: View,
    uv: FloatArray,
    variance_px2: FloatArray,
    size_m: FloatArray,
    rows: IntArray,
    surface_m: float,
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> list[Track]:
    """Return tracks that begin with detections, placed on the ground in view."""
    places = _on_sphere(view, uv[rows], surface_m, camera)
    rows, places = rows[np.isfinite(places[:, 0])], places[np.isfinite(places[:, 0])]
    _, by_point = _projected(view, places, camera)
    up = places / np.linalg.norm(places, axis=1, keepdims=True)
    normal = up[:, :, None] * up[:, None, :] / parameters.height_sigma_m**2
    normal = normal + np.swapaxes(by_point, 1, 2) @ by_point / variance_px2[rows, None, None]
    own = np.linalg.inv(normal)
    return [
        Track((view,), uv[i : i + 1], variance_px2[i : i + 1], float(size_m[i]), places[k], own[k], surface_m)
        for k, i in enumerate(rows)
    ]


def _best_tracks(tracks: tuple[Track, ...], limit: int) -> tuple[Track, ...]:
    """Return the tracks up to a limit, without those of the fewest and then the oldest sightings."""
    if len(tracks) <= limit:
        return tracks
    order = sorted(range(len(tracks)), key=lambda t: (len(tracks[t].views), tracks[t].views[-1].ticks))
    dropped = set(order[: len(tracks) - limit])
    return tuple(track for t, track in enumerate(tracks) if t not in dropped)


def _joined(
    tracks: tuple[Track, ...],
    view: View,
    uv: FloatArray,
    variance_px2: FloatArray,
    size_m: FloatArray,
    usable: BoolArray,
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> tuple[tuple[Track, ...], BoolArray]:
    """Return tracks with the detections that continue them, mutual nearest only, and which detections these are."""
    joined = np.zeros(usable.size, dtype=np.bool_)
    rows = np.flatnonzero(usable)
    if not rows.size or not tracks:
        return tracks, joined
    places = np.stack([track.position_mcmf_m for track in tracks])
    own = np.stack([track.own_covariance_m2 for track in tracks])
    sizes = np.array([track.diameter_m for track in tracks])
    predicted, by_point = _projected(view, places, camera)
    # Between frames the spacecraft's own error is the same: only the track's is left.
    spread = by_point @ own @ np.swapaxes(by_point, 1, 2)
    offset = uv[rows][None] - predicted[:, None]
    total = spread[:, None] + variance_px2[rows][None, :, None, None] * np.eye(2)
    with np.errstate(invalid="ignore"):
        distance = np.einsum("tna,tnab,tnb->tn", offset, np.linalg.inv(total), offset)
        alike = np.abs(np.log(size_m[rows][None] / sizes[:, None])) <= parameters.log_diameter_gate
    distance = np.where(alike & np.isfinite(distance), distance, np.inf)
    best_track, best_row = np.argmin(distance, axis=0), np.argmin(distance, axis=1)
    grown = list(tracks)
    for t, track in enumerate(tracks):
        k = int(best_row[t])
        if best_track[k] != t or not distance[t, k] < _GATE_2:
            continue
        i = int(rows[k])
        joined[i] = True
        kept = parameters.sightings_kept
        grown[t] = _placed(
            _longer(track, view, uv[i], float(variance_px2[i]), float(size_m[i]), kept),
            camera,
            parameters.height_sigma_m,
        )
    return tuple(grown), joined


def _longer(track: Track, view: View, uv: FloatArray, variance_px2: float, diameter_m: float, kept: int) -> Track:
    """Return the track with one more sighting; only the newest sightings up to a limit are kept."""
    count = len(track.views)
    return replace(
        track,
        views=(*track.views, view)[-kept:],
        uv_px=np.concatenate([track.uv_px, uv[None]])[-kept:],
        variance_px2=np.append(track.variance_px2, variance_px2)[-kept:],
        diameter_m=float(np.exp((count * np.log(track.diameter_m) + np.log(diameter_m)) / (count + 1))),
    )


def _placed(track: Track, camera: PinholeCamera, height_sigma_m: float) -> Track:
    """Return the track with its place by least squares: its sightings, and the height of the ground in view."""
    place, f, centre = track.position_mcmf_m, camera.focal_px, np.array(camera.centre_px)
    rotation = np.stack([view.camera_from_mcmf for view in track.views])
    position = np.stack([view.position_mcmf_m for view in track.views])
    weight = np.repeat(1.0 / track.variance_px2, 2)
    normal = np.eye(3)
    for _ in range(_PLACEMENT_ITERATIONS):
        radius = float(np.sqrt(place @ place))
        up = place / radius
        seen = np.einsum("kij,kj->ki", rotation, place - position)
        scale = f / seen[:, 2]
        predicted = seen[:, :2] * scale[:, None] + centre
        by_seen = np.zeros((len(track.views), 2, 3))
        by_seen[:, 0, 0] = by_seen[:, 1, 1] = scale
        by_seen[:, :, 2] = -seen[:, :2] * (scale / seen[:, 2])[:, None]
        design = (by_seen @ rotation).reshape(-1, 3)
        left = (track.uv_px - predicted).reshape(-1)
        normal = np.outer(up, up) / height_sigma_m**2 + (design.T * weight) @ design
        pull = (track.surface_m - (radius - MOON_RADIUS_M)) / height_sigma_m**2
        place = place + np.linalg.solve(normal, up * pull + design.T @ (weight * left))
    own = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return replace(track, position_mcmf_m=place, own_covariance_m2=own)


def _projected(view: View, places: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, FloatArray]:
    """Return pixels (n, 2) of places and their derivatives (n, 2, 3); NaN behind the camera."""
    seen = (places - view.position_mcmf_m) @ view.camera_from_mcmf.T
    depth = np.where(seen[:, 2] > 0.0, seen[:, 2], np.nan)
    f, x, y = camera.focal_px, seen[:, 0] / depth, seen[:, 1] / depth
    by_seen = np.zeros((depth.size, 2, 3))
    by_seen[:, 0, 0] = by_seen[:, 1, 1] = f / depth
    by_seen[:, 0, 2], by_seen[:, 1, 2] = -f * x / depth, -f * y / depth
    uv = f * np.stack([x, y], axis=1) + np.array(camera.centre_px)
    return uv, by_seen @ view.camera_from_mcmf


def _closed(
    state: MapState, ticks: int | None, camera: PinholeCamera, parameters: MappingParameters
) -> tuple[MapState, tuple[Landmark, ...]]:
    """Return the map without the tracks not seen for a while (without any, for no time), and their landmarks."""
    memory = parameters.track_memory_s * TICKS_PER_SECOND
    done: list[Track] = []
    going: list[Track] = []
    for track in state.tracks:
        old = ticks is None or not 0 <= ticks - track.views[-1].ticks <= memory
        (done if old else going).append(track)
    state = replace(state, tracks=tuple(going))
    made = []
    for track in done:
        if len(track.views) < parameters.sightings:
            continue
        landmark = _landmark(track, state.next_identity, camera)
        if landmark is not None:
            state, landmark = _added(state, landmark, parameters)
            made.append(landmark)
    return state, tuple(made)


def _landmark(track: Track, identity: int, camera: PinholeCamera) -> Landmark | None:
    """Return the landmark that a track gives; None where its sightings contradict each other."""
    misfit = 0.0
    for view, uv, variance in zip(track.views, track.uv_px, track.variance_px2, strict=True):
        left = uv - _projected(view, track.position_mcmf_m[None], camera)[0][0]
        misfit += float(left @ left) / float(variance)
    # Each sighting brings two numbers, a place takes three.
    if not misfit <= _RESIDUAL_LIMIT * max(2 * len(track.views) - 3, 1):
        return None
    middle = track.views[len(track.views) // 2]
    reach = float(np.linalg.norm(track.position_mcmf_m - middle.position_mcmf_m))
    covariance = (
        track.own_covariance_m2
        + np.mean([view.covariance_m2 for view in track.views], axis=0)
        + np.eye(3) * (reach * middle.attitude_sigma_rad) ** 2
    )
    return Landmark(
        identity, track.position_mcmf_m, covariance, track.diameter_m, len(track.views), 1, track.views[-1].ticks
    )


def _added(state: MapState, new: Landmark, parameters: MappingParameters) -> tuple[MapState, Landmark]:
    """Return the map with a landmark, joined with an earlier mapping of the same crater; and what it became.

    A full map loses the landmark of the fewest and then the oldest sightings.
    """
    landmarks, places = list(state.landmarks), state.places_mcmf_m
    known = _known(state, new, parameters.log_diameter_gate)
    if known is not None:
        joined = intersected(landmarks[known], new)
        places = places.copy()
        landmarks[known], places[known] = joined, joined.position_mcmf_m
        return replace(state, landmarks=tuple(landmarks), places_mcmf_m=places), joined
    if len(landmarks) >= parameters.landmarks:
        poorest = min(range(len(landmarks)), key=lambda k: (landmarks[k].sightings, landmarks[k].ticks))
        del landmarks[poorest]
        places = np.delete(places, poorest, axis=0)
    grown = MapState(
        (*landmarks, new), np.concatenate([places, new.position_mcmf_m[None]]), state.tracks, state.next_identity + 1
    )
    return grown, new


def _known(state: MapState, new: Landmark, log_diameter_gate: float) -> int | None:
    """Return the index of the landmark that a new one is another mapping of; None if there is none."""
    if not state.landmarks:
        return None
    away_m = np.abs(state.places_mcmf_m - new.position_mcmf_m).max(axis=1)
    best, nearest = None, _GATE_3
    for k in np.flatnonzero(away_m < max(new.diameter_m, _SAME_CRATER_M)):
        landmark = state.landmarks[k]
        offset = landmark.position_mcmf_m - new.position_mcmf_m
        if abs(np.log(landmark.diameter_m / new.diameter_m)) > log_diameter_gate:
            continue
        away = float(offset @ np.linalg.solve(landmark.covariance_m2 + new.covariance_m2, offset))
        if away < nearest:
            best, nearest = int(k), away
    return best


def intersected(first: Landmark, second: Landmark) -> Landmark:
    """Return two mappings of one crater as one, by the covariance intersection of least trace."""
    inverse_1, inverse_2 = np.linalg.inv(first.covariance_m2), np.linalg.inv(second.covariance_m2)
    best: tuple[float, FloatArray, FloatArray] | None = None
    for weight in np.linspace(0.0, 1.0, _INTERSECTION_WEIGHTS):
        covariance = np.linalg.inv(weight * inverse_1 + (1.0 - weight) * inverse_2)
        if best is None or float(np.trace(covariance)) < best[0]:
            information = weight * inverse_1 @ first.position_mcmf_m
            information = information + (1.0 - weight) * inverse_2 @ second.position_mcmf_m
            best = float(np.trace(covariance)), covariance, covariance @ information
    assert best is not None
    total = first.sightings + second.sightings
    log_diameter = (first.sightings * np.log(first.diameter_m) + second.sightings * np.log(second.diameter_m)) / total
    return Landmark(
        first.identity,
        best[2],
        best[1],
        float(np.exp(log_diameter)),
        total,
        first.passes + second.passes,
        max(first.ticks, second.ticks),
    )


@dataclass(frozen=True, slots=True, eq=False)
class MapRows:
    """Landmarks as columns of one length; heights above the sphere of the maps, sigma east, north, up (n, 3)."""

    identity: IntArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    height_m: FloatArray
    diameter_m: FloatArray
    sigma_m: FloatArray
    sightings: IntArray
    passes: IntArray


def map_rows(landmarks: Sequence[Landmark]) -> MapRows:
    """Return landmarks as columns."""
    places = np.array([landmark.position_mcmf_m for landmark in landmarks]).reshape(-1, 3)
    radius = np.linalg.norm(places, axis=1)
    latitude, longitude = np.arcsin(places[:, 2] / radius), np.arctan2(places[:, 1], places[:, 0])
    axes = enu_from_mcmf(latitude, longitude)
    covariance = np.array([landmark.covariance_m2 for landmark in landmarks]).reshape(-1, 3, 3)
    local = axes @ covariance @ np.swapaxes(axes, 1, 2)
    return MapRows(
        np.array([landmark.identity for landmark in landmarks], dtype=np.int64),
        latitude,
        longitude,
        radius - MOON_RADIUS_M,
        np.array([landmark.diameter_m for landmark in landmarks]),
        np.sqrt(np.maximum(np.diagonal(local, axis1=1, axis2=2), 1.0)),
        np.array([landmark.sightings for landmark in landmarks], dtype=np.int64),
        np.array([landmark.passes for landmark in landmarks], dtype=np.int64),
    )


def unclaimed(found: Detections, sighting: Sighting, used: IntArray) -> BoolArray:
    """Return which detections belong to no crater of the catalogue: not used, and none of their size near by."""
    free = np.ones(len(found), dtype=np.bool_)
    free[used] = False
    if len(sighting):
        uv = np.stack([found.u_px, found.v_px], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = np.linalg.norm(uv[:, None] - sighting.uv_px[None], axis=2)
            alike = np.abs(np.log(found.diameter_px[:, None] / sighting.diameter_px[None])) < _CLAIMED_LOG_DIAMETER
        free &= ~np.any((away < _CLAIMED_PX) & alike, axis=1)
    return free
