"""Candidate observation windows: where constraints on the orbit, the light, the ground and the resources all hold.

Everything is computed along one reference ephemeris. The crater count is that of a nadir camera over the catalogue;
the battery is a simple balance of generation and load, full where the search begins; stored data leave in the order
they came whenever a station sees the spacecraft.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from ground_service.contacts.links.core import PredictedContact, predict_contacts
from ground_service.evaluation.recall import expected_craters
from ground_service.planning.filling import Option
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation, spherical_from_mcmf
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import DSN_STATIONS, GroundStation, find_windows, sun_elevation_azimuth, sunlit_fraction
from tmtc.dictionary.payload import DICTIONARY

Range = tuple[float, float]
TerrainAt = Callable[[FloatArray, FloatArray], BoolArray]
"""Latitudes and longitudes (n,) in rad to whether the ground there is mare (n,)."""

CONTACT_HORIZON_S = 86_400.0
"""Data that are not down a day after their window are taken to stay on board."""

EDGE_TOLERANCE_S = 1.0
OPEN_END = 1e6
"""Limits beyond this, in km or degrees, are none."""

TOO_SHORT = "too short"
BATTERY, STORAGE, CONTACT = "battery too low", "storage too small", "no contact to downlink its data"
"""Reasons why a span is no candidate."""

_DEGREE = 180.0 / math.pi


@dataclass(frozen=True, slots=True)
class Constraints:
    """Conditions that a window fulfils throughout; None: no condition. Angles in rad, lengths in m."""

    altitude_m: Range | None = None
    sun_elevation_rad: Range | None = None
    latitude_rad: Range | None = None
    regions_rad: tuple[tuple[Range, Range], ...] = ()
    """Latitudes, and longitudes from west to east; one of them has to hold."""

    craters_per_frame: float | None = None
    crater_diameter_m: Range = (5e3, 30e3)
    mare: bool | None = None
    sunlit: bool = False
    minimum_duration_s: float = 300.0
    maximum_duration_s: float = 2400.0
    minimum_battery: float | None = None
    needs_contact: bool = False
    limit_rad: float | None = None
    """Largest latitude, north and south, that the mission description permits."""


@dataclass(frozen=True, slots=True, eq=False)
class Excess:
    """A constraint, and by how much it is broken (n,) in its unit: 0 where it holds, infinite where nothing is near.

    A fixed one is no choice of the request.
    """

    name: str
    value: FloatArray
    unit: str = ""
    is_fixed: bool = False


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources of spacecraft and ground; the defaults are those of a 6U CubeSat."""

    storage_octets: int = 64 << 20
    downlink_bit_s: float = 16_000.0
    battery_wh: float = 75.0
    generation_w: float = 30.0
    idle_w: float = 12.0
    observing_w: float = 8.0
    estimators: int = 3
    detections_per_frame: float = 25.0
    stations: tuple[GroundStation, ...] = DSN_STATIONS


@dataclass(frozen=True, slots=True)
class Candidate:
    """A window that fulfils the constraints, and what it would be like; None where it was not asked or not known."""

    start_utc_ns: int
    stop_utc_ns: int
    frames: int
    altitude_m: Range
    sun_elevation_rad: Range
    latitude_rad: Range
    sunlit_share: float
    craters_per_frame: Range | None
    mare_share: float | None
    data_octets: int
    energy_wh: float
    battery_minimum: float
    storage_peak_octets: int
    downlinked_by_utc_ns: int | None


@dataclass(frozen=True, slots=True)
class RejectedSpan:
    """A span in which the constraints hold, but that is no candidate."""

    start_utc_ns: int
    stop_utc_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Candidates in order of time, the contacts that were counted with, and why spans were left out."""

    candidates: tuple[Candidate, ...]
    contacts: tuple[PredictedContact, ...]
    rejected: tuple[RejectedSpan, ...] = ()
    reason: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """Position (n, 3) and conditions (n,) at the sub-satellite point; `sunlit` is the share of the Sun's disc."""

    position_mcmf_m: FloatArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    altitude_m: FloatArray
    sun_elevation_rad: FloatArray
    sunlit: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Planner:
    """Window search in one ephemeris; `mare` and `catalogue` are None if not available.

    `gap_ns` is the time between two windows that their telecommands need (`preparation.gap_ns`).
    """

    ephemeris: Ephemeris
    orientation: Orientation
    resources: Resources
    camera: PinholeCamera
    catalogue: CraterCatalogue | None = None
    mare: TerrainAt | None = None
    gap_ns: int = 0

    def search(
        self,
        constraints: Constraints,
        start_utc_ns: int,
        stop_utc_ns: int,
        cadence_s: float,
        *,
        step_s: float = 30.0,
        commitments: Sequence[Option] = (),
    ) -> SearchResult:
        """Windows between two times, longer ones cut at the maximum duration, in order of time.

        Raises
        ------
        EphemerisCoverageError
            If the ephemeris does not cover the span.
        """
        contacts = predict_contacts(self.ephemeris, self.resources.stations, start_utc_ns, stop_utc_ns)
        battery = self._battery(start_utc_ns, stop_utc_ns, step_s)
        rejected: list[RejectedSpan] = []
        refused: list[Candidate] = []
        candidates = []
        for first, last in self._pieces(constraints, start_utc_ns, stop_utc_ns, step_s):
            if last - first < constraints.minimum_duration_s * NS:
                rejected.append(RejectedSpan(first, last, TOO_SHORT))
                continue
            candidate = self._candidate(constraints, first, last, cadence_s, contacts, battery, commitments)
            reason = self._refusal(candidate, constraints)
            if reason:
                rejected.append(RejectedSpan(first, last, reason))
                refused.append(candidate)
            else:
                candidates.append(candidate)
        if candidates:
            reason = None
        elif refused:
            reason = explain_refusals([one.reason for one in rejected], refused)
        else:
            reason = self.exclusion(constraints, start_utc_ns, stop_utc_ns, step_s=step_s)
        return SearchResult(tuple(candidates), contacts, tuple(rejected), reason)

    def spans(
        self, constraints: Constraints, start_utc_ns: int, stop_utc_ns: int, *, step_s: float = 30.0
    ) -> list[tuple[int, int]]:
        """Return the spans in which the constraints hold, cut at the maximum duration, without short ones."""
        parts = self._pieces(constraints, start_utc_ns, stop_utc_ns, step_s)
        return [(a, b) for a, b in parts if b - a >= constraints.minimum_duration_s * NS]

    def _pieces(
        self, constraints: Constraints, start_utc_ns: int, stop_utc_ns: int, step_s: float
    ) -> list[tuple[int, int]]:
        """Return the spans in which the constraints hold, cut at the maximum duration with the gap in between."""
        found = find_windows(
            lambda utc_ns: _hold(self._excess(self.conditions(utc_ns), constraints), len(utc_ns)),
            start_utc_ns,
            stop_utc_ns,
            step_s,
            EDGE_TOLERANCE_S,
        )
        maximum_ns = round(constraints.maximum_duration_s * NS)
        return [part for span in found for part in _cut(*span, maximum_ns, self.gap_ns)]

    def exclusion(self, constraints: Constraints, start_utc_ns: int, stop_utc_ns: int, *, step_s: float = 30.0) -> str:
        """Return the smallest set of constraints that no span of the minimum duration fulfils, and what would help."""
        epochs = np.arange(start_utc_ns, stop_utc_ns + 1, round(step_s * NS), dtype=np.int64)
        excess = self._excess(self.conditions(epochs), constraints, everywhere=True)
        needed = math.ceil(constraints.minimum_duration_s / step_s) + 1
        return explain_exclusion(excess, needed, step_s)

    def sunlit(self, utc_ns: IntArray) -> FloatArray:
        """Return the share (n,) of the Sun that the spacecraft sees."""
        return self.conditions(utc_ns).sunlit

    def downlink_octets(
        self, start_utc_ns: int, steps: int, step_s: float, outages: Mapping[str, Sequence[tuple[int, int]]]
    ) -> FloatArray:
        """Return the octets that contacts can take in each step (n,), outside the outages of the stations."""
        edges = start_utc_ns + np.arange(steps + 1, dtype=np.int64) * round(step_s * NS)
        stop = min(int(edges[-1]), self.ephemeris.stop_utc_ns)
        seconds = np.zeros(steps)
        if stop > start_utc_ns:
            contacts = predict_contacts(self.ephemeris, self.resources.stations, start_utc_ns, stop, outages)
            for begin, end in _union(contacts):
                inside = np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin)
                seconds += np.maximum(inside, 0) / NS
        return np.asarray(seconds * self.resources.downlink_bit_s / 8.0)

    def predict(
        self,
        start_utc_ns: int,
        stop_utc_ns: int,
        cadence_s: float,
        *,
        since_utc_ns: int,
        until_utc_ns: int,
        commitments: Sequence[Option] = (),
    ) -> Candidate:
        """Predict the resources of a given window: battery full at `since`, contacts up to `until`."""
        horizon = min(until_utc_ns, stop_utc_ns + round(CONTACT_HORIZON_S) * NS)
        contacts = predict_contacts(self.ephemeris, self.resources.stations, start_utc_ns, horizon)
        battery = self._battery(since_utc_ns, stop_utc_ns, 30.0)
        return self._candidate(Constraints(), start_utc_ns, stop_utc_ns, cadence_s, contacts, battery, commitments)

    def conditions(self, utc_ns: IntArray) -> Conditions:
        """Return the conditions below the spacecraft at epochs (n,)."""
        position, _ = self.ephemeris.at(utc_ns)
        tdb_s = np.asarray(tdb_s_from_utc_ns(utc_ns))
        rotation = self.orientation.mcmf_from_icrf(tdb_s)
        sun = np.asarray(sun_position_icrf_m(tdb_s))
        place = np.einsum("nij,nj->ni", rotation, position)
        latitude, longitude, altitude = spherical_from_mcmf(place)
        elevation, _ = sun_elevation_azimuth(latitude, longitude, np.einsum("nij,nj->ni", rotation, sun))
        lit = sunlit_fraction(position, sun, np.asarray(earth_position_icrf_m(tdb_s)))
        return Conditions(place, latitude, longitude, altitude, elevation, lit)

    def _excess(self, at: Conditions, constraints: Constraints, *, everywhere: bool = False) -> list[Excess]:
        """Return by how much each constraint is broken (n,).

        The dear one, the craters, is counted `everywhere`, or only where the others hold.
        """
        found: list[Excess] = []
        for name, unit, scale, value, limits in (
            ("altitude", "km", 1e-3, at.altitude_m, constraints.altitude_m),
            ("Sun elevation", "deg", _DEGREE, at.sun_elevation_rad, constraints.sun_elevation_rad),
            ("latitude", "deg", _DEGREE, at.latitude_rad, constraints.latitude_rad),
        ):
            if limits is not None:
                beyond = np.maximum(limits[0] - value, value - limits[1])
                low, high = scale * limits[0], scale * limits[1]
                text = f"{low:g} to {high:g} {unit}"
                if low <= -OPEN_END or high >= OPEN_END:
                    text = f"at most {high:g} {unit}" if low <= -OPEN_END else f"at least {low:g} {unit}"
                found.append(Excess(f"{name} {text}", scale * np.maximum(beyond, 0.0), unit))
        flags: list[tuple[str, BoolArray]] = []
        if constraints.limit_rad is not None:
            inside = np.abs(at.latitude_rad) <= constraints.limit_rad
            name = f"latitude limit of the mission description {_DEGREE * constraints.limit_rad:g} deg"
            found.append(Excess(name, np.where(inside, 0.0, np.inf), is_fixed=True))
        if constraints.regions_rad:
            flags.append(("regions", in_regions(at.latitude_rad, at.longitude_rad, constraints.regions_rad)))
        if constraints.sunlit:
            flags.append(("spacecraft in sunlight", at.sunlit >= 1.0))
        if constraints.mare is not None and self.mare is not None:
            wanted = self.mare(at.latitude_rad, at.longitude_rad) == constraints.mare
            flags.append(("terrain " + ("mare" if constraints.mare else "highland"), wanted))
        found += [Excess(name, np.where(held, 0.0, np.inf)) for name, held in flags]
        if constraints.craters_per_frame is not None and self.catalogue is not None:
            missing = np.zeros(len(at.altitude_m))
            rows = np.flatnonzero(_hold([] if everywhere else found, len(missing)))
            counts = self._craters(at.position_mcmf_m[rows], constraints)
            assert counts is not None
            missing[rows] = np.maximum(constraints.craters_per_frame - counts, 0.0)
            found.append(Excess(f"craters per frame {constraints.craters_per_frame:g}", missing, "craters"))
        return found

    def _craters(self, position_mcmf_m: FloatArray, constraints: Constraints) -> IntArray | None:
        """Catalogued craters of the wanted sizes that a nadir camera sees from each position (n,)."""
        if self.catalogue is None:
            return None
        low, high = constraints.crater_diameter_m
        expected = expected_craters(self.catalogue, self.camera, position_mcmf_m)
        diameter = self.catalogue.diameter_m[expected.index]
        wanted = np.concatenate(([0], np.cumsum((diameter >= low) & (diameter <= high))))
        return np.asarray(np.diff(wanted[expected.offsets]), dtype=np.int64)

    def _battery(self, start_utc_ns: int, stop_utc_ns: int, step_s: float) -> tuple[IntArray, FloatArray]:
        """Epochs (n,) and the charge (n,) in Wh of a battery that was full at the start, without observations."""
        epochs = np.arange(start_utc_ns, stop_utc_ns + 1, round(step_s * NS), dtype=np.int64)
        gain = (self.conditions(epochs).sunlit * self.resources.generation_w - self.resources.idle_w) * (
            step_s / 3600.0
        )
        charge = np.empty(len(epochs))
        now = self.resources.battery_wh
        for i, change in enumerate(gain.tolist()):
            charge[i] = now
            now = min(max(now + change, 0.0), self.resources.battery_wh)
        return epochs, charge

    def _candidate(
        self,
        constraints: Constraints,
        start: int,
        stop: int,
        cadence_s: float,
        contacts: Sequence[PredictedContact],
        battery: tuple[IntArray, FloatArray],
        commitments: Sequence[Option],
    ) -> Candidate:
        frames = frames_between(start, stop, cadence_s)
        epochs = np.linspace(start, stop, min(max(frames, 2), 200)).astype(np.int64)
        at = self.conditions(epochs)
        craters = self._craters(at.position_mcmf_m, constraints) if constraints.craters_per_frame else None
        per_frame = float(craters.mean()) if craters is not None else self.resources.detections_per_frame
        octets = data_octets(frames, per_frame, self.resources.estimators)
        extra_w = self.resources.observing_w
        charge = np.interp(epochs, *battery) - extra_w * (epochs - start) / NS / 3600.0
        mine = Option(start, stop, octets)
        peak, by = storage_peak([*commitments, mine], contacts, self.resources.downlink_bit_s, mine)
        return Candidate(
            start_utc_ns=start,
            stop_utc_ns=stop,
            frames=frames,
            altitude_m=_range(at.altitude_m),
            sun_elevation_rad=_range(at.sun_elevation_rad),
            latitude_rad=_range(at.latitude_rad),
            sunlit_share=float(np.mean(at.sunlit)),
            craters_per_frame=_range(craters) if craters is not None else None,
            mare_share=float(np.mean(self.mare(at.latitude_rad, at.longitude_rad))) if self.mare else None,
            data_octets=octets,
            energy_wh=extra_w * (stop - start) / NS / 3600.0,
            battery_minimum=max(float(charge.min()), 0.0) / self.resources.battery_wh,
            storage_peak_octets=peak,
            downlinked_by_utc_ns=by,
        )

    def _refusal(self, candidate: Candidate, constraints: Constraints) -> str | None:
        if constraints.minimum_battery is not None and candidate.battery_minimum < constraints.minimum_battery:
            return BATTERY
        if candidate.storage_peak_octets > self.resources.storage_octets:
            return STORAGE
        return CONTACT if constraints.needs_contact and candidate.downlinked_by_utc_ns is None else None


def in_regions(
    latitude_rad: FloatArray, longitude_rad: FloatArray, regions_rad: Sequence[tuple[Range, Range]]
) -> BoolArray:
    """Return whether places (n,) are in one of the regions; a region may contain the date line."""
    inside = np.zeros(len(latitude_rad), dtype=np.bool_)
    for (south, north), (west, east) in regions_rad:
        width = east - west if east - west >= 2.0 * math.pi else (east - west) % (2.0 * math.pi)
        along = (longitude_rad - west) % (2.0 * math.pi)
        inside |= (latitude_rad >= south) & (latitude_rad <= north) & (along <= width)
    return inside


def frames_between(start_utc_ns: int, stop_utc_ns: int, cadence_s: float) -> int:
    """Return the number of frames of an observation: one at its start, then one per cadence, none at its stop."""
    return max(-((start_utc_ns - stop_utc_ns) // round(cadence_s * NS)), 1)


COAST_M_S = 1.75e6
"""Along-track error, 1 sigma, after a coast of one revolution, times the duration of the window before it, if nothing
was known before: what the filter states on tuning ground at 20 to 40 km (docs/results/navigation.md), .9 to 1.0 times
this for windows up to 15 minutes and .7 for 35 minutes."""


def data_octets(frames: int, detections_per_frame: float, estimators: int) -> int:
    """Octets of telemetry that an observation makes, by the lengths of the dictionary's packets."""
    detections = DICTIONARY.packet("detections")
    each = detections.base_length + detections.item_length * detections_per_frame
    for name in ("navigation_state", "frame_outcome"):
        each += estimators * DICTIONARY.packet(name).base_length
    return round(frames * (each + DICTIONARY.packet("housekeeping").base_length))


def storage_peak(
    commitments: Sequence[Option], contacts: Sequence[PredictedContact], downlink_bit_s: float, mine: Option
) -> tuple[int, int | None]:
    """Most octets ever stored on board, and when those of `mine` are down (None: not within the contacts).

    Data are there from the end of their window on; what came first leaves first, while any station sees the spacecraft.
    """
    visible = _union(contacts)
    queue = sorted(commitments, key=lambda one: (one.stop_utc_ns, one.start_utc_ns))
    rate = downlink_bit_s / 8.0 / NS
    finished: list[tuple[int | None, Option]] = []
    free_at = 0
    for one in queue:
        left = float(one.octets)
        end: int | None = None
        for begin, stop in visible:
            begin = max(begin, one.stop_utc_ns, free_at)
            if begin >= stop:
                continue
            needed = math.ceil(left / rate) if rate > 0.0 else stop - begin + 1
            if begin + needed <= stop:
                end = begin + needed
                break
            left -= (stop - begin) * rate
        finished.append((end, one))
        free_at = end if end is not None else 2**62
    peak = 0
    for _, one in finished:
        held = sum(
            other.octets
            for end, other in finished
            if other.stop_utc_ns <= one.stop_utc_ns and (end is None or end > one.stop_utc_ns)
        )
        peak = max(peak, held)
    return peak, next(end for end, one in finished if one is mine)


def _union(contacts: Sequence[PredictedContact]) -> list[tuple[int, int]]:
    """Spans in which at least one station sees the spacecraft."""
    spans: list[tuple[int, int]] = []
    for contact in sorted(contacts, key=lambda one: one.start_utc_ns):
        if spans and contact.start_utc_ns <= spans[-1][1]:
            spans[-1] = (spans[-1][0], max(spans[-1][1], contact.stop_utc_ns))
        else:
            spans.append((contact.start_utc_ns, contact.stop_utc_ns))
    return spans


def _cut(start: int, stop: int, maximum_ns: int, gap_ns: int) -> list[tuple[int, int]]:
    """The span in pieces of equal length, none longer than the maximum, with a gap after each."""
    pieces = max(math.ceil((stop - start + gap_ns) / (maximum_ns + gap_ns)), 1)
    edges = np.linspace(start, stop + gap_ns, pieces + 1).astype(np.int64).tolist()
    return [(first, last - gap_ns) for first, last in pairwise(edges)]


def _hold(excess: Sequence[Excess], n: int) -> BoolArray:
    """Return where all constraints hold (n,)."""
    held = np.ones(n, dtype=np.bool_)
    for one in excess:
        held &= one.value <= 0.0
    return held


def explain_exclusion(excess: Sequence[Excess], needed: int, step_s: float) -> str:
    """Return the smallest set of constraints that exclude every span, and the nearest relaxation of one of them.

    Parameters
    ----------
    needed
        Consecutive samples in which all constraints have to hold.
    """
    duration = f"minimum duration {(needed - 1) * step_s:g} s"
    if not excess or len(excess[0].value) < needed:
        return f"no window: the span that was searched is shorter than the {duration}"

    n = len(excess[0].value)

    def spans(held: FloatArray | BoolArray) -> Any:
        return np.lib.stride_tricks.sliding_window_view(held, needed)

    excluding = (
        chosen
        for size in range(1, len(excess) + 1)
        for chosen in combinations(excess, size)
        if not spans(_hold(chosen, n)).all(axis=1).any()
    )
    smallest = next(excluding, ())
    if not smallest:
        return f"no window: the constraints hold for about the {duration} only"
    reason = f"no window: excluded by {', '.join(one.name for one in smallest)} with the {duration}"
    helps = []
    for one in smallest:
        free = spans(_hold([other for other in excess if other is not one], n)).all(axis=1)
        if one.is_fixed or not free.any():
            continue
        nearest = float(spans(one.value).max(axis=1)[free].min())
        helps.append(
            f"{one.name} relaxed by {nearest:.3g} {one.unit}" if math.isfinite(nearest) else f"without {one.name}"
        )
    longest = max(map(len, _hold(excess, n).tobytes().split(b"\0")))
    if longest > 1:
        helps.append(f"a minimum duration of {(longest - 1) * step_s:g} s")
    return reason + (f"; possible: {' or '.join(helps)}" if helps else "; no single relaxation gives one")


def explain_refusals(reasons: Sequence[str], refused: Sequence[Candidate]) -> str:
    """Return what excludes every span in which the constraints hold, and the nearest relaxation of each reason."""
    battery = max(one.battery_minimum for one in refused)
    storage = min(one.storage_peak_octets for one in refused)
    helps = {
        BATTERY: f"a minimum battery of {math.floor(1e3 * battery) / 1e3:g}",
        STORAGE: f"a storage of {storage / (1 << 20):.3g} MiB",
        CONTACT: "without the need of a contact within the span",
        TOO_SHORT: "a shorter minimum duration",
    }
    found = [one for one in helps if one in reasons]
    counted = ", ".join(f"{one} ({reasons.count(one)})" for one in found)
    possible = " or ".join(helps[one] for one in found)
    return f"no window: {len(reasons)} spans are excluded by {counted}; possible: {possible}"


def _range(values: FloatArray | IntArray) -> Range:
    return float(np.min(values)), float(np.max(values))
