"""Names of housekeeping parameters as panels print them."""

import numpy as np
import pytest

from reports.figures.housekeeping import parameter_title
from reports.values import HousekeepingParameter


@pytest.mark.parametrize(
    ("name", "unit", "title"),
    [
        ("bus_voltage_v", "V", "bus voltage, V"),
        ("temperature_c", "°C", "temperature, °C"),
        ("storage_used_permille", "‰", "storage used, ‰"),
        ("vitamin_c", "", "vitamin c"),
        ("v", "V", "v, V"),
    ],
)
def test_a_unit_is_named_once(name: str, unit: str, title: str) -> None:
    nothing = np.zeros(0)
    assert parameter_title(HousekeepingParameter(name, unit, nothing.astype(np.int64), nothing)) == title
