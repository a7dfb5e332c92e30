"""`linna link`: link settings of a recorded downlink; links to stations, their state, operation and contacts."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._ground import add_service_options, event_of_signals, open_ground_only, settings_of
from linna.commands._table import Command, Commands, CustomCommand, Option
from linna.errors import UsageError
from linna.output import emit, finish, log
from linna.parser import option

if TYPE_CHECKING:
    from ground_service.contacts.links.model import Contacts, LinkStatus
    from linna.parser import LinnaParser
    from tmtc.link.link_check import LinkProposal
    from tmtc.packets.stream import PacketForm

INCONCLUSIVE = 3
SHOWN = 6
_DECLARED = ("frame_length", "coding", "randomiser", "interleave", "rs_errors", "dual_basis", "frame_checksum")
_CODE_ONLY = ("interleave", "rs_errors", "dual_basis")


def _configure_check(parser: LinnaParser) -> None:
    parser.description = (
        "Propose the link settings of a recording from the whole file. Exit status 0: one candidate; "
        "1: it contradicts the mission description; 3: none, or several with equal support."
    )
    option(parser, "file FILE", Path)
    option(parser, "--mission M", Path, "mission description to compare the settings with")
    finish(parser, check)


def check(arguments: argparse.Namespace) -> int:
    from tmtc.downlink import propose_packets, propose_settings

    octets = arguments.file.read_bytes()
    proposal = propose_settings(octets)
    packets, form = 0, None
    if proposal.settings is None and not proposal.has_regular_markers:
        packets, form = propose_packets(octets)
        if not packets:
            raise UsageError(
                f"{arguments.file}: expected CADUs or space packets, found none in its {len(octets)} octets"
            )
    settings = proposal.settings.describe() if proposal.settings is not None else None
    differences = _differences(settings, _declared(arguments.mission)) if settings is not None else []
    figures: dict[str, Any] = {
        "settings": settings,
        "evidence": [one.describe() for one in proposal.evidence],
        "ambiguous": proposal.ambiguous,
        "markers": proposal.markers,
        "distances": dict(list(proposal.distances.items())[:SHOWN]),
        "packets_without_frames": packets,
        "packet_checksum": None if form is None else "crc16" if form.error_control else "none",
        "packet_prefix_octets": None if form is None else form.prefix_octets,
        "contradicts_mission": differences,
    }
    emit(arguments, figures, text="\n".join(_lines(proposal, packets, form, differences)))
    if proposal.ambiguous or (proposal.settings is None and not packets):
        return INCONCLUSIVE
    return 1 if differences else 0


def _declared(path: Path | None) -> dict[str, Any]:
    """Return the link settings that a mission description states; empty without a description."""
    from ground_service.missions.model import parse_mission

    if path is None:
        return {}
    link = parse_mission(path.read_text(encoding="utf-8"), str(path)).link
    return {name: getattr(link, name) for name in _DECLARED if getattr(link, name) is not None}


def _differences(settings: Mapping[str, Any], declared: Mapping[str, Any]) -> list[str]:
    """Return one line for each declared setting that the recording contradicts."""
    lines = []
    for name, stated in declared.items():
        if name in _CODE_ONLY and settings["coding"] == "none":
            continue
        found = settings["checksum" if name == "frame_checksum" else name]
        if found != stated:
            lines.append(f"{name}: the mission states {stated}, the recording has {found}")
    return lines


def _lines(proposal: LinkProposal, packets: int, form: PacketForm | None, differences: list[str]) -> list[str]:
    lines = [f"markers {proposal.markers}"]
    common = list(proposal.distances.items())[:SHOWN]
    if common:
        text = ", ".join(f"{octets} ({times} times)" for octets, times in common)
        lines.append(f"octets between markers: {text}")
    for one in proposal.evidence[:SHOWN]:
        lines.append(
            f"{_named(one.settings.describe())}: of {one.sampled} frames: "
            f"codewords clean {_share(one.codewords_clean)}, repairable {_share(one.codewords_repairable)}, "
            f"checksums {_share(one.checksums_hold)}, headers {_share(one.headers_regular)}; "
            f"{one.packets} packets in consecutive CADUs"
        )
    if proposal.settings is not None:
        lines.append(f"settings: {_named(proposal.settings.describe())}")
    elif form is not None:
        kind = "with" if form.error_control else "without"
        behind = f", each behind {form.prefix_octets} other octets" if form.prefix_octets else ""
        lines.append(f"no frames: {packets} space packets {kind} checksum{behind}")
        stated = [] if form.error_control else ['packet_checksum = "none"']
        stated += [f"packet_prefix_octets = {form.prefix_octets}"] if form.prefix_octets else []
        lines += [f"state in [link] of the mission description: {one}" for one in stated]
    else:
        lines.append("settings: none; no frame is valid under any known setting")
    if proposal.ambiguous:
        lines.append("ambiguous: other candidates have equal support; state the link settings")
    return lines + differences


def _named(settings: Mapping[str, Any]) -> str:
    code = "uncoded"
    if settings["coding"] == "rs":
        basis = "dual" if settings["dual_basis"] else "conventional"
        code = f"Reed-Solomon E={settings['rs_errors']} I={settings['interleave']} {basis} basis"
    check = "with" if settings["checksum"] else "without"
    return f"frames of {settings['frame_length']} octets, {code}, randomiser {settings['randomiser']}, {check} FECF"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _configure_run(parser: LinnaParser) -> None:
    parser.description = "Operate links until stopped, in place of `linna serve` (LINNA_LINKS=false)."
    option(parser, "names LINK", str, "default: all links", nargs="*")
    add_service_options(parser)
    parser.set_defaults(handler=operate)


def operate(arguments: argparse.Namespace) -> int:
    from ground_service.contacts.links.service import declared_links
    from ground_service.contacts.links.supervisor import LinkSupervisor
    from ground_service.worker.dispatch import dispatcher_for
    from ground_service.worker.follow_up import follow_in_process

    stopping = event_of_signals()
    with open_ground_only(arguments) as ground:
        dispatcher = dispatcher_for(ground, settings_of(arguments))
        follow_in_process(ground, dispatcher.start)
        names = frozenset(arguments.names)
        unknown = sorted(names.difference(declared_links(ground)))
        if unknown:
            raise UsageError(f"{unknown[0]}: expected a link of a mission description, found none of this name")
        supervisor = LinkSupervisor(ground, names or None)
        supervisor.start()
        log(f"links: {', '.join(sorted(names)) or 'all'}")
        stopping.wait()
        supervisor.stop()
        dispatcher.close()
    return 0


def _line(link: LinkStatus) -> str:
    reason = f": {link.reason}" if link.reason else ""
    waiting = f", {link.unsent} telecommands wait" if link.unsent else ""
    return f"{link.name} ({link.station or 'no station'}): {link.state}{reason}; {link.octets} octets{waiting}"


def _contacts(found: Contacts) -> str:
    lines = [
        f"{one.start}  {one.stop or 'open':<27}  {one.state:<9} {one.link} ({one.station})"
        f"  {one.octets} octets, {one.telecommands} telecommands{'  ' + one.reason if one.reason else ''}"
        for one in found.contacts
    ]
    lines += [f"{name}: not predicted: {reason}" for name, reason in found.unpredicted.items()]
    return "\n".join(lines) or "no contacts"


LINK: Commands = {
    "check": CustomCommand("propose the link settings of a recording from the whole file", _configure_check),
    "list": Command(
        "list_links",
        "list the links of the mission descriptions with their state",
        _line,
        "links",
        "no mission description states a link",
    ),
    "send": Command(
        "send_link",
        "send the released telecommands now, in a contact or not",
        _line,
        options={"name": Option(metavar="LINK")},
    ),
    "contacts": Command(
        "list_contacts",
        "list past, missed and predicted contacts",
        _contacts,
        options={
            "since": "default: a day before mission time",
            "until": "default: two days after --since",
            "link": Option("contacts of this link only", "LINK"),
        },
    ),
    "run": CustomCommand("operate links in a process of their own", _configure_run),
}
