"""Orbit, attitude, poses and SPICE kernels of a pass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ground_service.errors import EvaluationError
from ground_service.evaluation.core import PassInputs
from ground_service.exports.model import REFERENCE
from ground_service.missions.timekeeping.core import TimeCorrelation, ticks_of_utc_ns
from lunar.arrays import FloatArray, IntArray
from lunar.ephemeris import Covariance, Ephemeris, clipped, ephemeris_from_states
from lunar.frames import mcmf_from_spherical
from lunar.messages.aem import AttitudeSegment, format_aem
from lunar.messages.oem import format_oem
from lunar.messages.oem_xml import format_oem_xml
from lunar.messages.spice import ClockLine, ck_octets, format_fk, format_ik, format_sclk, spacecraft_id, spk_kernel
from lunar.timescales import LEAP_DATES, TICKS_PER_SECOND, tdb_s_from_utc_ns, utc_ns_from_ticks


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of frames whose position is known, in time order.

    Attributes
    ----------
    states
        States that the positions come from: `reference` or the name of an estimator.
    frame_number, utc_ns
        Frames (n,).
    row
        Places (n,) of the frames in the detections of the pass.
    position_mcmf_m, mcmf_from_icrf, camera_from_mcmf
        Positions (n, 3) and rotations (n, 3, 3).
    """

    states: str
    frame_number: IntArray
    utc_ns: IntArray
    row: IntArray
    position_mcmf_m: FloatArray
    mcmf_from_icrf: FloatArray
    camera_from_mcmf: FloatArray

    @property
    def camera_from_icrf(self) -> FloatArray:
        """Rotations (n, 3, 3) from ICRF to camera axes."""
        return np.asarray(self.camera_from_mcmf @ self.mcmf_from_icrf)


def poses_of(inputs: PassInputs, states: str = REFERENCE) -> Poses:
    """Return the poses of the frames with detection reports.

    Raises
    ------
    EvaluationError
        If the mission does not state the orientation of the Moon, or there are no such states.
    """
    if inputs.orientation is None:
        raise EvaluationError(inputs.refused.get("orientation", "lunar orientation: not stated"))
    utc_ns = inputs.detections.utc_ns
    mcmf_from_icrf = inputs.orientation.mcmf_from_icrf(tdb_s_from_utc_ns(utc_ns))
    if states == REFERENCE:
        position = _reference_positions(inputs, utc_ns, mcmf_from_icrf)
    else:
        position = _estimated_positions(inputs, utc_ns, states)
    known = np.flatnonzero(np.isfinite(position).all(axis=1))
    utc_ns, position, mcmf_from_icrf = utc_ns[known], position[known], mcmf_from_icrf[known]
    return Poses(
        states,
        inputs.detections.frame_number[known],
        utc_ns,
        known.astype(np.int64),
        position,
        mcmf_from_icrf,
        inputs.viewing.camera_from_mcmf(utc_ns, position, mcmf_from_icrf),
    )


def states_names(inputs: PassInputs) -> list[str]:
    names = [one.estimator for one in inputs.navigation if len(one.utc_ns)]
    return [*([REFERENCE] if inputs.reference is not None else []), *names]


def no_such_states(inputs: PassInputs, states: str) -> EvaluationError:
    """Return the error of a request for states that the pass does not have."""
    return EvaluationError(f"states: expected {' or '.join(states_names(inputs)) or 'none'}, found {states!r}")


def _reference_positions(inputs: PassInputs, utc_ns: IntArray, mcmf_from_icrf: FloatArray) -> FloatArray:
    if inputs.reference is None:
        raise no_such_states(inputs, REFERENCE)
    position = np.full((len(utc_ns), 3), np.nan)
    covered = inputs.reference.covers(utc_ns)
    icrf, _ = inputs.reference.at(utc_ns[covered])
    position[covered] = np.einsum("nij,nj->ni", mcmf_from_icrf[covered], icrf)
    return position


def _estimated_positions(inputs: PassInputs, utc_ns: IntArray, states: str) -> FloatArray:
    samples = next((one for one in inputs.navigation if one.estimator == states and len(one.utc_ns)), None)
    if samples is None:
        raise no_such_states(inputs, states)
    place = np.searchsorted(samples.utc_ns, utc_ns, side="right") - 1
    same = (place >= 0) & (samples.utc_ns[np.maximum(place, 0)] == utc_ns)
    position = np.full((len(utc_ns), 3), np.nan)
    rows = place[same]
    position[same] = mcmf_from_spherical(
        np.radians(samples.latitude_deg[rows]), np.radians(samples.longitude_deg[rows]), samples.altitude_m[rows]
    )
    return position


FILTER = "anchored"
"""Estimator whose states are downlinked with velocities and covariances."""

KERNELS = ("sclk", "fk", "ik", "spk", "ck")
DAY_TICKS = 86_400 * TICKS_PER_SECOND
GAP_STEPS = 1.5
"""Attitudes further apart than so many usual steps are not interpolated in a CK."""


@dataclass(frozen=True, slots=True)
class SpacecraftNames:
    """Name and CCSDS number of a spacecraft, and the correlations of its clock."""

    name: str
    number: int
    correlations: tuple[TimeCorrelation, ...]


def craft_name(inputs: PassInputs, number: int) -> str:
    """Return the name of the spacecraft in the reference, otherwise one of its number."""
    reference = inputs.reference
    return reference.segments[0].object_name if reference is not None else f"SPACECRAFT_{number}"


def ephemeris_of(inputs: PassInputs, states: str, spacecraft: SpacecraftNames) -> Ephemeris:
    """Return the states of a pass as an ephemeris: the reference in its interval, or the states of the filter.

    Raises
    ------
    EvaluationError
        If there are no such states, they have no velocities, or cannot be turned into ICRF.
    """
    if states == REFERENCE:
        if inputs.reference is None:
            raise no_such_states(inputs, states)
        return clipped(inputs.reference, inputs.start_utc_ns, inputs.stop_utc_ns)
    if states not in states_names(inputs):
        raise no_such_states(inputs, states)
    found = inputs.filter_states
    if states != FILTER or found is None or not len(found):
        raise EvaluationError(
            f"states: expected {REFERENCE} or {FILTER} (downlinked with velocities), found {states!r}"
        )
    if inputs.orientation is None or inputs.onboard_orientation is None:
        reasons = (inputs.refused.get(name) for name in ("orientation", "onboard_orientation"))
        reason = next(filter(None, reasons), "no lunar orientation is given")
        raise EvaluationError(f"states: expected orientations that turn {FILTER} into ICRF; {reason}")
    found = found.in_icrf(inputs.orientation, inputs.onboard_orientation)
    covariances = tuple(
        Covariance(int(utc), found.frame, matrix[:6, :6])
        for utc, matrix in zip(found.utc_ns, found.covariance, strict=True)
    )
    return ephemeris_from_states(
        found.utc_ns,
        found.state[:, :3],
        found.state[:, 3:6],
        spacecraft.name,
        frame=found.frame,
        interpolation="HERMITE",
        degree=3,
        comments=(
            "states of the on-board navigation filter after each frame, downlinked;",
            f"turned into ICRF with the orientation {inputs.orientation.name};",
            f"evidence level: {inputs.evidence_level or 'not stated'}",
        ),
        covariances=covariances,
    )


def orbit_octets(inputs: PassInputs, spacecraft: SpacecraftNames, kind: str, states: str) -> bytes:
    """Return the orbit of a pass as `oem`, `oem-xml` or `spk`."""
    ephemeris = ephemeris_of(inputs, states, spacecraft)
    if kind == "spk":
        return spk_kernel(ephemeris, spacecraft_id(spacecraft.number)).octets
    return (format_oem_xml(ephemeris) if kind == "oem-xml" else format_oem(ephemeris)).encode()


def attitude_octets(inputs: PassInputs, spacecraft: SpacecraftNames, kind: str, version: str) -> bytes:
    """Return the attitude of the camera in the frames of a pass as `ck`, or `aem` of a version.

    Raises
    ------
    EvaluationError
        If the attitude of no frame is known.
    """
    utc_ns, q_wxyz = inputs.viewing.attitude_utc_ns, inputs.viewing.q_wxyz
    if not len(utc_ns):
        raise EvaluationError(f"pass {inputs.pass_id}: expected attitudes of its frames, found none")
    if kind == "ck":
        ticks = np.array([ticks_of_utc_ns(int(one), spacecraft.correlations) for one in utc_ns], dtype=np.int64)
        step = float(np.median(np.diff(ticks))) if len(ticks) > 1 else float(TICKS_PER_SECOND)
        return ck_octets(ticks, q_wxyz, spacecraft_id(spacecraft.number), gap_ticks=int(GAP_STEPS * step))
    segment = AttitudeSegment(utc_ns, q_wxyz, object_name=spacecraft.name, object_id=spacecraft.name)
    return format_aem((segment,), version).encode()


def clock_lines(correlations: Sequence[TimeCorrelation], ticks: IntArray) -> list[ClockLine]:
    """Return the time correlations as lines that follow each other; the first begins a day before the ticks (n,)."""
    first = max(int(ticks.min()) - DAY_TICKS, 0)
    if not correlations:
        return [ClockLine(first, int(utc_ns_from_ticks(first)))]
    ordered = sorted(correlations, key=lambda one: one.start_ticks)
    lines = []
    for number, one in enumerate(ordered):
        start = min(first, one.start_ticks) if number == 0 else one.start_ticks
        utc_ns = int(one.utc_ns(np.array([start], dtype=np.int64))[0])
        lines.append(ClockLine(start, utc_ns, 1.0 + one.drift_ppb * 1e-9))
    return lines


def text_kernel(inputs: PassInputs, spacecraft: SpacecraftNames, kind: str) -> str:
    """Return the text kernel `sclk`, `fk` or `ik` of a pass."""
    number = spacecraft_id(spacecraft.number)
    if kind == "fk":
        return format_fk(number, spacecraft.name)
    if kind == "ik":
        return format_ik(inputs.viewing.camera, number, spacecraft.name)
    ticks = [ticks_of_utc_ns(one, spacecraft.correlations) for one in (inputs.start_utc_ns, inputs.stop_utc_ns)]
    return format_sclk(clock_lines(spacecraft.correlations, np.array(ticks, dtype=np.int64)), number)


def leap_seconds() -> str:
    """Return a leap-second kernel; the formula of TDB is that of NAIF (TIME Required Reading)."""
    steps = "\n".join(f"    {10 + number}, @{date}" for number, date in enumerate(LEAP_DATES))
    return f"""KPL/LSK

\\begindata

DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT = (
{steps}
)

\\begintext
"""


def meta_kernel(names: Sequence[str]) -> str:
    """Return a kernel that loads others of the working folder."""
    listed = "\n".join(f"    '{name}'" for name in names)
    return f"KPL/MK\n\n\\begindata\n\nKERNELS_TO_LOAD = (\n{listed}\n)\n\n\\begintext\n"
