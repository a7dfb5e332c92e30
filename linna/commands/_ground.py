"""What the ground's commands share: which service they work on, here or at a server."""

from __future__ import annotations

import argparse
import getpass
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ground_service.ground import Ground
    from ground_service.settings import Settings


def add_service_options(parser: argparse.ArgumentParser) -> None:
    """Options that choose the local service."""
    parser.add_argument(
        "--home",
        type=Path,
        metavar="DIR",
        help="folder of database, raw files and reports (default: $LINNA_HOME)",
    )


def add_operator_options(parser: argparse.ArgumentParser) -> None:
    """Options that choose the local service or a server."""
    add_service_options(parser)
    parser.add_argument(
        "--server", metavar="URL", help="work on this server (default: $LINNA_SERVER, else this machine)"
    )
    parser.add_argument("--token", metavar="T", help="token for the server (default: $LINNA_TOKEN)")
    parser.add_argument(
        "--as", dest="actor", metavar="NAME", help="who does it, without a server (default: you)"
    )


def operations(arguments: argparse.Namespace) -> Any:
    """The operators' work (`LocalOperations` or `Client`), to be used in a with statement."""
    server = arguments.server or (None if arguments.home else os.environ.get("LINNA_SERVER"))
    if server:
        from ground_service.client import Client

        if arguments.home:
            from linna.errors import UsageError

            raise UsageError("--home and --server: expected one of them, found both")
        return Client(server, arguments.token or os.environ.get("LINNA_TOKEN"))
    from ground_service.operations import LocalOperations

    return LocalOperations(open_service(arguments), str(arguments.actor or local_actor()))


def local_actor() -> str:
    """Return the name of the operating-system user for the audit log; the user id if there is no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


def settings_of(arguments: argparse.Namespace, **given: object) -> Settings:
    """The deployment's settings, with what the command line overrides."""
    from ground_service.settings import load_settings

    return load_settings(home=getattr(arguments, "home", None), **given)


def open_service(arguments: argparse.Namespace) -> Ground:
    """The local service, its database brought up to date where that is this program's to do."""
    from ground_service.worker.follow_up import open_following
    from linna.data import data_folder

    settings = settings_of(arguments)
    return open_following(
        settings.home,
        data_folder(),
        database_url=settings.resolved_database_url(),
        runner=settings.runner_exchange,
    )
