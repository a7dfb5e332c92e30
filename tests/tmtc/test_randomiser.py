import numpy as np
import pytest

from tmtc.errors import LinkFormatError
from tmtc.link.randomiser import randomise, sequence


@pytest.mark.parametrize(
    ("name", "start"),
    [
        # CCSDS 131.0-B-3 section 9.4.2: first 40 bits of the 255-bit sequence; more octets from its register
        ("legacy", "FF480EC09A0D70BC8E2C"),
        # CCSDS 131.0-B-5 section 10: first 40 bits of the 131071-bit sequence
        ("long", "1C71B91BA9"),
        # CCSDS 231.0-B section 6: first 40 bits of the telecommand sequence
        ("telecommand", "FF399E5A68"),
    ],
)
def test_sequences_begin_as_the_standards_print_them(name, start):
    assert sequence(name, len(start) // 2).tobytes().hex().upper() == start


@pytest.mark.parametrize(("name", "bits"), [("legacy", 255), ("long", 131_071), ("telecommand", 255)])
def test_sequences_repeat_after_their_full_period_and_not_before(name, bits):
    stream = np.unpackbits(sequence(name, (2 * bits + 7) // 8 + 1))
    assert np.array_equal(stream[:bits], stream[bits : 2 * bits])
    assert (
        np.count_nonzero(stream[:bits]) == (bits + 1) // 2
    )  # a maximal sequence has one more one than zeros
    for divisor in (3, 5, 17):
        if bits % divisor == 0:
            assert not np.array_equal(stream[: bits - bits // divisor], stream[bits // divisor : bits])


@pytest.mark.parametrize("name", ["none", "legacy", "long", "telecommand"])
def test_randomising_twice_gives_the_frames_back(name):
    frames = np.random.default_rng(0).integers(0, 256, (3, 1275), dtype=np.uint8)
    assert np.array_equal(randomise(randomise(frames, name), name), frames)


def test_an_unknown_randomiser_is_refused():
    with pytest.raises(LinkFormatError, match="expected one of none, legacy, long, telecommand, found 'xyz'"):
        sequence("xyz", 4)
