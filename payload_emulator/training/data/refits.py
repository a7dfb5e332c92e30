"""Rims measured on the terrain itself instead of the catalogue's circles, for labels and for localisation.

`linna catalogue curate` fits a circle to each crater's rim on the height raster and keeps the craters that have one. A
crater of that table is moved in the picture by the difference between the two centres, and its diameter changes by the
ratio of the two; all others stay where the catalogue puts them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset, Frame
from tmtc.errors import TableError
from tmtc.tables import unpack_catalogue_table


@dataclass(frozen=True, slots=True, eq=False)
class RefittedRims:
    """Measured circles, arrays (n,), ids ascending; heights of the rim above the sphere of the maps."""

    ids: IntArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    diameter_m: FloatArray
    rim_height_m: FloatArray

    def __len__(self) -> int:
        return int(self.ids.size)


def load_refitted(path: Path, east_m: float = 0.0, north_m: float = 0.0) -> RefittedRims:
    """The rims of a table that `linna catalogue curate` wrote, shifted by `east_m` and `north_m`.

    Table and pictures are both in the frame of the terrain. Data sets that were drawn before the terrain was registered
    need a shift of tens of metres.

    Raises
    ------
    DatasetError
        The file cannot be read or is no such table.
    """
    try:
        table = unpack_catalogue_table(path.read_bytes())
    except (OSError, TableError) as error:
        raise DatasetError(
            f"{path}: expected a table of rims (`linna catalogue curate`), found: {error}"
        ) from error
    order = np.argsort(table.ids, kind="stable")
    latitude = table.latitude_rad[order] + north_m / MOON_RADIUS_M
    return RefittedRims(
        table.ids[order],
        latitude,
        table.longitude_rad[order] + east_m / (MOON_RADIUS_M * np.cos(latitude)),
        table.diameter_m[order],
        table.rim_height_m[order],
    )


def refitted_frame(dataset: Dataset, frame: Frame, rims: RefittedRims) -> tuple[Frame, BoolArray]:
    """The frame with its craters on the measured rims where there is one, and which those are, (n,)."""
    craters = frame.craters
    known = np.zeros(craters["id"].size, bool)
    if not frame.complete and len(rims):
        place = np.clip(np.searchsorted(rims.ids, craters["id"]), 0, len(rims) - 1)
        known = rims.ids[place] == craters["id"]
    rows = np.flatnonzero(known)
    if rows.size == 0:
        return frame, known
    of = place[rows]

    def project(latitude_rad: FloatArray, longitude_rad: FloatArray) -> FloatArray:
        ground = np.asarray(mcmf_from_spherical(latitude_rad, longitude_rad, rims.rim_height_m[of]))
        return np.asarray(dataset.camera.project((ground - frame.position_mcmf_m) @ frame.camera_from_mcmf.T))

    shift = project(rims.latitude_rad[of], rims.longitude_rad[of]) - project(
        np.radians(craters["latitude_deg"][rows].astype(np.float64)),
        np.radians(craters["longitude_deg"][rows].astype(np.float64)),
    )
    ratio = rims.diameter_m[of] / craters["diameter_m"][rows]
    moved = {name: values.copy() for name, values in craters.items()}
    moved["u_px"][rows] += shift[:, 0].astype(craters["u_px"].dtype)
    moved["v_px"][rows] += shift[:, 1].astype(craters["v_px"].dtype)
    for name in ("diameter_px", "major_px", "minor_px"):
        moved[name][rows] *= ratio.astype(craters[name].dtype)
    return replace(frame, craters=moved), known
