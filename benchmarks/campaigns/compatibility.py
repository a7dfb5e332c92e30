"""Campaign that runs other programs over our files, and our readers over theirs.

    python -m benchmarks.campaigns.compatibility [--row NAME ...] [--again] [--write]

Each row has an environment of its own under `build/compatibility`, with the versions of `neighbours/requirements`. A
program that cannot be installed, or fails, does not stop the others. A row is not run again until its script, versions
or our files change. `--write` writes `docs/compatibility.md`. Exit status 1 if a value differs or is refused
without a reason that the script of the row states.
"""

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
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
NEIGHBOURS = Path(__file__).parent / "neighbours"
BUILD = ROOT / "build" / "compatibility"
PAGE = ROOT / "docs" / "compatibility.md"
LIMIT_S = 1200
ENOUGH_DIGITS = 6
"""Values that agree in fewer digits differ."""


class Row(NamedTuple):
    name: str
    script: str
    function: str
    environment: str
    packages: str


ROWS = tuple(
    Row(*line.split("|"))
    for line in """\
Yamcs|yamcs_server.py|yamcs|yamcs|fprime-yamcs-bundle
Orekit|orbits.py|orekit|orekit|orekit_jpype
ANISE|orbits.py|anise|orbits|anise
brahe|orbits.py|brahe|orbits|brahe
skyfield|orbits.py|skyfield|orbits|skyfield
jplephem|orbits.py|jplephem|orbits|jplephem
SpiceyPy (CSPICE N0067)|orbits.py|spiceypy|orbits|spiceypy
ccsds-ndm|orbits.py|ccsds_ndm|ndm|ccsds-ndm
ccsds-ndm-py|orbits.py|ccsds_ndm_py|ndm-py|ccsds-ndm-py
oem|orbits.py|oem|gmat|oem
GMAT and STK files|orbits.py|gmat|gmat|gmat-run
Cesium (CZML)|cesium.cjs|cesium|node|cesium
GDAL, QGIS through GDAL|tables.py|gdal|maps|pyogrio rasterio
evo|tables.py|evo|tables|evo
compliance-checker|tables.py|compliance_checker|conventions|compliance-checker
xarray|tables.py|xarray|tables|xarray netCDF4
pandas|tables.py|pandas|tables|pandas
Parquet: PyArrow|tables.py|pyarrow|tables|pyarrow
Parquet: fastparquet|tables.py|fastparquet|tables|fastparquet
Parquet: DuckDB|tables.py|duckdb|tables|duckdb
Parquet: polars|tables.py|polars|tables|polars
Parquet: hyparquet|hyparquet.mjs|hyparquet|node|hyparquet
craterpy|tables.py|craterpy|craters|craterpy
COCO: pycocotools|tables.py|pycocotools|tables|pycocotools
COCO: faster-coco-eval|tables.py|faster_coco_eval|tables|faster-coco-eval
yamcs-pymdb|packets.py|yamcs_pymdb|packets|yamcs-pymdb
fprime-xtce|packets.py|fprime_xtce|fprime|fprime-xtce
OpenC3|packets.py|openc3|openc3|openc3
space_packet_parser|packets.py|space_packet_parser|packets|space_packet_parser
ccsdspy|packets.py|ccsdspy|packets|ccsdspy
spacepackets|packets.py|spacepackets|packets|spacepackets
satnogs-decoders|packets.py|satnogs_decoders|packets|satnogs-decoders
cfdp-py|packets.py|cfdp_py|packets|cfdp-py
Open MCT|openmct.py|openmct|node|openmct""".splitlines()
)
WITH_OURS = ("yamcs_server.py", "openmct.py")
"""Scripts that also run programs of this project; they run with its interpreter."""
WITHOUT = {"reads": "no common format that we write", "writes": "no common format that we read"}
SAMPLES = """\
export 1 --format oem --out pass.oem
export 1 --format oem-xml --out pass.xml
export 1 --format aem --out pass.aem
export 1 --format aem --version 1.0 --out pass-1.0.aem
export 1 --format geojson --out pass.geojson
export 1 --format gpkg --out pass.gpkg
export 1 --format czml --out pass.czml
export 1 --format netcdf --out pass.nc
export 1 --format spice --out spice
export 1 --format parquet --out parquet
export 1 --format csv --out csv
export 1 --format tum --out tum
orbit convert pass.oem --out pass.e
orbit convert pass.oem --out pass.bsp --spice-id -85 --type 3
orbit convert pass.oem --out pass-13.bsp --spice-id -85 --type 13
tm xtce --out linna.xml
tm xtce --unrolled --out unrolled.xml
tm decode downlink.cadu --xtce linna.xml --out linna.json
tm decode downlink.cadu --xtce unrolled.xml --out unrolled.json
dataset build detector-validation --out dataset --frames 3"""


def make_samples(folder, demo):
    """Write every format of one pass, and the values that are right."""
    from tmtc.downlink import decode

    folder.mkdir(parents=True, exist_ok=True)
    shutil.copytree(demo / "ground", folder / "ground", dirs_exist_ok=True)
    for name in ("downlink.cadu", "catalogue.csv"):
        shutil.copy(demo / "pass" / name, folder)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "LINNA_HOME": str(folder / "ground")}
    for line in SAMPLES.splitlines():
        subprocess.run([sys.executable, "-m", "linna", *line.split()], check=True, cwd=folder, env=environment)
    decoded = decode((folder / "downlink.cadu").read_bytes())
    (folder / "packets.bin").write_bytes(b"".join(decoded.cut.packets(decoded.buffer)))
    (folder / "expected.json").write_text(json.dumps(_expected(folder)))


def _expected(folder):
    from lunar.messages.ephemeris_files import load_ephemeris
    from lunar.messages.spice import et_from_utc_ns
    from lunar.utc import LEAP_DATES, format_utc

    whole, arc = (load_ephemeris(folder / name).segments[0] for name in ("pass.oem", "pass.e"))
    attitude = read_attitude(folder / "pass.aem", {})
    rows = {path.stem: list(csv.reader(path.open())) for path in (folder / "csv").glob("*.csv")}
    leaps = [np.datetime64(date).astype(object) for date in LEAP_DATES]
    leap = " {:%Y} {} {:2d} =JD {:.1f}  TAI-UTC= {:5.1f}       S + (MJD - 41317.) X 0.0      S\n"
    return {
        "states": _state_rows(whole),
        "states_utc": [format_utc(ns, 9).rstrip("Z") for ns in whole.utc_ns.tolist()],
        "arc": _state_rows(arc),
        "arc_utc": [format_utc(ns, 9).rstrip("Z") for ns in arc.utc_ns.tolist()],
        "arc_et": et_from_utc_ns(arc.utc_ns).tolist(),
        "attitude": attitude,
        "attitude_wxyz": [[t, w, -x, -y, -z] for t, x, y, z, w in attitude],
        "attitude_utc": [row[0].rstrip("Z") for row in rows["attitude"][1:]],
        "camera_frame": -(100000 + 76) * 1000 - 1,
        "tai_utc_dat": "".join(
            leap.format(day, f"{day:%b}".upper(), day.day, day.toordinal() + 1721424.5, 10 + k)
            for k, day in enumerate(leaps)
        ),
        "tables": {name: [one[0], *([_number(text) for text in row] for row in one[1:])] for name, one in rows.items()},
        "tum": np.loadtxt(folder / "tum" / "anchored.tum").tolist(),
        "packets": json.loads((folder / "linna.json").read_text()),
        "unrolled": json.loads((folder / "unrolled.json").read_text()),
    }


def _number(text):
    try:
        return float(text) if text else None
    except ValueError:
        return text


def _state_rows(segment):
    seconds = (segment.tai_ns - segment.tai_ns[0]) / 1e9
    return np.column_stack([seconds, segment.position_m / 1e3, segment.velocity_m_s / 1e3]).tolist()


def read_orbit(path, entry):
    """States of an ephemeris, as `expected.json` has them."""
    from lunar.messages.ephemeris_files import is_spk, load_ephemeris
    from lunar.messages.spice import load_spk

    found = load_spk(path, step_s=entry["step"]) if is_spk(path) else load_ephemeris(path)
    return [row for segment in found.segments for row in _state_rows(segment)]


def read_attitude(path, _):
    """Attitudes of an AEM: seconds, vector and scalar of the quaternion of the standard."""
    from lunar.messages.aem import parse_aem

    one = parse_aem(path.read_text(), str(path))[0]
    seconds = (one.utc_ns - one.utc_ns[0]) / 1e9
    return np.column_stack([seconds, -one.q_wxyz[:, 1:], one.q_wxyz[:, 0]]).tolist()


def read_packets(path, entry):
    """Of packets, the parameters that the other program states."""
    from tmtc.packets.stream import PacketForm, cut_packets, primary_headers
    from tmtc.xtce.decode import Decoder
    from tmtc.xtce.importing import parse_xtce
    from tmtc.xtce.series import xtce_records

    octets = path.read_bytes()
    cut = cut_packets(octets, form=PacketForm(error_control=False))
    decoder = Decoder(parse_xtce({name: (path.parent / name).read_bytes() for name in entry["xtce"]}))
    found = xtce_records(decoder.decode(octets, cut, primary_headers(octets, cut)))
    return [{key: one.get(key) for key in right} for one, right in zip(found, entry["values"], strict=True)]


def read_telecommands(path, _):
    from tmtc.dictionary.payload import DICTIONARY

    return [DICTIONARY.unpack_command(bytes.fromhex(one)).name for one in json.loads(path.read_text())]


def read_raster(path, entry):
    from payload_emulator.sim.terrain.rasters import open_layers

    return open_layers([path])[0].read(*entry["window"]).tolist()


def read_labels(path, _):
    from payload_emulator.training.data.pictures import load_pictures

    return sorted(list(map(float, box)) for one in load_pictures(path.parent) for box in one.box_px)


def compare(expected, found, *, rotations=False):
    """Text of a cell, and whether the values are equal: numbers to digits of the greatest value of their column."""
    if _is_table(expected) and _is_table(found):
        right, other = np.array(expected, dtype=np.float64), np.array(found, dtype=np.float64)
        if right.shape != other.shape:
            shapes = [" × ".join(map(str, one.shape)) for one in (other, right)]
            return "differs: {} values of {}".format(*shapes), False
        if rotations:
            other[(right[:, 1:] * other[:, 1:]).sum(axis=1) < 0, 1:] *= -1
        if (np.isnan(right) != np.isnan(other)).any():
            return "differs: other values are unknown", False
        with np.errstate(all="ignore"):
            error = np.nanmax(np.abs(right - other) / np.maximum(np.nanmax(np.abs(right), axis=0), 1e-300))
        digits = math.inf if error == 0 else math.floor(-math.log10(error))
        if digits < ENOUGH_DIGITS:
            return f"differs by {error:.2g} of the greatest value", False
        return f"equal{f' to {digits} digits' * bool(error)} ({right.size} values)", True
    pairs = list(_leaves(expected, found, ""))
    wrong = [one for one in pairs if not _same(*one[1:])]
    if not wrong:
        return f"equal ({len(pairs)} values)", True
    path, right, other = wrong[0]
    first = f"{path.lstrip('.')} is {str(other)[:40]}, expected {str(right)[:40]}"
    return f"differs in {len(wrong)} of {len(pairs)} values: {first}", False


def _is_table(value):
    rows = value if isinstance(value, list) else []
    if not rows or not all(isinstance(row, list) and len(row) == len(rows[0]) for row in rows):
        return False
    return all(one is None or isinstance(one, (int, float)) for row in rows for one in row)


def _leaves(expected, found, path):
    if isinstance(expected, dict) and isinstance(found, dict):
        for key in sorted(expected.keys() | found.keys()):
            yield from _leaves(expected.get(key, "(none)"), found.get(key, "(none)"), f"{path}.{key}")
    elif isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        for k, (one, other) in enumerate(zip(expected, found, strict=True)):
            yield from _leaves(one, other, f"{path}[{k}]")
    else:
        yield path, expected, found


def _same(right, other):
    right, other = (None if isinstance(one, float) and math.isnan(one) else one for one in (right, other))
    if isinstance(right, float) and isinstance(other, (int, float)):
        return np.float32(right) == np.float32(other)
    return right == other


def _pins(environment):
    return NEIGHBOURS / "requirements" / f"{environment}.{'json' if environment == 'node' else 'txt'}"


def prepare(name):
    """Return the interpreter of an environment, made if it is not there or its versions changed."""
    folder, pins = BUILD / "environments" / name, _pins(name)
    interpreter = Path(shutil.which("node") or "node") if name == "node" else folder / "bin" / "python"
    if (folder / "pins").is_file() and (folder / "pins").read_bytes() == pins.read_bytes():
        return interpreter
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    install = '"$0" -m venv . && bin/python -m pip install --quiet --disable-pip-version-check -r "$1"'
    if name == "node":
        shutil.copy(pins, folder / "package.json")
        install = "npm install --no-audit --no-fund --ignore-scripts --silent"
    command = ["sh", "-c", install, sys.executable, str(pins)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=LIMIT_S)
    shutil.copy(pins, folder / "pins")
    return interpreter


def versions(row):
    """Versions of the packages of a row, from the pins of its environment."""
    text, packages = _pins(row.environment).read_text(), row.packages.split()
    is_node = row.environment == "node"
    stated = json.loads(text)["dependencies"] if is_node else dict(line.split("==") for line in text.split())
    found = [f"{package} {stated[package]}" for package in packages]
    return ", ".join(found) if len(found) > 1 else stated[packages[0]]


def run_row(row, samples, out):
    """Run a program and return its entries; one that does not run has one that says why."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    try:
        interpreter = prepare(row.environment)
    except (subprocess.SubprocessError, OSError) as error:
        text = str(getattr(error, "stderr", "") or error).strip()
        return _not_tried(f"not installed: {text.splitlines()[-1][:160]}")
    environment = {**os.environ, "PYTHONPATH": "", "PYTHONWARNINGS": "ignore", "NEIGHBOUR": str(interpreter)}
    environment["NODE_PATH"] = str(BUILD / "environments" / "node" / "node_modules")
    if row.script in WITH_OURS:
        interpreter, environment["PYTHONPATH"] = sys.executable, str(ROOT)
    command = [str(interpreter), str(NEIGHBOURS / row.script), row.function, str(samples), str(out)]
    options = {"start_new_session": True, "env": environment, "cwd": out}
    with (out / "log.txt").open("w") as log, subprocess.Popen(command, stdout=log, stderr=log, **options) as process:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(LIMIT_S)
        with contextlib.suppress(ProcessLookupError):  # what it started, too
            os.killpg(process.pid, signal.SIGTERM)
    if (out / "cells.json").is_file():
        return json.loads((out / "cells.json").read_text())
    return _not_tried([*(out / "log.txt").read_text().strip().splitlines(), "no message"][-2:][0][:160])


def _not_tried(reason):
    return [{"way": way, "what": "", "not_tried": reason} for way in WITHOUT]


def _judge(entry, expected):
    """The cell of an entry: what was read compared with what is right."""
    if "refused" in entry:
        text, good = f"refused: {entry['refused']}", False
    elif "not_tried" in entry:
        text, good = f"not tried: {entry['not_tried']}", True
    elif "reader" in entry:
        path = Path(entry["file"])
        try:
            found = globals()[f"read_{entry['reader']}"](path, entry)
            text, good = compare(entry["values"], found, rotations=entry["reader"] == "attitude")
        except Exception as error:  # the reason is the cell
            text, good = f"refused by us: {str(error).replace(f'{path.parent}/', '')[:200]}", False
    else:
        name = entry["expects"]
        right = expected[name] if isinstance(name, str) else name
        text, good = compare(right, entry["values"], rotations=str(name).startswith("attitude"))
    why = entry.get("why", "")
    known = bool(why) and text.startswith("refused")  # a reason excuses a refusal, never other values
    text = f"{text} ({why})" if why and not good else text
    return {**entry, "text": text.replace("|", "\\|"), "good": good or known}


def result(row, samples, *, again):
    """Cells of a row; the program is not run again if nothing changed since it was."""
    scripts = NEIGHBOURS / row.script, NEIGHBOURS / "_cells.py", _pins(row.environment)
    parts = [part.read_bytes() for part in (*scripts, samples / "expected.json")]
    digest = hashlib.sha256(b"".join(parts)).hexdigest()
    kept = BUILD / "results" / f"{row.function}.json"
    stored = json.loads(kept.read_text()) if kept.is_file() and not again else {}
    if stored.get("digest") != digest or any(one.get("not_tried") and not one["what"] for one in stored["entries"]):
        print(f"{row.name} ...", file=sys.stderr, flush=True)
        stored = {"digest": digest, "entries": run_row(row, samples, BUILD / "files" / row.function)}
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(stored))
    return [_judge(entry, json.loads(parts[-1])) for entry in stored["entries"]]


HEAD = """\
# Compatibility

Each cell is the result of a run: the program read a file of ours, or we read a file of the program, and the
values were compared. `python -m benchmarks.campaigns.compatibility --write` runs the programs, each in an
environment of its own, and writes this page. `make campaigns` does the same.

*Equal to n digits*: the largest difference is 10⁻ⁿ of the largest value of its column.

| program | version | reads what we write | writes what we read |
|---|---|---|---|"""


def format_page(results):
    """The page with the table."""
    lines = [HEAD]
    for row in ROWS:
        if row.name in results:
            texts = [_cell(results[row.name], way) for way in WITHOUT]
            lines.append(f"| {row.name} | {versions(row)} | {texts[0]} | {texts[1]} |")
    return "\n".join([*lines, ""])


def _cell(cells, way):
    found = [": ".join(filter(None, (one["what"], one["text"]))) for one in cells if one["way"] == way]
    return "<br>".join(found) or WITHOUT[way]


def main(arguments=None):
    """Run the campaign and print a line for each cell."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--row", action="append", help="only this row (repeatable)")
    parser.add_argument("--again", action="store_true", help="run rows that have results again")
    parser.add_argument("--write", action="store_true", help="write docs/compatibility.md")
    options = parser.parse_args(arguments)
    samples = BUILD / "samples"
    if not (samples / "expected.json").is_file():
        demo = BUILD / "demo"
        if not (demo / "ground").is_dir():
            subprocess.run([sys.executable, "-m", "linna", "demo", "--out", str(demo)], check=True, cwd=ROOT)
        make_samples(samples, demo)
    wanted = [row for row in ROWS if not options.row or row.name in options.row]
    results = {row.name: result(row, samples, again=options.again) for row in wanted}
    for name, cells in results.items():
        for one in cells:
            mark = "" if one["good"] else "   <-- no reason stated"
            print(f"{name} | {one['way']} | {one['what']} | {one['text']}{mark}")
    if options.write:
        PAGE.write_text(format_page(results))
    return int(not all(one["good"] for cells in results.values() for one in cells))


if __name__ == "__main__":
    raise SystemExit(main())
