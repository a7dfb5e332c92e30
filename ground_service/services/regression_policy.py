"""The policy file by which builds are judged."""

from __future__ import annotations

import datetime
import hashlib
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_service.errors import InvalidInput, storage_error
from ground_service.processing.regression_gates import GatePolicy, GateRule, Waiver

SHIPPED = Path(__file__).with_name("regression_policy.toml")
SCHEMA_VERSION = 1
_KEYS = ("schema_version", "version", "alpha", "block_frames", "resamples", "per_pass", "gate", "waiver")


@dataclass(frozen=True, slots=True)
class PolicyFile:
    """A policy and the hash of the file it stands in."""

    policy: GatePolicy
    sha256: str
    name: str


def load_policy(path: Path | None = None) -> PolicyFile:
    """The policy in a file; the shipped one by default.

    Raises
    ------
    InvalidInput
        The file is missing or no policy; the message names the key.
    """
    where = path or SHIPPED
    source = str(where)
    try:
        octets = where.read_bytes()
        table = tomllib.loads(octets.decode("utf-8"))
    except FileNotFoundError:
        raise InvalidInput(source, "", "a policy file (TOML)", "nothing there") from None
    except OSError as error:
        raise storage_error(error, where) from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInput(source, "", "a policy file (TOML)", str(error)) from None
    for key in table:
        if key not in _KEYS:
            raise InvalidInput(source, key, f"one of {', '.join(_KEYS)}", "an unknown key")
    if table.get("schema_version") != SCHEMA_VERSION:
        raise InvalidInput(source, "schema_version", str(SCHEMA_VERSION), repr(table.get("schema_version")))
    policy = GatePolicy(
        version=_value(table, "version", str, source),
        alpha=_number(table, "alpha", source, 1e-6, 0.2),
        block_frames=int(_number(table, "block_frames", source, 1, 1000)),
        resamples=int(_number(table, "resamples", source, 50, 10_000)),
        rules=tuple(
            _rule(item, f"gate[{i}]", source) for i, item in enumerate(_tables(table, "gate", source))
        ),
        per_pass=tuple(str(item) for item in _value(table, "per_pass", list, source)),
        waivers=tuple(
            _waiver(item, f"waiver[{i}]", source) for i, item in enumerate(_tables(table, "waiver", source))
        ),
    )
    return PolicyFile(policy, hashlib.sha256(octets).hexdigest(), "shipped" if path is None else source)


def _rule(item: dict[str, Any], place: str, source: str) -> GateRule:
    _only(item, ("figure", "margin"), place, source)
    return GateRule(
        _value(item, "figure", str, source, place), _number(item, "margin", source, 0.0, 1e9, place)
    )


def _waiver(item: dict[str, Any], place: str, source: str) -> Waiver:
    _only(item, ("gate", "pass", "reason", "until"), place, source)
    until = item.get("until")
    text = until.isoformat() if isinstance(until, datetime.date) else until
    try:
        day = datetime.date.fromisoformat(str(text))
    except ValueError:
        raise InvalidInput(source, f"{place}.until", "a day such as 2029-12-31", repr(until)) from None
    reason = _value(item, "reason", str, source, place)
    if not reason.strip():
        raise InvalidInput(source, f"{place}.reason", "why the gate may fail", "nothing")
    return Waiver(
        _value(item, "gate", str, source, place), reason, day.isoformat(), str(item.get("pass", "*"))
    )


def _tables(table: dict[str, Any], key: str, source: str) -> list[dict[str, Any]]:
    found = table.get(key, [])
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise InvalidInput(source, key, f"tables [[{key}]]", type(found).__name__)
    return found


def _only(item: dict[str, Any], keys: tuple[str, ...], place: str, source: str) -> None:
    for key in item:
        if key not in keys:
            raise InvalidInput(source, f"{place}.{key}", f"one of {', '.join(keys)}", "an unknown key")


def _value(table: dict[str, Any], key: str, kind: type, source: str, place: str = "") -> Any:
    value = table.get(key)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise InvalidInput(source, f"{place}.{key}".strip("."), f"a {kind.__name__}", repr(value)[:80])
    return value


def _number(table: dict[str, Any], key: str, source: str, low: float, high: float, place: str = "") -> float:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise InvalidInput(
            source, f"{place}.{key}".strip("."), f"a number from {low:g} to {high:g}", repr(value)[:80]
        )
    return float(value)
