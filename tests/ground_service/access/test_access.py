"""Users, tokens and the audit log over HTTP."""

import pytest

from tests.serving import TestClient

V1 = "/api/v1"

Guarded = tuple[TestClient, dict[str, dict[str, str]]]


def test_an_administrator_manages_users(guarded: Guarded) -> None:
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


@pytest.mark.parametrize(
    "body",
    [
        {"name": "a\nb", "role": "viewer"},
        {"name": "ann", "role": "root"},
        {"name": "ann", "role": "viewer", "days_valid": True},
        {"name": "ann", "role": "viewer", "days_valid": -1},
        {"name": "ann", "role": "viewer", "days_valid": "3"},
        {"name": 5, "role": "viewer"},
        {"name": "ann", "role": "viewer", "admin": True},
    ],
)
def test_a_user_that_cannot_be_added_is_refused(guarded: Guarded, body: dict[str, object]) -> None:
    client, heads = guarded
    assert client.post(f"{V1}/users", json=body, headers=heads["admin"]).status_code == 422
    assert client.get(f"{V1}/users", headers=heads["admin"]).json()["total"] == 3


def test_operators_read_who_did_what(guarded: Guarded) -> None:
    client, heads = guarded
    client.patch(f"{V1}/users/viewer", json={"state": "disabled"}, headers=heads["admin"])
    page = client.get(f"{V1}/audit?limit=2", headers=heads["operator"]).json()
    assert (page["total"], [one["number"] for one in page["items"]]) == (4, [4, 3])
    newest = page["items"][0]
    assert (newest["actor"], newest["action"], newest["target"]) == ("admin", "disable user", "viewer")
    head = client.get(f"{V1}/audit/head", headers=heads["operator"]).json()
    assert head == {"number": 4, "sha256": newest["sha256"]}
    for query, numbers in (
        ("actor=admin", [4]),
        ("action=user", [4, 3, 2, 1]),
        ("action=add", [3, 2, 1]),
        ("action=%25", []),
        ("target=viewer", [4, 1]),
        (f"since={newest['time']}", [4]),
        (f"until={newest['time']}", [3, 2, 1]),
        ("offset=3", [1]),
    ):
        found = client.get(f"{V1}/audit?{query}", headers=heads["operator"]).json()
        assert [one["number"] for one in found["items"]] == numbers, query
    for query in (
        "since=yesterday",
        "actor=%00",
        "limit=0",
        f"since={newest['time']}&until=2020-01-01T00:00:00Z",
    ):
        assert client.get(f"{V1}/audit?{query}", headers=heads["operator"]).status_code == 422, query
    assert client.get(f"{V1}/audit", headers=heads["admin"]).status_code == 200
