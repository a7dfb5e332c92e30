"""Files that may be compressed: gzip, or a zip archive with one file, expanded to a bounded size."""

from __future__ import annotations

import gzip
import io
import zipfile
import zlib
from pathlib import Path

from lunar.errors import DataFileError

EXPANDED_LIMIT_OCTETS = 256 << 20
"""Largest size of an expanded file: a year of states each minute is 70 MB of text."""

_GZIP = b"\x1f\x8b"
_ZIP = b"PK\x03\x04"


def read_expanded(path: Path | str, expected: str, limit_octets: int = EXPANDED_LIMIT_OCTETS) -> bytes:
    """Return the octets of a file, expanded if it is compressed with gzip or in a zip archive of one file.

    Raises
    ------
    DataFileError
        If the file cannot be read, the compression is damaged, or the expanded file is larger than the limit.
    """
    try:
        with Path(path).open("rb") as stream:
            octets = stream.read(limit_octets + 1)
    except OSError as error:
        raise DataFileError(path, "", expected, error.strerror or str(error)) from None
    for mark, expanded in ((_GZIP, _gunzipped), (_ZIP, _unzipped)):
        if octets.startswith(mark) and len(octets) <= limit_octets:
            octets = expanded(octets, path, limit_octets)
            break
    if len(octets) > limit_octets:
        raise DataFileError(path, "", f"at most {limit_octets >> 20} MiB when expanded", "more")
    return octets


# Both read no more than one octet above the limit, whatever size the archive states.


def _gunzipped(octets: bytes, path: Path | str, limit_octets: int) -> bytes:
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(octets)) as stream:
            return stream.read(limit_octets + 1)
    except EOFError:
        raise DataFileError(path, "", "a complete gzip file", "one that is cut short") from None
    except (OSError, zlib.error) as error:
        raise DataFileError(path, "", "a gzip file", f"damaged data ({error})") from None


def _unzipped(octets: bytes, path: Path | str, limit_octets: int) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(octets)) as archive:
            files = [one for one in archive.infolist() if not one.is_dir()]
            if len(files) != 1:
                raise DataFileError(path, "", "a zip archive of one file", f"{len(files)} files")
            with archive.open(files[0]) as stream:
                return stream.read(limit_octets + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise DataFileError(path, "", "a zip archive", f"damaged data ({error})") from None
