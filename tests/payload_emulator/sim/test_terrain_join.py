"""Transition from the raster to seeded relief: spectrum, craters, edges, threads."""

import itertools
import threading
from math import log10, pi, radians, sin, sqrt

import numpy as np
from pytest import approx, mark, raises

from lunar.catalogue import load_catalogue, make_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import find_data
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.procedural import ProceduralTerrain

PIXEL_M = radians(MOON_RADIUS_M) / 256.0
BANDS_KM = [*itertools.pairwise((20, 14, 10, 7, 5, 3.5, 2.5, 1.8, 1.3, 0.9, 0.65))]
"""Wavelengths on both sides of the join at 1.8 km; down to 3.5 km the raster itself can be believed."""

BELIEVED = slice(0, 5)
ADDED = slice(7, 10)

PLACES = ((-37, 292), (-5, 291), (-30, 190), (-50, 275))
"""Uplands of both sides and a plain."""


def spectrum(terrain, latitude_deg, longitude_deg):
    """log10 of the power per band along meridians of four degrees, m3."""
    n = 1024
    latitude = np.radians(latitude_deg + 2.0 - np.arange(n) / 256.0)
    longitude = np.radians(longitude_deg - 1.0 + np.arange(0, 512, 8) / 256.0)
    heights = terrain.height_m(latitude[:, None], longitude[None, :])
    ramp = np.polyfit(np.arange(n), heights, 1)
    heights = heights - (ramp[0] * np.arange(n)[:, None] + ramp[1])
    window = np.hanning(n)[:, None]
    power = (np.abs(np.fft.rfft(heights * window, axis=0)) ** 2).mean(axis=1) * 2.0 * PIXEL_M / (window**2).sum()
    wave_km = 1.0 / np.maximum(np.fft.rfftfreq(n, PIXEL_M / 1000.0), 1e-9)
    return np.array([np.log10(power[(wave_km >= a) & (wave_km < b)].mean()) for b, a in BANDS_KM])


@mark.real_data
def test_the_power_spectrum_goes_on_across_the_join(data_path):
    """The Moon's uplands have a Hurst exponent of 0.95 (Rosenburg et al. 2011): a spectrum falling as k^-2.9."""
    data = find_data(data_path)
    middle = np.log10([sqrt(a * b) for a, b in BANDS_KM])
    nearby = {}
    for sharpen in (False, True):
        terrain = open_terrain("raster", data, 1, sharpen=sharpen)
        pooled = np.mean([spectrum(terrain, *place) for place in PLACES], axis=0)
        line = np.polyfit(middle[BELIEVED], pooled[BELIEVED], 1)
        nearby[sharpen] = pooled - np.polyval(line, middle)
    # The raster alone falls to a tenth and less of what its longer waves promise; sharpened it stays within a factor 2.
    assert nearby[False][8:].max() < -1.0
    assert np.abs(nearby[True]).max() < log10(2.0)
    below = np.polyfit(middle[ADDED], pooled[ADDED], 1)
    assert line[0] == approx(2.9, abs=0.6)
    assert below[0] == approx(2.9, abs=0.8)


@mark.real_data
def test_the_density_of_craters_goes_on_across_the_join(data_path):
    """LU1319381 holds 1,319,381 craters from 1 km up over the Moon's 37.93 million km2 (Wang, Wu et al. 2022)."""
    data = find_data(data_path)
    catalogue = load_catalogue(data.catalogue_lu)
    terrain = open_terrain("raster", data, 1)
    counts, area_km2 = np.zeros(2), 0.0
    for latitude in range(-58, 59, 14):
        window = np.radians([latitude, latitude + 2.0]), np.radians([274.0, 298.0])
        small = terrain.small_craters(*window)
        inside = (
            (small.latitude_rad >= window[0][0])
            & (small.latitude_rad < window[0][1])
            & (small.longitude_rad % (2 * pi) >= window[1][0])
            & (small.longitude_rad % (2 * pi) < window[1][1])
        )
        diameter_m = 2.0 * small.radius_rad[inside] * MOON_RADIUS_M
        counts += [np.count_nonzero(diameter_m >= 1000.0), np.count_nonzero(diameter_m >= 500.0)]
        area_km2 += (MOON_RADIUS_M / 1e3) ** 2 * radians(24.0) * (sin(window[0][1]) - sin(window[0][0]))
    of_2km = np.count_nonzero(catalogue.diameter_m >= 2000.0) / (37.93e6 * 53 / 72)
    density = counts / area_km2 + of_2km
    # Density follows the catalogue by place; this strip has more upland than the Moon's mean: within a third.
    assert density[0] == approx(1_319_381 / 37.93e6, rel=0.35)
    # From 1 km to 500 m the number grows as D^-2.2, as it does from 2 km to 1 km: 4.6 times.
    assert density[1] / density[0] == approx(2.0**2.2, rel=0.1)


@mark.real_data
def test_ground_joins_at_tile_edges_and_ends_clearly_beyond_the_tiles(data_path):
    terrain = open_terrain("raster", find_data(data_path), 1)
    # Along 285 and 0 degrees east tiles meet; across, heights run on as they do next to them.
    latitude = np.radians(np.linspace(21.0, 24.0, 300))
    for edge_deg in (285.0, 360.0 + 15.0):
        step = radians(0.25 / 256.0)
        edge = radians(edge_deg)
        across = terrain.height_m(latitude, edge + step) - terrain.height_m(latitude, edge - step)
        nearby = terrain.height_m(latitude, edge + 9 * step) - terrain.height_m(latitude, edge + 7 * step)
        assert np.sqrt(np.mean(across**2)) < 1.5 * np.sqrt(np.mean(nearby**2)) + 0.2
    assert terrain.covers(np.radians([59.9, 60.1, -59.9]), np.radians(290.0)).tolist() == [True, False, True]
    # The coarse model fills in beyond 60 degrees; nobody has the pole.
    assert np.isfinite(terrain.height_m(radians(60.3), radians(290.0)))
    with raises(TerrainError, match="expected latitudes within 84 deg, found -88"):
        terrain.height_m(radians(-88.0), 0.0)


def test_a_terrain_belongs_to_one_thread():
    none = make_catalogue([], [], [], source="none")
    terrain = ProceduralTerrain(3, catalogue=none)
    here = terrain.height_m(0.1, 0.2)
    caught = []

    def ask():
        try:
            terrain.height_m(0.1, 0.2)
        except TerrainError as error:
            caught.append(str(error))
        # One of its own gives the same bits.
        caught.append(ProceduralTerrain(3, catalogue=none).height_m(0.1, 0.2))

    other = threading.Thread(target=ask, name="second")
    other.start()
    other.join()
    assert "another (second): open a terrain for each thread" in caught[0]
    assert caught[1] == here == terrain.height_m(0.1, 0.2)
