"""Exports of passes: everything is computed from the archive as it is now; nothing is stored.

Formats of several files are written to a temporary file, one file of the format after another. The memory that an
export needs is therefore that of its largest file.
"""

import importlib.util
import io
import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import chain
from typing import IO

import numpy as np

from ground_service.clock import utc_now_ns
from ground_service.errors import EvaluationError, storage_error
from ground_service.evaluation.alignment import format_tum
from ground_service.evaluation.core import PassInputs, evaluate_pass
from ground_service.evaluation.inputs import load_pass_inputs
from ground_service.exports import messages
from ground_service.exports.maps import MAPS, map_octets
from ground_service.exports.model import FORMATS, ExportFormatInfo, ExportRequest, Format
from ground_service.exports.tables import csv_files, netcdf_octets, parquet_files, pass_tables
from ground_service.ground import Ground
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes import store
from ground_service.passes.parameters import packets_by_name
from ground_service.passes.service import get_pass
from ground_service.passes.span import pass_span
from ground_service.store.files import INCOMING, unfinished_prefix
from lunar.frames import mcmf_from_spherical
from lunar.messages.spice import format_pck, moon_kernel
from lunar.timescales import format_utc
from tmtc.errors import MissingLibrary

ORBITS = ("oem", "oem-xml", "spk")
ATTITUDES = ("aem", "ck")
SPOOLED_OCTETS = 8 << 20
"""A zip archive up to this size stays in memory."""

_EPOCH_OF_ZIP = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Exported:
    """File of an export, open at its beginning; it is gone when it is closed."""

    name: str
    size: int
    stream: IO[bytes]

    def blocks(self, size: int = 1 << 20) -> Iterator[bytes]:
        """Yield the content in blocks, and close the file."""
        with self.stream as stream:
            while block := stream.read(size):
                yield block


def list_formats() -> list[ExportFormatInfo]:
    """Return the formats, and whether their libraries are installed here."""
    return [
        ExportFormatInfo.of(asdict(one), available=not one.library or importlib.util.find_spec(one.library) is not None)
        for one in FORMATS.values()
    ]


def export_pass(ground: Ground, request: ExportRequest) -> Exported:
    """Return a pass in a format.

    Raises
    ------
    NotFound
        There is no such pass.
    EvaluationError
        The pass lacks what the format contains.
    MissingLibrary
        The format needs a library that is not installed.
    """
    chosen = FORMATS[request.format]
    if chosen.library and importlib.util.find_spec(chosen.library) is None:
        raise MissingLibrary(f"export as {chosen.name}", chosen.library, f"linna[{chosen.extra}]")
    name = f"pass-{request.pass_id}.{chosen.ending}"
    if chosen.several_files:
        stream = _zipped(ground, _files(ground, request, chosen))
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        return Exported(f"pass-{request.pass_id}-{chosen.name}.zip", size, stream)
    octets = _octets(ground, request)
    return Exported(name, len(octets), io.BytesIO(octets))


def _octets(ground: Ground, request: ExportRequest) -> bytes:
    inputs = load_pass_inputs(ground, request.pass_id)
    kind = request.format
    if kind == "netcdf":
        history = f"{format_utc(utc_now_ns(), 0)} LINNA: pass {inputs.pass_id} exported as netCDF"
        about = _about(inputs) | {"history": history}
        return netcdf_octets(pass_tables(inputs, evaluate_pass(inputs).navigation), about)
    if kind in MAPS:
        return map_octets(inputs, kind, request.states)
    detail = get_pass(ground, request.pass_id)
    with ground.database.reading() as connection:
        correlations = load_correlations(connection, store.get_pass(connection, request.pass_id).vehicle_id)
    number = detail.spacecraft_id
    spacecraft = messages.SpacecraftNames(messages.craft_name(inputs, number), number, correlations)
    if kind in ORBITS:
        return messages.orbit_octets(inputs, spacecraft, kind, request.states)
    if kind in ATTITUDES:
        return messages.attitude_octets(inputs, spacecraft, kind, request.version)
    return messages.text_kernel(inputs, spacecraft, kind).encode()


def _files(ground: Ground, request: ExportRequest, chosen: Format) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each file of a format; EvaluationError without any."""
    if chosen.name == "parquet":
        with ground.database.reading() as connection:
            packets = packets_by_name(connection, pass_span(connection, store.get_pass(connection, request.pass_id)))
            yield from _some(parquet_files(packets, {"pass": str(request.pass_id)}), request.pass_id, "packets")
    elif chosen.name == "images":
        with ground.database.reading() as connection:
            store.get_pass(connection, request.pass_id)
            found = store.frame_files(connection, request.pass_id)
        images = ((f"{number:06d}.png", ground.files.get(sha256)) for number, sha256 in found.items())
        yield from _some(images, request.pass_id, "archived images")
    elif chosen.name == "spice":
        stem = f"pass-{request.pass_id}"
        inputs = load_pass_inputs(ground, request.pass_id)
        common = {
            f"{stem}.tls": messages.leap_seconds().encode(),
            f"{stem}.tpc": format_pck().encode(),
            f"{stem}-moon.bsp": moon_kernel(inputs.start_utc_ns, inputs.stop_utc_ns),
        }
        yield from common.items()
        own = {kind: f"{stem}.{FORMATS[kind].ending}" for kind in messages.KERNELS}
        for kind, name in own.items():
            yield name, _octets(ground, request.model_copy(update={"format": kind}))
        yield f"{stem}.tm", messages.meta_kernel([*common, *own.values()]).encode()
    else:
        inputs = load_pass_inputs(ground, request.pass_id)
        if chosen.name == "csv":
            yield from csv_files(pass_tables(inputs, evaluate_pass(inputs).navigation), _about(inputs))
        else:
            yield from _some(_trajectories(inputs), request.pass_id, "navigation solutions with a reference")


def _some(files: Iterable[tuple[str, bytes]], pass_id: int, what: str) -> Iterator[tuple[str, bytes]]:
    """Yield the files; without any the pass lacks what the format contains."""
    left = iter(files)
    first = next(left, None)
    if first is None:
        raise EvaluationError(f"pass {pass_id}: expected {what}, found none")
    return chain([first], left)


def _trajectories(inputs: PassInputs) -> Iterator[tuple[str, bytes]]:
    """Yield each navigation solution, and the reference at its times, in TUM form."""
    report = evaluate_pass(inputs)
    if report.reference is None:
        return
    reference = report.reference
    truth = mcmf_from_spherical(
        np.radians(reference.latitude_deg), np.radians(reference.longitude_deg), reference.altitude_m
    )
    for series in report.navigation:
        position = mcmf_from_spherical(
            np.radians(series.latitude_deg), np.radians(series.longitude_deg), series.altitude_m
        )
        rows = np.minimum(np.searchsorted(reference.utc_ns, series.utc_ns), len(reference.utc_ns) - 1)
        known = np.isfinite(position).all(axis=1) & (reference.utc_ns[rows] == series.utc_ns)
        known &= np.isfinite(truth[rows]).all(axis=1)
        if np.count_nonzero(known) < 2:
            continue
        utc_ns, there = series.utc_ns[known], truth[rows[known]]
        stem = "".join(c if c.isalnum() else "-" for c in series.name.lower())
        yield f"{stem}.tum", format_tum(utc_ns, position[known], there).encode()
        yield f"{stem}-reference.tum", format_tum(utc_ns, there, there).encode()


def _about(inputs: PassInputs) -> dict[str, str]:
    return {
        "title": inputs.title,
        "pass": inputs.pass_id,
        "source": "LINNA ground service",
        "evidence_level": inputs.evidence_level or "not stated",
        "comment": "mean-Earth coordinates on the sphere of 1737.4 km (IAU_2015:30100)",
    }


def _zipped(ground: Ground, files: Iterable[tuple[str, bytes]]) -> IO[bytes]:
    """Return a zip archive in a temporary file without a name; the same files give the same octets."""
    folder = ground.files.root
    with ExitStack() as unfinished:
        try:
            stream = unfinished.enter_context(
                tempfile.SpooledTemporaryFile(SPOOLED_OCTETS, dir=str(folder), prefix=unfinished_prefix(INCOMING))
            )
            with zipfile.ZipFile(stream, "w") as archive:
                for name, octets in files:
                    entry = zipfile.ZipInfo(name, _EPOCH_OF_ZIP)
                    # Images are compressed already.
                    stored = name.endswith(".png")
                    entry.compress_type = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
                    archive.writestr(entry, octets)
        except OSError as error:
            raise storage_error(error, folder) from None
        unfinished.pop_all()
    return stream
