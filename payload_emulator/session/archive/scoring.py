"""Anchored navigation of an emulated session against the truth, from what came down and nothing else of the payload.

Positions are compared in mean-Earth axes, since the payload flies its own orientation of the Moon, and split along
the true orbit (radial, transverse, normal). Beside every figure stands what propagation of the start state alone
would have given.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import project_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.constants import NS
from lunar.frames import icrf_from_onboard, rtn_from_inertial, spherical_from_mcmf
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel, coasted, flown, process_noise
from payload_emulator.flight.navigation.outcomes import Mode, Outcome
from payload_emulator.session.spacecraft.loading import LoadedPayload
from payload_emulator.session.world.world import World, clock_ticks
from tmtc.dictionary.estimates import FilterEstimates, filter_estimates
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Table
from tmtc.dictionary.tables import (
    BurnTable,
    OrientationTable,
    no_burns,
    unpack_burn_table,
    unpack_gravity_table,
    unpack_initial_state,
    unpack_orientation_table,
)
from tmtc.packets.stream import cut_packets

# Frames further apart than this belong to different arcs: the shortest gap, over a pole, takes 18 minutes.
_ARC_GAP_NS = 600 * NS
# A session of several arcs is judged from the third on, a single one after this many frames.
_SETTLED_ARC, _SETTLED_FRAMES = 2, 20
# A pair is right if the crater truly lies within this of the detection: six pixels, or a quarter of its diameter.
_RIGHT_PX, _RIGHT_OF_DIAMETER = 6.0, 0.25
_LOG_DIAMETER_GATE = 0.4
# After a disturbance the estimate is back once it is this close, and stays so for as many frames with an image.
_BACK_M, _BACK_FRAMES = 500.0, 4


@dataclass(frozen=True, slots=True, eq=False)
class FlownErrors:
    """Errors of the filter after each frame, a row per frame of the session that the filter spoke in.

    Attributes
    ----------
    frame
        Number of the frame in the session.
    state_error_rtn
        Estimate minus truth, position (m) and velocity (m/s), shape (n, 6).
    sigma_rtn_m
        Standard deviation of the position that the filter states along the axes of the true orbit, shape (n, 3).
    nees
        Normalised estimation error squared, 6 degrees of freedom.
    only_error_m
        Length of the position error of propagation alone.
    coast_end_m, coast_sigmas
        Length of the error right before the first image after a gap, and the error along each axis over the standard
        deviation that the filter states by then, shape (n, 3); NaN elsewhere.
    """

    frame: IntArray
    state_error_rtn: FloatArray
    sigma_rtn_m: FloatArray
    nees: FloatArray
    only_error_m: FloatArray
    coast_end_m: FloatArray
    coast_sigmas: FloatArray

    @property
    def position_m(self) -> FloatArray:
        return np.asarray(np.linalg.norm(self.state_error_rtn[:, :3], axis=1), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class JudgedSession:
    """Performance of the anchored estimator in a session, judged by the truth; a row per frame of the session.

    Attributes
    ----------
    errors
        Errors after the frames that the filter spoke in.
    outcome, nis, matched
        Outcome of each frame (-1: none), NIS and number of matched craters of its fix.
    pairs
        Right and wrong pairs of the fix, shape (n, 2).
    seen
        Detections, and those that are catalogued craters, shape (n, 2).
    tracks
        Frames with each crater of the list in the image, and frames that detect it, shape (craters of the list, 2).
    arcs
        First and last frame of each stretch of images.
    """

    errors: FlownErrors
    outcome: IntArray
    nis: FloatArray
    matched: IntArray
    pairs: IntArray
    seen: IntArray
    tracks: IntArray
    arcs: tuple[tuple[int, int], ...]

    @property
    def imaging(self) -> BoolArray:
        return np.asarray((self.outcome >= 0) & (self.outcome != Outcome.no_image))

    @property
    def fixed(self) -> BoolArray:
        return np.asarray(self.outcome == Outcome.fixed)

    @property
    def wrong_fixes(self) -> int:
        """Fixes with mostly wrong pairs."""
        return int(np.sum(self.fixed & (self.pairs[:, 1] > self.pairs[:, 0])))

    def nis_per_degree(self, chosen: BoolArray) -> float | None:
        """Return the NIS of the fixes in chosen frames (n,) per degree of freedom; None without any."""
        used = chosen & self.fixed & np.isfinite(self.nis)
        return _ratio(float(np.sum(self.nis[used])), float(2 * np.sum(self.matched[used])))


def judge_session(
    world: World, loaded: LoadedPayload, catalogue: CraterCatalogue, camera_from_mcmf: FloatArray, octets: bytes
) -> JudgedSession | None:
    """Return a session judged by the truth; None where the anchored estimator did not run.

    Parameters
    ----------
    catalogue
        True craters near the track.
    camera_from_mcmf
        True attitude at each frame, shape (n, 3, 3).
    octets
        All packets of the payload, end to end.
    """
    tables = DICTIONARY.unpack_many(octets, cut_packets(octets))
    estimates = filter_estimates(tables)
    if not len(estimates):
        return None
    frame_ticks = np.array([clock_ticks(world, int(utc_ns)) for utc_ns in world.frame_utc_ns])
    outcomes, nis, matched = _outcomes(tables, frame_ticks)
    imaging = (outcomes >= 0) & (outcomes != Outcome.no_image)
    errors = _errors(world, loaded, estimates, frame_ticks, imaging)
    judged = _judged_pairs(world, catalogue, camera_from_mcmf, tables, frame_ticks)
    return JudgedSession(errors, outcomes, nis, matched, *judged, tuple(_arcs(world.frame_utc_ns, imaging)))


def score_navigation(world: World, judged: JudgedSession | None) -> dict[str, Any]:
    """Return the section `navigation` of a summary; nothing where the anchored estimator did not run."""
    if judged is None:
        return {}
    errors, arcs, imaging, fixed = judged.errors, judged.arcs, judged.imaging, judged.fixed
    rows = [_arc_row(world, errors, judged.outcome, arc) for arc in arcs]
    first = arcs[_SETTLED_ARC][0] if len(arcs) > _SETTLED_ARC else _SETTLED_FRAMES
    settled = imaging[errors.frame] & (errors.frame >= first)
    coast = errors.coast_end_m[errors.frame >= first]
    return {
        "navigation": {
            "counted_from": "third arc" if len(arcs) > _SETTLED_ARC else f"frame {_SETTLED_FRAMES}",
            "arcs": len(arcs),
            "imaging": _statistics(errors.position_m[settled]),
            "imaging_from_start": _statistics(errors.position_m[imaging[errors.frame]]),
            "end_of_coast": _statistics(coast[np.isfinite(coast)]),
            "propagate_only": _statistics(errors.only_error_m[settled]),
            "velocity_p95_m_s": _percentile(np.linalg.norm(errors.state_error_rtn[settled, 3:], axis=1), 95.0),
            "bias_rtn_m": _means(errors.state_error_rtn[settled, :3]),
            "median_rtn_m": _absolute_percentiles(errors.state_error_rtn[settled, :3], 50.0),
            "p95_rtn_m": _absolute_percentiles(errors.state_error_rtn[settled, :3], 95.0),
            "nees6": _means(errors.nees[settled, None])[0],
            "nis_per_degree": judged.nis_per_degree(fixed),
            "fixed_share_imaging": _ratio(float(np.sum(fixed & imaging)), float(np.sum(imaging))),
            "pairs": int(judged.pairs.sum()),
            "wrong_pairs_share": _ratio(float(judged.pairs[:, 1].sum()), float(judged.pairs.sum())),
            "wrong_fixes": judged.wrong_fixes,
            "recovery": _recovery(world, errors, imaging),
            "per_arc": rows,
        }
    }


def _first_of_each(image_ticks: IntArray, frame_ticks: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows (n,) of frames of the session, each frame once (frames that were played back occur twice)."""
    ticks = image_ticks.astype(np.int64)
    at = np.minimum(np.searchsorted(frame_ticks, ticks), frame_ticks.size - 1)
    rows = np.flatnonzero(frame_ticks[at] == ticks)
    frames, first = np.unique(at[rows], return_index=True)
    return rows[first], frames.astype(np.int64)


def _outcomes(tables: dict[str, Table], frame_ticks: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Outcome of each frame (-1: none), and NIS and matched craters of its fix."""
    outcome = np.full(frame_ticks.size, -1, dtype=np.int64)
    nis, matched = np.full(frame_ticks.size, np.nan), np.zeros(frame_ticks.size, dtype=np.int64)
    for name in ("frame_outcome", "navigation_state"):
        mine = tables[name].columns["estimator"] == int(Mode.anchored)
        columns = {key: values[mine] for key, values in tables[name].columns.items()}
        at = np.minimum(np.searchsorted(frame_ticks, columns["image_ticks"]), frame_ticks.size - 1)
        known = frame_ticks[at] == columns["image_ticks"]
        outcome[at[known]] = columns["outcome"][known]
        if name == "navigation_state":
            nis[at[known]], matched[at[known]] = columns["nis"][known], columns["matched"][known]
    return outcome, nis, matched


def _errors(
    world: World, loaded: LoadedPayload, estimates: FilterEstimates, frame_ticks: IntArray, imaging: BoolArray
) -> FlownErrors:
    which, frame = _first_of_each(estimates.image_ticks, frame_ticks)
    own, covariance = estimates.state[which], estimates.covariance[which]
    ticks = frame_ticks[frame]
    orientation = unpack_orientation_table(loaded.tables.orientation)
    burns = unpack_burn_table(loaded.tables.burns) if loaded.tables.burns else no_burns()
    gravity = unpack_gravity_table(loaded.tables.gravity)
    degree = gravity.c_bar.shape[0] - 1
    model = OrbitModel(gravity, orientation, degree, process_noise(degree, gravity.name))
    utc_ns = world.frame_utc_ns[frame]
    position, velocity = world.truth.states(utc_ns)
    truth = np.concatenate([position, velocity], axis=1)
    rotation = world.truth.orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(utc_ns), dtype=np.float64))
    to_truth = turns(rotation, orientation, ticks)
    rtn = rtn_from_inertial(truth[:, :3], truth[:, 3:])
    error = rtn_errors(own[:, :6], truth, to_truth, rtn)
    own_error = np.einsum("nji,nkj->nki", to_truth, halves(turned(own[:, :6], to_truth) - truth))
    nees = normalised_squares(own_error.reshape(-1, 6), covariance[:, :6, :6])
    axes = rtn @ to_truth
    sigma = np.sqrt(np.einsum("nij,njk,nik->ni", axes, covariance[:, :3, :3], axes))
    only = _propagated(loaded, model, burns, ticks)
    only_error = np.linalg.norm(rtn_errors(only, truth, to_truth, rtn)[:, :3], axis=1)
    coast_end, coast_sigmas = np.full(frame.size, np.nan), np.full((frame.size, 3), np.nan)
    for first, _ in _arcs(world.frame_utc_ns, imaging)[1:]:
        at = int(np.searchsorted(frame, first))
        if 0 < at < frame.size and frame[at] == first:
            span = int(ticks[at - 1]), int(ticks[at])
            prior = coasted(model, own[at - 1], covariance[at - 1], *span, burns)
            if prior is not None:
                here = slice(at, at + 1)
                off = rtn_errors(prior[0][None, :6], truth[here], to_truth[here], rtn[here])[0, :3]
                stated = np.diag(axes[at] @ prior[1][:3, :3] @ axes[at].T)
                coast_end[at], coast_sigmas[at] = np.linalg.norm(off), off / np.sqrt(stated)
    return FlownErrors(frame, error, sigma, nees, only_error, coast_end, coast_sigmas)


def turns(rotation: FloatArray, orientation: OrientationTable, ticks: IntArray) -> FloatArray:
    """Return the rotations (n, 3, 3) from the payload's inertial axes to the true ones, by way of the Moon."""
    own = [orientation.at(int(tick)) for tick in ticks]
    known = np.array([np.full((3, 3), np.nan) if matrix is None else matrix for matrix in own])
    return icrf_from_onboard(rotation, known)


def halves(states: FloatArray) -> FloatArray:
    """Position and velocity of states (n, 6) as (n, 2, 3)."""
    return states.reshape(-1, 2, 3)


def turned(states: FloatArray, turn: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nij,nkj->nki", turn, halves(states)).reshape(-1, 6), dtype=np.float64)


def rtn_errors(states: FloatArray, truth: FloatArray, turn: FloatArray, rtn: FloatArray) -> FloatArray:
    """Return the errors (n, 6) of the payload's states along the axes of the true orbit."""
    return turned(turned(states, turn) - truth, rtn)


def normalised_squares(error: FloatArray, block: FloatArray) -> FloatArray:
    """Return the normalised errors squared (n,) of position and velocity (n, 6) under covariances (n, 6, 6)."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", block), 1e-30))
    whitened = error / scale
    correlation = block / (scale[:, :, None] * scale[:, None, :])
    solved = np.linalg.solve(correlation, whitened[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", whitened, solved), dtype=np.float64)


def _propagated(loaded: LoadedPayload, model: OrbitModel, burns: BurnTable, ticks: IntArray) -> FloatArray:
    """Return the states (n, 6) of the start state propagated without any image, NaN where the orbit model ends."""
    start = unpack_initial_state(loaded.tables.initial_state)
    state: FloatArray | None = np.concatenate([start.position_icrf_m, start.velocity_icrf_m_s, np.zeros(3)])
    at, states = start.ticks, np.full((ticks.size, 6), np.nan)
    for row, tick in enumerate(ticks.tolist()):
        state = None if state is None else flown(model, state, at, tick, burns)
        if state is None:
            break
        at, states[row] = tick, state[:6]
    return states


def _judged_pairs(
    world: World,
    catalogue: CraterCatalogue,
    camera_from_mcmf: FloatArray,
    tables: dict[str, Table],
    frame_ticks: IntArray,
) -> tuple[IntArray, IntArray, IntArray]:
    """Right and wrong pairs of each frame's fix, shape (n, 2), and `seen` and `tracks` of the session.

    Landmarks that the payload mapped itself are in no catalogue and are not judged.
    """
    frames = world.frame_utc_ns.size
    judged, counts = np.zeros((2, frames, 2), dtype=np.int64)
    tracks = np.zeros((len(catalogue), 2), dtype=np.int64)
    corner = np.array([world.camera.width_px, world.camera.height_px]) - 1.0
    seen = tables["detections"]
    places = np.stack([seen.items["u_px"], seen.items["v_px"], seen.items["diameter_px"]], axis=1)
    position = world.truth.positions_mcmf(world.frame_utc_ns)
    rim = catalogue.position_mcmf_m
    used = tables.get("identifications")
    used_row = (
        {} if used is None else dict(zip(*_first_of_each(used.columns["image_ticks"], frame_ticks)[::-1], strict=True))
    )
    order = np.argsort(catalogue.ids)
    latitude, longitude, altitude = spherical_from_mcmf(position)
    for row, number in zip(*_first_of_each(seen.columns["image_ticks"], frame_ticks), strict=True):
        mine = places[_rows_of(seen.item_owner, row)]
        reach = 4.0 * altitude[number] + 50_000.0
        near = catalogue.near(float(latitude[number]), float(longitude[number]), float(reach))
        uv, diameter = _seen(world, camera_from_mcmf[number], position[number], rim, catalogue, near)
        away = np.linalg.norm(mine[:, None, :2] - uv[None], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            alike = np.abs(np.log(mine[:, None, 2] / diameter[None])) < _LOG_DIAMETER_GATE
        limit = np.maximum(_RIGHT_PX, _RIGHT_OF_DIAMETER * mine[:, 2])
        same = alike & (away < limit[:, None])
        wanted = np.all((uv >= 0.0) & (uv <= corner), axis=1)
        counts[number] = len(mine), same.any(axis=1).sum()
        tracks[near] += np.stack([wanted, wanted & same.any(axis=0)], axis=1)
        if used is None or number not in used_row:
            continue
        pairs = _rows_of(used.item_owner, used_row[number])
        named = used.items["crater_id"][pairs].astype(np.int64)
        listed = np.isin(named, catalogue.ids)
        detection = used.items["detection"][pairs].astype(np.int64)[listed]
        crater = order[np.searchsorted(catalogue.ids[order], named[listed])]
        at, _ = _seen(world, camera_from_mcmf[number], position[number], rim, catalogue, crater)
        right = np.linalg.norm(mine[detection, :2] - at, axis=1) < limit[detection]
        judged[number] = np.count_nonzero(right), np.count_nonzero(~right)
    return judged, counts, tracks


def _rows_of(owner: IntArray, value: int) -> slice:
    low, high = np.searchsorted(owner, [value, value + 1])
    return slice(int(low), int(high))


def _seen(
    world: World,
    camera_from_mcmf: FloatArray,
    position: FloatArray,
    rim: FloatArray,
    catalogue: CraterCatalogue,
    which: IntArray,
) -> tuple[FloatArray, FloatArray]:
    uv = project_mcmf(world.camera, camera_from_mcmf, position, rim[which])
    depth = (rim[which] - position) @ camera_from_mcmf[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return uv, catalogue.diameter_m[which] * world.camera.focal_px / np.where(depth > 0.0, depth, np.nan)


def _arcs(utc_ns: IntArray, imaging: BoolArray) -> list[tuple[int, int]]:
    """First and last frame of each stretch of images without a long gap."""
    at = np.flatnonzero(imaging)
    if not at.size:
        return []
    cuts = np.flatnonzero(np.diff(utc_ns[at]) > _ARC_GAP_NS) + 1
    return [(int(part[0]), int(part[-1])) for part in np.split(at, cuts)]


def _arc_row(world: World, errors: FlownErrors, outcomes: IntArray, arc: tuple[int, int]) -> dict[str, Any]:
    first, last = arc
    mine = (errors.frame >= first) & (errors.frame <= last)
    middle = world.frame_utc_ns[(first + last) // 2]
    _, longitude, _ = spherical_from_mcmf(world.truth.positions_mcmf(middle))
    _, _, altitude = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns[first : last + 1]))
    inside = outcomes[first : last + 1]
    before = errors.coast_end_m[mine]
    before = before[np.isfinite(before)]
    return {
        "start_utc": format_utc(int(world.frame_utc_ns[first]), 0),
        "longitude_deg": round(float(np.degrees(longitude[0])) % 360.0, 2),
        "altitude_km": round(float(altitude.mean()) / 1e3, 2),
        "frames": int(inside.size),
        "fixed": int(np.sum(inside == Outcome.fixed)),
        "coast_end_m": round(float(before[0]), 1) if before.size else None,
        **_statistics(errors.position_m[mine]),
        "radial_bias_m": _means(errors.state_error_rtn[mine, :1])[0],
        "propagate_only_m": _percentile(errors.only_error_m[mine], 50.0),
    }


def frames_to_recover(error_m: FloatArray) -> int | None:
    """Return which frame with an image is the first to be back (1: the first of all), None where none is.

    Parameters
    ----------
    error_m
        Position errors after the frames with an image since the disturbance, shape (n,).
    """
    close = error_m < _BACK_M
    for first in np.flatnonzero(close).tolist():
        if close[first : first + _BACK_FRAMES].all():
            return first + 1
    return None


def _recovery(world: World, errors: FlownErrors, imaging: BoolArray) -> dict[str, Any] | None:
    """Return the number of frames with an image until recovery from a kidnap or an outage; None without either."""
    section = world.scenario.disturbances
    if section.kidnap_distance_km > 0.0:
        event = "kidnap told" if section.kidnap_told else "silent kidnap"
        after_s = section.kidnap_at_s
    elif section.outage_duration_s > 0.0:
        event, after_s = "camera outage", section.outage_at_s + section.outage_duration_s
    else:
        return None
    utc_ns = world.frame_utc_ns
    since = (utc_ns[errors.frame] >= utc_ns[0] + round(after_s * NS)) & imaging[errors.frame]
    frames = frames_to_recover(errors.position_m[since])
    return {"after": event, "frames_with_image": int(np.sum(since)), "frames_until_below_500_m": frames}


def _statistics(values: FloatArray) -> dict[str, Any]:
    return {
        "count": int(values.size),
        "median_m": _percentile(values, 50.0),
        "p95_m": _percentile(values, 95.0),
        "max_m": _percentile(values, 100.0),
    }


def _percentile(values: FloatArray, percent: float) -> float | None:
    values = values[np.isfinite(values)]
    return round(float(np.percentile(values, percent)), 3) if values.size else None


def _means(values: FloatArray) -> list[float | None]:
    if not len(values):
        return [None] * values.shape[1]
    return [round(float(value), 3) for value in values.mean(axis=0)]


def _absolute_percentiles(values: FloatArray, percent: float) -> list[float | None]:
    """Return a percentile of the absolute values of each column of (n, k)."""
    return [_percentile(column, percent) for column in np.abs(values).T]


def _ratio(part: float, whole: float) -> float | None:
    return round(part / whole, 5) if whole > 0.0 else None
