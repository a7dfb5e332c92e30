"""Proposal of link settings from a recorded stream, with the evidence for each candidate.

The whole stream is searched for undamaged markers. Their distances give the possible lengths of a CADU. A station may
have inserted octets between CADUs, so shorter lengths are tried if the distances alone give no valid frame. For each
length, every code, basis, interleaving depth and randomiser is tried on a sample of CADUs spread over the stream. The
evidence is the share of codewords that are correct or correctable, the share of valid frame checksums, the share of
regular frame headers, and the number of packets with a valid checksum. A candidate with neither code nor checksum is
proposed only if valid packets support it.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tmtc.arrays import BoolArray, IntArray, OctetArray
from tmtc.errors import LinkFormatError
from tmtc.link import cadu, reed_solomon
from tmtc.link.frames import FRAME_HEADER_LENGTH, FRAME_MAX_LENGTH, Randomiser, frame_checksums_hold, randomise
from tmtc.link.settings import FRAME_MIN_LENGTH, LinkSettings

BLOCK_OCTETS = 1 << 16
"""Octets of a block; link settings that hold for less than a block are not looked for."""

KEPT_PER_BLOCK = 16
"""Largest number of markers of a block whose position is kept."""

LONGEST_DISTANCE = 1 << 14
"""Largest distance of markers that is counted, in octets."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerSurvey:
    """Undamaged markers of a stream.

    `start_bits` (n,) and `inverted` (n,) hold at most `KEPT_PER_BLOCK` markers of each block in order, `markers` is the
    number of all. `distances`: how often each distance in octets occurs between consecutive markers, the most frequent
    first.
    """

    start_bits: IntArray
    inverted: BoolArray
    markers: int
    distances: dict[int, int]

    @property
    def block(self) -> IntArray:
        """Block (n,) of each kept marker."""
        return (self.start_bits >> 3) // BLOCK_OCTETS

    @property
    def is_regular(self) -> bool:
        """Return whether the stream has more, or more regular, markers than random data."""
        return self.markers >= 3 or max(self.distances.values(), default=0) >= 2


def survey_markers(stream: OctetArray) -> MarkerSurvey:
    """Return the survey of a stream (n,)."""
    histogram = np.zeros(LONGEST_DISTANCE + 1, dtype=np.int64)
    kept: list[IntArray] = [np.empty(0, dtype=np.int64)]
    markers, last_block, in_block = 0, -1, 0
    last = np.empty(0, dtype=np.int64)
    for found in cadu.undamaged_candidates(stream):
        markers += found.size
        starts = np.concatenate((last, found))
        distance = starts[1:] - starts[:-1]
        whole = distance[(distance & 7 == 0) & (distance >= 8 * cadu.ASM_LENGTH)] >> 3
        histogram += np.bincount(whole[whole <= LONGEST_DISTANCE], minlength=histogram.size)
        last = found[-1:]
        block = (found >> 3) // BLOCK_OCTETS
        rank = np.arange(found.size) - np.searchsorted(block, block)
        rank += np.where(block == last_block, in_block, 0)
        kept.append(found[rank < KEPT_PER_BLOCK])
        last_block, in_block = int(block[-1]), int(rank[-1]) + 1
    kept_starts = np.concatenate(kept)
    order = np.argsort(-histogram, kind="stable")
    order = order[histogram[order] > 0]
    return MarkerSurvey(
        kept_starts,
        cadu.are_inverted(stream, kept_starts),
        markers,
        {int(octets): int(histogram[octets]) for octets in order},
    )


CountPackets = Callable[[cadu.CaduSync, LinkSettings], tuple[int, float]]
"""Returns the number of valid packets in CADUs under link settings, and the share of the frames that they fill."""

RANDOMISERS: tuple[Randomiser, ...] = ("legacy", "long", "none")
SAMPLE = 48
"""Number of CADUs on which candidates are tried, spread over the stream so that one weak part does not decide."""

STRETCH = 64
"""Number of consecutive CADUs in which packets are counted."""

LONGEST_GAP = 64
"""Largest number of octets that a station is assumed to insert between CADUs if the mission description states none."""

LEAST_SHARE = 0.02
LEAST_REGULAR = 0.9
"""Smallest share of frames without code and checksum that have regular headers; random data give one in 128."""

LEAST_FILLED = 0.5
"""Smallest share of frames without code and checksum that valid packets fill."""

LEAST_PROOFS = 2
"""Smallest number of valid frames: a 16-bit checksum is valid by chance once in 65,536 trials."""

_STANDARD = tuple(cadu.ASM_LENGTH + depth * reed_solomon.CODEWORD for depth in reed_solomon.INTERLEAVES)
_REPAIRED = 12
_FEW = 8
_SHORTEST_CADU = cadu.ASM_LENGTH + FRAME_HEADER_LENGTH + 2


@dataclass(frozen=True, slots=True)
class LinkEvidence:
    """Evidence for one candidate: shares of a sample, and valid packets in consecutive CADUs.

    `codewords_clean` and `codewords_repairable`: codewords without error, and corrected codewords (None: no code, or
    not tried). `checksums_hold`: valid frame checksums. `headers_regular`: frame headers of version 0 with the usual
    flags. `filled`: share of the frames that valid packets fill.
    """

    settings: LinkSettings
    sampled: int
    codewords_clean: float | None
    codewords_repairable: float | None
    checksums_hold: float
    headers_regular: float
    packets: int
    filled: float

    @property
    def rank(self) -> tuple[float, float]:
        """Order of candidates: packets first, then proof."""
        return self.packets + self.headers_regular, max(
            self.codewords_clean or 0.0, self.codewords_repairable or 0.0, self.checksums_hold
        )

    def describe(self) -> dict[str, object]:
        """Return the evidence by name, for output."""
        return asdict(self) | {"settings": self.settings.describe()}


@dataclass(frozen=True, slots=True)
class LinkProposal:
    """Link settings proposed for a stream (None: none fit), with the evidence.

    `markers`: undamaged markers in the stream. `distances`: octets between consecutive markers and their number, the
    most frequent first. `ambiguous`: another candidate has equal support.
    """

    settings: LinkSettings | None
    evidence: tuple[LinkEvidence, ...]
    markers: int
    distances: dict[int, int]
    ambiguous: bool

    @property
    def has_regular_markers(self) -> bool:
        """Return whether the stream has more, or more regular, markers than random data."""
        return self.markers >= 3 or max(self.distances.values(), default=0) >= 2


def propose_link(stream: OctetArray, count_packets: CountPackets, survey: MarkerSurvey) -> LinkProposal:
    """Return the link settings that fit a stream of CADUs, with the evidence.

    Parameters
    ----------
    stream : (n,) uint8
    count_packets
        Counts the valid packets in some CADUs of the stream.
    survey
        Undamaged markers of the stream.
    """
    starts, inverted, distances = survey.start_bits, survey.inverted, survey.distances
    if not starts.size:
        return LinkProposal(None, (), 0, distances, False)
    found: list[LinkEvidence] = []
    groups = list(_lengths(stream.size, distances))
    for proved in (True, False):
        for lengths in groups:
            for length in lengths:
                usual = lengths is groups[0]
                found += _examine(stream, starts, inverted, length, count_packets, proved, usual)
            if found:
                break
        if found:
            break
    found.sort(key=lambda one: one.rank, reverse=True)
    if not found:
        return LinkProposal(None, (), survey.markers, distances, False)
    best = found[0]
    rivals = [
        one for one in found[1:] if one.packets >= best.packets > 0 and one.headers_regular >= best.headers_regular
    ]
    return LinkProposal(best.settings, tuple(found), survey.markers, distances, bool(rivals))


def _lengths(octets: int, distances: dict[int, int]) -> Iterator[list[int]]:
    """Yield groups of possible CADU lengths in octets, the most likely group first."""
    longest = cadu.ASM_LENGTH + max(FRAME_MAX_LENGTH, max(reed_solomon.INTERLEAVES) * reed_solomon.CODEWORD)
    if not distances:
        yield [octets] if _SHORTEST_CADU <= octets <= longest else []
        return
    total = sum(distances.values())
    usual = [d for d, n in distances.items() if n >= max(total / 50, 2) and _SHORTEST_CADU <= d <= longest][:4]
    yield usual or [d for d in list(distances)[:1] if _SHORTEST_CADU <= d <= longest]
    # a header or gap between CADUs: lengths up to the distance that only few pairs of markers are below
    ordered = sorted(distances)
    passed = np.cumsum([distances[d] for d in ordered])
    shortest = ordered[int(np.searchsorted(passed, 0.05 * total))]
    near = range(max(shortest - LONGEST_GAP, _SHORTEST_CADU), shortest + 1)
    yield [length for length in {*_STANDARD, *near} if length <= min(shortest, longest)]


def _examine(
    stream: OctetArray,
    starts: IntArray,
    inverted: BoolArray,
    length: int,
    count_packets: CountPackets,
    proved: bool,
    usual: bool,
) -> list[LinkEvidence]:
    """Return the evidence of the candidates for one length of a CADU.

    `proved`: examine candidates with a code or checksum, otherwise those without. `usual`: the length is a distance of
    markers; for other lengths, only the standard ones are tried on codewords with errors.
    """
    whole = np.flatnonzero(starts + 8 * length <= 8 * stream.size)
    if not whole.size:
        return []
    rows = whole[np.unique(np.linspace(0, whole.size - 1, min(whole.size, SAMPLE)).astype(np.int64))]
    sync = cadu.CaduSync(starts[rows], inverted[rows], np.zeros(rows.size, dtype=np.int64), starts[:0], length)
    blocks = cadu.cadu_octets(stream, sync)[:, cadu.ASM_LENGTH :]
    plain = {name: randomise(blocks, name) for name in RANDOMISERS}
    coded, uncoded = _candidates(length - cadu.ASM_LENGTH)
    if not proved:
        without = [
            replace(c, checksum=False) for c in uncoded if are_regular(plain[c.randomiser]).mean() >= LEAST_REGULAR
        ]
        weighed = [_weigh(stream, sync, plain[c.randomiser], c, count_packets) for c in without]
        return [one for one in weighed if one.packets >= LEAST_PROOFS and one.filled >= LEAST_FILLED]
    # a few blocks exclude most candidates
    few = np.unique(np.linspace(0, rows.size - 1, min(rows.size, _FEW)).astype(np.int64))
    likely = [c for c in coded if reed_solomon.clean(plain[c.randomiser][few], _code(c)).any()]
    clean = [(c, reed_solomon.clean(plain[c.randomiser], _code(c))) for c in likely]
    finalists = _best([(float(words.mean()), c, np.all(words, axis=1)) for c, words in clean])
    if not finalists:
        held = [(c, frame_checksums_hold(plain[c.randomiser])) for c in uncoded]
        finalists = _best([(float(proof.mean()), c, proof) for c, proof in held])
    if not finalists and (usual or length in _STANDARD):
        some = np.unique(np.linspace(0, rows.size - 1, min(rows.size, _REPAIRED)).astype(np.int64))
        for c in coded:  # by the first codeword of each block
            words = np.ascontiguousarray(plain[c.randomiser][some, :: _code(c).interleave])
            if np.count_nonzero(reed_solomon.repair(words, _code(c))[1] >= 0) >= min(LEAST_PROOFS, some.size):
                finalists.append(c)
    return [_weigh(stream, sync, plain[c.randomiser], c, count_packets) for c in finalists]


def _weigh(
    stream: OctetArray, sync: cadu.CaduSync, blocks: OctetArray, candidate: LinkSettings, count_packets: CountPackets
) -> LinkEvidence:
    """Return the evidence for one candidate, with frame error control if most frames have it."""
    code = candidate.code
    settings, frames = candidate, blocks
    clean = repaired = None
    good: BoolArray = np.ones(blocks.shape[0], dtype=np.bool_)
    if code is not None:
        decoded = reed_solomon.decode(blocks, code)
        clean = float((decoded.corrected == 0).mean())
        repaired = float((decoded.corrected > 0).mean())
        good = np.all(decoded.corrected >= 0, axis=1)
        frames = decoded.frames
    held = frame_checksums_hold(frames)
    if code is not None:
        settings = replace(candidate, checksum=bool(held[good].sum() > good.sum() / 2))
    proved = good & held if settings.checksum else good
    share = float(are_regular(frames)[proved].mean()) if proved.any() else 0.0
    first = int(np.argmax(proved)) if proved.any() else 0
    begin = int(sync.start_bits[first] >> 3)
    # enough octets for these CADUs and the gaps that a station may have inserted
    stretch = stream[begin : begin + (STRETCH + 1) * (sync.period + LONGEST_GAP)]
    consecutive = cadu.synchronise(stretch, sync.period)
    consecutive = consecutive.take(np.arange(min(STRETCH, consecutive.start_bits.size)))
    shifted = replace(consecutive, start_bits=consecutive.start_bits + 8 * begin)
    packets, filled = count_packets(shifted, settings)
    return LinkEvidence(
        settings=settings,
        sampled=int(blocks.shape[0]),
        codewords_clean=clean,
        codewords_repairable=repaired,
        checksums_hold=float(held.mean()),
        headers_regular=share,
        packets=packets,
        filled=filled,
    )


def are_regular(frames: OctetArray) -> BoolArray:
    """Return whether each frame (n, length) has version 0, no data field flags and segment length id 11."""
    regular: BoolArray = (frames[:, 0] >> 6 == 0) & (frames[:, 4] >> 3 == 0b00011)
    return regular


def _best(shares: list[tuple[float, LinkSettings, Any]]) -> list[LinkSettings]:
    """Return the candidates with at least half of the greatest share and enough valid frames."""
    greatest = max((share for share, _, _ in shares), default=0.0)
    if greatest <= LEAST_SHARE:
        return []
    return [
        settings
        for share, settings, proof in shares
        if share >= greatest / 2 and proof.sum() >= min(LEAST_PROOFS, proof.size)
    ]


def _code(settings: LinkSettings) -> reed_solomon.ReedSolomon:
    code = settings.code
    if code is None:
        raise LinkFormatError("link: expected a coded candidate, found none")
    return code


def _candidates(block_length: int) -> tuple[list[LinkSettings], list[LinkSettings]]:
    """Return the coded and the uncoded settings whose blocks have that length."""
    coded = []
    for errors in (16, 8):
        for depth in reversed(reed_solomon.INTERLEAVES):
            frame_length = block_length - 2 * errors * depth
            if (
                block_length % depth
                or block_length // depth > reed_solomon.CODEWORD
                or not (FRAME_MIN_LENGTH <= frame_length <= FRAME_MAX_LENGTH)
            ):
                continue
            for dual in (True, False):
                for name in RANDOMISERS:
                    coded.append(LinkSettings(frame_length, "rs", name, depth, errors, dual))
    if not FRAME_MIN_LENGTH <= block_length <= FRAME_MAX_LENGTH:
        return coded, []
    return coded, [LinkSettings(block_length, "none", name) for name in RANDOMISERS]
