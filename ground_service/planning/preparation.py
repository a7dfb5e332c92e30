"""On-board tables of an observation window, made from the reference ephemeris and uploaded as scheduled telecommands.

The payload leaves its downlink a minute before the window, takes the tables, observes, and returns to the downlink.
"""

from collections.abc import Callable

import numpy as np

from ground_service.errors import Conflict
from ground_service.evaluation.smoother import StartState
from ground_service.missions.model import Uploads
from lunar.constants import NS as NS
from lunar.ephemeris import Ephemeris
from lunar.errors import EphemerisCoverageError
from lunar.frames import IauOrientation, Orientation
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from tmtc.dictionary.tables import InitialState, pack_anchor_table, pack_initial_state, pack_orientation_table
from tmtc.packets.large_data import split

LEAD_NS = 60 * NS
"""The payload is in standby from then on before the window, and takes its tables."""

AFTER_NS = 20 * NS
"""The payload returns to the downlink this long after the window."""

MARGIN_NS = 120 * NS
ANCHOR_STEP_NS = 15 * NS
ORIENTATION_STEP_NS = 3600 * NS
ORIENTATION_MARGIN_NS = 4 * ORIENTATION_STEP_NS
PART_OCTETS = 16_000
"""Largest part of a table in a telecommand; parts are carried in segments."""

TicksOf = Callable[[int], int]
Activity = tuple[int, str, dict[str, object]]
"""UTC of release, telecommand, arguments."""


def gap_ns(uploads: Uploads | None) -> int:
    """Return the time between two windows that the end of one sequence and the begin of the next need."""
    return 0 if uploads is None else AFTER_NS + LEAD_NS + NS


def prepare_window(
    uploads: Uploads,
    reference: Ephemeris | None,
    orientation: Orientation,
    start_utc_ns: int,
    stop_utc_ns: int,
    ticks_of: TicksOf,
    transaction: int,
    start: StartState | None = None,
) -> tuple[list[Activity], StartState | None]:
    """Return the activities around a window other than its observation, and the uploaded start state.

    `start` is the start state of a window of the experiment; None: that of the reference.

    Raises
    ------
    Conflict
        A table needs a reference ephemeris, and none covers the window.
    """
    activities: list[Activity] = [(start_utc_ns - LEAD_NS, "perform_function", _mode(1.0))]
    state = None
    if uploads.tables:
        needed = f"window from {format_utc(start_utc_ns, 0)}: its tables need a reference ephemeris that covers it"
        if reference is None:
            raise Conflict(f"{needed}, found none")
        try:
            state = start or start_state(reference, start_utc_ns)
            tables = _tables(uploads, reference, orientation, state, stop_utc_ns, ticks_of)
        except EphemerisCoverageError as error:
            raise Conflict(f"{needed}: {error}") from None
        at_utc_ns = start_utc_ns - LEAD_NS + 10 * NS
        for k, (name, octets) in enumerate(tables):
            for command, values in split(
                octets, transaction=(transaction + k) % 65_536, table=name, part_length=PART_OCTETS, link="uplink"
            ):
                items = values["items"]
                assert isinstance(items, dict)
                stated = [{"octet": octet} for octet in items["octet"].tolist()]
                activities.append((at_utc_ns, command, {**values, "items": stated}))
                at_utc_ns += NS
    activities.append((stop_utc_ns + AFTER_NS, "perform_function", _mode(3.0)))
    return activities, state


def start_state(reference: Ephemeris, utc_ns: int) -> StartState:
    """Return the state of the reference at an instant."""
    position, velocity = reference.at(np.array([utc_ns], dtype=np.int64))
    return StartState(utc_ns, position[0], velocity[0])


def experiment_state(orbit: Ephemeris, error_m: float, utc_ns: int, spacecraft_id: int) -> StartState:
    """Return a state of an orbit with an error that spacecraft and time determine.

    The errors of the position, 1 sigma per axis, and of the velocity, this times the mean motion, are independent.
    """
    known = start_state(orbit, utc_ns)
    drawn = np.random.default_rng((spacecraft_id, utc_ns)).normal(0.0, error_m, (2, 3))
    return StartState(
        utc_ns, known.position_icrf_m + drawn[0], known.velocity_icrf_m_s + drawn[1] * _mean_motion(known)
    )


def experiment_accuracy(uploads: Uploads, error_m: float, state: StartState) -> Uploads:
    """Return uploads that declare the accuracy of a start state of the experiment."""
    return uploads.model_copy(update={"sigma_position_m": error_m, "sigma_velocity_m_s": error_m * _mean_motion(state)})


def _mean_motion(state: StartState) -> float:
    """Return the angular rate of a state about the Moon, in rad/s."""
    return float(np.linalg.norm(state.velocity_icrf_m_s) / np.linalg.norm(state.position_icrf_m))


def _tables(
    uploads: Uploads,
    reference: Ephemeris,
    orientation: Orientation,
    state: StartState,
    stop_utc_ns: int,
    ticks_of: TicksOf,
) -> list[tuple[str, bytes]]:
    """Return name and octets of each table; the start state is the last, since each load starts estimators again."""
    start_utc_ns = state.utc_ns
    made: list[tuple[str, bytes]] = []
    if "orientation" in uploads.tables:
        times = np.arange(
            start_utc_ns - ORIENTATION_MARGIN_NS, stop_utc_ns + ORIENTATION_MARGIN_NS, ORIENTATION_STEP_NS
        )
        onboard = IauOrientation()
        tdb_s = np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64)
        mcmf_from_icrf = onboard.mcmf_from_icrf(tdb_s)
        pa_from_mcmf = onboard.pa_from_icrf(float(tdb_s[0])) @ mcmf_from_icrf[0].T
        made.append(("orientation", pack_orientation_table(_ticks(times, ticks_of), mcmf_from_icrf, pa_from_mcmf)))
    if "anchor_ephemeris" in uploads.tables:
        first, last = start_utc_ns - MARGIN_NS, stop_utc_ns + MARGIN_NS
        times = np.arange(first, last, ANCHOR_STEP_NS, dtype=np.int64)
        position, _ = reference.at(times)
        rotation = orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(times), dtype=np.float64))
        places = np.einsum("nij,nj->ni", rotation, position)
        made.append(("anchor_ephemeris", pack_anchor_table(_ticks(times, ticks_of), places)))
    if "initial_state" in uploads.tables:
        initial = InitialState(
            ticks_of(start_utc_ns),
            state.position_icrf_m,
            state.velocity_icrf_m_s,
            uploads.sigma_position_m or 1000.0,
            uploads.sigma_velocity_m_s or 1.0,
        )
        made.append(("initial_state", pack_initial_state(initial)))
    return made


def _ticks(
    times: np.ndarray[tuple[int], np.dtype[np.int64]], ticks_of: TicksOf
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([ticks_of(int(one)) for one in times.tolist()], dtype=np.int64)


def _mode(number: float) -> dict[str, object]:
    return {"function_id": "set_mode", "argument_1": number, "argument_2": 0.0}
