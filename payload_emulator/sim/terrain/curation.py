"""The anchoring catalogue, made on the ground: which craters of a list can be seen, and where exactly their rims are.

Each crater is looked up on a height raster. Profiles from its centre outwards give the rim azimuth by azimuth; a
circle through those points gives centre and radius, their scatter the uncertainty, heights along the circle the rim
height. Craters without a rim worth the name are dropped, and so are those with a neighbour that could be taken for
them. List and raster differ by some tens of metres that change slowly from place to place (`registration`): centres lie
where the raster shows the rims, and a rim counts as that of a listed crater if it lies near the registered centre.

Frame: mean-Earth (ME), as the raster is georeferenced. Heights are metres above the sphere of the maps.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.plausible import CRATER_DEPTH_RATIO, LISTED_DEPTH_RATIO, Limit
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain.registration import Registration, Rims, clear_rims, fit_registration
from tmtc.dictionary.tables import CatalogueTable

Mask = BoolArray

REASONS = ("size", "no_terrain", "shallow", "no_rim", "moved", "confusable")
"""Reasons for dropping a crater, in the order of the tests."""

# Rims measured on coarse rasters lie low: 44 m (5 to 30 km) and 30 m (3 to 30 km) at 16 px/deg compared with 64 px/deg,
# 106 m at 4 px/deg (measured on GLD100); taken as linear in the logarithm of the resolution, zero from 64 px/deg on.
_FULL_RESOLUTION_PPD = 64.0
_LOW_RIM_M_PER_HALVING = 20.0
REGISTERED_M = (4_000.0, 16_000.0)
"""Diameters of craters that a registration is fitted to: smaller ones are soft on rasters of 128 px/deg, and listed
centres of larger ones are 500 m off."""

_BLOCK_DEG = 5.0
_MANY = 10  # craters from which their median depth decides
_AZIMUTHS = 48
_FLOOR = (0.1, 0.22, 0.34)
_RIM = np.arange(0.70, 1.3601, 0.03)
_OUTER = 1.6
# Rim points this far apart in azimuth err independently: fields of ejecta and later craters span about 30 degrees.
_INDEPENDENT = 12


class Heights(Protocol):
    """A height raster in longitude and latitude."""

    pixels_per_degree: float

    def window(self, south: float, north: float, west: float, east: float) -> tuple[FloatArray, float, float]:
        """Heights (rows, columns), north first, NaN where there are none; latitude and longitude of pixel (0, 0)."""
        ...


@dataclass(frozen=True, slots=True)
class Region:
    """Part of the Moon, degrees; longitudes may run over 360."""

    west_deg: float = 0.0
    east_deg: float = 360.0
    south_deg: float = -90.0
    north_deg: float = 90.0

    def holds(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Mask:
        latitude = np.degrees(latitude_rad)
        inside = (latitude >= self.south_deg) & (latitude <= self.north_deg)
        east = np.mod(np.degrees(longitude_rad) - self.west_deg, 360.0)
        return np.asarray(inside & (east <= self.east_deg - self.west_deg))


@dataclass(frozen=True, slots=True)
class CurationRules:
    """Conditions for a crater to be kept.

    Attributes
    ----------
    smallest_m, largest_m
        Diameters.
    depth_ratio
        Least depth over diameter, as measured on the raster: shallower ones can hardly be seen by anyone.
    rim_share
        Least share of azimuths that show a rim.
    rim_scatter
        Largest scatter of rim points about the circle, over its radius.
    shift_ratio
        Largest shift of the centre from the registered one over the radius: more means another crater was fitted.
    confusable_distance, confusable_log_diameter
        A neighbour closer than this share of the diameter and of a size within this factor could be taken for it;
        the deeper of the two stays.
    centre_sigma_m
        Least uncertainty of a centre: a twelfth of a pixel of 128 px/deg.
    height_sigma_m
        Least uncertainty of a rim height.
    """

    smallest_m: float = 3_000.0
    largest_m: float = 30_000.0
    depth_ratio: float = 0.03
    rim_share: float = 0.5
    rim_scatter: float = 0.18
    shift_ratio: float = 0.35
    confusable_distance: float = 0.6
    confusable_log_diameter: float = 0.4
    centre_sigma_m: float = 20.0
    height_sigma_m: float = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Curation:
    """The anchoring catalogue and how it came about.

    Attributes
    ----------
    table
        Kept craters with uncertainties east, north, up.
    depth_m
        Measured depths of the kept, shape (n,).
    dropped
        Number by reason.
    registration
        Shift from the list to the raster, by place.
    offset_m, offset_sigma_m
        Mean of that shift over the kept craters, east and north, and of its standard deviation; zero without any.
    shift_m
        Shift of each kept centre from the registered one, east and north, shape (n, 2).
    height_correction_m
        Added to every rim height for the raster's resolution.
    """

    table: CatalogueTable
    depth_m: FloatArray
    dropped: dict[str, int]
    registration: Registration
    offset_m: tuple[float, float]
    offset_sigma_m: float
    shift_m: FloatArray
    height_correction_m: float

    def catalogue(self, source: str) -> CraterCatalogue:
        """Return the kept craters as a catalogue (which has no room for the uncertainties)."""
        table = self.table
        return CraterCatalogue(
            table.ids,
            table.latitude_rad,
            np.mod(table.longitude_rad, 2.0 * math.pi),
            table.diameter_m,
            table.rim_height_m,
            self.depth_m,
            source,
            np.ones(len(table), dtype=np.bool_),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Measured craters, arrays of one length; NaN where the raster has nothing."""

    east_m: FloatArray
    north_m: FloatArray
    radius_m: FloatArray
    rim_m: FloatArray
    depth_m: FloatArray
    scatter_m: FloatArray
    share: FloatArray
    sigma_rim_m: FloatArray


def curate(
    catalogue: CraterCatalogue, heights: Heights, region: Region = Region(), rules: CurationRules = CurationRules()
) -> Curation:
    """Return the anchoring catalogue of a region.

    Raises
    ------
    TerrainError
        The raster covers none of the craters.
    """
    inside = region.holds(catalogue.latitude_rad, catalogue.longitude_rad)
    sized = inside & (catalogue.diameter_m >= rules.smallest_m) & (catalogue.diameter_m <= rules.largest_m)
    dropped = dict.fromkeys(REASONS, 0)
    dropped["size"] = int(np.count_nonzero(inside & ~sized))
    craters = catalogue.select(sized)
    fit = _measured(craters, heights)
    known = np.isfinite(fit.rim_m)
    if not known.any():
        raise TerrainError(
            f"terrain of the curation: expected heights under some of {len(craters)} craters, found none"
        )
    keep = known
    dropped["no_terrain"] = int(np.count_nonzero(~known))
    diameter_m = 2.0 * fit.radius_m
    with np.errstate(invalid="ignore"):
        tests = (
            ("shallow", fit.depth_m >= rules.depth_ratio * diameter_m),
            ("no_rim", (fit.share >= rules.rim_share) & (fit.scatter_m <= rules.rim_scatter * fit.radius_m)),
        )
    for reason, passed in tests:
        dropped[reason] = int(np.count_nonzero(keep & ~passed))
        keep = keep & passed
    registration = fit_registration(_clear(craters, fit))
    expected, expected_sigma_m = registration.at(craters.latitude_rad, craters.longitude_rad)
    east, north = fit.east_m - expected[:, 0], fit.north_m - expected[:, 1]
    near = np.hypot(east, north) <= rules.shift_ratio * fit.radius_m
    dropped["moved"] = int(np.count_nonzero(keep & ~near))
    keep = keep & near
    latitude = craters.latitude_rad + fit.north_m / MOON_RADIUS_M
    longitude = craters.longitude_rad + fit.east_m / (MOON_RADIUS_M * np.cos(craters.latitude_rad))
    rows = np.flatnonzero(keep)
    clear = _unmistakable(latitude[rows], longitude[rows], diameter_m[rows], fit.depth_m[rows], rules)
    dropped["confusable"] = int(np.count_nonzero(~clear))
    rows = rows[clear]
    halvings = math.log2(_FULL_RESOLUTION_PPD / heights.pixels_per_degree)
    correction_m = _LOW_RIM_M_PER_HALVING * max(0.0, halvings)
    centre_sigma = fit.scatter_m[rows] * math.sqrt(2.0 / _INDEPENDENT)
    centre_sigma = np.hypot(centre_sigma, rules.centre_sigma_m)
    up_sigma = np.hypot(fit.sigma_rim_m[rows], rules.height_sigma_m + 0.5 * correction_m)
    table = CatalogueTable(
        craters.ids[rows],
        latitude[rows],
        longitude[rows],
        diameter_m[rows],
        fit.rim_m[rows] + correction_m,
        np.stack([centre_sigma, centre_sigma, up_sigma], axis=1),
    )
    return Curation(
        table,
        fit.depth_m[rows],
        dropped,
        registration,
        (float(expected[rows, 0].mean()), float(expected[rows, 1].mean())) if rows.size else (0.0, 0.0),
        float(np.nanmean(expected_sigma_m[rows])) if rows.size else 0.0,
        np.stack([east[rows], north[rows]], axis=1),
        correction_m,
    )


def measured_rims(catalogue: CraterCatalogue, heights: Heights, region: Region) -> Rims:
    """Return the clear rims of a region with their listed craters, of the sizes whose centres are known best."""
    chosen = region.holds(catalogue.latitude_rad, catalogue.longitude_rad)
    chosen &= (catalogue.diameter_m >= REGISTERED_M[0]) & (catalogue.diameter_m <= REGISTERED_M[1])
    craters = catalogue.select(chosen)
    return _clear(craters, _measured(craters, heights))


def _clear(craters: CraterCatalogue, fit: _Fit) -> Rims:
    return clear_rims(craters, fit.east_m, fit.north_m, fit.radius_m, fit.depth_m, fit.scatter_m, fit.share)


def _measured(craters: CraterCatalogue, heights: Heights) -> _Fit:
    """Return fits of all craters, made block by block of the raster."""
    columns = np.full((8, len(craters)), np.nan)
    for rows, window in _blocks(craters, heights):
        columns[:, rows] = _fitted(craters.select(rows), heights.pixels_per_degree, *window)
    fit = _Fit(*columns)
    _require_depths(craters, fit)
    return fit


def _require_depths(craters: CraterCatalogue, fit: _Fit) -> None:
    """Refuse heights on which craters are deeper than any, or otherwise than listed."""
    with np.errstate(divide="ignore", invalid="ignore"):
        over_listed = fit.depth_m / craters.depth_m
    for share, of, limit in (
        (0.5 * fit.depth_m / fit.radius_m, "their diameters", Limit(-1.0, CRATER_DEPTH_RATIO.high, "")),
        (over_listed, "the depths in the list", LISTED_DEPTH_RATIO),
    ):
        known = share[np.isfinite(share)]
        if known.size >= _MANY and not limit.holds(np.median(known)):
            raise TerrainError(
                f"terrain of the curation: expected depths of {limit.high:g} times {of} at the most and "
                f"{max(limit.low, 0.0):g} at the least (median), found {np.median(known):.2f} in {known.size} craters: "
                "another scale of heights?"
            )


def _blocks(craters: CraterCatalogue, heights: Heights) -> Iterator[tuple[IntArray, tuple[FloatArray, float, float]]]:
    """Yield rows of craters that lie in one block, with the heights about them."""
    latitude = np.degrees(craters.latitude_rad)
    longitude = np.mod(np.degrees(craters.longitude_rad), 360.0)
    usable = np.abs(latitude) < 80.0
    key = np.floor(latitude / _BLOCK_DEG) * 1_000.0 + np.floor(longitude / _BLOCK_DEG)
    for block in np.unique(key[usable]):
        rows = np.flatnonzero(usable & (key == block))
        reach = 1.2 * _OUTER * 0.5 * float(craters.diameter_m[rows].max())
        spare = math.degrees(reach / MOON_RADIUS_M) + 3.0 / heights.pixels_per_degree
        wide = spare / math.cos(math.radians(float(np.abs(latitude[rows]).max())))
        window = heights.window(
            float(latitude[rows].min()) - spare,
            float(latitude[rows].max()) + spare,
            float(longitude[rows].min()) - wide,
            float(longitude[rows].max()) + wide,
        )
        if np.isfinite(window[0]).any():
            yield rows.astype(np.int64), window


def _fitted(craters: CraterCatalogue, ppd: float, window: FloatArray, top_deg: float, left_deg: float) -> FloatArray:
    """Return east, north, radius, rim height, depth, scatter, share of azimuths, sigma of the rim height, (8, n)."""
    count = len(craters)
    latitude, longitude = np.degrees(craters.latitude_rad), np.degrees(craters.longitude_rad)
    longitude = left_deg + np.mod(longitude - left_deg, 360.0)
    metres = math.radians(1.0) * MOON_RADIUS_M
    east, north = np.zeros(count), np.zeros(count)
    radius = 0.5 * craters.diameter_m
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * (2.0 * math.pi / _AZIMUTHS)
    sine, cosine = np.sin(azimuth), np.cos(azimuth)

    def sample(at: FloatArray) -> FloatArray:
        """Heights at distances (n, k) from the centres along all azimuths, shape (n, azimuths, k)."""
        x = east[:, None, None] + at[:, None, :] * sine[None, :, None]
        y = north[:, None, None] + at[:, None, :] * cosine[None, :, None]
        lat = latitude[:, None, None] + y / metres
        lon = longitude[:, None, None] + x / (metres * np.cos(np.radians(latitude))[:, None, None])
        return _bilinear(window, (top_deg - lat) * ppd, (lon - left_deg) * ppd)

    for _ in range(3):
        outer = sample(_OUTER * radius[:, None])[:, :, 0]
        # The regional slope: a plane through the ring outside.
        tilt_east, tilt_north = 2.0 * (outer * sine).mean(axis=1), 2.0 * (outer * cosine).mean(axis=1)
        at = radius[:, None] * _RIM
        profile = sample(at)
        level = (tilt_east[:, None] * sine + tilt_north[:, None] * cosine)[:, :, None] * (_RIM / _OUTER)
        points, seen = _rim_points(profile - level)
        centre_east, centre_north, size, scatter, share = _circle(points, seen, sine, cosine)
        good = np.isfinite(size)
        limit = 0.5 * radius
        with np.errstate(invalid="ignore"):
            good &= np.hypot(centre_east, centre_north) * radius < limit
        east = np.where(good, east + centre_east * radius, east)
        north = np.where(good, north + centre_north * radius, north)
        scatter_m = np.where(good, scatter * radius, np.inf)
        radius = np.where(good, radius * size, radius)
    around = sample(radius[:, None])[:, :, 0]
    rim = around.mean(axis=1)
    rings = sample(radius[:, None] * np.array(_FLOOR)).mean(axis=1)
    # Rings stand for equal-width annuli of the inner 0.4 radius: weights are their areas.
    floor = (rings @ np.array(_FLOOR)) / sum(_FLOOR)
    sigma_rim = around.std(axis=1) / math.sqrt(_INDEPENDENT)
    return np.stack([east, north, radius, rim, rim - floor, scatter_m, share, sigma_rim])


def _rim_points(profile: FloatArray) -> tuple[FloatArray, Mask]:
    """Return where along profiles (n, azimuths, k) the crest lies, over the assumed radius, and whether it does."""
    best = np.argmax(np.nan_to_num(profile, nan=-np.inf), axis=2)
    inner = np.clip(best, 1, profile.shape[2] - 2)[..., None]
    before = np.take_along_axis(profile, inner - 1, axis=2)[..., 0]
    middle = np.take_along_axis(profile, inner, axis=2)[..., 0]
    after = np.take_along_axis(profile, inner + 1, axis=2)[..., 0]
    curve = before - 2.0 * middle + after
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.clip(0.5 * (before - after) / curve, -1.0, 1.0)
    seen = (best > 0) & (best < profile.shape[2] - 1) & (curve < 0.0)
    return _RIM[inner[..., 0]] + np.nan_to_num(step) * (_RIM[1] - _RIM[0]), seen


def _circle(
    points: FloatArray, seen: Mask, sine: FloatArray, cosine: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return centre east, north, radius, scatter (all over the radius assumed) and share of azimuths used, (n,).

    Least squares of r = R + e sin + n cos, with points weighted down by their distance (Cauchy, scale from the median).
    """
    design = np.stack([sine, cosine, np.ones_like(sine)], axis=1)
    weight = seen.astype(np.float64)
    share = weight.mean(axis=1)
    answer = np.full((points.shape[0], 3), np.nan)
    scatter = np.full(points.shape[0], np.nan)
    enough = np.flatnonzero(share >= 0.3)
    if enough.size:
        r, w = points[enough], weight[enough]
        for _ in range(5):
            normal = np.einsum("na,ai,aj->nij", w, design, design) + 1e-6 * np.eye(3)
            right = np.einsum("na,ai,na->ni", w, design, r)
            solution = np.linalg.solve(normal, right[..., None])[..., 0]
            left = r - solution @ design.T
            spread = 1.4826 * np.median(np.where(seen[enough], np.abs(left), np.nan_to_num(left)), axis=1)
            scale = np.maximum(spread, 0.01)[:, None]
            w = weight[enough] / (1.0 + (left / (1.5 * scale)) ** 2)
        answer[enough] = solution
        scatter[enough] = np.sqrt((w * left**2).sum(axis=1) / np.maximum(w.sum(axis=1), 1e-9))
    return answer[:, 0], answer[:, 1], answer[:, 2], scatter, share


def _unmistakable(
    latitude: FloatArray, longitude: FloatArray, diameter: FloatArray, depth: FloatArray, rules: CurationRules
) -> Mask:
    """Return which craters have no deeper neighbour of their size on top of them."""
    clear = np.ones(latitude.size, dtype=np.bool_)
    order = np.argsort(latitude, kind="stable")
    reach = rules.confusable_distance * float(diameter.max(initial=0.0)) / MOON_RADIUS_M
    last = np.searchsorted(latitude[order], latitude[order] + reach)
    for k in range(order.size):
        i, others = int(order[k]), order[k + 1 : last[k]]
        if not others.size:
            continue
        turn = np.abs(np.mod(longitude[others] - longitude[i] + math.pi, 2.0 * math.pi) - math.pi)
        away = MOON_RADIUS_M * np.hypot(latitude[others] - latitude[i], turn * math.cos(latitude[i]))
        larger = np.maximum(diameter[others], diameter[i])
        twin = (away < rules.confusable_distance * larger) & (
            np.abs(np.log(diameter[others] / diameter[i])) < rules.confusable_log_diameter
        )
        for j in others[twin]:
            clear[i if depth[i] < depth[j] else j] = False
    return clear


def _bilinear(values: FloatArray, row: FloatArray, column: FloatArray) -> FloatArray:
    """Return values at pixel coordinates, NaN outside and next to NaN."""
    rows, columns = values.shape
    i = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
    j = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
    y, x = row - i, column - j
    upper = values[i, j] * (1.0 - x) + values[i, j + 1] * x
    lower = values[i + 1, j] * (1.0 - x) + values[i + 1, j + 1] * x
    inside = (y >= 0.0) & (y <= 1.0) & (x >= 0.0) & (x <= 1.0)
    return np.asarray(np.where(inside, upper * (1.0 - y) + lower * y, np.nan))


SMOOTHING_PIXELS = 0.7


class RasterHeights:
    """Height rasters as files: the finest resolution of those given, smoothed by a pixel against quantisation."""

    def __init__(self, paths: Sequence[Path | str], relief: Path | None = None) -> None:
        """`relief` is a coarse height raster of the Moon to compare with."""
        from payload_emulator.sim.terrain.rasters import open_layers

        if not paths:
            raise TerrainError("terrain of the curation: expected at least one height raster, found none")
        coarse = None if relief is None else open_layers([relief])[0]
        layers = open_layers(paths, relief=coarse)
        # Most craters must lie on one resolution, or heights would jump: that with most files.
        self._layer = max(layers, key=lambda layer: (len(layer.files), layer.pixels_per_degree))
        self.pixels_per_degree = float(self._layer.pixels_per_degree)
        self.files = tuple(file.path for file in self._layer.files)

    @property
    def readings(self) -> list[str]:
        """Return the interpretation of the values of each file that was read."""
        return self._layer.readings

    def window(self, south: float, north: float, west: float, east: float) -> tuple[FloatArray, float, float]:
        """Heights of a window in degrees, with latitude and longitude of the centre of its first pixel."""
        layer, ppd = self._layer, self.pixels_per_degree
        top = math.floor((90.0 - north) * ppd - layer.north_offset - 0.5)
        left = math.floor(west * ppd - layer.west_offset - 0.5)
        rows = math.ceil((north - south) * ppd) + 2
        columns = math.ceil((east - west) * ppd) + 2
        values = np.asarray(layer.read(top, left, rows, columns), dtype=np.float64)
        if np.isfinite(values).any():
            values = _smoothed(values, SMOOTHING_PIXELS)
        return (values, 90.0 - (top + 0.5 + layer.north_offset) / ppd, (left + 0.5 + layer.west_offset) / ppd)


def _smoothed(values: FloatArray, sigma: float) -> FloatArray:
    """Return values under a small Gaussian; what touches NaN becomes NaN."""
    reach = math.ceil(3.0 * sigma)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-9)) ** 2)
    kernel /= kernel.sum()
    for axis in (0, 1):
        padded = np.pad(values, [(reach, reach) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        size = values.shape[axis]
        values = sum(weight * np.take(padded, range(k, k + size), axis=axis) for k, weight in enumerate(kernel))
    return np.asarray(values)
