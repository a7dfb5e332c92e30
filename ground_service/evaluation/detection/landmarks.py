"""Landmarks that the payload mapped itself, compared with the ground's catalogue.

Landmarks that are catalogued craters show the quality of the map: its offset, and whether the claimed sigma
covers it. The others are new: candidates for the next anchoring catalogue. Frame: mean-Earth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_service.evaluation.detection.fixes import IdentificationSamples
from lunar.arrays import FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from reports.values import PayloadMap
from tmtc.dictionary.schema import Table

LOG_DIAMETER_GATE = 0.4
"""Largest difference of the logarithms of mapped and catalogued diameter."""

SIGMAS = 5.0
"""A catalogued crater is looked for within so many sigma, and at least half a radius."""

FIRST_LANDMARK_ID = 3_000_000_000
"""In the pairs of fixes the payload's own landmarks have identities from here on."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedCraters:
    """Landmarks as they came down: arrays of one length, sigma east, north, up (n, 3).

    `passes` is on how many passes each had been mapped by then.
    """

    landmark_id: IntArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    height_m: FloatArray
    diameter_m: FloatArray
    sigma_m: FloatArray
    passes: IntArray

    def __len__(self) -> int:
        return len(self.landmark_id)


@dataclass(frozen=True, slots=True, eq=False)
class MapComparison:
    """What the catalogue says of a map.

    Attributes
    ----------
    crater
        Row in the catalogue of each landmark, -1 for a new one, shape (n,).
    offset_m
        Landmark minus catalogue, east, north, up, shape (n, 3); NaN for new ones and unknown heights.
    median_horizontal_m, median_offset_m
        Over the known ones: of the distance, and of east, north, up; NaN without any.
    normalised_square
        Mean of the squares of east and north over the claimed sigma: 1 where the claims hold.
    """

    crater: IntArray
    offset_m: FloatArray
    median_horizontal_m: float
    median_offset_m: tuple[float, float, float]
    normalised_square: float

    @property
    def known(self) -> int:
        return int(np.count_nonzero(self.crater >= 0))


def mapped_craters(reports: Table | None) -> MappedCraters:
    """Return all reports of landmarks in the order in which they came; none without packets."""
    items = {} if reports is None else reports.items

    def column(name: str) -> FloatArray:
        return np.asarray(items.get(name, np.empty(0)), dtype=np.float64)

    return MappedCraters(
        column("landmark_id").astype(np.int64),
        column("latitude_deg"),
        column("longitude_deg"),
        column("height_m"),
        column("diameter_m"),
        np.stack([column(f"sigma_{axis}_m") for axis in ("east", "north", "up")], axis=1),
        column("passes").astype(np.int64),
    )


def latest(mapped: MappedCraters) -> MappedCraters:
    """Return the last report of each landmark; reports are in the order in which they were made."""
    _, first = np.unique(mapped.landmark_id[::-1], return_index=True)
    rows = np.sort(len(mapped) - 1 - first)
    return MappedCraters(
        mapped.landmark_id[rows],
        mapped.latitude_deg[rows],
        mapped.longitude_deg[rows],
        mapped.height_m[rows],
        mapped.diameter_m[rows],
        mapped.sigma_m[rows],
        mapped.passes[rows],
    )


def compare_map(mapped: MappedCraters, catalogue: CraterCatalogue) -> MapComparison:
    """Return which landmarks are catalogued, and their offsets; each crater is matched to at most one landmark."""
    count = len(mapped)
    crater, offset = np.full(count, -1, dtype=np.int64), np.full((count, 3), np.nan)
    distance = np.full(count, np.inf)
    latitude, longitude = np.radians(mapped.latitude_deg), np.radians(mapped.longitude_deg)
    for k in range(count):
        reach_m = max(SIGMAS * float(mapped.sigma_m[k, :2].max()), 0.25 * float(mapped.diameter_m[k]))
        near = catalogue.near(float(latitude[k]), float(longitude[k]), reach_m)
        alike = np.abs(np.log(catalogue.diameter_m[near] / mapped.diameter_m[k])) < LOG_DIAMETER_GATE
        near = near[alike]
        if not near.size:
            continue
        turn = np.mod(longitude[k] - catalogue.longitude_rad[near] + np.pi, 2.0 * np.pi) - np.pi
        east = MOON_RADIUS_M * turn * np.cos(latitude[k])
        north = MOON_RADIUS_M * (latitude[k] - catalogue.latitude_rad[near])
        best = int(np.argmin(np.hypot(east, north)))
        crater[k], distance[k] = near[best], float(np.hypot(east[best], north[best]))
        up = mapped.height_m[k] - catalogue.rim_height_m[near[best]]
        offset[k] = east[best], north[best], up
    for row in np.unique(crater[crater >= 0]):
        claimants = np.flatnonzero(crater == row)
        losers = claimants[claimants != claimants[np.argmin(distance[claimants])]]
        crater[losers], offset[losers] = -1, np.nan
    known = crater >= 0
    if not known.any():
        nan = float("nan")
        return MapComparison(crater, offset, nan, (nan, nan, nan), nan)
    heights = offset[known, 2][np.isfinite(offset[known, 2])]
    ratio = offset[known, :2] / mapped.sigma_m[known, :2]
    return MapComparison(
        crater,
        offset,
        float(np.median(np.hypot(offset[known, 0], offset[known, 1]))),
        (
            float(np.median(offset[known, 0])),
            float(np.median(offset[known, 1])),
            float(np.median(heights)) if heights.size else float("nan"),
        ),
        float(np.mean(ratio**2)),
    )


def payload_map(
    reports: MappedCraters | None,
    identifications: IdentificationSamples | None,
    catalogue: CraterCatalogue | None,
) -> PayloadMap | None:
    """Return what a report says of the payload's map; None where nothing of it came down."""
    if reports is None or not len(reports):
        return None
    mapped = latest(reports)
    pairs = np.empty(0, dtype=np.int64) if identifications is None else identifications.crater_id
    own = pairs[pairs >= FIRST_LANDMARK_ID]
    offset = sigma = np.empty((0, 2))
    nan = float("nan")
    median, ratio = (nan, nan, nan), nan
    known = 0
    if catalogue is not None:
        result = compare_map(mapped, catalogue)
        found = result.crater >= 0
        known, median, ratio = result.known, result.median_offset_m, result.normalised_square
        offset, sigma = result.offset_m[found, :2], mapped.sigma_m[found, :2]
    return PayloadMap(
        mapped=len(mapped),
        mapped_again=int(np.count_nonzero(mapped.passes >= 2)),
        used=int(np.unique(own).size),
        pairs=int(own.size),
        pairs_of_all=int(pairs.size),
        catalogued=known,
        offset_m=offset,
        sigma_m=sigma,
        median_offset_m=median,
        normalised_square=ratio,
        source="" if catalogue is None else catalogue.source,
    )
