"""Compiled loops of the fast renderer and the sensor; `renderer` explains the frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lunar._compile import njit
from lunar.constants import MOON_RADIUS_M

NODE_STEP = 32
BLOCK_SHIFT = 3
SHARP = 4.0
CLOSE_TEXELS = 0.04
"""A clearance that ends the search for a hit: a hundredth of a pixel at the corners of a 120 degree picture."""


@njit(fastmath=True, error_model="numpy", nogil=True)
def fill_grid(
    heights: Any,
    node_row: Any,
    node_column: Any,
    slope_row: Any,
    slope_column: Any,
    pool: Any,
    table: Any,
    shift: Any,
    x0: Any,
    y0: Any,
    texel: Any,
) -> Any:
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
                    # A tile's own pixels start at (1, 1).
                    a = (a & mask) + 1
                    b = (b & mask) + 1
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


@njit(fastmath=True, error_model="numpy", nogil=True)
def sweep_shadows(
    heights: Any, shadow: Any, distance: Any, texel: Any, tangent: Any, penumbra: Any, depth: Any
) -> Any:
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


@njit(fastmath=True, error_model="numpy", nogil=True)
def block_peaks(heights: Any) -> Any:
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
def _clearance(heights: Any, i: Any, j: Any, z: Any) -> Any:
    """How far a point lies above the ground, bilinear."""
    a = np.uint64(i)
    b = np.uint64(j)
    one = np.uint64(1)
    fi = np.float32(i - a)
    fj = np.float32(j - b)
    top = heights[a, b] + fj * (heights[a, b + one] - heights[a, b])
    low = heights[a + one, b] + fj * (heights[a + one, b + one] - heights[a + one, b])
    return z - (top + fi * (low - top))


@njit(fastmath=True, error_model="numpy", nogil=True)
def find_hit(
    heights: Any, peaks: Any, i0: Any, j0: Any, z0: Any, di: Any, dj: Any, dz: Any, start: Any, stop: Any
) -> Any:
    """First parameter t in [start, stop] at which a ray (i0 + t di, j0 + t dj, z0 + t dz) meets the ground.

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
            # Bracketed: false position with the Illinois halving.
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
        rate = max((above - under) / (end - begin), slowest)
        if under < 0.3:
            return end + under / rate
        begin = end
        above = under
        steps += 1
    return -1.0


@njit(fastmath=True, error_model="numpy", nogil=True)
def trace_pixels(
    heights: Any,
    peaks: Any,
    x0: Any,
    y0: Any,
    texel: Any,
    altitude: Any,
    tangent_from_camera: Any,
    focal: Any,
    centre_u: Any,
    centre_v: Any,
    depth_along: Any,
) -> Any:
    """Fill ``depth_along`` (H, W) with the distance of the first hit along the boresight; -1 where there is none.

    The picture is walked outward from the nadir, in lines of four sectors.  The ray of a pixel passes above those
    of its two neighbours nearer the nadir, so the ground up to their hits is clear and the search starts at the
    nearer of them.  Three evaluations without a branch settle most pixels (many in flight at once); the others are
    searched one by one.
    """
    rows, columns = heights.shape
    high, wide = depth_along.shape
    flat = heights.ravel()
    inverse = 1.0 / texel
    i0 = np.float32(-x0 * inverse)
    j0 = np.float32(-y0 * inverse)
    top = float(peaks.max()) + 1.0
    low = float(heights.min()) - 1.0
    down = -tangent_from_camera[2, 2]
    nadir_u = wide // 2
    nadir_v = high // 2
    if down > 0.05:
        nadir_u = min(max(int(centre_u - focal * tangent_from_camera[2, 0] / down), 0), wide - 1)
        nadir_v = min(max(int(centre_v - focal * tangent_from_camera[2, 1] / down), 0), high - 1)
    longest = high + wide
    clear = np.empty(longest, np.float32)
    inner = np.empty(longest, np.float32)
    first = np.empty(longest, np.float32)
    found = np.empty(longest, np.float32)
    doubt = np.empty(longest, np.bool_)
    z0 = np.float32(altitude)
    last_i = np.float32(rows - 2.01)
    last_j = np.float32(columns - 2.01)
    near = np.float32(1.01)
    stride = np.int32(columns)
    close = np.float32(CLOSE_TEXELS * texel)
    tiny = np.float32(1.0e-9)
    zero = np.float32(0.0)
    next_one = np.uint64(1)
    next_row = np.uint64(columns)
    for sector in range(4):
        upright = sector < 2
        forward = sector % 2 == 0
        main0 = nadir_v if upright else nadir_u
        cross0 = nadir_u if upright else nadir_v
        main_size = high if upright else wide
        cross_size = wide if upright else high
        lines = main_size - main0 if forward else main0 + 1
        for n in range(lines):
            main = main0 + n if forward else main0 - n
            # Left and right sectors leave the diagonals to the others.
            half = n if upright else n - 1
            if half < 0:
                continue
            begin = max(cross0 - half, 0)
            end = min(cross0 + half, cross_size - 1) + 1
            for k in range(begin, end):
                # Where the inner line was shorter its end stands in.
                if n == 0 or (not upright and n == 1):
                    clear[k] = zero
                else:
                    short = half - 1
                    left = max(cross0 - short, 0)
                    right = min(cross0 + short, cross_size - 1)
                    same = min(max(k, left), right)
                    toward = k - 1 if k > cross0 else (k + 1 if k < cross0 else k)
                    toward = min(max(toward, left), right)
                    clear[k] = min(inner[same], inner[toward])
            if upright:
                ax = tangent_from_camera[0, 0] / focal
                ay = tangent_from_camera[1, 0] / focal
                az = tangent_from_camera[2, 0] / focal
                b = (main - centre_v) / focal
                bx = tangent_from_camera[0, 1] * b + tangent_from_camera[0, 2] - ax * centre_u
                by = tangent_from_camera[1, 1] * b + tangent_from_camera[1, 2] - ay * centre_u
                bz = tangent_from_camera[2, 1] * b + tangent_from_camera[2, 2] - az * centre_u
            else:
                ax = tangent_from_camera[0, 1] / focal
                ay = tangent_from_camera[1, 1] / focal
                az = tangent_from_camera[2, 1] / focal
                b = (main - centre_u) / focal
                bx = tangent_from_camera[0, 0] * b + tangent_from_camera[0, 2] - ax * centre_v
                by = tangent_from_camera[1, 0] * b + tangent_from_camera[1, 2] - ay * centre_v
                bz = tangent_from_camera[2, 0] * b + tangent_from_camera[2, 2] - az * centre_v
            fax = np.float32(ax * inverse)
            fay = np.float32(ay * inverse)
            faz = np.float32(az)
            fbx = np.float32(bx * inverse)
            fby = np.float32(by * inverse)
            fbz = np.float32(bz)
            for k in range(begin, end):
                c = np.float32(k)
                di = fax * c + fbx
                dj = fay * c + fby
                fall = max(-(faz * c + fbz), np.float32(1.0e-3))
                out = np.float32(math.sqrt(di * di + dj * dj)) + tiny
                pace = np.float32(1.0) / out
                # Without inner neighbours the start is the height of the highest ground: wrong, and settled below.
                t0 = clear[k] * pace
                i = min(max(i0 + t0 * di, near), last_i)
                j = min(max(j0 + t0 * dj, near), last_j)
                p = np.int32(i)
                q = np.int32(j)
                m = np.uint64(p * stride + q)
                fj = j - np.float32(q)
                h0 = flat[m] + fj * (flat[m + next_one] - flat[m])
                h1 = flat[m + next_row] + fj * (flat[m + next_row + next_one] - flat[m + next_row])
                f0 = z0 - t0 * fall - (h0 + (i - np.float32(p)) * (h1 - h0))
                t1 = t0 + min(f0 / fall, pace)
                i = min(max(i0 + t1 * di, near), last_i)
                j = min(max(j0 + t1 * dj, near), last_j)
                p = np.int32(i)
                q = np.int32(j)
                m = np.uint64(p * stride + q)
                fj = j - np.float32(q)
                h0 = flat[m] + fj * (flat[m + next_one] - flat[m])
                h1 = flat[m + next_row] + fj * (flat[m + next_row + next_one] - flat[m + next_row])
                f1 = z0 - t1 * fall - (h0 + (i - np.float32(p)) * (h1 - h0))
                rate = max((f0 - f1) / max(t1 - t0, tiny), np.float32(0.25) * fall)
                t2 = t1 + min(max(f1 / rate, t0 - t1), pace)
                i = min(max(i0 + t2 * di, near), last_i)
                j = min(max(j0 + t2 * dj, near), last_j)
                p = np.int32(i)
                q = np.int32(j)
                m = np.uint64(p * stride + q)
                fj = j - np.float32(q)
                h0 = flat[m] + fj * (flat[m + next_one] - flat[m])
                h1 = flat[m + next_row] + fj * (flat[m + next_row + next_one] - flat[m + next_row])
                f2 = z0 - t2 * fall - (h0 + (i - np.float32(p)) * (h1 - h0))
                inside = i > near and i < last_i and j > near and j < last_j
                doubt[k] = not (f0 > zero and abs(f2) < close and inside)
                first[k] = t0 if f0 > zero else zero
                found[k] = t2 + f2 / rate
            for k in range(begin, end):
                c = np.float32(k)
                di = fax * c + fbx
                dj = fay * c + fby
                t = found[k]
                if doubt[k]:
                    t = _search(heights, peaks, i0, j0, altitude, di, dj, faz * c + fbz, first[k], top, low)
                if upright:
                    depth_along[main, k] = t
                else:
                    depth_along[k, main] = t
                inner[k] = t * np.float32(math.sqrt(di * di + dj * dj)) if t > zero else zero


@njit(fastmath=True, error_model="numpy", nogil=True)
def _search(
    heights: Any,
    peaks: Any,
    i0: Any,
    j0: Any,
    altitude: Any,
    di: Any,
    dj: Any,
    dz: Any,
    first: Any,
    top: Any,
    low: Any,
) -> Any:
    """First hit of one ray: from ``first`` if that is above ground, else from the highest ground down; -1 for none."""
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
    t = -2.0
    if first > start and first < stop:
        t = find_hit(heights, peaks, i0, j0, altitude, di, dj, dz, first, stop)
    if t == -2.0 and start < stop:
        t = find_hit(heights, peaks, i0, j0, altitude, di, dj, dz, start, stop)
    return t if t > 0.0 else -1.0


@njit(fastmath=True, error_model="numpy", nogil=True)
def shade_pixels(
    depth: Any,
    x0: Any,
    y0: Any,
    texel: Any,
    altitude: Any,
    tangent_from_camera: Any,
    focal: Any,
    centre_u: Any,
    centre_v: Any,
    sun_up: Any,
    sun_flat: Any,
    law: Any,
    hapke: Any,
    node_row: Any,
    node_column: Any,
    slope_row: Any,
    slope_column: Any,
    pool: Any,
    albedo: Any,
    table: Any,
    shift: Any,
    albedo_step: Any,
    mean_albedo: Any,
    contrast: Any,
    radiance: Any,
    lit: Any,
    range_m: Any,
) -> Any:
    """Fill the pictures from ``range_m``, which comes as the depth along the boresight.

    The Sun stands at -x: its vector is (-sun_flat, 0, sun_up).  Slopes come from the terrain's own pixels: the tangent
    grid would blur them once more.
    """
    inverse = 1.0 / texel
    i0 = -x0 * inverse
    j0 = -y0 * inverse
    one = np.float32(1.0)
    half = np.float32(0.5)
    zero = np.float32(0.0)
    next_one = np.uint64(1)
    next_two = np.uint64(2)
    up = np.float32(sun_up)
    flat = np.float32(sun_flat)
    many = np.float32(law.shape[1] - 2)
    gamma = np.float32(math.sqrt(1.0 - 0.21))
    mask = np.uint64((1 << shift) - 1)
    tile_shift = np.uint64(shift)
    albedo_mask = np.uint64((1 << (shift - albedo_step)) - 1)
    albedo_scale = np.float32(1.0 / (1 << albedo_step))
    share = 1.0 / NODE_STEP
    per_texel = np.float32(inverse / NODE_STEP)
    last_ni = node_row.shape[0] - 2
    last_nj = node_row.shape[1] - 2
    for v in range(radiance.shape[0]):
        b = (v - centre_v) / focal
        for u in range(radiance.shape[1]):
            a = (u - centre_u) / focal
            t = np.float64(range_m[v, u])
            if t < 0.0:
                radiance[v, u] = zero
                lit[v, u] = zero
                range_m[v, u] = np.float32(np.nan)
                continue
            dx = tangent_from_camera[0, 0] * a + tangent_from_camera[0, 1] * b + tangent_from_camera[0, 2]
            dy = tangent_from_camera[1, 0] * a + tangent_from_camera[1, 1] * b + tangent_from_camera[1, 2]
            dz = tangent_from_camera[2, 0] * a + tangent_from_camera[2, 1] * b + tangent_from_camera[2, 2]
            x = t * dx
            y = t * dy
            z = altitude + t * dz
            i = i0 + x * inverse
            j = j0 + y * inverse
            length = np.float32(math.sqrt(a * a + b * b + 1.0))
            range_m[v, u] = np.float32(t) * length
            p = np.uint64(i)
            q = np.uint64(j)
            fi = np.float32(i - p)
            fj = np.float32(j - q)
            p1 = p + next_one
            q1 = q + next_one
            top = depth[p, q] + fj * (depth[p, q1] - depth[p, q])
            low = depth[p1, q] + fj * (depth[p1, q1] - depth[p1, q])
            rise = top + fi * (low - top)
            if rise <= -one:
                lit[v, u] = zero
                radiance[v, u] = zero
                continue
            # Place on the terrain's grid and how it changes along x and y.
            ni = np.uint64(min(int(i) // NODE_STEP, last_ni))
            nj = np.uint64(min(int(j) // NODE_STEP, last_nj))
            ni1 = ni + next_one
            nj1 = nj + next_one
            ti = np.float32(i * share - ni)
            tj = np.float32(j * share - nj)
            base = math.sqrt(x * x + y * y + (MOON_RADIUS_M + z) * (MOON_RADIUS_M + z))
            h = np.float32(base - MOON_RADIUS_M)
            r00 = node_row[ni, nj] + h * slope_row[ni, nj]
            r01 = node_row[ni, nj1] + h * slope_row[ni, nj1]
            r10 = node_row[ni1, nj] + h * slope_row[ni1, nj]
            r11 = node_row[ni1, nj1] + h * slope_row[ni1, nj1]
            c00 = node_column[ni, nj] + h * slope_column[ni, nj]
            c01 = node_column[ni, nj1] + h * slope_column[ni, nj1]
            c10 = node_column[ni1, nj] + h * slope_column[ni1, nj]
            c11 = node_column[ni1, nj1] + h * slope_column[ni1, nj1]
            ra = r00 + tj * (r01 - r00)
            rb = r10 + tj * (r11 - r10)
            ca = c00 + tj * (c01 - c00)
            cb = c10 + tj * (c11 - c10)
            r = ra + ti * (rb - ra)
            c = ca + ti * (cb - ca)
            rx = (rb - ra) * per_texel
            cx = (cb - ca) * per_texel
            ry = (r01 - r00 + ti * (r11 - r10 - r01 + r00)) * per_texel
            cy = (c01 - c00 + ti * (c11 - c10 - c01 + c00)) * per_texel
            p = np.uint64(r)
            q = np.uint64(c)
            fi = r - np.float32(p)
            fj = c - np.float32(q)
            slot = table[p >> tile_shift, q >> tile_shift]
            tile = pool[slot]
            p = p & mask
            q = q & mask
            p1 = p + next_one
            q1 = q + next_one
            p2 = p + next_two
            q2 = q + next_two
            p3 = p2 + next_one
            q3 = q2 + next_one
            h11 = tile[p1, q1]
            h12 = tile[p1, q2]
            h21 = tile[p2, q1]
            h22 = tile[p2, q2]
            w11 = fi * fj
            w01 = fj - w11
            w10 = fi - w11
            w00 = one - fi - w01
            along_row = half * (
                w00 * (h21 - tile[p, q1])
                + w01 * (h22 - tile[p, q2])
                + w10 * (tile[p3, q1] - h11)
                + w11 * (tile[p3, q2] - h12)
            )
            along_column = half * (
                w00 * (h12 - tile[p1, q])
                + w01 * (tile[p1, q3] - h11)
                + w10 * (h22 - tile[p2, q])
                + w11 * (tile[p2, q3] - h21)
            )
            gx = along_row * rx + along_column * cx
            gy = along_row * ry + along_column * cy
            # The nodes hold places at fixed height; the ground's own rise moves the place a little.
            sx = np.float32(x)
            sy = np.float32(y)
            inverse_base = np.float32(1.0 / base)
            lean = one / (one + (gx * sx + gy * sy) * inverse_base)
            steep = np.float32(1.0 / (MOON_RADIUS_M + z))
            gx = (np.float32(base) * gx * lean - sx) * steep
            gy = (np.float32(base) * gy * lean - sy) * steep
            norm = one / np.float32(math.sqrt(gx * gx + gy * gy + one))
            mu0 = (gx * flat + up) * norm
            if mu0 <= zero:
                lit[v, u] = zero
                radiance[v, u] = zero
                continue
            s = min(rise, one)
            sun = half + s * (np.float32(0.75) - np.float32(0.25) * s * s)
            lit[v, u] = sun
            reach = one / length
            vx = np.float32(-dx) * reach
            vy = np.float32(-dy) * reach
            vz = np.float32(-dz) * reach
            mu = max((vz - gx * vx - gy * vy) * norm, np.float32(0.02))
            place = min(max((vz * up - vx * flat + one) * half, zero), one) * many
            k = np.uint64(place)
            f = place - np.float32(k)
            seeliger = law[0, k] + f * (law[0, k + next_one] - law[0, k])
            lambert = law[1, k] + f * (law[1, k + next_one] - law[1, k])
            both = mu0 / (mu0 + mu)
            value = seeliger * both + lambert * mu0
            if hapke:
                h0 = (one + np.float32(2.0) * mu0) / (one + np.float32(2.0) * mu0 * gamma)
                h1 = (one + np.float32(2.0) * mu) / (one + np.float32(2.0) * mu * gamma)
                value += law[2, k] * h0 * h1 * both
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
            paint = albedo[slot]
            a0 = paint[p, q] + fj * (paint[p, q1] - paint[p, q])
            a1 = paint[p1, q] + fj * (paint[p1, q1] - paint[p1, q])
            shade = np.float32(mean_albedo) + np.float32(contrast) * (
                a0 + fi * (a1 - a0) - np.float32(mean_albedo)
            )
            radiance[v, u] = shade * value * sun


@njit(fastmath=True, error_model="numpy", nogil=True)
def read_out(
    signal: Any,
    noise: Any,
    colour: Any,
    full_well: Any,
    dark: Any,
    read_noise: Any,
    offset: Any,
    transfer: Any,
    out: Any,
) -> Any:
    """Fill ``out`` (H, W, 3) with levels of ``transfer``: a signal in shares of full scale plus shot and read noise."""
    last = np.float32(transfer.size - 1)
    well = np.float32(full_well)
    ground = np.float32(dark)
    floor = np.float32(read_noise * read_noise)
    scale = last / well
    black = np.float32(offset) * last + np.float32(0.5)
    zero = np.float32(0.0)
    for i in range(signal.shape[0]):
        for j in range(signal.shape[1]):
            electrons = min(max(signal[i, j], zero), np.float32(1.0)) * well + ground
            deviation = np.float32(math.sqrt(electrons + floor))
            for k in range(3):
                level = (colour[k] * electrons + deviation * noise[i, j, k]) * scale + black
                out[i, j, k] = transfer[np.uint64(min(max(level, zero), last))]
