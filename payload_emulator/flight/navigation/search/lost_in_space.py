"""Search for the pose of the camera without any prior position.

The camera looks down with a known heading, both only as well as the ADCS holds them; altitude is known to lie in an
interval, and the place anywhere over the map. Every pair of a detection and a crater puts the camera on one place for
each altitude: votes are counted over the whole map, the best places are fitted to the detections they explain, and
one is believed if chance would make up such a place less often than a limit anywhere in the search, and no other
place does nearly as well. Otherwise the answer is that there is no fix.

Chance is counted by the Bayes factor of a place: how much likelier the detections are with the camera there than
scattered over the image, on the average over all poses that are possible before. Its expected value for scattered
detections is one, so that chance exceeds 1 / p anywhere in the search with a probability of at most p (Markov's
inequality). Near a place, the average over poses follows from the fit and its normal matrix (Laplace's method).
"""

import math
import threading
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.sighting import LandmarkMap
from payload_emulator.flight.vision.detections import Detections

NADIR_NORTH_UP: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""camera_from_enu of a camera that looks straight down, image up to the north."""

# Candidates that a search returns.
_CANDIDATES = 48

# Bins of rim height: half a bin moves a place by 350 m at the edge of the image.
_HEIGHT_BIN_M = 400.0
# Edge of a tile of the map: over the whole Moon the blocks that its craters vote for fit into the L2 cache.
_TILE_RAD = math.radians(15.0)
# Number of a tile: row times this plus column.
_TILE_FACTOR = 1_000
# The vote leaves out places this far from any crater.
_MARGIN_RAD = math.radians(3.0)
# Largest number of detections that vote, which the vote keeps in eight bits, and the number that always votes.
_VOTERS, _LEAST_VOTERS = 250, 6
# Quantiles of the sizes of all craters, to tell how many are like a detection.
_QUANTILES = 257
# Largest natural logarithm of how much rarer a chance vote is than a true one: one detection decides nothing.
_WEIGHT_LIMIT = 6.0
# The gate of a fit for logarithms of diameters over that of the vote, which is narrow to cast few chance votes.
_LOG_GATE_FACTOR = 1.25
# Smallest cosine of latitude: near a pole a margin in longitude would otherwise grow without bound.
_POLE_COSINE = 0.1
# Cells of the vote, kept between searches of a thread.
_KEPT = threading.local()
# The repeatability of a detector is not better than this.
_SMALLEST_SIGMA_PX = 0.3
# Scores of detections in the evidence: that of a detection without one, and the smallest.
_UNKNOWN_SCORE, _LEAST_SCORE = 0.5, 0.01
# Angle off nadir up to which the depth of the ground is taken from the direction.
_LARGEST_OFF_NADIR_RAD = 1.5
# A fit may end this far outside the altitudes that were voted on, which are steps.
_ALTITUDE_SLACK = 1.25


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
    log_diameter_sigma
        Standard deviation of that difference.
    detections
        Number of detections used, strongest first: all that a detector gives. Those smaller than any crater of the map
        cost no evidence, since no crater is like them, and the strongest alone are not those that the map holds.
    places
        Best places of the vote that are fitted.
    gate
        Chi-square within which a crater explains a detection after the fit; 99.5 % of true pairs.
    false_fix_limit
        Largest probability that a search of scattered detections ends with a fix.
    rival_ratio
        A fix must be this many times less likely made up by chance than the best other place.
    cells, votes
        Bounds of work space and work: cells of the vote (2 octets each), and pairs of a detection and a crater of its
        size that vote at all altitudes together. The largest detections vote, which the fewest craters resemble.
    """

    minimum_altitude_m: float = 12_000.0
    maximum_altitude_m: float = 55_000.0
    attitude_sigma_rad: float = math.radians(0.5)
    block_px: float = 14.0
    altitude_step: float = 0.045
    log_diameter_gate: float = 0.2
    log_diameter_sigma: float = 0.1
    detections: int = 120
    places: int = 500
    gate: float = 10.6
    false_fix_limit: float = 1e-4
    rival_ratio: float = 1e3
    cells: int = 24_000_000
    votes: int = 8_000_000


@dataclass(frozen=True, slots=True, eq=False)
class PlaceIndex:
    """Craters sorted for the vote: by tiles of the map, by bins of rim height in them, by diameter inside these.

    Attributes
    ----------
    landmarks
        The map itself, for the fit.
    extent
        South, north, west, width in longitude (rad) and area (sr) of what the map covers.
    size_quantiles
        Logarithms of diameters at equal steps of rank, ascending, of the map as a whole.
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
    size_quantiles: FloatArray

    @property
    def octets(self) -> int:
        """Return the size of what is kept in addition to the map."""
        bins = (self.tile_start, self.bin_start, self.bin_height, self.height_m)
        craters = (self.log_diameter, self.latitude_rad, self.tangent, self.longitude_rad, self.size_quantiles)
        return int(sum(array.nbytes for array in (*bins, *craters)))

    def __len__(self) -> int:
        return int(self.log_diameter.size)


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
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
    log_false
        Natural logarithm of the largest probability that chance makes up a place as good as this in a search.
    """

    position_mcmf_m: FloatArray
    attitude_rad: FloatArray
    sigma_m: FloatArray
    detection: IntArray
    index: IntArray
    log_false: float

    def __len__(self) -> int:
        return int(self.detection.size)


def place_index(landmarks: LandmarkMap) -> PlaceIndex:
    """Return the map sorted for the vote."""
    position = landmarks.position_mcmf_m
    radius = np.linalg.norm(position, axis=1)
    longitude = np.arctan2(position[:, 1], position[:, 0])
    log_diameter = np.log(landmarks.diameter_m)
    heights, height = np.unique(
        np.floor((radius - MOON_RADIUS_M) / _HEIGHT_BIN_M).astype(np.int64), return_inverse=True
    )
    row, column = (np.floor(part / _TILE_RAD).astype(np.int64) for part in (landmarks.latitude_rad, longitude))
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
        np.quantile(log_diameter, np.linspace(0.0, 1.0, _QUANTILES)) if log_diameter.size else np.zeros(0),
    )


def candidate_places(
    found: Detections,
    sigma_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters = LostParameters(),
) -> list[PoseHypothesis]:
    """Return the best places that explain at least three detections, the least likely by chance first.

    Parameters
    ----------
    sigma_px
        One sigma of the centre of each detection, per axis, shape (n,).
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
    places = _voted(uv, chosen.diameter_px, index, camera, parameters)
    fits = _fitted(places, chosen, sigma, index, camera, parameters)
    fits.sort(key=lambda place: place.log_false)
    apart: list[PoseHypothesis] = []
    for place in fits:
        if len(apart) == _CANDIDATES:
            break
        if all(_distance_m(place, other) > _same_place_m(place, camera, parameters) for other in apart):
            apart.append(place)
    return [replace(place, detection=usable[place.detection].astype(np.int64)) for place in apart]


def find_place(
    found: Detections,
    sigma_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters = LostParameters(),
) -> PoseHypothesis | None:
    """Return the best place if its probability of chance and all other places are far enough, otherwise None."""
    places = candidate_places(found, sigma_px, index, camera, parameters)
    if not places or places[0].log_false > math.log(parameters.false_fix_limit):
        return None
    rival = places[1].log_false if len(places) > 1 else math.inf
    return places[0] if rival - places[0].log_false > math.log(parameters.rival_ratio) else None


def _voted(
    uv: FloatArray, diameter_px: FloatArray, index: PlaceIndex, camera: PinholeCamera, parameters: LostParameters
) -> FloatArray:
    """Return the best places of the vote (MCMF), shape (n, 3), best first."""
    from payload_emulator.flight.navigation.search._vote_kernel import Blocks, Directions, SortedCraters, vote

    rays = camera.rays(uv)
    enu = rays @ NADIR_NORTH_UP
    off_nadir = np.arccos(np.clip(-enu[:, 2], -1.0, 1.0))
    azimuth = np.arctan2(enu[:, 0], enu[:, 1])
    # Depth below the camera over depth along the boresight is one for a camera that looks down.
    log_size = np.log(
        diameter_px / camera.focal_px * rays[:, 2] / np.cos(np.minimum(off_nadir, _LARGEST_OFF_NADIR_RAD))
    )
    south, north, west, width, area = index.extent
    low, high = parameters.minimum_altitude_m, parameters.maximum_altitude_m
    steps = math.ceil(math.log(high / low) / math.log1p(parameters.altitude_step)) + 1
    listed = np.zeros((parameters.places + 1, 4))
    smallest = math.sqrt((north - south) * width * _widest(index) / parameters.cells)
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
    altitudes_m = np.geomspace(low, high, steps)
    cells = np.maximum(0.5 * parameters.block_px * altitudes_m / camera.focal_px / MOON_RADIUS_M, smallest)
    order = np.argsort(-diameter_px, kind="stable")[:_VOTERS]
    order = order[: _affordable(log_size[order], altitudes_m, cells, index, parameters)]
    # Cells grow with altitude: the lowest has most of them.
    work = _work_space(math.prod(_grid(index, float(cells[0]))))
    for altitude_m, cell in zip(altitudes_m, cells, strict=True):
        rows, columns = _grid(index, float(cell))
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
    _, row, column, distance_m = listed[1 : int(listed[0, 0]) + 1].T
    edge = cells[np.searchsorted(altitudes_m, distance_m - MOON_RADIUS_M - 1.0)]
    latitude = south + (row + 1.0) * edge
    longitude = west + (column + 1.0) * edge / np.cos(latitude)
    flat = distance_m * np.cos(latitude)
    return np.stack([flat * np.cos(longitude), flat * np.sin(longitude), distance_m * np.sin(latitude)], axis=1)


def _grid(index: PlaceIndex, cell_rad: float) -> tuple[int, int]:
    """Return rows and columns of the cells of an edge that cover the map."""
    south, north, _, width, _ = index.extent
    return math.ceil((north - south) / cell_rad) + 1, math.ceil(width * _widest(index) / cell_rad) + 2


def _widest(index: PlaceIndex) -> float:
    """Return the radius of the longest parallel of the map as a share of the equator's."""
    south, north = index.extent[:2]
    return math.cos(max(south, -north, 0.0))


def _work_space(cells: int) -> NDArray[np.uint16]:
    """Return memory for at least so many cells, the same in each search of a thread.

    New memory costs a page fault for each page that is written first. On a virtual machine that can take as long as the
    search.
    """
    kept: NDArray[np.uint16] | None = getattr(_KEPT, "cells", None)
    if kept is None or kept.size < cells:
        kept = _KEPT.cells = np.empty(cells, dtype=np.uint16)
    return kept


def _affordable(
    log_size: FloatArray, altitudes_m: FloatArray, cells_rad: FloatArray, index: PlaceIndex, parameters: LostParameters
) -> int:
    """Return how many detections, from the first on, may vote within the bound of work.

    The same ones vote at all altitudes, so that the votes of places can be compared.

    Parameters
    ----------
    log_size
        Logarithms of diameter over depth, largest diameter first, shape (k,).
    altitudes_m, cells_rad
        Altitudes and the edges of a quarter block there, shape (h,).
    """
    from payload_emulator.flight.navigation.search._vote_kernel import CHANCE_LIMIT

    size = log_size[:, None] + np.log(altitudes_m)
    level = np.linspace(0.0, len(index), index.size_quantiles.size)
    below, above = (
        np.interp(size + sign * parameters.log_diameter_gate, index.size_quantiles, level) for sign in (-1.0, 1.0)
    )
    votes = above - below
    votes[votes * 4.0 * cells_rad**2 > CHANCE_LIMIT * index.extent[4]] = 0.0
    return max(_LEAST_VOTERS, int(np.searchsorted(np.cumsum(votes.sum(axis=1)), parameters.votes)))


def _fitted(
    places: FloatArray,
    chosen: Detections,
    sigma_px: FloatArray,
    index: PlaceIndex,
    camera: PinholeCamera,
    parameters: LostParameters,
) -> list[PoseHypothesis]:
    """Return places (MCMF), shape (n, 3), fitted to the detections they explain; those without three are left out."""
    from payload_emulator.flight.navigation.search._fit_kernel import Craters, DetectedCraters, Gates, Image, fit_place

    landmarks = index.landmarks
    half_px = 0.5 * np.array([camera.width_px, camera.height_px], dtype=np.float64)
    image = Image(camera.focal_px, np.array(camera.centre_px), half_px)
    uv = np.stack([chosen.u_px, chosen.v_px], axis=1)
    score = np.nan_to_num(chosen.score, nan=_UNKNOWN_SCORE)
    found = DetectedCraters(uv, np.log(chosen.diameter_px), sigma_px**2, np.clip(score, _LEAST_SCORE, 1.0))
    craters = Craters(
        landmarks.latitude_rad,
        landmarks.position_mcmf_m,
        landmarks.diameter_m,
        np.hypot(landmarks.sigma_m[:, 0], landmarks.sigma_m[:, 1]) / math.sqrt(2.0),
    )
    gates = Gates(
        parameters.block_px,
        parameters.gate,
        _LOG_GATE_FACTOR * parameters.log_diameter_gate,
        parameters.log_diameter_sigma,
    )
    lowest_m = parameters.minimum_altitude_m / _ALTITUDE_SLACK
    highest_m = _ALTITUDE_SLACK * parameters.maximum_altitude_m
    fits: list[PoseHypothesis] = []
    for start in places:
        position, attitude, normal, pair, evidence = fit_place(
            start, NADIR_NORTH_UP, image, found, craters, parameters.attitude_sigma_rad, gates, MOON_RADIUS_M
        )
        detection = np.flatnonzero(pair >= 0)
        altitude_m = float(np.linalg.norm(position)) - MOON_RADIUS_M
        if detection.size < 3 or not lowest_m < altitude_m < highest_m:
            continue
        try:
            covariance = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            continue
        fits.append(
            PoseHypothesis(
                position,
                attitude,
                np.sqrt(np.maximum(np.diag(covariance)[:3], 0.0)),
                detection,
                pair[detection],
                -evidence - _log_share(altitude_m, attitude, normal, index, parameters),
            )
        )
    return fits


def _log_share(
    altitude_m: float, attitude_rad: FloatArray, normal: FloatArray, index: PlaceIndex, parameters: LostParameters
) -> float:
    """Return the logarithm of the share of all possible poses that agrees with the detections as well as a fit.

    All places of the map are alike, so are logarithms of the altitude; the attitude has the normal distribution of its
    sigma, per axis. The normal matrix (6, 6) tells how far place and attitude may move.
    """
    sigma = parameters.attitude_sigma_rad
    span = math.log(parameters.maximum_altitude_m / parameters.minimum_altitude_m)
    of_place = -math.log(float(index.extent[4]) * MOON_RADIUS_M**2 * altitude_m * span)
    of_attitude = -1.5 * math.log(2.0 * math.pi * sigma**2) - 0.5 * float(attitude_rad @ attitude_rad) / sigma**2
    volume = 3.0 * math.log(2.0 * math.pi) - 0.5 * float(np.linalg.slogdet(normal)[1])
    return of_place + of_attitude + volume


def _distance_m(first: PoseHypothesis, second: PoseHypothesis) -> float:
    return float(np.linalg.norm(first.position_mcmf_m - second.position_mcmf_m))


def _same_place_m(place: PoseHypothesis, camera: PinholeCamera, parameters: LostParameters) -> float:
    """Return how far apart two fits may lie and still be of one place."""
    altitude_m = float(np.linalg.norm(place.position_mcmf_m)) - MOON_RADIUS_M
    return 2.0 * parameters.block_px * altitude_m / camera.focal_px


def _span(longitude: FloatArray) -> tuple[float, float]:
    """Return the west end and the width of the smallest interval that holds all longitudes."""
    if not longitude.size:
        return 0.0, 0.0
    ordered = np.sort(np.mod(longitude, 2.0 * math.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * math.pi)
    widest = int(np.argmax(gaps))
    return float(ordered[(widest + 1) % ordered.size]), 2.0 * math.pi - float(gaps[widest])
