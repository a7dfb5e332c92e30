"""Rotations between the frames of the Moon, the local frames of an orbiter, and quaternions.

All rotations are target-from-source matrices, shape ``(..., 3, 3)``: ``position_mcmf = mcmf_from_icrf @
position_icrf``.

Frames
------
ICRF : axes of the International Celestial Reference Frame; here with the origin at the centre of the Moon
MCI : equator and node of the Moon at a stated epoch (IAU pole), held inertial; frame of the orbital elements
MCMF : mean-Earth/polar-axis (ME) axes, fixed to the Moon; frame of maps, height models and crater catalogues
PA : principal axes of inertia of the Moon, fixed to it; frame of gravity fields, about 0.9 km from ME on the ground
ENU : east, north, up at a place on the reference sphere
RTN : radial, along-track (transverse) and cross-track (normal) axes of an orbit

`IauOrientation` (a series, no file) or `De421Orientation` (a binary PCK file) gives the orientation of the Moon. They
differ by up to a few hundred metres on the ground, because the IAU series contains only some terms of the physical
libration.

References
----------
Archinal et al. 2011, Report of the IAU WGCCRE 2009, table 2 (the Moon), as printed in NAIF pck00010.tpc.
Williams, Boggs, Folkner 2008, JPL IOM 335-JW,DB,WF-20080314-001: DE421 lunar orientation, and ME from PA.
"""

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.errors import DataFileError, EphemerisCoverageError
from lunar.plausible import ORIENTATION_RAD

ARCSECOND_RAD = np.pi / 648_000.0
DAY_S = 86_400.0
CENTURY_S = 36_525.0 * DAY_S

# WGCCRE 2009: E1 to E13 in degrees at J2000 and degrees per day, then their coefficients in degrees for right
# ascension (sine) and declination (cosine) of the pole, and for the prime meridian (sine).
IAU_E_DEG = np.array(
    [125.045, 250.089, 260.008, 176.625, 357.529, 311.589, 134.963, 276.617, 34.226, 15.134, 119.743, 239.961, 25.053]
)
IAU_E_RATE_DEG_DAY = np.array(
    [
        *(-0.0529921, -0.1059842, 13.0120009, 13.3407154, 0.9856003, 26.4057084, 13.0649930),
        *(0.3287146, 1.7484877, -0.1589763, 0.0036096, 0.1643573, 12.9590088),
    ]
)
IAU_POLE_RA_TERMS_DEG = np.array([-3.8787, -0.1204, 0.0700, -0.0172, 0, 0.0072, 0, 0, 0, -0.0052, 0, 0, 0.0043])
IAU_POLE_DEC_TERMS_DEG = np.array([1.5419, 0.0239, -0.0278, 0.0068, 0, -0.0029, 0.0009, 0, 0, 0.0008, 0, 0, -0.0009])
IAU_MERIDIAN_TERMS_DEG = np.array(
    [*(3.5610, 0.1208, -0.0642, 0.0158, 0.0252, -0.0066, -0.0047), *(-0.0046, 0.0028, 0.0052, 0.0040, 0.0019, -0.0044)]
)

IAU_POLE_RA_DEG, IAU_POLE_DEC_DEG = (269.9949, 0.0031, 0.0), (66.5392, 0.0130, 0.0)
IAU_MERIDIAN_DEG = (38.3213, 13.17635815, -1.4e-12)
"""Polynomials of the pole in degrees and centuries, and of the prime meridian in degrees and days."""

DE421_PA_FROM_ME_ARCSECONDS = (67.92, 78.56, 0.30)
"""From mean-Earth to DE421 principal axes: R_z(67.92") R_y(78.56") R_x(0.30")."""


_PCK_EXPECTED = "a binary PCK kernel (DAF/PCK)"
_DAF_RECORD = 1024


ICRF = "ICRF"
ICRF_NAMES = (ICRF, "ICRF1", "ICRF2", "ICRF3", "GCRF", "ICRS")
J2000_NAMES = ("EME2000", "J2000")
"""Names of inertial axes in ephemeris files."""


class Orientation(Protocol):
    """Orientation of the Moon in ICRF: ``tdb_s`` of any shape ``(...)`` gives ``(..., 3, 3)``."""

    @property
    def name(self) -> str: ...

    def mcmf_from_icrf(self, tdb_s: ArrayLike) -> FloatArray: ...

    def pa_from_icrf(self, tdb_s: ArrayLike) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class IauOrientation:
    """The IAU WGCCRE 2009 series for the mean-Earth frame; principal axes by the constant DE421 rotation."""

    name: str = "IAU WGCCRE 2009"

    def mcmf_from_icrf(self, tdb_s: ArrayLike) -> FloatArray:
        right_ascension, declination, meridian = iau_pole_and_meridian_rad(tdb_s)
        return zxz_rotation(right_ascension + np.pi / 2, np.pi / 2 - declination, meridian)

    def pa_from_icrf(self, tdb_s: ArrayLike) -> FloatArray:
        return np.asarray(PA_FROM_ME_DE421 @ self.mcmf_from_icrf(tdb_s))


@dataclass(frozen=True, slots=True, eq=False)
class De421Orientation:
    """Orientation integrated by JPL: Chebyshev series of three Euler angles, and a constant turn to ME.

    ``coefficients`` has the shape (records, 3, terms): the angles phi, theta, psi in rad of
    R_z(psi) R_x(theta) R_z(phi), each record spanning ``record_s`` seconds of TDB from ``start_tdb_s`` on.
    """

    start_tdb_s: float
    record_s: float
    coefficients: FloatArray
    me_from_pa: FloatArray
    name: str = "DE421"

    @property
    def stop_tdb_s(self) -> float:
        return self.start_tdb_s + self.record_s * len(self.coefficients)

    def euler_angles_rad(self, tdb_s: ArrayLike) -> FloatArray:
        """Return phi, theta, psi, shape ``(..., 3)``.

        Raises
        ------
        EphemerisCoverageError
            Where an epoch is outside the span of the file.
        """
        seconds = np.asarray(tdb_s, dtype=np.float64)
        since_start = seconds - self.start_tdb_s
        inside = (since_start >= 0.0) & (seconds <= self.stop_tdb_s)
        if not np.all(inside):
            worst = float(np.atleast_1d(seconds)[~np.atleast_1d(inside)][0])
            raise EphemerisCoverageError(
                f"{worst:.3f}", f"{self.start_tdb_s:.0f}..{self.stop_tdb_s:.0f} TDB s past J2000", self.name
            )
        record = np.minimum((since_start / self.record_s).astype(np.int64), len(self.coefficients) - 1)
        x = 2.0 * (since_start - record * self.record_s) / self.record_s - 1.0
        terms = self.coefficients[record]
        x = x[..., None]
        newer, older = np.zeros_like(terms[..., 0]), np.zeros_like(terms[..., 0])
        for k in range(terms.shape[-1] - 1, 0, -1):
            newer, older = terms[..., k] + 2.0 * x * newer - older, newer
        return np.asarray(terms[..., 0] + x * newer - older)

    def pa_from_icrf(self, tdb_s: ArrayLike) -> FloatArray:
        angles = self.euler_angles_rad(tdb_s)
        return zxz_rotation(angles[..., 0], angles[..., 1], angles[..., 2])

    def mcmf_from_icrf(self, tdb_s: ArrayLike) -> FloatArray:
        return np.asarray(self.me_from_pa @ self.pa_from_icrf(tdb_s))


def iau_pole_and_meridian_rad(tdb_s: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return right ascension and declination of the Moon's pole and the prime meridian W, rad, ``(...)``."""
    seconds = np.asarray(tdb_s, dtype=np.float64)
    days = seconds / DAY_S
    centuries = seconds / CENTURY_S
    e_rad = np.radians(IAU_E_DEG + IAU_E_RATE_DEG_DAY * days[..., None])
    sine, cosine = np.sin(e_rad), np.cos(e_rad)
    (ra0, ra1, _), (dec0, dec1, _), (w0, w1, w2) = IAU_POLE_RA_DEG, IAU_POLE_DEC_DEG, IAU_MERIDIAN_DEG
    right_ascension = ra0 + ra1 * centuries + sine @ IAU_POLE_RA_TERMS_DEG
    declination = dec0 + dec1 * centuries + cosine @ IAU_POLE_DEC_TERMS_DEG
    meridian = w0 + w1 * days + w2 * days**2 + sine @ IAU_MERIDIAN_TERMS_DEG
    return np.radians(right_ascension), np.radians(declination), np.radians(meridian)


def mci_from_icrf(tdb_s: float) -> FloatArray:
    """Return the rotation to the Moon's equator and node of date at ``tdb_s``, shape (3, 3).

    z is the IAU pole, x the ascending node of the Moon's equator on the ICRF equator.
    """
    right_ascension, declination, _ = iau_pole_and_meridian_rad(float(tdb_s))
    return zxz_rotation(right_ascension + np.pi / 2, np.pi / 2 - declination, np.zeros(()))


def icrf_from_onboard(mcmf_from_icrf: ArrayLike, mcmf_from_onboard: ArrayLike) -> FloatArray:
    """Return the rotation to ICRF from the inertial axes of a payload, shape ``(..., 3, 3)``.

    A payload knows where it is over the ground, and turns this with an orientation of its own. The ground beneath a
    state is the same for all, so its axes differ from ICRF by the difference of both orientations: tens of metres.
    """
    return np.asarray(np.swapaxes(np.asarray(mcmf_from_icrf), -1, -2) @ np.asarray(mcmf_from_onboard))


def load_orientation(bpc_path: Path | str, tf_path: Path | str | None = None) -> De421Orientation:
    """Return the orientation in a binary PCK file, with mean-Earth axes as the text frame kernel gives them.

    Without a frame kernel the DE421 rotation of `DE421_PA_FROM_ME_ARCSECONDS` is used.

    Raises
    ------
    DataFileError
        Where a file is missing, is no binary PCK of type 2 in ICRF axes, is cut short, or lacks the rotation.
    """
    path = Path(bpc_path)
    try:
        octets = path.read_bytes()
    except OSError as error:
        raise DataFileError(path, "", _PCK_EXPECTED, error.strerror or str(error)) from None
    frame, words = _pck_segment(path, octets)
    start, record_s, record_words, record_count = (float(v) for v in words[-4:])
    values = words[:-4]
    if values.size != int(record_words) * int(record_count) or record_words < 5 or (int(record_words) - 2) % 3:
        expected = f"{record_count:.0f} records of {record_words:.0f} words"
        raise DataFileError(path, "coefficients", expected, f"{values.size} words")
    if not np.all(np.isfinite(values)):
        raise DataFileError(path, "coefficients", "finite numbers", "not-a-number values")
    records = values.reshape(int(record_count), int(record_words))
    # Each record starts with its own middle and half-length, which the directory already gives.
    coefficients = records[:, 2:].reshape(len(records), 3, -1)
    me_from_pa = PA_FROM_ME_DE421.T if tf_path is None else _me_from_pa_of_kernel(Path(tf_path), frame)
    name = "DE421" if frame == 31006 else f"binary PCK frame {frame}"
    orientation = De421Orientation(start, record_s, np.ascontiguousarray(coefficients), me_from_pa, name)
    epochs = np.linspace(start, orientation.stop_tdb_s, 5)
    turned = orientation.mcmf_from_icrf(epochs) @ np.swapaxes(IauOrientation().mcmf_from_icrf(epochs), -1, -2)
    off_rad = float(np.linalg.norm(rotation_vector_from_matrix(turned), axis=-1).max())
    if not off_rad <= ORIENTATION_RAD:
        where = path if tf_path is None else f"{path} with {tf_path}"
        expected = f"mean-Earth axes within {ORIENTATION_RAD:g} rad of the IAU series"
        raise DataFileError(where, "", expected, f"{off_rad:.3g} rad: other units, axes or body?")
    return orientation


def icrf_from_j2000() -> FloatArray:
    """Return the constant frame bias from mean equator and equinox of J2000 (EME2000), (3, 3); 23 mas.

    IERS Conventions 2010, section 5.4.4: xi0 = -16.617 mas, eta0 = -6.8192 mas, dalpha0 = -14.6 mas.
    """
    xi, eta, alpha = (v * 1e-3 * ARCSECOND_RAD for v in (-16.6170, -6.8192, -14.6))
    return np.asarray((axis_rotation(1, -eta) @ axis_rotation(2, xi) @ axis_rotation(3, alpha)).T)


def zxz_rotation(first_rad: ArrayLike, second_rad: ArrayLike, third_rad: ArrayLike) -> FloatArray:
    """Return R_z(third) R_x(second) R_z(first) of frame turns by angles ``(...)``, shape ``(..., 3, 3)``."""
    c1, s1 = np.cos(first_rad), np.sin(first_rad)
    c2, s2 = np.cos(second_rad), np.sin(second_rad)
    c3, s3 = np.cos(third_rad), np.sin(third_rad)
    rows = [
        [c3 * c1 - s3 * c2 * s1, c3 * s1 + s3 * c2 * c1, s3 * s2],
        [-s3 * c1 - c3 * c2 * s1, -s3 * s1 + c3 * c2 * c1, c3 * s2],
        [s2 * s1, -s2 * c1, c2 + 0.0 * c1],
    ]
    return _stack_rows(rows)


def axis_rotation(axis: int, angle_rad: float) -> FloatArray:
    """Return the (3, 3) matrix of a frame turned by ``angle_rad`` about axis 1 (x), 2 (y) or 3 (z)."""
    i, j = axis % 3, (axis + 1) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle_rad)
    matrix[i, j] = np.sin(angle_rad)
    matrix[j, i] = -matrix[i, j]
    return matrix


def enu_from_mcmf(latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> FloatArray:
    """Return the rotation to east, north, up at places on the sphere, shape ``(..., 3, 3)``."""
    latitude, longitude = np.broadcast_arrays(
        np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64)
    )
    cl, sl = np.cos(longitude), np.sin(longitude)
    cp, sp = np.cos(latitude), np.sin(latitude)
    zero = np.zeros_like(cl)
    return _stack_rows([[-sl, cl, zero], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


def rtn_from_inertial(position_m: ArrayLike, velocity_m_s: ArrayLike) -> FloatArray:
    """Return the rotation ``(..., 3, 3)`` to radial, transverse, normal axes of states ``(..., 3)``."""
    position = np.asarray(position_m, dtype=np.float64)
    radial = position / np.linalg.norm(position, axis=-1, keepdims=True)
    momentum = np.cross(position, np.asarray(velocity_m_s, dtype=np.float64))
    normal = momentum / np.linalg.norm(momentum, axis=-1, keepdims=True)
    return np.stack([radial, np.cross(normal, radial), normal], axis=-2)


def spherical_from_mcmf(position_mcmf_m: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, east longitude (-pi..pi) in rad and altitude above `MOON_RADIUS_M` in m, ``(...)``."""
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    x, y, z = position[..., 0], position[..., 1], position[..., 2]
    equatorial = np.hypot(x, y)
    return np.arctan2(z, equatorial), np.arctan2(y, x), np.asarray(np.hypot(equatorial, z) - MOON_RADIUS_M)


def mcmf_from_spherical(latitude_rad: ArrayLike, longitude_rad: ArrayLike, altitude_m: ArrayLike = 0.0) -> FloatArray:
    """Return positions in m, shape ``(..., 3)``, of places at altitudes above `MOON_RADIUS_M`."""
    latitude, longitude, altitude = np.broadcast_arrays(
        np.asarray(latitude_rad, dtype=np.float64),
        np.asarray(longitude_rad, dtype=np.float64),
        np.asarray(altitude_m, dtype=np.float64),
    )
    radius = MOON_RADIUS_M + altitude
    equatorial = radius * np.cos(latitude)
    parts = [equatorial * np.cos(longitude), equatorial * np.sin(longitude), radius * np.sin(latitude)]
    return np.stack(parts, axis=-1)


def matrix_from_quaternion(q_wxyz: ArrayLike) -> FloatArray:
    """Return the target-from-source matrix ``(..., 3, 3)`` of unit quaternions ``(..., 4)``: v_t = q v_s q*.

    Quaternions are Hamilton's (ij = k); they are normalised first.
    """
    q = np.asarray(q_wxyz, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return _stack_rows(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(matrix: ArrayLike) -> FloatArray:
    """Return unit quaternions ``(..., 4)`` with w >= 0 of rotation matrices ``(..., 3, 3)``."""
    m = np.asarray(matrix, dtype=np.float64)
    m00, m01, m02 = m[..., 0, 0], m[..., 0, 1], m[..., 0, 2]
    m10, m11, m12 = m[..., 1, 0], m[..., 1, 1], m[..., 1, 2]
    m20, m21, m22 = m[..., 2, 0], m[..., 2, 1], m[..., 2, 2]
    # Rows are 4 q_i q: four expressions of the same quaternion, of which the one with the largest part is
    # well scaled.
    candidates = _stack_rows(
        [
            [1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01],
            [m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20],
            [m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12],
            [m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22],
        ]
    )
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0.0, -q, q))


def continuous_quaternions(q: ArrayLike) -> FloatArray:
    """Return quaternions (n, 4) of the same rotations with signs such that each lies closest to the one before."""
    given = np.asarray(q, dtype=np.float64)
    flips = np.sum(given[1:] * given[:-1], axis=1) < 0.0
    signs = np.cumprod(np.where(np.concatenate([[False], flips]), -1.0, 1.0))
    return np.asarray(given * signs[: len(given), None])


def rotation_vector_from_matrix(matrix: ArrayLike) -> FloatArray:
    """Return rotation vectors ``(..., 3)``, rad and at most pi long, of rotation matrices ``(..., 3, 3)``."""
    q = quaternion_from_matrix(matrix)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    # Without a rotation the limit of angle over sine is 2.
    ratio = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)
    return np.asarray(q[..., 1:] * ratio)


def _stack_rows(rows: list[list[Any]]) -> FloatArray:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _me_from_pa_of_kernel(path: Path, pa_frame: int) -> FloatArray:
    """Return the mean-Earth from principal-axes rotation of a text frame kernel, relative to ``pa_frame``."""
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise DataFileError(path, "", "a text frame kernel", error.strerror or str(error)) from None
    data = "\n".join(re.findall(r"(?ms)^\s*\\begindata\s*$(.*?)(?:^\s*\\begintext\s*$|\Z)", text))
    pool = {key: value.strip() for key, value in re.findall(r"(\w+)\s*=\s*(\([^)]*\)|'[^']*'|\S+)", data)}
    pa_names = {value for key, value in pool.items() if key == f"FRAME_{pa_frame}_NAME"}
    for key, relative in pool.items():
        match = re.fullmatch(r"TKFRAME_(\d+)_RELATIVE", key)
        if match is None or relative not in pa_names or "_ME" not in pool.get(f"FRAME_{match[1]}_NAME", ""):
            continue
        prefix = f"TKFRAME_{match[1]}_"
        units = pool.get(prefix + "UNITS", "'RADIANS'").strip("'").upper()
        scale = {"ARCSECONDS": ARCSECOND_RAD, "DEGREES": np.pi / 180.0, "RADIANS": 1.0}.get(units)
        try:
            angles = [float(v.upper().replace("D", "E")) for v in _kernel_values(pool[prefix + "ANGLES"])]
            axes = [int(v) for v in _kernel_values(pool[prefix + "AXES"])]
        except (KeyError, ValueError):
            break
        if scale is None or len(angles) != 3 or len(axes) != 3 or not set(axes) <= {1, 2, 3}:
            break
        # The frame kernel's rule: turns in the order printed lead from this frame to the one it is relative
        # to.
        turns = [axis_rotation(axis, angle * scale) for axis, angle in zip(axes, angles, strict=True)]
        return np.ascontiguousarray((turns[0] @ turns[1] @ turns[2]).T)
    raise DataFileError(
        path, "frame specifications", f"three angles of a mean-Earth frame relative to frame {pa_frame}", "none"
    )


def _pck_segment(path: Path, octets: bytes) -> tuple[int, FloatArray]:
    """Return frame class id and words of the one type 2 segment of a binary PCK (NAIF DAF required reading)."""
    order = {b"LTL-IEEE": "<", b"BIG-IEEE": ">"}.get(octets[88:96], "")
    if octets[:7] != b"DAF/PCK" or not order:
        raise DataFileError(path, "file header", _PCK_EXPECTED, repr(octets[:8].decode("latin-1")))
    if len(octets) < 3 * _DAF_RECORD:
        raise DataFileError(path, "summary record", f"at least {3 * _DAF_RECORD} octets", f"{len(octets)}")
    nd, ni = struct.unpack_from(order + "2i", octets, 8)
    (first_summary,) = struct.unpack_from(order + "i", octets, 76)
    at = (first_summary - 1) * _DAF_RECORD
    if (nd, ni) != (2, 5) or not 0 < at <= len(octets) - _DAF_RECORD:
        raise DataFileError(path, "file header", "ND = 2, NI = 5 and a summary record", f"ND = {nd}, NI = {ni}")
    following, _, count = struct.unpack_from(order + "3d", octets, at)
    frame, axes, kind, first, last = struct.unpack_from(order + "5i", octets, at + 24 + 16)
    if count != 1 or following != 0 or axes != 1 or kind != 2:
        found = f"{count:.0f} segments, the first of type {kind} in frame {axes}"
        raise DataFileError(path, "segment summary", "one segment of type 2 in frame 1 (J2000)", found)
    if not 1 <= first <= last - 4 or 8 * last > len(octets):
        raise DataFileError(path, "coefficients", f"{8 * last} octets in the file", f"{len(octets)}")
    words = np.frombuffer(octets, dtype=order + "f8", count=last - first + 1, offset=8 * (first - 1))
    return frame, words.astype(np.float64)


def _kernel_values(text: str) -> list[str]:
    return text.strip("()").replace(",", " ").split()


_Z, _Y, _X = (angle * ARCSECOND_RAD for angle in DE421_PA_FROM_ME_ARCSECONDS)
PA_FROM_ME_DE421 = np.asarray(axis_rotation(3, _Z) @ axis_rotation(2, _Y) @ axis_rotation(1, _X))
"""Principal axes of DE421 from mean-Earth axes, (3, 3)."""
