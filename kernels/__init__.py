"""Compiled functions; the import of this package alone does not import numba."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder of compiled code: NUMBA_CACHE_DIR, else linna/kernels in the user's cache folder."""
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "linna" / "kernels"
