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
factorial leaves the range of a double.  Coefficients lie block by block in the order of use; the sums at order m need
the coefficients of orders m-1, m and m+1, which are overlapping loads from the same row.

The vector code is written as LLVM instructions, because no loop that numba compiles is vectorised across an outer
index: `plain_sums`, the same in numba, takes about nine times as long (``python -m benchmarks orbit``).  This is the
only file of the project that writes instructions for the compiler.
"""

import math
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features

from kernels.compiled import njit  # before numba: it sets how numba compiles
from lunar.arrays import FloatArray

from numba.core import cgutils, types  # isort: skip
from numba.extending import intrinsic  # isort: skip

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


class _VectorCode:
    """Writer of the vector instructions of `sums`; `plain_sums` says in numba what they do."""

    def __init__(self, builder: ir.IRBuilder, two_zeta: ir.Value, rho2: ir.Value) -> None:
        self.builder = builder
        self.real, self.integer = ir.DoubleType(), ir.IntType(64)
        self.vector = ir.VectorType(self.real, LANES)
        self.zero = ir.Constant(self.vector, None)
        self.fused = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(self.vector, [self.vector] * 3), f"llvm.fmuladd.v{LANES}f64"
        )
        self.two_zeta, self.rho2 = self.spread(two_zeta), self.spread(rho2)
        self.two_rho2 = self.spread(builder.fmul(self.number(2.0), rho2))

    def index(self, value: int) -> ir.Constant:
        return ir.Constant(self.integer, value)

    def number(self, value: float) -> ir.Constant:
        return ir.Constant(self.real, value)

    def place(self, pointer: ir.Value, offset: int) -> ir.Value:
        return self.builder.gep(pointer, [self.index(offset)], source_etype=self.real)

    def _as_vector(self, pointer: ir.Value, offset: int) -> ir.Value:
        return self.builder.bitcast(self.place(pointer, offset), self.vector.as_pointer())

    def load(self, pointer: ir.Value, offset: int) -> ir.Value:
        return self.builder.load(self._as_vector(pointer, offset), align=8, typ=self.vector)

    def store(self, value: ir.Value, pointer: ir.Value, offset: int) -> None:
        self.builder.store(value, self._as_vector(pointer, offset), align=8)

    def spread(self, value: ir.Value) -> ir.Value:
        """Return a vector with a number in every lane."""
        undefined = ir.Constant(self.vector, ir.Undefined)
        single = self.builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
        return self.builder.shuffle_vector(single, undefined, mask)

    def fma(self, a: ir.Value, b: ir.Value, c: ir.Value) -> ir.Value:
        return self.builder.call(self.fused, [a, b, c])

    def climb(self, ladder: list[ir.Value]) -> list[ir.Value]:
        """Return the ladder at the next degree: (2n-1) zeta, (n-1)^2 rho^2, first difference of the latter."""
        a, q, rise = ladder
        add = self.builder.fadd
        return [add(a, self.two_zeta), add(q, rise), add(rise, self.two_rho2)]

    def recursion(
        self, ladder: list[ir.Value], m2rho2: ir.Value, last: ir.Value, before: ir.Value, seed: ir.Value
    ) -> ir.Value:
        """Return w(n) of every lane, plus a seed for the lane that starts at this degree."""
        lower = self.builder.fsub(m2rho2, ladder[1])
        rest = self.builder.fmul(lower, before) if seed is None else self.fma(lower, before, seed)
        return self.fma(ladder[0], last, rest)

    def add(self, sums: list[ir.Value], pointer: ir.Value, offset: int, harmonic: ir.Value) -> list[ir.Value]:
        """Return the six sums with one degree added: C at m-1, m, m+1, then S."""
        places = [0, 1, 2, LANES + 2, LANES + 3, LANES + 4]
        return [
            self.fma(self.load(pointer, offset + k), harmonic, total) for k, total in zip(places, sums, strict=True)
        ]

    def phis(self, count: int) -> list[ir.PhiInstr]:
        return [self.builder.phi(self.vector) for _ in range(count)]

    def first_degrees(
        self, first: ir.Value, head: ir.Value, m2rho2: ir.Value, zeta: ir.Value, rho2: ir.Value
    ) -> tuple[list[ir.Value], ir.Value, ir.Value, list[ir.Value]]:
        """Return ladder, w of the last two degrees and sums after the degrees at which lanes start.

        Lane j starts, with 1, at the degree that is its order.
        """
        builder, rows = self.builder, self.place(head, _HEAD)
        n_real = builder.sitofp(first, self.real)
        n_less_1 = builder.fsub(n_real, self.number(1.0))
        odd = builder.fadd(n_real, n_less_1)
        ladder = [
            self.spread(builder.fmul(odd, zeta)),
            self.spread(builder.fmul(builder.fmul(n_less_1, n_less_1), rho2)),
            self.spread(builder.fmul(odd, rho2)),
        ]
        seeds = [ir.Constant(self.vector, [1.0 if lane == j else 0.0 for lane in range(LANES)]) for j in range(LANES)]
        ladder = self.climb(ladder)
        before, last, sums = seeds[0], self.fma(ladder[0], seeds[0], seeds[1]), [self.zero] * 6
        for j in range(2, LANES):
            ladder = self.climb(ladder)
            new = self.recursion(ladder, m2rho2, last, before, seeds[j])
            sums = self.add(sums, rows, (j - 2) * _ROW, before)
            last, before = new, last
        return self.climb(ladder), last, before, sums

    def turned_sums(
        self, head: ir.Value, powers: list[ir.Value], steps: list[ir.Value], sums: list[ir.Value]
    ) -> list[ir.Value]:
        """Return powers of the longitude factor for the next block, and the acceleration with this block added."""
        builder, fma = self.builder, self.fma
        c_below, c_same, c_above, s_below, s_same, s_above = sums
        power_re, power_im, sum_x, sum_y, sum_z = powers
        below, above = self.load(head, 0), self.load(head, LANES)
        c_down, c_up = builder.fmul(below, c_below), builder.fmul(above, c_above)
        s_down, s_up = builder.fmul(below, s_below), builder.fmul(above, s_above)
        c_minus, c_plus = builder.fsub(c_up, c_down), builder.fadd(c_up, c_down)
        s_minus, s_plus = builder.fsub(s_up, s_down), builder.fadd(s_up, s_down)
        step_re, step_im = steps
        return [
            builder.fsub(builder.fmul(power_re, step_re), builder.fmul(power_im, step_im)),
            fma(power_re, step_im, builder.fmul(power_im, step_re)),
            fma(power_re, c_minus, fma(power_im, s_minus, sum_x)),
            fma(power_re, s_plus, builder.fsub(sum_y, builder.fmul(power_im, c_plus))),
            fma(power_re, c_same, fma(power_im, s_same, sum_z)),
        ]


def _join(phis: list[ir.PhiInstr], values: list[ir.Value], origin: ir.Block) -> None:
    for phi, value in zip(phis, values, strict=True):
        phi.add_incoming(value, origin)


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
    entry = builder.block
    block_loop, degree_test, degree_loop, block_end, done = (
        builder.append_basic_block(f"gravity.{name}") for name in ("block", "test", "degree", "block_end", "done")
    )
    code = _VectorCode(builder, builder.fmul(ir.Constant(ir.DoubleType(), 2.0), zeta), rho2)
    powers = [code.load(scratch, _POWER_RE), code.load(scratch, _POWER_IM)]
    steps = [code.spread(step_re), code.spread(step_im)]
    builder.branch(block_loop)

    builder.position_at_end(block_loop)
    first, head = builder.phi(code.integer), builder.phi(coefficients.type)
    outer = code.phis(5)
    _join([first, head, *outer], [code.index(0), coefficients, *powers, *[code.zero] * 3], entry)
    m2rho2 = builder.fmul(code.load(head, 2 * LANES), code.rho2)
    ladder, last, before, sums = code.first_degrees(first, head, m2rho2, zeta, rho2)
    start_rows = code.place(code.place(head, _HEAD), (LANES - 2) * _ROW)
    start_n = builder.add(first, code.index(LANES))
    builder.branch(degree_test)

    builder.position_at_end(degree_test)
    n, at = builder.phi(code.integer), builder.phi(coefficients.type)
    inner = code.phis(11)
    _join([n, at, *inner], [start_n, start_rows, *ladder, last, before, *sums], block_loop)
    builder.cbranch(builder.icmp_signed("<", n, degrees), degree_loop, block_end)

    builder.position_at_end(degree_loop)
    last, before = inner[3:5]
    new = code.recursion(inner[:3], m2rho2, last, before, None)
    next_sums = code.add(inner[5:], at, 0, before)
    climbed = [builder.add(n, code.index(1)), code.place(at, _ROW), *code.climb(inner[:3])]
    _join([n, at, *inner], [*climbed, new, last, *next_sums], degree_loop)
    builder.branch(degree_test)

    builder.position_at_end(block_end)
    sums = code.add(code.add(inner[5:], at, 0, inner[4]), at, _ROW, inner[3])
    turned = code.turned_sums(head, outer, steps, sums)
    following = builder.add(first, code.index(LANES))
    _join([first, head, *outer], [following, code.place(at, 2 * _ROW), *turned], block_end)
    more = builder.icmp_signed("<", following, builder.mul(blocks, code.index(LANES)))
    builder.cbranch(more, block_loop, done)

    builder.position_at_end(done)
    for value, offset in zip(turned[2:], (_SUM_X, _SUM_Y, _SUM_Z), strict=True):
        code.store(value, scratch, offset)


@intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def sums(
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
    """Fill the three vector sums of ``scratch`` from its powers of the longitude factor, in vector instructions.

    ``start`` is where the first block lies in ``coefficients``, ``blocks`` the number of blocks of `LANES` orders,
    ``degrees`` that of degrees; the step turns the powers by `LANES` orders.
    """
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
def acceleration(packed: FloatArray, scratch: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
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
    sums(packed, 4, scratch, (degree + 1 + LANES) // LANES, degree + 2, re, im, zeta, rho2)
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
    u_re, u_im = rho * x * inverse_r, rho * y * inverse_r
    harmonic = np.empty((2, size, size + 2))  # real and imaginary parts: numba compiles complex products for long
    s_re, s_im = rho, 0.0  # sectorial; column m + 2
    for m in range(size):
        if m:
            v_re, v_im = (2 * m - 1) * u_re, (2 * m - 1) * u_im
            s_re, s_im = s_re * v_re - s_im * v_im, s_re * v_im + s_im * v_re
        harmonic[0, m, m + 2], harmonic[1, m, m + 2] = s_re, s_im
        for n in range(m + 1, size):
            last, before = (2 * n - 1) * zeta, ((n - 1) * (n - 1) - m * m) * rho2
            for k in range(2):
                older = harmonic[k, n - 2, m + 2] if n > m + 1 else 0.0
                harmonic[k, n, m + 2] = last * harmonic[k, n - 1, m + 2] - before * older
    for n in range(size):
        harmonic[0, n, 1], harmonic[1, n, 1] = -harmonic[0, n, 3], harmonic[1, n, 3]
        harmonic[0, n, 0], harmonic[1, n, 0] = harmonic[0, n, 4], -harmonic[1, n, 4]
    xx = xy = xz = yy = yz = zz = 0.0
    at = 4
    for n in range(degree + 1):
        re, im = harmonic[0, n + 2], harmonic[1, n + 2]
        for m in range(n + 1):
            c, s = packed[at], -packed[at + 1]
            at += 2
            even = 0.25 * (c * (re[m + 4] + re[m]) - s * (im[m + 4] + im[m]))
            middle = 0.5 * (c * re[m + 2] - s * im[m + 2])
            xx += even - middle
            yy -= even + middle
            zz += 2.0 * middle
            xy += 0.25 * (c * (im[m + 4] - im[m]) + s * (re[m + 4] - re[m]))
            xz += 0.5 * (c * (re[m + 3] - re[m + 1]) - s * (im[m + 3] - im[m + 1]))
            yz += 0.5 * (c * (im[m + 3] + im[m + 1]) + s * (re[m + 3] + re[m + 1]))
    g = packed[1]
    return g * xx, g * xy, g * xz, g * yy, g * yz, g * zz


@njit(error_model="numpy", boundscheck=False)
def gradients(packed: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the gradients at positions of shape (n, 3), shape (n, 3, 3)."""
    out = np.empty((len(positions), 3, 3))
    for i in range(len(positions)):
        xx, xy, xz, yy, yz, zz = acceleration_gradient(packed, positions[i, 0], positions[i, 1], positions[i, 2])
        out[i, 0, 0] = xx
        out[i, 1, 1] = yy
        out[i, 2, 2] = zz
        out[i, 0, 1] = out[i, 1, 0] = xy
        out[i, 0, 2] = out[i, 2, 0] = xz
        out[i, 1, 2] = out[i, 2, 1] = yz
    return out
