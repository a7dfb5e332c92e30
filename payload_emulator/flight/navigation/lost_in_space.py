"""Where the camera is when nothing is known of its place: one frame, or a few that the orbit links.

The camera looks down with a known heading, both only as well as the ADCS holds them; altitude is known to lie in an
interval, and the place anywhere over the map. Every pair of a detection and a crater puts the camera on one place for
each altitude: votes are counted over the whole map, the best places are fitted to the detections they explain, and
one is believed if chance would make up such a place less often than a limit anywhere in the search, and no other
place does nearly as well. Otherwise the answer is that there is no fix.

Chance is counted so: detections thrown at random into the image fall within the tolerance of a crater of their size
with a known probability; the number that does is Poisson distributed, and there are as many trials as the search has
distinguishable poses (an a-contrario test; Desolneux, Moisan, Morel 2000).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from payload_emulator.flight.navigation.sighting import LandmarkMap
from payload_emulator.flight.vision.detections import Detections

NADIR_NORTH_UP: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""camera_from_enu of a camera that looks straight down, image up to the north."""

FRAMES_COMBINED = 4

# Candidates of each frame that take part in a search over several.
_CANDIDATES_COMBINED = 12

# Bins of rim height: half a bin moves a place by 350 m at the edge of the image.
_HEIGHT_BIN_M = 400.0
# Edge of a tile of the map: over the whole Moon the blocks that its craters vote for fit into the L2 cache.
_TILE_RAD = math.radians(15.0)
# Number of a tile: row times this plus column.
_TILE_FACTOR = 1_000
# The vote leaves out places this far from any crater.
_MARGIN_RAD = math.radians(3.0)
# Largest natural logarithm of how much rarer a chance vote is than a true one: one detection decides nothing.
_WEIGHT_LIMIT = 6.0
# The gate of a fit for logarithms of diameters over that of the vote, which is narrow to cast few chance votes.
_LOG_GATE_FACTOR = 1.25
# Smallest cosine of latitude: near a pole a margin in longitude would otherwise grow without bound.
_POLE_COSINE = 0.1
# The repeatability of a detector is not better than this.
_SMALLEST_SIGMA_PX = 0.3
# Angle off nadir up to which the depth of the ground is taken from the direction.
_LARGEST_OFF_NADIR_RAD = 1.5
# A fit may end this far outside the altitudes that were voted on, which are steps.
_ALTITUDE_SLACK = 1.25
# Two places of one orbit: what relief and a bent track add to their sigmas, the number of sigmas, the share by which
# the speed of an elliptical orbit differs from a circular one, and the radial speed at an eccentricity of 0.02.
_TRACK_DOUBT_M, _DOUBT_SIGMAS, _SPEED_SHARE, _RADIAL_SPEED_M_S = 1_500.0, 3.0, 0.05, 33.0
# Legs longer than this show the direction of flight, which two legs of an orbit share to this cosine.
_SHORTEST_LEG_M, _LEG_COSINE = 5_000.0, 0.9


@dataclass(frozen=True, slots=True)
class LostParameters:
    """Search without a prior.

    Attributes
    ----------
    minimum_altitude_m, maximum_altitude_m
        Altitudes searched, above the sphere of the maps.
    attitude_sigma_rad
        How well nadir and heading are held, per axis.
    block_px
        Edge of a block of the vote: takes the errors of detections, craters and attitude.
    altitude_step
        Ratio of neighbouring altitudes less one.
    log_diameter_gate
        Largest difference of the logarithms of measured and catalogued diameter.
    detections
        Number of detections used, strongest first: all that a detector gives. Those smaller than any crater of the map
        cost no evidence, since no crater is like them, and the strongest alone are not those that the map holds.
    places
        Best places of the vote that are fitted.
    gate
        Chi-square within which a crater explains a detection after the fit; 99.5 % of true pairs.
    false_fix_limit
        Expected number of false fixes per search.
    rival_ratio
        A fix must be this many times less likely made up by chance than the best other place.
    cells, votes
        Bounds of work space and work: cells of the vote (2 octets each), and detections times craters that vote; over
        a large map only the largest of the detections do.
    """

    minimum_altitude_m: float = 12_000.0
    maximum_altitude_m: float = 55_000.0
    attitude_sigma_rad: float = math.radians(0.5)
    block_px: float = 14.0
    altitude_step: float = 0.045
    log_diameter_gate: float = 0.2
    detections: int = 120
    places: int = 48
    gate: float = 10.6
    false_fix_limit: float = 1e-4
    rival_ratio: float = 1e3
    cells: int = 12_000_000
    votes: int = 400_000


@dataclass(frozen=True, slots=True, eq=False)
class PlaceIndex:
    """Craters sorted for the vote: by tiles of the map, by bins of rim height in them, by diameter inside these.

    Attributes
    ----------
    landmarks
        The map itself, for the fit.
    extent
        South, north, west, width in longitude (rad) and area (sr) of what the map covers.
    """

    landmarks: LandmarkMap
    tile_start: IntArray
    bin_start: IntArray
    bin_height: IntArray
    height_m: FloatArray
    log_diameter: FloatArray
    latitude_rad: FloatArray
    tangent: FloatArray
    longitude_rad: FloatArray
    extent: FloatArray

    @property
    def octets(self) -> int:
        """Return the size of what is kept in addition to the map."""
        bins = (self.tile_start, self.bin_start, self.bin_height, self.height_m)
        craters = (self.log_diameter, self.latitude_rad, self.tangent, self.longitude_rad)
        return int(sum(array.nbytes for array in (*bins, *craters)))

    def __len__(self) -> int:
        return int(self.log_diameter.size)


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A place of the camera that explains detections.

    Attributes
    ----------
    position_mcmf_m
        Shape (3,).
    attitude_rad
        Rotation of the camera from its nominal attitude, camera axes: C = (1 - [theta x]) C_nominal.
    sigma_m
        Standard deviations east, north, up.
    detection, index
        Pairs: indices into the detections and into the map.
    chance
        Expected number of pairs by chance.
    log_false
        Natural logarithm of the expected number of places as good as this that chance makes up per search.
    """

    position_mcmf_m: FloatArray
    attitude_rad: FloatArray
    sigma_m: FloatArray
    detection: IntArray
    index: IntArray
    chance: float
    log_false: float

    def __len__(self) -> int:
        return int(self.detection.size)


@dataclass(frozen=True, slots=True, eq=False)
class LostFrame:
    """One frame of a search over several: detections, one sigma of each centre, and the time since the first."""

    found: Detections
    sigma_px: FloatArray
    elapsed_s: float


def place_index(landmarks: LandmarkMap) -> PlaceIndex:
    """Return the map sorted for the vote."""
    position = landmarks.position_mcmf_m
    radius = np.linalg.norm(position, axis=1)
    longitude = np.arctan2(position[:, 1], position[:, 0])
    log_diameter = np.log(landmarks.diameter_m)
    heights, height = np.unique(
        np.floor((radius - MOON_RADIUS_M) / _HEIGHT_BIN_M).astype(np.int64), return_inverse=True
    )
    row, column = (
        np.floor(part / _TILE_RAD).astype(np.int64) for part in (landmarks.latitude_rad, longitude)
    )
    tile = row * _TILE_FACTOR + column
    order = np.lexsort((log_diameter, height, tile))
    bins, first = np.unique(np.stack([tile[order], height[order]]), axis=1, return_index=True)
    _, tiles = np.unique(bins[0], return_index=True)
    latitude = landmarks.latitude_rad
    west, width = _span(longitude)
    south = max(float(latitude.min(initial=0.0)) - _MARGIN_RAD, -0.5 * math.pi)
    north = min(float(latitude.max(initial=0.0)) + _MARGIN_RAD, 0.5 * math.pi)
    stretch = _MARGIN_RAD / max(math.cos(max(abs(south), abs(north))), _POLE_COSINE)
    west, width = west - stretch, min(width + 2.0 * stretch, 2.0 * math.pi)
    area = width * (math.sin(north) - math.sin(south))
    return PlaceIndex(
        landmarks,
        np.append(tiles, bins.shape[1]).astype(np.int64),
        np.append(first, order.size).astype(np.int64),
        bins[1].astype(np.int64),
        (heights + 0.5) * _HEIGHT_BIN_M,
        log_diameter[order],
        latitude[order],
        np.tan(latitude[order]),
        west + np.mod(longitude[order] - west, 2.0 * math.pi),
        np.array([south, north, west, width, area]),
    )


def candidate_places(
    found: Detections,
    sigma_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters = LostParameters(),
    camera_from_enu: FloatArray = NADIR_NORTH_UP,
) -> list[Place]:
    """Return places that explain at least three detections, the least likely by chance first.

    Parameters
    ----------
    sigma_px
        One sigma of the centre of each detection, per axis, shape (n,).
    camera_from_enu
        Attitude that the ADCS holds, shape (3, 3).
    """
    usable = np.flatnonzero(
        np.isfinite(found.u_px) & np.isfinite(found.v_px) & (found.diameter_px > 0.0) & np.isfinite(sigma_px)
    )
    if usable.size > parameters.detections:
        strongest = np.argsort(-np.nan_to_num(found.score[usable]), kind="stable")[: parameters.detections]
        usable = np.sort(usable[strongest])
    if usable.size < 3 or len(index) < 3:
        return []
    chosen, sigma = found.select(usable), np.maximum(sigma_px[usable], _SMALLEST_SIGMA_PX)
    uv = np.stack([chosen.u_px, chosen.v_px], axis=1)
    places = _voted(uv, chosen.diameter_px, index, camera, parameters, camera_from_enu)
    fits = []
    for start in places:
        place = _fitted(start, uv, chosen.diameter_px, sigma, index, camera, parameters, camera_from_enu)
        if place is not None:
            fits.append(place)
    fits.sort(key=lambda place: place.log_false)
    apart: list[Place] = []
    for place in fits:
        if all(_distance_m(place, other) > _same_place_m(place, camera, parameters) for other in apart):
            apart.append(place)
    return [_renumbered(place, usable) for place in apart]


def find_place(
    found: Detections,
    sigma_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters = LostParameters(),
    camera_from_enu: FloatArray = NADIR_NORTH_UP,
) -> Place | None:
    """Return the place of a single frame, None where none is safe."""
    return believed_place(
        candidate_places(found, sigma_px, index, camera, parameters, camera_from_enu), parameters
    )


def believed_place(places: Sequence[Place], parameters: LostParameters = LostParameters()) -> Place | None:
    """Return the best of candidate places if chance and all others leave it, None where none is safe."""
    if not places or places[0].log_false > math.log(parameters.false_fix_limit):
        return None
    rival = places[1].log_false if len(places) > 1 else math.inf
    return places[0] if rival - places[0].log_false > math.log(parameters.rival_ratio) else None


def find_place_in_frames(
    frames: Sequence[LostFrame],
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters = LostParameters(),
    camera_from_enu: FloatArray = NADIR_NORTH_UP,
) -> tuple[Place, ...] | None:
    """Return the places of frames seconds to a minute apart, one per frame that takes part; None where none is safe.

    The last `FRAMES_COMBINED` frames are used, see `place_of_frames`.
    """
    frames = sorted(frames, key=lambda frame: frame.elapsed_s)[-FRAMES_COMBINED:]
    candidates = [
        candidate_places(frame.found, frame.sigma_px, index, camera, parameters, camera_from_enu)
        for frame in frames
    ]
    return place_of_frames(candidates, frames, parameters)


def place_of_frames(
    candidates: Sequence[Sequence[Place]],
    frames: Sequence[LostFrame],
    parameters: LostParameters = LostParameters(),
) -> tuple[Place, ...] | None:
    """Return the places of frames in order of time from the candidate places of each; None where none is safe.

    Places of different frames support each other if an orbit leads from one to the next: the distance is that of a
    circular orbit to five per cent, altitude changes little, the heading stays.
    """
    per_frame = [places[:_CANDIDATES_COMBINED] for places in candidates]
    chains: list[tuple[float, tuple[tuple[int, Place], ...]]] = []
    for number, places in enumerate(per_frame):
        grown: list[tuple[float, tuple[tuple[int, Place], ...]]] = []
        grown += [(place.log_false, ((number, place),)) for place in places]
        for _, chain in list(chains):
            for place in places:
                longer = (*chain, (number, place))
                if _one_orbit(longer, frames):
                    grown.append((_log_false_of_chain(longer, parameters), longer))
        chains += grown
    chains.sort(key=lambda item: item[0])
    if not chains or chains[0][0] > math.log(parameters.false_fix_limit):
        return None
    best = chains[0][1]
    # A rival is what comes near the best, and a place of one frame that would be safe if it were alone.
    near, alone = chains[0][0] + math.log(parameters.rival_ratio), math.log(parameters.false_fix_limit)
    for log_false, chain in chains[1:]:
        if log_false > near and (len(chain) > 1 or log_false > alone):
            continue
        if not _one_orbit(tuple(sorted((*best, *chain), key=lambda item: item[0])), frames):
            return None
    return tuple(place for _, place in best)


def _voted(
    uv: FloatArray,
    diameter_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters,
    camera_from_enu: FloatArray,
) -> FloatArray:
    """Return the best places of the vote (MCMF), shape (n, 3), best first."""
    from payload_emulator.flight.navigation._vote_kernel import Blocks, Directions, SortedCraters, vote

    rays = camera.rays(uv)
    enu = rays @ camera_from_enu
    off_nadir = np.arccos(np.clip(-enu[:, 2], -1.0, 1.0))
    azimuth = np.arctan2(enu[:, 0], enu[:, 1])
    # Depth below the camera over depth along the boresight is one for a camera that looks down.
    log_size = np.log(
        diameter_px / camera.focal_px * rays[:, 2] / np.cos(np.minimum(off_nadir, _LARGEST_OFF_NADIR_RAD))
    )
    voters = max(8, parameters.votes // len(index))
    order = np.argsort(-diameter_px, kind="stable")[: min(voters, 250)]
    south, north, west, width, area = index.extent
    low, high = parameters.minimum_altitude_m, parameters.maximum_altitude_m
    steps = math.ceil(math.log(high / low) / math.log1p(parameters.altitude_step)) + 1
    listed = np.zeros((parameters.places + 1, 4))
    result: list[tuple[float, FloatArray]] = []
    # The widest parallel of the map: the equator where it holds it.
    widest = math.cos(max(south, -north, 0.0))
    smallest = math.sqrt((north - south) * width * widest / parameters.cells)
    craters = SortedCraters(
        index.tile_start,
        index.bin_start,
        index.bin_height,
        index.height_m,
        index.log_diameter,
        index.latitude_rad,
        index.tangent,
        index.longitude_rad,
    )
    work = np.empty(0, dtype=np.uint16)
    for altitude_m in np.geomspace(low, high, steps):
        cell = max(0.5 * parameters.block_px * altitude_m / camera.focal_px / MOON_RADIUS_M, smallest)
        rows = math.ceil((north - south) / cell) + 1
        columns = math.ceil(width * widest / cell) + 2
        if not work.size:
            work = np.empty(rows * columns, dtype=np.uint16)
        before = {tuple(row) for row in listed[1 : int(listed[0, 0]) + 1]}
        vote(
            MOON_RADIUS_M + float(altitude_m),
            MOON_RADIUS_M,
            Directions(off_nadir[order], azimuth[order], log_size[order]),
            parameters.log_diameter_gate,
            craters,
            Blocks(south, west, area, cell, rows, columns),
            work,
            _WEIGHT_LIMIT,
            listed,
            parameters.places,
        )
        for row in listed[1 : int(listed[0, 0]) + 1]:
            if tuple(row) in before:
                continue
            latitude = south + (row[1] + 1.0) * cell
            longitude = west + (row[2] + 1.0) * cell / math.cos(latitude)
            result.append((float(row[0]), _mcmf(latitude, longitude, float(row[3]))))
    result.sort(key=lambda item: -item[0])
    return np.array([place for _, place in result[: parameters.places]]).reshape(-1, 3)


def _fitted(
    start: FloatArray,
    uv: FloatArray,
    diameter_px: FloatArray,
    sigma_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters,
    camera_from_enu: FloatArray,
) -> Place | None:
    """Return a place fitted to the detections it explains, None where they are fewer than three."""
    from payload_emulator.flight.navigation._fit_kernel import Craters, Found, Gates, Image, fit_place

    landmarks = index.landmarks
    position, attitude, normal, pair, chance = fit_place(
        start,
        camera_from_enu,
        Image(
            camera.focal_px,
            np.array(camera.centre_px),
            0.5 * np.array([camera.width_px, camera.height_px], dtype=np.float64),
        ),
        Found(uv, diameter_px, sigma_px**2),
        Craters(
            landmarks.latitude_rad,
            landmarks.position_mcmf_m,
            landmarks.diameter_m,
            np.hypot(landmarks.sigma_m[:, 0], landmarks.sigma_m[:, 1]) / math.sqrt(2.0),
        ),
        parameters.attitude_sigma_rad,
        Gates(parameters.block_px, parameters.gate, _LOG_GATE_FACTOR * parameters.log_diameter_gate),
        MOON_RADIUS_M,
    )
    detection = np.flatnonzero(pair >= 0)
    altitude_m = float(np.linalg.norm(position)) - MOON_RADIUS_M
    lowest_m = parameters.minimum_altitude_m / _ALTITUDE_SLACK
    inside = lowest_m < altitude_m < _ALTITUDE_SLACK * parameters.maximum_altitude_m
    if detection.size < 3 or not inside:
        return None
    try:
        covariance = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None
    expected = float(np.minimum(chance, 1.0).sum())
    trials = _log_trials(index, altitude_m, float(np.median(sigma_px)), camera, parameters)
    return Place(
        position,
        attitude,
        np.sqrt(np.maximum(np.diag(covariance)[:3], 0.0)),
        detection,
        pair[detection],
        expected,
        trials + log_poisson_tail(detection.size, expected),
    )


def log_poisson_tail(count: int, mean: float) -> float:
    """Return the logarithm of the probability of at least a number of events of a Poisson distribution."""
    if count <= 0 or mean <= 0.0:
        return 0.0 if count <= 0 else -math.inf
    if count <= mean:
        # Not the tail any more: no evidence.
        return 0.0
    first = count * math.log(mean) - mean - math.lgamma(count + 1)
    total, term = 1.0, 1.0
    for k in range(count + 1, count + 200):
        term *= mean / k
        total += term
        if term < 1e-12 * total:
            break
    return min(first + math.log(total), 0.0)


def _log_trials(
    index: PlaceIndex,
    altitude_m: float,
    sigma_px: float,
    camera: PinholeCamera,
    parameters: LostParameters,
) -> float:
    """Return the logarithm of the number of poses that the search tells apart.

    Two poses are told apart if they move craters by more than the radius within which pairs are accepted: cells of
    place, steps of altitude at the edge of the image, and steps of attitude within two sigma.
    """
    radius_px = sigma_px * math.sqrt(parameters.gate)
    cell_m = radius_px * altitude_m / camera.focal_px
    places = index.extent[4] * MOON_RADIUS_M**2 / (math.pi * cell_m**2)
    edge_px = 0.5 * camera.width_px
    span = math.log(parameters.maximum_altitude_m / parameters.minimum_altitude_m)
    altitudes = 1.0 + span * edge_px / (2.0 * radius_px)
    # Beyond the shift that a change of place makes up for, a tilt distorts: focal length times tangent squared.
    swing = 4.0 * parameters.attitude_sigma_rad / (2.0 * radius_px)
    tilts = (1.0 + swing * edge_px**2 / camera.focal_px) ** 2
    turns = 1.0 + swing * edge_px
    return math.log(places * altitudes * tilts * turns)


def _log_false_of_chain(chain: tuple[tuple[int, Place], ...], parameters: LostParameters) -> float:
    """Return the logarithm of the number of chains as good as this that chance makes up.

    The first place may be anywhere; the next lies on a ring about it, a further one near a point. What a ring and a
    point leave of the trials of a whole search is at most one in two thousand and one in two million.
    """
    total = 0.0
    for number, (_, place) in enumerate(chain):
        freed = (0.0, math.log(2e3), math.log(2e6))[min(number, 2)]
        total += place.log_false - freed
        # A place takes part only where it has something to say.
        if number and place.log_false - freed > 0.0:
            return math.inf
    return total


def _one_orbit(chain: Sequence[tuple[int, Place]], frames: Sequence[LostFrame]) -> bool:
    """Return whether a low circular orbit leads through places in order of time."""
    for (a, first), (b, second) in pairwise(chain):
        elapsed_s = frames[b].elapsed_s - frames[a].elapsed_s
        apart_m = _distance_m(first, second)
        doubt_m = _TRACK_DOUBT_M + _DOUBT_SIGMAS * float(np.hypot(first.sigma_m.max(), second.sigma_m.max()))
        if elapsed_s <= 0.0:
            if apart_m > doubt_m:
                return False
            continue
        radius = float(np.linalg.norm(first.position_mcmf_m))
        expected_m = math.sqrt(GM_MOON_M3_S2 / radius) * elapsed_s
        climb_m = abs(radius - float(np.linalg.norm(second.position_mcmf_m)))
        if (
            abs(apart_m - expected_m) > _SPEED_SHARE * expected_m + doubt_m
            or climb_m > _RADIAL_SPEED_M_S * elapsed_s + 2.0 * doubt_m
        ):
            return False
    for k in range(len(chain) - 2):
        legs = [chain[k + 1 + j][1].position_mcmf_m - chain[k + j][1].position_mcmf_m for j in range(2)]
        lengths = [float(np.linalg.norm(leg)) for leg in legs]
        if min(lengths) > _SHORTEST_LEG_M and legs[0] @ legs[1] < _LEG_COSINE * lengths[0] * lengths[1]:
            return False
    return True


def _distance_m(first: Place, second: Place) -> float:
    return float(np.linalg.norm(first.position_mcmf_m - second.position_mcmf_m))


def _same_place_m(place: Place, camera: PinholeCamera, parameters: LostParameters) -> float:
    """Return how far apart two fits may lie and still be of one place."""
    altitude_m = float(np.linalg.norm(place.position_mcmf_m)) - MOON_RADIUS_M
    return 2.0 * parameters.block_px * altitude_m / camera.focal_px


def _renumbered(place: Place, usable: IntArray) -> Place:
    return Place(
        place.position_mcmf_m,
        place.attitude_rad,
        place.sigma_m,
        usable[place.detection].astype(np.int64),
        place.index,
        place.chance,
        place.log_false,
    )


def _span(longitude: FloatArray) -> tuple[float, float]:
    """Return the west end and the width of the smallest interval that holds all longitudes."""
    if not longitude.size:
        return 0.0, 0.0
    ordered = np.sort(np.mod(longitude, 2.0 * math.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * math.pi)
    widest = int(np.argmax(gaps))
    west = float(ordered[(widest + 1) % ordered.size])
    return west, 2.0 * math.pi - float(gaps[widest])


def _mcmf(latitude: float, longitude: float, radius_m: float) -> FloatArray:
    flat = radius_m * math.cos(latitude)
    return np.array([flat * math.cos(longitude), flat * math.sin(longitude), radius_m * math.sin(latitude)])
