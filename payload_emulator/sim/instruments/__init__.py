"""Simulated instruments: one module per instrument, found by package discovery.

A module declares `INSTRUMENT`, a `SimulatedInstrument`. No list names the modules: adding a file adds an instrument.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from types import MappingProxyType

from payload_emulator.sim.instruments._declaration import (
    Limit,
    SimulatedInstrument,
    Situation,
    Surroundings,
)

__all__ = ["Limit", "SimulatedInstrument", "Situation", "Surroundings", "simulated_instruments"]


@functools.cache
def simulated_instruments() -> Mapping[str, SimulatedInstrument]:
    """Return the declarations of all instruments by name, in alphabetical order."""
    names = sorted(item.name for item in pkgutil.iter_modules(__path__) if not item.name.startswith("_"))
    found: list[SimulatedInstrument] = [
        importlib.import_module(f"{__name__}.{name}").INSTRUMENT for name in names
    ]
    return MappingProxyType({one.name: one for one in found})
