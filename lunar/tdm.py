"""CCSDS Tracking Data Message 2.0 of optical sightings: directions from a spacecraft to landmarks.

Each landmark is a participant of its own segment.  The path is from the landmark (2) to the spacecraft
(1); the angles are right ascension and declination of the line of sight in ICRF axes.

References
----------
CCSDS 503.0-B-2 (2020), Tracking Data Message, sections 3.3 and 3.5 (ANGLE_TYPE = RADEC).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.errors import EphemerisError
from lunar.kvn import comment_lines, epoch_texts
from lunar.timescales import format_utc


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Directions to one landmark: epochs (n,), ascending, and unit vectors (n, 3) in ICRF axes."""

    landmark: str
    utc_ns: IntArray
    direction_icrf: FloatArray
    comments: tuple[str, ...] = ()


def format_tdm(
    sightings: Sequence[Sightings],
    spacecraft: str,
    *,
    comments: Sequence[str] = (),
    originator: str = "LINNA",
    creation_utc_ns: int | None = None,
) -> str:
    """Return TDM 2.0 text; angles to 1e-9 deg.  CREATION_DATE is the first epoch unless given.

    Raises
    ------
    EphemerisError
        Where there is no sighting.
    """
    if not sightings:
        raise EphemerisError("a TDM: expected at least one sighting, found none")
    created = min(int(one.utc_ns[0]) for one in sightings) if creation_utc_ns is None else creation_utc_ns
    lines = [
        "CCSDS_TDM_VERS = 2.0",
        *comment_lines(comments),
        f"CREATION_DATE = {format_utc(created).rstrip('Z')}",
        f"ORIGINATOR = {originator}",
        "",
    ]
    for one in sightings:
        texts = epoch_texts(one.utc_ns)
        x, y, z = one.direction_icrf.T
        ascension = np.degrees(np.arctan2(y, x)) % 360.0
        declination = np.degrees(np.arctan2(z, np.hypot(x, y)))
        lines += [
            "META_START",
            *comment_lines(one.comments),
            "TIME_SYSTEM = UTC",
            f"START_TIME = {texts[0]}",
            f"STOP_TIME = {texts[-1]}",
            f"PARTICIPANT_1 = {spacecraft}",
            f"PARTICIPANT_2 = {one.landmark}",
            "MODE = SEQUENTIAL",
            "PATH = 2,1",
            "ANGLE_TYPE = RADEC",
            "REFERENCE_FRAME = ICRF",
            "META_STOP",
            "",
            "DATA_START",
        ]
        for text, first, second in zip(texts, ascension.tolist(), declination.tolist(), strict=True):
            lines += [f"ANGLE_1 = {text} {first:.9f}", f"ANGLE_2 = {text} {second:.9f}"]
        lines += ["DATA_STOP", ""]
    return "\n".join(lines)
