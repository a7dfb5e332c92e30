"""Binary encoding of detections, pairs and filter states of one image in a column: little-endian values."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

DETECTION_ITEM = np.dtype(
    [
        ("u_px", "<f4"),
        ("v_px", "<f4"),
        ("diameter_px", "<f4"),
        ("score", "<f4"),
        ("sigma_px", "<f4"),
        ("size_class", "<i1"),
    ]
)
"""Steps of 1/64 px and 1/255 are far coarser than float32 here (2^-15 px at 512 px), so nothing is lost."""


IDENTIFICATION_ITEM = np.dtype([("detection", "<u2"), ("crater_id", "<u4")])


def pack_detections(items: dict[str, NDArray[np.float64]], offsets: NDArray[np.int64]) -> list[bytes]:
    """One octet string per frame of all items (n,), frame i holding rows ``offsets[i]`` to ``offsets[i + 1]``."""
    return _pack(items, offsets, DETECTION_ITEM)


def pack_identifications(items: dict[str, NDArray[np.int64]], offsets: NDArray[np.int64]) -> list[bytes]:
    """As `pack_detections`, of pairs of detection and crater."""
    return _pack(items, offsets, IDENTIFICATION_ITEM)


def _pack(items: dict[str, NDArray[Any]], offsets: NDArray[np.int64], kind: np.dtype[Any]) -> list[bytes]:
    names = kind.names or ()
    records = np.empty(len(items[names[0]]), dtype=kind)
    for name in names:
        records[name] = items[name]
    octets = records.tobytes()
    ends = (offsets * kind.itemsize).tolist()
    return [octets[start:stop] for start, stop in pairwise(ends)]


def unpack_detections(columns: Sequence[bytes]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """The records of all frames one after another, and where each frame begins (f + 1,)."""
    return _unpack(columns, DETECTION_ITEM)


def unpack_identifications(columns: Sequence[bytes]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """As `unpack_detections`, of pairs of detection and crater."""
    return _unpack(columns, IDENTIFICATION_ITEM)


def pack_filter_states(state: NDArray[np.float64], covariance: NDArray[np.float64]) -> list[bytes]:
    """Pack each state (n, k) and the lower triangle of its covariance (n, k, k) into an octet string of float64."""
    rows, columns = np.tril_indices(state.shape[1])
    packed = np.concatenate([state, covariance[:, rows, columns]], axis=1).astype("<f8")
    return [row.tobytes() for row in packed]


def unpack_filter_states(
    columns: Sequence[bytes], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return states (n, size) and covariances (n, size, size) from packed octet strings."""
    rows, places = np.tril_indices(size)
    values = np.frombuffer(b"".join(columns), dtype="<f8").reshape(len(columns), size + len(rows))
    covariance = np.zeros((len(columns), size, size))
    covariance[:, rows, places] = covariance[:, places, rows] = values[:, size:]
    return values[:, :size].astype(np.float64), covariance


def _unpack(columns: Sequence[bytes], kind: np.dtype[Any]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    lengths = np.fromiter((len(c) for c in columns), dtype=np.int64, count=len(columns))
    offsets = np.concatenate(([0], np.cumsum(lengths // kind.itemsize))).astype(np.int64)
    return np.frombuffer(b"".join(columns), dtype=kind), offsets
