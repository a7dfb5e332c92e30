"""Seeded, realistic report values for tests: no emulator, no ground, only the shapes that a real pass has.

The orbit is a circle with an eccentric altitude profile, the errors follow the magnitudes that simulations of the
mission gave: a planar odometry that loses 1 to 2 % of path, a spherical one that loses almost nothing, a catalogue
filter of a few tens of metres that coasts through the dark, a Kepler and a degree-50 propagation, and a single-frame
fix.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reports.values import (
    AnchorRead,
    ApidAccounting,
    BinScore,
    CalibrationBin,
    ChangedCraters,
    ChangedTrack,
    ClassScore,
    CompletenessSeries,
    CraterMap,
    DetectorReport,
    DetectorScore,
    DriftSample,
    FrameAccounting,
    GalleryFrame,
    HeadlineFigure,
    HousekeepingParameter,
    NamedScore,
    NavigationSeries,
    NavigationStatistics,
    PacketAccounting,
    PassEvent,
    PassReport,
    PayloadMap,
    PrecisionRecallCurve,
    ReceptionQuality,
    RegressionGate,
    RegressionPass,
    RegressionReport,
    ResidualSeries,
    ScoreGroup,
    SigmaBin,
    TerrainMap,
    TimeSpan,
    TrackSeries,
    TrainingCurve,
)

Array = NDArray[np.float64]

START_UTC_NS = 1_880_964_840_000_000_000  # 2029-08-09T10:14:00Z
RADIUS_M = 1_737_400.0
PERIOD_S = 111.20 * 60.0
INCLINATION_RAD = np.radians(88.2)
FOCAL_PX = 147.80


def _unit_track(elapsed_s: Array) -> tuple[Array, Array]:
    """Unit position and direction of motion over the rotating Moon, (n, 3) each."""

    def position(t: Array) -> Array:
        angle = np.radians(-62.0) + 2.0 * np.pi * t / PERIOD_S
        node = np.radians(296.0) - 2.0 * np.pi * t / (27.32 * 86_400.0)
        x, y = np.cos(angle), np.sin(angle) * np.cos(INCLINATION_RAD)
        z = np.sin(angle) * np.sin(INCLINATION_RAD)
        return np.stack(
            [x * np.cos(node) - y * np.sin(node), x * np.sin(node) + y * np.cos(node), z], axis=-1
        )

    here = position(elapsed_s)
    motion = position(elapsed_s + 0.5) - position(elapsed_s - 0.5)
    return here, motion / np.linalg.norm(motion, axis=-1, keepdims=True)


def _altitude_m(elapsed_s: Array) -> Array:
    angle = 2.0 * np.pi * elapsed_s / PERIOD_S
    return np.asarray(30_700.0 - 9_800.0 * np.cos(angle - 0.6) + 1_900.0 * np.sin(3.1 * angle))


def _geodetic(position_m: Array) -> tuple[Array, Array, Array]:
    radius = np.linalg.norm(position_m, axis=-1)
    latitude = np.degrees(np.arcsin(position_m[:, 2] / radius))
    longitude = np.degrees(np.arctan2(position_m[:, 1], position_m[:, 0])) % 360.0
    return latitude, longitude, radius - RADIUS_M


def _quantiles(error_rtn_m: Array, drift_percent: float, path_m: float) -> NavigationStatistics:
    length = np.linalg.norm(error_rtn_m, axis=1)
    length = length[np.isfinite(length)]
    if not len(length):
        return NavigationStatistics()
    p50, p68, p95, p99 = (float(v) for v in np.quantile(length, (0.5, 0.68, 0.95, 0.99)))
    return NavigationStatistics(
        p50, p68, p95, p99, float(length.max()), drift_percent, float(length[-1]), path_m
    )


def _series(
    name: str, kind: str, utc_ns: NDArray[np.int64], elapsed_s: Array, error_rtn_m: Array, **more: object
) -> NavigationSeries:
    unit, along = _unit_track(elapsed_s)
    cross = np.cross(unit, along)
    radius = RADIUS_M + _altitude_m(elapsed_s)
    position = unit * (radius + error_rtn_m[:, 0])[:, None]
    position = position + along * error_rtn_m[:, 1:2] + cross * error_rtn_m[:, 2:3]
    latitude, longitude, altitude = _geodetic(position)
    return NavigationSeries(name, kind, utc_ns, latitude, longitude, altitude, error_rtn_m, **more)


def _odometry(
    rng: np.random.Generator,
    imaging: NDArray[np.bool_],
    step_bias_m: Array,
    step_noise_m: Array,
    shares: tuple[float, ...],
) -> tuple[Array, tuple[str, ...], tuple[str, ...], Array]:
    names = ("multi", "single", "predicted", "missed", "rejected")
    n = len(imaging)
    error, before = np.full((n, 3), np.nan), np.full(n, np.nan)
    outcome, trigger = [], []
    state, running, side = np.zeros(3), False, rng.normal(0.0, 0.6)
    for i in range(n):
        if not imaging[i]:
            running = False
            outcome.append("")
            trigger.append("none")
            continue
        if not running:
            outcome.append("anchored")
            trigger.append("initialization" if not any(outcome[:-1]) else "time_gap")
            before[i] = float(np.hypot(state[1], state[2])) if trigger[-1] == "time_gap" else np.nan
            state, running, side = np.zeros(3), True, rng.normal(0.0, 0.6)
        else:
            what = str(rng.choice(names, p=shares))
            outcome.append(what)
            trigger.append("none")
            state = (
                state + step_bias_m * np.array([1.0, 1.0 + 0.3 * side, side]) + rng.normal(0.0, step_noise_m)
            )
            if what in ("missed", "rejected"):
                state = state - np.array([0.0, 0.4 * step_noise_m[1], 0.0])
        error[i] = state
    return error, tuple(outcome), tuple(trigger), before


def _filter(
    rng: np.random.Generator, imaging: NDArray[np.bool_], cadence_s: float
) -> tuple[Array, Array, tuple[str, ...], NDArray[np.int64], Array]:
    n = len(imaging)
    error, sigma = np.zeros((n, 3)), np.zeros((n, 3))
    scale = np.array([800.0, 900.0, 700.0])
    state = rng.normal(0.0, 0.5, 3) * scale
    outcome: list[str] = []
    matched, age = np.zeros(n, np.int64), np.zeros(n)
    floor = np.array([18.0, 34.0, 24.0])
    since = 0.0
    for i in range(n):
        count = int(rng.poisson(5.5)) if imaging[i] else 0
        if imaging[i] and count >= 3:
            gain = 0.45
            scale = np.sqrt((1 - gain) * scale**2 + gain * floor**2)
            state = (1 - gain) * state + gain * rng.normal(0.0, floor * 1.3) + rng.normal(0.0, 2.0, 3)
            outcome.append("fixed" if rng.random() > 0.02 else "refused")
            matched[i], since = count, 0.0
        else:
            since += cadence_s
            grow = np.array([0.35, 1.6, 0.3]) * cadence_s / 15.0
            scale = scale + grow
            state = state + rng.normal(0.0, 0.25, 3) * grow + np.sign(state) * 0.55 * grow
            outcome.append("coasted" if imaging[i] else "no_image")
        error[i], sigma[i], age[i] = state, scale, since
    return error, sigma, tuple(outcome), matched, age


def crater_image(
    seed: int, size: int = 512, craters: int = 14
) -> tuple[NDArray[np.uint8], tuple[Array, Array, Array]]:
    """A gray frame with shaded bowls, and their centres and diameters in pixels."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, 1.0, (size, size))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1.0
    ground = np.fft.ifft2(np.fft.fft2(noise) / frequency**1.1).real
    gray = 118.0 + 9.0 * ground / ground.std()
    u, v = rng.uniform(20, size - 20, craters), rng.uniform(20, size - 20, craters)
    diameter = rng.choice([15, 22, 30, 44, 70], craters, p=[0.3, 0.3, 0.2, 0.13, 0.07]) * rng.uniform(
        0.9, 1.2, craters
    )
    small = rng.uniform(0, size, (160, 2))
    every = [*zip(u, v, diameter, strict=True), *((a, b, rng.uniform(3, 8)) for a, b in small)]
    for x, y, d in every:
        reach = int(1.1 * d) + 2
        left, top = max(0, int(x) - reach), max(0, int(y) - reach)
        patch = gray[top : int(y) + reach, left : int(x) + reach]
        rows, columns = np.mgrid[0 : patch.shape[0], 0 : patch.shape[1]].astype(np.float64)
        dx, dy = (columns + left - x) / (d / 2), (rows + top - y) / (d / 2)
        r = np.hypot(dx, dy)
        slope = np.where(r < 1.0, 2.6 * r, -1.5 * np.exp(-((r - 1.0) / 0.28)))
        patch -= 26.0 * np.where(r < 2.2, slope, 0.0) * (dx * 0.35 - dy * 0.94) / np.maximum(r, 1e-3)
    gray += rng.normal(0.0, 2.5, gray.shape)
    return np.clip(gray, 0, 255).astype(np.uint8), (u, v, diameter)


def size_class(diameter_px: Array, altitude_m: float = 30_000.0) -> NDArray[np.int64]:
    kilometres = diameter_px * altitude_m / FOCAL_PX / 1e3
    return np.where(kilometres < 5, 3, np.where(kilometres < 10, 0, np.where(kilometres < 15, 1, 2))).astype(
        np.int64
    )


def gallery_frame(seed: int, frame_number: int = 1, utc_ns: int | None = None) -> GalleryFrame:
    image, (u, v, diameter) = crater_image(seed)
    rng = np.random.default_rng(seed + 1)
    seen = rng.random(len(u)) < 0.72
    du, dv = rng.normal(0.0, 1.1, len(u)), rng.normal(0.0, 1.1, len(u))
    false = int(rng.integers(0, 3))
    du_false, dv_false = rng.uniform(20, 490, false), rng.uniform(20, 490, false)
    found_u, found_v = np.append((u + du)[seen], du_false), np.append((v + dv)[seen], dv_false)
    found_d = np.append((diameter * rng.uniform(0.93, 1.07, len(u)))[seen], rng.uniform(15, 30, false))
    return GalleryFrame(
        frame_number=frame_number,
        utc_ns=utc_ns,
        image=image,
        detection_u_px=found_u,
        detection_v_px=found_v,
        detection_diameter_px=found_d,
        detection_class=size_class(found_d),
        catalogue_u_px=u,
        catalogue_v_px=v,
        catalogue_diameter_px=diameter,
        catalogue_class=size_class(diameter),
        detection_matched=np.append(np.ones(int(seen.sum()), bool), np.zeros(false, bool)),
        catalogue_matched=seen,
        caption=f"{int(seen.sum())} of {len(u)} found, {false} false",
    )


def detector_score(seed: int = 3) -> DetectorScore:
    rng = np.random.default_rng(seed)
    n = 2_400
    azimuth = rng.uniform(-45.0, 45.0, n) % 360.0
    u, v = rng.uniform(0, 511, n), rng.uniform(0, 511, n)
    du = 0.16 * np.sin(np.radians(azimuth)) + 0.0004 * (u - 255.5) + rng.normal(0, 1.2, n)
    dv = -0.22 * np.cos(np.radians(azimuth)) + 0.0003 * (v - 255.5) + rng.normal(0, 1.2, n)
    threshold = np.linspace(0.05, 0.95, 46)
    curves = tuple(
        PrecisionRecallCurve(
            label, threshold, 1 - (1 - top) * (1.35 - threshold) ** 2.2, rec * (1 - threshold**3.2)
        )
        for label, top, rec in (("5–10 km", 0.8, 0.79), ("10–15 km", 0.84, 0.74), ("15–30 km", 0.88, 0.86))
    )
    return DetectorScore(
        per_class=(
            ClassScore(0, "5–10 km", 1_642, 1_166, 206, 0.8499, 0.7101, 1.13),
            ClassScore(1, "10–15 km", 371, 234, 45, 0.8387, 0.6307, 1.57),
            ClassScore(2, "15–30 km", 240, 187, 23, 0.8905, 0.7792, 2.26),
        ),
        micro=ClassScore(-1, "all", 2_253, 1_587, 274, 0.8528, 0.7044, 1.33),
        method="One-to-one, same class, within the larger of 10 px and half the radius; a crater is expected when its "
        "centre and rim lie inside the frame of the reference pose.",
        by_altitude_km=tuple(
            BinScore(
                a,
                a + 5,
                int(60 + 25 * (a - 10)),
                0.79 + 0.004 * (a - 10),
                0.80 - 0.007 * (a - 10),
                1.0 + 0.02 * a,
            )
            for a in range(15, 45, 5)
        ),
        by_sun_elevation_deg=tuple(
            BinScore(e, e + 2, 420 - 18 * e, 0.8 + 0.006 * e, 0.52 + 0.018 * e, 1.6 - 0.03 * e)
            for e in range(5, 15, 2)
        ),
        curves=curves,
        calibration=tuple(
            CalibrationBin(s, min(0.99, s * 0.9 + 0.13), int(40 + 500 * (1 - s)))
            for s in np.arange(0.35, 1.0, 0.1)
        ),
        residuals=ResidualSeries(u, v, du, dv, azimuth, rng.uniform(8, 70, n)),
    )


def pass_report(
    seed: int = 7, *, hours: float = 37.1 / 60.0, cadence_s: float = 15.0, gallery: int = 6, worst: int = 10
) -> PassReport:
    """A complete pass report; with ``hours=24`` a whole day of windows between 60 degrees south and north."""
    rng = np.random.default_rng(seed)
    n = max(1, round(hours * 3600.0 / cadence_s))
    elapsed = np.arange(n) * cadence_s + 40.0
    utc_ns = START_UTC_NS + (elapsed * 1e9).astype(np.int64)
    unit, _ = _unit_track(elapsed)
    altitude = _altitude_m(elapsed)
    latitude, longitude, _ = _geodetic(unit * RADIUS_M)
    reference = TrackSeries(utc_ns, latitude, longitude, altitude)
    imaging = np.abs(latitude) <= 60.0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], imaging.astype(int), [0]])))
    half = int(cadence_s * 5e8)
    arcs = tuple(
        TimeSpan(int(utc_ns[a]) - half, int(utc_ns[b - 1]) + half)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )
    path = float(n * cadence_s * 1_636.0)
    sun = 10.0 + 4.0 * np.sin(elapsed / 300.0)
    terrain = tuple(np.where(np.abs(latitude) < 22, "mare", "highland"))

    paper, outcome, trigger, before = _odometry(
        rng,
        imaging,
        np.array([55.0, 400.0, 130.0]),
        np.array([60.0, 380.0, 260.0]),
        (0.716, 0.018, 0.247, 0.013, 0.006),
    )
    rounds, round_outcome, round_trigger, round_before = _odometry(
        rng,
        imaging,
        np.array([0.5, 2.2, 0.6]),
        np.array([14.0, 42.0, 34.0]),
        (0.861, 0.01, 0.123, 0.005, 0.001),
    )
    fix, sigma, fix_outcome, matched, age = _filter(rng, imaging, cadence_s)
    nees = np.sum((fix / sigma) ** 2, axis=1)
    nis = np.where(matched > 0, rng.chisquare(np.maximum(2 * matched, 1)), np.nan)
    hours_in = (elapsed - elapsed[0]) / 3600.0
    wave = 2.0 * np.pi * elapsed / PERIOD_S
    kepler = np.stack(
        [
            420.0 * hours_in * (1 - np.cos(wave)),
            2_050.0 * hours_in * (1 + 0.35 * np.sin(wave)),
            260.0 * hours_in,
        ],
        axis=1,
    )
    deg50 = np.stack(
        [24.0 * hours_in * (1 - np.cos(wave)), 118.0 * hours_in * (1 + 0.3 * np.sin(wave)), 22.0 * hours_in],
        axis=1,
    )
    snapshot = rng.normal(0.0, [95.0, 120.0, 118.0], (n, 3))
    snapshot[(matched < 3) | ~imaging] = np.nan
    lengths = np.array([100e3, 200e3, 500e3, 1e6, 2e6])

    def sweep(base: float, slope: float) -> tuple[DriftSample, ...]:
        return tuple(
            DriftSample(float(m), base * (m / 1e6) ** slope, 2.1 * base * (m / 1e6) ** slope, int(4e7 / m))
            for m in lengths
        )

    navigation = (
        _series(
            "paper",
            "estimate",
            utc_ns,
            elapsed,
            paper,
            outcome=outcome,
            reset_trigger=trigger,
            anchor_reads=sum(t not in ("none", "") for t in trigger),
            anchor_reads_after_start=sum(t not in ("none", "", "initialization") for t in trigger),
            statistics=_quantiles(paper, 1.71, path),
            reset_error_m=before,
            sun_elevation_deg=sun,
            terrain=terrain,
            matched=np.where(imaging, rng.poisson(5, n), 0),
            drift_by_length=sweep(1.7, -0.05),
            description="the published planar odometry, re-anchored to the uploaded ephemeris",
        ),
        _series(
            "spherical",
            "estimate",
            utc_ns,
            elapsed,
            rounds,
            outcome=round_outcome,
            reset_trigger=round_trigger,
            anchor_reads=sum(t not in ("none", "") for t in round_trigger),
            anchor_reads_after_start=sum(t not in ("none", "", "initialization") for t in round_trigger),
            statistics=_quantiles(rounds, 0.014, path),
            reset_error_m=round_before,
            sun_elevation_deg=sun,
            terrain=terrain,
            matched=np.where(imaging, rng.poisson(5, n), 0),
            drift_by_length=sweep(0.05, -0.5),
            description="the same matcher with spherical back-projection",
        ),
        _series(
            "anchored",
            "estimate",
            utc_ns,
            elapsed,
            fix,
            sigma_rtn_m=sigma,
            outcome=fix_outcome,
            matched=matched,
            nis=nis,
            nis_dof=2 * matched,
            nees=nees,
            time_since_fix_s=age,
            sun_elevation_deg=sun,
            terrain=terrain,
            wrong_fixes=0,
            anchor_reads=0,
            anchor_reads_after_start=0,
            statistics=_quantiles(fix, 0.002, path),
            description="catalogue filter; never reads the anchor ephemeris",
        ),
        _series("Kepler", "baseline", utc_ns, elapsed, kepler, statistics=_quantiles(kepler, 0.04, path)),
        _series(
            "propagate only, degree 50",
            "baseline",
            utc_ns,
            elapsed,
            deg50,
            statistics=_quantiles(deg50, 0.003, path),
        ),
        _series(
            "snapshot fix",
            "baseline",
            utc_ns,
            elapsed,
            snapshot,
            statistics=_quantiles(snapshot, float("nan"), path),
        ),
    )

    frames = int(imaging.sum())
    bins = min(60, n)
    cut = np.linspace(int(utc_ns[0]) - half, int(utc_ns[-1]) + half, bins + 1).astype(np.int64)
    expected = np.histogram(utc_ns, cut)[0] * 4 + 1
    received = expected.copy()
    if bins > 20:
        received[bins // 2] = expected[bins // 2] // 3
    map_n = int(900 * max(1.0, hours / 2))
    pick = rng.integers(0, n, map_n)
    seen_often = rng.integers(1, 7, map_n)
    stripes = (
        128
        + 40 * np.sin(np.add.outer(np.arange(180) / 7.0, np.arange(360) / 11.0))
        + rng.normal(0, 12, (180, 360))
    )
    fast = utc_ns[:: max(1, n // 400)]
    k = len(fast)
    return PassReport(
        title="Observation window W-0042" if hours < 2 else "Day 221: twenty-four hours of windows",
        pass_id="2029-08-09-W0042",
        verdict="The catalogue filter held 51 m (median) without reading the anchor ephemeris once, five times better "
        "than propagating alone would have done by the end of a day; the published odometry drifted 1.7 % of path, "
        "as published.",
        verdict_level="met",
        generated_for="LINNA payload review",
        evidence_level="3",
        headline=(
            HeadlineFigure("Position error, anchored, median", 51.2, "m", "3-D, all samples, no alignment"),
            HeadlineFigure("Position error, anchored, 95 %", 148.0, "m", "3-D, all samples"),
            HeadlineFigure(
                "Odometry drift, paper mode", 1.71, "% of path", "at the instant before each reset"
            ),
            HeadlineFigure("Detector recall", 0.704, "", "5–30 km, precision 0.853", evidence_level="3"),
            HeadlineFigure("Packets lost", 9, "of 1 204", "one gap of 42 s"),
        ),
        provenance={
            "Payload build": "flight 0.1.0",
            "Model SHA-256": "7f0c" * 16,
            "Parameters SHA-256": "91ab" * 16,
            "Telemetry dictionary": "version 1, 3c1e5f02",
            "Seed": str(seed),
            "Gravity of truth": "GRGM1200A to degree 100",
            "Gravity of baseline": "LP165P to degree 50",
            "Attitude error model": "20 arcsec random, 10 arcsec fixed",
        },
        data_sources=(
            "LROC GLD100 terrain, 118 m/px, longitude 270–330° E",
            "LU1319381 crater catalogue",
            "GRAIL GRGM1200A gravity",
            "DE421 lunar orientation",
        ),
        span=TimeSpan(int(utc_ns[0]) - half, int(utc_ns[-1]) + half),
        accounting=FrameAccounting(
            expected=frames,
            acquired=frames - min(2, frames),
            lit=frames - min(2, frames),
            processed=frames - min(3, frames),
            with_detections=max(0, frames - 9),
            navigated=max(0, frames - 14),
            bad_image=min(1, frames),
            quality={"ok": max(frames - 3, 0), "dark": 1, "saturated": 0, "uniform": 0, "invalid": 0},
        ),
        packets=PacketAccounting(
            packets=1_195,
            lost=9,
            duplicates=4,
            conflicts=0,
            crc_errors=1,
            octets_skipped=3,
            frames=168,
            frames_bad=1,
            symbols_corrected=27,
            octets=214_872,
            receptions=(
                ReceptionQuality(
                    "madrid",
                    "mission",
                    False,
                    100,
                    99,
                    27,
                    2.5e-5,
                    1,
                    129_900,
                    0,
                    START_UTC_NS,
                    START_UTC_NS + 60,
                ),
                ReceptionQuality("", "proposed", True, 68, 68, 0, None, 0, 86_972, 3),
            ),
            by_apid={
                0x0A0: ApidAccounting("housekeeping", 149),
                0x0A1: ApidAccounting("detections", 145, 3, 1),
                0x0A2: ApidAccounting("navigation_state", 440, 4, 2),
                0x0A3: ApidAccounting("frame_outcome", 442, 2, 1, 0, 1),
                0x0A4: ApidAccounting("event", 12),
                0x0A5: ApidAccounting("time_report", 7),
            },
            completeness=CompletenessSeries(cut, expected, received),
        ),
        reference=reference,
        navigation=navigation,
        imaging_arcs=arcs,
        gaps=(TimeSpan(int(cut[bins // 2]), int(cut[bins // 2 + 1])),) if bins > 20 else (),
        detector=detector_score(seed),
        gallery=tuple(
            gallery_frame(seed + 10 * i, 20 * i + 3, int(utc_ns[min(n - 1, 20 * i + 3)]))
            for i in range(gallery)
        ),
        worst_frames=tuple(
            gallery_frame(seed + 500 + 10 * i, 12 * i + 5, int(utc_ns[min(n - 1, 12 * i + 5)]))
            for i in range(worst)
        ),
        craters=CraterMap(
            latitude[pick] + rng.normal(0.0, 1.1, map_n),
            (longitude[pick] + rng.normal(0.0, 1.1, map_n)) % 360.0,
            5_000.0 * rng.pareto(1.8, map_n) + 5_000.0,
            seen_often,
            rng.binomial(seen_often, 0.66),
            "LU1319381",
        ),
        payload_map=PayloadMap(
            mapped=64,
            mapped_again=17,
            used=12,
            pairs=230,
            pairs_of_all=4_100,
            catalogued=40,
            offset_m=rng.normal(0.0, 90.0, (40, 2)),
            sigma_m=np.full((40, 2), 90.0),
            median_offset_m=(4.0, -9.0, float("nan")),
            normalised_square=1.04,
            source="LU1319381",
        ),
        terrain=TerrainMap(
            np.clip(stripes, 0, 255).astype(np.uint8), 0.0, 360.0, -90.0, 90.0, "synthetic stripes"
        ),
        housekeeping=(
            HousekeepingParameter(
                "temperature", "°C", fast, 21.0 + 4.0 * np.sin(np.arange(k) / 40.0) + rng.normal(0, 0.2, k)
            ),
            HousekeepingParameter("bus_voltage", "V", fast, 12.1 + 0.05 * np.cos(np.arange(k) / 20.0)),
            HousekeepingParameter(
                "power", "W", fast, 3.2 + 0.8 * (np.abs(latitude[:: max(1, n // 400)]) <= 60)
            ),
            HousekeepingParameter("memory_used", "MiB", fast, 182.0 + np.cumsum(rng.random(k) * 0.02)),
            HousekeepingParameter("queue_depth", "", fast, rng.integers(0, 4, k).astype(float)),
            HousekeepingParameter("storage_used", "‰", fast, np.linspace(12, 31, k)),
        ),
        events=(
            PassEvent(int(utc_ns[0]), "info", "window_started", "observing"),
            PassEvent(int(utc_ns[n // 2]), "low", "image_rejected", "frame 74: dark"),
            PassEvent(int(utc_ns[-1]), "info", "window_ended", "147 frames"),
        ),
        truth_ledger=tuple(
            AnchorRead(name, int(utc_ns[i]), triggers[i], i)
            for name, triggers in (("paper", trigger), ("spherical", round_trigger))
            for i in range(n)
            if triggers[i] not in ("none", "")
        ),
        configuration={
            "camera": {"width_px": 512, "height_px": 512, "fov_deg": 120.0},
            "cadence": {"cadence_s": cadence_s, "light": "paper"},
            "matcher": {"tau_km_per_30s": 4.0, "minimum_pairs": 2, "coast_limit": 20, "time_gap_s": 60.0},
        },
        scenario_text='name = "gld100-window"\nseed = 7\n\n[camera]\nfov_deg = 120.0\n',
        remarks=(
            "The truth and the baseline use different gravity fields and different orientation objects.",
        ),
    )


def _regression_pass(i: int, rng: np.random.Generator) -> RegressionPass:
    recall, precision, median = (
        rng.normal(0.68, 0.05, 2),
        rng.normal(0.84, 0.03, 2),
        rng.lognormal(3.7, 0.2, 2),
    )
    pairs = ((float(pair[0]), float(pair[1])) for pair in (recall, precision, median))
    return RegressionPass(f"W-{i:04d}", 148, i if i % 3 else None, *pairs)


def _changed_track(i: int) -> ChangedTrack:
    sides = (gallery_frame(i, i, 0), gallery_frame(i + 9, i, 0))
    return ChangedTrack(f"W-{i:04d}", -12.5, 301.25, 7.5, 4, 3, 0, *sides)


def regression_report(seed: int = 12, count: int = 24) -> RegressionReport:
    """A candidate that is better on the whole and worse in a few passes."""
    rng = np.random.default_rng(seed)
    return RegressionReport(
        title="Build 0.2.0 against 0.1.0",
        regression_id="R-17",
        candidate="flight 0.2.0",
        baseline="flight 0.1.0",
        gates=(
            RegressionGate("median error, anchored", 45.0, 38.0, 50.0, "pass", "m", "", 0.1, 0.06, 3_552),
            RegressionGate("95 % error, anchored", 130.0, 121.0, 143.0, "pass", "m", "", 0.1, 0.09, 3_552),
            RegressionGate("recall, class 0", 0.71, 0.66, 0.69, "fail", "", "W-0007", 0.02, 0.015, 148),
        ),
        passes=tuple(_regression_pass(i, rng) for i in range(count)),
        craters=ChangedCraters(
            rng.uniform(-60, 60, 90),
            rng.uniform(-30, 30, 90),
            np.arange(90.0) % 4 - 2,
            np.ones(2),
            np.ones(2),
        ),
        changed_tracks=tuple(_changed_track(i) for i in range(3)),
        verdict="One gate failed: recall of the smallest class in W-0007 fell below its limit.",
        verdict_level="fail",
        evidence_level="3",
        headline=(
            HeadlineFigure("Gates failed", 1, "of 3"),
            HeadlineFigure("Median error", 38.0, "m", "was 45"),
            HeadlineFigure("95 % error", 121.0, "m", "was 130"),
            HeadlineFigure("Recall, class 0", 0.66, "", "was 0.71"),
            HeadlineFigure("Passes compared", count),
        ),
        provenance={"Candidate SHA-256": "ab12" * 16, "Baseline SHA-256": "cd34" * 16},
        data_sources=("24 archived passes",),
    )


def detector_report(seed: int = 13) -> DetectorReport:
    """A detector with everything that can be said of it."""
    rng = np.random.default_rng(seed)
    epoch = np.arange(1.0, 41.0)
    return DetectorReport(
        title="MobileNetV3-small with CenterNet head",
        model_id="model 7f0c7f0c",
        score=detector_score(seed),
        by_degradation=tuple(
            NamedScore(label, n, p, r, 1.2)
            for label, n, p, r in (
                ("fresh", 420, 0.91, 0.89),
                ("slightly degraded", 700, 0.88, 0.81),
                ("degraded", 690, 0.82, 0.64),
                ("ghost", 440, 0.60, 0.29),
            )
        ),
        by_source=(
            NamedScore("procedural Moon", 1_200, 0.86, 0.73, 1.2),
            NamedScore("real terrain", 1_053, 0.79, 0.55, 1.7),
        ),
        groups=(
            ScoreGroup(
                "By type of terrain",
                (
                    NamedScore("lowland", 612, 0.87, 0.43, 1.1, 0.93, 0.61),
                    NamedScore("upland", 1_641, 0.79, 0.38, 1.8, 0.88, 0.52),
                ),
                "Lowland: mean ground below −1 km.",
            ),
        ),
        sigma=(
            SigmaBin("all", 1_400, 0.92, 1.21, 0.691, 0.958),
            SigmaBin("14–20 km up", 210, 1.40, 1.33, 0.655, 0.941),
        ),
        training=(
            TrainingCurve("training loss", epoch, 3.0 * np.exp(-epoch / 12) + 0.4 + rng.normal(0, 0.03, 40)),
            TrainingCurve(
                "validation loss", epoch, 3.1 * np.exp(-epoch / 11) + 0.55 + rng.normal(0, 0.04, 40)
            ),
            TrainingCurve("validation F1", epoch, 0.78 - 0.6 * np.exp(-epoch / 8)),
        ),
        cost={"Median latency": "6.4 ms, one thread", "Model": "3.8 MB", "Peak memory": "122 MB"},
        gallery=tuple(gallery_frame(seed + 7 * i, i) for i in range(3)),
        verdict="Every class beats the paper in precision, recall and localisation on held-out procedural terrain.",
        verdict_level="partly met",
        evidence_level="2",
        headline=(
            HeadlineFigure("Precision", 0.853),
            HeadlineFigure("Recall", 0.704),
            HeadlineFigure("Localisation", 1.33, "px"),
            HeadlineFigure("Bias in the worst octant", 0.23, "px"),
            HeadlineFigure("Latency", 6.4, "ms", "one thread"),
        ),
        provenance={"Model SHA-256": "7f0c" * 16, "Data set": "D-3"},
        data_sources=("procedural Moon, seed 3",),
        configuration={"training": {"epochs": 40, "crop_px": 384, "batch": 8, "learning_rate": 0.0025}},
    )
