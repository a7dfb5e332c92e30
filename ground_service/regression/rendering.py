"""Missing frames of kept archives: rendered from the declared scenario by an external program, and compared by hash.

The renderer is `linna replay --complete` in the sandbox of builds. It refuses every frame whose pixels do not have the
hash that was recorded in flight, so that a rendered frame is the one that the payload was given. If it refuses the
archive, the archive becomes telemetry only, with the reason: its received detections then replace the frames. If it
fails otherwise (no sandbox, a limit, declared data that are missing here), the archive is left as it is.

An uploaded archive is not trusted: whatever its scenario names, the renderer sees the archive and the public data
products only.
"""

import errno
import hashlib
import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import GroundError, InvalidInput
from ground_service.ground import Ground
from ground_service.passes.archive_import import unpacked
from ground_service.regression import store
from ground_service.regression.archives import (
    DETECTIONS,
    INPUTS,
    MANIFEST,
    PassArchive,
    archive_of,
    check_archive,
    check_out,
    kept_archive,
    restock_archive,
    working_folder,
)
from ground_service.regression.builds import Limits
from ground_service.regression.model import COMPLETE, TELEMETRY_ONLY, TO_RENDER, KeptArchive
from ground_service.regression.runner import DOWNLINKS, RunRequest, run_confined
from ground_service.regression.sandbox import SandboxRefused, tail
from tmtc.dictionary.definitions import parse_dictionary
from tmtc.downlink import decode
from tmtc.errors import TmtcError

COMPLETED = "complete.zip"
RENDERING = RunRequest(
    (
        "{python}", "-P", "-c",
        "import shutil, sys; from linna.cli import run; "
        "ended = run(['replay', '{archive}', '--complete', '--out', '{out}/complete']); "
        "ended or shutil.make_archive('{out}/complete', 'zip', '{out}/complete'); sys.exit(ended)",
    ),
    Limits(wall_s=1500, cpu_s=3000, memory_mib=8192, file_mib=1024, folder_mib=2048).model_dump(),
    (COMPLETED,),
    reads_data=True,
)  # fmt: skip
"""Request of a run that renders the frames of one archive; a job of a worker has half an hour."""

LACKING = "data product missing: "
"""Beginning of a refusal because of data that the archive declares and this installation does not have."""

REASON_LIMIT = 300
LIVE_BEGINNING = "the pass was received live"
"""Beginning of the reason of an archive of a live pass that has no inputs of the payload."""

NO_DETECTIONS = "; no received detections: "
"""Part of the reason of an archive whose downlink has no detections that can be decoded."""

_ARCHIVE = re.compile(r"(?:/[\w.-]+)*/archive\b")


class RenderingFailed(GroundError):
    """The renderer ended without a result and without a refusal; another attempt may succeed."""

    def __init__(self, name: str, found: str) -> None:
        super().__init__(f"rendering of {name}: expected all frames, or a refusal with its reason, found {found}")


def settle_archive(ground: Ground, digest: str, *, again: bool = False) -> KeptArchive:
    """Render the missing frames of a kept archive once; return the archive with its new state.

    Parameters
    ----------
    again
        Also try an archive whose frames could not be rendered before.

    Raises
    ------
    NotFound
        No archive of this identity is kept.
    RenderingFailed
        The renderer failed without refusing the archive, whose state does not change.
    """
    with ground.alone(f"render {digest}"):
        record = ground.read(store.get_archive, digest)
        if record.state == COMPLETE:
            return kept_archive(ground, digest)
        manifest = archive_of(ground, record, Path()).manifest
        renders = record.state == TO_RENDER or (again and bool(manifest.get("scenario_toml")))
        settled = DETECTIONS in manifest["files"] or NO_DETECTIONS in record.reason
        if renders or (INPUTS in manifest["files"] and not settled):
            with working_folder(ground) as folder:
                archive = check_out(ground, digest, folder / "archive")
                restock_archive(ground, record, _settled(ground, archive, folder / "complete", renders))
    return kept_archive(ground, digest)


def _settled(ground: Ground, archive: PassArchive, out: Path, renders: bool) -> PassArchive:
    """Return an archive with all its frames in `out`, otherwise the archive with its received detections."""
    if DETECTIONS in archive.manifest["files"]:
        archive = _without_detections(archive)
    reason = archive.reason
    if renders:
        reason = _render(ground, archive, out)
    if not reason:
        whole = check_archive(out)
        if whole.state == COMPLETE:
            return replace(whole, digest=archive.digest)
        reason = whole.reason or "the renderer left out frames"
    if INPUTS not in archive.manifest["files"]:
        return replace(archive, state=TELEMETRY_ONLY, reason=f"{LIVE_BEGINNING}, and {reason}")
    archive = replace(archive, state=TELEMETRY_ONLY, reason=reason)
    try:
        return with_detections(archive)
    except InvalidInput as error:
        return replace(archive, reason=f"{reason}{NO_DETECTIONS}{_shortened(str(error))}")


def _render(ground: Ground, archive: PassArchive, out: Path) -> str:
    """Write a complete copy of an archive; return why the renderer refuses it, otherwise an empty text."""
    work = archive.folder.parent
    written, printed = work / "written", work / "printed.txt"
    for folder in (work / "build", written):
        folder.mkdir()
    try:
        report = run_confined(
            RENDERING, work, written, printed, runner=ground.runner, private=(ground.home,), data=ground.data.root
        )
    except SandboxRefused as error:
        raise RenderingFailed(archive.name, str(error)) from None
    if report["exit_status"] == 0 and not report["cause"]:
        with unpacked(written / COMPLETED, work, archive.name) as folder:
            folder.rename(out)
        return ""
    refusal = _refusal(report["exit_status"], tail(printed))
    if not refusal or refusal.startswith(LACKING):
        raise RenderingFailed(archive.name, refusal or report["cause"] or f"exit status {report['exit_status']}")
    return f"the frames cannot be rendered: {_shortened(_ARCHIVE.sub('archive', refusal))}"


def _refusal(status: int, printed: str) -> str:
    """Return the reason of the renderer; empty if it failed otherwise, also on an error of the operating system."""
    lines = printed.strip().splitlines()
    begin = "linna: error: "
    if status != 2 or not lines or not lines[-1].startswith(begin):
        return ""
    message = lines[-1].removeprefix(begin)
    of_system = tuple(os.strerror(code) for code in errno.errorcode)
    return "" if message.startswith(of_system) or "[Errno " in message else message


def _shortened(text: str) -> str:
    """Return a message as one line of limited length."""
    line = "".join(sign if sign.isprintable() else " " for sign in text)
    return " ".join(line.split())[:REASON_LIMIT]


def with_detections(archive: PassArchive) -> PassArchive:
    """Add the received detections to an archive."""
    rows = recorded_detections(archive)
    octets = "".join(json.dumps(row) + "\n" for row in rows).encode()
    (archive.folder / DETECTIONS).write_bytes(octets)
    entry = {"sha256": hashlib.sha256(octets).hexdigest(), "bytes": len(octets)}
    return _with_files(archive, {**archive.manifest["files"], DETECTIONS: entry})


def _without_detections(archive: PassArchive) -> PassArchive:
    (archive.folder / DETECTIONS).unlink()
    files = {name: entry for name, entry in archive.manifest["files"].items() if name != DETECTIONS}
    return _with_files(archive, files)


def _with_files(archive: PassArchive, files: dict[str, Any]) -> PassArchive:
    manifest = {**archive.manifest, "files": files}
    (archive.folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")
    return replace(archive, manifest=manifest)


def recorded_detections(archive: PassArchive) -> list[dict[str, Any]]:
    """Return the received detection reports of an archive, the first of each image, in order of on-board time.

    Raises
    ------
    InvalidInput
        The archive has no downlink that its packet dictionary decodes.
    """
    files = archive.manifest["files"]
    name = next((one for one in DOWNLINKS if one in files), None)
    if name is None:
        raise InvalidInput(archive.name, "", " or ".join(DOWNLINKS), "neither")
    text = (archive.folder / "payload/dictionary.json").read_text(encoding="utf-8")
    dictionary = parse_dictionary(text, "payload/dictionary.json")
    try:
        decoded = decode((archive.folder / name).read_bytes(), dictionary=dictionary)
    except TmtcError as error:
        raise InvalidInput(archive.name, name, "telemetry of the dictionary of its archive", str(error)) from None
    table = decoded.tables(dictionary).get("detections")
    if table is None or len(table) == 0:
        return []
    ticks = np.asarray(table.columns["image_ticks"], dtype=np.int64)
    owner = np.asarray(table.item_owner)
    rows = []
    for packet in np.unique(ticks, return_index=True)[1].tolist():
        items = np.flatnonzero(owner == packet)
        rows.append(
            {
                "ticks": int(ticks[packet]),
                "quality": int(table.columns["image_quality"][packet]),
                **{
                    key: _numbers(table.items[key][items] if key in table.items else np.full(len(items), np.nan))
                    for key in ("u_px", "v_px", "diameter_px", "score", "sigma_px")
                },
            }
        )
    return rows


def _numbers(values: NDArray[Any]) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]
