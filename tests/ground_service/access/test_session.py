"""Browser sessions: a cookie instead of a token, ended by sign-out, time and revocation of the token."""

from pathlib import Path

import pytest
from sqlalchemy import update

from ground_service.access import service as users
from ground_service.access.security import SESSION_COOKIE
from ground_service.app import create_app
from ground_service.settings import Settings
from ground_service.store import repository
from tests.serving import TestClient, token_valid

OWN = {"Origin": "http://testserver"}


@pytest.fixture
def token(client: TestClient) -> str:
    return users.add_user(client.app.state.ground, "ann", "operator")


def start(client: TestClient, token: str) -> None:
    answer = client.post("/api/v1/session", json={"token": token}, headers=OWN)
    assert answer.status_code == 200, answer.text


def test_a_session_needs_no_token_in_requests(client: TestClient, token: str) -> None:
    answer = client.post("/api/v1/session", json={"token": token}, headers=OWN)
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie and "max-age=43200" in cookie
    assert token not in cookie
    found = client.get("/api/v1/session").json()
    assert (found["name"], found["role"], found["browser"]) == ("ann", "operator", True)
    assert client.get("/api/v1/passes").status_code == 200


def test_a_wrong_token_starts_no_session(client: TestClient, token: str) -> None:
    answer = client.post("/api/v1/session", json={"token": token + "x"}, headers=OWN)
    assert answer.status_code == 401 and "set-cookie" not in answer.headers


def test_a_session_ends_when_its_user_is_disabled_and_stays_ended(client: TestClient, token: str) -> None:
    ground = client.app.state.ground
    start(client, token)
    users.change_user(ground, "ann", state="disabled")
    assert client.get("/api/v1/session").status_code == 401
    users.change_user(ground, "ann", state="active")
    assert client.get("/api/v1/session").status_code == 401
    assert token_valid(ground, token)  # tokens of programs are valid again


def test_sign_out_ends_the_session_and_not_the_token(client: TestClient, token: str) -> None:
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


def test_revocation_of_the_token_ends_its_sessions(client: TestClient, token: str) -> None:
    ground = client.app.state.ground
    start(client, token)
    (parent,) = [one for one in users.list_tokens(ground, "ann") if one.parent_id is None]
    (session,) = [one for one in users.list_tokens(ground, "ann") if one.parent_id is not None]
    assert session.parent_id == parent.id
    users.revoke_token(ground, parent.id)
    assert client.get("/api/v1/session").status_code == 401


def test_a_session_ends_with_the_validity_of_its_token(client: TestClient) -> None:
    ground = client.app.state.ground
    token = users.add_user(ground, "bob", "viewer", days_valid=0.1)
    start(client, token)
    expires = {one.expires for one in users.list_tokens(ground, "bob")}
    assert len(expires) == 1


def test_an_expired_session_is_refused_with_its_reason_and_changes_nothing(
    client: TestClient, token: str
) -> None:
    ground = client.app.state.ground
    start(client, token)
    with ground.database.writing() as connection:
        connection.execute(update(repository.TOKENS).values(expires_utc_ns=5))
    for answer in (client.get("/api/v1/passes"), client.post("/api/v1/windows", json={}, headers=OWN)):
        assert answer.status_code == 401 and "has expired" in answer.json()["detail"], answer.text
    # The page to sign in again is there.
    page = client.get("/", headers={"Accept": "text/html"})
    assert page.status_code == 200 and "has expired" not in page.headers.get("set-cookie", "")


def test_a_change_with_the_cookie_from_another_origin_is_refused(client: TestClient, token: str) -> None:
    start(client, token)
    for headers in ({}, {"Origin": "https://example.org"}, {"Sec-Fetch-Site": "cross-site"}):
        answer = client.post("/api/v1/windows", json={}, headers=headers)
        assert answer.status_code == 403, headers
    assert client.post("/api/v1/windows", json={}, headers=OWN).status_code == 422


@pytest.fixture
def openmct(tmp_path: Path) -> Path:
    """A folder with the files of the npm package that the service reads."""
    folder = tmp_path / "openmct"
    (folder / "dist").mkdir(parents=True)
    (folder / "package.json").write_text('{"version": "4.2.0"}')
    (folder / "LICENSE.md").write_text("terms")
    (folder / "dist" / "openmct.js").write_text("script")
    (folder / "dist" / "secret.env").write_text("no file of the displays")
    return folder


def test_the_displays_open_with_a_session_only(tmp_path: Path, openmct: Path) -> None:
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
def test_an_incomplete_installation_counts_as_none(tmp_path: Path, openmct: Path, missing: str) -> None:
    (openmct / missing).unlink()
    settings = Settings(home=tmp_path / "home", openmct=openmct)
    with TestClient(create_app(settings, inline_jobs=True)) as client:
        answer = client.get("/mct")
        assert answer.status_code == 200 and "make openmct" in answer.text
