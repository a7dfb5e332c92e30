"""CCSDS messages in XML: Orbit Ephemeris Messages of versions 1.0, 2.0 and 3.0 (written as 2.0); lines of an AEM.

The elements are brought into keyword notation, line by line, and read by `lunar.messages.oem` or `lunar.messages.aem`:
both notations pass the same checks, and errors name the line of the XML file.  Document type
definitions are refused, so entities cannot expand or refer to files.

References
----------
CCSDS 505.0-B-2 (2021), XML Specification for Navigation Data Messages, sections on the OEM and AEM.
"""

from collections.abc import Iterable, Iterator
from xml.parsers import expat
from xml.sax.saxutils import escape

import numpy as np

from lunar.ephemeris import Covariance, Ephemeris, EphemerisSegment
from lunar.errors import DataFileError
from lunar.messages.kvn import Lines, epoch_texts, utc_epoch_text
from lunar.messages.oem import parse_oem_lines
from lunar.timescales import format_utc

_STATE = ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
_AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
_COVARIANCE = [[f"C{row}_{column}" for column in _AXES[: k + 1]] for k, row in enumerate(_AXES)]
_UNITS = dict.fromkeys(("X", "Y", "Z"), "km") | dict.fromkeys(("X_DOT", "Y_DOT", "Z_DOT"), "km/s")
_DEPTH = 16
BLOCK_OCTETS = 1 << 16
_ROWS = {
    "stateVector": _STATE,
    **dict.fromkeys(("quaternionEphemeris", "quaternionState"), ("EPOCH", "Q1", "Q2", "Q3", "QC")),
}
"""Elements that become a line of numbers, by name: an AEM has the scalar of a quaternion last."""

_GROUPS = ("header", "metadata", "covarianceMatrix", *_ROWS)
_MESSAGES = ("oem", "aem")
_FRAMES = ("ndm", *_MESSAGES, "body", "segment", "data", "attitudeState", "quaternion", *_GROUPS)


def parse_oem_xml(octets: bytes, source: str = "OEM XML") -> Ephemeris:
    """Return the ephemeris in an OEM in XML; ``source`` names it in errors.

    Raises
    ------
    DataFileError
        Where the text is no XML, has a document type, or says something that cannot be, with its line.
    UnknownFrameError, UnknownTimeSystemError
        Where axes, centre or time scale are none that can be converted.
    """
    return parse_oem_lines(Lines(xml_lines(octets, source), source))


def xml_lines(octets: bytes, source: str) -> Iterator[tuple[int, str]]:
    """Yield the lines in keyword notation of a message in XML, with line numbers; raises as `parse_oem_xml`."""
    return _Reader(source).read(octets)


def format_oem_xml(ephemeris: Ephemeris) -> str:
    """Return OEM 2.0 as XML; positions to 1 um, velocities to 1 nm/s, epochs exact to the nanosecond."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<oem xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        'xsi:noNamespaceSchemaLocation="https://sanaregistry.org/r/ndmxml/ndmxml-1.0-master.xsd" '
        'id="CCSDS_OEM_VERS" version="2.0">',
        "<header>",
        *_comments(ephemeris.comments),
        _element("CREATION_DATE", format_utc(ephemeris.start_utc_ns).rstrip("Z")),
        _element("ORIGINATOR", ephemeris.originator),
        "</header>",
        "<body>",
    ]
    for segment in ephemeris.segments:
        lines += _segment(segment)
    return "\n".join([*lines, "</body>", "</oem>", ""])


class _Reader:
    """Lines in keyword notation with the line numbers of the XML that they come from."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.lines: list[tuple[int, str]] = []
        self.path: list[str] = []
        self.text: list[str] = []
        self.values: dict[str, str] = {}
        self.parser = expat.ParserCreate()
        self.parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self._doctype
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self.text.append

    def read(self, octets: bytes) -> Iterator[tuple[int, str]]:
        try:
            for begin in range(0, len(octets), BLOCK_OCTETS):
                self.parser.Parse(octets[begin : begin + BLOCK_OCTETS], False)
                yield from self.lines[:-1]
                del self.lines[:-1]  # the next covariance may replace the last line
            self.parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise self._error("well-formed XML", expat.ErrorString(error.code)) from None
        except (LookupError, ValueError) as error:  # an encoding that is unknown or not supported
            raise self._error("XML in UTF-8", str(error)) from None
        yield from self.lines

    def _error(self, expected: str, found: str) -> DataFileError:
        return DataFileError(self.source, f"line {self.parser.CurrentLineNumber}", expected, found)

    def _line(self, text: str) -> None:
        self.lines.append((self.parser.CurrentLineNumber, text))

    def _doctype(self, name: str, *_: object) -> None:
        raise self._error("XML without a document type", f"<!DOCTYPE {name[:40]}>")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        name = tag.rpartition(":")[2]
        self.path.append(name)
        self.text.clear()
        if len(self.path) > _DEPTH:
            raise self._error(f"at most {_DEPTH} levels of elements", f"<{name[:40]}>")
        if name in _MESSAGES:
            key = attributes.get("id", f"CCSDS_{name.upper()}_VERS")
            self._line(f"{key} = {attributes.get('version', '')}")
        elif name == "metadata":
            self._line("META_START")
        elif name in _GROUPS:
            self.values = {}
        elif name == "data" and "aem" in self.path:
            self._line("DATA_START")
        elif self.path[0] not in ("ndm", *_MESSAGES):
            raise self._error("an element <oem>, <aem> or <ndm>", f"<{name[:40]}>")
        unit = attributes.get("units")
        if unit is not None and name in _UNITS and unit != _UNITS[name]:
            raise self._error(f"units={_UNITS[name]!r} of {name}", repr(unit))

    def _end(self, tag: str) -> None:
        name = self.path.pop()
        value = " ".join("".join(self.text).split())
        self.text.clear()
        group = self.path[-1] if self.path else ""
        if name == "metadata":
            self._line("META_STOP")
        elif name in _ROWS:
            self._line(" ".join(self._values(_ROWS[name])))
        elif name == "data" and "aem" in self.path:
            self._line("DATA_STOP")
        elif name == "covarianceMatrix":
            self._covariance()
        elif name in _FRAMES:
            return
        elif name == "COMMENT":
            # Comments between states belong to nothing that is kept.
            if group in ("header", "metadata"):
                self._line(f"COMMENT {value}".rstrip())
        elif name == "QUATERNION_TYPE":
            return  # In XML the elements name the parts of a quaternion.
        elif group in ("header", "metadata"):
            self._line(f"{name} = {value}")
        elif group in (*_GROUPS, "quaternion"):
            self.values[name] = value
        else:
            raise self._error(f"an element of an OEM or AEM in <{group}>", f"<{name[:40]}>")

    def _values(self, names: Iterable[str]) -> list[str]:
        for name in names:
            if not self.values.get(name) or " " in self.values[name]:
                raise self._error(f"<{name}> with one value", repr(self.values.get(name, "none")[:40]))
        return [self.values[name] for name in names]

    def _covariance(self) -> None:
        opened = "COVARIANCE_STOP"
        if self.lines and self.lines[-1][1] == opened:
            self.lines.pop()
        else:
            self._line("COVARIANCE_START")
        self._line(f"EPOCH = {self._values(('EPOCH',))[0]}")
        if "COV_REF_FRAME" in self.values:
            self._line(f"COV_REF_FRAME = {self.values['COV_REF_FRAME']}")
        for row in _COVARIANCE:
            self._line(" ".join(self._values(row)))
        self._line(opened)


def _element(name: str, value: str) -> str:
    return f"<{name}>{escape(value)}</{name}>"


def _comments(comments: Iterable[str]) -> list[str]:
    return [_element("COMMENT", line) for comment in comments for line in comment.splitlines() if line]


def _segment(segment: EphemerisSegment) -> list[str]:
    texts = epoch_texts(segment.tai_ns, segment.time_system)
    meta = [
        ("OBJECT_NAME", segment.object_name),
        ("OBJECT_ID", segment.object_id or segment.object_name),
        ("CENTER_NAME", segment.centre),
        ("REF_FRAME", segment.frame),
        ("TIME_SYSTEM", segment.time_system),
        ("START_TIME", texts[0]),
    ]
    if segment.useable_start_utc_ns is not None or segment.useable_stop_utc_ns is not None:
        meta += [
            (f"USEABLE_{end}_TIME", epoch_texts(edge, segment.time_system)[0])
            for edge, end in zip(segment.span_tai_ns, ("START", "STOP"), strict=True)
        ]
    meta += [
        ("STOP_TIME", texts[-1]),
        ("INTERPOLATION", segment.interpolation),
        ("INTERPOLATION_DEGREE", str(segment.degree)),
    ]
    lines = ["<segment>", "<metadata>", *_comments(segment.comments)]
    lines += [_element(name, value) for name, value in meta]
    lines += ["</metadata>", "<data>"]
    row = "<stateVector><EPOCH>%s</EPOCH>"
    row += "".join(f'<{key} units="km">%.9f</{key}>' for key in _AXES[:3])
    row += "".join(f'<{key} units="km/s">%.12f</{key}>' for key in _AXES[3:]) + "</stateVector>"
    states = (np.concatenate([segment.position_m, segment.velocity_m_s], axis=1) / 1e3).tolist()
    lines += [row % (text, *state) for text, state in zip(texts, states, strict=True)]
    for covariance in segment.covariances:
        lines += _covariance_lines(covariance, segment.time_system)
    return [*lines, "</data>", "</segment>"]


def _covariance_lines(covariance: Covariance, time_system: str) -> list[str]:
    epoch = utc_epoch_text(covariance.utc_ns, time_system)
    units = ("km**2", "km**2/s", "km**2/s**2")
    lines = ["<covarianceMatrix>", _element("EPOCH", epoch), _element("COV_REF_FRAME", covariance.frame)]
    for k, row in enumerate(_COVARIANCE):
        for column, name in enumerate(row):
            unit = units[(k > 2) + (column > 2)]
            lines.append(f'<{name} units="{unit}">{covariance.matrix[k, column] / 1e6:.15e}</{name}>')
    return [*lines, "</covarianceMatrix>"]
