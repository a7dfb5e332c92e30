"""Where the real data products are: $LINNA_DATA, else the user's data directory, else nowhere."""

from __future__ import annotations

import os
from pathlib import Path

from lunar.datafolder import DataFolder, find_data


def user_data_directory() -> Path:
    """The folder that `linna data fetch` fills (XDG base directory convention)."""
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "linna" / "data"


def data_folder() -> DataFolder:
    """The data products at hand; an empty folder object when there are none. A wrong $LINNA_DATA is an error."""
    named = os.environ.get("LINNA_DATA")
    if named:
        return find_data(Path(named))
    default = user_data_directory()
    return find_data(default if default.is_dir() else None)
