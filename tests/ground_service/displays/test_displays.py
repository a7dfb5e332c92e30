"""Stored display objects: versions, limits, audit and roles, on both databases."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from pydantic import ValidationError

from ground_service.access.model import AuditFilter
from ground_service.access.store import list_audit
from ground_service.displays import service, store
from ground_service.displays.model import DEPTH_LIMIT, DOCUMENT_LIMIT_OCTETS, DisplayIn
from ground_service.displays.store import list_displays
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.events import read_events
from ground_service.ground import Ground
from ground_service.http.model import Paging


def layout(version: int = 0, **document: object) -> DisplayIn:
    return DisplayIn(name="Pass shift", type="layout", version=version, document=document)


def keep(ground: Ground, given: DisplayIn, actor: str = "eva") -> int:
    return service.keep_display(ground, "mine", given, actor=actor).version


def test_an_object_is_kept_with_its_versions_actors_audit_and_events(either: Ground) -> None:
    ground = either
    assert keep(ground, layout(items=[1, "Sägezahn"])) == 1
    assert keep(ground, layout(1, items=[2]), actor="ida") == 2
    found = ground.read(store.get, "mine")
    assert found.document == {"items": [2]}
    assert (found.created_by, found.changed_by, found.octets) == ("eva", "ida", len('{"items":[2]}'))
    page = ground.read(list_displays, Paging(limit=10, offset=0))
    listed, total = page.items, page.total
    assert total == 1 and [(one.key, one.name, one.version) for one in listed] == [("mine", "Pass shift", 2)]
    service.delete_display(ground, "mine", actor="ida")
    with pytest.raises(NotFound):
        ground.read(store.get, "mine")
    entries = [
        (one.actor, one.action) for one in ground.read(list_audit, AuditFilter(target="display mine")).items
    ]
    assert entries == [("ida", "delete display"), ("ida", "keep display"), ("eva", "keep display")]
    events = [one.payload for one in read_events(ground.database, 0) if one.kind == "display"]
    assert events == [{"key": "mine", "version": 1}, {"key": "mine", "version": 2}, {"key": "mine"}]


@pytest.mark.parametrize("version", [0, 1, 3])
def test_a_version_that_is_not_the_current_one_changes_nothing(either: Ground, version: int) -> None:
    keep(either, layout(items=[1]))
    keep(either, layout(1, items=[2]))
    with pytest.raises(Conflict, match=f"expected version {version}, found 2 of eva"):
        keep(either, layout(version, items=[3]), actor="ida")
    assert either.read(store.get, "mine").document == {"items": [2]}


def test_an_object_that_was_deleted_is_not_replaced(either: Ground) -> None:
    with pytest.raises(NotFound):
        keep(either, layout(4))
    with pytest.raises(NotFound):
        service.delete_display(either, "mine", actor="eva")


def test_one_of_several_simultaneous_changes_succeeds(either: Ground) -> None:
    keep(either, layout())

    def change(number: int) -> bool:
        try:
            keep(either, layout(1, number=number))
        except Conflict:
            return False
        return True

    with ThreadPoolExecutor(4) as threads:
        assert sum(threads.map(change, range(4))) == 1


def test_documents_and_their_number_are_limited(either: Ground, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = len('{"text":""}')
    assert keep(either, layout(text="x" * (DOCUMENT_LIMIT_OCTETS - frame))) == 1
    with pytest.raises(ValidationError, match=f"expected at most {DOCUMENT_LIMIT_OCTETS} octets"):
        layout(text="x" * (DOCUMENT_LIMIT_OCTETS - frame + 1))
    monkeypatch.setattr(service, "OBJECTS_LIMIT", 1)
    with pytest.raises(InvalidInput, match="at most 1 stored objects"):
        service.keep_display(either, "other", layout(), actor="eva")
    assert keep(either, layout(1)) == 2  # a change adds none


def nested(levels: int) -> list[object]:
    return [nested(levels - 1)] if levels > 1 else []


def test_the_depth_of_documents_is_limited(either: Ground) -> None:
    assert keep(either, layout(items=nested(DEPTH_LIMIT - 1))) == 1
    with pytest.raises(ValidationError, match=f"expected at most {DEPTH_LIMIT} levels"):
        layout(items=nested(DEPTH_LIMIT))
    with pytest.raises(ValidationError, match="levels"):
        layout(items=nested(900))


def notebook(version: int = 0, entries: tuple[dict[str, object], ...] = (), **given: object) -> DisplayIn:
    document = {"configuration": {"entries": {"section": {"page": list(entries)}}}} | given
    return DisplayIn(name="Notes", type="notebook", version=version, document=document)


def entry(number: int, text: str, **authors: str) -> dict[str, object]:
    return {"id": f"entry-{number}", "text": text, "createdBy": "ada"} | authors


def authors(ground: Ground) -> list[tuple[object, ...]]:
    found = ground.read(store.get, "mine").document["configuration"]["entries"]["section"]["page"]
    return [tuple(one.get(name) for name in ("createdBy", "modifiedBy", "createdByRole")) for one in found]


def test_authors_of_entries_are_those_who_stored_them(either: Ground) -> None:
    keep(either, notebook(0, (entry(1, "one", createdByRole="director"),), createdBy="ada", modifiedBy="ada"))
    assert authors(either) == [("eva", None, None)]
    given = (entry(1, "one", modifiedBy="ada"), entry(2, "two", modifiedBy="ada"))
    keep(either, notebook(1, given, createdBy="ada", modifiedBy="ada"), "ida")
    assert authors(either) == [("eva", None, None), ("ida", "ida", None)]
    document = either.read(store.get, "mine").document
    assert (document["createdBy"], document["modifiedBy"]) == ("eva", "ida")


def test_a_changed_entry_names_who_changed_it(either: Ground) -> None:
    keep(either, notebook(0, (entry(1, "one"), entry(2, "two"))))
    keep(either, notebook(1, (entry(1, "none"), entry(2, "two"))), "ida")
    changed = ("eva", "ida", "changed by ida")
    assert authors(either) == [changed, ("eva", None, None)]
    keep(either, notebook(2, (entry(1, "none"), entry(2, "2"))))
    assert authors(either) == [changed, ("eva", "eva", None)]


def test_an_entry_without_identifier_is_new(either: Ground) -> None:
    unnamed: dict[str, object] = {"text": "one", "createdBy": "ada"}
    keep(either, notebook(0, (unnamed,), createdBy="ada"))
    keep(either, notebook(1, (unnamed, unnamed | {"id": 4}), createdBy="ada"), "ida")
    assert authors(either) == [("ida", None, None), ("ida", None, None)]
