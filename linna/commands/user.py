"""`linna user add | token | ensure | list | disable | enable | role | tokens | revoke`: users and their tokens."""

from __future__ import annotations

import argparse

from linna.commands._ground import add_service_options, local_actor, open_service
from linna.output import add_json_flag, emit

ROLES = ("viewer", "operator", "admin")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    adding = actions.add_parser("add", help="add a user and print the token, once")
    adding.set_defaults(handler=add)
    renewing = actions.add_parser("token", help="give a user a new token and revoke all earlier ones")
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
    listing = actions.add_parser("list", help="all users")
    listing.set_defaults(handler=list_all)
    showing = actions.add_parser("tokens", help="list the tokens without their secrets, newest first")
    showing.add_argument("name", nargs="?", help="only tokens of this user")
    showing.set_defaults(handler=list_tokens)
    revoking = actions.add_parser("revoke", help="revoke one token")
    revoking.add_argument("token_id", type=int, metavar="ID", help="number shown by 'linna user tokens'")
    revoking.set_defaults(handler=revoke)
    for action in (
        adding,
        renewing,
        ensuring,
        disabling,
        enabling,
        ranking,
        listing,
        showing,
        revoking,
    ):
        add_service_options(action)
        add_json_flag(action)


def add(arguments: argparse.Namespace) -> int:
    from ground_service.access.service import add_user

    with open_service(arguments) as ground:
        token = add_user(
            ground, arguments.name, arguments.role, days_valid=arguments.days, actor=local_actor()
        )
    emit(arguments, {"name": arguments.name, "role": arguments.role, "token": token}, text=token)
    return 0


def renew(arguments: argparse.Namespace) -> int:
    from ground_service.access.service import add_token, renew_token

    make = add_token if arguments.keep else renew_token
    with open_service(arguments) as ground:
        token = make(ground, arguments.name, days_valid=arguments.days, actor=local_actor())
    emit(arguments, {"name": arguments.name, "token": token}, text=token)
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
    from ground_service.access.service import change_user

    with open_service(arguments) as ground:
        user = change_user(
            ground, arguments.name, state=arguments.state, role=arguments.role, actor=local_actor()
        )
    emit(arguments, user.model_dump(), text=f"{user.name}: {user.role}, {user.state}")
    return 0


def list_all(arguments: argparse.Namespace) -> int:
    from ground_service.access.service import list_users

    with open_service(arguments) as ground:
        users = list_users(ground)
    emit(
        arguments,
        {"users": [user.model_dump() for user in users]},
        text="\n".join(f"{user.role:<9} {user.state:<9} {user.name}" for user in users) or "no users",
    )
    return 0


def list_tokens(arguments: argparse.Namespace) -> int:
    from ground_service.access.service import list_tokens as read_tokens

    with open_service(arguments) as ground:
        tokens = read_tokens(ground, arguments.name)
    lines = [
        f"{one.id:>5}  {one.user:<12} {one.hint:<12}  {one.state:<8} created {one.created[:19]}Z  "
        f"expires {one.expires[:19] + 'Z' if one.expires else 'never':<20}  "
        f"used {one.used[:13] + 'h' if one.used else 'never'}"
        for one in tokens
    ]
    emit(
        arguments,
        {"tokens": [one.model_dump() for one in tokens]},
        text="\n".join(lines) or "no tokens",
    )
    return 0


def revoke(arguments: argparse.Namespace) -> int:
    from ground_service.access.service import revoke_token

    with open_service(arguments) as ground:
        token = revoke_token(ground, arguments.token_id, actor=local_actor())
    emit(arguments, token.model_dump(), text=f"{token.id}: revoked")
    return 0
