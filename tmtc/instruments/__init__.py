"""Telemetry of optional instruments: one module per instrument, found by package discovery.

A module declares `TELEMETRY`, an `InstrumentTelemetry`. No list names the modules: adding a file adds an instrument.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from dataclasses import dataclass

from tmtc.codes import Labels
from tmtc.fields import Field
from tmtc.schema import Group, PacketDefinition

APID_INSTRUMENTS = 0x0AE
_SERVICE = 129

SAMPLE_STATUSES: Labels = ((0, "used"), (1, "gated"), (2, "no_data"), (3, "no_model"))
"""Used by the estimator; refused by its gate; the instrument gave no value; the estimator cannot predict the value."""

ATTITUDE = "camera_from_icrf_wxyz"
"""Field of an instrument that gives attitude: the quaternion with which the frame was processed, NaN without one."""


@dataclass(frozen=True, slots=True)
class Residual:
    """Measurement minus prediction in each sample.

    Attributes
    ----------
    field, sigma_field
        Names of the fields with the residual and with its standard deviation as predicted, NaN where there is none.
    scale, unit
        Factor from the field to the unit of reports.
    """

    label: str
    field: str
    sigma_field: str
    unit: str
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class InstrumentTelemetry:
    """Packet of an instrument and what a report shows of it.

    Attributes
    ----------
    name
        Name of the instrument, of its packet and of its section in scenarios.
    since
        Version of the dictionary that added the packet.
    quantities
        Names of the sample fields whose statistics a report shows. All sample fields are parameters with a series.
    """

    name: str
    title: str
    since: int
    packet: PacketDefinition
    residuals: tuple[Residual, ...]
    quantities: tuple[str, ...] = ()

    @property
    def sample_fields(self) -> tuple[Field, ...]:
        """Fields of a sample after its time and status."""
        group = self.packet.group
        fields = () if group is None else group.fields
        return tuple(one for one in fields if one.name not in ("sample_ticks", "sample_status"))


def sample_packet(
    name: str,
    subtype: int,
    description: str,
    sample: tuple[Field, ...],
    frame: tuple[Field, ...] = (),
) -> PacketDefinition:
    """Return the packet of an instrument: frame, fields of the frame, then a group with a row per sample.

    Parameters
    ----------
    subtype
        Subtype of service 129 under the APID of instruments, unique to the instrument.
    sample, frame
        Fields of each sample after its time and status, and fields of the frame.
    """
    return PacketDefinition(
        name,
        APID_INSTRUMENTS,
        _SERVICE,
        subtype,
        description,
        (
            Field("frame_number", "u32", "Count of frames since the start of the observation"),
            Field(
                "frame_ticks",
                "u64",
                "On-board time of the frame before which the samples were taken",
                "2^-16 s",
            ),
            *frame,
            Field("count", "u8", "Number of samples that follow"),
        ),
        Group(
            "count",
            (
                Field("sample_ticks", "u64", "On-board time of the sample", "2^-16 s"),
                Field("sample_status", "u8", "Use of the sample by the estimator", labels=SAMPLE_STATUSES),
                *sample,
            ),
        ),
    )


@functools.cache
def instrument_telemetry() -> tuple[InstrumentTelemetry, ...]:
    """Return the declarations of all instruments, in the order in which the dictionary got them, then by name."""
    names = (item.name for item in pkgutil.iter_modules(__path__) if not item.name.startswith("_"))
    found: list[InstrumentTelemetry] = [
        importlib.import_module(f"{__name__}.{name}").TELEMETRY for name in names
    ]
    return tuple(sorted(found, key=lambda one: (one.since, one.name)))
