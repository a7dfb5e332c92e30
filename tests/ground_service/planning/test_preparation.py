"""Tables of a window: what they hold, when they are taken on board, and what is refused."""

import numpy as np
import pytest

from ground_service.errors import Conflict
from ground_service.missions.model import Uploads
from ground_service.planning.preparation import experiment_accuracy, experiment_state, prepare_window
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.frames import IauOrientation
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from tmtc.dictionary.tables import unpack_anchor_table, unpack_initial_state, unpack_orientation_table
from tmtc.packets.large_data import LargeDataReceiver

NS = 1_000_000_000
START = parse_utc("2029-08-08T10:00:00Z")
STOP = START + 600 * NS
ALL = Uploads(
    tables=("orientation", "anchor_ephemeris", "initial_state"), sigma_position_m=500.0, sigma_velocity_m_s=0.5
)


def ticks_of(utc_ns):
    """Return the reading of a clock that is 7 s ahead, counted from the start of the window."""
    return 1_000_000 + (utc_ns - START + 7 * NS) * 65_536 // NS


@pytest.fixture(scope="module")
def reference():
    times = np.arange(START - 3_600 * NS, STOP + 3_600 * NS, 30 * NS)
    angle = 2.0 * np.pi * (times - START) / (6_672.0 * NS)
    rate = 2.0 * np.pi / 6_672.0
    zero = np.zeros_like(angle)
    position = 1.768e6 * np.stack([np.cos(angle), zero, np.sin(angle)], axis=1)
    velocity = 1.768e6 * rate * np.stack([-np.sin(angle), zero, np.cos(angle)], axis=1)
    segment = EphemerisSegment(times, position, velocity, object_name="A", object_id="A", degree=7)
    return Ephemeris((segment,))


def prepared(ephemeris, uploads=ALL, *start, late=0):
    return prepare_window(uploads, ephemeris, IauOrientation(), START + late, STOP + late, ticks_of, 8, *start)


def loaded(activities):
    """Octets by number of the table, as the payload puts the parts together."""
    receiver, found = LargeDataReceiver(), {}
    numbers = {"anchor_ephemeris": 1, "orientation": 8, "initial_state": 9}
    for _, name, arguments in activities:
        if name.startswith("uplink"):
            octets = np.array([one["octet"] for one in arguments["items"]], dtype=np.uint8)
            values = {**arguments, "table": numbers[arguments["table"]], "items": {"octet": octets}}
            whole = receiver.accept(name, values)
            found[whole.table] = whole.octets
    return found


def test_the_tables_hold_the_reference_at_on_board_times(reference):
    activities, state = prepared(reference)
    tables = loaded(activities)
    initial = unpack_initial_state(tables[9])
    assert initial.ticks == ticks_of(START)
    np.testing.assert_allclose(initial.position_icrf_m, [1.768e6, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(initial.velocity_icrf_m_s, [0.0, 0.0, 1664.97], atol=0.01)
    assert (initial.sigma_position_m, initial.sigma_velocity_m_s) == (500.0, 0.5)
    assert state.utc_ns == START
    anchor = unpack_anchor_table(tables[1])
    assert anchor.ticks[0] == ticks_of(START - 120 * NS) and anchor.ticks[-1] >= ticks_of(STOP + 100 * NS)
    k = int(np.flatnonzero(anchor.ticks == ticks_of(START))[0])
    expected = IauOrientation().mcmf_from_icrf(float(tdb_s_from_utc_ns(START))) @ [1.768e6, 0.0, 0.0]
    np.testing.assert_allclose(anchor.position_mcmf_m[k], expected, atol=0.01)
    orientation = unpack_orientation_table(tables[8])
    assert orientation.ticks[0] < ticks_of(START) < ticks_of(STOP) < orientation.ticks[-1]


def test_a_window_of_the_experiment_starts_from_the_stated_error_with_its_declared_accuracy(reference):
    made = [experiment_state(reference, 1_000.0, START + k * NS, 76) for k in range(400)]
    known = [reference.at(np.array([one.utc_ns])) for one in made]
    position = np.array([a.position_icrf_m - b[0][0] for a, b in zip(made, known, strict=True)])
    velocity = np.array([a.velocity_icrf_m_s - b[1][0] for a, b in zip(made, known, strict=True)])
    # 400 draws: the standard deviation of each axis is known to 3.5 %, its mean to 5 %.
    np.testing.assert_allclose(position.std(axis=0), 1_000.0, rtol=0.12)
    np.testing.assert_allclose(position.mean(axis=0), 0.0, atol=180.0)
    np.testing.assert_allclose(velocity.std(axis=0), 1_000.0 * 2.0 * np.pi / 6_672.0, rtol=0.12)
    again = experiment_state(reference, 1_000.0, START, 76)
    np.testing.assert_array_equal(again.position_icrf_m, made[0].position_icrf_m)
    assert (experiment_state(reference, 1e3, START, 77).position_icrf_m != again.position_icrf_m).all()
    stated = experiment_accuracy(ALL, 1_000.0, again)
    activities, state = prepared(reference, stated, again)
    initial = unpack_initial_state(loaded(activities)[9])
    assert state is again and initial.sigma_position_m == 1_000.0
    assert initial.sigma_velocity_m_s == pytest.approx(0.9417, rel=5e-3)
    np.testing.assert_allclose(initial.position_icrf_m, again.position_icrf_m, atol=1e-3)


def test_standby_comes_first_then_the_tables_with_the_start_state_last_and_the_downlink_after_the_window(reference):
    activities, _ = prepared(reference)
    times = [utc_ns for utc_ns, _, _ in activities]
    assert times == sorted(times)
    modes = [(utc_ns, one["argument_1"]) for utc_ns, name, one in activities if name == "perform_function"]
    assert modes == [(START - 60 * NS, 1.0), (STOP + 20 * NS, 3.0)]
    loads = [(utc_ns, one["table"]) for utc_ns, name, one in activities if name.startswith("uplink")]
    assert loads[-1][1] == "initial_state"
    assert all(START - 60 * NS < utc_ns < START for utc_ns, _ in loads)


def test_without_tables_only_the_mode_changes():
    activities, state = prepared(None, Uploads())
    assert [name for _, name, _ in activities] == ["perform_function"] * 2 and state is None


def test_a_window_without_a_reference_that_covers_it_is_refused(reference):
    for ephemeris, late in ((None, 0), (reference, 7_800 * NS)):
        with pytest.raises(Conflict, match="its tables need a reference ephemeris"):
            prepared(ephemeris, late=late)
