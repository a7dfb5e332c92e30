"""Events, craters, newest values and verdicts across the passes of a spacecraft; data of the wrong time."""

import random
import time

import numpy as np
from pytest import approx, fixture, mark, raises

from ground_service.client.local import local_client
from ground_service.clock import set_mission_clock
from ground_service.contacts.commanding.service import enter_command, reject_command
from ground_service.errors import NotFound
from ground_service.evaluation import inputs, store
from ground_service.evaluation.model import StoredReport
from ground_service.evaluation.service import make_report, pass_summary
from ground_service.http.model import Paging, UtcTime
from ground_service.ingest.service import ingest_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.passes import service
from ground_service.passes.archive_import import import_archive
from ground_service.passes.live import list_spacecraft, live_parameters
from ground_service.passes.model import EventFilter, PassFilter
from ground_service.passes.service import completeness, define_pass
from ground_service.passes.span import pass_span
from ground_service.passes.store import get_pass, list_passes
from ground_service.store.files import register_file
from lunar.catalogue import load_catalogue
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import save_oem
from lunar.timescales import format_utc, parse_utc, ticks_from_utc_ns, utc_ns_from_ticks
from tests.ground_service.conftest import event_packet
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

TICKS = 900_000_000 * 65_536
HOUR_S = 1000
ZEROS = {name: {field.name: 0 for field in DICTIONARY.packet(name).fields} for name in ("housekeeping", "performance")}
CODES = {name: code for code, name in DICTIONARY.labels("event_info", "event_id").items()}


def event(second, severity, name):
    values = {"event_id": CODES[name], "frame_number": 7, "value_1": 1.0, "value_2": 2.0}
    return DICTIONARY.pack(f"event_{severity}", values, ticks=TICKS + second * 65_536, sequence_count=second)


def utc_ns(second):
    return int(utc_ns_from_ticks(TICKS + second * 65_536))


def defined(ground, start_utc_ns, stop_utc_ns, name="p"):
    return define_pass(ground, name=name, start_utc_ns=start_utc_ns, stop_utc_ns=stop_utc_ns, spacecraft_id=76)


@fixture
def passed(either, tmp_path):
    """Events of two passes, an hour each, and one between them."""
    given = [
        event(0, "info", "mode_changed"),
        event(10, "high", "camera_fault"),
        event(2 * HOUR_S, "low", "mode_changed"),
        event(5 * HOUR_S, "medium", "image_dark"),
    ]
    file = tmp_path / "events.cadu"
    file.write_bytes(encode_cadus(given, spacecraft_id=76))
    ingest_file(either, file)
    for name, start in (("first", 0), ("second", 5 * HOUR_S)):
        defined(either, utc_ns(start), utc_ns(start + HOUR_S), name)
    return either


def names(ground, **filters):
    page = service.spacecraft_events(ground, EventFilter(spacecraft_id=76, **filters))
    assert page.total >= len(page.items)
    return [one.name for one in page.items]


def test_events_of_all_passes_are_listed_newest_first_with_their_pass(passed):
    page = service.spacecraft_events(passed, EventFilter(spacecraft_id=76))
    found = page.items
    assert page.total == 4
    assert [(one.name, one.severity, one.pass_id) for one in found] == [
        ("image_dark", "medium", 2),
        ("mode_changed", "low", None),
        ("camera_fault", "high", 1),
        ("mode_changed", "info", 1),
    ]
    assert found[0].time.utc_ns == utc_ns(5 * HOUR_S)
    assert found[0].detail == service.list_events(passed, 2, Paging(limit=1)).items[0].detail != ""


def test_events_are_filtered_by_severity_name_and_time(passed):
    assert names(passed, severity=["medium", "high"]) == ["image_dark", "camera_fault"]
    assert names(passed, name="Mode chan") == ["mode_changed", "mode_changed"]
    assert names(passed, name="nothing of the kind") == []
    assert names(passed, start=UtcTime(utc_ns(10)), stop=UtcTime(utc_ns(2 * HOUR_S))) == [
        "mode_changed",
        "camera_fault",
    ]
    assert names(passed, start=UtcTime(utc_ns(10) + 1_000_000)) == ["image_dark", "mode_changed"]
    assert names(passed, limit=1, offset=1) == ["mode_changed"]
    assert names(passed, severity=["info"], limit=1) == ["mode_changed"]


def test_events_and_parameters_of_an_unknown_spacecraft_are_not_found(ground):
    with raises(NotFound, match="spacecraft 5"):
        service.spacecraft_events(ground, EventFilter(spacecraft_id=5))
    with raises(NotFound, match="spacecraft 5"):
        live_parameters(ground, 5, "flight")


def test_the_craters_of_a_pass_are_listed_the_largest_first(ground, synthetic_pass):
    pass_id = import_archive(ground, synthetic_pass.folder)
    catalogue = load_catalogue(synthetic_pass.folder / "catalogue.csv")
    page = service.craters(ground, pass_id, Paging(limit=1000))
    found = page.items
    assert page.total == len(catalogue) == len(found)
    sizes = [one.diameter_m for one in found]
    assert sizes == sorted(catalogue.diameter_m.tolist(), reverse=True)
    assert all(-180.0 <= one.longitude_deg < 180.0 for one in found)
    assert service.craters(ground, pass_id, Paging(limit=2, offset=1)).items == found[1:3]


def test_a_pass_without_a_catalogue_has_no_craters(passed):
    assert service.craters(passed, 1, Paging(limit=10)).total == 0


def receive(ground, tmp_path, second, **values):
    given = ZEROS["housekeeping"] | values | {"structure_id": 1}
    packet = DICTIONARY.pack("housekeeping", given, ticks=TICKS + second * 65_536, sequence_count=second)
    file = tmp_path / f"{second}.cadu"
    file.write_bytes(encode_cadus([packet], spacecraft_id=76))
    ingest_file(ground, file)


def test_the_newest_packet_by_on_board_time_counts(either, tmp_path):
    receive(either, tmp_path, 10, temperature_c=70.25, bus_voltage_v=12.0, mode=2, model_hash=0xDF7F5779)
    receive(either, tmp_path, 5, temperature_c=20.0)  # arrives later, and is older
    found = {one.name: one for one in live_parameters(either, 76, "flight")}
    temperature = found["temperature_c"]
    assert (temperature.value, temperature.text, temperature.limit_state) == (70.25, "70.25", "warning")
    assert (temperature.limits, temperature.packet) == ("-20 to 60", "housekeeping")
    assert (found["mode"].text, found["mode"].limit_state) == ("observing", "none")
    assert found["model_hash"].text == "df7f5779"
    assert temperature.time.utc_ns == utc_ns(10)
    (listed,) = list_spacecraft(either)
    assert (listed.spacecraft_id, listed.instance, listed.name) == (76, "flight", None)
    add_mission(either, b'name = "m"\n[spacecraft]\nid = 76\nname = "SelenITA"\n')
    assert list_spacecraft(either)[0].name == "SelenITA"


@mark.parametrize("later_s, age_s", [(42.5, 42.5), (-1e8, 0.0)])
def test_ages_are_those_of_mission_time_and_count_from_the_newest_packet_where_that_is_later(
    ground, tmp_path, later_s, age_s
):
    receive(ground, tmp_path, 0)
    now = utc_ns(0) + round(later_s * 1e9)
    set_mission_clock(lambda: now)
    assert {one.age_s for one in live_parameters(ground, 76, "flight")} == {age_s}


def test_a_mistyped_spacecraft_is_listed_until_its_telecommand_is_rejected(either):
    command = enter_command(either, "test_connection", {}, spacecraft_id=67, actor="ann")
    assert [one.spacecraft_id for one in list_spacecraft(either)] == [67]
    reject_command(either, command, actor="ann", reason="mistyped")
    assert list_spacecraft(either) == []


def test_a_parameter_of_a_further_structure_has_a_series_a_live_value_an_alarm_and_a_drawing(ground, monkeypatch):
    values = [10.0, 61.25, 20.0]
    name, packets = "camera_temperature_c", []
    for k, value in enumerate(values):
        given = ZEROS["performance"] | {"structure_id": 2, name: value}
        packets.append(DICTIONARY.pack("performance", given, ticks=TICKS + (k << 16), sequence_count=k))
    with local_client(ground, "ann") as client:
        client.ingest_file(encode_cadus(packets[::-1], spacecraft_id=76))
        start, stop = (format_utc(utc_ns(s)) for s in (-60, 60))
        pass_id = client.define_pass("pass", start, stop, 76).id
        [listed] = [one for one in client.list_parameters(pass_id).parameters if one.name == name]
        assert (listed.packet, listed.unit) == ("performance", "degC")
        assert [bucket.mean for bucket in client.get_parameter(pass_id, name).buckets] == values
        [live] = [one for one in client.list_live_parameters(76) if one.name == name]
        assert (live.value, live.limit_state) == (20.0, "within")
        [alarm] = client.list_alarms()
        assert (alarm.name, alarm.severity, alarm.value, alarm.active) == (name, "alarm", 61.25, False)
        monkeypatch.setattr(inputs, "DRAWN", (name,))
        [drawn] = inputs.load_pass_inputs(ground, pass_id).housekeeping
        assert (drawn.name, drawn.unit, drawn.values.tolist()) == (name, "°C", values)


NS = 1_000_000_000
DAY = 86_400
START = parse_utc("2029-08-07T06:00:00Z")
FRAMES = 200
MISSION = b"""
name = "test"
[spacecraft]
id = 76
[frames]
orientation = "IAU WGCCRE 2009"
"""


def housekeeping(day):
    """A packet every ten seconds; the counts of a day go on where those of the day before ended."""
    values = dict.fromkeys(ZEROS["housekeeping"], 1)
    first = int(ticks_from_utc_ns(START + day * DAY * NS))
    return [
        DICTIONARY.pack(
            "housekeeping",
            {**values, "frames_processed": k},
            ticks=first + k * 10 * 65_536,
            sequence_count=(16_300 + (day + 1) * FRAMES + k) % 16_384,
        )
        for k in range(FRAMES)
    ]


def day_pass(ground, day):
    start = START + day * DAY * NS
    return defined(ground, start, start + 10 * FRAMES * NS)


def test_bursts_of_yesterday_in_todays_stream_fall_into_their_own_day(ground, tmp_path):
    rng = random.Random(1)
    today, yesterday = housekeeping(0), housekeeping(-1)
    stream = []
    while today or yesterday:
        burst = yesterday if yesterday and (not today or rng.random() < 0.3) else today
        for _ in range(min(rng.randint(1, 25), len(burst))):
            stream.append(burst.pop(0))
    (tmp_path / "d.cadu").write_bytes(encode_cadus(stream, spacecraft_id=76))
    assert ingest_file(ground, tmp_path / "d.cadu").packets_new == 2 * FRAMES
    for day in (0, -1):
        found = completeness(ground, day_pass(ground, day))
        assert (found.packets, found.lost, found.conflicts) == (FRAMES, 0, 0)


@mark.parametrize("share, covered", [(0.0, False), (0.5, True)])
def test_a_reference_that_does_not_cover_gives_figures_where_it_does(ground, synthetic_pass, tmp_path, share, covered):
    whole = load_ephemeris(synthetic_pass.folder / "reference.oem")
    first, last = int(synthetic_pass.utc_ns[0]), int(synthetic_pass.utc_ns[-1])
    stop = first + int(share * (last - first))
    times = np.arange(first - (300 if share else 3600) * NS, stop - 60 * NS, 15 * NS)
    times = times[(times >= whole.start_utc_ns) & (times <= whole.stop_utc_ns)]
    save_oem(ephemeris_from_states(times, *whole.at(times)), tmp_path / "part.oem")
    add_ephemeris(ground, ground.files.put_file(tmp_path / "part.oem"), name="part")
    add_mission(ground, MISSION)
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    key = defined(ground, first, last)
    figures = pass_summary(ground, key)["navigation"]
    found = figures.get("spherical", {"median_3d_m": None})["median_3d_m"]
    assert found == (approx(130.0, abs=1.0) if covered else None)
    assert make_report(ground, key).report_id


def add_report(ground, pass_id, level, created_utc_ns):
    stored = ground.files.put_octets(b"report")
    with ground.database.writing() as connection:
        register_file(connection, stored, "report", "report", created_utc_ns)
        store.add_report(
            connection,
            StoredReport(
                id=f"{pass_id:016x}{created_utc_ns:016x}",
                pass_id=pass_id,
                html_sha256=stored.sha256,
                json_sha256=stored.sha256,
                pdf_sha256=None,
                summary={"verdict_level": level},
                mission_id=None,
                event_number=None,
                previous_id=None,
                changes=None,
                created_utc_ns=created_utc_ns,
            ),
        )


def listed(ground, **terms):
    page = ground.read(list_passes, PassFilter(**terms))
    return sorted(one.id for one in page.items), page.total


def test_passes_are_listed_by_the_verdict_of_their_newest_report(either):
    for hour in range(3):
        start = (1_900_000_000 + 3600 * hour) * NS
        defined(either, start, start + 60 * NS, f"pass {hour}")
    # The second report of pass 1 is older.
    for report in ((1, "met", 2), (1, "not met", 1), (2, "met", 1), (2, "not met", 3)):
        add_report(either, *report)
    verdicts = {"met": [1], "not met": [2], "unknown": [], "none": [3]}
    for verdict, passes in verdicts.items():
        assert listed(either, verdict=verdict) == (passes, len(passes))
    assert listed(either, verdict="met", search="pass 1") == ([], 0)
    assert listed(either) == ([1, 2, 3], 3)


def test_the_interval_of_a_pass_takes_time_in_proportion_to_its_starts(ground, tmp_path):
    file = tmp_path / "starts.packets"
    file.write_bytes(b"".join(event_packet(TICKS + 65_536 * k, k, "observation_started") for k in range(4_000)))
    ingest_file(ground, file, spacecraft_id=76)
    key = defined(ground, utc_ns(0), utc_ns(4_000))
    record, begun = ground.read(get_pass, key), time.process_time()
    ground.read(pass_span, record)
    assert time.process_time() - begun < 1.0  # 8 million comparisons take several seconds
