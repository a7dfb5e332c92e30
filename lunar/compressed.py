"""Files that may be compressed: gzip, or a zip archive with one file, expanded to a bounded size."""

import gzip
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

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
    with open_expanded(path, expected) as stream:
        octets = stream.read(limit_octets + 1)
    if len(octets) > limit_octets:
        raise DataFileError(path, "", f"at most {limit_octets >> 20} MiB when expanded", "more")
    return octets


@contextmanager
def open_expanded(path: Path | str, expected: str) -> Iterator[IO[bytes]]:
    """Yield a stream of the octets of a file, expanded as they are read; no archive's word on its size is trusted.

    Raises
    ------
    DataFileError
        If the file cannot be read or the compression is damaged, also while the stream is read.
    """
    kind = "file"
    try:
        with Path(path).open("rb") as file:
            mark = file.read(len(_ZIP))
            file.seek(0)
            if mark.startswith(_GZIP):
                kind = "gzip file"
                with gzip.open(file) as stream:
                    yield cast("IO[bytes]", stream)
            elif mark == _ZIP:
                kind = "zip archive"
                with zipfile.ZipFile(file) as archive:
                    files = [one for one in archive.infolist() if not one.is_dir()]
                    if len(files) != 1:
                        raise DataFileError(path, "", "a zip archive of one file", f"{len(files)} files")
                    with archive.open(files[0]) as member:
                        yield member
            else:
                yield file
    except EOFError:
        raise DataFileError(path, "", f"a complete {kind}", "one that is cut short") from None
    except (OSError, zlib.error, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        if kind == "file":
            raise DataFileError(path, "", expected, getattr(error, "strerror", "") or str(error)) from None
        raise DataFileError(path, "", f"a {kind}", f"damaged data ({error})") from None
