"""Estimates of the navigation filter with full covariances, from the packets of any dictionary version."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tmtc.arrays import FloatArray, IntArray
from tmtc.dictionary.schema import Table
from tmtc.packets.pus import onboard_ticks

ESTIMATE_PACKETS = ("filter_state", "filter_estimate")
"""Packets that carry an estimate: in version 2, and from version 3 on."""

STATES = 9


@dataclass(frozen=True, slots=True, eq=False)
class FilterEstimates:
    """Filter estimates in the order of their packets.

    Attributes
    ----------
    packet_index
        IntArray of each packet in its stream, shape (n,).
    image_ticks, frame_number
        Of the image, shape (n,).
    packet_ticks
        On-board time of the packet, shape (n,).
    state
        Position (m) and velocity (m/s), Moon-centred, in the inertial axes of the payload; empirical acceleration
        (m/s^2), radial, transverse, normal; shape (n, 9).
    covariance
        Of the state, in its units and axes, shape (n, 9, 9).
    innovation_degrees
        Degrees of freedom of the normalised innovation squared, 0 without a fix, -1 if unknown (version 2).
    """

    packet_index: IntArray
    image_ticks: IntArray
    frame_number: IntArray
    packet_ticks: IntArray
    state: FloatArray
    covariance: FloatArray
    innovation_degrees: IntArray

    def __len__(self) -> int:
        return len(self.image_ticks)


def filter_estimates(tables: Mapping[str, Table]) -> FilterEstimates:
    """Return the estimates in unpacked tables, those of version 2 first; empty if no such packet was received."""
    parts = [_of_table(tables[name]) for name in ESTIMATE_PACKETS if name in tables]
    if not parts:
        none = np.zeros(0, dtype=np.int64)
        states = np.zeros((0, STATES)), np.zeros((0, STATES, STATES))
        return FilterEstimates(none, none, none, none, *states, none)
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in FilterEstimates.__dataclass_fields__)
    return FilterEstimates(*columns)


def full_covariance(triangle: FloatArray, *, upper: bool) -> FloatArray:
    """Return symmetric matrices (n, 9, 9) from triangles by rows (n, 45)."""
    rows, columns = np.triu_indices(STATES) if upper else np.tril_indices(STATES)
    covariance = np.zeros((len(triangle), STATES, STATES))
    covariance[:, rows, columns] = covariance[:, columns, rows] = triangle
    return covariance


def _of_table(table: Table) -> FilterEstimates:
    columns, upper = table.columns, table.name == "filter_estimate"
    names = ("position_icrf_m", "velocity_icrf_m_s", "acceleration_rtn_m_s2")
    return FilterEstimates(
        table.packet_index,
        onboard_ticks(columns["image_ticks"]),
        columns["frame_number"],
        table.ticks,
        np.concatenate([columns[name] for name in names], axis=1),
        full_covariance(columns["covariance"], upper=upper),
        columns["innovation_degrees"] if upper else np.full(len(table), -1, dtype=np.int64),
    )
