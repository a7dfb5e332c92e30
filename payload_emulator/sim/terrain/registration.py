"""Registration of a crater catalogue to a terrain: the shift from the listed craters to the rims on the terrain.

Catalogues and height models are tied to the Moon by different images and orbits. Their difference is tens of metres and
changes slowly from place to place, so no constant shift is correct. It is fitted from rims measured on the terrain:
robust means over small cells, then Gaussian-process regression with an exponential covariance over the angle between
two places, evaluated on a lattice. Where there are few rims the estimate tends to zero and its standard deviation to
that of the process; where there is no node, nothing is known and nothing is applied.

The shift is applied once, to the catalogue when a terrain is opened (`registered`): on-board table, labels and
evaluation then all lie on the terrain. The terrain is drawn as it is georeferenced.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.plausible import MAP_SHIFT_M
from payload_emulator.errors import TerrainError

VERSION = 1
METHOD = "robust cell means, Gaussian process"
LATTICE_DEG = 7.5
"""Spacing of the nodes; 15 degree tiles have nodes at their edges and in their middle."""

PROCESS_SIGMA_M = 43.0
PROCESS_ANGLE_DEG = 80.0
"""Standard deviation per axis of the difference between LU1319381 and GLD100, and the angle over which it is similar.

Greatest likelihood over the tiles of the available data without the strip and the block that are kept for tests: 43 m
and 82 degrees. Over 10 degrees the difference changes by 21 m (1 sigma per axis)."""

FLOOR_SIGMA_M = 10.0
"""Least standard deviation of a node: interpolation over the lattice and what all rims share (slopes, pixels)."""

_NODES = ("row", "column", "east_m", "north_m", "sigma_m", "rims")
_CELL_DEG = 2.5
_LEAST_SCALE = 0.3
_LEAST_SCATTER_M = 30.0
_LEAST_DEPTH_RATIO = 0.05
_LEAST_SHARE = 0.5
_LARGEST_SCATTER = 0.12
_LARGEST_SHIFT = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Rims:
    """Rims on a terrain compared with the craters of a list, arrays of length n.

    Attributes
    ----------
    east_m, north_m
        Centre of the rim minus the listed centre.
    scatter_m
        Scatter of the rim points about the fitted circle, to which the error of the centre is proportional.
    """

    latitude_rad: FloatArray
    longitude_rad: FloatArray
    east_m: FloatArray
    north_m: FloatArray
    scatter_m: FloatArray

    def __len__(self) -> int:
        return int(self.east_m.size)


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """Shift from listed craters to the terrain at the nodes of a lattice in latitude and longitude.

    Attributes
    ----------
    row, column
        Latitude and longitude (0 to 360) of each node over `LATTICE_DEG`, shape (n,).
    east_m, north_m, sigma_m
        Shift and its standard deviation per axis, shape (n,).
    rims
        Rims nearer to this node than to any other, shape (n,).
    catalogue
        SHA-256 of the catalogue file.
    terrain
        SHA-256 of each raster by file name.
    made_utc
        Date.
    """

    row: IntArray
    column: IntArray
    east_m: FloatArray
    north_m: FloatArray
    sigma_m: FloatArray
    rims: IntArray
    catalogue: str = ""
    terrain: Mapping[str, str] = field(default_factory=dict)
    made_utc: str = ""

    @property
    def words(self) -> str:
        """Return nodes, rims and mean shift, as printed with figures."""
        spans = (("east", self.east_m), ("north", self.north_m), ("1 sigma", self.sigma_m))
        listed = (f"{part.min():.2f} to {part.max():.2f} m {name}" for name, part in spans if part.size)
        return ", ".join([f"{self.row.size} nodes of {int(self.rims.sum())} rims", *listed])

    def at(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return shifts east and north (k, 2) and their sigma (k,); zero and NaN where nothing is known.

        Sigma grows where only some of the nodes around a place are known, as the shift changes from place to place.
        """
        row = np.degrees(latitude_rad) / LATTICE_DEG
        column = np.mod(np.degrees(longitude_rad), 360.0) / LATTICE_DEG
        low, left = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
        up, right = row - low, column - left
        turn = round(360.0 / LATTICE_DEG)
        table = np.full((2 * turn + 1, turn), -1, dtype=np.int64)
        table[self.row + turn, np.mod(self.column, turn)] = np.arange(self.row.size)
        total, shift, variance = np.zeros(row.shape), np.zeros((*row.shape, 2)), np.zeros(row.shape)
        for i, along in ((0, 1.0 - up), (1, up)):
            for j, across in ((0, 1.0 - right), (1, right)):
                node = table[low + i + turn, np.mod(left + j, turn)]
                weight = np.where(node >= 0, along * across, 0.0)
                total += weight
                for axis, values in enumerate((self.east_m, self.north_m)):
                    shift[..., axis] += weight * np.append(values, 0.0)[node]
                # Errors of neighbouring nodes are nearly the same error.
                variance += weight * np.append(self.sigma_m, 0.0)[node] ** 2
        known = total > 0.25
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = np.where(known[..., None], shift / total[..., None], 0.0)
            beyond_deg = LATTICE_DEG * (1.0 - total)
            grown = PROCESS_SIGMA_M**2 * -np.expm1(-2.0 * beyond_deg / PROCESS_ANGLE_DEG)
            sigma = np.where(known, np.sqrt(variance / total + grown), np.nan)
        return shift, sigma

    def select(self, which: BoolArray) -> Registration:
        """Return the registration with some of its nodes."""
        nodes: dict[str, Any] = {name: getattr(self, name)[which] for name in _NODES}
        return replace(self, **nodes)

    def rims_near(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> int:
        """Return the number of rims at the nodes that places use."""
        row, turn = np.degrees(latitude_rad) / LATTICE_DEG, round(360.0 / LATTICE_DEG)
        column = np.mod(np.degrees(longitude_rad), 360.0) / LATTICE_DEG
        used = np.concatenate(
            [(np.floor(row) + i) * turn + np.mod(np.floor(column) + j, turn) for i in (0, 1) for j in (0, 1)]
        )
        return int(self.rims[np.isin(self.row * turn + np.mod(self.column, turn), used)].sum())


def joined(first: Registration, second: Registration) -> Registration:
    """Return the first registration with those nodes of the second that it lacks."""
    turn = round(360.0 / LATTICE_DEG)
    there, here = (one.row * turn + np.mod(one.column, turn) for one in (second, first))
    new = ~np.isin(there, here)
    nodes: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(second, name)[new]]) for name in _NODES
    }
    return replace(first, **nodes)


def registered(catalogue: CraterCatalogue, registration: Registration | None) -> CraterCatalogue:
    """Return the catalogue with its craters where the terrain shows them; unchanged where nothing is known."""
    if registration is None or not len(catalogue):
        return catalogue
    shift, _ = registration.at(catalogue.latitude_rad, catalogue.longitude_rad)
    east_rad = shift[:, 0] / (MOON_RADIUS_M * np.cos(catalogue.latitude_rad))
    return replace(
        catalogue,
        latitude_rad=catalogue.latitude_rad + shift[:, 1] / MOON_RADIUS_M,
        longitude_rad=np.mod(catalogue.longitude_rad + east_rad, 2.0 * math.pi),
    )


@dataclass(frozen=True, slots=True)
class TileShift:
    """Registration of a tile of 15 degrees: mean over its nodes; rims nearest to them, those of its edges included."""

    south_deg: float
    west_deg: float
    east_m: float
    north_m: float
    sigma_m: float
    rims: int


def by_tile(registration: Registration) -> list[TileShift]:
    """Return the registration of each tile of 15 degrees with a node in its middle, from the south."""
    turn, tiles = round(360.0 / LATTICE_DEG), []
    column = np.mod(registration.column, turn)
    middle = (registration.row % 2 == 1) & (column % 2 == 1)
    for row, west in sorted(zip(registration.row[middle].tolist(), column[middle].tolist(), strict=True)):
        mine = (np.abs(registration.row - row) <= 1) & (np.mod(column - west + 1, turn) <= 2)
        tiles.append(
            TileShift(
                (row - 1) * LATTICE_DEG,
                (west - 1) * LATTICE_DEG,
                round(float(registration.east_m[mine].mean()), 1),
                round(float(registration.north_m[mine].mean()), 1),
                round(float(registration.sigma_m[mine].mean()), 1),
                int(registration.rims[mine].sum()),
            )
        )
    return tiles


def clear_rims(
    craters: CraterCatalogue,
    east_m: FloatArray,
    north_m: FloatArray,
    radius_m: FloatArray,
    depth_m: FloatArray,
    scatter_m: FloatArray,
    share: FloatArray,
) -> Rims:
    """Return the rims that tell where a crater lies: deep, round, seen all around, near the listed place."""
    with np.errstate(invalid="ignore"):
        clear = np.flatnonzero(
            (depth_m >= 2.0 * _LEAST_DEPTH_RATIO * radius_m)
            & (share >= _LEAST_SHARE)
            & (scatter_m <= _LARGEST_SCATTER * radius_m)
            & (np.hypot(east_m, north_m) <= _LARGEST_SHIFT * radius_m)
        )
    return Rims(
        craters.latitude_rad[clear], craters.longitude_rad[clear], east_m[clear], north_m[clear], scatter_m[clear]
    )


def fit_registration(rims: Rims) -> Registration:
    """Return the registration that rims give, at all nodes within one spacing of a rim; without provenance.

    References
    ----------
    Rasmussen, Williams (2006), Gaussian Processes for Machine Learning, equations 2.25 and 2.26.
    """
    row = np.degrees(rims.latitude_rad) / LATTICE_DEG
    column = np.mod(np.degrees(rims.longitude_rad), 360.0) / LATTICE_DEG
    turn = round(360.0 / LATTICE_DEG)
    corners = [np.stack([np.floor(row) + i, np.mod(np.floor(column) + j, turn)]) for i in (0, 1) for j in (0, 1)]
    nodes = np.unique(np.concatenate(corners, axis=1).astype(np.int64), axis=1)
    nearest = np.stack([np.rint(row), np.mod(np.rint(column), turn)]).astype(np.int64)
    count = np.array([np.count_nonzero(np.all(nearest == node[:, None], axis=0)) for node in nodes.T], np.int64)
    places = _unit(np.radians(nodes[0] * LATTICE_DEG), np.radians(nodes[1] * LATTICE_DEG))
    cells, mean, variance = _cells(rims)
    prior = _alike(cells, cells) + np.diag(variance)
    crossed = _alike(places, cells)
    solved = np.linalg.solve(prior, np.concatenate([mean, crossed.T], axis=1))
    shift = crossed @ solved[:, :2]
    left = PROCESS_SIGMA_M**2 - np.einsum("nc,cn->n", crossed, solved[:, 2:])
    sigma = np.hypot(np.sqrt(np.maximum(left, 0.0)), FLOOR_SIGMA_M)
    return Registration(nodes[0], nodes[1], shift[:, 0], shift[:, 1], sigma, count)


def _cells(rims: Rims) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return unit vectors (c, 3), robust mean shifts (c, 2) and their variances (c,) of cells of about equal area."""
    row = np.floor(np.degrees(rims.latitude_rad) / _CELL_DEG)
    wide = _CELL_DEG / np.cos(np.radians((row + 0.5) * _CELL_DEG))
    column = np.floor(np.mod(np.degrees(rims.longitude_rad), 360.0) / wide)
    _, cell = np.unique(row * 1_000.0 + column, return_inverse=True)
    shift = np.stack([rims.east_m, rims.north_m], axis=1)
    sigma = np.hypot(rims.scatter_m, _LEAST_SCATTER_M)
    mean, total = _means(cell, shift, sigma)
    # How large errors are against the scatter of rim points follows from the rims themselves, where cells hold several.
    many = np.bincount(cell)[cell] >= 4
    if np.count_nonzero(many) >= 20:
        away = np.abs(shift - mean[cell])[many] / sigma[many, None]
        sigma = sigma * max(1.4826 * float(np.median(away)), _LEAST_SCALE)
        mean, total = _means(cell, shift, sigma)
    places = _unit(rims.latitude_rad, rims.longitude_rad)
    middle = np.stack([np.bincount(cell, places[:, axis]) for axis in range(3)], axis=1)
    return middle / np.linalg.norm(middle, axis=1, keepdims=True), mean, 1.0 / total


def _means(cell: IntArray, shift: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return robust means (c, 2) and their information (c,): least squares with weights of Student's t (4 degrees)."""
    weight = 1.0 / sigma**2
    for step in range(16):
        total = np.bincount(cell, weight)
        mean = np.stack([np.bincount(cell, weight * shift[:, axis]) for axis in (0, 1)], axis=1) / total[:, None]
        if step == 15:
            break
        square = np.sum((shift - mean[cell]) ** 2, axis=1) / sigma**2
        weight = (4.0 + 2.0) / (4.0 + square) / sigma**2
    # The information of Student's t is below that of its weights: (v + 2) / (v + 4) of the normal one, two axes.
    return mean, np.asarray(0.75 * np.bincount(cell, 1.0 / sigma**2), dtype=np.float64)


def _unit(latitude_rad: FloatArray, longitude_rad: FloatArray) -> FloatArray:
    level = np.cos(latitude_rad)
    return np.stack([level * np.cos(longitude_rad), level * np.sin(longitude_rad), np.sin(latitude_rad)], axis=-1)


def _alike(first: FloatArray, second: FloatArray) -> FloatArray:
    """Covariance (n, m) of the shift between places (unit vectors), per axis."""
    angle_deg = np.degrees(np.arccos(np.clip(first @ second.T, -1.0, 1.0)))
    return np.asarray(PROCESS_SIGMA_M**2 * np.exp(-angle_deg / PROCESS_ANGLE_DEG))


def format_registration(registration: Registration) -> str:
    """Return the product as text (JSON, a line per node)."""
    head = {
        "version": VERSION,
        "kind": "registration",
        "method": METHOD,
        "made_utc": registration.made_utc,
        "lattice_deg": LATTICE_DEG,
        "process_sigma_m": PROCESS_SIGMA_M,
        "process_angle_deg": PROCESS_ANGLE_DEG,
        "catalogue_sha256": registration.catalogue,
        "terrain_sha256": dict(sorted(registration.terrain.items())),
        "columns": list(_COLUMNS),
    }
    rows = zip(
        (registration.row * LATTICE_DEG).tolist(),
        (registration.column * LATTICE_DEG).tolist(),
        np.round(registration.east_m, 1).tolist(),
        np.round(registration.north_m, 1).tolist(),
        np.round(registration.sigma_m, 1).tolist(),
        registration.rims.tolist(),
        strict=True,
    )
    nodes = ",\n".join("  " + json.dumps(list(row)) for row in rows)
    return json.dumps(head, indent=1)[:-2] + ',\n "nodes": [\n' + nodes + "\n ]\n}\n"


_COLUMNS = ("latitude_deg", "longitude_deg", "east_m", "north_m", "sigma_m", "rims")


def parse_registration(text: str, source: str) -> Registration:
    """Return a registration from the text of a product.

    Raises
    ------
    TerrainError
        The text is no registration, or one of another version or lattice.
    """
    try:
        head: Any = json.loads(text)
    except json.JSONDecodeError as error:
        raise TerrainError(f"{source}: expected a registration (JSON), found {error}") from None
    if not isinstance(head, dict) or head.get("kind") != "registration":
        raise TerrainError(f"{source}: expected a registration made by linna catalogue register, found another file")
    for name, expected in (("version", VERSION), ("lattice_deg", LATTICE_DEG), ("columns", list(_COLUMNS))):
        if head.get(name) != expected:
            raise TerrainError(f"{source}: expected {name} {expected}, found {head.get(name)}; make it again")
    try:
        rows = np.array(head["nodes"], dtype=np.float64).reshape(-1, len(_COLUMNS))
        catalogue, terrain = str(head["catalogue_sha256"]), dict(head["terrain_sha256"])
    except (KeyError, TypeError, ValueError) as error:
        raise TerrainError(
            f"{source}: expected nodes of {len(_COLUMNS)} numbers and two hashes, found {error}"
        ) from None
    if not np.all(np.isfinite(rows)) or np.any(rows[:, 4] <= 0.0) or np.any(rows[:, 5] < 0.0):
        raise TerrainError(f"{source}: expected finite shifts, positive sigma_m and counts of rims, found others")
    places, shifts = rows[:, :2] / LATTICE_DEG, np.abs(rows[:, 2:4])
    is_lattice = np.all(np.abs(places - np.rint(places)) < 1e-6) and np.all(np.abs(rows[:, 0]) <= 90.0)
    if not is_lattice or len(np.unique(rows[:, :2], axis=0)) < len(rows):
        raise TerrainError(f"{source}: expected each node of the lattice of {LATTICE_DEG:g} deg once, found others")
    if shifts.size and shifts.max() > MAP_SHIFT_M:
        raise TerrainError(f"{source}: expected shifts of at most {MAP_SHIFT_M:g} m, found {shifts.max():.6g} m")
    row, column = np.rint(rows[:, :2].T / LATTICE_DEG).astype(np.int64)
    return Registration(
        row,
        column,
        rows[:, 2],
        rows[:, 3],
        rows[:, 4],
        rows[:, 5].astype(np.int64),
        catalogue,
        terrain,
        str(head.get("made_utc", "")),
    )
