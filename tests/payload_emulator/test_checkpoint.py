"""The state of a continuous session in its file: exact, refused when damaged or foreign, whole after a failure."""

from __future__ import annotations

import hashlib
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from payload_emulator.errors import RecordError
from payload_emulator.session.checkpoint import (
    VERSION,
    Account,
    BoardState,
    Checkpoint,
    LinkState,
    load_checkpoint,
    save_checkpoint,
)
from payload_emulator.session.spacecraft import new_board
from payload_emulator.sim.board.faults import parse_fault
from payload_emulator.sim.board.link import Receiver, Transmitter
from payload_emulator.sim.board.platform import SimulatedBoard
from tmtc.cadu import ASM
from tmtc.link import LinkSettings
from tmtc.packets import idle_packet
from tmtc.uplink import Farm

CRAFT = 76


def used_board() -> SimulatedBoard:
    """A board that has run: random numbers drawn, memory and tables written."""
    board = new_board(5)
    board.switch(3)
    board.advance(1_000.0, 0.5)
    board.sensors()
    board.enter(1)
    board.store[:3] = 1, 2, 255
    board.settings[-1] = 7
    board.write_table(4, b"table")
    board.heat_c = 2.5
    return board


def used_link() -> tuple[Receiver, Transmitter]:
    receiver, transmitter = Receiver(CRAFT), Transmitter(CRAFT, LinkSettings())
    receiver.decoder.farms[2] = Farm(2, expected=9, lockout=True, farm_b_counter=3)
    receiver.decoder.parts[(2, 1)] = b"half a packet"
    transmitter.send([idle_packet(2_000)], 0)
    transmitter.send([idle_packet(500)], 0, virtual_channel=1)
    return receiver, transmitter


def checkpoint(**changed: Any) -> Checkpoint:
    values: dict[str, Any] = {
        "scenario": "one",
        "utc_ns": 1_880_000_000_123_456_789,
        "board": BoardState.of(used_board()),
        "resets": [1, 2],
        "clock_error_ticks": -3,
        "begun": [parse_fault("clock_jump at 40 size 12"), parse_fault("overheating at 3.5 for 60")],
        "link": LinkState.of(*used_link()),
        "state_icrf": [1.8e6, 0.1, -1.0 / 3.0, 1.0, 2.0, 1600.0],
        "account": Account(frames=4, telecommands=9),
    }
    return Checkpoint.model_validate(values | changed)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "new folder" / "session.state"


def test_every_value_is_read_as_it_was_written(path: Path) -> None:
    kept = checkpoint()
    save_checkpoint(path, kept)
    read = load_checkpoint(path, "one")
    # Compared as text: readings may be NaN.
    assert read is not None and read.model_dump_json() == kept.model_dump_json()
    assert read.state_icrf == kept.state_icrf and read.begun == kept.begun and read.account == kept.account
    assert [one.name for one in path.parent.iterdir()] == [path.name]
    assert load_checkpoint(path.with_name("none"), "one") is None


def test_a_board_goes_on_with_the_same_random_numbers_and_memory(path: Path) -> None:
    board, other = used_board(), new_board(5)
    save_checkpoint(path, checkpoint(board=BoardState.of(board)))
    read = load_checkpoint(path, "one")
    assert read is not None
    read.board.put_on(other)
    np.testing.assert_array_equal(other.store, board.store)
    np.testing.assert_array_equal(other.settings, board.settings)
    np.testing.assert_array_equal(other.readings, board.readings)
    assert other.read_table(4) == b"table" and other.heat_c == 2.5 and other.store.flags.writeable
    assert other.uptime_ticks() == board.uptime_ticks() > 0 and other.charge == board.charge
    for one in (board, other):
        one.reset(3)
    np.testing.assert_array_equal(other.sensors(), board.sensors())
    assert other.enter(2) == board.enter(2)


def test_frame_counts_and_acceptance_go_on(path: Path) -> None:
    receiver, transmitter = used_link()
    save_checkpoint(path, checkpoint())
    read = load_checkpoint(path, "one")
    assert read is not None
    again = Receiver(CRAFT), Transmitter(CRAFT, LinkSettings())
    read.link.put_on(*again)
    assert again[0].decoder.farms == receiver.decoder.farms
    assert again[0].decoder.parts == receiver.decoder.parts
    packet = [idle_packet(700)]
    sent = again[1].send(packet, 0, virtual_channel=1)
    assert sent.startswith(ASM) and sent == transmitter.send(packet, 0, virtual_channel=1)


def written(path: Path, change: Any, version: int = VERSION) -> None:
    """Write a state whose document is changed, with a valid checksum."""
    document = json.loads(checkpoint().model_dump_json())
    change(document)
    octets = json.dumps(document).encode()
    path.parent.mkdir(exist_ok=True)
    digest = hashlib.sha256(octets).hexdigest()
    path.write_bytes(f"LINNA session state, version {version}, SHA-256 {digest}\n".encode() + octets)


@pytest.mark.parametrize("length", [0, 1, 60, 103, 104, 2_000, -1])
def test_a_truncated_file_is_refused(path: Path, length: int) -> None:
    save_checkpoint(path, checkpoint())
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(
        RecordError, match=r"session\.state: expected .*, found a (damaged file|file that begins)"
    ):
        load_checkpoint(path, "one")


def test_a_changed_octet_is_refused(path: Path) -> None:
    save_checkpoint(path, checkpoint())
    octets = bytearray(path.read_bytes())
    octets[octets.index(b'"utc_ns":') + 10] ^= 1
    path.write_bytes(octets)
    with pytest.raises(RecordError, match="found a damaged file"):
        load_checkpoint(path, "one")


def test_a_foreign_file_is_refused_and_nothing_in_it_is_executed(path: Path) -> None:
    class Harm:
        def __reduce__(self) -> Any:
            return (Path(path).with_name("harm").touch, ())

    path.parent.mkdir()
    path.write_bytes(pickle.dumps(Harm()))
    with pytest.raises(RecordError, match="found a file that begins with"):
        load_checkpoint(path, "one")
    assert not path.with_name("harm").exists()
    with pytest.raises(RecordError, match=r"found Is a directory"):
        load_checkpoint(path.parent, "one")


def test_another_version_or_scenario_is_refused(path: Path) -> None:
    written(path, lambda document: None, version=VERSION + 1)
    with pytest.raises(RecordError, match=f"expected version {VERSION} of the state, found {VERSION + 1}"):
        load_checkpoint(path, "one")
    save_checkpoint(path, checkpoint())
    with pytest.raises(RecordError, match="expected the state of scenario two, found that of one"):
        load_checkpoint(path, "two")


@pytest.mark.parametrize(
    ("place", "change"),
    [
        ("board.store", lambda document: document["board"].update(store="no octets")),
        ("state_icrf", lambda document: document["state_icrf"].pop()),
        ("state_icrf.0", lambda document: document["state_icrf"].__setitem__(0, float("nan"))),
        ("extra", lambda document: document.update(extra=1)),
        ("link.master_count", lambda document: document["link"].pop("master_count")),
    ],
)
def test_an_invalid_value_is_refused_with_its_place(path: Path, place: str, change: Any) -> None:
    written(path, change)
    with pytest.raises(RecordError, match=rf"session\.state, {place}: expected a valid state, found: "):
        load_checkpoint(path, "one")


def test_a_failure_while_writing_leaves_the_state_before(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_checkpoint(path, checkpoint())

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(path, checkpoint(clock_error_ticks=99))
    read = load_checkpoint(path, "one")
    assert read is not None and read.clock_error_ticks == -3
