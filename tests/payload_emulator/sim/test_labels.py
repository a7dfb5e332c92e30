"""Labels against rims found by casting rays; the EXR reader against files written field by field."""

from math import degrees, hypot, isnan, radians, sqrt

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

from lunar.camera import BrownCamera, PinholeCamera, nadir_camera_from_mcmf, pointed_camera_from_mcmf
from lunar.catalogue import make_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import find_data
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import RendererError
from payload_emulator.sim.render.cycles import read_exr
from payload_emulator.sim.render.labels import label_frame, project_craters
from payload_emulator.sim.render.raymarch import cast
from payload_emulator.sim.terrain.opening import open_terrain
from tests.payload_emulator.sim.cast_rims import rim_errors
from tests.payload_emulator.sim.exr_file import exr_octets

CAMERA = PinholeCamera()


def pose(latitude_rad=0.0, longitude_rad=0.0):
    """Place of a camera at 20 km, and its attitude."""
    position = mcmf_from_spherical(latitude_rad, longitude_rad, 20e3)
    return position, nadir_camera_from_mcmf(position)


def crater_at(latitude_deg, longitude_deg, diameter_m, rim_height_m):
    return make_catalogue(
        np.radians([latitude_deg]), np.radians([longitude_deg]), [diameter_m], source="t",
        rim_height_m=[rim_height_m]
    )  # fmt: skip


def test_a_crater_below_is_as_wide_as_the_lens_makes_it_and_rim_height_moves_one_at_the_edge():
    labels = project_craters(crater_at(degrees(0.2), degrees(1.0), 5000.0, 2000.0), CAMERA, *pose(0.2, 1.0))
    assert (labels.u_px[0], labels.v_px[0]) == approx((255.5, 255.5), abs=1e-6)
    # 18 km above the rim, which is wider at 2 km than on the map sphere; its plane lies 1.8 m below its middle.
    width = 5000.0 * (1.0 + 2000.0 / MOON_RADIUS_M)
    assert labels.diameter_px[0] == approx(CAMERA.focal_px * width / 18_001.8, rel=1e-5)
    assert labels.size_class[0] == 0 and labels.inside[0] and labels.visible_fraction[0] == 1.0
    longitude = degrees(1.0 + 30e3 / MOON_RADIUS_M)
    low, high = (
        project_craters(crater_at(0.0, longitude, 5000.0, height), CAMERA, *pose(0.0, 1.0)).u_px[0]
        for height in (0.0, 1000.0)
    )
    # x = 30 km, and the ground falls 0.26 km over that: u = f x / z, 11.4 px for this kilometre.
    assert high - low == approx(CAMERA.focal_px * 30.0 * (1.0 / 19.26 - 1.0 / 20.26), rel=0.02)


def test_craters_cut_by_the_edge_say_so_and_those_out_of_sight_or_behind_the_limb_are_none():
    labels = project_craters(crater_at(0.0, degrees(34.2e3 / MOON_RADIUS_M), 9000.0, 0.0), CAMERA, *pose())
    assert 0.3 < labels.visible_fraction[0] < 0.7
    assert len(project_craters(crater_at(40.0, 100.0, 9000.0, 0.0), CAMERA, *pose())) == 0
    assert len(project_craters(make_catalogue([], [], [], source="t"), CAMERA, *pose())) == 0
    assert len(project_craters(crater_at(0.0, 179.0, 9000.0, 0.0), CAMERA, *pose())) == 0


def test_frame_labels_point_into_the_terrains_catalogue(procedural):
    labels = label_frame(procedural, CAMERA, *pose(radians(10.0), radians(20.0)))
    assert len(labels) > 10
    assert_array_equal(procedural.catalogue.diameter_m[labels.index], labels.diameter_m)
    assert np.isfinite(procedural.measured(labels.index).rim_height_m).all()


def test_ground_in_front_of_a_rim_takes_it_out_of_sight():
    catalogue = crater_at(0.0, 0.0, 8000.0, 0.0)
    clear = np.full((512, 512), 20e3, np.float32)
    half = clear.copy()
    half[:, :256] = 12e3
    seen = [
        project_craters(catalogue, CAMERA, *pose(), range_m=ranges).sight_fraction[0]
        for ranges in (clear, half, np.full_like(clear, np.nan))
    ]
    # 24 rim points; one or two lie on the line between the halves.
    assert seen[0] == 1.0 and seen[1] == approx(0.5, abs=0.09) and seen[2] == 0.0
    assert isnan(project_craters(catalogue, CAMERA, *pose()).sight_fraction[0])


def test_the_ellipse_of_a_crater_at_the_edge_is_that_of_perspective():
    """Seen at 45 degrees a circle is foreshortened to cos 45 across and stretched by the flat image plane."""
    label = project_craters(crater_at(0.0, degrees(20e3 / MOON_RADIUS_M), 3000.0, 0.0), CAMERA, *pose())
    # On a plane below a nadir pinhole circles stay circles: f D / z, z = 20 km + the fall of 115 m.
    flat = CAMERA.focal_px * 3.0 / 20.115
    assert label.minor_px[0] == approx(flat, rel=0.02)
    # The ground leans away by 0.66 degrees there: 1.2 % at 45 degrees.
    assert label.major_px[0] == approx(flat, rel=0.02)


RAMP = np.arange(12, dtype=np.float32).reshape(3, 4)
PLANES = {"A.Position.X": RAMP, "A.Combined.R": RAMP * -0.5}


@mark.parametrize("options", [{}, {"first_line": 7}, {"upward": True}, {"version": 2 | 0x400}])
def test_planes_come_back_by_name(tmp_path, options):
    file = tmp_path / "a.exr"
    file.write_bytes(exr_octets(PLANES, **options))
    read = read_exr(file)
    assert sorted(read) == sorted(PLANES)
    for name, plane in PLANES.items():
        assert_array_equal(read[name], plane)


@mark.parametrize(
    "octets, message",
    [
        (exr_octets(PLANES)[:-5], "expected 3 lines"), (exr_octets(PLANES, kind=1), "32-bit floats"),
        (exr_octets(PLANES, compression=3), "uncompressed EXR, found method 3"),
        (exr_octets(PLANES, version=2 | 0x1000), "single-part EXR"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "single-part EXR"), (exr_octets(PLANES)[:30], "damaged"),
        (b"", "damaged")
    ]
)  # fmt: skip
def test_anything_else_is_refused_with_what_is_wrong(tmp_path, octets, message):
    file = tmp_path / "b.exr"
    file.write_bytes(octets)
    with raises(RendererError, match=message):
        read_exr(file)


def errors_px(terrain, latitude_deg, longitude_deg, altitudes_m, camera=CAMERA):
    offsets = []
    for number, altitude_m in enumerate(altitudes_m):
        place = radians(latitude_deg), radians(longitude_deg)
        position = mcmf_from_spherical(*place, altitude_m)
        rotation = pointed_camera_from_mcmf(position, radians(2.0 * number), 0.7 * number)
        index, found = rim_errors(terrain, camera, position, rotation)
        offsets += [*found[terrain.catalogue.diameter_m[index] <= 30e3].ravel()]
    return np.array(offsets)


def test_rays_meet_a_smooth_sphere_where_geometry_says(formula_terrain):
    terrain = formula_terrain(lambda latitude, longitude: 700.0 + 0.0 * latitude)
    position = mcmf_from_spherical(0.2, 1.0, 25e3)
    rotation = nadir_camera_from_mcmf(position)
    uv = np.array([[255.5, 255.5], [400.25, 30.5], [0.0, 511.0]])
    hits = cast(terrain, CAMERA, position, rotation, uv)
    # Heights are single precision and a ray is halved onto the ground to millimetres.
    assert_allclose(norm(hits, axis=1) - MOON_RADIUS_M, 700.0, atol=0.05)
    assert_allclose(CAMERA.project((hits - position) @ rotation.T), uv, atol=1e-3)


def test_a_label_on_a_slope_sits_on_the_slopes_rim(formula_terrain):
    """A rim 300 m higher in the north, seen from the side: a label of one height is off by more than 0.1 px."""
    latitude, longitude = 0.2 + 30e3 / MOON_RADIUS_M, 1.0
    catalogue = make_catalogue([latitude], [longitude], [14_000.0], source="t")
    slope = 300.0 / (7_000.0 / MOON_RADIUS_M)
    terrain = formula_terrain(lambda lat, lon: slope * (lat - latitude) + 0.0 * lon, catalogue)
    position = mcmf_from_spherical(0.2, 1.0, 25e3)
    index, offsets = rim_errors(terrain, CAMERA, position, nadir_camera_from_mcmf(position))
    assert index.tolist() == [0] and hypot(*offsets[0]) < 0.01
    level = project_craters(terrain.measured(np.array([0])), CAMERA, position, nadir_camera_from_mcmf(position))
    tilted = label_frame(terrain, CAMERA, position, nadir_camera_from_mcmf(position))
    assert hypot(level.u_px[0] - tilted.u_px[0], level.v_px[0] - tilted.v_px[0]) > 0.1
    tilt = terrain.rim_tilts_m(np.array([0]))[0]
    # 300 m over one radius to the north, by the definition of the slope.
    assert tilt[0] == approx(300.0, rel=0.01) and abs(tilt[1]) < 1.0


def test_labels_sit_on_procedural_rims_also_through_a_distorting_lens(procedural):
    offsets = errors_px(procedural, 10.0, 20.0, (22e3, 45e3))
    assert offsets.size >= 40
    assert sqrt(np.mean(offsets**2)) <= 0.1
    offsets = errors_px(procedural, 10.0, 20.0, (40e3,), BrownCamera(k1=-0.015, p1=5e-4))
    assert offsets.size >= 20
    assert sqrt(np.mean(offsets**2)) <= 0.1


@mark.real_data
def test_labels_sit_on_real_rims(data_path):
    offsets = errors_px(open_terrain("raster", find_data(data_path), 3), -30.0, 294.0, (45e3,))
    assert offsets.size >= 20
    assert sqrt(np.mean(offsets**2)) <= 0.1
