"""Correlations follow the time reports and their receptions, whatever comes first, and once only."""

import itertools
import json
import random

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises
from sqlalchemy import text

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.errors import Conflict, InvalidInput
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.timekeeping import recorrelation
from ground_service.missions.timekeeping.core import clock_runs, fit_correlation
from ground_service.missions.timekeeping.recorrelation import (
    ReceivedReport,
    TimePoint,
    correlate,
    correlate_again,
    enter_receptions,
    read_receptions,
    recorrelate,
    residuals,
    withdraw_correlations,
)
from ground_service.missions.timekeeping.store import correlations_in_force, correlations_on_record
from ground_service.passes.service import define_pass, list_events
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.integrity import verify
from linna.cli import run
from lunar.constants import SPEED_OF_LIGHT_M_S
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import format_utc, parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from tests.ground_service.conftest import cells, circular_states, save_circle
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.space_packets import PacketSequencer

NS = 1_000_000_000
START = parse_utc("2029-08-07T06:00:00Z")
SPACECRAFT = 76
REPORTS = 30
DRIFT = 3e-6  # the clock runs fast
BOOT_AFTER = 15
OFFSETS_S = (0.25, -1.5)  # of the clock, before and after the boot
LIGHT_S = 1.25


def clock(utc_ns, number):
    off_s = OFFSETS_S[number >= BOOT_AFTER] + DRIFT * (utc_ns - START) / NS
    return int(ticks_from_utc_ns(utc_ns)) + round(off_s * 65_536)


class Spacecraft:
    """A minute from one time report to the next, a boot in the middle, with housekeeping that tells of it."""

    def __init__(self):
        sequencer = PacketSequencer()
        housekeeping = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
        self.sent = [START + k * 60 * NS for k in range(REPORTS)]
        self.packets = []
        self.reports = []
        for k, utc_ns in enumerate(self.sent):
            ticks = clock(utc_ns, k)
            boot = {**housekeeping, "boot_count": 7 + (k >= BOOT_AFTER)}
            event = {"event_id": 3, "frame_number": k, "value_1": 0.0, "value_2": 0.0}
            report = {"reported_ticks": ticks, "rate_exponent": 4}
            # Housekeeping a little before, so that a run of the clock begins with it.
            for name, one, at in (
                ("housekeeping", boot, ticks - 6553), ("time_report", report, ticks), ("event_info", event, ticks),
            ):  # fmt: skip
                count = sequencer.next(DICTIONARY.packet(name).apid)
                self.packets.append(DICTIONARY.pack(name, one, ticks=at, sequence_count=count))
                if name == "time_report":
                    self.reports.append(ReceivedReport(ticks, count, utc_ns + round(LIGHT_S * NS)))

    def downlink(self, first=0, last=REPORTS):
        return encode_cadus(self.packets[3 * first : 3 * last], spacecraft_id=SPACECRAFT)


@fixture(scope="module")
def spacecraft():
    return Spacecraft()


@fixture(autouse=True)
def fixed_light_time(monkeypatch):
    monkeypatch.setattr(recorrelation, "_light_time_ns", lambda *given: np.full(len(given[3]), round(LIGHT_S * NS)))


def ingest(ground, folder, octets, name="d.cadu"):
    (folder / name).write_bytes(octets)
    return ingest_file(ground, folder / name).vehicle_id


def receive(ground, reports):
    return enter_receptions(ground, SPACECRAFT, "flight", reports, actor="ann")


def content(rows):
    return [row.model_dump(exclude={"id", "created"}) for row in rows]


def test_every_boot_gets_its_line_and_every_derived_time_names_it(ground, spacecraft, tmp_path):
    vehicle = ingest(ground, tmp_path, spacecraft.downlink())
    rows = receive(ground, spacecraft.reports)
    assert [row.boot_count for row in rows] == [7, 8]
    assert [row.points for row in rows] == [15, 15]
    for row in rows:
        assert row.drift_ppb == approx(-3000.0, abs=20.0)  # a tick (15 us) over 14 minutes is 18 ppb
        assert row.residual_rms_ns < 15_259
    key = define_pass(
        ground, name="p", start_utc_ns=START - 60 * NS, stop_utc_ns=START + REPORTS * 60 * NS,
        spacecraft_id=SPACECRAFT,
    )  # fmt: skip
    found = list_events(ground, key, Paging(limit=1000)).items
    assert_allclose([event.time.utc_ns for event in found], spacecraft.sent, atol=20_000)
    assert [event.correlation_id for event in found] == [rows[0].id] * 15 + [rows[1].id] * 15
    left = residuals(ground, vehicle)
    assert len(left) == REPORTS
    assert max(abs(one.residual_ns) for one in left) < 20_000


def test_the_order_of_telemetry_and_receptions_does_not_matter(spacecraft, tmp_path):
    cut = spacecraft.downlink(0, 12), spacecraft.downlink(12, 20), spacecraft.downlink(20)
    found = []
    for number, seed in enumerate(range(4)):
        rng = random.Random(seed)
        with open_ground(tmp_path / f"home{number}") as ground:
            follow_in_process(ground)
            steps = [("file", octets) for octets in cut]
            steps += [("times", spacecraft.reports[k : k + 11]) for k in range(0, REPORTS, 10)]
            rng.shuffle(steps)
            steps += rng.sample(steps, 2)
            for k, (kind, what) in enumerate(steps):
                if kind == "file":
                    vehicle = ingest(ground, tmp_path, what, f"{number}-{k}.cadu")
                else:
                    receive(ground, what)
            found.append(content(ground.read(correlations_in_force, vehicle)))
            on_record = len(ground.read(correlations_on_record, vehicle))
            assert not recorrelate(ground, vehicle)
            assert len(ground.read(correlations_on_record, vehicle)) == on_record
    assert all(one == found[0] for one in found)
    assert len(found[0]) == 2


def test_a_clock_that_is_set_begins_a_new_line_and_one_bad_report_does_not():
    sent = START + np.arange(20, dtype=np.int64) * 60 * NS
    ticks = np.asarray(ticks_from_utc_ns(sent), dtype=np.int64)
    none = np.zeros(20, dtype=np.int64)
    wild = ticks.copy()
    wild[8] += 5 * 65_536
    (run_,) = clock_runs(wild, sent, none, none)
    fit = fit_correlation(wild[run_], sent[run_], none)
    assert (fit.points, fit.rejected, fit.drift_ppb) == (19, 1, 0.0)
    runs = clock_runs(np.where(np.arange(20) < 8, ticks, ticks + 3 * 65_536), sent, none, none)
    assert [len(one) for one in runs] == [8, 12]


@mark.parametrize("drift_ppm", [0.0, 150.0])
def test_a_step_during_hours_without_reports_begins_a_new_line(drift_ppm):
    """In three hours an unknown drift of 200 ppm could be 2 s; that of this clock is known from the reports before."""
    hours = np.array([0.0, 0.1, 2.0, 2.1, 4.0, 4.1, 7.0, 7.1, 10.0])
    sent = START + np.asarray(hours * 3600 * NS, dtype=np.int64)
    error_s = hours * 3600.0 * drift_ppm * 1e-6
    none = np.zeros(len(hours), dtype=np.int64)
    for step_s, lengths in (0.0, [9]), (-1.0, [6, 3]), (0.1, [6, 3]):
        off = np.rint((error_s + np.where(hours > 5.0, step_s, 0.0)) * 65_536).astype(np.int64)
        runs = clock_runs(np.asarray(ticks_from_utc_ns(sent), dtype=np.int64) + off, sent, none, none)
        assert [len(one) for one in runs] == lengths


def test_a_drift_within_the_resolution_of_the_clock_is_none():
    sent = START + np.arange(4, dtype=np.int64) * NS
    ticks = np.asarray(ticks_from_utc_ns(sent), dtype=np.int64) + np.array([0, 0, 1, 1])
    fit = fit_correlation(ticks, sent, np.zeros(4, dtype=np.int64))
    assert fit.drift_ppb == 0.0


def test_what_an_operator_entered_stays_until_asked_otherwise(ground, spacecraft, tmp_path):
    vehicle = ingest(ground, tmp_path, spacecraft.downlink())
    correlate(ground, vehicle, [TimePoint(clock(START, 0), START, 0)])
    assert [row.points for row in receive(ground, spacecraft.reports)] == [1]
    assert len(correlate_again(ground, SPACECRAFT, "flight", actor="ann")) == 2


def test_what_an_operator_entered_can_be_withdrawn_with_a_trace(ground, spacecraft, tmp_path):
    vehicle = ingest(ground, tmp_path, spacecraft.downlink())
    assert ground.read(correlations_in_force, vehicle) == []
    fitted = [row.id for row in receive(ground, spacecraft.reports)]
    with raises(Conflict, match="expected correlations in force that a person entered, found none"):
        withdraw_correlations(ground, SPACECRAFT, "flight", actor="ann")
    correlate(ground, vehicle, [TimePoint(clock(START, 0), START, 0)])
    (entered,) = ground.read(correlations_in_force, vehicle)
    left = withdraw_correlations(ground, SPACECRAFT, "flight", actor="ann")
    assert [row.points for row in left] == [15, 15]
    record = {row.id: row.in_force for row in ground.read(correlations_on_record, vehicle)}
    assert record == dict.fromkeys((*fitted, entered.id), False) | {one.id: True for one in left}
    with ground.database.reading() as connection:
        trace = list_audit(connection, AuditFilter(action="withdraw correlations")).items
    assert [(one.actor, one.detail) for one in trace] == [("ann", {"ids": [entered.id]})]


def test_telemetry_without_receptions_leaves_the_clock_ideal(ground, spacecraft, tmp_path):
    vehicle = ingest(ground, tmp_path, spacecraft.downlink())
    assert ground.read(correlations_in_force, vehicle) == []


def test_an_earlier_reception_of_the_same_report_counts(ground, spacecraft, tmp_path):
    ingest(ground, tmp_path, spacecraft.downlink())
    played_back = [
        ReceivedReport(one.ticks, one.sequence_count, one.earth_utc_ns + 3600 * NS) for one in spacecraft.reports
    ]
    for order in itertools.permutations([spacecraft.reports, played_back]):
        for reports in order:
            rows = receive(ground, reports)
    assert [row.reference_utc_ns for row in rows] == approx([spacecraft.sent[7], spacecraft.sent[22]], abs=20_000)


def test_a_new_reference_ephemeris_gives_new_light_times(ground, spacecraft, tmp_path, monkeypatch):
    monkeypatch.undo()
    vehicle = ingest(ground, tmp_path, spacecraft.downlink())
    receive(ground, spacecraft.reports)
    sent = np.array(spacecraft.sent)
    earth = np.asarray(earth_position_icrf_m(np.asarray(tdb_s_from_utc_ns(sent))))
    nearer_m = np.linalg.norm(earth, axis=1) - np.linalg.norm(earth - circular_states(sent)[0], axis=1)
    before = [one.light_time_s for one in residuals(ground, vehicle)]
    orbit = save_circle(tmp_path / "orbit.oem", START - 600 * NS, 2.0)
    add_ephemeris(ground, ground.files.put_file(orbit), name="orbit")
    after = [one.light_time_s for one in residuals(ground, vehicle)]
    # From the Moon's centre to the orbit around it, which moves by 2 km while the light travels.
    assert_allclose(np.array(before) - after, nearer_m / SPEED_OF_LIGHT_M_S, atol=1e-5)
    assert np.abs(nearer_m).max() > 1e5
    assert len(ground.read(correlations_in_force, vehicle)) == 2
    assert len(ground.read(correlations_on_record, vehicle)) == 4


def test_an_operator_correlates_from_a_file(spacecraft, tmp_path, capsys):
    home = ["--home", str(tmp_path / "home"), "--json"]
    who = ["--spacecraft-id", str(SPACECRAFT)]
    (tmp_path / "d.cadu").write_bytes(spacecraft.downlink())
    lines = [f"{r.ticks},{r.sequence_count},{format_utc(r.earth_utc_ns)}," for r in spacecraft.reports]
    table = tmp_path / "times.csv"
    table.write_text("\n".join(["packet_ticks,sequence_count,received_utc,station", *lines]) + "\n")

    def linna(*words):
        assert run([*words, *home]) == 0
        return json.loads(capsys.readouterr().out)

    linna("ingest", str(tmp_path / "d.cadu"))
    made = linna("correlate", "receptions", str(table), *who)["correlations"]
    assert made == linna("correlate", "list", *who)["correlations"] == linna("correlate", "run", *who)["correlations"]
    assert len(linna("correlate", "residuals", *who)["time_reports"]) == REPORTS


NO_FILES = r"""
a,b\n1,2\n | line 1: expected a column packet_ticks, found a,b
packet_ticks,sequence_count,received_utc\n1,2,then\n | receptions.0
\ufeffpacket_ticks,sequence_count,received_utc\n1,2,then\n | receptions.0
packet_ticks,sequence_count,received_utc\n | expected 1 to \d+ receptions, found none
packet_ticks,sequence_count,received_utc\n1,99999,2029-08-07T06:00:00Z\n | 14 bits of count
packet_ticks,sequence_count,received_utc,station\n1,2,2029-08-07T06:00:00Z,Mars\n | Canberra
"""


@mark.parametrize("text, message", cells(NO_FILES))
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "t.csv").write_text(text.replace(r"\n", "\n").replace(r"\ufeff", "\ufeff"))
    with raises(InvalidInput, match=message):
        read_receptions(tmp_path / "t.csv")


def test_an_archive_may_have_no_receptions(tmp_path):
    (tmp_path / "t.csv").write_text("packet_ticks,sequence_count,received_utc\n")
    assert read_receptions(tmp_path / "t.csv", 0) == []


@mark.parametrize(
    "changes, kinds",
    [
        ("reference_utc_ns = reference_utc_ns + 900", set()),  # rounding
        ("reference_utc_ns = reference_utc_ns + 1100", {"correlations"}),
        ("drift_ppb = drift_ppb + 5", {"correlations"}),
        ("superseded = 1", {"correlations"}),
        ("method = 'entered'", set()),
    ],
)
def test_verification_fits_the_correlations_again(either, tmp_path, spacecraft, changes, kinds):
    ingest(either, tmp_path, spacecraft.downlink())
    receive(either, spacecraft.reports)
    intact = verify(either, rebuild=True)
    assert (intact.damaged, intact.unchecked, intact.checked["correlations"]) == ([], {}, 2)
    with either.database.writing() as connection:
        connection.execute(text(f"UPDATE correlations SET {changes} WHERE boot_count = 8"))
    found = verify(either, rebuild=True)
    assert {one.kind for one in found.damaged} == kinds
    assert bool(found.unchecked) == changes.startswith("method")


def test_verification_does_not_expect_correlations_before_the_follow_up_work(either, tmp_path, spacecraft, monkeypatch):
    receive(either, spacecraft.reports)
    monkeypatch.setattr(either.database.listeners, "_functions", [])
    ingest(either, tmp_path, spacecraft.downlink())
    found = verify(either, rebuild=True)
    assert found.damaged == []
    assert found.unchecked == {"vehicles with follow-up work that is not done": 1}
