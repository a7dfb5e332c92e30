"""Names and reasons as one line of text that can be printed anywhere."""

from __future__ import annotations

import re

from ground_service.errors import InvalidInput

LINE_PATTERN = r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]*$"
"""No control characters (NUL, ESC, line ends), no separators of lines, nothing that turns the direction of writing."""

LINE_PATTERN_JSON = r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]*$"
"""The same without surrogates, which text over the wire cannot hold, as the API documents it."""

NAME_LIMIT = 200
REASON_LIMIT = 500

_LINE = re.compile(LINE_PATTERN)


def require_line(text: object, what: str, where: str, limit: int = NAME_LIMIT) -> str:
    """Return a text that is one printable line of at most `limit` characters.

    Raises
    ------
    InvalidInput
        If it is anything else; the message shows control characters by their codes.
    """
    expected = f"a line of 1 to {limit} characters without control characters"
    if not isinstance(text, str):
        raise InvalidInput(what, where, expected, type(text).__name__)
    if not text or len(text) > limit:
        raise InvalidInput(what, where, expected, f"{len(text)} characters")
    if not _LINE.fullmatch(text):
        raise InvalidInput(what, where, expected, ascii(text)[:80])
    return text
