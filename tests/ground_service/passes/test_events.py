"""Event reports and craters across the passes of a spacecraft."""

from pathlib import Path
from typing import Any

import pytest

from ground_service.errors import NotFound
from ground_service.ground import Ground
from ground_service.http.model import Paging
from ground_service.http.times import UtcTime
from ground_service.ingest.service import ingest_file
from ground_service.passes import service
from ground_service.passes.archive_import import import_archive
from ground_service.passes.model import EventFilter
from lunar.catalogue import load_catalogue
from lunar.timescales import utc_ns_from_ticks
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

TICKS = 900_000_000 * 65_536
HOUR_S = 1000
CODES = {name: code for code, name in DICTIONARY.labels("event_info", "event_id").items()}


def event(second: int, severity: str, name: str) -> bytes:
    values = {"event_id": CODES[name], "frame_number": 7, "value_1": 1.0, "value_2": 2.0}
    return DICTIONARY.pack(f"event_{severity}", values, ticks=TICKS + second * 65_536, sequence_count=second)


def utc_ns(second: int) -> int:
    return int(utc_ns_from_ticks(TICKS + second * 65_536))


@pytest.fixture
def passed(either: Ground, tmp_path: Path) -> Ground:
    """Events of two passes, an hour each, and one between them."""
    given = [
        event(0, "info", "mode_changed"),
        event(10, "high", "camera_fault"),
        event(2 * HOUR_S, "low", "mode_changed"),
        event(5 * HOUR_S, "medium", "image_dark"),
    ]
    file = tmp_path / "events.cadu"
    file.write_bytes(encode_cadus(given, spacecraft_id=76))
    ingest_file(either, file)
    for name, start in (("first", 0), ("second", 5 * HOUR_S)):
        service.define_pass(
            either,
            name=name,
            start_utc_ns=utc_ns(start),
            stop_utc_ns=utc_ns(start + HOUR_S),
            spacecraft_id=76,
        )
    return either


def names(ground: Ground, **filters: Any) -> list[str]:
    page = service.spacecraft_events(ground, EventFilter(spacecraft_id=76, **filters))
    assert page.total >= len(page.items)
    return [one.name for one in page.items]


def test_events_of_all_passes_are_listed_newest_first_with_their_pass(passed: Ground) -> None:
    page = service.spacecraft_events(passed, EventFilter(spacecraft_id=76))
    found, total = page.items, page.total
    assert total == 4
    assert [(one.name, one.severity, one.pass_id) for one in found] == [
        ("image_dark", "medium", 2),
        ("mode_changed", "low", None),
        ("camera_fault", "high", 1),
        ("mode_changed", "info", 1),
    ]
    assert found[0].time.utc_ns == utc_ns(5 * HOUR_S)
    assert found[0].detail == service.list_events(passed, 2, Paging(limit=1)).items[0].detail != ""


def test_events_are_filtered_by_severity_name_and_time(passed: Ground) -> None:
    assert names(passed, severity=["medium", "high"]) == ["image_dark", "camera_fault"]
    assert names(passed, name="Mode chan") == ["mode_changed", "mode_changed"]
    assert names(passed, name="nothing of the kind") == []
    assert names(passed, start=UtcTime(utc_ns(10)), stop=UtcTime(utc_ns(2 * HOUR_S))) == [
        "mode_changed",
        "camera_fault",
    ]
    assert names(passed, start=UtcTime(utc_ns(10) + 1_000_000)) == ["image_dark", "mode_changed"]
    assert names(passed, limit=1, offset=1) == ["mode_changed"]
    assert names(passed, severity=["info"], limit=1) == ["mode_changed"]


def test_events_of_an_unknown_spacecraft_are_not_found(ground: Ground) -> None:
    with pytest.raises(NotFound, match="spacecraft 5"):
        service.spacecraft_events(ground, EventFilter(spacecraft_id=5))


def test_the_craters_of_a_pass_are_listed_the_largest_first(ground: Ground, synthetic_pass: Any) -> None:
    pass_id = import_archive(ground, synthetic_pass.folder)
    catalogue = load_catalogue(synthetic_pass.folder / "catalogue.csv")
    page = service.craters(ground, pass_id, Paging(limit=1000))
    found, total = page.items, page.total
    assert total == len(catalogue) == len(found)
    sizes = [one.diameter_m for one in found]
    assert sizes == sorted(catalogue.diameter_m.tolist(), reverse=True)
    assert all(-180.0 <= one.longitude_deg < 180.0 for one in found)
    assert service.craters(ground, pass_id, Paging(limit=2, offset=1)).items == found[1:3]


def test_a_pass_without_a_catalogue_has_no_craters(passed: Ground) -> None:
    assert service.craters(passed, 1, Paging(limit=10)).total == 0
