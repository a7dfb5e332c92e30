"""On-board processing of optional instruments: one module per instrument, found by package discovery.

A module declares `INSTRUMENT`, a `FlightInstrument`. No list names the modules: adding a file adds an instrument.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from types import MappingProxyType

from payload_emulator.flight.instruments._declaration import (
    AttitudeEstimate,
    FlightInstrument,
    Knowledge,
    Measured,
    Reading,
)

__all__ = [
    "AttitudeEstimate",
    "FlightInstrument",
    "Knowledge",
    "Measured",
    "Reading",
    "flight_instruments",
]


@functools.cache
def flight_instruments() -> Mapping[str, FlightInstrument]:
    """Return the declarations of all instruments by name: those that give attitude first, then by name."""
    names = (item.name for item in pkgutil.iter_modules(__path__) if not item.name.startswith("_"))
    found: list[FlightInstrument] = [
        importlib.import_module(f"{__name__}.{name}").INSTRUMENT for name in names
    ]
    found.sort(key=lambda one: (not one.gives_attitude, one.name))
    return MappingProxyType({one.name: one for one in found})
