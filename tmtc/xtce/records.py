"""Packets decoded through an imported definition as JSON, CSV or Parquet: one record for each packet."""

import json

from tmtc.export import Record, format_records, plain
from tmtc.xtce.decode import XtceDecode

_CONTAINER = "packet"


def xtce_records(found: XtceDecode, *, raw: bool = False) -> list[Record]:
    """Return a record for each decoded packet in stream order: `packet` names the container, then its parameters.

    Arrays are lists, aggregates mappings, octets hexadecimal digits, numbers that are not finite None. `raw` gives
    values as transmitted instead of calibrated and named ones. A parameter that is called `packet` becomes `packet_`.
    """
    numbered: list[tuple[int, Record]] = []
    for name, table in found.tables.items():
        columns = {
            f"{key}_" if key == _CONTAINER else key: column.to_list(raw) for key, column in table.columns.items()
        }
        rows = zip(*columns.values(), strict=True) if columns else ((),) * len(table)
        for index, values in zip(table.packet_index.tolist(), rows, strict=True):
            record: Record = {_CONTAINER: name}
            record.update(zip(columns, map(plain, values), strict=True))
            numbered.append((index, record))
    numbered.sort(key=lambda pair: pair[0])
    return [record for _, record in numbered]


def format_xtce_records(records: list[Record], kind: str) -> bytes:
    """Return the records as a file of that kind (`json`, `csv`, `parquet`).

    CSV and Parquet hold a row for each packet and a column for every parameter that occurs; members of aggregates are
    columns `parameter.member`, arrays are JSON in one column.
    """
    return format_records(records if kind == "json" else [_flat(record) for record in records], kind)


def _flat(record: Record) -> Record:
    flat: Record = {}
    for key, value in record.items():
        if isinstance(value, dict):
            flat.update({f"{key}.{inner}": one for inner, one in _flat(value).items()})
        elif isinstance(value, list):
            flat[key] = json.dumps(value, allow_nan=False)
        else:
            flat[key] = value
    return flat
