"""Compiled loops of the terrain: seeded noise, resampling, stamped craters, look-ups in the tile pool.

Heights are metres above the map sphere.  A *grid pixel* is an area; its centre lies at latitude
``90 - (row + 0.5) / ppd`` and longitude ``(column + 0.5) / ppd`` degrees.
"""

import math

import numpy as np

from kernels.compiled import FAST, njit
from lunar.arrays import Float32Array, FloatArray, Int32Array, IntArray

PROFILE_REACH = 2.6
"""Distance from a crater's centre, in radii, at which its stamped profile ends."""

LATTICE_SHIFT = 32768.37
"""Keeps lattice coordinates positive down to waves of 53 m, and the planes of the lattice off the axes."""


@njit(ahead="f4[:, ::1], *4 * [f8[::1]], f8, f8, i8, f4[:, ::1]", **FAST)
def add_noise(
    out: Float32Array,
    cos_lat: FloatArray,
    sin_lat: FloatArray,
    cos_lon: FloatArray,
    sin_lon: FloatArray,
    frequency: float,
    amplitude: float,
    seed: int,
    gain: Float32Array,
) -> None:
    """Add one octave of gradient noise on the unit sphere: lattice cells per radian ``frequency``.

    The lattice lives in three dimensions, so the field has no seam at any meridian and no pinch at the poles;
    a value depends on the place and the seed alone.  ``gain`` scales it per pixel.
    """
    rows, columns = out.shape
    salt = np.uint32(seed)
    six = np.float32(6.0)
    ten = np.float32(10.0)
    fifteen = np.float32(15.0)
    one = np.float32(1.0)
    scale = np.float32(amplitude)
    # Lattice coordinates need doubles; the noise itself is made in a loop without any, twice as many at a time.
    fraction = np.empty(2 * columns, np.float32)
    cell = np.empty(2 * columns, np.uint32)
    for i in range(rows):
        ring = frequency * cos_lat[i]
        z = frequency * sin_lat[i] + LATTICE_SHIFT
        z_floor = math.floor(z)
        fz = np.float32(z - z_floor)
        fz1 = fz - one
        wz = fz * fz * fz * (fz * (fz * six - fifteen) + ten)
        hz0 = np.uint32(np.uint32(np.int32(z_floor)) * np.uint32(0xCB1AB31F)) ^ salt
        hz1 = np.uint32(np.uint32(np.int32(z_floor) + 1) * np.uint32(0xCB1AB31F)) ^ salt
        for j in range(columns):
            x = ring * cos_lon[j] + LATTICE_SHIFT
            y = ring * sin_lon[j] + LATTICE_SHIFT
            ix = np.int32(x)
            iy = np.int32(y)
            fraction[j] = np.float32(x - np.float64(ix))
            fraction[j + columns] = np.float32(y - np.float64(iy))
            cell[j] = np.uint32(ix)
            cell[j + columns] = np.uint32(iy)
        for j in range(columns):
            fx = fraction[j]
            fy = fraction[j + columns]
            wx = fx * fx * fx * (fx * (fx * six - fifteen) + ten)
            wy = fy * fy * fy * (fy * (fy * six - fifteen) + ten)
            hx0 = np.uint32(cell[j] * np.uint32(0x8DA6B343))
            hx1 = np.uint32(hx0 + np.uint32(0x8DA6B343))
            hy0 = np.uint32(cell[j + columns] * np.uint32(0xD8163841))
            hy1 = np.uint32(hy0 + np.uint32(0xD8163841))
            a = _corner(hx0 ^ hy0 ^ hz0, fx, fy, fz)
            b = _corner(hx1 ^ hy0 ^ hz0, fx - one, fy, fz)
            c = _corner(hx0 ^ hy1 ^ hz0, fx, fy - one, fz)
            d = _corner(hx1 ^ hy1 ^ hz0, fx - one, fy - one, fz)
            low = a + wx * (b - a) + wy * (c - a + wx * (a - b - c + d))
            a = _corner(hx0 ^ hy0 ^ hz1, fx, fy, fz1)
            b = _corner(hx1 ^ hy0 ^ hz1, fx - one, fy, fz1)
            c = _corner(hx0 ^ hy1 ^ hz1, fx, fy - one, fz1)
            d = _corner(hx1 ^ hy1 ^ hz1, fx - one, fy - one, fz1)
            high = a + wx * (b - a) + wy * (c - a + wx * (a - b - c + d))
            out[i, j] += gain[i, j] * scale * (low + wz * (high - low))


@njit(fastmath=True, nogil=True)
def _corner(h: np.uint32, dx: np.float32, dy: np.float32, dz: np.float32) -> np.float32:
    """Dot product of a corner's hashed gradient with the way from it; 2.2 makes the rms of the noise about one."""
    h = _mixed(h)
    k = np.float32(2.2 / 511.5)
    return k * (_component(h, 0) * dx + _component(h, 10) * dy + _component(h, 20) * dz)


@njit(inline="always")  # compiled in one piece with the loop: calls would round otherwise
def _mixed(h: np.uint32) -> np.uint32:
    """Return a well mixed hash of 32 bits: two rounds of exclusive or with a shift, times an odd number."""
    h = np.uint32(h ^ np.uint32(h >> np.uint32(15)))
    h = np.uint32(h * np.uint32(0x2C1B3C6D))
    h = np.uint32(h ^ np.uint32(h >> np.uint32(12)))
    h = np.uint32(h * np.uint32(0x297A2D39))
    return np.uint32(h ^ np.uint32(h >> np.uint32(15)))


@njit(inline="always")  # compiled in one piece with the loop: calls would round otherwise
def _component(h: np.uint32, shift: int) -> np.float32:
    """Return ten bits of a hash from ``shift`` up as a float from -511 to 512."""
    bits = np.uint32(h >> np.uint32(shift)) & np.uint32(1023)
    return np.float32(np.int32(bits)) - np.float32(511.0)


@njit(ahead="f4[:, ::1], *4 * [f8], f4[:, ::1]", **FAST)
def resample_cubic(
    source: Float32Array, first_row: float, row_step: float, first_column: float, column_step: float, out: Float32Array
) -> None:
    """Fill ``out`` with ``source`` at rows ``first_row + i * row_step`` (and likewise columns), Catmull-Rom.

    The caller leaves one source pixel before and two after the span asked for.
    """
    rows, columns = out.shape
    width = source.shape[1]
    line = np.empty(width, np.float32)
    for i in range(rows):
        r = first_row + i * row_step
        k = math.floor(r)
        t = np.float32(r - k)
        w0 = np.float32(0.5) * t * (t * (np.float32(2.0) - t) - np.float32(1.0))
        w1 = np.float32(0.5) * (t * t * (np.float32(3.0) * t - np.float32(5.0)) + np.float32(2.0))
        w2 = np.float32(0.5) * t * (t * (np.float32(4.0) - np.float32(3.0) * t) + np.float32(1.0))
        w3 = np.float32(0.5) * t * t * (t - np.float32(1.0))
        for j in range(width):
            line[j] = w0 * source[k - 1, j] + w1 * source[k, j] + w2 * source[k + 1, j] + w3 * source[k + 2, j]
        for j in range(columns):
            c = first_column + j * column_step
            m = int(c)
            t = np.float32(c - m)
            w0 = np.float32(0.5) * t * (t * (np.float32(2.0) - t) - np.float32(1.0))
            w1 = np.float32(0.5) * (t * t * (np.float32(3.0) * t - np.float32(5.0)) + np.float32(2.0))
            w2 = np.float32(0.5) * t * (t * (np.float32(4.0) - np.float32(3.0) * t) + np.float32(1.0))
            w3 = np.float32(0.5) * t * t * (t - np.float32(1.0))
            out[i, j] = w0 * line[m - 1] + w1 * line[m] + w2 * line[m + 1] + w3 * line[m + 2]


@njit(error_model="numpy", nogil=True, ahead="f4[:, ::1], f4[::1]")
def smooth(values: Float32Array, weights: Float32Array) -> Float32Array:
    """Rows and then columns of ``values`` under symmetric ``weights`` (2 n + 1); the outer n pixels are left.

    Terms are added in the order of the weights and rounded one by one, whatever the machine: no fast mathematics.
    """
    rows, columns = values.shape
    reach = weights.size // 2
    out = values.copy()
    line = np.empty(columns, np.float32)
    for i in range(rows):
        for j in range(columns):  # not a slice: numba compiles the message of its error for seconds
            line[j] = values[i, j]
        if reach <= i < rows - reach:
            source = values[i - reach]
            for j in range(columns):
                line[j] = weights[0] * source[j]
            for k in range(1, weights.size):
                source = values[i - reach + k]
                weight = weights[k]
                for j in range(columns):
                    line[j] += weight * source[j]
        inner = out[i, reach : columns - reach]
        for j in range(inner.size):
            inner[j] = weights[0] * line[j]
        for k in range(1, weights.size):
            source = line[k:]
            weight = weights[k]
            for j in range(inner.size):
                inner[j] += weight * source[j]
        for j in range(reach):
            out[i, j], out[i, columns - 1 - j] = line[j], line[columns - 1 - j]
    return out


@njit(ahead="f4[:, ::1], *6 * [f8[::1]], i8[::1], f8[:, ::1], f4[:, ::1]", **FAST)
def stamp_craters(
    out: Float32Array,
    latitude_rad: FloatArray,
    longitude_rad: FloatArray,
    crater_latitude: FloatArray,
    crater_longitude: FloatArray,
    radius_rad: FloatArray,
    depth_m: FloatArray,
    profile_row: IntArray,
    wobble: FloatArray,
    profiles: Float32Array,
) -> None:
    """Add craters to heights; centres and angular radii in radians, profiles of unit depth in rows.

    ``wobble`` (n, 4) holds cosine and sine amplitudes of the second and third harmonic of the rim's radius; craters
    of a few pixels are stamped round.
    """
    rows, columns = out.shape
    samples = profiles.shape[1] - 2
    row_step = latitude_rad[0] - latitude_rad[1]
    column_step = longitude_rad[1] - longitude_rad[0]
    middle = 0.5 * (longitude_rad[0] + longitude_rad[-1])
    scale = np.float32(samples / PROFILE_REACH)
    soft = np.float32(0.05)
    one = np.float32(1.0)
    reach = PROFILE_REACH * 1.05
    for n in range(crater_latitude.size):
        lat = crater_latitude[n]
        radius = radius_rad[n]
        first = max(0, math.ceil((latitude_rad[0] - lat - reach * radius) / row_step))
        last = min(rows - 1, math.floor((latitude_rad[0] - lat + reach * radius) / row_step))
        if first > last:
            continue
        lon = crater_longitude[n]
        lon += 2.0 * math.pi * math.floor((middle - lon) / (2.0 * math.pi) + 0.5)
        cos_c = math.cos(lat)
        depth = np.float32(depth_m[n])
        row = profiles[profile_row[n]]
        round_rim = radius < 8.0 * row_step
        a2 = np.float32(wobble[n, 0])
        b2 = np.float32(wobble[n, 1])
        a3 = np.float32(wobble[n, 2])
        b3 = np.float32(wobble[n, 3])
        for i in range(first, last + 1):
            north = 2.0 * math.sin(0.5 * (latitude_rad[i] - lat)) / radius
            east_scale = math.sqrt(max(math.cos(latitude_rad[i]) * cos_c, 1.0e-8)) / radius
            rest = reach * reach - north * north
            if rest <= 0.0:
                continue
            half = math.sqrt(rest) / east_scale
            left = max(0, math.ceil((lon - half - longitude_rad[0]) / column_step))
            right = min(columns - 1, math.floor((lon + half - longitude_rad[0]) / column_step))
            y = np.float32(north)
            x0 = np.float32((longitude_rad[0] - lon) * east_scale)
            dx = np.float32(column_step * east_scale)
            if round_rim:
                for j in range(left, right + 1):
                    x = x0 + dx * np.float32(j)
                    s = np.float32(math.sqrt(x * x + y * y)) * scale
                    k = min(int(s), samples)
                    f = min(s - np.float32(k), one)
                    out[i, j] += depth * (row[k] + f * (row[k + 1] - row[k]))
            else:
                for j in range(left, right + 1):
                    x = x0 + dx * np.float32(j)
                    s2 = x * x + y * y
                    s = np.float32(math.sqrt(s2))
                    g = one / (s2 + soft)
                    p = (x * x - y * y) * g
                    q = np.float32(2.0) * x * y * g
                    g = one / (s + soft)
                    u = (p * x - q * y) * g
                    v = (p * y + q * x) * g
                    s = s * (one + a2 * p + b2 * q + a3 * u + b3 * v) * scale
                    k = min(int(s), samples)
                    f = min(s - np.float32(k), one)
                    out[i, j] += depth * (row[k] + f * (row[k + 1] - row[k]))


@njit(ahead="f4[:, :, ::1], i4[:, ::1], i8, *3 * [f8[::1]]", **FAST)
def sample_pool(
    pool: Float32Array,
    table: Int32Array,
    shift: int,
    rows: FloatArray,
    columns: FloatArray,
    out: FloatArray | Float32Array,
) -> None:
    """Fill ``out`` (n) with bilinear values at pool rows and columns (pixel coordinates within the patch)."""
    mask = (1 << shift) - 1
    for n in range(rows.size):
        r = rows[n]
        c = columns[n]
        i = math.floor(r)
        j = math.floor(c)
        fr = r - i
        fc = c - j
        slot = table[i >> shift, j >> shift]
        # A tile's own pixels start at (1, 1).
        i = (i & mask) + 1
        j = (j & mask) + 1
        top = pool[slot, i, j] + fc * (pool[slot, i, j + 1] - pool[slot, i, j])
        low = pool[slot, i + 1, j] + fc * (pool[slot, i + 1, j + 1] - pool[slot, i + 1, j])
        out[n] = top + fr * (low - top)
