"""TOML and JSON of external documents: each fault is one line with its place, what was expected and what was found."""

import difflib
import json
import re
import tomllib
from collections.abc import Sequence
from dataclasses import is_dataclass
from itertools import accumulate
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ValidationError

from ground_service.errors import InvalidInput

LIMIT_OCTETS = 4 << 20
DEPTH_LIMIT = 16
KEY_LIMIT = 200
KEYS_LIMIT = 100_000
"""Limits of TOML before it is parsed: size, depth and length of a key, and number of keys, brackets and commas.

A parser takes about a kilobyte for each part of a key, so that a document of the limit takes 100 MiB.
"""

_TEXT = re.compile(
    r'"""(?:\\.|[^\\])*?(?:"{3,5}|\Z)|'
    r"'''.*?(?:'{3,5}|\Z)|"
    r'"(?:\\.|[^"\\\n])*"?|'
    r"'[^'\n]*'?|#[^\n]*",
    re.DOTALL,
)
"""Strings and comments; without its end, one takes the rest, as for the parser."""

# Possessive, and begun once in a run of characters: their time grows with the length of the text alone.
_DEEP = re.compile(rf"(?<![\w\- \t.])[ \t]*+(?:[\w-]*+[ \t]*+\.[ \t]*+){{{DEPTH_LIMIT}}}")
_BRACKET = re.compile(r"[\[\]{}]")
_LONG = re.compile(rf"(?<![\w-])[\w-]{{{KEY_LIMIT + 1},}}+[ \t]*+[=.\]]")

Model = TypeVar("Model", bound=BaseModel)


def read_table(text: str | bytes, source: str, what: str) -> dict[str, Any]:
    """Return the table in TOML text.

    Raises
    ------
    InvalidInput
        The text is not TOML; `what` names the expected file.
    """
    try:
        text = text.decode("utf-8") if isinstance(text, bytes) else text
        _check_limits(text, source, what)
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidInput(source, "", what, _met(error)) from None


def _check_limits(text: str, source: str, what: str) -> None:
    if len(text) > LIMIT_OCTETS:
        found = f"{len(text)} characters"
        raise InvalidInput(source, "", f"{what} of at most {LIMIT_OCTETS >> 20} MiB", found)
    bare = _TEXT.sub("_", text)
    if _DEEP.search(bare) or _LONG.search(bare):
        expected = f"keys of at most {DEPTH_LIMIT} parts of {KEY_LIMIT} characters"
        raise InvalidInput(source, "", expected, "a deeper or longer one")
    if (count := sum(map(bare.count, "=.,[{"))) > KEYS_LIMIT:
        raise InvalidInput(source, "", f"{what} of at most {KEYS_LIMIT} keys and values", str(count))
    steps = (1 if one in "[{" else -1 for one in _BRACKET.findall(bare))
    if max(accumulate(steps), default=0) > DEPTH_LIMIT:
        expected = f"at most {DEPTH_LIMIT} brackets inside each other"
        raise InvalidInput(source, "", expected, "brackets that are nested too deeply")


def read_json(octets: str | bytes, source: str, limit_octets: int = 16 << 20) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    InvalidInput
        The text is too long or not JSON.
    """
    if len(octets) > limit_octets:
        raise InvalidInput(source, "", f"at most {limit_octets} octets", str(len(octets)))
    try:
        return json.loads(octets)
    except (ValueError, RecursionError) as error:
        raise InvalidInput(source, "", "JSON", _met(error)) from None


def _met(error: Exception) -> str:
    """Return why a reader gave up."""
    if isinstance(error, RecursionError):
        return "brackets that are nested too deeply"
    return "a number with too many digits" if "int_max_str_digits" in str(error) else str(error)


def parse_table(kind: type[Model], table: Any, source: str) -> Model:
    """Return a table as a model.

    Raises
    ------
    InvalidInput
        The first fault.
    """
    try:
        return kind.model_validate(table)
    except ValidationError as error:
        raise faults(kind, error, source)[0] from None


def faults(kind: type[BaseModel], error: ValidationError, source: str) -> list[InvalidInput]:
    """Return the faults of a table: unknown keys alone if there are any, because they cause others."""
    found = error.errors(include_url=False)
    unknown = [one for one in found if one["type"] in _UNKNOWN_KEY]
    return [_fault(kind, one, source) for one in unknown or found]


_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
"""Faults of models and of dataclasses."""


def _fault(kind: type[BaseModel], error: Any, source: str) -> InvalidInput:
    place = ".".join(map(str, error["loc"]))
    if error["type"] == "missing":
        return InvalidInput(source, place, "a value", "nothing")
    if error["type"] in _UNKNOWN_KEY:
        key = str(error["loc"][-1])
        known = keys_at(kind, error["loc"][:-1])
        near = difflib.get_close_matches(key, known, n=1)
        return InvalidInput(source, place, f"'{near[0]}'" if near else ", ".join(known), f"unknown key '{key}'")
    message = str(error["msg"])
    expected = (message[:1].lower() + message[1:]).removeprefix("value error, ")
    expected, _, found = expected.removeprefix("input should be ").partition(", found ")
    try:
        found = found or repr(error["input"])[:80]
    except ValueError:  # hexadecimal, so that it was read
        found = "a number with too many digits"
    if error["loc"][-1:] == ("webhook",):
        found = "another text"  # what follows the host may be a password
    return InvalidInput(source, place, expected, found)


def keys_at(kind: type, place: Sequence[int | str]) -> list[str]:
    """Return the keys of the table at a place; numbers in lists and names in tables of tables lead to no field."""
    for part in place:
        kind = table_in(_annotations(kind).get(str(part))) or kind
    return list(_annotations(kind))


def _annotations(kind: type) -> dict[str, Any]:
    if issubclass(kind, BaseModel):
        return {one.alias or name: one.annotation for name, one in kind.model_fields.items()}
    return get_type_hints(kind)


def table_in(annotation: Any) -> type | None:
    """Return the model or dataclass in an annotation such as ``tuple[Model, ...] | None``."""
    if isinstance(annotation, type) and (issubclass(annotation, BaseModel) or is_dataclass(annotation)):
        return annotation
    return next(filter(None, map(table_in, get_args(annotation))), None)


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
