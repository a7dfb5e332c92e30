"""What a cut gravity field lacks, as a filter's process noise."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import eval_legendre

from lunar.datafolder import find_data
from lunar.gravity import GravityField, load_gravity
from lunar.gravity_omission import measured_omission, omission_psd_m2_s3

GM, RADIUS = 4.902800118e12, 1_738_000.0


def zonal_field(degree: int, coefficient: float) -> GravityField:
    c_bar, s_bar = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
    c_bar[0, 0], c_bar[degree, 0] = 1.0, coefficient
    return GravityField("zonal", GM, RADIUS, c_bar, s_bar)


def test_the_same_field_lacks_nothing() -> None:
    field = zonal_field(12, 1e-5)
    found = measured_omission(field, field, revolutions=2)
    assert not np.any(found.psd_m2_s3)
    assert not np.any(found.rms_m_s2)


@pytest.mark.parametrize("degree", [20, 80])
def test_only_slow_waves_count(degree: int) -> None:
    """A zonal term of degree n goes as P_n(sin latitude): how much of that lies below 31 waves a circle."""
    found = measured_omission(zonal_field(degree, 1e-6), zonal_field(0, 1.0), revolutions=40)
    angle = np.arange(4_096) / 4_096 * 2.0 * np.pi
    power = np.abs(np.fft.fft(eval_legendre(degree, np.sin(angle)))) ** 2
    expected = power[1:31].sum() / power[: 4_096 // 2].sum()
    period_s = 2.0 * np.pi * np.sqrt(1_768_180.0**3 / GM)
    slow = found.psd_m2_s3[0] * 2.0 * 30.0 / period_s / found.rms_m_s2[0] ** 2
    assert slow == pytest.approx(expected, rel=0.1)


def test_density_of_a_zonal_term_against_its_closed_form() -> None:
    """Radially -(n+1) GM/r^2 (R/r)^n c sqrt(2n+1) P_n(sin lat): for n = 2 its mean square by hand."""
    c = 1e-5
    found = measured_omission(zonal_field(2, c), zonal_field(0, 1.0), revolutions=60)
    # Mean square of P2(sin) around a circle is 11/32.
    expected = (
        3.0 * GM / 1_768_180.0**2 * (RADIUS / 1_768_180.0) ** 2 * c * np.sqrt(5.0) * np.sqrt(11.0 / 32.0)
    )
    assert found.rms_m_s2[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.real_data
def test_the_table_of_the_filter_is_what_is_measured(data_path: Path) -> None:
    named = find_data(data_path).gravity
    assert named is not None
    truth = load_gravity(named)
    for degree in (20, 50, 70, 100):
        found = measured_omission(truth.truncated(150), truth.truncated(degree))
        assert found.psd_m2_s3 == pytest.approx(omission_psd_m2_s3(degree), rel=0.35), degree
