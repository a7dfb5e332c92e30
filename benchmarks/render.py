"""Renderers: python -m benchmarks render, on the procedural Moon.

Milliseconds of processor time of a 512 x 512 frame with shadows at three altitudes, the smallest of nine, and of the
ray march over the same frame. Pictures of both are compared over random poses of 14 to 50 km, Sun of 3 to 60 degrees,
any azimuth and yaw, tilt to 5 degrees.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks._rows import Row, best_s
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf, pointed_camera_from_mcmf
from lunar.datafolder import find_data
from lunar.errors import LunarError
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import PayloadError
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.renderer import Rendering
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.tiles import Terrain

REPEATS = 9
CAMERA = PinholeCamera()
SHADOW = 0.5
"""Ground that sees less of the Sun's disc is in shadow."""

FULLY_LIT = 0.95


POSES, EVERY = 6, 16


@dataclasses.dataclass(frozen=True, slots=True)
class Agreement:
    """Of one renderer with another.

    Attributes
    ----------
    shadow_iou
        Pixels dark in both over pixels dark in either; NaN without any.
    radiance_rmse
        Root mean square difference where both see the whole Sun, as a share of the reference's mean there; each view
        against its own mean.
    correlation
        Of radiance over all pixels on the Moon, the mean over views.
    views, dark_pixels
        What the figures come from; dark in either.
    """

    shadow_iou: float
    radiance_rmse: float
    correlation: float
    views: int
    dark_pixels: int


def _frame(terrain: Terrain, number: int, km: float) -> tuple[float, float, float]:
    """Return the milliseconds of processor time of a frame, of the first one of its place, and of the ray march."""
    place = math.radians(10.0), math.radians(20.0)
    position = mcmf_from_spherical(*place, 1000.0 * km)
    rng = np.random.default_rng((1, number))
    light = math.radians(rng.uniform(5.0, 15.0)), math.radians(rng.uniform(-45.0, 45.0))
    view = (terrain, CAMERA, position, nadir_camera_from_mcmf(position), sun_direction_mcmf(*light, *place))
    first_ms = 1e3 * best_s(lambda: renderer.render(*view), 0)
    render_ms = 1e3 * best_s(lambda: renderer.render(*view), REPEATS)
    raymarch.render(*view, every=64)
    return render_ms, first_ms, 64e3 * best_s(lambda: raymarch.render(*view, every=8), 0)


def _compared(terrain: Terrain) -> tuple[Agreement, float]:
    """Return the agreement of the fast renderer with the ray march over random poses, and the difference of ranges."""
    rng = np.random.default_rng(20)
    fast, marched = [], []
    for _ in range(4 * POSES):
        latitude, longitude = map(math.radians, rng.uniform((-55.0, 0.0), (55.0, 360.0)))
        position = mcmf_from_spherical(latitude, longitude, rng.uniform(14e3, 50e3))
        tilt, yaw = math.radians(rng.uniform(-5.0, 5.0)), rng.uniform(0.0, 2.0 * math.pi)
        light = math.radians(rng.uniform(3.0, 60.0)), rng.uniform(0.0, 2.0 * math.pi)
        rotation = pointed_camera_from_mcmf(position, tilt, yaw)
        view = (terrain, CAMERA, position, rotation, sun_direction_mcmf(*light, latitude, longitude))
        try:
            picture, oracle = renderer.render(*view), raymarch.render(*view, every=EVERY)
        except (PayloadError, LunarError) as error:
            print(f"pose left out: {error}", flush=True)
            continue
        fast.append(thinned(picture, EVERY))
        marched.append(oracle)
        if len(fast) == POSES:
            break
    found = compare_renderings(marched, fast)
    pairs = zip(marched, fast, strict=True)
    return found, float(np.median([np.nanmedian(np.abs(m.range_m - f.range_m)) for m, f in pairs]))


def compare_renderings(reference: Sequence[Rendering], other: Sequence[Rendering]) -> Agreement:
    """Agreement over views: renderings of the same ones by two renderers, in the same order."""
    both = either = 0
    errors, correlations = [], []
    for one, two in zip(reference, other, strict=True):
        ground = np.isfinite(one.range_m) & np.isfinite(two.range_m)
        dark, also = ground & (one.lit < SHADOW), ground & (two.lit < SHADOW)
        both += int(np.count_nonzero(dark & also))
        either += int(np.count_nonzero(dark | also))
        lit = ground & (one.lit > FULLY_LIT) & (two.lit > FULLY_LIT)
        if lit.any():
            expected = one.radiance[lit].astype(np.float64)
            errors.append(float(np.mean((two.radiance[lit] - expected) ** 2)) / float(expected.mean()) ** 2)
        correlations.append(_correlation(one.radiance[ground], two.radiance[ground]))
    return Agreement(
        shadow_iou=both / either if either else math.nan,
        radiance_rmse=math.sqrt(float(np.mean(errors))) if errors else math.nan,
        correlation=float(np.mean(correlations)) if correlations else math.nan,
        views=len(reference),
        dark_pixels=either,
    )


def thinned(rendering: Rendering, every: int) -> Rendering:
    """Each so-manieth pixel of each so-manieth row, as `raymarch.render` gives with the same ``every``."""
    return Rendering(
        rendering.radiance[::every, ::every], rendering.lit[::every, ::every], rendering.range_m[::every, ::every]
    )


def _correlation(one: NDArray[np.float32], two: NDArray[np.float32]) -> float:
    if one.size < 2 or one.std() == 0.0 or two.std() == 0.0:
        return math.nan
    return float(np.corrcoef(one, two)[0, 1])


def rows() -> Iterator[Row]:
    """Yield the fast renderer compared with the ray march on the procedural Moon; different pictures are an error."""
    terrain = open_terrain("procedural", find_data(None), 3)
    found, range_m = _compared(terrain)
    wrong = "" if found.correlation > 0.99 and range_m < 5.0 else f"{found}, range {range_m:.1f} m"
    for name in ("shadow_iou", "radiance_rmse", "correlation"):
        yield Row(f"{name.replace('_', ' ')} with the ray march", getattr(found, name), "", wrong=wrong)
    for number, km in enumerate((14.0, 30.0, 48.6)):
        frame, first, march = _frame(terrain, number, km)
        yield Row(f"frame from {km:g} km", frame, "ms", "ray march", march, wrong)
        yield Row(f"first frame of a place from {km:g} km", first, "ms", "later frames", frame)
