"""Alert rules and dashboard name metrics that exist; alerts fire; a request and its job have one trace."""

import json
import re
import shutil
import sys
from ast import literal_eval
from dataclasses import replace
from pathlib import Path

import yaml
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from prometheus_client.parser import text_string_to_metric_families
from pytest import MonkeyPatch, fixture, mark, raises, skip

from ground_service import logs
from ground_service.app import create_app
from ground_service.clock import utc_now_ns
from ground_service.errors import SettingsError
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import enter_job, get_job
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.worker import condition
from ground_service.worker.backup import backup
from ground_service.worker.condition import WorkCounts, newest_backup_utc_ns, read_condition
from ground_service.worker.jobs import run_job
from tests.ground_service.conftest import cells
from tests.serving import TestClient, ran

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
RULES = DEPLOY / "prometheus/linna.rules.yml"
DASHBOARD = DEPLOY / "grafana/linna.json"
NAME = re.compile(r"\blinna_[a-z_]+\b")
SELECTOR = re.compile(r"\b(linna_[a-z_]+)\{([^}]*)\}")
S = 1_000_000_000


def alerts():
    return [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]


def panels():
    return json.loads(DASHBOARD.read_text())["panels"]


def expressions():
    drawn = [target["expr"] for panel in panels() for target in panel["targets"]]
    return [rule["expr"] for rule in alerts()] + drawn


@fixture(scope="module")
def samples(tmp_path_factory, synthetic_pass):
    """Names of all samples of /metrics, with the names of their labels."""
    folder = tmp_path_factory.mktemp("observed")
    with open_ground(folder / "home") as ground:
        vehicle = ingest_file(ground, synthetic_pass.folder / "downlink.cadu").vehicle_id
        enter_job(ground, "report", {"pass_id": 1})
        add_correlation(ground, vehicle, utc_now_ns())
        backup(ground, folder / "backups/one", now_utc_ns=utc_now_ns())
    settings = Settings(home=folder / "home", backups=folder / "backups")

    def distributed(*given):
        return replace(read_condition(*given), broker=True, runner=True, processes={"worker": 2})

    with MonkeyPatch.context() as patched, TestClient(create_app(settings, inline_jobs=True)) as client:
        patched.setattr("ground_service.worker.metrics.read_condition", distributed)
        client.get("/api/v1/passes")
        text = client.get("/metrics").text
    return {
        sample.name: set(sample.labels) for family in text_string_to_metric_families(text) for sample in family.samples
    }


def add_correlation(ground, vehicle, created_utc_ns):
    with ground.database.writing() as connection:
        line = dict.fromkeys(["start_ticks", "stop_ticks", "reference_ticks", "reference_utc_ns", "drift_ppb"], 0)
        given = {"vehicle_id": vehicle, "method": "test", "points": 2, "created_utc_ns": created_utc_ns}
        repository.add(connection, repository.CORRELATIONS, **line, **given)


def test_metrics_and_labels_of_alerts_and_dashboard_are_those_of_the_condition(samples):
    for expression in expressions():
        named = set(NAME.findall(expression))
        assert named or "up{" in expression or "probe_ssl_earliest_cert_expiry{" in expression, expression
        assert named <= set(samples), expression
        for name, selector in SELECTOR.findall(expression):
            assert set(re.findall(r"(\w+)[=!]", selector)) <= samples[name], expression
        for grouped in re.findall(r"\bby \(([^)]*)\)", expression):
            labels = {label.strip() for label in grouped.split(",")}
            assert labels <= set().union(*(samples[name] for name in named)), expression
    used = {name for expression in expressions() for name in NAME.findall(expression)}
    families = {re.sub(r"_(bucket|count|sum|created|total)$", "", name) for name in samples}
    assert families == {re.sub(r"_(bucket|total)$", "", name) for name in used}


def test_every_alert_has_a_severity_a_summary_and_an_action_and_the_limit_of_the_status():
    names = [rule["alert"] for rule in alerts()]
    assert len(set(names)) == len(names) >= 10
    for rule in alerts():
        assert rule["labels"]["severity"] in ("page", "ticket")
        assert set(rule["annotations"]) == {"summary", "action"}
    limits = {rule["alert"]: [float(word) for word in re.findall(r"[<>] ([0-9.]+)", rule["expr"])] for rule in alerts()}
    names = (
        "QueueOld QUEUE_AGE_LIMIT_S IngestLag INGEST_LAG_LIMIT_S DiskFull DISK_FREE_LIMIT BackupOld BACKUP_AGE_LIMIT_S"
    )
    words = f"{names} TimeCorrelationOld CORRELATION_AGE_LIMIT_S".split()
    for alert, limit in zip(words[::2], words[1::2], strict=True):
        assert limits[f"Linna{alert}"] == [getattr(condition, limit)]
    assert f'instance="{condition.FLIGHT}"' in RULES.read_text()


GOOD = condition.Condition(WorkCounts({}, {}, 0, None, None), 0.0, 0.0, 50, 100, None, {}, "somebody")


COMPLAINTS = """
scheduler | None | No process does the recurring work.
broker | False | The broker does not answer.
processes | {"api": 2, "worker": 0} | No worker does jobs.
runner | False | No runner of payload builds responds.
disagreements | ("api b: other files than api a",) | Processes disagree: api b: other files than api a.
queue_age_s | 901.0 | A job has waited for 901 s.
ingest_lag_s | 601.0 | An ingest has been unfinished for 601 s.
disk_free | 9 | 9% of the disk of the archive are free.
backup_missing | True | No backup was found.
uncorrelated | (76,) | Spacecraft 76 has no time correlation.
backup_age_s | 97_200.0 | The newest backup is 27 h old.
correlation_ages_s | {(76, "flight"): 18e4, (76, "replay"): 1e9} | The time correlation of spacecraft 76 is 50 h old.
"""


@mark.parametrize("name, value, said", cells(COMPLAINTS))
def test_the_status_names_what_has_to_be_looked_after(name, value, said):
    assert condition.complaints(GOOD) == []
    assert condition.complaints(replace(GOOD, **{name: literal_eval(value)})) == [said]
    at_the_limit = {"queue_age_s": 900.0, "ingest_lag_s": 600.0, "disk_free": 10, "backup_age_s": 93_600.0}
    assert condition.complaints(replace(GOOD, **at_the_limit)) == []


FIRING = """
LinnaDown | up{job="linna"} = 1x5 0x20 1x200 | 20m | 40m
LinnaApiLost | up{job="linna"} = 1x200; up{job="linna",instance="b"} = 1x5 0x20 1x200 | 20m | 40m
LinnaNoWorker | linna_processes{kind="worker"} = 2x5 0x20 2x200 | 12m | 40m
LinnaProcessLost | linna_processes{kind="worker"} = 2x5 1x40 2x200 | 30m | 60m
LinnaNoRunner | linna_runner_up{kind="exchange"} = 1x5 0x20 1x200 | 20m | 40m
LinnaBrokerDown | linna_broker_up{kind="redis"} = 1x5 0x20 1x200 | 20m | 40m
LinnaDisagreement | linna_disagreements = 0x5 1x20 0x200 | 20m | 40m
LinnaNoScheduler | linna_scheduler = 1x5 0x20 1x200 | 20m | 40m
LinnaQueueOld | linna_queue_age_seconds = 0+60x40 0x200 | 40m | 60m
LinnaIngestLag | linna_ingest_lag_seconds = 0+60x40 0x200 | 40m | 60m
LinnaJobsFailed | linna_jobs{state="failed",kind="report"} = 0x20 1x200 | 40m | 120m
LinnaErrors | linna_http_requests_total{status="200"} = 0+100x300; \
    linna_http_requests_total{status="500"} = 0+5x40 200x200 | 30m | 60m
LinnaSlow | linna_http_request_seconds_bucket{method="GET",le="0.5"} = 0+1x60 60+100x200; \
    linna_http_request_seconds_bucket{method="GET",le="1.0"} = 0+100x60 6000+100x200; \
    linna_http_request_seconds_bucket{method="GET",le="+Inf"} = 0+100x60 6000+100x200 | 40m | 120m
LinnaDiskFull | linna_disk_free_bytes = 50x5 9x20 50x200 | 20m | 40m
LinnaBackupOld | linna_backup_age_seconds = 90000+60x200 60x200 | 180m | 240m
LinnaTimeCorrelationOld | linna_time_correlation_age_seconds{spacecraft_id="76",spacecraft_instance="flight"} \
    = 172000+60x120 0x200 | 120m | 160m
LinnaCertificateExpires | probe_ssl_earliest_cert_expiry{job="linna-proxy"} = 1123200x120 7776000x200 | 120m | 160m
"""
"""Alerts with the series that let them fire, and times at which they fire and have cleared."""


def test_prometheus_renames_no_label_of_a_metric(samples):
    """Its own labels `job` and `instance` replace those of a metric, so that a rule with them never fires."""
    assert not any({"job", "instance"} & labels for labels in samples.values())


def test_the_configuration_of_prometheus_is_valid_and_has_the_jobs_of_the_alerts():
    program = shutil.which("promtool")
    if program is None:
        skip("promtool is not installed")
    place = RULES.with_name("prometheus.yml")
    checked = ran([program, "check", "config", str(place)])
    assert checked.returncode == 0, checked.stdout + checked.stderr
    jobs = {one["job_name"] for one in yaml.safe_load(place.read_text())["scrape_configs"]}
    assert set(re.findall(r'job="([^"]+)"', RULES.read_text())) == jobs


HEALTHY = """
up{job="linna"} = 1x200
linna_scheduler = 1x200
linna_backup_age_seconds = 3600x200
linna_backup_configured = 1x200
probe_ssl_earliest_cert_expiry{job="linna-proxy"} = 1296000x200
linna_queue_age_seconds = 30x200
linna_processes{kind="worker"} = 2x200
linna_broker_up{kind="redis"} = 1x200
linna_runner_up{kind="exchange"} = 1x200
linna_disagreements = 0x200
linna_disk_free_bytes = 50x200
linna_disk_size_bytes = 100x200
linna_jobs{state="failed",kind="report"} = 2x200
"""
"""Series of a healthy service; times of certificates are 15 days."""


def series_of(text):
    """Return the input series of a test of rules, one a line: name = values."""
    rows = (line.rpartition(" = ") for line in text.strip().splitlines())
    return [{"series": name.strip(), "values": values} for name, _, values in rows]


def run_of(series, *expected):
    return {"interval": "1m", "input_series": series, "promql_expr_test": list(expected)}


def expectation(expression, at, value, labels="{}"):
    return {"expr": expression, "eval_time": at, "exp_samples": [{"labels": labels, "value": value}]}


def replicas_test(healthy):
    """One of two API processes fails, and both count the same failed job: no call, and one failure."""
    series, up = 'linna_jobs{state="failed",kind="report"', 'up{job="linna"'
    others = [one for one in healthy if not one["series"].startswith((series, up))]
    added = series_of(f"""
{up},instance="a"}} = 1x200
{up},instance="b"}} = 0x200
{series},instance="a"}} = 0x20 1x180
{series},instance="b"}} = 0x20 1x180
""")
    failed = 'ALERTS{alertstate="firing",alertname="LinnaJobsFailed"}'
    (rule,) = (one["expr"] for one in alerts() if one["alert"] == "LinnaJobsFailed")
    return run_of(
        others + added,
        expectation('count(ALERTS{alertname="LinnaDown"}) or vector(0)', "20m", 0),
        expectation('count(ALERTS{alertstate="firing",alertname="LinnaApiLost"})', "20m", 1),
        expectation(f"count({failed})", "70m", 1),
        expectation(f"round({rule})", "70m", 1, '{kind="report", state="failed"}'),
        expectation(f"count({failed}) or vector(0)", "150m", 0),
    )


def backup_tests(healthy):
    """Without a backup there is an alert if a folder is configured, otherwise none."""
    others = [one for one in healthy if not one["series"].startswith("linna_backup")]
    for configured in 0, 1:
        firing = 'count(ALERTS{alertstate="firing",alertname="LinnaBackupOld"}) or vector(0)'
        given = series_of(f"linna_backup_configured = {configured}x200")
        yield run_of(others + given, expectation(firing, "150m", configured))


def test_alerts_fire_and_only_when_they_should(tmp_path):
    program = shutil.which("promtool")
    if program is None:
        skip("promtool is not installed")
    checked = ran([program, "check", "rules", str(RULES)])
    assert checked.returncode == 0, checked.stderr
    healthy = series_of(HEALTHY)
    names = [rule["alert"] for rule in alerts()]
    tests = [run_of(healthy, expectation('count(ALERTS{alertstate="firing"}) or vector(0)', "3h", 0))]
    assert {row[0] for row in cells(FIRING)} == set(names)
    for name, text, fires, clears in cells(FIRING):
        series = series_of(text.replace("; ", "\n"))
        given = {one["series"] for one in series}
        others = [one for one in healthy if one["series"] not in given]
        firing = f'count(ALERTS{{alertstate="firing",alertname="{name}"}}) or vector(0)'
        expected = (expectation(firing, at, value) for at, value in (("1m", 0), (fires, 1), (clears, 0)))
        tests.append(run_of(others + series, *expected))
    tests += [replicas_test(healthy), *backup_tests(healthy)]
    document = {"rule_files": [str(RULES)], "evaluation_interval": "1m", "tests": tests}
    (tmp_path / "tests.yml").write_text(yaml.safe_dump(document))
    done = ran([program, "test", "rules", str(tmp_path / "tests.yml")])
    assert done.returncode == 0, done.stdout + done.stderr


def test_ages_of_waiting_work_and_of_correlations(either, synthetic_pass):
    idle = read_condition(either, None)
    assert (idle.queue_age_s, idle.ingest_lag_s, idle.backup_age_s) == (0.0, 0.0, None)
    assert 0 < idle.disk_free <= idle.disk_size and idle.scheduler is None
    vehicle = ingest_file(either, synthetic_pass.folder / "downlink.cadu").vehicle_id
    # A finished ingest does not wait. The jobs of the other ages are older than the test.
    assert read_condition(either, None).ingest_lag_s == 0.0
    waiting, done = (enter_job(either, "plan", {}) for _ in range(2))
    verdict = enter_job(either, "regression", {})  # it waits for its replays, which is no reason for a call
    run_job(either, done)
    now, jobs, ingests = utc_now_ns(), repository.JOBS, repository.INGESTS
    with either.database.writing() as connection:
        for job, age_s in (waiting, 1000), (verdict, 9000), (done, 9000):
            connection.execute(jobs.update().where(jobs.c.id == job).values(created_utc_ns=now - age_s * S))
        connection.execute(ingests.update().values(state="running", received_utc_ns=now - 2000 * S))
        connection.execute(repository.CORRELATIONS.delete())
    assert read_condition(either, None).uncorrelated == (76,)
    add_correlation(either, vehicle, now - 5000 * S)
    add_correlation(either, vehicle, now - 4000 * S)
    seen = read_condition(either, None)
    assert 1000.0 <= seen.queue_age_s < 2000.0 <= seen.ingest_lag_s < 3000.0
    assert idle.uncorrelated == seen.uncorrelated == ()
    ((key, age_s),) = seen.correlation_ages_s.items()
    assert key == (76, "flight") and 4000.0 <= age_s < 5000.0


def test_the_status_counts_jobs_of_all_kinds_by_state(either):
    enter_job(either, "report", {"pass_id": 1})
    run_job(either, enter_job(either, "plan", {}))
    enter_job(either, "plan", {})
    enter_job(either, "plan", {})
    seen = condition.service_status(either, None)
    assert seen.jobs == {"queued": 3, "done": 1} and seen.backup_age_s is None
    assert seen.complaints[0] == "No process does the recurring work."


def test_the_newest_complete_backup_counts(ground, tmp_path):
    assert newest_backup_utc_ns(tmp_path / "none") is None
    assert read_condition(ground, tmp_path / "none").backup_missing
    assert not read_condition(ground, None).backup_missing
    for name, made in ("a", 3000 * S), ("b", 2000 * S):
        backup(ground, tmp_path / "backups" / name, now_utc_ns=made)
    (tmp_path / "backups/c").mkdir()
    (tmp_path / "backups/c/backup.json").write_text('{"made_utc"')
    assert newest_backup_utc_ns(tmp_path / "backups") == 3000 * S


TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = f"00-{TRACE}-00f067aa0ba902b7-01"


def test_a_job_that_another_process_does_later_belongs_to_the_trace(ground):
    assert logs.current() is None
    with logs.span("request", parent=PARENT):
        job = enter_job(ground, "plan", {})
        inner = logs.current()
    assert logs.current() is None
    stored = ground.read(get_job, job).traceparent
    assert stored == inner != PARENT and logs.trace_id_of(stored) == TRACE


def test_spans_of_a_request_its_job_and_its_report_are_one_tree(tmp_path, synthetic_pass):
    exporter = InMemorySpanExporter()
    logs.configure(None, exporter=exporter)
    try:
        with TestClient(create_app(Settings(home=tmp_path), inline_jobs=True)) as client:
            pass_id = import_archive(client.app.state.ground, synthetic_pass.folder)
            exporter.clear()
            client.post(f"/api/v1/passes/{pass_id}/reports", headers={"traceparent": PARENT})
    finally:
        logs.stop()
    spans = {one.name: one for one in exporter.get_finished_spans()}
    request = spans["POST /api/v1/passes/{pass_id}/reports"]
    job, report = spans["job report"], spans["report"]
    assert f"{request.parent.span_id:016x}" == PARENT.split("-")[2]
    assert job.parent.span_id == request.context.span_id and report.parent.span_id == job.context.span_id
    assert {f"{one.context.trace_id:032x}" for one in (request, job, report)} == {TRACE}
    assert request.attributes["http.response.status_code"] in (201, 202)
    assert (job.attributes["linna.state"], report.attributes["linna.pass"]) == ("done", pass_id)


def test_traces_without_the_library_are_refused_with_a_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with raises(SettingsError, match="LINNA_TRACES: expected the extra 'traces'"):
        create_app(Settings(home=tmp_path, traces="http://127.0.0.1:4318/v1/traces"))
