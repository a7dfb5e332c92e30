"""`linna plan`: search, planning, approval, uplink and exchange of observation windows."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from ground_service.planning.model import Window

RANGE = ("MIN", "MAX")


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    ephemeris = actions.add_parser("ephemeris", help="add a reference ephemeris (OEM, STK .e, Horizons CSV)")
    ephemeris.add_argument("file", type=Path)
    ephemeris.add_argument("--name")
    ephemeris.add_argument("--precedence", type=int, default=0)
    ephemeris.set_defaults(handler=add_ephemeris)
    searching = actions.add_parser("search", help="search candidate windows over a reference ephemeris")
    _search_options(searching)
    searching.set_defaults(handler=search)
    adding = actions.add_parser("add", help="enter a window as a draft")
    adding.add_argument("--start", required=True, metavar="UTC")
    adding.add_argument("--stop", required=True, metavar="UTC")
    adding.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    adding.add_argument("--instance", default="flight")
    adding.add_argument("--name", default="observation")
    adding.add_argument("--cadence-s", type=float, default=15.0)
    adding.add_argument("--after", type=int, metavar="ID", help="window that must precede this one")
    adding.add_argument("--approve", action="store_true", help="approve the window as well")
    adding.set_defaults(handler=add)
    listing = actions.add_parser("list", help="list planned windows, newest first")
    listing.add_argument("--limit", type=int, default=100)
    listing.set_defaults(handler=list_all)
    parsers = [ephemeris, searching, adding, listing]
    for name, handler, text in (
        ("show", show, "show a window"),
        ("approve", decide, "approve a draft"),
        ("draft", decide, "return a window to the state draft"),
        ("fail", decide, "mark a window as failed"),
        ("delete", delete, "remove a window from the plan"),
        ("uplink", uplink, "release the time-tagged telecommands of a window"),
    ):
        one = actions.add_parser(name, help=text)
        one.add_argument("window_id", type=int, metavar="ID")
        if name == "uplink":
            one.add_argument(
                "--out",
                type=Path,
                metavar="FILE",
                help="write all released telecommands as CLTUs; they count as sent",
            )
        if name == "fail":
            one.add_argument("--reason", required=True)
        one.set_defaults(handler=handler, action=name)
        parsers.append(one)
    _configure_requests(actions)
    exporting = actions.add_parser("export", help="write the plan as JSON")
    exporting.add_argument("--out", type=Path, required=True, metavar="FILE")
    exporting.set_defaults(handler=export)
    importing = actions.add_parser("import", help="enter the windows of a plan as drafts, all or none")
    importing.add_argument("file", type=Path)
    importing.set_defaults(handler=import_file)
    for one in (*parsers, exporting, importing):
        add_operator_options(one)
        add_json_flag(one)


def _search_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--start", metavar="UTC", help="default: start of the ephemeris")
    parser.add_argument("--stop", metavar="UTC", help="default: end of the ephemeris")
    parser.add_argument("--ephemeris-id", type=int, metavar="ID")
    parser.add_argument(
        "--spacecraft-id",
        type=int,
        metavar="N",
        help="consider the data that this spacecraft has already stored",
    )
    for name, unit in (("altitude", "km"), ("sun-elevation", "deg"), ("latitude", "deg")):
        parser.add_argument(f"--{name}-{unit}", type=float, nargs=2, metavar=RANGE)
    parser.add_argument(
        "--craters-per-frame", type=float, metavar="N", help="minimum number of catalogued craters in a frame"
    )
    parser.add_argument(
        "--catalogue-pass-id", type=int, metavar="ID", help="use the crater catalogue of this pass"
    )
    parser.add_argument("--terrain", choices=("mare", "highland"))
    parser.add_argument(
        "--sunlit", action="store_true", help="require that the spacecraft is in full sunlight"
    )
    parser.add_argument("--minimum-duration-s", type=float, metavar="S")
    parser.add_argument("--maximum-duration-s", type=float, metavar="S")
    parser.add_argument("--minimum-battery", type=float, metavar="SHARE")
    parser.add_argument(
        "--needs-contact",
        action="store_true",
        help="require that the data are downlinked within the time span",
    )
    parser.add_argument("--cadence-s", type=float, metavar="S")
    parser.add_argument("--step-s", type=float, metavar="S")


def add_ephemeris(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        made = service.add_ephemeris(arguments.file, name=arguments.name, precedence=arguments.precedence)
    text = f"ephemeris {made.id} ({made.name}): {made.start} to {made.stop}"
    emit(arguments, made.model_dump(mode="json"), text=text)
    return 0


def search(arguments: argparse.Namespace) -> int:
    names = (
        "start", "stop", "ephemeris_id", "spacecraft_id", "craters_per_frame", "catalogue_pass_id", "terrain",
        "minimum_duration_s", "maximum_duration_s", "minimum_battery", "cadence_s", "step_s",
    )  # fmt: skip
    request: dict[str, Any] = {name: getattr(arguments, name) for name in names}
    for name in ("altitude_km", "sun_elevation_deg", "latitude_deg"):
        limits = getattr(arguments, name)
        request[name] = None if limits is None else {"min": limits[0], "max": limits[1]}
    request = {name: value for name, value in request.items() if value is not None}
    request |= {"sunlit": arguments.sunlit, "needs_contact": arguments.needs_contact}
    with ground_client(arguments) as service:
        found = service.search_windows(request)
    lines = [
        f"{str(one.start)[:19]}Z  {str(one.stop)[:19]}Z  {one.frames:>4} frames  "
        f"{one.altitude_km.min:.1f} to {one.altitude_km.max:.1f} km  "
        f"Sun {one.sun_elevation_deg.min:.0f} to {one.sun_elevation_deg.max:.0f} deg"
        for one in found.candidates
    ]
    lines.append(f"{len(found.candidates)} candidates; data: {'; '.join(found.data)}")
    emit(arguments, found.model_dump(mode="json"), text="\n".join(lines))
    return 0


def add(arguments: argparse.Namespace) -> int:
    request = {
        "name": arguments.name,
        "start": arguments.start,
        "stop": arguments.stop,
        "cadence_s": arguments.cadence_s,
        "spacecraft_id": arguments.spacecraft_id,
        "instance": arguments.instance,
        "predecessor_id": arguments.after,
    }
    with ground_client(arguments) as service:
        window = service.add_window(request)
        if arguments.approve:
            window = service.change_window(window.id, {"state": "approved"})
    return _show(arguments, window)


def list_all(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        page = service.list_windows().page(arguments.limit)
    text = "\n".join(_line(window) for window in page.items) or "no windows"
    windows = [window.model_dump(mode="json") for window in page.items]
    emit(arguments, {"windows": windows, "total": page.total}, text=text)
    return 0


def show(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        return _show(arguments, service.get_window(arguments.window_id))


def decide(arguments: argparse.Namespace) -> int:
    state = {"approve": "approved", "draft": "draft", "fail": "failed"}[arguments.action]
    request = {"state": state}
    if arguments.action == "fail":
        request["reason"] = arguments.reason
    with ground_client(arguments) as service:
        return _show(arguments, service.change_window(arguments.window_id, request))


def delete(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        service.delete_window(arguments.window_id)
    emit(arguments, {"deleted": arguments.window_id}, text=f"window {arguments.window_id}: deleted")
    return 0


def uplink(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        released = service.uplink_window(arguments.window_id)
        if arguments.out is not None:
            window = service.get_window(arguments.window_id)
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            with arguments.out.open("wb") as file:
                file.write(service.take_uplink(window.spacecraft_id, instance=window.instance).octets)
    lines = [f"telecommand {one.id} ({one.name}): {one.state}" for one in released]
    telecommands = [one.model_dump(mode="json") for one in released]
    emit(arguments, {"window_id": arguments.window_id, "telecommands": telecommands}, text="\n".join(lines))
    return 0


def export(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        plan = service.export_plan().model_dump(mode="json")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(plan, indent=2) + "\n", encoding="utf-8")
    figures = {"file": str(arguments.out), "windows": len(plan["windows"])}
    emit(arguments, figures, text=f"{arguments.out}: {len(plan['windows'])} windows")
    return 0


def import_file(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError

    try:
        plan = json.loads(arguments.file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        raise UsageError(f"{arguments.file}: expected a plan as JSON, found other text") from None
    if not isinstance(plan, dict):
        raise UsageError(f"{arguments.file}: expected a plan as a JSON object, found {type(plan).__name__}")
    with ground_client(arguments) as service:
        made = service.import_plan(plan)
    lines = [f"{key}: window {number}" for key, number in made.windows.items()]
    emit(arguments, made.model_dump(mode="json"), text="\n".join(lines))
    return 0


def _show(arguments: argparse.Namespace, window: Window) -> int:
    emit(arguments, window.model_dump(mode="json"), text=_line(window))
    return 0


def _line(window: Window) -> str:
    reason = f" ({window.reason})" if window.reason else ""
    return (
        f"{window.id:>4}  {str(window.start)[:19]}Z  {str(window.stop)[:19]}Z  {window.state}{reason}  "
        f"{window.name}"
    )


def _configure_requests(actions: Any) -> None:
    requests = actions.add_parser("request", help="standing requests, which the planner keeps in the plan")
    kinds = requests.add_subparsers(metavar="ACTION", required=True)
    adding = kinds.add_parser("add", help="add a standing request")
    adding.add_argument("--name", required=True)
    adding.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
    adding.add_argument("--instance", default="flight")
    adding.add_argument("--windows", type=int, required=True, metavar="N", help="windows in each period")
    adding.add_argument("--period-days", type=float, default=7.0, metavar="D")
    adding.add_argument(
        "--horizon-days", type=float, default=3.0, metavar="D", help="days ahead (default: 3)"
    )
    adding.add_argument("--sun", type=float, nargs=2, metavar=RANGE, help="Sun elevation, degrees")
    adding.add_argument("--altitude", type=float, nargs=2, metavar=RANGE, help="altitude, km")
    adding.add_argument("--latitude", type=float, nargs=2, metavar=RANGE, help="latitude, degrees")
    adding.add_argument(
        "--longitude", type=float, nargs=2, metavar=("WEST", "EAST"), help="degrees, to the east"
    )
    adding.add_argument("--duration", type=float, nargs=2, metavar=RANGE, help="duration, seconds")
    adding.add_argument(
        "--minimum-battery", type=float, metavar="SHARE", help="share of its capacity (default: 0.3)"
    )
    adding.set_defaults(handler=add_request)
    listing = kinds.add_parser("list", help="list the standing requests, newest first")
    listing.set_defaults(handler=list_requests)
    parsers = [adding, listing]
    for name, text in (
        ("plan", "show the candidates of the last plan with the reasons"),
        ("pause", "plan no further windows"),
        ("resume", "plan windows again"),
        ("delete", "delete a standing request; its windows stay"),
    ):
        one = kinds.add_parser(name, help=text)
        one.add_argument("request_id", type=int, metavar="ID")
        one.set_defaults(handler=show_request_plan if name == "plan" else change_request, action=name)
        parsers.append(one)
    for one in parsers:
        add_operator_options(one)
        add_json_flag(one)


def add_request(arguments: argparse.Namespace) -> int:
    def limits(pair: list[float] | None) -> dict[str, float] | None:
        return None if pair is None else {"min": pair[0], "max": pair[1]}

    request: dict[str, Any] = {
        "name": arguments.name,
        "spacecraft_id": arguments.spacecraft_id,
        "instance": arguments.instance,
        "windows": arguments.windows,
        "period_days": arguments.period_days,
        "horizon_days": arguments.horizon_days,
        "sun_elevation_deg": limits(arguments.sun),
        "altitude_km": limits(arguments.altitude),
        "minimum_battery": arguments.minimum_battery,
    }
    if arguments.duration is not None:
        request["minimum_duration_s"], request["maximum_duration_s"] = arguments.duration
    region: dict[str, Any] = {"latitude_deg": limits(arguments.latitude)}
    if arguments.longitude is not None:
        region["west_deg"], region["east_deg"] = arguments.longitude
    region = {key: value for key, value in region.items() if value is not None}
    if region:
        request["regions"] = [region]
    with ground_client(arguments) as service:
        added = service.add_request({key: value for key, value in request.items() if value is not None})
    emit(arguments, added.model_dump(mode="json"), text=f"standing request {added.id}: {added.state}")
    return 0


def list_requests(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        found = list(service.list_requests())
    lines = [
        f"{one.id:>4}  {one.state:<7} {one.name}: {one.terms.windows} in {one.terms.period_days:g} days; "
        + (", ".join(f"{number} {state}" for state, number in one.windows.items()) or "no windows yet")
        for one in found
    ]
    figures = {"requests": [one.model_dump(mode="json") for one in found]}
    emit(arguments, figures, text="\n".join(lines) or "no standing requests")
    return 0


def show_request_plan(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        plan = service.get_request_plan(arguments.request_id)
    lines = [plan.reason] if plan.reason else []
    for one in plan.candidates:
        outcome = f"window {one.window_id}" if one.window_id is not None else f"rejected: {one.reason}"
        lines.append(f"{one.start}  {one.stop}  {outcome}")
    lines += [f"window {one['window_id']} failed: {one['reason']}" for one in plan.replaced]
    emit(arguments, plan.model_dump(mode="json"), text="\n".join(lines) or "no candidates")
    return 0


def change_request(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        if arguments.action == "delete":
            service.delete_request(arguments.request_id)
            emit(arguments, {"deleted": arguments.request_id}, text=f"request {arguments.request_id} deleted")
            return 0
        state = "paused" if arguments.action == "pause" else "active"
        found = service.change_request(arguments.request_id, {"state": state})
    emit(arguments, found.model_dump(mode="json"), text=f"standing request {found.id}: {found.state}")
    return 0
