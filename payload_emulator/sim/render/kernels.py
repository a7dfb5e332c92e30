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
LINE = 4096
"""Longest side of a picture."""

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
    mask = np.int32((1 << shift) - 1)
    size = np.int32(pool.shape[2])
    flat = pool.ravel()
    tile_size = np.uint64(pool.shape[1] * pool.shape[2])
    next_one = np.uint64(1)
    next_row = np.uint64(pool.shape[2])
    one = np.float32(1.0)
    half = np.float32(0.5)
    inverse_radius = np.float32(1.0 / MOON_RADIUS_M)
    share = np.float32(1.0 / NODE_STEP)
    step = np.float32(texel)
    left = np.float32(y0)
    # Rows of the buffer: height of the ground, fractions of row and column, the four corners.
    work = np.zeros(7 * LINE, np.float32)
    places = np.empty(3 * LINE, np.int32)
    for i in range(rows):
        ni = min(i // NODE_STEP, node_row.shape[0] - 2)
        fi = np.float32(i - ni * NODE_STEP) * share
        x2 = np.float32((x0 + i * texel) * (x0 + i * texel))
        for _ in range(2 if i == 0 else 1):
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
                    h = work[j]
                    r = r0 + f * r1 + h * (sr + f * dsr)
                    c = c0 + f * c1 + h * (sc + f * dsc)
                    a = np.int32(r)
                    b = np.int32(c)
                    work[j + LINE] = r - np.float32(a)
                    work[j + 2 * LINE] = c - np.float32(b)
                    places[j] = a >> shift
                    places[j + LINE] = b >> shift
                    # A tile's own pixels start at (1, 1).
                    places[j + 2 * LINE] = ((a & mask) + 1) * size + (b & mask) + 1
            for j in range(columns):
                slot = np.uint64(table[np.uint64(places[j]), np.uint64(places[j + LINE])])
                m = slot * tile_size + np.uint64(places[j + 2 * LINE])
                work[j + 3 * LINE] = flat[m]
                work[j + 4 * LINE] = flat[m + next_one]
                m += next_row
                work[j + 5 * LINE] = flat[m]
                work[j + 6 * LINE] = flat[m + next_one]
            for j in range(columns):
                fr = work[j + LINE]
                fc = work[j + 2 * LINE]
                top = work[j + 3 * LINE] + fc * (work[j + 4 * LINE] - work[j + 3 * LINE])
                low = work[j + 5 * LINE] + fc * (work[j + 6 * LINE] - work[j + 5 * LINE])
                work[j] = top + fr * (low - top)
        for j in range(columns):
            h = work[j]
            y = left + np.float32(j) * step
            inverse = inverse_radius * (one - h * inverse_radius)
            u = (x2 + y * y) * inverse
            v = u * inverse
            heights[i, j] = h - half * u * (one + half * half * v * (one + half * v))


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


@njit(fastmath=True, error_model="numpy", nogil=True)
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
    inner = np.empty(high + wide, np.float32)
    inner_z = np.empty(high + wide, np.float32)
    work = np.empty(9 * LINE, np.float32)
    places = np.empty(LINE, np.int32)
    z0 = np.float32(altitude)
    high_z = np.float32(top)
    quarter = np.float32(0.25)
    last_i = np.float32(rows - 2.01)
    last_j = np.float32(columns - 2.01)
    near = np.float32(1.01)
    stride = np.int32(columns)
    close = np.float32(CLOSE_TEXELS * texel)
    tiny = np.float32(1.0e-9)
    zero = np.float32(0.0)
    one = np.float32(1.0)
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
            count = end - begin
            for n_k in range(count):
                k = begin + n_k
                # Where the inner line was shorter its end stands in.
                if n == 0 or (not upright and n == 1):
                    work[n_k] = zero
                    work[n_k + LINE] = high_z
                else:
                    short = half - 1
                    left = max(cross0 - short, 0)
                    right = min(cross0 + short, cross_size - 1)
                    same = min(max(k, left), right)
                    toward = k - 1 if k > cross0 else (k + 1 if k < cross0 else k)
                    toward = min(max(toward, left), right)
                    nearer = same if inner[same] < inner[toward] else toward
                    work[n_k] = inner[nearer]
                    work[n_k + LINE] = inner_z[nearer]
            # The line runs along u in upright sectors, along v in the others.
            run = 0 if upright else 1
            ax = tangent_from_camera[0, run] / focal
            ay = tangent_from_camera[1, run] / focal
            az = tangent_from_camera[2, run] / focal
            start = centre_u if upright else centre_v
            b = (main - (centre_v if upright else centre_u)) / focal
            bx = tangent_from_camera[0, 1 - run] * b + tangent_from_camera[0, 2] - ax * start
            by = tangent_from_camera[1, 1 - run] * b + tangent_from_camera[1, 2] - ay * start
            bz = tangent_from_camera[2, 1 - run] * b + tangent_from_camera[2, 2] - az * start
            fax = np.float32(ax * inverse)
            fay = np.float32(ay * inverse)
            faz = np.float32(az)
            fbx = np.float32(bx * inverse + ax * inverse * begin)
            fby = np.float32(by * inverse + ay * inverse * begin)
            fbz = np.float32(bz + az * begin)
            # Newton steps on the bilinear ground, from where the ray passes the neighbour's height.  The loops are
            # split so that all but the look-ups run in vector registers; one buffer with rows a constant apart tells
            # the compiler that nothing overlaps.
            for k in range(count):
                c = np.float32(k)
                di = fax * c + fbx
                dj = fay * c + fby
                fall = max(-(faz * c + fbz), np.float32(1.0e-3))
                pace = one / (np.float32(math.sqrt(di * di + dj * dj)) + tiny)
                t0 = work[k] * pace
                work[k + 2 * LINE] = min(max((z0 - work[k + LINE]) / fall, t0), t0 + pace)
            for step in range(3):
                for k in range(count):
                    c = np.float32(k)
                    t = work[k + 2 * LINE]
                    i = min(max(i0 + t * (fax * c + fbx), near), last_i)
                    j = min(max(j0 + t * (fay * c + fby), near), last_j)
                    p = np.int32(i)
                    q = np.int32(j)
                    places[k] = p * stride + q
                    work[k + 3 * LINE] = i - np.float32(p)
                    work[k + 4 * LINE] = j - np.float32(q)
                for k in range(count):
                    m = np.uint64(places[k])
                    work[k + 5 * LINE] = flat[m]
                    work[k + 6 * LINE] = flat[m + next_one]
                    work[k + 7 * LINE] = flat[m + next_row]
                    work[k + 8 * LINE] = flat[m + next_row + next_one]
                for k in range(count):
                    c = np.float32(k)
                    di = fax * c + fbx
                    dj = fay * c + fby
                    fall = max(-(faz * c + fbz), np.float32(1.0e-3))
                    t = work[k + 2 * LINE]
                    fi = work[k + 3 * LINE]
                    fj = work[k + 4 * LINE]
                    h0 = work[k + 5 * LINE]
                    h1 = work[k + 6 * LINE] - h0
                    h2 = work[k + 7 * LINE] - h0
                    h3 = work[k + 8 * LINE] - h0 - h1 - h2
                    value = z0 - t * fall - (h0 + fi * h2 + fj * (h1 + fi * h3))
                    rate = max(fall + (h2 + fj * h3) * di + (h1 + fi * h3) * dj, quarter * fall)
                    pace = one / (np.float32(math.sqrt(di * di + dj * dj)) + tiny)
                    move = value / rate
                    if step < 2:
                        t0 = work[k] * pace
                        move = min(max(move, t0 - t), pace)
                    work[k + LINE] = value
                    work[k + 2 * LINE] = t + move
            for k in range(count):
                c = np.float32(k)
                di = fax * c + fbx
                dj = fay * c + fby
                t = work[k + 2 * LINE]
                i = i0 + t * di
                j = j0 + t * dj
                out = np.float32(math.sqrt(di * di + dj * dj)) + tiny
                if not (abs(work[k + LINE]) < close and i > near and i < last_i and j > near and j < last_j):
                    t = _search(
                        heights, peaks, i0, j0, altitude, di, dj, faz * c + fbz, work[k] / out, top, low
                    )
                if upright:
                    depth_along[main, begin + k] = t
                else:
                    depth_along[begin + k, main] = t
                inner[begin + k] = t * out if t > zero else zero
                inner_z[begin + k] = z0 + t * (faz * c + fbz) if t > zero else high_z


@njit(fastmath=True, error_model="numpy", nogil=True)
def trace_shifted(
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
    shift_u: Any,
    shift_v: Any,
    depth_along: Any,
) -> Any:
    """As `trace_pixels` for a lens that shifts its pixels: the rays of a line no longer lie in a plane, so each pixel
    is searched on its own.
    """
    inverse = 1.0 / texel
    i0 = -x0 * inverse
    j0 = -y0 * inverse
    top = float(peaks.max()) + 1.0
    low = float(heights.min()) - 1.0
    eye = tangent_from_camera
    for v in range(depth_along.shape[0]):
        for u in range(depth_along.shape[1]):
            right = (u + shift_u[v, u] - centre_u) / focal
            below = (v + shift_v[v, u] - centre_v) / focal
            di = (eye[0, 0] * right + eye[0, 1] * below + eye[0, 2]) * inverse
            dj = (eye[1, 0] * right + eye[1, 1] * below + eye[1, 2]) * inverse
            dz = eye[2, 0] * right + eye[2, 1] * below + eye[2, 2]
            depth_along[v, u] = _search(heights, peaks, i0, j0, altitude, di, dj, dz, 0.0, top, low)


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
    shift_u: Any,
    shift_v: Any,
    radiance: Any,
    lit: Any,
    range_m: Any,
) -> Any:
    """Fill the pictures from ``range_m``, which comes as the depth along the boresight.

    ``shift_u`` and ``shift_v`` (H, W) are what a lens takes off its pixels' places, None for a lens without distortion.

    The Sun stands at -x: its vector is (-sun_flat, 0, sun_up).  Slopes come from the terrain's own pixels: the tangent
    grid would blur them once more.
    """
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
    work = np.empty(13 * LINE, np.float32)
    places = np.empty(2 * LINE, np.int32)
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
        # As in `trace_pixels`: look-ups apart from arithmetic, one buffer with rows a constant apart.
        for k in range(wide):
            work[k] = range_m[v, k]
        for k in range(wide):
            c = np.float32(k)
            t = max(work[k], zero)
            if shift_u is None:
                x = t * (ax * c + bx)
                y = t * (ay * c + by)
                z = high + t * (az * c + bz)
            else:
                c += shift_u[v, k]
                d = shift_v[v, k]
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
            places[k + LINE] = ni * node_stride + nj
            work[k + LINE] = x
            work[k + 2 * LINE] = y
            work[k + 3 * LINE] = z
            work[k + 4 * LINE] = i - np.float32(whole_i)
            work[k + 5 * LINE] = j - np.float32(whole_j)
            work[k + 6 * LINE] = i * share - np.float32(ni)
            work[k + 7 * LINE] = j * share - np.float32(nj)
            work[k + 8 * LINE] = z + half * bend * (one - half * half * bend * radius)
        for k in range(wide):
            if work[k] < zero:
                work[k + 9 * LINE] = -two
                continue
            m = np.uint64(places[k])
            fi = work[k + 4 * LINE]
            fj = work[k + 5 * LINE]
            top = rises[m] + fj * (rises[m + next_one] - rises[m])
            m += next_row
            low = rises[m] + fj * (rises[m + next_one] - rises[m])
            rise = top + fi * (low - top)
            work[k + 9 * LINE] = rise
            if rise <= -one:
                continue
            # Place on the terrain's grid and how it changes along x and y.
            m = np.uint64(places[k + LINE])
            m1 = m + next_one
            m2 = m + next_node_row
            m3 = m2 + next_one
            ti = work[k + 6 * LINE]
            tj = work[k + 7 * LINE]
            h = work[k + 8 * LINE]
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
            work[k + 4 * LINE] = scale * (along_row * (rb - ra) + along_column * (cb - ca))
            work[k + 5 * LINE] = scale * (
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
            work[k + 6 * LINE] = mean + spread * (a0 + fi * (a1 - a0) - mean)
        for k in range(wide):
            c = np.float32(k)
            x = work[k + LINE]
            y = work[k + 2 * LINE]
            z = work[k + 3 * LINE] * radius
            gx = work[k + 4 * LINE]
            gy = work[k + 5 * LINE]
            # The nodes hold places at fixed height; the ground's own rise moves the place a little.
            lean = one / (one + (gx * x + gy * y) * radius)
            stretch = one + (work[k + 8 * LINE] * radius - z) * (one - z)
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
                d = shift_v[v, k]
                right = left + c * per_pixel
                below = np.float32(b) + d * per_pixel
                length = np.float32(math.sqrt(right * right + below * below + one))
                reach = one / length
                vx = -(ax * c + cx * d + bx) * reach
                vy = -(ay * c + cy * d + by) * reach
                vz = -(az * c + cz * d + bz) * reach
            mu0 = (gx * flat + up) * norm
            mu = max((vz - gx * vx - gy * vy) * norm, np.float32(0.02))
            s = min(work[k + 9 * LINE], one)
            sun = half + s * (np.float32(0.75) - np.float32(0.25) * s * s)
            sun = sun if (s > -one and mu0 > zero) else zero
            mu0 = max(mu0, zero)
            both = mu0 / (mu0 + mu)
            h0 = (one + two * mu0) / (one + two * mu0 * gamma)
            h1 = (one + two * mu) / (one + two * mu * gamma)
            work[k + 9 * LINE] = sun
            work[k + 10 * LINE] = min(max((vz * up - vx * flat + one) * half, zero), one) * many
            work[k + LINE] = mu0
            work[k + 2 * LINE] = both
            work[k + 3 * LINE] = both * h0 * h1
            work[k] = work[k] * length if work[k] >= zero else np.float32(np.nan)
        for k in range(wide):
            sun = work[k + 9 * LINE]
            lit[v, k] = sun
            range_m[v, k] = work[k]
            value = zero
            if sun > zero:
                place = work[k + 10 * LINE]
                m = np.uint64(place)
                f = place - np.float32(m)
                seeliger = law[0, m] + f * (law[0, m + next_one] - law[0, m])
                lambert = law[1, m] + f * (law[1, m + next_one] - law[1, m])
                value = seeliger * work[k + 2 * LINE] + lambert * work[k + LINE]
                if hapke:
                    value += law[2, m] * work[k + 3 * LINE]
                value *= work[k + 6 * LINE] * sun
            radiance[v, k] = value


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
