"""Camera, lunar orientation, gravity fields and packets declared by a mission description.

The local data folder decides only whether a declared model is available, never which model is used.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pydantic import ValidationError

from ground_service.missions.automation import Section
from ground_service.missions.model import Camera, DictionarySection, Evidence, Frames, Mission, Spacecraft, World
from lunar.camera import BrownCamera, PinholeCamera
from lunar.datafolder import DataFolder
from lunar.frames import IauOrientation, Orientation, load_orientation
from lunar.gravity import GravityField, builtin_gravity, load_gravity

REMEDY = "set LINNA_DATA to a folder that has it, or run linna data fetch"


@dataclass(frozen=True, slots=True, eq=False)
class DeclaredFrames:
    """Models for the evaluation; None if not stated or not available, with the reason in `refused`.

    Attributes
    ----------
    gravity
        Field of the reference, cut to the declared degree.
    onboard_gravity
        Field of the on-board filter, cut to the declared degree.
    refused
        Reason by name of the model: "orientation", "onboard_orientation", "gravity", "onboard_gravity".
    """

    orientation: Orientation | None = None
    onboard_orientation: Orientation | None = None
    gravity: GravityField | None = None
    onboard_gravity: GravityField | None = None
    refused: Mapping[str, str] = field(default_factory=dict)


def declared_frames(frames: Frames, data: DataFolder) -> DeclaredFrames:
    """Return the declared and available models of a mission."""
    refused: dict[str, str] = {}
    orientation = _orientation(frames.orientation, data)
    if orientation is None:
        refused["orientation"] = _reason("lunar orientation", frames.orientation, "frames.orientation")
    on_board = _orientation(frames.onboard_orientation, data)
    if on_board is None:
        refused["onboard_orientation"] = _reason(
            "lunar orientation on board", frames.onboard_orientation, "frames.onboard_orientation"
        )
    gravity = _gravity(frames.gravity_field, frames.gravity_degree, data)
    if gravity is None:
        refused["gravity"] = _reason("gravity field", frames.gravity_field, "frames.gravity_field")
    onboard = _gravity(frames.onboard_gravity_field, frames.onboard_gravity_degree, data)
    if onboard is None:
        refused["onboard_gravity"] = _reason(
            "gravity field of the filter", frames.onboard_gravity_field, "frames.onboard_gravity_field"
        )
    return DeclaredFrames(orientation, on_board, gravity, onboard, refused)


def camera_of(camera: Camera) -> PinholeCamera:
    """Return the declared camera of a mission, with its lens; the paper's values replace sizes that are not stated."""
    default = PinholeCamera()
    sizes = (
        default.width_px if camera.width_px is None else camera.width_px,
        default.height_px if camera.height_px is None else camera.height_px,
        default.fov_rad if camera.fov_deg is None else math.radians(camera.fov_deg),
    )
    lens = tuple(value or 0.0 for value in (camera.k1, camera.k2, camera.k3, camera.p1, camera.p2))
    return BrownCamera(*sizes, *lens) if any(lens) else PinholeCamera(*sizes)


def assumed_camera(camera: Camera) -> str:
    """Return which sizes of the camera are assumed because they are not stated; empty without any."""
    default = PinholeCamera()
    assumed = {
        "image width": (camera.width_px, f"{default.width_px} px"),
        "image height": (camera.height_px, f"{default.height_px} px"),
        "field of view": (camera.fov_deg, f"{math.degrees(default.fov_rad):g} deg"),
    }
    values = [f"{name} ({value})" for name, (stated, value) in assumed.items() if stated is None]
    if not values:
        return ""
    return f"the mission description does not state sizes of the camera, which are assumed: {', '.join(values)}"


def _reason(what: str, declared: str | None, key: str) -> str:
    if declared is None:
        return f"the mission description does not state the {what} ({key})"
    return f"the mission declares the {what} {declared}, which is not available on this machine ({REMEDY})"


def _orientation(name: str | None, data: DataFolder) -> Orientation | None:
    built_in = IauOrientation()
    if name == built_in.name:
        return built_in
    if name is None or data.orientation_bpc is None:
        return None
    kernel = _kernel(data)
    return kernel if kernel.name == name else None


def _gravity(name: str | None, degree: int | None, data: DataFolder) -> GravityField | None:
    if name is None:
        return None
    field_named = _named_field(name, data)
    if field_named is None or degree is None or degree >= field_named.degree:
        return field_named
    return field_named.truncated(degree)


@functools.lru_cache(maxsize=4)
def _kernel(data: DataFolder) -> Orientation:
    assert data.orientation_bpc is not None
    return load_orientation(data.orientation_bpc, data.orientation_tf)


def _named_field(name: str, data: DataFolder) -> GravityField | None:
    built_in = builtin_gravity()
    if name == built_in.name:
        return built_in
    for path in (data.gravity, data.gravity_alternative):
        if path is not None:
            found = _field(path)
            if found.name == name:
                return found
    return None


_field = functools.lru_cache(maxsize=4)(load_gravity)


AnySection = TypeVar("AnySection", bound=Section)

ORIENTATION_PREFIX = "orientation "
"""Prefix of the entry of `data_sources` that names the lunar orientation."""

REAL_TERRAINS = ("LROC WAC GLD100", "SLDEM2015")
"""Names of real terrains in the manifest key `terrain`."""


def mission_of_manifest(manifest: Mapping[str, Any]) -> Mission:
    """Return the mission description that a manifest declares."""
    sources = manifest.get("data_sources")
    named = [str(one) for one in sources] if isinstance(sources, list | tuple) else []
    orientations = [one.removeprefix(ORIENTATION_PREFIX) for one in named if one.startswith(ORIENTATION_PREFIX)]
    gravity, camera = _table(manifest, "gravity"), _table(manifest, "camera")
    dictionary = _table(manifest, "dictionary")
    name = str(manifest.get("scenario") or manifest.get("pass_name") or "not stated")[:200]
    return Mission(
        name=name,
        spacecraft=_section(Spacecraft, id=manifest.get("spacecraft_id")),
        dictionary=_section(DictionarySection, version=dictionary.get("version"), hash=dictionary.get("hash")),
        frames=_section(
            Frames,
            orientation=orientations[0] if len(orientations) == 1 else None,
            gravity_field=gravity.get("truth"),
            gravity_degree=gravity.get("degree"),
            onboard_orientation=gravity.get("filter_orientation"),
            onboard_gravity_field=gravity.get("filter"),
            onboard_gravity_degree=gravity.get("filter_degree"),
        ),
        camera=_section(
            Camera,
            width_px=camera.get("width_px"),
            height_px=camera.get("height_px"),
            fov_deg=camera.get("fov_deg"),
            frame_interval_s=manifest.get("cadence_s"),
        ),
        evidence=_section(
            Evidence, world=_world(str(manifest.get("terrain")), manifest.get("seed")), seed=manifest.get("seed")
        ),
    )


def _world(terrain: str, seed: object) -> World | None:
    """Return the world of a terrain name; a manifest does not state whether real terrain was used in training."""
    if terrain in REAL_TERRAINS:
        return "real-terrain"
    if terrain.startswith("photograph "):
        return "photographs"
    made = terrain == f"procedural Moon, seed {seed}" or terrain.endswith(f" on a procedural base, seed {seed}")
    return "procedural" if made else None


def _table(manifest: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = manifest.get(key)
    return found if isinstance(found, Mapping) else {}


def _section(kind: type[AnySection], **values: Any) -> AnySection:
    """Return a section with the accepted values; refused values are not stated."""
    kept = {}
    for key, value in values.items():
        try:
            kind(**{key: value})
        except ValidationError:
            continue
        kept[key] = value
    return kind(**kept)
