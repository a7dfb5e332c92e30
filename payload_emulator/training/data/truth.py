"""Catalogued craters in view of a frame: what detections are scored against."""

from dataclasses import dataclass

from lunar.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Catalogued craters in view of one frame, arrays (n,); `block` names the independent piece of ground."""

    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    diameter_m: FloatArray
    depth_ratio: FloatArray
    ids: IntArray
    width_px: int
    height_px: int
    sun_azimuth_image_rad: float
    block: int
