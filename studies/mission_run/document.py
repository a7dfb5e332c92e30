"""The closing report of a mission run as an HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from reports.document import (
    Absent,
    Block,
    Cell,
    Column,
    Document,
    Facts,
    Heading,
    Paragraph,
    Picture,
    Table,
    Verdict,
)
from reports.html_page import html_page
from reports.text import NOT_A_VALUE, count_text, duration_text, number_text, significant_text
from studies.mission_run.pictures import draw_memory, draw_windows

Figures = Mapping[str, Any]
Row = tuple[Cell | str, ...]

TREND_LABELS = {"median_m": "median error, m", "drift_percent": "drift, % of path", "recall": "recall"}
STATUSES = ("met", "not met", "unknown", "not judged")
PARTS = ("ground", "run", "spacecraft", "link", "api", "worker", "scheduler", "database", "broker")


def save_document(figures: Figures, path: Path) -> None:
    """Write the page of closing figures."""
    path.write_text(html_page(mission_document(figures)), encoding="utf-8")


def mission_document(figures: Figures) -> Document:
    """Return the document of the closing figures."""
    blocks: list[Block] = [
        _verdict(figures),
        Heading("Operations"),
        Facts(tuple(_operations(figures))),
        Heading("Windows"),
        *_windows(figures),
        Heading("Navigation and detection"),
        *_performance(figures),
        Heading("Requirements"),
        *_requirements(figures),
        Heading("Time correlation"),
        *_correlations(figures),
    ]
    if figures.get("kills"):
        blocks += [Heading("Kills"), *_kills(figures["kills"])]
    blocks += [Heading("Processes"), *_processes(figures)]
    blocks += [Heading("Incidents"), *_incidents(figures)]
    blocks += [Heading("Interventions"), *_interventions(figures)]
    facts = (
        ("Scenario", str(figures["scenario"])),
        ("Simulated", f"{figures['days']:g} days, to {figures['end']}"),
        ("Form", str(figures.get("form", "unknown"))),
        ("Wall time", duration_text(figures["wall_s"])),
        ("Starts", count_text(figures["starts"])),
        ("Evidence", _counts(figures["evidence"]) or "unknown"),
    )
    name = str(figures["scenario"])
    return Document("Mission run", f"{name}, {figures['days']:g} days", name, facts, tuple(blocks))


def _verdict(figures: Figures) -> Verdict:
    windows, lost = figures["windows"], figures["packets_lost"]
    done = windows["processed"] == windows["flown"] > 0 and lost == 0
    complete = figures["reports_complete"] == figures["reports"] > 0
    words = [
        f"{windows['processed']} of {windows['flown']} flown windows are processed",
        "no packet that the link delivered is lost"
        if lost == 0
        else f"{count_text(lost)} packets that the link delivered are lost",
        f"{figures['reports_complete']} of {figures['reports']} reports are complete",
        f"{figures['interventions']} interventions",
        f"verdicts of the passes: {_counts(figures['verdicts']) or 'none'}",
    ]
    clean = complete and not figures["interventions"] and set(figures["verdicts"]) == {"met"}
    level = "not met" if not done else "met" if clean else "partly met"
    return Verdict(", ".join(words) + ".", level)


def _operations(figures: Figures) -> Iterator[tuple[str, str]]:
    windows = figures["windows"]
    contacts = windows["processed_after_contacts"]
    yield (
        "Windows requested, flown, processed, failed",
        ", ".join(count_text(windows[key]) for key in ("requested", "flown", "processed", "failed")),
    )
    yield (
        "Contacts until a window was processed",
        (", ".join(f"{key}: {count} windows" for key, count in contacts.items()) or "unknown"),
    )
    yield "Images flown", count_text(figures["frames"])
    unknown = figures["reports_without_frames"]
    yield (
        "Images in the reports",
        count_text(figures["frames_received"]) + (f" (unknown in {unknown} reports)" if unknown else ""),
    )
    yield "Packets sent", count_text(figures["packets"])
    yield "Packets lost on the link", count_text(figures["packets_lost_on_link"])
    yield "Packets received", count_text(figures["packets_received"])
    yield "Packets lost after the link", count_text(figures["packets_lost"])
    yield "Packets missing by sequence count", count_text(figures["packets_lost_of_passes"])
    yield "Contacts", count_text(figures["contacts"])
    yield "Telecommands", count_text(figures["telecommands"])
    yield "Octets of telecommands lost", count_text(figures["telecommand_octets_lost"])
    yield "Resets of the spacecraft", count_text(figures["spacecraft_resets"])


def _windows(figures: Figures) -> Iterator[Block]:
    trend = figures["trend"]
    if not trend:
        yield Absent("Windows", "none was requested")
        return
    if any(row.get("median_m") for row in trend):
        yield Picture(
            "mission-windows",
            "Median position error of each estimator, recall, and share of NEES inside its bounds, of each window.",
            f"Median error, recall and NEES of {len(trend)} windows over time; the table below has the values.",
            4.0,
            lambda canvas: draw_windows(canvas, trend),
        )
    names = sorted({name for row in trend for name in row.get("median_m") or {}})
    columns = (
        Column("window"),
        Column("start, UTC"),
        Column("state", numeric=False),
        Column("contacts"),
        Column("images"),
        Column("lost"),
        *(Column(name, group="median error, m") for name in names),
        Column("recall"),
        Column("NEES, %"),
        Column("not met"),
        Column("lacks"),
    )
    rows = [
        (
            str(row["window"]),
            str(row["start"])[:16].replace("T", " "),
            str(row["state"]),
            count_text(row["contacts_to_processed"]),
            count_text(row.get("frames")),
            count_text(row.get("packets_lost")),
            *(number_text((row.get("median_m") or {}).get(name), 0) for name in names),
            number_text(row.get("recall"), 2),
            number_text(row.get("nees_inside_percent"), 0),
            count_text(len(row["not_met"])) if "not_met" in row else NOT_A_VALUE,
            count_text(len(row["lacks"])) if "lacks" in row else NOT_A_VALUE,
        )
        for row in trend
    ]
    yield Table(
        "Windows in order of time: contacts until processed, images, packets lost, share of NEES inside its bounds, "
        "requirements not met.",
        columns,
        tuple(rows),
    )


def _performance(figures: Figures) -> Iterator[Block]:
    rows = [
        (
            Cell(name, strong=True),
            count_text(round(one["passes"])),
            number_text(one["median_m"], 1),
            number_text(one["p95_m"], 1),
            significant_text(one["drift_percent"]),
        )
        for name, one in figures["navigation"].items()
    ]
    columns = (
        Column("estimator", numeric=False),
        Column("passes"),
        Column("median", group="error, m"),
        Column("95th percentile", group="error, m"),
        Column("drift, % of path"),
    )
    yield _table("Navigation: medians over the passes.", columns, rows, "no report has a navigation error")
    detector = figures["detector"]
    yield Facts(
        (
            ("Recall, median", number_text(detector["recall"], 3)),
            ("Precision, median", number_text(detector["precision"], 3)),
            ("NEES inside its bounds, median", f"{number_text(figures['nees_inside_percent'], 1)} %"),
            ("Verdicts of the passes", _counts(figures["verdicts"]) or "none"),
            ("Reports lack", _counts(figures["reports_lack"]) or "nothing"),
        )
    )
    trends = [
        (
            _trend_label(name),
            count_text(one["passes"]),
            significant_text(one["first_third"]),
            significant_text(one["last_third"]),
            significant_text(one["slope_per_day"]),
        )
        for name, one in figures["trends"].items()
    ]
    columns = (
        Column("figure", numeric=False),
        Column("passes"),
        Column("first third", group="median"),
        Column("last third", group="median"),
        Column("slope for each day"),
    )
    yield _table("Trends over the passes.", columns, trends, "no pass has a report")


def _requirements(figures: Figures) -> Iterator[Block]:
    rows: list[Row] = [
        (Cell(name, swatch=_swatch(counts)), *(count_text(counts.get(status, 0)) for status in STATUSES))
        for name, counts in figures["requirements"].items()
    ]
    columns = (
        Column("requirement", numeric=False),
        *(Column(status, group="passes") for status in STATUSES),
    )
    yield _table("Requirements: passes by status.", columns, rows, "no report has requirements")


def _correlations(figures: Figures) -> Iterator[Block]:
    rows = [
        (
            ticks,
            count_text(one["time_reports"]),
            count_text(one["rejected"]),
            significant_text(one["drift_ppb"]),
            significant_text(one["residual_rms_us"]),
            significant_text(one["residual_max_us"]),
        )
        for ticks, one in figures["time_correlation"].items()
    ]
    columns = (
        Column("from, ticks", numeric=False),
        Column("time reports"),
        Column("rejected"),
        Column("drift, 1e-9"),
        Column("rms", group="residual, µs"),
        Column("largest", group="residual, µs"),
    )
    yield _table("On-board time to UTC, in force.", columns, rows, "no correlation is in force")


def _kills(kills: Figures) -> Iterator[Block]:
    yield Paragraph(
        f"{kills['done']} of {kills['planned']} kills are carried out; seed {kills['seed']}; "
        f"by phase of a contact: {_counts(kills['by_phase']) or 'none'}. "
        f"Processes that have ended by themselves: {_counts(kills['ended_by_themselves']) or 'none'}."
    )
    rows = [
        (
            Cell(part, strong=True),
            count_text(count),
            number_text(kills["recovery_s"].get(part, {}).get("median"), 1),
            number_text(kills["recovery_s"].get(part, {}).get("longest"), 1),
        )
        for part, count in kills["by_part"].items()
    ]
    columns = (
        Column("process", numeric=False),
        Column("kills"),
        Column("median", group="recovery, s"),
        Column("longest", group="recovery, s"),
    )
    yield _table("Kills and time until the process works again.", columns, rows, "none was carried out")


def _processes(figures: Figures) -> Iterator[Block]:
    series, lives = figures["memory_series_mib"], figures["memory_lives"]
    names = sorted(figures["memory_mib"], key=lambda name: PARTS.index(name) if name in PARTS else len(PARTS))
    if any(len(series[name]) > 1 for name in names):
        yield Picture(
            "mission-memory",
            "Memory of each process with its children, sampled after each contact.",
            "Memory of each process over mission time; the table below has first, peak and last sample.",
            3.2,
            lambda canvas: draw_memory(canvas, {name: series[name] for name in names}, lives),
        )
    flat = {True: "flat", False: "not flat", None: "unknown"}
    rows: list[Row] = [
        (
            Cell(name, strong=True),
            *(number_text(one[key], 0) for key in ("first", "peak", "last", "first_third", "last_third")),
            number_text(one["slope_per_day"], 2),
            count_text(one["restarts"]),
            flat[one["flat"]],
            number_text(figures["cpu_s"].get(name), 0),
        )
        for name, one in ((name, figures["memory_mib"][name]) for name in names)
    ]
    columns = (
        Column("process", numeric=False),
        Column("first", group="memory, MiB"),
        Column("peak", group="memory, MiB"),
        Column("last", group="memory, MiB"),
        Column("first third", group="memory, MiB"),
        Column("last third", group="memory, MiB"),
        Column("MiB a day"),
        Column("restarts"),
        Column("judged", numeric=False),
        Column("processor time, s"),
    )
    yield _table(
        "Processes. The first mission day after a start is not judged.", columns, rows, "not sampled"
    )


def _incidents(figures: Figures) -> Iterator[Block]:
    rows = [
        (str(one["utc"]), str(one["kind"]), str(one["text"]), str(one["recovery"] or "none"))
        for one in figures["incidents"]
    ]
    columns = tuple(Column(name, numeric=False) for name in ("time, UTC", "kind", "incident", "recovery"))
    caption = "Incidents. Kills and losses of links have times of the wall clock."
    yield Table(caption, columns, tuple(rows)) if rows else Paragraph("None.")


def _interventions(figures: Figures) -> Iterator[Block]:
    rows = [(str(one["utc"]), str(one["text"])) for one in figures["interventions_list"]]
    columns = (Column("time, UTC", numeric=False), Column("intervention", numeric=False))
    caption = "Interventions after the posts at the start."
    yield Table(caption, columns, tuple(rows)) if rows else Paragraph("None.")


def _table(caption: str, columns: Sequence[Column], rows: Iterable[Row], absent: str) -> Block:
    kept = tuple(rows)
    return Table(caption, tuple(columns), kept) if kept else Absent(caption.rstrip("."), absent)


def _swatch(counts: Mapping[str, int]) -> str:
    if counts.get("not met"):
        return "vermillion"
    return "" if not counts.get("met") else "orange" if counts.get("unknown") else "green"


def _trend_label(name: str) -> str:
    estimator, _, key = name.rpartition(" ")
    return f"{estimator}: {TREND_LABELS[key]}" if estimator else TREND_LABELS.get(key, key)


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {count}" for name, count in counts.items())
