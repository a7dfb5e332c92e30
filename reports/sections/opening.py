"""Opening and closing sections of every report: verdict, figures, provenance, data, configuration."""

from collections.abc import Mapping
from typing import Any

from reports.document import (
    Absent,
    Block,
    Bullets,
    Heading,
    Headline,
    Paragraph,
    Properties,
    Verdict,
    evidence_number,
    evidence_text,
)
from reports.sections.common import is_hash, setting_text
from reports.text import hash_text
from reports.values import ReportCommon


def about(report: ReportCommon, *facts: tuple[str, str]) -> tuple[tuple[str, str], ...]:
    """Return the known facts for the header."""
    known = (*facts, ("for", report.generated_for), ("made", report.created_utc))
    return tuple((name, value) for name, value in known if value)


def judgement(report: ReportCommon) -> list[Block]:
    """Return verdict and figures."""
    blocks: list[Block] = []
    if report.verdict:
        blocks.append(Verdict(report.verdict[0].upper() + report.verdict[1:], report.verdict_level))
    else:
        blocks.append(absent(report, "verdict", "Verdict", "there is no verdict"))
    if report.headline:
        blocks.append(Headline(report.headline, report.evidence_level))
    else:
        blocks.append(absent(report, "headline", "Five figures", "no figure was computed"))
    return blocks


def absent(report: ReportCommon, field: str, what: str, usual: str) -> Absent:
    """Return the block for an item that is not available."""
    return Absent(what, report.not_available.get(field) or usual)


def missing_and_remarks(report: ReportCommon) -> list[Block]:
    """Return the list of missing items and the remarks."""
    blocks: list[Block] = []
    if report.not_available:
        blocks.append(Heading("What this report does not show", 3))
        reasons = sorted(report.not_available.items())
        blocks.append(Bullets(tuple(f"{name.replace('_', ' ')}: {why}" for name, why in reasons)))
    if report.remarks:
        blocks.append(Heading("Remarks", 3))
        blocks.append(Bullets(report.remarks))
    return blocks


def provenance_and_data(report: ReportCommon) -> list[Block]:
    """Return the provenance of the figures and their data sources."""
    blocks: list[Block] = [Heading("Provenance and data")]
    if evidence_number(report.evidence_level) is not None:
        blocks.append(
            Paragraph(
                f"The accuracy figures are at {evidence_text(report.evidence_level)}. A figure at a lower level "
                "says less about performance in flight than one at a higher level. Quote figures only with their level."
            )
        )
    if report.provenance:
        blocks.append(Properties(tuple((k, hash_text(v) if is_hash(v) else v) for k, v in report.provenance.items())))
    else:
        blocks.append(absent(report, "provenance", "Build, hashes, seed", "none was archived"))
    blocks.append(Heading("Data sources", 3))
    if report.data_sources:
        blocks.append(Bullets(report.data_sources))
    else:
        blocks.append(absent(report, "data_sources", "Data sources", "not given"))
    return blocks


def settings(configuration: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """Groups of settings."""
    blocks: list[Block] = []
    for group, values in configuration.items():
        blocks.append(Heading(str(group), 3))
        blocks.append(Properties(tuple((str(k), setting_text(v)) for k, v in values.items()), mono=True))
    return blocks
