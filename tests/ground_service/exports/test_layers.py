"""Lines and rings at the 180th meridian and around the poles, and the geometry that GDAL makes of them."""

import numpy as np
import pyogrio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ground_service.exports.layers import Feature, Layer, cut_line, cut_ring
from ground_service.exports.maps import format_geojson, geopackage_octets


def area(ring: np.ndarray) -> float:
    x, y = ring.T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2.0


def test_a_line_across_the_meridian_is_cut_on_it() -> None:
    parts = cut_line(np.array([[178.0, 10.0], [-178.0, 20.0], [-170.0, 20.0]]))
    np.testing.assert_allclose(parts[0], [[178.0, 10.0], [180.0, 15.0]])
    np.testing.assert_allclose(parts[1], [[-180.0, 15.0], [-178.0, 20.0], [-170.0, 20.0]])


def test_a_line_that_stays_in_the_world_is_one_part() -> None:
    line = np.array([[-10.0, 0.0], [0.0, 5.0], [170.0, 0.0]])
    (part,) = cut_line(line)
    np.testing.assert_allclose(part, line)


def test_a_ring_across_the_meridian_becomes_two() -> None:
    parts = cut_ring(np.array([[178.0, 0.0], [178.0, 10.0], [-176.0, 10.0], [-176.0, 0.0]]))
    spans = sorted((float(part[:, 0].min()), float(part[:, 0].max())) for part in parts)
    np.testing.assert_allclose(spans, [(-180.0, -176.0), (178.0, 180.0)])
    assert sum(area(part) for part in parts) == pytest.approx(60.0)


@given(
    east=st.floats(-180.0, 180.0),
    north=st.floats(-60.0, 60.0),
    size=st.floats(0.5, 20.0),
    points=st.integers(3, 40),
    backwards=st.booleans(),
)
def test_cut_rings_keep_the_area_and_turn_counterclockwise(
    east: float, north: float, size: float, points: int, backwards: bool
) -> None:
    angle = np.arange(points) / points * 2.0 * np.pi
    ring = np.column_stack([east + size * np.cos(angle), north + size * np.sin(angle)])
    wrapped = np.column_stack([(ring[:, 0] + 180.0) % 360.0 - 180.0, ring[:, 1]])
    parts = cut_ring(wrapped[::-1] if backwards else wrapped)
    whole = abs(area(np.concatenate([ring, ring[:1]])))
    assert sum(area(part) for part in parts) == pytest.approx(whole, rel=1e-6)
    for part in parts:
        assert (np.abs(part[:, 0]) <= 180.0 + 1e-9).all()
        np.testing.assert_array_equal(part[0], part[-1])


@pytest.mark.parametrize("pole", [90.0, -90.0])
def test_a_ring_around_a_pole_is_closed_over_it(pole: float) -> None:
    east = np.arange(-170.0, 180.0, 20.0)
    parts = cut_ring(np.column_stack([east, np.full(len(east), np.sign(pole) * 85.0)]))
    assert sum(area(part) for part in parts) == pytest.approx(360.0 * 5.0)
    assert any((part[:, 1] == pole).any() for part in parts)


def test_gdal_reads_the_geometries_as_written(tmp_path) -> None:
    rings = cut_ring(np.array([[178.0, 0.0], [178.0, 10.0], [-176.0, 10.0], [-176.0, 0.0]]))
    lines = cut_line(np.array([[178.0, 10.0], [-178.0, 20.0]]))
    layers = (
        Layer("footprints", "MultiPolygon", ("frame",), (Feature(rings, {"frame": 3}),)),
        Layer("tracks", "MultiLineString", ("states",), (Feature(lines, {"states": "é"}),)),
        Layer("craters", "Point", ("d",), (Feature((np.array([[7.0, 8.0]]),), {"d": float("nan")}),)),
        Layer("landmarks", "Point", ("d",), ()),
    )
    path = tmp_path / "map.gpkg"
    path.write_bytes(geopackage_octets(layers))
    assert {str(name) for name, _ in pyogrio.list_layers(path)} == {"footprints", "tracks", "craters"}
    bounds = pyogrio.read_bounds(path, layer="footprints")[1][:, 0]
    np.testing.assert_allclose(bounds, [-180.0, 0.0, 180.0, 10.0])
    assert pyogrio.raw.read(path, layer="tracks")[3][0][0] == "é"
    collection = tmp_path / "map.geojson"
    collection.write_text(format_geojson(layers, "map"))
    assert pyogrio.read_info(collection)["features"] == 3
    np.testing.assert_allclose(pyogrio.read_bounds(collection)[1][:, 0], [-180.0, 0.0, 180.0, 10.0])
