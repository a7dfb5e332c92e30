"""`linna landmarks find | list | show | accept | reject | export | table | upload`: craters learned from flight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._table import Command, Option
from linna.errors import UsageError

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.evaluation.landmarks.model import Landmark, LandmarkDetail, LandmarkUpdate


def _find(service: Client, pass_ids: list[int]) -> list[LandmarkUpdate]:
    return [service.find_landmarks(one) for one in pass_ids]


def _export(
    service: Client,
    *,
    catalogue: Path | None = None,
    table: Path | None = None,
    labels: bool = False,
    out: Path,
    spacecraft_id: int | None = None,
) -> dict[str, Any]:
    from ground_service.evaluation.landmarks.service import extended_catalogue, extended_table, format_labels
    from lunar.catalogue import format_catalogue, load_catalogue
    from tmtc.dictionary.tables import pack_catalogue_table, unpack_catalogue_table

    chosen = [catalogue is not None, table is not None, labels]
    if sum(chosen) != 1:
        raise UsageError(f"export: expected one of --catalogue, --table and --labels, found {sum(chosen)}")
    accepted = list(service.list_landmarks(spacecraft_id=spacecraft_id, state="accepted"))
    if table is not None:
        octets = pack_catalogue_table(extended_table(unpack_catalogue_table(_octets(table)), accepted))
    elif catalogue is not None:
        octets = format_catalogue(extended_catalogue(load_catalogue(catalogue), accepted)).encode()
    else:
        octets = format_labels(accepted).encode("ascii")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(octets)
    return {"file": str(out), "landmarks": len(accepted), "octets": len(octets)}


def _table(service: Client, pass_id: int, *, out: Path) -> dict[str, Any]:
    from tmtc.dictionary.tables import table_hash, unpack_catalogue_table

    service.get_onboard_table(pass_id, out)
    octets = out.read_bytes()
    return {"file": str(out), "craters": len(unpack_catalogue_table(octets)), "hash": f"{table_hash(octets):08x}"}


def _upload(
    service: Client, table: Path, *, transaction: int = 1, instance: str = "flight", spacecraft_id: int
) -> dict[str, Any]:
    from ground_service.evaluation.landmarks.service import upload_entries
    from tmtc.dictionary.tables import unpack_catalogue_table

    octets = _octets(table)
    craters = len(unpack_catalogue_table(octets))
    queued = [
        service.enter_telecommand(name, spacecraft_id, arguments=values, instance=instance).id
        for name, values in upload_entries(octets, transaction)
    ]
    return {"telecommands": queued, "craters": craters, "octets": len(octets)}


def _octets(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: expected an anchoring table, found {error.strerror}") from None


def _found(one: LandmarkUpdate) -> str:
    return (
        f"pass {one.pass_id}: {one.unmatched} of {one.detections} detections without a crater, {one.places} places, "
        f"{one.listed} further ones at listed craters, {one.added} new, {one.proposed} landmarks proposed"
    )


def _line(one: Landmark) -> str:
    ending = f" by {one.decided_by}" if one.decided_by else ""
    return (
        f"{one.id:>6}  {one.state:<8} {one.latitude_deg:9.4f} {one.longitude_deg:9.4f}  {one.diameter_m:6.0f} m  "
        f"sigma {one.sigma_east_m:.0f}/{one.sigma_north_m:.0f}/{one.sigma_up_m:.0f} m  "
        f"{one.passes} passes, {one.sightings} of {one.looks} frames{ending}"
    )


def _detail(landmark: LandmarkDetail) -> str:
    evidence = (
        f"  pass {one.pass_id}: {len(one.sightings)} of {one.looks} frames, {one.latitude_deg:.4f} "
        f"{one.longitude_deg:.4f}, {one.controls} calibrating craters"
        for one in landmark.evidence
    )
    return "\n".join([_line(landmark), *evidence])


def _decided(landmark: LandmarkDetail) -> dict[str, Any]:
    return landmark.model_dump(mode="json", exclude={"evidence"})


ONLY = "only of this spacecraft"
WHY = {"reason": "why"}
LANDMARKS = {
    "find": Command(
        _find,
        "search passes for places of detections without a crater",
        _found,
        "passes",
        options={"pass_ids": Option(metavar="PASS")},
    ),
    "list": Command(
        "list_landmarks",
        "list the landmarks, most passes first",
        _line,
        "landmarks",
        "no landmarks",
        options={"spacecraft_id": ONLY},
    ),
    "show": Command("get_landmark", "show a landmark with its sightings", _detail),
    "accept": Command("accept_landmark", "accept a proposed landmark", _line, figures=_decided, options=WHY),
    "reject": Command("reject_landmark", "reject a proposed landmark", _line, figures=_decided, options=WHY),
    "export": Command(
        _export,
        "write the accepted landmarks: a catalogue, an anchoring table, or labels for training",
        lambda made: f"{made['file']}: {made['landmarks']} landmarks, {made['octets']} octets",
        options={
            "catalogue": "crater catalogue to extend; written to --out as CSV",
            "table": "anchoring table on board to extend; written to --out",
            "labels": "labels for `linna detector train --landmarks`",
            "spacecraft_id": ONLY,
        },
    ),
    "table": Command(
        _table,
        "write the anchoring table that was on board at the end of a pass",
        lambda made: f"{made['file']}: {made['craters']} craters, hash {made['hash']}",
        options={"pass_id": Option(metavar="PASS"), "out": "file to write"},
    ),
    "upload": Command(
        _upload,
        "queue the telecommands that upload an anchoring table (PUS 13)",
        lambda made: (
            f"{made['craters']} craters in {len(made['telecommands'])} telecommands: "
            f"{', '.join(map(str, made['telecommands']))}"
        ),
        options={"transaction": "number of the transfer"},
    ),
}
