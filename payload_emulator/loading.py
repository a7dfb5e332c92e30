"""What is uploaded to the payload before a window: model, parameters, tables.

It is made by the ground from the ground's own knowledge (reference ephemeris, catalogue, gravity field). Nothing of the
simulated truth passes through here except what a scenario declares to be known.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation
from lunar.timescales import format_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.errors import ModelError
from payload_emulator.flight.detector import DetectorParameters, OnnxDetector
from payload_emulator.flight.odometry import OdometryParameters
from payload_emulator.flight.outcomes import Mode
from payload_emulator.flight.payload import FlightParameters, FlightTables, Payload
from payload_emulator.flight.tables import pack_anchor_table
from payload_emulator.scenario import Scenario

SHIPPED_MODEL = "linna.onnx"
_ANCHOR_STEP_NS = 15_000_000_000

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LoadedPayload:
    """A payload ready to observe, and what the archive records of how it was loaded."""

    payload: Payload
    build: dict[str, str]
    start_state: dict[str, Any]
    table_hashes: dict[str, str]
    gravity: dict[str, Any]


def load_payload(
    scenario: Scenario,
    camera: PinholeCamera,
    reference: Ephemeris,
    catalogue: CraterCatalogue,
    orientation: Orientation,
    data: DataFolder,
    first_frame_utc_ns: int,
    model: Path | None = None,
) -> LoadedPayload:
    """Flight software with its tables, for a window that starts at `first_frame_utc_ns`.

    Raises
    ------
    ModelError
        The detector model is missing or no network of this project.
    """
    model_octets = _model_octets(model)
    detector = OnnxDetector(
        model_octets, DetectorParameters(width_px=camera.width_px, height_px=camera.height_px)
    )
    parameters = FlightParameters(
        camera=camera,
        modes=tuple(Mode[name] for name in scenario.navigation.estimators),
        odometry=OdometryParameters(safety_timeout_s=scenario.navigation.safety_timeout_s or None),
    )
    tables = FlightTables(anchor_ephemeris=_anchor_table(reference, orientation))
    payload = Payload(
        detector, parameters, tables, model_hash=detector.model_hash, model_octets=len(model_octets)
    )
    position, velocity = reference.at(np.array([first_frame_utc_ns]))
    return LoadedPayload(
        payload,
        build={
            "name": "linna-flight",
            "version": "0.1.0",
            "model_sha256": detector.sha256,
            "parameters_sha256": parameters.sha256,
        },
        start_state={
            "utc": format_utc(first_frame_utc_ns, 9),
            "position_icrf_m": position[0].tolist(),
            "velocity_icrf_m_s": velocity[0].tolist(),
        },
        table_hashes={"anchor_ephemeris": hashlib.sha256(tables.anchor_ephemeris).hexdigest()},
        gravity={},
    )


def _anchor_table(reference: Ephemeris, orientation: Orientation) -> bytes:
    """The anchor ephemeris as uploaded: places in MCMF against on-board time."""
    times = np.arange(reference.start_utc_ns, reference.stop_utc_ns + 1, _ANCHOR_STEP_NS, dtype=np.int64)
    position, _ = reference.at(times)
    rotation = orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64))
    return pack_anchor_table(
        np.asarray(ticks_from_utc_ns(times)), np.einsum("nij,nj->ni", rotation, position)
    )


def _model_octets(model: Path | None) -> bytes:
    if model is not None:
        return model.read_bytes()
    shipped = resources.files("payload_emulator.flight") / "models" / SHIPPED_MODEL
    try:
        return shipped.read_bytes()
    except FileNotFoundError:
        raise ModelError(
            f"shipped detector model {SHIPPED_MODEL}: expected beside flight software, found none"
        ) from None
