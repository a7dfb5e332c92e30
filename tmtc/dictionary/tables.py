"""On-board tables as octets: what the ground uploads and flight reads.

Every table is one block: magic `LINNATBL`, kind (2 octets, ASCII), version (u16), length of the content
(u32), CRC-32 of the content (u32), then the content; all big-endian. The identity of a table in telemetry is
the first 32 bits of the SHA-256 of the whole block. The functions `unpack_…` raise `TableError` if the block is
damaged, is of another kind, or holds numbers that are not finite or times out of order.

Kinds: `AE` anchor ephemeris, `CC` crater catalogue, `GR` gravity field, `OR` orientation, `IS` initial state,
`BU` burns.
Frames: MCMF is mean-Earth/polar-axis (ME), PA principal axes, ICRF the inertial axes centred on the Moon.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmtc.arrays import BoolArray, FloatArray, IntArray
from tmtc.errors import TableError
from tmtc.packets.pus import TICKS_PER_SECOND

MAGIC = b"LINNATBL"
VERSION = 1
_HEADER = struct.Struct(">8s2sHII")

# Nodes of the Lagrange interpolation of smooth tables: with 60 s between nodes of a 111 min orbit the
# truncation error of degree 7 is below a millimetre.
_LAGRANGE_NODES = 8

# Angles of the catalogue table in units of 2^-32 of a turn: 2.5 mm on the ground.
_TURN = 4_294_967_296.0
_DIAMETER_UNIT_M = 4.0
_HEIGHT_UNIT_M = 0.5
_SIGMA_UNIT_M = 0.5
MAP_RADIUS_M = 1_737_400.0
"""Radius of the sphere that heights and altitudes of the tables refer to, that of the lunar maps."""

_CRATER = np.dtype(
    [
        ("id", ">u4"),
        ("latitude", ">i4"),
        ("longitude", ">u4"),
        ("diameter", ">u2"),
        ("height", ">i2"),
        ("sigma_east", ">u2"),
        ("sigma_north", ">u2"),
        ("sigma_up", ">u2"),
    ]
)


@dataclass(frozen=True, slots=True)
class AnchorSample:
    """Place of the spacecraft in the anchor ephemeris; `direction` is +1 moving north, -1 moving south."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    direction: int


@dataclass(frozen=True, slots=True, eq=False)
class AnchorTable:
    """Uploaded ephemeris for the estimators that need one: on-board ticks, and place in MCMF.

    Attributes
    ----------
    ticks
        On-board time, 2^-16 s, strictly increasing, shape (n,).
    position_mcmf_m
        Positions, shape (n, 3).
    """

    ticks: IntArray
    position_mcmf_m: FloatArray

    def at(self, ticks: int) -> AnchorSample | None:
        """Return the place at an on-board time, None outside the table or in a gap of it."""
        position = _interpolate(self.ticks, self.position_mcmf_m, ticks)
        if position is None:
            return None
        radius = float(np.linalg.norm(position))
        after = min(ticks + TICKS_PER_SECOND, int(self.ticks[-1]))
        before = max(ticks - TICKS_PER_SECOND, int(self.ticks[0]))
        later = _interpolate(self.ticks, self.position_mcmf_m, after)
        earlier = _interpolate(self.ticks, self.position_mcmf_m, before)
        climb = 0.0 if later is None or earlier is None else _sine_latitude(later) - _sine_latitude(earlier)
        return AnchorSample(
            float(np.arcsin(position[2] / radius)),
            float(np.arctan2(position[1], position[0])),
            radius - MAP_RADIUS_M,
            1 if climb >= 0.0 else -1,
        )

    def altitude_m(self, ticks: int) -> float:
        """Return the altitude above the sphere of the maps, NaN outside the table."""
        position = _interpolate(self.ticks, self.position_mcmf_m, ticks)
        return float("nan") if position is None else float(np.linalg.norm(position)) - MAP_RADIUS_M


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueTable:
    """Anchoring catalogue on board: place, size and rim height of each crater, with its uncertainty.

    Attributes
    ----------
    ids
        Catalogue identities.
    latitude_rad, longitude_rad
        Centre, MCMF.
    diameter_m
        Rim diameter.
    rim_height_m
        Height of the rim above the sphere of the maps.
    sigma_m
        Standard deviations east, north, up of the centre at rim height, shape (n, 3).
    """

    ids: IntArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    diameter_m: FloatArray
    rim_height_m: FloatArray
    sigma_m: FloatArray

    def __len__(self) -> int:
        return int(self.ids.shape[0])

    def select(self, which: BoolArray | IntArray) -> CatalogueTable:
        return CatalogueTable(*(getattr(self, one.name)[which] for one in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class GravityTable:
    """Fully normalised harmonics in principal axes; coefficients of shape (degree + 1, degree + 1)."""

    name: str
    gm_m3_s2: float
    radius_m: float
    c_bar: FloatArray
    s_bar: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OrientationTable:
    """Rotation of the Moon sampled on on-board time.

    Attributes
    ----------
    ticks
        On-board time, shape (n,).
    mcmf_from_icrf
        Rotations at those times, shape (n, 3, 3).
    pa_from_mcmf
        The constant rotation from mean-Earth axes to principal axes, shape (3, 3).
    """

    ticks: IntArray
    mcmf_from_icrf: FloatArray
    pa_from_mcmf: FloatArray

    def at(self, ticks: int) -> FloatArray | None:
        """Return mcmf_from_icrf at an on-board time, shape (3, 3); None outside the table."""
        matrix = _interpolate(self.ticks, self.mcmf_from_icrf.reshape(-1, 9), ticks)
        if matrix is None:
            return None
        left, _, right = np.linalg.svd(matrix.reshape(3, 3))
        return np.asarray(left @ right, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class InitialState:
    """The state that starts the navigation filter: Moon-centred ICRF, with standard deviations.

    Attributes
    ----------
    ticks
        On-board time of the state.
    position_icrf_m, velocity_icrf_m_s
        Shape (3,).
    sigma_position_m, sigma_velocity_m_s
        Per axis, equal in all directions.
    """

    ticks: int
    position_icrf_m: FloatArray
    velocity_icrf_m_s: FloatArray
    sigma_position_m: float
    sigma_velocity_m_s: float


@dataclass(frozen=True, slots=True, eq=False)
class BurnTable:
    """Impulsive burns as planned, in order of time.

    Attributes
    ----------
    ticks
        On-board time of each burn, shape (n,).
    delta_v_icrf_m_s
        Planned change of velocity, shape (n, 3).
    sigma_m_s
        Standard deviation per axis of what is carried out against the plan, shape (n,).
    """

    ticks: IntArray
    delta_v_icrf_m_s: FloatArray
    sigma_m_s: FloatArray

    def __len__(self) -> int:
        return int(self.ticks.shape[0])


def no_burns() -> BurnTable:
    """Return a table without burns."""
    return BurnTable(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty(0))


def table_hash(octets: bytes) -> int:
    """Return the identity of a table as telemetry carries it, 32 bits."""
    return int.from_bytes(hashlib.sha256(octets).digest()[:4], "big")


def pack_anchor_table(ticks: ArrayLike, position_mcmf_m: ArrayLike) -> bytes:
    """Return an anchor ephemeris as octets."""
    times = _increasing(ticks, "anchor ephemeris")
    position = np.asarray(position_mcmf_m, dtype=">f8").reshape(times.size, 3)
    return _wrap(b"AE", struct.pack(">I", times.size) + times.astype(">i8").tobytes() + position.tobytes())


def unpack_anchor_table(octets: bytes) -> AnchorTable:
    """Return the anchor ephemeris in a block of octets."""
    content = _unwrap(b"AE", octets)
    count = _count(content, 32, b"AE")
    times = np.frombuffer(content, dtype=">i8", count=count, offset=4)
    position = np.frombuffer(content, dtype=">f8", count=3 * count, offset=4 + 8 * count)
    return AnchorTable(_increasing(times, "anchor ephemeris"), _finite(position, "anchor ephemeris").reshape(count, 3))


def pack_catalogue_table(table: CatalogueTable) -> bytes:
    """Return an anchoring catalogue as octets, 22 per crater, in order of latitude.

    Quantisation: 2.5 mm in place, 4 m in diameter, 0.5 m in height and in sigma.
    """
    order = np.argsort(table.latitude_rad, kind="stable")
    rows = np.zeros(len(table), dtype=_CRATER)
    rows["id"] = table.ids[order]
    rows["latitude"] = np.round(table.latitude_rad[order] * (_TURN / (2.0 * np.pi)))
    rows["longitude"] = np.round(np.mod(table.longitude_rad[order] / (2.0 * np.pi), 1.0) * _TURN) % _TURN
    rows["diameter"] = np.clip(np.round(table.diameter_m[order] / _DIAMETER_UNIT_M), 0, 65_535)
    rows["height"] = np.clip(np.round(table.rim_height_m[order] / _HEIGHT_UNIT_M), -32_768, 32_767)
    for axis, name in enumerate(("sigma_east", "sigma_north", "sigma_up")):
        rows[name] = np.clip(np.ceil(table.sigma_m[order, axis] / _SIGMA_UNIT_M), 1, 65_535)
    return _wrap(b"CC", struct.pack(">I", len(table)) + rows.tobytes())


def unpack_catalogue_table(octets: bytes) -> CatalogueTable:
    """Return the anchoring catalogue in a block of octets, in order of latitude."""
    content = _unwrap(b"CC", octets)
    count = _count(content, _CRATER.itemsize, b"CC")
    rows = np.frombuffer(content, dtype=_CRATER, count=count, offset=4)
    return CatalogueTable(
        rows["id"].astype(np.int64),
        rows["latitude"] * (2.0 * np.pi / _TURN),
        rows["longitude"] * (2.0 * np.pi / _TURN),
        rows["diameter"] * _DIAMETER_UNIT_M,
        rows["height"] * _HEIGHT_UNIT_M,
        np.stack([rows["sigma_east"], rows["sigma_north"], rows["sigma_up"]], axis=1) * _SIGMA_UNIT_M,
    )


def pack_gravity_table(table: GravityTable) -> bytes:
    """Return a gravity field as octets: name, GM, radius, degree, C, S of the lower triangle by rows."""
    degree = table.c_bar.shape[0] - 1
    lower = np.tril_indices(degree + 1)
    name = table.name.encode("ascii", "replace")[:32]
    head = struct.pack(">32sddH", name, table.gm_m3_s2, table.radius_m, degree)
    return _wrap(b"GR", head + table.c_bar[lower].astype(">f8").tobytes() + table.s_bar[lower].astype(">f8").tobytes())


def unpack_gravity_table(octets: bytes) -> GravityTable:
    """Return the gravity field in a block of octets."""
    content = _unwrap(b"GR", octets)
    head = struct.Struct(">32sddH")
    if len(content) < head.size:
        raise TableError(f"gravity table: expected at least {head.size} octets, found {len(content)}")
    name, gm, radius, degree = head.unpack_from(content)
    terms = (degree + 1) * (degree + 2) // 2
    expected = head.size + 16 * terms
    if len(content) != expected:
        raise TableError(f"gravity table: degree {degree} needs {expected} octets, found {len(content)}")
    values = _finite(np.frombuffer(content, dtype=">f8", offset=head.size), "gravity table")
    lower = np.tril_indices(degree + 1)
    c_bar = np.zeros((degree + 1, degree + 1))
    s_bar = np.zeros((degree + 1, degree + 1))
    c_bar[lower] = values[:terms]
    s_bar[lower] = values[terms:]
    return GravityTable(name.rstrip(b"\0").decode("ascii", "replace"), gm, radius, c_bar, s_bar)


def pack_orientation_table(ticks: ArrayLike, mcmf_from_icrf: ArrayLike, pa_from_mcmf: ArrayLike) -> bytes:
    """Return the rotation of the Moon as octets: the constant rotation to principal axes, times, matrices.

    Two hours between samples keep the interpolation below a millimetre on the ground.
    """
    times = _increasing(ticks, "orientation table")
    matrices = np.asarray(mcmf_from_icrf, dtype=">f8").reshape(times.size, 9)
    constant = np.asarray(pa_from_mcmf, dtype=">f8").reshape(9)
    content = struct.pack(">I", times.size) + constant.tobytes() + times.astype(">i8").tobytes()
    return _wrap(b"OR", content + matrices.tobytes())


def unpack_orientation_table(octets: bytes) -> OrientationTable:
    """Return the rotation of the Moon in a block of octets."""
    content = _unwrap(b"OR", octets)
    count = _count(content, 80, b"OR", extra=72)
    constant = np.frombuffer(content, dtype=">f8", count=9, offset=4)
    times = np.frombuffer(content, dtype=">i8", count=count, offset=76)
    matrices = np.frombuffer(content, dtype=">f8", count=9 * count, offset=76 + 8 * count)
    return OrientationTable(
        _increasing(times, "orientation table"),
        _finite(matrices, "orientation table").reshape(count, 3, 3),
        _finite(constant, "orientation table").reshape(3, 3),
    )


def pack_initial_state(state: InitialState) -> bytes:
    """Return the state that starts the filter as octets."""
    values = (*map(float, state.position_icrf_m), *map(float, state.velocity_icrf_m_s))
    return _wrap(b"IS", struct.pack(">q8d", state.ticks, *values, state.sigma_position_m, state.sigma_velocity_m_s))


def unpack_initial_state(octets: bytes) -> InitialState:
    """Return the state that starts the filter."""
    content = _unwrap(b"IS", octets)
    if len(content) != 72:
        raise TableError(f"initial state: expected 72 octets of content, found {len(content)}")
    ticks, *values = struct.unpack(">q8d", content)
    numbers = _finite(np.array(values), "initial state")
    if not (numbers[6] > 0.0 and numbers[7] > 0.0):
        raise TableError(f"initial state: sigmas must be positive, found {numbers[6]} and {numbers[7]}")
    return InitialState(ticks, numbers[:3], numbers[3:6], float(numbers[6]), float(numbers[7]))


def pack_burn_table(table: BurnTable) -> bytes:
    """Return planned burns as octets, 40 per burn, in order of time."""
    order = np.argsort(table.ticks, kind="stable")
    rows = np.concatenate([table.delta_v_icrf_m_s, table.sigma_m_s[:, None]], axis=1)[order]
    content = struct.pack(">I", len(table)) + table.ticks[order].astype(">i8").tobytes()
    return _wrap(b"BU", content + rows.astype(">f8").tobytes())


def unpack_burn_table(octets: bytes) -> BurnTable:
    """Return the planned burns in a block of octets.

    Raises
    ------
    TableError
        The block is damaged, holds another kind of table, values that are not finite, or times out of order.
    """
    content = _unwrap(b"BU", octets)
    count = _count(content, 40, b"BU")
    ticks = np.frombuffer(content, dtype=">i8", count=count, offset=4).astype(np.int64)
    rows = np.frombuffer(content, dtype=">f8", count=4 * count, offset=4 + 8 * count)
    rows = _finite(rows, "burn table").reshape(count, 4)
    if np.any(np.diff(ticks) <= 0) or np.any(rows[:, 3] < 0.0):
        raise TableError("burn table: expected increasing times and sigmas of zero or more, found others")
    return BurnTable(ticks, rows[:, :3], rows[:, 3])


def _wrap(kind: bytes, content: bytes) -> bytes:
    return _HEADER.pack(MAGIC, kind, VERSION, len(content), zlib.crc32(content)) + content


def _unwrap(kind: bytes, octets: bytes) -> bytes:
    """Return the content of a block after every check of its header."""
    name = _NAMES[kind]
    if len(octets) < _HEADER.size:
        raise TableError(f"{name}: expected at least {_HEADER.size} octets, found {len(octets)}")
    magic, found, version, length, crc = _HEADER.unpack_from(octets)
    if magic != MAGIC:
        raise TableError(f"{name}: octets 0 to 7 should read {MAGIC!r}, found {magic!r}")
    if found != kind:
        raise TableError(f"{name}: expected a table of kind {kind!r}, found {found!r}")
    if version != VERSION:
        raise TableError(f"{name}: expected version {VERSION}, found {version}")
    content = octets[_HEADER.size :]
    if len(content) != length:
        raise TableError(f"{name}: header announces {length} octets of content, found {len(content)}")
    if zlib.crc32(content) != crc:
        raise TableError(f"{name}: CRC-32 of the content is {zlib.crc32(content):08x}, header says {crc:08x}")
    return content


_NAMES = {
    b"AE": "anchor ephemeris",
    b"CC": "crater catalogue table",
    b"GR": "gravity table",
    b"OR": "orientation table",
    b"IS": "initial state",
    b"BU": "burn table",
}


def _count(content: bytes, each: int, kind: bytes, extra: int = 0) -> int:
    """Return the number of rows a content announces, after comparing it with its length."""
    if len(content) < 4 + extra:
        raise TableError(f"{_NAMES[kind]}: expected at least {4 + extra} octets, found {len(content)}")
    count = int(struct.unpack_from(">I", content)[0])
    expected = 4 + extra + each * count
    if len(content) != expected:
        raise TableError(f"{_NAMES[kind]}: {count} rows need {expected} octets, found {len(content)}")
    return count


def _increasing(ticks: ArrayLike | Sequence[int], what: str) -> IntArray:
    times = np.asarray(ticks).astype(np.int64).reshape(-1)
    if times.size < 2 or np.any(np.diff(times) <= 0):
        raise TableError(f"{what}: needs at least two times, strictly increasing")
    return times


def _finite(values: NDArray[np.floating], what: str) -> FloatArray:
    numbers = np.asarray(values, dtype=np.float64)
    if not np.all(np.isfinite(numbers)):
        first = int(np.argmax(~np.isfinite(numbers)))
        raise TableError(f"{what}: expected finite numbers, value {first} is {numbers.reshape(-1)[first]}")
    return numbers


def _interpolate(ticks: IntArray, values: FloatArray, at_ticks: int) -> FloatArray | None:
    """Return rows interpolated by Lagrange's formula on the nearest nodes; None outside or in a gap.

    A gap is a step more than twice the smallest: the table is evenly spaced wherever it covers.
    """
    if at_ticks < ticks[0] or at_ticks > ticks[-1]:
        return None
    after = int(np.searchsorted(ticks, at_ticks))
    if ticks[after] == at_ticks:
        return np.asarray(values[after], dtype=np.float64).copy()
    step = int(ticks[after] - ticks[after - 1])
    smallest = int(np.min(np.diff(ticks[max(0, after - 8) : after + 8])))
    if step > 2 * smallest:
        return None
    first = after - _LAGRANGE_NODES // 2
    low, high = max(0, first), min(ticks.size, first + _LAGRANGE_NODES)
    if low == 0:
        high = min(ticks.size, _LAGRANGE_NODES)
    if high == ticks.size:
        low = max(0, ticks.size - _LAGRANGE_NODES)
    # Stay on this side of any gap: nodes must follow each other at the local step.
    while low < after - 1 and np.any(np.diff(ticks[low:after]) > 2 * smallest):
        low += 1
    while high > after + 1 and np.any(np.diff(ticks[after - 1 : high]) > 2 * smallest):
        high -= 1
    nodes = (ticks[low:high] - at_ticks).astype(np.float64) / smallest
    difference = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(difference, 1.0)
    ratio = -nodes[None, :] / difference
    np.fill_diagonal(ratio, 1.0)
    return np.asarray(np.prod(ratio, axis=1) @ values[low:high], dtype=np.float64)


def _sine_latitude(position: FloatArray) -> float:
    return float(position[2] / np.linalg.norm(position))
