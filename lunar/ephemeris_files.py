"""Ephemeris files of either format: CCSDS OEM or STK."""

from __future__ import annotations

from pathlib import Path

from lunar.ephemeris import Ephemeris, read_text
from lunar.errors import DataFileError
from lunar.oem import parse_oem
from lunar.stk import parse_stk


def load_ephemeris(path: Path | str) -> Ephemeris:
    """Return the ephemeris in a CCSDS OEM (KVN) or STK ``.e`` file, distinguished by content.

    Raises
    ------
    DataFileError
        Where the file is neither, or says something that cannot be.
    """
    text = read_text(path, "a CCSDS OEM or STK .e ephemeris")
    for line in text.split("\n", 50)[:50]:
        word = line.strip()
        if word.startswith("CCSDS_OEM_VERS"):
            return parse_oem(text, source=str(path))
        if word.lower().startswith("stk.v"):
            return parse_stk(text, source=str(path))
        if word and not word.startswith(("COMMENT", "#")):
            raise DataFileError(path, "first line", "CCSDS_OEM_VERS or stk.v.", repr(word[:40]))
    raise DataFileError(path, "first line", "CCSDS_OEM_VERS or stk.v.", "nothing")
