"""Contacts of stations: against the geometry in local horizon coordinates by pymap3d, handover, outages."""

import itertools

import numpy as np
from numpy import cos, pi, radians, sin
from numpy.linalg import norm
from pytest import approx, fixture, mark, raises

from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.sim.board.contact_plan import parse_outage, plan_contacts
from payload_emulator.sim.board.link import STATIONS, LinkSection
from tests.lazy import Lazy

NS = 1_000_000_000
START = parse_utc("2029-08-07T00:00:00Z")
STOP = START + 24 * 3600 * NS
SPEED_OF_LIGHT_M_S = 299_792_458.0


@fixture(scope="module")
def ephemeris():
    """A circular polar orbit of 1768 km about the Moon, 111 minutes, whose plane holds the line to the Earth."""
    times = np.arange(START - 600 * NS, STOP + 600 * NS, 30 * NS)
    angle = 2.0 * pi * (times - START) / (6_672.0 * NS)
    toward = np.asarray(earth_position_icrf_m(float(tdb_s_from_utc_ns(START))))
    first = toward / norm(toward)
    second = np.array([0.0, 0.0, 1.0]) - first[2] * first
    second /= norm(second)
    rate = 2.0 * pi / 6_672.0
    position = 1.768e6 * (cos(angle)[:, None] * first + sin(angle)[:, None] * second)
    velocity = 1.768e6 * rate * (-sin(angle)[:, None] * first + cos(angle)[:, None] * second)
    return Ephemeris((EphemerisSegment(times, position, velocity, object_name="A", object_id="A", degree=7),))


def elevation_deg(ephemeris, utc_ns, station):
    """Elevation by pymap3d, with the sidereal time of Meeus 1998, equation 12.4, and no precession."""
    position, _ = ephemeris.at(np.array([utc_ns]))
    from_earth = position[0] - np.asarray(earth_position_icrf_m(float(tdb_s_from_utc_ns(utc_ns))))
    days = utc_ns / NS / 86_400.0 + 2_440_587.5 - 2_451_545.0
    sidereal = radians((280.46061837 + 360.98564736629 * days) % 360.0)
    cosine, sine = cos(sidereal), sin(sidereal)
    x, y, z = from_earth
    latitude, longitude, height = STATIONS[station]
    _, elevation, _ = Lazy("pymap3d").ecef2aer(
        cosine * x + sine * y, cosine * y - sine * x, z, latitude, longitude, height
    )
    return float(elevation)


@mark.parametrize("station", ["goldstone", "canberra"])
def test_contacts_are_where_pymap3d_sees_the_spacecraft_above_the_lowest_elevation(ephemeris, station):
    plan = plan_contacts(ephemeris, LinkSection(stations=(station,)), START, STOP)
    assert plan
    inside = np.zeros(1440, bool)
    minutes = START + np.arange(1440) * 60 * NS
    for one in plan:
        inside |= (minutes >= one.start_utc_ns) & (minutes < one.stop_utc_ns)
    hidden = 0
    for utc_ns, seen in zip(minutes.tolist(), inside.tolist(), strict=True):
        elevation = elevation_deg(ephemeris, utc_ns, station)
        if seen:
            assert elevation > 9.5  # precession since 2000 is 0.4 deg
        elif elevation > 10.5:
            position = ephemeris.at(np.array([utc_ns]))[0][0]
            earth = np.asarray(earth_position_icrf_m(float(tdb_s_from_utc_ns(utc_ns))))
            toward = earth / norm(earth)
            across = position - (position @ toward) * toward
            # Behind the Moon: beyond its centre as seen from the Earth, and within its disc.
            assert position @ toward < 0.0 and norm(across) < 1.75e6
            hidden += 1
    assert hidden > 60


def test_one_station_at_a_time_has_the_contact_at_the_light_time_of_its_range_cut_by_outages(ephemeris):
    plan = plan_contacts(ephemeris, LinkSection(stations=("goldstone", "madrid", "canberra")), START, STOP)
    assert {one.station for one in plan} == {"goldstone", "madrid", "canberra"}
    for earlier, later in itertools.pairwise(plan):
        assert earlier.stop_utc_ns <= later.start_utc_ns
    assert any(
        earlier.stop_utc_ns == later.start_utc_ns and earlier.station != later.station
        for earlier, later in itertools.pairwise(plan)
    )
    contact = plan_contacts(ephemeris, LinkSection(stations=("madrid",)), START, STOP)[0]
    utc_ns = contact.start_utc_ns + 137 * NS
    position = ephemeris.at(np.array([utc_ns]))[0][0]
    centre_s = norm(position - np.asarray(earth_position_icrf_m(float(tdb_s_from_utc_ns(utc_ns))))) / SPEED_OF_LIGHT_M_S
    # At elevation e the station is R sin(e) nearer than the centre of the Earth: here near 10 deg.
    expected = centre_s - 6.371e6 * sin(radians(elevation_deg(ephemeris, utc_ns, "madrid"))) / SPEED_OF_LIGHT_M_S
    assert contact.light_s(utc_ns) == approx(expected, abs=3e-4)
    whole = plan_contacts(ephemeris, LinkSection(stations=("madrid",)), START, STOP)[0]
    assert whole.stop_utc_ns - whole.start_utc_ns > 1800 * NS
    cut = LinkSection(stations=("madrid",), outages=("madrid 2029-08-07T00:00:00Z 2029-08-07T23:59:59Z",))
    assert not plan_contacts(ephemeris, cut, START, STOP - NS)
    other = LinkSection(stations=("madrid",), outages=("canberra 2029-08-07T00:00:00Z 2029-08-07T23:59:59Z",))
    assert plan_contacts(ephemeris, other, START, STOP)[0].stop_utc_ns == whole.stop_utc_ns


@mark.parametrize(
    "text",
    [
        "madrid", "paris 2029-08-07T00:00:00Z 2029-08-08T00:00:00Z", "madrid tomorrow 2029-08-08T00:00:00Z",
        "madrid 2029-08-08T00:00:00Z 2029-08-07T00:00:00Z"
    ]
)  # fmt: skip
def test_an_outage_in_another_form_is_refused(text):
    with raises(ScenarioError, match=r"link\.outages: expected"):
        parse_outage(text)
