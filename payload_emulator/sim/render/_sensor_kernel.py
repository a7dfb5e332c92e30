"""Compiled loop of the sensor: electrons, noise, levels."""

import math

import numpy as np
from numpy.typing import NDArray

from kernels.compiled import FAST, njit
from lunar.arrays import Float32Array


@njit(ahead="f4[:, ::1], f4[:, :, ::1], f4[::1], *4 * [f8], u1[::1], u1[:, :, ::1]", **FAST)
def read_out(
    signal: Float32Array,
    noise: Float32Array,
    colour: Float32Array,
    full_well: float,
    dark: float,
    read_noise: float,
    offset: float,
    transfer: NDArray[np.unsignedinteger],
    out: NDArray[np.unsignedinteger],
) -> None:
    """Fill ``out`` (H, W, 3) with levels of ``transfer``: a signal in shares of full scale plus shot and read noise."""
    last = np.float32(transfer.size - 1)
    well = np.float32(full_well)
    ground = np.float32(dark)
    floor = np.float32(read_noise * read_noise)
    scale = last / well
    black = np.float32(offset) * last + np.float32(0.5)
    zero = np.float32(0.0)
    for i in range(signal.shape[0]):
        for j in range(signal.shape[1]):
            electrons = min(max(signal[i, j], zero), np.float32(1.0)) * well + ground
            deviation = np.float32(math.sqrt(electrons + floor))
            for k in range(3):
                level = (colour[k] * electrons + deviation * noise[i, j, k]) * scale + black
                out[i, j, k] = transfer[np.uint64(min(max(level, zero), last))]
