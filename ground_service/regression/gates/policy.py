"""The policy file by which builds are judged."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from ground_service.errors import InvalidInput, storage_error
from ground_service.missions.automation import Table
from ground_service.regression.gates.core import EXACT_METRICS, GatePolicy, GateRule
from ground_service.regression.gates.metrics import FRAMES, TIMES, UNDECODABLE
from ground_service.toml import parse_table, read_table

SHIPPED = {"ci": Path(__file__).with_name("ci.toml")}
"""Policies by name; the first one is the default."""

SCHEMA_VERSION = 3
ALWAYS = "Telemetry that cannot be read or contradicts itself fails under every policy that does not name its gate."

Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class LevelTable(_Table):
    """Probability of a wrong claim on an equal build."""

    level: float = Field(ge=1e-6, le=0.2)
    reason: Text


class PolicyTable(_Table):
    """Content of a policy file."""

    schema_version: int = Field(ge=SCHEMA_VERSION, le=SCHEMA_VERSION)
    version: Text
    inconclusive: Literal["failure", "skip"] = "failure"
    fail: LevelTable
    gate: list[Annotated[GateRule, Table]] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class PolicyFile:
    """A policy and the hash of the file it stands in."""

    policy: GatePolicy
    sha256: str
    name: str


def load_policy(path: Path | None = None) -> PolicyFile:
    """Return the policy in a file, or a shipped one by its name; the shipped one `ci` by default.

    Raises
    ------
    InvalidInput
        The file is missing or not a valid policy; the message names the key.
    """
    name = "ci" if path is None else str(path)
    where = SHIPPED.get(name, path or SHIPPED["ci"])
    try:
        octets = where.read_bytes()
    except FileNotFoundError:
        raise InvalidInput(str(where), "", "a policy file (TOML)", "nothing there") from None
    except OSError as error:
        raise storage_error(error, where) from None
    read = read_policy(octets, str(where))
    return replace(read, name=name) if name in SHIPPED else read


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
    read = parse_table(PolicyTable, table, source)
    for i, item in enumerate(read.gate):
        if not item.reason.strip():
            raise InvalidInput(source, f"gate.{i}.reason", "a text", "none")
        if (item.weight == 0.0) != (item.metric in EXACT_METRICS):
            expected = "no weight: the metric is exact" if item.weight else "a weight above 0"
            raise InvalidInput(source, f"gate.{i}.weight", expected, f"{item.weight:g}")
        if item.weight and not item.materiality < item.margin:
            raise InvalidInput(
                source, f"gate.{i}.margin", f"more than the materiality {item.materiality:g}", f"{item.margin:g}"
            )
    weights = sum(item.weight for item in read.gate)
    if not 0.0 < weights <= 1.0 + 1e-9:
        raise InvalidInput(source, "gate", "weights above 0 that sum to at most 1", f"{weights:g}")
    named = {item.metric for item in read.gate}
    always = (GateRule(name, 0.0, ALWAYS) for name in (UNDECODABLE, TIMES, FRAMES) if name not in named)
    policy = GatePolicy(
        version=read.version, fail_level=read.fail.level, rules=(*always, *read.gate), inconclusive=read.inconclusive
    )
    return PolicyFile(policy, hashlib.sha256(octets).hexdigest(), source)
