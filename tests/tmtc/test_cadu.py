import numpy as np
import pytest

from tmtc.cadu import ASM, find_period, synchronise

PERIOD = 128


def stream_of(count: int, seed: int = 0) -> np.ndarray:
    blocks = np.random.default_rng(seed).integers(0, 256, (count, PERIOD), dtype=np.uint8)
    blocks[:, :4] = np.frombuffer(ASM, dtype=np.uint8)
    return blocks.reshape(-1)


def starts(stream: np.ndarray, **options) -> list[int]:
    return synchronise(stream, PERIOD, **options).offsets.tolist()


def test_the_marker_is_that_of_the_standard():
    assert bytes.fromhex("1ACFFC1D") == ASM


def test_every_cadu_of_an_undamaged_stream_is_found():
    stream = stream_of(50)
    assert find_period(stream) == PERIOD
    assert starts(stream) == list(range(0, 50 * PERIOD, PERIOD))


def test_a_stream_may_begin_and_end_anywhere():
    assert starts(stream_of(50)[77:-5]) == [PERIOD * k - 77 for k in range(1, 49)]


def test_nothing_and_noise_have_no_cadus():
    assert starts(np.empty(0, dtype=np.uint8)) == []
    assert find_period(np.random.default_rng(1).integers(0, 256, 100_000, dtype=np.uint8)) == 0
    assert starts(np.random.default_rng(1).integers(0, 256, 100_000, dtype=np.uint8)) == []


@pytest.mark.parametrize("wrong_bits", [1, 3, 4, 32])
def test_a_damaged_marker_is_passed_over_while_in_lock(wrong_bits):
    stream = stream_of(20)
    marker = np.unpackbits(stream[10 * PERIOD : 10 * PERIOD + 4])
    marker[:wrong_bits] ^= 1
    stream[10 * PERIOD : 10 * PERIOD + 4] = np.packbits(marker)
    sync = synchronise(stream, PERIOD)
    assert sync.offsets.tolist() == list(range(0, 20 * PERIOD, PERIOD))
    assert sync.marker_errors[10] == wrong_bits


def test_lost_octets_cost_the_frame_they_are_lost_from():
    stream = np.delete(stream_of(20), slice(7 * PERIOD + 60, 7 * PERIOD + 63))
    sync = synchronise(stream, PERIOD)
    expected = [PERIOD * k for k in range(7)] + [PERIOD * k - 3 for k in range(8, 20)]
    assert sync.offsets.tolist() == expected
    assert sync.truncated.tolist() == [7 * PERIOD]


def test_inserted_octets_are_skipped():
    stream = np.insert(stream_of(20), 7 * PERIOD, np.zeros(5, dtype=np.uint8))
    assert starts(stream) == [PERIOD * k for k in range(7)] + [PERIOD * k + 5 for k in range(7, 20)]


def test_a_marker_inside_a_frame_does_not_catch_the_lock():
    stream = stream_of(20)
    stream[5 * PERIOD + 40 : 5 * PERIOD + 44] = np.frombuffer(ASM, dtype=np.uint8)
    assert starts(stream) == list(range(0, 20 * PERIOD, PERIOD))
    # not even in search: the check one period later fails
    assert starts(stream[5 * PERIOD + 10 :]) == [PERIOD * k - 10 for k in range(1, 15)]


def test_a_long_outage_is_bridged():
    stream = np.concatenate(
        (
            stream_of(5),
            np.random.default_rng(9).integers(0, 256, 100_001, dtype=np.uint8),
            stream_of(5, seed=2),
        )
    )
    assert starts(stream) == [PERIOD * k for k in range(5)] + [
        5 * PERIOD + 100_001 + PERIOD * k for k in range(5)
    ]


def test_a_single_cadu_is_a_stream():
    stream = stream_of(1)
    assert find_period(stream) == PERIOD and starts(stream) == [0]
