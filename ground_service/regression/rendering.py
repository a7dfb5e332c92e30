"""Missing frames of kept archives: rendered from the declared scenario by an external program, and compared by hash.

The renderer is `linna replay --complete` in a subprocess. It refuses every frame whose pixels do not have the hash that
was recorded in flight, so that a rendered frame is the one that the payload was given. If the frames cannot be
rendered, the archive becomes telemetry only, with the reason: its received detections then replace the frames.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.regression import store
from ground_service.regression.archives import (
    DETECTIONS,
    MANIFEST,
    PassArchive,
    check_archive,
    check_out,
    kept_archive,
    restock_archive,
    scratch_of,
)
from ground_service.regression.model import COMPLETE, TELEMETRY_ONLY, TO_RENDER, KeptArchive
from ground_service.sandbox.host import package_root, tail
from tmtc.definitions import parse_dictionary
from tmtc.downlink import decode
from tmtc.errors import TmtcError

RENDER_LIMIT_S = 1500.0
"""Longest time for the frames of one archive; a job of a worker has half an hour."""

WAIT_S = 0.2
_ENVIRONMENT = ("PATH", "HOME", "LANG", "TMPDIR", "OMP_NUM_THREADS", "NUMBA_CACHE_DIR")
_DOWNLINKS = ("downlink.cadu", "downlink.packets")
_rendering: set[str] = set()
_changed = threading.Condition()


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
    """
    with _alone(ground, digest):
        with ground.database.reading() as connection:
            record = store.get_archive(connection, digest)
        if record.state == COMPLETE:
            return kept_archive(ground, digest)
        with tempfile.TemporaryDirectory(prefix="render-", dir=scratch_of(ground)) as name:
            archive = check_out(ground, digest, Path(name) / "archive")
            renders = record.state == TO_RENDER or (again and "scenario_toml" in archive.manifest)
            if archive.has_inputs and (renders or DETECTIONS not in archive.manifest["files"]):
                restock_archive(ground, record, _settled(ground, archive, Path(name) / "complete", renders))
    return kept_archive(ground, digest)


def _settled(ground: Ground, archive: PassArchive, out: Path, renders: bool) -> PassArchive:
    """Return an archive with all its frames in `out`, otherwise the archive with its received detections."""
    if DETECTIONS in archive.manifest["files"]:
        archive = _without_detections(archive)
    reason = _render(ground, archive.folder, out) if renders else archive.reason
    if not reason:
        whole = check_archive(out)
        if whole.state == COMPLETE:
            return replace(whole, digest=archive.digest)
        reason = whole.reason or "the renderer left out frames"
    archive = replace(archive, state=TELEMETRY_ONLY, reason=reason)
    try:
        return with_detections(archive)
    except InvalidInput as error:
        return replace(archive, reason=f"{reason}; no received detections: {error}")


def _render(ground: Ground, folder: Path, out: Path) -> str:
    """Write a complete copy of an archive; return why that is not possible, otherwise an empty text."""
    words = [sys.executable, "-m", "linna", "replay", str(folder), "--complete", "--out", str(out), "--json"]
    environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    environment["PYTHONPATH"] = str(package_root())
    if ground.data.root is not None:
        environment["LINNA_DATA"] = str(ground.data.root)
    printed = out.with_name("printed.txt")
    with printed.open("wb") as stream:
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stream,
            env=environment,
            cwd=folder,
            start_new_session=True,
        )
        deadline = time.monotonic() + RENDER_LIMIT_S
        try:
            while process.poll() is None:
                ground.check_stopping()
                if time.monotonic() > deadline:
                    return f"the frames were not rendered within {RENDER_LIMIT_S:.0f} s"
                time.sleep(WAIT_S)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    if process.returncode == 0:
        return ""
    lines = tail(printed).strip().splitlines()
    told = lines[-1].removeprefix("linna: ").removeprefix("error: ") if lines else "no message"
    return f"the frames cannot be rendered: {told.replace(str(folder), 'archive')[:500]}"


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
