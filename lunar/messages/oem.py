"""CCSDS Orbit Ephemeris Message in keyword notation: reads versions 1.0, 2.0 and 3.0, writes 2.0.

Files are Moon-centred, in km and km/s.  States come out in ICRF axes, m and m/s; a file in EME2000 (J2000)
axes is turned by the constant frame bias.  Covariances keep their own frame and come out in m and m/s.
Accelerations, where a file has them, are not used.

References
----------
CCSDS 502.0-B-1 (2004), 502.0-B-2 (2009) and 502.0-B-3 (2023), Orbit Data Messages, section 5.
"""

from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.ephemeris import INTERPOLATIONS, Covariance, Ephemeris, EphemerisSegment
from lunar.errors import DataFileError, UnknownFrameError, UnknownTimeSystemError
from lunar.frames import ICRF_NAMES, J2000_NAMES, icrf_from_j2000
from lunar.messages.kvn import Lines, comment_lines, epoch_texts, is_number, numbered_lines, utc_epoch_text
from lunar.timescales import TIME_SYSTEMS, format_tai, format_utc, tai_ns_from_utc_ns, to_tai_ns, utc_ns_from_tai_ns

VERSIONS = ("1.0", "2.0", "3.0")
CENTRES = ("MOON",)
STATES_LIMIT = 1_000_000
"""States of a file: two years of states each minute."""

BLOCK_ROWS = 10_000
_CAST_ROWS = 256
"""Texts that numpy turns into epochs at a time: it refuses a text among more than 500 by a segmentation fault."""

_MANDATORY = ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM", "START_TIME", "STOP_TIME")
_META_KEYS = (
    *_MANDATORY,
    "REF_FRAME_EPOCH",
    "USEABLE_START_TIME",
    "USEABLE_STOP_TIME",
    "INTERPOLATION",
    "INTERPOLATION_DEGREE",
)
_LOWER = np.tril_indices(6)


def save_oem(ephemeris: Ephemeris, path: Path | str) -> None:
    """Write an OEM 2.0 file."""
    Path(path).write_text(format_oem(ephemeris), encoding="utf-8", newline="\n")


def parse_oem(text: str, source: str = "OEM text") -> Ephemeris:
    """Return the ephemeris in the text of an OEM; ``source`` names it in errors.

    Raises
    ------
    DataFileError
        Where the text is cut short or says something that cannot be, with its line.
    UnknownFrameError, UnknownTimeSystemError
        Where axes, centre or time scale are none that can be converted.
    """
    return parse_oem_lines(Lines(numbered_lines(text.splitlines()), source))


def parse_oem_lines(reader: Lines) -> Ephemeris:
    """Return the ephemeris in the lines of an OEM in keyword notation; raises as `parse_oem`."""
    comments, header = reader.header("OEM", VERSIONS)
    for key in ("CREATION_DATE", "ORIGINATOR"):
        if key not in header:
            raise reader.error(f"{key} in the header", "the end of the file" if reader.peek() is None else "none")
    segments: list[EphemerisSegment] = []
    while reader.peek() is not None:
        segments.append(_read_segment(reader, STATES_LIMIT - sum(len(one.utc_ns) for one in segments)))
    if not segments:
        raise reader.error("META_START", "the end of the file")
    for k, (earlier, later) in enumerate(pairwise(segments), start=2):
        start, stop = later.span_tai_ns[0], earlier.span_tai_ns[1]
        if start < stop:
            expected = f"a start at or after {format_tai(stop)}, the end of the segment before"
            raise DataFileError(reader.source, f"segment {k}", expected, format_tai(start))
    return Ephemeris(tuple(segments), header["ORIGINATOR"], tuple(comments))


def format_oem(ephemeris: Ephemeris, *, time_system: str | None = None, creation_utc_ns: int | None = None) -> str:
    """Return OEM 2.0 text; positions to 1 um, velocities to 1 nm/s, epochs exact to the nanosecond.

    ``time_system`` overrides the segments' own.  CREATION_DATE is the first epoch of the ephemeris unless
    given, so that the same states give the same octets.
    """
    created = ephemeris.start_utc_ns if creation_utc_ns is None else creation_utc_ns
    lines = ["CCSDS_OEM_VERS = 2.0"]
    lines += comment_lines(ephemeris.comments)
    lines += [f"CREATION_DATE = {format_utc(created).rstrip('Z')}", f"ORIGINATOR = {ephemeris.originator}", ""]
    for segment in ephemeris.segments:
        lines += _segment_lines(segment, time_system or segment.time_system)
    return "\n".join(lines) + "\n"


def _read_segment(reader: Lines, left: int) -> EphemerisSegment:
    line = reader.take()
    if line != "META_START":
        raise reader.error("META_START", repr(line[:60]))
    comments, meta, where = reader.metadata(_META_KEYS, _MANDATORY)
    system = meta["TIME_SYSTEM"].upper()
    if system not in TIME_SYSTEMS:
        place = f"{reader.source}: line {where['TIME_SYSTEM']}"
        raise UnknownTimeSystemError(meta["TIME_SYSTEM"], TIME_SYSTEMS, place)
    frame = meta["REF_FRAME"].upper().replace(" ", "")
    if frame not in ICRF_NAMES + J2000_NAMES:
        place = f"{reader.source}: line {where['REF_FRAME']}"
        raise UnknownFrameError(meta["REF_FRAME"], (*ICRF_NAMES, *J2000_NAMES), place)
    if meta["CENTER_NAME"].upper() not in CENTRES:
        raise reader.error("CENTER_NAME = MOON", repr(meta["CENTER_NAME"]), where["CENTER_NAME"])
    method = meta.get("INTERPOLATION", "HERMITE").upper()
    if method not in INTERPOLATIONS:
        raise reader.error(f"an INTERPOLATION out of {', '.join(INTERPOLATIONS)}", repr(method), where["INTERPOLATION"])
    degree = _degree(reader, meta, where, method)
    useable: dict[str, int] = {
        key: reader.epoch(meta[key], system, where[key])
        for key in ("USEABLE_START_TIME", "USEABLE_STOP_TIME")
        if key in meta
    }
    ends = {key: reader.tai(meta[key], system, where[key]) for key in ("START_TIME", "STOP_TIME")}
    comments += reader.comments()
    tai_ns, states, lines_at = _read_states(reader, system, left)
    spans = ends | {key: tai_ns_from_utc_ns(value) for key, value in useable.items()}
    _check_epochs(reader, tai_ns, spans, lines_at)
    position_m, velocity_m_s = 1e3 * states[:, :3], 1e3 * states[:, 3:6]
    if frame in J2000_NAMES:
        position_m, velocity_m_s = position_m @ icrf_from_j2000().T, velocity_m_s @ icrf_from_j2000().T
    return EphemerisSegment(
        utc_ns_from_tai_ns(tai_ns),
        position_m,
        velocity_m_s,
        centre="MOON",
        frame="ICRF",
        object_name=meta["OBJECT_NAME"],
        object_id=meta["OBJECT_ID"],
        time_system=system,
        interpolation=method,
        degree=degree,
        useable_start_utc_ns=useable.get("USEABLE_START_TIME"),
        useable_stop_utc_ns=useable.get("USEABLE_STOP_TIME"),
        comments=tuple(comments),
        covariances=tuple(_read_covariances(reader, system, meta["REF_FRAME"])),
        tai_ns=tai_ns,
    )


def _degree(reader: Lines, meta: dict[str, str], where: dict[str, int], method: str) -> int:
    if "INTERPOLATION_DEGREE" not in meta:
        if "INTERPOLATION" in meta and method != "LINEAR":
            raise reader.error("INTERPOLATION_DEGREE with INTERPOLATION", "none", where["INTERPOLATION"])
        return 1 if method == "LINEAR" else 7
    text = meta["INTERPOLATION_DEGREE"]
    if not text.isdigit() or not 1 <= int(text) <= 30:
        raise reader.error("an INTERPOLATION_DEGREE of 1 to 30", repr(text), where["INTERPOLATION_DEGREE"])
    return int(text)


def _read_states(reader: Lines, system: str, left: int) -> tuple[IntArray, FloatArray, IntArray]:
    """Return epochs (n,) in TAI, states (n, 6 or 9) in km and line numbers (n,); at most ``left`` of them."""
    if not (reader.peek() or " ")[0].isdigit():
        found = reader.peek()
        expected = "a state: epoch x y z vx vy vz"
        raise reader.next_error(expected, "the end of the file" if found is None else repr(found[:60]))
    blocks = []
    width = len((reader.peek() or "").split())
    while (taken := reader.rows(BLOCK_ROWS))[0]:
        rows, at = taken
        left -= len(rows)
        if left < 0:
            raise reader.error(f"at most {STATES_LIMIT} states", "more")
        blocks.append((*_parse_states(reader, rows, at, width, system), np.array(at)))
    epochs, numbers, lines = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return epochs, numbers, lines


def _parse_states(
    reader: Lines, rows: list[str], at: list[int], width: int, system: str
) -> tuple[IntArray, FloatArray]:
    """Return the epochs in TAI and numbers of a block of rows with ``width`` values each."""
    table = None
    if width in (7, 10):
        # The reader of numpy takes epochs and numbers in one go; what it refuses is gone through line by line.
        with suppress(ValueError):
            kind = [("epoch", "S40"), ("state", "f8", width - 1)]
            table = np.loadtxt(rows, dtype=kind, comments=None, ndmin=1)
    if table is None:
        for row, line in zip(rows, at, strict=True):
            count = len(row.split())
            if count not in (7, 10) or count != width:
                first = width not in (7, 10)
                expected = "an epoch and 6 or 9 numbers" if first else f"{width} values as in the line before"
                raise reader.error(expected, f"{count} values", line)
            for token in row.split()[1:]:
                if not is_number(token):
                    raise reader.error("a number", repr(token), line)
        raise reader.error("states of numbers", "others", at[0])
    numbers = table["state"].copy()
    bad = np.flatnonzero(~np.isfinite(numbers).all(axis=1))
    if bad.size:
        raise reader.error("finite numbers", "NaN or infinity", at[int(bad[0])])
    return _epochs(reader, table["epoch"], at, system), numbers


def _epochs(reader: Lines, texts: NDArray[np.bytes_], at: list[int], system: str) -> IntArray:
    # numpy reads calendar dates in one go; other notations, leap seconds and faults go through the slow reader, which
    # names the line.
    texts = np.strings.rstrip(texts, b"Z")
    if texts[0][4:5] == b"-" and texts[0][7:8] == b"-":
        with suppress(ValueError):
            parts = [texts[k : k + _CAST_ROWS].astype("datetime64[ns]") for k in range(0, len(texts), _CAST_ROWS)]
            return np.asarray(to_tai_ns(np.concatenate(parts).astype(np.int64), system))
    return np.array(
        [reader.tai(text.decode("latin-1"), system, line) for text, line in zip(texts, at, strict=True)], dtype=np.int64
    )


def _check_epochs(reader: Lines, tai_ns: IntArray, times: dict[str, int], at: IntArray) -> None:
    late = np.flatnonzero(np.diff(tai_ns) <= 0)
    if late.size:
        k = int(late[0])
        raise reader.error(
            f"an epoch after {format_tai(int(tai_ns[k]), 6)}", format_tai(int(tai_ns[k + 1]), 6), int(at[k + 1])
        )
    start_ns, stop_ns, grace_ns = times["START_TIME"], times["STOP_TIME"], 10**6  # Both may be rounded.
    outside = np.flatnonzero((tai_ns < start_ns - grace_ns) | (tai_ns > stop_ns + grace_ns))
    if outside.size:
        span = f"{format_tai(start_ns)}..{format_tai(stop_ns)} (START_TIME..STOP_TIME)"
        k = int(outside[0])
        raise reader.error(f"an epoch within {span}", format_tai(int(tai_ns[k])), int(at[k]))
    is_cut = stop_ns > tai_ns[-1] + grace_ns
    if is_cut or start_ns < tai_ns[0] - grace_ns:
        side, key = (-1, "STOP_TIME") if is_cut else (0, "START_TIME")
        raise reader.error(
            f"a {'last' if side else 'first'} state at {key} = {format_tai(times[key])}",
            f"{format_tai(int(tai_ns[side]))}; the segment is cut short",
            int(at[side]),
        )
    low = times.get("USEABLE_START_TIME", int(tai_ns[0]))
    high = times.get("USEABLE_STOP_TIME", int(tai_ns[-1]))
    if low > high or low > tai_ns[-1] or high < tai_ns[0]:
        raise reader.error(
            f"a useable interval within {format_tai(int(tai_ns[0]))}..{format_tai(int(tai_ns[-1]))}",
            f"{format_tai(low)}..{format_tai(high)}",
            int(at[0]),
        )


def _read_covariances(reader: Lines, system: str, frame: str) -> Iterator[Covariance]:
    """Yield the covariances of the block that the next line opens, if it opens one."""
    list(reader.comments())  # Comments after the states belong to nothing that is kept.
    if reader.peek() != "COVARIANCE_START":
        return
    reader.take()
    # A frame holds until the next is named; without any, the covariance is in the frame of the segment.
    while True:
        list(reader.comments())
        if reader.peek() == "COVARIANCE_STOP":
            reader.take()
            return
        _, value = reader.keyword(("EPOCH",))
        epoch = reader.epoch(value, system)
        list(reader.comments())
        if (reader.peek() or "").startswith("COV_REF_FRAME"):
            _, frame = reader.keyword(("COV_REF_FRAME",))
        values: list[float] = []
        for row in range(1, 7):
            tokens = reader.take().split()
            if len(tokens) != row or not all(map(is_number, tokens)):
                raise reader.error(f"{row} numbers of row {row} of a covariance", repr(" ".join(tokens)[:60]))
            values += map(float, tokens)
        matrix = np.zeros((6, 6))
        matrix[_LOWER] = values
        yield Covariance(epoch, frame, 1e6 * (matrix + np.tril(matrix, -1).T))


def _segment_lines(segment: EphemerisSegment, system: str) -> list[str]:
    if system not in TIME_SYSTEMS:
        raise UnknownTimeSystemError(system, TIME_SYSTEMS)
    texts = epoch_texts(segment.tai_ns, system)
    lines = [
        "META_START",
        *comment_lines(segment.comments),
        f"OBJECT_NAME = {segment.object_name}",
        f"OBJECT_ID = {segment.object_id or segment.object_name}",
        f"CENTER_NAME = {segment.centre}",
        f"REF_FRAME = {segment.frame}",
        f"TIME_SYSTEM = {system}",
        f"START_TIME = {texts[0]}",
    ]
    if segment.useable_start_utc_ns is not None or segment.useable_stop_utc_ns is not None:
        # Some readers want both or none.
        first, last = (epoch_texts(edge, system)[0] for edge in segment.span_tai_ns)
        lines += [f"USEABLE_START_TIME = {first}", f"USEABLE_STOP_TIME = {last}"]
    lines += [
        f"STOP_TIME = {texts[-1]}",
        f"INTERPOLATION = {segment.interpolation}",
        f"INTERPOLATION_DEGREE = {segment.degree}",
        "META_STOP",
        "",
    ]
    states = np.concatenate([segment.position_m, segment.velocity_m_s], axis=1) / 1e3
    row = "%s %.9f %.9f %.9f %.12f %.12f %.12f"
    lines += [row % (text, *state) for text, state in zip(texts, states.tolist(), strict=True)]
    if segment.covariances:
        lines += ["", "COVARIANCE_START"]
        for covariance in segment.covariances:
            lines.append(f"EPOCH = {utc_epoch_text(covariance.utc_ns, system)}")
            lines.append(f"COV_REF_FRAME = {covariance.frame}")
            lines += [" ".join(f"{v:.15e}" for v in covariance.matrix[k, : k + 1] / 1e6) for k in range(6)]
        lines.append("COVARIANCE_STOP")
    return [*lines, ""]
