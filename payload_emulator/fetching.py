"""Downloads into the data folder: resumed where they broke off, checked before they count, and re-checked later.

A download grows beside its place as ``NAME.partial`` and takes the place in one move once its size and checksum hold.
What arrived is recorded in ``SHA256SUMS`` of the folder, so that damage is found even where no checksum is published.
"""

from __future__ import annotations

import errno
import hashlib
import http.client
import json
import shutil
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from payload_emulator.data_products import PRODUCTS, Product, ProductFile
from payload_emulator.errors import DataProductError

RECORD = "SHA256SUMS"

_CHUNK_OCTETS = 1 << 20
_AGENT = "linna-data"
_PASSING = {408, 425, 429, 500, 502, 503, 504}
"""Answers after which it is worth asking again."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How long a transfer is tried: attempts without progress, first pause, longest pause, silence of the server."""

    attempts: int = 5
    pause_s: float = 1.0
    longest_pause_s: float = 60.0
    timeout_s: float = 60.0


@dataclass(frozen=True, slots=True)
class Fetched:
    """State of a file: "present", "fetched" or "fetched, differs from the tested copy"; octets now on disk."""

    path: str
    status: str
    octets: int


@dataclass(frozen=True, slots=True)
class Checked:
    """A file re-read: "whole", "damaged", "missing" or "unknown"; against what; SHA-256 found."""

    path: str
    status: str
    against: str
    sha256: str


Report = Callable[[str, int, int], None]
"""Called with path, octets so far and octets in all (0 unknown)."""


def fetch(
    file: ProductFile,
    root: Path,
    patience: Patience | None = None,
    report: Report | None = None,
) -> Fetched:
    """Bring a file into the data folder unless it is there already.

    Raises
    ------
    DataProductError
        No address is known, the server does not have the file or another one, the transfer broke off too often, the
        checksum does not hold, or the folder cannot be written.  What arrived is kept and the next call goes on.
    """
    patience = patience or Patience()
    target = root / file.path
    if target.is_file() and _status_of(file, target, _recorded(root)) != "damaged":
        return Fetched(file.path, "present", target.stat().st_size)
    if not file.url:
        raise DataProductError(f"{file.path}: expected an address to fetch it from, found none known")
    arriving = target.with_name(f"{target.name}{'.zip' if file.member else ''}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _transfer(file, arriving, patience, report)
        whole = _unpack(file, arriving) if file.member else arriving
        sha256, md5 = digests(whole)
        status = "fetched"
        if _differs(file, sha256, md5):
            if file.origin == "published":
                whole.unlink()
                arriving.unlink(missing_ok=True)
                known, found = (file.sha256, sha256) if file.sha256 else (file.md5, md5)
                raise DataProductError(
                    f"{file.url}: expected the checksum {known} ({file.checksum_source}), found {found}; "
                    "what arrived was thrown away"
                )
            status = "fetched, differs from the tested copy"
        whole.replace(target)
        arriving.unlink(missing_ok=True)
        _state_path(arriving).unlink(missing_ok=True)
        _record(root, file.path, sha256)
    except OSError as error:
        kept = f"; {arriving.stat().st_size} octets are kept for the next try" if arriving.is_file() else ""
        raise DataProductError(f"{error.filename or target}: {error.strerror or error}{kept}") from error
    return Fetched(file.path, status, target.stat().st_size)


def verify(root: Path, products: Sequence[Product] = PRODUCTS) -> list[Checked]:
    """Every file of the registry or of the folder's record, read again and compared with what is known of it."""
    recorded = _recorded(root)
    known = {file.path: file for product in products for file in product.files}
    paths = sorted({path for path in known if (root / path).is_file()} | set(recorded))
    return [_check(root, path, known.get(path), recorded.get(path, "")) for path in paths]


def survey(root: Path, products: Sequence[Product] = PRODUCTS) -> list[dict[str, Any]]:
    """What is known of each product and how much of it lies in the data folder."""
    there = {
        str(path.relative_to(root)) for folder in _folders(products) for path in (root / folder).glob("**/*")
    }
    return [
        {
            **{name: getattr(product, name) for name in ("name", "title", "basic", "octets")},
            "files": len(product.files),
            "files_present": sum(file.path in there for file in product.files),
            "files_of_its_own": sum(
                product.claims(path) and all(path != file.path for file in product.files) for path in there
            ),
            "octets_known": sum(file.octets for file in product.files),
            "checksums": sorted({file.checksum_source for file in product.files if file.checksum_source}),
            **{name: getattr(product, name) for name in ("licence", "citation", "note")},
            "address": product.files[0].url if product.files else "",
        }
        for product in products
    ]


def digests(path: Path) -> tuple[str, str]:
    """SHA-256 and MD5 of a file."""
    sha256, md5 = hashlib.sha256(), hashlib.md5(usedforsecurity=False)
    with path.open("rb") as stream:
        while octets := stream.read(_CHUNK_OCTETS):
            sha256.update(octets)
            md5.update(octets)
    return sha256.hexdigest(), md5.hexdigest()


def from_mirror(file: ProductFile, mirror: str) -> ProductFile:
    """The file as a mirror offers it: under the same path as in the data folder, unpacked."""
    octets = 0 if file.member else file.octets
    return replace(file, url=f"{mirror.rstrip('/')}/{file.path}", octets=octets, member="")


def _transfer(file: ProductFile, arriving: Path, patience: Patience, report: Report | None) -> None:
    """Make `arriving` whole, going on where it stands, with pauses that double after attempts that brought nothing."""
    fruitless = 0
    while True:
        before = _size(arriving)
        try:
            if _receive(file, arriving, patience.timeout_s, report):
                return
            reason = f"the connection closed after {_size(arriving)} octets"
        except urllib.error.HTTPError as error:
            error.close()
            if error.code not in _PASSING:
                raise DataProductError(
                    f"{file.url}: expected the file, found HTTP status {error.code} ({error.reason})"
                ) from None
            reason = f"HTTP status {error.code}"
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            reason = str(getattr(error, "reason", error)) or type(error).__name__
        fruitless = 0 if _size(arriving) > before else fruitless + 1
        if fruitless >= patience.attempts:
            raise DataProductError(
                f"{file.url}: expected the file, found no progress in {patience.attempts} attempts, "
                f"the last: {reason}; {_size(arriving)} octets are kept for the next try"
            )
        time.sleep(min(patience.pause_s * 2.0 ** max(fruitless - 1, 0), patience.longest_pause_s))


def _receive(file: ProductFile, arriving: Path, timeout_s: float, report: Report | None) -> bool:
    """One request, continued from what has arrived where the server still has the same file; whether it is whole."""
    have, validator = _size(arriving), _validator(arriving)
    headers = {"User-Agent": _AGENT, "Accept-Encoding": "identity"}
    if have and validator:
        headers |= {"Range": f"bytes={have}-", "If-Range": validator}
    else:
        have = 0
    try:
        answer = urllib.request.urlopen(urllib.request.Request(file.url, headers=headers), timeout=timeout_s)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not have:
            raise
        # Nothing lies beyond what we have: it is whole, or of another file and requested again.
        error.close()
        if error.headers.get("Content-Range") == f"bytes */{have}":
            return True
        arriving.unlink()
        return False
    with answer:
        if answer.status != 206:
            have = 0
        total = _total(answer, have)
        if file.octets and total and total != file.octets:
            raise DataProductError(
                f"{file.url}: expected {file.octets} octets, found {total} announced by the server: another file"
            )
        _require_room(arriving, (total or file.octets) - have)
        _keep_validator(arriving, answer.headers.get("ETag") or answer.headers.get("Last-Modified") or "")
        with arriving.open("ab" if have else "wb") as out:
            while octets := answer.read(_CHUNK_OCTETS):
                out.write(octets)
                have += len(octets)
                if report is not None:
                    report(file.path, have, total or file.octets)
    wanted = total or file.octets
    if wanted and have > wanted:
        arriving.unlink()
        raise DataProductError(f"{file.url}: expected {wanted} octets, found {have}; thrown away")
    return not wanted or have == wanted


def _total(answer: Any, have: int) -> int:
    """Size of the whole file by an answer's headers, 0 unknown."""
    span = answer.headers.get("Content-Range", "")
    if answer.status == 206 and span:
        start, _, whole = span.removeprefix("bytes ").partition("/")
        if int(start.split("-")[0]) != have:
            raise http.client.HTTPException(f"a range from {start} in place of {have}")
        return int(whole) if whole.isdigit() else 0
    return int(answer.headers.get("Content-Length") or 0)


def _unpack(file: ProductFile, archive: Path) -> Path:
    """Extract the member of a downloaded ZIP file into the same folder."""
    out = archive.with_name(f"{Path(file.path).name}.partial")
    try:
        with zipfile.ZipFile(archive) as bundle:
            names = [name for name in bundle.namelist() if name.rsplit("/", 1)[-1] == file.member]
            if len(names) != 1:
                raise DataProductError(
                    f"{file.url}: expected one member {file.member} in the ZIP file, found {len(names)}"
                )
            with bundle.open(names[0]) as source, out.open("wb") as target:
                shutil.copyfileobj(source, target, _CHUNK_OCTETS)
    except zipfile.BadZipFile as error:
        archive.unlink()
        raise DataProductError(f"{file.url}: expected a ZIP file, found {error}; thrown away") from None
    return out


def _check(root: Path, path: str, file: ProductFile | None, recorded: str) -> Checked:
    if not (root / path).is_file():
        return Checked(path, "missing", f"{RECORD} of the folder", "")
    sha256, md5 = digests(root / path)
    if file is not None and file.origin == "published":
        return Checked(
            path, "damaged" if _differs(file, sha256, md5) else "whole", file.checksum_source, sha256
        )
    if recorded:
        return Checked(path, "whole" if recorded == sha256 else "damaged", f"{RECORD} of the folder", sha256)
    if file is not None and file.origin == "copy" and not _differs(file, sha256, md5):
        return Checked(path, "whole", file.checksum_source, sha256)
    return Checked(path, "unknown", "no checksum is known", sha256)


def _status_of(file: ProductFile, path: Path, recorded: dict[str, str]) -> str:
    """Whether a file on disk is as it should be, without more reading than its size where that tells."""
    if file.octets and not file.member and path.stat().st_size != file.octets:
        return "damaged"
    if file.origin != "published" and file.path not in recorded:
        return "unknown"
    return _check(
        path.parents[len(Path(file.path).parts) - 1], file.path, file, recorded.get(file.path, "")
    ).status


def _differs(file: ProductFile, sha256: str, md5: str) -> bool:
    return bool((file.sha256 and file.sha256 != sha256) or (file.md5 and file.md5 != md5))


def _recorded(root: Path) -> dict[str, str]:
    """Hashes in the folder's record, by path."""
    try:
        lines = (root / RECORD).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    pairs = (line.split(maxsplit=1) for line in lines if line.strip())
    return {name.lstrip("*").removeprefix("./"): value for value, name in pairs}


def _record(root: Path, path: str, sha256: str) -> None:
    lines = sorted((_recorded(root) | {path: sha256}).items())
    unfinished = root / f".{RECORD}"
    unfinished.write_text("".join(f"{value}  ./{name}\n" for name, value in lines), encoding="utf-8")
    unfinished.replace(root / RECORD)


def _folders(products: Sequence[Product]) -> set[str]:
    names = [file.path for product in products for file in product.files]
    names += [pattern for product in products for pattern in product.patterns]
    return {name.split("/", 1)[0] for name in names}


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _state_path(arriving: Path) -> Path:
    return arriving.with_name(f"{arriving.name}.state")


def _validator(arriving: Path) -> str:
    """What tells the server which version of the file we have a part of; empty where that is not known."""
    try:
        return str(json.loads(_state_path(arriving).read_text(encoding="utf-8"))["validator"])
    except (OSError, ValueError, KeyError):
        return ""


def _keep_validator(arriving: Path, validator: str) -> None:
    # A weak validator does not promise equal octets.
    strong = "" if validator.startswith("W/") else validator
    _state_path(arriving).write_text(json.dumps({"validator": strong}), encoding="utf-8")


def _require_room(arriving: Path, octets: int) -> None:
    free = shutil.disk_usage(arriving.parent).free
    if octets > free:
        raise OSError(errno.ENOSPC, f"expected room for {octets} octets, found {free} free", str(arriving))
