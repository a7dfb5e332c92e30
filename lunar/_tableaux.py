"""Coefficients of the explicit Runge-Kutta methods, as plain arrays for the compiled integrator.

References
----------
DOP853: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (2nd ed. 1993), section II.10, 8(5,3).
RKN8(6): Dormand, El-Mikkawy, Prince, IMA J. Numer. Anal. 7:235 (1987), RKN8(6)9FM, for accelerations that do not depend
on velocity; 9 stages of which the last is the first of the next step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tableau:
    """One method of ``stages`` stages.

    ``c`` are the nodes, ``a`` the lower triangle of stages, ``b`` (2, stages) the weights for position and for
    velocity, ``error`` (2, stages) those of the error estimate.  A Nystrom method forms positions from accelerations
    alone, with h^2; the others form both from rates, with h, so that their two rows are equal.  DOP853 has a second
    estimate.  ``error_order`` is the power of h in the estimate, ``rtol`` and ``max_step_s`` what suits a low orbit.
    """

    name: str
    nystrom: bool
    c: FloatArray
    a: FloatArray
    b: FloatArray
    error: FloatArray
    second_error: FloatArray
    error_order: int
    rtol: float
    max_step_s: float


def _lower_triangle(*rows: Sequence[float]) -> FloatArray:
    matrix = np.zeros((len(rows) + 1, len(rows) + 1))
    for number, row in enumerate(rows, start=1):
        matrix[number, : len(row)] = row
    return matrix


_DOP853_A = _lower_triangle(
    (0.05260015195876773,),
    (
        0.0197250569845379,
        0.0591751709536137,
    ),
    (
        0.02958758547680685,
        0.0,
        0.08876275643042054,
    ),
    (
        0.2413651341592667,
        0.0,
        -0.8845494793282861,
        0.924834003261792,
    ),
    (
        0.037037037037037035,
        0.0,
        0.0,
        0.17082860872947386,
        0.12546768756682242,
    ),
    (
        0.037109375,
        0.0,
        0.0,
        0.17025221101954405,
        0.06021653898045596,
        -0.017578125,
    ),
    (
        0.03709200011850479,
        0.0,
        0.0,
        0.17038392571223998,
        0.10726203044637328,
        -0.015319437748624402,
        0.008273789163814023,
    ),
    (
        0.6241109587160757,
        0.0,
        0.0,
        -3.3608926294469414,
        -0.868219346841726,
        27.59209969944671,
        20.154067550477894,
        -43.48988418106996,
    ),
    (
        0.47766253643826434,
        0.0,
        0.0,
        -2.4881146199716677,
        -0.590290826836843,
        21.230051448181193,
        15.279233632882423,
        -33.28821096898486,
        -0.020331201708508627,
    ),
    (
        -0.9371424300859873,
        0.0,
        0.0,
        5.186372428844064,
        1.0914373489967295,
        -8.149787010746927,
        -18.52006565999696,
        22.739487099350505,
        2.4936055526796523,
        -3.0467644718982196,
    ),
    (
        2.273310147516538,
        0.0,
        0.0,
        -10.53449546673725,
        -2.0008720582248625,
        -17.9589318631188,
        27.94888452941996,
        -2.8589982771350235,
        -8.87285693353063,
        12.360567175794303,
        0.6433927460157636,
    ),
)
_DOP853_C = np.array(
    [
        0.0,
        0.05260015195876773,
        0.0789002279381516,
        0.1183503419072274,
        0.2816496580927726,
        0.3333333333333333,
        0.25,
        0.3076923076923077,
        0.6512820512820513,
        0.6,
        0.8571428571428571,
        1.0,
    ]
)
_DOP853_B = np.array(
    [
        0.054293734116568765,
        0.0,
        0.0,
        0.0,
        0.0,
        4.450312892752409,
        1.8915178993145003,
        -5.801203960010585,
        0.3111643669578199,
        -0.1521609496625161,
        0.20136540080403034,
        0.04471061572777259,
    ]
)
_DOP853_ERROR_5 = np.array(
    [
        0.01312004499419488,
        0.0,
        0.0,
        0.0,
        0.0,
        -1.2251564463762044,
        -0.4957589496572502,
        1.6643771824549864,
        -0.35032884874997366,
        0.3341791187130175,
        0.08192320648511571,
        -0.022355307863886294,
    ]
)
_DOP853_ERROR_3 = np.array(
    [
        -0.18980075407240762,
        0.0,
        0.0,
        0.0,
        0.0,
        4.450312892752409,
        1.8915178993145003,
        -5.801203960010585,
        -0.4226823213237919,
        -0.1521609496625161,
        0.20136540080403034,
        0.02265179219836082,
    ]
)

_RKN86_C = np.array([0, 1 / 20, 1 / 10, 3 / 10, 1 / 2, 7 / 10, 9 / 10, 1, 1])
_RKN86_A = _lower_triangle(
    (1 / 800,),
    (1 / 600, 1 / 300),
    (9 / 200, -9 / 100, 9 / 100),
    (-66701 / 197352, 28325 / 32892, -2665 / 5482, 2170 / 24669),
    (227015747 / 304251000, -54897451 / 30425100, 12942349 / 10141700, -9499 / 304251, 539 / 9250),
    (
        -1131891597 / 901789000,
        41964921 / 12882700,
        -6663147 / 3220675,
        270954 / 644135,
        -108 / 5875,
        114 / 1645,
    ),
    (
        *(13836959 / 3667458, -17731450 / 1833729, 1063919505 / 156478208, -33213845 / 39119552),
        *(13335 / 28544, -705 / 14272, 1645 / 57088),
    ),
    (223 / 7938, 0, 1175 / 8064, 925 / 6048, 41 / 448, 925 / 14112, 1175 / 72576),
)
_RKN86_B = np.array(
    [
        [223 / 7938, 0, 1175 / 8064, 925 / 6048, 41 / 448, 925 / 14112, 1175 / 72576, 0, 0],
        [
            *(223 / 7938, 0, 5875 / 36288, 4625 / 21168, 41 / 224, 4625 / 21168, 5875 / 36288, 223 / 7938),
            0,
        ],
    ]
)
_RKN86_LOWER = np.array(
    [
        [
            *(7987313 / 109941300, 0, 1610737 / 44674560, 10023263 / 33505920, -497221 / 12409600),
            *(10023263 / 78180480, 1610737 / 402071040, 0, 0),
        ],
        [
            *(7987313 / 109941300, 0, 1610737 / 40207104, 10023263 / 23454144, -497221 / 6204800),
            *(10023263 / 23454144, 1610737 / 40207104, -4251941 / 54970650, 3 / 20),
        ],
    ]
)

_TWICE = np.ones((2, 1))
RKN86 = Tableau(
    "rkn86", True, _RKN86_C, _RKN86_A, _RKN86_B, _RKN86_B - _RKN86_LOWER, np.zeros(9), 7, 1e-9, 30.0
)
DOP853 = Tableau(
    *("dop853", False, _DOP853_C, _DOP853_A, _TWICE * _DOP853_B),
    *(_TWICE * _DOP853_ERROR_5, _DOP853_ERROR_3, 8, 1e-10, 30.0),
)
TABLEAUX = {tableau.name: tableau for tableau in (RKN86, DOP853)}
