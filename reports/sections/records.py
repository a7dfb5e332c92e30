"""Reads of the anchor ephemeris, and configuration."""

from reports.document import Block, Cell, Column, Heading, Listing, Paragraph, Table
from reports.figures.theme import TRIGGERS
from reports.sections.common import PassView, role_of, setting_text
from reports.sections.opening import settings
from reports.text import count_text, utc_text
from reports.values import SettingsComparison

_MOST_READS = 30
_MOST_CHANGES = 60


def ledger(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Reads of the anchor ephemeris")]
    if not view.estimates:
        blocks.append(view.absent("navigation", "Reads of the anchor ephemeris"))
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
    resets = [read for read in report.truth_ledger if read.trigger != "none"]
    if resets:
        rest = len(resets) - _MOST_READS
        blocks.append(
            Table(
                "Reads that reset an estimator.",
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
                        TRIGGERS.get(r.trigger, r.trigger),
                    )
                    for r in resets[:_MOST_READS]
                ),
                note=(f"{rest} further resets. " if rest > 0 else "")
                + "Every read is in the JSON form of this report.",
            )
        )
    return blocks


def configuration(view: PassView) -> list[Block]:
    """Settings of the pass and its scenario."""
    report = view.report
    blocks: list[Block] = [Heading("Configuration"), *settings(report.configuration)]
    if not report.configuration and not report.scenario_text:
        blocks.append(view.absent("configuration", "Configuration"))
    if report.comparison is not None:
        blocks.append(_changed_settings(report.comparison))
    if report.scenario_text:
        blocks.append(Listing("Scenario file", report.scenario_text))
    return blocks


def _changed_settings(comparison: SettingsComparison) -> Block:
    if not comparison.changes:
        return Paragraph(f"All settings are those of the previous pass, {comparison.previous_pass}.")
    rest = len(comparison.changes) - _MOST_CHANGES
    return Table(
        f"Settings that differ from those of the previous pass, {comparison.previous_pass}.",
        tuple(Column(words, numeric=False) for words in ("setting", "previous pass", "this pass")),
        tuple(
            (name, setting_text(before), setting_text(after))
            for name, before, after in comparison.changes[:_MOST_CHANGES]
        ),
        note=f"{rest} further settings are in the JSON form of this report." if rest > 0 else "",
    )
