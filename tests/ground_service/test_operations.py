"""Description of the HTTP API: names, summaries, errors, times, page links and query keys of all operations."""

import html
import json
import re
from datetime import datetime, timedelta
from pathlib import Path

from pytest import fixture, mark

from ground_service.access.service import add_user
from ground_service.app import create_app
from ground_service.clock import set_mission_clock
from ground_service.contacts.commanding.service import enter_command, release_command
from ground_service.http.model import UtcTime
from ground_service.http.requests import ALWAYS
from ground_service.missions.service import add_mission
from ground_service.passes.service import define_pass
from ground_service.planning import service as planning
from ground_service.planning.model import WindowEntry
from ground_service.settings import Settings
from tests.ground_service.conftest import START, add_reference, cells, save_circle
from tests.serving import TestClient

HOUR = 3600 * 10**9


def words(text):
    return set(text.split())


VERBS = words("""
accept acknowledge add approve change check define delete end enter evaluate export find get hold import keep
list refuse reject release render repeat request resume revoke run search send shelve start take uplink upload
withdraw
""")
SUMMARY_VERBS = words("""
Accept Acknowledge Add Approve Change Check Compare Count Create Define Delete Disable End Evaluate Export
Import Ingest Keep List Pause Queue Refuse Register Reject Release Render Request Return Revoke Run Search
Send Show Start Suppress Take Withdraw
""")
TAGS = words("""
access alarms ephemerides exports jobs landmarks links missions passes planning regression reports requests
status telecommands telemetry time
""")


@fixture(scope="module")
def client(tmp_path_factory):
    with TestClient(create_app(Settings(home=tmp_path_factory.mktemp("api")))) as opened:
        yield opened


@fixture(scope="module")
def operations(client):
    paths = client.get("/api/v1/openapi.json").json()["paths"]
    return [(method, path, one) for path, methods in paths.items() for method, one in methods.items()]


def test_operations_are_named_by_a_verb_and_a_noun(operations):
    ids = [one["operationId"] for _, _, one in operations]
    assert len(ids) > 60 and len(set(ids)) == len(ids)
    for identity in ids:
        assert re.fullmatch(r"[a-z]+(_[a-z]+)+", identity) and identity.split("_")[0] in VERBS, identity
        assert "view" not in identity.split("_"), identity


def test_a_body_that_needs_no_field_may_be_absent(client):
    document = client.get("/api/v1/openapi.json").json()
    seen = 0
    for path, methods in document["paths"].items():
        body = methods.get("post", {}).get("requestBody", {})
        schema = body.get("content", {}).get("application/json", {}).get("schema", {})
        name = str(schema.get("$ref", "")).rpartition("/")[2]
        if name and "required" not in document["components"]["schemas"][name]:
            assert not body.get("required"), path
            seen += 1
    assert seen >= 4


def test_summaries_fit_on_a_line_readers_declare_no_errors_of_writing_and_successes_have_a_type(operations):
    for method, path, one in operations:
        summary = one["summary"]
        assert summary.split()[0] in SUMMARY_VERBS, (method, path, summary)
        assert len(summary) <= 110 and not summary.endswith("."), summary
        assert len(one["tags"]) == 1 and one["tags"][0] in TAGS
    for method, path, one in operations:
        declared = {int(status) for status in one["responses"]}
        assert set(ALWAYS) <= declared, path
        assert (404 in declared) >= ("{" in path), path
        assert (400 in declared) == (413 in declared) == ("requestBody" in one), path
        if method == "get":
            assert not declared & {400, 409, 412, 413, 415, 507}, path
        else:
            assert 507 in declared, path
    for method, path, one in operations:
        (status,) = [status for status in one["responses"] if status.startswith("2")]
        content = one["responses"][status].get("content", {})
        if list(content) == ["application/json"]:  # documents in several media types are files
            schema = content["application/json"]["schema"]
            assert "$ref" in schema or "$ref" in schema.get("items", {}), (method, path, schema)


def test_every_operation_refuses_unknown_query_keys(client, operations):
    for method, path, _ in operations:
        answer = client.request(method, re.sub(r"\{\w+\}", "1", path), params={"unknown_key": "1"})
        assert answer.status_code == 422, (method, path, answer.text)
        assert "unknown_key" in answer.json()["detail"], answer.text


def test_times_are_read_by_the_date_types_of_python(client):
    ground = client.app.state.ground
    start = 1_880_777_100_123_456_789
    key = define_pass(ground, name="p", start_utc_ns=start, stop_utc_ns=start + 10**9, spacecraft_id=76)
    shown = client.get(f"/api/v1/passes/{key}").json()
    read = datetime.fromisoformat(shown["start"])
    assert read.utcoffset() == timedelta(0) and read.microsecond == 123_456
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z", shown["start"])
    assert UtcTime(start).utc_ns == start and UtcTime(start).datetime == read


BAD_FIELDS = """
{"spacecraft_id": 1024} | body.spacecraft_id: expected less than or equal to 1023, found '1024'
{"spacecraft": 76} | body.spacecraft: expected spacecraft_id, found an unknown field
{"name": null} | body.name: expected a valid string
{"start": 5} | body.start: expected a time such as 2029-08-07T06:00:00Z, found '5'
{"start": "tomorrow"} | body.start: expected a time such as 2029-08-07T06:00:00Z, found 'tomorrow'
{"start": "1815-12-10"} | body.start: expected a time between 1970 and 2130, found '1815-12-10'
"""


@mark.parametrize("change, detail", cells(BAD_FIELDS))
def test_a_fault_is_answered_with_what_was_expected_and_found(client, change, detail):
    given = {"name": "p", "start": "2029-08-07T06:00:00Z", "stop": "2029-08-07T06:37:00Z", "spacecraft_id": 76}
    answer = client.post("/api/v1/passes", json=given | json.loads(change))
    assert (answer.status_code, answer.json()["detail"]) == (422, detail)
    del given["name"]
    assert client.post("/api/v1/passes", json=given).json()["detail"] == "body.name: expected a value, found none"


def test_pages_of_a_list_link_to_each_other(client):
    ground = client.app.state.ground
    for number in range(5):
        define_pass(ground, name=f"w{number}", start_utc_ns=0, stop_utc_ns=10**9, spacecraft_id=77)
    total = client.get("/api/v1/passes").json()["total"]
    address = "/api/v1/passes?limit=2"
    found = []
    previous = None
    while address is not None:
        page = client.get(address).json()
        assert page["previous"] == previous
        found += [one["id"] for one in page["items"]]
        previous = f"/api/v1/passes?limit=2&offset={page['offset']}"
        address = page["next"]
    assert len(found) == len(set(found)) == total >= 5


def test_links_keep_the_filter_of_a_list(client):
    for number in range(2):
        client.post("/api/v1/telecommands", json={"name": "test_connection", "spacecraft_id": 76 + number})
    page = client.get("/api/v1/telecommands?state=queued&limit=1").json()
    assert page["next"] == "/api/v1/telecommands?state=queued&limit=1&offset=1"
    assert client.get(page["next"]).json()["next"] is None


REFUSALS = re.findall(
    r"^\| (?P<mistake>[^|]+) \| `(?P<request>[A-Z]+ [^` ]+)`(?: `(?P<body>[^`]*)`)?(?: with `(?P<header>[^`]+)`)? "
    r"\| (?P<status>\d{3}) \| (?P<line>.+) \|$",
    (Path(__file__).parents[2] / "docs/results/http-mistakes.md").read_text(),
    re.MULTILINE,
)


@fixture(scope="module")
def shift(tmp_path_factory):
    """A service with an approved window, a released and a critical telecommand; headers of each role."""
    home = tmp_path_factory.mktemp("shift")
    set_mission_clock(lambda: START)
    with TestClient(create_app(Settings(home=home), inline_jobs=True)) as opened:
        ground = opened.app.state.ground
        headers = {
            role: {"Authorization": f"Bearer {add_user(ground, role, role)}"}
            for role in ("viewer", "operator", "admin")
        }
        add_mission(ground, b'name = "m"\n[spacecraft]\nid = 76\nname = "SelenITA"\n')
        add_reference(ground, save_circle(home / "a.oem"))
        planning.add_window(ground, WindowEntry("w", START + HOUR, START + HOUR + HOUR // 6, 15.0, 76), actor="ann")
        planning.change_window(ground, 1, actor="ann", changes={}, decision="approved")
        reboot = {"function_id": "reboot"}
        for name, arguments in ("test_connection", {}), ("perform_function", reboot):
            enter_command(ground, name, arguments, spacecraft_id=76, actor="operator")
        release_command(ground, 1, actor="operator")
        yield opened, headers


def test_each_mistake_of_the_documents_is_refused_with_its_line(shift, now):
    client, headers = shift
    assert len(REFUSALS) >= 40
    for mistake, request, body, header, status, line in REFUSALS:
        method, path = request.split(" ", 1)
        role = next((one for one in ("viewer", "admin") if one in mistake.split()), "operator")
        sent = {} if mistake == "no token" else dict(headers[role])
        if body.startswith("{"):
            sent["Content-Type"] = "application/json"
        if header:
            sent |= [header.split(": ", 1)]
        content = body.encode() if body or (method == "POST" and "telemetry" in path) else None
        answer = client.request(method, f"/api/v1/{path}", headers=sent, content=content)
        found = answer.json()["detail"]
        assert (answer.status_code, mistake) == (int(status), mistake), found
        assert re.fullmatch(re.escape(html.unescape(line)).replace("…", ".*"), found), f"{mistake}: {found}"
