"""Joining of units that were cut between pieces of a downlink, at any octet and in any order of the pieces.

A CADU in several pieces is joined by position (stated by the sender, or the order of arrival), otherwise by content: a
start and an end whose lengths add up to one CADU and whose frame counts are consecutive. A packet in several runs of
frames is joined by the counts of its channel. The codes and checksums of the CADU or packet decide in every case;
octets that do not match yet wait.

Edges are committed before adjacent edges are searched. Therefore, of two pieces that are ingested at the same time, at
least the later one sees the edges of both, and no lock is held during decoding. The result of joining is stored in at
most two transactions: one for CADUs or bare packets, one for the packets of channels. The octets of a CADU count as
used from the second one on, so that an ingest that is cut off in between joins the CADU again and finds the same
packets.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.ground import Ground
from ground_service.ingest import edge_store as store
from ground_service.ingest.edge_store import Part, Piece, StoredEdge
from ground_service.ingest.edges import CLOSER, MIDDLE, OPENER, PLACED, UNKNOWN, Edge, packet_octets_missing
from ground_service.ingest.frames import (
    ChannelEdge,
    ChannelReader,
    FrameBlock,
    UncheckedApids,
    all_checked,
    is_checked,
    marker_errors,
    packets_end,
    read_frames,
)
from ground_service.ingest.packets import batch_of_cut
from ground_service.ingest.redecode import note_dictionary
from ground_service.ingest.store import store_batch
from ground_service.ingest.stream import BARE, Link
from ground_service.store.vehicles import vehicle_id
from tmtc import reed_solomon
from tmtc.arrays import as_octets
from tmtc.cadu import ASM_LENGTH, DEFAULT_TOLERANCE
from tmtc.crc import crc16
from tmtc.dictionary import DICTIONARY
from tmtc.link import LinkSettings
from tmtc.packets import IDLE_APID, PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.randomiser import randomise
from tmtc.stream import whole_packets

OctetArray = NDArray[np.uint8]

MIDDLES_LIMIT = 512
"""Largest number of pieces without a position that are tried, newest first."""

MIDDLES_IN_A_CADU = 7
ARRANGEMENTS_LIMIT = 5_040
"""Limits of the pieces without a position in one CADU, and of the arrangements of the right length that are tried."""

ANY_COUNT_LIMIT = 16
"""Largest number of edges of the right length and another frame count that are tried, newest first.

Counts are derived from the frames around a CADU, and are wrong if these are of another spacecraft."""

REPAIRS_LIMIT = 4
"""Largest number of arrangements that are corrected if none is free of errors."""

FOREIGN_SHARE = 0.25
"""Octets of which a larger share is corrected belong to another CADU; noise that can be corrected has 6 %."""

PATHS_LIMIT = 256
"""Largest number of sequences of middles that are tried for one packet."""


@dataclass(slots=True)
class Joined:
    """Result of joining."""

    packets: int = 0
    frames: int = 0


@dataclass(slots=True)
class _Found:
    """Results that are not stored yet: packets by spacecraft, edges, and the octets used."""

    packets: dict[int, list[bytes]] = field(default_factory=dict)
    channel_edges: list[ChannelEdge] = field(default_factory=list)
    openers: list[tuple[str, str, Edge]] = field(default_factory=list)
    used: dict[int, StoredEdge] = field(default_factory=dict)
    parts: list[tuple[str, Part]] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.packets or self.channel_edges or self.openers or self.used or self.parts)

    def uses(self, edge: StoredEdge) -> bool:
        """Return whether an edge is used."""
        if edge.id in self.used:
            return not store.is_reusable(edge.edge)
        return not store.is_reusable(edge.edge) and any(
            domain == edge.domain
            and part.file_sha256 == edge.file_sha256
            and edge.edge.start is not None
            and part.start <= edge.edge.start
            and edge.edge.start + len(edge.edge.octets) <= part.stop
            for domain, part in self.parts
        )


@dataclass(slots=True)
class Joiner:
    """Joiner of one piece with all others of its scope.

    `vehicles` maps spacecraft to vehicle ids; new spacecraft are added.
    """

    ground: Ground
    piece: Piece
    vehicles: dict[int, int]
    unchecked_apids: UncheckedApids = all_checked
    joined: Joined = field(default_factory=Joined)
    _channels: list[tuple[str, bytes]] = field(default_factory=list)
    _raw: list[tuple[Link, list[bytes]]] = field(default_factory=list)
    _found: _Found = field(default_factory=_Found)
    _joined_cadus: _Found = field(default_factory=_Found)

    def vehicle(self, connection: Connection, spacecraft: int) -> int:
        """Return the vehicle id of a spacecraft; create it if it is new."""
        if spacecraft not in self.vehicles:
            vehicle = vehicle_id(connection, spacecraft, self.piece.scope)
            note_dictionary(connection, vehicle)
            self.vehicles[spacecraft] = vehicle
        return self.vehicles[spacecraft]

    def keep_channel_edges(self, connection: Connection, edges: Sequence[ChannelEdge]) -> None:
        """Store the fragments in channels for `join`, within the caller's transaction."""
        by_domain: dict[str, list[Edge]] = {}
        for one in edges:
            spacecraft, channel, start, stop = one.channel
            domain = f"channel {self.vehicle(connection, spacecraft)} {channel} {start} {stop}"
            by_domain.setdefault(domain, []).append(one.edge)
        for domain, mine in sorted(by_domain.items()):
            self._channels += [(domain, identity) for identity in store.add_edges(connection, domain, mine)]

    def keep_edges(self, connection: Connection, link: Link, edges: Sequence[Edge]) -> None:
        """Store the edges of the piece, whose link is `link`, within the caller's transaction."""
        domain = raw_domain(self.piece, link)
        if self.piece.stream:
            edges = [replace(one, role=PLACED) if one.role == MIDDLE else one for one in edges]
        mine = store.add_edges(connection, domain, edges, self.piece.file_sha256)
        self._raw.append((link, mine))

    def join(self) -> None:
        """Join the stored and committed edges, and the edges that result from joining."""
        for link, identities in self._raw:
            domain = raw_domain(self.piece, link)
            if link.settings is not None:
                with self.ground.database.reading() as connection:
                    self._join_cadus_by_place(connection, domain, link.settings)
                    for edge in self._open(connection, domain, identities):
                        self._join_cadu_by_content(connection, domain, link.settings, edge)
                self._store()
            elif self.piece.spacecraft_id is not None:
                with self.ground.database.reading() as connection:
                    self._join_packets_by_place(connection, domain)
                waiting = [*identities, *self._store()]
                while waiting:
                    with self.ground.database.reading() as connection:
                        for edge in self._open(connection, domain, waiting):
                            self._join_packet_by_content(connection, domain, edge)
                    waiting = self._store()
        self._raw.clear()
        self._join_channels()
        self._found.used |= self._joined_cadus.used
        self._found.parts += self._joined_cadus.parts
        self._joined_cadus = _Found()
        self._store()

    def _store(self) -> list[bytes]:
        """Store the results in one transaction; return the identities of new waiting starts of packets.

        All transactions write in this order, which prevents deadlocks.
        """
        found, self._found = self._found, _Found()
        if not found:
            return []
        if found.channel_edges:
            self._joined_cadus.used |= found.used
            self._joined_cadus.parts += found.parts
            found.used, found.parts = {}, []
        batches = {}
        for spacecraft, packets in found.packets.items():
            cut = whole_packets(np.array([len(one) for one in packets], dtype=np.int64))
            batches[spacecraft] = batch_of_cut(b"".join(packets), cut, DICTIONARY, spacecraft)
        waiting: list[bytes] = []
        with self.ground.database.writing() as connection:
            store.use_edges(connection, found.used.values(), found.parts)
            for domain, file_sha256, opener in found.openers:
                waiting += store.add_edges(connection, domain, [opener], file_sha256)
            self.keep_channel_edges(connection, found.channel_edges)
            vehicles = {self.vehicle(connection, spacecraft): spacecraft for spacecraft in batches}
            for vehicle, spacecraft in sorted(vehicles.items()):
                stored = store_batch(connection, vehicle, batches[spacecraft])
                self.joined.packets += stored.new
                store.count_stored(connection, self.piece.ingest_id, stored.new, stored.samples, joined=True)
        return waiting

    def _open(self, connection: Connection, domain: str, identities: Sequence[bytes]) -> Iterator[StoredEdge]:
        """Yield the edges that wait and are not used by results found meanwhile."""
        for edge in store.open_edges(connection, domain, identities):
            if edge.edge.role != PLACED and not self._found.uses(edge):
                yield edge

    def _candidates(self, connection: Connection, domain: str, role: int, **wanted: Any) -> list[StoredEdge]:
        found = store.candidates(connection, domain, role, **wanted)
        return [edge for edge in found if not self._found.uses(edge)]

    def _use(self, edges: Sequence[StoredEdge]) -> None:
        self._found.used.update((edge.id, edge) for edge in edges)

    # CADUs

    def _join_cadus_by_place(self, connection: Connection, domain: str, settings: LinkSettings) -> None:
        length, octets = settings.cadu_length, self.piece.octets
        before = store.octets_before(connection, self.piece, length - 1)
        behind = store.octets_behind(connection, self.piece, length + ASM_LENGTH - 1)
        sha256 = self.piece.file_sha256
        reach = length + ASM_LENGTH - 1
        if octets <= 2 * reach:
            contexts = [([*before, Part(sha256, 0, octets), *behind], before, octets)]
        else:
            contexts = [
                ([*before, Part(sha256, 0, reach)], before, reach),
                ([Part(sha256, octets - reach, octets), *behind], [], reach),
            ]
        for parts, ahead, mine in contexts:
            if len(parts) == 1:
                continue
            stream = as_octets(b"".join(self._octets(part) for part in parts))
            start = sum(part.stop - part.start for part in ahead)
            slots = _slots_across(stream, start, start + mine, settings)
            if not slots.size:
                continue
            block = read_frames(stream, slots, settings)
            for offset in self._take_frames(block):
                wrong = _repaired(stream, offset, block)
                for part in _within(parts, offset, offset + length):
                    octets = part.stop - part.start
                    if not _is_foreign(wrong[:octets]):
                        self._found.parts.append((domain, part))
                    wrong = wrong[octets:]

    def _join_cadu_by_content(
        self, connection: Connection, domain: str, settings: LinkSettings, edge: StoredEdge
    ) -> None:
        length = settings.cadu_length
        counts = [edge.edge.count if edge.edge.role == CLOSER else edge.edge.next_count, UNKNOWN]
        if edge.edge.role != MIDDLE:
            other = CLOSER if edge.edge.role == OPENER else OPENER
            for found in self._with_count_first(connection, domain, other, edge.edge.fit, counts):
                pairs = [[edge, one] if other == CLOSER else [one, edge] for one in found]
                if pairs and self._try_cadus(settings, pairs):
                    return
        if self.piece.stream:
            return  # an incomplete CADU without a position waits for octets with one
        for arrangement in self._with_middles(connection, domain, edge, counts, length):
            if self._try_cadus(settings, arrangement):
                return

    def _with_count_first(
        self, connection: Connection, domain: str, role: int, fit: int, counts: list[int]
    ) -> Iterator[list[StoredEdge]]:
        """Yield the edges of the right length: those with the right count first, then those with any count."""
        if counts[0] == UNKNOWN:
            yield self._candidates(connection, domain, role, fit=(fit,))
            return
        right = self._candidates(connection, domain, role, fit=(fit,), count=counts)
        yield right
        tried = {one.id for one in right}
        found = self._candidates(connection, domain, role, fit=(fit,), limit=ANY_COUNT_LIMIT)
        yield [one for one in found if one.id not in tried]

    def _with_middles(
        self, connection: Connection, domain: str, edge: StoredEdge, counts: list[int], length: int
    ) -> Iterator[list[list[StoredEdge]]]:
        """Yield arrangements of a CADU with pieces without a position, those with fewer pieces first."""
        middles = self._candidates(connection, domain, MIDDLE, limit=MIDDLES_LIMIT)
        if not middles:
            return
        wanted = None if counts[0] == UNKNOWN else counts
        openers = [edge] if edge.edge.role == OPENER else []
        closers = [edge] if edge.edge.role == CLOSER else []
        openers = openers or self._candidates(connection, domain, OPENER, count=wanted, limit=MIDDLES_LIMIT)
        closers = closers or self._candidates(connection, domain, CLOSER, count=wanted, limit=MIDDLES_LIMIT)
        pairs = [
            (opener, [closer], length - len(opener.edge.octets) - len(closer.edge.octets))
            for opener in openers
            for closer in closers
            if _counts_fit(opener.edge.next_count, closer.edge.count)
        ]
        if edge.edge.role != CLOSER:  # the last CADU of a stream, which no marker follows
            pairs += [(opener, [], opener.edge.fit) for opener in openers]
        by_length: dict[int, list[tuple[StoredEdge, list[StoredEdge]]]] = {}
        for opener, ending, missing in pairs:
            by_length.setdefault(missing, []).append((opener, ending))
        must = (edge,) if edge.edge.role == MIDDLE else ()
        others = [one for one in middles if one.id != edge.id]
        arrangements = (
            [opener, *chosen, *ending]
            for subset in _subsets(must, others, by_length)
            for chosen in permutations(subset)
            for opener, ending in by_length[sum(len(one.edge.octets) for one in subset)]
        )
        budget = islice(arrangements, ARRANGEMENTS_LIMIT)
        while some := list(islice(budget, 256)):
            yield some

    def _try_cadus(self, settings: LinkSettings, arrangements: list[list[StoredEdge]]) -> bool:
        """Return whether one of these arrangements of edges is a CADU, and take its packets."""
        length = settings.cadu_length
        code = settings.code
        for first in range(0, len(arrangements), 256):
            some = arrangements[first : first + 256]
            stream = as_octets(b"".join(one.edge.octets for arrangement in some for one in arrangement))
            offsets = np.arange(len(some), dtype=np.int64) * length
            if code is not None and len(some) > 1:
                blocks = randomise(stream.reshape(-1, length)[:, ASM_LENGTH:], settings.randomiser)
                clean = np.flatnonzero(reed_solomon.clean(blocks, code).all(axis=1))
                if not clean.size and first == 0:
                    clean = np.arange(min(len(some), REPAIRS_LIMIT))
                offsets = offsets[clean]
            block = read_frames(stream, offsets, settings)
            for offset in self._take_frames(block):
                if is_checked(settings):
                    wrong = _repaired(stream, offset, block)
                    for edge in some[offset // length]:
                        if not _is_foreign(wrong[: len(edge.edge.octets)]):
                            self._use([edge])
                        wrong = wrong[len(edge.edge.octets) :]
                    return True
        return False

    def _take_frames(self, block: FrameBlock) -> list[int]:
        """Take the packets of good frames separately; return the offsets of those frames."""
        used = []
        for index in np.flatnonzero(block.good).tolist():
            spacecraft = int(block.header.spacecraft_id[index])
            if self.piece.spacecraft_id is not None and spacecraft != self.piece.spacecraft_id:
                continue
            known = spacecraft in self.vehicles or spacecraft in self._found.packets
            if not is_checked(block.settings) and not (known and block.frames[index, 4] >> 3 == 0b00011):
                continue
            reader = ChannelReader(DICTIONARY, self.unchecked_apids)
            buffer, cut = reader.cut(block.only(index), spacecraft)
            reader.close()
            self._found.packets.setdefault(spacecraft, []).extend(cut.packets(buffer))
            self._found.channel_edges += reader.edges
            self.joined.frames += 1
            used.append(int(block.offsets[index]))
        return used

    # packets of channels

    def _join_channels(self) -> None:
        by_domain: dict[str, list[bytes]] = {}
        for domain, identity in self._channels:
            by_domain.setdefault(domain, []).append(identity)
        self._channels.clear()
        if not by_domain:
            return
        with self.ground.database.reading() as connection:
            for domain, identities in by_domain.items():
                for edge in self._open(connection, domain, identities):
                    self._join_channel(connection, domain, edge)

    def _join_channel(self, connection: Connection, domain: str, edge: StoredEdge) -> None:
        """Join the packet that an edge of a channel belongs to."""
        for path in self._channel_paths(connection, domain, edge):
            octets = b"".join(one.edge.octets for one in path)
            spacecraft = self._spacecraft_of(domain)
            if _is_packet(octets, self.unchecked_apids(spacecraft)):
                self._found.packets.setdefault(spacecraft, []).append(octets)
            elif not _is_even_idle(octets):
                continue
            self._use(path)
            return

    def _spacecraft_of(self, domain: str) -> int:
        vehicle = int(domain.split()[1])
        return next(spacecraft for spacecraft, one in self.vehicles.items() if one == vehicle)

    def _channel_paths(
        self, connection: Connection, domain: str, edge: StoredEdge
    ) -> Iterator[list[StoredEdge]]:
        """Yield sequences of edges, from an opener to a closer, that an edge may belong to."""
        budget = PATHS_LIMIT
        heads = self._backwards(connection, domain, [edge]) if edge.edge.role != OPENER else [[edge]]
        for head in heads:
            if head[-1].edge.role == CLOSER:
                yield head
                continue
            for path in self._forwards(connection, domain, head):
                yield path
                budget -= 1
                if budget <= 0:
                    return

    def _backwards(
        self, connection: Connection, domain: str, path: list[StoredEdge]
    ) -> Iterator[list[StoredEdge]]:
        count = path[0].edge.count
        held = sum(len(one.edge.octets) for one in path)
        direct = path[0].edge.role == CLOSER and len(path) == 1
        fit = (held, UNKNOWN) if direct else None
        for opener in self._candidates(
            connection, domain, OPENER, fit=fit, count=(count,), limit=PATHS_LIMIT
        ):
            yield [opener, *path]
        if held < PACKET_MAX_LENGTH:
            for middle in self._candidates(connection, domain, MIDDLE, next_count=count, limit=8):
                if all(one.id != middle.id for one in path):
                    yield from self._backwards(connection, domain, [middle, *path])

    def _forwards(
        self, connection: Connection, domain: str, path: list[StoredEdge]
    ) -> Iterator[list[StoredEdge]]:
        octets = b"".join(one.edge.octets for one in path)
        count = path[-1].edge.next_count
        missing = packet_octets_missing(octets)
        fit = None if missing == UNKNOWN else (missing,)
        for closer in self._candidates(
            connection, domain, CLOSER, fit=fit, count=(count,), limit=PATHS_LIMIT
        ):
            yield [*path, closer]
        if len(octets) < PACKET_MAX_LENGTH and missing != 0:
            for middle in self._candidates(connection, domain, MIDDLE, count=(count,), limit=8):
                if all(one.id != middle.id for one in path):
                    yield from self._forwards(connection, domain, [*path, middle])

    # bare packets

    def _join_packets_by_place(self, connection: Connection, domain: str) -> None:
        """Cut packets from the last known packet start before the piece, as far as octets are available."""
        before = store.octets_before(connection, self.piece, PACKET_MAX_LENGTH)
        behind = store.octets_behind(connection, self.piece, PACKET_MAX_LENGTH)
        sha256, octets = self.piece.file_sha256, self.piece.octets
        reach = min(octets, PACKET_MAX_LENGTH)
        contexts = [[*before, Part(sha256, 0, octets), *behind]]
        if octets > 2 * reach:
            contexts = [
                [*before, Part(sha256, 0, reach)],
                [Part(sha256, octets - reach, octets), *behind],
            ]
        for parts in contexts:
            if len(parts) == 1:
                continue
            stream = b"".join(self._octets(part) for part in parts)
            begins = _known_beginnings(connection, domain, parts)
            if not parts[0].start and parts[0].file_sha256 != sha256 and not begins:
                begins = [0]
            for begin in begins:
                self._walk_packets(connection, domain, parts, stream, begin)

    def _walk_packets(
        self,
        connection: Connection,
        domain: str,
        parts: Sequence[Part],
        stream: bytes,
        begin: int,
    ) -> None:
        assert self.piece.spacecraft_id is not None
        end = begin
        packets = []
        unchecked = self.unchecked_apids(self.piece.spacecraft_id)
        while (length := _packet_length(stream, end)) and _is_packet_or_idle(
            stream[end : end + length], unchecked
        ):
            packets.append(stream[end : end + length])
            end += length
        if end == begin:
            return
        self._found.packets.setdefault(self.piece.spacecraft_id, []).extend(packets)
        self._found.parts += [(domain, part) for part in _within(parts, begin, end)]
        rest = list(_within(parts, end, len(stream)))
        if rest and not store.open_starts(connection, domain, rest[0]):
            octets = self._octets(rest[0])
            if len(octets) <= PACKET_MAX_LENGTH and not _packet_length(octets, 0):
                opener = Edge(OPENER, UNKNOWN, UNKNOWN, octets, rest[0].start)
                self._found.openers.append((domain, rest[0].file_sha256, opener))

    def _join_packet_by_content(self, connection: Connection, domain: str, edge: StoredEdge) -> None:
        assert self.piece.spacecraft_id is not None
        middles = []
        if not self.piece.stream:
            middles = self._candidates(connection, domain, MIDDLE, limit=MIDDLES_LIMIT)
        if edge.edge.role == OPENER:
            openers = [edge]
        elif edge.edge.role == CLOSER and not middles:
            openers = self._candidates(connection, domain, OPENER, fit=(edge.edge.fit, UNKNOWN))
        else:
            openers = self._candidates(connection, domain, OPENER, limit=MIDDLES_LIMIT)
        ends: dict[int, list[StoredEdge]] = {}
        for opener in openers:
            path = self._packet_path(connection, domain, opener, middles, edge, ends)
            if path is not None:
                break
        else:
            return
        chosen, octets = path
        packets = self._found.packets.setdefault(self.piece.spacecraft_id, [])
        packets.append(octets)
        self._use(chosen)
        last = chosen[-1]
        left = sum(len(one.edge.octets) for one in chosen) - len(octets)
        if left and last.file_sha256 is not None:
            rest = last.edge.octets[-left:]
            end = packets_end(rest, 0, len(rest))
            if _is_packet(rest[:end], self.unchecked_apids(self.piece.spacecraft_id)):
                packets.append(rest[:end])
            start = (last.edge.start or 0) + len(last.edge.octets) - left + end
            opener_edge = Edge(OPENER, UNKNOWN, UNKNOWN, rest[end:], start)
            self._found.openers.append((domain, last.file_sha256, opener_edge))

    def _packet_path(
        self,
        connection: Connection,
        domain: str,
        opener: StoredEdge,
        middles: Sequence[StoredEdge],
        edge: StoredEdge,
        ends: dict[int, list[StoredEdge]],
    ) -> tuple[list[StoredEdge], bytes] | None:
        """Return the edges and octets of a packet that begins with `opener` and contains `edge`; None if there is none.

        `ends` caches the closers by length.
        """

        def closers(missing: int) -> list[StoredEdge]:
            if edge.edge.role == CLOSER:
                return [edge] if missing in (UNKNOWN, edge.edge.fit) else []
            if missing not in ends:
                fit = None if missing == UNKNOWN else (missing,)
                ends[missing] = self._candidates(connection, domain, CLOSER, fit=fit)
            return ends[missing]

        unchecked = (
            all_checked(0)
            if self.piece.spacecraft_id is None
            else self.unchecked_apids(self.piece.spacecraft_id)
        )
        if edge.edge.role != MIDDLE:
            for closer in closers(opener.edge.fit):
                octets = opener.edge.octets + closer.edge.octets
                if _is_packet(octets, unchecked):
                    return [opener, closer], octets
        for chosen in islice(_orders(middles, edge), ARRANGEMENTS_LIMIT):
            octets = opener.edge.octets + b"".join(one.edge.octets for one in chosen)
            held = len(octets) - len(chosen[-1].edge.octets)
            missing = packet_octets_missing(octets)
            if missing == UNKNOWN:
                continue
            if missing == 0:
                whole = octets[: int.from_bytes(octets[4:6], "big") + PRIMARY_HEADER_LENGTH + 1]
                enough = edge.edge.role != CLOSER and len(whole) > held
                if enough and _is_packet(whole, unchecked) and _goes_on(whole, octets[len(whole) :]):
                    return [opener, *chosen], whole
            else:
                for closer in closers(missing):
                    whole = octets + closer.edge.octets
                    if _is_packet(whole, unchecked):
                        return [opener, *chosen, closer], whole
        return None

    def _octets(self, part: Part) -> bytes:
        return self.ground.files.read(part.file_sha256, part.start, part.stop)


def raw_domain(piece: Piece, link: Link) -> str:
    """Return the name of the domain in which the raw octets of a piece with this link can be joined.

    CADUs contain the spacecraft id, bare packets do not.
    """
    if link == BARE:
        return f"packets {piece.spacecraft_id} {piece.scope}"
    return f"cadus {store.link_digest(link)} {piece.scope}"


def _known_beginnings(connection: Connection, domain: str, parts: Sequence[Part]) -> list[int]:
    """Return the known starts of incomplete packets in a chain of parts, which are waiting openers."""
    places = []
    position = 0
    for part in parts:
        for start in store.open_starts(connection, domain, part):
            places.append(position + start - part.start)
        position += part.stop - part.start
    return places


def _repaired(stream: OctetArray, offset: int, block: FrameBlock) -> NDArray[np.bool_]:
    """Return which octets of the marker and of the frame of the CADU at an offset the code has corrected."""
    frame = block.frames[int(np.flatnonzero(block.offsets == offset)[0])]
    first = offset + ASM_LENGTH
    # The code is systematic: the frame comes first. The whole block is derandomised, as the sequence begins with it.
    received = randomise(stream[None, first : offset + block.settings.cadu_length], block.settings.randomiser)
    return np.concatenate((np.zeros(ASM_LENGTH, dtype=np.bool_), received[0, : frame.size] != frame))


def _is_foreign(wrong: NDArray[np.bool_]) -> bool:
    """Return whether octets were not part of a CADU but repaired into it, which the code can do with a short edge."""
    return bool(np.count_nonzero(wrong) > FOREIGN_SHARE * wrong.size)


def _counts_fit(one: int, other: int) -> bool:
    return one == other or UNKNOWN in (one, other)


def _subsets(
    must: tuple[StoredEdge, ...], others: Sequence[StoredEdge], totals: Collection[int]
) -> Iterator[tuple[StoredEdge, ...]]:
    """Yield sets of edges, including `must`, whose total octets are one of `totals`, those with fewer edges first.

    Bit n of `reach[k][i]` is set if k of `others[i:]` have n octets in total, which excludes impossible sets early.
    """
    held = sum(len(one.edge.octets) for one in must)
    wanted = sum(1 << total - held for total in totals if total >= held)
    within = (1 << wanted.bit_length()) - 1
    sizes = [len(one.edge.octets) for one in others]
    reach = [[1] * (len(sizes) + 1)]

    def chosen(number: int, first: int, left: int) -> Iterator[tuple[StoredEdge, ...]]:
        if number == 0:
            yield ()
            return
        for index in range(first, len(sizes)):
            if not reach[number][index] & left:
                return
            rest = left >> sizes[index]
            if reach[number - 1][index + 1] & rest:
                for more in chosen(number - 1, index + 1, rest):
                    yield (others[index], *more)

    for number in range(MIDDLES_IN_A_CADU + 1 - len(must)):
        if number:
            sums = [0] * (len(sizes) + 1)
            for index in reversed(range(len(sizes))):
                sums[index] = sums[index + 1] | (reach[-1][index + 1] << sizes[index] & within)
            reach.append(sums)
        if reach[number][0] & wanted and number + len(must):
            for more in chosen(number, 0, wanted):
                yield (*must, *more)


def _slots_across(stream: OctetArray, start: int, stop: int, settings: LinkSettings) -> NDArray[np.int64]:
    """Return the positions of CADUs that lie partly in [start, stop) of a stream and partly outside."""
    length = settings.cadu_length
    last = stream.size - length
    if last < 0:
        return np.empty(0, dtype=np.int64)
    places = np.arange(max(start - length + 1, 0), min(stop, last + 1), dtype=np.int64)
    places = places[(places < start) | (places + length > stop)]
    if not places.size:
        return places
    places = places[marker_errors(stream, places) <= DEFAULT_TOLERANCE]
    followed = places + length + ASM_LENGTH <= stream.size
    right = ~followed
    right[followed] = marker_errors(stream, places[followed] + length) <= DEFAULT_TOLERANCE
    return places[right]


def _within(parts: Sequence[Part], start: int, stop: int) -> Iterator[Part]:
    """Yield the portions of a chain of parts within [start, stop) of it."""
    position = 0
    for part in parts:
        size = part.stop - part.start
        low, high = max(start - position, 0), min(stop - position, size)
        if low < high:
            yield Part(part.file_sha256, part.start + low, part.start + high)
        position += size


def _orders(middles: Sequence[StoredEdge], edge: StoredEdge) -> Iterator[tuple[StoredEdge, ...]]:
    """Yield sequences of up to two middles, including `edge` if it is one."""
    others = [one for one in middles if one.id != edge.id]
    if edge.edge.role != MIDDLE:
        yield from ((one,) for one in middles)
        yield from permutations(middles, 2)
        return
    yield (edge,)
    for one in others:
        yield (one, edge)
        yield (edge, one)


def _goes_on(packet: bytes, rest: bytes) -> bool:
    """Return whether a packet seems to follow: with many arrangements, one valid checksum is not sufficient."""
    if len(rest) < PRIMARY_HEADER_LENGTH:
        return rest[:1] in (b"", packet[:1])
    return rest[0] & 0xF8 == packet[0] & 0xF8 and rest[2] >> 6 == packet[2] >> 6


def _packet_length(octets: bytes, start: int) -> int:
    """Return the length of the packet at `start` in octets, 0 if it is incomplete or invalid."""
    if len(octets) - start <= PRIMARY_HEADER_LENGTH or octets[start] >> 4:
        return 0
    length = int.from_bytes(octets[start + 4 : start + 6], "big") + PRIMARY_HEADER_LENGTH + 1
    return length if start + length <= len(octets) else 0


def _is_packet(octets: bytes, unchecked: frozenset[int]) -> bool:
    """Return whether these octets are one telemetry packet, with a valid checksum unless its APID is `unchecked`."""
    if len(octets) <= PRIMARY_HEADER_LENGTH or _packet_length(octets, 0) != len(octets) or _is_idle(octets):
        return False
    if int.from_bytes(octets[:2], "big") & 0x7FF in unchecked:
        return True
    return len(octets) > PRIMARY_HEADER_LENGTH + 2 and crc16(octets) == 0


def _is_idle(octets: bytes) -> bool:
    return int.from_bytes(octets[:2], "big") & 0x7FF == IDLE_APID


def _is_even_idle(octets: bytes) -> bool:
    """Return whether these octets are one idle packet filled with one octet value."""
    fill = octets[PRIMARY_HEADER_LENGTH:]
    return _packet_length(octets, 0) == len(octets) and _is_idle(octets) and fill == fill[:1] * len(fill)


def _is_packet_or_idle(octets: bytes, unchecked: frozenset[int]) -> bool:
    return _is_packet(octets, unchecked) or _is_even_idle(octets)
