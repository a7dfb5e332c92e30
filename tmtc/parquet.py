"""A table as an Apache Parquet file: one row group, uncompressed, plain encoding, nullable columns.

References
----------
Apache Parquet format 2.x: `parquet.thrift` for the numbers of fields and codes, and the Thrift compact protocol.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

_MAGIC = b"PAR1"
_INT64, _DOUBLE, _BYTE_ARRAY = 2, 5, 6
_OPTIONAL = 1
_UTF8, _UINT_64 = 0, 14
_PLAIN, _RLE = 0, 3
_DATA_PAGE = 0

# Thrift compact protocol types
_I32, _I64, _BINARY, _LIST, _STRUCT = 5, 6, 8, 9, 12


def parquet_octets(columns: Mapping[str, Sequence[object]]) -> bytes:
    """A Parquet file of columns of one length; values are integers, floats or texts, None where there is none."""
    rows = len(next(iter(columns.values()), ()))
    body = bytearray(_MAGIC)
    chunks, schema = [], [_struct((4, _BINARY, _binary("schema")), (5, _I32, _zigzag(len(columns))))]
    total = 0
    for name, values in columns.items():
        kind, converted, data = _plain(values)
        levels = _levels(values)
        page = struct.pack("<I", len(levels)) + levels + data
        page_header = _struct(
            (1, _I32, _zigzag(_DATA_PAGE)),
            (2, _I32, _zigzag(len(page))),
            (3, _I32, _zigzag(len(page))),
            (
                5,
                _STRUCT,
                _struct(
                    (1, _I32, _zigzag(rows)),
                    (2, _I32, _zigzag(_PLAIN)),
                    (3, _I32, _zigzag(_RLE)),
                    (4, _I32, _zigzag(_RLE)),
                ),
            ),
        )
        at, size = len(body), len(page_header) + len(page)
        body += page_header + page
        total += size
        meta = _struct(
            (1, _I32, _zigzag(kind)),
            (2, _LIST, _list(_I32, [_zigzag(_PLAIN), _zigzag(_RLE)])),
            (3, _LIST, _list(_BINARY, [_binary(name)])),
            (4, _I32, _zigzag(0)),
            (5, _I64, _zigzag(rows)),
            (6, _I64, _zigzag(size)),
            (7, _I64, _zigzag(size)),
            (9, _I64, _zigzag(at)),
        )
        chunks.append(_struct((2, _I64, _zigzag(at)), (3, _STRUCT, meta)))
        element = [(1, _I32, _zigzag(kind)), (3, _I32, _zigzag(_OPTIONAL)), (4, _BINARY, _binary(name))]
        if converted is not None:
            element.append((6, _I32, _zigzag(converted)))
        schema.append(_struct(*element))
    group = _struct((1, _LIST, _list(_STRUCT, chunks)), (2, _I64, _zigzag(total)), (3, _I64, _zigzag(rows)))
    footer = _struct(
        (1, _I32, _zigzag(1)),
        (2, _LIST, _list(_STRUCT, schema)),
        (3, _I64, _zigzag(rows)),
        (4, _LIST, _list(_STRUCT, [group])),
        (6, _BINARY, _binary("linna tmtc")),
    )
    return bytes(body) + footer + struct.pack("<I", len(footer)) + _MAGIC


def _plain(values: Sequence[object]) -> tuple[int, int | None, bytes]:
    """(physical type, converted type, plain encoding) of the values that are there.

    Whole numbers are signed, or unsigned where one does not fit; a column that fits neither is written as text.
    """
    present = [value for value in values if value is not None]
    numbers = [int(value) for value in present if isinstance(value, (int, np.integer))]
    if present and len(numbers) == len(present):
        least, greatest = min(numbers), max(numbers)
        if least >= -(1 << 63) and greatest < 1 << 63:
            return _INT64, None, np.array(numbers, dtype="<i8").tobytes()
        if least >= 0 and greatest < 1 << 64:
            return _INT64, _UINT_64, np.array(numbers, dtype="<u8").tobytes()
    elif all(isinstance(value, (int, float, np.integer, np.floating)) for value in present):
        return _DOUBLE, None, np.array(present, dtype="<f8").tobytes()
    texts = [str(value).encode() for value in present]
    return _BYTE_ARRAY, _UTF8, b"".join(struct.pack("<I", len(text)) + text for text in texts)


def _levels(values: Sequence[object]) -> bytes:
    """Definition levels, 1 where there is a value, as one bit-packed run."""
    bits = np.array([value is not None for value in values], dtype=np.uint8)
    groups = -(-bits.size // 8)
    return _varint(groups << 1 | 1) + np.packbits(bits, bitorder="little").tobytes()


def _varint(value: int) -> bytes:
    octets = bytearray()
    while value > 0x7F:
        octets.append(value & 0x7F | 0x80)
        value >>= 7
    octets.append(value)
    return bytes(octets)


def _zigzag(value: int) -> bytes:
    return _varint(value << 1 if value >= 0 else (-value << 1) - 1)


def _binary(text: str) -> bytes:
    octets = text.encode()
    return _varint(len(octets)) + octets


def _list(kind: int, elements: list[bytes]) -> bytes:
    head = (
        bytes((len(elements) << 4 | kind,))
        if len(elements) < 15
        else bytes((0xF0 | kind,)) + _varint(len(elements))
    )
    return head + b"".join(elements)


def _struct(*fields: tuple[int, int, bytes]) -> bytes:
    """A Thrift struct of (field number, type, encoded value), numbers rising."""
    octets, last = bytearray(), 0
    for number, kind, value in fields:
        octets.append((number - last) << 4 | kind)
        octets += value
        last = number
    return bytes(octets) + b"\0"
