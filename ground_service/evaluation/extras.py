"""Additional contents of a pass report: Sun geometry, ground track, wrong fixes, and positions from single frames."""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import InvalidInput
from ground_service.evaluation.alignment import ReferenceStates, error_of_places_rtn_m, navigation_statistics
from ground_service.evaluation.fixes import Pairs, snapshot_positions, wrong_fixes
from ground_service.evaluation.recall import Viewing
from ground_service.telemetry.samples import NavigationSamples
from kernels import made_once
from lunar.arrays import FloatArray
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import sun_elevation_azimuth
from reports.values import NavigationSeries, TerrainMap

SNAPSHOT = "snapshot"
FILTER = "anchored"


@dataclass(frozen=True, slots=True, eq=False)
class SunAngles:
    """Elevation and azimuth (from north, clockwise) of the Sun at the sub-satellite points (n,), degrees."""

    elevation_deg: FloatArray
    azimuth_deg: FloatArray


def sun_angles(track: ReferenceStates) -> SunAngles:
    """The Sun along the reference; NaN where that does not cover."""
    sun = np.asarray(sun_position_icrf_m(np.asarray(tdb_s_from_utc_ns(track.utc_ns))))
    elevation, azimuth = sun_elevation_azimuth(
        track.latitude_rad, track.longitude_rad, np.einsum("nij,nj->ni", track.mcmf_from_icrf, sun)
    )
    return SunAngles(np.degrees(elevation), np.degrees(azimuth))


def with_sun(series: NavigationSeries, track: ReferenceStates, sun: SunAngles) -> NavigationSeries:
    """The series with the Sun's elevation at its samples, which are all times of the track that `sun` is of."""
    rows = np.searchsorted(track.utc_ns, series.utc_ns)
    return replace(series, sun_elevation_deg=sun.elevation_deg[rows])


def with_terrain(series: NavigationSeries, track: ReferenceStates, surface: TerrainMap) -> NavigationSeries:
    """The series with the kind of ground under its samples, "" where the reference does not cover.

    Mare is what is darker than the grey value that best parts the whole map in two (Otsu 1979, by area).
    """
    rows = np.searchsorted(track.utc_ns, series.utc_ns)
    latitude, longitude = track.latitude_deg[rows], track.longitude_deg[rows]
    known = np.isfinite(latitude) & np.isfinite(longitude)
    height, width = surface.image.shape
    down = (surface.north_deg - latitude[known]) / (surface.north_deg - surface.south_deg) * height
    right = (longitude[known] - surface.west_deg) % 360.0 / (surface.east_deg - surface.west_deg) * width
    grey = surface.image[np.clip(down.astype(np.int64), 0, height - 1), np.clip(right.astype(np.int64), 0, width - 1)]
    kinds = np.full(len(rows), "", dtype="<U8")
    kinds[known] = np.where(grey < dark_limit(surface), "mare", "highland")
    return replace(series, terrain=tuple(kinds.tolist()))


def dark_limit(surface: TerrainMap) -> float:
    """The grey value that parts a map in two with the least spread on either side, each pixel weighed by its area.

    References
    ----------
    Otsu (1979), A threshold selection method from gray-level histograms, IEEE Trans. SMC 9, equation 18.
    """
    rows = surface.image.shape[0]
    step = (surface.north_deg - surface.south_deg) / rows
    area = np.cos(np.radians(surface.north_deg - (np.arange(rows) + 0.5) * step))
    share = np.zeros(256)
    for row, weight in zip(surface.image, area, strict=True):
        share += weight * np.bincount(row, minlength=256)
    share /= share.sum()
    dark = np.cumsum(share)
    below = np.cumsum(share * np.arange(256))
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (below[-1] * dark - below) ** 2 / (dark * (1.0 - dark))
    return float(np.nanargmax(np.where(np.isfinite(between), between, -1.0)) + 1)


def with_wrong_fixes(
    series: NavigationSeries, pairs: Pairs, viewing: Viewing, track: ReferenceStates
) -> NavigationSeries:
    """The filter's series with the number of its wrong fixes; any other as it is."""
    if series.name != FILTER or len(pairs.frame) == 0:
        return series
    rotations = viewing.camera_from_mcmf(track.utc_ns, track.position_mcmf_m, track.mcmf_from_icrf)
    return replace(
        series, wrong_fixes=wrong_fixes(pairs, viewing.camera, track.utc_ns, track.position_mcmf_m, rotations)
    )


def snapshot_series(
    pairs: Pairs, samples: NavigationSamples, viewing: Viewing, track: ReferenceStates, path_m: FloatArray
) -> NavigationSeries | None:
    """Positions of single frames as a baseline, at the epochs of the filter's states; None without any."""
    if len(pairs.frame) == 0 or len(samples.utc_ns) == 0:
        return None
    believed = mcmf_from_spherical(
        np.radians(samples.latitude_deg), np.radians(samples.longitude_deg), samples.altitude_m
    )
    every = track.at_rows(np.searchsorted(track.utc_ns, samples.utc_ns))
    known = viewing.known(samples.utc_ns)
    rotations = viewing.camera_from_mcmf(samples.utc_ns, every.position_mcmf_m, every.mcmf_from_icrf)
    rotations[~known] = np.nan
    position = snapshot_positions(pairs, viewing.camera, samples.utc_ns, believed, viewing.pointed, rotations)
    solved = np.flatnonzero(np.isfinite(position[:, 0]))
    if len(solved) == 0:
        return None
    latitude, longitude, altitude = spherical_from_mcmf(position[solved])
    rows = np.searchsorted(track.utc_ns, samples.utc_ns[solved])
    here = track.at_rows(rows)
    latitude_deg, longitude_deg = np.degrees(latitude), np.degrees(longitude) % 360.0
    error = error_of_places_rtn_m(here, latitude_deg, longitude_deg, altitude)
    return NavigationSeries(
        name=SNAPSHOT,
        kind="baseline",
        utc_ns=samples.utc_ns[solved],
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=altitude,
        error_rtn_m=error,
        # Frames know nothing of one another: each is a fix of its own, and there is no drift to speak of.
        statistics=navigation_statistics(error, path_m[rows], np.ones(len(solved), dtype=np.bool_)),
        description="each frame separately, from the filter's identifications and the attitude, without dynamics",
    )


WIDTH_PX = 2048


@lru_cache(maxsize=2)
def albedo_picture(path: Path) -> NDArray[np.uint8]:
    """Grey values (1024, 2048), -180 to 180 degrees east, 90 to -90 north; kept on disk by the hash of the file.

    Raises
    ------
    InvalidInput
        If the file is no picture.
    """
    try:
        octets = path.read_bytes()
    except OSError:
        octets = b""
    name = f"figure-albedo-{hashlib.sha256(octets + Path(__file__).read_bytes()).hexdigest()}"
    levels = made_once(name, lambda: _grey_levels(path, octets).tobytes())
    return np.frombuffer(levels, np.uint8).reshape(WIDTH_PX // 2, WIDTH_PX)


def _grey_levels(path: Path, octets: bytes) -> NDArray[np.uint8]:
    import cv2

    grey = cv2.imdecode(np.frombuffer(octets, np.uint8), cv2.IMREAD_GRAYSCALE) if octets else None
    if grey is None:
        raise InvalidInput(str(path), "", "an albedo map as a picture", "a file that cannot be read as one")
    small = cv2.resize(grey, (WIDTH_PX, WIDTH_PX // 2), interpolation=cv2.INTER_AREA).astype(np.float32)
    low, high = np.percentile(small, (0.5, 99.5))
    stretched = np.clip((small - low) / max(float(high - low), 1.0), 0.0, 1.0)
    return np.asarray(np.rint(40.0 + 180.0 * stretched), dtype=np.uint8)


def surface_map(path: Path) -> TerrainMap:
    """The albedo as the ground of a report's maps, 0 to 360 degrees east."""
    picture = np.roll(albedo_picture(path), WIDTH_PX // 2, axis=1)
    return TerrainMap(picture, 0.0, 360.0, -90.0, 90.0, source="the albedo of the Moon")
