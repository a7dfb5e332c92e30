"""Gravity fields: the compiled sums against independent evaluations, the file formats, bad files."""

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
from mpmath import atan2, cos, mp, mpf, sin, sqrt
from numpy import allclose, array_equal
from numpy.linalg import norm
from pytest import approx, mark, raises

from lunar import _gravity_kernel as kernel
from lunar.errors import DataFileError, OrbitError
from lunar.gravity import GravityField, acceleration, builtin_gravity, gradient, load_gravity, packed


def kaula_field(degree, seed=1):
    """A made-up field of the Moon's roughness (Kaula's rule, 2.5e-4 / n^2), central term 1."""
    rng = np.random.default_rng(seed)
    n = np.arange(degree + 1.0)[:, None]
    size = np.where(n >= 2, 2.5e-4 / np.maximum(n, 1.0) ** 2, 0.0)
    c = np.tril(rng.normal(size=(degree + 1, degree + 1)) * size)
    s = np.tril(rng.normal(size=(degree + 1, degree + 1)) * size)
    s[:, 0] = 0.0
    c[0, 0] = 1.0
    return GravityField("made up", 4.9028e12, 1.738e6, c, s)


def exact_acceleration(field, position, degree):
    """The gradient of the potential by central differences of its definition, with 50 digits."""
    mp.dps = 50

    def potential(x, y, z):
        r = sqrt(x * x + y * y + z * z)
        u, c = z / r, sqrt(x * x + y * y) / r
        longitude = atan2(y, x)
        total, sectorial = mpf(0), mpf(1)
        for m in range(degree + 1):
            if m:
                sectorial *= c * sqrt(mpf((2 * m + 1) * (2 if m == 1 else 1)) / (2 * m))
            before, now = mpf(0), sectorial
            east, north = cos(m * longitude), sin(m * longitude)
            for n in range(m, degree + 1):
                if n > m:
                    a = sqrt(mpf((2 * n - 1) * (2 * n + 1)) / ((n - m) * (n + m)))
                    b = mpf((2 * n + 1) * (n + m - 1) * (n - m - 1)) / ((n - m) * (n + m) * (2 * n - 3))
                    before, now = now, a * u * now - sqrt(b) * before
                weight = mpf(float(field.c_bar[n, m])) * east + mpf(float(field.s_bar[n, m])) * north
                total += (mpf(field.radius_m) / r) ** n * now * weight
        return mpf(field.gm_m3_s2) / r * total

    start = np.array([mpf(float(value)) for value in position])
    steps = mpf(10) ** -12 * np.eye(3, dtype=int)
    return np.array([float((potential(*(start + d)) - potential(*(start - d))) / (2 * d.sum())) for d in steps])


def at(latitude_deg, longitude_deg, altitude_km=30.0):
    r, lat, lon = 1.7374e6 + 1e3 * altitude_km, math.radians(latitude_deg), math.radians(longitude_deg)
    return r * np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])


@mark.parametrize("place", [at(37.0, -101.0), at(-89.2, 12.0), at(1e-3, 200.0, 14.0)])
def test_degree_100_agrees_with_an_evaluation_in_fifty_digits(place):
    field = kaula_field(100)
    expected = exact_acceleration(field, place, 100)
    # 5,000 terms of a double each: a few units in the last place of the sum.
    assert norm(acceleration(field, place) - expected) <= 5e-15 * norm(expected)


@mark.parametrize("degree", [*range(13), 20, 31, 32, 33])
def test_every_degree_agrees_with_the_definition_whatever_the_number_of_blocks(degree):
    field = kaula_field(33)
    place = at(-21.0, 77.0, 100.0)
    expected = exact_acceleration(field, place, degree)
    assert norm(acceleration(field, place, degree) - expected) <= 3e-15 * norm(expected)


def test_a_sphere_pulls_as_a_point_mass_and_nothing_happens_at_the_poles():
    field = kaula_field(60)
    pole = np.array([0.0, 0.0, -1.768e6])
    nearby = acceleration(field, pole + np.array([1e-3, 0.0, 0.0]))
    # The gradient is 2e-6 1/s^2: 1 mm away the acceleration differs by 2e-9 m/s^2 and no more.
    assert allclose(acceleration(field, pole), nearby, rtol=0.0, atol=4e-9)
    assert np.all(np.isfinite(gradient(field, pole, 20)))
    place = at(12.0, 34.0, 1000.0)
    expected = -4.9028e12 * place / norm(place) ** 3
    assert allclose(acceleration(kaula_field(5), place, 0), expected, rtol=1e-15)


def test_oblateness_pulls_as_in_the_closed_form():
    """Vallado, Fundamentals of Astrodynamics (2013), equations 8-19 and following: acceleration by J2."""
    j2, radius, gm = 2.0e-4, 1.738e6, 4.9e12
    c = np.zeros((3, 3))
    c[0, 0], c[2, 0] = 1.0, -j2 / math.sqrt(5.0)
    x, y, z = at(48.0, 5.0)
    r = math.sqrt(x * x + y * y + z * z)
    common = -1.5 * j2 * gm * radius**2 / r**5
    k = 5.0 * z * z / r**2
    expected = common * np.array([x * (1 - k), y * (1 - k), z * (3 - k)])
    found = acceleration(GravityField("J2", gm, radius, c, np.zeros((3, 3))), [x, y, z])
    assert allclose(found + gm * np.array([x, y, z]) / r**3, expected, rtol=1e-11, atol=1e-16)


@mark.parametrize("degree", [0, 1, 2, 8, 40])
def test_the_gradient_is_the_change_of_the_acceleration(degree):
    field = kaula_field(40)
    place, step = at(-63.0, 140.0), 10.0
    expected = np.stack(
        [
            (acceleration(field, place + d, degree) - acceleration(field, place - d, degree)) / (2 * step)
            for d in step * np.eye(3)
        ],
        axis=-1,
    )
    found = gradient(field, place, degree)
    # Differences over 20 m: curvature of the field to degree 40 leaves 1e-13, rounding 1e-17 (1/s^2).
    assert allclose(found, expected, rtol=0.0, atol=1e-12)
    assert array_equal(found, found.T)
    assert abs(np.trace(found)) < 1e-20


def test_shapes_are_kept_for_none_one_and_many_positions():
    field = kaula_field(4)
    assert acceleration(field, np.empty((0, 3))).shape == (0, 3)
    assert acceleration(field, at(0, 0)).shape == (3,)
    places = np.array([[at(0, 0), at(10, 20)], [at(30, 40), at(50, 60)]])
    assert acceleration(field, places).shape == (2, 2, 3)
    assert array_equal(acceleration(field, places)[1, 0], acceleration(field, at(30, 40)))
    assert gradient(field, places).shape == (2, 2, 3, 3)


def test_the_other_vector_width_gives_the_same_sums(tmp_path):
    """Machines differ in the width of their vectors; here the one this machine does not use by itself."""
    text = Path(kernel.__file__).read_text(encoding="utf-8")
    marker = 'LANES = 8 if get_host_cpu_features().get("avx512f") else 4'
    assert marker in text
    other_path = tmp_path / "other_width.py"
    other_path.write_text(text.replace(marker, f"LANES = {4 if kernel.LANES == 8 else 8}"), encoding="utf-8")
    spec = importlib.util.spec_from_file_location("other_width", other_path)
    other = importlib.util.module_from_spec(spec)
    sys.modules["other_width"] = other
    try:
        spec.loader.exec_module(other)
        field = kaula_field(51)
        places = np.array([at(-77.0, 3.0), at(5.0, 250.0)])
        found = other.accelerations(other.pack(field.c_bar, field.s_bar, field.gm_m3_s2, field.radius_m), places)
    finally:
        del sys.modules["other_width"]
    assert allclose(found, acceleration(field, places), rtol=1e-14)


def test_truncation_asks_for_a_degree_the_field_has_and_the_built_in_one_says_what_it_is():
    field = kaula_field(5)
    assert field.truncated(3).degree == 3
    assert field.truncated(5) is field
    for degree in (6, -1):
        with raises(OrbitError, match=f"expected a degree from 0 to 5, found {degree}"):
            acceleration(field, at(0, 0), degree)
    assert packed(field, 3) is packed(field, 3)
    field = builtin_gravity()
    assert field.degree == 12 and "GRGM1200L" in field.name
    assert field.c_bar[0, 0] == 1.0 and np.all(field.s_bar[:, 0] == 0.0)
    # (B - A)/(M R^2) = 4 C22 over (B - A)/C = 227.7317e-6 (Williams et al. 2014, doi 10.1002/2013JE004559) must be the
    # polar moment of inertia C/(M R^2) = 0.3931 +- 0.0002 (Konopliv et al. 1998, Science 281:1476).
    c22 = field.c_bar[2, 2] * math.sqrt(5.0 / 12.0)
    assert 4.0 * c22 / 227.7317e-6 == approx(0.3931, abs=0.0002)


@mark.real_data
def test_the_built_in_field_agrees_with_other_fields(data_path):
    builtin = builtin_gravity()
    for name, tolerance in (("GRGM660PRIM_to150.gfc", 1e-8), ("LP165P.cof", 5e-7)):
        other = load_gravity(data_path / "gravity" / name, max_degree=12)
        # The GRAIL solution differs by its tides, the Lunar Prospector one by what it could see of the far side.
        assert np.abs(other.c_bar - builtin.c_bar).max() < tolerance
        assert np.abs(other.s_bar - builtin.s_bar).max() < tolerance


@mark.real_data
def test_published_files_are_read_to_their_last_line(data_path):
    grail = load_gravity(data_path / "gravity/GRGM660PRIM_to150.gfc")
    assert (grail.name, grail.degree, grail.gm_m3_s2, grail.radius_m) == (
        *("GRGM660PRIM", 150),
        *(4.902799806931690e12, 1.738e6),
    )
    prospector = load_gravity(data_path / "gravity/LP165P.cof")
    assert (prospector.name, prospector.degree, prospector.gm_m3_s2) == ("LP165P", 165, 4.902801056e12)
    # A line whose two numbers run into each other: S(2,1) is negative.
    assert (prospector.c_bar[2, 1], prospector.s_bar[2, 1]) == (-2.72203236159e-09, -7.57518292083e-10)
    assert np.all(np.tril(prospector.c_bar)[165, 160:] != 0.0)


ICGEM = """product_type gravity_field
modelname TINY
earth_gravity_constant 0.49D+13
radius 1.738E+06
max_degree 2
norm fully_normalized
end_of_head ====
gfc 0 0 1.0 0.0
gfc 2 0 -9.0D-05 0.0 1e-10 0.0
gfc 2 1 1.0e-09 2.0e-09
gfc 2 2 3.4e-05 -1.0e-10
"""
COF = """COMMENT   1
CCCCC  tiny.grv : [2x2] TINY                                              CCCCC
POTFIELD  2  2  0 4.90000000000000e+12 1.73800000000000e+06 1.00000000000000e+00
RECOEF    2  0   -9.00000000000000e-05
RECOEF    2  1    1.00000000000000e-09 2.00000000000000e-09
RECOEF    2  2    3.40000000000000e-05-1.00000000000000e-10
END
"""
SHADR = """ 1.738E+03, 4.9E+03, 0.0, 2, 2, 1, 0.0, 0.0
    2,    0,-9.0E-05, 0.0, 0.0, 0.0
    2,    1, 1.0E-09, 2.0E-09, 0.0, 0.0
    2,    2, 3.4E-05,-1.0E-10, 0.0, 0.0
"""


SHTOOLS = """# comments are left out
a field, for tests
1.7380000000000000e+06, 4.9000000000000000e+12, 2.6617073000000001e-06, 2
0, 0, 1.0, 0.0
1, 0, 0.0, 0.0
1, 1, 0.0, 0.0
2, 0, -9.0e-05, 0.0
2, 1, 1.0e-09, 2.0e-09
2, 2, 3.4e-05, -1.0e-10
"""
SHTOOLS_KM = "1.738E+03, 4.9E+03, 2.66E-06, 2, 2\n" + SHADR.partition("\n")[2]


@mark.parametrize(
    "text", [ICGEM, COF, SHADR, SHTOOLS, SHTOOLS_KM], ids=["icgem", "cof", "shadr", "pyshtools", "pyshtools in km"]
)
def test_the_formats_hold_the_same_field(text, tmp_path):
    path = tmp_path / "tiny"
    path.write_text(text)
    field = load_gravity(path)
    assert (field.degree, field.gm_m3_s2, field.radius_m) == (2, 4.9e12, 1.738e6)
    assert field.name.lower() == "tiny"
    assert field.c_bar.tolist() == [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-9e-5, 1e-9, 3.4e-5]]
    assert field.s_bar.tolist() == [[0.0] * 3, [0.0] * 3, [0.0, 2e-9, -1e-10]]


# What is replaced | by what | where | what was expected; ¶ is the end of a line. Each is tried on the format before it.
FAULTS = {
    ICGEM: """
gfc 2 2 3.4e-05 -1.0e-10¶ |  | degree 2, order 2 | all coefficients to degree 2
gfc 2 1 | gfc 1 2 | line 10 | order <= degree <= 2
gfc 2 1 | gfc 2 0 | line 10 | every coefficient once
fully_normalized | unnormalized | header, norm | fully_normalized
3.4e-05 | 3.4e-0x | line 11 | degree, order and two coefficients
3.4e-05 | nan | line 11 | finite coefficients
max_degree 2¶ |  | header, max_degree | a number
0.49D+13 | 0.49 | header | Moon's GM of 4.9028e+12 m3/s2
0.49D+13 | 3.986004415E+14 | header | radius of 1.7374e+06 m
1.738E+06 | 1.738E+03 | header | radius of 1.7374e+06 m
-9.0D-05 | -9.0 | degree 2, order 0 | normalised flattening
""",
    SHADR: """
1.738E+03 | 3.396E+03 | header | radius of 1.7374e+06 m
2, 2, 1, | 2, 2, 0, | line 1, normalisation state | fully normalised
    2,    2, 3.4E-05,-1.0E-10, 0.0, 0.0¶ |     2,    2, | line 4 | degree, order and two coefficients
""",
    SHTOOLS: """
1.738 | 3.396 | header | radius of 1.7374e+06 m
-9.0e-05 | -2.032e-04 | degree 2, order 0 | normalised flattening
2, 2, 3.4e-05, -1.0e-10¶ |  | degree 2, order 2 | all coefficients to degree 2
""",
    COF: """
END¶ |  | end of file | END
1.00000000000000e+00¶ | 0.00000000000000e+00¶ | line 3 | normalised coefficients
RECOEF    2  2 | RECOEF    3  2 | line 6 | order <= degree <= 2
""",
    "hello\n": """
hello | hullo |  | an ICGEM, GMAT .cof, PDS SHADR or pyshtools gravity field
hello¶ |  |  | an ICGEM, GMAT .cof, PDS SHADR or pyshtools gravity field
""",
}


@mark.parametrize("text, row", [(text, row) for text in FAULTS for row in FAULTS[text].strip("\n").splitlines()])
def test_a_bad_file_is_named_with_the_place_and_what_was_expected(text, row, tmp_path):
    old, new, where, expected = row.replace("¶", "\n").split(" | ")
    assert old in text
    path = tmp_path / "bad.field"
    path.write_text(text.replace(old, new))
    with raises(DataFileError) as caught:
        load_gravity(path)
    assert where in caught.value.where and expected in caught.value.expected
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with raises(DataFileError, match=r"nowhere\.gfc: expected a gravity field file"):
        load_gravity(tmp_path / "nowhere.gfc")
