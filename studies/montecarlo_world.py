"""Worlds for Monte Carlo runs: gravity fields to any degree, craters of the paper's density, tracks.

The process noise of the filter is tuned on the track `tuning` only. The other tracks are held out.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from lunar.catalogue import CraterCatalogue, make_catalogue
from lunar.constants import MOON_RADIUS_M, NS
from lunar.datafolder import DataFolder
from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation
from lunar.gravity import GravityField, builtin_gravity, load_gravity
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.filter.dynamics import process_noise
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule
from payload_emulator.sim.detector import SimulatedDetector
from studies.montecarlo import CatalogueErrors, NavigationCase

Track = Literal["test", "tuning", "inclined", "limb"]
TRACKS: tuple[Track, ...] = get_args(Track)

# Kaula's rule for the Moon: size of a normalised coefficient of degree n is this over n squared.
KAULA = 2.5e-4
_TRUTH_DEGREE, _FILTER_DEGREE = 150, 100
# Craters of 5 to 30 km per square metre, and the slope of their cumulative size distribution (the paper's counts).
_DENSITY_M2, _SIZE_SLOPE = 2.09e-9, -1.77


@dataclass(frozen=True, slots=True)
class TrackOrbit:
    """Orbit of Monte Carlo runs, as elements at an epoch in the Moon's equator of date.

    Attributes
    ----------
    angles_deg
        Inclination, node, argument of perilune, true anomaly.
    node_longitudes_deg
        Range of longitudes of the ascending node from which each run draws one; None for any.
    """

    epoch: str
    semi_major_m: float
    eccentricity: float
    angles_deg: tuple[float, float, float, float]
    node_longitudes_deg: tuple[float, float] | None = None


_TRACKS: dict[Track, TrackOrbit] = {
    # The paper's orbit: 19 to 43 km.
    "test": TrackOrbit("2029-08-07T00:00:00Z", 1_768_180.0, 0.006908, (89.076, 3.164, 333.604, 8.882)),
    # Another inclination, perilune and time: images from 19 km on.
    "tuning": TrackOrbit("2029-09-16T06:00:00Z", 1_768_180.0, 0.006908, (86.5, 121.0, 210.0, 80.0)),
    # Inclined by 60 degrees, nearly circular: 25 to 34 km.
    "inclined": TrackOrbit("2029-11-02T12:00:00Z", 1_767_000.0, 0.0025, (60.0, 200.0, 20.0, 300.0)),
    # Higher, and over the limbs as seen from the Earth, where a field without far-side tracking is accurate: 34 to 62
    # km.
    "limb": TrackOrbit("2030-01-15T18:00:00Z", 1_785_400.0, 0.008, (80.0, 30.0, 150.0, 190.0), (75.0, 105.0)),
}


def rough_gravity(degree: int) -> GravityField:
    """The built-in field continued with random coefficients of the size that the Moon's have."""
    known = builtin_gravity()
    rng = np.random.default_rng(3)
    n = np.arange(degree + 1)
    size = np.where(n > known.degree, KAULA / np.maximum(n, 1) ** 2, 0.0)[:, None]
    c_bar = np.tril(rng.standard_normal((degree + 1, degree + 1))) * size
    s_bar = np.tril(rng.standard_normal((degree + 1, degree + 1)), -1) * size
    s_bar[:, 0] = 0.0
    k = known.degree + 1
    c_bar[:k, :k], s_bar[:k, :k] = known.c_bar, known.s_bar
    return GravityField("rough", known.gm_m3_s2, known.radius_m, c_bar, s_bar)


def crater_world() -> CraterCatalogue:
    """Craters of 5 to 30 km, uniform on the sphere at the paper's density, with heights of two kilometres' range."""
    rng = np.random.default_rng(11)
    count = int(4.0 * np.pi * MOON_RADIUS_M**2 * _DENSITY_M2)
    z, longitude = rng.uniform(-1.0, 1.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    diameter = 5e3 * (1.0 - rng.uniform(size=count) * (1.0 - 6.0**_SIZE_SLOPE)) ** (1.0 / _SIZE_SLOPE)
    height = 1_500.0 * np.sin(3.0 * longitude) * z + 500.0 * rng.standard_normal(count)
    return make_catalogue(np.arcsin(z), longitude, diameter, source="simulated", rim_height_m=height)


def standard_case(data: DataFolder, track: Track, hours: float, catalogued: float = 1.0) -> NavigationCase:
    """Return the case of a track: start errors of 5 km and 5 m/s, a frame every 15 s.

    Each revolution has two imaging arcs of 37 minutes.

    Each run has another ascending node: over the same ground, all runs would have the same gravity errors, and their
    average would represent a single sample.

    The truth uses GRAIL to degree 150 and the filter Lunar Prospector's field to degree 100, if both are available;
    otherwise a synthetic field with the same truncation. Every error that the filter models is drawn with the size and
    correlation time that the filter assumes.

    Parameters
    ----------
    catalogued
        Share of the craters that the uploaded catalogue holds. The payload maps the others, and uses them one
        revolution (1.85 hours) later, when most of the ground in view is the same.
    """
    if data.gravity is not None and data.gravity_alternative is not None:
        gravity, other = load_gravity(data.gravity), load_gravity(data.gravity_alternative)
    else:
        gravity = other = rough_gravity(_TRUTH_DEGREE)
    orbit = _TRACKS[track]
    epoch_utc_ns = parse_utc(orbit.epoch)
    inclination, node, perilune, anomaly = (float(value) for value in np.radians(orbit.angles_deg))
    position, velocity = icrf_state_from_elements(
        Elements(orbit.semi_major_m, orbit.eccentricity, inclination, node, perilune, anomaly),
        float(tdb_s_from_utc_ns(epoch_utc_ns)),
        gravity.gm_m3_s2,
    )
    parameters = AnchoredParameters(gravity_degree=_FILTER_DEGREE, offset=OffsetRule())
    errors, shipped = parameters.errors, process_noise(_FILTER_DEGREE, other.name)
    frames = round(hours * 240.0)
    # Two arcs of 37 minutes in each period of 111, with gaps of 18 over the poles.
    elapsed_s = np.arange(frames) * 15.0
    craters = crater_world()
    return NavigationCase(
        epoch_utc_ns=epoch_utc_ns,
        position_icrf_m=position,
        velocity_icrf_m_s=velocity,
        frame_utc_ns=epoch_utc_ns + np.arange(frames) * 15 * NS,
        imaging=elapsed_s % 3_336.0 < 2_226.0,
        gravity=gravity,
        gravity_degree=min(_TRUTH_DEGREE, gravity.degree),
        orientation=IauOrientation(),
        filter_gravity=other.truncated(_FILTER_DEGREE),
        filter_orientation=IauOrientation(),
        craters=craters,
        on_board=np.random.default_rng(12).uniform(size=len(craters)) < catalogued,
        any_node=True,
        node_longitudes_deg=orbit.node_longitudes_deg,
        detector=SimulatedDetector(
            persistence=parameters.detection_persistence,
            bias_sigma_px=errors.pixel_bias_px,
            bias_correlation_s=errors.pixel_correlation_s,
            scale_sigma=errors.scale_sigma,
        ),
        catalogue_errors=CatalogueErrors(
            regional_sigma_m=errors.catalogue_offset_m, regional_rad=errors.catalogue_correlation_rad
        ),
        start_position_m=5_000.0,
        start_velocity_m_s=5.0,
        attitude_noise_rad=errors.attitude_noise_rad,
        attitude_bias_rad=errors.attitude_bias_rad,
        attitude_correlation_s=errors.attitude_correlation_s,
        lasting_m_s2=shipped.markov_sigma_m_s2,
        lasting_correlation_s=shipped.correlation_s,
        parameters=replace(parameters, noise=shipped),
    )
