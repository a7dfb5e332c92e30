"""Roll-ups: series aggregated ahead of time, so that a long one is drawn without reading its samples.

Samples are gathered in buckets of on-board time on several levels, each four times as long as the one below. One row
holds one bucket of all values of a kind: count, sum, least and greatest value of each. Rows are added to in the
transaction that stores new samples, and a packet is stored once, so roll-ups count every sample once in whatever
order samples come. (Sums are of floating-point numbers: their last bits may depend on the order.)
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, Connection, LargeBinary, and_, bindparam, delete, func, or_, select

from ground_service.store.models import HOUSEKEEPING, NAVIGATION_STATES, ROLLUPS
from ground_service.store.repository import FEW_ROWS, insert_columns
from ground_service.store.vehicles import hold
from ground_service.telemetry.store import sample_arrays
from lunar.arrays import FloatArray, IntArray

HOUSEKEEPING_VALUES = tuple(one.name for one in HOUSEKEEPING.c if not one.primary_key)
STATE_VALUES = tuple(one.name for one in NAVIGATION_STATES.c)[8:]
"""Values of roll-ups: the columns after those of the image, the estimator and the outcome."""

KINDS: dict[str, tuple[int, str | None, tuple[str, ...]]] = {
    "housekeeping": (1, None, HOUSEKEEPING_VALUES),
    "navigation_states": (2, "estimator", STATE_VALUES),
}
"""Kinds of samples with roll-ups: code, the column that parts them, and the values (only ever added to at the end)."""

PARAMETERS_CODE = 3
"""Code of the values of packets that mission descriptions define; their parts are the numbers of their containers."""

PACKETS_CODE = 4
"""Code of values that are read from stored packets, which have no roll-ups."""

LEVELS = 7
BASE_TICKS = 64 << 16
"""The shortest buckets are 64 s long, the longest 4^6 times that: three days."""

STATISTICS = 4
"""Numbers kept of each value: count, sum, least, greatest."""

_TABLE: Any = ROLLUPS

_KEY = ("vehicle_id", "dictionary_version", "kind", "part", "level")
_BUCKET = (_TABLE.c.bucket, _TABLE.c.first_ticks, _TABLE.c.last_ticks, _TABLE.c.rows, _TABLE.c.statistics)
_STORED = select(*_BUCKET).where(
    *(_TABLE.c[name] == bindparam(name) for name in _KEY),
    _TABLE.c.bucket.between(bindparam("first_bucket"), bindparam("last_bucket")),
)
_FEW = 4
"""Buckets of one level up to which all levels are looked up together."""

_DELETED = delete(_TABLE).where(
    *(_TABLE.c[name] == bindparam(f"of_{name}") for name in _KEY), _TABLE.c.bucket == bindparam("of_bucket")
)


def width_ticks(level: int) -> int:
    """Length of the buckets of a level."""
    return int(BASE_TICKS * 4**level)


def add_to_rollups(
    connection: Connection, vehicle_id: int, dictionary_version: int, kind: str, columns: Mapping[str, Any]
) -> None:
    """Add new samples to the roll-ups, in the transaction that stores them; columns (n,) as stored.

    The roll-ups of a vehicle are locked until the transaction ends; therefore they are written last.
    """
    if kind not in KINDS or len(columns["ticks"]) == 0:
        return
    code, part_column, names = KINDS[kind]
    ticks = np.asarray(columns["ticks"], dtype=np.int64)
    parts = (
        np.zeros(len(ticks), dtype=np.int64)
        if part_column is None
        else np.asarray(columns[part_column], dtype=np.int64)
    )
    values = np.column_stack([np.asarray(columns[name], dtype=np.float64) for name in names])
    chosen = {part: np.flatnonzero(parts == part) for part in np.unique(parts).tolist()}
    samples = {part: (ticks[rows], values[rows]) for part, rows in chosen.items()}
    add_values(connection, vehicle_id, dictionary_version, code, samples)


def add_values(
    connection: Connection, vehicle_id: int, version: int, code: int, samples: Mapping[int, tuple[IntArray, FloatArray]]
) -> None:
    """Add on-board times (n,) and values (n, v) of each part of a kind, as `add_to_rollups` does."""
    hold(connection, f"rollups {vehicle_id}")
    found: list[tuple[dict[str, int], _Level]] = []
    for part, (ticks, values) in samples.items():
        level_values = _buckets(ticks, values)
        for level in range(LEVELS):
            if level:
                level_values = _merged(*level_values, 4)
            numbers = (vehicle_id, version, code, part, level)
            found.append((dict(zip(_KEY, numbers, strict=True)), level_values))
    _store(connection, found)


def rebuild_rollups(
    connection: Connection, vehicle_id: int, dictionary_version: int, kind: str, ticks: Sequence[int]
) -> None:
    """Aggregate the samples again in the longest buckets that contain these times, after some were removed."""
    if kind not in KINDS:
        return
    code, part_column, names = KINDS[kind]
    wanted = ("ticks", *names) if part_column is None else ("ticks", part_column, *names)
    top = LEVELS - 1
    for bucket in sorted({one // width_ticks(top) for one in ticks}):
        first, last = bucket * width_ticks(top), (bucket + 1) * width_ticks(top) - 1
        for level in range(LEVELS):
            connection.execute(
                delete(_TABLE).where(
                    _TABLE.c.vehicle_id == vehicle_id,
                    _TABLE.c.dictionary_version == dictionary_version,
                    _TABLE.c.kind == code,
                    _TABLE.c.level == level,
                    _TABLE.c.bucket.between(first // width_ticks(level), last // width_ticks(level)),
                )
            )
        where = vehicle_id, first, last, dictionary_version
        columns = sample_arrays(connection, kind, where, wanted)
        add_to_rollups(connection, vehicle_id, dictionary_version, kind, columns)


def forget_rollups(connection: Connection, vehicle_id: int, dictionary_version: int) -> None:
    """Remove the roll-ups of one dictionary version, before its samples are decoded again."""
    forget_values(connection, vehicle_id, dictionary_version, tuple(code for code, _, _ in KINDS.values()))


def forget_values(connection: Connection, vehicle_id: int, version: int, codes: Sequence[int]) -> None:
    """Remove the roll-ups of some kinds in one version."""
    connection.execute(
        delete(_TABLE).where(
            _TABLE.c.vehicle_id == vehicle_id, _TABLE.c.dictionary_version == version, _TABLE.c.kind.in_(codes)
        )
    )


def rollup_rows(
    connection: Connection,
    code: int,
    vehicle_id: int,
    dictionary_version: int,
    part: int,
    level: int,
    first_bucket: int,
    last_bucket: int,
    index: int,
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """First and last on-board time and number of samples (n,) of buckets, and the statistics (n, 4) of one value."""
    length = STATISTICS * 8
    wanted = func.substr(_TABLE.c.statistics, index * length + 1, length, type_=LargeBinary)
    rows = connection.execute(
        select(_TABLE.c.first_ticks, _TABLE.c.last_ticks, _TABLE.c.rows, wanted)
        .where(
            *_of(vehicle_id, dictionary_version, code, part, level), _TABLE.c.bucket.between(first_bucket, last_bucket)
        )
        .order_by(_TABLE.c.bucket)
    ).all()
    if not rows:
        none = np.zeros(0, dtype=np.int64)
        return none, none, none, np.zeros((0, STATISTICS))
    octets = b"".join([row[3] for row in rows])
    whole = np.array([row[:3] for row in rows], dtype=np.int64)
    return whole[:, 0], whole[:, 1], whole[:, 2], np.frombuffer(octets, "<f8").reshape(-1, STATISTICS)


def rolled_extent(
    connection: Connection,
    code: int,
    vehicle_id: int,
    dictionary_version: int,
    part: int,
    start_ticks: int,
    stop_ticks: int,
) -> tuple[int, int, int]:
    """Return the number of samples in the longest buckets that touch a span, and their first and last time."""
    width = width_ticks(LEVELS - 1)
    row = connection.execute(
        select(
            func.coalesce(func.sum(_TABLE.c.rows), 0), func.min(_TABLE.c.first_ticks), func.max(_TABLE.c.last_ticks)
        ).where(
            *_of(vehicle_id, dictionary_version, code, part, LEVELS - 1),
            _TABLE.c.bucket.between(start_ticks // width, stop_ticks // width),
        )
    ).one()
    return int(row[0]), int(row[1] or 0), int(row[2] or 0)


def _of(*key: int) -> list[ColumnElement[bool]]:
    return [_TABLE.c[name] == value for name, value in zip(_KEY, key, strict=True)]


_Level = tuple[IntArray, IntArray, IntArray, IntArray, FloatArray]


def _buckets(ticks: IntArray, values: FloatArray) -> _Level:
    """Bucket numbers (b,), first and last time, rows, statistics (b, v, 4) of samples on the lowest level."""
    order = np.argsort(ticks, kind="stable")
    ticks, values = ticks[order], values[order]
    number = ticks // BASE_TICKS
    starts = np.flatnonzero(np.concatenate(([True], np.diff(number) > 0)))
    ends = np.concatenate((starts[1:], [len(ticks)]))
    known = np.isfinite(values)
    statistics = np.stack(
        [
            np.add.reduceat(known.astype(np.float64), starts, axis=0),
            np.add.reduceat(np.where(known, values, 0.0), starts, axis=0),
            np.minimum.reduceat(np.where(known, values, np.inf), starts, axis=0),
            np.maximum.reduceat(np.where(known, values, -np.inf), starts, axis=0),
        ],
        axis=-1,
    )
    return number[starts], ticks[starts], ticks[ends - 1], (ends - starts).astype(np.int64), statistics


def _merged(
    number: IntArray, first: IntArray, last: IntArray, rows: IntArray, statistics: FloatArray, factor: int
) -> _Level:
    """Buckets put together by bucket number divided by `factor`; numbers have to ascend."""
    number = number // factor
    starts = np.flatnonzero(np.concatenate(([True], np.diff(number) > 0)))
    return (
        number[starts],
        np.minimum.reduceat(first, starts),
        np.maximum.reduceat(last, starts),
        np.add.reduceat(rows, starts),
        np.stack(
            [
                np.add.reduceat(statistics[..., 0], starts, axis=0),
                np.add.reduceat(statistics[..., 1], starts, axis=0),
                np.minimum.reduceat(statistics[..., 2], starts, axis=0),
                np.maximum.reduceat(statistics[..., 3], starts, axis=0),
            ],
            axis=-1,
        ),
    )


def _few_stored(
    connection: Connection, found: Sequence[tuple[Mapping[str, int], _Level]]
) -> dict[tuple[int, int], list[Any]]:
    """Return the stored buckets of the levels with few, by part and level, with one query."""
    wanted = [
        (key["part"], key["level"], bucket)
        for key, level in found
        if level[0].size <= _FEW
        for bucket in level[0].tolist()
    ]
    stored: dict[tuple[int, int], list[Any]] = {}
    if wanted:
        # Few texts of the query, because each one is kept by the program and by the server: the last bucket is repeated
        # up to the next power of two.
        count = 1 << (len(wanted) - 1).bit_length()
        wanted += wanted[-1:] * (count - len(wanted))
        values = {name: found[0][0][name] for name in _KEY[:3]}
        for number, place in enumerate(wanted):
            values |= dict(zip((f"part_{number}", f"level_{number}", f"bucket_{number}"), place, strict=True))
        for part, level_number, *row in connection.execute(_buckets_query(count), values):
            stored.setdefault((part, level_number), []).append(row)
    return stored


@lru_cache(maxsize=16)
def _buckets_query(count: int) -> Any:
    """Return the query for `count` buckets by their whole key, each of which both databases find by the index."""
    common = [_TABLE.c[name] == bindparam(name) for name in _KEY[:3]]
    each = [
        and_(*common, *(_TABLE.c[name] == bindparam(f"{name}_{number}") for name in ("part", "level", "bucket")))
        for number in range(count)
    ]
    return select(_TABLE.c.part, _TABLE.c.level, *_BUCKET).where(or_(*each))


def _store(connection: Connection, found: Sequence[tuple[Mapping[str, int], _Level]]) -> None:
    """Add buckets, by the rest of their key (of one vehicle, version and kind), to the stored ones."""
    merged: list[tuple[Mapping[str, int], _Level]] = []
    replaced: list[dict[str, int]] = []
    few = _few_stored(connection, found)
    for key, (number, first, last, rows, statistics) in found:
        if number.size <= _FEW:
            stored = few.get((key["part"], key["level"]), [])
        else:
            span = {"first_bucket": int(number[0]), "last_bucket": int(number[-1])}
            wanted = set(number.tolist())
            stored = [row for row in connection.execute(_STORED, {**key, **span}) if row[0] in wanted]
        if stored:
            shape = (len(stored), -1, STATISTICS)
            old = np.frombuffer(b"".join(bytes(row[4]) for row in stored), "<f8").reshape(shape)
            heads = np.array([row[:4] for row in stored], dtype=np.int64)
            order = np.argsort(np.concatenate([heads[:, 0], number]), kind="stable")
            number, first, last, rows, statistics = _merged(
                np.concatenate([heads[:, 0], number])[order],
                np.concatenate([heads[:, 1], first])[order],
                np.concatenate([heads[:, 2], last])[order],
                np.concatenate([heads[:, 3], rows])[order],
                np.concatenate([old, statistics])[order],
                1,
            )
            of_key = {f"of_{name}": value for name, value in key.items()}
            replaced += [{**of_key, "of_bucket": int(row[0])} for row in stored]
        merged.append((key, (number, first, last, rows, statistics)))
    sizes = [len(level[0]) for _, level in merged]
    is_small = sum(sizes) <= FEW_ROWS
    if replaced and not is_small:
        connection.execute(_DELETED, replaced)
    insert_columns(
        connection,
        _TABLE,
        {
            **{name: np.repeat([key[name] for key, _ in merged], sizes) for name in _KEY},
            "bucket": np.concatenate([level[0] for _, level in merged]),
            "first_ticks": np.concatenate([level[1] for _, level in merged]),
            "last_ticks": np.concatenate([level[2] for _, level in merged]),
            "rows": np.concatenate([level[3] for _, level in merged]),
            "statistics": [one.tobytes() for _, level in merged for one in np.ascontiguousarray(level[4], dtype="<f8")],
        },
        replace=is_small,
    )
