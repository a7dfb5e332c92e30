import numpy as np
import pytest

from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import ValueRefused
from tmtc.packets.large_data import LargeData, LargeDataReceiver, split

IMAGE = np.random.default_rng(0).bytes(10_000)


def received(parts):
    receiver = LargeDataReceiver()
    return [whole for name, values in parts if (whole := receiver.accept(name, values)) is not None]


def through_packets(parts):
    """What the other end unpacks."""
    for k, (name, values) in enumerate(parts):
        yield DICTIONARY.unpack(DICTIONARY.pack(name, values, ticks=k, sequence_count=k))


@pytest.mark.parametrize("part_length", [1000, 9999, 10_000, 20_000])
def test_what_is_split_comes_back(part_length):
    parts = split(IMAGE, transaction=3, table="thumbnail", part_length=part_length)
    assert received(through_packets(parts)) == [LargeData(3, 6, IMAGE)]


def test_the_parts_are_first_middle_and_last():
    names = [name for name, _ in split(IMAGE, transaction=1, table=1, part_length=2500)]
    assert names == ["large_data_first", "large_data_middle", "large_data_middle", "large_data_last"]
    assert [name for name, _ in split(b"", transaction=1, table=1, part_length=10)] == ["large_data_last"]


def test_parts_go_up_as_telecommands():
    octets = b""
    for name, values in split(IMAGE, transaction=9, table="model", part_length=900, link="uplink"):
        command = DICTIONARY.unpack_command(DICTIONARY.pack_command(name, values, sequence_count=0))
        octets += command.values["items"]["octet"].astype(np.uint8).tobytes()
    assert octets == IMAGE


def test_order_and_repetition_do_not_matter():
    parts = list(through_packets(split(IMAGE, transaction=3, table="thumbnail", part_length=1000)))
    receiver = LargeDataReceiver()
    for k in (9, 0, 0, 4, 2):
        assert receiver.accept(*parts[k]) is None
    for k in (1, 3, 5, 6, 7):
        assert receiver.accept(*parts[k]) is None
    assert receiver.accept(*parts[8]) == LargeData(3, 6, IMAGE)
    assert receiver._kept == 0


def test_a_number_that_is_used_again_for_another_table_begins_again():
    old = list(through_packets(split(IMAGE, transaction=3, table="thumbnail", part_length=5000)))
    new = list(through_packets(split(IMAGE[::-1], transaction=3, table="landmark_map", part_length=5000)))
    assert received([old[0], *new]) == [LargeData(3, 7, IMAGE[::-1])]


def test_unfinished_transfers_do_not_grow_without_bound():
    receiver = LargeDataReceiver(most_octets=5000)
    for transaction in range(100):
        name, values = split(IMAGE, transaction=transaction, table=1, part_length=1000)[0]
        receiver.accept(name, values)
        assert receiver._kept <= 5000


def test_impossible_parts_are_refused():
    with pytest.raises(ValueRefused):
        split(IMAGE, transaction=1, table=1, part_length=0)
    with pytest.raises(ValueRefused, match="at most 65535 parts"):
        split(bytes(70_000), transaction=1, table=1, part_length=1)
