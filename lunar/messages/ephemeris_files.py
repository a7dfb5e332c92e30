"""Ephemeris files: CCSDS OEM (keyword notation or XML), STK, or Horizons tables, also compressed.

SPICE kernels are binary and read by `lunar.messages.spice`, outside of the server.
"""

import io
import itertools
from pathlib import Path

from lunar.comparison import check_gravity, cut_at_burns
from lunar.datafolder import read_expanded
from lunar.ephemeris import Ephemeris
from lunar.errors import DataFileError
from lunar.messages.horizons import is_horizons, parse_horizons
from lunar.messages.kvn import Lines, numbered_lines
from lunar.messages.oem import parse_oem_lines
from lunar.messages.oem_xml import parse_oem_xml
from lunar.messages.stk import parse_stk

EXPECTED = "a CCSDS OEM, STK .e or Horizons ephemeris"
SPK_MARK = b"DAF/SPK"
OCTETS_LIMIT = 96 << 20
LINES_LIMIT, LINE_OCTETS = 1_000_000, 1 << 16
"""Limits of a file, and of a line that is not XML: a year of states each minute has 60 MB; reading it takes 280 MB."""

_FIRST = "CCSDS_OEM_VERS, stk.v., XML or a Horizons table"


def load_ephemeris(path: Path | str) -> Ephemeris:
    """Return the ephemeris in a file, whose format is determined by its content.

    The formats are CCSDS OEM in keyword notation or XML, STK ``.e``, and CSV vector tables of JPL Horizons; the file
    may be compressed with gzip, or in a zip archive of one file.

    Raises
    ------
    DataFileError
        Where the file is none of them, or says something that cannot be.
    """
    octets = read_expanded(path, EXPECTED, OCTETS_LIMIT)
    if (lines := octets.count(b"\n")) > LINES_LIMIT:
        raise DataFileError(path, "", f"at most {LINES_LIMIT} lines", str(lines))
    pieces = io.BytesIO(octets)
    while line := pieces.readline(LINE_OCTETS + 1):
        if len(line) > LINE_OCTETS and b"<" not in octets[:LINE_OCTETS]:
            raise DataFileError(path, "", f"at most {LINE_OCTETS} octets in a line", "more")
    if octets.startswith(SPK_MARK):
        raise DataFileError(path, "", EXPECTED, "a SPICE kernel; convert it with 'linna orbit convert'")
    stream = io.TextIOWrapper(io.BytesIO(octets), "utf-8-sig")
    try:
        for word in map(str.strip, itertools.islice(stream, 50)):
            if word.startswith("<"):
                return parse_oem_xml(octets, source=str(path))
            if word.startswith("CCSDS_OEM_VERS"):
                stream.seek(0)
                return parse_oem_lines(Lines(numbered_lines(stream), str(path)))
            if word.lower().startswith("stk.v"):
                return parse_stk(octets.decode("utf-8-sig"), source=str(path))
            if word and not word.startswith(("COMMENT", "#")):
                if is_horizons(text := octets.decode("utf-8-sig")):
                    return parse_horizons(text, source=str(path))
                raise DataFileError(path, "first line", _FIRST, repr(word[:40]))
    except UnicodeDecodeError:
        raise DataFileError(path, "", EXPECTED, "octets that are no text") from None
    raise DataFileError(path, "first line", _FIRST, "nothing")


def load_orbit(path: Path | str) -> Ephemeris:
    """Return the ephemeris in a file, whose states must move as gravity moves them, cut at burns."""
    ephemeris = load_arcs(path)
    check_gravity(ephemeris)
    return ephemeris


def load_arcs(path: Path | str) -> Ephemeris:
    """Return the ephemeris in a file that was checked before, cut at burns."""
    return cut_at_burns(load_ephemeris(path))


def is_spk(path: Path | str) -> bool:
    """Return whether a file is a SPICE kernel of orbits; False where it cannot be read."""
    try:
        with Path(path).open("rb") as stream:
            return stream.read(len(SPK_MARK)) == SPK_MARK
    except OSError:
        return False
