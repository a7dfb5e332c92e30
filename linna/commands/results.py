"""`linna pass | report | export | performance | alarm`: passes, reports, exports, trends over passes, alarms."""

from __future__ import annotations

import argparse
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._ground import add_operator_options, ground_client, server_of, settings_of
from linna.commands._table import Command, Option, as_json
from linna.errors import UsageError
from linna.output import emit, finish, log
from linna.parser import RawFormatter, option

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.evaluation.model import PassFigures
    from ground_service.evaluation.performance.model import Performance
    from ground_service.passes.alarms.model import Alarm, AlarmDetail
    from ground_service.passes.model import PassSummary


def _listed(item: PassSummary) -> dict[str, Any]:
    times = {"start": f"{item.start[:23]}Z", "stop": f"{item.stop[:23]}Z"}
    return {"pass_id": item.id, "name": item.name, **times}


def _pass_line(item: PassSummary) -> str:
    return f"{item.id:>6}  {item.start[:23]}Z  {item.stop[:23]}Z  {item.name}"


def describe(found: PassFigures) -> str:
    """Return the metrics of a pass as lines of text."""
    figures = as_json(found)
    lines = [
        f"pass {figures['pass_id']}: {figures['frames']} frames, {figures['packets']} packets, "
        f"{figures['packets_lost']} lost",
        figures["verdict"],
    ]
    for kind in ("navigation", "baselines"):
        for name, row in figures[kind].items():
            drift = row["drift_percent"]
            lines.append(
                f"  {name:<16} median {_metres(row['median_3d_m'])}, 95 % {_metres(row['p95_3d_m'])}, "
                f"largest {_metres(row['max_3d_m'])}, drift {'-' if drift is None else f'{drift:.3f} %'}"
            )
    lines += requirement_lines(figures.get("requirements") or [])
    detector = figures["detector"]
    if detector["recall"] is not None:
        lines.append(
            f"  detector         precision {detector['precision']:.2f}, recall {detector['recall']:.2f}, "
            f"localisation {detector['loc_px']:.2f} px"
        )
    return "\n".join(lines)


def requirement_lines(requirements: list[dict[str, Any]]) -> list[str]:
    """Return the judged requirements as lines of text, failures first, those of the experiment marked."""
    order = ("not met", "unknown", "met")
    judged = [one for one in requirements if one["status"] in order]
    marks = {"experiment": "experiment, "}
    return [
        f"  {one['status']:<8} {marks.get(one['question'], '')}{one['name']}: {_figure(one['value'], one['unit'])}, "
        f"limit {one['relation']} {_figure(one['limit'], one['unit'])}"
        + (f" ({one['note']})" if one["note"] and one["status"] != "met" else "")
        for one in sorted(judged, key=lambda one: order.index(one["status"]))
    ]


def _figure(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}".rstrip()


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} m"


PASS = {
    "list": Command(
        "list_passes",
        "list passes, newest first",
        _pass_line,
        "passes",
        "no passes: telemetry alone makes none; a pass is a flown window, an imported archive, or a defined interval",
        _listed,
        options={"search": "part of the name", "verdict": "verdict of the newest report; none: without a report"},
    ),
    "show": Command("evaluate_pass", "evaluate a pass and show its metrics", describe),
}


def configure_report(parser: argparse.ArgumentParser) -> None:
    option(parser, "pass_id PASS", int, "number of the pass (see linna pass list)")
    option(
        parser,
        "--out DIR",
        Path,
        "folder for the documents (default: reports/pass-N in the home folder; with a server: pass-N)",
    )
    add_operator_options(parser)
    finish(parser, run_report)


def run_report(arguments: argparse.Namespace) -> int:
    folder = arguments.out or _default_folder(arguments)
    log("evaluating the pass ...")
    with ground_client(arguments) as service:
        report_id = service.make_report(arguments.pass_id)
        for kind in ("html", "json", "pdf"):
            service.get_report(report_id, folder / f"report.{kind}", format=kind)
        summary = service.get_report_summary(report_id).model_dump(mode="json")
    figures: dict[str, Any] = {
        "report": str(folder / "report.html"),
        "report_json": str(folder / "report.json"),
        "report_pdf": str(folder / "report.pdf"),
        "report_id": report_id,
        **summary,
    }
    lines = [figures["report"], figures["verdict"], *requirement_lines(figures.get("requirements") or [])]
    return emit(arguments, figures, text="\n".join(lines))


def _default_folder(arguments: argparse.Namespace) -> Path:
    name = f"pass-{arguments.pass_id}"
    if server_of(arguments) is not None:
        return Path(name)
    home: Path = settings_of(arguments).home.expanduser().absolute()
    return home / "reports" / name


def configure_export(parser: argparse.ArgumentParser) -> None:
    from ground_service.exports.model import FORMATS, REFERENCE

    parser.formatter_class = RawFormatter
    parser.epilog = "formats:\n" + "\n".join(f"  {one.name:<8} {one.description}" for one in FORMATS.values())
    option(parser, "pass_id PASS", int, "number of the pass (see linna pass list)")
    option(parser, "--format FORMAT", FORMATS, "one of the list below", required=True)
    option(
        parser,
        "--out F",
        Path,
        "file to write; for formats of several files a folder, or a name ending in .zip",
        required=True,
    )
    option(
        parser,
        "--states NAME",
        str,
        f"states of orbits and maps: {REFERENCE} (default), or the name of an estimator",
        default=REFERENCE,
    )
    option(parser, "--version V", ("1.0", "2.0"), "version of a CCSDS AEM", "2.0")
    add_operator_options(parser)
    finish(parser, run_export)


def run_export(arguments: argparse.Namespace) -> int:
    from ground_service.exports.model import FORMATS

    out: Path = arguments.out
    unpacked = FORMATS[arguments.format].several_files and out.suffix.lower() != ".zip"
    if out.exists() and out.is_dir() != unpacked:
        expected, found = ("a folder", "a file") if unpacked else ("a file", "a folder")
        raise UsageError(f"--out: expected {expected} for {arguments.format}, found {found} {str(out)!r}")
    log(f"exporting pass {arguments.pass_id} as {arguments.format} ...")
    with ground_client(arguments) as service, tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "export.zip" if unpacked else out
        service.export_pass(
            arguments.pass_id, arguments.format, target, states=arguments.states, version=arguments.version
        )
        files = _unpack(target, out) if unpacked else [out]
    figures = {
        "pass_id": arguments.pass_id,
        "format": arguments.format,
        "files": [str(file) for file in files],
        "octets": sum(file.stat().st_size for file in files),
    }
    return emit(arguments, figures, text="\n".join(figures["files"]))


def _unpack(archive: Path, folder: Path) -> list[Path]:
    """Write the files of an archive into a folder, under their plain names."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with zipfile.ZipFile(archive) as opened:
        for entry in opened.infolist():
            path = folder / Path(entry.filename).name
            path.write_bytes(opened.read(entry))
            written.append(path)
    return written


METRICS = {"recall": ("%", 100.0, 1), "drift_percent": ("% of path", 1.0, 3), "median_error_m": ("m", 1.0, 0)}
"""Unit, scale and decimals of the metrics."""


def performance_lines(found: Performance) -> str:
    """Return the performance as lines of text."""
    missing = found.passes_in_span - len(found.passes)
    lines = [f"{len(found.passes)} passes with a report" + (f", {missing} without" if missing else "")]
    for one in found.groups:
        unit, scale, decimals = METRICS[one.metric]
        if one.mean is None:
            continue
        between = "interval unknown"
        if one.low is not None and one.high is not None:
            between = f"{scale * one.low:.{decimals}f} to {scale * one.high:.{decimals}f}"
        value = f"{scale * one.mean:.{decimals}f} {unit} ({between}, {one.passes} passes)"
        lines.append(f"  {one.factor}, {one.group}: {one.metric} {value}")
    for change in found.changes:
        unit, scale, decimals = METRICS[change.metric]
        lines.append(
            f"  change of {change.metric} at pass {change.pass_id} ({change.time}): "
            f"{scale * change.before:.{decimals}f} -> {scale * change.after:.{decimals}f} {unit}, "
            f"p = {change.p_value:.3g}"
        )
    if found.passes and not found.changes:
        lines.append("  no change of level")
    for rule in found.requirements:
        judged = rule.met + rule.not_met
        status = f"met on {rule.met} of {judged} judged passes" if judged else "not judged"
        remark = f"; {rule.remark}" if rule.remark else ""
        lines.append(f"  {rule.name}, last {found.window_days:g} days: {status}, unknown on {rule.unknown}{remark}")
    return "\n".join(lines)


def _report(service: Client, *, spacecraft_id: int, instance: str = "flight", month: str, out: Path) -> dict[str, Any]:
    made = service.add_monthly_report(spacecraft_id, month, instance=instance)
    for kind in ("html", "pdf", "json"):
        service.get_monthly_report(made.id, out / f"report.{kind}", format=kind)
    return {"report": str(out / "report.html"), **as_json(made)}


PERFORMANCE = {
    "show": Command(
        "get_performance",
        "show recall, drift and error by condition, changes of level, and requirements",
        performance_lines,
        options={
            "instance": "instance (default: the flown one if it has passes, otherwise all imported passes)",
            "start": "only passes from this time",
            "stop": "only passes before this time",
            "window_days": Option("rolling window of the requirements", "D"),
        },
    ),
    "report": Command(
        _report,
        "write the report of a month as HTML, PDF and JSON",
        lambda made: f"{made['report']}\n{made['verdict']}",
        options={
            "month": Option("month (UTC)", "YYYY-MM"),
            "out": Option("folder for the documents of the report", "DIR"),
        },
    ),
    "list": Command(
        "list_monthly_reports",
        "list the monthly reports",
        lambda one: (
            f"{one.month}  spacecraft {one.spacecraft_id} ({one.instance})  {one.passes:4} passes  "
            f"{one.verdict}  {one.id}"
        ),
        "reports",
        "there is no monthly report",
        options={"spacecraft_id": "only of this spacecraft"},
        limit=None,
    ),
}


def _alarm_line(alarm: Alarm) -> str:
    value = "" if alarm.value is None else f", last {alarm.value:g} {alarm.unit} (limits {alarm.limits})"
    return (
        f"{alarm.id:>6}  {alarm.last[:19]}Z  {alarm.severity:<7} {alarm.state:<12} "
        f"{alarm.name.replace('_', ' ')}, {alarm.count} packets{value}"
    )


def _alarm_lines(alarm: AlarmDetail) -> str:
    history = (f"        {one.time[:19]}Z  {one.actor}: {one.change} {one.comment}" for one in alarm.history)
    return "\n".join([_alarm_line(alarm), *(one.rstrip() for one in history)])


COMMENT = {"comment": "comment for the history"}
ALARM = {
    "list": Command(
        "list_alarms",
        "list alarms, open ones first",
        _alarm_line,
        "alarms",
        "no alarms",
        options={"state": "only alarms in this state; can be repeated", "severity": "only alarms of this severity"},
    ),
    "show": Command("get_alarm", "show an alarm with its history", _alarm_lines),
    "acknowledge": Command("acknowledge_alarm", "acknowledge an alarm", _alarm_lines, options=COMMENT),
    "shelve": Command(
        "shelve_alarm",
        "suppress an alarm until a time",
        _alarm_lines,
        options=COMMENT | {"until": "end of the suppression (RFC 3339); in the past: end it now"},
    ),
}
