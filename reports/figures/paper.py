"""Figures of the paper's orbit, catalogue and camera studies, and of its simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas
from reports.figures.gallery import draw_frame
from reports.figures.theme import color
from reports.figures.track_map import latitude_label
from reports.paper_values import FovCurves, PaperSession
from reports.statistics import error_3d_m, inside, reference_at
from reports.text import length_text, utc_text
from reports.values import ByteArray, GalleryFrame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CLASS_NAMES = ("Class 0 (5–10 km)", "Class 1 (10–15 km)", "Class 2 (15–30 km)")
_CLASS_EDGES_KM = (5.0, 10.0, 15.0, 30.0)
_CLASS_ROLES = ("silver", "gray2", "gray1")
_BIN_KM = 0.5
_FOV_STYLES = (("sky", "o"), ("blue", "s"), ("vermillion", "^"), ("green", "D"))


def draw_class_histogram(canvas: Canvas, diameter_km: FloatArray) -> None:
    """Histogram of crater diameters of 5 to 30 km in the three size classes, light to dark (paper, Fig. 4)."""
    axes = canvas.axes(0.85, 0.5, canvas.width_in - 1.1, canvas.height_in - 0.8)
    edges = np.arange(_CLASS_EDGES_KM[0], _CLASS_EDGES_KM[-1] + _BIN_KM / 2, _BIN_KM)
    counts, _ = np.histogram(diameter_km, edges)
    for k, name in enumerate(CLASS_NAMES):
        mine = (edges[:-1] >= _CLASS_EDGES_KM[k] - 1e-9) & (edges[:-1] < _CLASS_EDGES_KM[k + 1] - 1e-9)
        axes.bar(
            edges[:-1][mine], counts[mine], _BIN_KM * 0.92, align="edge", color=color(_CLASS_ROLES[k]),
            label=f"{name}: {int(counts[mine].sum()):,}",
        )  # fmt: skip
    if counts.any():
        axes.set_yscale("log")
    axes.set_xlim(_CLASS_EDGES_KM[0], _CLASS_EDGES_KM[-1])
    axes.set_xticks([5, 10, 15, 20, 25, 30])
    axes.set_xlabel("diameter, km")
    axes.set_title(f"craters per {_BIN_KM:g} km")
    axes.legend(loc="upper right", frameon=False)


def draw_fov_curves(canvas: Canvas, curves: FovCurves, threshold: float) -> None:
    """Probability of at least n craters in the footprint over the field of view, with the field selected."""
    axes = canvas.axes(0.85, 0.5, canvas.width_in - 1.1, canvas.height_in - 0.8)
    for (n, values), (role, marker) in zip(curves.probability_at_least.items(), _FOV_STYLES, strict=False):
        axes.plot(
            curves.fov_deg, values, "-", color=color(role), marker=marker, markersize=4.0,
            label=f"at least {n} crater{'s' if n > 1 else ''}",
        )  # fmt: skip
    axes.axhline(threshold, color=color("muted"), linestyle=(0, (4, 2)), linewidth=0.9)
    if np.isfinite(curves.selected_fov_deg):
        axes.axvline(curves.selected_fov_deg, color=color("ink"), linewidth=0.9)
    axes.set_ylim(0.0, 1.03)
    axes.set_yticks(np.arange(0.0, 1.01, 0.2), [f"{v:g} %" for v in range(0, 101, 20)])
    axes.set_xlabel("full field of view, degrees")
    axes.set_title("probability of craters in the footprint")
    axes.legend(loc="lower right", frameon=False)


def draw_image(canvas: Canvas, image: ByteArray) -> None:
    """One image over the whole canvas."""
    axes = canvas.axes(0.0, 0.0, canvas.width_in, canvas.height_in)
    axes.set_axis_off()
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    canvas.photo(axes, image, (0.0, 1.0, 0.0, 1.0))


def draw_simulator(canvas: Canvas, session: PaperSession, frame: GalleryFrame) -> None:
    """The simulator at one frame: image with detections, ground track, and the state of each estimator."""
    size = canvas.height_in
    sheet = canvas.axes(0.0, 0.0, canvas.width_in, canvas.height_in)
    sheet.set_axis_off()
    sheet.set_xlim(0.0, canvas.width_in)
    sheet.set_ylim(0.0, canvas.height_in)
    draw_frame(canvas, sheet, 0.0, 0.0, size, frame)
    left, map_height = size + 0.65, 1.75
    axes = canvas.axes(left, canvas.height_in - map_height - 0.25, canvas.width_in - left - 0.15, map_height)
    _ground_track(axes, session, frame)
    _state_lines(canvas, size + 0.2, canvas.height_in - map_height - 0.85, session, frame)


def _ground_track(axes: Axes, session: PaperSession, frame: GalleryFrame) -> None:
    track = session.track
    axes.set_xlim(0, 360)
    axes.set_ylim(-90, 90)
    axes.set_xticks(range(0, 361, 90), [f"{v}°" for v in range(0, 361, 90)])
    axes.set_yticks(range(-90, 91, 45), [latitude_label(v) for v in range(-90, 91, 45)])
    axes.set_title("ground track of the session; circle: this frame")
    lit = inside(track.utc_ns, session.arcs) if session.arcs else np.ones(len(track.utc_ns), dtype=np.bool_)
    axes.plot(
        track.longitude_deg[lit] % 360.0, track.latitude_deg[lit], ".", color=color("vermillion"),
        markersize=1.2, label="ground track",
    )  # fmt: skip
    if frame.utc_ns is not None:
        latitude, longitude, _ = reference_at(track, np.array([frame.utc_ns]))
        axes.plot(
            longitude % 360.0, latitude, "o", markerfacecolor="none", markeredgecolor=color("ink"),
            markersize=9.0,
        )  # fmt: skip


def _state_lines(canvas: Canvas, left: float, top: float, session: PaperSession, frame: GalleryFrame) -> None:
    if frame.utc_ns is None:
        return
    utc_ns = np.array([frame.utc_ns])
    latitude, longitude, altitude = (float(v[0]) for v in reference_at(session.track, utc_ns))
    lines = [("UTC", utc_text(frame.utc_ns)), ("reference", _place(latitude, longitude, altitude))]
    for one in session.series:
        k = int(np.argmin(np.abs(one.utc_ns - frame.utc_ns)))
        error = float(error_3d_m(one.error_rtn_m[k : k + 1])[0])
        place = _place(float(one.latitude_deg[k]), float(one.longitude_deg[k]), float(one.altitude_m[k]))
        lines.append((one.name, f"{place}; error {length_text(error)}; {one.outcome[k] if one.outcome else ''}"))
    for row, (name, text) in enumerate(lines):
        canvas.text(left, top - 0.22 * row, name, fontsize="small", weight="bold")
        canvas.text(left + 0.85, top - 0.22 * row, text, fontsize="small")


def _place(latitude_deg: float, longitude_deg: float, altitude_m: float) -> str:
    return f"{latitude_deg:+.3f}°, {longitude_deg % 360.0:.3f}° E, {altitude_m / 1e3:.2f} km"
