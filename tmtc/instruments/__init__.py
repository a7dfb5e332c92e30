"""Telemetry of optional instruments: one module per instrument, found by package discovery.

A module declares `TELEMETRY`, an `InstrumentTelemetry`. No list names the modules: adding a file adds an instrument.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil

from tmtc.instruments._declaration import (
    APID_INSTRUMENTS,
    ATTITUDE,
    SAMPLE_STATUSES,
    InstrumentTelemetry,
    Residual,
    sample_packet,
)

__all__ = [
    "APID_INSTRUMENTS",
    "ATTITUDE",
    "SAMPLE_STATUSES",
    "InstrumentTelemetry",
    "Residual",
    "instrument_telemetry",
    "sample_packet",
]


@functools.cache
def instrument_telemetry() -> tuple[InstrumentTelemetry, ...]:
    """Return the declarations of all instruments, in the order in which the dictionary got them, then by name."""
    names = (item.name for item in pkgutil.iter_modules(__path__) if not item.name.startswith("_"))
    found: list[InstrumentTelemetry] = [
        importlib.import_module(f"{__name__}.{name}").TELEMETRY for name in names
    ]
    return tuple(sorted(found, key=lambda one: (one.since, one.name)))
