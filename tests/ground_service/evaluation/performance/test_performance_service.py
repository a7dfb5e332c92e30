"""Performance over stored reports, and monthly reports by operation, command, rule and nightly job."""

import hashlib
import json
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

from pytest import approx, fixture, mark, raises

from ground_service.client.local import local_client
from ground_service.clock import set_mission_clock, utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.evaluation import service as evaluation
from ground_service.evaluation.model import StoredReport
from ground_service.evaluation.performance import service
from ground_service.evaluation.performance.model import MonthlyReportFilter
from ground_service.evaluation.performance.service import (
    _consistency_remark,
    last_month,
    list_monthly_reports,
    make_due_report,
    make_monthly_report,
    month_span,
    monthly_value,
    performance,
)
from ground_service.evaluation.service import make_report
from ground_service.evaluation.store import add_report, get_report
from ground_service.http.model import UtcTime
from ground_service.jobs.service import enter_job
from ground_service.passes.archive_import import import_archive
from ground_service.passes.service import define_pass
from ground_service.store import repository
from ground_service.store.event_kinds import WindowChanged, publish, read_events
from ground_service.store.files import register_file
from ground_service.store.vehicles import FLOWN, vehicle_id
from ground_service.worker import upkeep
from ground_service.worker.upkeep import nightly
from linna.cli import run
from linna.commands.results import performance_lines
from lunar.timescales import parse_utc
from reports import pdf_pages
from tests.ground_service.conftest import ALTITUDE_M, SPACECRAFT

DAY_NS = 86_400_000_000_000
FIRST = parse_utc("2029-08-02T06:00:00Z")


@fixture(scope="module")
def flown(make_pass):
    return make_pass(frames=30, seed=9)


def add_pass(
    ground,
    number,
    *,
    instance=FLOWN,
    recall=...,
    error=80.0,
    altitude=25.0,
    status="met",
    build="a",
    key="accuracy.median",
    limit=100.0,
):
    """Add a pass with a report, one a day."""
    start = FIRST + number * DAY_NS
    pass_id = define_pass(
        ground,
        name=f"pass {number}",
        start_utc_ns=start,
        stop_utc_ns=start + 10**12,
        spacecraft_id=SPACECRAFT,
        instance=instance,
    )
    blob = ground.files.put_octets(b"x")
    if recall is ...:
        recall = 0.70 + 0.01 * (number % 3)
    errors = dict.fromkeys(("p68_3d_m", "p95_3d_m", "p99_3d_m", "max_3d_m", "end_of_pass_m"))
    summary = {
        "pass_id": pass_id,
        "frames": 10,
        "packets": 50,
        "packets_lost": 1,
        "packets_expected": 51,
        "detector": {"precision": 0.8, "recall": recall, "loc_px": 1.0, "per_class": []},
        "navigation": {
            "anchored": {"median_3d_m": error, "drift_percent": 0.1, **errors},
            "paper": {"median_3d_m": 9e3, "drift_percent": 9.0, **errors},
        },
        "smoothed": {},
        "baselines": {},
        "verdict": "met",
        "verdict_level": "met",
        "requirements": [
            {
                "key": key, "name": "median 3-D error", "value": error, "limit": limit,
                "relation": "<=", "unit": "m", "margin": 1.0, "status": status, "note": "",
            }
        ],
        "error_budget": {},
        "evidence_level": "2 (procedural Moon)",
        "data": [],
        "conditions": {
            "altitude_km": altitude, "sun_elevation_deg": 20.0, "build": build,
            "estimator": "anchored",
        },
    }  # fmt: skip
    with ground.database.writing() as connection:
        register_file(connection, blob, "report", "x", 1)
        report = StoredReport(
            id=f"{pass_id:032x}",
            pass_id=pass_id,
            html_sha256=blob.sha256,
            json_sha256=blob.sha256,
            pdf_sha256=None,
            summary=summary,
            mission_id=None,
            event_number=None,
            previous_id=None,
            changes=None,
            created_utc_ns=start,
        )
        add_report(connection, report)
    return pass_id


def group_means(found):
    return {(one.factor, one.group, one.metric): one for one in found.groups}


def test_a_report_states_the_conditions_of_its_pass(either, flown):
    pass_id = import_archive(either, flown.folder)
    made = make_report(either, pass_id)
    conditions = made.summary["conditions"]
    assert conditions["altitude_km"] == approx(ALTITUDE_M / 1e3, abs=0.1)
    assert conditions["sun_elevation_deg"] is None  # the light of the images is not that of the ephemeris
    [one] = performance(either, SPACECRAFT).passes
    assert (one.pass_id, one.report_id) == (pass_id, made.report_id)
    assert one.altitude_km == conditions["altitude_km"]
    assert one.recall == made.summary["detector"]["recall"] is not None
    assert performance(either, SPACECRAFT, instance="flight").passes == []
    # Passes of an archive are not mixed with those of the flown spacecraft.
    flight = add_pass(either, 0)
    found = performance(either, SPACECRAFT)
    assert (found.instance, [one.pass_id for one in found.passes]) == ("flight", [flight])


def test_processes_that_make_a_pdf_at_the_same_time_keep_one_file(either, monkeypatch):
    key = f"{add_pass(either, 0):032x}"
    blob = either.read(get_report, key).html_sha256
    either.write(repository.change, repository.REPORTS, key, print_sha256=blob)
    both = threading.Barrier(2)

    def pdf_of(form, page):
        both.wait()
        return form + page.encode()

    monkeypatch.setattr(pdf_pages, "pdf_of", pdf_of)
    monkeypatch.setattr(evaluation, "_typesetting", nullcontext())  # as other processes have their own
    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(lambda _: evaluation.report_document(either, key, "pdf"), range(2)))
    assert made == [b"xx", b"xx"]
    assert either.read(get_report, key).pdf_sha256 == hashlib.sha256(b"xx").hexdigest()
    assert evaluation.report_document(either, key, "pdf") == b"xx"  # without waiting for a second one


def test_passes_are_grouped_and_changes_found(either):
    low = {"recall": 0.4, "altitude": 35.0, "build": "b", "status": "not met", "error": 120.0}
    for number in range(20):
        add_pass(either, number, **(low if number >= 12 else {}))
    found = performance(either, SPACECRAFT, instance="flight")
    assert [one.estimator for one in found.passes] == ["anchored"] * 20
    groups = group_means(found)
    by_altitude = [groups["altitude", name, "recall"] for name in ("20 to 30 km", "30 to 40 km")]
    assert [(one.passes, round(one.mean or 0.0, 3)) for one in by_altitude] == [(12, 0.71), (8, 0.4)]
    assert by_altitude[0].low is not None and by_altitude[0].low < 0.71 < (by_altitude[0].high or 0.0)
    assert groups["build", "b", "median_error_m"].mean == 120.0
    assert ("sun elevation", "15 to 30 °", "drift_percent") in groups
    assert ("terrain", "2 (procedural Moon)", "recall") in groups
    assert [(one.metric, one.pass_id) for one in found.changes] == [
        ("median_error_m", found.passes[12].pass_id),
        ("recall", found.passes[12].pass_id),
    ]
    [requirement] = found.requirements
    assert (requirement.passes, requirement.met, requirement.not_met) == (7, 0, 7)
    assert (requirement.share_met, requirement.lowest_share) == (0.0, 0.0)
    earlier = performance(either, SPACECRAFT, stop_utc_ns=FIRST + 12 * DAY_NS)
    assert len(earlier.passes) == 12 and earlier.changes == []
    [requirement] = earlier.requirements
    assert (requirement.met, requirement.share_met, requirement.high) == (7, 1.0, 1.0)
    assert 0.6 < (requirement.low or 0.0) < 0.7


def test_unknown_values_stay_unknown(ground):
    add_pass(ground, 0, recall=None, altitude=None, status="unknown", build="")
    found = performance(ground, SPACECRAFT)
    groups = group_means(found)
    assert groups["altitude", "unknown", "recall"].mean is None
    assert groups["build", "not stated", "drift_percent"].mean == 0.10
    [requirement] = found.requirements
    assert (requirement.unknown, requirement.share_met, requirement.low) == (1, None, None)


def test_the_same_month_is_stored_once_and_late_data_give_a_new_report(either):
    for number in range(3):
        add_pass(either, number)
    first = make_monthly_report(either, SPACECRAFT, "2029-08")
    assert make_monthly_report(either, SPACECRAFT, "2029-08") == first
    assert (first.passes, first.month) == (3, "2029-08")
    assert first.verdict == "requirements met in every pass: 1 of 1 judged"
    add_pass(either, 5, status="not met")
    second = make_monthly_report(either, SPACECRAFT, "2029-08")
    assert second.id != first.id and second.verdict == "requirements not met in every pass: 1 of 1 judged"
    assert {one.id for one in monthly(either)} == {first.id, second.id}
    with raises(InvalidInput, match="2029-09: expected passes with a report, found none"):
        make_monthly_report(either, SPACECRAFT, "2029-09")


def monthly(ground):
    return ground.read(list_monthly_reports, MonthlyReportFilter()).items


def test_months():
    assert month_span("2028-02") == (parse_utc("2028-02-01T00:00:00Z"), parse_utc("2028-03-01T00:00:00Z"))
    assert last_month(parse_utc("2029-01-01T00:00:00Z")) == "2028-12"
    assert last_month(parse_utc("2029-03-31T23:59:59Z")) == "2029-02"
    with raises(InvalidInput, match="expected a month such as 2029-08, found 2029-13"):
        month_span("2029-13")


@fixture
def september():
    set_mission_clock(lambda: parse_utc("2029-09-01T00:00:05Z"))


def test_a_requirement_that_is_unknown_on_some_passes_is_not_good(ground):
    for number in range(4):
        add_pass(ground, number, status="met" if number == 3 else "unknown")
    value = monthly_value(performance(ground, SPACECRAFT, window_days=31.0), "2029-08")
    assert value.verdict_level == "unknown"
    assert value.verdict == "requirements judged: 1 of 1, none missed; median 3-D error not judged on 3 of 4 passes"


def test_a_requirement_without_a_limit_may_be_unknown(ground):
    add_pass(ground, 0)
    add_pass(ground, 1, key="other", limit=None, status="unknown")
    add_pass(ground, 2)
    found = performance(ground, SPACECRAFT, window_days=31.0)
    value = monthly_value(found, "2029-08")
    assert {one.key: (one.limit, one.unknown) for one in found.requirements} == {
        "accuracy.median": (100.0, 1),
        "other": (None, 3),
    }
    assert value.verdict.endswith("median 3-D error not judged on 1 of 3 passes")


def test_requirements_that_the_newest_report_lacks_are_judged(ground):
    add_pass(ground, 0, key="old", limit=50.0, status="not met")
    add_pass(ground, 1, key="old", limit=60.0, status="not met")
    add_pass(ground, 2)
    found = performance(ground, SPACECRAFT)
    rules = {one.key: (one.limit, one.met, one.not_met, one.unknown) for one in found.requirements}
    assert rules == {"accuracy.median": (100.0, 1, 0, 2), "old": (60.0, 0, 2, 1)}
    assert monthly_value(found, "2029-08").verdict_level == "not met"


def test_a_monthly_report_has_the_passes_of_one_instance(either):
    add_pass(either, 0)
    add_pass(either, 0, instance="replay", status="not met")
    add_pass(either, 1, instance="replay", status="not met")
    flown = make_monthly_report(either, SPACECRAFT, "2029-08")
    replayed = make_monthly_report(either, SPACECRAFT, "2029-08", instance="replay")
    assert (flown.instance, flown.passes, flown.verdict) == (
        "flight", 1, "requirements met in every pass: 1 of 1 judged"
    )  # fmt: skip
    assert (replayed.instance, replayed.passes) == ("replay", 2)
    assert len(performance(either, SPACECRAFT).passes) == 1
    assert len(performance(either, SPACECRAFT, instance="replay").passes) == 2


def test_passes_without_a_report_are_counted_and_the_month_is_not_good(ground):
    add_pass(ground, 0)
    assert monthly_value(performance(ground, SPACECRAFT), "2029-08").verdict_level == "met"
    start = FIRST + DAY_NS
    define_pass(ground, name="no", start_utc_ns=start, stop_utc_ns=start + 10**12, spacecraft_id=SPACECRAFT)
    found = performance(ground, SPACECRAFT)
    assert (found.passes_in_span, len(found.passes)) == (2, 1)
    assert performance_lines(found).splitlines()[0] == "1 passes with a report, 1 without"
    value = monthly_value(found, "2029-08")
    assert value.verdict_level == "unknown"
    assert value.verdict.endswith("; 1 of 2 passes have a report")


def test_too_many_passes_are_one_clear_error(ground, monkeypatch):
    monkeypatch.setattr("ground_service.evaluation.performance.service.PASSES_LIMIT", 2)
    for number in range(3):
        add_pass(ground, number)
    with raises(InvalidInput, match=r"expected at most 2 passes .* found 3 passes"):
        performance(ground, SPACECRAFT)
    assert len(performance(ground, SPACECRAFT, start_utc_ns=FIRST + DAY_NS).passes) == 2


def test_the_failed_report_of_a_spacecraft_leaves_the_others(ground, september, monkeypatch, caplog):
    add_pass(ground, 0)
    with ground.database.writing() as connection:
        other = vehicle_id(connection, 5, FLOWN)
        row = dict(connection.execute(repository.PASSES.select()).mappings().one())
        del row["id"]
        repository.add(connection, repository.PASSES, **{**row, "vehicle_id": other, "name": "other"})
    made = service.make_due_report

    def broken(ground, spacecraft_id, instance=FLOWN):
        if spacecraft_id == 5:
            raise InvalidInput("report", "", "a value", "none")
        return made(ground, spacecraft_id, instance)

    monkeypatch.setattr(service, "make_due_report", broken)
    done = nightly(ground, {})
    assert [one["spacecraft_id"] for one in done["monthly_reports"]] == [SPACECRAFT]
    assert done["monthly_reports_failed"] == [5]
    assert "monthly report of spacecraft 5: failed: report: expected a value, found none" in caplog.text


def test_what_is_old_goes_before_anything_of_the_night_can_fail(ground, monkeypatch):
    def fail(_):
        raise InvalidInput("report", "", "a value", "none")

    monkeypatch.setattr(upkeep, "make_due_reports", fail)
    enter_job(ground, "nightly", {}, job_id=upkeep.nightly_job_id(utc_now_ns() - upkeep.DAY_NS))
    with ground.database.writing() as connection:
        for number in 1, 2:
            publish(connection, WindowChanged(id=number, state="processed"))
    with ground.database.writing() as connection:
        connection.execute(repository.EVENT_LOG.update().values(utc_ns=0))
    with raises(InvalidInput):
        nightly(ground, {})
    assert len(list(read_events(ground.database, 0))) == 1  # the newest stays


def test_the_first_processed_window_of_a_month_reports_the_last_one(ground, september):
    add_pass(ground, 0)
    assert make_due_report(ground, 5) is None
    with ground.database.writing() as connection:
        row = connection.execute(repository.PASSES.select()).mappings().one()
        values = {
            "vehicle_id": row["vehicle_id"],
            "pass_id": row["id"],
            "name": "w",
            "start_utc_ns": FIRST,
            "stop_utc_ns": FIRST + 10**12,
            "cadence_s": 15.0,
            "state": "processed",
            "version": 1,
            "decision": "approved",
            "data_octets": 1,
            "predicted": {},
            "closed": 0,
            "created_by": "a",
            "edited_by": "a",
            "created_utc_ns": 1,
            "changed_utc_ns": 1,
        }
        window = repository.add(connection, repository.WINDOWS, **values)
        publish(connection, WindowChanged(id=int(window), state="processed"))
    [made] = monthly(ground)
    assert (made.month, made.passes, made.spacecraft_id) == ("2029-08", 1, SPACECRAFT)
    assert nightly(ground, {})["monthly_reports"] == [
        {"spacecraft_id": SPACECRAFT, "month": "2029-08", "report": made.id}
    ]
    assert len(monthly(ground)) == 1


def test_operations_and_commands_give_the_same_report(ground, tmp_path, capsys):
    for number in range(14):
        add_pass(ground, number, **({"recall": 0.3} if number >= 7 else {}))
    with local_client(ground, "ann") as client:
        made = client.add_monthly_report(SPACECRAFT, "2029-08")
        assert [one.id for one in client.list_monthly_reports(spacecraft_id=SPACECRAFT)] == [made.id]
        assert list(client.list_monthly_reports(spacecraft_id=1)) == []
        for kind in "html", "pdf", "json":
            client.get_monthly_report(made.id, tmp_path / f"api.{kind}", format=kind)
        found = client.get_performance(SPACECRAFT, start=str(UtcTime(FIRST)), window_days=3.0)
        assert (len(found.passes), found.window_days) == (14, 3.0)
    page = (tmp_path / "api.html").read_text()
    assert "Changes of level" in page and "Monthly report" in page and "20 to 30 km" in page
    assert (tmp_path / "api.pdf").read_bytes().startswith(b"%PDF")
    document = json.loads((tmp_path / "api.json").read_text())
    assert document["kind"] == "MonthlyReportValue"
    assert [one["metric"] for one in document["changes"]] == ["recall"]

    def command(words, *out):
        return run(["performance", *words.split(), *map(str, out), "--home", str(ground.home)])

    report = f"report --spacecraft-id {SPACECRAFT} --month"
    assert command(f"{report} 2029-08 --out", tmp_path / "cli") == 0
    assert (tmp_path / "cli/report.html").read_text() == page
    capsys.readouterr()
    assert command(f"show --spacecraft-id {SPACECRAFT}") == 0
    printed = capsys.readouterr().out
    assert "change of recall at pass 8" in printed and "14 passes with a report" in printed
    assert command("list --json") == 0
    assert [one["id"] for one in json.loads(capsys.readouterr().out)["reports"]] == [made.id]
    assert command(f"{report} 2029-10 --out", tmp_path) == 2
    assert "expected passes with a report, found none" in capsys.readouterr().err


@mark.parametrize(
    "key, values, remark",
    [
        # Twelve passes, 36 degrees of freedom: 21.34 / 36 and 54.44 / 36 (tables of chi-square).
        ("consistency.nees", [0.3] * 11 + [0.42], "mean 0.31 of 12 passes: sigmas 1.8 times too large"),
        ("consistency.nees", [0.6] * 12, ""),
        ("consistency.nees", [1.5] * 12, ""),
        ("consistency.nees", [1.6] * 12, "mean 1.60 of 12 passes: sigmas 1.3 times too small"),
        ("consistency.nees", [9.0], ""),
        # Student's t: 0.7 +- 4.303 * 0.1 / sqrt(3) = 0.45 to 0.95, and 0.8 the same excludes nothing.
        ("consistency.nis", [0.6, None, 0.7, 0.8], "mean 0.70 of 3 passes: sigmas 1.2 times too large"),
        ("consistency.nis", [0.7, 0.8, 0.9], ""),
        ("accuracy.median", [0.1] * 12, ""),
    ],
)
def test_a_filter_is_judged_over_passes_by_both_bounds(key, values, remark):
    assert _consistency_remark(key, values) == remark
