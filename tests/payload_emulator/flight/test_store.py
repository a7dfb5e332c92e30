"""The packet store: order, priorities, overflow, playback, recovery from memory that was hit."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from payload_emulator.flight.telemetry.store import SHARES, PacketStore, StoreClass
from tmtc.dictionary.payload import DICTIONARY

HEADER = 13


def packet(count, seconds=0.0, octets=0):
    """A large-data packet of 29 octets and more."""
    values = {"transaction": 1, "part": 1, "table": 6, "items": {"octet": [7] * octets}}
    ticks = round(seconds * 65_536)
    return DICTIONARY.pack("large_data_middle", values, ticks=ticks, sequence_count=count)


def store(octets=4000, **options):
    return PacketStore(np.zeros(octets, np.uint8), **options)


def test_what_goes_in_comes_out_once_in_the_order_it_was_made():
    kept = store()
    packets = [packet(k) for k in range(8)]
    for k, octets in enumerate(packets):
        assert kept.append(octets, StoreClass(k % 5))
    assert kept.waiting == 8
    assert kept.take(1 << 20) == packets
    assert kept.waiting == 0 and kept.take(1 << 20) == []


def test_a_small_link_takes_the_important_first_and_nothing_overtakes_in_its_class():
    kept = store()
    bulk, event, long_one = packet(0), packet(1), packet(2, octets=60)
    kept.append(bulk, StoreClass.bulk)
    kept.append(long_one, StoreClass.housekeeping)
    kept.append(packet(3), StoreClass.housekeeping)
    kept.append(event, StoreClass.critical)
    assert kept.take(len(event) + 20) == [event]
    assert kept.take(len(event) + 20) == []
    assert kept.take(len(long_one)) == [long_one]
    assert kept.take(1 << 20) == [bulk, packet(3)]
    assert store().take(0) == []


def test_only_the_classes_asked_for_are_sent():
    kept = store()
    kept.append(packet(0), StoreClass.detections)
    kept.append(packet(1), StoreClass.critical)
    assert kept.take(1 << 20, (StoreClass.critical,)) == [packet(1)]
    assert kept.waiting == 1


def test_a_full_class_overwrites_its_oldest_alone_and_begins_again_at_the_last_octet():
    kept = store()
    kept.append(packet(0), StoreClass.critical)
    room = int(SHARES[StoreClass.bulk] * 4000) // (HEADER + len(packet(0)))
    for k in range(room + 3):
        assert kept.append(packet(k), StoreClass.bulk)
    assert kept.overwritten == 3
    assert kept.take(1 << 20) == [packet(0), *(packet(k) for k in range(3, room + 3))]
    # Four packets of 29 octets and their headers fill the class of the most important packets exactly.
    kept = store(round(4 * (29 + HEADER) / SHARES[0]))
    packets = [packet(k) for k in range(9)]
    assert all(kept.append(octets, StoreClass.critical) for octets in packets)
    assert kept.take(1 << 20) == packets[-4:]
    assert kept.overwritten == 5


def test_a_full_class_refuses_the_new_where_nothing_may_be_overwritten():
    kept = store(overwrite=False)
    room = int(SHARES[StoreClass.bulk] * 4000) // (HEADER + len(packet(0)))
    assert [kept.append(packet(k), StoreClass.bulk) for k in range(room + 2)] == [True] * room + [False] * 2
    assert (kept.refused, kept.overwritten) == (2, 0)
    # What was sent may go.
    assert len(kept.take(1 << 20)) == room
    assert kept.append(packet(99), StoreClass.bulk)
    assert not kept.append(packet(0, octets=5000), StoreClass.bulk)


def test_playback_sends_again_what_was_made_between_two_times_once():
    kept = store()
    packets = [packet(k, seconds=10.0 * k) for k in range(6)]
    for octets in packets:
        kept.append(octets, StoreClass.housekeeping)
    kept.take(1 << 20)
    assert kept.replay(10 * 65_536, 30 * 65_536) == 2
    assert kept.replay(10 * 65_536, 30 * 65_536) == 0
    kept.append(packet(9), StoreClass.housekeeping)
    assert kept.waiting == 3
    # New ones first, the old ones again after them.
    assert kept.take(1 << 20) == [packet(9), packets[1], packets[2]]
    assert kept.delete(20 * 65_536) == 3
    assert kept.replay(0, 1 << 47) == 4


def test_a_reset_loses_nothing_and_sends_nothing_twice():
    kept = store()
    for k in range(10):
        kept.append(packet(k), StoreClass.navigation)
    sent = kept.take(3 * len(packet(0)))
    after = PacketStore(kept.memory)
    assert after.recover() == 10
    assert sent + after.take(1 << 20) == [packet(k) for k in range(10)]
    after.append(packet(10), StoreClass.navigation)
    assert next(after.newest()) == packet(10)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 40), min_size=1, max_size=80), st.integers(0, 2**32 - 1))
def test_recovery_believes_no_damaged_packet(lengths, seed):
    kept = store(3000)
    made = [packet(k, octets=octets) for k, octets in enumerate(lengths)]
    for octets in made:
        kept.append(octets, StoreClass.navigation)
    clean = PacketStore(kept.memory.copy())
    clean.recover()
    whole = set(clean.newest())
    assert whole <= set(made)
    rng = np.random.default_rng(seed)
    used = np.flatnonzero(kept.memory)
    hit = rng.choice(used, min(3, used.size), replace=False)
    kept.memory[hit] ^= 1 << rng.integers(0, 8, hit.size).astype(np.uint8)
    after = PacketStore(kept.memory)
    after.recover()
    found = list(after.newest())
    assert set(found) <= whole
    # One flipped bit costs one packet at most.
    assert len(found) >= len(whole) - hit.size


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 200), st.booleans()), max_size=120))
def test_every_packet_is_sent_or_waiting_or_counted_as_lost(steps):
    kept, made, sent = store(6000), 0, []
    for kind, octets, take in steps:
        made += 1
        kept.append(packet(made, octets=octets), StoreClass(kind))
        if take:
            sent += kept.take(400)
    assert len(set(sent)) == len(sent)
    assert made == len(sent) + kept.waiting + kept.overwritten + kept.refused
    levels = kept.levels()
    assert sum(waiting for waiting, _ in levels) == kept.waiting
    assert all(0 <= permille <= 1000 for _, permille in levels)


def test_scrubbing_finds_and_counts_what_was_hit():
    kept = store()
    for k in range(5):
        kept.append(packet(k), StoreClass.critical)
    kept.memory[HEADER + 3] ^= 0x10
    assert kept.scrub(100) == 1
    assert kept.scrub(100) == 0
    assert kept.damaged == 1
    assert kept.take(1 << 20) == [packet(k) for k in range(1, 5)]
    report = kept.report()[StoreClass.critical]
    assert (report.packets, report.unsent, report.octets) == (4, 0, 4 * (HEADER + len(packet(0))))
