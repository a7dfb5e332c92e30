"""Survey of detection and navigation over the terrain of a region: sessions of several seeds, judged by the truth.

Each seed flies the windows of the region as `linna emulate` does (rendered images, the network on board, the shipped
filter). Windows are judged by their mean errors: errors within a window are almost one draw, so consistency is a matter
of the windows of all seeds together. The first frames of a session, which starts with a large error, do not count.
"""

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from lunar.arrays import IntArray
from lunar.catalogue import NAVIGATION_CLASS, CraterCatalogue
from lunar.datafolder import DataFolder
from lunar.frames import spherical_from_mcmf
from payload_emulator.errors import ScenarioError
from payload_emulator.session.archive.mission import level_of, level_text, unseen_share
from payload_emulator.session.archive.scoring import JudgedSession, judge_session
from payload_emulator.session.scenario import Scenario, format_scenario
from payload_emulator.session.spacecraft.loading import load_scenario_payload, network_octets
from payload_emulator.session.spacecraft.loop import new_spacecraft
from payload_emulator.session.spacecraft.schedule import fly_scenario, timeline
from payload_emulator.session.world.world import World, build_world, registered_share
from payload_emulator.sim.terrain.curation import Region
from reports.statistics import sigma_remark

Progress = Callable[[Iterable[Any], int], Iterable[Any]]

SETTLED_FRAMES = 20
"""Frames at the start of a session that do not count."""

TRACK_FRAMES = (5, 2)
"""A crater is counted on its track with so many frames that have it in the image, and as found with so many that
detect it."""

COAST_FRAMES = (1, 60, 120)
"""Numbers of frames before a coast from which coasts are counted together."""

RECALL_GROUPS = {
    "5_30_km": "5 to 30 km",
    "5_30_km_depth_06_10": "of these with depth/diameter .06 to .10",
    "5_30_km_depth_above_10": "above .10",
    "3_5_km": "3 to 5 km",
}
"""Groups of craters whose recall is counted."""


class SurveyWindow(BaseModel):
    """One window; errors of the position in metres, and the share of frames within 2 sigma along each axis.

    The coast ends at the first frame of the window: its error, the same over its standard deviation along each axis,
    and the frames of the session before it.
    """

    seed: int
    longitude_deg: float
    altitude_km: tuple[float, float]
    frames: int
    fixed: int
    median_m: float
    p95_m: float
    bias_rtn_m: tuple[float, float, float]
    inside_2_sigma: tuple[float, float, float]
    nees: float
    nis: float | None
    coast_end_m: float | None
    coast_sigmas: tuple[float, float, float] | None = None
    coast_frames: int = 0
    position_m: tuple[float, ...]


class SurveySession(BaseModel):
    """The session of one seed; `registered_share` is of the frames where the list is registered, `recall` by group."""

    windows: tuple[SurveyWindow, ...]
    detections: int
    findable: int
    recall: dict[str, tuple[int, int, int, int]]
    pairs: int
    wrong_pairs: int
    wrong_fixes: int
    registered_share: float
    level: str
    data: tuple[str, ...]


def survey_scenario(base: Scenario, region: Region, windows: int, seed: int) -> Scenario:
    """Return the scenario of one seed over a region."""
    window = replace(
        base.window,
        search="terrain",
        passes=windows,
        direction="ascending",
        latitude_limit_deg=90.0,
        longitude_min_deg=region.west_deg,
        longitude_max_deg=region.east_deg,
        latitude_min_deg=region.south_deg,
        latitude_max_deg=region.north_deg,
    )
    return replace(base, name=f"survey-{seed}", seed=seed, window=window)


def survey_session(scenario: Scenario, data: DataFolder, out: Path | None, progress: Progress) -> SurveySession:
    """Return the session of a scenario: that kept in the folder `out`, or one that is flown now and kept there."""
    if out is None:
        return _flown(build_world(scenario, data), data, progress)
    network = hashlib.sha256(network_octets(scenario.detector.network)).hexdigest()
    of = "|".join([format_scenario(scenario), network, str(data.root)])
    kept = out / f"{scenario.name}-{hashlib.sha256(of.encode()).hexdigest()[:12]}.json"
    if not kept.is_file():
        session = _flown(build_world(scenario, data), data, progress)
        partial = kept.with_suffix(".partial")
        partial.write_text(session.model_dump_json(), encoding="utf-8")
        partial.replace(kept)
    try:
        return SurveySession.model_validate_json(kept.read_bytes())
    except ValidationError as error:
        fault = error.errors()[0]
        raise ScenarioError(f"{kept}: expected a session of a survey, found {fault['msg']}") from None


def _flown(world: World, data: DataFolder, progress: Progress) -> SurveySession:
    loaded, _, catalogue = load_scenario_payload(world, data)
    spacecraft = new_spacecraft(world, loaded)
    attitudes = np.full((world.frame_utc_ns.size, 3, 3), np.nan)
    packets: list[bytes] = []
    for result in progress(fly_scenario(world, spacecraft), len(timeline(world))):
        packets += result.packets
        if result.exposure is not None:
            attitudes[result.step.frame] = result.exposure.camera_from_mcmf
    judged = judge_session(world, loaded, catalogue, attitudes, b"".join(packets))
    if judged is None:
        raise ScenarioError(
            f"scenario {world.scenario.name}: expected the estimator anchored, "
            f"found {', '.join(world.scenario.navigation.estimators)}"
        )
    unseen = unseen_share(world)
    level = level_text(level_of("real-terrain" if world.terrain.is_real else "procedural", unseen), unseen)
    navigation = world.scenario.navigation
    if distortion_m := navigation.catalogue_distortion_m:
        level += f", map distorted by {distortion_m:g} m over {navigation.catalogue_distortion_deg:g}°"
    detections, findable = judged.seen.sum(axis=0)
    return SurveySession(
        windows=_windows(world, judged),
        detections=detections,
        findable=findable,
        recall=recall_counts(catalogue, judged.tracks),
        pairs=judged.pairs.sum(),
        wrong_pairs=judged.pairs[:, 1].sum(),
        wrong_fixes=judged.wrong_fixes,
        registered_share=registered_share(world.terrain, world.truth, world.frame_utc_ns),
        level=level,
        data=world.data_names,
    )


def recall_counts(catalogue: CraterCatalogue, tracks: IntArray) -> dict[str, tuple[int, int, int, int]]:
    """Return by group of craters: frames that have one in the image and that detect it, tracks, tracks that find it.

    `tracks` (n, 2) is that of `JudgedSession`. A crater of unknown depth is in no group by depth/diameter.
    """
    depth_ratio, paper = catalogue.depth_m / catalogue.diameter_m, np.isin(catalogue.size_class, (0, 1, 2))
    groups = (
        paper,
        paper & (depth_ratio >= 0.06) & (depth_ratio < 0.10),
        paper & (depth_ratio >= 0.10),
        catalogue.size_class == NAVIGATION_CLASS,
    )
    lasting = tracks[:, 0] >= TRACK_FRAMES[0]
    counted = np.stack([*tracks.T, lasting, lasting & (tracks[:, 1] >= TRACK_FRAMES[1])], axis=1)
    sums = (tuple(counted[chosen].sum(axis=0).tolist()) for chosen in groups)
    return dict(zip(RECALL_GROUPS, sums, strict=True))


def _windows(world: World, judged: JudgedSession) -> tuple[SurveyWindow, ...]:
    """Return the windows that have frames after the first ones of the session."""
    errors, rows = judged.errors, []
    _, longitude, altitude = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    number = np.arange(judged.outcome.size)
    for first, last in judged.arcs:
        start = max(first, judged.arcs[0][0] + SETTLED_FRAMES)
        mine = (errors.frame >= start) & (errors.frame <= last)
        if not mine.any():
            continue
        chosen = judged.imaging & (number >= start) & (number <= last)
        rtn, sigma = errors.state_error_rtn[mine, :3], errors.sigma_rtn_m[mine]
        here = errors.frame == first
        coast, sigmas = errors.coast_end_m[here], errors.coast_sigmas[here]
        rows.append(
            SurveyWindow(
                seed=world.scenario.seed,
                longitude_deg=round(float(np.degrees(longitude[(first + last) // 2])) % 360.0, 1),
                altitude_km=tuple(np.round(np.percentile(altitude[first : last + 1], (0, 100)) / 1e3, 1)),
                frames=chosen.sum(),
                fixed=(chosen & judged.fixed).sum(),
                median_m=np.median(errors.position_m[mine]),
                p95_m=np.percentile(errors.position_m[mine], 95.0),
                bias_rtn_m=tuple(rtn.mean(axis=0)),
                inside_2_sigma=tuple((np.abs(rtn) <= 2.0 * sigma).mean(axis=0)),
                nees=errors.nees[mine].mean(),
                nis=judged.nis_per_degree(chosen),
                coast_end_m=coast[0] if np.isfinite(coast).all() and coast.size else None,
                coast_sigmas=tuple(sigmas[0]) if np.isfinite(sigmas).all() and coast.size else None,
                coast_frames=int(judged.imaging[:first].sum()),
                position_m=tuple(errors.position_m[mine]),
            )
        )
    return tuple(rows)


def summary(sessions: Sequence[SurveySession]) -> dict[str, Any]:
    """Return the figures of all windows together.

    `median_95_m` is the 95 % interval of the median, by drawing whole windows again (errors within a window are almost
    one draw). `bounds` are those of the mean NEES(6) over windows at 95 %, as many independent draws as windows;
    `nees_trend` is its change from a window of a session to the next.
    """
    from scipy.stats import chi2

    windows = [window for session in sessions for window in session.windows]
    if not windows:
        raise ScenarioError(f"survey: expected windows with more than {SETTLED_FRAMES} frames in a session, found none")
    position = np.concatenate([window.position_m for window in windows])
    frames = np.array([window.frames for window in windows])
    nees = np.array([window.nees for window in windows])
    order = np.concatenate([np.arange(len(session.windows)) for session in sessions])
    coasts = [window.coast_end_m for window in windows if window.coast_end_m is not None]
    nis = [(window.nis, window.fixed) for window in windows if window.nis is not None]
    inside = np.average([window.inside_2_sigma for window in windows], axis=0, weights=frames)
    bias = np.average([window.bias_rtn_m for window in windows], axis=0, weights=frames)
    drawn = np.random.default_rng(1).integers(0, len(windows), (2_000, len(windows)))
    medians = [np.median(np.concatenate([windows[k].position_m for k in row])) for row in drawn]
    low, high = chi2.ppf((0.025, 0.975), 6 * len(windows)) / len(windows)
    sums = {
        name: sum(getattr(session, name) for session in sessions)
        for name in SurveySession.model_fields
        if name not in ("windows", "recall", "registered_share", "level", "data")
    }
    recall: dict[str, float | None] = {}
    for group in RECALL_GROUPS:
        craters, found, tracks, tracked = np.sum([session.recall[group] for session in sessions], axis=0)
        recall[f"recall_{group}"] = float(found / craters) if craters else None
        recall[f"track_recall_{group}"] = float(tracked / tracks) if tracks else None
    return {
        "windows": [window.model_dump(exclude={"position_m"}) for window in windows],
        "frames": int(frames.sum()),
        "median_m": float(np.median(position)),
        "median_95_m": np.percentile(medians, (2.5, 97.5)).tolist(),
        "p95_m": float(np.percentile(position, 95.0)),
        "max_m": float(position.max()),
        "coasts": _coasts(windows),
        "coast_end_p95_m": float(np.percentile(coasts, 95.0)) if coasts else None,
        "nees_mean": float(nees.mean()),
        "bounds": [float(low), float(high)],
        "nees_remark": sigma_remark(float(nees.mean()) / 6.0, float(low) / 6.0, float(high) / 6.0),
        "nees_trend": float(np.polyfit(order, nees, 1)[0]) if np.ptp(order) > 0 else None,
        "nees_above_12_6_share": float((nees > 12.6).mean()),
        "bias_rtn_m": bias.tolist(),
        "inside_2_sigma": dict(zip("rtn", inside.tolist(), strict=True)),
        "nis": float(np.average(nis, axis=0, weights=[fixed for _, fixed in nis])[0]) if nis else None,
        "fixed_share": sum(window.fixed for window in windows) / max(int(frames.sum()), 1),
        "catalogued_share": sums["findable"] / max(sums["detections"], 1),
        **recall,
        "wrong_pairs_share": sums["wrong_pairs"] / max(sums["pairs"], 1),
        "wrong_fixes": sums["wrong_fixes"],
        "registered_share": min(session.registered_share for session in sessions),
        "level": sessions[0].level,
        "data": list(sessions[0].data),
    }


def _coasts(windows: Sequence[SurveyWindow]) -> list[dict[str, Any]]:
    """Return the coasts by the frames before them: number, largest error, share of the axes within 2 sigma."""
    rows = []
    for least, most in zip(COAST_FRAMES, (*COAST_FRAMES[1:], math.inf), strict=True):
        mine = [one for one in windows if one.coast_sigmas is not None and least <= one.coast_frames < most]
        if mine:
            inside = np.abs([one.coast_sigmas or () for one in mine]) <= 2.0
            largest_m = max(one.coast_end_m or 0.0 for one in mine)
            share = float(np.mean(inside))
            rows.append({"frames_from": least, "coasts": len(mine), "max_m": largest_m, "inside_2_sigma": share})
    return rows


def format_survey(figures: dict[str, Any]) -> str:
    """Return windows and figures as lines of text."""
    lines = ["seed   lon E   altitude km   fixed        median  95 % m  NEES   bias R, T, N m      coast m"]
    for row in figures["windows"]:
        low, high = row["altitude_km"]
        coast = "" if row["coast_end_m"] is None else f"{row['coast_end_m']:.0f}"
        lines.append(
            f"{row['seed']:<6}{row['longitude_deg']:>6.1f}{low:>9.0f} to {high:<3.0f}"
            f"{row['fixed']:>5} of {row['frames']:<5}{row['median_m']:>7.0f}{row['p95_m']:>8.0f}{row['nees']:>6.1f}   "
            f"{', '.join(f'{value:.0f}' for value in row['bias_rtn_m']):<18}{coast:>7}"
        )
    inside, (least, most) = figures["inside_2_sigma"], figures["bounds"]
    registered = figures["registered_share"]
    stated = f"registered in {100 * registered:.0f} % of the frames" if registered else "not registered"
    nis = "unknown" if figures["nis"] is None else f"{figures['nis']:.2f}"
    coast = figures["coast_end_p95_m"]
    shares = [
        "unknown" if (share := figures[f"{kind}_{group}"]) is None else f"{100 * share:.0f} %"
        for group in RECALL_GROUPS
        for kind in ("recall", "track_recall")
    ]
    recall = zip(RECALL_GROUPS.values(), shares[::2], shares[1::2], strict=True)
    return "\n".join(
        [
            *lines,
            "all: median {median_m:.0f} m ({0:.0f} to {1:.0f} m when windows are drawn again), 95 % {p95_m:.0f} m, "
            "largest {max_m:.0f} m".format(*figures["median_95_m"], **figures)
            + ("" if coast is None else f"; end of coast 95 % {coast:.0f} m"),
            f"mean NEES(6) {figures['nees_mean']:.2f}, bounds {least:.2f} to {most:.2f} for {len(figures['windows'])} "
            f"windows; within 2 sigma {', '.join(f'{axis.upper()} {share:.2f}' for axis, share in inside.items())}; "
            f"NIS {nis}" + (f"; {wrong}" if (wrong := figures["nees_remark"]) else ""),
            "coasts, by the frames before them: "
            + (
                "; ".join(
                    f"from {row['frames_from']} on {row['coasts']}, largest {row['max_m']:.0f} m, "
                    f"within 2 sigma {row['inside_2_sigma']:.2f}"
                    for row in figures["coasts"]
                )
                or "none"
            ),
            f"fixed {100 * figures['fixed_share']:.1f} %; wrong pairs {100 * figures['wrong_pairs_share']:.2f} %, "
            f"wrong fixes {figures['wrong_fixes']}; crater list {stated}",
            f"{100 * figures['catalogued_share']:.0f} % of the detections are catalogued craters; detected of the "
            "catalogued craters in view (on their tracks): "
            + ", ".join(f"{text} {share} ({lasting})" for text, share, lasting in recall),
            f"level {figures['level']}",
        ]
    )
