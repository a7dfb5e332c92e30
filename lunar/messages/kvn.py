"""Keyword notation (KVN) of CCSDS navigation messages: lines, keywords, comments and epochs."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike

from lunar.constants import NS
from lunar.errors import DataFileError, LeapSecondError, TimeFormatError
from lunar.timescales import from_tai_ns, in_leap_second, parse_tai, tai_ns_from_utc_ns, utc_ns_from_tai_ns

_HEADER_KEYS = ("CLASSIFICATION", "CREATION_DATE", "ORIGINATOR", "MESSAGE_ID")


def numbered_lines(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield the lines that are not blank, stripped, with their line numbers."""
    return (item for item in enumerate(map(str.strip, lines), start=1) if item[1])


class Lines:
    """Lines of a message that are not blank, read once; `at` is the line number of the line last taken."""

    def __init__(self, numbered: Iterable[tuple[int, str]], source: str) -> None:
        self._lines = iter(numbered)
        self._next = next(self._lines, None)
        self.source = source
        self.at = 1

    def peek(self) -> str | None:
        """Return the next line, None at the end."""
        return None if self._next is None else self._next[1]

    def take(self) -> str:
        """Return the next line and pass it."""
        if self._next is None:
            raise self.error("more lines", "the end of the file")
        self.at, line = self._next
        self._next = next(self._lines, None)
        return line

    def next_error(self, expected: str, found: str) -> DataFileError:
        """Return an error at the next line, at the end at the last one."""
        return self.error(expected, found, None if self._next is None else self._next[0])

    def error(self, expected: str, found: str, at: int | None = None) -> DataFileError:
        """Return an error at the line last taken, or at line number ``at``."""
        return DataFileError(self.source, f"line {self.at if at is None else at}", expected, found)

    def comments(self) -> Iterator[str]:
        """Yield the comments here and pass them."""
        while (line := self.peek()) is not None and line.split(None, 1)[0] == "COMMENT":
            self.take()
            yield line[7:].strip()

    def keyword(self, allowed: Iterable[str]) -> tuple[str, str]:
        """Return the next line as a keyword with its value."""
        line = self.take()
        key, equals, value = line.partition("=")
        key, value = key.strip().upper(), value.strip()
        if not equals or key not in allowed:
            raise self.error(f"one of {', '.join(allowed)}", repr(line[:60]))
        if not value:
            raise self.error(f"a value of {key}", "nothing")
        return key, value

    def rows(self, most: int) -> tuple[list[str], list[int]]:
        """Return the next lines that begin with a digit, at most ``most``, and their numbers; pass comments too."""
        rows: list[str] = []
        numbers: list[int] = []
        for _ in self.comments():
            pass
        while len(rows) < most and self._next is not None and self._next[1][0].isdigit():
            self.at, line = self._next
            rows.append(line)
            numbers.append(self.at)
            self._next = next(self._lines, None)
        return rows, numbers

    def header(self, kind: str, versions: tuple[str, ...]) -> tuple[list[str], dict[str, str]]:
        """Return comments and values of the header of an OEM or AEM."""
        version = f"CCSDS_{kind}_VERS"
        if not (self.peek() or "").startswith(version):
            found = "nothing" if self._next is None else repr(self._next[1][:40])
            raise self.next_error(f"{version} = {', '.join(versions[:-1])} or {versions[-1]}", found)
        comments: list[str] = []
        header: dict[str, str] = {}
        while True:
            comments += self.comments()
            if self.peek() in (None, "META_START"):
                return comments, header
            key, value = self.keyword((version, *_HEADER_KEYS))
            if key in header:
                raise self.error(f"{key} once", "it again")
            if key == version and value not in versions:
                raise self.error(f"an {kind} version out of {', '.join(versions)}", repr(value))
            header[key] = value

    def metadata(
        self, allowed: Iterable[str], mandatory: Iterable[str]
    ) -> tuple[list[str], dict[str, str], dict[str, int]]:
        """Return comments, values and line numbers of the keywords up to META_STOP, which is passed."""
        comments: list[str] = []
        meta: dict[str, str] = {}
        where: dict[str, int] = {}
        while True:
            comments += self.comments()
            if self.peek() == "META_STOP":
                self.take()
                break
            key, value = self.keyword(allowed)
            if key in meta:
                raise self.error(f"{key} once", "it again")
            meta[key], where[key] = value, self.at
        for key in mandatory:
            if key not in meta:
                raise self.error(f"{key} before META_STOP", "none")
        return comments, meta, where

    def epoch(self, value: str, time_system: str, at: int | None = None) -> int:
        """Return ``utc_ns`` of an epoch in a time system, which is not within a leap second."""
        tai_ns = self.tai(value, time_system, at)
        if in_leap_second(tai_ns):
            raise self.error(LeapSecondError.expected, f"{value!r} {time_system}", at)
        return utc_ns_from_tai_ns(tai_ns)

    def tai(self, value: str, time_system: str, at: int | None = None) -> int:
        """Return ``tai_ns`` of an epoch in a time system."""
        try:
            return parse_tai(value, time_system)
        except TimeFormatError:
            raise self.error("an epoch like 2029-08-07T00:00:00.000", repr(value), at) from None


def is_number(token: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(token)
    except ValueError:
        return False
    return True


def comment_lines(comments: Iterable[str]) -> list[str]:
    return [f"COMMENT {line}".rstrip() for comment in comments for line in (comment.splitlines() or [""])]


def epoch_texts(tai_ns: ArrayLike, time_system: str) -> list[str]:
    """Return calendar texts in a time system, with three decimals where that is exact for all and else nine."""
    instants = np.atleast_1d(np.asarray(tai_ns, dtype=np.int64))
    leap = in_leap_second(instants) & (time_system == "UTC")
    counts = from_tai_ns(instants, time_system) - NS * leap
    unit = "ms" if np.all(counts % (NS // 1000) == 0) else "ns"
    texts: list[str] = np.datetime_as_string(counts.astype("datetime64[ns]").astype(f"datetime64[{unit}]")).tolist()
    for k in np.flatnonzero(leap).tolist():
        texts[k] = texts[k].replace(":59:59", ":59:60")
    return texts


def utc_epoch_text(utc_ns: int, time_system: str) -> str:
    """Return the calendar text in a time system of one UTC epoch."""
    return epoch_texts(tai_ns_from_utc_ns(utc_ns), time_system)[0]
