"""State of a continuous session in a file, from which the session goes on after its process has ended.

The file has two lines: `LINNA session state, version N, SHA-256 HEX`, and a JSON document in UTF-8 whose checksum this
is. Octets in the document are compressed with zlib and encoded in base64. Nothing in the file is executed.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError

from payload_emulator.errors import RecordError
from payload_emulator.sim.board.faults import Fault
from payload_emulator.sim.board.link import Receiver, Transmitter
from payload_emulator.sim.board.platform import Memory, SimulatedBoard
from tmtc.uplink import Farm

VERSION = 2
_HEADER = re.compile(rb"LINNA session state, version (\d{1,9}), SHA-256 ([0-9a-f]{64})\n")
_EXPECTED = "the state of a session (linna emulate --continuous --state)"


def _compressed(octets: bytes) -> str:
    return base64.b64encode(zlib.compress(octets, 1)).decode("ascii")


def _decompressed(value: object) -> object:
    if not isinstance(value, str):
        return value
    try:
        return zlib.decompress(base64.b64decode(value, validate=True))
    except (binascii.Error, zlib.error):
        raise ValueError("expected compressed octets") from None


Octets = Annotated[bytes, BeforeValidator(_decompressed), PlainSerializer(_compressed)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")


@dataclass(slots=True)
class Account:
    """What a session has done since its epoch."""

    frames: int = 0
    packets: int = 0
    frames_sent: int = 0
    frames_lost: int = 0
    packets_lost_on_link: int = 0
    contacts: int = 0
    telecommands: int = 0
    telecommand_octets_lost: int = 0
    resets: int = 0


class _Words(_Part):
    """State of the generator PCG64: two integers of 128 bits."""

    state: int
    inc: int


class GeneratorState(_Part):
    """State of the random numbers of the board."""

    bit_generator: Literal["PCG64"]
    state: _Words
    has_uint32: int
    uinteger: int


class BoardState(_Part):
    """What the board keeps without power, and the state of its environment."""

    store: Octets
    settings: Octets
    tables: dict[int, Octets]
    reset_cause: int
    detector_factor: float
    heat_c: float
    drop_v: float
    charge: float
    structure_c: float
    board_c: float
    camera_c: float
    readings: Annotated[list[float], Field(min_length=4, max_length=4)]
    uptime: int
    counter_ns: int
    generator: GeneratorState

    @classmethod
    def of(cls, board: SimulatedBoard) -> BoardState:
        """Return the state of a board."""
        generator: dict[str, Any] = dict(board.generator.bit_generator.state)
        return cls.model_validate(
            {
                **{name: getattr(board, name) for name in _PLAIN},
                "store": board.store.tobytes(),
                "settings": board.settings.tobytes(),
                "tables": {number: bytes(octets) for number, octets in board.tables.items()},
                "readings": board.readings.tolist(),
                "generator": generator,
            }
        )

    def put_on(self, board: SimulatedBoard) -> None:
        """Give a new board this state."""
        board.store, board.settings = _memory(self.store), _memory(self.settings)
        board.tables = {number: bytearray(octets) for number, octets in self.tables.items()}
        board.readings = np.array(self.readings)
        board.generator.bit_generator.state = self.generator.model_dump()
        for name in _PLAIN:
            setattr(board, name, getattr(self, name))


_PLAIN = (
    "reset_cause",
    "detector_factor",
    "heat_c",
    "drop_v",
    "charge",
    "structure_c",
    "board_c",
    "camera_c",
    "uptime",
    "counter_ns",
)


class OpenPacket(_Part):
    """Telecommand packet of which segments are missing."""

    virtual_channel: int
    map_id: int
    octets: Octets


class LinkState(_Part):
    """State of the receiver (FARM-1, unfinished packets) and frame counts of both directions."""

    farms: dict[int, Farm]
    open_packets: list[OpenPacket]
    uplink_sequence_number: int
    master_count: int
    channel_counts: dict[int, int]

    @classmethod
    def of(cls, receiver: Receiver, transmitter: Transmitter) -> LinkState:
        """Return the state of receiver and transmitter."""
        parts = receiver.decoder.parts.items()
        return cls(
            farms=receiver.decoder.farms,
            open_packets=[OpenPacket(virtual_channel=c, map_id=m, octets=o) for (c, m), o in parts],
            uplink_sequence_number=receiver.station.sequence_number,
            master_count=transmitter.encoder.master_count,
            channel_counts=transmitter.encoder.channel_counts,
        )

    def put_on(self, receiver: Receiver, transmitter: Transmitter) -> None:
        """Give a new receiver and a new transmitter this state."""
        receiver.decoder.farms = dict(self.farms)
        receiver.decoder.parts = {(one.virtual_channel, one.map_id): one.octets for one in self.open_packets}
        receiver.station.sequence_number = self.uplink_sequence_number
        transmitter.encoder.master_count = self.master_count
        transmitter.encoder.channel_counts = dict(self.channel_counts)


class Checkpoint(_Part):
    """State of a session outside of observations; the payload starts from it as after a loss of power.

    Attributes
    ----------
    state_icrf
        Position (m) and velocity (m/s) of the spacecraft at `utc_ns`.
    """

    scenario: str
    utc_ns: int
    board: BoardState
    resets: list[int]
    clock_error_ticks: int
    begun: list[Fault]
    link: LinkState
    state_icrf: Annotated[
        list[Annotated[float, Field(allow_inf_nan=False)]], Field(min_length=6, max_length=6)
    ]
    account: Account


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Replace the file by one with this state; after a loss of power either the old or the new one is whole."""
    document = checkpoint.model_dump_json().encode()
    header = f"LINNA session state, version {VERSION}, SHA-256 {hashlib.sha256(document).hexdigest()}\n"
    replace_file(path, header.encode() + document)


def replace_file(path: Path, octets: bytes) -> None:
    """Replace the content of a file; after a loss of power either the old or the new one is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new_file = path.with_name(path.name + ".new")
    with new_file.open("wb") as stream:
        stream.write(octets)
        stream.flush()
        os.fsync(stream.fileno())
    new_file.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load_checkpoint(path: Path, scenario: str) -> Checkpoint | None:
    """Return the state of a session of a scenario; None without a file.

    Raises
    ------
    RecordError
        The file is another one or damaged, or belongs to another scenario.
    """
    try:
        octets = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordError(f"{path}: expected {_EXPECTED}, found {error.strerror}") from None
    header = _HEADER.match(octets)
    if header is None:
        raise RecordError(f"{path}: expected {_EXPECTED}, found a file that begins with {octets[:24]!r}")
    if int(header[1]) != VERSION:
        raise RecordError(f"{path}: expected version {VERSION} of the state, found {int(header[1])}")
    document = octets[header.end() :]
    if hashlib.sha256(document).hexdigest().encode() != header[2]:
        raise RecordError(f"{path}: expected content with the checksum of line 1, found a damaged file")
    try:
        checkpoint = Checkpoint.model_validate_json(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise RecordError(f"{path}, {place}: expected a valid state, found: {first['msg']}") from None
    if checkpoint.scenario != scenario:
        raise RecordError(
            f"{path}: expected the state of scenario {scenario}, found that of {checkpoint.scenario}"
        )
    return checkpoint


def _memory(octets: bytes) -> Memory:
    return np.frombuffer(octets, dtype=np.uint8).copy()
