"""`linna link check`: link settings of a recorded downlink, with the evidence."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from tmtc.link_check import LinkProposal

INCONCLUSIVE = 3
SHOWN = 6
_DECLARED = (
    "frame_length",
    "coding",
    "randomiser",
    "interleave",
    "rs_errors",
    "dual_basis",
    "frame_checksum",
)
_CODE_ONLY = ("interleave", "rs_errors", "dual_basis")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    checking = actions.add_parser(
        "check",
        help="propose the link settings of a recording from the whole file",
        description="Propose the link settings of a recording from the whole file. Exit status 0: one candidate; "
        "1: it contradicts the mission description; 3: none, or several with equal support.",
    )
    checking.add_argument("file", type=Path, metavar="FILE")
    checking.add_argument(
        "--mission", type=Path, metavar="M", help="mission description to compare the settings with"
    )
    add_json_flag(checking)
    checking.set_defaults(handler=check)


def check(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError
    from tmtc.downlink import decode, propose_settings

    octets = arguments.file.read_bytes()
    proposal = propose_settings(octets)
    packets = 0
    if proposal.settings is None and not proposal.has_regular_markers:
        packets = decode(octets).packets
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
        "contradicts_mission": differences,
    }
    emit(arguments, figures, text="\n".join(_lines(proposal, packets, differences)))
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


def _lines(proposal: LinkProposal, packets: int, differences: list[str]) -> list[str]:
    lines = [f"markers {proposal.markers}"]
    common = list(proposal.distances.items())[:SHOWN]
    if common:
        text = ", ".join(f"{octets} ({times} times)" for octets, times in common)
        lines.append(f"octets between markers: {text}")
    for one in proposal.evidence[:SHOWN]:
        lines.append(
            f"{_named(one.settings.describe())}: of {one.sampled} frames: codewords clean {_share(one.clean)}, "
            f"repairable {_share(one.repaired)}, checksums {_share(one.checksums)}, headers {_share(one.regular)}; "
            f"{one.packets} packets in consecutive CADUs"
        )
    if proposal.settings is not None:
        lines.append(f"settings: {_named(proposal.settings.describe())}")
    elif packets:
        lines.append(f"no frames: {packets} space packets without frames")
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
