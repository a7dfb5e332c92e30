"""Position error, drift, altitude, consistency of the filters, and what the error depends on."""

import math
from functools import partial

import numpy as np

from reports.document import Block, Cell, Column, Heading, Picture, Table
from reports.figures import consistency, navigation
from reports.sections.common import PassView, role_of, slug
from reports.sections.summary import error_picture
from reports.statistics import containment, error_3d_m, inside, per_degree, quantiles
from reports.text import NOT_A_VALUE, count_text, number_text
from reports.values import NavigationSeries


def errors(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Position error")]
    if not view.with_error:
        blocks.append(view.no_error())
        return blocks
    zoom = navigation.zoom_span(view.time, report.imaging_arcs)
    if zoom is not None:
        blocks.append(error_picture(view, "error-hour", 3.1, zoom))
    arcs = report.imaging_arcs
    blocks.append(
        Picture(
            "distribution",
            "Cumulative distribution of the error. A curve further left is better; where it crosses 50 % is "
            "its median.",
            "Cumulative distribution of the 3-D error of every solution.",
            2.7,
            partial(navigation.draw_distribution, series=view.with_error, styles=view.styles, arcs=arcs),
        )
    )
    blocks.append(_arc_table(view))
    blocks += _budget_table(view)
    for one in view.estimates:
        if not np.isfinite(one.error_rtn_m).any():
            continue
        bounds = one.sigma_rtn_m is not None and np.isfinite(one.sigma_rtn_m).any()
        text = (
            "The gray band, with its edges, is three times the uncertainty that the estimator itself reports."
            if bounds
            else ("This estimator reports no uncertainty of its own.")
        )
        blocks.append(
            Picture(
                f"rtn-{slug(one.name)}",
                f"Error of {one.name} in the radial, along-track and cross-track directions of the reference "
                f"orbit. {text}",
                f"Radial, along-track and cross-track error of {one.name}.",
                3.6,
                partial(navigation.draw_rtn, one=one, styles=view.styles, time=view.time, arcs=arcs),
            )
        )
    return blocks


def _budget_table(view: PassView) -> list[Block]:
    """Return the table of the contribution of the reference to the observed errors."""
    rows = []
    for one in view.with_error:
        budget = one.error_budget
        if budget is not None:
            rest = budget.estimate_rms_m
            rows.append(
                (
                    Cell(one.name, swatch=role_of(view.styles[one.name][0])),
                    number_text(budget.observed_rms_m, 0),
                    number_text(budget.reference_rms_m, 0),
                    "below the reference" if math.isnan(rest) else number_text(rest, 0),
                )
            )
    if not rows:
        return []
    return [
        Table(
            "Error budget: root mean square of the 3-D error, m.",
            (Column("solution", numeric=False), Column("observed"), Column("reference"), Column("estimate")),
            tuple(rows),
            note="Observed² = estimate² + reference², with the 1-sigma error of the reference that the mission "
            "declares. The errors of odometry that is reset to the anchor ephemeris are not independent.",
        )
    ]


def _arc_table(view: PassView) -> Table:
    rows: list[tuple[Cell | str, ...]] = []
    for one in view.with_error:
        error = error_3d_m(one.error_rtn_m)
        lit = inside(one.utc_ns, view.report.imaging_arcs)
        first = True
        arcs = (("imaging", lit), ("between", ~lit)) if view.report.imaging_arcs else (("whole", ~lit),)
        for name, mask in arcs:
            finite = mask & np.isfinite(error)
            if not finite.any():
                continue
            p50, p95 = quantiles(error[mask], (0.5, 0.95))
            rms = [float(np.sqrt(np.mean(one.error_rtn_m[finite, i] ** 2))) for i in range(3)]
            held = [
                containment(one.error_rtn_m[mask, i], one.sigma_rtn_m[mask, i])
                if one.sigma_rtn_m is not None
                else math.nan
                for i in range(3)
            ]
            rows.append(
                (
                    Cell(one.name if first else "", swatch=role_of(view.styles[one.name][0]) if first else ""),
                    name,
                    count_text(int(finite.sum())),
                    number_text(p50, 0),
                    number_text(p95, 0),
                    *(number_text(v, 0) for v in rms),
                    *(NOT_A_VALUE if math.isnan(v) else number_text(100 * v, 1) for v in held),
                )
            )
            first = False
    return Table(
        "The same errors by direction in the reference orbit"
        f"{', inside imaging arcs and between them' if view.report.imaging_arcs else ''}.",
        (
            Column("solution", numeric=False),
            Column("arc", numeric=False),
            Column("samples"),
            Column("median", group="3-D error, m"),
            Column("95 %", group="3-D error, m"),
            Column("radial", group="rms error, m"),
            Column("along", group="rms error, m"),
            Column("cross", group="rms error, m"),
            Column("radial", group="within ±3σ, %"),
            Column("along", group="within ±3σ, %"),
            Column("cross", group="within ±3σ, %"),
        ),
        tuple(rows),
        note="A filter that knows its own error keeps 99.7 % of a Gaussian error within ±3σ.",
    )


def drift(view: PassView) -> list[Block]:
    report, odometry = view.report, view.odometry
    if not odometry:
        return []
    blocks: list[Block] = [Heading("Odometry: drift and resets")]
    track = report.reference
    placed = any(np.isfinite(s.latitude_deg).any() for s in odometry)
    if track is not None and len(track.utc_ns) and not placed:
        blocks.append(view.absent("error", "Error in latitude and longitude"))
    elif track is not None and len(track.utc_ns):
        spans = [("ground-error", view.time, "")]
        times = [utc_ns for utc_ns, _ in navigation.resets_of(odometry, view.time)]
        zoom = navigation.zoom_span(view.time, report.imaging_arcs, resets=times)
        if zoom is not None:
            spans.append(("ground-error-hour", zoom, " One hour of it."))
        for key, time, extra in spans:
            resets = len(navigation.resets_of(odometry, time))
            noun = "reset" if resets == 1 else "resets"
            blocks.append(
                Picture(
                    key,
                    "Accumulated error in latitude and longitude of the odometry, as lengths on the ground "
                    "(form of the paper's Fig. 8)."
                    f"{extra} It grows until the estimate is set back to the anchor ephemeris; "
                    f"{count_text(resets)} {noun} shown.",
                    f"Latitude and longitude error of the odometry over time, {resets} resets.",
                    3.7,
                    partial(
                        navigation.draw_ground_error,
                        series=odometry,
                        track=track,
                        styles=view.styles,
                        time=time,
                        arcs=report.imaging_arcs,
                    ),
                )
            )
    else:
        blocks.append(view.absent("reference", "Error in latitude and longitude"))
    swept = tuple(s for s in view.estimates if s.drift_by_length)
    reset = tuple(s for s in odometry if s.reset_error_m is not None and np.isfinite(s.reset_error_m).any())
    if swept or reset:
        shown = tuple(s for s in view.estimates if s in swept or s in reset)
        parts = []
        if swept:
            parts.append(
                "relative drift by the length of path over which it is taken (dots: median; tint: up to the "
                "95th percentile)"
            )
        if reset:
            parts.append("horizontal error at the instant before each reset")
        caption = "; ".join(parts)
        blocks.append(
            Picture(
                "drift",
                f"{caption[0].upper()}{caption[1:]}.",
                "Drift of the odometry.",
                2.6,
                partial(navigation.draw_drift, series=shown, styles=view.styles),
            )
        )
    if swept:
        blocks.append(_drift_table(swept))
    return blocks


def _drift_table(series: tuple[NavigationSeries, ...]) -> Table:
    lengths = sorted({d.path_length_m for s in series for d in s.drift_by_length})
    columns = [Column("path length", unit="km")]
    for one in series:
        columns += [Column("median", group=f"{one.name}, %"), Column("95 %", group=f"{one.name}, %")]
    rows = []
    for length in lengths:
        row: list[Cell | str] = [number_text(length / 1e3, 0)]
        for one in series:
            found = next((d for d in one.drift_by_length if d.path_length_m == length), None)
            row += (
                [number_text(found.median_percent, 3), number_text(found.p95_percent, 3)]
                if found
                else [NOT_A_VALUE] * 2
            )
        rows.append(tuple(row))
    return Table("Relative drift by path length, percent of path.", tuple(columns), tuple(rows))


def altitude(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Altitude")]
    track = report.reference
    if track is None or not len(track.utc_ns):
        blocks.append(view.absent("reference", "Altitude against the reference"))
        return blocks
    series = tuple(s for s in view.estimates if np.isfinite(s.altitude_m).any())
    spans = [("altitude", view.time, "")]
    times = [utc_ns for utc_ns, _ in navigation.resets_of(series, view.time)]
    zoom = navigation.zoom_span(view.time, report.imaging_arcs, resets=times)
    if zoom is not None:
        spans.append(("altitude-hour", zoom, " One hour of it."))
    low, high = quantiles(track.altitude_m, (0.0, 1.0))
    runs_from = (
        f"The reference runs from {low / 1e3:.1f} to {high / 1e3:.1f} km."
        if math.isfinite(low)
        else "The reference has no altitude."
    )
    what = (
        "Estimated altitude over the reference (wide gray line), and the magnitude of its error (form of the "
        "paper's Fig. 10)."
        if series
        else "Altitude of the reference; no estimate of it came down."
    )
    for key, time, extra in spans:
        blocks.append(
            Picture(
                key,
                f"{what}{extra} {runs_from}",
                f"Altitude over time. {runs_from}",
                3.9 if series else 2.4,
                partial(
                    navigation.draw_altitude,
                    series=series,
                    track=track,
                    styles=view.styles,
                    time=time,
                    arcs=report.imaging_arcs,
                ),
            )
        )
    return blocks


_ERRORS_IN_WORDS = {
    "NEES": "Normalised estimation error squared of the position",
    consistency.DIAGONAL: "Squared position errors over their variances, summed over the axes (no covariance "
    "came down),",
}


def consistency_section(view: PassView) -> list[Block]:
    series = [one for one in view.estimates if consistency.quantities(one)]
    if not series:
        if not view.estimates:
            return []
        return [Heading("Filter consistency"), view.absent("consistency", "NEES and NIS")]
    blocks: list[Block] = [Heading("Filter consistency")]
    for one in series:
        names = [name for name, _, _ in consistency.quantities(one)]
        errors = names[0] if names[0] != "NIS" else "NEES"
        blocks.append(
            Picture(
                f"consistency-{slug(one.name)}",
                f"{_ERRORS_IN_WORDS[errors]} and normalised innovation squared of "
                f"{one.name}, each "
                "divided by its degrees of "
                "freedom, so that one is right. Dots: samples; line: running mean; band: where 95 % of the "
                "samples of a consistent filter "
                "lie. NIS alone cannot see an error common to all craters of a frame.",
                f"{errors} and NIS of {one.name} over time.",
                3.4 if len(names) > 1 else 2.1,
                partial(
                    consistency.draw_consistency,
                    one=one,
                    styles=view.styles,
                    time=view.time,
                    arcs=view.report.imaging_arcs,
                ),
            )
        )
    rows: list[tuple[Cell | str, ...]] = []
    for one in series:
        for name, value, dof in consistency.quantities(one):
            count, mean, inside_bounds = per_degree(value, dof)
            rows.append(
                (
                    Cell(one.name, swatch=role_of(view.styles[one.name][0])),
                    name,
                    count_text(count),
                    number_text(mean, 2),
                    number_text(100.0 * inside_bounds, 1),
                )
            )
    if rows:
        blocks.append(
            Table(
                "Consistency over the pass.",
                (
                    Column("solution", numeric=False),
                    Column("quantity", numeric=False),
                    Column("samples"),
                    Column("mean", unit="per degree of freedom"),
                    Column("inside 95 % bounds", unit="% of samples"),
                ),
                tuple(rows),
            )
        )
    return blocks


def dependence(view: PassView) -> list[Block]:
    series = tuple(s for s in view.estimates if np.isfinite(s.error_rtn_m).any())
    track = view.report.reference
    found = {name for s in series for name, _, _ in consistency.dependences(s, track)}
    terrain = navigation.terrain_kinds(series)
    panels = len(found) + bool(terrain)
    if not panels or sum(len(s.utc_ns) for s in series) < 20:
        return []
    rows = -(-panels // 3)
    return [
        Heading("What the error depends on"),
        Picture(
            "dependence",
            "3-D error by altitude of the reference, light, number of craters matched, time since the last fix and "
            "terrain, as far as they are known. "
            "Dot: median of a bin; line above it: up to the 95th percentile. Bins with fewer than five "
            "samples are left out.",
            "Median and 95th percentile of the error in bins of each quantity.",
            0.86 + rows * 1.75 + (rows - 1) * 0.66,
            partial(consistency.draw_dependence, series=series, track=track, styles=view.styles),
        ),
    ]
