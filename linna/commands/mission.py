"""`linna mission write | check | add | list | show`: mission descriptions."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    writing = actions.add_parser("write", help="write the mission description of a scenario")
    writing.add_argument("scenario", metavar="SCENARIO", help="scenario file or name")
    writing.add_argument("--out", type=Path, default=Path("mission.toml"), metavar="FILE")
    writing.set_defaults(handler=write)
    checking = actions.add_parser("check", help="check a mission description; print one line for each fault")
    checking.add_argument("file", type=Path, metavar="FILE")
    checking.set_defaults(handler=check)
    adding = actions.add_parser("add", help="add a mission description as a revision")
    adding.add_argument("file", type=Path, metavar="FILE")
    adding.set_defaults(handler=add)
    listing = actions.add_parser("list", help="list the revisions, newest first")
    listing.add_argument("--limit", type=int, default=50, help="largest number of revisions (default: 50)")
    listing.set_defaults(handler=list_missions)
    showing = actions.add_parser("show", help="show a revision")
    showing.add_argument("revision", metavar="REVISION", help="the hash or its first eight digits")
    showing.set_defaults(handler=show)
    for action in (adding, listing, showing):
        add_operator_options(action)
    for action in (writing, checking, adding, listing, showing):
        add_json_flag(action)


def write(arguments: argparse.Namespace) -> int:
    from ground_service.missions.model import parse_mission
    from linna.data import data_folder
    from payload_emulator.session.mission import scenario_mission_text
    from payload_emulator.session.scenario import load_scenario

    text = scenario_mission_text(load_scenario(arguments.scenario), data_folder())
    mission = parse_mission(text, str(arguments.out))
    arguments.out.write_text(text, encoding="utf-8")
    figures = {**_figures(mission), "file": str(arguments.out)}
    emit(arguments, figures, text=f"{arguments.out}\n{_described(figures)}")
    return 0


def check(arguments: argparse.Namespace) -> int:
    from ground_service.missions.service import check_mission_file

    mission, faults = check_mission_file(arguments.file)
    if mission is None:
        figures: dict[str, Any] = {"mission": None, "revision": None, "unknown": [], "faults": faults}
        emit(arguments, figures, text="\n".join(faults))
        return 2
    figures = {**_figures(mission), "faults": []}
    emit(arguments, figures, text=_described(figures))
    return 0


def add(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        figures = service.add_mission(arguments.file).model_dump(mode="json")
    emit(arguments, figures, text=_described(figures))
    return 0


def list_missions(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        page = service.list_missions().page(arguments.limit)
    lines = [
        f"{one.revision[:16]}  {str(one.entered)[:19]}Z  {one.mission}  ({len(one.unknown)} not stated)"
        for one in page.items
    ]
    figures = {"missions": [one.model_dump(mode="json") for one in page.items], "total": page.total}
    emit(arguments, figures, text="\n".join(lines) or "no mission descriptions")
    return 0


def show(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        figures = service.get_mission(arguments.revision).model_dump(mode="json")
    emit(arguments, figures, text=f"{_described(figures)}\n\n{figures['text'].rstrip()}")
    return 0


def _figures(mission: Any) -> dict[str, Any]:
    return {"mission": mission.name, "revision": mission.revision, "unknown": list(mission.unknown)}


def _described(figures: Mapping[str, Any]) -> str:
    unknown = figures["unknown"]
    lines = [f"mission {figures['mission']}, revision {figures['revision'][:16]}"]
    if unknown:
        lines.append(f"not stated ({len(unknown)}): {', '.join(unknown)}")
    return "\n".join(lines)
