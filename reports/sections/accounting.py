"""Frames and packets: what was expected, what came."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from reports import values
from reports.document import Block, Column, Heading, Paragraph, Picture, Properties, Table
from reports.figures import accounting
from reports.sections.common import PassView, arc_words
from reports.text import NOT_A_VALUE, computed_text, count_text, duration_text, percent_text, rate_text, utc_text

_MOST_GAPS = 40


def _frame_steps(count: values.FrameAccounting) -> list[tuple[str, int]]:
    steps = (
        ("expected", count.expected),
        ("acquired", count.acquired),
        ("lit", count.lit),
        ("processed", count.processed),
        ("with detections", count.with_detections),
        ("used to navigate", count.navigated),
        ("in the downlink", count.downlinked),
    )
    return [(name, n) for name, n in steps if n is not None]


def _link_quality(receptions: tuple[values.ReceptionQuality, ...]) -> Table:
    return Table(
        "Link quality by reception.",
        (
            Column("station", numeric=False),
            Column("first frame", numeric=False),
            Column("last frame", numeric=False),
            Column("good", unit="frames"),
            Column("corrected", unit="symbols"),
            Column("bit errors", unit="rate"),
            Column("lock", unit="losses"),
            Column("octets"),
            Column("outside", unit="frames"),
            Column("link settings", numeric=False),
        ),
        tuple(
            (
                one.station or "not stated",
                NOT_A_VALUE if one.first_utc_ns is None else utc_text(one.first_utc_ns),
                NOT_A_VALUE if one.last_utc_ns is None else utc_text(one.last_utc_ns, date=False),
                f"{count_text(one.frames_good)} of {count_text(one.frames)}",
                count_text(one.symbols_corrected),
                rate_text(one.bit_error_rate),
                count_text(one.lock_losses),
                count_text(one.octets),
                count_text(one.octets_other),
                one.source,
            )
            for one in receptions
        ),
        note="Each row is one received file that may contain packets of the pass. The bit error rate is that of the "
        "codewords that could be corrected, a lower bound. Lock losses are frames that do not follow the previous "
        "one at the usual distance. Times are those of the station's records.",
    )


def frames_and_packets(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Frames and packets"), *_frame_blocks(view)]
    packets = report.packets
    if packets is None:
        return [*blocks, view.absent("packets", "Packet accounting")]
    blocks += [Heading("Downlink", 3), _downlink_properties(packets)]
    if packets.completeness is not None and len(packets.completeness.expected):
        blocks.append(_completeness(view, packets.completeness))
    if packets.by_apid:
        blocks.append(_packets_by_apid(packets.by_apid))
    if packets.receptions:
        blocks.append(_link_quality(packets.receptions))
    if report.gaps:
        blocks.append(_gaps(report.gaps))
    return blocks


def _frame_blocks(view: PassView) -> list[Block]:
    """Return the frames left after each step, and their image quality."""
    count = view.report.accounting
    steps = _frame_steps(count) if count is not None else []
    if count is None or not steps:
        return [view.absent("accounting", "Frame accounting")]
    last = steps[-1]
    bad = "" if not count.bad_image else f" {count.bad_image} could not be used as images."
    blocks: list[Block] = [
        Picture(
            "frames",
            f"Frames left after each step. Of {count_text(steps[0][1])} {steps[0][0]}, {count_text(last[1])} "
            f"({percent_text(last[1], steps[0][1])}) are {last[0]}.{bad}",
            "Bars: " + ", ".join(f"{name} {n}" for name, n in steps),
            0.28 + 0.27 * len(steps),
            partial(accounting.draw_frame_steps, steps=steps),
        )
    ]
    if count.quality:
        words = ", ".join(f"{name} {count_text(n)}" for name, n in count.quality.items())
        blocks.append(Paragraph(f"Image quality as judged on board: {words}.", small=True))
    return blocks


def _downlink_properties(packets: values.PacketAccounting) -> Properties:
    return Properties(
        (
            (
                "Packets received",
                f"{count_text(packets.packets)} ({percent_text(packets.packets, packets.expected, 2)} of "
                f"{count_text(packets.expected)} expected)",
            ),
            ("Packets lost in gaps", count_text(packets.lost)),
            ("Packets lost at the edges", computed_text(packets.lost_at_edges, "not known without a plan")),
            ("Duplicates, conflicts", f"{computed_text(packets.duplicates)}, {count_text(packets.conflicts)}"),
            ("Packets with CRC errors", computed_text(packets.crc_errors)),
            ("Transfer frames, of these bad", f"{computed_text(packets.frames)}, {computed_text(packets.frames_bad)}"),
            ("Symbols corrected", computed_text(packets.symbols_corrected)),
            ("Octets, of these skipped", f"{computed_text(packets.octets)}, {computed_text(packets.octets_skipped)}"),
        )
    )


def _completeness(view: PassView, completeness: values.CompletenessSeries) -> Picture:
    report = view.report
    faulty = int(np.sum(completeness.received < completeness.expected))
    said = (
        "Every interval is complete."
        if not faulty
        else f"{faulty} of {len(completeness.expected)} intervals are not complete."
    )
    return Picture(
        "completeness",
        f"Packets received of those expected, by on-board time. {said} Complete intervals are blue, others "
        f"vermillion.{arc_words(view.time, report.imaging_arcs)}",
        f"Completeness over time. {said}",
        1.85,
        partial(
            accounting.draw_completeness,
            series=completeness,
            time=view.time,
            arcs=report.imaging_arcs,
            gaps=report.gaps,
        ),
    )


def _packets_by_apid(by_apid: Mapping[int, values.ApidAccounting]) -> Table:
    return Table(
        "Packets by application process.",
        (
            Column("APID", numeric=False),
            Column("packet", numeric=False),
            Column("received"),
            Column("in gaps", group="lost"),
            Column("at edges", group="lost"),
            Column("duplicates"),
            Column("conflicts"),
            Column("CRC errors"),
        ),
        tuple(
            (
                f"0x{apid:03X}",
                a.name,
                count_text(a.packets),
                count_text(a.lost),
                computed_text(a.lost_at_edges, NOT_A_VALUE),
                computed_text(a.duplicates),
                count_text(a.conflicts),
                computed_text(a.crc_errors),
            )
            for apid, a in sorted(by_apid.items())
        ),
        note="Lost in gaps: missing sequence counts between received packets. Lost at edges: packets of "
        "planned frames before the first and after the last received packet. Duplicates and CRC errors "
        "are counted in the raw files over the on-board time of the pass.",
    )


def _gaps(gaps: Sequence[values.TimeSpan]) -> Table:
    return Table(
        "Gaps in what was received.",
        (Column("from", numeric=False), Column("to", numeric=False), Column("length"), Column("of", numeric=False)),
        tuple(
            (
                utc_text(g.start_utc_ns),
                utc_text(g.stop_utc_ns),
                duration_text((g.stop_utc_ns - g.start_utc_ns) / 1e9),
                g.label or "packets",
            )
            for g in gaps[:_MOST_GAPS]
        ),
    )
