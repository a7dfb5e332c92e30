"""The HTTP interface: operations, problem documents, authorisation, limits."""

import asyncio
import json
import math
import re
import threading

from pytest import approx, fixture, raises

from ground_service.app import create_app
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from tests.ground_service.conftest import cells
from tests.serving import TestClient
from tmtc.downlink import DownlinkEncoder
from tmtc.link.frames import Clcw, pack_clcw

V1 = "/api/v1"


@fixture(scope="module")
def client(synthetic_pass, tmp_path_factory):
    """A service without users, with the synthetic pass in it; not to be given users."""
    settings = Settings(home=tmp_path_factory.mktemp("api"), upload_limit_mib=2)
    with TestClient(create_app(settings, inline_jobs=True)) as opened:
        import_archive(opened.app.state.ground, synthetic_pass.folder)
        yield opened


def is_problem(response, status):
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert body["status"] == status
    assert body["title"] and body["detail"]
    return True


def test_an_upload_is_ingested_and_doubles_nothing(client, make_pass):
    stream = (make_pass(frames=3, seed=9).folder / "downlink.cadu").read_bytes()
    first = client.post(f"{V1}/telemetry", content=stream, headers={"Idempotency-Key": "a"})
    assert first.status_code == 202, first.text
    ingest = client.get(first.headers["location"]).json()
    assert ingest["state"] == "done"
    assert ingest["accounting"]["packets_new"] == ingest["accounting"]["packets"] > 0
    again = client.post(f"{V1}/telemetry", content=stream, headers={"Idempotency-Key": "a"}).json()
    assert again == first.json()
    third = client.post(f"{V1}/telemetry", content=stream).json()
    assert third["ingest_id"] != first.json()["ingest_id"]
    assert client.get(f"{V1}/ingests/{third['ingest_id']}").json()["accounting"]["packets_new"] == 0


def test_an_upload_that_is_no_downlink_becomes_a_failed_ingest(client):
    accepted = client.post(f"{V1}/telemetry", content=b"hello world" * 1000).json()
    ingest = client.get(f"{V1}/ingests/{accepted['ingest_id']}").json()
    assert ingest["state"] == "failed"
    assert "expected a stream of CADUs or of space packets" in ingest["error"]
    assert is_problem(client.post(f"{V1}/telemetry", content=b""), 422)


def test_an_upload_over_the_limit_is_refused_announced_or_not(client):
    assert is_problem(client.post(f"{V1}/telemetry", content=b"\0" * (3 << 20)), 413)
    blocks = (b"\0" * (1 << 18) for _ in range(12))
    assert is_problem(client.post(f"{V1}/telemetry", content=blocks), 413)
    assert is_problem(client.post(f"{V1}/passes", content=b"[" * (2 << 20)), 413)


def test_the_telecommand_receiver_is_shown_as_the_newest_telemetry_tells_it(client, make_pass):
    packets = make_pass(frames=3, seed=11).packets

    def receive(clcw):
        stream = DownlinkEncoder(76).encode(packets, clcw=None if clcw is None else pack_clcw(clcw))
        return int(client.post(f"{V1}/telemetry?instance=uplink", content=stream).json()["ingest_id"])

    def shown():
        return list(client.get(f"{V1}/spacecraft/76/uplink?instance=uplink").json()["channels"])

    assert is_problem(client.get(f"{V1}/spacecraft/76/uplink?instance=nobody"), 404)
    receive(None)  # as recorded before frames had the field
    assert shown() == []
    locked = receive(Clcw(0, 4, lockout=True, farm_b_counter=1))
    assert [(one["ingest_id"], one["lockout"], one["frames_lockout"] > 0) for one in shown()] == [(locked, True, True)]
    ready = receive(Clcw(0, 4, farm_b_counter=2))
    receive(None)
    (channel,) = shown()
    assert (channel["ingest_id"], channel["lockout"], channel["farm_b_counter"]) == (ready, False, 2)


def test_passes_are_listed_in_pages_and_shown(client):
    page = client.get(f"{V1}/passes?limit=1").json()
    assert page["total"] >= 1
    assert len(page["items"]) == 1
    shown = client.get(f"{V1}/passes/1").json()
    assert shown["name"] == "synthetic pass"
    assert shown["start"] == "2029-08-07T06:00:00.000000Z"
    for path, status in ("/999", 404), ("/x", 422), ("?limit=0", 422):
        assert is_problem(client.get(f"{V1}/passes{path}"), status)


def test_a_pass_can_be_defined(client):
    span = {"start": "2029-08-07T06:00:00Z", "stop": "2029-08-07T07:00:00Z"}
    given = {"name": "p", "spacecraft_id": 76, **span}
    assert client.post(f"{V1}/passes", json=given).status_code == 201
    assert is_problem(client.post(f"{V1}/passes", json={**given, "stop": "2029-08-07T05:00:00Z"}), 422)


def test_what_is_in_a_pass_can_be_read(client, synthetic_pass):
    complete = client.get(f"{V1}/passes/1/completeness").json()
    assert (complete["packets"], complete["lost"]) == (len(synthetic_pass.packets), 0)
    found = client.get(f"{V1}/passes/1/detections?limit=5&offset=3").json()
    assert len(found["items"]) == 5
    assert found["total"] > 1000
    assert client.get(f"{V1}/passes/1/events").json()["items"][0]["name"] == "observation_stopped"


def test_pages_of_detections_put_together_are_all_of_them_once(client):
    def page(limit, offset):
        return list(client.get(f"{V1}/passes/1/detections?limit={limit}&offset={offset}").json()["items"])

    total = client.get(f"{V1}/passes/1/detections?limit=1").json()["total"]
    large = [item for offset in range(0, total, 1000) for item in page(1000, offset)]
    small = [item for offset in range(0, 300, 7) for item in page(7, offset)]
    assert len(large) == total and small == large[: len(small)]
    assert page(10, total - 3) == large[-3:] and page(10, total) == []
    assert sorted(large, key=lambda item: item["time"]) == large


def test_a_series_asked_for_twice_is_the_same(client):
    path = f"{V1}/passes/1/states?estimator=spherical&value=altitude_m&value=nis&max_points=5"
    first, second = client.get(path), client.get(path)
    assert first.content == second.content
    assert [one["name"] for one in first.json()["series"]] == ["altitude_m", "nis"]
    assert first.headers["content-type"] == "application/json"


def test_series_are_made_short_with_their_extremes(client):
    states = client.get(f"{V1}/passes/1/states?estimator=spherical&value=altitude_m&max_points=7").json()
    buckets = states["series"][0]["buckets"]
    assert len(buckets) <= 7
    assert sum(bucket["count"] for bucket in buckets) == 40
    assert all(b["min"] <= b["mean"] <= b["max"] for b in buckets)
    assert {len(one["start"]) for one in buckets} == {len("2029-08-07T00:00:00.000000Z")}
    temperature = client.get(f"{V1}/passes/1/telemetry/temperature_c").json()
    assert (temperature["unit"], temperature["samples"]) == ("degC", 40)
    assert temperature["buckets"][-1]["max"] == approx(23.9)
    assert is_problem(client.get(f"{V1}/passes/1/telemetry/salary"), 404)
    assert is_problem(client.get(f"{V1}/passes/1/states?estimator=nobody"), 404)
    assert is_problem(client.get(f"{V1}/passes/1/states?value=salary"), 422)


def test_a_page_gets_the_head_of_a_report_and_its_errors_made_short(client):
    job = client.get(client.post(f"{V1}/passes/1/reports").headers["location"]).json()
    address = f"{V1}/reports/{job['result']['report_id']}"
    whole = client.get(address, params={"format": "json"}).json()
    answer = client.get(f"{address}/overview?max_points=7")
    short = answer.json()
    assert all(short[name] == whole[name] != [] for name in ("verdict", "headline", "requirements"))
    assert [one["name"] for one in short["navigation"]] == [one["name"] for one in whole["navigation"]]
    for brief, full in zip(short["navigation"], whole["navigation"], strict=True):
        known = [math.hypot(*error) for error in full["error_rtn_m"] if None not in error]
        assert len(brief["time_s"]) == min(7, len(known))
        assert min(brief["min_m"]) == approx(min(known), abs=1e-3)
        assert max(brief["max_m"]) == approx(max(known), abs=1e-3)
        columns = ("min_m", "max_m", "mean_m", "after_gap")
        assert all(len(brief[column]) == len(brief["time_s"]) for column in columns)
    again = client.get(f"{address}/overview?max_points=7", headers={"if-none-match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert is_problem(client.get(f"{V1}/reports/{'0' * 32}/overview"), 404)
    assert is_problem(client.get(f"{address}/overview?max_points=0"), 422)


def test_a_report_is_made_and_read_as_html_and_json(client):
    asked = client.post(f"{V1}/passes/1/reports")
    assert asked.status_code == 202
    job = client.get(asked.headers["location"]).json()
    assert job["state"] == "done", job
    report = f"{V1}/reports/{job['result']['report_id']}"
    page = client.get(report, headers={"accept": "text/html"})
    assert page.headers["content-type"].startswith("text/html")
    assert "synthetic pass" in page.text
    assert client.get(report, params={"format": "json"}).json()
    paper = client.get(report, headers={"accept": "text/html;q=0.5, application/pdf"})
    assert paper.headers["content-type"] == "application/pdf"
    assert paper.content.startswith(b"%PDF-")
    assert client.get(report, headers={"accept": "*/*"}).headers["content-type"] == "application/json"
    assert is_problem(client.get(report, params={"format": "exe"}), 422)
    assert is_problem(client.get(f"{V1}/reports/{'0' * 32}"), 404)
    assert is_problem(client.post(f"{V1}/passes/77/reports"), 404)


def test_an_ephemeris_is_uploaded_once(client, synthetic_pass):
    octets = (synthetic_pass.folder / "reference.oem").read_bytes()
    first = client.post(f"{V1}/ephemerides", content=octets, params={"name": "reference"})
    assert first.status_code == 201, first.text
    assert first.json()["frame"] == "ICRF"
    assert client.post(f"{V1}/ephemerides", content=octets, params={"name": "reference"}).json() == first.json()
    refused = client.post(f"{V1}/ephemerides", content=b"not an ephemeris")
    assert is_problem(refused, 422)
    assert "/files/" not in refused.text


def test_answers_carry_secure_headers_and_no_cors(client):
    answer = client.get(f"{V1}/passes", headers={"Origin": "https://elsewhere.example"})
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert "access-control-allow-origin" not in answer.headers


def test_the_service_can_be_watched(client):
    assert client.get("/healthz").json() == {"status": "ok"}
    assert client.get("/readyz").json() == {"status": "ok"}


def test_the_description_is_complete(client):
    document = client.get(f"{V1}/openapi.json").json()
    for path, operations in document["paths"].items():
        assert path.startswith(V1)
        for method, operation in operations.items():
            assert ("security" in operation) == ((method, path) != ("post", f"{V1}/session"))
            assert "application/problem+json" in json.dumps(operation["responses"]["422"])


# Viewers read and operators do everything else, except these.
EXCEPTIONS = {
    tuple(operation.split()): role
    for operation, role in cells("""
GET /audit | operator
GET /audit/head | operator
GET /users | admin
POST /users | admin
GET /users/{name} | admin
PATCH /users/{name} | admin
POST /users/{name}/tokens | admin
GET /tokens | admin
DELETE /tokens/{token_id} | admin
POST /exports | viewer
POST /windows/search | viewer
DELETE /session | viewer
""")
}


def test_every_operation_asks_for_its_role(guarded):
    client, heads = guarded
    ranks = ["viewer", "operator", "admin"]
    described = client.get(f"{V1}/openapi.json", headers=heads["viewer"]).json()
    operations = {(m.upper(), p.removeprefix(V1)) for p, verbs in described["paths"].items() for m in verbs}
    operations.remove(("POST", "/session"))  # whose token is in the body
    assert len(operations) > 60 and operations >= set(EXCEPTIONS)
    for method, template in sorted(operations):
        lowest = EXCEPTIONS.get((method, template), "viewer" if method == "GET" else "operator")
        path = re.sub(r"\{\w+\}", "999", template)
        assert is_problem(client.request(method, V1 + path), 401), path
        assert is_problem(client.request(method, V1 + path, headers={"Authorization": "Bearer x"}), 401), path
        for role in ranks:
            status = client.request(method, V1 + path, headers=heads[role]).status_code
            if ranks.index(role) < ranks.index(lowest):
                assert status == 403, (path, role)
            else:
                assert status not in (401, 403), (path, role)


def test_what_happens_is_sent_live_and_can_be_caught_up_with(client, make_pass):
    def payload_of(message):
        return message["payload"]["id"], message["payload"]["state"]

    stream = (make_pass(frames=3, seed=9).folder / "downlink.cadu").read_bytes()
    other = threading.Thread(target=lambda: client.post(f"{V1}/telemetry", content=b"no downlink"))
    with client.websocket_connect(f"{V1}/live") as socket:
        other.start()  # as the nightly job does, another may come between the messages of a job
        job = client.post(f"{V1}/telemetry", content=stream).json()["job_id"]
        other.join()
        messages = [socket.receive_json()]
        while messages[-1]["kind"] != "job" or payload_of(messages[-1]) != (job, "done"):
            messages.append(socket.receive_json())
    jobs = [payload_of(message) for message in messages if message["kind"] == "job"]
    states = [state for number, state in jobs if number == job]
    assert states == ["queued", "running", "done"]
    numbers = [m["sequence"] for m in messages]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    with client.websocket_connect(f"{V1}/live?after={numbers[0]}") as socket:
        assert [socket.receive_json() for _ in numbers[1:]] == messages[1:]


def test_a_socket_opens_whose_server_announces_the_client_late(client):
    """The first message of a socket may come after its handler started; nothing else may take it."""
    plain = """{"type": "websocket", "scheme": "ws", "path": "/api/v1/live", "root_path": "", "subprotocols": [],
        "extensions": {}, "client": ["testclient", 50000], "server": ["testserver", 80]}"""
    octets = {"raw_path": b"/api/v1/live", "query_string": b"", "headers": [(b"host", b"testserver")]}
    scope = json.loads(plain) | octets

    async def opened():
        arriving = asyncio.Queue()
        sent = asyncio.Queue()
        handler = asyncio.ensure_future(client.app(scope, arriving.get, sent.put))
        await asyncio.sleep(0.5)
        await arriving.put({"type": "websocket.connect"})
        try:
            return await asyncio.wait_for(sent.get(), 20)
        finally:
            await arriving.put({"type": "websocket.disconnect", "code": 1000})
            handler.cancel()
            await asyncio.wait([handler])

    assert client.portal.call(opened)["type"] == "websocket.accept"


def test_watching_needs_a_token_where_there_are_users(guarded):
    from starlette.websockets import WebSocketDisconnect

    client, heads = guarded
    token = heads["viewer"]["Authorization"].removeprefix("Bearer ")
    for headers in {}, {"Authorization": "Bearer wrong"}:
        with raises(WebSocketDisconnect), client.websocket_connect(f"{V1}/live", headers=headers):
            pass
    with client.websocket_connect(f"{V1}/live", headers=heads["viewer"]):
        pass
    with client.websocket_connect(f"{V1}/live", subprotocols=["bearer", token]) as socket:
        assert socket.accepted_subprotocol == "bearer"


def test_figures_are_kept_by_route(client):
    client.get(f"{V1}/passes/1")
    figures = client.get("/metrics").text
    assert 'linna_http_requests_total{method="GET",route="/api/v1/passes/{pass_id}",status="200"}' in figures
    assert "linna_passes 1.0" in figures or "linna_passes 2.0" in figures


def test_requests_are_logged_with_an_id_that_the_answer_carries(client, caplog):
    with caplog.at_level("INFO", "ground_service.worker.metrics"):
        named = client.get(f"{V1}/passes/999", headers={"X-Request-ID": "abc-1"})
        made_up = client.get(f"{V1}/passes", headers={"X-Request-ID": "two\tlines"})
        client.get("/healthz")
    assert named.headers["X-Request-ID"] == "abc-1"
    logged = [vars(record) for record in caplog.records if record.name == "ground_service.worker.metrics"]
    assert [(one["status"], one["route"], one["caller"]) for one in logged] == [
        (404, "/api/v1/passes/{pass_id}", "local"),
        (200, "/api/v1/passes", "local"),
    ]
    assert [one["request_id"] for one in logged] == ["abc-1", made_up.headers["X-Request-ID"]]
    assert len(made_up.headers["X-Request-ID"]) == 16


def test_json_that_no_reader_takes_is_refused_in_one_line(client):
    for body in b"[" * 500_000, b"1" * 500_000:
        answer = client.post(f"{V1}/windows", content=body, headers={"Content-Type": "application/json"})
        assert is_problem(answer, 400)
        assert "expected JSON of ordinary depth" in answer.json()["detail"]


def test_a_telecommand_that_is_sent_again_under_its_key_is_queued_once(guarded):
    client, heads = guarded
    operator = heads["operator"] | {"Idempotency-Key": "k1"}
    ping = {"name": "test_connection", "arguments": {}, "spacecraft_id": 76}

    def post(path, headers, **body):
        return client.post(f"{V1}{path}", headers=headers, **body)

    first = post("/telecommands", operator, json=ping)
    again = post("/telecommands", operator, json=ping)
    assert (first.status_code, again.status_code) == (201, 201) and again.json() == first.json()
    assert client.get(f"{V1}/telecommands", headers=operator).json()["total"] == 1
    # A key belongs to one request of one caller.
    assert is_problem(post("/telecommands", operator, json={**ping, "timeout_s": 7}), 409)
    other = heads["admin"] | {"Idempotency-Key": "k1"}
    assert post("/telecommands", other, json=ping).json()["id"] == 2
    # What was refused may be asked for again.
    wrong = {**operator, "Idempotency-Key": "k2"}
    assert is_problem(post("/telecommands", wrong, json={**ping, "name": "dance"}), 422)
    assert post("/telecommands", wrong, json=ping).status_code == 201

    # An uplink whose answer is lost on the way is not lost.
    assert post("/telecommands/1/release", operator).status_code == 200
    query = {"params": {"spacecraft_id": 76}}
    taken, once_more = post("/uplink", operator, **query), post("/uplink", operator, **query)
    assert taken.headers["X-Telecommands"] == once_more.headers["X-Telecommands"] == "1"
    assert taken.content == once_more.content != b""
    assert post("/uplink", {**operator, "Idempotency-Key": "later"}, **query).content == b""


def test_passes_and_windows_sent_again_under_their_key_are_entered_once(client):
    span = {"start": "2029-08-07T06:00:00Z", "stop": "2029-08-07T06:05:00Z", "spacecraft_id": 76}
    for path, more in ("/passes", {}), ("/windows", {"cadence_s": 15.0}):
        headers, body = {"Idempotency-Key": f"key {path}"}, {"name": "once", **more, **span}
        first, again = (client.post(f"{V1}{path}", json=body, headers=headers) for _ in range(2))
        assert (first.status_code, again.status_code) == (201, 201), first.text
        assert first.json() == again.json()
        assert all(first.headers.get(name) == again.headers.get(name) for name in ("Location", "ETag"))


def test_figures_of_work_that_is_over_go_away(tmp_path, monkeypatch):
    from ground_service.jobs.service import enter_job
    from ground_service.worker.jobs import run_job

    monkeypatch.setattr("ground_service.worker.scheduler.TICK_S", 600.0)  # it would take the job up
    with TestClient(create_app(Settings(home=tmp_path), inline_jobs=True)) as opened:
        ground = opened.app.state.ground
        job = enter_job(ground, "report", {"pass_id": 1})
        figures = opened.get("/metrics").text
        for line in 'report",state="queued"} 1.0', 'report",state="failed"} 0.0', 'plan",state="failed"} 0.0':
            assert f'linna_jobs{{kind="{line}' in figures
        assert "linna_backup_configured 0.0" in figures and "linna_backup_age_seconds{" not in figures
        run_job(ground, job)
        figures = opened.get("/metrics").text
    assert 'linna_jobs{kind="report",state="failed"} 1.0' in figures
    assert 'state="queued"' not in figures


def test_jobs_left_unfinished_are_taken_up_again(synthetic_pass, tmp_path):
    from ground_service.ground import open_ground
    from ground_service.jobs.service import enter_job

    with open_ground(tmp_path) as ground:
        import_archive(ground, synthetic_pass.folder)
        left = enter_job(ground, "report", {"pass_id": 1})
    with TestClient(create_app(Settings(home=tmp_path), inline_jobs=True)) as opened:
        assert opened.get(f"{V1}/jobs/{left}").json()["state"] == "done"
