"""Truth-use ledger and configuration."""

from __future__ import annotations

from reports.document import (
    Block,
    Cell,
    Column,
    Heading,
    Listing,
    Paragraph,
    Table,
)
from reports.figures.theme import TRIGGERS
from reports.sections.common import PassView, role_of
from reports.sections.opening import settings
from reports.text import count_text, utc_text

_MOST_READS = 30


def ledger(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Truth-use ledger")]
    if not view.estimates:
        blocks.append(view.absent("navigation", "Truth-use ledger"))
        return blocks
    clean = [s.name for s in view.estimates if (s.anchor_reads_after_start or 0) == 0 and not s.anchor_reads]
    users = [s.name for s in view.estimates if s.name not in clean]
    sentences = []
    if clean:
        sentences.append(f"Never read the anchor ephemeris: {', '.join(clean)}.")
    if users:
        sentences.append(
            f"Read it: {', '.join(users)}. The error of these estimators between two reads is theirs; the read "
            "itself is not."
        )
    blocks.append(Paragraph(" ".join(sentences)))
    rows: list[tuple[Cell | str, ...]] = []
    for one in view.estimates:
        triggers = [t for t in one.reset_trigger if t in TRIGGERS]
        rows.append(
            (
                Cell(one.name, swatch=role_of(view.styles[one.name][0])),
                count_text(one.anchor_reads),
                count_text(one.anchor_reads_after_start),
                *(count_text(triggers.count(t)) for t in TRIGGERS),
            )
        )
    blocks.append(
        Table(
            "Reads of the anchor ephemeris by each estimator, and its resets by what triggered them.",
            (
                Column("estimator", numeric=False),
                Column("all", group="reads"),
                Column("after start", group="reads"),
                *(Column(words, group="resets by trigger") for words in TRIGGERS.values()),
            ),
            tuple(rows),
        )
    )
    if report.truth_ledger:
        rest = len(report.truth_ledger) - _MOST_READS
        blocks.append(
            Table(
                "Every read.",
                (
                    Column("time, UTC", numeric=False),
                    Column("estimator", numeric=False),
                    Column("frame"),
                    Column("trigger", numeric=False),
                ),
                tuple(
                    (
                        utc_text(r.utc_ns).removesuffix(" UTC"),
                        r.estimator,
                        count_text(r.frame_number),
                        TRIGGERS.get(r.trigger, "no reset" if r.trigger == "none" else r.trigger),
                    )
                    for r in report.truth_ledger[:_MOST_READS]
                ),
                note=f"{rest} further reads are in the JSON form of this report." if rest > 0 else "",
            )
        )
    return blocks


def configuration(view: PassView) -> list[Block]:
    """Settings of the pass and its scenario."""
    report = view.report
    blocks: list[Block] = [Heading("Configuration"), *settings(report.configuration)]
    if not report.configuration and not report.scenario_text:
        blocks.append(view.absent("configuration", "Configuration"))
    if report.scenario_text:
        blocks.append(Listing("Scenario file", report.scenario_text))
    return blocks
