"""Pose of the camera in each frame of a pass, from the reference or from the states of an estimator.

Frames: ICRF, mean-Earth (MCMF) and camera axes (x right, y down, z along the boresight).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_service.errors import EvaluationError
from ground_service.evaluation.core import PassInputs
from ground_service.exports.model import REFERENCE
from lunar.arrays import FloatArray, IntArray
from lunar.frames import mcmf_from_spherical
from lunar.timescales import tdb_s_from_utc_ns


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of frames whose position is known, in time order.

    Attributes
    ----------
    states
        States that the positions come from: `reference` or the name of an estimator.
    frame_number, utc_ns
        Frames (n,).
    row
        Places (n,) of the frames in the detections of the pass.
    position_mcmf_m, mcmf_from_icrf, camera_from_mcmf
        Positions (n, 3) and rotations (n, 3, 3).
    """

    states: str
    frame_number: IntArray
    utc_ns: IntArray
    row: IntArray
    position_mcmf_m: FloatArray
    mcmf_from_icrf: FloatArray
    camera_from_mcmf: FloatArray

    @property
    def camera_from_icrf(self) -> FloatArray:
        """Rotations (n, 3, 3) from ICRF to camera axes."""
        return np.asarray(self.camera_from_mcmf @ self.mcmf_from_icrf)


def poses_of(inputs: PassInputs, states: str = REFERENCE) -> Poses:
    """Return the poses of the frames with detection reports.

    Raises
    ------
    EvaluationError
        If the mission does not state the orientation of the Moon, or there are no such states.
    """
    if inputs.orientation is None:
        raise EvaluationError(inputs.refused.get("orientation", "lunar orientation: not stated"))
    utc_ns = inputs.detections.utc_ns
    mcmf_from_icrf = inputs.orientation.mcmf_from_icrf(tdb_s_from_utc_ns(utc_ns))
    if states == REFERENCE:
        position = _reference_positions(inputs, utc_ns, mcmf_from_icrf)
    else:
        position = _estimated_positions(inputs, utc_ns, states)
    known = np.flatnonzero(np.isfinite(position).all(axis=1))
    utc_ns, position, mcmf_from_icrf = utc_ns[known], position[known], mcmf_from_icrf[known]
    return Poses(
        states,
        inputs.detections.frame_number[known],
        utc_ns,
        known.astype(np.int64),
        position,
        mcmf_from_icrf,
        inputs.viewing.camera_from_mcmf(utc_ns, position, mcmf_from_icrf),
    )


def states_names(inputs: PassInputs) -> list[str]:
    """Return the names of the states of a pass."""
    names = [one.estimator for one in inputs.navigation if len(one.utc_ns)]
    return [*([REFERENCE] if inputs.reference is not None else []), *names]


def no_such_states(inputs: PassInputs, states: str) -> EvaluationError:
    """Return the error of a request for states that the pass does not have."""
    return EvaluationError(
        f"states: expected {' or '.join(states_names(inputs)) or 'none'}, found {states!r}"
    )


def _reference_positions(inputs: PassInputs, utc_ns: IntArray, mcmf_from_icrf: FloatArray) -> FloatArray:
    if inputs.reference is None:
        raise no_such_states(inputs, REFERENCE)
    position = np.full((len(utc_ns), 3), np.nan)
    covered = inputs.reference.covers(utc_ns)
    icrf, _ = inputs.reference.at(utc_ns[covered])
    position[covered] = np.einsum("nij,nj->ni", mcmf_from_icrf[covered], icrf)
    return position


def _estimated_positions(inputs: PassInputs, utc_ns: IntArray, states: str) -> FloatArray:
    samples = next((one for one in inputs.navigation if one.estimator == states and len(one.utc_ns)), None)
    if samples is None:
        raise no_such_states(inputs, states)
    place = np.searchsorted(samples.utc_ns, utc_ns, side="right") - 1
    same = (place >= 0) & (samples.utc_ns[np.maximum(place, 0)] == utc_ns)
    position = np.full((len(utc_ns), 3), np.nan)
    rows = place[same]
    position[same] = mcmf_from_spherical(
        np.radians(samples.latitude_deg[rows]),
        np.radians(samples.longitude_deg[rows]),
        samples.altitude_m[rows],
    )
    return position
