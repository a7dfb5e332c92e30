"""One frame from image to telemetry: detector, estimators, and the packets that report its outcome."""

from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.catalogue import size_class
from lunar.frames import matrix_from_quaternion
from payload_emulator.flight.navigation.anchored.anchored import AnchoredReport, AnchoredState
from payload_emulator.flight.navigation.estimator import ESTIMATORS, Frame
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.landmark_map import map_rows
from payload_emulator.flight.navigation.odometry import odometry
from payload_emulator.flight.navigation.outcomes import Mode, Outcome, ResetTrigger
from payload_emulator.flight.onboard.housekeeping import StageTimer
from payload_emulator.flight.onboard.loads import TABLE_NUMBERS, FlightParameters, FlightTables
from payload_emulator.flight.ports import Stage
from payload_emulator.flight.telemetry.packets import Telemetry
from payload_emulator.flight.vision.detections import Detections, Detector, no_detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from tmtc.dictionary.tables import (
    table_hash,
    unpack_anchor_table,
    unpack_burn_table,
    unpack_catalogue_table,
    unpack_gravity_table,
    unpack_initial_state,
    unpack_orientation_table,
)
from tmtc.errors import TableError

Table = TypeVar("Table")

_NAN = float("nan")
_PIXEL_LIMIT = 65_535 / 64.0
# No camera has a detection out there: what the network gives beyond, or as no number, is passed over.
_FARTHEST_PX = 1e5
_MILLISECOND_NS = 1e6
_LANDMARKS_A_PACKET = 40
_UNPACK: dict[str, Callable[[bytes], Any]] = {
    "catalogue": unpack_catalogue_table,
    "gravity": unpack_gravity_table,
    "orientation": unpack_orientation_table,
    "initial_state": unpack_initial_state,
    "burns": unpack_burn_table,
}
_ORBIT_TRIANGLE = np.triu_indices(kalman.ORBIT.stop)


class Observer:
    """Everything of flight software that looks at frames.

    Parameters
    ----------
    detector
        Finds craters in images.
    parameters
        As loaded at boot.
    telemetry, timer
        Where packets go, and what processor time is counted with.
    """

    def __init__(
        self, detector: Detector, parameters: FlightParameters, telemetry: Telemetry, timer: StageTimer
    ) -> None:
        self.detector = detector
        self.last_quality = ImageQuality.OK
        self.detector_ms = 0.0
        self.detector_failed = False
        self.counts: Counter[str] = Counter()
        self._no_image: Counter[str] = Counter()
        self.reacquisitions = 0
        self.manual_step = False
        self._altitude_m = _NAN
        self.sightings: Counter[int] = Counter()
        self._parameters = parameters
        self._telemetry = telemetry
        self._timer = timer
        self._outcomes: dict[Mode, Counter[Outcome]] = {mode: Counter() for mode in parameters.modes}
        self._triggers: dict[Mode, Counter[ResetTrigger]] = {mode: Counter() for mode in parameters.modes}
        self._states: dict[Mode, Any] = {}
        self._loaded: dict[str, Any] = {}
        self._in_trouble: set[str] = set()
        self._map_offset: tuple[float, int] | None = None
        self._tables = FlightTables()

    @property
    def anchor_reads(self) -> int:
        """Reads of the anchor ephemeris since boot, all estimators."""
        return sum(sum(ESTIMATORS[mode].summary(state)) for mode, state in self._states.items())

    def load_tables(self, tables: FlightTables) -> None:
        """Start again with these tables; a damaged one is reported and not used."""
        self._tables = tables
        self._loaded["anchor_ephemeris"] = self._load("anchor_ephemeris", unpack_anchor_table)
        for mode in self._parameters.modes:
            self._start(mode)

    def reset(self) -> None:
        """Forget all estimates and what was learned of the tables; each estimator starts from its tables."""
        self._states.clear()
        for mode in self._parameters.modes:
            self._start(mode)

    def widen(self, position_m: float, velocity_m_s: float) -> None:
        """Trust the orbit no more than this."""
        for mode, state in self._states.items():
            if state is not None:
                self._states[mode] = ESTIMATORS[mode].widen(state, position_m, velocity_m_s)

    def frame(
        self, image: NDArray[Any], attitude: FloatArray, score_floor: float, timeout_s: float, quiet: bool
    ) -> None:
        """Detect craters in one frame, run every estimator on them, report both.

        `quiet` leaves out the event about the quality of the image.
        """
        telemetry = self._telemetry
        sun = attitude[4:7] if attitude.size == 7 and np.all(np.isfinite(attitude[4:7])) else None
        camera_from_icrf = _rotation(attitude)
        if camera_from_icrf is None:
            telemetry.event("low", "attitude_missing")
        quality, found = self._detect(image, sun, timeout_s)
        found = self._with_sizes(found)
        size_px = found.diameter_px if found.size_class is None else np.nan_to_num(found.diameter_px)
        numbers = np.stack([found.u_px, found.v_px, size_px])
        somewhere = np.all(np.abs(numbers) < _FARTHEST_PX, axis=0)
        found = found.select(somewhere & ~(found.score < score_floor))
        self.last_quality = quality
        if quality is not ImageQuality.OK:
            self.counts["frames_bad"] += 1
            if not quiet:
                telemetry.event("low", f"image_{quality.name.lower()}")
        self._timer.enter(Stage.navigation)
        altitude_m = _NAN
        reason = "detector failed" if self.detector_failed else quality.name.lower()
        given = Frame(telemetry.ticks, found, reason == "ok", camera_from_icrf, self.manual_step)
        if not given.usable and Mode.anchored in self._parameters.modes:
            self._no_image[reason] += 1
        for mode in self._parameters.modes:
            below_m = self._estimate(mode, given)
            altitude_m = below_m if np.isfinite(below_m) else altitude_m
        self._timer.enter(Stage.telemetry)
        self._altitude_m = altitude_m if np.isfinite(altitude_m) else self._altitude_m
        self._report_detections(self._with_sizes(found), altitude_m)
        self.manual_step = False
        self.counts["frames"] += 1
        self.counts["detections"] += len(found)
        telemetry.frame_number += 1

    def summary(self) -> dict[str, Any]:
        """Return the outcomes of the frames since boot, for the operators of the emulator."""
        estimators = {mode.name: self._summary_of(mode) for mode in self._parameters.modes}
        modes = self._parameters.modes
        primary = Mode.anchored if Mode.anchored in modes else next(iter(modes), None)
        chosen = estimators[primary.name] if primary is not None else {}
        return {
            "estimators": estimators,
            "outcomes": chosen.get("outcomes", {}),
            "fixes": {**estimators["anchored"]["outcomes"], "reacquired": self.reacquisitions}
            if "anchored" in estimators
            else {},
            "no_image_reasons": dict(self._no_image),
            "anchor_reads_after_start": chosen.get("anchor_reads_after_start", 0),
            "frames_processed": self.counts["frames"],
            "frames_bad": self.counts["frames_bad"],
            "detections": self.counts["detections"],
            "events": self._telemetry.counts["events"],
        }

    def _summary_of(self, mode: Mode) -> dict[str, Any]:
        estimator = ESTIMATORS[mode]
        altitude_reads, resets = estimator.summary(self._states.get(mode))
        return {
            "outcomes": {outcome.name: self._outcomes[mode][outcome] for outcome in estimator.outcomes},
            "reset_triggers": {trigger.name: n for trigger, n in sorted(self._triggers[mode].items())},
            "resets": resets,
            "altitude_reads": altitude_reads,
            "anchor_reads_after_start": max(0, altitude_reads - 1) + max(0, resets - 1),
        }

    def _load(self, name: str, unpack: Callable[[bytes], Table]) -> Table | None:
        """Return a table as uploaded; None, with an event, where it is damaged, and None where there is none."""
        octets: bytes = getattr(self._tables, name)
        if not octets:
            return None
        number, identity = float(TABLE_NUMBERS[name]), float(table_hash(octets))
        try:
            table = unpack(octets)
        except TableError:
            self._telemetry.event("high", "table_refused", number, identity)
            return None
        self._telemetry.event("info", "table_loaded", number, identity)
        return table

    def _detect(self, image: NDArray[Any], sun: FloatArray | None, timeout_s: float) -> tuple[ImageQuality, Detections]:
        """Run the detector; what fails or comes too late is an event and no detection."""
        started_ns = self._timer.enter(Stage.detector)
        self.detector_failed = False
        try:
            quality, found = self.detector.examine(image, sun)
        except Exception as error:  # whatever the inference library throws must not stop the payload
            self._telemetry.event("high", "detector_error", float(len(str(error))))
            self.detector_failed, quality, found = True, ImageQuality.OK, no_detections()
        self.detector_ms = (self._timer.enter(Stage.telemetry) - started_ns) / _MILLISECOND_NS
        if self.detector_ms > 1e3 * timeout_s:
            self.counts["detector_timeouts"] += 1
            self._telemetry.event("medium", "detector_timeout", self.detector_ms / 1e3, timeout_s)
            self.detector_failed, found = True, no_detections()
        return quality, found

    def _start(self, mode: Mode) -> None:
        """Start an estimator from its tables; what it learned of the same tables is kept."""
        estimator = ESTIMATORS[mode]
        for name in estimator.tables:
            self._loaded[name] = self._load(name, _UNPACK[name])
        self._states[mode] = estimator.start(self._loaded, self._parameters, self._states.get(mode))

    def _estimate(self, mode: Mode, given: Frame) -> float:
        """Run an estimator on one frame, report it, and return the altitude that scales the frame."""
        estimator = ESTIMATORS[mode]
        try:
            self._states[mode], report = estimator.step(self._states.get(mode), given, self._parameters)
        except np.linalg.LinAlgError:
            self._telemetry.event("high", "estimator_error", float(mode))
            # A covariance that cannot be inverted is of no use: start again from the tables.
            self._start(mode)
            _, report = estimator.step(None, given, self._parameters)
        self._outcomes[mode][report.outcome] += 1
        if report.trigger is not ResetTrigger.none:
            self._triggers[mode][report.trigger] += 1
            self._telemetry.event("info", "anchor_read", float(report.trigger), float(mode))
        frame = {"frame_number": self._telemetry.frame_number, "image_ticks": self._telemetry.ticks}
        self._telemetry.send(
            "frame_outcome",
            {
                **frame,
                "estimator": int(mode),
                "outcome": int(report.outcome),
                "reset_trigger": int(report.trigger),
                "detections": report.detections,
                "candidate_pairs": report.pairs[0],
                "pairs": report.pairs[1],
                "shift_east_m": report.shift_m[0],
                "shift_north_m": report.shift_m[1],
                "anchor_reads": report.anchor_reads,
            },
        )
        if report.place is None:
            return report.below_m
        if report.filter is not None:
            self._report_troubles(report.filter[1])
        latitude_rad, longitude_rad, altitude_m = report.place
        self._telemetry.send(
            "navigation_state",
            {
                **frame,
                "estimator": int(mode),
                "outcome": int(report.outcome),
                "latitude_deg": float(np.degrees(latitude_rad)),
                "longitude_deg": float(np.degrees(longitude_rad)) % 360.0,
                "altitude_m": altitude_m,
                "velocity_icrf_m_s": report.velocity_icrf_m_s,
                "sigma_rtn_m": report.sigma_rtn_m,
                "nis": report.nis,
                "matched": report.pairs[1],
            },
        )
        if report.filter is not None:
            self._send_filter(*report.filter, given.found if given.usable else None)
        return report.below_m

    def _report_troubles(self, report: AnchoredReport) -> None:
        """Send the events of a filter: a reset, and the beginning of a lasting trouble."""
        refused, sigma_m = report.outcome is Outcome.refused, max(report.sigma_rtn_m)
        if report.reacquired:
            self.reacquisitions += 1
            self._telemetry.event("medium", "filter_reset", float(report.matched), sigma_m)
        self._trouble("fix_refused", refused, float(report.candidates), float(report.expected))
        self._trouble("filter_divergence", report.lost, sigma_m, 0.0)
        self._report_attitude(report)
        learned = report.offset
        if learned is not None and (learned.sigma_m, learned.fixes) != self._map_offset:
            self._map_offset = learned.sigma_m, learned.fixes
            self._telemetry.event("info", "map_offset", learned.sigma_m, float(learned.fixes))
            self._telemetry.event("info", "detection_noise", learned.noise_factor, float(learned.fixes))

    def _send_filter(self, state: AnchoredState, report: AnchoredReport, found: Detections | None) -> None:
        """Send what the ground needs to judge and to smooth the filter: its orbit in full, the pairs of its fix."""
        frame = {"frame_number": self._telemetry.frame_number, "image_ticks": self._telemetry.ticks}
        mean, fix = state.estimate.mean, report.fix
        self._telemetry.send(
            "filter_estimate",
            {
                **frame,
                "position_icrf_m": mean[kalman.POSITION],
                "velocity_icrf_m_s": mean[kalman.VELOCITY],
                "acceleration_rtn_m_s2": mean[kalman.ACCELERATION],
                "covariance": state.estimate.covariance[kalman.ORBIT, kalman.ORBIT][_ORBIT_TRIANGLE],
                "innovation_degrees": 0 if fix is None else 2 * fix.index.size,
            },
        )
        if fix is not None and found is not None:
            reported = _reported(found)
            sent = np.isin(fix.identification.detection, reported)
            pairs = {
                "detection": np.searchsorted(reported, fix.identification.detection[sent]),
                "crater_id": state.landmarks.ids[fix.index[sent]],
            }
            self.sightings.update(pairs["crater_id"].tolist())
            self._telemetry.send("identifications", {**frame, "items": pairs})
        for first in range(0, len(report.new_landmarks), _LANDMARKS_A_PACKET):
            rows = map_rows(report.new_landmarks[first : first + _LANDMARKS_A_PACKET])
            items = {
                "landmark_id": rows.identity,
                "latitude_deg": np.degrees(rows.latitude_rad),
                "longitude_deg": np.degrees(rows.longitude_rad) % 360.0,
                "height_m": rows.height_m,
                "diameter_m": rows.diameter_m,
                "sigma_east_m": rows.sigma_m[:, 0],
                "sigma_north_m": rows.sigma_m[:, 1],
                "sigma_up_m": rows.sigma_m[:, 2],
                "sightings": rows.sightings,
                "passes": rows.passes,
            }
            self._telemetry.send("landmarks", {**frame, "items": items})

    def _trouble(self, event: str, present: bool, value_1: float, value_2: float) -> None:
        """Report the beginning of a lasting trouble, once."""
        if present and event not in self._in_trouble:
            self._telemetry.event("medium", event, value_1, value_2)
        (self._in_trouble.add if present else self._in_trouble.discard)(event)

    def _report_attitude(self, report: AnchoredReport) -> None:
        """Report beginning and end of an attitude that is noisier than declared."""
        degraded = bool(report.attitude_noise_rad > 0.0)
        if degraded == ("attitude_degraded" in self._in_trouble):
            return
        (self._in_trouble.add if degraded else self._in_trouble.discard)("attitude_degraded")
        noise_deg, declared_deg = np.degrees([report.attitude_noise_rad, report.attitude_declared_rad])
        if degraded:
            self._telemetry.event("medium", "attitude_degraded", float(noise_deg), float(declared_deg))
        else:
            self._telemetry.event("info", "attitude_restored", float(declared_deg))

    def _report_detections(self, found: Detections, altitude_m: float) -> None:
        kept = found.select(_reported(found))
        self._telemetry.send(
            "detections",
            {
                "frame_number": self._telemetry.frame_number,
                "image_ticks": self._telemetry.ticks,
                "image_quality": int(self.last_quality),
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

    def _with_sizes(self, found: Detections) -> Detections:
        """Return classified detections with apparent diameters of their priors at the last known altitude."""
        if found.diameter_m is None:
            return found
        camera = self._parameters.camera
        depth_m = odometry.depth_on_sphere(found.u_px, found.v_px, self._altitude_m, camera)
        return found.with_prior_sizes(depth_m, camera.focal_px)

    def _size_class(self, found: Detections, altitude_m: float) -> NDArray[np.int8]:
        """Return size classes by diameter on the sphere below the given altitude; -1 where it is unknown."""
        if found.size_class is not None:
            return found.size_class.astype(np.int8)
        camera = self._parameters.camera
        depth = odometry.depth_on_sphere(found.u_px, found.v_px, altitude_m, camera)
        return size_class(found.diameter_px * depth / camera.focal_px)


def _rotation(attitude: FloatArray) -> FloatArray | None:
    """Return camera_from_icrf of an ADCS message, None where it holds no rotation."""
    if attitude.size != 7 or not np.all(np.isfinite(attitude[:4])):
        return None
    length = float(np.linalg.norm(attitude[:4]))
    # Rounding of a unit quaternion is far below this; anything else is no attitude.
    return None if abs(length - 1.0) > 1e-3 else matrix_from_quaternion(attitude[:4] / length)


def _reported(found: Detections) -> IntArray:
    """Return the detections that fit into a packet, the strongest, in their order."""
    return np.sort(np.argsort(-found.score, kind="stable")[:255])
