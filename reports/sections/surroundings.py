"""Ground track, housekeeping, events."""

from functools import partial

import numpy as np

from reports.document import Block, Column, Heading, Picture, Table
from reports.figures import housekeeping, track_map
from reports.sections.common import PassView
from reports.text import count_text, utc_text
from reports.values import TimeSpan

_MOST_EVENTS = 40


def ground_track(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Ground track")]
    track = report.reference
    if track is None or not len(track.utc_ns):
        blocks.append(view.absent("reference", "Ground track"))
        return blocks
    arcs = report.imaging_arcs
    chosen = _middle_arc(view)
    several = len(arcs) > 1
    under = f" over {report.terrain.source}" if report.terrain is not None and report.terrain.source else ""
    imaging = "Vermillion: imaging; thin: sampled between imaging arcs" if arcs else "Vermillion: the track of the pass"
    blocks.append(
        Picture(
            "globe",
            f"Ground track of the reference on the whole Moon{under}. {imaging}"
            f"{'; blue: the arc of the next figure' if several else ''}.",
            "Map of the Moon with the ground track.",
            4.6 if several else 3.2,
            partial(
                track_map.draw_globe, track=track, arcs=arcs, terrain=report.terrain, span=chosen if several else None
            ),
        )
    )
    crater_text = ""
    craters = report.craters
    if craters is not None and craters.detected is not None:
        found = int(np.sum(craters.detected > 0))
        crater_text = (
            f" Craters of the catalogue: filled blue where detected at least once ({count_text(found)} of "
            f"{count_text(len(craters.diameter_m))}), open orange where never."
        )
    elif craters is None:
        blocks.append(view.absent("craters", "Craters on the map"))
    flown = tuple(s for s in view.estimates if np.isfinite(s.latitude_deg).any())
    blocks.append(
        Picture(
            "strips",
            "One imaging arc cut into four strips, read from left to right. Dashed: reference; coloured: estimates."
            f"{crater_text}",
            "Strips along one imaging arc with craters and estimated tracks.",
            4.9,
            partial(
                track_map.draw_strips,
                track=track,
                series=flown,
                styles=view.styles,
                craters=craters,
                terrain=report.terrain,
                span=chosen,
            ),
        )
    )
    return blocks


def _middle_arc(view: PassView) -> TimeSpan:
    time = view.time
    middle = (time.start_utc_ns + time.stop_utc_ns) // 2
    arcs = view.report.imaging_arcs
    if not arcs:
        return TimeSpan(time.start_utc_ns, time.stop_utc_ns + 1)
    return min(arcs, key=lambda a: abs((a.start_utc_ns + a.stop_utc_ns) // 2 - middle))


def housekeeping_and_events(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Housekeeping and events")]
    parameters = report.housekeeping[:12]
    if parameters:
        blocks.append(
            Picture(
                "housekeeping",
                "Engineering parameters over the pass, each on its own scale.",
                "Housekeeping parameters: " + ", ".join(p.name for p in parameters),
                housekeeping.housekeeping_height_in(len(parameters)),
                partial(
                    housekeeping.draw_housekeeping, parameters=parameters, time=view.time, arcs=report.imaging_arcs
                ),
            )
        )
    else:
        blocks.append(view.absent("housekeeping", "Housekeeping"))
    if report.events:
        rest = len(report.events) - _MOST_EVENTS
        blocks.append(
            Table(
                "Event reports of the payload.",
                (
                    Column("time, UTC", numeric=False),
                    Column("severity", numeric=False),
                    Column("event", numeric=False),
                    Column("detail", numeric=False),
                ),
                tuple(
                    (utc_text(e.utc_ns).removesuffix(" UTC"), e.severity, e.name.replace("_", " "), e.detail)
                    for e in report.events[:_MOST_EVENTS]
                ),
                note=f"{rest} further events are in the JSON form of this report." if rest > 0 else "",
            )
        )
    else:
        blocks.append(view.absent("events", "Events"))
    return blocks
