"""Compiled part of packet cutting: walks a buffer of octets, checks checksums, finds its way back after
damage.

While packets follow each other without damage, each costs one checksum over its octets. After damage every
octet is a candidate for a packet's beginning. To test a candidate in constant time, whatever length its
header claims, the checksum register after every octet is kept (`prefix`, started at zero): with S the
register before the packet, E after it, and n its octets, the packet's own checksum is E xor (S xor 0xFFFF)
* x**(8n) modulo the generator polynomial, and must be zero.

A packet without a checksum is accepted by what follows it: the end of the octets, a packet with a right checksum,
or another header of such an APID or of an idle packet. Its content is not checked.
"""

# numba wants numpy integers where annotations say int
# mypy: disable-error-code="return-value,arg-type,assignment,no-any-return"

import functools

import numpy as np

from kernels.compiled import njit
from tmtc.arrays import RecordArray

GOOD, BAD, SKIPPED, IDLE = 0, 1, 2, 3
"""Kinds of rows."""

NO_CHECKSUM, UNKNOWN = 1, 2
"""Marks of APIDs whose packets do not end with a checksum, or of which that is unknown."""

POLYNOMIAL = 0x1021
_PUS_TM_LENGTH = 22
_PUS_TC_LENGTH = 13
_CUC_P_FIELD = 0x2E
_PACKET_MAX = 65_542
_U = np.uint64


@functools.cache
def crc_tables() -> RecordArray:
    """(17, 256) uint16: the register's change by an octet that is followed by 0..16 zero octets."""
    tables = np.zeros((17, 256), dtype=np.uint16)
    for octet in range(256):
        register = octet << 8
        for _ in range(8):
            register = (register << 1 ^ (POLYNOMIAL if register & 0x8000 else 0)) & 0xFFFF
        tables[0, octet] = register
    for row in range(1, 17):
        before = tables[row - 1]
        tables[row] = before << 8 ^ tables[0, before >> 8]
    return tables


@functools.cache
def powers_of_octets() -> RecordArray:
    """(65543,) int32: x**(8n) modulo the generator polynomial."""
    tables = crc_tables()[0].tolist()
    power, powers = 1, []
    for _ in range(_PACKET_MAX + 1):
        powers.append(power)
        power = (power << 8 & 0xFFFF) ^ tables[power >> 8]
    return np.array(powers, dtype=np.int32)


@njit(nogil=True, inline="always")
def _after(crc: int, buffer: RecordArray, i: int, last: int, tables: RecordArray) -> int:
    change = _U(tables[last, buffer[i] ^ (crc >> _U(8))] ^ tables[last - _U(1), buffer[i + _U(1)] ^ (crc & _U(255))])
    for k in range(2, last + _U(1)):
        change ^= tables[last - _U(k), buffer[i + _U(k)]]
    return change


@njit(nogil=True)
def _crc(buffer: RecordArray, start: int, stop: int, tables: RecordArray) -> int:
    """Return the CRC register after at least two octets, 16 per step; unsigned indices avoid wraparound checks."""
    crc, i, end = _U(0xFFFF), _U(start), _U(stop)
    while i + _U(17) < end:
        crc = _after(crc, buffer, i, _U(15), tables)
        i += _U(16)
    return _after(crc, buffer, i, end - i - _U(1), tables)


@njit(nogil=True, ahead="u1[:, ::1].copy(readonly=True), u2[:, ::1], b1[::1]")
def checksums_hold(rows: RecordArray, tables: RecordArray, holds: RecordArray) -> None:
    """Write whether the last two octets of each row (n, length) are the checksum of those before."""
    for n in range(rows.shape[0]):
        holds[n] = _crc(rows[n], 0, rows.shape[1], tables) == 0


@njit(nogil=True, ahead="u1[::1].copy(readonly=True), i8[::1], i8[::1], u1[::1]")
def copy_spans(buffer: RecordArray, starts: RecordArray, sizes: RecordArray, out: RecordArray) -> None:
    """Copy the `sizes` (n,) octets from each of `starts` (n,) into `out`, one span after another."""
    end = _U(0)
    for n in range(starts.size):
        start = _U(starts[n])
        for i in range(_U(sizes[n])):
            out[end + i] = buffer[start + i]
        end += _U(sizes[n])


@njit(nogil=True)
def length_at(buffer: RecordArray, p: int, stop: int, packet_type: int) -> int:
    """Octets of the packet whose header stands at `p`, or 0 where no such header can stand."""
    if stop - p < 7 or (buffer[p] >> 4) != packet_type:
        return 0
    length = (np.int64(buffer[p + 4]) << 8 | np.int64(buffer[p + 5])) + 7
    if length > stop - p or (length < 9 and not is_idle(buffer, p)):
        return 0
    return length


@njit(nogil=True)
def is_idle(buffer: RecordArray, p: int) -> bool:
    return (buffer[p] & 0x0F) == 0x07 and buffer[p + 1] == 0xFF


@njit(nogil=True)
def is_pus(buffer: RecordArray, p: int, length: int, packet_type: int) -> bool:
    """Return whether a PUS-C secondary header stands where it should."""
    if not buffer[p] & 0x08:
        return False
    if packet_type == 0:
        return length >= _PUS_TM_LENGTH and buffer[p + 6] >> 4 == 2 and buffer[p + 13] == _CUC_P_FIELD
    return length >= _PUS_TC_LENGTH and buffer[p + 6] >> 4 == 2


@njit(nogil=True)
def _multiply(a: int, b: int) -> int:
    product = 0
    for bit in range(15, -1, -1):
        product = (product << 1) ^ (0x11021 if product & 0x8000 else 0)
        if b >> bit & 1:
            product ^= a
    return product


@njit(nogil=True)
def _prefix_holds(
    buffer: RecordArray,
    p: int,
    length: int,
    prefix: RecordArray,
    known: RecordArray,
    tables: RecordArray,
    powers: RecordArray,
) -> bool:
    """Return whether the packet at `p` ends with its checksum; `prefix` is filled over [known[0], known[1]]."""
    e = p + length
    if p < known[0] or p > known[1]:
        # what was filled does not reach here: start afresh
        known[0] = p
        known[1] = p
        prefix[p] = 0
    i = known[1]
    register = np.int64(prefix[i])
    while i < e:
        register = ((register << 8) & 0xFFFF) ^ tables[0, (register >> 8) ^ buffer[i]]
        i += 1
        prefix[i] = register
    known[1] = i
    return prefix[e] == _multiply(np.int64(prefix[p]) ^ 0xFFFF, np.int64(powers[length]))


@njit(nogil=True)
def _stands(
    buffer: RecordArray, p: int, stop: int, packet_type: int,
    prefix: RecordArray, known: RecordArray, tables: RecordArray, powers: RecordArray,
) -> bool:  # fmt: skip
    """Return whether a whole packet with a right checksum, or the header of an idle packet, stands at `p`."""
    length = length_at(buffer, p, stop, packet_type)
    if length == 0:
        return False
    return is_idle(buffer, p) or _prefix_holds(buffer, p, length, prefix, known, tables, powers)


@njit(nogil=True, ahead="u1[::1].copy(readonly=True), i8, i8, i8, u2[::1], i8[::1], u2[:, ::1], i4[::1]")
def chain_start(
    buffer: RecordArray, first: int, end: int, packet_type: int,
    prefix: RecordArray, known: RecordArray, tables: RecordArray, powers: RecordArray,
) -> int:  # fmt: skip
    """Least position in [first, end) from which right packets lead exactly to `end`, or -1."""
    leads = np.zeros(end - first + 1, dtype=np.uint8)
    leads[end - first] = 1
    # fill forwards, once, what the candidates below ask for
    _prefix_holds(buffer, first, end - first, prefix, known, tables, powers)
    found = -1
    for q in range(end - 9, first - 1, -1):
        length = length_at(buffer, q, end, packet_type)
        if length == 0 or is_idle(buffer, q) or not leads[q + length - first]:
            continue
        if _prefix_holds(buffer, q, length, prefix, known, tables, powers):
            leads[q - first] = 1
            found = q
    return found


@njit(nogil=True)
def _search_checked(
    buffer: RecordArray, first: int, limit: int, stop: int, packet_type: int,
    prefix: RecordArray, known: RecordArray, tables: RecordArray, powers: RecordArray,
) -> int:  # fmt: skip
    """First position in [first, limit) at which a packet is believed to begin, or `limit`.

    One right checksum is not enough among so many candidates: it also takes a PUS-C header, or the buffer's
    end or another right packet just after.
    """
    for q in range(first, limit):
        length = length_at(buffer, q, stop, packet_type)
        if length == 0 or is_idle(buffer, q):
            continue
        if _prefix_holds(buffer, q, length, prefix, known, tables, powers):
            e = q + length
            if (
                is_pus(buffer, q, length, packet_type)
                or e == stop
                or _stands(buffer, e, stop, packet_type, prefix, known, tables, powers)
            ):
                return q
    return limit


CHAIN = 32
_AHEAD = 256


@njit(nogil=True)
def header_at(buffer: RecordArray, p: int, stop: int, packet_type: int) -> int:
    """Octets that the header at `p` claims, whether or not they are there; 0 where no header can stand."""
    if stop - p < 7 or (buffer[p] >> 4) != packet_type:
        return 0
    length = (np.int64(buffer[p + 4]) << 8 | np.int64(buffer[p + 5])) + 7
    return length


@njit(nogil=True)
def walk_unchecked(
    buffer: RecordArray,
    p: int,
    stop: int,
    packet_type: int,
    prefix: int,
    last: RecordArray,
    unchecked: RecordArray,
    tables: RecordArray,
    rows: RecordArray,
    count: int,
) -> tuple[int, int]:
    """Like `walk` for packets that are found by their headers: goes on as long as these follow each other.

    Packets of an APID in `unchecked` (2048,) do not end with a checksum; those of others are rows of their own kind if
    it is wrong, as idle packets are. `last` (2048,) keeps the sequence count of each APID.
    """
    while p < stop and count < rows.shape[0]:
        length = header_at(buffer, p, stop, packet_type)
        if length == 0 or length > stop - p:
            break
        kind = IDLE
        if not is_idle(buffer, p):
            apid = (np.int64(buffer[p]) & 0x07) << 8 | np.int64(buffer[p + 1])
            last[apid] = (np.int64(buffer[p + 2]) & 0x3F) << 8 | np.int64(buffer[p + 3])
            kind = GOOD if unchecked[apid] or _crc(buffer, p, p + length, tables) == 0 else BAD
        rows[count, 0] = kind
        rows[count, 1] = p
        rows[count, 2] = p + length
        p += length + prefix
        count += 1
    return p, count


@njit(nogil=True)
def proves(
    buffer: RecordArray, q: int, stop: int, packet_type: int, prefix: int, last: RecordArray,
    is_begin: bool, first: bool = False,
) -> bool:  # fmt: skip
    """Return whether packets without error control begin at `q`.

    Headers must follow each other until one continues the sequence counts of its APID: those before the damage, or
    those of another packet of this chain. At the beginning of a segment it is also enough that they lead to its end, or
    that three follow each other. `first`: the count of the first packet of the chain must continue or be continued.
    """
    apids = np.empty(CHAIN, dtype=np.int64)
    counts = np.empty(CHAIN, dtype=np.int64)
    p = q
    for k in range(CHAIN):
        if p >= stop:
            return is_begin and k > 0
        length = header_at(buffer, p, stop, packet_type)
        if length == 0 or length > stop - p:
            return is_begin and k >= 3
        apids[k] = (np.int64(buffer[p]) & 0x07) << 8 | np.int64(buffer[p + 1])
        counts[k] = (np.int64(buffer[p + 2]) & 0x3F) << 8 | np.int64(buffer[p + 3])
        if apids[k] != 0x7FF:
            before = last[apids[k]]
            if before >= 0 and 1 <= (counts[k] - before) % 16384 <= _AHEAD and (k == 0 or not first):
                return True
            for j in range(min(k, 1) if first else k):
                if apids[j] == apids[k] and (counts[k] - counts[j]) % 16384 == 1:
                    return True
        p += length + prefix
    return is_begin


@njit(nogil=True)
def search_unchecked(
    buffer: RecordArray, first: int, stop: int, packet_type: int, prefix: int, last: RecordArray,
    unchecked: RecordArray, tables: RecordArray,
) -> int:  # fmt: skip
    """First position in [first, stop) at which packets begin that are found by their headers, or `stop`."""
    for q in range(first, stop):
        if (buffer[q] >> 4) == packet_type and proves(buffer, q, stop, packet_type, prefix, last, False):
            end = q + header_at(buffer, q, stop, packet_type)
            if is_idle(buffer, q) or (not _is_unchecked(buffer, q, unchecked) and _crc(buffer, q, end, tables) == 0):
                return q
            if not _is_unchecked(buffer, q, unchecked):
                continue
            if proves(buffer, q, stop, packet_type, prefix, last, False, True):
                return q
            for r in range(q + 1, end):  # any header can lead to a packet by chance: one in it may be surer
                if proves(buffer, r, stop, packet_type, prefix, last, False, True):
                    return r
            return q
    return stop


@njit(nogil=True)
def _is_unchecked(buffer: RecordArray, p: int, unchecked: RecordArray) -> bool:
    return unchecked[(np.int64(buffer[p]) & 0x07) << 8 | np.int64(buffer[p + 1])] == NO_CHECKSUM


@njit(nogil=True)
def _is_unknown(buffer: RecordArray, p: int, unchecked: RecordArray) -> bool:
    return unchecked[(np.int64(buffer[p]) & 0x07) << 8 | np.int64(buffer[p + 1])] == UNKNOWN


@njit(nogil=True)
def unchecked_length(buffer: RecordArray, p: int, stop: int, packet_type: int, unchecked: RecordArray) -> int:
    """Octets of the packet without a checksum whose header stands at `p`; 0 if there is none or it does not end."""
    length = header_at(buffer, p, stop, packet_type)
    if length == 0 or length > stop - p or is_idle(buffer, p) or not _is_unchecked(buffer, p, unchecked):
        return 0
    return length


@njit(nogil=True)
def follows(
    buffer: RecordArray,
    e: int,
    stop: int,
    packet_type: int,
    unchecked: RecordArray,
    tables: RecordArray,
    open_end: bool,
) -> bool:
    """Return whether a packet can end at `e`; `open_end`: more octets will follow `stop`.

    Packets of which it is unknown whether they have a checksum must lead to one that can be judged.
    """
    for _ in range(CHAIN):
        if e == stop:
            return not open_end
        if stop - e < 7:
            return not open_end and (buffer[e] >> 4) == packet_type
        claimed = header_at(buffer, e, stop, packet_type)
        if claimed == 0:
            return False
        if is_idle(buffer, e) or _is_unchecked(buffer, e, unchecked):
            return True
        if claimed > stop - e:
            return not open_end
        if claimed > 8 and _crc(buffer, e, e + claimed, tables) == 0:
            return True
        if not _is_unknown(buffer, e, unchecked):
            return False
        e += claimed
    return False


@njit(nogil=True, ahead="u1[::1].copy(readonly=True), i8, i8, i8, u2[:, ::1], i8[:, ::1], i8, u1[::1], b1")
def walk(
    buffer: RecordArray, p: int, stop: int, packet_type: int, tables: RecordArray, rows: RecordArray, count: int,
    unchecked: RecordArray, open_end: bool,
) -> tuple[int, int]:  # fmt: skip
    """(position, number of rows) after the undamaged packets from `p` on have been written as rows kind,
    start, stop.

    Stops at the end, at the first position where no right packet stands (an idle one included), or with
    full rows. `unchecked` (2048,): `NO_CHECKSUM` for APIDs whose packets do not end with one: what follows decides, as
    it does for a packet without a right checksum of an `UNKNOWN` APID.
    """
    while p < stop and count < rows.shape[0]:
        length = unchecked_length(buffer, p, stop, packet_type, unchecked)
        if length:
            if not follows(buffer, p + length, stop, packet_type, unchecked, tables, open_end):
                break
        else:
            length = length_at(buffer, p, stop, packet_type)
            if length == 0 or is_idle(buffer, p):
                break
            if _crc(buffer, p, p + length, tables) != 0:
                leads = _is_unknown(buffer, p, unchecked)
                if not leads or not follows(buffer, p + length, stop, packet_type, unchecked, tables, open_end):
                    break
        rows[count, 0] = GOOD
        rows[count, 1] = p
        p += length
        rows[count, 2] = p
        count += 1
    return p, count


@njit(nogil=True)
def search(
    buffer: RecordArray, first: int, limit: int, stop: int, packet_type: int,
    prefix: RecordArray, known: RecordArray, tables: RecordArray, powers: RecordArray, unchecked: RecordArray,
) -> int:  # fmt: skip
    """First position in [first, limit) at which a packet is believed to begin, or `limit`.

    Two packets without a checksum must follow each other before a place is believed.
    """
    checked = _search_checked(buffer, first, limit, stop, packet_type, prefix, known, tables, powers)
    for q in range(first, checked):
        length = unchecked_length(buffer, q, stop, packet_type, unchecked)
        if length == 0:
            continue
        e = q + length
        if e == stop:
            return q
        second = unchecked_length(buffer, e, stop, packet_type, unchecked)
        if second == 0:
            if follows(buffer, e, stop, packet_type, unchecked, tables, False):
                return q
        elif follows(buffer, e + second, stop, packet_type, unchecked, tables, False):
            return q
    return checked
