"""Options and client of the commands that work on the ground service, of this machine or of a server."""

from __future__ import annotations

import argparse
import getpass
import os
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from linna.data import data_folder
from linna.errors import UsageError
from linna.output import log
from linna.parser import option

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.ground import Ground
    from ground_service.settings import Settings


def add_service_options(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses the local service."""
    option(parser, "--home DIR", Path, "folder of the database, raw files and reports (default: $LINNA_HOME)")


def add_operator_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the local service or a server."""
    add_service_options(parser)
    option(parser, "--server URL", str, "work on this server (default: $LINNA_SERVER, otherwise this machine)")
    option(parser, "--token T", str, "token for the server (default: $LINNA_TOKEN)")
    option(parser, "--as NAME", str, "actor in the audit log, without a server (default: the login name)", dest="actor")


def ground_client(arguments: argparse.Namespace, *, background: bool = False) -> Client:
    """Return a client of the server that the options name, otherwise of the service of this machine.

    On this machine, `background` lets jobs run in a thread while their progress is shown.
    """
    server = server_of(arguments)
    if server is None:
        import logging

        from ground_service.client.local import local_client
        from ground_service.clock import follow_missions, mission_now_ns

        def read_clock() -> int:
            from ground_service.missions.clocks import read_mission_clock

            read_mission_clock(ground)
            return mission_now_ns()

        # The error of a failed job is that of the command, which prints it.
        logging.getLogger("ground_service.worker").setLevel(logging.ERROR)
        ground = open_ground_only(arguments)
        follow_missions(read_clock)  # when the time is first asked for: few lists need it
        return local_client(ground, str(arguments.actor or local_actor()), background=background)
    from ground_service.client import Client

    if arguments.home:
        raise UsageError("--home and --server: expected one of them, found both")
    return Client(server, arguments.token or os.environ.get("LINNA_TOKEN"))


def server_of(arguments: argparse.Namespace) -> str | None:
    """Return the URL of the server that the options or the environment name; None for this machine.

    --home is stronger than $LINNA_SERVER; a warning tells that the server is not used.
    """
    named = os.environ.get("LINNA_SERVER")
    if arguments.home and named and not arguments.server:
        log(f"linna: warning: --home {arguments.home} is used, LINNA_SERVER={named} is not")
    return arguments.server or (None if arguments.home else named) or None


def event_of_signals() -> threading.Event:
    """Return an event that SIGTERM and SIGINT set."""
    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    return stopping


def local_actor() -> str:
    """Return the name of the operating-system user for the audit log; the user id if there is no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


def settings_of(arguments: argparse.Namespace, **given: object) -> Settings:
    """Return the settings of the deployment, overridden by the command line."""
    from ground_service.settings import load_settings

    settings = load_settings(home=getattr(arguments, "home", None), **given)
    if settings.clock_file is not None:
        from ground_service.clock import ClockFile, set_mission_clock

        set_mission_clock(ClockFile(settings.clock_file).read)
    return settings


def open_service(arguments: argparse.Namespace) -> Ground:
    """Return the opened service of this machine, which handles its events in this process."""
    from ground_service.missions.clocks import read_mission_clock
    from ground_service.worker.follow_up import follow_in_process

    ground = open_ground_only(arguments)
    follow_in_process(ground)
    read_mission_clock(ground)
    return ground


def open_ground_only(arguments: argparse.Namespace) -> Ground:
    """Return the opened service of this machine, which does not handle events."""
    from ground_service.ground import open_ground
    from ground_service.store.objects import objects_of

    settings = settings_of(arguments)
    return open_ground(
        settings.home,
        data_folder(),
        database_url=settings.resolved_database_url(),
        runner=settings.runner_exchange,
        objects=objects_of(settings),
        networks=settings.notify_networks,
    )
