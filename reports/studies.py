"""Plots of the orbit and camera studies, each saved as one picture (PNG, SVG or PDF by the ending of its name)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import FloatArray, IntArray
from reports.errors import ReportError
from reports.figures.canvas import TimeScale, thinned, time_axis
from reports.figures.theme import color, drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FORMATS = (".png", ".svg", ".pdf")
CLASS_NAMES = ("Class 0 (5-10 km)", "Class 1 (10-15 km)", "Class 2 (15-30 km)")
CLASS_EDGES_KM = (5.0, 10.0, 15.0, 30.0)
BIN_KM = 0.5


def save_fov_study(
    path: Path,
    fov_deg: FloatArray,
    probability_at_least: Mapping[int, FloatArray],
    threshold: float,
    needed: int,
    selected_fov_deg: float,
    caption: str,
) -> None:
    """Curves of the probability of at least n craters over the field of view, with the one selected."""
    with _sheet(path, 7.2, 4.4) as figure:
        axes = figure.add_axes((0.09, 0.21, 0.77, 0.68))
        styles = (("sky", "o", "-"), ("blue", "s", "-"), ("vermillion", "^", "-"), ("green", "D", "-"))
        for (n, values), (role, marker, line) in zip(probability_at_least.items(), styles, strict=False):
            axes.plot(fov_deg, values, line, color=color(role), marker=marker, markersize=4)
            name = f"at least {n} crater" + ("s" if n > 1 else "")
            axes.plot([], [], line, color=color(role), marker=marker, markersize=4, label=name)
        axes.axhline(threshold, color=color("muted"), linestyle=(0, (4, 2)), linewidth=0.9)
        axes.text(
            fov_deg[0], threshold + 0.012, f"{100 * threshold:g} %", color=color("muted"), fontsize="small"
        )
        if np.isfinite(selected_fov_deg):
            axes.axvline(selected_fov_deg, color=color("ink"), linewidth=0.9)
            axes.text(
                selected_fov_deg - 1.0,
                0.03,
                f"selected {selected_fov_deg:g}°",
                rotation=90,
                ha="right",
                va="bottom",
            )
        axes.set_ylim(0.0, 1.03)
        axes.set_yticks(np.arange(0.0, 1.01, 0.2), [f"{v:g} %" for v in range(0, 101, 20)])
        axes.set_xlabel("full field of view, degrees")
        axes.set_title(f"Probability of craters in the footprint; at least {needed} are needed")
        axes.legend(loc="lower right", bbox_to_anchor=(0.995, 0.02) if selected_fov_deg < 90 else None)
        _caption(figure, caption)


def save_class_histogram(path: Path, diameter_km: FloatArray, caption: str) -> None:
    """Histogram of crater diameters of 5 to 30 km in the three size classes, light to dark (the paper's Fig. 4)."""
    edges = np.arange(CLASS_EDGES_KM[0], CLASS_EDGES_KM[-1] + BIN_KM / 2, BIN_KM)
    counts, _ = np.histogram(diameter_km, edges)
    with _sheet(path, 7.2, 4.2) as figure:
        axes = figure.add_axes((0.11, 0.21, 0.85, 0.68))
        for name, low, high, role in zip(
            CLASS_NAMES, CLASS_EDGES_KM[:-1], CLASS_EDGES_KM[1:], ("silver", "gray2", "gray1"), strict=True
        ):
            mine = (edges[:-1] >= low - 1e-9) & (edges[:-1] < high - 1e-9)
            total = int(counts[mine].sum())
            axes.bar(
                edges[:-1][mine],
                counts[mine],
                BIN_KM * 0.92,
                align="edge",
                color=color(role),
                label=f"{name}: {total:,}".replace(",", " "),
            )
        if counts.any():
            axes.set_yscale("log")
            axes.set_ylim(bottom=max(0.8, 0.5 * float(counts.min())))
        axes.set_xlim(CLASS_EDGES_KM[0], CLASS_EDGES_KM[-1])
        axes.set_xticks([5, 10, 15, 20, 25, 30])
        axes.set_xlabel("diameter, km")
        axes.set_ylabel(f"craters per {BIN_KM:g} km")
        axes.set_title("Crater diameters by size class")
        axes.legend(loc="upper right")
        _caption(figure, caption)


def save_altitude_plot(
    path: Path,
    utc_ns: IntArray,
    altitude_km: FloatArray,
    latitude_deg: FloatArray,
    caption: str,
    event_utc_ns: Sequence[int] = (),
) -> None:
    """Altitude over time with any manoeuvres marked, and its distribution over time and latitude."""
    time = TimeScale(int(utc_ns[0]), int(utc_ns[-1]))
    low, mean, high = float(altitude_km.min()), float(altitude_km.mean()), float(altitude_km.max())
    with _sheet(path, 9.0, 5.6) as figure:
        over_time = figure.add_axes((0.07, 0.60, 0.86, 0.33))
        x, y = thinned(np.asarray(time.x(utc_ns), dtype=np.float64), altitude_km, 1500)
        over_time.plot(x, y, color=color("blue"), linewidth=0.5)
        for event in event_utc_ns:
            over_time.axvline(float(time.x(event)), color=color("vermillion"), linewidth=0.8)
        for value in (low, mean, high):
            over_time.axhline(value, color=color("ink"), linewidth=0.7, linestyle=(0, (4, 2)))
            over_time.text(
                1.008,
                value,
                f"{value:.1f} km",
                transform=over_time.get_yaxis_transform(),
                va="center",
                fontsize="small",
            )
        over_time.set_ylim(min(0.0, low) - 3.0, high + 5.0)
        time_axis(over_time, time)
        over_time.set_ylabel("altitude, km")
        title = "Altitude over the sphere of 1737.4 km: minimum, mean, maximum"
        over_time.set_title(title + ("; upright lines: manoeuvres" if len(event_utc_ns) else ""))
        share = figure.add_axes((0.07, 0.17, 0.36, 0.27))
        weights = np.full(len(altitude_km), 100.0 / len(altitude_km))
        share.hist(altitude_km, bins=40, weights=weights, color=color("blue"))
        share.set_xlabel("altitude, km")
        share.set_ylabel("share of states, %")
        share.set_title("Distribution")
        by_latitude = figure.add_axes((0.53, 0.17, 0.44, 0.27))
        low, high = (
            min(low, mean - 0.5),
            max(high, mean + 0.5),
        )  # an orbit without relief still needs a height
        cells, _, _ = np.histogram2d(
            latitude_deg, altitude_km, bins=(90, 48), range=((-90, 90), (low, high + 1e-6))
        )
        shown = np.where(cells > 0, np.log10(np.maximum(cells, 1)), np.nan).T
        by_latitude.imshow(
            shown,
            origin="lower",
            aspect="auto",
            extent=(-90, 90, low, high),
            cmap="cividis_r",
            interpolation="none",
        )
        by_latitude.grid(False)
        by_latitude.set_xticks(
            range(-90, 91, 30), [f"{abs(v)}°{'S' if v < 0 else 'N' if v else ''}" for v in range(-90, 91, 30)]
        )
        by_latitude.set_ylabel("altitude, km")
        by_latitude.set_title("By latitude (darker: more often)")
        _caption(figure, caption)


def save_difference_plot(
    path: Path, utc_ns: IntArray, position_rtn_m: FloatArray, names: tuple[str, str], caption: str
) -> None:
    """Radial, transverse and normal difference of two ephemerides over time."""
    time = TimeScale(int(utc_ns[0]), int(utc_ns[-1]))
    with _sheet(path, 9.0, 5.4) as figure:
        for row, (name, role) in enumerate(
            (("radial", "blue"), ("transverse", "vermillion"), ("normal", "green"))
        ):
            axes = figure.add_axes((0.10, 0.69 - 0.255 * row, 0.87, 0.225))
            x, y = thinned(np.asarray(time.x(utc_ns), dtype=np.float64), position_rtn_m[:, row], 1500)
            axes.plot(x, y, color=color(role), linewidth=0.9)
            axes.axhline(0.0, color=color("faint"), linewidth=0.7)
            axes.set_ylabel(f"{name}, m")
            time_axis(axes, time, labelled=row == 2)
            if row == 0:
                axes.set_title(f"{names[1]} minus {names[0]}")
        _caption(figure, caption)


@contextmanager
def _sheet(path: Path, width_in: float, height_in: float) -> Iterator[Figure]:
    if path.suffix.lower() not in FORMATS:
        raise ReportError(
            f"{path}: expected a picture name ending in {', '.join(FORMATS)}, found {path.suffix!r}"
        )
    import matplotlib
    from matplotlib.figure import Figure

    # Names inside an SVG are made from the salt: the same figures give the same octets.
    with drawing(), matplotlib.rc_context({"svg.hashsalt": path.stem}):
        figure = Figure(figsize=(width_in, height_in), facecolor="white")
        yield figure
        # No creation date, for the same reason.
        metadata = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix.lower(), {})
        part = path.with_name(f"{path.stem}.part{path.suffix}")
        try:
            figure.savefig(part, dpi=150, facecolor="white", metadata=metadata)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def _caption(figure: Figure, text: str) -> None:
    figure.text(0.012, 0.025, text, color=color("muted"), fontsize="small", va="bottom", wrap=True)
