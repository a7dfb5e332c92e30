"""Images and inputs of a live pass, made again from the declared world and compared with telemetry.

The record of what a payload was given exists only where it was simulated. The ground has telemetry and telecommands of
a pass; where the mission description declares the simulated world, the flight is propagated again and each image is
taken again at the time that telemetry states. Nothing is used unless telemetry confirms it: image reports state CRC-32
of the pixels and of the attitude, housekeeping the hashes of model, parameters and catalogue.

Housekeeping values of the board (temperatures, processor time) are not known and are not made again.
"""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import load_catalogue
from lunar.datafolder import DataFolder
from payload_emulator.errors import RecordError
from payload_emulator.flight.onboard.commanding import Refusal, parse_commands
from payload_emulator.flight.ports import UNLIMITED, ResetCause
from payload_emulator.flight.telemetry.packets import image_report
from payload_emulator.session.archive import recording
from payload_emulator.session.archive.emulator import Progress, file_entries
from payload_emulator.session.archive.mission import save_attitudes
from payload_emulator.session.scenario import Scenario, parse_scenario
from payload_emulator.session.spacecraft.loading import LoadedPayload, launch_payload
from payload_emulator.session.world.camera import Exposure, expose
from payload_emulator.session.world.world import CHUNK_S, World, extended_flight, first_utc_ns, frame_utc_ns, open_world
from payload_emulator.sim.board.platform import parse_fault
from tmtc.dictionary.fields import find_parameter
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Table
from tmtc.dictionary.tables import table_hash
from tmtc.downlink import DownlinkDecode, decode
from tmtc.errors import TmtcError
from tmtc.packets.pus import TICKS_PER_SECOND

DOWNLINK = "downlink.packets"
TELECOMMANDS = "telecommands.packets"
"""Telecommand packets that were sent for the pass, in order of transmission."""

CATALOGUE = "onboard-catalogue.csv"
"""Crater catalogue of the ground, of which the table on board was made."""

_BOOT_TICKS = 60 * TICKS_PER_SECOND
_MARGIN_NS = 600_000_000_000
_NO_ATTITUDE = np.full(7, np.nan)
_UNKNOWN_SENSORS = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class ImageReport:
    """Statement of telemetry about one image."""

    ticks: int
    values: Mapping[str, int]


def reconstruct(archive: Path, out: Path, data: DataFolder, progress: Progress | None = None) -> dict[str, Any]:
    """Write a copy of the archive of a live pass with its images and the inputs of the payload; return its manifest.

    Raises
    ------
    RecordError
        Telemetry does not confirm an image or an input, or the archive lacks what is needed to make them again.
    """
    manifest = json.loads((archive / "manifest.json").read_text())
    scenario = parse_scenario(str(manifest["scenario_toml"]), source=f"declared world of {archive}")
    if scenario.camera.images == "reduced":
        raise RecordError(f"{archive}: expected a world with rendered images, found camera.images = 'reduced'")
    received = _received(archive)
    telemetry = received.tables(DICTIONARY)
    reports = image_reports(telemetry.get("image_report"))
    if not reports:
        raise RecordError(f"{archive}: expected image reports in telemetry, found none")
    telecommands = _octets(archive, TELECOMMANDS, "telecommands that were sent for the pass")
    _octets(archive, CATALOGUE, "the crater catalogue that was on board at launch")
    catalogue = load_catalogue(archive / CATALOGUE)
    world = open_world(scenario, data, is_declared=True)
    loaded = launch_payload(scenario, world.camera, data, catalogue)
    _check_loads(archive, telemetry.get("housekeeping"), loaded, telecommands)
    world = flown_until(world, first_utc_ns(world, reports[-1].ticks))
    shutil.copytree(archive, out)
    steps: dict[int, recording.RecordedStep] = {}
    times = []
    for number, (report, exposure) in enumerate(
        progress(_exposures(world, reports), len(reports)) if progress else _exposures(world, reports)
    ):
        _check_image(archive, number, report, exposure)
        recording.save_image(out, number, exposure.image)
        steps[report.ticks] = _frame_step(number, report.ticks, exposure)
        times.append(exposure.utc_ns)
    inputs = with_telecommands(steps, telecommands)
    recording.save_record(out, inputs, loaded.parameters, loaded.tables)
    recording.save_frame_times(out, np.array(times, dtype=np.int64))
    save_attitudes(out, inputs)
    manifest |= _described(world, loaded, scenario)
    manifest["files"] = file_entries(out)
    (out / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    return dict(manifest)


def image_reports(table: Table | None) -> list[ImageReport]:
    """Return the image reports of a pass in order of time, the first of each image."""
    found: dict[int, ImageReport] = {}
    if table is not None:
        for i, ticks in enumerate(np.asarray(table.columns["image_ticks"], dtype=np.int64).tolist()):
            values = {
                name: int(table.columns[name][i]) for name in ("width_px", "height_px", "image_crc", "inputs_crc")
            }
            found.setdefault(ticks, ImageReport(ticks, values))
    return [found[ticks] for ticks in sorted(found)]


def flown_until(world: World, utc_ns: int) -> World:
    """Return a world whose flight reaches beyond a time."""
    while world.truth.stop_utc_ns < utc_ns + _MARGIN_NS:
        truth, burns = extended_flight(world, CHUNK_S)
        world = replace(world, truth=truth, burns=(*world.burns, *burns))
    return world


def with_telecommands(steps: Mapping[int, recording.RecordedStep], telecommands: bytes) -> list[recording.RecordedStep]:
    """Return the steps of a pass: a boot that receives the telecommands, and one at each time of release or image."""
    releases = [
        int(command.values["release_ticks"])
        for command in parse_commands(telecommands)
        if not isinstance(command, Refusal) and command.name == "insert_activity"
    ]
    first = min([*releases, *steps]) - _BOOT_TICKS
    found = [replace(_step(first), telecommands=telecommands, boot=int(ResetCause.power_on), uptime_ticks=0)]
    for ticks in sorted({*releases, *steps}):
        found.append(replace(steps.get(ticks, _step(ticks)), uptime_ticks=ticks - first))
    return found


def _exposures(world: World, reports: Sequence[ImageReport]) -> Iterator[tuple[ImageReport, Exposure]]:
    """Yield the exposure of each report; where the clock has jumped, at the time that telemetry confirms."""
    faults = map(parse_fault, world.scenario.faults.events)
    jumps_s = [one.size for one in sorted(faults, key=lambda one: one.at_s) if one.kind == "clock_jump"]
    errors_s = list(accumulate(jumps_s, initial=0.0))
    for report in reports:
        for error_s in tuple(errors_s):
            ticks = report.ticks - round(error_s * TICKS_PER_SECOND)
            exposure = expose(world, frame_utc_ns(world, ticks))
            found = image_report(exposure.image, np.zeros(0))
            if found["image_crc"] == report.values["image_crc"]:
                break
            errors_s = errors_s[1:] or errors_s
        yield report, exposure


def _step(ticks: int) -> recording.RecordedStep:
    """Return a step without an image."""
    return recording.RecordedStep(-1, ticks, _NO_ATTITUDE, b"", (0, 0), "", None, _UNKNOWN_SENSORS, 0, UNLIMITED)


def _frame_step(number: int, ticks: int, exposure: Exposure) -> recording.RecordedStep:
    return replace(
        _step(ticks),
        number=number,
        attitude=np.asarray(exposure.attitude, np.float64),
        image_shape=exposure.image.shape,
        image_sha256=recording.pixel_hash(exposure.image),
    )


def _check_image(archive: Path, number: int, report: ImageReport, exposure: Exposure) -> None:
    """Refuse an image or inputs that are not those that telemetry reports."""
    found = image_report(exposure.image, np.asarray(exposure.attitude))
    for name, expected in report.values.items():
        if found[name] != expected:
            form = "08X" if name.endswith("crc") else "d"
            raise RecordError(
                f"{archive}: image {number} of the declared world: expected {name} {expected:{form}} as in "
                f"telemetry, found {found[name]:{form}}"
            )


def _parameters_hash(loaded: LoadedPayload, telecommands: bytes) -> int:
    """Return the hash of the parameters with those that telecommands change, as housekeeping reports it."""
    changed = {}
    for command in parse_commands(telecommands):
        if not isinstance(command, Refusal) and command.name == "set_parameter":
            parameter = find_parameter(int(command.values["parameter_id"]))
            if parameter is not None:
                changed[parameter.name] = float(command.values["value"])
    if not changed:
        return loaded.parameters.flight.hash
    return table_hash(json.dumps(changed, sort_keys=True).encode())


def _check_loads(archive: Path, table: Table | None, loaded: LoadedPayload, telecommands: bytes) -> None:
    """Refuse a declared world whose payload has not the model, parameters and catalogue that housekeeping reports."""
    if table is None or len(table) == 0:
        raise RecordError(f"{archive}: expected housekeeping with the hashes of model and tables, found none")
    declared = {
        "model_hash": loaded.detector.model_hash,
        "parameters_hash": _parameters_hash(loaded, telecommands),
        "catalogue_hash": table_hash(loaded.tables.catalogue) if loaded.tables.catalogue else 0,
    }
    for name, expected in declared.items():
        for found in np.unique(np.asarray(table.columns[name], dtype=np.int64)).tolist():
            if found != expected:
                raise RecordError(
                    f"{archive}: {name} of the declared payload: expected {found:08X} as in telemetry, "
                    f"found {expected:08X}"
                )


def _received(archive: Path) -> DownlinkDecode:
    octets = _octets(archive, DOWNLINK, "received packets")
    try:
        return decode(octets, dictionary=DICTIONARY)
    except TmtcError as error:
        raise RecordError(f"{archive / DOWNLINK}: expected packets of the dictionary, found {error}") from None


def _octets(archive: Path, name: str, what: str) -> bytes:
    path = archive / name
    if not path.is_file() or not (octets := path.read_bytes()):
        raise RecordError(f"{path}: expected {what}, found none")
    return octets


def _described(world: World, loaded: LoadedPayload, scenario: Scenario) -> dict[str, Any]:
    """Return what the manifest of an emulated pass says of the world and the build."""
    return {
        "seed": scenario.seed,
        "build": loaded.build,
        "dictionary": {"version": DICTIONARY.version, "hash": DICTIONARY.hash},
        "data_sources": list(world.data_names),
        "light": scenario.light.mode,
        "terrain": world.terrain.name,
        "estimators": list(scenario.navigation.estimators),
        "tables": loaded.table_hashes,
    }
