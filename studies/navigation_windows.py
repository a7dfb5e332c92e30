"""Recordings of the inputs of the anchored estimator over a session, and the estimator repeated on them.

Rendering and detection take nearly all of the time of a session and do not depend on the estimator. A recording holds
detections, attitudes, tables and truth of every frame: variants of catalogue and parameters see the same frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.errors import RecordError
from payload_emulator.flight.onboard.loads import FlightTables
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.emulator import load_scenario_payload
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world import build_world, exposures

_TABLES = tuple(item.name for item in fields(FlightTables))
_COLUMNS = ("u_px", "v_px", "diameter_px", "score", "sigma_px")
_CATALOGUE = ("ids", "latitude_rad", "longitude_rad", "diameter_m", "rim_height_m", "depth_m", "complete")
Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Inputs of the estimator in every frame of a session, and the truth that judges it.

    Attributes
    ----------
    name, seed
        Scenario.
    utc_ns, ticks
        Time of each frame and on-board time, shape (n,).
    attitude
        Messages of the ADCS, shape (n, 7).
    camera_from_mcmf
        True attitude, shape (n, 3, 3).
    truth
        Position (m) and velocity (m/s), ICRF, shape (n, 6).
    mcmf_from_icrf
        True orientation of the Moon, shape (n, 3, 3).
    usable
        Whether the detector accepted the image, shape (n,).
    first
        First detection of each frame and the end of the last, shape (n + 1,).
    detections
        All detections, columns u, v, diameter, score, sigma in pixels, shape (m, 5).
    catalogue
        True craters near the track with the heights of their rims.
    tables
        As uploaded.
    """

    name: str
    seed: int
    utc_ns: IntArray
    ticks: IntArray
    attitude: FloatArray
    camera_from_mcmf: FloatArray
    truth: FloatArray
    mcmf_from_icrf: FloatArray
    usable: Any
    first: IntArray
    detections: FloatArray
    catalogue: CraterCatalogue
    tables: FlightTables

    def found(self, number: int) -> Detections | None:
        """Return the detections of a frame; None where the image was not usable."""
        if not self.usable[number]:
            return None
        return Detections(*self.detections[self.first[number] : self.first[number + 1]].T.copy())


def record(scenario: Scenario, data: DataFolder, progress: Progress | None = None) -> Recording:
    """Return the recording of a scenario: its frames rendered and searched by the network of the scenario."""
    world = build_world(scenario, data)
    loaded, _, catalogue = load_scenario_payload(world, data)
    total = int(world.frame_utc_ns.size)
    usable = np.zeros(total, dtype=np.bool_)
    ticks, attitude, rotation, rows = [], [], [], []
    frames: Iterable[Any] = exposures(world)
    for number, exposure in enumerate(progress(frames, total) if progress else frames):
        quality, found = loaded.detector.examine(exposure.image, exposure.attitude[4:7])
        usable[number] = quality is ImageQuality.OK
        ticks.append(exposure.clock_ticks)
        attitude.append(exposure.attitude)
        rotation.append(exposure.camera_from_mcmf)
        rows.append(np.stack([getattr(found, name) for name in _COLUMNS], axis=1))
    position, velocity = world.truth.states(world.frame_utc_ns)
    tdb_s = np.asarray(tdb_s_from_utc_ns(world.frame_utc_ns), dtype=np.float64)
    return Recording(
        scenario.name,
        scenario.seed,
        world.frame_utc_ns,
        np.array(ticks, dtype=np.int64),
        np.array(attitude),
        np.array(rotation),
        np.concatenate([position, velocity], axis=1),
        np.asarray(world.truth.orientation.mcmf_from_icrf(tdb_s)),
        usable,
        np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64),
        np.concatenate(rows),
        catalogue,
        loaded.tables,
    )


def save_recording(path: Path, recording: Recording) -> None:
    """Write a recording (NumPy archive)."""
    arrays = {
        name: getattr(recording, name)
        for name in ("utc_ns", "ticks", "attitude", "camera_from_mcmf", "truth", "mcmf_from_icrf", "usable")
    }
    arrays |= {"first": recording.first, "detections": recording.detections}
    arrays |= {f"catalogue_{name}": getattr(recording.catalogue, name) for name in _CATALOGUE}
    arrays |= {
        f"table_{name}": np.frombuffer(getattr(recording.tables, name), dtype=np.uint8) for name in _TABLES
    }
    named = {"name": np.array(recording.name), "source": np.array(recording.catalogue.source)}
    np.savez_compressed(path, allow_pickle=False, **arrays, **named, seed=np.array(recording.seed))


def load_recording(path: Path) -> Recording:
    """Return a recording.

    Raises
    ------
    RecordError
        The file is missing or no recording.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            values = {name: stored[name] for name in stored.files}
        columns = {name: values[f"catalogue_{name}"] for name in _CATALOGUE}
        tables = {name: values[f"table_{name}"].tobytes() for name in _TABLES}
        return Recording(
            str(values["name"]),
            int(values["seed"]),
            values["utc_ns"],
            values["ticks"],
            values["attitude"],
            values["camera_from_mcmf"],
            values["truth"],
            values["mcmf_from_icrf"],
            values["usable"],
            values["first"],
            values["detections"],
            CraterCatalogue(**columns, source=str(values["source"])),
            FlightTables(**tables),
        )
    except (OSError, KeyError, ValueError) as error:
        raise RecordError(f"{path}: expected a recording of navigation windows, found {error}") from None
