"""SPICE kernels: SPK (orbit), CK (attitude), SCLK (clock), FK (frames), IK (camera), PCK (Moon); SPK can be read.

The binary kernels are written and read with spiceypy, which is an optional dependency.  The text kernels need none.
Frame and instrument numbers follow from the number of the spacecraft, as NAIF recommends: -S000 is the spacecraft,
-S001 the camera.

References
----------
NAIF Required Reading: SPK (types 2, 3, 9 and 13), CK (type 3), SCLK (type 1), PCK, FRAMES, GETFOV, TIME.
"""

from __future__ import annotations

import math
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

from lunar import frames, timescales
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M, NS, SECONDS_PER_DAY
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import DataFileError, EphemerisError, MissingLibrary, UnknownFrameError
from lunar.third_bodies import moon_barycentric_icrf_m

MOON = 301
FRAME = "J2000"
"""Name of the ICRF axes in SPICE."""

READ_STEP_S = 60.0
"""Step between states taken from an SPK: Hermite interpolation of degree 7 in a low orbit is then exact to 1 um."""

STATES_LIMIT = 2_000_000

EXACT_M = 1e-4
"""Polynomials so close to an ephemeris count as exact: a float64 of SPICE's seconds is 0.2 mm in a low orbit."""

_MOST_TERMS, _MOON_TERMS = 28, 14
_COMMENT_CHARACTERS = 1000

# TDB - TT of SPICE's leap-second kernels: amplitude in s, eccentricity, mean anomaly in rad and rad/s.
_K, _EB, _M0, _M1 = 1.657e-3, 1.671e-2, 6.239996, 1.99096871e-7
_MODULUS = 1 << 32
_CSPICE = threading.Lock()
"""CSPICE keeps its state in global variables."""


@dataclass(frozen=True, slots=True)
class ClockLine:
    """Line of a time correlation: on-board ticks of 2^-16 s, their UTC, and the real seconds of a clock second."""

    start_ticks: int
    utc_ns: int
    rate: float = 1.0


def spacecraft_id(number: int) -> int:
    """Return the SPICE number of a spacecraft that NAIF has given none: -100000 minus its CCSDS number."""
    return -100_000 - number


def camera_id(spacecraft: int) -> int:
    """Return the number of the camera and of its frame."""
    return spacecraft * 1000 - 1


def et_from_utc_ns(utc_ns: IntArray | int) -> FloatArray:
    """Return SPICE's ephemeris time (...) in s: TDB past J2000 by the formula of its leap-second kernels."""
    return et_from_tai_ns(timescales.tai_ns_from_utc_ns(np.asarray(utc_ns, dtype=np.int64)))


def et_from_tai_ns(tai_ns: IntArray | int) -> FloatArray:
    """Return SPICE's ephemeris time (...) in s of TAI epochs."""
    tt_s = (
        np.asarray(tai_ns, dtype=np.int64) + (timescales.TT_MINUS_TAI_NS - timescales.J2000_TT_AS_UTC_COUNT_NS)
    ) / NS
    return np.asarray(tt_s + _tdb_minus_tt_s(tt_s))


def tai_ns_from_et(et_s: FloatArray | float) -> IntArray:
    """Return TAI (...) of SPICE's ephemeris times, to 0.1 us."""
    et = np.asarray(et_s, dtype=np.float64)
    tt = et - _tdb_minus_tt_s(et - _tdb_minus_tt_s(et))
    whole = np.floor(tt)
    tt_ns = whole.astype(np.int64) * NS + np.rint((tt - whole) * NS).astype(np.int64)
    return np.asarray(tt_ns + (timescales.J2000_TT_AS_UTC_COUNT_NS - timescales.TT_MINUS_TAI_NS))


def _tdb_minus_tt_s(seconds: FloatArray) -> FloatArray:
    anomaly = _M0 + _M1 * seconds
    return np.asarray(_K * np.sin(anomaly + _EB * np.sin(anomaly)))


@dataclass(frozen=True, slots=True)
class SpkKernel:
    """An SPK: its octets, type (3, 13 or 9), and number of states, in type 3 of records.

    ``error_m`` is the largest distance of the polynomials of type 3 from the ephemeris, None in other types.
    """

    octets: bytes
    data_type: int
    states: int
    error_m: float | None = None


def spk_kernel(ephemeris: Ephemeris, spacecraft: int, data_type: int | None = None) -> SpkKernel:
    """Return an SPK of an ephemeris with a segment for each arc.

    Type 3 has Chebyshev polynomials, which most readers know.  Type 13 (Hermite interpolation, otherwise type 9) has
    the states; its window is that of the ephemeris where SPICE has it (an even number of states).  Without a
    ``data_type``, it is 3 where that is within `EXACT_M` of the ephemeris.  Arcs of one state are left out.

    Raises
    ------
    MissingLibrary
        If spiceypy is not installed.
    EphemerisError
        If no arc has two states.
    """
    arcs = [one for one in ephemeris.arcs() if one.span_tai_ns[0] < one.span_tai_ns[1]]
    if not arcs:
        raise EphemerisError("an SPK: expected a segment of at least two states, found none")
    series = [_chebyshev_series(one) for one in arcs] if data_type != 13 else []
    error_m = max((one.error_m for one in series), default=math.inf)
    chosen = data_type or (3 if error_m <= EXACT_M else 13)
    if chosen == 3:
        comment = f"Chebyshev polynomials within {error_m:.1e} m of the ephemeris."
        states = sum(len(one.coefficients) for one in series)
    else:
        chosen = 13 if all(one.interpolation == "HERMITE" for one in arcs) else 9
        comment, states = "States of the ephemeris.", sum(len(one.utc_ns) for one in arcs)

    def write(spice: Any, path: str) -> None:
        handle = spice.spkopn(path, "LINNA", _COMMENT_CHARACTERS)
        spice.dafac(handle, [f"Spacecraft {spacecraft} about the Moon. {comment}"])
        for number, one in enumerate(arcs):
            et = et_from_tai_ns(np.array(one.span_tai_ns))
            name = one.object_name[:40].encode("ascii", "replace").decode()
            head = (handle, spacecraft, MOON, FRAME, float(et[0]), float(et[1]), name)
            if chosen == 3:
                _write_series(spice, head, series[number])
            else:
                _write_states(spice, head, one)
        spice.spkcls(handle)

    return SpkKernel(_written(write), chosen, states, error_m if chosen == 3 else None)


def _write_states(spice: Any, head: tuple[Any, ...], one: EphemerisSegment) -> None:
    et = et_from_tai_ns(one.tai_ns)
    states = np.concatenate([one.position_m, one.velocity_m_s], axis=1) / 1e3
    if one.interpolation == "HERMITE":
        window = min((one.degree + 1) // 2, len(et))
        # Windows of SPICE have an even number of states; the degree of type 13 is 2 w - 1.
        degree = 2 * min(max(window - window % 2, 2), 14) - 1
        spice.spkw13(*head, degree, len(et), states, et)
    else:
        degree = 1 if one.interpolation == "LINEAR" else min(one.degree, 27, len(et) - 1)
        spice.spkw09(*head, max(degree - (degree + 1) % 2, 1), len(et), states, et)


def _write_series(spice: Any, head: tuple[Any, ...], series: _Series) -> None:
    records, _, terms = series.coefficients.shape
    octets = np.ascontiguousarray(series.coefficients / 1e3)
    spice.spkw03(*head, series.record_s, records, terms - 1, octets.reshape(-1), series.start_et_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Series:
    """Chebyshev coefficients (records, 6, terms) in m and m/s of equal spans of time, and the largest error."""

    start_et_s: float
    record_s: float
    coefficients: FloatArray
    error_m: float


def _chebyshev_series(one: EphemerisSegment) -> _Series:
    """Return the series with the longest records that are exact, else those with a record for each step."""
    step_s = float(np.median(np.diff(one.tai_ns))) / NS
    start_s, stop_s = (float(value) for value in et_from_tai_ns(np.array(one.span_tai_ns)))
    arc = Ephemeris((one,))
    for steps, terms in ((16, 24), (8, 16), (4, 16), (2, 12), (1, min(one.degree, _MOST_TERMS - 1) + 1)):
        records = max(math.ceil((stop_s - start_s) / (steps * step_s) - 1e-6), 1)
        series = _fitted(start_s, (stop_s - start_s) / records, records, terms, arc.at_tai, one.span_tai_ns)
        if series.error_m <= EXACT_M:
            break
    return series


def _fitted(
    start_s: float,
    record_s: float,
    records: int,
    terms: int,
    state: Callable[[IntArray], tuple[FloatArray, FloatArray]],
    span_tai_ns: tuple[int, int],
) -> _Series:
    """Return the series through states at the Chebyshev nodes; its error is that at twice as many other places."""
    half_s = record_s / 2.0
    middle: FloatArray = start_s + half_s + record_s * np.arange(records, dtype=np.float64)
    # Seconds of TDB and TAI differ by 3e-10, which are 0.1 mm in some minutes.
    rate = (_tdb_minus_tt_s(middle + half_s) - _tdb_minus_tt_s(middle - half_s)) / record_s

    def at(places: FloatArray) -> FloatArray:
        offset_ns = np.rint((half_s * NS * (1.0 - rate))[:, None] * places).astype(np.int64)
        values = np.concatenate(state(np.clip(tai_ns_from_et(middle)[:, None] + offset_ns, *span_tai_ns)), axis=2)
        return values.transpose(0, 2, 1)

    nodes, others = chebyshev.chebpts1(terms), np.linspace(-1.0, 1.0, 2 * terms + 1)
    coefficients = at(nodes) @ np.linalg.inv(chebyshev.chebvander(nodes, terms - 1)).T
    off = coefficients @ chebyshev.chebvander(others, terms - 1).T - at(others)
    error_m = float(np.linalg.norm(off[:, :3], axis=1).max())
    return _Series(start_s, record_s, coefficients, error_m)


def moon_kernel(start_utc_ns: int, stop_utc_ns: int) -> bytes:
    """Return an SPK (type 2) of the Moon about the barycentre of the solar system, with an hour before and after.

    SPICE asks for this when it intersects a line of sight with the Moon, although the place relative to a spacecraft
    does not depend on it.  A planetary kernel that is loaded later takes its place.

    Raises
    ------
    MissingLibrary
        If spiceypy is not installed.
    """
    first, last = et_from_utc_ns(np.array([start_utc_ns - 3600 * NS, stop_utc_ns + 3600 * NS])).tolist()
    records = math.ceil((last - first) / SECONDS_PER_DAY)
    record_s = (last - first) / records
    nodes = chebyshev.chebpts1(_MOON_TERMS)
    at = first + record_s * (np.arange(records)[:, None] + 0.5 + nodes / 2.0)
    series = np.linalg.inv(chebyshev.chebvander(nodes, _MOON_TERMS - 1)) @ (moon_barycentric_icrf_m(at) / 1e3)
    coefficients = np.ascontiguousarray(series.transpose(0, 2, 1)).reshape(-1)

    def write(spice: Any, path: str) -> None:
        handle = spice.spkopn(path, "LINNA", _COMMENT_CHARACTERS)
        spice.dafac(
            handle, ["The Moon about the barycentre, within 20 km (ERFA); load DE440 (NAIF) after it for better."]
        )
        head = (handle, MOON, 0, FRAME, first, last, "MOON TO 20 KM")
        spice.spkw02(*head, record_s, records, _MOON_TERMS - 1, coefficients, first)
        spice.spkcls(handle)

    return _written(write)


def ck_octets(
    ticks: IntArray, q_wxyz: FloatArray, spacecraft: int, *, gap_ticks: int = 10 * timescales.TICKS_PER_SECOND
) -> bytes:
    """Return a CK (type 3) of the camera: attitudes are interpolated between images at most ``gap_ticks`` apart.

    Angular rates are those of the turns to the images before and after, and 0 for an image alone.

    Parameters
    ----------
    ticks, q_wxyz
        On-board times (n,), ascending, and quaternions (n, 4) from ICRF to camera axes.

    Raises
    ------
    MissingLibrary
        If spiceypy is not installed.
    EphemerisError
        If there is no attitude.
    """
    if len(ticks) == 0:
        raise EphemerisError("a CK: expected at least one attitude, found none")
    times = ticks.astype(np.float64)
    apart = np.diff(ticks) > gap_ticks
    starts = times[np.concatenate(([True], apart))]
    rates = _angular_rates(ticks, q_wxyz, ~apart)

    def write(spice: Any, path: str) -> None:
        handle = spice.ckopn(path, "LINNA", 0)
        spice.ckw03(
            handle,
            times[0],
            times[-1],
            camera_id(spacecraft),
            FRAME,
            True,
            "LINNA camera",
            len(times),
            times,
            np.ascontiguousarray(q_wxyz),
            rates,
            len(starts),
            starts,
        )
        spice.ckcls(handle)

    return _written(write)


def _angular_rates(ticks: IntArray, q_wxyz: FloatArray, joined: BoolArray) -> FloatArray:
    """Return angular velocities (n, 3) in rad/s and ICRF, of attitudes (n, 4) of which neighbours are ``joined``."""
    camera = frames.matrix_from_quaternion(q_wxyz)
    turns = frames.rotation_vector_from_matrix(np.swapaxes(camera[1:], 1, 2) @ camera[:-1])
    between = np.where(joined[:, None], turns * timescales.TICKS_PER_SECOND / np.diff(ticks)[:, None], 0.0)
    edge, none = np.zeros((1, 3)), np.zeros(1, dtype=np.int64)
    sides = np.concatenate([none, joined]) + np.concatenate([joined, none])
    total = np.concatenate([edge, between]) + np.concatenate([between, edge])
    return np.ascontiguousarray(total / np.maximum(sides, 1)[:, None])


def format_pck() -> str:
    """Return a kernel of constants: radius of the Moon, and its orientation by the series of the IAU (IAU_MOON)."""
    angles = np.column_stack([frames.IAU_E_DEG, frames.IAU_E_RATE_DEG_DAY * frames.CENTURY_S / frames.DAY_S]).ravel()
    values = {
        "BODY301_RADII": [MOON_RADIUS_M / 1e3] * 3,
        "BODY301_POLE_RA": frames.IAU_POLE_RA_DEG,
        "BODY301_POLE_DEC": frames.IAU_POLE_DEC_DEG,
        "BODY301_PM": frames.IAU_MERIDIAN_DEG,
        "BODY301_NUT_PREC_RA": frames.IAU_POLE_RA_TERMS_DEG,
        "BODY301_NUT_PREC_DEC": frames.IAU_POLE_DEC_TERMS_DEG,
        "BODY301_NUT_PREC_PM": frames.IAU_MERIDIAN_TERMS_DEG,
        "BODY3_NUT_PREC_ANGLES": angles,
    }
    lines = [
        f"{name} = (\n" + "\n".join(f"    {value!r}" for value in map(float, row)) + "\n)"
        for name, row in values.items()
    ]
    text = "The Moon of the IAU WGCCRE 2009, degrees. It differs from DE421 by some hundred metres on the ground."
    return "\n".join(["KPL/PCK", "", text, "", "\\begindata", "", *lines, "", "\\begintext", ""])


def format_sclk(lines: Sequence[ClockLine], spacecraft: int) -> str:
    """Return an SCLK kernel of the on-board clock: 32 bits of seconds, 16 bits of fraction, one partition."""
    rows = []
    for one in lines:
        tai_ns = int(timescales.tai_ns_from_utc_ns(one.utc_ns))
        tt_ns = tai_ns + timescales.TT_MINUS_TAI_NS - timescales.J2000_TT_AS_UTC_COUNT_NS
        seconds, rest = divmod(tt_ns, NS)
        rows.append(f"    {one.start_ticks}  {seconds}.{rest:09d}  {one.rate:.15f}")
    number = -spacecraft
    return "\n".join(
        [
            "KPL/SCLK",
            "",
            "On-board clock: seconds since 2000-01-01T00:00:00 TAI with a fraction of 16 bits. Each line is a time",
            "correlation: on-board ticks of 2^-16 s, TT seconds past J2000, and seconds of TT of a clock second.",
            "",
            "\\begindata",
            "",
            f"SCLK_KERNEL_ID = ( @{np.datetime64(lines[0].utc_ns, 'ns').astype('datetime64[s]')} )",
            f"SCLK_DATA_TYPE_{number} = ( 1 )",
            f"SCLK01_TIME_SYSTEM_{number} = ( 2 )",
            f"SCLK01_N_FIELDS_{number} = ( 2 )",
            f"SCLK01_MODULI_{number} = ( {_MODULUS} {timescales.TICKS_PER_SECOND} )",
            f"SCLK01_OFFSETS_{number} = ( 0 0 )",
            f"SCLK01_OUTPUT_DELIM_{number} = ( 1 )",
            f"SCLK_PARTITION_START_{number} = ( 0 )",
            f"SCLK_PARTITION_END_{number} = ( {_MODULUS * timescales.TICKS_PER_SECOND - 1} )",
            f"SCLK01_COEFFICIENTS_{number} = (",
            *rows,
            ")",
            "",
            "\\begintext",
            "",
        ]
    )


def format_fk(spacecraft: int, name: str) -> str:
    """Return a frame kernel: the names of spacecraft and camera, and the camera frame, whose attitude is in the CK."""
    body, camera = _spice_name(name), _spice_name(name) + "_CAMERA"
    number = camera_id(spacecraft)
    return "\n".join(
        [
            "KPL/FK",
            "",
            "Camera axes: x to the right of the image, y down, z along the boresight.",
            "",
            "\\begindata",
            "",
            f"NAIF_BODY_NAME += ( '{body}' '{camera}' )",
            f"NAIF_BODY_CODE += ( {spacecraft} {number} )",
            "",
            f"FRAME_{camera} = {number}",
            f"FRAME_{number}_NAME = '{camera}'",
            f"FRAME_{number}_CLASS = 3",
            f"FRAME_{number}_CLASS_ID = {number}",
            f"FRAME_{number}_CENTER = {spacecraft}",
            f"CK_{number}_SCLK = {spacecraft}",
            f"CK_{number}_SPK = {spacecraft}",
            "",
            "\\begintext",
            "",
        ]
    )


def format_ik(camera: PinholeCamera, spacecraft: int, name: str) -> str:
    """Return an instrument kernel: the field of view of the camera between the outer corners of the image."""
    number, frame = camera_id(spacecraft), _spice_name(name) + "_CAMERA"
    rays = camera.rays(camera.corners_px())
    corners = ["    " + " ".join(f"{value:.15f}" for value in ray) for ray in rays.tolist()]
    focal = camera.focal_px
    lens = (getattr(camera, name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    lines = [
        "KPL/IK",
        "",
        "Pixel centres have whole coordinates; the centre of the first pixel is (0, 0).",
        "Distortion (K1, K2, K3, P1, P2) is that of Brown's model; a lens without any has zeros.",
        "",
        "\\begindata",
        "",
        f"INS{number}_FOV_FRAME = '{frame}'",
        f"INS{number}_FOV_SHAPE = 'POLYGON'",
        f"INS{number}_BORESIGHT = ( 0.0 0.0 1.0 )",
        f"INS{number}_FOV_BOUNDARY = (",
        *corners,
        ")",
        f"INS{number}_PIXEL_SAMPLES = ( {camera.width_px} )",
        f"INS{number}_PIXEL_LINES = ( {camera.height_px} )",
        f"INS{number}_FOCAL_LENGTH_PX = ( {focal:.12f} )",
        f"INS{number}_CCD_CENTER = ( {camera.centre_px[0]:.6f} {camera.centre_px[1]:.6f} )",
        f"INS{number}_FOV_DEGREES = ( {math.degrees(camera.fov_rad):.12f} )",
        f"INS{number}_DISTORTION = ( {' '.join(f'{float(value):.15e}' for value in lens)} )",
        "",
        "\\begintext",
        "",
    ]
    return "\n".join(lines)


def _spice_name(name: str) -> str:
    kept = "".join(c if c.isascii() and c.isalnum() else "_" for c in name.upper())
    return kept[:20] or "SPACECRAFT"


def load_spk(path: Path | str, target: int | None = None, step_s: float = READ_STEP_S) -> Ephemeris:
    """Return the ephemeris of a spacecraft about the Moon in an SPK, with states every ``step_s`` seconds.

    Each segment of the kernel is one of the ephemeris, with both its ends: nothing is interpolated across these.
    Where segments overlap, the last in the file counts, as in SPICE.

    Parameters
    ----------
    target
        SPICE number of the spacecraft; None where the kernel has only one spacecraft.

    Raises
    ------
    MissingLibrary
        If spiceypy is not installed.
    DataFileError
        If the file is no SPK, has no such spacecraft, or does not give its states about the Moon.
    UnknownFrameError
        If the axes of a segment are none that SPICE turns into ICRF without further kernels.
    """
    with _spice() as spice:
        try:
            bodies = sorted(int(one) for one in spice.spkobj(str(path)))
        except spice.utils.exceptions.SpiceyError as error:
            raise DataFileError(path, "", "an SPK", _reason(error)) from None
        chosen = _chosen(path, bodies, target)
        handle = spice.spklef(str(path))
        try:
            arcs = _spk_arcs(spice, handle, chosen)
            states = sum((arc.stop_s - arc.start_s) / step_s + 2 for arc in arcs)
            if not states <= STATES_LIMIT:
                raise DataFileError(path, "", f"at most {STATES_LIMIT} states of {step_s:g} s", f"{states:.0f}")
            segments = [_spk_segment(spice, handle, f"{path}: body {chosen}", arc, step_s) for arc in arcs]
        except spice.utils.exceptions.SpiceyError as error:
            raise DataFileError(path, f"body {chosen}", "states about the Moon", _reason(error)) from None
        finally:
            spice.spkuef(handle)
    if not segments:
        raise DataFileError(path, f"body {chosen}", "an interval of states", "none")
    return Ephemeris(tuple(segments), "SPK")


def _chosen(path: Path | str, bodies: list[int], target: int | None) -> int:
    listed = ", ".join(map(str, bodies)) or "none"
    if target is None:
        craft = [one for one in bodies if one < 0]
        if len(craft) != 1:
            raise DataFileError(path, "", "one spacecraft, or the number of one", f"bodies {listed}")
        return craft[0]
    if target not in bodies:
        raise DataFileError(path, "", f"body {target}", f"bodies {listed}")
    return target


@dataclass(frozen=True, slots=True, eq=False)
class _Arc:
    """Part of a segment of an SPK: descriptor, centre and frame numbers, and its first and last ephemeris time."""

    descriptor: FloatArray
    centre: int
    frame: int
    start_s: float
    stop_s: float


def _spk_arcs(spice: Any, handle: int, body: int) -> list[_Arc]:
    """Return the parts of the segments of a body that count, in time order."""
    arcs: list[_Arc] = []
    spice.dafbbs(handle)
    while spice.daffpa():
        descriptor = spice.dafgs()[:5]
        (start, stop), (target, centre, frame, *_) = spice.dafus(descriptor, 2, 6)
        if target != body:
            continue
        parts = [(float(start), float(stop))]
        for later in arcs:
            parts = [
                part
                for a, b in parts
                for part in ((a, min(b, later.start_s)), (max(a, later.stop_s), b))
                if part[0] < part[1]
            ]
        arcs += [_Arc(descriptor, int(centre), int(frame), a, b) for a, b in parts if a < b]
    return sorted(arcs, key=lambda arc: arc.start_s)


def _spk_segment(spice: Any, handle: int, place: str, arc: _Arc, step_s: float) -> EphemerisSegment:
    count = max(math.ceil((arc.stop_s - arc.start_s) / step_s), 1) + 1
    # A float64 of seconds is good to 0.1 us.
    tai_ns = np.rint(tai_ns_from_et(np.linspace(arc.start_s, arc.stop_s, count)) / 1000).astype(np.int64) * 1000
    states = []
    for et in np.clip(et_from_tai_ns(tai_ns), arc.start_s, arc.stop_s).tolist():  # SPICE refuses 0.1 us beyond an end
        state = spice.spkpvn(handle, arc.descriptor, et)[1]
        state = _turn(spice, place, arc.frame, et) @ state
        if arc.centre != MOON:
            state = state + spice.spkgeo(arc.centre, et, FRAME, MOON)[0]
        states.append(state)
    values, name = 1e3 * np.array(states), place.rpartition(" ")[2]
    return EphemerisSegment(
        timescales.utc_ns_from_tai_ns(tai_ns),
        values[:, :3],
        values[:, 3:],
        object_name=name,
        object_id=name,
        tai_ns=tai_ns,
    )


def _turn(spice: Any, place: str, frame: int, et: float) -> FloatArray:
    """Return the matrix (6, 6) that turns states of a frame into ICRF."""
    name = spice.frmnam(frame)
    try:
        return np.asarray(spice.sxform(name, FRAME, et) if name != FRAME else np.eye(6))
    except spice.utils.exceptions.SpiceyError:
        known = (FRAME, "others that SPICE turns into it without further kernels")
        raise UnknownFrameError(name or str(frame), known, place) from None


def _reason(error: Exception) -> str:
    """Return the short message of a SPICE error."""
    text = str(getattr(error, "short", "") or error)
    return " ".join(text.split())[:120]


def _written(write: Callable[[Any, str], None]) -> bytes:
    with _spice() as spice, tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "kernel")
        write(spice, path)
        return Path(path).read_bytes()


@contextmanager
def _spice() -> Iterator[Any]:
    """Yield spiceypy, one thread at a time."""
    try:
        import spiceypy
    except ImportError:
        raise MissingLibrary("SPICE kernels", "spiceypy", "linna[spice]") from None
    with _CSPICE:
        yield spiceypy
