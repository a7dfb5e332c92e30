"""`linna user add | token | ensure | list | disable | enable | role | tokens | revoke`: users and their tokens."""

from __future__ import annotations

import argparse

from linna.commands._ground import (
    add_operator_options,
    add_service_options,
    ground_client,
    local_actor,
    open_service,
)
from linna.output import add_json_flag, emit

ROLES = ("viewer", "operator", "admin")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    adding = actions.add_parser("add", help="add a user and print the token, which cannot be printed again")
    adding.set_defaults(handler=add)
    renewing = actions.add_parser("token", help="create a token for a user and revoke all earlier ones")
    renewing.add_argument("--keep", action="store_true", help="keep earlier tokens valid")
    renewing.set_defaults(handler=renew)
    ensuring = actions.add_parser(
        "ensure", help="create the user if needed, with the token of an environment variable"
    )
    ensuring.add_argument(
        "--token-variable", default="LINNA_ADMIN_TOKEN", metavar="NAME", help="default: LINNA_ADMIN_TOKEN"
    )
    ensuring.set_defaults(handler=ensure)
    disabling = actions.add_parser("disable", help="disable a user and all tokens of the user")
    disabling.set_defaults(handler=change, state="disabled", role=None)
    enabling = actions.add_parser("enable", help="enable a disabled user")
    enabling.set_defaults(handler=change, state="active", role=None)
    ranking = actions.add_parser("role", help="change the role of a user")
    ranking.set_defaults(handler=change, state=None)
    for action in (adding, renewing, ensuring, disabling, enabling, ranking):
        action.add_argument("name")
    ranking.add_argument("role", choices=ROLES)
    for action in (adding, ensuring):
        action.add_argument("--role", choices=ROLES, required=True)
    for action in (adding, renewing):
        action.add_argument(
            "--days", type=float, metavar="D", help="validity of the token in days (default: unlimited)"
        )
    listing = actions.add_parser("list", help="list all users")
    listing.set_defaults(handler=list_all)
    showing = actions.add_parser("tokens", help="list the tokens without their secrets, newest first")
    showing.add_argument("name", nargs="?", help="only tokens of this user")
    showing.set_defaults(handler=list_tokens)
    revoking = actions.add_parser("revoke", help="revoke one token")
    revoking.add_argument("token_id", type=int, metavar="ID", help="number shown by 'linna user tokens'")
    revoking.set_defaults(handler=revoke)
    add_service_options(ensuring)
    add_json_flag(ensuring)
    for action in (adding, renewing, disabling, enabling, ranking, listing, showing, revoking):
        add_operator_options(action)
        add_json_flag(action)


def add(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        made = service.add_user(arguments.name, arguments.role, days_valid=arguments.days)
    emit(arguments, {"name": arguments.name, "role": arguments.role, "token": made.token}, text=made.token)
    return 0


def renew(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        made = service.add_token(arguments.name, days_valid=arguments.days, revoke_others=not arguments.keep)
    emit(arguments, {"name": arguments.name, "token": made.token}, text=made.token)
    return 0


def ensure(arguments: argparse.Namespace) -> int:
    import os

    from ground_service.access.service import ensure_user
    from linna.errors import UsageError

    token = os.environ.get(arguments.token_variable, "")
    if not token:
        raise UsageError(f"{arguments.token_variable}: expected the token of {arguments.name}, found nothing")
    with open_service(arguments) as ground:
        changed = ensure_user(ground, arguments.name, arguments.role, token, actor=local_actor())
    state = "set" if changed else "unchanged"
    emit(arguments, {"name": arguments.name, "changed": changed}, text=f"{arguments.name}: {state}")
    return 0


def change(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        user = service.change_user(arguments.name, state=arguments.state, role=arguments.role)
    emit(arguments, user.model_dump(mode="json"), text=f"{user.name}: {user.role}, {user.state}")
    return 0


def list_all(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        users = list(service.list_users())
    emit(
        arguments,
        {"users": [user.model_dump(mode="json") for user in users]},
        text="\n".join(f"{user.role:<9} {user.state:<9} {user.name}" for user in users) or "no users",
    )
    return 0


def list_tokens(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        tokens = list(service.list_tokens(user=arguments.name))
    lines = [
        f"{one.id:>5}  {one.user:<12} {one.hint:<12}  {one.state:<8} created {str(one.created)[:19]}Z  "
        f"expires {str(one.expires)[:19] + 'Z' if one.expires else 'never':<20}  "
        f"used {str(one.used)[:13] + 'h' if one.used else 'never'}"
        for one in tokens
    ]
    emit(
        arguments,
        {"tokens": [one.model_dump(mode="json") for one in tokens]},
        text="\n".join(lines) or "no tokens",
    )
    return 0


def revoke(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        service.revoke_token(arguments.token_id)
        token = next(one for one in service.list_tokens() if one.id == arguments.token_id)
    emit(arguments, token.model_dump(mode="json"), text=f"{token.id}: revoked")
    return 0
