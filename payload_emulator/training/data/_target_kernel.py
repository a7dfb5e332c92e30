"""Compiled loop of `targets.make_targets`; it lets other threads run, which a loop of small numpy calls does not."""

# ruff: noqa: RUF046 (compiled, ceil and floor give floats)
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.compiled import njit


@njit(nogil=True)
def paint(
    x: NDArray[Any],
    y: NDArray[Any],
    radius: NDArray[Any],
    labelled: NDArray[Any],
    weight: NDArray[Any],
    size_class: NDArray[Any],
    log_diameter: NDArray[Any],
    tenfold_depth: NDArray[Any],
    sigma_of_radius: float,
    min_sigma: float,
    ignore_of_radius: float,
    min_ignore: float,
    heat: NDArray[Any],
    positive: NDArray[Any],
    negative: NDArray[Any],
    geometry: NDArray[Any],
    regressed: NDArray[Any],
) -> None:
    """Paint craters (n,) given in cells into the target maps; see `targets.Targets` for what each map holds."""
    channels, rows, columns = heat.shape
    strength = np.zeros((rows, columns))
    for i in range(x.size):
        sigma = max(sigma_of_radius * radius[i], min_sigma)
        reach = 3.0 * sigma if labelled[i] else max(ignore_of_radius * radius[i], min_ignore)
        j0, j1 = max(int(math.ceil(x[i] - reach)), 0), min(int(math.floor(x[i] + reach)), columns - 1)
        i0, i1 = max(int(math.ceil(y[i] - reach)), 0), min(int(math.floor(y[i] + reach)), rows - 1)
        own = 1 + size_class[i] if channels > 1 and 0 <= size_class[i] <= 2 else 0
        for r in range(i0, i1 + 1):
            for c in range(j0, j1 + 1):
                square = (c - x[i]) ** 2 + (r - y[i]) ** 2
                if labelled[i]:
                    bump = np.float32(math.exp(-0.5 * square / (sigma * sigma)))
                    heat[0, r, c] = max(heat[0, r, c], bump)
                    if own > 0:
                        heat[own, r, c] = max(heat[own, r, c], bump)
                elif square <= reach * reach:
                    for k in range(channels):
                        negative[k, r, c] = 0.0
        row, column = int(round(y[i])), int(round(x[i]))
        if not labelled[i] or row < 0 or row >= rows or column < 0 or column >= columns:
            continue
        heat[0, row, column] = 1.0
        positive[0, row, column] = max(positive[0, row, column], np.float32(weight[i]))
        if own > 0:
            heat[own, row, column] = 1.0
            positive[own, row, column] = max(positive[own, row, column], np.float32(weight[i]))
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                closeness = math.exp(-((c - x[i]) ** 2) - (r - y[i]) ** 2)
                if closeness > strength[r, c]:
                    strength[r, c] = closeness
                    geometry[0, r, c] = x[i] - c
                    geometry[1, r, c] = y[i] - r
                    geometry[2, r, c] = log_diameter[i]
                    geometry[3, r, c] = tenfold_depth[i]
                    regressed[r, c] = weight[i] * (1.0 if r == row and c == column else 0.3)
