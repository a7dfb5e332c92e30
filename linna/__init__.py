"""The `linna` command line and `linna.open` for notebooks: the only package that knows emulator and ground service."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from linna.passes import Archive

__version__ = "0.1.0"
__all__ = ["__version__", "open"]


def open(source: str | Path | None = None, *, token: str | None = None) -> Archive:
    """Open passes for analysis: a home folder, the URL of a server, or a pass archive (folder or zip).

    Parameters
    ----------
    source
        None is the home folder of the settings (``LINNA_HOME``).
    token
        Token for a server; ``LINNA_TOKEN`` by default.

    Raises
    ------
    UsageError
        If the source is none of them.
    """
    from linna.passes import open_archive

    return open_archive(source, token)
