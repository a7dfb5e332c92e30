"""Training targets of one image: heatmap, geometry and where no loss is taken.

Three tiers of craters: LABEL pulls the heatmap up with a weight that grows with depth/diameter; IGNORE (catalogued, but
too shallow, too small, cut, or in shadow) takes the loss away around its centre; what no catalogue lists is background.
All coordinates are pixels of the image as given to the network; pixel centres are integers.
"""

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from payload_emulator.flight.vision.detector import REFERENCE_DIAMETER_PX, STRIDE_PX

SIGMA_OF_RADIUS = 0.22  # heat falls to 0.6 at this share of the radius
MIN_SIGMA_CELLS = 0.9  # less would leave a small crater a single warm cell
IGNORE_OF_RADIUS = 0.7  # the centre may be found this far off on a rim too worn to see
MIN_IGNORE_CELLS = 1.5


class Tier(enum.IntEnum):
    """Part of a catalogued crater in the loss."""

    IGNORE = 0
    LABEL = 1


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Arrays on the cells of one image (h, w).

    heat (c, h, w): 1 at centres, Gaussian around. weight (c, h, w): of the positive term at centres, else 0.
    negative (c, h, w): weight of the negative term. geometry (4, h, w): offsets in cells, ln diameter, ten times
    depth/diameter; regressed (h, w): weight of the geometry loss, non-zero on the 3 x 3 cells around centres.
    """

    heat: NDArray[np.float32]
    weight: NDArray[np.float32]
    negative: NDArray[np.float32]
    geometry: NDArray[np.float32]
    regressed: NDArray[np.float32]


def make_targets(
    height_px: int,
    width_px: int,
    u_px: FloatArray,
    v_px: FloatArray,
    diameter_px: FloatArray,
    tier: NDArray[np.int8],
    weight: FloatArray,
    size_class: NDArray[np.int8] | None = None,
    depth_ratio: FloatArray | None = None,
    stride_px: int = STRIDE_PX,
) -> Targets:
    """Targets of craters (n,) in an image; `size_class` given: three class heatmaps follow the common one.

    `depth_ratio` (n,) is depth/diameter; None leaves that target zero. `stride_px` is the size of a cell.
    """
    from payload_emulator.training.data._target_kernel import paint

    rows, columns = height_px // stride_px, width_px // stride_px
    channels = 1 if size_class is None else 4
    targets = Targets(
        np.zeros((channels, rows, columns), np.float32),
        np.zeros((channels, rows, columns), np.float32),
        np.ones((channels, rows, columns), np.float32),
        np.zeros((4, rows, columns), np.float32),
        np.zeros((rows, columns), np.float32),
    )
    centre_of_cell = (stride_px - 1) / 2.0
    tenfold_depth = 10.0 * np.asarray(np.zeros(np.shape(u_px)) if depth_ratio is None else depth_ratio, float)
    classes = np.full(np.shape(u_px), -1, np.int8) if size_class is None else np.asarray(size_class, np.int8)
    paint(
        (np.asarray(u_px, np.float64) - centre_of_cell) / stride_px,
        (np.asarray(v_px, np.float64) - centre_of_cell) / stride_px,
        np.asarray(diameter_px, np.float64) / (2.0 * stride_px),
        np.asarray(tier, np.int8) == Tier.LABEL,
        np.asarray(weight, np.float64),
        classes,
        np.log(np.asarray(diameter_px, np.float64) / REFERENCE_DIAMETER_PX),
        tenfold_depth,
        SIGMA_OF_RADIUS,
        MIN_SIGMA_CELLS,
        IGNORE_OF_RADIUS,
        MIN_IGNORE_CELLS,
        targets.heat,
        targets.weight,
        targets.negative,
        targets.geometry,
        targets.regressed,
    )
    return targets
