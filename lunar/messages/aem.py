"""CCSDS Attitude Ephemeris Message of quaternions: reads and writes versions 1.0 and 2.0, and reads them in XML.

A message gives the rotation from a reference frame A to a frame B of the spacecraft.  Here a quaternion is
``q_wxyz``, Hamilton's, with v_B = q v_A q*; the standard's is its conjugate (the matrix of the standard turns
coordinates from A to B with the opposite sign of the vector part).

References
----------
CCSDS 504.0-B-1 (2008) and 504.0-B-2 (2024), Attitude Data Messages, section 4 and annex on quaternions.
"""

from dataclasses import dataclass

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.errors import EphemerisError, UnknownTimeSystemError
from lunar.frames import continuous_quaternions
from lunar.messages.kvn import Lines, comment_lines, epoch_texts, is_number, numbered_lines
from lunar.messages.oem_xml import xml_lines
from lunar.timescales import TIME_SYSTEMS, format_utc, tai_ns_from_utc_ns

VERSIONS = ("1.0", "2.0")
UNIT_TOLERANCE = 1e-3
"""Accepted deviation of a quaternion from unit length: attitude reports have few digits."""

CAMERA_FRAME = "INSTRUMENT_1"
"""Name of the camera axes in messages; SANA registers INSTRUMENT_n for instruments."""

CAMERA_NAMES = ("INSTRUMENT", "CAMERA")
"""Beginnings of the names of the camera axes in an AEM."""

_MANDATORY = (
    "OBJECT_NAME",
    "OBJECT_ID",
    "REF_FRAME_A",
    "REF_FRAME_B",
    "TIME_SYSTEM",
    "START_TIME",
    "STOP_TIME",
    "ATTITUDE_TYPE",
)
_META_KEYS = (
    *_MANDATORY,
    "CENTER_NAME",
    "ATTITUDE_DIR",
    "QUATERNION_TYPE",
    "USEABLE_START_TIME",
    "USEABLE_STOP_TIME",
    "INTERPOLATION_METHOD",
    "INTERPOLATION_DEGREE",
)


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeSegment:
    """Attitudes of one span.

    Attributes
    ----------
    utc_ns, q_wxyz
        Epochs (n,), ascending, and unit quaternions (n, 4) that turn vectors from ``frame_a`` to ``frame_b``.
    """

    utc_ns: IntArray
    q_wxyz: FloatArray
    frame_a: str = "ICRF"
    frame_b: str = CAMERA_FRAME
    object_name: str = "SELENITA"
    object_id: str = "SELENITA"
    time_system: str = "UTC"
    comments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.utc_ns) == 0:
            raise EphemerisError("an attitude segment: expected at least one attitude, found none")
        if self.q_wxyz.shape != (len(self.utc_ns), 4):
            raise EphemerisError(
                f"an attitude segment: expected quaternions ({len(self.utc_ns)}, 4), found {self.q_wxyz.shape}"
            )


def parse_aem(text: str, source: str = "AEM text") -> tuple[AttitudeSegment, ...]:
    """Return the segments in the text of an AEM, in keyword notation or XML; ``source`` names it in errors.

    Raises
    ------
    DataFileError
        Where the text is cut short or says something that cannot be, with its line.
    UnknownTimeSystemError
        Where the time scale is none that can be converted.
    """
    is_xml = text.lstrip().startswith("<")
    lines = xml_lines(text.encode(), source) if is_xml else numbered_lines(text.splitlines())
    reader = Lines(lines, source)
    reader.header("AEM", VERSIONS)
    segments: list[AttitudeSegment] = []
    while reader.peek() is not None:
        segments.append(_read_segment(reader))
        start = int(segments[-1].utc_ns[0])
        if len(segments) > 1 and start < (end := int(segments[-2].utc_ns[-1])):
            raise reader.error(f"attitudes at or after {format_utc(end)}", format_utc(start))
    if not segments:
        raise reader.error("META_START", "the end of the file")
    return tuple(segments)


def format_aem(segments: tuple[AttitudeSegment, ...], version: str = VERSIONS[-1]) -> str:
    """Return AEM text, quaternions with the scalar last and continuous signs; CREATION_DATE is the first epoch."""
    # Version 2.0 has neither direction nor order: it is always from A to B with the scalar last.
    first = version == VERSIONS[0]
    lines = [
        f"CCSDS_AEM_VERS = {version}",
        f"CREATION_DATE = {format_utc(int(segments[0].utc_ns[0])).rstrip('Z')}",
        "ORIGINATOR = LINNA",
        "",
    ]
    for one in segments:
        texts = epoch_texts(tai_ns_from_utc_ns(one.utc_ns), one.time_system)
        lines += [
            "META_START",
            *comment_lines(one.comments),
            f"OBJECT_NAME = {one.object_name}",
            f"OBJECT_ID = {one.object_id}",
            "CENTER_NAME = MOON",
            f"REF_FRAME_A = {one.frame_a}",
            f"REF_FRAME_B = {one.frame_b}",
            *(["ATTITUDE_DIR = A2B"] if first else []),
            f"TIME_SYSTEM = {one.time_system}",
            f"START_TIME = {texts[0]}",
            f"STOP_TIME = {texts[-1]}",
            "ATTITUDE_TYPE = QUATERNION",
            *(["QUATERNION_TYPE = LAST"] if first else []),
            "META_STOP",
            "",
            "DATA_START",
        ]
        q_wxyz = continuous_quaternions(one.q_wxyz)
        vector_last = (q_wxyz * [1.0, -1.0, -1.0, -1.0])[:, [1, 2, 3, 0]].tolist()
        row = "%s %.12f %.12f %.12f %.12f"
        lines += [row % (text, *values) for text, values in zip(texts, vector_last, strict=True)]
        lines += ["DATA_STOP", ""]
    return "\n".join(lines)


def _read_segment(reader: Lines) -> AttitudeSegment:
    line = reader.take()
    if line != "META_START":
        raise reader.error("META_START", repr(line[:60]))
    comments, meta, where = reader.metadata(_META_KEYS, _MANDATORY)
    system = meta["TIME_SYSTEM"].upper()
    if system not in TIME_SYSTEMS:
        raise UnknownTimeSystemError(meta["TIME_SYSTEM"], TIME_SYSTEMS, reader.source)
    first, inverse = _notation(reader, meta)
    utc_ns, numbers = _read_quaternions(reader, system)
    useable = _useable(reader, meta, where, system, utc_ns)
    utc_ns, numbers = utc_ns[useable], numbers[useable]
    q_wxyz = numbers if first else numbers[:, [3, 0, 1, 2]]
    if not inverse:
        q_wxyz = q_wxyz * [1.0, -1.0, -1.0, -1.0]
    q_wxyz = q_wxyz / np.linalg.norm(q_wxyz, axis=1, keepdims=True)
    return AttitudeSegment(
        utc_ns,
        q_wxyz,
        meta["REF_FRAME_A"],
        meta["REF_FRAME_B"],
        meta["OBJECT_NAME"],
        meta["OBJECT_ID"],
        system,
        tuple(comments),
    )


def _useable(reader: Lines, meta: dict[str, str], where: dict[str, int], system: str, utc_ns: IntArray) -> BoolArray:
    """Return which attitudes (n,) are in the useable interval; they span START_TIME to STOP_TIME, to 1 ms."""
    start, stop, first, last = (
        reader.epoch(meta[key], system, where[key]) if key in meta else None
        for key in ("START_TIME", "STOP_TIME", "USEABLE_START_TIME", "USEABLE_STOP_TIME")
    )
    for key, stated, found in (("START_TIME", start, utc_ns[0]), ("STOP_TIME", stop, utc_ns[-1])):
        if stated is not None and abs(stated - int(found)) > 10**6:
            expected = f"an attitude at {key} = {format_utc(stated)}"
            raise reader.error(expected, f"{format_utc(int(found))}; the segment is cut short?", where[key])
    held = np.ones(len(utc_ns), dtype=np.bool_)
    if first is not None:
        held &= utc_ns >= first
    if last is not None:
        held &= utc_ns <= last
    if not held.any():
        raise reader.error("attitudes in the useable interval", "none")
    return held


def _notation(reader: Lines, meta: dict[str, str]) -> tuple[bool, bool]:
    """Return whether the scalar comes first, and whether the rotation is that from B to A."""
    kind = meta["ATTITUDE_TYPE"].upper()
    if kind != "QUATERNION":
        raise reader.error("ATTITUDE_TYPE = QUATERNION", repr(meta["ATTITUDE_TYPE"]))
    order = meta.get("QUATERNION_TYPE", "LAST").upper()
    if order not in ("FIRST", "LAST"):
        raise reader.error("QUATERNION_TYPE = FIRST or LAST", repr(order))
    direction = meta.get("ATTITUDE_DIR", "A2B").upper()
    if direction not in ("A2B", "B2A"):
        raise reader.error("ATTITUDE_DIR = A2B or B2A", repr(direction))
    return order == "FIRST", direction == "B2A"


def _read_quaternions(reader: Lines, system: str) -> tuple[IntArray, FloatArray]:
    for _ in reader.comments():
        pass
    line = reader.take()
    if line != "DATA_START":
        raise reader.error("DATA_START", repr(line[:60]))
    epochs: list[int] = []
    rows: list[list[float]] = []
    while (line := reader.take()) != "DATA_STOP":
        if line.startswith("COMMENT"):
            continue
        epoch, *values = line.split()
        if len(values) != 4 or not all(map(is_number, values)):
            raise reader.error("an epoch and a quaternion of 4 numbers", repr(line[:60]))
        numbers = [float(value) for value in values]
        if not abs(float(np.linalg.norm(numbers)) - 1.0) <= UNIT_TOLERANCE:
            raise reader.error("a quaternion of unit length", repr(line[:60]))
        epochs.append(reader.epoch(epoch, system))
        if len(epochs) > 1 and epochs[-1] <= epochs[-2]:
            raise reader.error(f"an epoch after {format_utc(epochs[-2])}", format_utc(epochs[-1]))
        rows.append(numbers)
    if not rows:
        raise reader.error("at least one attitude", "none")
    return np.array(epochs, dtype=np.int64), np.array(rows)
