"""SPICE kernels: SPK (orbit), CK (attitude), SCLK (clock), FK (frames) and IK (camera); SPK can be read.

The binary kernels are written and read with spiceypy, which is an optional dependency.  The text kernels need none.
Frame and instrument numbers follow from the number of the spacecraft, as NAIF recommends: -S000 is the spacecraft,
-S001 the camera.

References
----------
NAIF Required Reading: SPK (types 9 and 13), CK (type 3), SCLK (type 1), FRAMES, GETFOV, TIME.
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

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import DataFileError, EphemerisError, MissingLibrary
from lunar.timescales import (
    J2000_TT_AS_UTC_COUNT_NS,
    NS,
    TICKS_PER_SECOND,
    TT_MINUS_TAI_NS,
    tai_ns_from_utc_ns,
    utc_ns_from_tai_ns,
)

MOON = 301
FRAME = "J2000"
"""Name of the ICRF axes in SPICE."""

READ_STEP_S = 60.0
"""Step between states taken from an SPK: Hermite interpolation of degree 7 in a low orbit is then exact to 1 um."""

STATES_LIMIT = 2_000_000

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
    tai_ns = np.asarray(tai_ns_from_utc_ns(np.asarray(utc_ns, dtype=np.int64)))
    tt_s = (tai_ns + (TT_MINUS_TAI_NS - J2000_TT_AS_UTC_COUNT_NS)) / NS
    return np.asarray(tt_s + _tdb_minus_tt_s(tt_s))


def utc_ns_from_et(et_s: FloatArray | float) -> IntArray:
    """Return UTC (...) of SPICE's ephemeris times, to 0.1 us."""
    et = np.asarray(et_s, dtype=np.float64)
    tt = et - _tdb_minus_tt_s(et - _tdb_minus_tt_s(et))
    whole = np.floor(tt)
    tai_ns = whole.astype(np.int64) * NS + np.rint((tt - whole) * NS).astype(np.int64)
    return np.asarray(
        utc_ns_from_tai_ns(tai_ns + (J2000_TT_AS_UTC_COUNT_NS - TT_MINUS_TAI_NS)), dtype=np.int64
    )


def _tdb_minus_tt_s(seconds: FloatArray) -> FloatArray:
    anomaly = _M0 + _M1 * seconds
    return np.asarray(_K * np.sin(anomaly + _EB * np.sin(anomaly)))


def spk_octets(ephemeris: Ephemeris, spacecraft: int) -> bytes:
    """Return an SPK of an ephemeris: type 13 for Hermite interpolation, type 9 otherwise, a segment for each.

    The window of states is that of the ephemeris where SPICE has it (an even number of states); segments of one state
    are left out.

    Raises
    ------
    MissingLibrary
        If spiceypy is not installed.
    EphemerisError
        If no segment has two states.
    """
    segments = [one for one in ephemeris.segments if len(one.utc_ns) > 1]
    if not segments:
        raise EphemerisError("an SPK: expected a segment of at least two states, found none")

    def write(spice: Any, path: str) -> None:
        handle = spice.spkopn(path, "LINNA", 0)
        for one in segments:
            _write_spk_segment(spice, handle, one, spacecraft)
        spice.spkcls(handle)

    return _written(write)


def _write_spk_segment(spice: Any, handle: int, one: EphemerisSegment, spacecraft: int) -> None:
    et = et_from_utc_ns(one.utc_ns)
    states = np.concatenate([one.position_m, one.velocity_m_s], axis=1) / 1e3
    useable = et_from_utc_ns(np.array([one.start_utc_ns, one.stop_utc_ns], dtype=np.int64))
    name = one.object_name[:40].encode("ascii", "replace").decode()
    head = (handle, spacecraft, MOON, FRAME, float(useable[0]), float(useable[1]), name)
    if one.interpolation == "HERMITE":
        window = min((one.degree + 1) // 2, len(et))
        # Windows of SPICE have an even number of states; the degree of type 13 is 2 w - 1.
        degree = 2 * min(max(window - window % 2, 2), 14) - 1
        spice.spkw13(*head, degree, len(et), states, et)
    else:
        degree = 1 if one.interpolation == "LINEAR" else min(one.degree, 27, len(et) - 1)
        spice.spkw09(*head, max(degree - (degree + 1) % 2, 1), len(et), states, et)


def ck_octets(
    ticks: IntArray, q_wxyz: FloatArray, spacecraft: int, *, gap_ticks: int = 10 * TICKS_PER_SECOND
) -> bytes:
    """Return a CK (type 3) of the camera: attitudes are interpolated between images at most ``gap_ticks`` apart.

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
    starts = times[np.concatenate(([True], np.diff(ticks) > gap_ticks))]

    def write(spice: Any, path: str) -> None:
        handle = spice.ckopn(path, "LINNA", 0)
        rates = np.zeros((len(times), 3))
        spice.ckw03(
            handle,
            times[0],
            times[-1],
            camera_id(spacecraft),
            FRAME,
            False,
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


def format_sclk(lines: Sequence[ClockLine], spacecraft: int) -> str:
    """Return an SCLK kernel of the on-board clock: 32 bits of seconds, 16 bits of fraction, one partition."""
    rows = []
    for one in lines:
        tai_ns = int(tai_ns_from_utc_ns(one.utc_ns))
        tt_ns = tai_ns + TT_MINUS_TAI_NS - J2000_TT_AS_UTC_COUNT_NS
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
            f"SCLK01_MODULI_{number} = ( {_MODULUS} {TICKS_PER_SECOND} )",
            f"SCLK01_OFFSETS_{number} = ( 0 0 )",
            f"SCLK01_OUTPUT_DELIM_{number} = ( 1 )",
            f"SCLK_PARTITION_START_{number} = ( 0 )",
            f"SCLK_PARTITION_END_{number} = ( {_MODULUS * TICKS_PER_SECOND - 1} )",
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
    """
    with _spice() as spice:
        try:
            bodies = sorted(int(one) for one in spice.spkobj(str(path)))
        except spice.utils.exceptions.SpiceyError as error:
            raise DataFileError(path, "", "an SPK", _reason(error)) from None
        chosen = _chosen(path, bodies, target)
        cover = spice.spkcov(str(path), chosen)
        spans = [spice.wnfetd(cover, k) for k in range(spice.wncard(cover))]
        states = sum((stop - start) / step_s + 2 for start, stop in spans)
        if not states <= STATES_LIMIT:
            raise DataFileError(path, "", f"at most {STATES_LIMIT} states of {step_s:g} s", f"{states:.0f}")
        handle = spice.spklef(str(path))
        try:
            segments = [
                _spk_span(spice, chosen, start, stop, step_s) for start, stop in spans if stop > start
            ]
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


def _spk_span(spice: Any, body: int, start: float, stop: float, step_s: float) -> EphemerisSegment:
    et = np.linspace(start, stop, max(math.ceil((stop - start) / step_s), 1) + 1)
    utc_ns = utc_ns_from_et(et)
    # Epochs are whole nanoseconds; the first and the last one stay inside of the interval.
    at = np.clip(et_from_utc_ns(utc_ns), start, stop)
    states = 1e3 * np.array([spice.spkgeo(body, float(one), FRAME, MOON)[0] for one in at])
    name = str(body)
    return EphemerisSegment(utc_ns, states[:, :3], states[:, 3:], object_name=name, object_id=name)


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
