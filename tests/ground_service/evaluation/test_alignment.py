"""Errors against a reference over a Moon that turns at a rate of its own, with every place worked out by hand."""

import math
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark

from ground_service.evaluation.alignment import (
    ReferenceStates,
    angle_from_meridian_deg,
    error_of_places_rtn_m,
    error_of_positions_rtn_m,
    ground_path_m,
    places_of_positions,
    reference_states,
)
from ground_service.evaluation.core import _not_applicable
from lunar.ephemeris import ephemeris_from_states
from lunar.timescales import parse_utc, tdb_s_from_utc_ns

EPOCH = parse_utc("2029-08-07T00:00:00Z")
START_S = float(tdb_s_from_utc_ns(EPOCH))
MOON_M = 1_737_400.0
RADIUS_M, SPEED_M_S = 1_787_400.0, 1_600.0
TURN_RAD_S = 1e-4


class Turning:
    """Mean-Earth axes turn about the pole, from those of ICRF at the epoch."""

    name = "turning"

    def mcmf_from_icrf(self, tdb_s):
        angle = TURN_RAD_S * (np.asarray(tdb_s, dtype=np.float64) - START_S)
        c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
        rows = [[c, s, zero], [-s, c, zero], [zero, zero, one]]
        return np.moveaxis(np.array(rows), (0, 1), (-2, -1))

    def pa_from_icrf(self, tdb_s):
        return self.mcmf_from_icrf(tdb_s)


def polar():
    """A circle over the poles in the plane of the x and z axes, at a steady angle."""
    seconds = np.arange(0.0, 601.0, 10.0)
    angle = SPEED_M_S / RADIUS_M * seconds
    zero = np.zeros_like(angle)
    outward = np.stack([np.cos(angle), zero, np.sin(angle)], axis=1)
    ahead = np.stack([-np.sin(angle), zero, np.cos(angle)], axis=1)
    return ephemeris_from_states(EPOCH + (seconds * 1e9).astype(np.int64), RADIUS_M * outward, SPEED_M_S * ahead)


def after(*seconds):
    return EPOCH + (np.array(seconds) * 1e9).astype(np.int64)


def flown(*seconds):
    return reference_states(polar(), Turning(), after(*seconds))


def test_the_reference_has_its_place_over_the_turned_moon():
    track = flown(0.0, 105.0, 600.0)
    angle = SPEED_M_S / RADIUS_M * np.array([0.0, 105.0, 600.0])
    assert track.covered.all()
    assert_allclose(track.latitude_deg, np.degrees(angle), atol=1e-9)
    # The ground turns to the east below it: 1e-4 rad/s over 105 and 600 s.
    assert_allclose(track.longitude_deg, [0.0, 360.0 - math.degrees(0.0105), 360.0 - math.degrees(0.06)])
    assert_allclose(track.altitude_m, 50_000.0, atol=1e-4)
    assert_allclose(np.linalg.norm(track.velocity_icrf_m_s, axis=1), SPEED_M_S, atol=1e-6)


def test_epochs_outside_or_without_a_reference_or_an_orientation_have_no_state():
    track = flown(-1.0, 0.0, 601.0)
    assert track.covered.tolist() == [False, True, False]
    _, _, *names = ReferenceStates.__slots__
    for values in (getattr(track, name) for name in names):
        assert np.isnan(values[[0, 2]]).all() and np.isfinite(values[1]).all()
    for given in (polar(), None), (None, Turning()), (None, None):
        track = reference_states(*given, after(0.0, 10.0))
        assert track.covered.tolist() == [False, False]
        assert track.position_icrf_m.shape == (2, 3) and track.mcmf_from_icrf.shape == (2, 3, 3)
        assert np.isnan(track.position_icrf_m).all() and np.isnan(track.altitude_m).all()
        assert track.utc_ns.tolist() == after(0.0, 10.0).tolist()


def test_rows_of_a_track_are_those_rows_of_all_of_it_and_no_epochs_are_no_error():
    track = flown(0.0, 100.0, 200.0)
    some = track.at_rows(np.array([2, 0]))
    for name in ReferenceStates.__slots__:
        assert_array_equal(getattr(some, name), getattr(track, name)[[2, 0]])
    none = flown()
    assert none.position_mcmf_m.shape == (0, 3) and ground_path_m(none, MOON_M).shape == (0,)


def test_an_error_of_place_splits_along_the_orbit():
    """Northward flight over the turned Moon: radial is up, transverse north and normal west."""
    track = flown(300.0, 300.0, 300.0)
    latitude, longitude = track.latitude_deg[0], track.longitude_deg[0]
    step, unit = 1e-3, np.eye(3)
    error = error_of_places_rtn_m(
        track, latitude + step * unit[1], longitude + step * unit[2], 50_000.0 + 70.0 * unit[0]
    )
    along = RADIUS_M * math.radians(step)
    expected = [[70.0, 0.0, 0.0], [0.0, along, 0.0], [0.0, 0.0, -along * math.cos(math.radians(latitude))]]
    # The chord of 31 m sinks below the sphere by 0.3 mm.
    assert_allclose(error, expected, atol=1e-3)


def test_an_error_of_position_is_estimate_minus_reference_and_its_place_is_found():
    track = flown(0.0)
    # At the epoch radial is x, transverse z and normal -y.
    position = track.position_icrf_m + np.array([[5.0, 7.0, 11.0]])
    assert_allclose(error_of_positions_rtn_m(track, position), [[5.0, 11.0, -7.0]], atol=1e-6)
    latitude, longitude, altitude = places_of_positions(track, np.array([[0.0, -2e6, 0.0]]))
    assert (latitude[0], longitude[0], altitude[0]) == approx((0.0, 270.0, 2e6 - MOON_M))
    longitude = places_of_positions(flown(600.0), np.array([[2e6, 0.0, 0.0]]))[1]
    assert longitude[0] == approx(360.0 - math.degrees(0.06))


def test_the_ground_path_is_the_arc_over_the_moon_that_does_not_turn_back_also_a_quarter_round():
    """Over the still Moon 1.6 km/s at 1787.4 km; the turning ground adds 174 m/s across, less toward the pole."""
    track = flown(0.0, 10.0, 20.0, 40.0)
    path = ground_path_m(track, MOON_M)
    north, east = SPEED_M_S * MOON_M / RADIUS_M, TURN_RAD_S * MOON_M
    # The cosine of 2 degrees is 0.9994; the chords of 20 s cut off nothing that counts.
    assert_allclose(path, np.hypot(north, east) * np.array([0.0, 10.0, 20.0, 40.0]), rtol=2e-5)
    assert_allclose(ground_path_m(track, 1.0), path / MOON_M, rtol=1e-12)
    place = np.array([[2e6, 0.0, 0.0], [0.0, 5e6, 0.0], [0.0, -1e6, 0.0]])
    track = replace(flown(0.0, 1.0, 2.0), position_mcmf_m=place)
    assert_allclose(ground_path_m(track, 2.0), [0.0, math.pi, 3.0 * math.pi])


@mark.parametrize("angle_deg", [0.0, 4.0, 4.2, 50.0, 130.0])
def test_the_angle_of_the_track_with_the_meridian_is_that_of_the_velocity(angle_deg):
    states = flown(10.0, 60.0)
    angle = math.radians(angle_deg)
    normal = np.cross(states.position_icrf_m, states.velocity_icrf_m_s)
    normal *= SPEED_M_S / np.linalg.norm(normal, axis=1, keepdims=True)
    turned = math.cos(angle) * states.velocity_icrf_m_s + math.sin(angle) * normal
    track = replace(states, velocity_icrf_m_s=turned)
    assert angle_from_meridian_deg(track) == approx(min(angle_deg, 180.0 - angle_deg), abs=1e-6)
    # The paper's matching finds no motion from 4.1 degrees on.
    refused = [bool(_not_applicable(name, track)) for name in ("paper", "spherical", "anchored")]
    assert refused == [angle_deg > 4.1, angle_deg > 4.1, False]
