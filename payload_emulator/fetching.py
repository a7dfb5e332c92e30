"""Downloads into the data folder with pooch: checked before they count, and re-checked later.

A download takes its place in one move once its size and checksum hold. What arrived is recorded in ``SHA256SUMS`` of
the folder, so that damage is found even where no checksum is published.
"""

import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from payload_emulator.data_products import PRODUCTS, Product, ProductFile
from payload_emulator.errors import DataProductError

RECORD = "SHA256SUMS"
ATTEMPTS = 4
_CHUNK_OCTETS = 1 << 20
_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class Fetched:
    """State of a file: "present", "fetched" or "fetched, differs from the tested copy"; octets now on disk."""

    path: str
    status: str
    octets: int


@dataclass(frozen=True, slots=True)
class Checked:
    """Result for a file: "whole", "damaged", "missing" or "unknown"; source of the checksum; SHA-256 found."""

    path: str
    status: str
    against: str
    sha256: str


def fetch(file: ProductFile, root: Path, attempts: int = ATTEMPTS, *, progress: bool = False) -> Fetched:
    """Download a file into the data folder unless it is there; `progress` shows a bar on standard error.

    Raises
    ------
    DataProductError
        No address is known, the server does not have the file or has another one, all attempts failed, or the folder
        cannot be written. A file that is there remains.
    """
    target = root / file.path
    if target.is_file() and _status_of(file, target, _recorded(root)) != "damaged":
        return Fetched(file.path, "present", target.stat().st_size)
    if not file.url:
        raise DataProductError(f"{file.path}: expected an address to fetch it from, found none known")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".fetching-", dir=target.parent) as folder:
            whole = _download(file, Path(folder), attempts, progress)
            sha256, md5 = digests(whole)
            if _differs(file, sha256, md5) and file.origin == "published":
                known, found = (file.sha256, sha256) if file.sha256 else (file.md5, md5)
                raise DataProductError(
                    f"{file.url}: expected the checksum {known} ({file.checksum_source}), found {found}"
                )
            whole.replace(target)
        _record(root, file.path, sha256)
    except OSError as error:
        raise DataProductError(f"{error.filename or target}: {error.strerror or error}") from error
    status = "fetched, differs from the tested copy" if _differs(file, sha256, md5) else "fetched"
    return Fetched(file.path, status, target.stat().st_size)


def _download(file: ProductFile, folder: Path, attempts: int, progress: bool) -> Path:
    """Return the downloaded file in a folder, unpacked."""
    import pooch
    import requests

    pooch.get_logger().setLevel("WARNING")
    name = Path(file.path).name
    source = pooch.create(
        folder, base_url="", registry={name: None}, urls={name: file.url}, retry_if_failed=attempts - 1
    )
    downloader = pooch.HTTPDownloader(progressbar=progress, chunk_size=_CHUNK_OCTETS, timeout=_TIMEOUT_S)
    try:
        arrived = Path(source.fetch(name, downloader=downloader))
    except requests.exceptions.HTTPError as error:
        status = None if error.response is None else error.response.status_code
        raise DataProductError(f"{file.url}: expected the file, found HTTP status {status}") from None
    except (requests.exceptions.RequestException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise DataProductError(
            f"{file.url}: expected the file, found no whole transfer in {attempts} attempts, the last: {reason}"
        ) from None
    octets = arrived.stat().st_size
    if file.octets and octets != file.octets:
        raise DataProductError(f"{file.url}: expected {file.octets} octets, found {octets}: another file")
    return _unpacked(file, arrived, folder / f"{name}.member") if file.member else arrived


def verify(root: Path, products: Sequence[Product] = PRODUCTS) -> list[Checked]:
    """Every file of the registry or of the folder's record, read again and compared with what is known of it."""
    recorded = _recorded(root)
    known = {file.path: file for product in products for file in product.files}
    paths = sorted({path for path in known if (root / path).is_file()} | set(recorded))
    return [_check(root, path, known.get(path), recorded.get(path, "")) for path in paths]


def survey(root: Path, products: Sequence[Product] = PRODUCTS) -> list[dict[str, Any]]:
    """Return each product with its state and its size in the data folder."""
    there = {str(path.relative_to(root)) for folder in _folders(products) for path in (root / folder).glob("**/*")}
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
    """Return SHA-256 and MD5 of a file."""
    import pooch

    return pooch.file_hash(str(path), "sha256"), pooch.file_hash(str(path), "md5")


def from_mirror(file: ProductFile, mirror: str) -> ProductFile:
    """The file as a mirror offers it: under the same path as in the data folder, unpacked."""
    octets = 0 if file.member else file.octets
    return replace(file, url=f"{mirror.rstrip('/')}/{file.path}", octets=octets, member="")


def _unpacked(file: ProductFile, archive: Path, out: Path) -> Path:
    """Extract the member of a downloaded ZIP file."""
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
        raise DataProductError(f"{file.url}: expected a ZIP file, found {error}") from None
    return out


def _check(root: Path, path: str, file: ProductFile | None, recorded: str) -> Checked:
    if not (root / path).is_file():
        return Checked(path, "missing", f"{RECORD} of the folder", "")
    sha256, md5 = digests(root / path)
    if file is not None and file.origin == "published":
        return Checked(path, "damaged" if _differs(file, sha256, md5) else "whole", file.checksum_source, sha256)
    if recorded:
        return Checked(path, "whole" if recorded == sha256 else "damaged", f"{RECORD} of the folder", sha256)
    if file is not None and file.origin == "copy" and not _differs(file, sha256, md5):
        return Checked(path, "whole", file.checksum_source, sha256)
    return Checked(path, "unknown", "no checksum is known", sha256)


def _status_of(file: ProductFile, path: Path, recorded: dict[str, str]) -> str:
    """Return whether a file on disk is as it should be, without more reading than its size where that tells."""
    if file.octets and not file.member and path.stat().st_size != file.octets:
        return "damaged"
    if file.origin != "published" and file.path not in recorded:
        return "unknown"
    return _check(path.parents[len(Path(file.path).parts) - 1], file.path, file, recorded.get(file.path, "")).status


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
