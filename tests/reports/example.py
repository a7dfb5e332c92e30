"""Seeded report values for tests: no emulator, no ground, only the shapes that a real pass has.

The orbit is a circle with an eccentric altitude profile, the errors have the magnitudes of simulations: two odometries
that walk from a reset at the start of each arc, a catalogue filter that coasts through the dark, two propagations and
a single-frame fix.
"""

import numpy as np
from numpy import cos, degrees, exp, nan, pi, sin
from numpy.linalg import norm
from numpy.random import default_rng

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
    Gate,
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

START_UTC_NS = 1_880_964_840_000_000_000  # 2029-08-09T10:14:00Z
RADIUS_M = 1_737_400.0
PERIOD_S = 111.20 * 60.0
FOCAL_PX = 147.80


def _unit_track(elapsed_s):
    """Unit position and direction of motion, (n, 3) each."""
    angle = np.radians(-62.0) + 2.0 * pi * elapsed_s[:, None] / PERIOD_S
    node, north = np.array([0.44, -0.90, 0.0]), np.array([0.03, 0.01, 1.0])
    return cos(angle) * node + sin(angle) * north, cos(angle) * north - sin(angle) * node


def _altitude_m(elapsed_s):
    angle = 2.0 * pi * elapsed_s / PERIOD_S
    return np.asarray(30_700.0 - 9_800.0 * cos(angle - 0.6) + 1_900.0 * sin(3.1 * angle))


def _geodetic(position_m):
    radius = norm(position_m, axis=-1)
    latitude = degrees(np.arcsin(position_m[:, 2] / radius))
    longitude = degrees(np.arctan2(position_m[:, 1], position_m[:, 0])) % 360.0
    return latitude, longitude, radius - RADIUS_M


def _quantiles(error_rtn_m, drift_percent, path_m):
    length = norm(error_rtn_m, axis=1)
    length = length[np.isfinite(length)]
    if not len(length):
        return NavigationStatistics()
    p50, p68, p95, p99 = (float(v) for v in np.quantile(length, (0.5, 0.68, 0.95, 0.99)))
    return NavigationStatistics(p50, p68, p95, p99, float(length.max()), drift_percent, float(length[-1]), path_m)


def _series(name, kind, utc_ns, elapsed_s, error_rtn_m, **more):
    unit, along = _unit_track(elapsed_s)
    cross = np.cross(unit, along)
    radius = RADIUS_M + _altitude_m(elapsed_s)
    position = unit * (radius + error_rtn_m[:, 0])[:, None]
    position = position + along * error_rtn_m[:, 1:2] + cross * error_rtn_m[:, 2:3]
    latitude, longitude, altitude = _geodetic(position)
    return NavigationSeries(name, kind, utc_ns, latitude, longitude, altitude, error_rtn_m, **more)


def _odometry(rng, imaging, drift_m):
    """Errors that walk from the start of each arc, with outcomes, reset triggers and errors before a reset."""
    n = len(imaging)
    starts = imaging & ~np.append(False, imaging[:-1])
    outcome = rng.choice(("multi", "single", "predicted", "missed", "rejected"), n, p=(0.8, 0.02, 0.15, 0.02, 0.01))
    trigger = np.where(np.cumsum(starts) == 1, "initialization", "time_gap")
    walked = np.cumsum(rng.normal(drift_m, drift_m, (n, 3)), axis=0)
    error = walked - walked[np.maximum.accumulate(np.where(starts, np.arange(n), 0))]
    before = np.where(starts & (trigger == "time_gap"), norm(drift_m) * 60.0, nan)
    error[~imaging] = nan
    resets = int(starts.sum())
    return {
        "error_rtn_m": error,
        "outcome": tuple(np.where(starts, "anchored", np.where(imaging, outcome, "")).tolist()),
        "reset_trigger": tuple(np.where(starts, trigger, "none").tolist()),
        "anchor_reads": resets,
        "anchor_reads_after_start": max(0, resets - 1),
        "reset_error_m": before,
        "matched": np.where(imaging, rng.poisson(5, n), 0),
    }


def _filter(rng, imaging, cadence_s):
    """Errors of a filter whose uncertainty grows with the time since its last fix."""
    n = len(imaging)
    pairs = rng.poisson(5.5, n) * imaging
    matched = np.where(pairs >= 3, pairs, 0)
    age = (np.arange(n) - np.maximum.accumulate(np.where(matched > 0, np.arange(n), 0))) * cadence_s
    sigma = np.array([18.0, 34.0, 24.0]) + age[:, None] * np.array([0.03, 0.11, 0.02])
    error = rng.normal(0.0, sigma)
    fixed = np.where(rng.random(n) > 0.02, "fixed", "refused")
    outcome = np.where(matched > 0, fixed, np.where(imaging, "coasted", "no_image"))
    return {
        "error_rtn_m": error, "sigma_rtn_m": sigma, "outcome": tuple(outcome.tolist()), "matched": matched,
        "nis": np.where(matched > 0, rng.chisquare(np.maximum(2 * matched, 1)), nan), "nis_dof": 2 * matched,
        "nees": np.sum((error / sigma) ** 2, axis=1), "time_since_fix_s": age, "wrong_fixes": 0, "anchor_reads": 0,
        "anchor_reads_after_start": 0,
    }  # fmt: skip


def crater_image(seed):
    """A gray frame of 512 by 512 pixels with shaded bowls, and their centres and diameters in pixels."""
    rng = default_rng(seed)
    gray = rng.normal(118.0, 5.0, (512, 512))
    u, v, diameter = rng.uniform(20, 492, 14), rng.uniform(20, 492, 14), rng.choice([15, 22, 30, 44, 70], 14)
    rows, columns = np.mgrid[0:512, 0:512]
    for x, y, d in zip(u, v, diameter, strict=True):
        dx, dy = (columns - x) / (d / 2), (rows - y) / (d / 2)
        gray -= 50.0 * np.where(np.hypot(dx, dy) < 1.0, dx * 0.35 - dy * 0.94, 0.0)
    return np.clip(gray, 0, 255).astype(np.uint8), (u, v, diameter.astype(np.float64))


def size_class(diameter_px):
    return np.array([3, 0, 1, 2])[np.digitize(diameter_px * 30.0 / FOCAL_PX, (5.0, 10.0, 15.0))]


def gallery_frame(seed, frame_number=1, utc_ns=None):
    image, (u, v, diameter) = crater_image(seed)
    rng = default_rng(seed + 1)
    seen = rng.random(len(u)) < 0.72
    false = int(rng.integers(0, 3))
    found_u, found_v, found_d = (
        np.append((one + rng.normal(0.0, 1.1, len(u)))[seen], rng.uniform(20, 490, false)) for one in (u, v, diameter)
    )
    return GalleryFrame(
        frame_number=frame_number, utc_ns=utc_ns, image=image, detection_u_px=found_u, detection_v_px=found_v,
        detection_diameter_px=found_d, detection_class=size_class(found_d), catalogue_u_px=u, catalogue_v_px=v,
        catalogue_diameter_px=diameter, catalogue_class=size_class(diameter), catalogue_matched=seen,
        detection_matched=np.arange(len(found_u)) < seen.sum(),
        caption=f"{seen.sum()} of {len(u)} found, {false} false",
    )  # fmt: skip


def detector_score(seed=3):
    rng = default_rng(seed)
    n = 2_400
    azimuth = rng.uniform(-45.0, 45.0, n) % 360.0
    u, v = rng.uniform(0, 511, (2, n))
    du, dv = rng.normal(0.0, 1.2, (2, n)) + 0.2 * np.array([sin(azimuth), -cos(azimuth)])
    threshold = np.linspace(0.05, 0.95, 46)
    curves = tuple(
        PrecisionRecallCurve(label, threshold, 1 - 0.2 * (1.35 - threshold) ** 2.2, best * (1 - threshold**3.2))
        for label, best in (("5–10 km", 0.79), ("10–15 km", 0.74), ("15–30 km", 0.86))
    )
    return DetectorScore(
        per_class=(
            ClassScore(0, "5–10 km", 1_642, 1_166, 206, 0.8499, 0.7101, 1.13),
            ClassScore(1, "10–15 km", 371, 234, 45, 0.8387, 0.6307, 1.57),
            ClassScore(2, "15–30 km", 240, 187, 23, 0.8905, 0.7792, 2.26),
        ),
        micro=ClassScore(-1, "all", 2_253, 1_587, 274, 0.8528, 0.7044, 1.33),
        method="One-to-one, same class, within the larger of 10 px and half the radius.",
        by_altitude_km=tuple(BinScore(a, a + 5, 30 * a, 0.79, 0.80 - 0.007 * a, 1.2) for a in range(15, 45, 5)),
        by_sun_elevation_deg=tuple(
            BinScore(e, e + 2, 420 - 18 * e, 0.8, 0.52 + 0.018 * e, 1.2) for e in range(5, 15, 2)
        ),
        curves=curves,
        calibration=tuple(CalibrationBin(s, s, int(540 - 500 * s)) for s in np.arange(0.35, 1.0, 0.1)),
        residuals=ResidualSeries(u, v, du, dv, azimuth, rng.uniform(8, 70, n)),
    )


def pass_report(seed=7, *, hours=37.1 / 60.0, cadence_s=15.0, gallery=6, worst=10):
    """A complete pass report; with ``hours=24`` a whole day of windows between 60 degrees south and north."""
    rng = default_rng(seed)
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
        TimeSpan(int(utc_ns[a]) - half, int(utc_ns[b - 1]) + half) for a, b in zip(edges[::2], edges[1::2], strict=True)
    )
    path = float(n * cadence_s * 1_636.0)
    sun = 10.0 + 4.0 * sin(elapsed / 300.0)
    terrain = tuple(np.where(np.abs(latitude) < 22, "mare", "highland"))

    paper = _odometry(rng, imaging, (55.0, 400.0, 130.0))
    rounds = _odometry(rng, imaging, (0.5, 2.2, 0.6))
    anchored = _filter(rng, imaging, cadence_s)
    seen = {"sun_elevation_deg": sun, "terrain": terrain}
    hours_in = (elapsed - elapsed[0]) / 3600.0
    wave = 2.0 * pi * elapsed / PERIOD_S
    growth = np.stack([1 - cos(wave), 1 + 0.35 * sin(wave), np.ones(n)], axis=1) * hours_in[:, None]
    snapshot = rng.normal(0.0, [95.0, 120.0, 118.0], (n, 3))
    snapshot[anchored["matched"] == 0] = nan
    lengths = np.array([100e3, 200e3, 500e3, 1e6, 2e6])

    def sweep(base, slope):
        return tuple(
            DriftSample(float(m), base * (m / 1e6) ** slope, 2.1 * base * (m / 1e6) ** slope, int(4e7 / m))
            for m in lengths
        )

    def flown(name, kind, error_rtn_m, drift_percent, **more):
        statistics = _quantiles(error_rtn_m, drift_percent, path)
        return _series(name, kind, utc_ns, elapsed, error_rtn_m, statistics=statistics, **more)

    planar = "the published planar odometry, re-anchored to the uploaded ephemeris"
    spherical = "the same matcher with spherical back-projection"
    catalogue = "catalogue filter; never reads the anchor ephemeris"
    navigation = (
        flown(
            "paper", "estimate", **paper, **seen, drift_percent=1.71, drift_by_length=sweep(1.7, -0.05),
            description=planar,
        ),
        flown(
            "spherical", "estimate", **rounds, **seen, drift_percent=0.014, drift_by_length=sweep(0.05, -0.5),
            description=spherical,
        ),
        flown("anchored", "estimate", **anchored, **seen, drift_percent=0.002, description=catalogue),
        flown("Kepler", "baseline", growth * (420.0, 2_050.0, 260.0), 0.04),
        flown("propagate only, degree 50", "baseline", growth * (24.0, 118.0, 22.0), 0.003),
        flown("snapshot fix", "baseline", snapshot, float("nan")),
    )  # fmt: skip

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
    stripes = 128 + 40 * sin(np.add.outer(np.arange(180) / 7.0, np.arange(360) / 11.0))
    fast = utc_ns[:: max(1, n // 400)]
    power_w = 3.2 + 0.8 * imaging[:: max(1, n // 400)]
    known = ReceptionQuality("madrid", "mission", 100, 99, 27, 2.5e-5, 1, 129_900, 0, START_UTC_NS, START_UTC_NS + 60)
    unknown = ReceptionQuality("", "default", 68, 68, 0, None, 0, 86_972, 3)
    accounting = FrameAccounting(
        expected=frames, acquired=max(0, frames - 2), lit=max(0, frames - 2), processed=max(0, frames - 3),
        with_detections=max(0, frames - 9), navigated=max(0, frames - 14), bad_image=min(1, frames),
        quality={"ok": max(0, frames - 3), "dark": 1},
    )  # fmt: skip
    packets = PacketAccounting(
        packets=1_195, lost=9, duplicates=4, crc_errors=1, octets_skipped=3, frames=168, frames_bad=1,
        symbols_corrected=27, octets=214_872, receptions=(known, unknown),
        by_apid={0x0A0: ApidAccounting("housekeeping", 149), 0x0A3: ApidAccounting("outcomes", 442, 2, 1, 0, 1)},
        completeness=CompletenessSeries(cut, expected, received),
    )  # fmt: skip
    payload_map = PayloadMap(
        mapped=64, mapped_again=17, used=12, pairs=230, pairs_of_all=4_100, catalogued=40,
        offset_m=rng.normal(0.0, 90.0, (40, 2)), sigma_m=np.full((40, 2), 90.0), normalised_square=1.04,
        median_offset_m=(4.0, -9.0, float("nan")), source="LU1319381",
    )  # fmt: skip
    return PassReport(
        title="Observation window W-0042" if hours < 2 else "Day 221: twenty-four hours of windows",
        pass_id="2029-08-09-W0042",
        verdict="The catalogue filter held 51 m (median) without reading the anchor ephemeris once.",
        verdict_level="met",
        generated_for="LINNA payload review",
        evidence_level="3",
        headline=(
            HeadlineFigure("Position error, anchored, median", 51.2, "m", "3-D, all samples, no alignment"),
            HeadlineFigure("Position error, anchored, 95 %", 148.0, "m", "3-D, all samples"),
            HeadlineFigure("Odometry drift, paper mode", 1.71, "% of path", "at the instant before a reset"),
            HeadlineFigure("Detector recall", 0.704, "", "5–30 km, precision 0.853", evidence_level="3"),
            HeadlineFigure("Packets lost", 9, "of 1 204", "one gap of 42 s"),
        ),
        provenance={
            "Payload build": "flight 0.1.0", "Model SHA-256": "7f0c" * 16, "Parameters SHA-256": "91ab" * 16,
            "Seed": str(seed),
        },
        data_sources=("LROC GLD100 terrain, 118 m/px, longitude 270–330° E", "LU1319381 crater catalogue"),
        span=TimeSpan(int(utc_ns[0]) - half, int(utc_ns[-1]) + half),
        accounting=accounting,
        packets=packets,
        reference=reference,
        navigation=navigation,
        imaging_arcs=arcs,
        gaps=(TimeSpan(int(cut[bins // 2]), int(cut[bins // 2 + 1])),) if bins > 20 else (),
        detector=detector_score(seed),
        gallery=tuple(
            gallery_frame(seed + 10 * i, 20 * i + 3, int(utc_ns[min(n - 1, 20 * i + 3)])) for i in range(gallery)
        ),
        worst_frames=tuple(
            gallery_frame(seed + 500 + 10 * i, 12 * i + 5, int(utc_ns[min(n - 1, 12 * i + 5)])) for i in range(worst)
        ),
        craters=CraterMap(
            latitude[pick] + rng.normal(0.0, 1.1, map_n), (longitude[pick] + rng.normal(0.0, 1.1, map_n)) % 360.0,
            5_000.0 * rng.pareto(1.8, map_n) + 5_000.0, seen_often, rng.binomial(seen_often, 0.66), "LU1319381",
        ),
        payload_map=payload_map,
        terrain=TerrainMap(stripes.astype(np.uint8), 0.0, 360.0, -90.0, 90.0, "synthetic stripes"),
        housekeeping=(
            HousekeepingParameter("temperature", "°C", fast, rng.normal(21.0, 0.2, len(fast))),
            HousekeepingParameter("power", "W", fast, power_w),
            HousekeepingParameter("queue_depth", "", fast, rng.integers(0, 4, len(fast)).astype(float)),
            HousekeepingParameter("storage_used", "‰", fast, np.linspace(12, 31, len(fast))),
        ),
        events=(
            PassEvent(int(utc_ns[0]), "info", "window_started", "observing"),
            PassEvent(int(utc_ns[n // 2]), "low", "image_rejected", "frame 74: dark"),
            PassEvent(int(utc_ns[-1]), "info", "window_ended", "147 frames"),
        ),
        truth_ledger=tuple(
            AnchorRead(name, int(utc_ns[i]), triggers[i], i)
            for name, triggers in (("paper", paper["reset_trigger"]), ("spherical", rounds["reset_trigger"]))
            for i in range(n)
            if triggers[i] != "none"
        ),
        configuration={
            "camera": {"width_px": 512, "height_px": 512, "fov_deg": 120.0},
            "cadence": {"cadence_s": cadence_s, "light": "paper"},
            "matcher": {"tau_km_per_30s": 4.0, "minimum_pairs": 2, "coast_limit": 20, "time_gap_s": 60.0},
        },
        scenario_text='name = "gld100-window"\nseed = 7\n\n[camera]\nfov_deg = 120.0\n',
        remarks=("The truth and the baseline use different gravity fields.",),
    )  # fmt: skip


def _regression_pass(i, rng):
    recall, precision, median = (tuple(one.tolist()) for one in rng.normal((0.68, 0.84, 40.0), 0.04, (2, 3)).T)
    return RegressionPass(f"W-{i:04d}", 148, i if i % 3 else None, recall, precision, median)


def _changed_track(i):
    sides = (gallery_frame(i, i, 0), gallery_frame(i + 9, i, 0))
    return ChangedTrack(f"W-{i:04d}", -12.5, 301.25, 7.5, 4, 3, 0, *sides)


def regression_report(seed=12, count=24):
    """A candidate that is better on the whole and worse in a few passes."""
    rng = default_rng(seed)
    return RegressionReport(
        title="Build 0.2.0 against 0.1.0",
        regression_id="R-17",
        candidate="flight 0.2.0",
        baseline="flight 0.1.0",
        gates=(
            Gate("median error, anchored", "pass", 45.0, 38.0, 5.0, 50.0, "m", resolution=0.1),
            Gate("95 % error, anchored", "pass", 130.0, 121.0, 13.0, 143.0, "m", resolution=0.1),
            Gate("recall, class 0", "fail", 0.71, 0.66, 0.02, 0.69, pass_id="W-0007", resolution=0.02),
        ),
        passes=tuple(_regression_pass(i, rng) for i in range(count)),
        craters=ChangedCraters(*rng.uniform(-30, 30, (2, 90)), np.arange(90.0) % 4 - 2, *np.ones((2, 2))),
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


def detector_report(seed=13):
    """A detector with everything that can be said of it."""
    epoch = np.arange(1.0, 41.0)
    kinds = (
        NamedScore("lowland", 612, 0.87, 0.43, 1.1, 0.93, 0.61),
        NamedScore("upland", 1_641, 0.79, 0.38, 1.8, 0.88, 0.52),
    )
    return DetectorReport(
        title="MobileNetV3-small with CenterNet head",
        model_id="model 7f0c7f0c",
        score=detector_score(seed),
        by_degradation=(NamedScore("fresh", 420, 0.91, 0.89, 1.2), NamedScore("ghost", 440, 0.60, 0.29, 1.2)),
        by_source=(
            NamedScore("procedural Moon", 1_200, 0.86, 0.73, 1.2),
            NamedScore("real terrain", 1_053, 0.79, 0.55, 1.7),
        ),
        groups=(ScoreGroup("By type of terrain", kinds, "Lowland: mean ground below −1 km."),),
        sigma=(
            SigmaBin("all", 1_400, 0.92, 1.21, 0.691, 0.958),
            SigmaBin("14–20 km up", 210, 1.40, 1.33, 0.655, 0.941),
        ),
        training=(
            TrainingCurve("training loss", epoch, 3.0 * exp(-epoch / 12) + 0.4),
            TrainingCurve("validation loss", epoch, 3.1 * exp(-epoch / 11) + 0.55),
            TrainingCurve("validation F1", epoch, 0.78 - 0.6 * exp(-epoch / 8)),
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
