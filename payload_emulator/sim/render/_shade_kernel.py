"""Compiled shading of the pixels of a frame: place on the terrain, slope, albedo, reflectance, sunlight.

The Sun stands at -x of the tangent frame: its vector is (-sun_flat, 0, sun_up). Slopes come from the terrain's own
pixels: the tangent grid would blur them once more.
"""

# NumPy's single-precision numbers count as floats for numba.
# mypy: disable-error-code="no-any-return"

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kernels.compiled import FAST, njit
from lunar.arrays import Float32Array, Int32Array
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.render._grid_kernel import INLINED, LINE, NODE_STEP, Grid, Nodes, Tiles
from payload_emulator.sim.render._trace_kernel import Viewpoint

# Columns of the work buffer of a row of pixels: depth along the boresight (then range), place in the tangent frame,
# fractions of the grid's and of the nodes' row and column, height of the ground, its rise out of shadow, phase.
(
    _DEPTH, _X, _Y, _Z, _ROW_PART, _COLUMN_PART, _NODE_ROW_PART, _NODE_COLUMN_PART, _HEIGHT, _RISE, _PHASE,
) = (LINE * k for k in range(11))  # fmt: skip
_WORK = 11 * LINE
# What later loops put where it is no longer needed: slopes and albedo after the look-ups, then the terms of the law.
_SLOPE_X, _SLOPE_Y, _ALBEDO = _ROW_PART, _COLUMN_PART, _NODE_ROW_PART
_LAMBERT, _SEELIGER, _MULTIPLE, _SUN = _X, _Y, _Z, _RISE
# Columns of its whole numbers: cell of the grid, cell of the nodes.
_CELL, _NODE = 0, LINE
_PLACES = 2 * LINE


class Surface(NamedTuple):
    """Albedo of the patch's tiles (n, side, side), binary logarithm of height pixels to one of it, mean, contrast."""

    albedo: NDArray[Any]
    step: int
    mean: float
    contrast: float


class Light(NamedTuple):
    """Sine and cosine of the Sun's elevation, tables of the photometric law (3, n), and whether that is Hapke's."""

    sun_up: float
    sun_flat: float
    law: Float32Array
    hapke: bool


class RayChange(NamedTuple):
    """Change of the ray of a pixel, per metre of depth, by a pixel to the right (a) and down (c); a pixel's size."""

    ax: np.float32
    ay: np.float32
    az: np.float32
    size: np.float32
    cx: np.float32
    cy: np.float32
    cz: np.float32


class FirstRay(NamedTuple):
    """Ray of the first pixel of a row, per metre of depth: tangent frame, right and down of the camera, down**2 + 1."""

    bx: np.float32
    by: np.float32
    bz: np.float32
    right: np.float32
    down: np.float32
    square: np.float32


class Steps(NamedTuple):
    """Camera on the grid (row, column), grid cells per metre, last row and column of nodes, row lengths of both."""

    first_row: np.float32
    first_column: np.float32
    per_metre: np.float32
    last_node_row: np.int32
    last_node_column: np.int32
    grid_stride: np.int32
    node_stride: np.int32


@njit(
    ahead=(
        "f4[:, ::1], Grid(f8, f8, f8), Viewpoint(f8, f8[:, ::1], f8, f8, f8), Light(f8, f8, f4[:, ::1], b1), "
        "Nodes(*4 * [f4[:, ::1]]), Tiles(f4[:, :, ::1], i4[:, ::1], i8), Surface(f4[:, :, ::1], i8, f8, f8), "
        "none, none, *3 * [f4[:, ::1]]"
    ),
    **FAST,
)
def shade_pixels(
    depth: Float32Array,
    grid: Grid,
    viewpoint: Viewpoint,
    light: Light,
    nodes: Nodes,
    tiles: Tiles,
    surface: Surface,
    shift_u: Float32Array | None,
    shift_v: Float32Array | None,
    radiance: Float32Array,
    lit: Float32Array,
    range_m: Float32Array,
) -> None:
    """Fill the images from ``range_m``, which comes as the depth along the boresight.

    Parameters
    ----------
    depth
        Rise of the grid's ground out of shadow, in half widths of the penumbra.
    shift_u, shift_v
        Shifts (H, W) of pixels by the lens; None for a lens without distortion.

    Notes
    -----
    The functions of a row are inlined before compilation: the compiler may reorder sums, and functions compiled apart
    order them otherwise, which changes the last bit of one pixel in forty and with it archived frames. As in
    `_trace_kernel` loops with look-ups are apart from loops of arithmetic.
    """
    steps = _steps_of(grid, depth.shape[1], nodes.row.shape[0], nodes.row.shape[1])
    rises = depth.ravel()
    node_rows = nodes.row.ravel()
    node_columns = nodes.column.ravel()
    row_slopes = nodes.row_slope.ravel()
    column_slopes = nodes.column_slope.ravel()
    pool, table, tile_shift = tiles
    albedo, albedo_step, mean_albedo, contrast = surface
    sun_up, sun_flat, law, hapke = light
    # Constants are computed before the loop, in this order: it decides in which order the compiler adds.
    up = np.float32(sun_up)
    flat = np.float32(sun_flat)
    last_phase = np.float32(law.shape[1] - 2)
    mean = np.float32(mean_albedo)
    spread = np.float32(contrast)
    high = np.float32(viewpoint.altitude_m)
    change = _ray_change(viewpoint)
    work = np.empty(_WORK, np.float32)
    places = np.empty(_PLACES, np.int32)
    for v in range(radiance.shape[0]):
        first = _first_ray(viewpoint, v)
        _locate_row(work, places, range_m, v, change, first, high, steps, shift_u, shift_v)
        _look_up_row(
            work, places, range_m.shape[1], rises, steps, node_rows, node_columns, row_slopes, column_slopes,
            pool, table, tile_shift, albedo, albedo_step, mean, spread,
        )  # fmt: skip
        _compute_law_terms(
            work, range_m.shape[1], v, change, first, up, flat, last_phase, shift_u, shift_v
        )  # fmt: skip
        _write_row(work, v, law, hapke, radiance, lit, range_m)


@njit(**INLINED)
def _steps_of(grid: Grid, columns: int, node_rows: int, node_columns: int) -> Steps:
    return Steps(
        np.float32(-grid.x0_m / grid.texel_m),
        np.float32(-grid.y0_m / grid.texel_m),
        np.float32(1.0 / grid.texel_m),
        np.int32(node_rows - 2),
        np.int32(node_columns - 2),
        np.int32(columns),
        np.int32(node_columns),
    )


@njit(**INLINED)
def _ray_change(viewpoint: Viewpoint) -> RayChange:
    turn, focal = viewpoint.tangent_from_camera, viewpoint.focal_px
    return RayChange(
        np.float32(turn[0, 0] / focal),
        np.float32(turn[1, 0] / focal),
        np.float32(turn[2, 0] / focal),
        np.float32(1.0 / focal),
        np.float32(turn[0, 1] / focal),
        np.float32(turn[1, 1] / focal),
        np.float32(turn[2, 1] / focal),
    )


@njit(**INLINED)
def _first_ray(viewpoint: Viewpoint, v: int) -> FirstRay:
    """Return the ray of the first pixel of row ``v`` of the image."""
    turn, focal = viewpoint.tangent_from_camera, viewpoint.focal_px
    b = (v - viewpoint.centre_v_px) / focal
    a = -viewpoint.centre_u_px / focal
    return FirstRay(
        np.float32(turn[0, 0] * a + turn[0, 1] * b + turn[0, 2]),
        np.float32(turn[1, 0] * a + turn[1, 1] * b + turn[1, 2]),
        np.float32(turn[2, 0] * a + turn[2, 1] * b + turn[2, 2]),
        np.float32(a),
        np.float32(b),
        np.float32(b * b + 1.0),
    )


@njit(**INLINED)
def _locate_row(
    work: Float32Array,
    places: Int32Array,
    range_m: Float32Array,
    v: int,
    change: RayChange,
    first: FirstRay,
    high: np.float32,
    steps: Steps,
    shift_u: Float32Array | None,
    shift_v: Float32Array | None,
) -> None:
    """Put the places that a row of pixels sees into the buffers: in the tangent frame, on the grid, among the nodes."""
    ax, ay, az, _, cx, cy, cz = change
    bx, by, bz, _, _, _ = first
    i0, j0, inverse, last_ni, last_nj, stride, node_stride = steps
    one = np.float32(1.0)
    half = np.float32(0.5)
    zero = np.float32(0.0)
    radius = np.float32(1.0 / MOON_RADIUS_M)
    share = np.float32(1.0 / NODE_STEP)
    for k in range(range_m.shape[1]):
        work[k + _DEPTH] = range_m[v, k]
    for k in range(range_m.shape[1]):
        c = np.float32(k)
        t = max(work[k + _DEPTH], zero)
        if shift_u is None:
            x = t * (ax * c + bx)
            y = t * (ay * c + by)
            z = high + t * (az * c + bz)
        else:
            c += shift_u[v, k]
            d = shift_v[v, k]  # type: ignore[index]  # given with shift_u
            x = t * (ax * c + cx * d + bx)
            y = t * (ay * c + cy * d + by)
            z = high + t * (az * c + cz * d + bz)
        i = max(i0 + x * inverse, zero)
        j = max(j0 + y * inverse, zero)
        whole_i = np.int32(i)
        whole_j = np.int32(j)
        ni = min(np.int32(i * share), last_ni)
        nj = min(np.int32(j * share), last_nj)
        lean = z * radius
        bend = (x * x + y * y) * radius * (one - lean + lean * lean)
        places[k] = whole_i * stride + whole_j
        places[k + _NODE] = ni * node_stride + nj
        work[k + _X] = x
        work[k + _Y] = y
        work[k + _Z] = z
        work[k + _ROW_PART] = i - np.float32(whole_i)
        work[k + _COLUMN_PART] = j - np.float32(whole_j)
        work[k + _NODE_ROW_PART] = i * share - np.float32(ni)
        work[k + _NODE_COLUMN_PART] = j * share - np.float32(nj)
        work[k + _HEIGHT] = z + half * bend * (one - half * half * bend * radius)


@njit(**INLINED)
def _look_up_row(
    work: Float32Array,
    places: Int32Array,
    wide: int,
    rises: Float32Array,
    steps: Steps,
    node_r: Float32Array,
    node_c: Float32Array,
    slope_r: Float32Array,
    slope_c: Float32Array,
    pool: Float32Array,
    table: Int32Array,
    tile_shift: int,
    albedo: NDArray[Any],
    albedo_step: int,
    mean: np.float32,
    contrast: np.float32,
) -> None:
    """Put rises out of shadow, slopes along x and y and albedo of the ground of a row of pixels into the buffer."""
    next_one = np.uint64(1)
    next_two = np.uint64(2)
    next_row = np.uint64(steps.grid_stride)
    next_node_row = np.uint64(steps.node_stride)
    mask = np.uint64((1 << tile_shift) - 1)
    shift = np.uint64(tile_shift)
    albedo_mask = np.uint64((1 << (tile_shift - albedo_step)) - 1)
    albedo_scale = np.float32(1.0 / (1 << albedo_step))
    per_texel = np.float32(1.0 / NODE_STEP) * steps.per_metre
    for k in range(wide):
        if work[k + _DEPTH] < np.float32(0.0):
            work[k + _RISE] = -np.float32(2.0)
            continue
        m = np.uint64(places[k])
        rise = _interpolate(rises, m, next_row, work[k + _ROW_PART], work[k + _COLUMN_PART])
        work[k + _RISE] = rise
        if rise <= -np.float32(1.0):
            continue
        # Place on the terrain's grid and how it changes along x and y.
        m = np.uint64(places[k + _NODE])
        m1 = m + next_one
        m2 = m + next_node_row
        m3 = m2 + next_one
        ti, tj = work[k + _NODE_ROW_PART], work[k + _NODE_COLUMN_PART]
        h = work[k + _HEIGHT]
        r00 = node_r[m] + h * slope_r[m]
        r01 = node_r[m1] + h * slope_r[m1]
        r10 = node_r[m2] + h * slope_r[m2]
        r11 = node_r[m3] + h * slope_r[m3]
        c00 = node_c[m] + h * slope_c[m]
        c01 = node_c[m1] + h * slope_c[m1]
        c10 = node_c[m2] + h * slope_c[m2]
        c11 = node_c[m3] + h * slope_c[m3]
        ra, rb = r00 + tj * (r01 - r00), r10 + tj * (r11 - r10)
        ca, cb = c00 + tj * (c01 - c00), c10 + tj * (c11 - c10)
        r, c = ra + ti * (rb - ra), ca + ti * (cb - ca)
        p, q = np.uint64(r), np.uint64(c)
        fi, fj = r - np.float32(p), c - np.float32(q)
        slot = np.uint64(table[p >> shift, q >> shift])
        p = p & mask
        q = q & mask
        p1, q1 = p + next_one, q + next_one
        p2, q2 = p + next_two, q + next_two
        p3, q3 = p2 + next_one, q2 + next_one
        h11, h12 = pool[slot, p1, q1], pool[slot, p1, q2]
        h21, h22 = pool[slot, p2, q1], pool[slot, p2, q2]
        w00, w01, w10, w11 = _weights(fi, fj)
        along_row = w00 * (h21 - pool[slot, p, q1]) + w01 * (h22 - pool[slot, p, q2])
        along_row += w10 * (pool[slot, p3, q1] - h11) + w11 * (pool[slot, p3, q2] - h12)
        along_column = w00 * (h12 - pool[slot, p1, q]) + w01 * (pool[slot, p1, q3] - h11)
        along_column += w10 * (h22 - pool[slot, p2, q]) + w11 * (pool[slot, p2, q3] - h21)
        scale = np.float32(0.5) * per_texel
        work[k + _SLOPE_X] = scale * (along_row * (rb - ra) + along_column * (cb - ca))
        work[k + _SLOPE_Y] = scale * (
            along_row * (r01 - r00 + ti * (r11 - r10 - r01 + r00))
            + along_column * (c01 - c00 + ti * (c11 - c10 - c01 + c00))
        )
        value = _albedo_at(albedo, slot, r * albedo_scale, c * albedo_scale, albedo_mask)
        work[k + _ALBEDO] = mean + contrast * (value - mean)


@njit(**INLINED)
def _interpolate(values: Float32Array, m: np.uint64, next_row: np.uint64, fi: np.float32, fj: np.float32) -> np.float32:
    """Return the value at fractions of row and column from place ``m`` of a grid stored as one line, bilinear."""
    next_one = np.uint64(1)
    top = values[m] + fj * (values[m + next_one] - values[m])
    m += next_row
    low = values[m] + fj * (values[m + next_one] - values[m])
    return top + fi * (low - top)


@njit(**INLINED)
def _weights(fi: np.float32, fj: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return the bilinear weights of the four values about a place, at fractions of row and column."""
    w11 = fi * fj
    w01 = fj - w11
    w10 = fi - w11
    return np.float32(1.0) - fi - w01, w01, w10, w11


@njit(**INLINED)
def _albedo_at(albedo: NDArray[Any], slot: np.uint64, r: np.float32, c: np.float32, mask: np.uint64) -> np.float32:
    """Return the albedo of a tile at row ``r`` and column ``c``, bilinear."""
    next_one = np.uint64(1)
    p = np.uint64(r)
    q = np.uint64(c)
    fi = r - np.float32(p)
    fj = c - np.float32(q)
    p = p & mask
    q = q & mask
    p1 = p + next_one
    q1 = q + next_one
    a0 = albedo[slot, p, q] + fj * (albedo[slot, p, q1] - albedo[slot, p, q])
    a1 = albedo[slot, p1, q] + fj * (albedo[slot, p1, q1] - albedo[slot, p1, q])
    return a0 + fi * (a1 - a0)


@njit(**INLINED)
def _compute_law_terms(
    work: Float32Array,
    wide: int,
    v: int,
    change: RayChange,
    first: FirstRay,
    up: np.float32,
    flat: np.float32,
    last_phase: np.float32,
    shift_u: Float32Array | None,
    shift_v: Float32Array | None,
) -> None:
    """Put sunlight, phase and terms of the photometric law of a row into the buffer; depths become ranges.

    With the cosines mu0 of incidence and mu of emission the terms are: Lambert, mu0; Lommel-Seeliger,
    mu0 / (mu0 + mu); multiple scattering, the latter times H(mu0) H(mu) with H(x) = (1 + 2 x) / (1 + 2 x gamma),
    gamma = sqrt(1 - w), w = 0.21.

    References
    ----------
    Hapke (1981), Bidirectional reflectance spectroscopy 1: Theory, J. Geophys. Res. 86.
    """
    ax, ay, az, per_pixel, cx, cy, cz = change
    bx, by, bz, left, row_below, square = first
    one = np.float32(1.0)
    two = np.float32(2.0)
    half = np.float32(0.5)
    zero = np.float32(0.0)
    gamma = np.float32(math.sqrt(1.0 - 0.21))
    for k in range(wide):
        c = np.float32(k)
        gx, gy = _ground_slopes(work, k)
        norm = one / np.float32(math.sqrt(gx * gx + gy * gy + one))
        if shift_u is None:
            right = left + c * per_pixel
            length = np.float32(math.sqrt(right * right + square))
            reach = one / length
            vx = -(ax * c + bx) * reach
            vy = -(ay * c + by) * reach
            vz = -(az * c + bz) * reach
        else:
            c += shift_u[v, k]
            d = shift_v[v, k]  # type: ignore[index]  # given with shift_u
            right = left + c * per_pixel
            below = row_below + d * per_pixel
            length = np.float32(math.sqrt(right * right + below * below + one))
            reach = one / length
            vx = -(ax * c + cx * d + bx) * reach
            vy = -(ay * c + cy * d + by) * reach
            vz = -(az * c + cz * d + bz) * reach
        mu0 = (gx * flat + up) * norm
        mu = max((vz - gx * vx - gy * vy) * norm, np.float32(0.02))
        s = min(work[k + _RISE], one)
        sun = half + s * (np.float32(0.75) - np.float32(0.25) * s * s)
        sun = sun if (s > -one and mu0 > zero) else zero
        mu0 = max(mu0, zero)
        both = mu0 / (mu0 + mu)
        h0 = (one + two * mu0) / (one + two * mu0 * gamma)
        h1 = (one + two * mu) / (one + two * mu * gamma)
        work[k + _SUN] = sun
        work[k + _PHASE] = min(max((vz * up - vx * flat + one) * half, zero), one) * last_phase
        work[k + _LAMBERT] = mu0
        work[k + _SEELIGER] = both
        work[k + _MULTIPLE] = both * h0 * h1
        work[k + _DEPTH] = work[k + _DEPTH] * length if work[k + _DEPTH] >= zero else np.float32(np.nan)


@njit(**INLINED)
def _ground_slopes(work: Float32Array, k: int) -> tuple[np.float32, np.float32]:
    """Return the slopes of the ground of pixel ``k`` in the tangent frame from those of heights above the sphere.

    The nodes hold places at fixed height; the ground's own rise moves the place a little.
    """
    one = np.float32(1.0)
    radius = np.float32(1.0 / MOON_RADIUS_M)
    x = work[k + _X]
    y = work[k + _Y]
    z = work[k + _Z] * radius
    gx = work[k + _SLOPE_X]
    gy = work[k + _SLOPE_Y]
    lean = one / (one + (gx * x + gy * y) * radius)
    stretch = one + (work[k + _HEIGHT] * radius - z) * (one - z)
    steep = radius * (one - z + z * z)
    return gx * lean * stretch - x * steep, gy * lean * stretch - y * steep


@njit(**INLINED)
def _write_row(
    work: Float32Array,
    v: int,
    law: Float32Array,
    hapke: bool,
    radiance: Float32Array,
    lit: Float32Array,
    range_m: Float32Array,
) -> None:
    """Write a row of the images: radiance by the terms of the law and its tables over the phase angle."""
    next_one = np.uint64(1)
    zero = np.float32(0.0)
    for k in range(radiance.shape[1]):
        sun = work[k + _SUN]
        lit[v, k] = sun
        range_m[v, k] = work[k + _DEPTH]
        value = zero
        if sun > zero:
            place = work[k + _PHASE]
            m = np.uint64(place)
            f = place - np.float32(m)
            seeliger = law[0, m] + f * (law[0, m + next_one] - law[0, m])
            lambert = law[1, m] + f * (law[1, m + next_one] - law[1, m])
            value = seeliger * work[k + _SEELIGER] + lambert * work[k + _LAMBERT]
            if hapke:
                value += law[2, m] * work[k + _MULTIPLE]
            value *= work[k + _ALBEDO] * sun
        radiance[v, k] = value
