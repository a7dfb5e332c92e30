"""Caller of a request, and the role that it needs."""

import asyncio
from types import SimpleNamespace

from fastapi.security import HTTPAuthorizationCredentials
from pytest import mark, raises

from ground_service.access.security import caller_of, requires
from ground_service.access.service import LOCAL_CALLER, Caller, add_user, change_user
from ground_service.errors import NotAuthorised
from ground_service.http.problems import Forbidden

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
