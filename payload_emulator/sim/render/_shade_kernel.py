"""Compiled shading of the pixels of a frame: place on the terrain, slope, albedo, reflectance, sunlight.

The Sun stands at -x of the tangent frame: its vector is (-sun_flat, 0, sun_up). Slopes come from the terrain's own
pixels: the tangent grid would blur them once more.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lunar._compile import njit
from lunar.arrays import Float32Array
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.render._grid_kernel import LINE, NODE_STEP, Grid, Nodes, Tiles
from payload_emulator.sim.render._trace_kernel import Eye

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


@njit(fastmath=True, error_model="numpy", nogil=True)
def shade_pixels(
    depth: Float32Array,
    grid: Grid,
    eye: Eye,
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
    One function, although long: the compiler may reorder the sums, and split into functions it orders them otherwise,
    which changes the last bit of one pixel in forty and with it archived frames.

    With the cosines mu0 of incidence and mu of emission the terms of the law are: Lambert, mu0; Lommel-Seeliger,
    mu0 / (mu0 + mu); multiple scattering, the latter times H(mu0) H(mu) with H(x) = (1 + 2 x) / (1 + 2 x gamma),
    gamma = sqrt(1 - w), w = 0.21.

    References
    ----------
    Hapke (1981), Bidirectional reflectance spectroscopy 1: Theory, J. Geophys. Res. 86.
    """
    x0, y0, texel = grid
    altitude, tangent_from_camera, focal, centre_u, centre_v = eye
    sun_up, sun_flat, law, hapke = light
    node_row, node_column, slope_row, slope_column = nodes
    pool, table, shift = tiles
    albedo, albedo_step, mean_albedo, contrast = surface
    wide = radiance.shape[1]
    inverse = np.float32(1.0 / texel)
    i0 = np.float32(-x0 / texel)
    j0 = np.float32(-y0 / texel)
    one = np.float32(1.0)
    half = np.float32(0.5)
    zero = np.float32(0.0)
    two = np.float32(2.0)
    next_one = np.uint64(1)
    next_two = np.uint64(2)
    next_row = np.uint64(depth.shape[1])
    up = np.float32(sun_up)
    flat = np.float32(sun_flat)
    many = np.float32(law.shape[1] - 2)
    gamma = np.float32(math.sqrt(1.0 - 0.21))
    mask = np.uint64((1 << shift) - 1)
    tile_shift = np.uint64(shift)
    albedo_mask = np.uint64((1 << (shift - albedo_step)) - 1)
    albedo_scale = np.float32(1.0 / (1 << albedo_step))
    mean = np.float32(mean_albedo)
    spread = np.float32(contrast)
    share = np.float32(1.0 / NODE_STEP)
    per_texel = share * inverse
    last_ni = np.int32(node_row.shape[0] - 2)
    last_nj = np.int32(node_row.shape[1] - 2)
    stride = np.int32(depth.shape[1])
    node_stride = np.int32(node_row.shape[1])
    next_node_row = np.uint64(node_row.shape[1])
    rises = depth.ravel()
    node_r = node_row.ravel()
    node_c = node_column.ravel()
    slope_r = slope_row.ravel()
    slope_c = slope_column.ravel()
    radius = np.float32(1.0 / MOON_RADIUS_M)
    high = np.float32(altitude)
    ax = np.float32(tangent_from_camera[0, 0] / focal)
    ay = np.float32(tangent_from_camera[1, 0] / focal)
    az = np.float32(tangent_from_camera[2, 0] / focal)
    per_pixel = np.float32(1.0 / focal)
    cx = np.float32(tangent_from_camera[0, 1] / focal)
    cy = np.float32(tangent_from_camera[1, 1] / focal)
    cz = np.float32(tangent_from_camera[2, 1] / focal)
    work = np.empty(_WORK, np.float32)
    places = np.empty(_PLACES, np.int32)
    for v in range(radiance.shape[0]):
        b = (v - centre_v) / focal
        a = -centre_u / focal
        bx = np.float32(
            tangent_from_camera[0, 0] * a + tangent_from_camera[0, 1] * b + tangent_from_camera[0, 2]
        )
        by = np.float32(
            tangent_from_camera[1, 0] * a + tangent_from_camera[1, 1] * b + tangent_from_camera[1, 2]
        )
        bz = np.float32(
            tangent_from_camera[2, 0] * a + tangent_from_camera[2, 1] * b + tangent_from_camera[2, 2]
        )
        left = np.float32(a)
        square = np.float32(b * b + 1.0)
        # As in `_trace_kernel`: look-ups apart from arithmetic.
        for k in range(wide):
            work[k + _DEPTH] = range_m[v, k]
        for k in range(wide):
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
        for k in range(wide):
            if work[k + _DEPTH] < zero:
                work[k + _RISE] = -two
                continue
            m = np.uint64(places[k])
            fi = work[k + _ROW_PART]
            fj = work[k + _COLUMN_PART]
            top = rises[m] + fj * (rises[m + next_one] - rises[m])
            m += next_row
            low = rises[m] + fj * (rises[m + next_one] - rises[m])
            rise = top + fi * (low - top)
            work[k + _RISE] = rise
            if rise <= -one:
                continue
            # Place on the terrain's grid and how it changes along x and y.
            m = np.uint64(places[k + _NODE])
            m1 = m + next_one
            m2 = m + next_node_row
            m3 = m2 + next_one
            ti = work[k + _NODE_ROW_PART]
            tj = work[k + _NODE_COLUMN_PART]
            h = work[k + _HEIGHT]
            r00 = node_r[m] + h * slope_r[m]
            r01 = node_r[m1] + h * slope_r[m1]
            r10 = node_r[m2] + h * slope_r[m2]
            r11 = node_r[m3] + h * slope_r[m3]
            c00 = node_c[m] + h * slope_c[m]
            c01 = node_c[m1] + h * slope_c[m1]
            c10 = node_c[m2] + h * slope_c[m2]
            c11 = node_c[m3] + h * slope_c[m3]
            ra = r00 + tj * (r01 - r00)
            rb = r10 + tj * (r11 - r10)
            ca = c00 + tj * (c01 - c00)
            cb = c10 + tj * (c11 - c10)
            r = ra + ti * (rb - ra)
            c = ca + ti * (cb - ca)
            p = np.uint64(r)
            q = np.uint64(c)
            fi = r - np.float32(p)
            fj = c - np.float32(q)
            slot = np.uint64(table[p >> tile_shift, q >> tile_shift])
            p = p & mask
            q = q & mask
            p1 = p + next_one
            q1 = q + next_one
            p2 = p + next_two
            q2 = q + next_two
            p3 = p2 + next_one
            q3 = q2 + next_one
            h11 = pool[slot, p1, q1]
            h12 = pool[slot, p1, q2]
            h21 = pool[slot, p2, q1]
            h22 = pool[slot, p2, q2]
            w11 = fi * fj
            w01 = fj - w11
            w10 = fi - w11
            w00 = one - fi - w01
            along_row = w00 * (h21 - pool[slot, p, q1]) + w01 * (h22 - pool[slot, p, q2])
            along_row += w10 * (pool[slot, p3, q1] - h11) + w11 * (pool[slot, p3, q2] - h12)
            along_column = w00 * (h12 - pool[slot, p1, q]) + w01 * (pool[slot, p1, q3] - h11)
            along_column += w10 * (h22 - pool[slot, p2, q]) + w11 * (pool[slot, p2, q3] - h21)
            scale = half * per_texel
            work[k + _SLOPE_X] = scale * (along_row * (rb - ra) + along_column * (cb - ca))
            work[k + _SLOPE_Y] = scale * (
                along_row * (r01 - r00 + ti * (r11 - r10 - r01 + r00))
                + along_column * (c01 - c00 + ti * (c11 - c10 - c01 + c00))
            )
            r *= albedo_scale
            c *= albedo_scale
            p = np.uint64(r)
            q = np.uint64(c)
            fi = r - np.float32(p)
            fj = c - np.float32(q)
            p = p & albedo_mask
            q = q & albedo_mask
            p1 = p + next_one
            q1 = q + next_one
            a0 = albedo[slot, p, q] + fj * (albedo[slot, p, q1] - albedo[slot, p, q])
            a1 = albedo[slot, p1, q] + fj * (albedo[slot, p1, q1] - albedo[slot, p1, q])
            work[k + _ALBEDO] = mean + spread * (a0 + fi * (a1 - a0) - mean)
        for k in range(wide):
            c = np.float32(k)
            x = work[k + _X]
            y = work[k + _Y]
            z = work[k + _Z] * radius
            gx = work[k + _SLOPE_X]
            gy = work[k + _SLOPE_Y]
            # The nodes hold places at fixed height; the ground's own rise moves the place a little.
            lean = one / (one + (gx * x + gy * y) * radius)
            stretch = one + (work[k + _HEIGHT] * radius - z) * (one - z)
            steep = radius * (one - z + z * z)
            gx = gx * lean * stretch - x * steep
            gy = gy * lean * stretch - y * steep
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
                below = np.float32(b) + d * per_pixel
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
            work[k + _PHASE] = min(max((vz * up - vx * flat + one) * half, zero), one) * many
            work[k + _LAMBERT] = mu0
            work[k + _SEELIGER] = both
            work[k + _MULTIPLE] = both * h0 * h1
            work[k + _DEPTH] = work[k + _DEPTH] * length if work[k + _DEPTH] >= zero else np.float32(np.nan)
        for k in range(wide):
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
