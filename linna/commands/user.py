"""`linna user add | token | list`: users of the ground service."""

from __future__ import annotations

import argparse

from linna.commands._ground import add_service_options, open_service
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    adding = actions.add_parser("add", help="add a user and print the token, once")
    adding.add_argument("name")
    adding.add_argument("--role", choices=("viewer", "operator", "admin"), required=True)
    adding.set_defaults(handler=add)
    renewing = actions.add_parser("token", help="give a user a new token; earlier ones become void")
    renewing.add_argument("name")
    renewing.set_defaults(handler=renew)
    for action in (adding, renewing):
        action.add_argument(
            "--days", type=float, metavar="D", help="days that the token is valid (default: for good)"
        )
    ensuring = actions.add_parser("ensure", help="see to it that a user exists with the token of a variable")
    ensuring.add_argument("name")
    ensuring.add_argument("--role", choices=("viewer", "operator", "admin"), required=True)
    ensuring.add_argument(
        "--token-variable", default="LINNA_ADMIN_TOKEN", metavar="NAME", help="default: LINNA_ADMIN_TOKEN"
    )
    ensuring.set_defaults(handler=ensure)
    listing = actions.add_parser("list", help="all users")
    listing.set_defaults(handler=list_all)
    for action in (adding, renewing, ensuring, listing):
        add_service_options(action)
        add_json_flag(action)


def add(arguments: argparse.Namespace) -> int:
    from ground_service.services.users import add_user

    with open_service(arguments) as ground:
        token = add_user(ground, arguments.name, arguments.role, days_valid=arguments.days)
    emit(arguments, {"name": arguments.name, "role": arguments.role, "token": token}, text=token)
    return 0


def renew(arguments: argparse.Namespace) -> int:
    from ground_service.services.users import renew_token

    with open_service(arguments) as ground:
        token = renew_token(ground, arguments.name, days_valid=arguments.days)
    emit(arguments, {"name": arguments.name, "token": token}, text=token)
    return 0


def ensure(arguments: argparse.Namespace) -> int:
    import os

    from ground_service.services.users import ensure_user
    from linna.errors import UsageError

    token = os.environ.get(arguments.token_variable, "")
    if not token:
        raise UsageError(f"{arguments.token_variable}: expected the token of {arguments.name}, found nothing")
    with open_service(arguments) as ground:
        changed = ensure_user(ground, arguments.name, arguments.role, token)
    state = "set" if changed else "unchanged"
    emit(arguments, {"name": arguments.name, "changed": changed}, text=f"{arguments.name}: {state}")
    return 0


def list_all(arguments: argparse.Namespace) -> int:
    from ground_service.services.users import list_users

    with open_service(arguments) as ground:
        users = list_users(ground)
    emit(
        arguments,
        {"users": users},
        text="\n".join(f"{u['role']:<9} {u['name']}" for u in users) or "no users",
    )
    return 0
