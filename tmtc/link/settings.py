"""Settings of a downlink: frame length, coding, randomiser and frame error control.

References
----------
CCSDS 131.0-B (coding, randomiser, marker); CCSDS 132.0-B (TM transfer frame).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from tmtc.errors import LinkFormatError, ValueRefused
from tmtc.link.cadu import ASM_LENGTH
from tmtc.link.frames import FRAME_MAX_LENGTH, Randomiser
from tmtc.link.reed_solomon import ReedSolomon, code_for

Coding = Literal["rs", "none"]
_TEXT_LIMIT = 200

FRAME_MIN_LENGTH = 16
"""Length of the shortest supported frame in octets: header, error control and some data."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Link parameters that must be the same at both ends.

    If `interleave` is None, the least depth that fits `frame_length` (octets) is used. `rs_errors`: number of symbols
    that can be corrected in a codeword. `checksum`: frames end with a frame error control field.
    """

    frame_length: int = 1115
    coding: Coding = "rs"
    randomiser: Randomiser = "legacy"
    interleave: int | None = None
    rs_errors: int = 16
    dual_basis: bool = True
    checksum: bool = True

    def __post_init__(self) -> None:
        if not FRAME_MIN_LENGTH <= self.frame_length <= FRAME_MAX_LENGTH:
            wanted = f"{FRAME_MIN_LENGTH}..{FRAME_MAX_LENGTH}"
            raise ValueRefused("transfer frame", "frame_length", self.frame_length, wanted)

    @classmethod
    def parse(cls, text: str) -> LinkSettings:
        """Return the settings in a text such as ``frame_length=1115,coding=rs,randomiser=legacy,checksum=true``.

        Values that are not given are the defaults.

        Raises
        ------
        LinkFormatError
            A name or value is unknown.
        """
        values: dict[str, Any] = {}
        for part in text[:_TEXT_LIMIT].split(","):
            name, _, value = (one.strip() for one in part.partition("="))
            allowed = _ALLOWED.get(name)
            if allowed is None:
                raise LinkFormatError(f"link: expected {', '.join(_ALLOWED)}, found {name[:40]!r}")
            if isinstance(allowed, dict):
                if value not in allowed:
                    raise LinkFormatError(f"link: {name}: expected {', '.join(allowed)}, found {value[:40]!r}")
                values[name] = allowed[value]
            elif not (value.isascii() and value.isdigit()):
                raise LinkFormatError(f"link: {name}: expected a number, found {value[:40]!r}")
            else:
                values[name] = int(value)
        settings = cls(**values)
        assert settings.code is None or settings.block_length  # refuses an impossible code
        return settings

    @property
    def code(self) -> ReedSolomon | None:
        """Reed-Solomon code, or None."""
        if self.coding == "none":
            return None
        if self.coding != "rs":
            raise LinkFormatError(f"link: expected coding rs or none, found {self.coding!r}")
        return code_for(self.frame_length, self.rs_errors, self.interleave, self.dual_basis)

    @property
    def explicit(self) -> LinkSettings:
        """The settings with the actual interleaving depth, and the defaults of the code for uncoded frames."""
        code = self.code
        if code is None:
            return replace(self, interleave=None, rs_errors=16, dual_basis=True)
        return replace(self, interleave=code.interleave)

    @property
    def block_length(self) -> int:
        """Number of octets between two markers."""
        code = self.code
        return self.frame_length if code is None else code.block_length

    @property
    def cadu_length(self) -> int:
        """Length of a CADU in octets, marker included."""
        return ASM_LENGTH + self.block_length

    @property
    def proves_frames(self) -> bool:
        """Return whether damaged frames can be detected, by code or checksum."""
        return self.coding != "none" or self.checksum

    def describe(self) -> dict[str, object]:
        """Return the settings by name, with the actual interleaving depth, for output."""
        code = self.code
        return {
            "frame_length": self.frame_length,
            "cadu_length": self.cadu_length,
            "coding": self.coding,
            "interleave": code.interleave if code else None,
            "rs_errors": code.errors if code else None,
            "dual_basis": code.dual_basis if code else None,
            "randomiser": self.randomiser,
            "checksum": self.checksum,
        }


_SWITCH = {"true": True, "false": False}
_ALLOWED: dict[str, dict[str, Any] | type[int]] = {
    "frame_length": int,
    "coding": {"rs": "rs", "none": "none"},
    "randomiser": {"legacy": "legacy", "long": "long", "none": "none"},
    "interleave": int,
    "rs_errors": int,
    "dual_basis": _SWITCH,
    "checksum": _SWITCH,
}
"""Names of the settings in a text, and their values."""
