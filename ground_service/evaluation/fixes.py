"""Ground evaluation of fixes from telemetered identifications: wrong fixes, snapshot baseline, own landmarks.

A fix is wrong when at least half of its identifications name a crater that, seen from the reference position, lies
further from the detection than the detector's own tolerance. The snapshot baseline solves each frame for its position
alone, from the same identifications and the attitude, without dynamics and without earlier frames.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ground_service.evaluation.recall import CENTRE_TOLERANCE_PX, CENTRE_TOLERANCE_RADII
from ground_service.telemetry.samples import DetectionSamples
from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from reports.values import PayloadMap
from tmtc.dictionary.schema import Table

Pointing = Callable[[FloatArray], FloatArray]

ROUNDS = 8
STEP_M = 1.0
PAIRS_NEEDED = 3
"""Two craters fix three coordinates just so; a third lets a wrong one show."""

CONVERGED_M = 0.01
LIMIT_M = 100e3
"""A solution that moves further than this from where it began is none."""


@dataclass(frozen=True, slots=True, eq=False)
class IdentificationSamples:
    """Pairs of all frames (n,): time of the image, place in the detections of the frame, crater of the catalogue."""

    utc_ns: IntArray
    detection: IntArray
    crater_id: IntArray

    def __len__(self) -> int:
        return len(self.utc_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Identifications (n,) joined with what was detected and where the crater is; `frame` (n,) groups them."""

    frame: IntArray
    utc_ns: IntArray
    uv_px: FloatArray
    diameter_px: FloatArray
    crater_mcmf_m: FloatArray


def join_pairs(found: IdentificationSamples, detections: DetectionSamples, catalogue: CraterCatalogue) -> Pairs:
    """Identifications whose detection came down and whose crater the catalogue holds with its height."""
    order = np.argsort(catalogue.ids, kind="stable")
    ids = catalogue.ids[order]
    place = np.minimum(np.searchsorted(ids, found.crater_id), max(len(ids) - 1, 0))
    known = (
        (ids[place] == found.crater_id) & np.isfinite(catalogue.rim_height_m[order[place]])
        if len(ids)
        else np.zeros(len(found), dtype=np.bool_)
    )
    frame = np.searchsorted(detections.utc_ns, found.utc_ns)
    frame = np.minimum(frame, max(len(detections) - 1, 0))
    if len(detections) == 0:
        known &= False
    else:
        known &= detections.utc_ns[frame] == found.utc_ns
        known &= found.detection < np.diff(detections.offsets)[frame]
    keep = np.flatnonzero(known)
    row = detections.offsets[frame[keep]] + found.detection[keep]
    return Pairs(
        frame[keep],
        found.utc_ns[keep],
        np.column_stack([detections.u_px[row], detections.v_px[row]]),
        detections.diameter_px[row],
        catalogue.position_mcmf_m[order[place[keep]]],
    )


def wrong_fixes(
    pairs: Pairs,
    camera: PinholeCamera,
    utc_ns: IntArray,
    position_mcmf_m: FloatArray,
    camera_from_mcmf: FloatArray | None = None,
) -> int:
    """Return the number of frames with wrong identifications.

    The reference (m, 3), MCMF, and the attitude (m, 3, 3) are given at the ascending times `utc_ns` (m,); without
    an attitude the camera points to nadir.
    """
    at = np.minimum(np.searchsorted(utc_ns, pairs.utc_ns), max(len(utc_ns) - 1, 0))
    if len(utc_ns) == 0 or len(pairs.frame) == 0:
        return 0
    kept = np.flatnonzero((utc_ns[at] == pairs.utc_ns) & np.isfinite(position_mcmf_m[at, 0]))
    rotations = nadir_camera_from_mcmf(position_mcmf_m) if camera_from_mcmf is None else camera_from_mcmf
    line = pairs.crater_mcmf_m[kept] - position_mcmf_m[at[kept]]
    uv = camera.project(np.einsum("nij,nj->ni", rotations[at[kept]], line))
    allowed = np.minimum(CENTRE_TOLERANCE_RADII * pairs.diameter_px[kept] / 2.0, CENTRE_TOLERANCE_PX)
    right = np.hypot(*(uv - pairs.uv_px[kept]).T) <= allowed
    _, frame = np.unique(pairs.frame[kept], return_inverse=True)
    return int(np.count_nonzero(2 * np.bincount(frame, weights=right) <= np.bincount(frame)))


def snapshot_positions(
    pairs: Pairs,
    camera: PinholeCamera,
    utc_ns: IntArray,
    start_mcmf_m: FloatArray,
    pointing: Pointing = nadir_camera_from_mcmf,
    camera_from_mcmf: FloatArray | None = None,
) -> FloatArray:
    """Return the position (m, 3), MCMF, at each epoch from its own identifications; NaN without a solution.

    Parameters
    ----------
    utc_ns, start_mcmf_m
        Ascending epochs (m,) and start positions of the iteration (m, 3): the estimates of the payload.
    pointing
        Attitude (..., 3, 3) of a camera at positions (..., 3), for epochs without a known attitude.
    camera_from_mcmf
        Attitude (m, 3, 3) at each epoch; NaN if unknown.
    """
    if camera_from_mcmf is None:
        camera_from_mcmf = np.full((len(utc_ns), 3, 3), np.nan)
    result = np.full((len(utc_ns), 3), np.nan)
    frames: dict[int, list[tuple[int, IntArray]]] = {}
    for rows in _by_frame(pairs):
        at = int(np.searchsorted(utc_ns, pairs.utc_ns[rows[0]]))
        if len(rows) >= PAIRS_NEEDED and at < len(utc_ns) and utc_ns[at] == pairs.utc_ns[rows[0]]:
            frames.setdefault(len(rows), []).append((at, rows))
    for alike in frames.values():
        where = np.array([at for at, _ in alike])
        chosen = np.array([rows for _, rows in alike])
        result[where] = _solved(
            camera,
            start_mcmf_m[where],
            pairs.crater_mcmf_m[chosen],
            pairs.uv_px[chosen],
            pointing,
            camera_from_mcmf[where],
        )
    return result


def _by_frame(pairs: Pairs) -> list[IntArray]:
    """Rows of the pairs of every frame that has any, in the order of frames."""
    order = np.argsort(pairs.frame, kind="stable")
    starts = np.flatnonzero(np.diff(pairs.frame[order])) + 1
    return np.split(order, starts) if len(order) else []


def _solved(
    camera: PinholeCamera,
    start_m: FloatArray,
    crater_m: FloatArray,
    uv_px: FloatArray,
    pointing: Pointing,
    fixed: FloatArray,
) -> FloatArray:
    """Return the positions (f, 3) of cameras that see n craters each by Gauss-Newton; NaN without convergence."""
    result = np.full(start_m.shape, np.nan)
    position = start_m.astype(np.float64)
    going = np.flatnonzero(np.isfinite(position).all(axis=1))
    steps = STEP_M * np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    coordinates = 2 * crater_m.shape[1]
    for _ in range(ROUNDS):
        projected = _projected(
            camera, position[going, None] + steps, crater_m[going, None], pointing, fixed[going, None]
        )
        residual = (uv_px[going] - projected[:, 0]).reshape(-1, coordinates)
        slope = ((projected[:, 1:4] - projected[:, 4:]) / (2.0 * STEP_M)).reshape(-1, 3, coordinates)
        known = np.isfinite(residual).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
        going, residual, slope = going[known], residual[known], slope[known].swapaxes(1, 2)
        if len(going) == 0:
            break  # none is left, or none was known
        rank = np.linalg.matrix_rank(slope)
        move = (np.linalg.pinv(slope) @ residual[..., None])[..., 0]
        position[going] += move
        good = (rank == 3) & (np.linalg.norm(position[going] - start_m[going], axis=1) <= LIMIT_M)
        settled = good & (np.linalg.norm(move, axis=1) < CONVERGED_M)
        result[going[settled]] = position[going[settled]]
        going = going[good & ~settled]
    return result


def _projected(
    camera: PinholeCamera, positions_m: FloatArray, crater_m: FloatArray, pointing: Pointing, fixed: FloatArray
) -> FloatArray:
    """Return the pixels (..., n, 2) of craters (..., n, 3) for cameras at (..., 3), in fixed attitudes if known."""
    rotations = np.where(np.isfinite(fixed), fixed, pointing(positions_m))
    return np.asarray(camera.project((crater_m - positions_m[..., None, :]) @ rotations.swapaxes(-1, -2)))


LOG_DIAMETER_GATE = 0.4
"""Largest difference of the logarithms of mapped and catalogued diameter."""

SIGMAS = 5.0
"""A catalogued crater is looked for within so many sigma, and at least half a radius."""

FIRST_LANDMARK_ID = 3_000_000_000
"""In the pairs of fixes the payload's own landmarks have identities from here on."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedCraters:
    """Landmarks as they came down: arrays of one length, sigma east, north, up (n, 3).

    `passes` is on how many passes each had been mapped by then.
    """

    landmark_id: IntArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    height_m: FloatArray
    diameter_m: FloatArray
    sigma_m: FloatArray
    passes: IntArray

    def __len__(self) -> int:
        return len(self.landmark_id)


@dataclass(frozen=True, slots=True, eq=False)
class MapComparison:
    """Comparison of a map with the catalogue.

    Attributes
    ----------
    crater
        Row in the catalogue of each landmark, -1 for a new one, shape (n,).
    offset_m
        Landmark minus catalogue, east, north, up, shape (n, 3); NaN for new ones and unknown heights.
    median_horizontal_m, median_offset_m
        Over the known ones: of the distance, and of east, north, up; NaN without any.
    normalised_square
        Mean of the squares of east and north over the claimed sigma: 1 where the claims hold.
    """

    crater: IntArray
    offset_m: FloatArray
    median_horizontal_m: float
    median_offset_m: tuple[float, float, float]
    normalised_square: float

    @property
    def known(self) -> int:
        return int(np.count_nonzero(self.crater >= 0))


def mapped_craters(reports: Table | None) -> MappedCraters:
    """Return all reports of landmarks in the order in which they came; none without packets."""
    items = {} if reports is None else reports.items

    def column(name: str) -> FloatArray:
        return np.asarray(items.get(name, np.empty(0)), dtype=np.float64)

    return MappedCraters(
        column("landmark_id").astype(np.int64),
        column("latitude_deg"),
        column("longitude_deg"),
        column("height_m"),
        column("diameter_m"),
        np.stack([column(f"sigma_{axis}_m") for axis in ("east", "north", "up")], axis=1),
        column("passes").astype(np.int64),
    )


def latest(mapped: MappedCraters) -> MappedCraters:
    """Return the last report of each landmark; reports are in the order in which they were made."""
    _, first = np.unique(mapped.landmark_id[::-1], return_index=True)
    rows = np.sort(len(mapped) - 1 - first)
    return MappedCraters(
        mapped.landmark_id[rows],
        mapped.latitude_deg[rows],
        mapped.longitude_deg[rows],
        mapped.height_m[rows],
        mapped.diameter_m[rows],
        mapped.sigma_m[rows],
        mapped.passes[rows],
    )


def compare_map(mapped: MappedCraters, catalogue: CraterCatalogue) -> MapComparison:
    """Return which landmarks are catalogued, and their offsets; each crater is matched to at most one landmark."""
    count = len(mapped)
    crater, offset = np.full(count, -1, dtype=np.int64), np.full((count, 3), np.nan)
    distance = np.full(count, np.inf)
    latitude, longitude = np.radians(mapped.latitude_deg), np.radians(mapped.longitude_deg)
    for k in range(count):
        reach_m = max(SIGMAS * float(mapped.sigma_m[k, :2].max()), 0.25 * float(mapped.diameter_m[k]))
        near = catalogue.near(float(latitude[k]), float(longitude[k]), reach_m)
        alike = np.abs(np.log(catalogue.diameter_m[near] / mapped.diameter_m[k])) < LOG_DIAMETER_GATE
        near = near[alike]
        if not near.size:
            continue
        turn = np.mod(longitude[k] - catalogue.longitude_rad[near] + np.pi, 2.0 * np.pi) - np.pi
        east = MOON_RADIUS_M * turn * np.cos(latitude[k])
        north = MOON_RADIUS_M * (latitude[k] - catalogue.latitude_rad[near])
        best = int(np.argmin(np.hypot(east, north)))
        crater[k], distance[k] = near[best], float(np.hypot(east[best], north[best]))
        up = mapped.height_m[k] - catalogue.rim_height_m[near[best]]
        offset[k] = east[best], north[best], up
    for row in np.unique(crater[crater >= 0]):
        claimants = np.flatnonzero(crater == row)
        losers = claimants[claimants != claimants[np.argmin(distance[claimants])]]
        crater[losers], offset[losers] = -1, np.nan
    known = crater >= 0
    if not known.any():
        nan = float("nan")
        return MapComparison(crater, offset, nan, (nan, nan, nan), nan)
    heights = offset[known, 2][np.isfinite(offset[known, 2])]
    ratio = offset[known, :2] / mapped.sigma_m[known, :2]
    return MapComparison(
        crater,
        offset,
        float(np.median(np.hypot(offset[known, 0], offset[known, 1]))),
        (
            float(np.median(offset[known, 0])),
            float(np.median(offset[known, 1])),
            float(np.median(heights)) if heights.size else float("nan"),
        ),
        float(np.mean(ratio**2)),
    )


def payload_map(
    reports: MappedCraters | None, identifications: IdentificationSamples | None, catalogue: CraterCatalogue | None
) -> PayloadMap | None:
    """Return what a report says of the payload's map; None where nothing of it came down."""
    if reports is None or not len(reports):
        return None
    mapped = latest(reports)
    pairs = np.empty(0, dtype=np.int64) if identifications is None else identifications.crater_id
    own = pairs[pairs >= FIRST_LANDMARK_ID]
    offset = sigma = np.empty((0, 2))
    nan = float("nan")
    median, ratio = (nan, nan, nan), nan
    known = 0
    if catalogue is not None:
        result = compare_map(mapped, catalogue)
        found = result.crater >= 0
        known, median, ratio = result.known, result.median_offset_m, result.normalised_square
        offset, sigma = result.offset_m[found, :2], mapped.sigma_m[found, :2]
    return PayloadMap(
        mapped=len(mapped),
        mapped_again=int(np.count_nonzero(mapped.passes >= 2)),
        used=int(np.unique(own).size),
        pairs=int(own.size),
        pairs_of_all=int(pairs.size),
        catalogued=known,
        offset_m=offset,
        sigma_m=sigma,
        median_offset_m=median,
        normalised_square=ratio,
        source="" if catalogue is None else catalogue.source,
    )
