"""Estimators of the payload: one protocol, and one table by mode.

Another estimator is a module that implements `Estimator` and a row of `ESTIMATORS`; another filter of the anchored mode
is a module with the functions of `KalmanFilter` and its row `AnchoredEstimator(module)`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Protocol

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation.anchored import anchored
from payload_emulator.flight.navigation.anchored.anchored import (
    AnchoredReport,
    AnchoredSetup,
    AnchoredState,
    Observation,
)
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.filter import KalmanFilter
from payload_emulator.flight.navigation.odometry import odometry
from payload_emulator.flight.navigation.odometry.odometry import OdometryParameters, OdometryState
from payload_emulator.flight.navigation.outcomes import Mode, Outcome, ResetTrigger
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import AnchorTable, CatalogueTable

OdometryRun = tuple[AnchorTable, OdometryState | None]
AnchoredRun = tuple[AnchoredSetup, AnchoredState]

_NAN = float("nan")
_UNKNOWN = (_NAN, _NAN, _NAN)


class NavigationParameters(Protocol):
    """Parameters of the build that estimators read."""

    @property
    def camera(self) -> PinholeCamera: ...
    @property
    def odometry(self) -> OdometryParameters: ...
    @property
    def anchored(self) -> AnchoredParameters: ...


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Input of one frame.

    Attributes
    ----------
    usable
        The image is good and the detector answered.
    camera_from_icrf
        Attitude, shape (3, 3); None where the ADCS gave none.
    manual_step
        The ground ordered a reset onto the anchor ephemeris.
    """

    ticks: int
    found: Detections
    usable: bool
    camera_from_icrf: FloatArray | None
    manual_step: bool


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """Outcome of one frame in the terms of its telemetry.

    Attributes
    ----------
    detections
        Detections that the estimator was given.
    pairs
        Pairs considered, and pairs used.
    place
        Latitude and longitude (rad) and altitude (m); None without a solution.
    below_m
        Altitude that scales pixels to the ground; NaN where it is unknown.
    filter
        State and report of a filter, which are sent in full; None for other estimators.
    """

    outcome: Outcome
    detections: int
    trigger: ResetTrigger = ResetTrigger.none
    pairs: tuple[int, int] = (0, 0)
    shift_m: tuple[float, float] = (_NAN, _NAN)
    anchor_reads: int = 0
    place: tuple[float, float, float] | None = None
    velocity_icrf_m_s: tuple[float, float, float] = _UNKNOWN
    sigma_rtn_m: tuple[float, float, float] = _UNKNOWN
    nis: float = _NAN
    below_m: float = _NAN
    filter: tuple[AnchoredState, AnchoredReport] | None = None


class Estimator(Protocol):
    """An estimator without memory: its state is passed in and returned; None before `start`.

    Attributes
    ----------
    tables
        On-board tables that are loaded at each start, by name.
    outcomes
        Outcomes that it reports.
    """

    tables: ClassVar[tuple[str, ...]]
    outcomes: ClassVar[tuple[Outcome, ...]]

    def start(self, tables: Mapping[str, Any], parameters: NavigationParameters, before: Any | None) -> Any | None:
        """Return the first state, with what a state `before` learned of the same tables; None without a table."""

    def step(self, state: Any | None, frame: Frame, parameters: NavigationParameters) -> tuple[Any | None, Report]:
        """Return the state after a frame and the report of it."""

    def widen(self, state: Any, position_m: float, velocity_m_s: float) -> Any:
        """Return the state with more uncertainty per axis."""

    def summary(self, state: Any | None) -> tuple[int, int]:
        """Return the reads of an altitude of the anchor ephemeris and the resets onto it."""


@dataclass(frozen=True, slots=True)
class OdometryEstimator:
    """Odometry of a mode; its state is the anchor ephemeris and the state after the last frame."""

    mode: Mode
    tables: ClassVar[tuple[str, ...]] = ()
    outcomes: ClassVar[tuple[Outcome, ...]] = tuple(Outcome)[: Outcome.fixed]

    def start(
        self, tables: Mapping[str, Any], parameters: NavigationParameters, before: OdometryRun | None
    ) -> OdometryRun | None:
        anchor = tables["anchor_ephemeris"]
        return None if anchor is None else (anchor, None)

    def step(
        self, state: OdometryRun | None, frame: Frame, parameters: NavigationParameters
    ) -> tuple[OdometryRun | None, Report]:
        if state is None:
            return None, Report(Outcome.missed, len(frame.found))
        anchor, before = state
        after, report = odometry.step(
            before, frame.ticks, frame.found, anchor, parameters.camera, self.mode, parameters.odometry,
            manual_step=frame.manual_step,
        )  # fmt: skip
        return (anchor, after), Report(
            report.outcome,
            len(frame.found),
            report.reset_trigger,
            (report.candidate_pairs, report.pairs),
            (report.shift_east_m, report.shift_north_m),
            0 if after is None else after.altitude_reads,
            None if after is None else (after.latitude_rad, after.longitude_rad, after.altitude_m),
            below_m=_NAN if after is None else after.features.altitude_m,
        )

    def widen(self, state: Any, position_m: float, velocity_m_s: float) -> Any:
        """Return the state as it is: an odometry has no uncertainty."""
        return state

    def summary(self, state: OdometryRun | None) -> tuple[int, int]:
        if state is None or state[1] is None:
            return 0, 0
        return state[1].altitude_reads, state[1].resets


@dataclass(frozen=True, slots=True)
class AnchoredEstimator:
    """Anchored navigation with a filter; its state is the set-up and the state after the last frame."""

    method: KalmanFilter = kalman
    tables: ClassVar[tuple[str, ...]] = ("catalogue", "gravity", "orientation", "initial_state", "burns")
    outcomes: ClassVar[tuple[Outcome, ...]] = tuple(Outcome)[Outcome.fixed :]

    def start(
        self, tables: Mapping[str, Any], parameters: NavigationParameters, before: AnchoredRun | None
    ) -> AnchoredRun | None:
        catalogue, gravity, orientation, initial, burns = (tables[name] for name in self.tables)
        if not (catalogue and gravity and orientation and initial):
            return None
        known = None if before is None or not _same(before[0].catalogue, catalogue) else before[1].offset
        return anchored.start(
            catalogue, gravity, orientation, initial, parameters.camera, parameters.anchored, burns, self.method, known
        )  # fmt: skip

    def step(
        self, state: AnchoredRun | None, frame: Frame, parameters: NavigationParameters
    ) -> tuple[AnchoredRun | None, Report]:
        found = frame.found if frame.usable else None
        count = 0 if found is None else len(found)
        if state is None:
            return None, Report(Outcome.refused, count)
        setup, before = state
        observation = Observation(frame.ticks, found, frame.camera_from_icrf)
        after, report = anchored.step(before, observation, setup)
        known = bool(np.isfinite(report.latitude_rad))
        return (setup, after), Report(
            report.outcome,
            count,
            pairs=(report.candidates, report.matched),
            place=(report.latitude_rad, report.longitude_rad, report.altitude_m) if known else None,
            velocity_icrf_m_s=report.velocity_icrf_m_s,
            sigma_rtn_m=report.sigma_rtn_m,
            nis=report.nis,
            below_m=report.altitude_m if known else _NAN,
            filter=(after, report) if known else None,
        )

    def widen(self, state: AnchoredRun, position_m: float, velocity_m_s: float) -> AnchoredRun:
        return state[0], anchored.widened(state[1], position_m, velocity_m_s)

    def summary(self, state: AnchoredRun | None) -> tuple[int, int]:
        return 0, 0


def _same(one: CatalogueTable, other: CatalogueTable) -> bool:
    return all(np.array_equal(getattr(one, item.name), getattr(other, item.name)) for item in fields(one))


ESTIMATORS: dict[Mode, Estimator] = {
    Mode.paper: OdometryEstimator(Mode.paper),
    Mode.spherical: OdometryEstimator(Mode.spherical),
    Mode.anchored: AnchoredEstimator(),
}
