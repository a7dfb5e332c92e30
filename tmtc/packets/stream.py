"""Packets cut out of octets, with every octet accounted for.

A stream of packets has no marks between them: one wrong length field and everything after it is lost,
unless the cutter finds its way back. `cut_packets` accepts a packet when its checksum holds, keeps a
damaged one (right length, wrong checksum) as such, and skips what is neither until a right packet stands
again. No whole packet is lost to damage before it.

Packets without error control are accepted by their headers alone: each must lead to the next, and sequence
counts must continue. Damage inside such a packet cannot be detected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray, Octets, as_octets
from tmtc.errors import ValueRefused
from tmtc.packets.space_packets import PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH, TYPE_TELEMETRY, crc16

_GOOD, _BAD, _SKIPPED, _IDLE = 0, 1, 2, 3
_NO_CHECKSUM, _UNKNOWN = 1, 2

PREFIX_LIMIT = 1024
"""Largest number of octets before each packet."""

LONGEST_PREFIX = 64
"""Largest number of octets before each packet that is found by trial."""

LOOK_AHEAD = 3 * PACKET_MAX_LENGTH + PRIMARY_HEADER_LENGTH
"""Octets that one decision after damage can need: a window of search, a packet begun in it, its successor."""


@dataclass(frozen=True, slots=True, eq=False)
class PacketCut:
    """Positions of packets in a buffer, or in the segments cut from it.

    `offsets`, `lengths` (n,) and `crc_ok` (n,) hold the packets in the buffer's order, the damaged ones
    included; `idle` (m, 2) and `skipped` (k, 2) are ranges [start, stop) of idle packets and of octets that
    belong to no packet. All of them together, and the prefixes of packets, are [0, consumed) without overlap.
    """

    offsets: IntArray
    lengths: IntArray
    crc_ok: BoolArray
    skipped: IntArray
    idle: IntArray
    consumed: int

    def __len__(self) -> int:
        return int(self.offsets.size)

    @property
    def octets_skipped(self) -> int:
        """Octets that belong to no packet."""
        return int((self.skipped[:, 1] - self.skipped[:, 0]).sum())

    @property
    def octets_idle(self) -> int:
        """Octets of idle packets."""
        return int((self.idle[:, 1] - self.idle[:, 0]).sum())

    @property
    def crc_errors(self) -> int:
        """Packets whose checksum does not hold."""
        return int(self.crc_ok.size - np.count_nonzero(self.crc_ok))

    def packets(self, buffer: Octets) -> Iterator[bytes]:
        """The octets of every packet whose checksum holds."""
        view = as_octets(buffer).data
        for start, length, good in zip(self.offsets.tolist(), self.lengths.tolist(), self.crc_ok.tolist(), strict=True):
            if good:
                yield view[start : start + length].tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class PrimaryHeaders:
    """Primary header fields of n packets as columns."""

    apid: IntArray
    sequence_count: IntArray
    secondary_header: BoolArray
    sequence_flags: IntArray


@dataclass(frozen=True, slots=True)
class PacketForm:
    """Form of the packets in a stream.

    Attributes
    ----------
    error_control
        False: no packet ends with a checksum, as in most captures of other missions; they are found by their headers.
    unchecked
        APIDs whose packets do not end with a checksum, among others that do. Such a packet is accepted if another one,
        or the end of its segment, follows it.
    unknown
        APIDs of which it is not known whether their packets end with a checksum. One packet or several without a right
        checksum must lead to a packet that is accepted.
    prefix_octets
        Octets, of a recorder for example, before each packet of a stream without frames. Packets are found by their
        headers.
    """

    error_control: bool = True
    unchecked: frozenset[int] = frozenset()
    unknown: frozenset[int] = frozenset()
    prefix_octets: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.prefix_octets <= PREFIX_LIMIT:
            raise ValueRefused("packet", "prefix_octets", self.prefix_octets, f"0..{PREFIX_LIMIT}")

    @property
    def by_headers(self) -> bool:
        """Return whether packets are found by their headers, which needs the octets behind them."""
        return not self.error_control or self.prefix_octets > 0

    @property
    def in_frames(self) -> PacketForm:
        """The form of the same packets in frames, where they adjoin."""
        return replace(self, prefix_octets=0)

    def lacks_checksum(self, apid: int) -> bool:
        """Return whether packets of an APID do not end with a checksum."""
        return not self.error_control or apid in self.unchecked

    def apids(self) -> OctetArray:
        """Return the marks of all APIDs (2048,) of the compiled cutters."""
        marks = np.zeros(1 << 11, dtype=np.uint8)
        marks[list(self.unknown)] = _UNKNOWN
        marks[list(self.unchecked) if self.error_control else slice(None)] = _NO_CHECKSUM
        return marks


CHECKED = PacketForm()
UNCHECKED = PacketForm(error_control=False)


def cut_packets(
    buffer: Octets,
    *,
    packet_type: int = TYPE_TELEMETRY,
    segments: IntArray | None = None,
    final: bool = True,
    form: PacketForm = CHECKED,
    begins: bool = True,
) -> PacketCut:
    """Return the positions of packets in `buffer`.

    Parameters
    ----------
    packet_type
        Only packets of this type are packets.
    segments : (s, 2), optional
        Ranges that are cut each for itself, for example between lost frames; the whole buffer by default.
    final
        False when more octets may follow: `consumed` then tells from where to go on.
    form
        If packets are found by their headers, `crc_ok` says of those without a checksum that the headers before and
        after fit; supported for whole streams (`final`) only.
    begins
        Whether a packet is expected at the beginning of each segment, for packets that are found by their headers.
    """
    if form.by_headers and not final:
        raise ValueRefused("packet stream", "final", final, "true for packets that are found by their headers")
    octets = as_octets(buffer).view()
    octets.flags.writeable = False  # one compiled variant for bytes and arrays alike
    if segments is None:
        segments = np.array([[0, octets.size]], dtype=np.int64)
    consumed = 0
    cutter: _Cutter | _HeaderCutter
    if form.by_headers:
        cutter = _HeaderCutter(octets, packet_type, form, begins)
    else:
        cutter = _Cutter(octets, packet_type, form)
    for start, stop in segments.tolist():
        consumed = cutter.cut(start, stop, final)
    rows = cutter.rows[: cutter.count]
    kind = rows[:, 0]
    whole = kind <= _BAD
    chosen = rows if whole.all() else rows[whole]
    return PacketCut(
        offsets=chosen[:, 1].copy(),
        lengths=chosen[:, 2] - chosen[:, 1],
        crc_ok=chosen[:, 0] == _GOOD,
        skipped=rows[kind == _SKIPPED, 1:],
        idle=rows[kind == _IDLE, 1:],
        consumed=octets.size if final else consumed,
    )


def find_prefix(octets: OctetArray, form: PacketForm) -> int:
    """Return the number of octets before each packet that packets of most of a stream (n,) have; 0 if there is none."""
    sample = octets[: 4 * PACKET_MAX_LENGTH]
    found = {0: 2}
    for prefix in range(1, LONGEST_PREFIX + 1):
        cut = cut_packets(sample, form=replace(form, prefix_octets=prefix))
        good = cut.lengths[cut.crc_ok] + prefix
        found[prefix] = good.size if 2 * int(good.sum()) > sample.size else 0
    return max(found, key=lambda prefix: found[prefix])


def whole_packets(lengths: IntArray) -> PacketCut:
    """Return the cut of packets of these lengths (n,), one after another, that are known to be undamaged."""
    none = np.empty((0, 2), dtype=np.int64)
    lengths = np.asarray(lengths, dtype=np.int64)
    offsets = np.cumsum(lengths) - lengths
    return PacketCut(offsets, lengths, np.ones(len(lengths), dtype=np.bool_), none, none, int(lengths.sum()))


def primary_headers(buffer: Octets, cut: PacketCut) -> PrimaryHeaders:
    """Primary header fields of the packets of `cut`, damaged ones included."""
    octets = as_octets(buffer)
    first = octets[cut.offsets].astype(np.int64) << 8 | octets[cut.offsets + 1]
    second = octets[cut.offsets + 2].astype(np.int64) << 8 | octets[cut.offsets + 3]
    return PrimaryHeaders(
        apid=first & 0x7FF,
        sequence_count=second & 0x3FFF,
        secondary_header=(first & 0x800) != 0,
        sequence_flags=second >> 14,
    )


class _Rows:
    """Rows kind, start, stop of a pass over a buffer."""

    def __init__(self, octets: OctetArray, packet_type: int) -> None:
        from tmtc.packets import _cutting

        self.kernels: Any = _cutting
        self.octets = octets
        self.packet_type = packet_type
        self.rows = np.empty((octets.size // 128 + 64, 3), dtype=np.int64)
        self.count = 0

    def grow(self) -> bool:
        """Make room for more rows where none is left; return whether that was so."""
        full = self.count == self.rows.shape[0]
        if full:
            self.rows = np.concatenate((self.rows, np.empty_like(self.rows)))
        return full

    def add(self, kind: int, p: int, q: int) -> None:
        """Write a row."""
        self.grow()
        self.rows[self.count] = kind, p, q
        self.count += 1


class _Cutter(_Rows):
    """One pass over a buffer: compiled walks over undamaged packets, a decision wherever one ends."""

    def __init__(self, octets: OctetArray, packet_type: int, form: PacketForm) -> None:
        super().__init__(octets, packet_type)
        self.tables, self.powers = self.kernels.crc_tables(), self.kernels.powers_of_octets()
        self.prefix: npt.NDArray[np.uint16] | None = None
        self.known = np.full(2, -1, dtype=np.int64)
        self.unchecked = form.apids()

    def cut(self, p: int, stop: int, final: bool) -> int:
        """The position reached in [p, stop): `stop`, or earlier where octets to come could change what follows."""
        begin = self.count
        self.known[:] = -1
        while p < stop:
            p = self.walk(p, stop, final)
            if self.grow():
                continue
            if p == stop:
                break
            if q := self.idle_end(p, stop):
                ends = [(_IDLE, q)]
            elif not final and stop - p < LOOK_AHEAD:
                return p
            else:
                ends = self.decide(p, stop)
            for kind, q in ends:
                self.note(kind, p, q, begin)
                p = q
        return p

    def walk(self, p: int, stop: int, final: bool) -> int:
        """Write rows of undamaged packets from `p` on; return the position behind them."""
        key = (self.octets, p, stop, self.packet_type, self.tables, self.rows, self.count)
        end, self.count = self.kernels.walk(*key, self.unchecked, not final)
        return int(end)

    def search(self, first: int, limit: int, stop: int, state: tuple[Any, ...]) -> int:
        """Return the first position in [first, limit) at which a packet is believed to begin, or `limit`."""
        key = (first, limit, stop, self.packet_type)
        return int(self.kernels.search(self.octets, *key, *state, self.unchecked))

    def note(self, kind: int, p: int, q: int, begin: int) -> None:
        """Write a row; what is skipped right after something skipped prolongs that row."""
        last = self.rows[self.count - 1]
        if kind == _SKIPPED and self.count > begin and last[0] == _SKIPPED:
            last[2] = q
        else:
            self.add(kind, p, q)

    def decide(self, p: int, stop: int) -> list[tuple[int, int]]:
        """(kind, end) of what stands at `p` and right after it, where no packet with a right checksum stands."""
        if self.prefix is None:
            self.prefix = np.empty(self.octets.size + 1, dtype=np.uint16)
        state = (self.prefix, self.known, self.tables, self.powers)
        length = self.length_at(p, stop)
        e = p + length
        trusted = length and (self.is_idle(p) or self.kernels.is_pus(self.octets, p, length, self.packet_type))
        if trusted and (e == stop or self.is_packet_at(e, stop)):
            # the header is one and a packet follows where it says, so the damage is inside [p, e), whatever else may
            # be found in there, unless the length is wrong and right packets fill the end of that range
            q = self.kernels.chain_start(self.octets, p + 1, e, self.packet_type, *state)
            return [(self.kind_of(p), e)] if q < 0 else [(_SKIPPED, q)]
        limit = min(stop, p + PACKET_MAX_LENGTH)
        q = self.search(p + 1, limit, stop, state)
        if q == limit < stop:
            return [(_SKIPPED, q)]
        # several damaged packets in a row, whose lengths still lead to the next right one
        ends, r = [], p
        while r < q and (length := self.length_at(r, q)):
            ends.append((self.kind_of(r), r + length))
            r += length
        return ends if r == q else [(_SKIPPED, q)]

    def idle_end(self, p: int, stop: int) -> int:
        """End of an evenly filled idle packet at `p` with a packet behind it, else 0: needs no search."""
        length = self.length_at(p, stop)
        if not length or not self.is_idle(p):
            return 0
        fill = self.octets[p + PRIMARY_HEADER_LENGTH : p + length]
        return p + length if np.all(fill == fill[0]) and self.is_packet_at(p + length, stop) else 0

    def kind_of(self, p: int) -> int:
        return _IDLE if self.is_idle(p) else _BAD

    def is_idle(self, p: int) -> bool:
        return bool(self.kernels.is_idle(self.octets, p))

    def length_at(self, p: int, stop: int) -> int:
        key = (self.octets, p, stop, self.packet_type)
        return int(self.kernels.unchecked_length(*key, self.unchecked) or self.kernels.length_at(*key))

    def is_packet_at(self, p: int, stop: int) -> bool:
        """Return whether a whole packet (with a right checksum if it has one) or an idle header stands at `p`."""
        if self.kernels.unchecked_length(self.octets, p, stop, self.packet_type, self.unchecked):
            return True
        length = self.length_at(p, stop)
        return bool(length) and (self.is_idle(p) or crc16(self.octets[p : p + length].data) == 0)


class _HeaderCutter(_Rows):
    """One pass over packets that are found by their headers: walk over headers, search where they end."""

    def __init__(self, octets: OctetArray, packet_type: int, form: PacketForm, begins: bool) -> None:
        super().__init__(octets, packet_type)
        self.begins = begins
        self.prefix_octets = form.prefix_octets
        self.checks = form.apids(), self.kernels.crc_tables()
        self.last = np.full(1 << 11, -1, dtype=np.int64)

    def cut(self, start: int, stop: int, final: bool) -> int:
        """Cut [start, stop), where a packet is expected behind a prefix at `start`."""
        kernels, key = self.kernels, (stop, self.packet_type)
        place = (*key, self.prefix_octets, self.last)
        p = start + self.prefix_octets
        if start < stop and not kernels.proves(self.octets, p, *place, self.begins):
            p = self.skip(start, *key)
        while p < stop:
            before = self.count
            p, self.count = kernels.walk_unchecked(self.octets, p, *place, *self.checks, self.rows, self.count)
            if self.grow():
                continue
            if p < stop and (self.count == before or self.is_begun(p, *key)):
                p = self.skip(p, *key)  # a packet whose end is missing; those before it fit
            elif p < stop:
                # the length of the last packet leads to no header: it is wrong, or what follows is no packet
                begin = int(self.rows[self.count - 1, 1])
                q = int(kernels.search_unchecked(self.octets, begin + 1, *place, *self.checks))
                if q < p:
                    self.count -= 1
                    p = begin
                elif self.is_unchecked(begin):  # nothing confirms the packet: octets of it may be missing
                    self.rows[self.count - 1, 0] = _BAD
                self.add(_SKIPPED, p, q)
                p = q
        return p

    def is_unchecked(self, p: int) -> bool:
        """Return whether the packet at `p` does not end with a checksum."""
        return bool(self.checks[0][(int(self.octets[p]) & 0x07) << 8 | int(self.octets[p + 1])])

    def is_begun(self, p: int, stop: int, packet_type: int) -> bool:
        """Return whether a packet can begin at `p` and end behind `stop`."""
        if stop - p <= PRIMARY_HEADER_LENGTH:
            return bool(self.octets[p] >> 4 == packet_type)
        return bool(self.kernels.header_at(self.octets, p, stop, packet_type))

    def skip(self, p: int, stop: int, packet_type: int) -> int:
        """Skip from `p` to the next position at which packets begin; return it."""
        key = (stop, packet_type, self.prefix_octets, self.last)
        q = int(self.kernels.search_unchecked(self.octets, p + 1, *key, *self.checks))
        self.add(_SKIPPED, p, q)
        return q
