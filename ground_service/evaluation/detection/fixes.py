"""Ground evaluation of fixes from telemetered identifications: wrong fixes, and the snapshot baseline.

A fix is wrong when at least half of its identifications name a crater that, seen from the reference position, lies
further from the detection than the detector's own tolerance. The snapshot baseline solves each frame for its position
alone, from the same identifications and the attitude, without dynamics and without earlier frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ground_service.evaluation.detection.recall import CENTRE_TOLERANCE_PX, CENTRE_TOLERANCE_RADII
from ground_service.passes.samples import DetectionSamples
from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue

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


def join_pairs(
    found: IdentificationSamples, detections: DetectionSamples, catalogue: CraterCatalogue
) -> Pairs:
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
    camera: PinholeCamera,
    positions_m: FloatArray,
    crater_m: FloatArray,
    pointing: Pointing,
    fixed: FloatArray,
) -> FloatArray:
    """Return the pixels (..., n, 2) of craters (..., n, 3) for cameras at (..., 3), in fixed attitudes if known."""
    rotations = np.where(np.isfinite(fixed), fixed, pointing(positions_m))
    return np.asarray(camera.project((crater_m - positions_m[..., None, :]) @ rotations.swapaxes(-1, -2)))
