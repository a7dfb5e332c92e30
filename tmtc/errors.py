"""Errors of octets, and of values that are packed into octets.

TmtcError
├── TruncatedPacket       fewer octets than the header or the definition asks for
├── MalformedPacket       header fields or lengths contradict the standard or the dictionary
├── ChecksumError         packet error control, frame error control or BCH does not hold
├── UnknownPacket         no such name or (APID, service, subtype) in the dictionary
├── ValueRefused          a value that its field cannot hold or its range forbids
├── FrameError            a transfer frame that cannot be built or read
├── TableError            an uploaded table (anchor ephemeris, catalogue, gravity) is damaged or of another kind
├── LinkFormatError       a stream whose framing cannot be determined, or settings that contradict each other
├── DefinitionError       an imported packet definition that is damaged, contradicts itself or is not supported
└── MissingLibrary        a file format whose optional library is not installed
"""


class TmtcError(Exception):
    """Base of every error raised by this package; `str(error)` is one line."""


class TruncatedPacket(TmtcError):
    """Octets end before the thing they announce."""

    def __init__(self, what: str, expected: int, found: int) -> None:
        self.expected = expected
        self.found = found
        super().__init__(f"{what}: expected {expected} octets, found {found}")


class MalformedPacket(TmtcError):
    """Header fields or lengths contradict the standard or the dictionary."""


class ChecksumError(TmtcError):
    """A checksum carried by the octets does not hold."""

    def __init__(self, what: str, expected: int, found: int) -> None:
        self.expected = expected
        self.found = found
        super().__init__(f"{what}: expected checksum 0x{expected:04X}, found 0x{found:04X}")


class UnknownPacket(TmtcError):
    """The dictionary does not know this packet."""


class ValueRefused(TmtcError):
    """A value that its field cannot hold, or that its range forbids."""

    def __init__(self, packet: str, field: str, value: object, expected: str) -> None:
        self.packet = packet
        self.field = field
        self.value = value
        super().__init__(f"{packet}.{field}: expected {expected}, found {value!r}")


class FrameError(TmtcError):
    """A transfer frame that cannot be built or read."""


class TableError(TmtcError):
    """An uploaded table is truncated, fails its checksum, or is of another kind or version."""


class LinkFormatError(TmtcError):
    """A stream whose framing cannot be determined, or link settings that contradict each other."""


class UnknownCoding(LinkFormatError):
    """A stream with regular markers in which no frame is valid under any known link settings."""

    def __init__(self, markers: int, distance_octets: int) -> None:
        self.expected = "frames that are valid under a known coding and randomiser, or stated link settings"
        self.found = f"{markers} markers, mostly {distance_octets} octets apart, and no valid frame or packet"
        super().__init__(f"downlink: expected {self.expected}, found {self.found}")


class DefinitionError(TmtcError):
    """An imported packet definition that is damaged, contradicts itself or uses what is not supported."""


class MissingLibrary(TmtcError):
    """A file format whose optional library is not installed."""

    def __init__(self, what: str, library: str, extra: str) -> None:
        self.library = library
        super().__init__(f"{what}: expected the library {library}, found none; install {extra}")
