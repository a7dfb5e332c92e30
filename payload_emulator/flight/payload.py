"""The payload as the spacecraft sees it: images, attitude, clock and telecommands in, space packets out.

`Payload.step` is the only door of flight software. Everything it takes is an array, a count or octets;
everything it says comes back as packets of the dictionary. It reads no clock but the ticks it is given.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera
from lunar.catalogue import size_class
from lunar.frames import matrix_from_quaternion
from payload_emulator.errors import TableError
from payload_emulator.flight import odometry
from payload_emulator.flight.anchored import AnchoredNavigator, AnchoredParameters
from payload_emulator.flight.commanding import Command, Refusal, parse_commands
from payload_emulator.flight.detections import Detections, Detector
from payload_emulator.flight.odometry import OdometryParameters, OdometryState
from payload_emulator.flight.outcomes import Mode, Outcome, ResetTrigger
from payload_emulator.flight.preprocess import ImageQuality
from payload_emulator.flight.tables import (
    TICKS_PER_SECOND,
    AnchorTable,
    table_hash,
    unpack_anchor_table,
    unpack_burn_table,
    unpack_catalogue_table,
    unpack_gravity_table,
    unpack_initial_state,
    unpack_orientation_table,
)
from tmtc.dictionary import DICTIONARY
from tmtc.packets import PacketSequencer
from tmtc.pus import ACK_ACCEPTANCE, ACK_COMPLETION, ACK_START

Float = NDArray[np.float64]
Table = TypeVar("Table")

_NAN = float("nan")
_UNKNOWN_VECTOR = (_NAN, _NAN, _NAN)
_PIXEL_LIMIT = 65_535 / 64.0
# Numbers of tables in events, as in the dictionary's table of tables; orientation and initial state follow it.
_TABLE_NUMBERS = {
    "anchor_ephemeris": 1,
    "catalogue": 2,
    "gravity": 3,
    "orientation": 8,
    "initial_state": 9,
    "burns": 10,
}
_STAGES = ((ACK_ACCEPTANCE, "accepted"), (ACK_START, "started"), (ACK_COMPLETION, "completed"))
# Codes of the dictionary's failure table.
_UNKNOWN_FUNCTION, _OUT_OF_RANGE = 9, 4
# No estimate is worth less than this (position in m, velocity in m/s).
_WIDEST_M = 1e6


class PayloadMode(IntEnum):
    """Mode of the payload as a machine; frames are processed in `observing` only."""

    safe = 0
    standby = 1
    observing = 2
    downlinking = 3


@dataclass(frozen=True, slots=True)
class FlightParameters:
    """What the parameter table of the payload holds.

    Attributes
    ----------
    camera
        The camera as calibrated on the ground.
    modes
        Estimators to run on each frame's detections.
    odometry
        Rules of `paper` and `spherical`.
    anchored
        Rules of `anchored`.
    housekeeping_interval_s
        Time between housekeeping packets.
    temperature_c, bus_voltage_v, power_w
        Readings of the sensors of the board; constant until the platform interfaces supply them.
    """

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    modes: tuple[Mode, ...] = (Mode.paper, Mode.spherical)
    odometry: OdometryParameters = field(default_factory=OdometryParameters)
    anchored: AnchoredParameters = field(default_factory=AnchoredParameters)
    housekeeping_interval_s: float = 60.0
    temperature_c: float = 20.0
    bus_voltage_v: float = 12.0
    power_w: float = 6.0

    @property
    def hash(self) -> int:
        """First 32 bits of the SHA-256 of the parameters as text."""
        return int.from_bytes(hashlib.sha256(repr(self).encode()).digest()[:4], "big")

    @property
    def sha256(self) -> str:
        """SHA-256 of the parameters as text, hexadecimal."""
        return hashlib.sha256(repr(self).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class FlightTables:
    """Tables as uploaded; empty octets where there is none.

    `paper` and `spherical` need the anchor ephemeris; `anchored` needs all the others but the burns, which are only
    there where some are planned, and never reads that one.
    """

    anchor_ephemeris: bytes = b""
    catalogue: bytes = b""
    gravity: bytes = b""
    orientation: bytes = b""
    initial_state: bytes = b""
    burns: bytes = b""


class Payload:
    """Flight software, running since its construction.

    Parameters
    ----------
    detector
        Finds craters in images.
    parameters, tables
        As loaded at boot. A damaged table is reported and not used.
    model_hash
        First 32 bits of the SHA-256 of the detector model, for housekeeping.
    model_octets
        Size of the detector model, for housekeeping.
    boot_count
        Boots since manufacture.
    """

    def __init__(
        self,
        detector: Detector,
        parameters: FlightParameters = FlightParameters(),
        tables: FlightTables = FlightTables(),
        *,
        model_hash: int = 0,
        model_octets: int = 0,
        boot_count: int = 1,
    ) -> None:
        self._detector = detector
        self._parameters = parameters
        self._tables = tables
        self._model_hash = model_hash
        self._memory_octets = model_octets + sum(len(getattr(tables, name)) for name in _TABLE_NUMBERS)
        self._boot_count = boot_count
        self._mode = PayloadMode.observing
        self._sequencer = PacketSequencer()
        self._messages: Counter[tuple[int, int]] = Counter()
        self._counts: Counter[str] = Counter()
        self._outcomes: dict[Mode, Counter[Outcome]] = {mode: Counter() for mode in parameters.modes}
        self._triggers: dict[Mode, Counter[ResetTrigger]] = {mode: Counter() for mode in parameters.modes}
        self._odometry: dict[Mode, OdometryState | None] = {}
        self._anchor: AnchorTable | None = None
        self._navigator: AnchoredNavigator | None = None
        self._reacquisitions = 0
        self._in_trouble: set[str] = set()
        self._manual_step = False
        self._housekeeping_on = True
        self._housekeeping_interval_s = parameters.housekeeping_interval_s
        self._next_housekeeping_ticks: int | None = None
        self._last_ticks: int | None = None
        self._clock_suspect = False
        self._last_quality = ImageQuality.OK
        self._packets: list[bytes] = []
        self._ticks = 0

    def step(
        self, image: NDArray[Any], attitude: Float, clock_ticks: int, telecommand_octets: bytes
    ) -> list[bytes]:
        """Return the space packets that one frame gives rise to.

        Parameters
        ----------
        image
            (H, W) or (H, W, 3); an image without pixels stands for a camera that gave none.
        attitude
            Message of the ADCS, shape (7,): q_wxyz of camera_from_icrf, then the unit Sun vector in the
            camera frame; NaN where absent. clock_ticks On-board time of the image, units of 2^-16 s.
            telecommand_octets Telecommand packets that arrived since the frame before, one after another.
        """
        self._packets, self._ticks = [], int(clock_ticks)
        if self._last_ticks is None:
            self._boot()
        elif self._ticks <= self._last_ticks:
            self._clock_suspect = True
            self._event("medium", "clock_jump", (self._ticks - self._last_ticks) / TICKS_PER_SECOND)
        self._last_ticks = self._ticks
        for item in parse_commands(telecommand_octets):
            self._obey(item)
        if self._mode is PayloadMode.observing:
            self._observe(image, np.asarray(attitude, dtype=np.float64).reshape(-1))
        else:
            self._event("info", "frame_skipped", float(self._mode))
        self._housekeep()
        return self._packets

    def summary(self) -> dict[str, Any]:
        """Return what the payload counted since boot, for the operators of the emulator."""
        estimators = {mode.name: self._summary_of(mode) for mode in self._parameters.modes}
        modes = self._parameters.modes
        primary = Mode.anchored if Mode.anchored in modes else next(iter(modes), None)
        chosen = estimators[primary.name] if primary is not None else {}
        return {
            "estimators": estimators,
            "outcomes": chosen.get("outcomes", {}),
            "fixes": {**estimators["anchored"]["outcomes"], "reacquired": self._reacquisitions}
            if "anchored" in estimators
            else {},
            "truth_reads_after_start": chosen.get("anchor_reads_after_start", 0),
            "frames_processed": self._counts["frames"],
            "frames_bad": self._counts["frames_bad"],
            "detections": self._counts["detections"],
            "events": self._counts["events"],
        }

    def _summary_of(self, mode: Mode) -> dict[str, Any]:
        names = [outcome for outcome in Outcome if (outcome >= Outcome.fixed) is (mode is Mode.anchored)]
        state = self._odometry.get(mode)
        altitude_reads, resets = (0, 0) if state is None else (state.altitude_reads, state.resets)
        return {
            "outcomes": {outcome.name: self._outcomes[mode][outcome] for outcome in names},
            "reset_triggers": {trigger.name: n for trigger, n in sorted(self._triggers[mode].items())},
            "resets": resets,
            "altitude_reads": altitude_reads,
            "anchor_reads_after_start": max(0, altitude_reads - 1) + max(0, resets - 1),
        }

    def _boot(self) -> None:
        self._event("info", "boot", float(self._boot_count))
        self._anchor = self._load("anchor_ephemeris", unpack_anchor_table)
        if Mode.anchored in self._parameters.modes:
            catalogue = self._load("catalogue", unpack_catalogue_table)
            gravity = self._load("gravity", unpack_gravity_table)
            orientation = self._load("orientation", unpack_orientation_table)
            state = self._load("initial_state", unpack_initial_state)
            burns = self._load("burns", unpack_burn_table)
            if catalogue and gravity and orientation and state:
                self._navigator = AnchoredNavigator(
                    catalogue,
                    gravity,
                    orientation,
                    state,
                    self._parameters.camera,
                    self._parameters.anchored,
                    burns,
                )

    def _load(self, name: str, unpack: Callable[[bytes], Table]) -> Table | None:
        """Return a table as uploaded; None, with an event, where it is damaged, and None where there is none."""
        octets: bytes = getattr(self._tables, name)
        if not octets:
            return None
        number, identity = float(_TABLE_NUMBERS[name]), float(table_hash(octets))
        try:
            table = unpack(octets)
        except TableError:
            self._event("high", "table_refused", number, identity)
            return None
        self._event("info", "table_loaded", number, identity)
        return table

    def _observe(self, image: NDArray[Any], attitude: Float) -> None:
        """Detect craters in one frame, run every estimator on them, report both."""
        sun = attitude[4:7] if attitude.size == 7 and np.all(np.isfinite(attitude[4:7])) else None
        camera_from_icrf = _rotation(attitude)
        if camera_from_icrf is None:
            self._event("low", "attitude_missing")
        quality, found = self._detector.examine(image, sun)
        finite = np.isfinite(found.u_px) & np.isfinite(found.v_px) & np.isfinite(found.diameter_px)
        found = found.select(finite)
        self._last_quality = quality
        if quality is not ImageQuality.OK:
            self._counts["frames_bad"] += 1
            self._event("low", f"image_{quality.name.lower()}")
        altitude_m = _NAN
        for mode in self._parameters.modes:
            if mode is Mode.anchored:
                usable = found if quality is ImageQuality.OK else None
                below_m = self._anchored_frame(usable, camera_from_icrf)
            else:
                below_m = self._odometry_frame(mode, found)
            altitude_m = below_m if np.isfinite(below_m) else altitude_m
        self._report_detections(found, altitude_m)
        self._manual_step = False
        self._counts["frames"] += 1
        self._counts["detections"] += len(found)

    def _anchored_frame(self, found: Detections | None, camera_from_icrf: Float | None) -> float:
        """Run the anchored estimator on one frame, report it, and return its altitude."""
        mode, detections = Mode.anchored, 0 if found is None else len(found)
        navigator = self._navigator
        report = None
        if navigator is not None:
            try:
                report = navigator.step(self._ticks, found, camera_from_icrf)
            except np.linalg.LinAlgError:
                self._event("high", "estimator_error", float(mode))
        outcome = Outcome.refused if report is None else report.outcome
        self._outcomes[mode][outcome] += 1
        self._send_outcome(
            mode,
            outcome,
            ResetTrigger.none,
            detections,
            (0, 0) if report is None else (report.candidates, report.matched),
            (_NAN, _NAN),
            0,
        )
        if report is None or navigator is None or not np.isfinite(report.latitude_rad):
            return _NAN
        if report.reacquired:
            self._reacquisitions += 1
            self._event("medium", "filter_reset", float(report.matched), max(report.sigma_rtn_m))
        self._trouble(
            "fix_refused", outcome is Outcome.refused, float(report.candidates), float(report.expected)
        )
        self._trouble("filter_divergence", navigator.lost, max(report.sigma_rtn_m), 0.0)
        self._send(
            "navigation_state",
            {
                "frame_number": self._counts["frames"],
                "image_ticks": self._ticks,
                "estimator": int(mode),
                "outcome": int(outcome),
                "latitude_deg": float(np.degrees(report.latitude_rad)),
                "longitude_deg": float(np.degrees(report.longitude_rad)) % 360.0,
                "altitude_m": report.altitude_m,
                "velocity_icrf_m_s": report.velocity_icrf_m_s,
                "sigma_rtn_m": report.sigma_rtn_m,
                "nis": report.nis,
                "matched": report.matched,
            },
        )
        self._send_filter(navigator, found)
        return report.altitude_m

    def _send_filter(self, navigator: AnchoredNavigator, found: Detections | None) -> None:
        """Send what the ground needs to judge and to smooth the filter: its orbit in full, the pairs of its fix."""
        frame = {"frame_number": self._counts["frames"], "image_ticks": self._ticks}
        mean, covariance = navigator.state.mean, navigator.state.covariance[:9, :9]
        self._send(
            "filter_state",
            {
                **frame,
                "position_icrf_m": mean[:3],
                "velocity_icrf_m_s": mean[3:6],
                "acceleration_rtn_m_s2": mean[6:9],
                "covariance": covariance[np.tril_indices(9)],
            },
        )
        fix = navigator.last_fix
        if fix is not None and found is not None:
            reported = _reported(found)
            sent = np.isin(fix.identification.detection, reported)
            pairs = {
                "detection": np.searchsorted(reported, fix.identification.detection[sent]),
                "crater_id": navigator.landmarks.ids[fix.index[sent]],
            }
            self._send("identifications", {**frame, "items": pairs})

    def _trouble(self, event: str, present: bool, value_1: float, value_2: float) -> None:
        """Report the beginning of a lasting trouble, once."""
        if present and event not in self._in_trouble:
            self._event("medium", event, value_1, value_2)
        (self._in_trouble.add if present else self._in_trouble.discard)(event)

    def _odometry_frame(self, mode: Mode, found: Detections) -> float:
        """Run one odometry on one frame, report it, and return the altitude it scaled the frame with."""
        if self._anchor is None:
            self._outcomes[mode][Outcome.missed] += 1
            self._send_outcome(mode, Outcome.missed, ResetTrigger.none, len(found), (0, 0), (_NAN, _NAN), 0)
            return _NAN
        state, report = odometry.step(
            self._odometry.get(mode),
            self._ticks,
            found,
            self._anchor,
            self._parameters.camera,
            mode,
            self._parameters.odometry,
            manual_step=self._manual_step,
        )
        self._odometry[mode] = state
        self._outcomes[mode][report.outcome] += 1
        if report.reset_trigger is not ResetTrigger.none:
            self._triggers[mode][report.reset_trigger] += 1
            self._event("info", "anchor_read", float(report.reset_trigger), float(mode))
        self._send_outcome(
            mode,
            report.outcome,
            report.reset_trigger,
            len(found),
            (report.candidate_pairs, report.pairs),
            (report.shift_east_m, report.shift_north_m),
            0 if state is None else state.altitude_reads,
        )
        if state is None:
            return _NAN
        self._send(
            "navigation_state",
            {
                "frame_number": self._counts["frames"],
                "image_ticks": self._ticks,
                "estimator": int(mode),
                "outcome": int(report.outcome),
                "latitude_deg": float(np.degrees(state.latitude_rad)),
                "longitude_deg": float(np.degrees(state.longitude_rad)) % 360.0,
                "altitude_m": state.altitude_m,
                "velocity_icrf_m_s": _UNKNOWN_VECTOR,
                "sigma_rtn_m": _UNKNOWN_VECTOR,
                "nis": _NAN,
                "matched": report.pairs,
            },
        )
        return state.features.altitude_m

    def _send_outcome(
        self,
        mode: Mode,
        outcome: Outcome,
        trigger: ResetTrigger,
        detections: int,
        pairs: tuple[int, int],
        shift_m: tuple[float, float],
        reads: int,
    ) -> None:
        self._send(
            "frame_outcome",
            {
                "frame_number": self._counts["frames"],
                "image_ticks": self._ticks,
                "estimator": int(mode),
                "outcome": int(outcome),
                "reset_trigger": int(trigger),
                "detections": detections,
                "candidate_pairs": pairs[0],
                "pairs": pairs[1],
                "shift_east_m": shift_m[0],
                "shift_north_m": shift_m[1],
                "anchor_reads": reads,
            },
        )

    def _report_detections(self, found: Detections, altitude_m: float) -> None:
        kept = found.select(_reported(found))
        self._send(
            "detections",
            {
                "frame_number": self._counts["frames"],
                "image_ticks": self._ticks,
                "image_quality": int(self._last_quality),
                "items": {
                    "u_px": np.clip(kept.u_px, 0.0, _PIXEL_LIMIT),
                    "v_px": np.clip(kept.v_px, 0.0, _PIXEL_LIMIT),
                    "diameter_px": np.clip(kept.diameter_px, 0.0, _PIXEL_LIMIT),
                    "score": np.clip(np.nan_to_num(kept.score), 0.0, 1.0),
                    "size_class": self._size_class(kept, altitude_m),
                    "sigma_px": kept.sigma_px,
                },
            },
        )

    def _size_class(self, found: Detections, altitude_m: float) -> NDArray[np.int8]:
        """Return size classes by diameter on the sphere below the given altitude; -1 where it is unknown."""
        camera = self._parameters.camera
        depth = odometry.depth_on_sphere(found.u_px, found.v_px, altitude_m, camera)
        return size_class(found.diameter_px * depth / camera.focal_px)

    def _obey(self, item: Command | Refusal) -> None:
        """Carry out one telecommand and report every stage that it asked to have reported."""
        if isinstance(item, Refusal):
            self._refuse(item.request_id, item.failure_code)
            return
        failure = self._execute(item)
        if failure:
            self._refuse(item.request_id, failure)
            return
        self._counts["telecommands_accepted"] += 1
        for flag, name in (
            (ACK_ACCEPTANCE, "accepted"),
            (ACK_START, "started"),
            (ACK_COMPLETION, "completed"),
        ):
            if item.acknowledgements & flag:
                self._send(f"verification_{name}", {"request_id": item.request_id})

    def _refuse(self, request_id: int, failure_code: int) -> None:
        self._counts["telecommands_rejected"] += 1
        self._send("verification_not_accepted", {"request_id": request_id, "failure_code": failure_code})
        self._event("low", "telecommand_rejected", float(failure_code))

    def _execute(self, command: Command) -> int:
        """Carry out a telecommand; return 0 or a code of the dictionary's failure table."""
        values = command.values
        if command.name == "perform_function":
            code = int(values["function_id"])
            function = DICTIONARY.labels("perform_function", "function_id").get(code, "")
            return self._perform(function, float(values["argument_1"]), float(values["argument_2"]))
        if command.name in ("enable_housekeeping", "disable_housekeeping"):
            self._housekeeping_on = command.name == "enable_housekeeping"
        elif command.name == "set_housekeeping_interval":
            self._housekeeping_interval_s = float(values["interval_s"])
            self._next_housekeeping_ticks = self._ticks
        elif command.name == "request_housekeeping":
            self._send_housekeeping()
        elif command.name == "test_connection":
            self._send("connection_report", {})
        else:
            return _UNKNOWN_FUNCTION
        return 0

    def _perform(self, function: str, argument: float, second: float) -> int:
        if function == "set_mode" and argument not in (0.0, 1.0, 2.0, 3.0):
            return _OUT_OF_RANGE
        if function == "manual_step":
            self._manual_step = True
        elif function == "reset_estimators":
            self._odometry.clear()
        elif function == "set_mode":
            self._enter(PayloadMode(int(argument)))
        elif function == "start_observation":
            self._enter(PayloadMode.observing)
        elif function == "widen_estimate":
            if not (0.0 <= argument <= _WIDEST_M and 0.0 <= second <= _WIDEST_M):
                return _OUT_OF_RANGE
            if self._navigator is not None:
                self._navigator.widen(argument, second)
        elif function == "stop_observation":
            self._enter(PayloadMode.standby)
        else:
            return _UNKNOWN_FUNCTION
        return 0

    def _enter(self, mode: PayloadMode) -> None:
        if mode is not self._mode:
            self._event("info", "mode_changed", float(self._mode), float(mode))
            self._mode = mode

    def _housekeep(self) -> None:
        due = self._next_housekeeping_ticks
        if not self._housekeeping_on or (due is not None and self._ticks < due and not self._clock_suspect):
            return
        self._send_housekeeping()
        self._next_housekeeping_ticks = self._ticks + round(self._housekeeping_interval_s * TICKS_PER_SECOND)

    def _send_housekeeping(self) -> None:
        reads = sum(state.altitude_reads + state.resets for state in self._odometry.values() if state)
        anchor = self._tables.anchor_ephemeris
        self._send(
            "housekeeping",
            {
                "structure_id": 1,
                "boot_count": self._boot_count & 0xFFFF,
                "mode": int(self._mode),
                "frames_processed": self._counts["frames"],
                "frames_bad": self._counts["frames_bad"],
                "detections_total": self._counts["detections"],
                "packets_sent": self._counts["packets"],
                "anchor_reads": reads,
                "events_sent": self._counts["events"],
                "telecommands_accepted": self._counts["telecommands_accepted"] & 0xFFFF,
                "telecommands_rejected": self._counts["telecommands_rejected"] & 0xFFFF,
                "last_image_quality": int(self._last_quality),
                "temperature_c": self._parameters.temperature_c,
                "bus_voltage_v": self._parameters.bus_voltage_v,
                "power_w": self._parameters.power_w,
                "memory_used_kib": self._memory_octets // 1024,
                "queue_depth": min(len(self._packets), 0xFFFF),
                "storage_used_permille": 0,
                "model_hash": self._model_hash,
                "parameters_hash": self._parameters.hash,
                "catalogue_hash": table_hash(self._tables.catalogue) if self._tables.catalogue else 0,
                "anchor_table_hash": table_hash(anchor) if anchor else 0,
                "clock_status": 2 if self._clock_suspect else 0,
                "watchdog_resets": 0,
            },
        )
        self._clock_suspect = False

    def _event(self, severity: str, event: str, value_1: float = 0.0, value_2: float = 0.0) -> None:
        self._counts["events"] += 1
        self._send(
            f"event_{severity}",
            {
                "event_id": event,
                "frame_number": self._counts["frames"],
                "value_1": value_1,
                "value_2": value_2,
            },
        )

    def _send(self, name: str, values: Mapping[str, object]) -> None:
        definition = DICTIONARY.packet(name)
        kind = (definition.service, definition.subtype)
        self._packets.append(
            DICTIONARY.pack(
                name,
                values,
                ticks=max(self._ticks, 0),
                sequence_count=self._sequencer.next(definition.apid),
                message_counter=self._messages[kind] & 0xFFFF,
            )
        )
        self._messages[kind] += 1
        self._counts["packets"] += 1


def _reported(found: Detections) -> NDArray[np.int64]:
    """Return the detections that fit into a packet, the strongest, in their order."""
    return np.sort(np.argsort(-found.score, kind="stable")[:255])


def _rotation(attitude: Float) -> Float | None:
    """Return camera_from_icrf of an ADCS message, None where it holds no rotation."""
    if attitude.size != 7 or not np.all(np.isfinite(attitude[:4])):
        return None
    length = float(np.linalg.norm(attitude[:4]))
    # Rounding of a unit quaternion is far below this; anything else is no attitude.
    if abs(length - 1.0) > 1e-3:
        return None
    return matrix_from_quaternion(attitude[:4] / length)
