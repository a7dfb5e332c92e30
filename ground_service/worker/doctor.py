"""Checks of a deployment from one of its processes: what `linna doctor` shows."""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from ground_service.access.provider import provider_of
from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError
from ground_service.ground import Ground
from ground_service.http.model import Entity
from ground_service.missions.store import channels_in_force
from ground_service.settings import Settings
from ground_service.store import leases
from ground_service.store.database import schema_revisions
from ground_service.store.files import file_names
from ground_service.worker import condition
from ground_service.worker.notifications import permitted_address
from ground_service.worker.scheduler import has_scheduler
from ground_service.worker.upkeep import CHANNEL, channel_of_heads

LISTED = 10
"""Faults of one check that are listed."""


class Check(Entity):
    """One check of a deployment."""

    name: str = Field(examples=["broker"])
    ok: bool
    found: str = Field(description="The value found, and the value expected if that is a fault")


def examine(ground: Ground, settings: Settings) -> list[Check]:
    """Return the results of all checks that apply to a deployment."""
    checks = []
    for name, check in CHECKS.items():
        try:
            faults, found = check(ground, settings)
        except (GroundError, OSError) as error:
            faults, found = [str(error)], ""
        if len(faults) > LISTED:
            faults = [*faults[:LISTED], f"{len(faults) - LISTED} more"]
        if faults or found:
            checks.append(Check(name=name, ok=not faults, found="; ".join(faults) or found))
    return checks


Result = tuple[list[str], str]
"""Faults of a check, and what it found without any; "" if it does not apply."""


def _schema(ground: Ground, _settings: Settings) -> Result:
    found, newest, _ = schema_revisions(ground.database)
    faults = [] if found == newest else [f"expected revision {newest}, found {found}"]
    return faults, f"revision {found}"


def _processes(ground: Ground, settings: Settings) -> Result:
    if ground.database.dialect != "postgresql":
        return [], ""
    processes = condition.running_processes(ground.database)
    faults = condition.disagreements(condition.statement_of(ground, settings), processes)
    versions = {one.statement.version for one in processes if one.statement is not None}
    if len(versions) > 1 or any(one.statement is None for one in processes):
        faults.append(f"expected one version, found {', '.join(sorted(versions)) or 'other ones'}")
    wanted = ["api", *(["worker"] if settings.resolved_broker_url() is not None else [])]
    faults += [
        f"expected a running {kind}, found none" for kind in wanted if all(one.kind != kind for one in processes)
    ]
    if any(one.statement is not None and one.statement.runner == "no" for one in processes):
        faults.append("expected a runner of payload builds that responds, found none")
    return faults, ", ".join(map(str, processes))


def _clocks(ground: Ground, _settings: Settings) -> Result:
    if ground.database.dialect != "postgresql":
        return [], ""
    with ground.database.reading() as connection:
        here = (utc_now_ns() - leases.database_now_ns(connection)) // 1_000_000
    clocks = {"here": here}
    clocks |= {
        str(one): one.statement.clock_ms
        for one in condition.running_processes(ground.database)
        if one.statement is not None
    }
    faults = [
        f"{name}: expected within {condition.CLOCK_LIMIT_MS} ms of the database, found {ms} ms"
        for name, ms in clocks.items()
        if abs(ms) > condition.CLOCK_LIMIT_MS
    ]
    return faults, f"largest difference from the database {max(map(abs, clocks.values()))} ms"


def _scheduler(ground: Ground, _settings: Settings) -> Result:
    return ([] if has_scheduler(ground) else ["expected a process that does the recurring work, found none"]), "one"


def _broker(_ground: Ground, settings: Settings) -> Result:
    url = settings.resolved_broker_url()
    if url is None:
        return [], ""
    return ([] if condition.broker_answers(url) else ["expected a broker that answers, found none"]), "answers"


def _archive(ground: Ground, _settings: Settings) -> Result:
    ground.database.require_writable()
    ground.files.require_writable()
    return [], "writable"


def _files(ground: Ground, _settings: Settings) -> Result:
    names = ground.read(file_names)
    faults = []
    for sha256 in names:
        try:
            if ground.files.octets(sha256) is None:
                faults.append(f"{sha256[:16]}: expected the file, found none")
            elif ground.objects is None:
                with ground.files.place(sha256).open("rb") as stream:
                    stream.read(1)
        except OSError as error:
            faults.append(f"{sha256[:16]}: {error.strerror}")
    return faults, f"{len(names)} readable"


def _provider(_ground: Ground, settings: Settings) -> Result:
    provider = provider_of(settings)
    if provider is None:
        return [], ""
    asyncio.run(provider.check())
    return [], provider.issuer


def _channels(ground: Ground, _settings: Settings) -> Result:
    faults, channels = [], ground.read(channels_in_force)
    for spacecraft, name, channel in channels:
        try:
            permitted_address(*channel.server, networks=ground.networks)
        except GroundError as error:
            faults.append(f"channel {name} of spacecraft {spacecraft}: {error}")
    return faults, f"{len(channels)} permitted" if channels else ""


def _audit_heads(ground: Ground, settings: Settings) -> Result:
    target = settings.audit_heads
    if target is None:
        return [], ""
    if target.startswith(CHANNEL):
        channel_of_heads(ground, target)
    elif not (Path(target).is_dir() and os.access(target, os.W_OK)):
        return [f"LINNA_AUDIT_HEADS: expected a folder that can be written, found {target}"], ""
    return [], target


CHECKS: dict[str, Callable[[Ground, Settings], Result]] = {
    "schema": _schema,
    "processes": _processes,
    "clocks": _clocks,
    "recurring work": _scheduler,
    "broker": _broker,
    "archive": _archive,
    "files": _files,
    "provider": _provider,
    "notifications": _channels,
    "audit heads": _audit_heads,
}
