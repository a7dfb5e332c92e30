"""A pass as tables of samples and as table files: columns of one length with unit and description, times in UTC."""

import csv
import io
import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import EvaluationError
from ground_service.evaluation.core import PassInputs
from lunar.arrays import FloatArray, IntArray
from lunar.frames import continuous_quaternions
from lunar.timescales import parse_utc, utc_texts
from lunar.visibility import ground_track
from reports.values import NavigationSeries
from tmtc.errors import MissingLibrary
from tmtc.export import Record, column_metadata, parquet_octets, record_columns

_AXES = (("r", "radial"), ("t", "transverse"), ("n", "normal"))


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """Column of a table: values (n,) of integers, floats (NaN: unknown) or texts; `unit` is empty without one.

    Columns whose unit is `utc` are nanoseconds since 1970-01-01T00:00:00 UTC, without leap seconds.
    """

    name: str
    values: NDArray[np.generic]
    unit: str
    description: str


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Table of a pass."""

    name: str
    description: str
    columns: tuple[Column, ...]

    def __len__(self) -> int:
        return len(self.columns[0].values)


def pass_tables(inputs: PassInputs, navigation: Sequence[NavigationSeries]) -> tuple[Table, ...]:
    """Return the tables of a pass, with the errors of its navigation solutions as evaluated."""
    tables = (
        _states(inputs),
        _residuals(navigation),
        _frames(inputs),
        _detections(inputs),
        _identifications(inputs),
        _landmarks(inputs),
        _housekeeping(inputs),
        _events(inputs),
        _reference(inputs),
        _attitude(inputs),
    )
    if not any(len(one) for one in tables):
        raise EvaluationError(f"pass {inputs.pass_id}: expected samples of the payload, found none")
    return tables


def _utc(values: IntArray) -> Column:
    return Column("utc", np.asarray(values, dtype=np.int64), "utc", "time of the sample")


def _texts(values: Sequence[str]) -> NDArray[np.generic]:
    return np.array(list(values), dtype=object)


def _joined(parts: Sequence[NDArray[np.generic]]) -> NDArray[np.generic]:
    return np.concatenate(parts) if parts else np.zeros(0)


def _states(inputs: PassInputs) -> Table:
    parts = [one for one in inputs.navigation if len(one.utc_ns)]
    names = [np.full(len(one.utc_ns), one.estimator, dtype=object) for one in parts]
    columns = [
        _utc(np.concatenate([one.utc_ns for one in parts]) if parts else np.zeros(0, dtype=np.int64)),
        Column("estimator", _joined(names), "", "name of the estimator"),
        Column("frame_number", _joined([one.frame_number for one in parts]), "", "number of the frame"),
        Column("latitude_deg", _joined([one.latitude_deg for one in parts]), "deg", "mean-Earth latitude"),
        Column("longitude_deg", _joined([one.longitude_deg for one in parts]), "deg", "mean-Earth east longitude"),
        Column("altitude_m", _joined([one.altitude_m for one in parts]), "m", "altitude above 1737.4 km"),
    ]
    for k, (axis, word) in enumerate(_AXES):
        sigma = _joined([one.sigma_rtn_m[:, k] for one in parts])
        columns.append(Column(f"sigma_{axis}_m", sigma, "m", f"1-sigma error, {word}"))
    columns += [
        Column("nis", _joined([one.nis for one in parts]), "", "normalised innovation squared"),
        Column("matched", _joined([one.matched for one in parts]), "", "craters matched"),
        Column("outcome", _joined([_texts(one.outcome) for one in parts]), "", "what the estimator made of the frame"),
    ]
    return Table("states", "States of the on-board estimators", tuple(columns))


def _residuals(navigation: Sequence[NavigationSeries]) -> Table:
    parts = [one for one in navigation if len(one.utc_ns) and len(one.error_rtn_m)]
    unknown = [np.full(len(one.utc_ns), np.nan) for one in parts]
    columns = [
        _utc(np.concatenate([one.utc_ns for one in parts]) if parts else np.zeros(0, dtype=np.int64)),
        Column(
            "solution",
            _joined([np.full(len(one.utc_ns), one.name, dtype=object) for one in parts]),
            "",
            "name of the navigation solution",
        ),
        Column(
            "kind",
            _joined([np.full(len(one.utc_ns), one.kind, dtype=object) for one in parts]),
            "",
            "estimate, smoothed or baseline",
        ),
    ]
    for k, (axis, word) in enumerate(_AXES):
        error = _joined([one.error_rtn_m[:, k] for one in parts])
        columns.append(Column(f"error_{axis}_m", error, "m", f"solution minus reference, {word}"))
    for k, (axis, word) in enumerate(_AXES):
        sigma = _joined(
            [
                none if one.sigma_rtn_m is None else one.sigma_rtn_m[:, k]
                for one, none in zip(parts, unknown, strict=True)
            ]
        )
        columns.append(Column(f"sigma_{axis}_m", sigma, "m", f"claimed 1-sigma error, {word}"))
    distance = _joined([np.linalg.norm(one.error_rtn_m, axis=1) for one in parts])
    columns.append(Column("error_3d_m", distance, "m", "distance of solution and reference"))
    nees = [none if one.nees is None else one.nees for one, none in zip(parts, unknown, strict=True)]
    columns.append(
        Column("nees", _joined(nees), "", "normalised estimation error squared of the position, 3 degrees of freedom")
    )
    return Table("residuals", "Errors of the navigation solutions against the reference", tuple(columns))


def _frames(inputs: PassInputs) -> Table:
    samples = inputs.detections
    archived = np.array([int(number) in inputs.images for number in samples.frame_number], dtype=np.int64)
    columns = (
        _utc(samples.utc_ns),
        Column("frame_number", samples.frame_number, "", "number of the frame"),
        Column("usable", samples.usable.astype(np.int64), "", "1: the payload used the image"),
        Column("quality", _texts(samples.quality), "", "quality of the image as the payload judged it"),
        Column("detections", np.diff(samples.offsets), "", "detections in the frame"),
        Column("archived", archived, "", "1: the image is in the archive"),
    )
    return Table("frames", "Frames with a detection report", columns)


def _detections(inputs: PassInputs) -> Table:
    samples = inputs.detections
    count = np.diff(samples.offsets)
    columns = (
        _utc(np.repeat(samples.utc_ns, count)),
        Column("frame_number", np.repeat(samples.frame_number, count), "", "number of the frame"),
        Column("u_px", samples.u_px, "px", "column; the centre of the first pixel is 0"),
        Column("v_px", samples.v_px, "px", "row; the centre of the first pixel is 0"),
        Column("diameter_px", samples.diameter_px, "px", "apparent diameter"),
        Column("score", samples.score, "", "score of the detector"),
        Column("size_class", samples.size_class, "", "0: 5-10 km, 1: 10-15 km, 2: 15-30 km, 3: 3-5 km, -1: none"),
        Column("crater_id", identified_craters(inputs), "", "crater that the payload identified, -1: none"),
    )
    return Table("detections", "Detections of the payload", columns)


def identified_craters(inputs: PassInputs) -> IntArray:
    """Return the crater (n,) that the payload took each detection of the pass for, -1 for none."""
    samples, found = inputs.detections, inputs.identifications
    craters = np.full(len(samples.u_px), -1, dtype=np.int64)
    if found is None or not len(found) or not len(samples):
        return craters
    frame = np.minimum(np.searchsorted(samples.utc_ns, found.utc_ns), len(samples) - 1)
    row = samples.offsets[frame] + found.detection
    good = (samples.utc_ns[frame] == found.utc_ns) & (found.detection >= 0) & (row < samples.offsets[frame + 1])
    craters[row[good]] = found.crater_id[good]
    return craters


def _identifications(inputs: PassInputs) -> Table:
    found = inputs.identifications
    none = np.zeros(0, dtype=np.int64)
    columns = (
        _utc(none if found is None else found.utc_ns),
        Column("detection", none if found is None else found.detection, "", "place in the detections of the frame"),
        Column("crater_id", none if found is None else found.crater_id, "", "crater of the catalogue"),
    )
    return Table("identifications", "Craters that the payload identified", columns)


def _landmarks(inputs: PassInputs) -> Table:
    found = inputs.landmarks
    whole, real = np.zeros(0, dtype=np.int64), np.zeros(0)
    columns = [
        Column("landmark_id", whole if found is None else found.landmark_id, "", "number of the landmark"),
        Column("latitude_deg", real if found is None else found.latitude_deg, "deg", "mean-Earth latitude"),
        Column("longitude_deg", real if found is None else found.longitude_deg, "deg", "mean-Earth east longitude"),
        Column("height_m", real if found is None else found.height_m, "m", "height above 1737.4 km"),
        Column("diameter_m", real if found is None else found.diameter_m, "m", "diameter"),
    ]
    for k, axis in enumerate(("east", "north", "up")):
        sigma = real if found is None else found.sigma_m[:, k]
        columns.append(Column(f"sigma_{axis}_m", sigma, "m", f"1-sigma error, {axis}"))
    columns.append(Column("passes", whole if found is None else found.passes, "", "passes with the landmark"))
    return Table("landmarks", "Craters that the payload mapped itself, each report", tuple(columns))


def _housekeeping(inputs: PassInputs) -> Table:
    parts = inputs.housekeeping
    utc_ns = parts[0].utc_ns if parts else np.zeros(0, dtype=np.int64)
    columns = [Column(one.name, one.values, one.unit, one.name.replace("_", " ")) for one in parts]
    return Table("housekeeping", "Housekeeping of the payload", (_utc(utc_ns), *columns))


def _events(inputs: PassInputs) -> Table:
    columns = (
        _utc(np.array([one.utc_ns for one in inputs.events], dtype=np.int64)),
        Column("severity", _texts([one.severity for one in inputs.events]), "", "info, low, medium or high"),
        Column("name", _texts([one.name for one in inputs.events]), "", "name of the event"),
        Column("detail", _texts([one.detail for one in inputs.events]), "", "frame and values"),
    )
    return Table("events", "Event reports of the payload", columns)


def _reference(inputs: PassInputs) -> Table:
    utc_ns = _reference_epochs(inputs)
    place = np.full((3, len(utc_ns)), np.nan)
    position, velocity = np.zeros((0, 3)), np.zeros((0, 3))
    if inputs.reference is not None and len(utc_ns):
        position, velocity = inputs.reference.at(utc_ns)
        if inputs.orientation is not None:
            track = ground_track(inputs.reference, inputs.orientation, utc_ns)
            place = np.stack([np.degrees(track.latitude_rad), np.degrees(track.longitude_rad), track.altitude_m])
    columns = [
        _utc(utc_ns),
        Column("latitude_deg", place[0], "deg", "mean-Earth latitude"),
        Column("longitude_deg", place[1], "deg", "mean-Earth east longitude"),
        Column("altitude_m", place[2], "m", "altitude above 1737.4 km"),
    ]
    vectors: tuple[tuple[str, FloatArray, str], ...] = (("", position, "m"), ("v", velocity, "m/s"))
    for prefix, values, unit in vectors:
        suffix = unit.replace("/", "_")
        columns += [
            Column(f"{prefix}{axis}_icrf_{suffix}", values[:, k], unit, "Moon-centred, ICRF axes")
            for k, axis in enumerate("xyz")
        ]
    return Table("reference", "Reference ephemeris at the times of the frames", tuple(columns))


def _reference_epochs(inputs: PassInputs) -> IntArray:
    if inputs.reference is None:
        return np.zeros(0, dtype=np.int64)
    times = [inputs.detections.utc_ns, *(one.utc_ns for one in inputs.navigation)]
    utc_ns = np.unique(np.concatenate(times))
    return utc_ns[inputs.reference.covers(utc_ns)]


def _attitude(inputs: PassInputs) -> Table:
    q_wxyz = continuous_quaternions(inputs.viewing.q_wxyz)
    columns = [_utc(inputs.viewing.attitude_utc_ns)]
    columns += [
        Column(f"q_{part}", q_wxyz[:, k], "", "quaternion from ICRF to camera axes, v_c = q v_i q*")
        for k, part in enumerate("wxyz")
    ]
    return Table("attitude", "Attitude of the camera in the frames", tuple(columns))


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
        return utc_texts(column.values)
    values = column.values.tolist()
    return ["" if value != value else value for value in values]  # NaN is not equal to itself


def _csv_metadata(table: Table) -> dict[str, Any]:
    columns = []
    for column in table.columns:
        entry = {"name": column.name, "titles": column.name, "dc:description": column.description}
        columns.append(entry | {"datatype": _datatype(column)} | ({"linna:unit": column.unit} if column.unit else {}))
    return {"url": f"{table.name}.csv", "dc:description": table.description, "tableSchema": {"columns": columns}}


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
