"""Files made of accepted landmarks: crater catalogue, anchoring table, training labels, telecommands of an upload."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ground_service.errors import InvalidInput
from ground_service.evaluation.landmarks.model import Landmark
from lunar.arrays import FloatArray
from lunar.catalogue import CraterCatalogue, make_catalogue
from tmtc.dictionary.tables import CatalogueTable
from tmtc.packets.large_data import split

FIRST_ID = 2_000_000_000
"""Learned craters have identities from here on; catalogues have lower ones, the map of the payload has higher ones."""

PART_OCTETS = 16_000
LABEL_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "diameter_m", "sightings", "looks", "score")
LIMIT_SIGMA_M = 32_000.0


def extended_catalogue(catalogue: CraterCatalogue, landmarks: Sequence[Landmark]) -> CraterCatalogue:
    """Return a catalogue with the accepted landmarks; those that it has already are not added again."""
    new = _new(catalogue.ids.tolist(), landmarks)
    added = make_catalogue(
        np.radians(_column(new, "latitude_deg")),
        np.radians(_column(new, "longitude_deg")),
        _column(new, "diameter_m"),
        source=catalogue.source,
        ids=np.array([FIRST_ID + one.id for one in new], dtype=np.int64),
        rim_height_m=_column(new, "height_m"),
        complete=True,
    )
    return replace(
        catalogue,
        ids=np.concatenate([catalogue.ids, added.ids]),
        latitude_rad=np.concatenate([catalogue.latitude_rad, added.latitude_rad]),
        longitude_rad=np.concatenate([catalogue.longitude_rad, added.longitude_rad]),
        diameter_m=np.concatenate([catalogue.diameter_m, added.diameter_m]),
        rim_height_m=np.concatenate([catalogue.rim_height_m, added.rim_height_m]),
        depth_m=np.concatenate([catalogue.depth_m, added.depth_m]),
        complete=np.concatenate([catalogue.complete, added.complete]),
    )


def extended_table(table: CatalogueTable, landmarks: Sequence[Landmark]) -> CatalogueTable:
    """Return an anchoring table with the accepted landmarks and their uncertainties."""
    new = _new(table.ids.tolist(), landmarks)
    sigma = np.column_stack([_column(new, f"sigma_{axis}_m") for axis in ("east", "north", "up")])
    return CatalogueTable(
        np.concatenate([table.ids, np.array([FIRST_ID + one.id for one in new], dtype=np.int64)]),
        np.concatenate([table.latitude_rad, np.radians(_column(new, "latitude_deg"))]),
        np.concatenate([table.longitude_rad, np.radians(_column(new, "longitude_deg"))]),
        np.concatenate([table.diameter_m, _column(new, "diameter_m")]),
        np.concatenate([table.rim_height_m, _column(new, "height_m")]),
        np.concatenate([table.sigma_m, np.minimum(sigma, LIMIT_SIGMA_M)]),
    )


def format_labels(landmarks: Sequence[Landmark]) -> str:
    """Return CSV of accepted landmarks for `linna detector train --landmarks`."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(LABEL_COLUMNS)
    for one in sorted(_accepted(landmarks), key=lambda found: found.id):
        writer.writerow(
            (
                f"{one.latitude_deg:.6f}", f"{one.longitude_deg % 360.0:.6f}", f"{one.height_m:.0f}",
                f"{one.diameter_m:.0f}", one.sightings, one.looks, f"{one.score:.3f}",
            )
        )  # fmt: skip
    return buffer.getvalue()


def upload_entries(octets: bytes, transaction: int) -> list[tuple[str, dict[str, object]]]:
    """Return names and arguments of the telecommands (PUS 13) that upload an anchoring table."""
    entries = []
    for name, values in split(
        octets, transaction=transaction, table="catalogue", part_length=PART_OCTETS, link="uplink"
    ):
        items = values["items"]
        assert isinstance(items, dict)
        entries.append((name, {**values, "items": [{"octet": octet} for octet in items["octet"].tolist()]}))
    return entries


def _accepted(landmarks: Sequence[Landmark]) -> list[Landmark]:
    return [one for one in landmarks if one.state == "accepted"]


def _new(ids: Sequence[int], landmarks: Sequence[Landmark]) -> list[Landmark]:
    """Return the accepted landmarks that a catalogue with these identities lacks.

    Raises
    ------
    InvalidInput
        No landmark is accepted.
    """
    accepted = _accepted(landmarks)
    if not accepted:
        raise InvalidInput("landmarks", "", "accepted landmarks", f"none among {len(landmarks)}")
    known = set(ids)
    return [one for one in sorted(accepted, key=lambda found: found.id) if FIRST_ID + one.id not in known]


def _column(landmarks: Sequence[Landmark], name: str) -> FloatArray:
    return np.array([getattr(one, name) for one in landmarks], dtype=np.float64)
