"""Compiled functions, and files kept in their folder; the import of this package alone does not import numba."""

import functools
import hashlib
import logging
import os
import time
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

KEPT_S = 90 * 86_400.0
"""Age at which a file is deleted: the version of the program that it belongs to may be gone."""

_DIGEST_OCTETS = 32
_written = Counter[tuple[Path, str]]()


def cache_folder() -> Path:
    """Return the folder of compiled code: NUMBA_CACHE_DIR, else linna/kernels in the user's cache folder."""
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "linna" / "kernels"


def _folder_of(kind: str) -> Path:
    """Return the folder of a kind; builds under test read that of compiled code: no ground and no figure lie in it."""
    return Path(f"{cache_folder()}-ground") if kind in ("tile", "rims", "figure", "pixels") else cache_folder()


def kept(name: str) -> bytes | None:
    """Return what this user or root kept under a name; None if there is none or it is damaged."""
    folder = _folder_of(name.partition("-")[0])
    try:
        with (folder / name).open("rb") as file:
            owners = {folder.stat().st_uid, os.fstat(file.fileno()).st_uid}
            content = file.read() if owners <= {os.getuid(), 0} else b""
    except OSError:
        return None
    octets = content[_DIGEST_OCTETS:]
    return octets if hashlib.sha256(octets).digest() == content[:_DIGEST_OCTETS] else None


def made_once(name: str, make: Callable[[], bytes], most: int = 0) -> bytes:
    """Return what is kept under a name, otherwise make and keep it; see `keep`."""
    octets = kept(name)
    if octets is None:
        octets = make()
        keep(name, octets, most)
    return octets


def keep(name: str, octets: bytes, most: int = 0) -> None:
    """Keep octets under a name, in one piece, unless the folder cannot be written; delete old files now and then.

    Of a kind, the name up to its hyphen, the newest files stay: at most ``most`` and a sixteenth, or all for 0.
    """
    kind = name.partition("-")[0]
    folder = _folder_of(kind)
    part = folder / uuid.uuid4().hex
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o755 if os.getuid() == 0 else 0o700)  # builds under test of root are other users
        part.write_bytes(hashlib.sha256(octets).digest() + octets)
        part.replace(folder / name)
    except OSError as error:
        _log_once(f"nothing is kept in {folder}: {error.strerror}")
        with suppress(OSError):
            part.unlink()  # of a full disk
        return
    _written[folder, kind] += 1
    if (_written[folder, kind] - 1) % (max(most // 16, 1) if most else 16):
        return  # a look at all files takes longer than all else
    with suppress(OSError), os.scandir(folder) as files:
        written = sorted((file.stat().st_mtime, file.name) for file in files)
        same = [other for _, other in written if other.partition("-")[0] == kind]
        old = [other for second, other in written if second < time.time() - KEPT_S]
        for other in {*old, *same[:-most]}:
            (folder / other).unlink()


@functools.cache
def _log_once(message: str) -> None:
    logging.getLogger(__name__).warning(message)
