"""What the network should say about one image: heatmap, geometry and where no loss is taken.

Three tiers of craters: LABEL pulls the heatmap up with a weight that grows with depth/diameter; IGNORE (catalogued, but
too shallow, too small, cut, or in shadow) takes the loss away around its centre; what no catalogue lists is background.
All coordinates are pixels of the image as given to the network; pixel centres are integers.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from payload_emulator.flight.detector import REFERENCE_DIAMETER_PX, STRIDE_PX

_SIGMA_OF_RADIUS = 0.22  # heat falls to 0.6 at this share of the radius
_MIN_SIGMA_CELLS = 0.9  # less would leave a small crater a single warm cell
_IGNORE_OF_RADIUS = 0.7  # the centre may be found this far off on a rim too worn to see
_MIN_IGNORE_CELLS = 1.5


class Tier(enum.IntEnum):
    """Part of a catalogued crater in the loss."""

    IGNORE = 0
    LABEL = 1


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Arrays on the cells of one image (h, w).

    heat (c, h, w): 1 at centres, Gaussian around. weight (c, h, w): of the positive term at centres, else 0.
    negative (c, h, w): weight of the negative term. geometry (3, h, w): offsets in cells, ln diameter; regressed (h, w):
    weight of the geometry loss, non-zero on the 3 x 3 cells around centres.
    """

    heat: NDArray[np.float32]
    weight: NDArray[np.float32]
    negative: NDArray[np.float32]
    geometry: NDArray[np.float32]
    regressed: NDArray[np.float32]


def make_targets(
    height_px: int,
    width_px: int,
    u_px: NDArray[np.float64],
    v_px: NDArray[np.float64],
    diameter_px: NDArray[np.float64],
    tier: NDArray[np.int8],
    weight: NDArray[np.float64],
    size_class: NDArray[np.int8] | None = None,
) -> Targets:
    """Targets of craters (n,) in an image; `size_class` given: three class heatmaps follow the common one."""
    rows, columns = height_px // STRIDE_PX, width_px // STRIDE_PX
    channels = 1 if size_class is None else 4
    heat = np.zeros((channels, rows, columns), np.float32)
    positive = np.zeros((channels, rows, columns), np.float32)
    negative = np.ones((channels, rows, columns), np.float32)
    geometry = np.zeros((3, rows, columns), np.float32)
    regressed = np.zeros((rows, columns), np.float32)
    strength = np.zeros((rows, columns), np.float32)  # heat of the crater whose geometry a cell holds
    centre_of_cell = (STRIDE_PX - 1) / 2.0
    x = (np.asarray(u_px) - centre_of_cell) / STRIDE_PX
    y = (np.asarray(v_px) - centre_of_cell) / STRIDE_PX
    radius = np.asarray(diameter_px) / (2.0 * STRIDE_PX)

    for i in range(x.shape[0]):
        labelled = tier[i] == Tier.LABEL
        sigma = max(_SIGMA_OF_RADIUS * radius[i], _MIN_SIGMA_CELLS)
        reach = 3.0 * sigma if labelled else max(_IGNORE_OF_RADIUS * radius[i], _MIN_IGNORE_CELLS)
        j0, j1 = max(int(np.ceil(x[i] - reach)), 0), min(int(np.floor(x[i] + reach)), columns - 1)
        i0, i1 = max(int(np.ceil(y[i] - reach)), 0), min(int(np.floor(y[i] + reach)), rows - 1)
        if j0 > j1 or i0 > i1:
            continue
        dx = np.arange(j0, j1 + 1) - x[i]
        dy = np.arange(i0, i1 + 1) - y[i]
        square = dx[None, :] ** 2 + dy[:, None] ** 2
        window = (slice(i0, i1 + 1), slice(j0, j1 + 1))
        if not labelled:
            negative[(slice(None), *window)][:, square <= reach * reach] = 0.0
            continue
        bump = np.exp(square / (-2.0 * sigma * sigma)).astype(np.float32)
        column, row = int(np.rint(x[i])), int(np.rint(y[i]))
        own = [0]
        if size_class is not None and 0 <= size_class[i] <= 2:
            own.append(1 + int(size_class[i]))
        for channel in own:
            np.maximum(heat[channel][window], bump, out=heat[channel][window])
        if not (0 <= row < rows and 0 <= column < columns):
            continue
        for channel in own:
            heat[channel, row, column] = 1.0
            positive[channel, row, column] = max(positive[channel, row, column], weight[i])
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                closeness = float(np.exp(-((c - x[i]) ** 2 + (r - y[i]) ** 2)))
                if closeness > strength[r, c]:
                    strength[r, c] = closeness
                    geometry[0, r, c] = x[i] - c
                    geometry[1, r, c] = y[i] - r
                    geometry[2, r, c] = np.log(diameter_px[i] / REFERENCE_DIAMETER_PX)
                    regressed[r, c] = weight[i] * (1.0 if (r, c) == (row, column) else 0.3)
    return Targets(heat, positive, negative, geometry, regressed)
