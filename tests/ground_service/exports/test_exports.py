"""Exports over HTTP, client and command line, read back with the tools that they are made for."""

import csv
import importlib.util
import io
import json
import re
import sqlite3
import tracemalloc
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from pytest import approx, fixture, mark, raises

from ground_service.access.service import add_user
from ground_service.app import create_app
from ground_service.client import ServiceProblem
from ground_service.client.local import local_client
from ground_service.errors import EvaluationError, FileDamaged, NotFound
from ground_service.exports import service
from ground_service.exports.maps import Feature, Layer, cut_line, cut_ring, format_geojson, geopackage_octets
from ground_service.exports.model import FORMATS, ExportRequest
from ground_service.exports.service import export_pass, list_formats
from ground_service.ground import open_ground
from ground_service.missions import frames as declared
from ground_service.passes.archive_import import import_archive
from ground_service.passes.service import define_pass
from ground_service.settings import Settings
from linna.cli import run
from lunar.camera import PinholeCamera
from lunar.catalogue import load_catalogue
from lunar.frames import (
    IauOrientation,
    matrix_from_quaternion,
    mcmf_from_spherical,
    rtn_from_inertial,
    spherical_from_mcmf,
)
from lunar.messages.aem import parse_aem
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import parse_oem
from lunar.messages.oem_xml import parse_oem_xml
from lunar.messages.spice import camera_id, et_from_utc_ns, spacecraft_id
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from tests.ground_service.conftest import FILTER_ERROR_RTN_M, SPACECRAFT, SPHERICAL_ERROR_RTN_M
from tests.ground_service.evaluation.still import TurnedOrientation
from tests.ground_service.exports.conftest import COVARIANCE, FRAMES
from tests.lazy import Lazy
from tests.serving import TestClient
from tmtc.errors import MissingLibrary

parquet = Lazy("pyarrow.parquet")
pyogrio = Lazy("pyogrio")
spiceypy = Lazy("spiceypy")

CRAFT = spacecraft_id(SPACECRAFT)


@fixture
def export(rich_ground):
    def run(kind, states="reference"):
        request = ExportRequest.model_validate({"pass_id": 1, "format": kind, "states": states})
        found = export_pass(rich_ground, request)
        octets = b"".join(found.blocks())
        assert found.size == len(octets) and found.stream.closed
        return octets

    return run


def unzipped(octets):
    with zipfile.ZipFile(io.BytesIO(octets)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def features(export, layer, states="reference"):
    document = json.loads(export("geojson", states))
    return [one for one in document["features"] if one["properties"]["layer"] == layer]


# Orbit, attitude, SPICE


def test_oem_is_the_reference_in_the_interval_of_the_pass(export, rich_pass):
    found = parse_oem(export("oem").decode())
    assert (found.start_utc_ns, found.stop_utc_ns) == (rich_pass.utc_ns[0], rich_pass.utc_ns[-1])
    between = rich_pass.utc_ns[:-1] + 7_123_456_789
    expected = load_ephemeris(rich_pass.folder / "reference.oem").at(between)[0]
    for one in (found, parse_oem_xml(export("oem-xml"))):
        assert_array_equal(one.at(between)[0], expected)


def errors_rtn_m(rich_pass, utc_ns, position_icrf_m):
    position, velocity = load_ephemeris(rich_pass.folder / "reference.oem").at(utc_ns)
    rtn = rtn_from_inertial(position, velocity)
    return np.einsum("nij,nj->ni", rtn, np.asarray(position_icrf_m) - position)


def rows_of(files, name):
    return list(csv.DictReader(io.StringIO(files[f"{name}.csv"].decode())))


@mark.filterwarnings("ignore:ERFA function")
def test_states_of_the_payload_have_the_errors_of_the_report_in_each_format(export, rich_pass, tmp_path):
    """The inertial axes of the payload are turned by 300 m against ICRF; read by oem, SPICE, json and csv."""
    utc_ns, found = rich_pass.utc_ns, {}
    tdb_s = np.asarray(tdb_s_from_utc_ns(utc_ns))
    icrf_from_mcmf = np.swapaxes(IauOrientation().mcmf_from_icrf(tdb_s), 1, 2)
    for kind in ("oem", "oem-xml", "spk", "czml"):
        (tmp_path / kind).write_bytes(export(kind, "anchored"))
    for kind in ("oem", "oem-xml"):
        states = list(Lazy("oem").OrbitEphemerisMessage.open(tmp_path / kind).states)
        found[kind] = 1e3 * np.array([one.position for one in states])
    with spiceypy.KernelPool(str(tmp_path / "spk")):
        ets = [float(et_from_utc_ns(int(one))) for one in utc_ns]
        found["spk"] = 1e3 * np.array([spiceypy.spkgeo(CRAFT, et, "J2000", 301)[0][:3] for et in ets])
    craft = next(one for one in json.loads((tmp_path / "czml").read_text()) if one["id"] == "spacecraft")
    fixed = {"czml": np.array(craft["position"]["cartesian"]).reshape(-1, 4)[:, 1:]}
    fixed["tum"] = np.loadtxt(io.BytesIO(unzipped(export("tum"))["anchored.tum"]))[:, 1:4]
    found |= {kind: np.einsum("nij,nj->ni", icrf_from_mcmf, one) for kind, one in fixed.items()}
    errors = {kind: errors_rtn_m(rich_pass, utc_ns, position) for kind, position in found.items()}
    rows = rows_of(unzipped(export("csv")), "residuals")
    errors["csv"] = np.array(
        [[float(one[f"error_{axis}_m"]) for axis in "rtn"] for one in rows if one["solution"] == "anchored"]
    )
    for kind, one in errors.items():
        assert_allclose(one, np.tile(FILTER_ERROR_RTN_M, (FRAMES, 1)), atol=0.01, err_msg=kind)


def test_oem_of_the_filter_has_its_covariances_in_icrf(export, rich_pass):
    segment = parse_oem(export("oem", "anchored").decode()).segments[0]
    assert segment.comments[-1] == "evidence level: not stated"
    assert_array_equal(segment.utc_ns, rich_pass.utc_ns)
    for turn, one in zip(rich_pass.onboard_from_icrf, segment.covariances, strict=True):
        both = np.kron(np.eye(2), turn)
        assert one.frame == "ICRF"
        assert_allclose(one.matrix, both.T @ COVARIANCE[:6, :6] @ both, rtol=1e-6, atol=1e-4)


def test_states_without_the_orientation_of_the_payload_are_not_exported(export, monkeypatch):
    monkeypatch.setattr(declared, "_kernel", lambda data: TurnedOrientation("another"))
    with raises(EvaluationError, match=r"turn anchored into ICRF; .* on board DE421, which is not"):
        export("oem", "anchored")


def test_aem_has_the_attitude_of_each_frame(export, rich_pass):
    (segment,) = parse_aem(export("aem").decode())

    assert_array_equal(segment.utc_ns, rich_pass.utc_ns)
    assert_allclose(matrix_from_quaternion(segment.q_wxyz), rich_pass.camera_from_icrf, atol=1e-11)


def test_spice_kernels_together_see_the_detected_crater_in_its_pixel(export, rich_pass, tmp_path, monkeypatch):
    reference = load_ephemeris(rich_pass.folder / "reference.oem")
    for name, octets in unzipped(export("spice")).items():
        (tmp_path / name).write_bytes(octets)
    monkeypatch.chdir(tmp_path)
    with spiceypy.KernelPool("pass-1.tm"):
        for k, utc_ns in enumerate(rich_pass.utc_ns):
            et = float(et_from_utc_ns(int(utc_ns)))
            assert spiceypy.str2et(format_utc(int(utc_ns)).rstrip("Z")) == approx(et, abs=1e-6)
            state, _ = spiceypy.spkgeo(CRAFT, et, "J2000", 301)
            assert_allclose(1e3 * state[:3], reference.at(utc_ns)[0], atol=1e-3)
            if 0 < k < FRAMES - 1:  # the ends of a CK are sharp, and the clock has ticks of 15 us
                turn = spiceypy.pxform("J2000", "SELENITA_CAMERA", et)
                assert_allclose(turn, rich_pass.camera_from_icrf[k], atol=1e-6)
                rate = (spiceypy.pxform("J2000", "SELENITA_CAMERA", et + 1.0) - turn) / 1.0
                found = spiceypy.sxform("J2000", "SELENITA_CAMERA", et + 0.5)
                assert_allclose(found[3:, :3], rate, rtol=0, atol=2e-4)
                # Where does the camera look?
                line = ("SELENITA", "SELENITA_CAMERA", [0.0, 0.0, 1.0])
                seen, *_ = spiceypy.sincpt("ELLIPSOID", "MOON", et, "IAU_MOON", "NONE", *line)
                boresight = rich_pass.camera_from_icrf[k].T @ [0.0, 0.0, 1.0]
                craft = 1e-3 * reference.at(utc_ns)[0]
                middle = -craft @ boresight
                distance = middle - np.sqrt(middle**2 - craft @ craft + 1737.4**2)
                fixed = IauOrientation().mcmf_from_icrf(tdb_s_from_utc_ns(int(utc_ns)))
                # 1e-6 rad of the CK at 30 km, and 2 us of the two formulae of TDB.
                assert_allclose(seen, fixed @ (craft + distance * boresight), rtol=0, atol=1e-4)
        shape, frame, _, _, corners = spiceypy.getfov(camera_id(CRAFT), 8)
    assert (shape, frame) == ("POLYGON", "SELENITA_CAMERA")
    assert_allclose(PinholeCamera().project(corners), PinholeCamera().corners_px(), atol=1e-9)


# Maps


def test_geojson_and_geopackage_have_the_same_features_on_the_moon(export, rich_pass, tmp_path):
    (tmp_path / "pass.geojson").write_bytes(export("geojson"))
    (tmp_path / "pass.gpkg").write_bytes(export("gpkg"))
    document = json.loads((tmp_path / "pass.geojson").read_text())
    counts = Counter(feature["properties"]["layer"] for feature in document["features"])
    layers = {str(name): str(kind) for name, kind in pyogrio.list_layers(tmp_path / "pass.gpkg")}
    assert layers == {
        "tracks": "MultiLineString", "footprints": "MultiPolygon", "detections": "Point", "craters": "Point",
    }  # fmt: skip
    for layer in layers:
        info = pyogrio.read_info(tmp_path / "pass.gpkg", layer=layer)
        assert info["features"] == counts[layer], layer
        assert 'AUTHORITY["IAU","30100"]' in info["crs"]
        assert 'SPHEROID["Moon (2015) - Sphere",1737400,0' in info["crs"]
    assert (counts["footprints"], counts["tracks"]) == (FRAMES, 4)
    with sqlite3.connect(tmp_path / "pass.gpkg") as database:
        columns = {row[1]: row[2] for name in layers for row in database.execute(f"PRAGMA table_info({name})")}
        times = database.execute("SELECT start, stop FROM tracks").fetchall()
    expected = {"utc": "DATETIME", "start": "DATETIME", "stop": "DATETIME", "complete": "BOOLEAN"}
    assert {name: columns[name] for name in expected} == expected
    assert times[0] == tuple(format_utc(int(rich_pass.utc_ns[k]), 0) for k in (0, -1))
    assert "1737400" in pyogrio.read_info(tmp_path / "pass.geojson")["crs"]


def test_located_detections_lie_on_their_craters(export, rich_pass, tmp_path):
    path = tmp_path / "pass.gpkg"
    path.write_bytes(export("gpkg"))
    catalogue = load_catalogue(rich_pass.folder / "catalogue.csv")
    _, _, geometry, values = pyogrio.raw.read(path, layer="detections")
    meta = pyogrio.read_info(path, layer="detections")
    columns = dict(zip(meta["fields"], values, strict=True))
    places = np.array([np.frombuffer(one[-16:], "<f8") for one in geometry])
    rows = {int(number): k for k, number in enumerate(catalogue.ids)}
    known = np.flatnonzero(columns["crater_id"] >= 0)
    assert len(known) == sum(map(len, rich_pass.craters))
    mine = np.array([rows[int(columns["crater_id"][k])] for k in known])
    found = mcmf_from_spherical(np.radians(places[known, 1]), np.radians(places[known, 0]), 0.0)
    true = mcmf_from_spherical(catalogue.latitude_rad[mine], catalogue.longitude_rad[mine], 0.0)
    # 1.35 pixels of 203 m at nadir and rims within 500 m of the sphere: both grow to the edges.
    assert np.median(np.linalg.norm(found - true, axis=1)) < 1000.0


def test_footprints_hold_the_sub_satellite_point_and_detections(export, rich_pass):
    latitude, longitude, _ = spherical_from_mcmf(rich_pass.position_mcmf_m)
    below = mcmf_from_spherical(latitude, longitude, 0.0) / 1_737_400.0
    places = np.degrees(np.column_stack([(longitude + np.pi) % (2 * np.pi) - np.pi, latitude]))
    rings = {
        one["properties"]["frame"]: np.array(one["geometry"]["coordinates"][0][0])
        for one in features(export, "footprints")
    }
    for k in range(FRAMES):
        assert (rings[k].min(axis=0) < places[k]).all() and (places[k] < rings[k].max(axis=0)).all()
        # The true arc to the middle of an edge is 53.4 km at 30 km altitude.
        east, north = np.radians(rings[k].T)
        arc_km = 1737.4 * np.arccos(mcmf_from_spherical(north, east, 0.0) / 1_737_400.0 @ below[k])
        assert arc_km.min() == approx(53.4, abs=0.1)
        assert_array_equal(rings[k][0], rings[k][-1])


def test_maps_of_an_estimator_move_with_its_error(export):
    moved, true = (
        np.array([one["geometry"]["coordinates"] for one in features(export, "detections", states)])
        for states in ("spherical", "reference")
    )
    shift = np.radians(np.linalg.norm(moved - true, axis=1)) * 1_737_400.0
    horizontal = float(np.linalg.norm(SPHERICAL_ERROR_RTN_M[1:]))
    # The radial error shifts points away from nadir, and degrees of longitude are shorter.
    assert np.median(shift) == approx(horizontal, rel=0.25)


def test_czml_is_read_by_czml3_with_the_positions_of_the_reference(export, rich_pass):
    from czml3 import Packet
    from scipy.spatial.transform import Rotation

    packets = json.loads(export("czml"))
    assert packets[0]["id"] == "document" and packets[0]["version"] == "1.0"
    read = {one["id"]: Packet.model_validate(one) for one in packets}
    position = read["spacecraft"].position
    assert position.referenceFrame == "FIXED" and str(position.epoch).startswith("2029-08-07T06:00:00")
    nodes = np.array(position.cartesian.values).reshape(-1, 4)
    assert_allclose(nodes[:, 0], (rich_pass.utc_ns - rich_pass.utc_ns[0]) / 1e9)
    assert_allclose(nodes[:, 1:], rich_pass.position_mcmf_m, atol=1e-3)
    [craft] = [one for one in packets if one["id"] == "spacecraft"]
    q_xyzw = np.array(craft["orientation"]["unitQuaternion"]).reshape(-1, 5)[:, 1:]
    boresight = Rotation.from_quat(q_xyzw).apply([0.0, 0.0, 1.0])
    down = -rich_pass.position_mcmf_m / np.linalg.norm(rich_pass.position_mcmf_m, axis=1, keepdims=True)
    assert_allclose(boresight, down, atol=1e-7)
    assert len(read) == len(packets)


# Tables and packets


def test_csv_tables_have_every_sample_with_units(export, rich_pass):
    files = unzipped(export("csv"))
    tables = {one["url"]: one for one in json.loads(files["csv-metadata.json"])["tables"]}
    assert {*tables, "csv-metadata.json"} == set(files)
    states = rows_of(files, "states")
    assert len(states) == 3 * FRAMES
    assert states[0]["utc"] == "2029-08-07T06:00:00.000000000Z"
    columns = {one["name"]: one for one in tables["states.csv"]["tableSchema"]["columns"]}
    assert columns["altitude_m"]["linna:unit"] == "m"
    assert list(columns) == list(states[0])
    sigmas = {one["sigma_r_m"] for one in rows_of(files, "residuals") if one["solution"] == "spherical"}
    assert sigmas == {""}
    known = [one for one in rows_of(files, "detections") if one["crater_id"] != "-1"]
    assert len(known) == sum(map(len, rich_pass.craters))


def test_netcdf_has_the_tables_as_groups(export, rich_pass, tmp_path):
    import pandas
    import xarray

    path = tmp_path / "pass.nc"
    path.write_bytes(export("netcdf"))
    rows = unzipped(export("csv"))
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        assert tree.attrs["title"] == "synthetic pass"
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ LINNA: pass 1 exported as netCDF", tree.attrs["history"])
        frames = tree["frames"].to_dataset()
        assert_array_equal(frames["utc"].values.astype("datetime64[ns]").astype(np.int64), rich_pass.utc_ns)
        assert tree["detections"]["u_px"].attrs["units"] == "px"
        for name in ("states", "residuals", "detections", "events", "housekeeping", "reference", "attitude"):
            table = pandas.read_csv(io.BytesIO(rows[f"{name}.csv"]))
            for column in table.columns.drop("utc"):
                values = tree[name][column].values
                if table[column].dtype.kind in "if":
                    assert_allclose(values.astype(float), table[column].to_numpy(float))
                else:
                    assert list(values) == list(table[column])


def test_parquet_has_a_file_for_each_packet_type_with_units(export, rich_pass):
    files = unzipped(export("parquet"))
    named = ("detections", "housekeeping", "filter_state", "event_info")
    assert {f"{name}.parquet" for name in named} <= set(files)
    table = parquet.read_table(io.BytesIO(files["housekeeping.parquet"]))
    assert table.num_rows == FRAMES
    assert str(table.schema.field("utc").type) == "timestamp[ns, tz=UTC]"
    stated = table.schema.field("temperature_c").metadata
    assert stated[b"unit"] == b"degC" and stated[b"description"]
    assert table.schema.metadata[b"packet"] == b"housekeeping"
    times = table.column("utc").cast("int64").to_numpy()
    # Housekeeping was packed 400 ticks after each image.
    assert_allclose(times - rich_pass.utc_ns, 400 / 65_536 * 1e9, atol=20_000)


def test_trajectories_differ_by_the_error_and_images_are_those_of_the_archive(export):
    files = unzipped(export("tum"))
    solution, reference = (np.loadtxt(io.BytesIO(files[name])) for name in ("spherical.tum", "spherical-reference.tum"))
    assert len(solution) == FRAMES
    distance = np.linalg.norm(solution[:, 1:4] - reference[:, 1:4], axis=1)
    assert_allclose(distance, np.linalg.norm(SPHERICAL_ERROR_RTN_M), atol=1.0)
    files = unzipped(export("images"))
    assert sorted(files) == ["000000.png", "000004.png", "000008.png"]
    assert np.asarray(Image.open(io.BytesIO(files["000004.png"])))[0, 0] == 40


def test_an_export_of_images_needs_the_memory_of_a_few_of_them(rich_ground, monkeypatch):
    image = np.random.default_rng(1).bytes(1 << 20)
    stored = rich_ground.files.put_octets(image)
    monkeypatch.setattr(service.store, "frame_files", lambda *_: dict.fromkeys(range(64), stored.sha256))
    tracemalloc.start()
    try:
        found = export_pass(rich_ground, ExportRequest(pass_id=1, format="images"))
        size = sum(map(len, found.blocks()))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert size == found.size > 64 << 20
    # The archive in memory until it is moved to disk, twice while it is moved, and some images.
    assert peak < 2 * service.SPOOLED_OCTETS + (6 << 20)


def test_a_damaged_image_refuses_the_export_and_leaves_no_file(rich_ground, monkeypatch):
    files = rich_ground.files
    whole, damaged = (files.put_octets(one).sha256 for one in (bytes(service.SPOOLED_OCTETS + 1), b"an image"))
    files.path(damaged).chmod(0o600)
    files.path(damaged).write_bytes(b"another one")
    monkeypatch.setattr(service.store, "frame_files", lambda *_: {1: whole, 2: damaged})
    before = sorted(files.root.iterdir())
    with raises(FileDamaged):
        export_pass(rich_ground, ExportRequest(pass_id=1, format="images"))
    assert sorted(files.root.iterdir()) == before


# Requests


def test_every_format_is_listed_and_gives_the_same_octets_twice(export):
    assert [one.name for one in list_formats()] == list(FORMATS)
    assert all(one.available for one in list_formats())
    for name in ("oem", "aem", "geojson", "csv", "parquet", "sclk"):
        assert export(name) == export(name), name


@mark.parametrize(
    "kind, states, expected",
    [
        ("oem", "paper", "reference or anchored .downlinked with velocities."),
        ("oem", "truth", "reference or paper or spherical or anchored"),
        ("geojson", "truth", "reference or paper or spherical or anchored"),
    ],
)
def test_states_that_do_not_exist_are_one_line(export, kind, states, expected):
    with raises(EvaluationError, match=f"states: expected {expected}, found '{states}'"):
        export(kind, states)


def test_a_pass_without_content_of_a_format_is_one_line(rich_ground):
    start = 10**18
    empty = define_pass(rich_ground, name="empty", start_utc_ns=start, stop_utc_ns=start + 1, spacecraft_id=SPACECRAFT)
    for kind, message in (
        ("aem", "expected attitudes of its frames, found none"),
        ("parquet", "expected packets, found none"),
        ("images", "expected archived images, found none"),
        ("csv", "expected samples of the payload, found none"),
        ("oem", "states: expected none, found 'reference'"),
        ("geojson", "lunar orientation"),
    ):
        with raises(EvaluationError, match=message):
            export_pass(rich_ground, ExportRequest(pass_id=empty, format=kind))
    with raises(NotFound, match="pass 999: not found"):
        export_pass(rich_ground, ExportRequest(pass_id=999, format="images"))


@mark.parametrize("kind", [name for name, one in FORMATS.items() if one.library])
def test_a_missing_library_is_one_line_with_its_extra(export, monkeypatch, kind):
    usual, chosen = importlib.util.find_spec, FORMATS[kind]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == chosen.library else usual(name))
    expected = rf"export as {kind}: expected the library {chosen.library}, found none; install linna\[{chosen.extra}\]"
    with raises(MissingLibrary, match=expected):
        export(kind)
    assert not next(one for one in list_formats() if one.name == kind).available


@fixture
def linna(rich_ground, tmp_path, capsys):
    """Run an export to a place below `tmp_path`; return its status and what it prints."""

    def export(arguments, place):
        status = run(["export", *arguments.split(), "--out", str(tmp_path / place), "--home", str(rich_ground.home)])
        return status, *capsys.readouterr()

    return export


def test_the_command_writes_one_file_or_several_into_a_folder_or_a_zip(linna, tmp_path):
    status, text, _ = linna("1 --format oem --json", "pass.oem")
    out = tmp_path / "pass.oem"
    assert (status, json.loads(text)["files"]) == (0, [str(out)])
    assert parse_oem(out.read_text()).segments[0].object_name == "SELENITA"
    status, text, _ = linna("1 --format csv --json", "tables")
    assert status == linna("1 --format csv", "tables.zip")[0] == 0
    assert len((tmp_path / "tables/frames.csv").read_text().splitlines()) == 1 + FRAMES
    with zipfile.ZipFile(tmp_path / "tables.zip") as archive:
        assert sorted(archive.namelist()) == sorted(Path(file).name for file in json.loads(text)["files"])


@mark.parametrize(
    "arguments, place, message",
    [
        ("1 --format aem", "folder", "--out: expected a file for aem, found a folder"),
        ("1 --format csv", "file", "--out: expected a folder for csv, found a file"),
        ("7 --format aem", "new", "pass 7: not found"),
        ("1 --format oem --states paper", "new", "expected reference or anchored"),
    ],
)
def test_faults_of_the_command_are_one_line(linna, tmp_path, arguments, place, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    status, text, errors = linna(arguments, place)
    assert (status, text) == (2, "")
    assert message in errors.splitlines()[-1]
    assert not (tmp_path / "new").exists()


def test_the_client_lists_formats_and_names_a_fault(rich_ground, tmp_path):
    with local_client(open_ground(rich_ground.home), "test") as client:
        assert {"oem", "gpkg", "netcdf"} <= {one.name for one in client.list_export_formats()}
        with raises(ServiceProblem, match=r"expected .*reference"):
            client.export_pass(1, "oem", out=tmp_path / "pass.oem", states="truth")
    assert list(tmp_path.iterdir()) == []


def test_the_server_gives_the_file_with_its_name(rich_pass, tmp_path):
    with TestClient(create_app(Settings(home=tmp_path), inline_jobs=True)) as client:
        ground = client.app.state.ground
        import_archive(ground, rich_pass.folder)
        asked = {"pass_id": 1, "format": "aem", "version": "1.0"}
        headers = {"Authorization": f"Bearer {add_user(ground, 'viewer', 'viewer')}"}
        assert client.post("/api/v1/exports", json=asked).status_code == 401
        answer = client.post("/api/v1/exports", json=asked, headers=headers)
        assert answer.status_code == 200
        assert answer.headers["Content-Disposition"] == 'attachment; filename="pass-1.aem"'
        assert answer.content.startswith(b"CCSDS_AEM_VERS = 1.0")
        for wrong in ({"pass_id": 1, "format": "doc"}, {"pass_id": 1}, {"pass_id": "1", "format": "aem"}):
            assert client.post("/api/v1/exports", json=wrong, headers=headers).status_code == 422
        assert client.get("/api/v1/exports/formats", headers=headers).json()[0]["name"] == "oem"


def area(ring):
    x, y = ring.T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2.0


def test_a_line_or_ring_across_the_meridian_is_cut_on_it_and_no_other():
    west, east = cut_line(np.array([[178.0, 10.0], [-178.0, 20.0], [-170.0, 20.0]]))
    assert_allclose(west, [[178.0, 10.0], [180.0, 15.0]])
    assert_allclose(east, [[-180.0, 15.0], [-178.0, 20.0], [-170.0, 20.0]])
    line = np.array([[-10.0, 0.0], [0.0, 5.0], [170.0, 0.0]])
    (part,) = cut_line(line)
    assert_allclose(part, line)
    spans = sorted((part[:, 0].min(), part[:, 0].max()) for part in cut_ring(RING))
    assert_allclose(spans, [(-180.0, -176.0), (178.0, 180.0)])


RING = np.array([[178.0, 0.0], [178.0, 10.0], [-176.0, 10.0], [-176.0, 0.0]])


@given(
    east=st.floats(-180.0, 180.0),
    north=st.floats(-60.0, 60.0),
    size=st.floats(0.5, 20.0),
    points=st.integers(3, 40),
    backwards=st.booleans(),
)
def test_cut_rings_keep_the_area_and_turn_counterclockwise(east, north, size, points, backwards):
    angle = np.arange(points) / points * 2.0 * np.pi
    ring = np.column_stack([east + size * np.cos(angle), north + size * np.sin(angle)])
    wrapped = np.column_stack([(ring[:, 0] + 180.0) % 360.0 - 180.0, ring[:, 1]])
    parts = cut_ring(wrapped[::-1] if backwards else wrapped)
    whole = abs(area(np.concatenate([ring, ring[:1]])))
    assert sum(area(part) for part in parts) == approx(whole, rel=1e-6)
    for part in parts:
        assert (np.abs(part[:, 0]) <= 180.0 + 1e-9).all()
        assert_array_equal(part[0], part[-1])


@mark.parametrize("pole", [90.0, -90.0])
def test_a_ring_around_a_pole_is_closed_over_it(pole):
    east = np.arange(-170.0, 180.0, 20.0)
    parts = cut_ring(np.column_stack([east, np.full(len(east), np.sign(pole) * 85.0)]))
    assert sum(area(part) for part in parts) == approx(360.0 * 5.0)
    assert any((part[:, 1] == pole).any() for part in parts)


def test_gdal_reads_the_geometries_as_written(tmp_path):
    rings = cut_ring(RING)
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
    bounds = [-180.0, 0.0, 180.0, 10.0]
    assert_allclose(pyogrio.read_bounds(path, layer="footprints")[1][:, 0], bounds)
    assert pyogrio.raw.read(path, layer="tracks")[3][0][0] == "é"
    collection = tmp_path / "map.geojson"
    collection.write_text(format_geojson(layers, "map"))
    assert pyogrio.read_info(collection)["features"] == 3
    assert_allclose(pyogrio.read_bounds(collection)[1][:, 0], bounds)
