"""`linna landmarks find | list | show | accept | reject | export | upload`: craters learned from flight."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from ground_service.landmarks.model import Landmark


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    finding = actions.add_parser("find", help="search passes for places of detections without a crater")
    finding.add_argument("pass_ids", type=int, nargs="+", metavar="PASS")
    finding.set_defaults(handler=find)
    listing = actions.add_parser("list", help="list the landmarks, most passes first")
    listing.add_argument("--state", choices=("seen", "proposed", "accepted", "rejected"))
    listing.add_argument("--limit", type=int, default=50, metavar="N", help="largest number (default: 50)")
    listing.set_defaults(handler=list_all)
    showing = actions.add_parser("show", help="show a landmark with its sightings")
    showing.set_defaults(handler=show)
    accepting = actions.add_parser("accept", help="accept a proposed landmark")
    rejecting = actions.add_parser("reject", help="reject a proposed landmark")
    for action, accept in ((accepting, True), (rejecting, False)):
        action.add_argument("--reason", default="", help="why")
        action.set_defaults(handler=decide, accept=accept)
    for action in (showing, accepting, rejecting):
        action.add_argument("landmark_id", type=int, metavar="ID")
    exporting = actions.add_parser(
        "export", help="write the accepted landmarks: a catalogue, an anchoring table, or labels for training"
    )
    exporting.add_argument(
        "--catalogue", type=Path, metavar="F", help="crater catalogue to extend; written to --out as CSV"
    )
    exporting.add_argument(
        "--table", type=Path, metavar="F", help="anchoring table on board to extend; written to --out"
    )
    exporting.add_argument(
        "--labels", action="store_true", help="labels for `linna detector train --landmarks`"
    )
    exporting.add_argument("--out", type=Path, required=True, metavar="F")
    exporting.set_defaults(handler=export)
    uploading = actions.add_parser(
        "upload", help="queue the telecommands that upload an anchoring table (PUS 13)"
    )
    uploading.add_argument("table", type=Path, metavar="TABLE")
    uploading.add_argument(
        "--transaction", type=int, default=1, metavar="N", help="number of the transfer (default: 1)"
    )
    uploading.add_argument(
        "--instance", default="flight", help="instance of the spacecraft (default: flight)"
    )
    uploading.set_defaults(handler=upload)
    for action in (listing, exporting):
        action.add_argument("--spacecraft-id", type=int, metavar="N", help="only of this spacecraft")
    uploading.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    for action in (finding, listing, showing, accepting, rejecting, exporting, uploading):
        add_operator_options(action)
        add_json_flag(action)


def find(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        found = [service.find_landmarks(one) for one in arguments.pass_ids]
    lines = [
        f"pass {one.pass_id}: {one.unmatched} of {one.detections} detections without a crater, {one.places} places, "
        f"{one.added} new, {one.proposed} landmarks proposed"
        for one in found
    ]
    emit(arguments, {"passes": [one.model_dump(mode="json") for one in found]}, text="\n".join(lines))
    return 0


def list_all(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        page = service.list_landmarks(spacecraft_id=arguments.spacecraft_id, state=arguments.state).page(
            arguments.limit
        )
    figures = {"landmarks": [one.model_dump(mode="json") for one in page.items], "total": page.total}
    emit(arguments, figures, text="\n".join(_line(one) for one in page.items) or "no landmarks")
    return 0


def show(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        landmark = service.get_landmark(arguments.landmark_id)
    lines = [_line(landmark)]
    lines += [
        f"  pass {one.pass_id}: {len(one.sightings)} of {one.looks} frames, {one.latitude_deg:.4f} "
        f"{one.longitude_deg:.4f}, {one.controls} calibrating craters"
        for one in landmark.evidence
    ]
    emit(arguments, landmark.model_dump(mode="json"), text="\n".join(lines))
    return 0


def decide(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        decision = service.accept_landmark if arguments.accept else service.reject_landmark
        landmark = decision(arguments.landmark_id, reason=arguments.reason)
    emit(arguments, landmark.model_dump(mode="json", exclude={"evidence"}), text=_line(landmark))
    return 0


def export(arguments: argparse.Namespace) -> int:
    from ground_service.landmarks.documents import extended_catalogue, extended_table, format_labels
    from linna.errors import UsageError
    from lunar.catalogue import format_catalogue, load_catalogue
    from tmtc.tables import pack_catalogue_table, unpack_catalogue_table

    chosen = [arguments.catalogue is not None, arguments.table is not None, arguments.labels]
    if sum(chosen) != 1:
        raise UsageError(f"export: expected one of --catalogue, --table and --labels, found {sum(chosen)}")
    with ground_client(arguments) as service:
        accepted = list(service.list_landmarks(spacecraft_id=arguments.spacecraft_id, state="accepted"))
    if arguments.labels:
        octets = format_labels(accepted).encode("ascii")
    elif arguments.catalogue is not None:
        octets = format_catalogue(extended_catalogue(load_catalogue(arguments.catalogue), accepted)).encode()
    else:
        table = unpack_catalogue_table(_octets(arguments.table))
        octets = pack_catalogue_table(extended_table(table, accepted))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_bytes(octets)
    figures = {"file": str(arguments.out), "landmarks": len(accepted), "octets": len(octets)}
    emit(arguments, figures, text=f"{arguments.out}: {len(accepted)} landmarks, {len(octets)} octets")
    return 0


def upload(arguments: argparse.Namespace) -> int:
    from ground_service.landmarks.documents import upload_entries
    from tmtc.tables import unpack_catalogue_table

    octets = _octets(arguments.table)
    craters = len(unpack_catalogue_table(octets))
    with ground_client(arguments) as service:
        queued = [
            service.enter_telecommand(
                name, arguments.spacecraft_id, arguments=values, instance=arguments.instance
            ).id
            for name, values in upload_entries(octets, arguments.transaction)
        ]
    figures = {"telecommands": queued, "craters": craters, "octets": len(octets)}
    emit(
        arguments,
        figures,
        text=f"{craters} craters in {len(queued)} telecommands: {', '.join(map(str, queued))}",
    )
    return 0


def _octets(path: Path) -> bytes:
    from linna.errors import UsageError

    try:
        return path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: expected an anchoring table, found {error.strerror}") from None


def _line(one: Landmark) -> str:
    ending = f" by {one.decided_by}" if one.decided_by else ""
    return (
        f"{one.id:>6}  {one.state:<8} {one.latitude_deg:9.4f} {one.longitude_deg:9.4f}  {one.diameter_m:6.0f} m  "
        f"sigma {one.sigma_east_m:.0f}/{one.sigma_north_m:.0f}/{one.sigma_up_m:.0f} m  "
        f"{one.passes} passes, {one.sightings} of {one.looks} frames{ending}"
    )
