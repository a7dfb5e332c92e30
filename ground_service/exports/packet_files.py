"""Decoded packets as Parquet files, one for each packet type."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from lunar.timescales import parse_utc
from tmtc.export import Record, column_metadata, record_columns
from tmtc.parquet import parquet_octets

_UTC = {"utc": {"description": "time of the packet: on-board time with the time correlation of the pass"}}


def parquet_files(
    packets: Iterable[tuple[str, bool, list[Record]]], about: Mapping[str, str]
) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of a file for each packet type.

    UTC is a time stamp; the metadata of a column state its unit and description.

    Raises
    ------
    MissingLibrary
        If pyarrow is not installed.
    """
    for name, own, records in packets:
        columns = record_columns(records)
        columns["utc"] = [parse_utc(str(text)) for text in columns["utc"]]
        stated = column_metadata(name) if own else {}
        octets = parquet_octets(
            columns, utc_columns=("utc",), fields={**stated, **_UTC}, about={**about, "packet": name}
        )
        yield f"{name.replace('/', '.')}.parquet", octets
