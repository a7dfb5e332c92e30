"""Exact states: views, known objects, refusals."""

from __future__ import annotations

import os
import pickle
from types import MappingProxyType

import numpy as np
import pytest

from payload_emulator.errors import RecordError
from payload_emulator.session.snapshot import pack_snapshot, unpack_snapshot


def test_views_stay_views_of_their_memory() -> None:
    memory = np.arange(24, dtype=np.uint8)
    kept = {"software": [memory, memory[6:20:2]], "words": memory.view(np.uint16)[3:]}
    found = unpack_snapshot(pack_snapshot("a", kept, {}), "a", {})
    whole, ring = found["software"]
    assert np.array_equal(ring, memory[6:20:2])
    whole[6:8] = 255
    assert ring[0] == 255 and found["words"][0] == 65_535
    assert memory[6] == 6


def test_read_only_mappings_stay_read_only() -> None:
    found = unpack_snapshot(pack_snapshot("a", {"given": MappingProxyType({"one": 1})}, {}), "a", {})
    assert found["given"] == {"one": 1} and isinstance(found["given"], MappingProxyType)


def test_known_objects_are_those_of_the_reader() -> None:
    network, other = object(), object()
    octets = pack_snapshot("a", {"one": [network]}, {"network": network})
    assert unpack_snapshot(octets, "a", {"network": other})["one"] == [other]
    with pytest.raises(RecordError, match="unknown object network"):
        unpack_snapshot(octets, "a", {})


def test_what_cannot_be_kept_or_read_is_refused_in_one_line() -> None:
    with pytest.raises(RecordError, match="expected values that can be kept"):
        pack_snapshot("a", {"function": lambda: None}, {})
    octets = pack_snapshot("a", {"one": 1}, {})
    with pytest.raises(RecordError, match="expected that of scenario b, found that of a"):
        unpack_snapshot(octets, "b", {})
    for damaged in (b"", b"nothing", octets[:-3]):
        with pytest.raises(RecordError, match="found damage"):
            unpack_snapshot(damaged, "a", {})


class Harm:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("true",)


@pytest.mark.parametrize("what", ["function of another program", "function of this program"])
def test_a_file_cannot_name_a_function_to_be_called(what: str) -> None:
    value = Harm() if what == "function of another program" else pack_snapshot
    octets = pickle.dumps((1, "a", {"one": value}))
    with pytest.raises(RecordError, match="expected a class"):
        unpack_snapshot(octets, "a", {})
