"""Campaign that runs other programs over our files, and our readers over theirs.

    python -m benchmarks.campaigns.compatibility [--row NAME ...] [--again] [--write]

Each row runs in an environment of its own, with the versions of `neighbours/requirements`, under `build/compatibility`.
A program that cannot be installed, or fails, does not stop the others. Rows that have results are not run again unless
their script, versions or files of ours changed; `--again` runs them all. `--write` writes `docs/compatibility.md`.

Exit status 1 if a value differs or a file is refused without a reason that the script of the row states.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
NEIGHBOURS = Path(__file__).parent / "neighbours"
BUILD = ROOT / "build" / "compatibility"
PAGE = ROOT / "docs" / "compatibility.md"
LIMIT_S = 1200
ENOUGH_DIGITS = 6
"""Values that agree in fewer digits differ."""


@dataclass(frozen=True, slots=True)
class Row:
    """Program of a row: the script and function that run it in an environment, and packages whose versions count."""

    name: str
    script: str
    function: str
    environment: str
    packages: tuple[str, ...]


ROWS = (
    Row("Yamcs", "yamcs_server.py", "yamcs", "yamcs", ("fprime-yamcs-bundle",)),
    Row("Orekit", "orbits.py", "orekit", "orekit", ("orekit_jpype",)),
    Row("ANISE", "orbits.py", "anise", "orbits", ("anise",)),
    Row("brahe", "orbits.py", "brahe", "orbits", ("brahe",)),
    Row("skyfield", "orbits.py", "skyfield", "orbits", ("skyfield",)),
    Row("jplephem", "orbits.py", "jplephem", "orbits", ("jplephem",)),
    Row("SpiceyPy (CSPICE N0067)", "orbits.py", "spiceypy", "orbits", ("spiceypy",)),
    Row("ccsds-ndm", "orbits.py", "ccsds_ndm", "ndm", ("ccsds-ndm",)),
    Row("ccsds-ndm-py", "orbits.py", "ccsds_ndm_py", "ndm-py", ("ccsds-ndm-py",)),
    Row("oem", "orbits.py", "oem", "gmat", ("oem",)),
    Row("GMAT and STK files", "orbits.py", "gmat", "gmat", ("gmat-run",)),
    Row("Cesium (CZML)", "cesium.cjs", "cesium", "node", ("cesium",)),
    Row("GDAL, QGIS through GDAL", "tables.py", "gdal", "maps", ("pyogrio", "rasterio")),
    Row("evo", "tables.py", "evo", "tables", ("evo",)),
    Row("compliance-checker", "tables.py", "compliance_checker", "conventions", ("compliance-checker",)),
    Row("xarray", "tables.py", "xarray", "tables", ("xarray", "netCDF4")),
    Row("pandas", "tables.py", "pandas", "tables", ("pandas",)),
    Row("Parquet: PyArrow", "tables.py", "pyarrow", "tables", ("pyarrow",)),
    Row("Parquet: fastparquet", "tables.py", "fastparquet", "tables", ("fastparquet",)),
    Row("Parquet: DuckDB", "tables.py", "duckdb", "tables", ("duckdb",)),
    Row("Parquet: polars", "tables.py", "polars", "tables", ("polars",)),
    Row("Parquet: hyparquet", "hyparquet.mjs", "hyparquet", "node", ("hyparquet",)),
    Row("craterpy", "tables.py", "craterpy", "craters", ("craterpy",)),
    Row("COCO: pycocotools", "tables.py", "pycocotools", "tables", ("pycocotools",)),
    Row("COCO: faster-coco-eval", "tables.py", "faster_coco_eval", "tables", ("faster-coco-eval",)),
    Row("yamcs-pymdb", "packets.py", "yamcs_pymdb", "packets", ("yamcs-pymdb",)),
    Row("fprime-xtce", "packets.py", "fprime_xtce", "fprime", ("fprime-xtce",)),
    Row("OpenC3", "packets.py", "openc3", "openc3", ("openc3",)),
    Row("space_packet_parser", "packets.py", "space_packet_parser", "packets", ("space_packet_parser",)),
    Row("ccsdspy", "packets.py", "ccsdspy", "packets", ("ccsdspy",)),
    Row("spacepackets", "packets.py", "spacepackets", "packets", ("spacepackets",)),
    Row("satnogs-decoders", "packets.py", "satnogs_decoders", "packets", ("satnogs-decoders",)),
    Row("cfdp-py", "packets.py", "cfdp_py", "packets", ("cfdp-py",)),
    Row("Open MCT", "openmct.py", "openmct", "node", ("openmct",)),
)

WITH_OURS = ("yamcs_server.py", "openmct.py")
"""Scripts that also run programs of this project; they run with its interpreter."""

WITHOUT = {"reads": "no common format that we write", "writes": "no common format that we read"}
"""Content of a cell without an entry."""


# our files


def linna(*arguments: str | Path, **environment: str) -> None:
    """Run a command of this project."""
    command = [sys.executable, "-m", "linna", *map(str, arguments)]
    subprocess.run(
        command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT, env={**os.environ, **environment}
    )


def make_samples(folder: Path, demo: Path) -> None:
    """Write every format of one pass, and the values that are right."""
    home = {"LINNA_HOME": str(demo / "ground")}
    folder.mkdir(parents=True, exist_ok=True)
    kinds = ("oem", "aem", "geojson", "gpkg", "czml", "nc", "xml")
    names = {"nc": "netcdf", "xml": "oem-xml"}
    for kind in kinds:
        linna("export", "1", "--format", names.get(kind, kind), "--out", folder / f"pass.{kind}", **home)
    linna("export", "1", "--format", "aem", "--version", "1.0", "--out", folder / "pass-1.0.aem", **home)
    for kind in ("spice", "parquet", "csv", "tum"):
        linna("export", "1", "--format", kind, "--out", folder / kind, **home)
    for name, *more in (("pass.e",), ("pass.bsp", "--type", "3"), ("pass-13.bsp", "--type", "13")):
        number = ["--spice-id", "-85"] if more else []
        linna("orbit", "convert", folder / "pass.oem", "--out", folder / name, *number, *more)
    linna("tm", "xtce", "--out", folder / "linna.xml")
    linna("tm", "xtce", "--unrolled", "--out", folder / "unrolled.xml")
    linna("tm", "yamcs", "--out", folder / "yamcs")
    for name in ("linna", "unrolled"):
        linna(
            "tm", "decode", demo / "pass" / "downlink.cadu", "--xtce", folder / f"{name}.xml",
            "--out", folder / f"{name}.json",
        )  # fmt: skip
    linna("dataset", "build", "detector-validation", "--out", folder / "dataset", "--frames", "3")
    shutil.copytree(demo / "ground", folder / "ground")
    shutil.copy(demo / "pass" / "downlink.cadu", folder)
    shutil.copy(demo / "pass" / "catalogue.csv", folder)
    (folder / "packets.bin").write_bytes(_packets(folder / "downlink.cadu"))
    (folder / "expected.json").write_text(json.dumps(_expected(folder)))


def _packets(path: Path) -> bytes:
    from tmtc.downlink import decode

    decoded = decode(path.read_bytes())
    return b"".join(decoded.cut.packets(decoded.buffer))


def _expected(folder: Path) -> dict[str, Any]:
    from lunar.messages.ephemeris_files import load_ephemeris
    from lunar.messages.spice import et_from_utc_ns
    from lunar.utc import LEAP_DATES, format_utc

    whole = load_ephemeris(folder / "pass.oem").segments[0]
    arc = load_ephemeris(folder / "pass.e").segments[0]
    attitude = read_attitude(folder / "pass.aem", {})
    texts = [format_utc(ns, 9).rstrip("Z") for ns in whole.utc_ns.tolist()]
    arc_texts = [format_utc(ns, 9).rstrip("Z") for ns in arc.utc_ns.tolist()]
    rows = {path.stem: list(csv.reader(path.open())) for path in sorted((folder / "csv").glob("*.csv"))}
    return {
        "states": _state_rows(whole),
        "states_utc": texts,
        "arc": _state_rows(arc),
        "arc_utc": arc_texts,
        "arc_et": et_from_utc_ns(arc.utc_ns).tolist(),
        "arc_offset_s": (int(arc.utc_ns[0]) - int(whole.utc_ns[0])) / 1e9,
        "attitude": attitude,
        "attitude_wxyz": [[t, w, -x, -y, -z] for t, x, y, z, w in attitude],
        "attitude_utc": [row[0].rstrip("Z") for row in rows["attitude"][1:]],
        "camera_frame": -(100000 + 76) * 1000 - 1,
        "tai_utc_dat": "".join(_leap_line(date, 10 + k) for k, date in enumerate(LEAP_DATES)),
        "tables": {name: [one[0], *map(_numbers, one[1:])] for name, one in rows.items()},
        "tum": _tum(folder / "tum" / "anchored.tum"),
        "packets": json.loads((folder / "linna.json").read_text()),
        "unrolled": json.loads((folder / "unrolled.json").read_text()),
    }


def _leap_line(date: str, offset: int) -> str:
    """Return a line of the file `tai-utc.dat` of the USNO."""
    day = np.datetime64(date)
    jd = float((day - np.datetime64("1972-01-01")).astype(int)) + 2441317.5
    name = day.astype(object).strftime("%b").upper()
    text = (
        f" {day.astype(object).year} {name} {day.astype(object).day:2d} =JD {jd:.1f}  TAI-UTC= {offset:5.1f}"
    )
    return f"{text}       S + (MJD - 41317.) X 0.0      S\n"


def _numbers(row: list[str]) -> list[float | str | None]:
    return [_number(text) for text in row]


def _number(text: str) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text


def _tum(path: Path) -> list[list[float]]:
    return [
        [float(value) for value in line.split()]
        for line in path.read_text().splitlines()
        if not line.startswith("#")
    ]


def _state_rows(segment: Any) -> list[list[float]]:
    seconds = (segment.tai_ns - segment.tai_ns[0]) / 1e9
    values = np.column_stack([seconds, segment.position_m / 1e3, segment.velocity_m_s / 1e3])
    rows: list[list[float]] = values.tolist()
    return rows


# their files, as we read them


def read_orbit(path: Path, entry: dict[str, Any]) -> list[list[float]]:
    """States of an ephemeris, as `expected.json` has them."""
    from lunar.messages.ephemeris_files import is_spk, load_ephemeris
    from lunar.messages.spice import load_spk

    if is_spk(path):
        segments = load_spk(path, step_s=entry["step"]).segments
    else:
        segments = load_ephemeris(path).segments
    return [row for segment in segments for row in _state_rows(segment)]


def read_attitude(path: Path, entry: dict[str, Any]) -> list[list[float]]:
    """Attitudes of an AEM: seconds, vector and scalar of the quaternion of the standard."""
    from lunar.messages.aem import parse_aem

    segment = parse_aem(path.read_text(), str(path))[0]
    seconds = (segment.utc_ns - segment.utc_ns[0]) / 1e9
    values = np.column_stack([seconds, -segment.q_wxyz[:, 1:], segment.q_wxyz[:, 0]])
    rows: list[list[float]] = values.tolist()
    return rows


def read_packets(path: Path, entry: dict[str, Any]) -> list[dict[str, Any]]:
    """Packets of `path` with a suffix `.bin`, through the XTCE documents of the entry."""
    from tmtc.packets.stream import PacketForm, cut_packets, primary_headers
    from tmtc.xtce.decode import Decoder
    from tmtc.xtce.importing import parse_xtce
    from tmtc.xtce.records import xtce_records

    documents = {name: (path.parent / name).read_bytes() for name in entry["xtce"]}
    octets = path.read_bytes()
    cut = cut_packets(octets, form=PacketForm(error_control=False))
    found = Decoder(parse_xtce(documents)).decode(octets, cut, primary_headers(octets, cut))
    records = xtce_records(found)
    if entry.get("subset"):  # of each packet, the parameters that the other program states
        return [
            {key: one.get(key) for key in stated}
            for one, stated in zip(records, entry["values"], strict=True)
        ]
    kept = entry.get("parameters")
    return [{key: one[key] for key in kept} if kept else one for one in records]


def read_telecommands(path: Path, entry: dict[str, Any]) -> list[Any]:
    """Telecommand packets, as hexadecimal digits in a JSON list, by our dictionary."""
    from tmtc.dictionary.payload import DICTIONARY

    return [DICTIONARY.unpack_command(bytes.fromhex(one)).name for one in json.loads(path.read_text())]


def read_raster(path: Path, entry: dict[str, Any]) -> list[list[float]]:
    """Heights of an elevation raster, from the pixel of its corner on."""
    from payload_emulator.sim.terrain.rasters import open_layers

    heights: list[list[float]] = open_layers([path])[0].read(*entry["window"]).tolist()
    return heights


def read_labels(path: Path, entry: dict[str, Any]) -> list[list[float]]:
    """Boxes of craters in the folder of a COCO file."""
    from payload_emulator.training.data.pictures import load_pictures

    return sorted(list(map(float, box)) for one in load_pictures(path.parent) for box in one.box_px)


READERS: dict[str, Callable[[Path, dict[str, Any]], Any]] = {
    "orbit": read_orbit,
    "attitude": read_attitude,
    "packets": read_packets,
    "telecommands": read_telecommands,
    "raster": read_raster,
    "labels": read_labels,
}


# comparison


@dataclass(frozen=True, slots=True)
class Outcome:
    """Content of a cell, and whether it needs no reason."""

    text: str
    good: bool


def compare(expected: Any, found: Any, *, rotations: bool = False) -> Outcome:
    """Compare values: numbers to digits of the greatest value of their column, all else exactly."""
    if _is_table(expected) and _is_table(found):
        right, other = np.array(expected, dtype=np.float64), np.array(found, dtype=np.float64)
        if right.shape != other.shape:
            shapes = " × ".join(map(str, right.shape)), " × ".join(map(str, other.shape))
            return Outcome(f"differs: {shapes[1]} values of {shapes[0]}", good=False)
        if rotations:
            same = (right[:, 1:] * other[:, 1:]).sum(axis=1) < 0
            other[same, 1:] *= -1
        with np.errstate(all="ignore"):
            scale = np.maximum(np.nanmax(np.abs(right), axis=0), 1e-300)
            error = np.nanmax(np.abs(right - other) / scale) if right.size else 0.0
        if (np.isnan(right) != np.isnan(other)).any():
            return Outcome("differs: other values are unknown", good=False)
        if error == 0:
            return Outcome(f"equal ({right.size} values)", good=True)
        digits = math.floor(-math.log10(error))
        if digits >= ENOUGH_DIGITS:
            return Outcome(f"equal to {digits} digits ({right.size} values)", good=True)
        return Outcome(f"differs by {error:.2g} of the greatest value", good=False)
    pairs = list(_leaves(expected, found, ""))
    wrong = [one for one in pairs if not _same(one[1], one[2])]
    if not wrong:
        return Outcome(f"equal ({len(pairs)} values)", good=True)
    path, right, other = wrong[0]
    first = f"{path.lstrip('.')} is {str(other)[:40]}, expected {str(right)[:40]}"
    return Outcome(f"differs in {len(wrong)} of {len(pairs)} values: {first}", good=False)


def _is_table(value: Any) -> bool:
    return (
        isinstance(value, list)
        and bool(value)
        and all(isinstance(row, list) and len(row) == len(value[0]) for row in value)
        and all(isinstance(one, (int, float)) or one is None for row in value for one in row)
    )


def _leaves(expected: Any, found: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(expected, dict) and isinstance(found, dict):
        for key in sorted(expected.keys() | found.keys()):
            yield from _leaves(expected.get(key, "(none)"), found.get(key, "(none)"), f"{path}.{key}")
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for k, (one, other) in enumerate(zip(expected, found, strict=True)):
            yield from _leaves(one, other, f"{path}[{k}]")
    else:
        yield path, expected, found


def _same(right: Any, other: Any) -> bool:
    right, other = (None if isinstance(one, float) and math.isnan(one) else one for one in (right, other))
    if isinstance(right, float) and isinstance(other, (int, float)):
        return bool(np.float32(right) == np.float32(other))
    return bool(right == other)


# environments


def prepare(name: str) -> Path:
    """Return the interpreter of an environment, made if it is not there or its versions changed.

    Raises
    ------
    subprocess.CalledProcessError
        If a package cannot be installed.
    """
    folder, is_node = BUILD / "environments" / name, name == "node"
    pins = _pins(name)
    marker = folder / "pins"
    interpreter = Path(shutil.which("node") or "node") if is_node else folder / "bin" / "python"
    if marker.is_file() and marker.read_bytes() == pins.read_bytes():
        return interpreter
    shutil.rmtree(folder, ignore_errors=True)
    if is_node:
        folder.mkdir(parents=True)
        shutil.copy(pins, folder / "package.json")
        _run(["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", "--silent"], folder)
    else:
        _run([sys.executable, "-m", "venv", str(folder)], ROOT)
        pip = [str(interpreter), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        _run([*pip, "-r", str(pins)], ROOT)
    shutil.copy(pins, marker)
    return interpreter


def _run(command: list[str], folder: Path) -> None:
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=LIMIT_S * 3)


def versions(row: Row) -> str:
    """Versions of the packages of a row, from the pins of its environment."""
    text = _pins(row.environment).read_text()
    if row.environment == "node":
        stated = json.loads(text)["dependencies"]
    else:
        stated = dict(line.split("==") for line in text.split())
    found = [stated[package] for package in row.packages]
    if len(found) == 1:
        return str(found[0])
    return ", ".join(f"{package} {version}" for package, version in zip(row.packages, found, strict=True))


# rows


def run_row(row: Row, samples: Path, out: Path) -> list[dict[str, Any]]:
    """Run a program and return its entries; one that does not run has one that says why."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    try:
        interpreter = prepare(row.environment)
    except (subprocess.SubprocessError, OSError) as error:
        return _not_tried(f"not installed: {_last_line(error)}")
    environment = {**os.environ, "PYTHONPATH": "", "PYTHONWARNINGS": "ignore", "NEIGHBOUR": str(interpreter)}
    environment["NODE_PATH"] = str(BUILD / "environments" / "node" / "node_modules")
    if row.script in WITH_OURS:
        interpreter, environment["PYTHONPATH"] = Path(sys.executable), str(ROOT)
    command = [str(interpreter), str(NEIGHBOURS / row.script), row.function, str(samples), str(out)]
    with (out / "log.txt").open("w") as log:
        try:
            _run_group(command, log, environment, out)
        except (subprocess.SubprocessError, OSError) as error:
            if not (out / "cells.json").is_file():
                lines = (out / "log.txt").read_text().strip().splitlines()
                return _not_tried(lines[-1][:160] if lines else str(error))
    entries: list[dict[str, Any]] = json.loads((out / "cells.json").read_text())
    return entries


def _run_group(command: list[str], log: IO[str], environment: dict[str, str], folder: Path) -> None:
    """Run a command, and end it and all that it started when it takes too long."""
    options: dict[str, Any] = {"stdout": log, "stderr": log, "env": environment, "cwd": folder}
    with subprocess.Popen(command, start_new_session=True, **options) as process:
        try:
            if process.wait(LIMIT_S):
                raise subprocess.CalledProcessError(process.returncode, command)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)


def _not_tried(reason: str) -> list[dict[str, Any]]:
    return [{"way": way, "what": "", "not_tried": reason} for way in WITHOUT]


def _last_line(error: Exception) -> str:
    text = str(getattr(error, "stderr", "") or error).strip()
    return text.splitlines()[-1][:160]


def _judge(entry: dict[str, Any], expected: dict[str, Any]) -> dict[str, str]:
    """The cell of an entry: what was read compared with what is right."""
    if "refused" in entry:
        outcome = Outcome(f"refused: {entry['refused']}", good=False)
    elif "not_tried" in entry:
        outcome = Outcome(f"not tried: {entry['not_tried']}", good=True)
    elif "reader" in entry:
        try:
            found = READERS[entry["reader"]](Path(entry["file"]), entry)
            outcome = compare(entry["values"], found, rotations=entry["reader"] == "attitude")
        except Exception as error:  # the reason is the cell
            said = str(error).replace(f"{Path(entry['file']).parent}/", "")
            outcome = Outcome(f"refused by us: {said[:200]}", good=False)
    else:
        right = expected[entry["expects"]] if isinstance(entry["expects"], str) else entry["expects"]
        outcome = compare(right, entry["values"], rotations=str(entry["expects"]).startswith("attitude"))
    why = entry.get("why", "")
    text = outcome.text if outcome.good or not why else f"{outcome.text} ({why})"
    good = "yes" if outcome.good or why else ""
    return {"way": entry["way"], "what": entry["what"], "text": text.replace("|", "\\|"), "good": good}


def result(row: Row, samples: Path, *, again: bool) -> list[dict[str, str]]:
    """Cells of a row; the program is not run again if nothing changed since it was."""
    parts = [
        NEIGHBOURS / row.script,
        NEIGHBOURS / "_cells.py",
        _pins(row.environment),
        samples / "expected.json",
    ]
    digest = hashlib.sha256(b"".join(part.read_bytes() for part in parts)).hexdigest()
    out = BUILD / "files" / row.function
    kept = BUILD / "results" / f"{row.function}.json"
    stored = json.loads(kept.read_text()) if kept.is_file() and not again else {}
    entries = stored.get("entries")
    if entries is None or stored["digest"] != digest or any("not_tried" in one for one in entries):
        print(f"{row.name} ...", file=sys.stderr, flush=True)
        entries = run_row(row, samples, out)
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps({"digest": digest, "entries": entries}, indent=1))
    expected = json.loads((samples / "expected.json").read_text())
    return [_judge(entry, expected) for entry in entries]


def _pins(environment: str) -> Path:
    return NEIGHBOURS / "requirements" / f"{environment}.{'json' if environment == 'node' else 'txt'}"


def format_page(results: dict[str, list[dict[str, str]]]) -> str:
    """The page with the table."""
    lines = [
        "# Compatibility",
        "",
        "Each cell is the result of a run: the program read a file of ours, or we read a file of the program, and the",
        "values were compared. `python -m benchmarks.campaigns.compatibility --write` runs the programs, each in an",
        "environment of its own, and writes this page. `make campaigns` does the same.",
        "",
        "*Equal to n digits*: the largest difference is 10⁻ⁿ of the largest value of its column.",
        "",
        "| program | version | reads what we write | writes what we read |",
        "|---|---|---|---|",
    ]
    for row in ROWS:
        cells = results.get(row.name)
        if cells is not None:
            texts = [_cell(cells, way) for way in ("reads", "writes")]
            lines.append(f"| {row.name} | {versions(row)} | {texts[0]} | {texts[1]} |")
    return "\n".join([*lines, ""])


def _cell(cells: list[dict[str, str]], way: str) -> str:
    found = [
        f"{one['what']}: {one['text']}" if one["what"] else one["text"] for one in cells if one["way"] == way
    ]
    return "<br>".join(found) or WITHOUT[way]


def main(arguments: list[str] | None = None) -> int:
    """Run the campaign and print a line for each cell."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--row", action="append", help="only this row (repeatable)")
    parser.add_argument("--again", action="store_true", help="run rows that have results again")
    parser.add_argument("--write", action="store_true", help="write docs/compatibility.md")
    parser.add_argument("--demo", type=Path, default=BUILD / "demo", help="folder of `linna demo` to use")
    options = parser.parse_args(arguments)
    samples = BUILD / "samples"
    if not (samples / "expected.json").is_file():
        if not (options.demo / "ground").is_dir():
            linna("demo", "--out", options.demo)
        make_samples(samples, options.demo)
    wanted = [row for row in ROWS if not options.row or row.name in options.row]
    results = {row.name: result(row, samples, again=options.again) for row in wanted}
    bad = 0
    for name, cells in results.items():
        for one in cells:
            bad += not one["good"]
            mark = "" if one["good"] else "   <-- no reason stated"
            print(f"{name} | {one['way']} | {one['what']} | {one['text']}{mark}")
    if options.write:
        PAGE.write_text(format_page(results))
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
