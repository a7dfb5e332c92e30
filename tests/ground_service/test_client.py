"""Client of the ground service: retries, problem details, paging, streams and coverage of the API."""

import inspect
import json
import re
import sys
import threading
import tracemalloc
from asyncio import run
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import httpx
from pytest import fixture, mark, raises

from ground_service.app import create_app
from ground_service.client import Client, ServiceProblem, connection
from ground_service.client.connection import ATTEMPTS, BUSY_S, JobFailed, Unreachable
from ground_service.client.local import local_client
from ground_service.client.transport import LocalTransport, OperationsOnDemand
from ground_service.ground import open_ground
from ground_service.settings import Settings
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service import client_generator
from tests.ground_service.conftest import cells, event_packet
from tests.serving import ran
from tmtc.downlink import encode_cadus

EPHEMERIS = json.loads("""{"id": 1, "name": "reference.oem", "object_name": "SELENITA", "frame": "ICRF", "states": 241,
    "precedence": 0, "start": "2029-08-07T00:00:00.000000Z", "stop": "2029-08-07T01:00:00.000000Z", "sha256": "00"}""")
MIB = 1 << 20


class Clock:
    """Clock of the client, which advances during sleep."""

    def __init__(self):
        self.now = 0.0
        self.slept = []

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


class Service:
    """Server with prepared responses, of which the last one is repeated; it records the received bodies."""

    def __init__(self):
        self.answers = []
        self.bodies = []
        self.octets_received = 0
        service = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                octets = int(self.headers.get("Content-Length", "0"))
                if octets > MIB:
                    while service.octets_received < octets:
                        service.octets_received += len(self.rfile.read(min(MIB, octets)))
                else:
                    service.bodies.append(self.rfile.read(octets))
                status, headers = service.answers[min(len(service.bodies), len(service.answers)) - 1]
                self._answer(status, headers, json.dumps(EPHEMERIS if status < 300 else {"detail": "busy now"}))

            def do_GET(self):
                self.send_response(200)
                self.end_headers()
                for _ in range(64):
                    self.wfile.write(b"\0" * MIB)

            def _answer(self, status, headers, text):
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text.encode())

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,))
        self.thread.start()
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"


@fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(connection, "time", made)
    return made


@fixture
def service():
    made = Service()
    yield made
    made.server.shutdown()
    made.server.server_close()
    made.thread.join()


@fixture
def body(tmp_path):
    path = tmp_path / "reference.oem"
    path.write_bytes(b"octets " * 1000)
    return path


def client_of(answer):
    """Return a client whose requests are answered by a function."""
    return Client("http://ground", "secret", transport=httpx.MockTransport(answer))


def test_an_upload_that_finds_the_service_busy_is_sent_again_whole(service, clock, body):
    service.answers = [(503, {"Retry-After": "1"}), (503, {"Retry-After": "3"}), (201, {})]
    assert Client(service.url).add_ephemeris(body).model_dump(mode="json") == EPHEMERIS
    assert clock.slept == [1.0, 3.0]
    assert service.bodies == [body.read_bytes()] * 3


def test_a_service_that_stays_busy_is_given_up_in_its_own_words(service, clock, body):
    service.answers = [(503, {"Retry-After": "600"})]
    with raises(ServiceProblem, match="busy now") as caught:
        Client(service.url).add_ephemeris(body)
    assert caught.value.status == 503
    assert clock.slept == [10.0] * int(BUSY_S / 10.0)  # it waits 10 s at most, however long it is asked to


@mark.parametrize(
    "answer", [(503, {}), (503, {"Retry-After": "soon"}), (500, {"Retry-After": "1"}), (409, {}), (429, {})]
)
def test_what_is_no_invitation_to_come_again_is_reported_at_once(service, clock, body, answer):
    service.answers = [answer]
    with raises(ServiceProblem) as caught:
        Client(service.url).add_ephemeris(body)
    assert caught.value.status == answer[0]
    assert (len(service.bodies), clock.slept) == (1, [])


@mark.parametrize(
    "call, attempts",
    [
        (lambda client: client.evaluate_pass(1), ATTEMPTS),
        (lambda client: client.enter_telecommand("test_connection", 76), ATTEMPTS),
        (lambda client: client.release_telecommand(1), 1),
        (lambda client: client.change_window(1, {"state": "approved"}), 1),
        (lambda client: client.delete_window(1), 1),
    ],
)
def test_after_a_broken_connection_only_safe_requests_and_those_with_a_key_are_repeated(clock, call, attempts):
    keys = []

    def answer(request):
        keys.append(request.headers.get("Idempotency-Key"))
        raise httpx.RemoteProtocolError("server disconnected")

    with raises(Unreachable, match="http://ground: the connection broke: server disconnected"):
        call(client_of(answer))
    assert len(keys) == attempts
    assert len(set(keys)) == 1  # the key stays the same, so the service processes the request once


def test_a_service_that_cannot_be_reached_is_not_asked_again(clock):
    def answer(_):
        raise httpx.ConnectError("connection refused")

    with raises(Unreachable, match="http://ground: cannot be reached: connection refused"):
        client_of(answer).evaluate_pass(1)
    assert clock.slept == []


KINDS = """
401 | NotAuthenticated
403 | NotPermitted
404 | NotFound
409 | Conflict
412 | Conflict
422 | InvalidRequest
507 | Unavailable
500 | ServiceProblem
302 | ServiceProblem
"""


@mark.parametrize("status, kind", cells(KINDS))
def test_a_refusal_is_an_exception_of_its_kind_with_the_problem_details(status, kind):
    text = f"""{{"type": "about:blank", "title": "t", "status": {status}, "detail": "window 3: no", "state": "draft",
        "new_field": 1}}"""
    with raises(ServiceProblem) as caught:
        client_of(lambda _: httpx.Response(int(status), text=text)).get_window(3)
    assert (type(caught.value).__name__, str(caught.value.status), str(caught.value)) == (kind, status, "window 3: no")
    assert caught.value.problem.state == "draft"


def test_a_response_of_another_program_is_reported_with_the_server():
    with raises(ServiceProblem, match="http://ground: expected JSON of a LINNA service, found other"):
        client_of(lambda _: httpx.Response(200, text="<html>")).get_job("0" * 32)
    with raises(ServiceProblem, match="404 Not Found") as caught:
        client_of(lambda _: httpx.Response(404, text="<html>")).get_job("0" * 32)
    assert caught.value.problem is None


def test_a_failed_job_is_an_exception_with_its_error():
    job = """{"id": "00", "kind": "ingest", "state": "failed", "progress": 0.0, "attempts": 1, "arguments": {},
        "result": null, "error": "no downlink", "created": "2029-08-07T00:00:00Z", "started": null, "finished": null,
        "traceparent": null}"""
    with raises(JobFailed, match="no downlink"):
        client_of(lambda _: httpx.Response(200, text=job)).wait("00")


def passes_of(total, asked):
    """Return a service with passes of which it sends at most 1000 in a page."""

    def answer(request):
        limit, offset = int(request.url.params["limit"]), int(request.url.params["offset"])
        asked.append((limit, offset))
        span = {"start": "2029-08-07T00:00:00Z", "stop": "2029-08-07T01:00:00Z"}
        items = [
            {"id": number, "name": "p", "spacecraft_id": 76, "instance": "flight", **span}
            for number in range(offset, min(offset + limit, total))
        ]
        return httpx.Response(200, json={"items": items, "total": total, "limit": limit, "offset": offset})

    return answer


@mark.parametrize("total, pages", [(0, 1), (999, 1), (1000, 1), (1001, 2), (2500, 3)])
def test_a_list_is_fetched_page_by_page_until_its_end(total, pages):
    asked = []
    client = client_of(passes_of(total, asked))
    assert [one.id for one in client.list_passes()] == list(range(total))
    assert asked == [(1000, 1000 * number) for number in range(pages)]


PAGES = """
1 | 1 | [(1, 0)]
0 | 1 | [(1, 0)]
50 | 50 | [(50, 0)]
1200 | 1200 | [(1000, 0), (200, 1000)]
5000 | 2500 | [(1000, 0), (1000, 1000), (1000, 2000)]
"""


@mark.parametrize("limit, expected, requests", cells(PAGES))
def test_a_page_has_as_many_items_as_asked_for(limit, expected, requests):
    asked = []
    page = client_of(passes_of(2500, asked)).list_passes().page(int(limit))
    assert (str(len(page.items)), page.total, str(asked)) == (expected, 2500, requests)


def test_a_list_that_shrinks_while_it_is_fetched_ends():
    def answer(request):
        return httpx.Response(200, json={"items": [], "total": 7, "limit": 1, "offset": 0})

    assert list(client_of(answer).list_passes()) == []
    assert client_of(answer).list_passes().page(5).items == []


def peak_of(work):
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_large_files_are_sent_and_received_in_blocks(service, tmp_path):
    large = tmp_path / "large"
    with large.open("wb") as stream:
        stream.truncate(64 * MIB)
    service.answers = [(201, {})]
    with Client(service.url) as client:
        assert peak_of(lambda: client.add_ephemeris(large)) < 8 * MIB
        assert service.octets_received == 64 * MIB
        target = tmp_path / "reports/report.pdf"
        assert peak_of(lambda: client.get_report("0" * 32, target, format="pdf")) < 8 * MIB
    assert target.stat().st_size == 64 * MIB


def test_a_download_that_breaks_leaves_no_file(tmp_path, clock):
    class Broken(httpx.SyncByteStream):
        def __iter__(self):
            yield b"half"
            raise httpx.ReadError("connection reset")

    with raises(Unreachable):
        client_of(lambda _: httpx.Response(200, stream=Broken())).get_report("0" * 32, tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


ARGUMENTS = json.loads("""{"constraints": {"a": 1}, "window": {"a": 1}, "change": {"a": 1},
    "plan": {"a": 1}, "request": {"a": 1}, "points": [{"a": 1}], "receptions": [{"a": 1}], "document": {"a": 1},
    "version": 1, "pinned": true, "format": "csv"}""") | {"file": b"octets"}


def test_the_operations_are_generated_from_the_routes():
    assert client_generator.TARGET.read_text() == client_generator.generate()


def operations_of(tmp_path):
    document = create_app(Settings(home=tmp_path)).openapi()
    return [
        (path, verb.upper(), operation)
        for path, operations in document["paths"].items()
        for verb, operation in operations.items()
    ]


def test_every_operation_of_the_api_has_a_method_of_its_name_with_its_path_keys_and_result(tmp_path):
    sent = []

    def answer(request):
        sent.append(request)
        return httpx.Response(418, json={})

    client = client_of(answer)
    operations = operations_of(tmp_path)
    assert len(operations) > 60
    for path, verb, operation in operations:
        method = getattr(client, operation["operationId"])
        given = inspect.signature(method).parameters.values()
        known = {item["name"] for item in operation.get("parameters", []) if item["in"] == "query"}
        values = {
            one.name: tmp_path / "out"
            if one.name == "out"
            else ARGUMENTS.get(one.name, 1 if one.name.endswith("_id") else "x")
            for one in given
            if one.default is one.empty or one.name in known or one.name in ("if_match", "key")
        }
        if operation["operationId"] in ("add_ephemeris", "upload_archive", "keep_archive", "add_build"):
            values["file"] = Path(__file__)
        result = None
        with raises(ServiceProblem):
            result = method(**values)
            list(result)  # a list sends its request when it is iterated
        request = sent[-1]
        pattern = re.sub(r"\{\w+\}", "[^/]+", path)
        assert (request.method, bool(re.fullmatch(pattern, request.url.path))) == (verb, True), path
        assert set(request.url.params) == known & {*request.url.params, *values, "limit", "offset"}, path
        heads = {item["name"] for item in operation.get("parameters", []) if item["in"] == "header"}
        assert {name for name in ("Idempotency-Key", "If-Match") if name in request.headers} == heads, path
        assert ("requestBody" in operation) == bool(request.headers.get("content-type")), path
        success = next(found for code, found in operation["responses"].items() if code.startswith("2"))
        schema = json.dumps(success.get("content", {}).get("application/json", {}).get("schema", {}))
        found = re.search(r"schemas/([A-Za-z]+?)(?:Page)?\"", schema)
        returned = str(inspect.signature(method).return_annotation)
        assert (found is None) == (returned in ("None", "Uplink", "dict[str, Any]")), path
        assert found is None or re.search(rf"\b{found[1]}\b", returned), path


def test_a_client_that_is_not_closed_lets_python_end(tmp_path):
    script = "import linna; passes = linna.open({!r}); print(len(passes))"
    open_ground(tmp_path / "home").close()
    command = [sys.executable, "-c", script.format(str(tmp_path / "home"))]
    done = ran(command)
    assert (done.returncode, done.stdout, done.stderr) == (0, "0\n", "")


def test_lists_in_one_response_are_lists_of_entities(tmp_path):
    with local_client(open_ground(tmp_path / "home"), "ann") as ground:
        ground.ingest_file(encode_cadus([event_packet(1, 0)], spacecraft_id=76))
        assert [(one.spacecraft_id, one.instance) for one in ground.list_spacecraft()] == [(76, "flight")]
        assert "oem" in [one.name for one in ground.list_export_formats()]


def test_the_example_of_the_documentation_runs(tmp_path, capsys, monkeypatch):
    text = (Path(__file__).parents[2] / "docs/client.md").read_text()
    example = text.split("```python\n")[1].split("```")[0]
    assert len(example.strip().splitlines()) <= 15
    first = int(ticks_from_utc_ns(parse_utc("2029-08-07T06:01:00Z")))
    packets = [event_packet(first + number, number, event="boot") for number in range(5)]
    downlink = tmp_path / "downlink.cadu"
    downlink.write_bytes(encode_cadus(packets, spacecraft_id=76))
    with local_client(open_ground(tmp_path / "home"), "ann") as ground:
        ground.ingest_file(downlink)
        span = {"start": "2029-08-07T06:00:00Z", "stop": "2029-08-07T06:10:00Z"}
        ground.define_pass("evening pass", spacecraft_id=76, **span)

    class OnThisMachine(Client):
        """Client that ignores the address of the example."""

        def __init__(self, _server, token=None):
            transport = LocalTransport(open_ground(tmp_path / "home"), "ann")
            super().__init__("http://localhost", token, transport=transport)

    monkeypatch.setattr("ground_service.client.Client", OnThisMachine)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/client.md", "exec"), {})
    assert capsys.readouterr().out.splitlines() == [
        "5 packets", "evening pass 2029-08-07T06:00:00.000000Z 0 packets lost",
        "['boot', 'boot', 'boot', 'boot', 'boot']", "404 pass 99: not found",
    ]  # fmt: skip


def test_operations_are_looked_for_under_the_last_word_of_their_path_that_names_some():
    app = AsyncMock(state=Mock(operations=[]), include_router=Mock())
    scope = {"type": "http", "method": "POST", "path": "/api/v1/passes/1/reports"}
    run(OperationsOnDemand(app)(scope, None, None))
    assert {"request_report", "get_report"} <= {route.name for route in app.state.operations}
    assert "define_pass" not in {route.name for route in app.state.operations}
