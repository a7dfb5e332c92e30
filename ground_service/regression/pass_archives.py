"""Regression archives of passes: the archive that a pass was imported from, or the received data of a live pass."""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from ground_service.contacts.commanding.store import sent_for_pass
from ground_service.errors import InvalidInput, NotFound
from ground_service.evaluation.inputs import reference_of
from ground_service.ground import Ground
from ground_service.missions.service import mission_of_pass
from ground_service.missions.store import detail
from ground_service.passes import sample_store
from ground_service.passes import store as passes
from ground_service.passes.model import PassRecord
from ground_service.passes.span import pass_span
from ground_service.regression import archives, store
from ground_service.regression.model import TELEMETRY_ONLY, TO_RENDER, KeptArchive
from ground_service.regression.rendering import LIVE_BEGINNING
from ground_service.store.vehicles import get_vehicle
from lunar.timescales import format_utc
from tmtc.dictionary.payload import DICTIONARY

LIVE = (
    f"{LIVE_BEGINNING}: telemetry does not contain the images and inputs of the payload, and the mission "
    "description declares no world to render them from"
)
LACKING = LIVE_BEGINNING + ", and its frames cannot be rendered: expected {}, found none"
_RENDERED_FROM = {
    "telecommands.packets": "telecommands of its window",
    "reference.oem": "a reference ephemeris",
    "catalogue.csv": "a crater catalogue",
    "onboard-catalogue.csv": "catalogue.sha256 in the mission description",
}
NO_INPUTS = "the archive of the pass does not contain the inputs of the payload"


def keep_pass(ground: Ground, pass_id: int, *, pinned: bool = False) -> KeptArchive:
    """Keep the regression archive of a pass; keeping it again changes nothing unless new data were received.

    An imported pass gives the archive that it was imported from. A live pass gives its received packets, the sent
    telecommands, mission description, reference and catalogue. Frames that are not stored are rendered at the first
    use: those of a live pass if the mission description declares the simulated world and telemetry confirms them.

    Raises
    ------
    NotFound
        There is no such pass.
    InvalidInput
        The pass has no telemetry, or its archive was imported by a version that did not store the manifest.
    """
    record = ground.read(passes.get_pass, pass_id)
    with archives.working_folder(ground) as work:
        folder = work / "archive"
        folder.mkdir()
        if record.archive_digest is not None:
            archive = _imported(ground, record, folder)
        else:
            with ground.database.reading() as connection:
                archive = _received(ground, connection, record, folder)
        archives.store_archive(ground, archive, pinned=pinned, pass_id=pass_id)
    return archives.kept_archive(ground, archive.digest)


def archive_of_pass(ground: Ground, pass_id: int) -> KeptArchive:
    """Return the kept archive of a pass, which is kept now if there is none."""
    kept = ground.read(store.archives_of_pass, pass_id)
    return archives.kept_archive(ground, kept[0].digest) if kept else keep_pass(ground, pass_id)


def _imported(ground: Ground, record: PassRecord, folder: Path) -> archives.PassArchive:
    """Write the archive of an imported pass into a folder; images that the ground did not store are left out."""
    assert record.archive_digest is not None
    try:
        octets = ground.files.get(record.archive_digest)
    except (NotFound, FileNotFoundError):
        raise InvalidInput(
            f"pass {record.id}", "", "the manifest of its archive (import the archive again)", "none"
        ) from None
    manifest: dict[str, Any] = json.loads(octets)
    present = {}
    for file, entry in manifest["files"].items():
        source = ground.files.path(entry["sha256"])
        if source.is_file():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, folder / file)
            present[file] = entry
        elif not file.startswith("frames/"):
            raise InvalidInput(f"pass {record.id}", file, "a file of its archive", "none")
    if len(present) < len(manifest["files"]):
        manifest = {**manifest, "files": present}
        octets = json.dumps(manifest, indent=2).encode() + b"\n"
    (folder / archives.MANIFEST).write_bytes(octets)
    if archives.INPUTS not in present:
        return archives.PassArchive(
            folder,
            hashlib.sha256(octets).hexdigest(),
            manifest,
            int(manifest.get("frames_expected") or 0),
            0,
            TELEMETRY_ONLY,
            NO_INPUTS,
        )
    # The identity is that of the imported archive, also where images are left out.
    return replace(archives.check_archive(folder), digest=record.archive_digest)


def _received(ground: Ground, connection: Connection, record: PassRecord, folder: Path) -> archives.PassArchive:
    """Write the received data of a live pass into a folder."""
    span = pass_span(connection, record)
    octets = b"".join(
        sample_store.packet_octets(connection, span, apid)
        for apid in sorted({definition.apid for definition in DICTIONARY.telemetry})
    )
    if not octets:
        raise InvalidInput(f"pass {record.id}", "", "received telemetry", "none")
    mission = mission_of_pass(connection, record.mission_id, record.manifest)
    vehicle = get_vehicle(connection, record.vehicle_id)
    reference = reference_of(connection, record)
    (folder / "downlink.packets").write_bytes(octets)
    telecommands = sent_for_pass(connection, record.id)
    if telecommands:
        (folder / "telecommands.packets").write_bytes(telecommands)
    if record.mission_id is not None:
        (folder / "mission.toml").write_text(detail(connection, record.mission_id).text, encoding="utf-8")
    for name, sha256 in (
        ("reference.oem", None if reference is None else reference.sha256),
        ("catalogue.csv", record.catalogue_sha256),
        ("onboard-catalogue.csv", mission.catalogue.sha256 if mission.world.scenario else None),
    ):
        if sha256 is not None:
            shutil.copyfile(ground.files.path(sha256), folder / name)
    frames = len(sample_store.detection_frames(connection, span)[0])
    camera = mission.camera
    manifest = {
        "schema_version": 1,
        "pass_name": record.name,
        "spacecraft_id": vehicle.ccsds_id,
        "start_utc": format_utc(record.start_utc_ns),
        "stop_utc": format_utc(record.stop_utc_ns),
        "cadence_s": camera.frame_interval_s,
        "frames_expected": record.manifest.get("frames_expected"),
        "camera": {"width_px": camera.width_px, "height_px": camera.height_px, "fov_deg": camera.fov_deg},
        "dictionary": {"version": span.dictionary_version},
        **({} if mission.world.scenario is None else {"scenario_toml": mission.world.scenario}),
        "start_state": record.manifest.get("start_state"),
        "data_sources": list(record.manifest.get("data_sources", ())),
        "files": {
            path.name: {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "bytes": path.stat().st_size}
            for path in sorted(folder.iterdir())
        },
    }
    text = json.dumps(manifest, indent=2).encode() + b"\n"
    (folder / archives.MANIFEST).write_bytes(text)
    digest = hashlib.sha256(text).hexdigest()
    reason = _unrenderable(manifest)
    state = TELEMETRY_ONLY if reason else TO_RENDER
    return archives.PassArchive(folder, digest, manifest, frames, 0, state, reason)


def _unrenderable(manifest: Mapping[str, Any]) -> str:
    """Return why the frames of a live pass cannot be rendered; empty if that can be tried."""
    if "scenario_toml" not in manifest:
        return LIVE
    for name, what in _RENDERED_FROM.items():
        if name not in manifest["files"]:
            return LACKING.format(what)
    return ""
