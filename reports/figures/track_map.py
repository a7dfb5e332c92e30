"""Maps of the ground track: the whole Moon, and strips along one pass with the craters seen and missed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import BoolArray, FloatArray
from reports.figures.canvas import Canvas
from reports.figures.theme import Styles, color
from reports.statistics import inside
from reports.values import CraterMap, NavigationSeries, TerrainMap, TimeSpan, TrackSeries

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_STRIPS = 4
_MOST_CRATERS = 220
_SILENT_STEPS = 5.0


def draw_globe(
    canvas: Canvas,
    track: TrackSeries,
    arcs: Sequence[TimeSpan],
    terrain: TerrainMap | None,
    span: TimeSpan | None = None,
) -> None:
    """The ground track on the whole Moon: imaging thick, the rest thin."""
    height = canvas.height_in - 0.62
    axes = canvas.axes(0.72, 0.50, min(2 * height, canvas.width_in - 0.87), height)
    axes.set_xlim(0, 360)
    axes.set_ylim(-90, 90)
    axes.set_xticks(range(0, 361, 30), [f"{v}°" for v in range(0, 361, 30)])
    axes.set_yticks(range(-90, 91, 30), [latitude_label(v) for v in range(-90, 91, 30)])
    draw_underlay(canvas, axes, terrain)
    axes.grid(True, axis="both")
    axes.set_xlabel("longitude, degrees east")
    axes.set_ylabel("latitude")
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    lit = inside(track.utc_ns, arcs) if arcs else np.ones(len(track.utc_ns), dtype=np.bool_)
    _line(axes, track, np.ones(len(lit), dtype=np.bool_), color("gray1"), 0.5)
    _line(axes, track, lit, color("vermillion"), 1.8 if len(arcs) < 4 else 0.9)
    if span is not None:
        one = lit & inside(track.utc_ns, (span,))
        _line(axes, track, one, color("blue"), 2.6)


def draw_strips(
    canvas: Canvas,
    track: TrackSeries,
    series: Sequence[NavigationSeries],
    styles: Styles,
    craters: CraterMap | None,
    terrain: TerrainMap | None,
    span: TimeSpan,
) -> None:
    """One pass cut into strips of equal time, read from left to right: craters, reference track and estimates."""
    keep = inside(track.utc_ns, (span,)) & np.isfinite(track.latitude_deg)
    latitude, longitude, utc_ns = track.latitude_deg[keep], track.longitude_deg[keep], track.utc_ns[keep]
    if not len(latitude):
        return
    gap, left, bottom = 0.52, 0.68, 0.50
    width = (canvas.width_in - left - 0.12 - gap * (_STRIPS - 1)) / _STRIPS
    height = canvas.height_in - bottom - 0.14
    parts = np.array_split(np.arange(len(latitude)), min(_STRIPS, len(latitude)))
    for i, part in enumerate(parts):
        axes = canvas.axes(left + i * (width + gap), bottom, width, height)
        low, high = float(latitude[part].min()), float(latitude[part].max())
        middle = float(_unwrapped(longitude[part], float(longitude[part[0]])).mean())
        tall = max(high - low, 4.0) * 1.04
        half = tall * width / height / 2 / max(np.cos(np.radians((low + high) / 2)), 0.3)
        axes.set_ylim((low + high - tall) / 2, (low + high + tall) / 2)
        axes.set_xlim(middle - half, middle + half)
        draw_underlay(canvas, axes, terrain, middle)
        axes.grid(False)
        step = _degree_step(2 * half, 3)
        ticks = np.arange(np.ceil((middle - half) / step), np.floor((middle + half) / step) + 1) * step
        axes.set_xticks(list(ticks), [f"{t % 360:g}°" for t in ticks])
        step = _degree_step(tall, 8)
        ticks = np.arange(np.ceil((low + high - tall) / 2 / step), np.floor((low + high + tall) / 2 / step) + 1) * step
        axes.set_yticks(list(ticks), [latitude_label(t) for t in ticks])
        if craters is not None:
            _craters(axes, craters, middle)
        for one in series:
            inside_time = (one.utc_ns >= utc_ns[part[0]]) & (one.utc_ns <= utc_ns[part[-1]])
            tint, dashes = styles[one.name]
            axes.plot(
                _unwrapped(one.longitude_deg[inside_time], middle),
                one.latitude_deg[inside_time],
                color=tint,
                linestyle=dashes,
                linewidth=1.3,
            )
        axes.plot(
            _unwrapped(longitude[part], middle),
            latitude[part],
            color=color("ink"),
            linewidth=1.0,
            linestyle=(0, (5, 2)),
        )
        for side in ("top", "right"):
            axes.spines[side].set_visible(True)
        if i == 0:
            axes.set_ylabel("latitude")
            axes.set_xlabel("longitude, degrees east", loc="left")


def _craters(axes: Axes, craters: CraterMap, middle: float) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    west, east = axes.get_xlim()
    south, north = axes.get_ylim()
    longitude = _unwrapped(craters.longitude_deg, middle)
    near = (longitude > west) & (longitude < east) & (craters.latitude_deg > south) & (craters.latitude_deg < north)
    found = _found(craters)
    angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    for mask, role in ((near & ~found, "orange"), (near & found, "blue")):
        index = np.flatnonzero(mask)[np.argsort(-craters.diameter_m[mask])][:_MOST_CRATERS]
        radius = np.degrees(craters.diameter_m[index] / 2 / 1_737_400.0)[:, None]
        wide = radius / np.maximum(np.cos(np.radians(craters.latitude_deg[index])), 0.1)[:, None]
        x = longitude[index][:, None] + wide * np.cos(angle)
        y = craters.latitude_deg[index][:, None] + radius * np.sin(angle)
        disks = Path.make_compound_path_from_polys(np.stack([x, y], axis=-1))
        inside = (color(role), 0.25) if role == "blue" else "none"
        axes.add_artist(PathPatch(disks, facecolor=inside, edgecolor=color(role), linewidth=0.9))


def _found(craters: CraterMap) -> BoolArray:
    if craters.detected is None:
        return np.zeros(len(craters.latitude_deg), dtype=np.bool_)
    return np.asarray(craters.detected > 0)


def _line(axes: Axes, track: TrackSeries, keep: BoolArray, tint: str, width: float) -> None:
    longitude = np.where(keep, track.longitude_deg % 360.0, np.nan)
    latitude = np.where(keep, track.latitude_deg, np.nan)
    step = np.diff(track.utc_ns, prepend=track.utc_ns[:1])
    silent = step > _SILENT_STEPS * float(np.median(step[1:])) if len(step) > 1 else np.zeros(len(step), np.bool_)
    # No line over the edge of the map, and none through places that nobody sampled.
    jump = (np.abs(np.diff(longitude, prepend=longitude[:1])) > 180.0) | silent
    axes.plot(
        np.insert(longitude, np.flatnonzero(jump), np.nan),
        np.insert(latitude, np.flatnonzero(jump), np.nan),
        color=tint,
        linewidth=width,
        solid_capstyle="butt",
    )


def draw_underlay(canvas: Canvas, axes: Axes, terrain: TerrainMap | None, middle: float = 180.0) -> None:
    """The shaded relief, faint, where it lies under the map."""
    if terrain is None or terrain.image.size == 0:
        return
    west, east = axes.get_xlim()
    south, north = axes.get_ylim()
    rows, columns = terrain.image.shape[:2]
    turn = round((middle - (terrain.west_deg + terrain.east_deg) / 2) / 360.0) * 360.0
    left, right = terrain.west_deg + turn, terrain.east_deg + turn
    first = int(np.clip(np.floor((west - left) / (right - left) * columns), 0, columns))
    last = int(np.clip(np.ceil((east - left) / (right - left) * columns), 0, columns))
    top = int(np.clip(np.floor((terrain.north_deg - north) / (terrain.north_deg - terrain.south_deg) * rows), 0, rows))
    base = int(np.clip(np.ceil((terrain.north_deg - south) / (terrain.north_deg - terrain.south_deg) * rows), 0, rows))
    if last <= first or base <= top:
        return
    step = (right - left) / columns
    down = (terrain.north_deg - terrain.south_deg) / rows
    box = (left + first * step, left + last * step, terrain.north_deg - base * down, terrain.north_deg - top * down)
    canvas.photo(axes, terrain.image[top:base, first:last], box, 0.5)


def _unwrapped(longitude_deg: FloatArray, middle: float) -> FloatArray:
    return np.asarray((longitude_deg - middle + 180.0) % 360.0 - 180.0 + middle)


def _degree_step(extent: float, most: int) -> float:
    return next((s for s in (0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0) if extent / s <= most), 60.0)


def latitude_label(value: float) -> str:
    """A latitude as a map prints it: 30° N."""
    if abs(value) < 1e-9:
        return "0°"
    return f"{abs(value):g}° {'N' if value > 0 else 'S'}"
