"""The emulator: flies a scenario, shows the payload what its camera would see, writes the pass archive.

Truth (trajectory, terrain, light) stays on this side of `Payload.step`; what the payload says comes back as space
packets, becomes CADUs, and goes through the link model into `downlink.cadu`.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import save_catalogue
from lunar.datafolder import DataFolder
from lunar.frames import spherical_from_mcmf
from lunar.messages.oem import save_oem
from lunar.timescales import format_utc
from payload_emulator.errors import ScenarioError, TerrainError
from payload_emulator.flight.ports import ResetCause
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.picture_search import find_sun
from payload_emulator.flight.vision.preprocess import prepare_image
from payload_emulator.session.archive import recording
from payload_emulator.session.archive.mission import MISSION_FILE, mission_text, save_attitudes
from payload_emulator.session.archive.scoring import judge_session, score_navigation
from payload_emulator.session.scenario import Scenario, format_scenario
from payload_emulator.session.spacecraft.loading import LoadedPayload, check_payload_files, load_scenario_payload
from payload_emulator.session.spacecraft.loop import PLAYBACK_CHANNEL, Spacecraft, StepResult, new_spacecraft
from payload_emulator.session.spacecraft.schedule import fly_scenario, timeline
from payload_emulator.session.world.camera import expose, require_renderable, true_sun_direction
from payload_emulator.session.world.external import ExternalFrames
from payload_emulator.session.world.world import World, build_world, clock_ticks, sample_truth
from payload_emulator.sim.board import link
from tmtc.dictionary.payload import APID_TIME_REPORT, DICTIONARY
from tmtc.link.settings import LinkSettings
from tmtc.packets.pus import TICKS_PER_SECOND

_FRAMES = 3
_WIDEST_DEG = 45.0  # a quarter turn of the image brings no other Sun within 45 degrees of its top


def sun_warnings(world: World, detector: OnnxDetector) -> list[str]:
    """Return a line for each of three external frames whose Sun differs from that of the ephemeris.

    A frame whose craters leave the direction of the Sun undetermined is not compared.
    """
    warnings = []
    rows = np.linspace(0, world.frame_utc_ns.size - 1, _FRAMES, dtype=int)
    for utc_ns in world.frame_utc_ns[np.unique(rows)].tolist():
        exposure = expose(world, utc_ns)
        seen = find_sun(detector, prepare_image(exposure.image, detector.preparation).gray)
        if seen is None or not seen.determined:
            continue
        right, down = exposure.attitude[4:6]
        azimuth_deg = float(np.degrees(np.arctan2(right, -down))) % 360.0
        position = world.truth.positions_mcmf(utc_ns)[0]
        sun = true_sun_direction(world, position, utc_ns, np.random.default_rng(0))
        elevation_deg = float(np.degrees(np.arcsin(position @ sun / np.linalg.norm(position))))
        apart_deg = abs((seen.azimuth_deg - azimuth_deg + 180.0) % 360.0 - 180.0)
        if apart_deg > _WIDEST_DEG or elevation_deg < 0.0:
            warnings.append(
                f"frame of {format_utc(utc_ns, 0)}: the image shows the Sun at azimuth {seen.azimuth_deg:.0f} deg "
                f"(clockwise from its top), the ephemeris has it at {azimuth_deg:.0f} deg, elevation "
                f"{elevation_deg:.0f} deg; the detector turns images by the ephemeris: check times and attitudes"
            )
    return warnings


_LATE_TICKS = 120 * TICKS_PER_SECOND
_DUMP_OCTETS = 64_000

Progress = Callable[[Iterable[Any], int], Iterator[Any]]


def emulate(
    scenario: Scenario,
    data: DataFolder,
    out: Path,
    *,
    frames_kept: int | None = 0,
    progress: Progress | None = None,
    external: ExternalFrames | None = None,
) -> dict[str, Any]:
    """Fly a scenario and write its pass archive into the folder `out`; the summary comes back.

    Parameters
    ----------
    frames_kept
        How many images, evenly spread, go into the archive; None keeps all.
    progress
        Wraps the iteration over frames (items, total), for a progress bar.
    external
        Frames that others took, instead of rendered ones; all of them are kept.

    Raises
    ------
    ScenarioError
        The scenario cannot be flown, or `out` holds something that is no pass archive.
    """
    started = time.monotonic()
    _require_replaceable(out)
    world = checked_world(scenario, data, external)
    frames_kept = frames_kept if external is None else None
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        summary = _emulate_into(world, data, partial, frames_kept, progress, started)
        if out.exists():
            shutil.rmtree(out)
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return summary


def checked_world(scenario: Scenario, data: DataFolder, external: ExternalFrames | None = None) -> World:
    """Return the world of a scenario, checked for all that its flight needs.

    Raises
    ------
    ScenarioError, TerrainError, ModelError, TableError
        The scenario cannot be flown.
    """
    check_payload_files(scenario)
    world = build_world(scenario, data, external)
    require_renderable(world)
    return world


@dataclass(slots=True, eq=False)
class Sender:
    """Puts what the payload hands over into dumps: one for all without stations, else several a contact.

    Packets older than `_LATE_TICKS` travel on the channel for playback. `time_reports` keeps when each was emitted
    (UTC), whenever their dump goes out: they tell the clock at that instant.
    """

    world: World
    settings: LinkSettings
    transmitter: link.Transmitter = field(init=False)
    time_reports: list[tuple[bytes, int]] = field(default_factory=list)
    _waiting: dict[int, list[tuple[bytes, bytes]]] = field(default_factory=dict)
    _utc_ns: int = 0
    _light_s: float = link.LIGHT_S

    def __post_init__(self) -> None:
        self.transmitter = link.Transmitter(self.world.scenario.spacecraft_id, self.settings)

    def take(self, result: StepResult) -> None:
        """Take the packets of a step, and send the dumps that are complete."""
        self._utc_ns, self._light_s = result.step.utc_ns, result.step.light_s
        stations = bool(self.world.scenario.link.stations)
        now = clock_ticks(self.world, result.step.utc_ns)
        for packet in result.packets:
            late = stations and now - int.from_bytes(packet[14:20], "big") > _LATE_TICKS
            self._waiting.setdefault(PLAYBACK_CHANNEL if late else 0, []).append((packet, result.clcw))
            if not late and int.from_bytes(packet[:2], "big") & 0x7FF == APID_TIME_REPORT:
                self.time_reports.append((packet, result.step.utc_ns))
        waiting = sum(len(packet) for packets in self._waiting.values() for packet, _ in packets)
        if stations and (not result.step.in_contact or waiting > _DUMP_OCTETS):
            self.flush()

    def flush(self) -> None:
        """Send everything."""
        for channel, waiting in sorted(self._waiting.items()):
            packets, clcws = [packet for packet, _ in waiting], [clcw for _, clcw in waiting]
            self.transmitter.send(packets, self._utc_ns, channel, self._light_s, clcws)
        self._waiting = {}


def _emulate_into(
    world: World, data: DataFolder, folder: Path, frames_kept: int | None, progress: Progress | None, started: float
) -> dict[str, Any]:
    scenario = world.scenario
    loaded, reference, catalogue = load_scenario_payload(world, data)
    warnings = [world.ends] if world.ends else []
    warnings += [] if world.external is None else sun_warnings(world, loaded.detector)
    total = int(world.frame_utc_ns.size)
    kept = (
        set(range(total)) if frames_kept is None else set(np.linspace(0, total - 1, frames_kept + 2, dtype=int)[1:-1])
    )
    spacecraft = new_spacecraft(world, loaded)
    sender = Sender(world, LinkSettings(coding=scenario.link.coding))
    inputs: list[recording.RecordedStep] = []
    attitudes = np.full((total, 3, 3), np.nan)
    flown = fly_scenario(world, spacecraft)
    for result in progress(flown, len(timeline(world))) if progress else flown:
        sender.take(result)
        payload_input, number = spacecraft.payload_input, result.step.frame
        if result.exposure is not None:
            if result.exposure.fault:
                raise TerrainError(result.exposure.fault)
            attitudes[number] = result.exposure.camera_from_mcmf
        if payload_input is None:
            continue
        inputs.append(recording.recorded_step(number, payload_input))
        if number in kept:
            recording.save_image(folder, number, payload_input.image)
    sender.flush()
    reception = link.transmit(sender.transmitter.dumps, sender.transmitter.settings, scenario.link, scenario.seed)
    recording.save_record(folder, inputs, loaded.parameters, loaded.tables)
    recording.save_frame_times(folder, world.frame_utc_ns)
    packets = [packet for dump in sender.transmitter.dumps for packet in dump.packets]
    save_attitudes(folder, inputs)
    (folder / MISSION_FILE).write_text(mission_text(world, data), encoding="utf-8")
    save_oem(sample_truth(world.truth, world.frame_utc_ns), folder / "truth.oem")
    save_oem(reference, folder / "reference.oem")
    save_catalogue(catalogue, folder / "catalogue.csv")
    (folder / "downlink.cadu").write_bytes(reception.octets)
    link.save_receptions(folder, sender.transmitter.dumps)
    emitted = np.array([utc_ns for _, utc_ns in sender.time_reports], dtype=np.int64)
    link.save_time_receptions(
        folder, [packet for packet, _ in sender.time_reports], emitted, world.truth.states(emitted)[0]
    )
    wall_s = time.monotonic() - started
    summary = _summary(world, loaded, spacecraft, packets, reception, len(kept), wall_s)
    judged = judge_session(world, loaded, catalogue, attitudes, b"".join(packets))
    summary |= score_navigation(world, judged) | {"warnings": warnings}
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    (folder / "manifest.json").write_text(json.dumps(_manifest(world, loaded, folder), indent=2) + "\n")
    return summary


def _summary(
    world: World,
    loaded: LoadedPayload,
    spacecraft: Spacecraft,
    packets: list[bytes],
    reception: link.Reception,
    kept: int,
    wall_s: float,
) -> dict[str, Any]:
    scenario = world.scenario
    total = int(world.frame_utc_ns.size)
    _, longitude, altitude = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "frames": total,
        "frames_kept": kept,
        "packets": len(packets),
        "downlink_octets": len(reception.octets),
        "start_utc": format_utc(int(world.frame_utc_ns[0])),
        "stop_utc": format_utc(int(world.frame_utc_ns[-1])),
        "altitude_km": {
            "min": float(altitude.min()) / 1e3,
            "mean": float(altitude.mean()) / 1e3,
            "max": float(altitude.max()) / 1e3,
        },
        "longitude_deg": {
            "first": float(np.degrees(longitude[0])) % 360.0,
            "last": float(np.degrees(longitude[-1])) % 360.0,
        },
        "maneuvers": len(world.burns),
        **spacecraft.payload.summary(),
        "truth_reads_after_start": spacecraft.truth_reads.count,
        "link": reception.account,
        "resets": [ResetCause(cause).name for cause in spacecraft.resets],
        "mode": spacecraft.payload.mode.name,
        "data": list(world.data_names),
        "wall_s": round(wall_s, 3),
        "realtime_factor": round(total * scenario.camera.frame_interval_s / wall_s, 2),
    }


def _manifest(world: World, loaded: LoadedPayload, folder: Path) -> dict[str, Any]:
    """Return the facts of a pass that the ground needs, with the hash of every other file of the archive."""
    scenario, camera = world.scenario, world.scenario.camera
    return {
        "schema_version": 1,
        "pass_name": f"{scenario.name}-{format_utc(int(world.frame_utc_ns[0]), 0)}",
        "spacecraft_id": scenario.spacecraft_id,
        "scenario": scenario.name,
        "scenario_toml": format_scenario(scenario),
        "seed": scenario.seed,
        "build": loaded.build,
        "dictionary": {"version": DICTIONARY.version, "hash": DICTIONARY.hash},
        "data_sources": list(world.data_names),
        "start_utc": format_utc(int(world.frame_utc_ns[0])),
        "stop_utc": format_utc(int(world.frame_utc_ns[-1])),
        "cadence_s": camera.frame_interval_s,
        "frames_expected": int(world.frame_utc_ns.size),
        "light": scenario.light.mode,
        "terrain": world.terrain.name,
        "camera": {"width_px": camera.width_px, "height_px": camera.height_px, "fov_deg": camera.fov_deg},
        "estimators": list(scenario.navigation.estimators),
        "start_state": loaded.start_state,
        "burns": [
            {
                "utc": format_utc(burn.utc_ns, 9),
                "delta_v_icrf_m_s": burn.planned_m_s.tolist(),
                "sigma_m_s": burn.sigma_m_s,
            }
            for burn in world.burns
            if burn.declared and int(world.frame_utc_ns[0]) <= burn.utc_ns <= int(world.frame_utc_ns[-1])
        ],
        "gravity": {
            "truth": world.gravity.name,
            "degree": min(world.gravity.degree, scenario.dynamics.degree),
            **loaded.gravity,
        },
        "tables": loaded.table_hashes,
        "files": file_entries(folder),
    }


def file_entries(folder: Path) -> dict[str, dict[str, Any]]:
    """Size and SHA-256 of every file of an archive but its manifest, by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / "manifest.json")
    return {
        path.relative_to(folder).as_posix(): {
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "bytes": path.stat().st_size,
        }
        for path in files
    }


def _require_replaceable(out: Path) -> None:
    """Refuse to overwrite anything that is not a pass archive of an earlier run."""
    if out.exists() and not (out.is_dir() and (not any(out.iterdir()) or (out / "manifest.json").is_file())):
        raise ScenarioError(
            f"{out}: expected a new folder or an earlier pass archive, found something else; choose another --out"
        )
