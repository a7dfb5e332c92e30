"""Contacts from the geometry of a station, and decisions of a link."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx, fixture

from ground_service.contacts.links.core import (
    BLOCK_NS,
    CLOCK_LIMIT_S,
    PredictedContact,
    clock_fault,
    contact_at,
    is_silent,
    next_wait_s,
    predict_contacts,
    without,
)
from ground_service.missions.model import parse_mission
from ground_service.missions.places import outages_of, station_of, stations_of
from lunar.constants import NS
from lunar.ephemeris import ephemeris_from_states
from lunar.visibility import GroundStation, link
from tests.ground_service.conftest import START, circular_states

DAY = 86_400 * NS
ALWAYS = GroundStation("above the horizon", 0.0, 0.0, 0.0, np.radians(-90.0))
MADRID = GroundStation("madrid", np.radians(40.43), np.radians(-4.25), 840.0, np.radians(10.0))


@fixture(scope="module")
def orbit():
    every = START + np.arange(0, 86_400 + 1, 60, dtype=np.int64) * NS
    return ephemeris_from_states(every, *circular_states(every))


def test_contacts_are_where_the_station_sees_the_spacecraft_cut_by_query_ephemeris_and_outages(orbit):
    contacts = predict_contacts(orbit, [MADRID], START, START + DAY)
    assert len(contacts) >= 2  # the orbit has a period of 111 minutes and goes behind the Moon
    for one in contacts:
        inside = np.linspace(one.start_utc_ns + NS, one.stop_utc_ns - NS, 20).astype(np.int64)
        assert link(orbit, inside, MADRID).visible.all()
        for edge, step in (one.start_utc_ns, -3 * NS), (one.stop_utc_ns, 3 * NS):
            if START + 10 * NS < edge < START + DAY - 10 * NS:
                assert not link(orbit, np.array([edge + step]), MADRID).visible[0]
    whole = predict_contacts(orbit, [MADRID], START, START + DAY)
    edges = range(BLOCK_NS * (START // BLOCK_NS + 1), START + DAY, BLOCK_NS)
    above = predict_contacts(orbit, [ALWAYS], START, START + DAY)
    assert any(one.start_utc_ns < edge < one.stop_utc_ns for one in above for edge in edges)
    for start, stop in (START + 3 * NS, START + DAY), (whole[0].start_utc_ns + NS, whole[-1].stop_utc_ns - NS):
        found = predict_contacts(orbit, [MADRID], start, stop)
        cut = [(max(one.start_utc_ns, start), min(one.stop_utc_ns, stop)) for one in whole]
        assert [(one.start_utc_ns, one.stop_utc_ns) for one in found] == [span for span in cut if span[0] < span[1]]
    contacts = predict_contacts(orbit, [MADRID], START - DAY, START + 5 * DAY)
    assert contacts == predict_contacts(orbit, [MADRID], START, START + DAY)
    assert predict_contacts(orbit, [MADRID], START + 2 * DAY, START + 3 * DAY) == ()
    first = contacts[0]
    middle = (first.start_utc_ns + first.stop_utc_ns) // 2
    closed = predict_contacts(orbit, [MADRID], START, START + DAY, {"madrid": [(middle - NS, middle + NS)]})
    assert [one.start_utc_ns for one in closed[:2]] == [first.start_utc_ns, middle + NS]
    assert closed[0].stop_utc_ns == middle - NS
    assert predict_contacts(orbit, [MADRID], START, START + DAY, {"canberra": [(START, START + DAY)]}) == contacts


@given(
    st.tuples(st.integers(0, 50), st.integers(51, 100)),
    st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100)).map(lambda ab: (min(ab), max(ab))), max_size=4),
)
def test_without_keeps_what_no_closed_span_covers(span, closed):
    parts = without(span, closed)
    for halves in range(2 * span[0] + 1, 2 * span[1], 2):  # the middle of every unit
        kept = any(2 * a < halves < 2 * b for a, b in parts)
        assert kept == (not any(2 * a < halves < 2 * b for a, b in closed))


def test_edges_of_contacts_silences_waits_and_offsets_of_the_clock_are_where_they_are_stated():
    contacts = [PredictedContact("a", 100, 200), PredictedContact("b", 300, 400)]
    assert [contact_at(contacts, t) for t in (99, 100, 200, 201)] == [None, contacts[0], contacts[0], None]
    assert contact_at(contacts, 290, 10) == contacts[1]
    assert contact_at(contacts, 289, 10) is None
    assert not is_silent(0, 60 * NS, 60.0)
    assert is_silent(0, 60 * NS + 1, 60.0)
    waits = [0.0]
    for _ in range(8):
        waits.append(next_wait_s(waits[-1]))
    assert waits[1:] == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    limit = round(CLOCK_LIMIT_S * NS)
    assert clock_fault(None) is None and clock_fault(limit) is None and clock_fault(-limit) is None
    assert "+3600 s" in (clock_fault(3600 * NS) or "") and "-3600 s" in (clock_fault(-3600 * NS) or "")


def test_stations_are_those_of_the_mission_description():
    section = parse_mission(
        'name = "x"\n[link.stations.near]\nlatitude_deg = 40.0\nlongitude_deg = -4.0\n'
        'minimum_elevation_deg = 5.0\noutages = ["2029-08-10T00:00:00Z/2029-08-10T06:00:00Z"]\n'
        "[link.stations.far]\nheader_octets = 8\n"
    ).link
    near = station_of(section, "near")
    assert stations_of(section) == (near,)
    assert near is not None and near.minimum_elevation_rad == approx(np.radians(5.0))
    assert station_of(section, "far") is None and station_of(section, None) is None
    (span,) = outages_of(section)["near"]
    assert span[1] - span[0] == 6 * 3600 * NS
