"""Compiled loops over the tangent grid: heights of the ground, shadows, highest ground of blocks.

The grid lies in the tangent frame of `renderer`: rows run away from the Sun, z is up, metres.
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.compiled import FAST, njit
from lunar.arrays import Float32Array, Int32Array
from lunar.constants import MOON_RADIUS_M

NODE_STEP = 32
"""Grid cells between two nodes, at which places on the terrain are computed exactly."""

BLOCK_SHIFT = 3
"""Binary logarithm of the side of a block of grid cells."""

SHARP = 4.0
"""Largest depth of light or shadow that is kept, in half widths of the penumbra."""

LINE = 4096
"""Longest side of an image or of a grid, the length of a column of a work buffer.

Columns of a buffer are offsets of LINE numbers: one buffer with constant offsets tells the compiler that columns do not
overlap, so that loops without look-ups run in vector registers.
"""

# Columns of the work buffer of `fill_grid`: height, fractions of the terrain's row and column, the four corners.
_HEIGHT, _ROW_PART, _COLUMN_PART, _H00, _H01, _H10, _H11 = (LINE * k for k in range(7))
_WORK = 7 * LINE
# Columns of its whole numbers: tile row, tile column, pixel within the tile.
_TILE_ROW, _TILE_COLUMN, _PIXEL = (LINE * k for k in range(3))
_PLACES = 3 * LINE

INLINED: dict[str, Any] = {**FAST, "inline": "always"}
"""Options of functions that are part of a loop: compiled in one piece, sums are ordered as if written there."""


class Grid(NamedTuple):
    """First row and column of a tangent grid and its texel, metres."""

    x0_m: float
    y0_m: float
    texel_m: float


class Nodes(NamedTuple):
    """Places of the nodes on the terrain at height 0 (n, m), pixels, and their change with height, pixels per metre."""

    row: Float32Array
    column: Float32Array
    row_slope: Float32Array
    column_slope: Float32Array


class Tiles(NamedTuple):
    """Terrain of a patch: pool of tiles (n, side, side), table of their slots, binary logarithm of a tile's pixels."""

    pool: Float32Array
    table: Int32Array
    shift: int


@njit(ahead="f4[:, ::1], Nodes(*4 * [f4[:, ::1]]), Tiles(f4[:, :, ::1], i4[:, ::1], i8), Grid(f8, f8, f8)", **FAST)
def fill_grid(heights: Float32Array, nodes: Nodes, tiles: Tiles, grid: Grid) -> None:
    """Fill ``heights`` with z of the ground in the tangent frame.

    A grid point sees ground of height h at the place ``node + h * slope``. The height of the previous row is close
    enough to start from: it is off by one texel's relief, which moves the place by a few metres.
    """
    rows, columns = heights.shape
    work = np.zeros(_WORK, np.float32)
    places = np.empty(_PLACES, np.int32)
    for i in range(rows):
        for _ in range(2 if i == 0 else 1):
            _place_row(work, places, nodes, i, columns, tiles.pool.shape[2], tiles.shift)
            _read_row(work, places, tiles.pool, tiles.table, columns)
        _bend_row(heights, work, i, grid)


@njit(**FAST)
def _place_row(
    work: Float32Array, places: Int32Array, nodes: Nodes, i: int, columns: int, tile_side: int, shift: int
) -> None:
    """Put the places of a grid row on the terrain into the buffers, linear between nodes."""
    mask = np.int32((1 << shift) - 1)
    size = np.int32(tile_side)
    share = np.float32(1.0 / NODE_STEP)
    node_row, node_column, slope_row, slope_column = nodes
    ni = min(i // NODE_STEP, node_row.shape[0] - 2)
    fi = np.float32(i - ni * NODE_STEP) * share
    for nj in range(node_row.shape[1] - 1):
        first = nj * NODE_STEP
        count = min(NODE_STEP, columns - first) if nj < node_row.shape[1] - 2 else columns - first
        r0 = node_row[ni, nj] + fi * (node_row[ni + 1, nj] - node_row[ni, nj])
        r1 = node_row[ni, nj + 1] + fi * (node_row[ni + 1, nj + 1] - node_row[ni, nj + 1])
        c0 = node_column[ni, nj] + fi * (node_column[ni + 1, nj] - node_column[ni, nj])
        c1 = node_column[ni, nj + 1] + fi * (node_column[ni + 1, nj + 1] - node_column[ni, nj + 1])
        sr = slope_row[ni, nj]
        sc = slope_column[ni, nj]
        dsr = (slope_row[ni, nj + 1] - sr) * share
        dsc = (slope_column[ni, nj + 1] - sc) * share
        r1 = (r1 - r0) * share
        c1 = (c1 - c0) * share
        for k in range(count):
            j = first + k
            f = np.float32(k)
            h = work[j + _HEIGHT]
            r = r0 + f * r1 + h * (sr + f * dsr)
            c = c0 + f * c1 + h * (sc + f * dsc)
            a = np.int32(r)
            b = np.int32(c)
            work[j + _ROW_PART] = r - np.float32(a)
            work[j + _COLUMN_PART] = c - np.float32(b)
            places[j + _TILE_ROW] = a >> shift
            places[j + _TILE_COLUMN] = b >> shift
            # A tile's own pixels start at (1, 1).
            places[j + _PIXEL] = ((a & mask) + 1) * size + (b & mask) + 1


@njit(**FAST)
def _read_row(work: Float32Array, places: Int32Array, pool: Float32Array, table: Int32Array, columns: int) -> None:
    """Put the heights of the terrain at the places of a grid row into the buffer, bilinear."""
    flat = pool.ravel()
    tile_size = np.uint64(pool.shape[1] * pool.shape[2])
    next_one = np.uint64(1)
    next_row = np.uint64(pool.shape[2])
    for j in range(columns):
        slot = np.uint64(table[np.uint64(places[j + _TILE_ROW]), np.uint64(places[j + _TILE_COLUMN])])
        m = slot * tile_size + np.uint64(places[j + _PIXEL])
        work[j + _H00] = flat[m]
        work[j + _H01] = flat[m + next_one]
        m += next_row
        work[j + _H10] = flat[m]
        work[j + _H11] = flat[m + next_one]
    for j in range(columns):
        fr = work[j + _ROW_PART]
        fc = work[j + _COLUMN_PART]
        top = work[j + _H00] + fc * (work[j + _H01] - work[j + _H00])
        low = work[j + _H10] + fc * (work[j + _H11] - work[j + _H10])
        work[j + _HEIGHT] = top + fr * (low - top)


@njit(**FAST)
def _bend_row(heights: Float32Array, work: Float32Array, i: int, grid: Grid) -> None:
    """Put z of a grid row into ``heights``: the height less the sagitta of the sphere below the tangent plane.

    For u = d^2 / (R + h) at a distance d along the plane the sagitta is u / 2 (1 + v / 4 (1 + v / 2)), v = u / (R + h).
    """
    one = np.float32(1.0)
    half = np.float32(0.5)
    inverse_radius = np.float32(1.0 / MOON_RADIUS_M)
    step = np.float32(grid.texel_m)
    left = np.float32(grid.y0_m)
    x2 = np.float32((grid.x0_m + i * grid.texel_m) * (grid.x0_m + i * grid.texel_m))
    for j in range(heights.shape[1]):
        h = work[j + _HEIGHT]
        y = left + np.float32(j) * step
        inverse = inverse_radius * (one - h * inverse_radius)
        u = (x2 + y * y) * inverse
        v = u * inverse
        heights[i, j] = h - half * u * (one + half * half * v * (one + half * v))


@njit(ahead="f4[:, ::1], f4[::1], f4[::1], f8, f8, f8, f4[:, ::1]", **FAST)
def sweep_shadows(
    heights: Float32Array,
    shadow: Float32Array,
    distance: Float32Array,
    texel: float,
    tangent: float,
    penumbra: float,
    depth: Float32Array,
) -> None:
    """Fill ``depth`` with how far the ground rises out of shadow, in half widths of the penumbra (-1..1 is partly lit).

    ``shadow`` and ``distance`` (columns) hold the height of the line of light and the distance of its caster one texel
    before the first row; they leave as those of the last row.
    """
    rows, columns = heights.shape
    fall = np.float32(texel * tangent)
    step = np.float32(texel)
    soft = np.float32(penumbra)
    sharp = np.float32(SHARP)
    zero = np.float32(0.0)
    for i in range(rows):
        for j in range(columns):
            line = shadow[j] - fall
            away = distance[j] + step
            z = heights[i, j]
            rise = z - line
            depth[i, j] = min(max(rise / (away * soft), -sharp), sharp)
            free = rise >= zero
            shadow[j] = z if free else line
            distance[j] = zero if free else away


@njit(ahead="f4[:, ::1]", **FAST)
def block_peaks(heights: Float32Array) -> Float32Array:
    """Return the highest z of every block of 8 x 8 grid cells (their borders included)."""
    rows, columns = heights.shape
    size = 1 << BLOCK_SHIFT
    peaks = np.empty(((rows - 2) // size + 1, (columns - 2) // size + 1), np.float32)
    line = np.empty(columns, np.float32)
    for bi in range(peaks.shape[0]):
        first = bi * size
        last = min(first + size, rows - 1)
        for j in range(columns):
            line[j] = heights[first, j]
        for i in range(first + 1, last + 1):
            for j in range(columns):
                line[j] = max(line[j], heights[i, j])
        for bj in range(peaks.shape[1]):
            top = line[bj * size]
            for j in range(bj * size + 1, min(bj * size + size, columns - 1) + 1):
                top = max(top, line[j])
            peaks[bi, bj] = top
    return peaks
