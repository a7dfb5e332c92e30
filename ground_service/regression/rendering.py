"""Missing frames of kept archives: rendered from the declared scenario by an external program, and compared by hash.

The renderer is `linna replay --complete` in a subprocess. It refuses every frame whose pixels do not have the hash that
was recorded in flight, so that a rendered frame is the one that the payload was given. If it refuses the archive, the
archive becomes telemetry only, with the reason: its received detections then replace the frames. If it fails otherwise
(time limit, signal, full disk), the archive is left as it is.

An uploaded archive is not trusted: its scenario must not name files, its images have a limited size, no module is
imported from its folder, and the renderer has limits of memory and of the size of files.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import GroundError, InvalidInput
from ground_service.ground import Ground
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
from ground_service.regression.model import COMPLETE, TELEMETRY_ONLY, TO_RENDER, KeptArchive
from ground_service.sandbox.host import package_root, tail
from ground_service.toml import read_table
from tmtc.definitions import parse_dictionary
from tmtc.downlink import decode
from tmtc.errors import TmtcError

RENDER_LIMIT_S = 1500.0
"""Longest time for the frames of one archive; a job of a worker has half an hour."""

LARGEST_IMAGE_PX = 4096
"""Largest width and height of an image that is rendered."""

RENDER_OCTETS = 8 << 30
"""Memory of the renderer."""

RENDERED_FILE_OCTETS = 1 << 30
REASON_LIMIT = 300
LIVE_BEGINNING = "the pass was received live"
"""Beginning of the reason of an archive of a live pass that has no inputs of the payload."""

NO_DETECTIONS = "; no received detections: "
"""Part of the reason of an archive whose downlink has no detections that can be decoded."""

WAIT_S = 0.2
_ENVIRONMENT = ("PATH", "HOME", "LANG", "TMPDIR", "OMP_NUM_THREADS", "NUMBA_CACHE_DIR")
_DOWNLINKS = ("downlink.cadu", "downlink.packets")
# Settings of a scenario by which the renderer opens a file, and their values that name none.
_FILE_SETTINGS = (("orbit", "oem", ("",)), ("dynamics", "gravity", ("auto", "builtin")))
# The same for the archive of a live pass, whose payload is loaded as at launch.
_LAUNCH_SETTINGS = (
    ("navigation", "filter_gravity", ("auto", "builtin")),
    ("navigation", "anchoring_catalogue", ("",)),
)
# Run by the process that becomes the renderer: limits, and its end with that of the service.
_LAUNCH = """
import ctypes, os, resource, signal, sys
service, memory, size = map(int, sys.argv[1:4])
for kind, limit in ((resource.RLIMIT_DATA, memory), (resource.RLIMIT_FSIZE, size), (resource.RLIMIT_CORE, 0)):
    hard = resource.getrlimit(kind)[1]
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(kind, (limit, limit))
ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
if os.getppid() != service:
    sys.exit(1)
os.execv(sys.executable, [sys.executable, "-P", "-m", "linna", *sys.argv[4:]])
"""
_rendering: set[str] = set()
_changed = threading.Condition()


class RenderingFailed(GroundError):
    """The renderer ended without a result and without a refusal; another attempt may succeed."""

    def __init__(self, name: str, found: str) -> None:
        super().__init__(
            f"rendering of {name}: expected all frames, or a refusal with its reason, found {found}"
        )


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
    with _alone(ground, digest):
        with ground.database.reading() as connection:
            record = store.get_archive(connection, digest)
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
        reason = untrusted_scenario(archive.manifest) or _render(ground, archive, out)
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
        return replace(archive, reason=f"{reason}{NO_DETECTIONS}{_told(str(error))}")


def untrusted_scenario(manifest: Mapping[str, Any]) -> str:
    """Return why the scenario of an archive is not given to the renderer; empty if it is.

    Text that is not a scenario is left to the renderer, which refuses it.
    """
    try:
        scenario = read_table(str(manifest["scenario_toml"]), "scenario", "TOML")
    except InvalidInput:
        return ""

    def value(section: str, key: str, default: Any) -> Any:
        table = scenario.get(section)
        return table.get(key, default) if isinstance(table, dict) else default

    is_live = INPUTS not in manifest["files"]
    if is_live and "/" in str(value("detector", "network", "")):
        return (
            "the scenario of the archive is not rendered: detector.network: expected the name of a shipped network, "
            "found a file"
        )
    for section, key, permitted in (*_FILE_SETTINGS, *(_LAUNCH_SETTINGS if is_live else ())):
        if value(section, key, permitted[0]) not in permitted:
            expected = " or ".join(permitted) or "none"
            return f"the scenario of the archive is not rendered: {section}.{key}: expected {expected}, found a file"
    for key in ("width_px", "height_px"):
        found = value("camera", key, 0)
        if isinstance(found, int) and found > LARGEST_IMAGE_PX:
            return (
                f"the scenario of the archive is not rendered: camera.{key}: expected at most {LARGEST_IMAGE_PX}, "
                f"found {str(found)[:20]}"
            )
    return ""


def _render(ground: Ground, archive: PassArchive, out: Path) -> str:
    """Write a complete copy of an archive; return why the renderer refuses it, otherwise an empty text.

    Raises
    ------
    RenderingFailed
        The renderer failed without refusing the archive.
    """
    limits = (os.getpid(), RENDER_OCTETS, RENDERED_FILE_OCTETS)
    options = (str(archive.folder.absolute()), "--complete", "--out", str(out.absolute()), "--json")
    environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    environment["PYTHONPATH"] = str(package_root())
    if ground.data.root is not None:
        environment["LINNA_DATA"] = str(ground.data.root)
    printed = out.with_name("printed.txt")
    with printed.open("wb") as stream:
        # With -P no module is imported from the folder in which the process runs.
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _LAUNCH, *map(str, limits), "replay", *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stream,
            env=environment,
            cwd=out.parent,
            start_new_session=True,
        )
        deadline = time.monotonic() + RENDER_LIMIT_S
        try:
            while process.poll() is None:
                ground.check_stopping()
                if time.monotonic() > deadline:
                    raise RenderingFailed(archive.name, f"no end within {RENDER_LIMIT_S:.0f} s")
                time.sleep(WAIT_S)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    if process.returncode == 0:
        return ""
    refusal = _refusal(process.returncode, tail(printed))
    if not refusal:
        raise RenderingFailed(archive.name, f"exit status {process.returncode}")
    for place, name in ((archive.folder, "archive"), (out, "archive"), (ground.data.root, "data folder")):
        refusal = refusal if place is None else refusal.replace(str(place), name)
    return f"the frames cannot be rendered: {_told(refusal)}"


def _refusal(status: int, printed: str) -> str:
    """Return the reason of the renderer; empty if it failed otherwise, also on an error of the operating system."""
    lines = printed.strip().splitlines()
    begin = "linna: error: "
    if status != 2 or not lines or not lines[-1].startswith(begin):
        return ""
    told = lines[-1].removeprefix(begin)
    of_system = tuple(os.strerror(code) for code in errno.errorcode)
    return "" if told.startswith(of_system) or "[Errno " in told else told


def _told(text: str) -> str:
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
    name = next((one for one in _DOWNLINKS if one in files), None)
    if name is None:
        raise InvalidInput(archive.name, "", " or ".join(_DOWNLINKS), "neither")
    text = (archive.folder / "payload/dictionary.json").read_text(encoding="utf-8")
    dictionary = parse_dictionary(text, "payload/dictionary.json")
    try:
        decoded = decode((archive.folder / name).read_bytes(), dictionary=dictionary)
    except TmtcError as error:
        raise InvalidInput(
            archive.name, name, "telemetry of the dictionary of its archive", str(error)
        ) from None
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
                    key: _numbers(
                        table.items[key][items] if key in table.items else np.full(len(items), np.nan)
                    )
                    for key in ("u_px", "v_px", "diameter_px", "score", "sigma_px")
                },
            }
        )
    return rows


def _numbers(values: NDArray[Any]) -> list[float | None]:
    return [None if np.isnan(value) else float(value) for value in values]


@contextmanager
def _alone(ground: Ground, digest: str) -> Iterator[None]:
    """Wait until no other thread or process renders the frames of an archive, and keep others out."""
    mine = f"{ground.home} {digest}"
    key = int.from_bytes(
        hashlib.blake2b(f"render {digest}".encode(), digest_size=8).digest(), "big", signed=True
    )
    with _changed:
        while mine in _rendering:
            ground.check_stopping()
            _changed.wait(WAIT_S)
        _rendering.add(mine)
    try:
        while True:
            with ground.database.alone(key) as alone:
                if alone:
                    yield
                    return
            ground.check_stopping()
            time.sleep(WAIT_S)
    finally:
        with _changed:
            _rendering.discard(mine)
            _changed.notify_all()
