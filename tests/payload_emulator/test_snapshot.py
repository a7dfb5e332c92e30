"""Exact states: views, known objects, refusals."""

from __future__ import annotations

import os
import pickle
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from payload_emulator.errors import RecordError
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.session.snapshot import (
    _view,
    load_snapshot,
    pack_snapshot,
    save_snapshot,
    unpack_snapshot,
)


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


def test_members_of_enumerations_are_kept_by_value_whatever_the_release_of_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def by_name(self: PayloadMode, _protocol: int) -> tuple[object, ...]:
        return getattr, (type(self), self.name)

    # as Python 3.11.0 to 3.11.3 do
    monkeypatch.setattr(PayloadMode, "__reduce_ex__", by_name)
    mode = list(PayloadMode)[-1]
    found = unpack_snapshot(pack_snapshot("a", {"mode": mode, "modes": [mode]}, {}), "a", {})
    assert found == {"mode": mode, "modes": [mode]} and found["mode"] is mode


def test_known_objects_are_those_of_the_reader() -> None:
    network, other = object(), object()
    octets = pack_snapshot("a", {"one": [network]}, {"network": network})
    assert unpack_snapshot(octets, "a", {"network": other})["one"] == [other]
    with pytest.raises(RecordError, match="unknown object network"):
        unpack_snapshot(octets, "a", {})


def test_what_cannot_be_kept_or_belongs_elsewhere_is_refused_in_one_line() -> None:
    with pytest.raises(RecordError, match="expected values that can be kept"):
        pack_snapshot("a", {"function": lambda: None}, {})
    octets = pack_snapshot("a", {"one": 1}, {})
    with pytest.raises(RecordError, match="expected the exact state of scenario b, found that of a"):
        unpack_snapshot(octets, "b", {})
    with pytest.raises(RecordError, match="expected version 3 of the exact state, found 1"):
        unpack_snapshot(octets.replace(b"version 3", b"version 1", 1), "a", {})


def test_a_damaged_file_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "exact"
    assert load_snapshot(path, "a", {}) is None
    save_snapshot(path, "a", {"one": np.arange(40)}, {})
    whole = path.read_bytes()
    found = load_snapshot(path, "a", {})
    assert found is not None and np.array_equal(found["one"], np.arange(40))
    assert [one.name for one in tmp_path.iterdir()] == ["exact"]
    begin = whole.index(b"\n") + 1
    for length in (0, 1, 20, begin - 1, begin, begin + 1, begin + 60, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordError, match=r"exact: expected the exact state of a session .*, found"):
            load_snapshot(path, "a", {})
    for place in (3, begin + 2, begin + 100, len(whole) - 2):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with pytest.raises(RecordError, match=r"exact: expected the exact state of a session .*, found"):
            load_snapshot(path, "a", {})


def sealed(document: bytes) -> bytes:
    """A pickle with the header that fits."""
    return f"LINNA exact state, version 3, SHA-256 {sha256(document).hexdigest()}\n".encode() + document


@pytest.mark.parametrize("length", [0, 1, 2, 11, 30, -1])
def test_a_pickle_that_ends_early_is_refused_also_with_a_fitting_checksum(length: int) -> None:
    octets = pack_snapshot("a", {"one": np.arange(40)}, {})
    document = octets[octets.index(b"\n") + 1 :]
    assert sealed(document) == octets
    with pytest.raises(RecordError, match="found damage"):
        unpack_snapshot(sealed(document[:length]), "a", {})


@pytest.mark.parametrize("value", [(1, 2, 3), 7, ("a", 5), None, ("a", {"one": {}}, 1)])
def test_a_pickle_of_something_else_is_refused(value: object) -> None:
    with pytest.raises(RecordError, match="found damage"):
        unpack_snapshot(sealed(pickle.dumps(value)), "a", {})


class Harm:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("true",)


@pytest.mark.parametrize("what", ["function of another program", "function of this program"])
def test_a_file_cannot_name_a_function_to_be_called(what: str) -> None:
    value = Harm() if what == "function of another program" else pack_snapshot
    with pytest.raises(RecordError, match="expected a class"):
        unpack_snapshot(sealed(pickle.dumps(("a", {"one": value}))), "a", {})


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("payload_emulator.sim.render.cycles", "subprocess.Popen"),
        ("payload_emulator.session.snapshot", "Path"),
        ("payload_emulator.session.snapshot", "pickle.Unpickler"),
        ("payload_emulator.session.continuous", "ThreadPoolExecutor"),
        ("payload_emulator.session.continuous", "ContinuousSession.run"),
    ],
)
def test_a_file_cannot_reach_what_a_module_of_this_program_imports(
    module: str, name: str, tmp_path: Path
) -> None:
    """The names are written as protocol 4 does, which looks up each part after a dot."""
    made = tmp_path / "made"
    words = [b"\x8c" + bytes([len(one)]) + one.encode() for one in (module, name, "touch", str(made))]
    call = words[0] + words[1] + b"\x93" + b"](" + words[2] + words[3] + b"e\x85R"
    document = b"\x80\x04\x8c\x01a}\x8c\x03one" + call + b"s\x86."
    with pytest.raises(RecordError, match=f"expected a class of {module}, found {name}"):
        unpack_snapshot(sealed(document), "a", {})
    assert not made.exists()


def test_a_view_of_objects_is_refused() -> None:
    """It would take numbers of the file as addresses of objects."""

    class View:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return _view, (np.zeros(8, np.uint8), 0, (1,), (8,), np.dtype(object))

    with pytest.raises(RecordError, match="expected a view of numbers"):
        unpack_snapshot(sealed(pickle.dumps(("a", {"one": View()}))), "a", {})
