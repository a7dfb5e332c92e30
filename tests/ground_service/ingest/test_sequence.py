"""Counts of packets: wraps, gaps, restarts, late and stray packets; decoded columns as the store takes them."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pytest import mark

from ground_service.ingest.core import UNKNOWN, Fragment, fits, join
from ground_service.ingest.service import ingest_file
from ground_service.ingest.store import recordings_of_vehicle
from ground_service.passes.downlink_accounting import account_sequence
from ground_service.store import repository
from ground_service.telemetry.packets import batch_of_cut
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.pus import NO_TICKS, TICKS_PER_SECOND
from tmtc.packets.space_packets import SEQUENCE_COUNT_LIMIT, append_crc, pack_packet
from tmtc.packets.stream import PacketForm, cut_packets

SECOND = TICKS_PER_SECOND


def stream(count, first=0, step_ticks=SECOND // 10):
    numbers = np.arange(first, first + count)
    return numbers * step_ticks, numbers % SEQUENCE_COUNT_LIMIT


def counted(ticks, counts):
    """Return packets lost, restarts and conflicts."""
    account = account_sequence(ticks, counts)
    return account.lost, account.restarts, account.conflicts


def test_no_packets_are_no_packets_and_a_wrap_is_no_gap():
    account = account_sequence(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    assert (account.lost, account.conflicts, account.restarts, account.gaps) == (0, 0, 0, ())
    ticks, counts = stream(40_000, first=16_000)
    account = account_sequence(ticks, counts)
    assert account.lost == 0
    assert account.count[-1] - account.count[0] == 39_999


@given(
    lost=st.sets(st.integers(1, 2998), max_size=60),
    seed=st.integers(0, 2**32 - 1),
    first=st.integers(0, SEQUENCE_COUNT_LIMIT - 1),
)
def test_what_is_missing_is_found_whatever_the_order_of_arrival(lost, seed, first):
    ticks, counts = stream(3000, first)
    keep = np.random.default_rng(seed).permutation(np.setdiff1d(np.arange(3000), np.array(sorted(lost), dtype=int)))
    account = account_sequence(ticks[keep], counts[keep])
    assert account.lost == len(lost)
    assert account.restarts == 0
    missing = {number for gap in account.gaps for number in range(gap.first_count, gap.last_count + 1)}
    assert missing == {first + number for number in lost}


def test_packets_of_one_instant_at_a_wrap_are_in_sequence_and_a_lost_wrap_is_counted_by_the_rate():
    # Yamcs keeps a failing test for this case: same time, wrapped count.
    ticks = np.array([100, 100, 100, 100]) * SECOND
    assert counted(ticks, np.array([16_382, 16_383, 0, 1])) == (0, 0, 0)
    ticks, counts = stream(60_000)
    keep = np.r_[0:5000, 55_000:60_000]
    assert account_sequence(ticks[keep], counts[keep]).lost == 50_000


def test_a_restart_begins_a_new_run_and_one_count_used_twice_is_a_conflict():
    before, counts_before = stream(500)
    after, counts_after = stream(300)
    assert counted(np.r_[before, after + before[-1] + 60 * SECOND], np.r_[counts_before, counts_after]) == (0, 1, 0)
    ticks, counts = stream(10)
    assert counted(np.r_[ticks, ticks[4] + 1], np.r_[counts, counts[4]]) == (0, 0, 1)


@mark.parametrize("years", [-29, 40])
def test_a_packet_from_another_age_does_not_disturb_the_rest(years):
    ticks, counts = stream(1000, first=5000)
    ticks = ticks + 29 * 31_557_600 * SECOND
    stray = ticks[500] + years * 31_557_600 * SECOND
    account = account_sequence(np.r_[ticks, stray], np.r_[counts, 77])
    inside = account.run == account.run[np.searchsorted(np.sort(np.r_[ticks, stray]), ticks[10])]
    assert inside.sum() >= 1000


def test_few_packets_have_no_rate_and_a_silence_hides_no_wraps():
    """Sixty packets, an hour of silence, and the count goes on at the one after the next."""
    ticks, counts = stream(60)
    later = np.array([ticks[-1] + 3600 * SECOND])
    account = account_sequence(np.r_[ticks, later], np.r_[counts, 61])
    assert (account.lost, account.restarts) == (1, 0)
    (gap,) = account.gaps
    assert (gap.run, gap.first_count, gap.last_count) == (0, 60, 60)
    assert (gap.before_ticks, gap.after_ticks) == (int(ticks[-1]), int(later[0]))


@mark.parametrize("silence_s, restarts, lost", [(600, 1, 0), (1000, 0, 8383)])
def test_wraps_are_looked_for_where_half_of_one_could_have_been_made(silence_s, restarts, lost):
    """At ten packets a second 600 s hold 6000 of them and 1000 s hold 10,000; half a wrap is 8192.

    A fall of 8000 is then a restart, or 8384 packets further on, of which the last came.
    """
    ticks, counts = stream(9000)
    after, counts_after = stream(100)
    found = counted(np.r_[ticks, after + ticks[-1] + silence_s * SECOND], np.r_[counts, counts_after + 999])
    assert found[:2] == (lost, restarts)


def test_a_fall_after_a_second_is_a_restart_and_counts_go_on_from_the_first_of_each_run():
    for ticks, restarts in (SECOND, 0), (SECOND + 1, 1):
        assert counted(np.array([0, ticks]), np.array([10, 9]))[1] == restarts
    before, counts_before = stream(5, first=16_382)
    after = before[-1] + 60 * SECOND + np.arange(3) * SECOND
    account = account_sequence(np.r_[before, after], np.r_[counts_before, 0, 1, 2])
    assert account.run.tolist() == [0] * 5 + [1] * 3
    assert account.count.tolist() == [16_382, 16_383, 16_384, 16_385, 16_386, 0, 1, 2]


def test_an_impossible_on_board_time_is_none_and_never_negative_garbage():
    octets = b"".join(
        DICTIONARY.pack("time_report", {"reported_ticks": ticks, "rate_exponent": 0}, ticks=9, sequence_count=k)
        for k, ticks in enumerate((0, 2**48 - 1, 2**48, 2**63, 2**64 - 1))
    )
    rows = batch_of_cut(octets, cut_packets(octets)).rows
    reported = next(columns["reported_ticks"] for columns in rows.values() if "reported_ticks" in columns)
    assert reported.dtype == "int64"
    assert reported.tolist() == [0, 2**48 - 1, NO_TICKS, NO_TICKS, NO_TICKS]


def test_parts_of_a_packet_are_joined_where_their_counts_and_octets_agree():
    """A packet in three frames of 20 octets; both parts hold the second frame, the last one of a stranger differs."""
    packet = append_crc(pack_packet(0x123, bytes(42), sequence_count=1)[:-2])
    channel, form = (76, 0, 0, 20), lambda _: PacketForm()
    begin = Fragment(channel, True, False, 254, 0, 0, 20, packet[:40])
    end = Fragment(channel, False, True, 255, 1, 900, 920, packet[20:])
    stranger = replace(end, octets=b"x" + packet[21:])
    assert (begin.fit, end.fit) == (len(packet) - 40, len(packet) - 20)
    assert [fits(end, octets) for octets in (end.fit, end.fit - 1, UNKNOWN)] == [True, False, True]
    assert fits(replace(end, ends=False), 5) and fits(replace(begin, ends=True), 5)
    assert join([begin, stranger, end], form) == ([(76, packet)], [stranger])
    assert join([begin, replace(end, count=0, next_count=2)], form)[0] == []


def test_only_ingests_with_packets_in_the_time_are_returned(either, synthetic_pass):
    result = ingest_file(either, synthetic_pass.folder / "downlink.cadu")
    first, last = result.first_ticks, result.last_ticks
    assert first < last

    def found(start_ticks, stop_ticks):
        return len(either.read(recordings_of_vehicle, result.vehicle_id, start_ticks, stop_ticks))

    assert found(first, last) == found(first - 9, first) == found(last, last + 9) == found(first + 1, first + 2) == 1
    assert found(first - 9, first - 1) == found(last + 1, last + 9) == 0

    def without_times(**counts):
        accounting = {"packets": 0, "vehicle_ids": [result.vehicle_id], **counts}
        changed = repository.INGESTS.update().values(first_ticks=None, last_ticks=None, accounting=accounting)
        with either.database.writing() as connection:
            connection.execute(changed)
        return found(last + 1, last + 9)

    assert without_times(frames=2) == 0  # without a packet, and without octets that could be of one
    assert without_times(packets=1) == without_times(frames_bad=1) == without_times(octets_pending=9) == 1
