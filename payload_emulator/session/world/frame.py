"""Frames of a scenario at any epochs, with the metadata and labels of the data sets."""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import BrownCamera, ground_point_sphere
from lunar.datafolder import DataFolder
from lunar.frames import spherical_from_mcmf
from lunar.messages.ephemeris_files import load_orbit
from lunar.timescales import format_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world.camera import true_sun_direction
from payload_emulator.session.world.world import World, build_world
from payload_emulator.sim.orbit.truth import require_above_ground
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.cycles_scene import CyclesSettings, describe_scene
from payload_emulator.sim.render.labels import Labels, label_frame
from payload_emulator.sim.render.light import sun_angles
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.renderer import Rendering
from payload_emulator.sim.render.sensor import Picture, take_picture


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """A picture and what is known of it.

    Attributes
    ----------
    image
        (H, W, 3), 8 or 16 bits.
    metadata, labels
        How it was taken, the craters in it; angles in degrees.
    data_names
        What the world is made of.
    rendering
        The picture before the sensor.
    filmic_png
        Cycles' own picture, Filmic tone in 16 bits, octets of a PNG file; empty from other renderers.
    """

    image: Picture
    metadata: dict[str, Any]
    labels: list[dict[str, Any]]
    data_names: tuple[str, ...]
    rendering: Rendering
    filmic_png: bytes = b""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """From where and under what light a frame is taken: position (3,), rotation (3, 3), unit Sun vector (3,), MCMF."""

    utc_ns: int
    position_mcmf_m: FloatArray
    camera_from_mcmf: FloatArray
    sun_mcmf: FloatArray


def render_frame(
    scenario: Scenario, data: DataFolder, utc_ns: int, renderer_name: str = "fast", blender_python: str = sys.executable
) -> Frame:
    """Return the image that the scenario's camera takes at an epoch, whatever the scenario's windows are.

    The light of the paper is drawn from the scenario's seed and the epoch, the sensor's noise likewise.

    Raises
    ------
    ScenarioError
        The epoch lies outside the orbit, or the spacecraft is below the ground.
    """
    find_renderer(renderer_name)
    world = world_at(scenario, data, [utc_ns])
    return take_frame(world, view_at(world, utc_ns), renderer_name, blender_python)


def find_renderer(name: str, blender_python: str = sys.executable) -> Callable[..., Rendering]:
    """Return the function that renders, by its name; `blender_python` is the interpreter that has Blender."""
    if name == "cycles":
        from payload_emulator.sim.render import cycles

        return partial(cycles.render, python=blender_python)
    found: dict[str, Callable[..., Rendering]] = {"fast": renderer.render, "raymarch": raymarch.render}
    if name not in found:
        raise ScenarioError(f"renderer: expected one of fast, raymarch, cycles, found {name!r}")
    return found[name]


def world_at(scenario: Scenario, data: DataFolder, epochs_utc_ns: Sequence[int]) -> World:
    """Return the scenario's world, flown as far as the last of the epochs.

    Raises
    ------
    ScenarioError
        An epoch lies outside the orbit, or the spacecraft is then below the ground.
    """
    first, last = min(epochs_utc_ns), max(epochs_utc_ns)
    _require_covered(scenario, first, last)
    window = replace(
        scenario.window,
        search="none",
        start=format_utc(last, 9),
        duration_s=scenario.camera.frame_interval_s,
        latitude_limit_deg=90.0,
        latitude_min_deg=-90.0,
        latitude_max_deg=90.0,
    )
    world = build_world(replace(scenario, window=window), data)
    require_above_ground(world.truth, np.array(sorted(epochs_utc_ns), dtype=np.int64), world.terrain.height_m)
    return world


def _require_covered(scenario: Scenario, first_utc_ns: int, last_utc_ns: int) -> None:
    if not scenario.orbit.oem:
        if first_utc_ns < scenario.epoch_utc_ns:
            raise ScenarioError(
                f"epoch: expected one at or after the scenario's {format_utc(scenario.epoch_utc_ns)}, "
                f"found {format_utc(first_utc_ns)}"
            )
        return
    ephemeris = load_orbit(Path(scenario.orbit.oem))
    for utc_ns in (first_utc_ns, last_utc_ns):
        if not ephemeris.start_utc_ns <= utc_ns < ephemeris.stop_utc_ns:
            raise ScenarioError(
                f"epoch: expected one from {format_utc(ephemeris.start_utc_ns)} to before "
                f"{format_utc(ephemeris.stop_utc_ns)} (orbit.oem), found {format_utc(utc_ns)}"
            )


def window_epochs(scenario: Scenario, data: DataFolder, count: int) -> tuple[World, list[int]]:
    """Return the scenario's world and ``count`` of its frames' epochs, evenly spread over its observation windows."""
    world = build_world(scenario, data)
    chosen = np.linspace(0, world.frame_utc_ns.size - 1, count + 2)[1:-1].round().astype(np.int64)
    return world, [int(utc_ns) for utc_ns in world.frame_utc_ns[np.unique(chosen)]]


def view_at(world: World, utc_ns: int) -> View:
    """Return position, pointing and direction of the Sun at an epoch."""
    position = world.truth.positions_mcmf(utc_ns)[0]
    rng = np.random.default_rng((world.scenario.seed, utc_ns))
    sun = true_sun_direction(world, position, utc_ns, rng)
    return View(utc_ns, position, world.camera_from_mcmf(position), sun)


def take_frame(world: World, view: View, renderer_name: str = "fast", blender_python: str = sys.executable) -> Frame:
    """Take the frame of a view: rendered, exposed, labelled."""
    pose = (world.terrain, world.true_camera, view.position_mcmf_m, view.camera_from_mcmf, view.sun_mcmf)
    law, filmic_png = Photometry(world.scenario.light.photometry), b""
    if renderer_name == "cycles":
        from payload_emulator.sim.render.cycles import render_scene

        picture = render_scene(describe_scene(*pose, law), CyclesSettings(), blender_python)
        rendering, filmic_png = picture.rendering, picture.filmic_png
    else:
        rendering = find_renderer(renderer_name)(*pose, law)
    # The noise is drawn from a separate stream: light and noise of a view do not depend on each other.
    rng = np.random.default_rng((world.scenario.seed, view.utc_ns, 1))
    metadata = metadata_of(world, view) | {"renderer": renderer_name}
    labels = label_frame(world.terrain, *pose[1:4], lit=rendering.lit, range_m=rendering.range_m)
    return Frame(
        take_picture(rendering.radiance, world.scenario.sensor, rng),
        metadata,
        _label_rows(labels, world.terrain.catalogue.ids),
        world.data_names,
        rendering,
        filmic_png,
    )


def metadata_of(world: World, view: View) -> dict[str, Any]:
    """Return the metadata of a view, angles in degrees; the same keys as in the metadata of data sets."""
    camera, section, scenario = world.true_camera, world.scenario.camera, world.scenario
    position, rotation, sun = view.position_mcmf_m, view.camera_from_mcmf, view.sun_mcmf
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    elevation, azimuth = sun_angles(sun, latitude, longitude)
    corners = ground_point_sphere(camera, rotation, position, camera.corners_px())
    corner_latitude, corner_longitude, _ = spherical_from_mcmf(corners)
    lens = {name: getattr(section, name) for name in ("k1", "k2", "k3", "p1", "p2")}
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "epoch": format_utc(view.utc_ns),
        "latitude_deg": math.degrees(latitude),
        "longitude_deg": math.degrees(longitude) % 360.0,
        "altitude_km": altitude / 1e3,
        "position_mcmf_m": position.tolist(),
        "camera_from_mcmf": rotation.tolist(),
        "tilt_deg": section.tilt_deg,
        "azimuth_deg": section.yaw_deg,
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
            "bits": scenario.sensor.bits,
            **(lens if isinstance(camera, BrownCamera) else {}),
        },
        "photometry": scenario.light.photometry,
        "terrain": world.terrain.name,
    }


def _label_rows(labels: Labels, ids: IntArray) -> list[dict[str, Any]]:
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
            "sight_fraction": _known(labels.sight_fraction[n]),
        }
        for n in range(len(labels))
    ]


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
