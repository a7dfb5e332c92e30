"""The compiled spherical-harmonic sum: acceleration of a field to degree N in the body-fixed frame of its coefficients.

Each Cartesian component of the gradient of a harmonic function is harmonic itself, so the acceleration is three sums
over the same irregular solid harmonics one degree up.  With I(n,m) = (n-m)! P(n,m)(sin lat) exp(i m lon) / r^(n+1),
P without the Condon-Shortley phase,

    d/dz I(n,m) = -I(n+1,m)    (d/dx + i d/dy) I(n,m) = -I(n+1,m+1)    (d/dx - i d/dy) I(n,m) = +I(n+1,m-1)

(Epton and Dembart 1995, SIAM J. Sci. Comput. 16:865), with no derivative of a Legendre function and no division by the
cosine of latitude: nothing happens at the poles.  Per degree and order that is three operations for the recursion

    w(n) = (2n-1) zeta w(n-1) - ((n-1)^2 - m^2) rho^2 w(n-2)

and six for the sums.  ``LANES`` adjacent orders go through it side by side as one vector of the processor, with
degree running inside; each lane is scaled so that its sectorial term w(m) is 1, and lengths are scaled so that no
factorial leaves the range of a double.  The vector code is written as LLVM instructions, because no loop that numba
compiles is vectorised across an outer index.  Coefficients lie block by block in the order of use; the sums at order m
need the coefficients of orders m-1, m and m+1, which are overlapping loads from the same row.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features

from lunar._compile import cgutils, intrinsic, njit, types
from lunar.arrays import FloatArray

LANES = 8 if get_host_cpu_features().get("avx512f") else 4
"""Orders side by side: as many doubles as a vector register of this machine holds (or twice that, on small ones)."""

_ROW = 2 * (LANES + 2)
_HEAD = 3 * LANES

# Places in the scratch array that one evaluation needs: powers of the longitude factor by lane, the three vector sums.
_POWER_RE, _POWER_IM, _SUM_X, _SUM_Y, _SUM_Z = (LANES * i for i in range(5))
_SCRATCH = 5 * LANES


def _padded_degrees(degree: int) -> int:
    return degree + 2 + LANES


def scratch_size(degree: int) -> int:
    """Return the length of the scratch array for fields up to ``degree``."""
    return _SCRATCH


def pack(c_bar: FloatArray, s_bar: FloatArray, gm_m3_s2: float, radius_m: float) -> FloatArray:
    """Return the coefficients of a fully normalised field in the order and scale in which the kernel reads them.

    The first four numbers are the degree, GM / R^2, R and the scale of lengths alpha.
    """
    degree = len(c_bar) - 1
    alpha = 2.0 / max(degree, 2)
    scale = _scales(degree, alpha)
    c = np.zeros((_padded_degrees(degree) + 1, _padded_degrees(degree) + LANES + 2))
    s = np.zeros_like(c)
    # Shifted by one: row = degree of the solid harmonic that multiplies them, column 0 = order -1.
    c[1 : degree + 2, 1 : degree + 2] = scale * np.tril(c_bar)
    s[1 : degree + 2, 1 : degree + 2] = scale * np.tril(s_bar)
    parts: list[FloatArray] = [np.array([degree, gm_m3_s2 / radius_m**2, radius_m, alpha])]
    for first in range(0, degree + 2, LANES):
        order = first + np.arange(LANES, dtype=np.float64)
        from_below = np.where(order > 0, 0.5 * (2.0 * order - 1.0), 0.0)
        from_below[order == 1] *= 2.0  # a zonal term stands for itself, others for +m and -m
        parts += [from_below, 0.5 / ((2.0 * order + 1.0) * alpha**2), order**2]
        rows = slice(first, max(degree + 2, first + LANES))
        columns = slice(first, first + LANES + 2)
        parts.append(np.hstack([c[rows, columns], s[rows, columns]]).ravel())
    return np.concatenate(parts)


def _scales(degree: int, alpha: float) -> FloatArray:
    """Return normalisation times scale, [n, m]: k(n,m) (2m-1)!! / ((n-m)! alpha^(n-m))."""
    scale = np.zeros((degree + 1, degree + 1), dtype=np.longdouble)
    sectorial = np.longdouble(1.0)
    for m in range(degree + 1):
        if m:
            sectorial *= np.sqrt(np.longdouble(2 * m + 1) * (2 if m == 1 else 1) / (2 * m))
        scale[m, m] = sectorial
        for n in range(m, degree):
            ratio = np.sqrt(np.longdouble(2 * n + 3) / (2 * n + 1) * (n + 1 - m) / (n + 1 + m))
            scale[n + 1, m] = scale[n, m] * ratio / ((n + 1 - m) * np.longdouble(alpha))
    return scale.astype(np.float64)


def _emit(
    builder: ir.IRBuilder,
    coefficients: ir.Value,
    scratch: ir.Value,
    blocks: ir.Value,
    degrees: ir.Value,
    step_re: ir.Value,
    step_im: ir.Value,
    zeta: ir.Value,
    rho2: ir.Value,
) -> None:
    """Write the double loop over blocks of orders and over degrees.

    The products of a degree are added two degrees after its solid harmonics are made: in program order the
    recursion, which is what everything waits for, then comes before work that can wait.
    """
    real, integer = ir.DoubleType(), ir.IntType(64)
    vector = ir.VectorType(real, LANES)
    fused = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fmuladd.v{LANES}f64"
    )
    zero = ir.Constant(vector, None)

    def index(value: int) -> ir.Constant:
        return ir.Constant(integer, value)

    def number(value: float) -> ir.Constant:
        return ir.Constant(real, value)

    def place(pointer: ir.Value, offset: int) -> ir.Value:
        return builder.gep(pointer, [index(offset)], source_etype=real)

    def load(pointer: ir.Value, offset: int) -> ir.Value:
        return builder.load(builder.bitcast(place(pointer, offset), vector.as_pointer()), align=8, typ=vector)

    def store(value: ir.Value, pointer: ir.Value, offset: int) -> None:
        builder.store(value, builder.bitcast(place(pointer, offset), vector.as_pointer()), align=8)

    def spread(value: ir.Value) -> ir.Value:
        single = builder.insert_element(
            ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0)
        )
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
        return builder.shuffle_vector(single, ir.Constant(vector, ir.Undefined), mask)

    def fma(a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        return builder.call(fused, [a, b, c])

    def climb(ladder: list[ir.Value]) -> list[ir.Value]:
        """What the recursion needs at the next degree: (2n-1) zeta, (n-1)^2 rho^2 and the latter's first difference."""
        a, q, rise = ladder
        return [builder.fadd(a, two_zeta), builder.fadd(q, rise), builder.fadd(rise, two_rho2)]

    def hold(value: ir.Value) -> None:
        """Keep the order of instructions at this place: LLVM would move the recursion behind the sums (20 % slower).

        An empty piece of assembler that reads the first lane, which is where a scalar lies: nothing is moved for it.
        """
        if builder.module.triple.startswith("x86_64"):
            lane = builder.extract_element(value, ir.Constant(ir.IntType(32), 0))
            builder.asm(ir.FunctionType(ir.VoidType(), [real]), "", "x", [lane], True)

    def add(sums: list[ir.Value], pointer: ir.Value, offset: int, harmonic: ir.Value) -> list[ir.Value]:
        """The six sums with one degree added: C at m-1, m, m+1, then S."""
        places = [0, 1, 2, LANES + 2, LANES + 3, LANES + 4]
        return [
            fma(load(pointer, offset + k), harmonic, total) for k, total in zip(places, sums, strict=True)
        ]

    def join(phis: list[ir.PhiInstr], values: list[ir.Value], origin: ir.Block) -> None:
        for phi, value in zip(phis, values, strict=True):
            phi.add_incoming(value, origin)

    entry = builder.block
    block_loop, degree_test, degree_loop, block_end, done = (
        builder.append_basic_block(f"gravity.{name}")
        for name in ("block", "test", "degree", "block_end", "done")
    )
    power_re_0, power_im_0 = load(scratch, _POWER_RE), load(scratch, _POWER_IM)
    step_re_v, step_im_v, rho2_v = spread(step_re), spread(step_im), spread(rho2)
    two_zeta, two_rho2 = spread(builder.fmul(number(2.0), zeta)), spread(builder.fmul(number(2.0), rho2))
    builder.branch(block_loop)

    builder.position_at_end(block_loop)
    first, head = builder.phi(integer), builder.phi(coefficients.type)
    outer = [builder.phi(vector) for _ in range(5)]
    join([first, head, *outer], [index(0), coefficients, power_re_0, power_im_0, zero, zero, zero], entry)
    m2rho2 = builder.fmul(load(head, 2 * LANES), rho2_v)
    rows = place(head, _HEAD)
    n_real = builder.sitofp(first, real)
    n_less_1 = builder.fsub(n_real, number(1.0))
    odd = builder.fadd(n_real, n_less_1)
    ladder = [
        spread(builder.fmul(odd, zeta)),
        spread(builder.fmul(builder.fmul(n_less_1, n_less_1), rho2)),
        spread(builder.fmul(odd, rho2)),
    ]
    # Lane j starts, with 1, at the degree that is its order.
    seeds = [ir.Constant(vector, [1.0 if lane == j else 0.0 for lane in range(LANES)]) for j in range(LANES)]
    ladder = climb(ladder)
    before, last, sums = seeds[0], fma(ladder[0], seeds[0], seeds[1]), [zero] * 6
    for j in range(2, LANES):
        ladder = climb(ladder)
        new = fma(ladder[0], last, fma(builder.fsub(m2rho2, ladder[1]), before, seeds[j]))
        sums = add(sums, rows, (j - 2) * _ROW, before)
        last, before = new, last
    ladder = climb(ladder)
    start_rows, start_n = place(rows, (LANES - 2) * _ROW), builder.add(first, index(LANES))
    builder.branch(degree_test)

    builder.position_at_end(degree_test)
    n, at = builder.phi(integer), builder.phi(coefficients.type)
    inner = [builder.phi(vector) for _ in range(11)]
    join([n, at, *inner], [start_n, start_rows, *ladder, last, before, *sums], block_loop)
    builder.cbranch(builder.icmp_signed("<", n, degrees), degree_loop, block_end)

    builder.position_at_end(degree_loop)
    last, before = inner[3:5]
    new = fma(inner[0], last, builder.fmul(builder.fsub(m2rho2, inner[1]), before))
    hold(new)
    next_sums = add(inner[5:], at, 0, before)
    join(
        [n, at, *inner],
        [builder.add(n, index(1)), place(at, _ROW), *climb(inner[:3]), new, last, *next_sums],
        degree_loop,
    )
    builder.branch(degree_test)

    builder.position_at_end(block_end)
    sums = add(add(inner[5:], at, 0, inner[4]), at, _ROW, inner[3])
    c_below, c_same, c_above, s_below, s_same, s_above = sums
    below, above = load(head, 0), load(head, LANES)
    power_re, power_im, sum_x, sum_y, sum_z = outer
    c_down, c_up = builder.fmul(below, c_below), builder.fmul(above, c_above)
    s_down, s_up = builder.fmul(below, s_below), builder.fmul(above, s_above)
    c_minus, c_plus = builder.fsub(c_up, c_down), builder.fadd(c_up, c_down)
    s_minus, s_plus = builder.fsub(s_up, s_down), builder.fadd(s_up, s_down)
    new_x = fma(power_re, c_minus, fma(power_im, s_minus, sum_x))
    new_y = fma(power_re, s_plus, builder.fsub(sum_y, builder.fmul(power_im, c_plus)))
    new_z = fma(power_re, c_same, fma(power_im, s_same, sum_z))
    next_re = builder.fsub(builder.fmul(power_re, step_re_v), builder.fmul(power_im, step_im_v))
    next_im = fma(power_re, step_im_v, builder.fmul(power_im, step_re_v))
    following = builder.add(first, index(LANES))
    join(
        [first, head, *outer],
        [following, place(at, 2 * _ROW), next_re, next_im, new_x, new_y, new_z],
        block_end,
    )
    builder.cbranch(builder.icmp_signed("<", following, builder.mul(blocks, index(LANES))), block_loop, done)

    builder.position_at_end(done)
    for value, offset in ((new_x, _SUM_X), (new_y, _SUM_Y), (new_z, _SUM_Z)):
        store(value, scratch, offset)


@intrinsic  # type: ignore[untyped-decorator]
def _sums(
    typing_context: Any,
    coefficients: Any,
    start: Any,
    scratch: Any,
    blocks: Any,
    degrees: Any,
    step_re: Any,
    step_im: Any,
    zeta: Any,
    rho2: Any,
) -> Any:
    """Typing of the vector code; ``start`` is where the first block lies in ``coefficients``."""
    signature = types.void(coefficients, types.intp, scratch, types.intp, types.intp, *[types.float64] * 4)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        def data(number: int) -> ir.Value:
            array = context.make_array(signature.args[number])(context, builder, arguments[number])
            return array.data

        first = builder.gep(data(0), [arguments[1]], source_etype=ir.DoubleType())
        _emit(builder, first, data(2), *arguments[3:])
        return context.get_dummy_value()

    return signature, generate


@njit(error_model="numpy", boundscheck=False)
def acceleration(
    packed: FloatArray, scratch: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return the acceleration (m/s^2) at a body-fixed position (m), central term included, as three floats.

    ``packed`` comes from `pack`; ``scratch`` is a float64 array of at least `scratch_size` that the caller keeps.
    """
    degree = int(packed[0])
    radius = packed[2]
    alpha = packed[3]
    inverse_r = 1.0 / math.sqrt(x * x + y * y + z * z)
    rho = radius * inverse_r
    zeta = alpha * rho * z * inverse_r
    rho2 = (alpha * rho) ** 2
    u_re = rho * x * inverse_r
    u_im = rho * y * inverse_r
    re = rho
    im = 0.0
    for lane in range(LANES):
        scratch[_POWER_RE + lane] = re
        scratch[_POWER_IM + lane] = im
        re, im = re * u_re - im * u_im, re * u_im + im * u_re
    re = 1.0
    im = 0.0
    for _ in range(LANES):
        re, im = re * u_re - im * u_im, re * u_im + im * u_re
    _sums(packed, 4, scratch, (degree + 1 + LANES) // LANES, degree + 2, re, im, zeta, rho2)
    ax = 0.0
    ay = 0.0
    az = 0.0
    for lane in range(LANES):
        ax += scratch[_SUM_X + lane]
        ay += scratch[_SUM_Y + lane]
        az += scratch[_SUM_Z + lane]
    g = packed[1]
    return g * ax, g * ay, -g * az / alpha


@njit(error_model="numpy", boundscheck=False)
def accelerations(packed: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the accelerations at positions of shape (n, 3)."""
    scratch = np.empty(_SCRATCH)
    out = np.empty_like(positions)
    for i in range(len(positions)):
        out[i, 0], out[i, 1], out[i, 2] = acceleration(
            packed, scratch, positions[i, 0], positions[i, 1], positions[i, 2]
        )
    return out


def pack_gradient(c_bar: FloatArray, s_bar: FloatArray, gm_m3_s2: float, radius_m: float) -> FloatArray:
    """Return what `acceleration_gradient` reads: degree, GM / (R alpha)^3, R, alpha, then C and S of all n, m <= n."""
    degree = len(c_bar) - 1
    alpha = 2.0 / max(degree, 2)
    scale = _scales(degree, alpha)
    column = 1.0
    for m in range(1, degree + 1):
        column *= (2 * m - 1) * alpha
        scale[:, m] /= column
    rows, columns = np.tril_indices(degree + 1)
    pairs = np.stack([(scale * c_bar)[rows, columns], (scale * s_bar)[rows, columns]], axis=-1)
    return np.concatenate([[degree, gm_m3_s2 / (radius_m**3 * alpha**3), radius_m, alpha], pairs.ravel()])


@njit(error_model="numpy", boundscheck=False)
def acceleration_gradient(
    packed: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float]:
    """Return (xx, xy, xz, yy, yz, zz) of the gradient of the acceleration, 1/s^2; meant for low degrees.

    From the same derivatives of solid harmonics as the acceleration, applied twice, with I(n,-m) = (-1)^m conj I(n,m).
    """
    degree = int(packed[0])
    radius = packed[2]
    alpha = packed[3]
    size = degree + 3
    r2 = x * x + y * y + z * z
    inverse_r = 1.0 / math.sqrt(r2)
    rho = alpha * radius * inverse_r
    zeta = rho * z * inverse_r
    rho2 = rho * rho
    u = complex(rho * x * inverse_r, rho * y * inverse_r)
    harmonic = np.zeros((size, size + 2), dtype=np.complex128)  # column m + 2
    sectorial = complex(rho, 0.0)
    for m in range(size):
        if m:
            sectorial *= (2 * m - 1) * u
        harmonic[m, m + 2] = sectorial
        for n in range(m + 1, size):
            older = harmonic[n - 2, m + 2] if n >= 2 else 0.0j
            harmonic[n, m + 2] = (2 * n - 1) * zeta * harmonic[n - 1, m + 2] - (
                (n - 1) ** 2 - m * m
            ) * rho2 * older
    for n in range(size):
        harmonic[n, 1] = -harmonic[n, 3].conjugate()
        harmonic[n, 0] = harmonic[n, 4].conjugate() if size > 2 else 0.0j
    xx = xy = xz = yy = yz = zz = 0.0
    at = 4
    for n in range(degree + 1):
        for m in range(n + 1):
            c = complex(packed[at], -packed[at + 1])
            at += 2
            two_up = harmonic[n + 2, m + 4]
            one_up = harmonic[n + 2, m + 3]
            same = harmonic[n + 2, m + 2]
            one_down = harmonic[n + 2, m + 1]
            two_down = harmonic[n + 2, m]
            even = 0.25 * (c * (two_up + two_down)).real
            middle = 0.5 * (c * same).real
            xx += even - middle
            yy -= even + middle
            zz += 2.0 * middle
            xy += 0.25 * (c * (two_up - two_down)).imag
            xz += 0.5 * (c * (one_up - one_down)).real
            yz += 0.5 * (c * (one_up + one_down)).imag
    g = packed[1]
    return g * xx, g * xy, g * xz, g * yy, g * yz, g * zz


@njit(error_model="numpy", boundscheck=False)
def gradients(packed: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the gradients at positions of shape (n, 3), shape (n, 3, 3)."""
    out = np.empty((len(positions), 3, 3))
    for i in range(len(positions)):
        xx, xy, xz, yy, yz, zz = acceleration_gradient(
            packed, positions[i, 0], positions[i, 1], positions[i, 2]
        )
        out[i, 0, 0] = xx
        out[i, 1, 1] = yy
        out[i, 2, 2] = zz
        out[i, 0, 1] = out[i, 1, 0] = xy
        out[i, 0, 2] = out[i, 2, 0] = xz
        out[i, 1, 2] = out[i, 2, 1] = yz
    return out
