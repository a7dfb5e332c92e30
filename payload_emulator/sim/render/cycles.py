"""The paper's own renderer: Blender's Cycles, in a separate process, with the inputs and outputs of `renderer`.

Blender is optional and stays outside: a scene goes to another interpreter as a file of arrays, pictures come back as
files.  That interpreter needs ``bpy`` (the wheel of Blender, GPL); this package never imports it.

File layout after the OpenEXR technical introduction (magic 20000630, version 2): attributes, a table of line offsets,
then for every line its number, its size and the channels one after another in the order of their names.
"""

import json
import math
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lunar.camera import PinholeCamera
from payload_emulator.errors import RendererError
from payload_emulator.sim.render.cycles_scene import CyclesScene, CyclesSettings, describe_scene
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.renderer import Image, Rendering
from payload_emulator.sim.terrain.tiles import Terrain

MAGIC = 20_000_630
LONG_NAMES = 0x400
FLOAT = 2
UNCOMPRESSED = 0


WORKER = Path(__file__).with_name("cycles_worker.py")
NO_BLENDER = 3
GRAZING = 0.001
"""Ground whose cosine to the Sun is smaller counts as shadow, as ground that faces away does in the other renderers.

Not larger: ground of cosine 0.01, which the Sun still sees whole, edges every broad shadow, and is a pixel wide.
"""


@dataclass(frozen=True, eq=False, slots=True)
class CyclesPicture:
    """Image of a scene by Cycles.

    Attributes
    ----------
    rendering
        As of the other renderers; the radiance is denoised and holds the light that ground throws on ground.
    filmic_png
        The picture as the paper exports it: Filmic tone, 16-bit PNG, octets of the file.
    blender
        Version.
    scene_s, render_s, render_cpu_s
        Seconds to build the scene, to render it (wall clock, tesselation and denoising included), and of processor.
    """

    rendering: Rendering
    filmic_png: bytes
    blender: str
    scene_s: float
    render_s: float
    render_cpu_s: float


def render(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    sun_direction_mcmf: npt.ArrayLike,
    photometry: Photometry | None = None,
    settings: CyclesSettings | None = None,
    python: str = sys.executable,
) -> Rendering:
    """Picture of the terrain, as `renderer.render`, by Cycles.

    The regolith is Blender's Principled BSDF, its base colour bent to the law of ``photometry`` (``matt`` leaves it as
    the paper has it).  ``python`` is an interpreter that can import ``bpy``.

    Raises
    ------
    RendererError
        There is no Blender, it failed, or the lens distorts.
    TerrainError
        The camera is in the ground or sees ground the terrain does not hold.
    """
    scene = describe_scene(terrain, camera, position_mcmf_m, camera_from_mcmf, sun_direction_mcmf, photometry)
    return render_scene(scene, settings or CyclesSettings(), python).rendering


def render_scene(scene: CyclesScene, settings: CyclesSettings, python: str = sys.executable) -> CyclesPicture:
    """The picture of a described scene, rendered by the Blender of an interpreter.

    Raises
    ------
    RendererError
        There is no Blender, or it failed.
    """
    with tempfile.TemporaryDirectory(prefix="linna-cycles-") as name:
        folder = Path(name)
        scene_file, exr, png, cost = (folder / file for file in ("scene.npz", "out.exr", "picture.png", "cost.json"))
        scene.save(scene_file, settings)
        # -P: the worker's own folder must not hide Blender's modules of the same names.
        _run([python, "-P", str(WORKER), str(scene_file), str(exr), str(png), str(cost)], python)
        missing = [path.name for path in (exr, png, cost) if not path.is_file()]
        if missing:
            raise RendererError(f"cycles: Blender ended without writing {', '.join(missing)}")
        figures = json.loads(cost.read_text(encoding="utf-8"))
        return CyclesPicture(
            rendering_of_passes(read_exr(exr), scene),
            png.read_bytes(),
            str(figures["blender"]),
            float(figures["scene_wall_s"]),
            float(figures["render_wall_s"]),
            float(figures["render_cpu_s"]),
        )


def rendering_of_passes(planes: dict[str, Image], scene: CyclesScene) -> Rendering:
    """Radiance, share of the Sun and range out of Cycles' passes.

    The direct diffuse pass is the Sun's irradiance over pi times the cosine of incidence and the share of the disc in
    sight (the lamp shines with pi); the normal pass gives the cosine.
    """
    ground = _plane(planes, "Combined.A") > 0.5
    sun = scene.sun_to_world[:3, 2]
    normal = [_plane(planes, f"Normal.{axis}") for axis in "XYZ"]
    cosine = sum(np.float32(s) * plane for s, plane in zip(sun, normal, strict=True))
    direct = _plane(planes, "Diffuse Direct.R", "DiffDir.R")
    lit = np.where(ground & (cosine > GRAZING), np.clip(direct / np.maximum(cosine, GRAZING), 0.0, 1.0), 0.0)
    viewpoint = scene.camera_to_world[:3, 3]
    offset = [_plane(planes, f"Position.{axis}") - np.float32(e) for axis, e in zip("XYZ", viewpoint, strict=True)]
    range_m = 1e3 * np.sqrt(sum(plane.astype(np.float64) ** 2 for plane in offset))
    return Rendering(
        np.where(ground, _plane(planes, "Combined.R"), np.float32(0.0)).astype(np.float32),
        lit.astype(np.float32),
        np.where(ground, range_m, math.nan).astype(np.float32),
    )


def _plane(planes: dict[str, Image], *endings: str) -> Image:
    for name, plane in planes.items():
        if name.endswith(tuple(f".{ending}" for ending in endings)):
            return plane
    raise RendererError(f"cycles: expected a pass {endings[0]}, found {', '.join(sorted(planes))}")


def _run(command: list[str], python: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise RendererError(
            f"cycles: expected a Python interpreter with Blender (bpy) at {python}, found none ({error.strerror})"
        ) from None
    if done.returncode == NO_BLENDER:
        raise RendererError(
            f"cycles: expected Blender as a module (bpy) in {python}, found none; install requirements/cycles.txt "
            "into an environment of its own and name its interpreter in LINNA_BLENDER_PYTHON"
        )
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise RendererError(
            f"cycles: Blender ended with status {done.returncode}: {lines[-1] if lines else 'no message'}"
        )


def read_exr(path: Path) -> dict[str, npt.NDArray[np.float32]]:
    """Planes (H, W) of a picture by channel name.

    Raises
    ------
    RendererError
        The file is no EXR of this kind, or ends early.
    """
    octets = path.read_bytes()
    try:
        attributes, place = _attributes(octets, path)
        names = _channels(attributes["channels"], path)
        if attributes["compression"][0] != UNCOMPRESSED:
            raise RendererError(f"{path}: expected an uncompressed EXR, found method {attributes['compression'][0]}")
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    except (KeyError, IndexError, struct.error, ValueError) as error:
        raise RendererError(f"{path}: expected the header of an EXR file, found it damaged ({error})") from None
    wide, high = right - left + 1, bottom - top + 1
    line = np.dtype([("number", "<i4"), ("size", "<i4"), ("values", "<f4", (len(names), wide))])
    start = place + 8 * high
    if len(octets) < start + high * line.itemsize:
        raise RendererError(
            f"{path}: expected {high} lines of {line.itemsize} octets after octet {start}, found "
            f"{len(octets) - start} octets"
        )
    lines = np.frombuffer(octets, line, high, start)
    values = np.empty((high, len(names), wide), np.float32)
    values[lines["number"] - top] = lines["values"]
    return {name: np.ascontiguousarray(values[:, n]) for n, name in enumerate(names)}


def _attributes(octets: bytes, path: Path) -> tuple[dict[str, bytes], int]:
    """Values of the header's attributes by name, and where the header ends."""
    magic, version = struct.unpack_from("<ii", octets)
    if magic != MAGIC or version & ~LONG_NAMES != 2:
        raise RendererError(f"{path}: expected a single-part EXR of version 2, found octets {octets[:8].hex()}")
    attributes = {}
    place = 8
    while octets[place] != 0:
        name, place = _text(octets, place)
        _, place = _text(octets, place)
        (size,) = struct.unpack_from("<i", octets, place)
        attributes[name] = octets[place + 4 : place + 4 + size]
        place += 4 + size
    return attributes, place + 1


def _channels(octets: bytes, path: Path) -> list[str]:
    names = []
    place = 0
    while octets[place] != 0:
        name, place = _text(octets, place)
        kind, _, across, down = struct.unpack_from("<iiii", octets, place)
        if (kind, across, down) != (FLOAT, 1, 1):
            raise RendererError(f"{path}: expected 32-bit floats in channel {name}, found type {kind}")
        names.append(name)
        place += 16
    return names


def _text(octets: bytes, place: int) -> tuple[str, int]:
    end = octets.index(0, place)
    return octets[place:end].decode("latin-1"), end + 1
