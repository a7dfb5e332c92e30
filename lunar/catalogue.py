"""Crater catalogues as arrays, with a spatial index, size classes and the published file formats.

Latitude and longitude are in the mean-Earth frame, in rad; longitudes are in 0..2 pi.  Heights are those of the rim
above the sphere of radius `MOON_RADIUS_M`.  NaN marks values that a catalogue does not give.
"""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import EXPANDED_LIMIT_OCTETS, open_expanded
from lunar.errors import DataFileError, LunarError
from lunar.frames import mcmf_from_spherical
from lunar.plausible import CRATER_COVER, CRATER_DEPTH, CRATER_DEPTH_RATIO, CRATER_DIAMETER_M, CRATER_MEDIAN_M, HEIGHT_M

TWO_PI = 2.0 * math.pi

CLASS_LIMITS_M = (5_000.0, 10_000.0, 15_000.0, 30_000.0)
"""Limits of the paper's size classes 0, 1 and 2; each includes its lower limit, the last also its upper limit."""

NAVIGATION_CLASS = 3
NAVIGATION_MINIMUM_M = 3_000.0
"""Craters of 3 to 5 km are used for navigation only and form class 3."""

PAPER_CLASS_COUNTS = (58_649, 12_830, 7_908)
"""Craters of 5-10, 10-15 and 15-30 km over the whole Moon (the paper, section V-B.2)."""

MARIA = (
    (18.4, -57.4, 1700.0),  # Oceanus Procellarum, approximated by one disc
    (32.8, -15.6, 1100.0),  # Imbrium
    (28.0, 17.5, 670.0),  # Serenitatis
    (8.5, 31.4, 870.0),  # Tranquillitatis
    (17.0, 59.1, 520.0),  # Crisium
    (-7.8, 51.3, 840.0),  # Fecunditatis
    (-15.2, 35.5, 340.0),  # Nectaris
    (-21.3, -16.6, 715.0),  # Nubium
    (-24.4, -38.6, 390.0),  # Humorum
    (-10.0, -23.1, 340.0),  # Cognitum
    (7.5, -30.9, 510.0),  # Insularum
    (13.3, 3.6, 245.0),  # Vaporum
    (57.0, -30.0, 500.0),  # Frigoris, western part
    (57.0, 10.0, 500.0),  # Frigoris, eastern part
    (1.3, 87.5, 370.0),  # Smythii
    (13.3, 86.1, 420.0),  # Marginis
    (56.8, 81.5, 230.0),  # Humboldtianum
    (-47.0, 91.0, 900.0),  # Australe
    (-19.4, -92.8, 300.0),  # Orientale
    (27.3, 147.9, 270.0),  # Moscoviense
    (-33.7, 163.5, 320.0),  # Ingenii
)
"""Latitude and east longitude in deg and diameter in km of the maria (IAU gazetteer, rounded)."""

MARE_DENSITY_RATIO = 0.045
"""Ratio of the density of 5-30 km craters in maria to that in highlands, for the synthetic catalogue.

LU1319381 has between 0.01 (Fecunditatis) and 0.15 (Procellarum).  With this value, the probability of three
craters in a footprint of 120 deg from the paper's orbit equals that of LU1319381 completed to the paper's class counts
(0.92).
"""

OWN_COLUMNS = ("id", "latitude_deg", "longitude_deg", "diameter_m", "rim_height_m", "depth_m", "complete")

BAND_RAD = math.radians(1.0)

BLOCK_OCTETS = 1 << 20
ROWS_LIMIT = 2_000_000
"""Most craters of a file; the largest public lists have 1.3 million."""

_COMPOSITE = "composite of "
_log = logging.getLogger(__name__)

_PUBLISHED = "lu1319381"
"""Beginning of the name of the published list, in which four craters of two tiles are known to be listed twice."""


@dataclass(frozen=True, eq=False)
class CraterCatalogue:
    """Craters as arrays of equal length; ``complete`` is True where the source covers the region completely.

    Not slotted, because the index is built on first use and cached.
    """

    ids: IntArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    diameter_m: FloatArray
    rim_height_m: FloatArray
    depth_m: FloatArray
    source: str
    complete: BoolArray

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def position_mcmf_m(self) -> FloatArray:
        """Return the centres at rim height, (n, 3); NaN if the height is unknown."""
        return mcmf_from_spherical(self.latitude_rad, self.longitude_rad, self.rim_height_m)

    @cached_property
    def size_class(self) -> NDArray[np.int8]:
        """Return the size class of every crater, (n,)."""
        return size_class(self.diameter_m)

    def select(self, mask_or_indices: ArrayLike | slice) -> CraterCatalogue:
        """Return the craters of a mask, of indices or of a slice, in that order."""
        chosen: Any = mask_or_indices if isinstance(mask_or_indices, slice) else np.asarray(mask_or_indices)
        if not isinstance(chosen, slice) and chosen.size == 0:
            chosen = chosen.astype(np.int64)
        return CraterCatalogue(
            self.ids[chosen],
            self.latitude_rad[chosen],
            self.longitude_rad[chosen],
            self.diameter_m[chosen],
            self.rim_height_m[chosen],
            self.depth_m[chosen],
            self.source,
            self.complete[chosen],
        )

    def near(self, latitude_rad: float, longitude_rad: float, radius_m: float) -> IntArray:
        """Return ascending indices of craters whose centres lie within an arc of ``radius_m`` of a place."""
        if len(self) == 0 or not radius_m >= 0.0:
            return np.zeros(0, dtype=np.int64)
        arc = radius_m / MOON_RADIUS_M
        keys, order, unit = self._index
        low, high = latitude_rad - arc, latitude_rad + arc
        bands = np.arange(_band(max(low, -math.pi / 2)), _band(min(high, math.pi / 2)) + 1)
        if low <= -math.pi / 2 or high >= math.pi / 2:
            half_width = math.pi
        else:
            half_width = math.asin(min(1.0, math.sin(arc) / math.cos(latitude_rad))) + 1e-9
        west = (longitude_rad - half_width) % TWO_PI
        if half_width >= math.pi:
            spans = [(0.0, TWO_PI)]
        elif west + 2.0 * half_width > TWO_PI:
            spans = [(west, TWO_PI), (0.0, west + 2.0 * half_width - TWO_PI)]
        else:
            spans = [(west, west + 2.0 * half_width)]
        pieces = []
        for span_low, span_high in spans:
            first = np.searchsorted(keys, bands * TWO_PI + span_low, side="left")
            last = np.searchsorted(keys, bands * TWO_PI + span_high, side="right")
            pieces += [order[a:b] for a, b in zip(first, last, strict=True) if b > a]
        if not pieces:
            return np.zeros(0, dtype=np.int64)
        candidates = np.unique(np.concatenate(pieces))
        cos_latitude = math.cos(latitude_rad)
        place = np.array(
            [cos_latitude * math.cos(longitude_rad), cos_latitude * math.sin(longitude_rad), math.sin(latitude_rad)]
        )
        chord = np.linalg.norm(unit[candidates] - place, axis=-1)
        return np.asarray(candidates[chord <= 2.0 * math.sin(min(arc, math.pi) / 2.0)])

    @cached_property
    def _index(self) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return sort keys (latitude band, then longitude), the craters in that order, and unit vectors."""
        bands = np.floor((self.latitude_rad + math.pi / 2) / BAND_RAD)
        key = bands * TWO_PI + np.mod(self.longitude_rad, TWO_PI)
        order = np.argsort(key, kind="stable").astype(np.int64)
        unit = mcmf_from_spherical(self.latitude_rad, self.longitude_rad) / MOON_RADIUS_M
        return key[order], order, unit


def size_class(diameter_m: ArrayLike) -> NDArray[np.int8]:
    """Return 0 for 5-10 km, 1 for 10-15 km, 2 for 15-30 km, 3 for 3-5 km (navigation only), -1 otherwise."""
    diameter = np.asarray(diameter_m, dtype=np.float64)
    edges = np.array([NAVIGATION_MINIMUM_M, *CLASS_LIMITS_M])
    edges[-1] = np.nextafter(edges[-1], np.inf)
    classes = np.array([-1, NAVIGATION_CLASS, 0, 1, 2, -1], dtype=np.int8)
    # NaN sorts last, so its class is -1, as for diameters above the last limit.
    return np.asarray(classes[np.searchsorted(edges, diameter, side="right")])


def class_counts(catalogue: CraterCatalogue) -> IntArray:
    """Return the number of craters in the classes 0, 1 and 2, shape (3,)."""
    classes = size_class(catalogue.diameter_m)
    return np.array([np.count_nonzero(classes == k) for k in range(3)], dtype=np.int64)


def make_catalogue(
    latitude_rad: ArrayLike,
    longitude_rad: ArrayLike,
    diameter_m: ArrayLike,
    *,
    source: str,
    ids: ArrayLike | None = None,
    rim_height_m: ArrayLike | None = None,
    depth_m: ArrayLike | None = None,
    complete: ArrayLike | bool = True,
) -> CraterCatalogue:
    """Return a catalogue of arrays (n,), with consecutive ids and NaN heights and depths unless given."""
    latitude = np.asarray(latitude_rad, dtype=np.float64)
    n = len(latitude)
    unknown = np.full(n, np.nan)
    return CraterCatalogue(
        np.arange(n, dtype=np.int64) if ids is None else np.asarray(ids, dtype=np.int64),
        latitude,
        np.mod(np.asarray(longitude_rad, dtype=np.float64), TWO_PI),
        np.asarray(diameter_m, dtype=np.float64),
        unknown if rim_height_m is None else np.asarray(rim_height_m, dtype=np.float64),
        unknown if depth_m is None else np.asarray(depth_m, dtype=np.float64),
        source,
        np.array(np.broadcast_to(np.asarray(complete, dtype=np.bool_), (n,))),
    )


def paper_density_catalogue(seed: int, uniform: bool = False) -> CraterCatalogue:
    """Return a synthetic catalogue of the paper's class counts, with few craters in the maria unless ``uniform``.

    Positions are random over the sphere; diameters follow N(>D) ~ D^-2 inside each class.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    mare = np.radians([(latitude, longitude) for latitude, longitude, _ in MARIA])
    mare_unit = mcmf_from_spherical(mare[:, 0], mare[:, 1]) / MOON_RADIUS_M
    mare_cos = np.cos([500.0 * diameter_km / MOON_RADIUS_M for _, _, diameter_km in MARIA])

    def accepted(latitude_rad: FloatArray, longitude_rad: FloatArray) -> BoolArray:
        chance = rng.random(len(latitude_rad))
        unit = mcmf_from_spherical(latitude_rad, longitude_rad) / MOON_RADIUS_M
        in_mare = np.any(unit @ mare_unit.T > mare_cos, axis=1)
        return np.asarray(uniform | ~in_mare | (chance < MARE_DENSITY_RATIO))

    diameter_m = _class_diameters_m(rng, PAPER_CLASS_COUNTS)
    latitude, longitude = _random_places(rng, len(diameter_m), accepted)
    where = "uniform places" if uniform else "sparse maria"
    return make_catalogue(
        latitude, longitude, diameter_m, source=f"synthetic, the paper's class counts, {where}, seed {seed}"
    )


def completed_to_paper(catalogue: CraterCatalogue, seed: int) -> CraterCatalogue:
    """Return the complete craters of 5-30 km of a catalogue, with random ones up to the paper's class counts added.

    The added craters lie in the tiles of 30 x 30 degrees in which the catalogue has no complete crater. Their ids are
    -1, -2, ...

    Raises
    ------
    LunarError
        If no tile is empty, or if a class already has more craters than the paper's catalogue.
    """
    in_range = catalogue.complete & (size_class(catalogue.diameter_m) >= 0)
    known = catalogue.select(in_range & (catalogue.diameter_m >= CLASS_LIMITS_M[0]))
    missing = np.array(PAPER_CLASS_COUNTS) - class_counts(known)
    tiles = np.bincount(_tile(catalogue.latitude_rad, catalogue.longitude_rad)[catalogue.complete], minlength=72)
    empty = tiles == 0
    if np.any(missing < 0) or not np.any(empty):
        raise LunarError(
            f"{catalogue.source}: expected a catalogue with empty tiles and at most {PAPER_CLASS_COUNTS} craters "
            f"of the three classes, found {np.count_nonzero(empty)} empty tiles and "
            f"{tuple(class_counts(known).tolist())} craters"
        )
    rng = np.random.Generator(np.random.PCG64(seed))
    diameter_m = _class_diameters_m(rng, missing.tolist())
    latitude, longitude = _random_places(rng, len(diameter_m), lambda lat, lon: empty[_tile(lat, lon)])
    n = len(diameter_m)
    return make_catalogue(
        np.concatenate([known.latitude_rad, latitude]),
        np.concatenate([known.longitude_rad, longitude]),
        np.concatenate([known.diameter_m, diameter_m]),
        source=f"{catalogue.source}, with {n} random craters (seed {seed}) in {np.count_nonzero(empty)} empty tiles",
        ids=np.concatenate([known.ids, -1 - np.arange(n)]),
        rim_height_m=np.concatenate([known.rim_height_m, np.full(n, np.nan)]),
        depth_m=np.concatenate([known.depth_m, np.full(n, np.nan)]),
    )


def _class_diameters_m(rng: np.random.Generator, counts: Sequence[int]) -> FloatArray:
    """Return shuffled diameters with ``counts`` in the classes 0, 1 and 2."""
    parts = []
    for (low, high), count in zip(pairwise(CLASS_LIMITS_M), counts, strict=True):
        parts.append((low**-2 + rng.random(count) * (high**-2 - low**-2)) ** -0.5)
    return rng.permutation(np.concatenate(parts))


def _random_places(
    rng: np.random.Generator, n: int, accepted: Callable[[FloatArray, FloatArray], BoolArray]
) -> tuple[FloatArray, FloatArray]:
    """Return n latitudes and longitudes, uniform over the accepted part of the sphere."""
    latitude_rad, longitude_rad = np.empty(0), np.empty(0)
    while len(latitude_rad) < n:
        latitude, longitude = np.arcsin(rng.uniform(-1.0, 1.0, n)), rng.uniform(0.0, TWO_PI, n)
        kept = accepted(latitude, longitude)
        latitude_rad = np.concatenate([latitude_rad, latitude[kept]])
        longitude_rad = np.concatenate([longitude_rad, longitude[kept]])
    return latitude_rad[:n], longitude_rad[:n]


def _tile(latitude_rad: FloatArray, longitude_rad: FloatArray) -> IntArray:
    """Return the number of the tile of 30 x 30 degrees, 0..71."""
    row = np.clip(np.floor((latitude_rad + math.pi / 2) / (math.pi / 6)), 0, 5)
    column = np.clip(np.floor(np.mod(longitude_rad, TWO_PI) / (math.pi / 6)), 0, 11)
    return np.asarray(12 * row + column, dtype=np.int64)


def load_catalogue(path: Path | str) -> CraterCatalogue:
    """Return the craters of a CSV file (plain or gzip), whose format is identified by its columns.

    Supported are LU1319381 (``longitude_deg, latitude_deg, diameter_m, depth_m``), the composite of several
    sources (``diameter_km, source, tile_complete``), Robbins (``lat, lon, diam`` in km, or as published with
    ``LAT_CIRC_IMG, LON_CIRC_IMG, DIAM_CIRC_IMG``) and the LINNA format.  Exact duplicates are removed.

    Raises
    ------
    DataFileError
        If the file cannot be read, its columns are unknown, a value is not a number or out of range, two craters have
        one id, or diameters, depths and places do not fit each other.
    """
    path = Path(path)
    blocks, is_identified = [], False
    for columns in _read_blocks(path):
        blocks.append(_reader_of(path, columns)(path, columns))
        is_identified = "id" in columns
    catalogue = _joined(blocks)
    _check_ranges(path, catalogue)
    kept = _first_of_repetitions(catalogue)
    _check_identity(path, catalogue.ids, kept)
    lost = len(kept) < len(catalogue.ids) and len(np.setdiff1d(catalogue.ids, catalogue.ids[kept]))
    if lost and is_identified and not path.name.startswith(_PUBLISHED):
        _log.warning(
            "%s: left out %d of %d craters, equal to one before but for the id", path, lost, len(catalogue.ids)
        )
    catalogue = catalogue.select(kept)
    _check_whole(path, catalogue)
    return catalogue


def _reader_of(path: Path, columns: _Columns) -> Reader:
    for reader, needed in _READERS:
        if needed <= set(columns):
            return reader
    known = "; ".join(", ".join(sorted(needed)) for _, needed in _READERS)
    raise DataFileError(path, "line 1", f"the columns of a crater catalogue ({known})", ", ".join(columns) or "nothing")


def _joined(blocks: list[CraterCatalogue]) -> CraterCatalogue:
    """Return the blocks of a list as one; a composite has the sources of all."""
    if len(blocks) == 1:
        return blocks[0]
    columns = {
        one.name: np.concatenate([getattr(block, one.name) for block in blocks])
        for one in fields(CraterCatalogue)
        if one.name != "source"
    }
    prefix = _COMPOSITE if blocks[0].source.startswith(_COMPOSITE) else ""
    sources = {name for block in blocks for name in block.source.removeprefix(prefix).split(", ")}
    return CraterCatalogue(**columns, source=prefix + ", ".join(sorted(sources)))


def catalogue_words(catalogue: CraterCatalogue) -> str:
    """Return number, places, diameters and depths of the craters of a list, as printed with figures of it."""
    if not len(catalogue):
        return "0 craters"
    east = np.degrees(catalogue.longitude_rad)
    ranges = [
        (np.degrees(catalogue.latitude_rad), "deg north"),
        (east, "deg east"),
        (catalogue.diameter_m / 1e3, "km across"),
        (catalogue.depth_m, "m deep"),
        (catalogue.rim_height_m, "m rim height"),
    ]
    words = [
        f"{np.nanmin(values):.4g} to {np.nanmax(values):.4g} {unit}"
        for values, unit in ranges
        if np.isfinite(values).any()
    ]
    kept = np.count_nonzero(catalogue.complete)
    return f"{len(catalogue)} craters ({kept} of a complete list): {', '.join(words)}"


def save_catalogue(catalogue: CraterCatalogue, path: Path | str) -> None:
    """Write a CSV in the LINNA format: id, latitude_deg, longitude_deg, diameter_m, rim_height_m, depth_m, complete."""
    Path(path).write_text(format_catalogue(catalogue), encoding="ascii", newline="\n")


def format_catalogue(catalogue: CraterCatalogue) -> str:
    """Return CSV in the LINNA format; angles to 1e-9 deg (30 um on the ground), lengths to 1 mm, unknown empty."""
    rows = zip(
        catalogue.ids.tolist(),
        np.degrees(catalogue.latitude_rad).tolist(),
        (np.degrees(catalogue.longitude_rad) % 360.0).tolist(),
        catalogue.diameter_m.tolist(),
        catalogue.rim_height_m.tolist(),
        catalogue.depth_m.tolist(),
        catalogue.complete.tolist(),
        strict=True,
    )
    lines = [",".join(OWN_COLUMNS)]
    lines += [
        f"{i},{lat:.9f},{lon:.9f},{diameter:.3f},{_or_empty(rim)},{_or_empty(depth)},{int(complete)}"
        for i, lat, lon, diameter, rim, depth, complete in rows
    ]
    return "\n".join(lines) + "\n"


def _or_empty(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3f}"


def _band(latitude_rad: float) -> int:
    return math.floor((latitude_rad + math.pi / 2) / BAND_RAD)


class _Columns(dict[str, list[str]]):
    """Texts of a block of rows by column; `first` is the line of its first row."""

    first = 2


def _read_blocks(path: Path) -> Iterator[_Columns]:
    """Yield the rows of a file, block by block: texts take many times the memory of the numbers in them."""
    header: list[str] = []
    first, encoding = 2, "utf-8-sig"
    with open_expanded(path, "a crater catalogue in CSV, plain or gzip") as stream:
        for octets in _line_blocks(path, stream):
            try:
                text = octets.decode(encoding)
            except ValueError as error:
                raise DataFileError(path, "", "a complete CSV or gzip file", str(error)) from None
            columns, header, rows = _columns_of(path, text, header, first)
            first, encoding = first + rows, "utf-8"
            if first - 2 > ROWS_LIMIT:
                raise DataFileError(path, "", f"at most {ROWS_LIMIT} craters", "more")
            yield columns


def _line_blocks(path: Path, stream: IO[bytes]) -> Iterator[bytes]:
    """Yield blocks of whole lines of a stream, at least one."""
    left, total = b"", 0
    while octets := stream.read(BLOCK_OCTETS):
        total += len(octets)
        whole, _, left = (left + octets).rpartition(b"\n")
        if total > EXPANDED_LIMIT_OCTETS or len(left) > BLOCK_OCTETS:
            limits = f"{EXPANDED_LIMIT_OCTETS >> 20} MiB when expanded and {BLOCK_OCTETS} octets of a line"
            raise DataFileError(path, "", f"at most {limits}", "more")
        if whole:
            yield whole
    if left or not total:
        yield left


def _columns_of(path: Path, text: str, header: list[str], first: int) -> tuple[_Columns, list[str], int]:
    """Return the columns of lines, the names of the columns, which the first block begins with, and the rows."""
    if '"' not in text:
        # Without quotes, a plain split is sufficient and five times as fast as the csv module.
        lines = [line for line in text.replace("\r", "").split("\n") if line]
        rows = []
        widths = [line.count(",") + 1 for line in lines]
        own = lines[0].split(",") if lines else []
    else:
        lines = []
        try:
            rows = [row for row in csv.reader(io.StringIO(text)) if row]
        except csv.Error as error:
            raise DataFileError(path, "", "a complete CSV or gzip file", str(error)) from None
        widths = [len(row) for row in rows]
        own = rows[0]
    begins = not header
    header = header or own
    if not header:
        raise DataFileError(path, "line 1", "the column names of a crater catalogue", "an empty file")
    if begins and len(header) == 1:
        raise DataFileError(path, "line 1", "column names of a crater catalogue, separated by commas", header[0])
    _check_widths(path, widths, len(header), first - begins)
    lines, rows = lines[begins:], rows[begins:]
    wanted = [k for k, name in enumerate(header) if name.strip() in _KNOWN_COLUMNS]
    names = [header[k].strip() for k in wanted]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataFileError(path, "line 1", "each column once", f"{twice} {names.count(twice)} times")
    if lines and 2 * len(wanted) < len(header):
        # Parse only the required columns of a wide table (Robbins: 21 columns, 1.3 million rows).
        columns = _some_columns(header, lines, wanted)
    else:
        flat = ",".join(lines).split(",") if lines else [value for row in rows for value in row]
        columns = _Columns({name.strip(): flat[k :: len(header)] for k, name in enumerate(header)})
    columns.first = first
    return columns, header, len(lines) or len(rows)


def _check_widths(path: Path, widths: list[int], expected: int, first: int) -> None:
    for number, width in enumerate(widths, start=first):
        if width != expected:
            raise DataFileError(path, f"line {number}", f"{expected} values", f"{width}")


def _some_columns(header: list[str], lines: list[str], wanted: list[int]) -> _Columns:
    """Return the columns of a table by name; columns that are not required are empty."""
    columns = _Columns({name.strip(): [] for name in header})
    last = max(wanted, default=0) + 1
    for line in lines:
        values = line.split(",", last)
        for k in wanted:
            columns[header[k].strip()].append(values[k])
    return columns


def _numbers(path: Path, columns: _Columns, name: str, missing: bool = False) -> FloatArray:
    texts = columns[name]
    if missing:
        texts = [text if text.strip() else "nan" for text in texts]
    try:
        return np.array([float(text) for text in texts], dtype=np.float64)
    except ValueError:
        for number, text in enumerate(texts, start=columns.first):
            try:
                float(text)
            except ValueError:
                raise DataFileError(path, f"line {number}, column {name}", "a number", repr(text)) from None
        raise


def _places(path: Path, columns: _Columns, latitude: str, longitude: str) -> tuple[FloatArray, FloatArray]:
    """Return latitudes and longitudes in radians of columns in degrees."""
    angles = []
    for name, low, high in ((latitude, -90.0, 90.0), (longitude, -360.0, 720.0)):
        values = _numbers(path, columns, name)
        wrong = np.flatnonzero(~((values >= low) & (values <= high)))
        if wrong.size:
            expected = f"a {'latitude' if name == latitude else 'longitude'} of {low:g}..{high:g} deg"
            raise DataFileError(path, f"line {wrong[0] + columns.first}", expected, f"{values[wrong[0]]:g}")
        angles.append(np.radians(values))
    return angles[0], angles[1]


def _ids(path: Path, columns: _Columns) -> IntArray:
    numbers = _numbers(path, columns, "id")
    whole = (np.rint(numbers) == numbers) & (np.abs(numbers) < 2.0**53)
    if not whole.all():
        row = int(np.argmin(whole))
        raise DataFileError(path, f"line {row + columns.first}, column id", "a whole number", columns["id"][row])
    return numbers.astype(np.int64)


def _ids_or_numbers(path: Path, columns: _Columns) -> IntArray:
    if "id" in columns:
        return _ids(path, columns)
    rows = max(map(len, columns.values()))
    return np.arange(columns.first - 2, columns.first - 2 + rows, dtype=np.int64)


def _flags(path: Path, columns: _Columns, name: str) -> BoolArray:
    texts = [text.strip().lower() for text in columns[name]]
    for row, text in enumerate(texts):
        if text not in ("1", "true", "0", "false", ""):
            raise DataFileError(path, f"line {row + columns.first}, column {name}", "1, 0, true or false", repr(text))
    return np.array([text in ("1", "true") for text in texts], dtype=np.bool_)


def _read_composite(path: Path, columns: _Columns) -> CraterCatalogue:
    return make_catalogue(
        *_places(path, columns, "latitude_deg", "longitude_deg"),
        1000.0 * _numbers(path, columns, "diameter_km"),
        source=_COMPOSITE + ", ".join(sorted(set(columns["source"]))),
        ids=_ids_or_numbers(path, columns),
        complete=_flags(path, columns, "tile_complete"),
    )


def _read_robbins(path: Path, columns: _Columns) -> CraterCatalogue:
    return make_catalogue(
        *_places(path, columns, "lat", "lon"),
        1000.0 * _numbers(path, columns, "diam"),
        source="Robbins",
        ids=_ids_or_numbers(path, columns),
    )


def _read_robbins_whole(path: Path, columns: _Columns) -> CraterCatalogue:
    return make_catalogue(
        *_places(path, columns, "LAT_CIRC_IMG", "LON_CIRC_IMG"),
        1000.0 * _numbers(path, columns, "DIAM_CIRC_IMG"),
        source="Robbins",
        ids=_ids_or_numbers(path, columns),
    )


def _read_own(path: Path, columns: _Columns) -> CraterCatalogue:
    return make_catalogue(
        *_places(path, columns, "latitude_deg", "longitude_deg"),
        _numbers(path, columns, "diameter_m"),
        source=path.name if set(OWN_COLUMNS) <= set(columns) else "LU1319381",
        ids=_ids(path, columns),
        rim_height_m=_numbers(path, columns, "rim_height_m", missing=True) if "rim_height_m" in columns else None,
        depth_m=_numbers(path, columns, "depth_m", missing=True),
        complete=_flags(path, columns, "complete") if "complete" in columns else True,
    )


Reader = Callable[[Path, _Columns], CraterCatalogue]
_READERS: tuple[tuple[Reader, set[str]], ...] = (
    (_read_composite, {"latitude_deg", "longitude_deg", "diameter_km", "source", "tile_complete"}),
    (_read_own, {"id", "latitude_deg", "longitude_deg", "diameter_m", "depth_m"}),
    (_read_robbins, {"lat", "lon", "diam"}),
    (_read_robbins_whole, {"LAT_CIRC_IMG", "LON_CIRC_IMG", "DIAM_CIRC_IMG"}),
)
_KNOWN_COLUMNS = frozenset().union(*(needed for _, needed in _READERS), OWN_COLUMNS)


def _check_ranges(path: Path, catalogue: CraterCatalogue) -> None:
    checks = (
        (CRATER_DIAMETER_M.holds(catalogue.diameter_m), f"a diameter of {CRATER_DIAMETER_M}", catalogue.diameter_m),
        (
            HEIGHT_M.holds(catalogue.rim_height_m) | np.isnan(catalogue.rim_height_m),
            f"a rim height of {HEIGHT_M} above the map sphere",
            catalogue.rim_height_m,
        ),
        (
            CRATER_DEPTH.holds(catalogue.depth_m / catalogue.diameter_m) | np.isnan(catalogue.depth_m),
            f"a depth over diameter of {CRATER_DEPTH}",
            catalogue.depth_m / catalogue.diameter_m,
        ),
    )
    for valid, expected, values in checks:
        if not np.all(valid):
            row = int(np.flatnonzero(~valid)[0])
            raise DataFileError(path, f"line {row + 2}", expected, f"{values[row]:.10g}")


def _check_identity(path: Path, ids: IntArray, kept: IntArray) -> None:
    """Refuse an id of two craters; `kept` are the rows that are no repetitions."""
    order = kept[np.argsort(ids[kept], kind="stable")]
    twice = np.flatnonzero(np.diff(ids[order]) == 0)
    if twice.size:
        first, second = order[twice[0]], order[twice[0] + 1]
        raise DataFileError(
            path,
            f"lines {first + 2} and {second + 2}, column id",
            "an id of its own for each crater (two lists joined?)",
            f"{ids[first]} twice",
        )


def _check_whole(path: Path, catalogue: CraterCatalogue) -> None:
    """Refuse a list whose typical diameter, depth, rim height or density shows another unit."""
    if len(catalogue) == 0:
        return
    diameter_m = catalogue.diameter_m
    median_m = float(np.median(diameter_m))
    if not CRATER_MEDIAN_M.holds(median_m):
        raise DataFileError(path, "", f"a median diameter of {CRATER_MEDIAN_M}", f"{median_m:.6g} m; another unit?")
    ratio = (catalogue.depth_m / diameter_m)[catalogue.depth_m > 0.0]
    if ratio.size and not CRATER_DEPTH_RATIO.holds(np.median(ratio)):
        found = f"{np.median(ratio):.3g}; another unit of depths?"
        raise DataFileError(path, "", f"a median depth over diameter of {CRATER_DEPTH_RATIO}", found)
    heights_m = catalogue.rim_height_m[np.isfinite(catalogue.rim_height_m)]
    if heights_m.size >= _MANY and heights_m.std() > 0.0 and np.abs(heights_m).max() <= HEIGHT_M.high / 1e3:
        found = f"none over {np.abs(heights_m).max():.3g} m; kilometres?"
        raise DataFileError(path, "", f"some of {heights_m.size} rim heights over {HEIGHT_M.high / 1e3:g} m", found)
    cover = len(catalogue) * 0.25 * math.pi * median_m**2 / _spanned_m2(catalogue, median_m)
    if len(catalogue) >= _MANY and cover > CRATER_COVER:
        found = f"{cover:.3g} times that ground; angles or diameters in another unit?"
        raise DataFileError(path, "", f"craters that cover at most {CRATER_COVER:g} of the ground they span", found)


_MANY = 20


def _spanned_m2(catalogue: CraterCatalogue, margin_m: float) -> float:
    """Return the area of the ground about all craters between their latitudes and longitudes."""
    margin = margin_m / MOON_RADIUS_M
    low, high = catalogue.latitude_rad.min() - margin, catalogue.latitude_rad.max() + margin
    south, north = max(low, -0.5 * math.pi), min(high, 0.5 * math.pi)
    gaps = np.diff(np.sort(catalogue.longitude_rad), append=catalogue.longitude_rad.min() + TWO_PI)
    width = min(TWO_PI, TWO_PI - float(gaps.max()) + margin / max(math.cos(max(abs(south), abs(north))), 1e-3))
    return float(MOON_RADIUS_M**2 * (math.sin(north) - math.sin(south)) * width)


def _first_of_repetitions(catalogue: CraterCatalogue) -> IntArray:
    """Return the rows, ascending, that are not equal to one before in place and diameter."""
    columns = (catalogue.diameter_m, catalogue.longitude_rad, catalogue.latitude_rad)
    order = np.lexsort(columns)
    same = np.ones(max(len(order) - 1, 0), dtype=np.bool_)
    for column in columns:
        same &= np.diff(column[order]) == 0.0
    # The sort is stable, so the first of equal rows is kept.
    return np.asarray(np.delete(np.arange(len(order)), order[1:][same]), dtype=np.int64)
