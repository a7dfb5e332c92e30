"""Scenario files: what is read comes back, what cannot be flown is refused with the key and the values."""

import tomllib

import pytest

from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import (
    SHIPPED,
    Scenario,
    format_scenario,
    load_scenario,
    parse_scenario,
)

# A file with a [dataset] table is a recipe of a data set, not a scenario to fly.
FLOWN = [file for file in sorted(SHIPPED.glob("*.toml")) if "dataset" not in tomllib.loads(file.read_text())]


@pytest.mark.parametrize("file", FLOWN, ids=lambda file: file.stem)
def test_each_shipped_scenario_reads_and_survives_a_round_trip(file) -> None:
    scenario = load_scenario(file)
    assert parse_scenario(format_scenario(scenario)) == scenario


def test_a_bare_name_means_a_shipped_scenario() -> None:
    assert load_scenario("selenita").orbit.semi_major_axis_km == 1768.180  # paper, Table I


def test_an_empty_scenario_is_the_papers_orbit() -> None:
    assert parse_scenario('name = "x"') == Scenario(name="x")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "key 'name' is missing"),
        ("name = 3", "name must be a text, found 3"),
        ('name = "x"\nsed = 4', "unknown key 'sed'; did you mean 'seed'?"),
        (
            'name = "x"\n[orbit]\nexcentricity = 0.1',
            "unknown key 'orbit.excentricity'; did you mean 'eccentricity'?",
        ),
        ('name = "x"\n[orbit]\neccentricity = "round"', "orbit.eccentricity must be a number, found 'round'"),
        (
            'name = "x"\n[dynamics]\nsolar_area_to_mass_m2_kg = -1.0',
            "dynamics.solar_area_to_mass_m2_kg must be from 0 to 1000, found -1.0",
        ),
        (
            'name = "x"\n[orbit]\neccentricity = 1.2',
            "orbit.eccentricity must be from 0 to below 1, found 1.2",
        ),
        ('name = "x"\n[orbit]\nsemi_major_axis_km = 1700.0', "an orbit above the ground"),
        ('name = "x"\n[orbit]\nepoch = "tomorrow"', "orbit.epoch must be a UTC time"),
        ('name = "x"\n[orbit]\nraan_deg = nan', "orbit.raan_deg must be finite"),
        ('name = "x"\n[light]\nmode = "moonlight"', "light.mode must be one of 'paper', 'real'"),
        (
            'name = "x"\n[navigation]\nestimators = ["oracle"]',
            "navigation.estimators must be of paper, spherical, anchored",
        ),
        ('name = "x"\n[camera]\nfov_deg = 180', "camera.fov_deg must be from 1 to 170"),
        ('name = "x"\n[window]\nsearch = "none"', "window.duration_s must be positive"),
        ("name = ", "not TOML"),
    ],
)
def test_what_cannot_be_flown_is_refused(text: str, message: str) -> None:
    with pytest.raises(ScenarioError, match="scenario: ") as refusal:
        parse_scenario(text)
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)
