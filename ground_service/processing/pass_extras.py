"""What a pass report says beside the errors themselves: the Sun, wrong fixes, and positions from single frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ground_service.processing.alignment import ReferenceStates, error_of_places_rtn_m
from ground_service.processing.drift import navigation_statistics
from ground_service.processing.fixes import Pairs, snapshot_positions, wrong_fixes
from ground_service.processing.samples import NavigationSamples
from lunar.camera import PinholeCamera
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import sun_elevation_azimuth
from reports.values import NavigationSeries

FloatArray = NDArray[np.float64]

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


def with_wrong_fixes(
    series: NavigationSeries, pairs: Pairs, camera: PinholeCamera, track: ReferenceStates
) -> NavigationSeries:
    """The filter's series with the number of its wrong fixes; any other as it is."""
    if series.name != FILTER or len(pairs.frame) == 0:
        return series
    return replace(series, wrong_fixes=wrong_fixes(pairs, camera, track.utc_ns, track.position_mcmf_m))


def snapshot_series(
    pairs: Pairs,
    samples: NavigationSamples,
    camera: PinholeCamera,
    track: ReferenceStates,
    path_m: FloatArray,
) -> NavigationSeries | None:
    """Positions of single frames as a baseline, at the epochs of the filter's states; None without any."""
    if len(pairs.frame) == 0 or len(samples.utc_ns) == 0:
        return None
    believed = mcmf_from_spherical(
        np.radians(samples.latitude_deg), np.radians(samples.longitude_deg), samples.altitude_m
    )
    position = snapshot_positions(pairs, camera, samples.utc_ns, believed)
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
        description="each frame by itself: the filter's identifications and the nadir attitude, no dynamics",
    )
