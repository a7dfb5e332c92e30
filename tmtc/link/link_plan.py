"""Sections of a stream and their link settings: one decision for every program that reads the stream.

The undamaged markers of the whole stream are surveyed. Declared settings are used where frames are valid with them.
Without a declaration, those are used that the evidence of the whole stream supports; where several consecutive blocks
have markers but no valid frame under them, other settings are proposed for these blocks. A section ends with the last
valid frame of its settings before valid frames of others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tmtc.arrays import BoolArray, IntArray, OctetArray
from tmtc.link import cadu, reed_solomon
from tmtc.link.frame_reading import proof_of
from tmtc.link.frames import frame_checksums_hold, randomise
from tmtc.link.link_check import (
    BLOCK_OCTETS,
    CountPackets,
    LinkProposal,
    MarkerSurvey,
    are_regular,
    propose_link,
    survey_markers,
)
from tmtc.link.settings import LinkSettings

TRIED_PER_BLOCK = 3
"""Number of CADUs of a block on which settings are tried."""

MOST_PROPOSALS = 8
"""Largest number of proposals of other settings for runs of blocks."""

LEAST_MARKERS = 8
"""Smallest number of undamaged markers of a run for which other settings are proposed."""

LEAST_UNPROVED = 3
"""Smallest number of frames without code and checksum from which their settings are accepted."""

SMALL_OCTETS = 1 << 16
"""Length of a stream up to which declared settings are tried without undamaged markers."""

_BATCH_ROWS = 512


@dataclass(frozen=True, slots=True)
class LinkSection:
    """Octets [start, stop) of a stream and the settings of their link."""

    start: int
    stop: int
    settings: LinkSettings


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """Sections of a stream, without gaps and in order; empty for a stream without frames.

    `proposal` is the evidence of the whole stream (None: the settings are declared). `has_regular_markers`: the stream
    has more, or more regular, markers than random data.
    """

    sections: tuple[LinkSection, ...]
    proposal: LinkProposal | None
    has_regular_markers: bool

    @property
    def ambiguous(self) -> bool:
        """Return whether other settings have equal support."""
        return self.proposal is not None and self.proposal.ambiguous


def declared_sections(
    stream: OctetArray, survey: MarkerSurvey, declared: Sequence[LinkSettings]
) -> tuple[LinkSection, ...]:
    """Return the sections of a stream (n,) in which frames are valid with declared settings; none without such frames.

    Frames without code and checksum are valid if their markers have the distance of the settings.
    """
    trial = _Trial(stream, survey)
    proved = [one for one in declared if one.proves_frames]
    for settings in proved:
        trial.try_settings(settings)
    if not trial.found:
        # a piece so small may hold no undamaged marker
        valid = [one for one in proved if stream.size <= SMALL_OCTETS and _valid_starts(stream, one).size]
        valid += [one for one in declared if not one.proves_frames and _are_at_distance(survey, one)]
        if valid:
            trial.try_settings(valid[0], always=True)
    return tuple(trial.sections())


def _are_at_distance(survey: MarkerSurvey, settings: LinkSettings) -> bool:
    return survey.distances.get(settings.cadu_length, 0) >= LEAST_UNPROVED - 1


def plan_link(stream: OctetArray, count_packets: CountPackets) -> LinkPlan:
    """Return the sections of a stream (n,) whose settings are not declared.

    `count_packets` counts the valid packets in some CADUs of a part of the stream (see `link_check.propose_link`).
    """
    survey = survey_markers(stream)
    trial = _Trial(stream, survey)
    proposal = None
    if survey.markers:
        proposal = propose_link(stream, count_packets, survey)
        if proposal.settings is not None and not proposal.settings.proves_frames:
            whole = LinkSection(0, stream.size, proposal.settings)
            enough = proposal.evidence[0].sampled >= LEAST_UNPROVED
            return LinkPlan((whole,) if enough else (), proposal, survey.is_regular)
        if proposal.settings is not None:
            trial.try_settings(proposal.settings, always=True)
    if trial.found:
        _explain_rest(trial, stream, count_packets)
    return LinkPlan(tuple(trial.sections()), proposal, survey.is_regular)


def one_section(stream: OctetArray, settings: LinkSettings) -> LinkPlan:
    """Return the plan of a stream whose settings are stated."""
    return LinkPlan((LinkSection(0, stream.size, settings),), None, True)


def _explain_rest(trial: _Trial, stream: OctetArray, count_packets: CountPackets) -> None:
    """Propose settings for the runs of blocks in which no frame is valid, the longest first."""
    given_up: set[int] = set()
    start = 0

    def count(sync: cadu.CaduSync, settings: LinkSettings) -> tuple[int, float]:
        return count_packets(replace(sync, start_bits=sync.start_bits + 8 * start), settings)

    for _ in range(MOST_PROPOSALS):
        run = next((one for one in trial.unexplained() if one[0] not in given_up), None)
        if run is None:
            return
        start, stop = run
        part = stream[start:stop]
        other = propose_link(part, count, survey_markers(part)).settings
        if other is None or not other.proves_frames or not trial.try_settings(other):
            given_up.add(start)


class _Trial:
    """Blocks of a stream and the settings that hold for them."""

    def __init__(self, stream: OctetArray, survey: MarkerSurvey) -> None:
        self.stream = stream
        self.found: list[LinkSettings] = []
        block = survey.block
        first = np.searchsorted(block, block)
        counts = np.bincount(block, minlength=int(block[-1]) + 1 if block.size else 0)
        # markers spread over each block, the same for all settings
        rank = np.arange(block.size) - first
        step = np.maximum(counts[block] // TRIED_PER_BLOCK, 1)
        chosen = (rank % step == 0) & (rank // step < TRIED_PER_BLOCK)
        self.start_bits: IntArray = survey.start_bits[chosen]
        self.inverted: BoolArray = survey.inverted[chosen]
        self.block: IntArray = block[chosen]
        self.markers = counts
        self.choice = np.full(counts.size, -1, dtype=np.int64)

    def try_settings(self, settings: LinkSettings, *, always: bool = False) -> bool:
        """Assign the settings to the blocks in which a frame is valid; return whether there are any.

        `always`: add the settings even without such a block.
        """
        rows = np.flatnonzero(self.choice[self.block] < 0)
        rows = rows[self.start_bits[rows] + 8 * settings.cadu_length <= 8 * self.stream.size]
        valid = np.zeros(rows.size, dtype=np.bool_)
        for first in range(0, rows.size, _BATCH_ROWS):
            part = rows[first : first + _BATCH_ROWS]
            valid[first : first + part.size] = self._valid(part, settings)
        blocks = np.unique(self.block[rows[valid]])
        if blocks.size or always:
            if settings not in self.found:
                self.found.append(settings)
            self.choice[blocks] = self.found.index(settings)
        return bool(blocks.size)

    def _valid(self, rows: IntArray, settings: LinkSettings) -> BoolArray:
        """Return whether each CADU (n,) is a valid frame that contradicts nothing the settings state."""
        sync = cadu.CaduSync(
            self.start_bits[rows],
            self.inverted[rows],
            np.zeros(rows.size, dtype=np.int64),
            rows[:0],
            settings.cadu_length,
        )
        blocks = randomise(cadu.cadu_octets(self.stream, sync)[:, cadu.ASM_LENGTH :], settings.randomiser)
        code = settings.code
        if code is None:
            return frame_checksums_hold(blocks)
        decoded = reed_solomon.decode(blocks, code)
        valid: BoolArray = np.all(decoded.corrected >= 0, axis=1)
        checksums = frame_checksums_hold(decoded.frames)
        if settings.checksum:
            return valid & checksums
        # the code holds under another randomiser as well, and with a checksum that is then taken for data
        return valid & ~checksums & are_regular(decoded.frames)

    def unexplained(self) -> Iterator[tuple[int, int]]:
        """Yield ranges of octets with markers, but without a valid frame under the settings found, longest first."""
        marked = np.flatnonzero(self.markers)
        runs = np.split(marked, np.flatnonzero(np.diff(self.choice[marked] < 0)) + 1)
        open_runs = [
            run for run in runs if run.size and self.choice[run[0]] < 0 and self.markers[run].sum() >= LEAST_MARKERS
        ]
        open_runs.sort(key=len, reverse=True)
        for run in open_runs:
            yield int(run[0]) * BLOCK_OCTETS, min((int(run[-1]) + 1) * BLOCK_OCTETS, self.stream.size)

    def sections(self) -> Iterator[LinkSection]:
        """Yield the sections."""
        if not self.found:
            return
        known = np.flatnonzero(self.choice >= 0)
        changes = known[1:][np.diff(self.choice[known]) != 0]
        start, now = 0, int(self.choice[known[0]]) if known.size else 0
        for change in changes.tolist():
            before = int(known[np.searchsorted(known, change) - 1])
            settings = self.found[int(self.choice[change])]
            border = self._border(before, change, self.found[now], settings)
            yield LinkSection(start, border, self.found[now])
            start, now = border, int(self.choice[change])
        yield LinkSection(start, self.stream.size, self.found[now])

    def _border(self, before: int, after: int, old: LinkSettings, new: LinkSettings) -> int:
        """Return the octet between two blocks at which other settings begin."""
        first = before * BLOCK_OCTETS
        last = min((after + 1) * BLOCK_OCTETS + max(old.cadu_length, new.cadu_length), self.stream.size)
        ends = _valid_starts(self.stream[first:last], old) + old.cadu_length
        begins = _valid_starts(self.stream[first:last], new)
        end = int(ends[-1]) if ends.size else 0
        later = begins[begins >= end]
        return first + (int(later[0]) if later.size else end)


def _valid_starts(part: OctetArray, settings: LinkSettings) -> IntArray:
    """Return the first octets of the valid frames in a part of a stream."""
    prove = proof_of(part, settings)
    sync = cadu.synchronise(part, settings.cadu_length, verify=prove)
    if prove is None or not sync.start_bits.size:
        return sync.offsets
    return sync.offsets[prove(sync)]
