"""Users and tokens: states that are compared and set, and refusals that hold at once."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import update

from ground_service.errors import Conflict, InvalidInput, NotAuthorised, NotFound
from ground_service.services.audit_log import list_entries
from ground_service.services.ground import Ground, open_ground
from ground_service.services.users import (
    add_token,
    add_user,
    authenticate,
    change_user,
    ensure_user,
    get_user,
    list_tokens,
    list_users,
    renew_token,
    revoke_token,
    token_valid,
)
from ground_service.store import repository
from ground_service.store.database import prepare_database

SECRET = "a-token-of-a-deployment-0123456789"


@pytest.fixture(params=["sqlite", "postgresql"])
def either(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ground]:
    """An empty service on each database."""
    url = None
    if request.param == "postgresql":
        url = request.getfixturevalue("new_postgres_database")()
        prepare_database(url, upgrade=True).engine.dispose()
    with open_ground(tmp_path / "home", database_url=url) as ground:
        yield ground


def actions(ground: Ground) -> list[tuple[str, str, str]]:
    return [(one.actor, one.action, one.target) for one in list_entries(ground)[0]][::-1]


def test_a_disabled_user_is_refused_at_once_in_every_process(either: Ground, tmp_path: Path) -> None:
    add_user(either, "ann", "admin")
    token = add_user(either, "bob", "operator", actor="ann")
    url = either.database.engine.url.render_as_string(hide_password=False)
    with open_ground(tmp_path / "other", database_url=url) as other:
        assert authenticate(other, token).name == "bob"
        assert token_valid(other, token)
        assert change_user(either, "bob", state="disabled", actor="ann").state == "disabled"
        with pytest.raises(NotAuthorised, match="user bob is disabled"):
            authenticate(other, token)
        assert not token_valid(other, token)
        with pytest.raises(Conflict, match="user bob: expected state active, found disabled"):
            change_user(other, "bob", state="disabled")
        change_user(other, "bob", state="active")
        assert authenticate(either, token).role == "operator"
    assert actions(either) == [
        ("local", "add user", "ann"), ("ann", "add user", "bob"), ("ann", "disable user", "bob"),
        ("local", "enable user", "bob"),
    ]  # fmt: skip


def test_a_revoked_token_is_refused_and_others_stay(either: Ground) -> None:
    first = add_user(either, "ann", "viewer")
    second = add_token(either, "ann", days_valid=2.0)
    newest, oldest = list_tokens(either, "ann")
    assert (oldest.hint, newest.hint) == (first[:12], second[:12])
    assert (oldest.expires, newest.state) == (None, "active")
    assert first not in str(newest) + str(oldest)
    assert revoke_token(either, oldest.id, actor="eve").state == "revoked"
    with pytest.raises(NotAuthorised):
        authenticate(either, first)
    assert not token_valid(either, first) and token_valid(either, second)
    assert authenticate(either, second).token_id == newest.id
    with pytest.raises(Conflict, match=f"token {oldest.id}: expected state active, found revoked"):
        revoke_token(either, oldest.id)
    with pytest.raises(NotFound):
        revoke_token(either, 99)
    assert actions(either)[-1] == ("eve", "revoke token", "ann")
    third = renew_token(either, "ann")
    assert [token_valid(either, one) for one in (first, second, third)] == [False, False, True]


def test_the_last_use_is_kept_to_the_hour(ground: Ground, monkeypatch: pytest.MonkeyPatch) -> None:
    token = add_user(ground, "ann", "viewer")
    assert list_tokens(ground)[0].used is None
    hour = 3_600_000_000_000
    now = 500_000 * hour + 5
    monkeypatch.setattr("ground_service.services.users.utc_now_ns", lambda: now)
    authenticate(ground, token)
    first = list_tokens(ground)[0].used
    now += hour // 2
    authenticate(ground, token)
    assert list_tokens(ground)[0].used == first and first is not None and first.endswith(":00:00.000000000Z")
    now += hour
    authenticate(ground, token)
    assert list_tokens(ground)[0].used != first


def test_an_expired_token_is_refused(ground: Ground) -> None:
    token = add_user(ground, "ann", "viewer", days_valid=1.0)
    with ground.database.writing() as connection:
        connection.execute(update(repository.TOKENS).values(expires_utc_ns=5))
    with pytest.raises(NotAuthorised, match="has expired"):
        authenticate(ground, token)
    assert not token_valid(ground, token)
    assert list_tokens(ground)[0].state == "expired"


def test_the_last_administrator_stays(either: Ground) -> None:
    for name in ("ann", "bob"):
        add_user(either, name, "admin")
    change_user(either, "bob", role="viewer")
    for change in ({"state": "disabled"}, {"role": "operator"}):
        with pytest.raises(Conflict, match="user ann: expected another active administrator, found none"):
            change_user(either, "ann", **change)
    assert get_user(either, "ann").role == "admin"
    change_user(either, "bob", state="disabled")
    change_user(either, "bob", role="admin")
    with pytest.raises(Conflict, match="another active administrator"):
        change_user(either, "ann", state="disabled")


def race(*tasks: Callable[[], object]) -> list[object]:
    """What each task returned or raised, all begun at once."""
    barrier, results = threading.Barrier(len(tasks)), [None] * len(tasks)

    def run(index: int) -> None:
        barrier.wait()
        try:
            results[index] = tasks[index]()
        except Exception as error:
            results[index] = error

    threads = [threading.Thread(target=run, args=(index,)) for index in range(len(tasks))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def test_of_two_administrators_who_disable_each_other_one_stays(either: Ground) -> None:
    for _ in range(8):
        for name in ("ann", "bob"):
            if name not in [user.name for user in list_users(either)]:
                add_user(either, name, "admin")
            elif get_user(either, name).state == "disabled":
                change_user(either, name, state="active")
        results = race(
            lambda: change_user(either, "ann", state="disabled"),
            lambda: change_user(either, "bob", state="disabled"),
        )
        assert sum(isinstance(one, Conflict) for one in results) == 1, results
        assert sorted(user.state for user in list_users(either)) == ["active", "disabled"]


def test_of_several_who_add_one_user_or_revoke_one_token_one_wins(either: Ground) -> None:
    results = race(*[lambda: add_user(either, "ann", "viewer")] * 4)
    assert sum(isinstance(one, str) for one in results) == 1, results
    assert sum(isinstance(one, Conflict) for one in results) == 3
    results = race(*[lambda: revoke_token(either, list_tokens(either)[0].id)] * 4)
    assert sum(isinstance(one, Conflict) for one in results) == 3, results


@pytest.mark.parametrize("name", ["", "a\nb", "a\x1b[31m", "a b", "ann\n", "é", "local", "x" * 65, "-a"])
def test_a_name_that_cannot_be_used_is_refused_in_one_line(ground: Ground, name: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        add_user(ground, name, "viewer")
    assert "\n" not in str(caught.value) and "\x1b" not in str(caught.value)
    assert list_users(ground) == []


@pytest.mark.parametrize("days", [0.0, -1.0, float("nan"), float("inf"), 1e9, True])
def test_a_validity_that_cannot_be_used_is_refused(ground: Ground, days: float) -> None:
    with pytest.raises(InvalidInput, match="days valid"):
        add_user(ground, "ann", "viewer", days_valid=days)
    assert list_users(ground) == []


def test_a_deployment_does_not_enable_a_disabled_user_again(ground: Ground) -> None:
    assert ensure_user(ground, "ann", "admin", SECRET)
    assert not ensure_user(ground, "ann", "admin", SECRET)
    assert list_tokens(ground)[0].hint == SECRET[:4]
    add_user(ground, "bob", "admin")
    change_user(ground, "ann", state="disabled")
    with pytest.raises(Conflict, match="expected state active, found disabled"):
        ensure_user(ground, "ann", "admin", SECRET)
    assert not token_valid(ground, SECRET)
