"""Coefficients of the explicit Runge-Kutta methods, as plain arrays for the compiled integrator.

References
----------
DOP853: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (2nd ed. 1993), section II.10, 8(5,3), as
SciPy carries it.
RKN8(6): Dormand, El-Mikkawy, Prince, IMA J. Numer. Anal. 7:235 (1987), RKN8(6)9FM, for accelerations that do not depend
on velocity; 9 stages of which the last is the first of the next step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import DOP853 as Scipy

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
# SciPy's estimates have one more column, zero, for the stage that begins the next step.
DOP853 = Tableau(
    *("dop853", False, Scipy.C, Scipy.A, _TWICE * Scipy.B),
    *(_TWICE * Scipy.E5[:-1], Scipy.E3[:-1], 8, 1e-10, 30.0),
)
TABLEAUX = {tableau.name: tableau for tableau in (RKN86, DOP853)}
