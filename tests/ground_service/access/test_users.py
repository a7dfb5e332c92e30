"""Users and tokens: compare-and-set of states, and immediate refusals."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

from pytest import fixture, mark, raises

from ground_service.access.model import AuditFilter
from ground_service.access.service import (
    _note_use,
    add_token,
    add_user,
    authenticate,
    change_user,
    ensure_user,
    get_user,
    list_tokens,
    list_users,
    revoke_token,
    start_session,
    token_sha256,
)
from ground_service.access.store import has_users, list_audit
from ground_service.errors import Conflict, InvalidInput, NotAuthorised, NotFound
from ground_service.ground import open_ground
from tests.serving import token_valid

SECRET = "a-token-of-a-deployment-0123456789"


def details(ground):
    entries = ground.read(list_audit, AuditFilter()).items
    return [(one.actor, one.action, one.target, dict(sorted(one.detail.items()))) for one in reversed(entries)]


def test_a_disabled_user_is_refused_at_once_in_every_process(either, tmp_path):
    add_user(either, "ann", "admin")
    token = add_user(either, "bob", "operator", actor="ann")
    url = either.database.engine.url.render_as_string(hide_password=False)
    with open_ground(tmp_path / "other", database_url=url) as other:
        assert authenticate(other, token).name == "bob"
        assert token_valid(other, token)
        assert change_user(either, "bob", state="disabled", actor="ann").state == "disabled"
        with raises(NotAuthorised, match="user bob is disabled"):
            authenticate(other, token)
        assert not token_valid(other, token)
        with raises(Conflict, match="user bob: expected state active, found disabled"):
            change_user(other, "bob", state="disabled")
        change_user(other, "bob", state="active")
        assert authenticate(either, token).role == "operator"


def test_a_revoked_token_is_refused_and_others_stay(either):
    first = add_user(either, "ann", "viewer")
    second = add_token(either, "ann", days_valid=2.0)
    newest, oldest = list_tokens(either, "ann")
    assert (oldest.hint, newest.hint) == (first[:12], second[:12])
    assert (oldest.expires, newest.state) == (None, "active")
    assert first not in str(newest) + str(oldest)
    assert revoke_token(either, oldest.id, actor="eve").state == "revoked"
    with raises(NotAuthorised):
        authenticate(either, first)
    assert not token_valid(either, first) and token_valid(either, second)
    assert authenticate(either, second).token_id == newest.id
    with raises(Conflict, match=f"token {oldest.id}: expected state active, found revoked"):
        revoke_token(either, oldest.id)
    with raises(NotFound):
        revoke_token(either, 99)
    third = add_token(either, "ann", revoke_others=True)
    assert [token_valid(either, one) for one in (first, second, third)] == [False, False, True]


def test_the_last_administrator_stays(either):
    for name in "ann", "bob":
        add_user(either, name, "admin")
    change_user(either, "bob", role="viewer")
    for change in {"state": "disabled"}, {"role": "operator"}:
        with raises(Conflict, match="user ann: expected another active administrator, found none"):
            change_user(either, "ann", **change)
    assert get_user(either, "ann").role == "admin"
    change_user(either, "bob", state="disabled")
    change_user(either, "bob", role="admin")
    with raises(Conflict, match="another active administrator"):
        change_user(either, "ann", state="disabled")


def race(*tasks):
    """Run tasks simultaneously; return what each returned or raised."""
    barrier = threading.Barrier(len(tasks))

    def run(task):
        barrier.wait()
        try:
            return task()
        except Exception as error:  # the test examines it
            return error

    with ThreadPoolExecutor(len(tasks)) as pool:
        return list(pool.map(run, tasks))


def test_of_two_administrators_who_disable_each_other_one_stays(either):
    for _ in range(8):
        for name in "ann", "bob":
            if name not in [user.name for user in list_users(either)]:
                add_user(either, name, "admin")
            elif get_user(either, name).state == "disabled":
                change_user(either, name, state="active")
        results = race(
            lambda: change_user(either, "ann", state="disabled"), lambda: change_user(either, "bob", state="disabled")
        )
        assert sum(isinstance(one, Conflict) for one in results) == 1, results
        assert sorted(user.state for user in list_users(either)) == ["active", "disabled"]


def test_of_several_who_add_one_user_or_revoke_one_token_one_wins(either):
    results = race(*[lambda: add_user(either, "ann", "viewer")] * 4)
    assert sum(isinstance(one, str) for one in results) == 1, results
    assert sum(isinstance(one, Conflict) for one in results) == 3
    results = race(*[lambda: revoke_token(either, list_tokens(either)[0].id)] * 4)
    assert sum(isinstance(one, Conflict) for one in results) == 3, results


@mark.parametrize("name", ["", "a\nb", "a\x1b[31m", "a b", "ann\n", "é", "local", "x" * 65, "-a"])
def test_a_name_that_cannot_be_used_is_refused_in_one_line(ground, name):
    with raises(InvalidInput) as caught:
        add_user(ground, name, "viewer")
    assert "\n" not in str(caught.value) and "\x1b" not in str(caught.value)
    assert list_users(ground) == []


@mark.parametrize("days", [0.0, -1.0, float("nan"), float("inf"), 36_500.001, True])
def test_a_validity_that_cannot_be_used_is_refused(ground, days):
    with raises(InvalidInput, match="days valid"):
        add_user(ground, "ann", "viewer", days_valid=days)
    assert list_users(ground) == []


def test_a_deployment_does_not_enable_a_disabled_user_again(ground):
    assert ensure_user(ground, "ann", "admin", SECRET)
    assert not ensure_user(ground, "ann", "admin", SECRET)
    assert list_tokens(ground)[0].hint == SECRET[:4]
    add_user(ground, "bob", "admin")
    change_user(ground, "ann", state="disabled")
    with raises(Conflict, match="expected state active, found disabled"):
        ensure_user(ground, "ann", "admin", SECRET)
    assert not token_valid(ground, SECRET)


HOUR_NS = 3_600_000_000_000
NOW = 500_000 * HOUR_NS + 1_234_567_890


@fixture
def clock(monkeypatch):
    """A clock that stands at `NOW` until it is set."""

    def put(now):
        monkeypatch.setattr("ground_service.access.service.utc_now_ns", lambda: now)

    put(NOW)
    return put


def test_every_change_is_in_the_audit_log_with_what_it_changed(ground):
    add_user(ground, "ann", "admin", actor="eve")
    add_user(ground, "bob", "viewer", actor="ann")
    add_token(ground, "bob", actor="ann")
    add_token(ground, "bob", actor="ann", revoke_others=True)
    change_user(ground, "bob", role="operator", actor="ann")
    change_user(ground, "bob", state="disabled", role="viewer", actor="ann")
    change_user(ground, "bob", state="active", actor="ann")
    revoke_token(ground, 4, actor="ann")
    ensure_user(ground, "cleo", "operator", SECRET, actor="deployment")
    found = "\n".join(f"{actor} | {action} | {target} | {detail}" for actor, action, target, detail in details(ground))
    assert (
        found
        == """
eve | add user | ann | {'role': 'admin', 'token_id': 1}
ann | add user | bob | {'role': 'viewer', 'token_id': 2}
ann | add token | bob | {'token_id': 3}
ann | renew token | bob | {'revoked': 2, 'token_id': 4}
ann | change role | bob | {'from': 'viewer', 'to': 'operator'}
ann | disable user | bob | {'sessions': 0}
ann | change role | bob | {'from': 'operator', 'to': 'viewer'}
ann | enable user | bob | {'sessions': 0}
ann | revoke token | bob | {'token_id': 4}
deployment | ensure user | cleo | {'role': 'operator', 'token_id': 5}
""".strip()
    )


def test_who_is_not_named_is_local(ground):
    add_user(ground, "ann", "admin")
    add_token(ground, "ann")
    add_token(ground, "ann", revoke_others=True)
    add_user(ground, "bob", "viewer")
    change_user(ground, "bob", role="operator")
    revoke_token(ground, 3)
    ensure_user(ground, "cleo", "viewer", SECRET)
    assert {actor for actor, *_ in details(ground)} == {"local"}


def test_a_token_is_shown_with_its_times_and_valid_up_to_its_last_instant(ground, clock):
    """NOW is 500,000 hours after 1970: 2027-01-15T08:00:00Z; two days later it expires."""
    token = add_user(ground, "ann", "operator", days_valid=2.0)
    (shown,) = list_tokens(ground)
    assert token.startswith("linna_") and len(token) == 6 + 43 and shown.hint == token[:12]
    assert (shown.id, shown.user, shown.state) == (1, "ann", "active")
    assert shown.created == "2027-01-15T08:00:01.234567Z"
    assert (shown.expires, shown.revoked, shown.used) == ("2027-01-17T08:00:01.234567Z", None, None)
    assert get_user(ground, "ann").created == shown.created
    caller = authenticate(ground, token)
    assert (caller.name, caller.role, caller.token_id) == ("ann", "operator", 1)
    assert list_tokens(ground)[0].used == "2027-01-15T08:00:00.000000Z"
    end = NOW + 48 * HOUR_NS
    clock(end - 1)
    assert token_valid(ground, token) and authenticate(ground, token).name == "ann"
    assert list_tokens(ground)[0].state == "active"
    clock(end)
    assert not token_valid(ground, token) and list_tokens(ground)[0].state == "expired"
    with raises(NotAuthorised, match="has expired"):
        authenticate(ground, token)
    clock(end + HOUR_NS)
    assert revoke_token(ground, 1).revoked == "2027-01-17T09:00:01.234567Z"
    # Revoked says more than expired.
    assert list_tokens(ground)[0].state == "revoked"


def test_further_tokens_expire_too(ground, clock):
    add_user(ground, "ann", "viewer")
    token = add_token(ground, "ann", days_valid=0.5)
    assert list_tokens(ground)[0].expires == "2027-01-15T20:00:01.234567Z"
    clock(NOW + 12 * HOUR_NS)
    assert not token_valid(ground, token)
    with raises(InvalidInput, match=r"^token, days valid: expected more than 0, at most 36500, found -1"):
        add_token(ground, "ann", days_valid=-1)
    with raises(NotFound):
        add_token(ground, "bob")


@mark.parametrize("days, hours", [(0.25, 5), (2.0, 12), (None, 12)])
def test_a_session_lasts_a_shift_and_no_longer_than_its_token(ground, clock, days, hours):
    token = add_user(ground, "ann", "viewer", days_valid=days)
    clock(NOW + HOUR_NS)
    secret, session = start_session(ground, token)
    assert session.expires.utc_ns == NOW + HOUR_NS + hours * HOUR_NS
    further, _ = start_session(ground, secret)
    assert [one.parent_id for one in list_tokens(ground)] == [1, 1, None]
    revoke_token(ground, 1)
    assert not token_valid(ground, further)


def test_the_use_of_a_token_is_noted_after_an_hour_and_not_before(ground, clock):
    """The stored time is the full hour; an hour after that, not after the use, it is written again."""
    token = add_user(ground, "ann", "viewer")
    authenticate(ground, token)
    clock(501_000 * HOUR_NS - 1)
    authenticate(ground, token)
    assert list_tokens(ground)[0].used == "2027-02-25T23:00:00.000000Z"
    clock(501_000 * HOUR_NS - 1 + HOUR_NS)
    authenticate(ground, token)
    assert list_tokens(ground)[0].used == "2027-02-26T00:00:00.000000Z"


def test_of_two_requests_at_once_the_first_notes_the_use(ground, clock):
    """Both read that the token was not used; the second finds the hour written when it comes to write."""
    add_user(ground, "ann", "viewer")
    _note_use(ground, 1, NOW)
    _note_use(ground, 1, NOW + HOUR_NS - 1 - NOW % HOUR_NS)
    assert list_tokens(ground)[0].used == "2027-01-15T08:00:00.000000Z"
    # One that began before, or on a clock that is behind, does not set it back.
    _note_use(ground, 1, NOW - HOUR_NS // 2)
    assert list_tokens(ground)[0].used == "2027-01-15T08:00:00.000000Z"
    _note_use(ground, 1, NOW - NOW % HOUR_NS + HOUR_NS)
    assert list_tokens(ground)[0].used == "2027-01-15T09:00:00.000000Z"


def test_only_the_token_itself_is_accepted(ground):
    token = add_user(ground, "ann", "viewer")
    for other in "", token[:-1], token + " ", token.upper(), token_sha256(token):
        assert not token_valid(ground, other)
        with raises(NotAuthorised, match="expected one that 'linna user add' gave out, found another"):
            authenticate(ground, other)
    # SHA-256 of "abc", FIPS 180-4.
    assert token_sha256("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_a_deployment_replaces_role_and_token_and_revokes_the_old_one(ground):
    old = add_user(ground, "ann", "viewer")
    assert ensure_user(ground, "ann", "operator", SECRET) and not token_valid(ground, old)
    caller = authenticate(ground, SECRET)
    assert (caller.name, caller.role, list_tokens(ground)[0].expires) == ("ann", "operator", None)
    assert not ensure_user(ground, "ann", "operator", SECRET)
    # Another token in the same role is a change, too.
    assert ensure_user(ground, "ann", "operator", SECRET[::-1]) and not token_valid(ground, SECRET)


def test_a_deployment_may_change_the_role_and_keep_the_token(ground):
    ensure_user(ground, "ann", "viewer", SECRET)
    further = add_token(ground, "ann")
    kept, ended = (start_session(ground, one)[0] for one in (SECRET, further))
    assert ensure_user(ground, "ann", "operator", SECRET)
    caller = authenticate(ground, SECRET)
    assert (caller.role, caller.token_id) == ("operator", 1)
    assert [token_valid(ground, one) for one in (kept, further, ended)] == [True, False, False]


def test_a_session_does_not_start_with_a_token_that_is_revoked_meanwhile(ground, monkeypatch):
    token = add_user(ground, "ann", "viewer")
    caller = authenticate(ground, token)
    monkeypatch.setattr("ground_service.access.service.authenticate", lambda *_: caller)
    change_user(ground, "ann", state="disabled")
    with raises(NotAuthorised, match="token: has been revoked"):
        start_session(ground, token)
    change_user(ground, "ann", state="active")
    revoke_token(ground, 1)
    with raises(NotAuthorised, match="token: has been revoked"):
        start_session(ground, token)


def test_a_deployment_does_not_bring_a_revoked_token_back(ground):
    ensure_user(ground, "ann", "viewer", SECRET)
    revoke_token(ground, 1)
    with raises(Conflict, match="user ann: expected a token in force, found one that was revoked"):
        ensure_user(ground, "ann", "viewer", SECRET)
    assert not token_valid(ground, SECRET)


@mark.parametrize("exists", [True, False])
def test_two_users_of_a_deployment_have_tokens_of_their_own(ground, exists):
    ensure_user(ground, "ann", "viewer", SECRET)
    if exists:
        add_user(ground, "bob", "viewer")
    with raises(Conflict, match="user bob: expected a unique token, found that of another user"):
        ensure_user(ground, "bob", "admin", SECRET)
    assert authenticate(ground, SECRET).name == "ann"
    assert [one.name for one in list_users(ground)] == (["ann", "bob"] if exists else ["ann"])
    assert all(one.role == "viewer" for one in list_users(ground))


@mark.parametrize("length", [23, 24])
def test_a_token_of_a_deployment_has_24_characters_or_more(ground, length):
    refused = raises(InvalidInput, match="token: expected 24 characters or more, found 23")
    with refused if length == 23 else nullcontext():
        assert ensure_user(ground, "ann", "viewer", "t" * length)
    assert bool(list_users(ground)) == (length == 24)


def test_changes_that_cannot_be_made_are_refused_with_what_was_expected(ground):
    add_user(ground, "ann", "admin")
    with raises(Conflict, match="user ann: exists already"):
        add_user(ground, "ann", "viewer")
    for change, message in (
        ({}, "user, ann: expected a new state, role or missions, found none of them"),
        ({"state": "asleep"}, "user, state: expected active or disabled, found 'asleep'"),
        ({"role": "root"}, "user, role: expected viewer, operator, admin, found 'root'"),
    ):
        with raises(InvalidInput, match=f"^{message}$"):
            change_user(ground, "ann", **change)
    for work in lambda: change_user(ground, "bob", state="disabled"), lambda: get_user(ground, "bob"):
        with raises(NotFound, match="bob"):
            work()
    with raises(InvalidInput, match=r"^user, name: .*service"):
        change_user(ground, "service", role="viewer")


def test_users_are_listed_by_name_and_tokens_newest_first(ground):
    assert not ground.read(has_users) and list_users(ground) == [] and list_tokens(ground) == []
    for name in "cleo", "ann", "bob":
        add_user(ground, name, "viewer")
    add_token(ground, "ann")
    assert ground.read(has_users)
    assert [one.name for one in list_users(ground)] == ["ann", "bob", "cleo"]
    assert " ".join(f"{one.id} {one.user}" for one in list_tokens(ground)) == "4 ann 3 bob 2 ann 1 cleo"
    assert [one.id for one in list_tokens(ground, "ann")] == [4, 2]
    with raises(NotFound):
        list_tokens(ground, "eve")


def test_renewing_revokes_only_the_tokens_of_that_user(ground):
    other = add_user(ground, "bob", "viewer")
    add_user(ground, "ann", "viewer")
    revoke_token(ground, 2)
    add_token(ground, "ann")
    add_token(ground, "ann", revoke_others=True)
    # The one that was revoked before is not revoked again.
    assert details(ground)[-1][3] == {"token_id": 4, "revoked": 1}
    assert token_valid(ground, other)
