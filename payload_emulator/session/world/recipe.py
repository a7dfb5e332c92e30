"""Recipe of a data set: sources of terrain by split, regions of its frames, light and positions.

A recipe is a TOML file with a `[dataset]` table and one `[[dataset.source]]` table per source. Angles are degrees and
lengths kilometres in the file. Splits are separated by footprint: every pixel of a frame looks into one of its source's
boxes and stays `buffer_km` away from every box it must avoid. A source may follow an ephemeris instead of drawing its
places, with the paper's own split: a contiguous test arc, the rest shuffled (section V-C).
"""

import hashlib
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from lunar.boxes import Box
from payload_emulator.errors import DatasetError
from payload_emulator.session.scenario import shipped_file
from payload_emulator.session.typed_toml import Record, TableFault, read_table

SPLITS = ("train", "val", "test")
PAPER_SPLIT = "80/15/5"
"""Split of a source along an ephemeris: the last 5 % of its frames in time are the test arc, the rest is shuffled."""

PAPER_SHARES = (0.80, 0.15, 0.05)


EVERYWHERE = (Box(0.0, 360.0, -60.0, 60.0),)


@dataclass(frozen=True, slots=True)
class Source:
    """One kind of frames.

    split : "train", "val" or "test"; along an ephemeris also "80/15/5".
    terrain : "procedural" (one world per seed), "real" (tiles of the data folder; seeds vary what is stamped) or
        "catalogue" (the data folder's craters on a procedural base).
    share : of all frames of the data set.
    light : "wide" = 3..60 degrees of elevation, mostly 5..15, any azimuth; "low" = 5..15, any azimuth; "paper" = 5..15
        and -45..45 degrees from north.
    vary : photometry, sensor and pointing are randomised; else they are nominal and the camera looks straight down.
    ephemeris : an OEM or STK file, or a scenario whose orbit is flown for `days`: frames are taken in turn at every
        `step_s` where the sub-satellite latitude is within `latitude_limit_deg` (the paper, section V-B.4) and the
        footprint is on the terrain. `altitude_km` does not apply.
    sharpen : real terrain gets seeded craters and roughness below what its rasters resolve.
    footprint : "inside" keeps whole footprints in the boxes and clear of those to avoid; "centre" only the point below
        the camera, for footprints wider than a box. Such frames are scored on the ground of their boxes alone.
    label_minimum_px : apparent diameter from which catalogued craters are listed.
    views, view_step_km : frames that are taken in turn under one Sun, and the distance by which the camera moves north
        from one to the next: they show how a detector repeats its errors. Without ephemeris.
    """

    name: str
    split: str
    terrain: Literal["procedural", "real", "catalogue"]
    share: float
    seeds: tuple[int, ...] = (1,)
    boxes: tuple[Box, ...] = EVERYWHERE
    avoid: tuple[Box, ...] = ()
    buffer_km: float = 60.0
    light: Literal["wide", "low", "paper"] = "wide"
    vary: bool = True
    altitude_km: tuple[float, float] = (12.0, 50.0)
    ephemeris: str = ""
    step_s: float = 15.0
    days: float = 1.0
    latitude_limit_deg: float = 60.0
    sharpen: bool = True
    footprint: Literal["inside", "centre"] = "inside"
    label_minimum_px: float = 5.0
    views: int = 1
    view_step_km: float = 24.5


@dataclass(frozen=True, slots=True)
class Recipe:
    """A data set up to its number of frames.

    bits : depth of the images, 8 or 16.
    colour : "gray", the mean of the camera's channels, or "rgb", the channels as the camera gives them (the paper,
        section IV-A).
    """

    name: str
    seed: int
    sources: tuple[Source, ...]
    width_px: int = 512
    height_px: int = 512
    fov_deg: float = 120.0
    frames_per_shard: int = 20
    bits: Literal[8, 16] = 8
    renderer: str = "fast"
    colour: Literal["gray", "rgb"] = "gray"

    def to_dict(self) -> dict[str, Any]:
        """Plain values; what came later than the first data sets is left out where it is not used."""
        document = _without_defaults(asdict(self), {"bits": 8, "renderer": "fast", "colour": "gray"})
        document["sources"] = [_source_dict(source) for source in document["sources"]]
        return document

    @property
    def digest(self) -> str:
        """Hash of everything that decides what the frames are."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()


def _source_dict(source: dict[str, Any]) -> dict[str, Any]:
    """Return a source's values; of an ephemeris only the name, as its folder says nothing about the frames."""
    source = _without_defaults(
        source, {"sharpen": True, "footprint": "inside", "label_minimum_px": 5.0, "views": 1, "view_step_km": 24.5}
    )
    if source["ephemeris"]:
        return source | {"ephemeris": Path(source["ephemeris"]).name}
    return {
        key: value for key, value in source.items() if key not in ("ephemeris", "step_s", "days", "latitude_limit_deg")
    }


def _without_defaults(document: dict[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key not in defaults or value != defaults[key]}


def procedural_recipe(seed: int = 1) -> Recipe:
    """Recipe without data: training worlds, a validation world and a test world that share no seed."""
    worlds = [seed * 100 + k for k in range(8)]
    return Recipe(
        "procedural",
        seed,
        (
            Source("procedural", "train", "procedural", 0.8, tuple(worlds[:6])),
            Source("procedural-val", "val", "procedural", 0.1, (worlds[6],), light="low", vary=False),
            Source("procedural-test", "test", "procedural", 0.1, (worlds[7],), light="low", vary=False),
        ),
    )


def load_recipe(path: Path) -> Recipe:
    """Recipe of a TOML file, or of a shipped scenario by its name.

    A file without a `[dataset]` table (a plain scenario) gives the procedural recipe.

    Raises
    ------
    DatasetError
        With the file, the key, what was expected and what was found.
    """
    path = shipped_file(path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: expected a TOML file, found: {error}") from error
    if "dataset" not in document:
        return procedural_recipe(int(document.get("seed", 1)))
    table = document["dataset"]
    if not isinstance(table, dict):
        raise DatasetError(f"{path}: dataset: expected a table, found {table!r}")
    sources = table.get("source", [])
    if not isinstance(sources, list) or not sources:
        raise DatasetError(f"{path}: dataset.source: expected at least one [[dataset.source]] table, found none")
    settings = {key: value for key, value in table.items() if key != "source"}
    for key in ("name", "seed"):
        if key not in settings:
            raise DatasetError(f"{path}: dataset.{key}: expected a value, found none")
    empty = Recipe(str(settings["name"]), 0, tuple(_source(path, n, item) for n, item in enumerate(sources)))
    return _read(path, "dataset", Recipe, settings, empty)


def _read(path: Path, where: str, kind: type[Record], table: object, present: Record | None = None) -> Record:
    try:
        return read_table(kind, table, present=present, bounds=_bounds)
    except TableFault as fault:
        if not fault.known:
            raise DatasetError(f"{path}: {where}: {fault}") from None
        hint = f" (did you mean {fault.nearest!r}?)" if fault.nearest else ""
        raise DatasetError(f"{path}: {where}: unknown key {fault.place!r}{hint}") from None


def _bounds(name: str) -> tuple[float, float]:
    return (1.0, 50.0) if name == "label_minimum_px" else (-math.inf, math.inf)


def _source(path: Path, number: int, table: Mapping[str, Any]) -> Source:
    where = f"dataset.source {number + 1}"
    values = dict(table)
    for key in ("name", "split", "terrain", "share"):
        if key not in values:
            raise DatasetError(f"{path}: {where}: {key}: expected a value, found none")
    splits = (*SPLITS, PAPER_SPLIT) if values.get("ephemeris") else SPLITS
    if values["split"] not in splits:
        raise DatasetError(f"{path}: {where}: split: expected one of {', '.join(splits)}, found {values['split']!r}")
    if "sharpen" in values and values["terrain"] != "real":
        raise DatasetError(
            f"{path}: {where}: sharpen: expected true or false on real terrain, found {values['sharpen']!r} "
            f"on {values['terrain']} terrain"
        )
    for key in ("boxes", "avoid"):
        if key in values:
            values[key] = [_box(path, f"{where}: {key}", item) for item in values[key]]
    source = _read(path, where, Source, values)
    if not 1 <= source.views <= 20 or (source.views > 1 and source.ephemeris):
        raise DatasetError(f"{path}: {where}: views: expected 1 to 20, and 1 along an ephemeris, found {source.views}")
    if not source.ephemeris:
        return source
    in_folder = path.parent / source.ephemeris
    for key in ("step_s", "days"):
        if not getattr(source, key) > 0.0:
            raise DatasetError(f"{path}: {where}: {key}: expected more than 0, found {values[key]!r}")
    return replace(source, ephemeris=str(in_folder)) if in_folder.exists() else source


def _box(path: Path, where: str, item: object) -> dict[str, float]:
    """Return the table of a box from its list of limits."""
    if not (isinstance(item, list) and len(item) == 4 and all(isinstance(value, (int, float)) for value in item)):
        raise DatasetError(f"{path}: {where}: expected [west, east, south, north] in degrees, found {item!r}")
    return dict(zip((limit.name for limit in fields(Box)), item, strict=True))
