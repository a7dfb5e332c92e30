"""Browser sessions: a cookie instead of a token; users, tokens and the audit log over HTTP."""

import pytest
from sqlalchemy import update

from ground_service.access import service as users
from ground_service.access.security import SESSION_COOKIE
from ground_service.app import create_app
from ground_service.settings import Settings
from ground_service.store import repository
from tests.ground_service.conftest import cells
from tests.serving import TestClient, token_valid

OWN = {"Origin": "http://testserver"}


@pytest.fixture
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
    users.revoke_token(ground, parent.id)
    assert client.get("/api/v1/session").status_code == 401


def test_a_session_ends_with_the_validity_of_its_token(client):
    ground = client.app.state.ground
    token = users.add_user(ground, "bob", "viewer", days_valid=0.1)
    start(client, token)
    expires = {one.expires for one in users.list_tokens(ground, "bob")}
    assert len(expires) == 1


def test_an_expired_session_is_refused_with_its_reason_and_changes_nothing(client, token):
    ground = client.app.state.ground
    start(client, token)
    with ground.database.writing() as connection:
        connection.execute(update(repository.TOKENS).values(expires_utc_ns=5))
    for answer in (client.get("/api/v1/passes"), client.post("/api/v1/windows", json={}, headers=OWN)):
        assert answer.status_code == 401 and "has expired" in answer.json()["detail"], answer.text
    # The page to sign in again is there.
    page = client.get("/", headers={"Accept": "text/html"})
    assert page.status_code == 200 and "has expired" not in page.headers.get("set-cookie", "")


def test_a_change_with_the_cookie_from_another_origin_is_refused(client, token):
    start(client, token)
    for headers in ({}, {"Origin": "https://example.org"}, {"Sec-Fetch-Site": "cross-site"}):
        answer = client.post("/api/v1/windows", json={}, headers=headers)
        assert answer.status_code == 403, headers
    assert client.post("/api/v1/windows", json={}, headers=OWN).status_code == 422


@pytest.fixture
def openmct(tmp_path):
    """A folder with the files of the npm package that the service reads."""
    folder = tmp_path / "openmct"
    (folder / "dist").mkdir(parents=True)
    (folder / "package.json").write_text('{"version": "4.2.0"}')
    (folder / "LICENSE.md").write_text("terms")
    (folder / "dist" / "openmct.js").write_text("script")
    (folder / "dist" / "secret.env").write_text("no file of the displays")
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


@pytest.mark.parametrize("missing", ["package.json", "LICENSE.md", "dist/openmct.js"])
def test_an_incomplete_installation_counts_as_none(tmp_path, openmct, missing):
    (openmct / missing).unlink()
    settings = Settings(home=tmp_path / "home", openmct=openmct)
    with TestClient(create_app(settings, inline_jobs=True)) as client:
        answer = client.get("/mct")
        assert answer.status_code == 200 and "make openmct" in answer.text


V1 = "/api/v1"


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


@pytest.mark.parametrize("body", BODIES.strip().splitlines())
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
    for query in ("since=yesterday", "actor=%00", "limit=0", f"since={newest['time']}&until=2020-01-01T00:00:00Z"):
        assert client.get(f"{V1}/audit?{query}", headers=heads["operator"]).status_code == 422, query
    assert client.get(f"{V1}/audit", headers=heads["admin"]).status_code == 200
