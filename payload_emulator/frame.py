"""One frame of a scenario at any epoch, with the metadata and labels of the data sets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera, ground_point_sphere, nadir_camera_from_mcmf
from lunar.datafolder import DataFolder
from lunar.frames import spherical_from_mcmf
from lunar.timescales import format_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.scenario import Scenario
from payload_emulator.sim import raymarch, renderer
from payload_emulator.sim.labels import Labels, label_frame
from payload_emulator.sim.light import sun_angles
from payload_emulator.sim.sensor import SensorModel, expose
from payload_emulator.world import World, build_world, true_sun_direction

FloatArray = NDArray[np.float64]

RENDERERS = {"fast": renderer.render, "raymarch": raymarch.render}


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """A picture (H, W, 3), what is known of how it was taken, and the craters in it; angles in degrees."""

    image: NDArray[np.uint8]
    metadata: dict[str, Any]
    labels: list[dict[str, Any]]
    data_names: tuple[str, ...]


def render_frame(scenario: Scenario, data: DataFolder, utc_ns: int, renderer_name: str = "fast") -> Frame:
    """The nadir picture that the scenario's camera takes at an epoch, whatever the scenario's windows are.

    The light of the paper is drawn from the scenario's seed and the epoch, the sensor's noise likewise.

    Raises
    ------
    ScenarioError
        The epoch lies before the scenario's, or the spacecraft is below the ground.
    """
    if renderer_name not in RENDERERS:
        raise ScenarioError(f"renderer: expected one of {', '.join(RENDERERS)}, found {renderer_name!r}")
    if not scenario.orbit.oem and utc_ns < scenario.epoch_utc_ns:
        raise ScenarioError(
            f"epoch: expected one at or after the scenario's {format_utc(scenario.epoch_utc_ns)}, "
            f"found {format_utc(utc_ns)}"
        )
    interval_s = scenario.camera.frame_interval_s
    window = replace(
        scenario.window,
        search="none",
        start=format_utc(utc_ns, 9),
        duration_s=interval_s,
        latitude_limit_deg=90.0,
    )
    world = build_world(replace(scenario, window=window), data)
    position = world.truth.positions_mcmf(utc_ns)[0]
    rotation = nadir_camera_from_mcmf(position)
    rng = np.random.default_rng((scenario.seed, utc_ns))
    sun = true_sun_direction(world, position, utc_ns, rng)
    rendering = RENDERERS[renderer_name](world.terrain, world.camera, position, rotation, sun)
    labels = label_frame(world.terrain, world.camera, position, rotation, lit=rendering.lit)
    metadata = _metadata(world, utc_ns, position, rotation, sun)
    metadata |= {"scenario": scenario.name, "seed": scenario.seed, "renderer": renderer_name}
    return Frame(
        expose(rendering.radiance, SensorModel(), rng),
        metadata,
        _label_rows(labels, world.terrain.catalogue.ids),
        world.data_names,
    )


def _metadata(
    world: World, utc_ns: int, position: FloatArray, rotation: FloatArray, sun: FloatArray
) -> dict[str, Any]:
    camera: PinholeCamera = world.camera
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    elevation, azimuth = sun_angles(sun, latitude, longitude)
    corners = ground_point_sphere(camera, rotation, position, camera.corners_px())
    corner_latitude, corner_longitude, _ = spherical_from_mcmf(corners)
    return {
        "epoch": format_utc(utc_ns),
        "latitude_deg": math.degrees(latitude),
        "longitude_deg": math.degrees(longitude) % 360.0,
        "altitude_km": altitude / 1e3,
        "position_mcmf_m": position.tolist(),
        "camera_from_mcmf": rotation.tolist(),
        "tilt_deg": 0.0,
        "azimuth_deg": 0.0,
        "sun_elevation_deg": math.degrees(elevation),
        "sun_azimuth_deg": math.degrees(azimuth),
        "sun_direction_mcmf": sun.tolist(),
        "sun_direction_camera": (rotation @ sun).tolist(),
        "corners_deg": [
            None if not math.isfinite(a) else [math.degrees(a), math.degrees(b) % 360.0]
            for a, b in zip(corner_latitude.tolist(), corner_longitude.tolist(), strict=True)
        ],
        "camera": {
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "fov_deg": math.degrees(camera.fov_rad),
        },
        "terrain": world.terrain.name,
    }


def _label_rows(labels: Labels, ids: NDArray[np.int64]) -> list[dict[str, Any]]:
    return [
        {
            "id": int(ids[labels.index[n]]),
            "u_px": float(labels.u_px[n]),
            "v_px": float(labels.v_px[n]),
            "diameter_px": float(labels.diameter_px[n]),
            "ellipse": {
                "major_px": float(labels.major_px[n]),
                "minor_px": float(labels.minor_px[n]),
                "angle_deg": math.degrees(labels.angle_rad[n]),
            },
            "class": int(labels.size_class[n]),
            "diameter_km": float(labels.diameter_m[n]) / 1e3,
            "depth_m": _known(labels.depth_m[n]),
            "inside": bool(labels.inside[n]),
            "visible_fraction": float(labels.visible_fraction[n]),
            "lit_fraction": _known(labels.lit_fraction[n]),
        }
        for n in range(len(labels))
    ]


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
