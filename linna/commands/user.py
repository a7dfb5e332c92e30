"""`linna user | audit`: users, their tokens and missions; the audit log."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from linna.commands._ground import add_service_options, local_actor, open_service
from linna.commands._table import Command, Commands, CustomCommand, Option
from linna.errors import UsageError
from linna.output import emit, finish, log
from linna.parser import option

if TYPE_CHECKING:
    from ground_service.access.model import AuditEntry, Token, User
    from ground_service.client import Client
    from linna.parser import LinnaParser


Role = Literal["viewer", "operator", "admin"]


def _say_unknown(service: Client, missions: Sequence[str] | None) -> None:
    """Warn of missions that no description has: the user sees nothing of them."""
    known = {one.mission for one in service.list_missions()} if missions else set()
    for name in sorted({*(missions or ())} - known):
        log(f"linna: warning: no spacecraft has the mission {name!r}; known: {', '.join(sorted(known)) or 'none'}")


def _add(
    service: Client, name: str, role: Role, *, missions: Sequence[str] | None = None, days: float | None = None
) -> dict[str, Any]:
    _say_unknown(service, missions)
    made = service.add_user(name, role, missions=missions, days_valid=days)
    return {"name": name, "role": role, "token": made.token}


def _renew(
    service: Client, name: str, *, keep: bool = False, missions: Sequence[str] | None = None, days: float | None = None
) -> dict[str, Any]:
    _say_unknown(service, missions)
    made = service.add_token(name, missions=missions, days_valid=days, revoke_others=not keep)
    return {"name": name, "token": made.token}


def _rank(service: Client, name: str, role: Role) -> User:
    return service.change_user(name, role=role)


def _limit(service: Client, name: str, missions: Sequence[str] = ()) -> User:
    _say_unknown(service, missions)
    return service.change_user(name, missions=list(missions))


def _revoke(service: Client, token_id: int) -> Token:
    service.revoke_token(token_id)
    return next(one for one in service.list_tokens() if one.id == token_id)


def _configure_ensure(parser: LinnaParser) -> None:
    option(parser, "name", str)
    option(parser, "--role", ("viewer", "operator", "admin"), required=True)
    option(parser, "--token-variable NAME", str, "", "LINNA_ADMIN_TOKEN")
    add_service_options(parser)
    finish(parser, _ensure)


def _ensure(arguments: argparse.Namespace) -> int:
    import os

    from ground_service.access.service import ensure_user

    token = os.environ.get(arguments.token_variable, "")
    if not token:
        raise UsageError(f"{arguments.token_variable}: expected the token of {arguments.name}, found nothing")
    with open_service(arguments) as ground:
        changed = ensure_user(ground, arguments.name, arguments.role, token, actor=local_actor())
    state = "set" if changed else "unchanged"
    return emit(arguments, {"name": arguments.name, "changed": changed}, text=f"{arguments.name}: {state}")


def _changed(user: User) -> str:
    return f"{user.name}: {user.role}, {user.state}{_missions(user)}"


def _missions(limited: User | Token) -> str:
    return f", missions {', '.join(limited.missions)}" if limited.missions else ""


def _token(one: Token) -> str:
    return (
        f"{one.id:>5}  {one.user:<12} {one.hint:<12}  {one.state:<8} created {one.created[:19]}Z  "
        f"expires {one.expires[:19] + 'Z' if one.expires else 'never':<20}  "
        f"used {one.used[:13] + 'h' if one.used else 'never'}{_missions(one)}"
    )


DAYS = {
    "days": Option("validity of the token in days (default: unlimited)", "D"),
    "missions": Option("only this mission; can be repeated (default: all)", "NAME", "--mission"),
}
USER: Commands = {
    "add": Command(
        _add, "add a user and print the token, which cannot be printed again", lambda made: made["token"], options=DAYS
    ),
    "token": Command(
        _renew,
        "create a token for a user and revoke all earlier ones",
        lambda made: made["token"],
        options=DAYS | {"keep": "keep earlier tokens valid"},
    ),
    "ensure": CustomCommand("create the user if needed, with a token from the environment", _configure_ensure),
    "disable": Command(
        "change_user",
        "disable a user and all tokens of the user",
        _changed,
        preset={"state": "disabled", "role": None, "missions": None},
    ),
    "enable": Command(
        "change_user", "enable a disabled user", _changed, preset={"state": "active", "role": None, "missions": None}
    ),
    "missions": Command(
        _limit,
        "limit a user to missions",
        _changed,
        options={"missions": "names of mission descriptions (default: all)"},
        positional=["missions"],
    ),
    "role": Command(_rank, "change the role of a user", _changed, positional=["role"]),
    "list": Command(
        "list_users",
        "list all users",
        lambda user: f"{user.role:<9} {user.state:<9} {user.name}{_missions(user)}",
        "users",
        "no users",
    ),
    "tokens": Command(
        "list_tokens",
        "list the tokens without their secrets, newest first",
        _token,
        "tokens",
        "no tokens",
        options={"user": Option("only tokens of this user", "name")},
        positional=["user"],
    ),
    "revoke": Command(
        _revoke,
        "revoke one token",
        lambda token: f"{token.id}: revoked",
        options={"token_id": "number shown by 'linna user tokens'"},
    ),
}


def _line(one: AuditEntry) -> str:
    text = one.detail.get("text", "")
    return f"{one.number:>6}  {one.time[:19]}Z  {one.actor:<12} {one.action} {one.target} {text}".rstrip()


AUDIT = {
    "list": Command(
        "list_audit",
        "list the entries, newest first",
        _line,
        "entries",
        "no entries",
        options={
            "actor": Option("only entries of this user", "NAME"),
            "action": "only actions that contain this text",
            "target": "only entries with this target",
        },
    ),
    "head": Command(
        "get_audit_head",
        "show number and hash of the newest entry, to be stored elsewhere",
        lambda head: f"{head.number}:{head.sha256}",
    ),
}
