"""Series from roll-ups: the same as from the samples, in whatever order they came, gaps marked."""

from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, select

from ground_service.errors import NotFound
from ground_service.ground import Ground
from ground_service.ingest.store import store_samples
from ground_service.passes import series
from ground_service.passes.parameters import series_source
from ground_service.passes.service import trend_series
from ground_service.passes.span import PassSpan
from ground_service.store import rollups
from ground_service.store.models import ROLLUPS
from ground_service.store.rollups import BASE_TICKS, HOUSEKEEPING_VALUES, STATE_VALUES
from ground_service.store.vehicles import vehicle_id
from tmtc.dictionary.payload import DICTIONARY

SECOND = 1 << 16
FIRST = 900_000_000 * SECOND
COUNT = 4000


def states(seed: int = 1) -> dict[str, Any]:
    """Samples of two estimators every 5 s with two silences; some values unknown, two samples at one time."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(COUNT) * 5
    seconds[1500:] += 4000
    seconds[2500:] += 90_000
    seconds[7] = seconds[6]
    columns: dict[str, Any] = {name: rng.normal(size=COUNT) * 1e3 for name in STATE_VALUES}
    columns["matched"] = rng.integers(0, 20, COUNT)
    columns["nis"][::7] = np.nan
    columns.update(
        packet=np.arange(COUNT),
        ticks=FIRST + seconds * SECOND + 11,
        packet_ticks=FIRST + seconds * SECOND,
        frame_number=np.arange(COUNT),
        estimator=np.arange(COUNT) % 2,
        outcome=np.zeros(COUNT, dtype=np.int64),
    )
    return columns


def stored(ground: Ground, columns: dict[str, Any], batches: list[np.ndarray]) -> int:
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, 76, "flight")
        for batch in batches:
            chosen = {name: column[batch] for name, column in columns.items() if name != "packet"}
            chosen["packet"] = np.arange(len(batch))
            store_samples(
                connection,
                vehicle,
                DICTIONARY.version,
                {"navigation_states": chosen},
                columns["packet"][batch] + 1,
            )
    return vehicle


def read(ground: Ground, vehicle: int, name: str, start: int, stop: int, points: int = 50) -> Any:
    with ground.database.reading() as connection:
        return series.SeriesReading(
            connection,
            PassSpan(vehicle, start, stop, (), DICTIONARY.version),
            series.kind_samples("navigation_states", DICTIONARY.version, 1),
            points,
        ).series({name: ""})[0]


def rollup_statistics(ground: Ground) -> tuple[list[Any], np.ndarray]:
    table: Any = ROLLUPS
    with ground.database.reading() as connection:
        rows = connection.execute(table.select().order_by(*table.primary_key.columns)).all()
    return [tuple(row[:-1]) for row in rows], np.frombuffer(b"".join(row[-1] for row in rows), "<f8")


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few samples are read from roll-ups too."""
    monkeypatch.setattr(series, "FEW_ROWS", 10)
    monkeypatch.setattr(series, "COARSE", 10**9)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("coarse", [0, 10**9], ids=["samples", "roll-ups"])
@pytest.mark.parametrize(("skip", "drop"), [(0, 0), (333, 200)])
def test_a_series_of_samples_or_roll_ups_holds_every_sample_once(
    ground: Ground, skip: int, drop: int, coarse: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(series, "COARSE", coarse)
    columns = states()
    vehicle = stored(ground, columns, [np.arange(COUNT)])
    start, stop = int(columns["ticks"][skip]), int(columns["ticks"][-1 - drop])
    for name in ("altitude_m", "nis"):
        found = read(ground, vehicle, name, start, stop)
        mine = (columns["estimator"] == 1) & (columns["ticks"] >= start) & (columns["ticks"] <= stop)
        values = columns[name][mine]
        known = values[np.isfinite(values)]
        buckets = found.buckets
        assert found.samples == np.count_nonzero(mine)
        assert buckets.count.sum() == len(known)
        assert len(buckets.count) <= 50
        assert (buckets.low.min(), buckets.high.max()) == (known.min(), known.max())
        # sums of 1000 numbers of size 1e3: 1e-10 is far above rounding
        assert np.sum(buckets.mean * buckets.count) == pytest.approx(known.sum(), abs=1e-6)
        assert np.all(buckets.start_utc_ns <= buckets.stop_utc_ns)
        assert np.all(np.diff(buckets.start_utc_ns) > 0)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("coarse", [0, 10**9], ids=["samples", "roll-ups"])
def test_a_series_of_all_time_is_as_fine_as_asked_for(
    ground: Ground, coarse: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(series, "COARSE", coarse)
    columns = states()
    vehicle = stored(ground, columns, [np.arange(COUNT)])
    found = read(ground, vehicle, "altitude_m", 0, (1 << 48) - 1).buckets
    span = (columns["ticks"][-1] - columns["ticks"][0]) / 65536e-9
    assert (found.stop_utc_ns - found.start_utc_ns).max() < span / 10


@pytest.mark.usefixtures("few")
def test_silences_are_marked(ground: Ground) -> None:
    columns = states()
    vehicle = stored(ground, columns, [np.arange(COUNT)])
    found = read(ground, vehicle, "altitude_m", 0, (1 << 48) - 1, points=2000).buckets
    assert np.count_nonzero(found.after_gap) == 2
    for place in np.flatnonzero(found.after_gap):
        silence = (found.start_utc_ns[place] - found.stop_utc_ns[place - 1]) / 1e9
        assert silence > 3900.0


def test_late_data_and_split_batches_give_the_same_roll_ups(ground: Ground, tmp_path: Any) -> None:
    from ground_service.ground import open_ground

    columns = states()
    stored(ground, columns, [np.arange(COUNT)])
    order = np.random.default_rng(5).permutation(COUNT)
    with open_ground(tmp_path / "other") as other:
        stored(other, columns, np.array_split(order, 7))
        heads, statistics = rollup_statistics(other)
    expected_heads, expected = rollup_statistics(ground)
    assert heads == expected_heads
    np.testing.assert_allclose(statistics, expected, rtol=1e-12, atol=1e-9)  # order of the sums
    # counts, least and greatest values do not depend on it at all
    assert np.array_equal(statistics.reshape(-1, 4)[:, [0, 2, 3]], expected.reshape(-1, 4)[:, [0, 2, 3]])


def test_every_value_of_a_kind_is_rolled_up() -> None:
    assert len(HOUSEKEEPING_VALUES) == 23
    assert (HOUSEKEEPING_VALUES[0], HOUSEKEEPING_VALUES[-1]) == ("boot_count", "watchdog_resets")
    assert (STATE_VALUES[0], STATE_VALUES[-1], len(STATE_VALUES)) == ("latitude_deg", "matched", 11)
    assert BASE_TICKS == 64 * SECOND


def test_trends_of_a_spacecraft_need_no_pass(ground: Ground, synthetic_pass: Any) -> None:
    from ground_service.ingest.service import ingest_file

    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    found = trend_series(ground, 76, "flight", "temperature_c", 10)
    assert found.samples == 40
    assert found.buckets.low.min() == pytest.approx(20.0)
    assert found.buckets.high.max() == pytest.approx(23.9)


def test_few_texts_of_the_query_for_buckets_find_any_number_of_them(ground: Ground) -> None:
    """Each text is kept by the program and by the server, so their number must not grow with the numbers of buckets."""
    columns = states()
    vehicle = stored(ground, columns, [np.arange(COUNT)])
    texts: set[str] = set()
    event.listen(ground.database.engine, "before_cursor_execute", lambda *given: texts.add(given[2]))
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(ROLLUPS.c.bucket).where(ROLLUPS.c.vehicle_id == vehicle, ROLLUPS.c.level == 0).limit(40)
        )
        buckets = np.unique(list(rows.scalars()))
        texts.clear()
        key = {
            "vehicle_id": vehicle,
            "dictionary_version": DICTIONARY.version,
            "kind": 2,
            "part": 0,
            "level": 0,
        }
        for count in range(1, 25):
            wanted = [(key, (buckets[start : start + 4], *[np.zeros(0)] * 4)) for start in range(0, count, 4)]
            whole = {(0, 0): sorted({b for _, (some, *_) in wanted for b in some.tolist()})}
            found = rollups._few_stored(connection, wanted)
            assert {place: sorted(row[0] for row in rows) for place, rows in found.items()} == whole
    assert len(texts) == 4, "for 4, 8, 16 and 32 buckets"


def test_a_misspelled_parameter_is_refused_with_the_nearest_one(ground: Ground) -> None:
    span = PassSpan(1, FIRST, FIRST + SECOND, (), DICTIONARY.version)
    with pytest.raises(NotFound, match=r"parameter temprature_c \(nearest: temperature_c\): not found"):
        ground.read(series_source, span, "temprature_c")
