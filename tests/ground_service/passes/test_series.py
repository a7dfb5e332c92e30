"""Series from roll-ups, the same as from the samples; estimates of the filter; images of a spacecraft."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises
from sqlalchemy import event, select

from ground_service.errors import InvalidInput, NotFound
from ground_service.evaluation.core import evaluate_pass
from ground_service.evaluation.inputs import filter_states, load_pass_inputs
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.ingest.store import store_batch
from ground_service.missions.service import add_mission
from ground_service.passes import archive_import, series, store
from ground_service.passes.archive_import import import_archive
from ground_service.passes.live import list_spacecraft
from ground_service.passes.parameters import series_source, spacecraft_parameters
from ground_service.passes.service import detections, trend_series
from ground_service.passes.span import PassSpan, pass_span
from ground_service.passes.store import get_pass
from ground_service.store import repository
from ground_service.store.files import register_file
from ground_service.store.models import ROLLUPS
from ground_service.store.vehicles import vehicle_id
from ground_service.telemetry import rollups
from ground_service.telemetry.decoding import catch_up
from ground_service.telemetry.packets import batch_of_cut
from ground_service.telemetry.rollups import BASE_TICKS, HOUSEKEEPING_VALUES, STATE_VALUES
from ground_service.telemetry.writing import store_samples
from lunar.frames import IauOrientation, rtn_from_inertial, spherical_from_mcmf
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.timescales import parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from tests.ground_service.conftest import NS, SPACECRAFT, define_pass_of, encode_downlink, enter_files
from tests.lazy import Lazy
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.large_data import Thumbnail, pack_thumbnail, split
from tmtc.packets.stream import cut_packets

cv2 = Lazy("cv2")

SECOND = 1 << 16
FIRST = 900_000_000 * SECOND
COUNT = 4000
ALWAYS = (0, (1 << 48) - 1)


@fixture(scope="module")
def columns():
    """Samples of two estimators every 5 s with two silences; some values unknown, two samples at one time."""
    rng = np.random.default_rng(1)
    each = np.arange(COUNT)
    seconds = each * 5
    seconds[1500:] += 4000
    seconds[2500:] += 90_000
    seconds[7] = seconds[6]
    made = {name: rng.normal(size=COUNT) * 1e3 for name in STATE_VALUES}
    made["nis"][::7] = np.nan
    ticks = FIRST + seconds * SECOND
    return made | {
        "matched": rng.integers(0, 20, COUNT), "packet": each, "ticks": ticks + 11, "packet_ticks": ticks,
        "frame_number": each, "estimator": each % 2, "outcome": 0 * each,
    }  # fmt: skip


@fixture
def vehicle(ground, columns):
    """A spacecraft with these samples."""
    return stored(ground, columns, [np.arange(COUNT)])


def stored(ground, columns, batches):
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, 76, "flight")
        for batch in batches:
            chosen = {name: column[batch] for name, column in columns.items()}
            samples = {"navigation_states": chosen | {"packet": np.arange(len(batch))}}
            store_samples(connection, vehicle, DICTIONARY.version, samples, chosen["packet"] + 1)
    return vehicle


def read(ground, span, name="altitude_m", points=50):
    with ground.database.reading() as connection:
        return series.SeriesReading(
            connection,
            PassSpan(*span, (), DICTIONARY.version),
            series.kind_samples("navigation_states", DICTIONARY.version, 1),
            points,
        ).series({name: ""})[0]


def rollup_statistics(ground):
    table = ROLLUPS
    with ground.database.reading() as connection:
        rows = connection.execute(table.select().order_by(*table.primary_key.columns)).all()
    return [tuple(row[:-1]) for row in rows], np.frombuffer(b"".join(row[-1] for row in rows), "<f8")


@fixture
def few(monkeypatch):
    """Few samples are read from roll-ups too."""
    monkeypatch.setattr(series, "FEW_ROWS", 10)
    monkeypatch.setattr(series, "COARSE", 10**9)


@mark.usefixtures("few")
@mark.parametrize("coarse", [0, 10**9], ids=["samples", "roll-ups"])
@mark.parametrize("skip, drop", [(0, 0), (333, 200)])
def test_a_series_of_samples_or_roll_ups_holds_every_sample_once_and_is_as_fine_as_asked_for(
    ground, columns, vehicle, skip, drop, coarse, monkeypatch
):
    monkeypatch.setattr(series, "COARSE", coarse)
    start, stop = int(columns["ticks"][skip]), int(columns["ticks"][-1 - drop])
    mine = (columns["estimator"] == 1) & (columns["ticks"] >= start) & (columns["ticks"] <= stop)
    for name in ("altitude_m", "nis"):
        found = read(ground, (vehicle, start, stop), name)
        values = columns[name][mine]
        known = values[np.isfinite(values)]
        buckets = found.buckets
        assert found.samples == len(values)
        assert buckets.count.sum() == len(known)
        assert len(buckets.count) <= 50
        assert (buckets.low.min(), buckets.high.max()) == (known.min(), known.max())
        # sums of 1000 numbers of size 1e3: 1e-10 is far above rounding
        assert np.sum(buckets.mean * buckets.count) == approx(known.sum(), abs=1e-6)
        assert np.all(buckets.start_utc_ns <= buckets.stop_utc_ns)
        assert np.all(np.diff(buckets.start_utc_ns) > 0)
    whole = read(ground, (vehicle, *ALWAYS)).buckets
    span = (columns["ticks"][-1] - columns["ticks"][0]) / 65536e-9
    assert (whole.stop_utc_ns - whole.start_utc_ns).max() < span / 10


@mark.usefixtures("few")
def test_silences_are_marked(ground, vehicle):
    found = read(ground, (vehicle, *ALWAYS), points=2000).buckets
    after = np.flatnonzero(found.after_gap)
    silence_s = (found.start_utc_ns[after] - found.stop_utc_ns[after - 1]) / 1e9
    assert len(after) == 2 and (silence_s > 3900.0).all()


@mark.usefixtures("vehicle")
def test_late_data_and_split_batches_give_the_same_roll_ups(ground, columns, tmp_path):
    order = np.random.default_rng(5).permutation(COUNT)
    with open_ground(tmp_path / "other") as other:
        stored(other, columns, np.array_split(order, 7))
        heads, statistics = rollup_statistics(other)
    expected_heads, expected = rollup_statistics(ground)
    assert heads == expected_heads
    assert_allclose(statistics, expected, rtol=1e-12, atol=1e-9)  # order of the sums
    # counts, least and greatest values do not depend on it at all
    assert np.array_equal(statistics.reshape(-1, 4)[:, [0, 2, 3]], expected.reshape(-1, 4)[:, [0, 2, 3]])


def test_every_value_of_a_kind_is_rolled_up():
    assert len(HOUSEKEEPING_VALUES) == 23
    assert (HOUSEKEEPING_VALUES[0], HOUSEKEEPING_VALUES[-1]) == ("boot_count", "watchdog_resets")
    assert (STATE_VALUES[0], STATE_VALUES[-1], len(STATE_VALUES)) == ("latitude_deg", "matched", 11)
    assert BASE_TICKS == 64 * SECOND


def test_trends_of_a_spacecraft_need_no_pass(ground, synthetic_pass):
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    found = trend_series(ground, 76, "flight", "temperature_c", 10)
    assert found.samples == 40
    assert found.buckets.low.min() == approx(20.0)
    assert found.buckets.high.max() == approx(23.9)


def test_few_texts_of_the_query_for_buckets_find_any_number_of_them(ground, vehicle):
    """Each text is kept by the program and by the server, so their number must not grow with the numbers of buckets."""
    texts = set()
    event.listen(ground.database.engine, "before_cursor_execute", lambda *given: texts.add(given[2]))
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(ROLLUPS.c.bucket).where(ROLLUPS.c.vehicle_id == vehicle, ROLLUPS.c.level == 0).limit(40)
        )
        buckets = np.unique(list(rows.scalars()))
        texts.clear()
        key = {"vehicle_id": vehicle, "dictionary_version": DICTIONARY.version, "kind": 2, "part": 0, "level": 0}
        for count in range(1, 25):
            wanted = [(key, (buckets[start : start + 4], *[np.zeros(0)] * 4)) for start in range(0, count, 4)]
            whole = {(0, 0): sorted({b for _, (some, *_) in wanted for b in some.tolist()})}
            found = rollups._few_stored(connection, wanted)
            assert {place: sorted(row[0] for row in rows) for place, rows in found.items()} == whole
    assert len(texts) == 4, "for 4, 8, 16 and 32 buckets"


def test_a_misspelled_parameter_is_refused_with_the_nearest_one(ground):
    span = PassSpan(1, FIRST, FIRST + SECOND, (), DICTIONARY.version)
    with raises(NotFound, match=r"parameter temprature_c \(nearest: temperature_c\): not found"):
        ground.read(series_source, span, "temprature_c")


ERROR_RTN_M = np.array([30.0, -40.0, 10.0])
SIGMA_M = np.array([20.0, 50.0, 10.0])
CORRELATION = 0.6
# Radial and transverse errors of 1.5 and -0.8 sigma, correlated by 0.6: (2.25 + 0.64 + 1.44) / 0.64, normal 1.
NEES = (1.5**2 + 0.8**2 + 2.0 * CORRELATION * 1.5 * 0.8) / (1.0 - CORRELATION**2) + 1.0
DIAGONAL = 1.5**2 + 0.8**2 + 1.0


def anchored_packets(made, version):
    """States and estimates of an anchored filter on the orbit of the synthetic pass, erring by `ERROR_RTN_M`."""

    reference = load_ephemeris(made.folder / "reference.oem")
    packets = []
    for k, utc_ns in enumerate(made.utc_ns.tolist()):
        state = np.concatenate([np.ravel(part) for part in reference.at(np.array([utc_ns]))])
        axes = rtn_from_inertial(state[:3], state[3:])
        position = state[:3] + axes.T @ ERROR_RTN_M
        rotation = IauOrientation().mcmf_from_icrf(float(tdb_s_from_utc_ns(utc_ns)))
        latitude, longitude, altitude = (float(x) for x in spherical_from_mcmf(rotation @ position))
        along = np.diag(SIGMA_M**2)
        along[0, 1] = along[1, 0] = CORRELATION * SIGMA_M[0] * SIGMA_M[1]
        covariance = np.diag([0.0] * 3 + [1e-4] * 3 + [1e-12] * 3)
        covariance[:3, :3] = axes.T @ along @ axes
        ticks = int(ticks_from_utc_ns(utc_ns))
        frame = {"frame_number": k, "image_ticks": ticks, "velocity_icrf_m_s": state[3:]}
        values = frame | {"position_icrf_m": position, "acceleration_rtn_m_s2": np.zeros(3)}
        if version == 2:
            estimate = "filter_state", values | {"covariance": covariance[np.tril_indices(9)]}
        else:
            triangle = covariance[np.triu_indices(9)]
            estimate = "filter_estimate", values | {"covariance": triangle, "innovation_degrees": 24}
        state_values = {
            **frame, "estimator": 2, "outcome": "fixed", "latitude_deg": np.degrees(latitude),
            "longitude_deg": np.degrees(longitude) % 360.0, "altitude_m": altitude, "sigma_rtn_m": SIGMA_M,
            "nis": 12.0, "matched": 12,
        }  # fmt: skip
        for n, one in enumerate((estimate, ("navigation_state", state_values))):
            packets.append(DICTIONARY.pack(*one, ticks=ticks + 5 + n, sequence_count=1_000 + 2 * k + n))
    return packets


@fixture(params=[2, 3])
def flown(request, tmp_path, make_pass):
    made = make_pass(frames=8, seed=3)
    path = tmp_path / "anchored.cadu"
    path.write_bytes(encode_cadus(anchored_packets(made, request.param), spacecraft_id=SPACECRAFT))
    return path, made, request.param


def reported(ground, made, packets):
    """Return the anchored series of a report on the synthetic pass with further packets in its downlink."""
    octets = encode_cadus([*made.packets, *packets], spacecraft_id=SPACECRAFT)
    (made.folder / "downlink.cadu").write_bytes(octets)
    enter_files(made.folder)
    report = evaluate_pass(load_pass_inputs(ground, import_archive(ground, made.folder)))
    return next(one for one in report.navigation if one.name == "anchored")


def versions(ground):
    """Return the versions of the dictionary by which states were decoded."""
    chosen = select(repository.SAMPLES["filter_states"].c.dictionary_version)
    with ground.database.reading() as connection:
        return set(connection.execute(chosen).scalars())


def states_of(ground, pass_id):
    with ground.database.reading() as connection:
        return filter_states(connection, pass_span(connection, get_pass(connection, pass_id)))


def test_estimates_of_either_version_are_stored_with_covariance_and_degrees(flown, ground):
    path, made, version = flown
    ingest_file(ground, path)
    found = states_of(ground, define_pass_of(ground, made))
    assert len(found) == 8
    # The axes are those of the estimate, 40 m in 1,767 km (2e-5 rad) from those of the orbit.
    assert_allclose(found.sigma_rtn_m, np.broadcast_to(SIGMA_M, (8, 3)), rtol=1e-4)
    block = found.position_covariance_rtn_m2
    assert_allclose(block[:, 0, 1], CORRELATION * 20.0 * 50.0, rtol=2e-4)
    assert found.innovation_degrees.tolist() == [-1 if version == 2 else 24] * 8
    assert versions(ground) == {DICTIONARY.version}


def test_what_version_2_decoded_is_decoded_again_to_the_same_states(ground, make_pass):
    made = make_pass(frames=8, seed=3)
    octets = b"".join(anchored_packets(made, 2))
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, SPACECRAFT, "flight")
        batch = batch_of_cut(octets, cut_packets(octets), replace(DICTIONARY, version=2), SPACECRAFT)
        store_batch(connection, vehicle, batch)
        repository.change(connection, repository.VEHICLES, vehicle, decoded_version=2)
    pass_id = define_pass_of(ground, made)
    before = states_of(ground, pass_id)
    assert catch_up(ground, vehicle) > 0
    after = states_of(ground, pass_id)
    assert len(before) == len(after) == 8
    assert_array_equal(before.state, after.state)
    assert_array_equal(before.covariance, after.covariance)
    assert versions(ground) == {2, DICTIONARY.version}


def test_the_report_weighs_errors_with_the_whole_covariance(flown, ground):
    _, made, version = flown
    series = reported(ground, made, anchored_packets(made, version))
    # A hundredth of the error: the reference is interpolated, and places are reported on the sphere.
    assert_allclose(series.nees, NEES, rtol=0.01)
    assert series.squared_normalised_errors is None
    assert approx(DIAGONAL, rel=0.3) != NEES
    assert series.nis_dof.tolist() == [24] * 8


def test_sigmas_alone_give_a_sum_of_another_name(ground, make_pass):
    made = make_pass(frames=8, seed=3)
    series = reported(ground, made, anchored_packets(made, 3)[1::2])
    assert series.nees is None
    assert_allclose(series.squared_normalised_errors, DIAGONAL, rtol=0.01)
    # Two pixel coordinates for each of twelve craters.
    assert series.nis_dof.tolist() == [24] * 8


START = parse_utc("2029-08-07T06:00:00Z")
TICKS = int(ticks_from_utc_ns(START))
HOUR_NS = 3600 * NS


def thumbnail(frame_number, ticks):
    levels = np.random.default_rng(frame_number).integers(0, 256, (8, 12), dtype=np.uint8)
    made = Thumbnail(frame_number, ticks, levels)
    return made, pack_thumbnail(made)


def large_data(octets, transaction, ticks, table="thumbnail"):
    """Packets of a transfer; their sequence counts continue those of earlier transfers."""
    parts = split(octets, transaction=transaction, table=table, part_length=50)
    return [
        DICTIONARY.pack(name, values, ticks=ticks + k, sequence_count=100 * transaction + k)
        for k, (name, values) in enumerate(parts)
    ]


@fixture
def receive(ground, tmp_path):
    def run(*packets):
        file = tmp_path / "downlink.cadu"
        file.write_bytes(encode_downlink(list(packets)))
        ingest_file(ground, file, spacecraft_id=SPACECRAFT)

    return run


def images(ground, start=START, stop=START + HOUR_NS):
    return archive_import.list_images(ground, SPACECRAFT, "flight", start, stop)


def picture(ground, ticks=TICKS, colour=True):
    """Return a thumbnail, with detections drawn or in grey."""
    png = archive_import.thumbnail_image(ground, SPACECRAFT, "flight", ticks, detections=colour)
    return decoded(png, cv2.IMREAD_COLOR if colour else cv2.IMREAD_UNCHANGED)


def decoded(png, how):
    return cv2.imdecode(np.frombuffer(png, np.uint8), how)


def test_complete_thumbnails_are_listed_at_the_time_of_their_frame(ground, receive):
    first, octets = thumbnail(1, TICKS)
    second, others = thumbnail(2, TICKS + 15 * SECOND)
    _, incomplete = thumbnail(3, TICKS + 30 * SECOND)
    later = TICKS + 600 * SECOND
    receive(
        *large_data(octets, 1, later),
        *large_data(thumbnail(9, TICKS + SECOND)[1], 2, later + 100, table="landmark_map"),
        *large_data(others, 3, later + 200),
        *large_data(incomplete, 4, later + 300)[:-1],
    )
    found = images(ground)
    assert [(one.frame_number, one.time.utc_ns, one.source) for one in found] == [
        (1, START, "thumbnail"),
        (2, START + 15 * NS, "thumbnail"),
    ]
    assert images(ground, START + NS) == found[1:]
    for one, made in zip(found, (first, second), strict=True):
        ticks = int(one.address.split("/thumbnails/")[1].split("?")[0])
        assert_array_equal(picture(ground, ticks, colour=False), made.levels)
    with raises(NotFound):
        picture(ground, TICKS + 30 * SECOND)
    with raises(InvalidInput, match="at most 31 days"):
        images(ground, stop=START + 32 * 24 * HOUR_NS)


def test_frames_of_an_archive_are_listed_and_read(ground, synthetic_pass):
    pass_id = import_archive(ground, synthetic_pass.folder)
    _, png = cv2.imencode(".png", np.full((1024, 1024), 77, np.uint8))
    stored = ground.files.put_octets(png.tobytes())
    with ground.database.writing() as connection:
        register_file(connection, stored, "frame", "3.png", START)
        store.add_frames(connection, pass_id, {3: stored.sha256})
        record = store.get_pass(connection, pass_id)
    (vehicle,) = {one.instance for one in list_spacecraft(ground)}
    span = record.start_utc_ns, record.stop_utc_ns
    (found,) = archive_import.list_images(ground, SPACECRAFT, vehicle, *span)
    assert (found.frame_number, found.source, found.pass_id) == (3, "archive", pass_id)
    assert record.start_utc_ns < found.time.utc_ns < record.stop_utc_ns
    assert found.address == f"/api/v1/passes/{pass_id}/images/3"
    assert found.overlay == f"{found.address}?detections=true"
    assert archive_import.archived_image(ground, pass_id, 3) == png.tobytes()
    items = detections(ground, pass_id, Paging(limit=1000)).items
    own = [one for one in items if one.frame_number == 3]
    drawn = decoded(archive_import.archived_image(ground, pass_id, 3, detections=True), cv2.IMREAD_COLOR)
    orange = archive_import.ORANGE_BGR
    assert own and set(map(tuple, drawn.reshape(-1, 3).tolist())) == {(77, 77, 77), orange}
    for one in own:
        rim = (round(one.v_px), round(one.u_px) + max(round(one.diameter_px / 2), 1))
        if max(rim) < 1024:
            assert tuple(drawn[rim].tolist()) == orange
    with raises(NotFound, match="image of frame"):
        archive_import.archived_image(ground, pass_id, 4)


MISSION = 'name = "camera"\n[spacecraft]\nid = 76\n[camera]\nwidth_px = 96\nheight_px = 64\n'


def detection(frame_number, ticks, count=1):
    """A report with detections at u = 55.5 and v = 31.5, with a diameter of 16 pixels."""
    shape = {"u_px": 55.5, "v_px": 31.5, "diameter_px": 16.0, "score": 0.9, "size_class": 0, "sigma_px": 1.0}
    items = {name: np.full(count, value) for name, value in shape.items()}
    frame = {"frame_number": frame_number, "image_ticks": ticks, "image_quality": 0, "items": items}
    return DICTIONARY.pack("detections", frame, ticks=ticks + 100, sequence_count=frame_number)


def test_detections_are_drawn_on_an_enlarged_thumbnail_of_a_known_camera(ground, receive):
    made, octets = thumbnail(1, TICKS)  # 12 by 8: one pixel for 8 by 8 of the camera
    later = TICKS + 600 * SECOND
    others = large_data(thumbnail(2, TICKS + 15 * SECOND)[1], 2, later + 200)
    # A report of the same frame number from another time belongs to another frame.
    reports = [detection(1, TICKS), detection(2, TICKS + 40 * SECOND)]
    receive(*reports, *large_data(octets, 1, later), *others)
    found = images(ground)
    assert [one.overlay for one in found] == [None, None]
    with raises(InvalidInput, match=r"camera\.width_px"):
        picture(ground)
    add_mission(ground, MISSION.encode(), actor="ann")
    found = images(ground)
    assert [one.overlay for one in found] == [f"{found[0].address}&detections=true", None]
    drawn = picture(ground)
    assert drawn.shape == (8 * 43, 12 * 43, 3)  # at least 512 wide
    rim = np.argwhere((drawn == archive_import.ORANGE_BGR).all(axis=2))
    scale = 43 / 8
    assert_allclose(rim.mean(axis=0)[::-1], [56.0 * scale - 0.5, 32.0 * scale - 0.5], atol=1.0)
    assert_allclose(np.ptp(rim, axis=0) + 1, 16.0 * scale, atol=2.0)
    assert_array_equal(drawn[::43, ::43, 0][:2], made.levels[:2])  # far from the circle


def test_a_thumbnail_of_a_dark_frame_is_enlarged_without_circles(ground, receive):
    add_mission(ground, MISSION.encode(), actor="ann")
    made, octets = thumbnail(1, TICKS)
    receive(detection(1, TICKS, count=0), *large_data(octets, 1, TICKS + SECOND))
    (found,) = images(ground)
    assert found.overlay
    assert_array_equal(picture(ground)[::43, ::43, 0], made.levels)


def test_states_of_each_estimator_are_parameters_of_the_spacecraft(ground, synthetic_pass):
    import_archive(ground, synthetic_pass.folder)
    (one,) = list_spacecraft(ground)
    listed = {found.name: found for found in spacecraft_parameters(ground, SPACECRAFT, one.instance)}
    name = "navigation_state.spherical.altitude_m"
    assert listed[name].unit == "m" and listed["temperature_c"].packet == "housekeeping"
    assert listed["navigation_state.spherical.velocity_x_m_s"].unit == "m/s"
    found = trend_series(ground, SPACECRAFT, one.instance, name, 1000)
    assert found.samples == 40 and 20e3 < found.buckets.mean.min() < 40e3
    none = trend_series(ground, SPACECRAFT, one.instance, "navigation_state.anchored.altitude_m", 1000)
    assert none.samples == 0
    with raises(NotFound):
        spacecraft_parameters(ground, SPACECRAFT, "flight")
