"""Tables as files: CSV with metadata for the web, and netCDF-4 with a group for each table.

References
----------
W3C Recommendation "Metadata Vocabulary for Tabular Data" (2015); CF conventions 1.11 for times and units.
"""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.exports.tables import Column, Table
from lunar.timescales import parse_utc
from tmtc.errors import MissingLibrary
from tmtc.export import Record, column_metadata, parquet_octets, record_columns

_UTC = {"utc": {"description": "time of the packet: on-board time with the time correlation of the pass"}}


CSV_METADATA = "csv-metadata.json"
_UTC_UNITS = "nanoseconds since 1970-01-01T00:00:00"


def csv_files(tables: Sequence[Table], about: Mapping[str, str]) -> Iterator[tuple[str, bytes]]:
    """Yield a CSV file for each table, and `csv-metadata.json` with types, units and descriptions.

    Unknown numbers are empty.
    """
    for table in tables:
        yield f"{table.name}.csv", _csv(table)
    document = {
        "@context": "http://www.w3.org/ns/csvw",
        **{f"dc:{key}": value for key, value in about.items()},
        "tables": [_csv_metadata(table) for table in tables],
    }
    yield CSV_METADATA, json.dumps(document, indent=1).encode()


def _csv(table: Table) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in table.columns])
    writer.writerows(zip(*(_cells(column) for column in table.columns), strict=True))
    return text.getvalue().encode()


def _cells(column: Column) -> list[Any]:
    if column.unit == "utc":
        texts = np.datetime_as_string(column.values.astype("datetime64[ns]"), unit="ns").tolist()
        return [f"{text}Z" for text in texts]
    values = column.values.tolist()
    return ["" if value != value else value for value in values]  # NaN is not equal to itself


def _csv_metadata(table: Table) -> dict[str, Any]:
    columns = []
    for column in table.columns:
        entry = {"name": column.name, "titles": column.name, "dc:description": column.description}
        columns.append(
            entry | {"datatype": _datatype(column)} | ({"linna:unit": column.unit} if column.unit else {})
        )
    return {
        "url": f"{table.name}.csv",
        "dc:description": table.description,
        "tableSchema": {"columns": columns},
    }


def _datatype(column: Column) -> str:
    if column.unit == "utc":
        return "dateTime"
    return {"i": "integer", "f": "number"}.get(column.values.dtype.kind, "string")


def netcdf_octets(tables: Sequence[Table], about: Mapping[str, str]) -> bytes:
    """Return a netCDF-4 file with a group for each table; times are CF times, unknown numbers NaN.

    Raises
    ------
    MissingLibrary
        If xarray or h5netcdf is not installed.
    """
    try:
        import h5netcdf  # noqa: F401 # the engine of xarray
        import xarray
    except ImportError:
        raise MissingLibrary("netCDF", "xarray with h5netcdf", "linna[netcdf]") from None
    groups = {"/": xarray.Dataset(attrs={"Conventions": "CF-1.11", **about})}
    for table in tables:
        variables = {column.name: _variable(table, column) for column in table.columns}
        groups[f"/{table.name}"] = xarray.Dataset(variables, attrs={"title": table.description})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pass.nc"
        xarray.DataTree.from_dict(groups).to_netcdf(path, engine="h5netcdf")
        return path.read_bytes()


def _variable(table: Table, column: Column) -> Any:
    attributes = {"long_name": column.description}
    values = column.values
    if column.unit == "utc":
        attributes |= {"standard_name": "time", "units": _UTC_UNITS, "calendar": "standard"}
    elif column.unit:
        attributes["units"] = column.unit
    if values.dtype.kind == "O":
        # The file takes texts of a fixed length, and an empty array has none.
        values = values.astype("U") if len(values) else values.astype("U1")
    return (f"{table.name}_row", values, attributes)


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
