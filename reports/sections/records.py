"""Provenance and data, truth-use ledger, configuration."""

from __future__ import annotations

from reports.document import (
    Block,
    Bullets,
    Cell,
    Column,
    Facts,
    Heading,
    Listing,
    Paragraph,
    Table,
    rung_number,
    rung_text,
)
from reports.figures.theme import TRIGGERS
from reports.sections.common import PassView, is_hash, role_of, setting_text
from reports.text import count_text, hash_text, utc_text

_MOST_READS = 30


def provenance(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Provenance and data")]
    number = rung_number(report.evidence_rung)
    if number is not None:
        blocks.append(
            Paragraph(
                f"The accuracy figures stand on {rung_text(report.evidence_rung)}. A figure on a lower rung "
                "says less about flight "
                "than one on a higher rung, and is not to be quoted without its rung."
            )
        )
    if report.provenance:
        pairs = tuple((k, hash_text(v) if is_hash(v) else v) for k, v in report.provenance.items())
        blocks.append(Facts(pairs))
    else:
        blocks.append(view.absent("provenance", "Build, hashes, seed"))
    blocks.append(Heading("Data sources", 3))
    if report.data_sources:
        blocks.append(Bullets(report.data_sources))
    else:
        blocks.append(view.absent("data_sources", "Data sources"))
    return blocks


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
            "Reads of the anchor ephemeris by each estimator, and the resets that caused them.",
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
                        TRIGGERS.get(r.trigger, r.trigger),
                    )
                    for r in report.truth_ledger[:_MOST_READS]
                ),
                note=f"{rest} further reads are in the JSON form of this report." if rest > 0 else "",
            )
        )
    return blocks


def configuration(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Configuration")]
    for group, settings in report.configuration.items():
        blocks.append(Heading(str(group), 3))
        blocks.append(Facts(tuple((str(k), setting_text(v)) for k, v in settings.items()), mono=True))
    if not report.configuration and not report.scenario_text:
        blocks.append(view.absent("configuration", "Configuration"))
    if report.scenario_text:
        blocks.append(Listing("Scenario file", report.scenario_text))
    return blocks
