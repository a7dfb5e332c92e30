"""What the ground's commands share: which service they work on."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ground_service.services.ground import Ground
    from ground_service.settings import Settings


def add_service_options(parser: argparse.ArgumentParser) -> None:
    """Options that choose the local service."""
    parser.add_argument(
        "--home",
        type=Path,
        metavar="DIR",
        help="folder of database, raw files and reports (default: $LINNA_HOME)",
    )


def settings_of(arguments: argparse.Namespace, **given: object) -> Settings:
    """The deployment's settings, with what the command line overrides."""
    from ground_service.settings import load_settings

    return load_settings(home=getattr(arguments, "home", None), **given)


def open_service(arguments: argparse.Namespace) -> Ground:
    """The local service, its database brought up to date where that is this program's to do."""
    from ground_service.services.ground import open_ground
    from linna.data import data_folder

    settings = settings_of(arguments)
    return open_ground(settings.home, data_folder(), database_url=settings.resolved_database_url())
