"""Passes for analysis: tables as pandas data frames, images as arrays, everything else as the client gives it.

Tables are those of the CSV export (docs/exports.md). Column `utc` is a time stamp with time zone; `attrs` of a data
frame has the units and descriptions of its columns.
"""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from argparse import Namespace
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from ground_service.client import Client
from ground_service.evaluation.model import PassFigures
from ground_service.exports.model import FormatName
from ground_service.exports.tables import CSV_METADATA
from linna.data import data_folder
from linna.errors import UsageError
from tmtc.errors import MissingLibrary

if TYPE_CHECKING:
    import pandas
    import xarray

EXPECTED = "a home folder with linna.db, a pass archive (folder or zip), or the URL of a server"


def open_archive(source: str | Path | None, token: str | None = None) -> Archive:
    """Open a home folder, a server or a pass archive; see `linna.open`."""
    text = "" if source is None else str(source)
    if text.startswith(("http://", "https://")):
        return Archive(Client(text, token or os.environ.get("LINNA_TOKEN")), text)
    if source is None:
        return _home(None)
    path = Path(source).expanduser()
    if (path / "manifest.json").is_file() or (path.suffix.lower() == ".zip" and path.is_file()):
        return _imported(path)
    if (path / "linna.db").is_file() or (path.is_dir() and os.environ.get("LINNA_DATABASE_URL")):
        return _home(path)
    raise UsageError(f"{path}: expected {EXPECTED}, found {'another folder' if path.is_dir() else 'none'}")


def _home(path: Path | None) -> Archive:
    from ground_service.client.local import local_client
    from linna.commands._ground import open_ground_only

    ground = open_ground_only(Namespace(home=path))
    return Archive(local_client(ground, "notebook"), str(ground.home))


def _imported(archive: Path) -> Archive:
    from ground_service.client.local import local_client
    from ground_service.ground import open_ground

    folder = tempfile.TemporaryDirectory(prefix="linna-archive-")
    client = local_client(open_ground(Path(folder.name), data_folder()), "notebook")
    opened = Archive(client, str(archive), folder)
    try:
        client.import_archive(archive)
    except BaseException:
        opened.close()
        raise
    return opened


class Archive(Mapping[int, "Pass"]):
    """Passes of a source by number; a context manager, which closes the source.

    `client` gives access to everything else that the ground service offers.
    """

    def __init__(self, client: Client, source: str, folder: tempfile.TemporaryDirectory[str] | None = None) -> None:
        self.client = client
        self.source = source
        self._folder = folder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<LINNA archive {self.source}: {len(self)} passes>"

    def close(self) -> None:
        """Close the source; data frames stay usable."""
        self.client.close()
        if self._folder is not None:
            self._folder.cleanup()

    @cached_property
    def _passes(self) -> dict[int, Pass]:
        found = sorted(self.client.list_passes(), key=lambda one: (str(one.start), one.id))
        return {one.id: Pass(self.client, one.id, one.name, str(one.start), str(one.stop)) for one in found}

    def __getitem__(self, number: int) -> Pass:
        return self._passes[number]

    def __iter__(self) -> Iterator[int]:
        return iter(self._passes)

    def __len__(self) -> int:
        return len(self._passes)

    @property
    def passes(self) -> list[Pass]:
        """Passes in order of time."""
        return list(self._passes.values())

    def summary(self) -> pandas.DataFrame:
        """Return the figures of each pass: packets, detector, and errors of each navigation solution."""
        pandas = _pandas()
        rows = [one.summary() for one in self.passes]
        table = pandas.DataFrame(rows)
        return table.set_index("pass_id") if len(table) else table


class Pass:
    """A pass, its tables and its images."""

    def __init__(self, client: Client, number: int, name: str, start: str, stop: str) -> None:
        self._client = client
        self.id = number
        self.name = name
        self.start = start
        self.stop = stop

    def __repr__(self) -> str:
        return f"<pass {self.id}: {self.name}, {self.start} to {self.stop}>"

    @cached_property
    def figures(self) -> PassFigures:
        """Figures of the evaluated pass."""
        return self._client.evaluate_pass(self.id)

    def summary(self) -> dict[str, Any]:
        """Return the main figures of the pass as plain values; None: unknown."""
        found = self.figures
        row: dict[str, Any] = {
            "pass_id": self.id,
            "name": self.name,
            "start": _pandas().Timestamp(self.start),
            "frames": found.frames,
            "packets": found.packets,
            "packets_lost": found.packets_lost,
            "evidence_level": found.evidence_level,
            "precision": found.detector.precision,
            "recall": found.detector.recall,
            "loc_px": found.detector.loc_px,
        }
        for kind in (found.navigation, found.smoothed, found.baselines):
            row |= {f"{name} median_3d_m": one.median_3d_m for name, one in kind.items()}
        return row

    @cached_property
    def _files(self) -> dict[str, bytes]:
        return self._exported("csv")

    @cached_property
    def _schema(self) -> dict[str, dict[str, Any]]:
        document = json.loads(self._files[CSV_METADATA])
        return {one["url"].removesuffix(".csv"): one for one in document["tables"]}

    @property
    def tables(self) -> list[str]:
        """Names of the tables."""
        return list(self._schema)

    def table(self, name: str) -> pandas.DataFrame:
        """Return a table; a new data frame each time.

        Raises
        ------
        UsageError
            If there is no such table.
        """
        pandas = _pandas()
        if name not in self._schema:
            raise UsageError(f"table: expected {', '.join(self.tables)}, found {name!r}")
        columns = self._schema[name]["tableSchema"]["columns"]
        kinds = {"integer": "int64", "number": "float64", "string": "str", "dateTime": "str"}
        frame = pandas.read_csv(
            io.BytesIO(self._files[f"{name}.csv"]),
            dtype={one["name"]: kinds[one["datatype"]] for one in columns},
            keep_default_na=False,
            na_values={one["name"]: [""] for one in columns if one["datatype"] == "number"},
        )
        for one in columns:
            if one["datatype"] == "dateTime":
                frame[one["name"]] = pandas.to_datetime(frame[one["name"]], utc=True).astype("datetime64[ns, UTC]")
        frame.attrs = {
            "description": self._schema[name]["dc:description"],
            "units": {one["name"]: one["linna:unit"] for one in columns if "linna:unit" in one},
            "descriptions": {one["name"]: one["dc:description"] for one in columns},
        }
        return frame

    @property
    def states(self) -> pandas.DataFrame:
        """States of the on-board estimators."""
        return self.table("states")

    @property
    def detections(self) -> pandas.DataFrame:
        """Detections of the payload."""
        return self.table("detections")

    @property
    def residuals(self) -> pandas.DataFrame:
        """Errors of the navigation solutions against the reference."""
        return self.table("residuals")

    @property
    def events(self) -> pandas.DataFrame:
        """Event reports of the payload."""
        return self.table("events")

    @property
    def frames(self) -> pandas.DataFrame:
        """Frames with a detection report."""
        return self.table("frames")

    @property
    def images(self) -> dict[int, NDArray[np.uint8]]:
        """Archived images by number of the frame; empty if there are none."""
        from PIL import Image

        if not self.frames["archived"].any():
            return {}
        return {
            int(Path(name).stem): np.asarray(Image.open(io.BytesIO(octets)))
            for name, octets in self._exported("images").items()
        }

    def dataset(self) -> xarray.DataTree:
        """Return all tables as an xarray tree with units; needs the extra `netcdf`."""
        try:
            import xarray
        except ImportError:
            raise MissingLibrary("data sets", "xarray", "linna[netcdf]") from None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pass.nc"
            self.export("netcdf", path)
            return xarray.load_datatree(path, engine="h5netcdf")

    def export(self, kind: FormatName, target: str | Path, *, states: str = "reference") -> Path:
        """Write the pass in a format of other tools, and return the path."""
        self._client.export_pass(self.id, kind, out=Path(target), states=states)
        return Path(target)

    def _exported(self, kind: FormatName) -> dict[str, bytes]:
        with tempfile.TemporaryDirectory() as folder:
            octets = self.export(kind, Path(folder) / "export.zip").read_bytes()
        with zipfile.ZipFile(io.BytesIO(octets)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}


def _pandas() -> Any:
    try:
        import pandas
    except ImportError:
        raise MissingLibrary("data frames", "pandas", "linna[notebook]") from None
    return pandas
