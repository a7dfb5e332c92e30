"""Public data products in a data folder, plain or compressed, and the default models for them.

A folder is laid out as ``gravity/ kernels/ craters/ dem/ albedo/ photometry/``; any part may be absent. Heights and
craters of a user are ``dem/own*.tif`` and ``craters/own*.csv``.
"""

from __future__ import annotations

import gzip
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

from lunar.errors import DataFileError

if TYPE_CHECKING:
    from lunar.frames import Orientation
    from lunar.gravity import GravityField


@dataclass(frozen=True, slots=True)
class DataFolder:
    """Paths of the data products found under ``root``; None or an empty tuple for absent products."""

    root: Path | None = None
    gravity: Path | None = None
    gravity_alternative: Path | None = None
    orientation_bpc: Path | None = None
    orientation_tf: Path | None = None
    catalogue_lu: Path | None = None
    catalogue_composite: Path | None = None
    catalogue_robbins: Path | None = None
    dem_tiles: tuple[Path, ...] = ()
    dem_global: Path | None = None
    albedo: Path | None = None
    dem_sldem: tuple[Path, ...] = ()
    albedo_tiles: tuple[Path, ...] = ()
    photometry: Path | None = None

    @property
    def own_heights(self) -> str:
        """Name of height rasters of the user; empty without them."""
        own = [path.name for path in self.dem_tiles if path.name.startswith("own")]
        return f"own heights {', '.join(own)}" if own else ""

    def names(self) -> tuple[str, ...]:
        """Return the names of the products present, for the ``data`` field of outputs."""
        listed = self.catalogue_robbins.name if self.catalogue_robbins is not None else ""
        listed = listed if listed.startswith("own") else "Robbins 2019"
        present = (
            (self.gravity, f"gravity {_stem(self.gravity)} (GRAIL, NASA GSFC)"),
            (self.gravity_alternative, f"gravity {_stem(self.gravity_alternative)} (Lunar Prospector, JPL)"),
            (self.orientation_bpc, "lunar orientation DE421 (JPL, NAIF)"),
            (self.catalogue_lu, "crater catalogue LU1319381 (Wang et al. 2022)"),
            (self.catalogue_composite, "crater catalogue composite (LU1319381; Robbins 2019; Povilaitis et al. 2018)"),
            (self.catalogue_robbins, f"crater catalogue {listed}"),
            (self.dem_tiles or None, self.own_heights or "height model LROC WAC GLD100 (Scholten et al. 2012)"),
            (self.dem_global, "height model LROC WAC GLD100, 16 px/deg"),
            (self.dem_sldem or None, "height model SLDEM2015 (Barker et al. 2016)"),
            (self.albedo, "albedo map"),
            (self.albedo_tiles or None, "albedo LROC WAC empirically normalised mosaic"),
            (self.photometry, "photometry SELENE SP (Kouyama et al. 2016)"),
        )
        return tuple(name for path, name in present if path is not None)


def find_data(path: Path | str | None) -> DataFolder:
    """Return the data products found under ``path``; no products for None.

    Raises
    ------
    DataFileError
        If ``path`` is given and is not a folder.
    """
    if path is None:
        return DataFolder()
    root = Path(path)
    if not root.is_dir():
        raise DataFileError(root, "", "a data folder", "a file" if root.exists() else "nothing there")
    global_dem = _first(root, "dem/*_global.jp2", "dem/*_global.tif")
    tiles = _all(root, "dem/*ppd_*E_*.jp2", "dem/*ppd_*E_*.tif", "dem/WAC_GLD100_E*.IMG", "dem/WAC_GLD100_E*.tif")
    return DataFolder(
        root=root,
        gravity=_first(root, "gravity/GRGM*.gfc", "gravity/*.gfc", "gravity/*GRGM*", "gravity/*.tab"),
        gravity_alternative=_first(root, "gravity/LP165P.cof", "gravity/*.cof", "gravity/jgl165p1.sha"),
        orientation_bpc=_first(root, "kernels/moon_pa_de421*.bpc"),
        orientation_tf=_first(root, "kernels/moon_080317.tf", "kernels/moon*.tf"),
        catalogue_lu=_first(root, "craters/lu1319381*.csv.gz", "craters/lu1319381*.csv"),
        catalogue_composite=_first(root, "craters/composite*.csv.gz", "craters/composite*.csv"),
        catalogue_robbins=_first(
            root, "craters/own*.csv", "craters/*robbins*.csv*", "craters/lunar_craters_ge20km.csv"
        ),
        dem_tiles=_all(root, "dem/own*.tif") + tiles,
        dem_global=global_dem,
        dem_sldem=_all(root, "dem/SLDEM2015*.LBL", "dem/sldem2015*.lbl", "dem/SLDEM2015*.tif"),
        albedo=_first(root, "albedo/moon_albedo*.jpg", "albedo/*.jpg"),
        albedo_tiles=_all(root, "albedo/WAC_*.IMG", "albedo/WAC_*.tif"),
        photometry=_first(root, "photometry/parameters"),
    )


def default_orientation(data: DataFolder) -> Orientation:
    """Return the DE421 orientation if its file is present, otherwise the IAU series."""
    from lunar.frames import IauOrientation, load_orientation

    if data.orientation_bpc is None:
        return IauOrientation()
    return load_orientation(data.orientation_bpc, data.orientation_tf)


def default_gravity(data: DataFolder) -> GravityField:
    """Return the GRAIL field if its file is present, otherwise the built-in low-degree field."""
    from lunar.gravity import builtin_gravity, load_gravity

    return builtin_gravity() if data.gravity is None else load_gravity(data.gravity)


def _all(root: Path, *patterns: str) -> tuple[Path, ...]:
    return tuple(sorted(found for pattern in patterns for found in root.glob(pattern)))


def _first(root: Path, *patterns: str) -> Path | None:
    for pattern in patterns:
        found = sorted(root.glob(pattern))
        if found:
            return found[0]
    return None


def _stem(path: Path | None) -> str:
    return "" if path is None else path.name.split(".")[0]


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
