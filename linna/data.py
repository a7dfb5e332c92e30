"""Location of the real data products: $LINNA_DATA, else the user's data directory; location of Blender."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lunar.datafolder import DataFolder, find_data

if TYPE_CHECKING:
    from lunar.ephemeris import Ephemeris


def user_data_directory() -> Path:
    """The folder that `linna data fetch` fills (XDG base directory convention)."""
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "linna" / "data"


def data_directory() -> Path:
    """Return the folder of the data products: $LINNA_DATA, else the user's data directory."""
    named = os.environ.get("LINNA_DATA")
    return Path(named) if named else user_data_directory()


def data_folder() -> DataFolder:
    """Return the folder of available data products; empty if there are none. An invalid $LINNA_DATA is an error."""
    named = os.environ.get("LINNA_DATA")
    if named:
        return find_data(Path(named))
    default = user_data_directory()
    return find_data(default if default.is_dir() else None)


def load_orbit(path: Path) -> Ephemeris:
    """Return the ephemeris in a file for figures of its states, which must move as gravity moves them."""
    from lunar.comparison import check_gravity
    from lunar.messages.ephemeris_files import load_ephemeris

    ephemeris = load_ephemeris(path)
    check_gravity(ephemeris)
    return ephemeris


def blender_python() -> str:
    """The interpreter that has Blender as a module: $LINNA_BLENDER_PYTHON, else the one that runs this."""
    return os.environ.get("LINNA_BLENDER_PYTHON") or sys.executable
