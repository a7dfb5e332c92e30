"""Validation of names and reasons as one line of printable text."""

from __future__ import annotations

import re

from ground_service.errors import InvalidInput

LINE_PATTERN = r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]*$"
"""Pattern without control characters (NUL, ESC, line ends), line separators and bidirectional controls."""

LINE_PATTERN_JSON = r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]*$"
"""The same pattern without surrogates, which UTF-8 cannot encode, for the API documentation."""

NAME_LIMIT = 200
REASON_LIMIT = 500

_LINE = re.compile(LINE_PATTERN)


def require_line(text: object, what: str, where: str, limit: int = NAME_LIMIT) -> str:
    """Return a text that is one printable line of at most `limit` characters.

    Raises
    ------
    InvalidInput
        If the text is not such a line; the message shows control characters by their codes.
    """
    expected = f"a line of 1 to {limit} characters without control characters"
    if not isinstance(text, str):
        raise InvalidInput(what, where, expected, type(text).__name__)
    if not text or len(text) > limit:
        raise InvalidInput(what, where, expected, f"{len(text)} characters")
    if not _LINE.fullmatch(text):
        raise InvalidInput(what, where, expected, ascii(text)[:80])
    return text
