import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from pytest import mark

from tmtc.packets.sequence import CONFLICT, DUPLICATE, FIRST, account


def never_same(a, b):
    return False


def always_same(a, b):
    return True


def report(counts, ticks=None, apid=None, same=always_same, boot=None):
    counts = np.asarray(counts, dtype=np.int64)
    ticks = np.arange(counts.size, dtype=np.int64) << 16 if ticks is None else np.asarray(ticks, dtype=np.int64)
    apid = np.full(counts.size, 5, dtype=np.int64) if apid is None else np.asarray(apid, dtype=np.int64)
    return account(apid, counts % 16384, ticks, same, boot)


def test_counts_have_no_gap_across_wraps_and_a_missing_packet_is_one():
    for counts in (range(100), range(16380, 16390), range(50_000)):
        result = report(counts)
        assert (result.gaps, result.missing, result.duplicates, result.conflicts) == (0, 0, 0, 0)
        assert result.accounts[0].received == len(counts)
        assert result.extended_count.tolist() == list(counts)
    assert report([]).accounts == ()
    for counts, missing in (([0, 1, 2, 4, 5], [3, 3]), ([16382, 16383, 16386, 16387], [16384, 16385])):
        result = report(counts)
        assert (result.gaps, result.missing) == (1, missing[1] - missing[0] + 1)
        assert result.accounts[0].missing_ranges.tolist() == [missing]


def test_order_of_arrival_does_not_matter():
    rng = np.random.default_rng(4)
    counts = np.delete(np.arange(16000, 17000), [3, 500, 501, 999 - 1])
    ticks = counts << 16
    order = rng.permutation(counts.size)
    shuffled = report(counts[order], ticks[order])
    assert shuffled.accounts[0].missing_ranges.tolist() == report(counts, ticks).accounts[0].missing_ranges.tolist()
    assert shuffled.missing == 4 and shuffled.gaps == 3
    assert shuffled.extended_count.tolist() == counts[order].tolist()


def test_what_comes_twice_is_a_duplicate_other_octets_a_conflict_and_equal_times_go_by_count():
    # four estimators report in one instant, arriving in any order, across the wrap
    assert report([16381, 16382, 0, 16383, 2, 1], ticks=[0, 0, 1, 1, 1, 1]).gaps == 0
    assert report([0, 1, 1, 2], ticks=[0, 1, 1, 2]).verdict.tolist() == [FIRST, FIRST, DUPLICATE, FIRST]
    conflict = report([0, 1, 1, 2], ticks=[0, 1, 1, 2], same=never_same)
    assert conflict.verdict.tolist() == [FIRST, FIRST, CONFLICT, FIRST]
    assert (conflict.duplicates, conflict.conflicts) == (0, 1)
    counts = np.r_[:500, :500]
    result = report(counts, ticks=counts << 16)
    assert (result.duplicates, result.gaps, result.accounts[0].received) == (500, 0, 500)
    assert np.all(result.verdict[:500] == FIRST)


def test_a_burst_from_yesterday_in_the_middle_of_today_is_separated():
    day = 86_400 << 16
    today, yesterday = np.arange(9000, 9100), np.arange(8900, 9000)
    counts = np.concatenate((today[:50], yesterday, today[50:]))
    result = report(counts, (counts << 16) + np.where(counts < 9000, day, 2 * day))
    assert (result.gaps, result.duplicates) == (0, 0)


def test_a_burst_from_the_future_leaves_no_gap_behind():
    # the clock jumped ahead for ten packets and came back
    counts = np.arange(100)
    ticks = counts << 16
    ticks[40:50] += 86_400 << 16
    assert report(counts, ticks).gaps == 0


def test_senders_and_boots_are_accounted_apart():
    apid = np.tile([1, 2], 50)
    counts = np.repeat(np.arange(50), 2)
    result = report(counts, apid=apid)
    assert result.gaps == 0 and [a.received for a in result.accounts] == [50, 50]
    counts = np.r_[:100, :100]
    result = report(counts, boot=np.repeat([7, 8], 100), same=never_same)
    assert [(a.boot, a.received, a.gaps, a.conflicts) for a in result.accounts] == [(7, 100, 0, 0), (8, 100, 0, 0)]


def test_a_counter_that_begins_again_is_a_restart_without_hiding_losses():
    counts = np.r_[3000:3100, :50]
    result = report(counts)
    assert (result.accounts[0].restarts, result.gaps, result.conflicts, result.duplicates) == (1, 0, 0, 0)
    counts = np.r_[3000:3100, :50]
    result = report(np.delete(counts, [50, 120]))
    # The second run counts on from 16,384.
    assert result.accounts[0].missing_ranges.tolist() == [[3050, 3050], [16_404, 16_404]]
    for before, after, restarts in ((3000, 63, 1), (3000, 64, 0), (115, 50, 1), (114, 50, 0)):
        result = report([before, after])
        assert result.accounts[0].restarts == restarts, (before, after)


@mark.parametrize(
    "counts, restarts, conflicts, missing",
    [
        ([*range(25), *range(3, 30)], 1, 0, 0),  # the last five before and the first three after it are lost
        ([*range(25), *range(30), *range(2, 20)], 2, 0, 0),
        ([*range(40), 20, *range(40, 60)], 0, 1, 0),  # one packet with a wrong count
        ([*range(25), *range(3, 10), *range(12, 30)], 1, 0, 2),
    ],
)
def test_counts_of_other_content_that_come_again_are_a_restart(counts, restarts, conflicts, missing):
    found = report(counts, same=never_same)
    assert (found.restarts, found.conflicts, found.missing) == (restarts, conflicts, missing)
    given = report(counts, same=never_same, boot=np.zeros(len(counts), dtype=np.int64))
    assert given.restarts == 0  # boots are known
    assert report(counts).restarts == 0  # copies


def test_other_content_behind_a_copy_is_no_restart():
    found = report([*range(40), *range(5, 15)], same=lambda earlier, _: earlier == 5)
    assert (found.restarts, found.duplicates, found.conflicts) == (0, 1, 9)


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 16383), st.lists(st.integers(1, 400), min_size=1, max_size=60),
    st.lists(st.integers(0, 59), max_size=20), st.randoms(use_true_random=False),
)  # fmt: skip
def test_any_losses_copies_and_orders_are_accounted_for(start, steps, copies, random):
    sent = start + np.cumsum(np.array(steps)) - steps[0]
    rows = list(range(sent.size)) + [c % sent.size for c in copies]
    random.shuffle(rows)
    counts = sent[rows]
    result = account(np.full(counts.size, 3), counts % 16384, counts * 100, lambda a, b: bool(counts[a] == counts[b]))
    assert result.accounts[0].received == sent.size
    assert result.missing == int(sent[-1] - sent[0] + 1 - sent.size)
    assert result.gaps == int(np.count_nonzero(np.diff(sent) > 1))
    assert result.duplicates == len(copies) and result.conflicts == 0
    assert_array_equal(result.extended_count - result.extended_count.min(), counts - counts.min())
