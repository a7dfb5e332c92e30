"""From radiance to the RGB picture that the camera hands over."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from payload_emulator.errors import PayloadError

Image = npt.NDArray[np.float32]

COLOUR = (1.06, 1.0, 0.90)
"""Red, green and blue response to sunlit regolith after white balance on the Sun: the Moon is slightly red."""

FULL_RADIANCE_FLOOR = 1.0e-4
"""Auto exposure gives up below this: the night side stays dark."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A colour camera; the defaults are a decent space-grade CMOS behind a fast wide-angle lens.

    Attributes
    ----------
    exposure
        Full-scale signal per unit of radiance; 0 sets it frame by frame from the picture.
    exposure_target, exposure_percentile
        Auto exposure brings this percentile of the sunlit pixels to this share of full scale.
    psf_sigma_px
        Blur of optics and pixel together.
    vignetting
        Loss of light at the corners; what remains after flat-fielding.
    full_well_e, read_noise_e, dark_e
        Electrons at full scale, rms read noise, mean dark signal.
    gain_mismatch
        Rms of the fixed, seeded response differences between pixels.
    gamma
        Output is the share of full scale to this power (1 is linear).
    offset
        Black level as a share of full scale.
    hot_pixels
        Share of pixels that always read full scale.
    smear
        Share of a column's mean signal added along it (frame transfer without a shutter).
    stray
        Share of the frame's mean signal spread evenly (stray light).
    bits
        8 or 16 per channel out (12-bit data are carried in 16).
    """

    exposure: float = 0.0
    exposure_target: float = 0.85
    exposure_percentile: float = 99.0
    psf_sigma_px: float = 0.55
    vignetting: float = 0.12
    full_well_e: float = 20_000.0
    read_noise_e: float = 15.0
    dark_e: float = 4.0
    gain_mismatch: float = 0.004
    gamma: float = 1.0
    offset: float = 0.01
    hot_pixels: float = 2.0e-5
    smear: float = 0.0
    stray: float = 0.002
    bits: int = 8

    def __post_init__(self) -> None:
        if self.bits not in (8, 12, 16):
            raise PayloadError(f"sensor: expected 8, 12 or 16 bits, found {self.bits}")


def expose(radiance: Image, sensor: SensorModel, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """RGB picture (H, W, 3) of a radiance (H, W), 8 bit; see `expose_deep` for more."""
    if sensor.bits != 8:
        raise PayloadError(f"sensor: expected 8 bits for an 8-bit picture, found {sensor.bits}")
    return np.asarray(_read_out(radiance, sensor, rng, 255), dtype=np.uint8)


def expose_deep(radiance: Image, sensor: SensorModel, rng: np.random.Generator) -> npt.NDArray[np.uint16]:
    """RGB picture (H, W, 3) with the sensor's own depth in 16 bits; 12-bit data fill the upper bits."""
    levels = (1 << sensor.bits) - 1
    counts = _read_out(radiance, sensor, rng, levels).astype(np.uint32)
    return np.asarray(counts * (65535 // levels) if sensor.bits == 8 else counts << (16 - sensor.bits), dtype=np.uint16)


def random_sensor(rng: np.random.Generator) -> SensorModel:
    """A sensor and exposure drawn over the span that a detector should be indifferent to."""
    return SensorModel(
        exposure_target=float(rng.uniform(0.45, 1.25)),
        exposure_percentile=float(rng.uniform(97.0, 99.7)),
        psf_sigma_px=float(rng.uniform(0.3, 1.1)),
        vignetting=float(rng.uniform(0.0, 0.45)),
        full_well_e=float(np.exp(rng.uniform(math.log(4_000.0), math.log(40_000.0)))),
        read_noise_e=float(np.exp(rng.uniform(math.log(3.0), math.log(60.0)))),
        gain_mismatch=float(rng.uniform(0.0, 0.012)),
        gamma=float(np.exp(rng.uniform(math.log(0.45), math.log(1.15)))),
        offset=float(rng.uniform(0.0, 0.04)),
        hot_pixels=float(rng.choice([0.0, 2.0e-5, 2.0e-4])),
        smear=float(rng.choice([0.0, 0.0, 0.02])),
        stray=float(rng.uniform(0.0, 0.02)),
    )


def auto_exposure(radiance: Image, sensor: SensorModel) -> float:
    """Full-scale signal per unit of radiance that the automatic exposure would choose."""
    sunlit = radiance[::2, ::2]
    sunlit = sunlit[sunlit > FULL_RADIANCE_FLOOR]
    if sunlit.size < 50:
        return 1.0
    return sensor.exposure_target / float(np.percentile(sunlit, sensor.exposure_percentile))


def _read_out(radiance: Image, sensor: SensorModel, rng: np.random.Generator, levels: int) -> npt.NDArray[np.float32]:
    signal = _blurred(np.asarray(radiance, dtype=np.float32), sensor.psf_sigma_px)
    height, width = signal.shape
    signal *= np.float32(sensor.exposure or auto_exposure(radiance, sensor))
    if sensor.vignetting:
        v = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
        u = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None, :]
        signal *= 1.0 - np.float32(0.5 * sensor.vignetting) * (u * u + v * v)
    if sensor.smear:
        signal += np.float32(sensor.smear) * signal.mean(axis=0)
    if sensor.stray:
        signal += np.float32(sensor.stray) * signal.mean()
    if sensor.gain_mismatch:
        # One picture of fixed pattern per sensor: drawn from the parameters, not from the frame's generator.
        fixed = np.random.Generator(np.random.PCG64([height, width, round(sensor.gain_mismatch * 1.0e6)]))
        signal *= 1.0 + np.float32(sensor.gain_mismatch) * fixed.standard_normal(signal.shape, dtype=np.float32)
    electrons = np.minimum(signal, 1.0) * np.float32(sensor.full_well_e) + np.float32(sensor.dark_e)
    inverse = np.float32(1.0 / sensor.full_well_e)
    noise = rng.standard_normal((height, width, 3), dtype=np.float32)
    deviation = np.sqrt(electrons + np.float32(sensor.read_noise_e**2))
    out = np.empty((height, width, 3), np.float32)
    for channel, response in enumerate(COLOUR):
        out[..., channel] = (np.float32(response) * electrons + deviation * noise[..., channel]) * inverse
    out += np.float32(sensor.offset)
    np.clip(out, 0.0, 1.0, out=out)
    if sensor.gamma != 1.0:
        np.power(out, np.float32(sensor.gamma), out=out)
    hot = round(sensor.hot_pixels * height * width)
    if hot:
        fixed = np.random.Generator(np.random.PCG64([width, height, hot]))
        out[fixed.integers(0, height, hot), fixed.integers(0, width, hot)] = 1.0
    out *= np.float32(levels)
    return np.asarray(np.rint(out, out=out))


def _blurred(values: Image, sigma: float) -> Image:
    """Gaussian blur; the picture's edge repeats outward."""
    if sigma <= 0.0:
        return values.copy()
    reach = max(1, math.ceil(3.0 * sigma))
    offsets = np.arange(-reach, reach + 1)
    # Integrals over pixels, not samples: right for sigmas below one pixel too.
    edges = np.array([math.erf((offset - 0.5) / (sigma * math.sqrt(2.0))) for offset in range(-reach, reach + 2)])
    weights = np.diff(edges).astype(np.float32)
    weights /= weights.sum()
    assert weights.size == offsets.size
    rows = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    out = np.zeros_like(values)
    for k, weight in enumerate(weights):
        out += weight * rows[k : k + values.shape[0]]
    columns = np.pad(out, ((0, 0), (reach, reach)), mode="edge")
    out = np.zeros_like(values)
    for k, weight in enumerate(weights):
        out += weight * columns[:, k : k + values.shape[1]]
    return out
