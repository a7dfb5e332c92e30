"""From radiance to the RGB picture that the camera hands over."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from lunar.arrays import OctetArray
from payload_emulator.errors import PayloadError

Image = npt.NDArray[np.float32]
Picture = OctetArray | npt.NDArray[np.uint16]

COLOUR = (1.06, 1.0, 0.90)
"""Red, green and blue response to sunlit regolith after white balance on the Sun: the Moon is slightly red."""

FULL_RADIANCE_FLOOR = 1.0e-4
"""Auto exposure gives up below this: the night side stays dark."""

TRANSFER_STEPS = 16_384

_BOUNDS = (
    ("exposure", 0.0, math.inf),
    ("gain", 1.0e-3, 1.0e3),
    ("exposure_target", 1.0e-3, 1.0e3),
    ("exposure_percentile", 0.0, 100.0),
    ("psf_sigma_px", 0.0, 50.0),
    ("vignetting", 0.0, 1.0),
    ("full_well_e", 1.0, math.inf),
    ("read_noise_e", 0.0, math.inf),
    ("dark_e", 0.0, math.inf),
    ("gain_mismatch", 0.0, 1.0),
    ("gamma", 0.05, 20.0),
    ("offset", 0.0, 1.0),
    ("hot_pixels", 0.0, 1.0),
    ("smear", 0.0, 1.0),
    ("stray", 0.0, 1.0),
)


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A colour camera; the defaults are a decent space-grade CMOS behind a fast wide-angle lens.

    Attributes
    ----------
    exposure
        Share of the full well per unit of radiance; 0 sets it frame by frame from the picture.
    gain
        Of the amplifier: full scale is reached at this part of the full well, so less light makes a noisier picture.
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
        8, 12 or 16 per channel.
    """

    exposure: float = 0.0
    gain: float = 1.0
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
        for name, low, high in _BOUNDS:
            value = getattr(self, name)
            if not low <= value <= high:
                raise PayloadError(f"sensor: expected {name} from {low:g} to {high:g}, found {value:g}")


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


def take_picture(radiance: Image, sensor: SensorModel, rng: np.random.Generator) -> Picture:
    """RGB picture (H, W, 3) of a radiance (H, W) in the sensor's steps: 8 bits of 8, else 16 with full scale 65535."""
    from payload_emulator.sim.render._sensor_kernel import read_out

    signal = _blurred(np.asarray(radiance, dtype=np.float32), sensor.psf_sigma_px)
    height, width = signal.shape
    signal *= np.float32(sensor.exposure * sensor.gain or auto_exposure(radiance, sensor))
    if sensor.vignetting:
        v = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
        u = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None, :]
        signal *= np.float32(1.0) - np.float32(0.5 * sensor.vignetting) * (u * u + v * v)
    if sensor.smear:
        signal += np.float32(sensor.smear) * signal.mean(axis=0)
    if sensor.stray:
        signal += np.float32(sensor.stray) * signal.mean()
    if sensor.gain_mismatch:
        signal *= _fixed_pattern(height, width, sensor.gain_mismatch)
    transfer = _transfer(sensor.gamma, sensor.bits)
    out = np.empty((height, width, 3), transfer.dtype)
    noise = rng.standard_normal((height, width, 3), dtype=np.float32)
    read_out(
        signal,
        noise,
        np.array(COLOUR, np.float32),
        sensor.full_well_e / sensor.gain,
        sensor.dark_e,
        sensor.read_noise_e,
        sensor.offset,
        transfer,
        out,
    )
    hot = round(sensor.hot_pixels * height * width)
    fixed = np.random.Generator(np.random.PCG64([width, height, hot]))
    out[fixed.integers(0, height, hot), fixed.integers(0, width, hot)] = transfer[-1]
    return out


@lru_cache(maxsize=4)
def _fixed_pattern(height: int, width: int, rms: float) -> Image:
    """Response of every pixel, the same in every frame: drawn from the parameters, not from the frame's generator."""
    fixed = np.random.Generator(np.random.PCG64([height, width, round(rms * 1.0e6)]))
    return np.float32(1.0) + np.float32(rms) * fixed.standard_normal((height, width), dtype=np.float32)


@lru_cache(maxsize=4)
def _transfer(gamma: float, bits: int) -> Picture:
    """Output for each of 16384 steps of input from 0 to full scale."""
    share = np.linspace(0.0, 1.0, TRANSFER_STEPS) ** gamma
    if bits == 8:
        return np.rint(255.0 * share).astype(np.uint8)
    levels = (1 << bits) - 1
    return np.rint(np.rint(levels * share) * (65535.0 / levels)).astype(np.uint16)


def _blurred(values: Image, sigma: float) -> Image:
    """Gaussian blur; the picture's edge repeats outward."""
    if sigma <= 0.0:
        return values.copy()
    import cv2

    reach = max(1, math.ceil(3.0 * sigma))
    # Integrals over pixels, not samples: right for sigmas below one pixel too.
    edges = np.array([math.erf((n - 0.5) / (sigma * math.sqrt(2.0))) for n in range(-reach, reach + 2)])
    weights = np.diff(edges) / (edges[-1] - edges[0])
    return np.asarray(cv2.sepFilter2D(values, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_REPLICATE))
