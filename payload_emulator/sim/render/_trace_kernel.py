"""Compiled search for the ground that each pixel sees, on the tangent grid of `_grid_kernel`.

A ray passes ``(i0 + t di, j0 + t dj, z0 + t dz)``: rows and columns of the grid, z in metres, t in metres along the
boresight.
"""

# NumPy's single-precision numbers count as floats for numba.
# mypy: disable-error-code="arg-type,no-any-return,type-var,assignment"

import math
from typing import NamedTuple

import numpy as np

from kernels.compiled import FAST, njit
from lunar.arrays import Float32Array, FloatArray, Int32Array
from payload_emulator.sim.render._grid_kernel import BLOCK_SHIFT, INLINED, LINE, Grid

CLOSE_TEXELS = 0.04
"""A clearance that ends the search for a hit: a hundredth of a pixel at the corners of a 120 degree picture."""

_NEWTON_STEPS = 3

# Columns of the work buffer of a line of pixels: horizontal distance and z of the hit of the neighbour nearer the
# nadir, parameter of the ray, fractions of the grid's row and column, the four corners. The clearance that
# is left takes the place of the neighbour's z.
_REACH, _NEIGHBOUR_Z, _T, _ROW_PART, _COLUMN_PART, _H00, _H01, _H10, _H11 = (LINE * k for k in range(9))
_LEFT = _NEIGHBOUR_Z
_WORK = 9 * LINE

_TINY = np.float32(1.0e-9)
_SLOWEST_FALL = np.float32(1.0e-3)


class Viewpoint(NamedTuple):
    """Camera above the tangent point: altitude, rotation (3, 3), focal length and centre of the image in pixels."""

    altitude_m: float
    tangent_from_camera: FloatArray
    focal_px: float
    centre_u_px: float
    centre_v_px: float


class Line(NamedTuple):
    """Rays of a line of pixels: di = ax k + bx, dj = ay k + by (texels), dz = az k + bz (metres), k from the first."""

    ax: np.float32
    ay: np.float32
    az: np.float32
    bx: np.float32
    by: np.float32
    bz: np.float32


class Start(NamedTuple):
    """Camera on the grid: row, column and altitude; largest row and column at which ground is looked up."""

    i0: np.float32
    j0: np.float32
    z0: np.float32
    last_i: np.float32
    last_j: np.float32


class Sector(NamedTuple):
    """Sector about the nadir: whether its lines are rows, whether they run upward in number, its place in the image."""

    upright: bool
    forward: bool
    main0: int
    cross0: int
    main_size: int
    cross_size: int


@njit(**FAST)
def _clearance(heights: Float32Array, i: float, j: float, z: float) -> float:
    """Return how far a point lies above the ground, bilinear."""
    a = np.uint64(i)
    b = np.uint64(j)
    one = np.uint64(1)
    fi = np.float32(i - a)
    fj = np.float32(j - b)
    top = heights[a, b] + fj * (heights[a, b + one] - heights[a, b])
    low = heights[a + one, b] + fj * (heights[a + one, b + one] - heights[a + one, b])
    above: float = z - (top + fi * (low - top))
    return above


@njit(**FAST)
def _bracketed_hit(
    heights: Float32Array,
    i0: float,
    j0: float,
    z0: float,
    di: float,
    dj: float,
    dz: float,
    begin: float,
    end: float,
    above: float,
    under: float,
) -> float:
    """Return the parameter of the hit between two clearances of opposite sign: false position, Illinois halving."""
    for _ in range(6):
        middle = begin + (end - begin) * above / (above - under)
        value = _clearance(heights, i0 + middle * di, j0 + middle * dj, z0 + middle * dz)
        if abs(value) < 0.3:
            return middle
        if value > 0.0:
            begin = middle
            above = value
            under *= 0.5
        else:
            end = middle
            under = value
            above *= 0.5
        if abs(value) < 3.0:
            break
    return begin + (end - begin) * above / (above - under)


@njit(**FAST)
def find_hit(
    heights: Float32Array,
    peaks: Float32Array,
    i0: float,
    j0: float,
    z0: float,
    di: float,
    dj: float,
    dz: float,
    start: float,
    stop: float,
) -> float:
    """Return the first parameter t in [start, stop] at which a ray (i0 + t di, j0 + t dj, z0 + t dz) meets the ground.

    Steps are as long as the clearance and its last rate of change allow, at most one texel; a ray still high
    after four leaps over blocks whose highest point lies under it.  -1 where nothing is hit, -2 where the ray
    starts under ground.
    """
    pace = 1.0 / max(abs(di), abs(dj), 1.0e-9)
    size = 1 << BLOCK_SHIFT
    begin = start
    above = _clearance(heights, i0 + begin * di, j0 + begin * dj, z0 + begin * dz)
    if above <= 0.0:
        return -2.0
    slowest = max(-0.25 * dz, 1.0e-3)
    rate = max(-dz, 1.0e-3)
    steps = 0
    while begin < stop:
        if steps >= 4:
            bi = min(int(i0 + begin * di) >> BLOCK_SHIFT, peaks.shape[0] - 1)
            bj = min(int(j0 + begin * dj) >> BLOCK_SHIFT, peaks.shape[1] - 1)
            leave = stop
            if di != 0.0:
                leave = min(leave, ((bi + (1 if di > 0.0 else 0)) * size - i0) / di)
            if dj != 0.0:
                leave = min(leave, ((bj + (1 if dj > 0.0 else 0)) * size - j0) / dj)
            leave = min(max(leave, begin) + 1.0e-4 * pace, stop)
            if min(z0 + begin * dz, z0 + leave * dz) > peaks[bi, bj]:
                begin = leave
                above = _clearance(heights, i0 + begin * di, j0 + begin * dj, z0 + begin * dz)
                if above <= 0.0:
                    return begin
                continue
            steps = 0
        step = min(1.02 * above / rate + 1.0e-3 * pace, pace)
        end = min(begin + step, stop)
        under = _clearance(heights, i0 + end * di, j0 + end * dj, z0 + end * dz)
        if under <= 0.0:
            return _bracketed_hit(heights, i0, j0, z0, di, dj, dz, begin, end, above, under)
        rate = max((above - under) / (end - begin), slowest)
        if under < 0.3:
            return end + under / rate
        begin = end
        above = under
        steps += 1
    return -1.0


@njit(
    ahead="f4[:, ::1], f4[:, ::1], f8, f8, Grid(f8, f8, f8), Viewpoint(f8, f8[:, ::1], f8, f8, f8), f4[:, ::1]", **FAST
)
def trace_pixels(
    heights: Float32Array,
    peaks: Float32Array,
    low: float,
    top: float,
    grid: Grid,
    viewpoint: Viewpoint,
    depth_along: Float32Array,
) -> None:
    """Fill ``depth_along`` (H, W) with the distance of the first hit along the boresight; -1 where there is none.

    All heights lie between ``low`` and ``top``.

    The image is walked outward from the nadir, in lines of four sectors. The ray of a pixel passes above those of its
    two neighbours nearer the nadir, so the ground up to their hits is clear and the search starts at the nearer of
    them. Three Newton steps without a branch settle most pixels (many in flight at once); the others are searched one
    by one.
    """
    rows, columns = heights.shape
    high, wide = depth_along.shape
    inverse = 1.0 / grid.texel_m
    start = Start(
        np.float32(-grid.x0_m * inverse),
        np.float32(-grid.y0_m * inverse),
        np.float32(viewpoint.altitude_m),
        np.float32(rows - 2.01),
        np.float32(columns - 2.01),
    )
    close = np.float32(CLOSE_TEXELS * grid.texel_m)
    nadir_u, nadir_v = _nadir_pixel(viewpoint, high, wide)
    inner = np.empty(high + wide, np.float32)
    inner_z = np.empty(high + wide, np.float32)
    work = np.empty(_WORK, np.float32)
    places = np.empty(LINE, np.int32)
    for number in range(4):
        upright = number < 2
        forward = number % 2 == 0
        sector = Sector(
            upright,
            forward,
            nadir_v if upright else nadir_u,
            nadir_u if upright else nadir_v,
            high if upright else wide,
            wide if upright else high,
        )
        lines = sector.main_size - sector.main0 if forward else sector.main0 + 1
        for n in range(lines):
            # Left and right sectors leave the diagonals to the others.
            half = n if upright else n - 1
            if half < 0:
                continue
            main = sector.main0 + n if forward else sector.main0 - n
            begin = max(sector.cross0 - half, 0)
            count = min(sector.cross0 + half, sector.cross_size - 1) + 1 - begin
            first = n == 0 or (not upright and n == 1)
            _take_neighbours(work, inner, inner_z, sector, half, begin, count, first, np.float32(top))
            line = _line_of(viewpoint, upright, main, begin, inverse)
            _newton_steps(work, places, heights, start, line, count)
            _settle(
                depth_along, inner, inner_z, work, heights, peaks, start, line, viewpoint.altitude_m, upright, main,
                begin, count, close, top, low,
            )  # fmt: skip


@njit(**INLINED)
def _nadir_pixel(viewpoint: Viewpoint, high: int, wide: int) -> tuple[int, int]:
    """Return the pixel (u, v) below the camera, within the image; its middle where the camera looks elsewhere."""
    rotation = viewpoint.tangent_from_camera
    down = -rotation[2, 2]
    nadir_u = wide // 2
    nadir_v = high // 2
    if down > 0.05:
        nadir_u = min(max(int(viewpoint.centre_u_px - viewpoint.focal_px * rotation[2, 0] / down), 0), wide - 1)
        nadir_v = min(max(int(viewpoint.centre_v_px - viewpoint.focal_px * rotation[2, 1] / down), 0), high - 1)
    return nadir_u, nadir_v


@njit(**INLINED)
def _take_neighbours(
    work: Float32Array,
    inner: Float32Array,
    inner_z: Float32Array,
    sector: Sector,
    half: int,
    begin: int,
    count: int,
    first: bool,
    high_z: np.float32,
) -> None:
    """Put distance and z of the nearer of two hits on the line nearer the nadir into the buffer.

    Where the inner line was shorter its end stands in; the first line starts from the highest ground.
    """
    cross0 = sector.cross0
    short = half - 1
    left = max(cross0 - short, 0)
    right = min(cross0 + short, sector.cross_size - 1)
    for n_k in range(count):
        k = begin + n_k
        if first:
            work[n_k + _REACH] = np.float32(0.0)
            work[n_k + _NEIGHBOUR_Z] = high_z
        else:
            same = min(max(k, left), right)
            toward = k - 1 if k > cross0 else (k + 1 if k < cross0 else k)
            toward = min(max(toward, left), right)
            nearer = same if inner[same] < inner[toward] else toward
            work[n_k + _REACH] = inner[nearer]
            work[n_k + _NEIGHBOUR_Z] = inner_z[nearer]


@njit(**INLINED)
def _line_of(viewpoint: Viewpoint, upright: bool, main: int, begin: int, inverse: float) -> Line:
    """Return the rays of a line of pixels, which runs along u in upright sectors and along v in the others."""
    rotation, focal = viewpoint.tangent_from_camera, viewpoint.focal_px
    run = 0 if upright else 1
    ax = rotation[0, run] / focal
    ay = rotation[1, run] / focal
    az = rotation[2, run] / focal
    start = viewpoint.centre_u_px if upright else viewpoint.centre_v_px
    b = (main - (viewpoint.centre_v_px if upright else viewpoint.centre_u_px)) / focal
    bx = rotation[0, 1 - run] * b + rotation[0, 2] - ax * start
    by = rotation[1, 1 - run] * b + rotation[1, 2] - ay * start
    bz = rotation[2, 1 - run] * b + rotation[2, 2] - az * start
    return Line(
        np.float32(ax * inverse),
        np.float32(ay * inverse),
        np.float32(az),
        np.float32(bx * inverse + ax * inverse * begin),
        np.float32(by * inverse + ay * inverse * begin),
        np.float32(bz + az * begin),
    )


@njit(**INLINED)
def _newton_steps(
    work: Float32Array, places: Int32Array, heights: Float32Array, start: Start, line: Line, count: int
) -> None:
    """Take Newton steps on the bilinear ground, from where each ray passes the neighbour's height.

    The loops are split so that all but the look-ups run in vector registers.
    """
    i0, j0, z0, last_i, last_j = start
    ax, ay, az, bx, by, bz = line
    one = np.float32(1.0)
    quarter = np.float32(0.25)
    near = np.float32(1.01)
    stride = np.int32(heights.shape[1])
    flat = heights.ravel()
    next_one = np.uint64(1)
    next_row = np.uint64(heights.shape[1])
    for k in range(count):
        c = np.float32(k)
        di = ax * c + bx
        dj = ay * c + by
        fall = max(-(az * c + bz), _SLOWEST_FALL)
        pace = one / (np.float32(math.sqrt(di * di + dj * dj)) + _TINY)
        t0 = work[k + _REACH] * pace
        work[k + _T] = min(max((z0 - work[k + _NEIGHBOUR_Z]) / fall, t0), t0 + pace)
    for step in range(_NEWTON_STEPS):
        for k in range(count):
            c = np.float32(k)
            t = work[k + _T]
            i = min(max(i0 + t * (ax * c + bx), near), last_i)
            j = min(max(j0 + t * (ay * c + by), near), last_j)
            p = np.int32(i)
            q = np.int32(j)
            places[k] = p * stride + q
            work[k + _ROW_PART] = i - np.float32(p)
            work[k + _COLUMN_PART] = j - np.float32(q)
        for k in range(count):
            m = np.uint64(places[k])
            work[k + _H00] = flat[m]
            work[k + _H01] = flat[m + next_one]
            work[k + _H10] = flat[m + next_row]
            work[k + _H11] = flat[m + next_row + next_one]
        for k in range(count):
            c = np.float32(k)
            di = ax * c + bx
            dj = ay * c + by
            fall = max(-(az * c + bz), _SLOWEST_FALL)
            t = work[k + _T]
            fi = work[k + _ROW_PART]
            fj = work[k + _COLUMN_PART]
            h0 = work[k + _H00]
            h1 = work[k + _H01] - h0
            h2 = work[k + _H10] - h0
            h3 = work[k + _H11] - h0 - h1 - h2
            value = z0 - t * fall - (h0 + fi * h2 + fj * (h1 + fi * h3))
            rate = max(fall + (h2 + fj * h3) * di + (h1 + fi * h3) * dj, quarter * fall)
            pace = one / (np.float32(math.sqrt(di * di + dj * dj)) + _TINY)
            move = value / rate
            if step < _NEWTON_STEPS - 1:
                t0 = work[k + _REACH] * pace
                move = min(max(move, t0 - t), pace)
            work[k + _LEFT] = value
            work[k + _T] = t + move


@njit(**INLINED)
def _settle(
    depth_along: Float32Array,
    inner: Float32Array,
    inner_z: Float32Array,
    work: Float32Array,
    heights: Float32Array,
    peaks: Float32Array,
    start: Start,
    line: Line,
    altitude: float,
    upright: bool,
    main: int,
    begin: int,
    count: int,
    close: np.float32,
    top: float,
    low: float,
) -> None:
    """Keep the hits of a line; a ray that Newton steps did not settle is searched for."""
    i0, j0, z0, last_i, last_j = start
    ax, ay, az, bx, by, bz = line
    zero = np.float32(0.0)
    near = np.float32(1.01)
    high_z = np.float32(top)
    for k in range(count):
        c = np.float32(k)
        di = ax * c + bx
        dj = ay * c + by
        t = work[k + _T]
        i = i0 + t * di
        j = j0 + t * dj
        out = np.float32(math.sqrt(di * di + dj * dj)) + _TINY
        if not (abs(work[k + _LEFT]) < close and i > near and i < last_i and j > near and j < last_j):
            first = work[k + _REACH] / out
            t = _search(heights, peaks, i0, j0, altitude, di, dj, az * c + bz, first, top, low)
        if upright:
            depth_along[main, begin + k] = t
        else:
            depth_along[begin + k, main] = t
        inner[begin + k] = t * out if t > zero else zero
        inner_z[begin + k] = z0 + t * (az * c + bz) if t > zero else high_z


@njit(**FAST)
def trace_shifted(
    heights: Float32Array,
    peaks: Float32Array,
    low: float,
    top: float,
    grid: Grid,
    viewpoint: Viewpoint,
    shift_u: Float32Array,
    shift_v: Float32Array,
    depth_along: Float32Array,
) -> None:
    """Do as `trace_pixels` for a lens that shifts its pixels.

    The rays of a line no longer lie in a plane, so each pixel is searched on its own.
    """
    inverse = 1.0 / grid.texel_m
    i0 = -grid.x0_m * inverse
    j0 = -grid.y0_m * inverse
    rotation = viewpoint.tangent_from_camera
    for v in range(depth_along.shape[0]):
        for u in range(depth_along.shape[1]):
            right = (u + shift_u[v, u] - viewpoint.centre_u_px) / viewpoint.focal_px
            below = (v + shift_v[v, u] - viewpoint.centre_v_px) / viewpoint.focal_px
            di = (rotation[0, 0] * right + rotation[0, 1] * below + rotation[0, 2]) * inverse
            dj = (rotation[1, 0] * right + rotation[1, 1] * below + rotation[1, 2]) * inverse
            dz = rotation[2, 0] * right + rotation[2, 1] * below + rotation[2, 2]
            depth_along[v, u] = _search(heights, peaks, i0, j0, viewpoint.altitude_m, di, dj, dz, 0.0, top, low)


@njit(**FAST)
def _search(
    heights: Float32Array,
    peaks: Float32Array,
    i0: float,
    j0: float,
    altitude: float,
    di: float,
    dj: float,
    dz: float,
    first: float,
    top: float,
    low: float,
) -> float:
    """Return the first hit of a ray: from ``first`` if that is above ground, else from the highest ground; -1: none."""
    rows, columns = heights.shape
    start = 0.0
    stop = 1.0e9
    if dz < -1.0e-9:
        start = max(0.0, (top - altitude) / dz)
        stop = (low - altitude) / dz
    # Keep within the grid, one texel inside for the gradients.
    if di > 1.0e-12:
        stop = min(stop, (rows - 2.001 - i0) / di)
    elif di < -1.0e-12:
        stop = min(stop, (1.001 - i0) / di)
    if dj > 1.0e-12:
        stop = min(stop, (columns - 2.001 - j0) / dj)
    elif dj < -1.0e-12:
        stop = min(stop, (1.001 - j0) / dj)
    t = -1.0
    # From `first`; should that be under ground, from the top.
    begin = first if start < first < stop else start
    for _ in range(2):
        if begin < stop:
            t = find_hit(heights, peaks, i0, j0, altitude, di, dj, dz, begin, stop)
        if t != -2.0:
            break
        begin = start
    return t if t > 0.0 else -1.0
