"""Compiled loops of the fast renderer: tangent grid, shadow sweep, per-pixel hit and shade.  See `renderer` for the frame."""

from __future__ import annotations

import math

import numpy as np

from lunar._compile import njit
from lunar.constants import MOON_RADIUS_M

NODE_STEP = 32
BLOCK_SHIFT = 3
SHARP = 4.0


@njit(fastmath=True, error_model="numpy")
def fill_grid(  # type: ignore[no-untyped-def]
    heights, node_row, node_column, slope_row, slope_column, pool, table, shift, x0, y0, texel
):
    """Fill ``heights`` with z of the ground in the tangent frame.

    A grid point sees ground of height h at the place ``node + h * slope``; the height of the row before is close enough
    to start from (it is off by one texel's relief, which moves the place by a few metres).
    """
    rows, columns = heights.shape
    mask = (1 << shift) - 1
    ground = np.zeros(columns, np.float32)
    inverse_radius = np.float32(1.0 / MOON_RADIUS_M)
    share = np.float32(1.0 / NODE_STEP)
    passes = 2
    for i in range(rows):
        ni = min(i // NODE_STEP, node_row.shape[0] - 2)
        fi = np.float32(i - ni * NODE_STEP) * share
        x = np.float32(x0 + i * texel)
        for _ in range(passes):
            for nj in range(node_row.shape[1] - 1):
                first = nj * NODE_STEP
                last = min(first + NODE_STEP, columns) if nj < node_row.shape[1] - 2 else columns
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
                for j in range(first, last):
                    k = np.float32(j - first)
                    h = ground[j]
                    r = r0 + k * r1 + h * (sr + k * dsr)
                    c = c0 + k * c1 + h * (sc + k * dsc)
                    a = int(r)
                    b = int(c)
                    fr = r - np.float32(a)
                    fc = c - np.float32(b)
                    slot = table[a >> shift, b >> shift]
                    a &= mask
                    b &= mask
                    top = pool[slot, a, b] + fc * (pool[slot, a, b + 1] - pool[slot, a, b])
                    low = pool[slot, a + 1, b] + fc * (pool[slot, a + 1, b + 1] - pool[slot, a + 1, b])
                    ground[j] = top + fr * (low - top)
        passes = 1
        for j in range(columns):
            h = ground[j]
            y = np.float32(y0) + np.float32(j) * np.float32(texel)
            inverse = inverse_radius * (np.float32(1.0) - h * inverse_radius)
            u = (x * x + y * y) * inverse
            v = u * inverse
            drop = (
                np.float32(0.5)
                * u
                * (np.float32(1.0) + np.float32(0.25) * v * (np.float32(1.0) + np.float32(0.5) * v))
            )
            heights[i, j] = h - drop


@njit(fastmath=True, error_model="numpy")
def sweep_shadows(heights, shadow, distance, texel, tangent, penumbra, depth):  # type: ignore[no-untyped-def]
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


@njit(fastmath=True, error_model="numpy")
def block_peaks(heights):  # type: ignore[no-untyped-def]
    """Highest z of every block of 8 x 8 grid cells (their borders included)."""
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


@njit(fastmath=True, error_model="numpy", inline="always")
def _bilinear(grid, i, j):  # type: ignore[no-untyped-def]
    a = int(i)
    b = int(j)
    fi = i - a
    fj = j - b
    top = grid[a, b] + fj * (grid[a, b + 1] - grid[a, b])
    low = grid[a + 1, b] + fj * (grid[a + 1, b + 1] - grid[a + 1, b])
    return top + fi * (low - top)


@njit(fastmath=True, error_model="numpy")
def find_hit(heights, peaks, i0, j0, z0, di, dj, dz, start, stop):  # type: ignore[no-untyped-def]
    """First parameter t in [start, stop] at which a ray (i0 + t di, j0 + t dj, z0 + t dz) meets the ground, or -1.

    Blocks whose highest point lies under the ray are leapt over; inside the others the ray goes by one texel.
    """
    speed = max(abs(di), abs(dj))
    size = 1 << BLOCK_SHIFT
    inverse_i = 1.0 / di if di != 0.0 else 1.0e30
    inverse_j = 1.0 / dj if dj != 0.0 else 1.0e30
    ahead_i = 1 if di > 0.0 else 0
    ahead_j = 1 if dj > 0.0 else 0
    nudge = 1.0e-4 / max(speed, 1.0e-12)
    t = start
    while t < stop:
        bi = min(max(int(i0 + t * di) >> BLOCK_SHIFT, 0), peaks.shape[0] - 1)
        bj = min(max(int(j0 + t * dj) >> BLOCK_SHIFT, 0), peaks.shape[1] - 1)
        leave = min(((bi + ahead_i) * size - i0) * inverse_i, ((bj + ahead_j) * size - j0) * inverse_j)
        if di == 0.0 and dj == 0.0:
            leave = stop
        leave = min(max(leave, t) + nudge, stop)
        top = peaks[bi, bj]
        if min(z0 + t * dz, z0 + leave * dz) <= top:
            begin = t
            if dz < 0.0:
                begin = min(max(t, (top - z0) / dz), leave)
            count = max(1, int(math.ceil((leave - begin) * speed)))
            step = (leave - begin) / count
            above = z0 + begin * dz - _bilinear(heights, i0 + begin * di, j0 + begin * dj)
            if above <= 0.0:
                return begin
            for n in range(1, count + 1):
                end = begin + step
                under = z0 + end * dz - _bilinear(heights, i0 + end * di, j0 + end * dj)
                if under <= 0.0:
                    # Bracketed: false position, three times (Illinois halving keeps it from sticking).
                    for _ in range(4):
                        middle = begin + (end - begin) * above / (above - under)
                        value = z0 + middle * dz - _bilinear(heights, i0 + middle * di, j0 + middle * dj)
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
                    return begin + (end - begin) * above / (above - under)
                begin = end
                above = under
        t = leave
    return -1.0


@njit(fastmath=True, error_model="numpy")
def shade_pixels(  # type: ignore[no-untyped-def]
    heights,
    depth,
    peaks,
    x0,
    y0,
    texel,
    altitude,
    tangent_from_camera,
    focal,
    centre_u,
    centre_v,
    sun_up,
    sun_flat,
    law,
    multiple,
    node_row,
    node_column,
    albedo,
    table,
    shift,
    albedo_step,
    mean_albedo,
    contrast,
    radiance,
    lit,
    range_m,
):
    """Fill the three pictures.  The Sun stands at -x: its vector is (-sun_flat, 0, sun_up)."""
    rows, columns = heights.shape
    inverse = 1.0 / texel
    i0 = -x0 * inverse
    j0 = -y0 * inverse
    top = peaks.max()
    low = heights.min()
    albedo_shift = shift - albedo_step
    albedo_mask = (1 << albedo_shift) - 1
    albedo_scale = np.float32(1.0 / (1 << albedo_step))
    share = 1.0 / NODE_STEP
    one = np.float32(1.0)
    half = np.float32(0.5)
    up = np.float32(sun_up)
    flat = np.float32(sun_flat)
    half_inverse = np.float32(0.5 * inverse)
    many = law.shape[1] - 2
    gamma = np.float32(math.sqrt(1.0 - 0.21))
    hapke = multiple > 0.0
    for v in range(radiance.shape[0]):
        for u in range(radiance.shape[1]):
            a = (u - centre_u) / focal
            b = (v - centre_v) / focal
            dx = tangent_from_camera[0, 0] * a + tangent_from_camera[0, 1] * b + tangent_from_camera[0, 2]
            dy = tangent_from_camera[1, 0] * a + tangent_from_camera[1, 1] * b + tangent_from_camera[1, 2]
            dz = tangent_from_camera[2, 0] * a + tangent_from_camera[2, 1] * b + tangent_from_camera[2, 2]
            di = dx * inverse
            dj = dy * inverse
            start = 0.0
            stop = 1.0e9
            if dz < -1.0e-9:
                start = max(0.0, (top - altitude) / dz)
                stop = (low - 1.0 - altitude) / dz
            # Keep within the grid, one texel inside for the gradients.
            if di > 1.0e-12:
                stop = min(stop, (rows - 2.001 - i0) / di)
            elif di < -1.0e-12:
                stop = min(stop, (1.001 - i0) / di)
            if dj > 1.0e-12:
                stop = min(stop, (columns - 2.001 - j0) / dj)
            elif dj < -1.0e-12:
                stop = min(stop, (1.001 - j0) / dj)
            t = find_hit(heights, peaks, i0, j0, altitude, di, dj, dz, start, stop) if start < stop else -1.0
            if t < 0.0:
                radiance[v, u] = np.float32(0.0)
                lit[v, u] = np.float32(0.0)
                range_m[v, u] = np.float32(np.nan)
                continue
            i = i0 + t * di
            j = j0 + t * dj
            length = math.sqrt(a * a + b * b + 1.0)
            range_m[v, u] = t * length
            p = int(i)
            q = int(j)
            fi = np.float32(i - p)
            fj = np.float32(j - q)
            w00 = (one - fi) * (one - fj)
            w01 = (one - fi) * fj
            w10 = fi * (one - fj)
            w11 = fi * fj
            rise = (
                w00 * depth[p, q] + w01 * depth[p, q + 1] + w10 * depth[p + 1, q] + w11 * depth[p + 1, q + 1]
            )
            gx = half_inverse * (
                w00 * (heights[p + 1, q] - heights[p - 1, q])
                + w01 * (heights[p + 1, q + 1] - heights[p - 1, q + 1])
                + w10 * (heights[p + 2, q] - heights[p, q])
                + w11 * (heights[p + 2, q + 1] - heights[p, q + 1])
            )
            gy = half_inverse * (
                w00 * (heights[p, q + 1] - heights[p, q - 1])
                + w01 * (heights[p, q + 2] - heights[p, q])
                + w10 * (heights[p + 1, q + 1] - heights[p + 1, q - 1])
                + w11 * (heights[p + 1, q + 2] - heights[p + 1, q])
            )
            norm = one / math.sqrt(gx * gx + gy * gy + one)
            mu0 = (gx * flat + up) * norm
            sun = np.float32(0.0)
            if rise > -one and mu0 > np.float32(0.0):
                s = min(rise, one)
                sun = half + s * (np.float32(0.75) - np.float32(0.25) * s * s)
            lit[v, u] = sun
            if sun <= np.float32(0.0):
                radiance[v, u] = np.float32(0.0)
                continue
            reach = np.float32(1.0 / length)
            vx = np.float32(-dx) * reach
            vy = np.float32(-dy) * reach
            vz = np.float32(-dz) * reach
            mu = max((vz - gx * vx - gy * vy) * norm, np.float32(0.02))
            place = min(max((vz * up - vx * flat + one) * half, np.float32(0.0)), one) * np.float32(many)
            k = int(place)
            f = place - np.float32(k)
            seeliger = law[0, k] + f * (law[0, k + 1] - law[0, k])
            lambert = law[1, k] + f * (law[1, k + 1] - law[1, k])
            value = seeliger * mu0 / (mu0 + mu) + lambert * mu0
            if hapke:
                h0 = (one + np.float32(2.0) * mu0) / (one + np.float32(2.0) * mu0 * gamma)
                h1 = (one + np.float32(2.0) * mu) / (one + np.float32(2.0) * mu * gamma)
                value += law[2, k] * h0 * h1 * mu0 / (mu0 + mu)
            ni = min(p // NODE_STEP, node_row.shape[0] - 2)
            nj = min(q // NODE_STEP, node_row.shape[1] - 2)
            ti = np.float32((i - ni * NODE_STEP) * share)
            tj = np.float32((j - nj * NODE_STEP) * share)
            w00 = (one - ti) * (one - tj)
            w01 = (one - ti) * tj
            w10 = ti * (one - tj)
            w11 = ti * tj
            r = albedo_scale * (
                w00 * node_row[ni, nj]
                + w01 * node_row[ni, nj + 1]
                + w10 * node_row[ni + 1, nj]
                + w11 * node_row[ni + 1, nj + 1]
            )
            c = albedo_scale * (
                w00 * node_column[ni, nj]
                + w01 * node_column[ni, nj + 1]
                + w10 * node_column[ni + 1, nj]
                + w11 * node_column[ni + 1, nj + 1]
            )
            p = int(r)
            q = int(c)
            fi = r - np.float32(p)
            fj = c - np.float32(q)
            slot = table[p >> albedo_shift, q >> albedo_shift]
            p &= albedo_mask
            q &= albedo_mask
            a0 = albedo[slot, p, q] + fj * (albedo[slot, p, q + 1] - albedo[slot, p, q])
            a1 = albedo[slot, p + 1, q] + fj * (albedo[slot, p + 1, q + 1] - albedo[slot, p + 1, q])
            shade = np.float32(mean_albedo) + np.float32(contrast) * (
                a0 + fi * (a1 - a0) - np.float32(mean_albedo)
            )
            radiance[v, u] = shade * value * sun
