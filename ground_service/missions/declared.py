"""Mission description from the manifest of an archive without `mission.toml`.

Only keys and exact values that emulators have written are read; all other values are not stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from ground_service.missions.model import (
    Camera,
    DictionarySection,
    Evidence,
    Frames,
    Mission,
    Spacecraft,
    World,
)
from ground_service.missions.section import Section

AnySection = TypeVar("AnySection", bound=Section)

ORIENTATION_PREFIX = "orientation "
"""Prefix of the entry of `data_sources` that names the lunar orientation."""

REAL_TERRAINS = ("LROC WAC GLD100", "SLDEM2015")
"""Names of real terrains in the manifest key `terrain`."""


def mission_of_manifest(manifest: Mapping[str, Any]) -> Mission:
    """Return the mission description that a manifest declares."""
    sources = manifest.get("data_sources")
    named = [str(one) for one in sources] if isinstance(sources, list | tuple) else []
    orientations = [
        one.removeprefix(ORIENTATION_PREFIX) for one in named if one.startswith(ORIENTATION_PREFIX)
    ]
    gravity, camera = _table(manifest, "gravity"), _table(manifest, "camera")
    dictionary = _table(manifest, "dictionary")
    name = str(manifest.get("scenario") or manifest.get("pass_name") or "not stated")[:200]
    return Mission(
        name=name,
        spacecraft=_section(Spacecraft, id=manifest.get("spacecraft_id")),
        dictionary=_section(
            DictionarySection, version=dictionary.get("version"), hash=dictionary.get("hash")
        ),
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
            Evidence,
            world=_world(str(manifest.get("terrain")), manifest.get("seed")),
            seed=manifest.get("seed"),
        ),
    )


def _world(terrain: str, seed: object) -> World | None:
    """Return the world of a terrain name; a manifest does not state whether real terrain was used in training."""
    if terrain in REAL_TERRAINS:
        return "real-terrain"
    if terrain.startswith("photograph "):
        return "photographs"
    made = terrain == f"procedural Moon, seed {seed}" or terrain.endswith(
        f" on a procedural base, seed {seed}"
    )
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
