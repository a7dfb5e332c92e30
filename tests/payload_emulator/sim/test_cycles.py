"""The Cycles renderer up to the process boundary: the scene, the input of Blender, its output, faults.

Blender itself (a 374 MB wheel under the GPL) is no part of the test requirements; `linna render --compare` and the
benchmark run it where it is available.
"""

import math
import sys
import types
from dataclasses import replace
from math import asin, atan2, cos, exp, isnan, pi, radians, sin

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.camera import BrownCamera, PinholeCamera, nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import axis_rotation, enu_from_mcmf, mcmf_from_spherical
from payload_emulator.errors import RendererError, TerrainError
from payload_emulator.sim.render import cycles, cycles_worker, renderer
from payload_emulator.sim.render.cycles_scene import GRID, MATT_SPECULAR_IOR, CyclesSettings, describe_scene
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.photometry import Photometry
from tests.payload_emulator.sim.exr_file import exr_octets

CAMERA = PinholeCamera()
PLACE = radians(-20.0), radians(359.8)
SUN = sun_direction_mcmf(radians(10.0), radians(30.0), *PLACE)


def pose(altitude_m=25e3):
    position = mcmf_from_spherical(*PLACE, altitude_m)
    return position, nadir_camera_from_mcmf(position)


@fixture
def hilly(formula_terrain):
    return formula_terrain(lambda latitude, longitude: 1500.0 * np.sin(90.0 * latitude) * np.cos(80.0 * longitude))


@fixture
def scene(hilly):
    return describe_scene(hilly, CAMERA, *pose(), SUN)


def test_the_cap_is_a_grid_of_65_on_the_sphere_through_the_middle_of_the_relief(scene):
    assert scene.vertices_km.shape == (GRID, GRID, 3) == (65, 65, 3)
    centre = np.array([0.0, 0.0, -MOON_RADIUS_M / 1e3])
    radius = norm(scene.vertices_km - centre, axis=-1)
    # One sphere, to the rounding of double precision over the Moon's radius in km.
    assert np.ptp(radius) < 1e-8
    assert -1500.0 <= 1e3 * (radius.mean() - MOON_RADIUS_M / 1e3 - scene.displacement_range_km / 2.0) < -1400.0


def test_displaced_vertices_lie_on_the_terrain(hilly, scene):
    """Height of the texture at a vertex, put on the vertex's radius, is the terrain's height there."""
    position, _ = pose()
    east = np.array([-sin(PLACE[1]), cos(PLACE[1]), 0.0])
    up = position / norm(position)
    north = np.cross(up, east)
    for row, column in ((0, 0), (20, 40), (64, 3)):
        local = scene.vertices_km[row, column] * 1e3
        point = up * MOON_RADIUS_M + local[0] * east + local[1] * north + local[2] * up
        latitude = asin(point[2] / norm(point))
        longitude = atan2(point[1], point[0])
        u, v = scene.uv[row, column]
        high, wide = scene.displacement.shape
        share = scene.displacement[min(int(v * high), high - 1), min(int(u * wide), wide - 1)]
        height = norm(point) - MOON_RADIUS_M + 1e3 * (share - 0.5) * scene.displacement_range_km
        # The texture is read at the nearest of its pixels, on slopes of up to 0.08.
        assert height == approx(float(hilly.height_m(latitude, longitude)), abs=20.0)


def test_the_scene_holds_the_footprint_toward_a_low_sun_its_displacement_and_the_axes_of_blender(scene):
    texture = scene.displacement
    assert texture.dtype == np.float32 and (texture.min(), texture.max()) == approx((0.0, 1.0), abs=1e-6)
    x, y = scene.vertices_km[..., 0], scene.vertices_km[..., 1]
    # Half the footprint of 120 degrees from 25 km is 43 km on flat ground.
    assert x.min() < -43.0 and y.min() < -43.0
    # The Sun stands 10 degrees high at azimuth 30: casters of 6 km shade ground 34 km on.
    assert y.max() > 43.0 + 25.0 and x.max() > 43.0 + 14.0
    assert y.max() < 140.0
    camera = scene.camera_to_world
    assert_allclose(camera[:3, 3], [0.0, 0.0, 25.0], atol=1e-9)
    # Nadir, image up to the north: x east, y north, looking along -z.
    assert_allclose(camera[:3, :3], np.eye(3), atol=1e-12)
    toward = [cos(0.1745329) * 0.5, cos(0.1745329) * cos(pi / 6.0), sin(0.1745329)]
    assert_allclose(scene.sun_to_world[:3, 2], toward, atol=1e-6)
    assert_allclose(scene.sun_to_world[:3, :3] @ scene.sun_to_world[:3, :3].T, np.eye(3), atol=1e-12)
    assert math.degrees(scene.sun_angle_rad) == approx(0.533, abs=0.001)


def texel(scene, east_km=0.0, north_km=0.0):
    """Row and column of the colour of a place of the cap."""
    x, y = scene.vertices_km[32, :, 0], scene.vertices_km[:, 32, 1]
    return tuple(
        int(np.interp(at, places, np.linspace(0.0, 1.0, GRID)) * size)
        for at, places, size in zip((north_km, east_km), (y, x), scene.albedo.shape, strict=True)
    )


def test_the_base_colour_of_a_matt_surface_is_its_albedo_and_of_other_laws_bent_to_them(formula_terrain):
    """On flat ground Lambert's ratio falls with phase alone; Lunar-Lambert is brightest looking away from the Sun."""
    flat = formula_terrain(lambda latitude, longitude: 0.0 * latitude)
    matt, lambert, lunar = (
        describe_scene(flat, CAMERA, *pose(), SUN, Photometry(law, albedo_contrast=0.0))
        for law in ("matt", "lambert", "lunar-lambert")
    )
    assert np.ptp(matt.albedo) == 0.0
    assert matt.specular_ior > 1.0 and lambert.specular_ior == lunar.specular_ior == 1.0
    # The texel below the camera: the phase angle of nadir is the Sun's distance from the zenith, 80 degrees.
    row, column = texel(matt)
    assert lambert.albedo[row, column] / matt.albedo[row, column] == approx(exp(-0.7 * radians(80.0)), rel=0.01)
    degrees = 80.0
    weight = 1.0 - 0.019 * degrees + 0.242e-3 * degrees**2 - 1.46e-6 * degrees**3
    mcewen = 2.0 * weight / (1.0 + sin(radians(10.0))) + 1.0 - weight
    assert lunar.albedo[row, column] / lambert.albedo[row, column] == approx(mcewen, rel=0.01)
    # Ground 40 km off, away from the Sun and toward it.
    step = round(40.0 / 50.0 * row / 2)
    assert lunar.albedo[row - step, column] > 1.3 * lunar.albedo[row + step, column]


def test_slopes_bend_the_base_colour_as_the_fast_renderer_shades_them(hilly):
    """Base colour times the cosine of incidence is the fast renderer's radiance, where nothing is shaded."""
    sun = sun_direction_mcmf(radians(40.0), radians(30.0), *PLACE)
    position, rotation = pose()
    law = Photometry("lunar-lambert")
    scene = describe_scene(hilly, CAMERA, position, rotation, sun, law)
    matt = describe_scene(hilly, CAMERA, position, rotation, sun, Photometry("matt"))
    ratio = renderer.render(hilly, CAMERA, position, rotation, sun, law).radiance
    ratio = ratio / renderer.render(hilly, CAMERA, position, rotation, sun, Photometry("matt")).radiance
    for v, u in ((100, 120), (256, 256), (400, 90), (300, 450)):
        ray = rotation.T @ CAMERA.rays(np.array([[float(u), float(v)]]))[0]
        reach = 25e3
        for _ in range(20):
            point = position + reach * ray
            latitude, longitude = asin(point[2] / norm(point)), atan2(point[1], point[0])
            above = norm(point) - MOON_RADIUS_M - float(hilly.height_m(latitude, longitude))
            reach += above / -float(ray @ point / norm(point))
        east, north = enu_from_mcmf(*PLACE)[:2] @ (point - position) / 1e3
        place = texel(scene, east, north)
        assert scene.albedo[place] / matt.albedo[place] == approx(ratio[v, u], rel=0.03)


def test_a_tilted_camera_tilts_and_lenses_or_views_that_cannot_be_are_refused(hilly):
    position, rotation = pose()
    tilted = describe_scene(hilly, CAMERA, position, axis_rotation(1, 0.1) @ rotation, SUN)
    # The boresight, -z of Blender's camera, leans to the north.
    assert_allclose(-tilted.camera_to_world[:3, 2], [0.0, sin(0.1), -cos(0.1)], atol=1e-12)
    with raises(RendererError, match="without distortion"):
        describe_scene(hilly, BrownCamera(k1=-0.01), *pose(), SUN)
    with raises(TerrainError, match="above the ground"):
        describe_scene(hilly, CAMERA, *pose(40.0), SUN)
    with raises(TerrainError):
        position, rotation = pose(400e3)
        describe_scene(hilly, CAMERA, position, axis_rotation(1, 0.9) @ rotation, SUN)


class Thing:
    """Stands in for anything of Blender's: keeps what is set on it, makes up what is asked for, can be called."""

    def __init__(self):
        self.items = {}
        self.calls = []

    def __getattr__(self, name):
        value = Thing()
        setattr(self, name, value)
        return value

    def __getitem__(self, key):
        return self.items.setdefault(key, Thing())

    def __call__(self, *arguments, **options):
        self.calls.append(arguments)
        return self.items.setdefault((*map(str, arguments),), Thing())

    def __iter__(self):
        return iter(())


@fixture
def blender(monkeypatch):
    fake = Thing()
    fake.app.version_string = "0.0"
    monkeypatch.setitem(sys.modules, "bpy", fake)
    monkeypatch.setitem(sys.modules, "mathutils", types.SimpleNamespace(Matrix=lambda rows: rows))
    return fake


def test_blender_gets_the_settings_of_the_paper(tmp_path, scene, blender):
    replace(scene, specular_ior=MATT_SPECULAR_IOR).save(tmp_path / "scene.npz", CyclesSettings(samples=16))
    files = [str(tmp_path / name) for name in ("scene.npz", "out.exr", "picture.png", "cost.json")]
    assert cycles_worker.main(*files) == 0
    made = blender.context.scene
    assert made.render.engine == "CYCLES"
    assert (made.render.resolution_x, made.render.resolution_y) == (512, 512)
    assert made.cycles.samples == 16 and made.cycles.use_adaptive_sampling is True
    assert made.cycles.denoiser == "OPENIMAGEDENOISE"
    assert made.cycles.denoising_input_passes == "RGB_ALBEDO_NORMAL"
    assert made.world.node_tree.nodes["Background"].inputs["Strength"].default_value == 0.0
    assert made.view_settings.view_transform == "Filmic"
    # The last file format set is that of the picture.
    assert (made.render.image_settings.file_format, made.render.image_settings.color_depth) == ("PNG", "16")
    ground = blender.data.objects.new("ground", blender.data.meshes.new("cap"))
    modifier = ground.modifiers.new("dicing", "SUBSURF")
    assert modifier.use_adaptive_subdivision is True and modifier.adaptive_pixel_size == 0.5
    assert ground.cycles.shadow_terminator_offset > 0.0
    surface = blender.data.materials.new("regolith").node_tree.nodes["Principled BSDF"]
    assert surface.inputs["Roughness"].default_value == 1.0
    assert 1.0 < surface.inputs["IOR"].default_value < 1.1
    assert blender.data.lights.new("Sun", "SUN").energy == approx(pi)
    vertices, _, faces = blender.data.meshes.new("cap").from_pydata.calls[0]
    assert len(vertices) == 65 * 65 and len(faces) == 64 * 64
    corners = np.array(vertices)[np.array(faces)]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])[:, 2] > 0.0).all()


def planes_of(scene, cosine, direct, range_km):
    """Passes of ground lying ``range_km`` below the camera, its normal at a cosine to the Sun; sky in one corner."""
    shape = (4, 5)
    sun = scene.sun_to_world[:3, 2]
    eye = scene.camera_to_world[:3, 3]
    alpha = np.ones(shape, np.float32)
    alpha[0, 0] = 0.0
    planes = {"V.Combined.R": np.full(shape, 0.03, np.float32), "V.Combined.A": alpha}
    for axis, s, e in zip("XYZ", sun, eye, strict=True):
        planes[f"V.Normal.{axis}"] = np.full(shape, s * cosine, np.float32)
        planes[f"V.Position.{axis}"] = np.full(shape, e - (range_km if axis == "Z" else 0.0), np.float32)
    planes["V.Diffuse Direct.R"] = np.full(shape, direct, np.float32)
    return planes


def test_passes_become_radiance_share_of_the_sun_and_range_and_a_missing_one_is_named(scene):
    picture = cycles.rendering_of_passes(planes_of(scene, 0.4, 0.2, 24.0), scene)
    assert picture.radiance[1, 1] == approx(0.03) and picture.radiance[0, 0] == 0.0
    assert picture.lit[1, 1] == approx(0.5, abs=1e-6) and picture.lit[0, 0] == 0.0
    assert picture.range_m[1, 1] == approx(24e3, rel=1e-6) and isnan(picture.range_m[0, 0])
    assert cycles.rendering_of_passes(planes_of(scene, -0.2, 0.0, 24.0), scene).lit.max() == 0.0
    planes = planes_of(scene, 0.4, 0.2, 24.0)
    del planes["V.Position.Y"]
    with raises(RendererError, match=r"expected a pass Position\.Y, found V\.Combined"):
        cycles.rendering_of_passes(planes, scene)


def interpreter(folder, body):
    """An executable that Blender's interpreter is replaced by: gets -P, worker, scene, exr, png, cost."""
    file = folder / "python"
    file.write_text(f"#!{sys.executable}\nimport json, sys\n{body}\n")
    file.chmod(0o755)
    return str(file)


def test_what_another_process_renders_comes_back(tmp_path, hilly, scene):
    exr = tmp_path / "made.exr"
    exr.write_bytes(exr_octets(planes_of(scene, 0.4, 0.4, 20.0)))
    python = interpreter(
        tmp_path,
        "import numpy, shutil\n"
        "stated = numpy.load(sys.argv[3])\n"
        "assert stated['set_samples'] == 7 and stated['vertices_km'].shape == (65, 65, 3)\n"
        f"shutil.copy({str(exr)!r}, sys.argv[4])\n"
        "open(sys.argv[5], 'wb').write(b'png')\n"
        "cost = {'blender': '5.0', 'scene_wall_s': 1, 'render_wall_s': 2, 'render_cpu_s': 3}\n"
        "json.dump(cost, open(sys.argv[6], 'w'))",
    )
    picture = cycles.render_scene(scene, CyclesSettings(samples=7), python)
    assert picture.filmic_png == b"png" and picture.blender == "5.0" and picture.render_cpu_s == 3.0
    assert picture.rendering.lit[2, 2] == approx(1.0)
    rendering = cycles.render(hilly, CAMERA, *pose(), SUN, settings=CyclesSettings(samples=7), python=python)
    assert_array_equal(rendering.range_m, picture.rendering.range_m)


def test_without_blender_one_line_says_how_to_get_it(tmp_path, monkeypatch, scene):
    (tmp_path / "bpy.py").write_text("raise ImportError('no Blender here')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with raises(RendererError, match=r"expected Blender as a module \(bpy\).*LINNA_BLENDER_PYTHON") as caught:
        cycles.render_scene(scene, CyclesSettings())
    assert "\n" not in str(caught.value)


def test_an_interpreter_that_is_not_there_is_named(scene):
    with raises(RendererError, match="at /nowhere/python, found none"):
        cycles.render_scene(scene, CyclesSettings(), "/nowhere/python")


@mark.parametrize(
    "body, message",
    [
        ("sys.exit('out of memory')", "status 1: out of memory"),
        ("pass", r"without writing out\.exr, picture\.png, cost\.json"),
    ],
)
def test_a_blender_that_fails_is_quoted(tmp_path, scene, body, message):
    with raises(RendererError, match=message):
        cycles.render_scene(scene, CyclesSettings(), interpreter(tmp_path, body))
