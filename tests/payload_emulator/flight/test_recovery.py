"""A navigator that finds itself elsewhere notices, and finds its place again."""

from dataclasses import replace

import numpy as np
from pytest import mark

from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.search.lost_in_space import LostParameters
from studies.montecarlo import CatalogueErrors, Kidnap, fly

FRAME = 20
PARAMETERS = AnchoredParameters(gravity_degree=50)


def frames_until_back(run):
    """Frames from the kidnap, itself included, to the first with an error below 500 m; 999 for never."""
    good = np.flatnonzero(run.error_m[FRAME:] < 500.0)
    return int(good[0]) + 1 if good.size else 999


@mark.parametrize(("distance_m", "announced", "limit"), [(5e3, False, 8), (20e3, True, 4), (20e3, False, 8)])
def test_a_kidnapped_spacecraft_is_back_within_the_frames_allowed(navigation_case, distance_m, announced, limit):
    case = navigation_case(FRAME + 16, kidnap=Kidnap(FRAME, distance_m, announced), parameters=PARAMETERS)
    for seed in (1, 2):
        run = fly(case, seed)
        assert run.error_m[FRAME] > 0.5 * distance_m or frames_until_back(run) == 1
        assert frames_until_back(run) <= limit
        assert run.error_m[-1] < 500.0


def test_farther_than_any_widened_search_the_place_is_found_without_a_prior(navigation_case):
    case = navigation_case(FRAME + 24, kidnap=Kidnap(FRAME, 200e3, announced=False), parameters=PARAMETERS)
    # The part of the Moon about the track, so that a search takes moments.
    near = np.flatnonzero(np.abs(np.degrees(case.craters.latitude_rad) - about_deg(case)[0]) < 35.0)
    case = replace(case, craters=case.craters.select(near[turn_deg(case, near) < 25.0]))
    lost = replace(PARAMETERS, lost_frames=10_000)
    without = fly(replace(case, parameters=lost), 1)
    found = fly(replace(case, parameters=replace(PARAMETERS, lost=LostParameters())), 1)
    assert frames_until_back(without) == 999
    assert frames_until_back(found) <= 16
    assert found.error_m[-1] < 500.0


def about_deg(case):
    """Latitude and longitude below the frame of the kidnap."""
    from lunar.propagation import ForceModel, propagate
    from lunar.timescales import tdb_s_from_utc_ns

    start, at = (float(tdb_s_from_utc_ns(int(case.frame_utc_ns[k]))) for k in (0, FRAME))
    model = ForceModel(case.gravity, case.orientation, 10)
    flown = propagate(start, case.position_icrf_m, case.velocity_icrf_m_s, at - start + 1.0, model)
    place = case.orientation.mcmf_from_icrf(at) @ flown.state(at)[:3]
    return np.degrees([np.arcsin(place[2] / np.linalg.norm(place)), np.arctan2(place[1], place[0])])


def turn_deg(case, rows):
    longitude = np.degrees(case.craters.longitude_rad[rows]) - about_deg(case)[1]
    return np.abs(np.mod(longitude + 180.0, 360.0) - 180.0)


@mark.parametrize("wrong_share", [0.3, 1.0])
def test_a_stale_catalogue_misleads_nobody(navigation_case, wrong_share):
    errors = CatalogueErrors(wrong_share=wrong_share)
    # Without the search of the whole Moon, which takes a second a frame on this map.
    parameters = replace(PARAMETERS, lost_frames=10_000)
    run = fly(navigation_case(40, catalogue_errors=errors, parameters=parameters), 3)
    assert np.all(np.isfinite(run.error_rtn_m))
    late = slice(20, None)
    if wrong_share < 1.0:
        assert np.median(run.error_m[late]) < 200.0
    else:
        # Nothing on board is where it should be: hardly a fix is believed, and the claimed sigma grows past the error.
        assert np.mean(run.fixed) < 0.2
        assert np.median(run.error_m[late]) < 4.0 * np.median(np.linalg.norm(run.sigma_rtn_m[late], axis=1))
