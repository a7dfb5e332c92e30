"""The list of passes by the verdict of their newest report, on each database."""

from typing import Any

from ground_service.evaluation import store
from ground_service.evaluation.model import StoredReport
from ground_service.ground import Ground
from ground_service.passes.model import PassFilter
from ground_service.passes.service import define_pass
from ground_service.passes.store import list_passes
from ground_service.store.stored_files import register_file

NS = 1_000_000_000


def add_report(ground: Ground, pass_id: int, level: str, created_utc_ns: int) -> None:
    stored = ground.files.put_octets(b"report")
    with ground.database.writing() as connection:
        register_file(connection, stored, "report", "report", created_utc_ns)
        store.add_report(
            connection,
            StoredReport(
                id=f"{pass_id:016x}{created_utc_ns:016x}",
                pass_id=pass_id,
                html_sha256=stored.sha256,
                json_sha256=stored.sha256,
                pdf_sha256=None,
                summary={"verdict_level": level},
                mission_id=None,
                event_number=None,
                previous_id=None,
                changes=None,
                created_utc_ns=created_utc_ns,
            ),
        )


def listed(ground: Ground, **terms: Any) -> tuple[list[int], int]:
    page = ground.read(list_passes, PassFilter(**terms))
    found, total = page.items, page.total
    return sorted(one.id for one in found), total


def test_passes_are_listed_by_the_verdict_of_their_newest_report(either: Ground) -> None:
    for hour in range(3):
        start = (1_900_000_000 + 3600 * hour) * NS
        define_pass(
            either,
            name=f"pass {hour}",
            start_utc_ns=start,
            stop_utc_ns=start + 60 * NS,
            spacecraft_id=76,
        )
    add_report(either, 1, "met", 2 * NS)
    add_report(either, 1, "not met", 1 * NS)  # older
    add_report(either, 2, "met", 1 * NS)
    add_report(either, 2, "not met", 3 * NS)
    assert listed(either, verdict="met") == ([1], 1)
    assert listed(either, verdict="not met") == ([2], 1)
    assert listed(either, verdict="unknown") == ([], 0)
    assert listed(either, verdict="none") == ([3], 1)
    assert listed(either, verdict="met", search="pass 1") == ([], 0)
    assert listed(either) == ([1, 2, 3], 3)
