"""Common parts of the sections of a pass report: values, time axis, colours and reasons for missing items."""

from dataclasses import dataclass

import numpy as np

from reports.document import Absent
from reports.figures.canvas import TimeScale, arcs_differ
from reports.figures.theme import Styles
from reports.text import hash_text
from reports.values import ODOMETRY_OUTCOMES, NavigationSeries, PassReport, TimeSpan

_USUAL_REASON = {
    "verdict": "the pass has no verdict",
    "headline": "no headline figure was computed",
    "accounting": "the frames of the pass were not counted",
    "packets": "the pass has no packet accounting",
    "reference": "no reference ephemeris covers the pass",
    "navigation": "no navigation telemetry was received",
    "error": "no downlinked state has both values and a reference",
    "outcomes": "no estimator reported matching outcomes",
    "detector": "detections, catalogue or reference orbit are not available",
    "gallery": "the pass has no images on the ground",
    "craters": "no catalogue was given for the map",
    "housekeeping": "no housekeeping packet was received",
    "events": "no event report was received",
    "consistency": "no estimator reported its own uncertainty",
    "drift": "no odometry was flown, or no path was long enough",
    "configuration": "none was archived with the pass",
    "provenance": "none was archived with the pass",
}


@dataclass(frozen=True, slots=True)
class PassView:
    """Pass report with the values that its sections share."""

    report: PassReport
    time: TimeScale
    styles: Styles

    @property
    def estimates(self) -> tuple[NavigationSeries, ...]:
        return tuple(s for s in self.report.navigation if s.kind != "baseline")

    @property
    def odometry(self) -> tuple[NavigationSeries, ...]:
        return tuple(s for s in self.estimates if any(o in ODOMETRY_OUTCOMES for o in s.outcome))

    @property
    def with_outcomes(self) -> tuple[NavigationSeries, ...]:
        return tuple(s for s in self.report.navigation if any(s.outcome))

    @property
    def with_error(self) -> tuple[NavigationSeries, ...]:
        return tuple(s for s in self.report.navigation if np.isfinite(s.error_rtn_m).any())

    def absent(self, field: str, what: str, usual: str = "") -> Absent:
        """Return the block for a section that is not available; `usual` is the reason if the report states none."""
        why = self.report.not_available.get(field) or usual or _USUAL_REASON.get(field, "not given")
        return Absent(what, why)

    def no_error(self) -> Absent:
        """Return the block with the reason why no error is available."""
        if not self.report.navigation:
            return self.absent("navigation", "Navigation")
        return self.absent("error" if self.report.reference else "reference", "Position error")


def role_of(tint: str) -> str:
    """Role of a light colour."""
    from reports.figures.theme import LIGHT

    return next(role for role, value in LIGHT.items() if value == tint)


def slug(name: str) -> str:
    """A name as part of an id."""
    return "".join(c if c.isalnum() else "-" for c in name.lower()).strip("-") or "series"


def arc_words(time: TimeScale, arcs: tuple[TimeSpan, ...]) -> str:
    """Return the words of a caption about the tint of imaging arcs."""
    if arcs_differ(time, arcs):
        return " Tinted ground marks imaging arcs."
    return " The whole span is one imaging arc." if len(arcs) == 1 else ""


def is_hash(text: str) -> bool:
    """True for the hexadecimal digest of anything."""
    return len(text) >= 32 and all(c in "0123456789abcdef" for c in text)


def setting_text(value: object) -> str:
    """A setting as it is printed."""
    if value is None:
        return "not stated"
    if isinstance(value, str) and is_hash(value):
        return hash_text(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(setting_text(v) for v in value)
    return str(value)
