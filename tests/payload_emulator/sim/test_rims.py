"""Labels against rims found by casting rays: the demand is 0.1 px rms on the ray march's geometry."""

from math import hypot, radians, sqrt

import numpy as np
from pytest import approx, mark

from lunar.camera import BrownCamera, PinholeCamera, nadir_camera_from_mcmf, pointed_camera_from_mcmf
from lunar.catalogue import make_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import find_data
from lunar.frames import mcmf_from_spherical
from payload_emulator.sim.render.labels import label_frame, project_craters
from payload_emulator.sim.render.raymarch import cast
from payload_emulator.sim.terrain.opening import open_terrain
from tests.payload_emulator.sim.cast_rims import rim_errors

CAMERA = PinholeCamera()


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
    np.testing.assert_allclose(np.linalg.norm(hits, axis=1) - MOON_RADIUS_M, 700.0, atol=0.05)
    np.testing.assert_allclose(CAMERA.project((hits - position) @ rotation.T), uv, atol=1e-3)


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


def test_labels_sit_on_procedural_rims(procedural):
    offsets = errors_px(procedural, 10.0, 20.0, (22e3, 45e3))
    assert offsets.size >= 40
    assert sqrt(np.mean(offsets**2)) <= 0.1


def test_labels_sit_on_rims_seen_through_a_distorting_lens(procedural):
    offsets = errors_px(procedural, 10.0, 20.0, (40e3,), BrownCamera(k1=-0.015, p1=5e-4))
    assert offsets.size >= 20
    assert sqrt(np.mean(offsets**2)) <= 0.1


@mark.real_data
def test_labels_sit_on_real_rims(data_path):
    terrain = open_terrain("raster", find_data(data_path), 3)
    offsets = errors_px(terrain, -30.0, 294.0, (45e3,))
    assert offsets.size >= 20
    assert sqrt(np.mean(offsets**2)) <= 0.1
