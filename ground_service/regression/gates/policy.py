"""The policy file by which builds are judged."""

from __future__ import annotations

import datetime
import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from ground_service.errors import InvalidInput, storage_error
from ground_service.regression.gates.core import EXACT_METRICS, GatePolicy, GateRule, Waiver
from ground_service.toml import parse_table, read_table

SHIPPED = Path(__file__).with_name("regression_policy.toml")
SCHEMA_VERSION = 2

Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ConfidenceTable(_Table):
    """Confidence of the decisions: of each pass, and of all failures together."""

    value: float = Field(ge=0.8, le=0.9999)
    reason: Text


class PowerTable(_Table):
    """Probability with which a degradation as large as the resolution is detected."""

    value: float = Field(ge=0.5, le=0.999)
    reason: Text


class GateTable(_Table):
    """Gate rule: the metrics it applies to, and the tolerated degradation."""

    figure: Text
    margin: float = Field(ge=0.0, le=1e9)
    pass_margin: float | None = Field(default=None, gt=0.0, le=1e9)
    reason: Text
    required: bool | None = None


class WaiverTable(_Table):
    """Waiver of a gate until a day."""

    gate: Text
    pass_name: Text = Field(default="*", alias="pass")
    reason: Text
    until: datetime.date


class PolicyTable(_Table):
    """Content of a policy file."""

    schema_version: int = Field(ge=SCHEMA_VERSION, le=SCHEMA_VERSION)
    version: Text
    resamples: int = Field(default=400, ge=50, le=10_000)
    confidence: ConfidenceTable
    power: PowerTable
    gate: list[GateTable] = Field(min_length=1)
    waiver: list[WaiverTable] = []


@dataclass(frozen=True, slots=True)
class PolicyFile:
    """A policy and the hash of the file it stands in."""

    policy: GatePolicy
    sha256: str
    name: str


def load_policy(path: Path | None = None) -> PolicyFile:
    """Return the policy in a file; the shipped one by default.

    Raises
    ------
    InvalidInput
        The file is missing or not a valid policy; the message names the key.
    """
    where = path or SHIPPED
    try:
        octets = where.read_bytes()
    except FileNotFoundError:
        raise InvalidInput(str(where), "", "a policy file (TOML)", "nothing there") from None
    except OSError as error:
        raise storage_error(error, where) from None
    read = read_policy(octets, str(where))
    return read if path is not None else replace(read, name="shipped")


def read_policy(octets: bytes, source: str) -> PolicyFile:
    """Return the policy in the octets of a file.

    Raises
    ------
    InvalidInput
        The octets are not a valid policy; the message names the key.
    """
    table = read_table(octets, source, "a policy file (TOML)")
    if table.get("schema_version") != SCHEMA_VERSION:
        raise InvalidInput(source, "schema_version", str(SCHEMA_VERSION), repr(table.get("schema_version")))
    for waiver in table.get("waiver", []) if isinstance(table.get("waiver"), list) else []:
        # A day may be written as a TOML date or as text.
        if isinstance(waiver, dict) and isinstance(waiver.get("until"), str):
            waiver["until"] = _day(waiver["until"])
    read = parse_table(PolicyTable, table, source)
    for i, item in enumerate(read.gate):
        if item.margin == 0.0 and item.figure not in EXACT_METRICS:
            raise InvalidInput(
                source,
                f"gate.{i}.margin",
                "a number above 0: no number of frames can show a change of exactly zero",
                "0",
            )
    policy = GatePolicy(
        version=read.version,
        confidence=read.confidence.value,
        power=read.power.value,
        resamples=read.resamples,
        rules=tuple(_rule(item) for item in read.gate),
        waivers=tuple(
            Waiver(item.gate, item.reason, item.until.isoformat(), item.pass_name) for item in read.waiver
        ),
    )
    return PolicyFile(policy, hashlib.sha256(octets).hexdigest(), source)


def _rule(item: GateTable) -> GateRule:
    wild = any(character in item.figure for character in "*?[")
    required = not wild if item.required is None else item.required
    return GateRule(item.figure, item.margin, item.pass_margin, item.reason, required)


def _day(text: str) -> datetime.date | str:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        return text
