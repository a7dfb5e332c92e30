"""Caller of a request, and the role that it needs."""

import asyncio
from types import SimpleNamespace

from fastapi.security import HTTPAuthorizationCredentials
from pytest import mark, raises

from ground_service.access.security import caller_of, once, requires
from ground_service.access.service import LOCAL_CALLER, Caller, add_user, change_user
from ground_service.errors import Conflict, DatabaseUnavailable, Forbidden, InvalidInput, NotAuthorised

NO_REQUEST = None
ROLES = ("viewer", "operator", "admin")


def request(ground, open_without_users):
    app = SimpleNamespace(state=SimpleNamespace(ground=ground, open_without_users=open_without_users))
    return SimpleNamespace(app=app, state=SimpleNamespace(), cookies={})


def bearer(token):
    return HTTPAuthorizationCredentials(scheme="Bearer", credentials=token)


def test_without_users_an_open_service_has_a_local_caller_and_one_that_others_reach_is_closed(ground):
    asked = request(ground, True)
    assert caller_of(asked, None) == LOCAL_CALLER == Caller("local", "admin", None)
    assert vars(asked.state) == {"caller": "local"}
    with raises(NotAuthorised, match="expected a bearer token in the Authorization header, found none"):
        caller_of(request(ground, False), None)


def test_the_first_user_closes_an_open_service_even_once_disabled(ground):
    add_user(ground, "ann", "viewer")
    change_user(ground, "ann", state="disabled")
    asked = request(ground, True)
    with raises(NotAuthorised, match="found none"):
        caller_of(asked, None)
    assert vars(asked.state) == {}


@mark.parametrize("open_without_users", [True, False])
def test_a_token_names_its_caller_whatever_the_service_is_open_to(ground, open_without_users):
    token = add_user(ground, "ann", "operator")
    asked = request(ground, open_without_users)
    caller = caller_of(asked, bearer(token))
    assert (caller.name, caller.role, caller.token_id) == ("ann", "operator", 1)
    assert vars(asked.state) == {"caller": "ann"}
    invented = request(ground, open_without_users)
    with raises(NotAuthorised):
        caller_of(invented, bearer(token + "x"))
    assert vars(invented.state) == {}


@mark.parametrize("role", ROLES)
@mark.parametrize("needed", ROLES)
def test_a_role_may_do_what_those_below_it_may(role, needed):
    caller = Caller("ann", role)
    allowed = ROLES.index(role) >= ROLES.index(needed)
    assert caller.may(needed) is allowed
    check = requires(needed)
    if allowed:
        assert asyncio.run(check(NO_REQUEST, caller)) is caller
    else:
        with raises(Forbidden, match=f"^ann: expected the role {needed} or higher, found {role}$"):
            asyncio.run(check(NO_REQUEST, caller))


def test_a_role_that_does_not_exist_allows_nothing():
    with raises(ValueError, match="not in tuple"):
        Caller("ann", "admin").may("root")


def test_a_limited_caller_may_use_what_belongs_to_own_spacecraft_only():
    limited = Caller("ann", "admin", missions=("ours",), spacecraft=frozenset({76, 78}))
    asked = (76,), (78, 76), (78, 77), (77,), (None,), (76, None)
    assert [limited.may_use(*one) for one in asked] == [True, True, False, False, False, False]
    assert all(LOCAL_CALLER.may_use(*one) for one in asked)


def test_a_key_stands_for_one_request_and_is_refused_after_work_that_was_cut_off(ground):
    def ask(work, key="done", actor="ann", operation="window", number=1):
        return once(ground, actor=actor, operation=operation, key=key, request={"a": number}, work=work)

    def fail(error):
        raise error

    assert [ask(lambda one=one: {"id": one}) for one in (1, 2)] == [{"id": 1}] * 2
    for other in {"key": None}, {"key": "other"}, {"actor": "bob"}, {"operation": "pass"}:
        assert ask(lambda: {"id": 3}, **other) == {"id": 3}
    with raises(Conflict, match="expected the request that it was first sent with, found another"):
        ask(lambda: {"id": 4}, number=2)
    with raises(InvalidInput):
        ask(lambda: fail(InvalidInput("window", "", "a time", "none")), "refused")
    assert ask(lambda: {"id": 5}, "refused") == {"id": 5}
    with raises(DatabaseUnavailable):
        ask(lambda: fail(DatabaseUnavailable("db", "gone")), "cut off")
    with raises(Conflict, match="begun and its end is not known"):
        ask(lambda: {"id": 6}, "cut off")
