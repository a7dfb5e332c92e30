"""Option `--region`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from payload_emulator.sim.terrain.curation import Region


def parse_region(text: str) -> Region:
    """Return the region of W,E,S,N in degrees."""
    from linna.errors import UsageError
    from payload_emulator.sim.terrain.curation import Region

    try:
        west, east, south, north = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--region: expected four numbers W,E,S,N in degrees, found {text!r}") from None
    if not (-90.0 <= south < north <= 90.0 and 0.0 < east - west <= 360.0):
        raise UsageError(f"--region: expected west before east and south before north, found {text!r}")
    return Region(west, east, south, north)
