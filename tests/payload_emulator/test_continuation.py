"""A session beyond the arc of its scenario: the orbit is flown on, and images are delivered."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from lunar.datafolder import find_data
from lunar.messages.oem import save_oem
from payload_emulator.session.emulator import load_scenario_payload, new_spacecraft
from payload_emulator.session.live import LivePayload
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world import build_world, continued, sample_truth

SCENARIO = parse_scenario("""
name = "beyond"
seed = 3
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[maneuvers]
enabled = false
[window]
search = "none"
start = "2029-08-07T01:40:00Z"
duration_s = 120.0
[camera]
images = "reduced"
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
filter_gravity = "builtin"
filter_degree = 8
""")
NO_DATA = find_data(None)
NS = 10**9


def test_the_orbit_goes_on_from_its_last_state_with_frames_of_their_own_arc() -> None:
    world = build_world(SCENARIO, NO_DATA)
    once = continued(world, 3_600.0)
    assert once is not None
    twice = continued(once, 1_800.0)
    assert twice is not None
    longer = build_world(replace(SCENARIO, window=replace(SCENARIO.window, duration_s=8_000.0)), NO_DATA)
    times = np.arange(world.truth.start_utc_ns, twice.truth.stop_utc_ns, 60 * NS)
    # Restarted integration at its tolerance against one without a joint.
    np.testing.assert_allclose(twice.truth.states(times)[0], longer.truth.states(times)[0], atol=1.0)
    np.testing.assert_array_equal(
        twice.truth.states(world.frame_utc_ns)[0], world.truth.states(world.frame_utc_ns)[0]
    )
    added = twice.frame_utc_ns[world.frame_utc_ns.size :]
    assert added[0] - world.frame_utc_ns[-1] == 30 * NS
    assert added.size > 100 and np.all(np.diff(twice.frame_utc_ns) >= 15 * NS)
    assert added[-1] < twice.truth.stop_utc_ns


def test_an_ephemeris_file_ends(tmp_path) -> None:
    world = build_world(SCENARIO, NO_DATA)
    save_oem(sample_truth(world.truth, world.frame_utc_ns), tmp_path / "t.oem")
    orbit = replace(SCENARIO.orbit, oem=str(tmp_path / "t.oem"))
    assert continued(build_world(replace(SCENARIO, orbit=orbit), NO_DATA), 3_600.0) is None


@pytest.mark.timeout(120)
def test_a_live_session_takes_images_after_the_scenario() -> None:
    world = build_world(SCENARIO, NO_DATA)
    loaded = load_scenario_payload(world, NO_DATA)[0]
    told: list[int] = []

    class Watched(LivePayload):
        def _send_frame(self, flown) -> None:
            if flown.moment.frame >= 0:
                told.append(flown.moment.frame)
            if flown.moment.utc_ns > int(world.frame_utc_ns[-1]) + 900 * NS:
                self.stopping.set()
            LivePayload._send_frame(self, flown)

    live = Watched(world, new_spacecraft(world, loaded), rate=0.0)
    thread = threading.Thread(target=live.run)
    thread.start()
    thread.join(100.0)
    assert not thread.is_alive()
    # Eight frames of the scenario, then one each 15 s for 15 minutes but for the gap of one.
    assert told == list(range(len(told))) and 60 <= len(told) <= 70
    assert live.spacecraft.payload.summary()["frames_processed"] >= 60
