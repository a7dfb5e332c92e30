"""Callers who are limited to missions; browser sessions; users, tokens and the audit log over HTTP."""

import re
from dataclasses import dataclass
from types import SimpleNamespace

from fastapi.routing import APIRoute
from pytest import fixture, mark, raises
from sqlalchemy import BigInteger, Float, Integer, LargeBinary, SmallInteger, func, select, update
from starlette.datastructures import QueryParams

from ground_service.access import service as users
from ground_service.access.model import AuditFilter
from ground_service.access.scopes import DECIDED, ROWS, Scope, check_scope, scope_of
from ground_service.access.security import SESSION_COOKIE
from ground_service.access.service import Caller, add_token, add_user, authenticate, change_user
from ground_service.access.store import list_audit, owner_of
from ground_service.app import create_app
from ground_service.errors import Forbidden
from ground_service.missions.service import add_mission
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.store.event_kinds import (
    CommandStateChanged,
    CorrelationChanged,
    HandoverChanged,
    LinkChanged,
    PlanChanged,
    RequestChanged,
    WindowChanged,
    publish,
)
from ground_service.store.events import LoggedEvent
from ground_service.store.models import METADATA
from ground_service.web.sockets import event_owner
from lunar.timescales import format_utc
from tests.ground_service.conftest import START, cells, save_circle
from tests.serving import TestClient, token_valid
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

V1 = "/api/v1"
OURS, THEIRS = 78, 76
KEY, REVISION = "0" * 32, "76" * 32
DESCRIPTION = """
name = "{name}"
[spacecraft]
id = {number}
name = "{name}"
[[links]]
name = "{name}"
kind = "file"
downlink = "/nowhere/{name}"
"""
SAMPLE = create_app(Settings())
CHECKED = [
    route
    for route in SAMPLE.state.operations
    if isinstance(route, APIRoute)
    and (
        "requires.<locals>.check" in repr([one.call for one in route.dependant.dependencies])
        or route.path.startswith(V1)
        or route.name.endswith("report_page")
        or route.name == "regression_page"
    )
]
NAMES = [f"{'/'.join(sorted(route.methods))} {route.path}" for route in CHECKED]
OPEN = ("all", "list", "content")
OURS_LISTED = {"list_ingests": 1, "list_missions": 1, "list_spacecraft": 1, "list_links": 1}
"""Numbers of entries of spacecraft 78."""


@dataclass(frozen=True)
class Fleet:
    """A service with a row of spacecraft 76 in each table, and a caller of the mission of spacecraft 78 only.

    The caller has uploaded frames of both.
    """

    client: TestClient
    ours: Caller
    theirs: Caller
    token: str

    @property
    def headers(self):
        return {"Authorization": f"Bearer {self.token}"}

    @property
    def cookie(self):
        return {"Cookie": f"linna_session={self.token}"}


def dummy(column):
    if isinstance(column.type, BigInteger | Integer | SmallInteger):
        return 1
    if isinstance(column.type, Float):
        return 1.0
    if isinstance(column.type, LargeBinary):
        return b""
    return {} if str(column.type) == "JSON" else KEY


def row_of(connection, table, **given):
    """Insert a row with these values, and others that only have the type of their columns."""
    needed = [one for one in table.c if not one.nullable and one.name not in given]
    repository.add(connection, table, **{one.name: dummy(one) for one in needed}, **given)


@fixture(scope="module")
def fleet(tmp_path_factory):
    settings = Settings(home=tmp_path_factory.mktemp("fleet"), links=False, plan_hourly=False)
    with TestClient(create_app(settings, inline_jobs=True)) as client:
        ground = client.app.state.ground
        for name, number in ("ours", OURS), ("theirs", THEIRS):
            add_mission(ground, DESCRIPTION.format(name=name, number=number).encode())
        tables = METADATA.tables
        with ground.database.writing() as connection:
            row_of(connection, tables["files"], sha256=KEY)
            row_of(connection, tables["vehicles"], id=1, ccsds_id=THEIRS, instance="flight")
            row_of(connection, tables["vehicles"], id=2, ccsds_id=OURS, instance="flight")
            row_of(connection, tables["passes"], id=1, vehicle_id=1)
            row_of(connection, tables["missions"], id=9, revision=REVISION, ccsds_id=THEIRS, entered_by="archive")
            row_of(connection, tables["links"], name="theirs", ccsds_id=THEIRS)
            row_of(connection, tables["ingests"], id=1, vehicle_id=1)
            for name in "landmarks", "monthly_reports":
                row_of(connection, tables[name], spacecraft_id=THEIRS)
            for name in "windows", "standing_requests", "telecommands", "alarms":
                row_of(connection, tables[name], id=1, vehicle_id=1)
            row_of(connection, tables["reports"], pass_id=1)
        token = add_user(ground, "ann", "admin", missions=["ours"])
        other = add_user(ground, "bob", "admin", missions=["theirs"])
        made = Fleet(client, authenticate(ground, token), authenticate(ground, other), token)
        values = {"event_id": 20, "frame_number": 1, "value_1": 0.0, "value_2": 0.0}
        packets = [DICTIONARY.pack("event_low", values, ticks=k << 16, sequence_count=k) for k in range(200)]
        octets = b"".join(encode_cadus(packets, spacecraft_id=one) for one in (THEIRS, OURS, THEIRS))
        answer = client.post(f"{V1}/telemetry?spacecraft_id={OURS}", content=octets, headers=made.headers)
        assert answer.status_code == 202, answer.text
        yield made


def values_of(route):
    """Return the path parameters of a request about spacecraft 76."""
    known = {"spacecraft_id": str(THEIRS), "report_id": KEY, "revision": REVISION, "name": "theirs"}
    known |= {"job_id": KEY, "key": KEY, "regression_id": KEY, "sha256": REVISION, "digest": REVISION}
    known |= {"parameter": "x", "packet": "x", "month": "2029-08"}
    return {name: known.get(name, "1") for name in re.findall(r"{(\w+)", route.path)}


def test_every_decision_is_that_of_an_operation():
    names = {route.name for route in SAMPLE.state.operations}
    assert len(CHECKED) > 100
    assert [one for found in DECIDED.values() for one in found if one not in names] == []


@mark.parametrize("route", CHECKED, ids=NAMES)
def test_an_operation_reaches_only_spacecraft_of_the_callers_missions(route, fleet):
    scope = scope_of(route)
    assert scope is not None, "decide in ground_service/access/scopes.py which spacecraft it concerns"
    values = values_of(route)
    stated = {scope.parameter: 1 if scope.parameter in ROWS else THEIRS}
    query = QueryParams(stated if scope.place == "query" else {})
    body = stated if scope.place == "body" else None
    if scope.decision not in OPEN:
        for method in route.methods - {"HEAD"}:
            path = route.path.format(**values)
            headers = fleet.headers if path.startswith(V1) else fleet.cookie
            answer = fleet.client.request(method, path, params=dict(query), json=body, headers=headers)
            assert answer.status_code == 403, answer.text
            assert "expected a spacecraft of the missions ours, found" in answer.json()["detail"]
    state = SimpleNamespace(ground=fleet.client.app.state.ground)
    asked = SimpleNamespace(
        scope={"route": route}, path_params=values, query_params=query, _json=body,
        app=SimpleNamespace(state=state),
    )  # fmt: skip
    for caller in Caller("eve", "viewer"), fleet.theirs:
        if scope.decision == "service" and caller.missions is not None:
            with raises(Forbidden, match="found an operation of the whole service"):
                check_scope(asked, caller)
        else:
            check_scope(asked, caller)


@mark.parametrize("name", sorted(DECIDED["list"]))
def test_a_list_leaves_out_other_spacecraft(name, fleet):
    (route,) = (one for one in CHECKED if one.name == name)
    answer = fleet.client.get(route.path, headers=fleet.headers)
    assert answer.status_code == 200, answer.text
    assert "theirs" not in answer.text and f'"spacecraft_id":{THEIRS}' not in answer.text
    assert answer.json().get("total", 0) == OURS_LISTED.get(name, 0)


def test_an_operation_without_a_decision_and_a_spacecraft_that_is_not_stated_are_refused(fleet):
    async def new(): ...

    route = APIRoute("/new", new)
    assert scope_of(route) is None
    asked = SimpleNamespace(scope={"route": route})
    with raises(Forbidden, match="operation of the whole service"):
        check_scope(asked, fleet.ours)
    answer = fleet.client.post(f"{V1}/telemetry", content=b"x", headers=fleet.headers)
    assert answer.status_code == 403
    assert "as spacecraft_id, found none" in answer.json()["detail"]
    search = {"spacecraft_id": None, "start": format_utc(START), "stop": format_utc(START + 10**12)}
    assert fleet.client.post(f"{V1}/windows/search", json=search, headers=fleet.headers).status_code == 403
    assert fleet.client.get(f"{V1}/parameters", headers=fleet.headers).status_code == 403
    assert fleet.client.get(f"{V1}/parameters?spacecraft_id={OURS}", headers=fleet.headers).status_code != 403
    (route,) = (one for one in CHECKED if one.path == f"{V1}/parameters")
    for both in (OURS, THEIRS), (THEIRS, OURS):
        query = QueryParams([("spacecraft_id", one) for one in both])
        with raises(Forbidden, match=f"found spacecraft_id {THEIRS} of another one"):
            check_scope(SimpleNamespace(scope={"route": route}, query_params=query), fleet.ours)


def test_frames_of_other_spacecraft_in_an_upload_are_not_stored(fleet):
    count = select(func.count()).select_from(METADATA.tables["packets"])
    with fleet.client.app.state.ground.database.reading() as connection:
        stored = {one: connection.scalar(count.filter_by(vehicle_id=one)) for one in (1, 2)}
    assert stored == {1: 0, 2: 200}


def test_a_description_or_ephemeris_of_another_mission_is_refused(fleet, tmp_path):
    for name, number in ("ours", THEIRS), ("theirs", OURS), ("theirs", THEIRS), ("ours", 5):
        text = DESCRIPTION.format(name=name, number=number) + "[evidence]\nseed = 1\n"
        answer = fleet.client.post(f"{V1}/missions", content=text.encode(), headers=fleet.headers)
        assert answer.status_code == 403, answer.text
    text = DESCRIPTION.format(name="ours", number=OURS)
    assert fleet.client.post(f"{V1}/missions", content=text.encode(), headers=fleet.headers).status_code == 201
    orbit = save_circle(tmp_path / "orbit.oem").read_text()
    added = {}
    for name in "NOBODY", "THEIRS", "OURS":
        named = re.sub(r"(OBJECT_NAME\s*=\s*)\S.*", rf"\g<1>{name}", orbit)
        answer = fleet.client.post(f"{V1}/ephemerides", content=named.encode(), headers=fleet.headers)
        added[name] = answer.status_code
        if name == "THEIRS":
            unlimited = {"Authorization": f"Bearer {add_user(fleet.client.app.state.ground, 'eve', 'operator')}"}
            foreign = fleet.client.post(f"{V1}/ephemerides", content=named.encode(), headers=unlimited).json()["id"]
        elif name == "OURS":
            own = answer.json()["id"]
    assert added == {"NOBODY": 403, "THEIRS": 403, "OURS": 201}
    assert fleet.client.delete(f"{V1}/ephemerides/{foreign}", headers=fleet.headers).status_code == 403
    assert fleet.client.delete(f"{V1}/ephemerides/{own}", headers=fleet.headers).status_code == 204


def test_a_token_limits_its_user_further_and_so_do_its_sessions(fleet):
    client, ground = fleet.client, fleet.client.app.state.ground
    add_user(ground, "fay", "viewer", missions=["ours", "theirs"])
    token = add_token(ground, "fay", missions=["ours", "elsewhere"])
    assert authenticate(ground, token).missions == ("ours",)
    assert authenticate(ground, token).spacecraft == {OURS}
    started = client.post(f"{V1}/session", json={"token": token})
    assert started.json()["missions"] == ["ours"]
    cookie = {"Cookie": f"linna_session={started.cookies['linna_session']}"}
    client.cookies.clear()
    assert client.get(f"{V1}/passes/1", headers=cookie).status_code == 403
    change_user(ground, "fay", missions=["theirs"])
    assert authenticate(ground, token).spacecraft == frozenset()
    change_user(ground, "fay", missions=[])
    assert authenticate(ground, token).spacecraft == {OURS}


def test_a_socket_sends_only_events_of_the_callers_spacecraft(fleet):
    ground = fleet.client.app.state.ground
    with fleet.client.websocket_connect(f"{V1}/live", headers=fleet.headers) as socket:
        for vehicle in 1, 2:
            ground.write(publish, CorrelationChanged(vehicle_id=vehicle, segments=1))
        for number in THEIRS, OURS:
            ground.write(publish, HandoverChanged(spacecraft_id=number, instance="flight", held_by="ann"))
        assert socket.receive_json()["payload"]["vehicle_id"] == 2
        assert socket.receive_json()["payload"]["spacecraft_id"] == OURS
    with fleet.client.websocket_connect(f"{V1}/live?after=0", headers=fleet.headers) as socket:
        assert socket.receive_json()["payload"]["mission"] == "ours"


@mark.parametrize(
    "event",
    [
        WindowChanged(id=1, state="approved"), CommandStateChanged(id=1, state="sent"),
        LinkChanged(link="theirs", state="connected"), RequestChanged(id=1, state="active"),
        PlanChanged(request_id=1, windows_added=(1,)),
    ],
)  # fmt: skip
def test_an_event_of_a_row_is_of_the_spacecraft_of_the_row(event, fleet):
    logged = LoggedEvent(1, 0, event.event_kind, event.model_dump(mode="json"))
    assert event_owner(fleet.client.app.state.ground, logged) == THEIRS


def test_a_scope_names_its_parameter():
    (route,) = (one for one in CHECKED if one.name == "enter_telecommand")
    assert scope_of(route) == Scope("spacecraft", "body", "spacecraft_id")


def test_the_beginning_of_revisions_of_two_spacecraft_belongs_to_neither(fleet):
    ground = fleet.client.app.state.ground
    owners = [ground.read(owner_of, ("missions",), REVISION[:length]) for length in (64, 8, 0)]
    assert owners == [THEIRS, THEIRS, None]


OWN = {"Origin": "http://testserver"}


@fixture
def token(client):
    return users.add_user(client.app.state.ground, "ann", "operator")


def start(client, token):
    answer = client.post("/api/v1/session", json={"token": token}, headers=OWN)
    assert answer.status_code == 200, answer.text


def test_a_session_needs_no_token_in_requests(client, token):
    answer = client.post("/api/v1/session", json={"token": token}, headers=OWN)
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie and "max-age=43200" in cookie
    assert token not in cookie
    found = client.get("/api/v1/session").json()
    assert (found["name"], found["role"], found["browser"]) == ("ann", "operator", True)
    assert client.get("/api/v1/passes").status_code == 200


def test_a_wrong_token_starts_no_session(client, token):
    answer = client.post("/api/v1/session", json={"token": token + "x"}, headers=OWN)
    assert answer.status_code == 401 and "set-cookie" not in answer.headers


def test_a_session_ends_when_its_user_is_disabled_and_stays_ended(client, token):
    ground = client.app.state.ground
    start(client, token)
    users.change_user(ground, "ann", state="disabled")
    assert client.get("/api/v1/session").status_code == 401
    users.change_user(ground, "ann", state="active")
    assert client.get("/api/v1/session").status_code == 401
    assert token_valid(ground, token)  # tokens of programs are valid again


def test_sign_out_ends_the_session_and_not_the_token(client, token):
    start(client, token)
    secret = client.cookies[SESSION_COOKIE]
    assert client.delete("/api/v1/session", headers=OWN).status_code == 204
    client.cookies.set(SESSION_COOKIE, secret)  # a copy of the cookie
    assert client.get("/api/v1/session").status_code == 401
    client.cookies.clear()
    bearer = {"Authorization": f"Bearer {token}"}
    assert client.get("/api/v1/session", headers=bearer).json()["browser"] is False
    assert client.delete("/api/v1/session", headers=bearer).status_code == 204
    assert client.get("/api/v1/session", headers=bearer).status_code == 200


def test_revocation_of_the_token_ends_its_sessions(client, token):
    ground = client.app.state.ground
    start(client, token)
    (parent,) = [one for one in users.list_tokens(ground, "ann") if one.parent_id is None]
    (session,) = [one for one in users.list_tokens(ground, "ann") if one.parent_id is not None]
    assert session.parent_id == parent.id
    (noted,) = ground.read(list_audit, AuditFilter(action="start session")).items
    assert (noted.actor, noted.target) == ("ann", "ann")
    assert noted.detail == {"token_id": session.id, "parent_id": parent.id}
    users.revoke_token(ground, parent.id)
    assert client.get("/api/v1/session").status_code == 401


def test_an_expired_session_is_refused_with_its_reason_and_changes_nothing(client, token):
    ground = client.app.state.ground
    start(client, token)
    with ground.database.writing() as connection:
        connection.execute(update(repository.TOKENS).values(expires_utc_ns=5))
    for answer in client.get("/api/v1/passes"), client.post("/api/v1/windows", json={}, headers=OWN):
        assert answer.status_code == 401 and "has expired" in answer.json()["detail"], answer.text
    # The page to sign in again is there.
    page = client.get("/", headers={"Accept": "text/html"})
    assert page.status_code == 200 and "has expired" not in page.headers.get("set-cookie", "")


def test_a_change_with_the_cookie_from_another_origin_is_refused(client, token):
    start(client, token)
    for headers in {}, {"Origin": "https://example.org"}, {"Sec-Fetch-Site": "cross-site"}:
        answer = client.post("/api/v1/windows", json={}, headers=headers)
        assert answer.status_code == 403, headers
    assert client.post("/api/v1/windows", json={}, headers=OWN).status_code == 422


@fixture
def openmct(tmp_path):
    """A folder with the files of the npm package that the service reads."""
    folder = tmp_path / "openmct"
    (folder / "dist").mkdir(parents=True)
    (folder / "package.json").write_text('{"version": "4.2.0"}')
    (folder / "LICENSE.md").write_text("terms")
    (folder / "dist/openmct.js").write_text("script")
    (folder / "dist/secret.env").write_text("no file of the displays")
    return folder


def test_the_displays_open_with_a_session_only(tmp_path, openmct):
    settings = Settings(home=tmp_path / "home", openmct=openmct)
    with TestClient(create_app(settings, inline_jobs=True)) as client:
        token = users.add_user(client.app.state.ground, "ann", "viewer")
        answer = client.get("/mct", follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, "/?next=/mct")
        start(client, token)
        answer = client.get("/mct", follow_redirects=False)
        assert answer.status_code == 200 and "/mct/4.2.0/openmct.js" in answer.text
        assert "'unsafe-eval'" in answer.headers["content-security-policy"]
        assert client.get("/mct/4.2.0/openmct.js").text == "script"
        assert client.get("/mct/4.2.0/secret.env").status_code == 404


@mark.parametrize("missing", ["package.json", "LICENSE.md", "dist/openmct.js"])
def test_an_incomplete_installation_counts_as_none(tmp_path, openmct, missing):
    (openmct / missing).unlink()
    settings = Settings(home=tmp_path / "home", openmct=openmct)
    with TestClient(create_app(settings, inline_jobs=True)) as client:
        answer = client.get("/mct")
        assert answer.status_code == 200 and "make openmct" in answer.text


def test_an_administrator_manages_users(guarded):
    client, heads = guarded
    admin = heads["admin"]
    made = client.post(f"{V1}/users", json={"name": "ann", "role": "viewer", "days_valid": 2}, headers=admin)
    assert made.status_code == 201, made.text
    mine = {"Authorization": f"Bearer {made.json()['token']}"}
    assert client.get(f"{V1}/passes", headers=mine).status_code == 200
    assert client.get(f"{V1}/users/ann", headers=admin).json() == made.json()["user"]
    names = [one["name"] for one in client.get(f"{V1}/users", headers=admin).json()["items"]]
    assert names == ["admin", "ann", "operator", "viewer"]
    (token,) = client.get(f"{V1}/tokens?user=ann", headers=admin).json()["items"]
    shown = "id user hint state created expires revoked used parent_id kind missions"
    assert set(token) == set(shown.split())
    assert made.json()["token"] not in str(token)
    changed = client.patch(f"{V1}/users/ann", json={"state": "disabled"}, headers=admin)
    assert changed.json()["state"] == "disabled"
    assert client.get(f"{V1}/passes", headers=mine).status_code == 401
    again = client.patch(f"{V1}/users/ann", json={"state": "disabled"}, headers=admin)
    assert again.status_code == 409
    assert again.json()["detail"] == "user ann: expected state active, found disabled"


BODIES = r"""
{"name": "ann", "role": "root"}
{"name": "ann", "role": "viewer", "days_valid": true}
{"name": "ann", "role": "viewer", "days_valid": -1}
{"name": "ann", "role": "viewer", "days_valid": "3"}
{"name": 5, "role": "viewer"}
{"name": "a\nb", "role": "viewer"}
{"name": "ann", "role": "viewer", "admin": true}
"""


@mark.parametrize("body", BODIES.strip().splitlines())
def test_a_user_that_cannot_be_added_is_refused(guarded, body):
    client, heads = guarded
    assert (
        client.post(
            f"{V1}/users", content=body, headers=heads["admin"] | {"Content-Type": "application/json"}
        ).status_code
        == 422
    )
    assert client.get(f"{V1}/users", headers=heads["admin"]).json()["total"] == 3


def test_operators_read_who_did_what(guarded):
    client, heads = guarded
    client.patch(f"{V1}/users/viewer", json={"state": "disabled"}, headers=heads["admin"])
    page = client.get(f"{V1}/audit?limit=2", headers=heads["operator"]).json()
    assert (page["total"], [one["number"] for one in page["items"]]) == (4, [4, 3])
    newest = page["items"][0]
    assert (newest["actor"], newest["action"], newest["target"]) == ("admin", "disable user", "viewer")
    head = client.get(f"{V1}/audit/head", headers=heads["operator"]).json()
    assert head == {"number": 4, "sha256": newest["sha256"]}
    queries = f"""
actor=admin | 4
action=user | 4 3 2 1
action=add | 3 2 1
action=%25 |
target=viewer | 4 1
since={newest["time"]} | 4
until={newest["time"]} | 3 2 1
offset=3 | 1
"""
    for query, numbers in cells(queries):
        found = client.get(f"{V1}/audit?{query}", headers=heads["operator"]).json()
        assert " ".join(str(one["number"]) for one in found["items"]) == numbers, query
    for query in "since=yesterday", "actor=%00", "limit=0", f"since={newest['time']}&until=2020-01-01T00:00:00Z":
        assert client.get(f"{V1}/audit?{query}", headers=heads["operator"]).status_code == 422, query
    assert client.get(f"{V1}/audit", headers=heads["admin"]).status_code == 200
