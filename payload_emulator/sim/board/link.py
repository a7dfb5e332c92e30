"""The radio link: passes over ground stations, and what becomes of the frames on their way, every one accounted for.

A dump is what the encoder is given at once; frames of a dump hold whole packets, so dumps can be lost in part, come out
of order and come twice without touching each other. Bit errors come in two states (Gilbert–Elliott), frame by frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray, OctetArray
from lunar.constants import SPEED_OF_LIGHT_M_S
from lunar.ephemeris import Ephemeris
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from lunar.visibility import GroundStation, link
from payload_emulator.errors import ScenarioError
from tmtc.downlink import DownlinkEncoder
from tmtc.link import cadu
from tmtc.link.frames import FRAME_HEADER_LENGTH, OCF_LENGTH, pack_clcw
from tmtc.link.settings import LinkSettings
from tmtc.link.uplink import Farm, UplinkDecoder, UplinkEncoder
from tmtc.packets.space_packets import CRC_LENGTH
from tmtc.packets.stream import cut_packets

LIGHT_S = 1.28
_LIGHT_NS = 1_500_000_000
_CONTACT_STEP_NS = 60_000_000_000
# WGS 84 latitude, east longitude (degrees) and height (m), from the agencies' public station pages, to 0.01 deg.
STATIONS = {
    "goldstone": (35.43, -116.89, 1000.0),
    "madrid": (40.43, -4.25, 840.0),
    "canberra": (-35.40, 148.98, 690.0),
    "cebreros": (40.45, -4.37, 790.0),
    "malargue": (-35.78, -69.40, 1550.0),
    "new_norcia": (-31.05, 116.19, 250.0),
}


@dataclass(frozen=True, slots=True)
class LinkSection:
    """Errors of the link, frame by frame, and its contacts.

    Losses and bit errors have two states: a burst begins and ends with the given probabilities per frame. What is sent
    at once (a dump) comes again with probability `repeat_share`, and behind the next one with `reorder_share`.
    `stations` are those that listen (one of `STATIONS`), behind the limb of the Moon or not;
    without any the link never ends. `rate_bps` counts the bits of packets, `uplink_bps` those of telecommands. With
    `playback` the first half of each contact's packets is asked for again in the next one. `outages` are spans in which
    a station does not listen: `STATION START STOP`, UTC; `missed` are more of them, which the ground does not know.
    `clock_errors` are those of the clocks of stations: `STATION SECONDS`.
    """

    coding: Literal["rs", "none"] = "rs"
    frame_loss: float = 0.0
    bit_error_rate: float = 0.0
    burst_start: float = 0.0
    burst_end: float = 0.2
    burst_frame_loss: float = 0.5
    burst_bit_error_rate: float = 1e-3
    repeat_share: float = 0.0
    reorder_share: float = 0.0
    stations: tuple[str, ...] = ()
    minimum_elevation_deg: float = 10.0
    rate_bps: float = 64_000.0
    playback: bool = False
    uplink_bps: float = 4_000.0
    outages: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()
    clock_errors: tuple[str, ...] = ()


@dataclass(slots=True, eq=False)
class Receiver:
    """The spacecraft's telecommand receiver: frames in, packets out, and the CLCW that its telemetry carries.

    It belongs to the platform, so a restart of the payload leaves it as it is.

    Attributes
    ----------
    decoder
        Takes CLTUs apart and decides by FARM-1 which frames are accepted.
    carrier, bit_lock
        Whether a station transmits to it, and bits of telecommands (or the idle pattern between them).
    """

    spacecraft_id: int
    carrier: bool = True
    bit_lock: bool = True
    decoder: UplinkDecoder = field(init=False)
    station: UplinkEncoder = field(init=False)

    def __post_init__(self) -> None:
        self.decoder = UplinkDecoder(self.spacecraft_id)
        self.station = UplinkEncoder(self.spacecraft_id)

    def take(self, packets: bytes) -> bytes:
        """Telecommand packets of a station, sent as it sends them and received here."""
        return b"".join(
            self.decoder.decode(self.station.encode(cut_packets(packets, packet_type=1).packets(packets))).packets
        )

    @property
    def clcw(self) -> bytes:
        """The operational control field of a frame that is sent now."""
        state = self.decoder.farms.get(self.station.virtual_channel, Farm()).clcw
        return pack_clcw(replace(state, no_rf_available=not self.carrier, no_bit_lock=not self.bit_lock))


@dataclass(frozen=True, slots=True)
class Dump:
    """CADUs that were encoded together, when they left, and where each packet lies in them.

    `light_s` is their way to the station; `first`, `last` (n,) are the frames that packet n begins and ends in.
    """

    cadus: bytes
    virtual_channel: int
    utc_ns: int
    packets: tuple[bytes, ...]
    first: IntArray
    last: IntArray
    light_s: float = LIGHT_S


@dataclass(slots=True, eq=False)
class Transmitter:
    """Encodes what the payload hands over, and remembers it for the account."""

    spacecraft_id: int
    settings: LinkSettings
    dumps: list[Dump] = field(default_factory=list)
    encoder: DownlinkEncoder = field(init=False)

    def __post_init__(self) -> None:
        self.encoder = DownlinkEncoder(self.spacecraft_id, self.settings)

    def send(
        self,
        packets: Sequence[bytes],
        utc_ns: int,
        virtual_channel: int = 0,
        light_s: float = LIGHT_S,
        clcw: bytes | Sequence[bytes] | None = None,
    ) -> bytes:
        """The CADUs of these packets; `clcw` as for `DownlinkEncoder.encode`."""
        octets = self.encoder.encode(packets, virtual_channel, clcw)
        if not packets:
            return octets
        frames = len(octets) // self.settings.cadu_length
        lengths = np.array([len(packet) for packet in packets], dtype=np.int64)
        zone = self._zone(clcw is not None)
        stop = np.cumsum(lengths)
        self.dumps.append(
            Dump(octets, virtual_channel, utc_ns, tuple(packets), (stop - lengths) // zone, (stop - 1) // zone, light_s)
        )
        assert int(self.dumps[-1].last[-1]) < frames
        return octets

    def idle(self, clcw: bytes) -> bytes:
        """Return a CADU that carries nothing but the CLCW."""
        return self.encoder.idle(1, clcw)

    def _zone(self, ocf: bool) -> int:
        """Octets of a frame for packets."""
        trailer = (OCF_LENGTH if ocf else 0) + (CRC_LENGTH if self.settings.checksum else 0)
        return self.settings.frame_length - FRAME_HEADER_LENGTH - trailer


@dataclass(frozen=True, slots=True, eq=False)
class Reception:
    """Received octets with their accounting.

    Attributes
    ----------
    octets
        The stream as recorded on the ground.
    account
        What was sent, lost, damaged and repeated; the keys that `linna tm check` has too mean the same.
    """

    octets: bytes
    account: dict[str, Any]


def transmit(dumps: Sequence[Dump], settings: LinkSettings, section: LinkSection, seed: int) -> Reception:
    """Send dumps over the link of a scenario; equal inputs give equal octets."""
    rng = np.random.default_rng((seed, 2**42))
    sent = [np.frombuffer(dump.cadus, dtype=np.uint8).reshape(-1, settings.cadu_length) for dump in dumps]
    counts: dict[str, int] = dict.fromkeys(
        ("frames", "frames_bad", "symbols_corrected", "packets", "frames_lost_on_link", "bit_errors"), 0
    )
    arrived: list[OctetArray] = []
    received: list[bytes] = []
    bursting = False
    for dump, frames in zip(dumps, sent, strict=True):
        bursts, bursting = _bursts(frames.shape[0], section, bursting, rng)
        lost = rng.random(frames.shape[0]) < np.where(bursts, section.burst_frame_loss, section.frame_loss)
        counts["frames_lost_on_link"] += int(lost.sum())
        rate = np.where(bursts, section.burst_bit_error_rate, section.bit_error_rate)
        came, bad, repaired, flipped = _with_errors(frames, lost, rate, settings, rng)
        whole = ~lost
        whole[np.flatnonzero(~lost)[bad]] = False
        counts["bit_errors"] += flipped
        kept = [
            packet
            for packet, first, last in zip(dump.packets, dump.first.tolist(), dump.last.tolist(), strict=True)
            if whole[first : last + 1].all()
        ]
        # What comes twice is the recording of one reception played again, errors and all.
        for _ in range(1 + int(rng.random() < section.repeat_share)):
            arrived.append(came)
            received += kept
            counts["frames"] += came.shape[0]
            counts["frames_bad"] += int(bad.sum())
            counts["symbols_corrected"] += repaired
            counts["packets"] += len(kept)
    arrived = _out_of_order(arrived, section.reorder_share, rng)
    made = {packet for dump in dumps for packet in dump.packets}
    stream = b"".join(block.tobytes() for block in arrived)
    return Reception(
        stream,
        {
            "dumps": len(dumps),
            "frames_sent": sum(block.shape[0] for block in sent),
            **counts,
            "octets": len(stream),
            "packets_made": len(made),
            "packets_received": len(set(received)),
            "packets_lost": len(made) - len(set(received)),
            "duplicates": len(received) - len(set(received)),
        },
    )


def save_receptions(folder: Path, dumps: Sequence[Dump]) -> None:
    """Write when each dump left and came, on which channel and with how many packets, into an archive `folder`."""
    rows = [
        f"{format_utc(dump.utc_ns)},{format_utc(dump.utc_ns + round(dump.light_s * 1e9))},"
        f"{dump.virtual_channel},{len(dump.packets)},{len(dump.cadus)}\n"
        for dump in dumps
    ]
    head = "sent_utc,received_utc,virtual_channel,packets,octets\n"
    (folder / "dumps.csv").write_text(head + "".join(rows))


def save_time_receptions(
    folder: Path, packets: Sequence[bytes], emitted_utc_ns: IntArray, position_icrf_m: FloatArray
) -> None:
    """Write when time reports (n,), emitted at positions (n, 3) from the Moon, came to the Earth's centre."""
    light_s = light_to_earth_s(position_icrf_m, emitted_utc_ns)
    received = emitted_utc_ns + np.rint(light_s * 1e9).astype(np.int64)
    rows = [
        f"{int.from_bytes(packet[14:20], 'big')},{int.from_bytes(packet[2:4], 'big') & 0x3FFF},{format_utc(utc)}\n"
        for packet, utc in zip(packets, received.tolist(), strict=True)
    ]
    (folder / "receptions.csv").write_text("packet_ticks,sequence_count,received_utc\n" + "".join(rows))


def station(name: str, minimum_elevation_deg: float = 10.0) -> GroundStation:
    """A ground station by name.

    Raises
    ------
    ScenarioError
        There is none of that name here.
    """
    if name not in STATIONS:
        raise ScenarioError(f"link.stations: expected names of {', '.join(STATIONS)}, found {name!r}")
    latitude_deg, longitude_deg, height_m = STATIONS[name]
    return GroundStation(
        name, np.radians(latitude_deg), np.radians(longitude_deg), height_m, np.radians(minimum_elevation_deg)
    )


def contacts(ephemeris: Ephemeris, utc_ns: IntArray, section: LinkSection) -> tuple[BoolArray, FloatArray]:
    """Return whether any station receives the spacecraft at emission epochs (n,), and the light time to there in s.

    Without stations it is always received, by the Earth's centre. Contacts begin and end on a grid of a minute.
    """
    if utc_ns.size == 0:
        return np.ones(0, dtype=np.bool_), np.full(0, LIGHT_S)
    if not section.stations:
        return np.ones(utc_ns.size, dtype=np.bool_), light_to_earth_s(ephemeris.at(utc_ns)[0], utc_ns)
    grid = np.arange(utc_ns.min(), utc_ns.max() + 1, _CONTACT_STEP_NS, dtype=np.int64)
    in_contact, light_s = np.zeros(grid.size, dtype=np.bool_), np.full(grid.size, LIGHT_S)
    for name in section.stations:
        # Reception comes later than emission by the light time, within a third of a second of this.
        geometry = link(ephemeris, grid + _LIGHT_NS, station(name, section.minimum_elevation_deg))
        in_contact |= geometry.visible
        light_s = np.where(geometry.visible, geometry.light_time_s, light_s)
    at = (utc_ns - grid[0]) // _CONTACT_STEP_NS
    return in_contact[at], light_s[at]


def light_to_earth_s(position_icrf_m: FloatArray, utc_ns: IntArray) -> FloatArray:
    """Light time (n,) from positions (n, 3) from the Moon to the Earth's centre, s."""
    earth = np.asarray(earth_position_icrf_m(np.asarray(tdb_s_from_utc_ns(utc_ns)))).reshape(-1, 3)
    return np.asarray(np.linalg.norm(position_icrf_m - earth, axis=1) / SPEED_OF_LIGHT_M_S)


def _bursts(frames: int, section: LinkSection, bursting: bool, rng: np.random.Generator) -> tuple[BoolArray, bool]:
    """Return whether each frame falls into a burst, and whether one goes on behind the last."""
    states = np.zeros(frames, dtype=np.bool_)
    for k, draw in enumerate(rng.random(frames).tolist()):
        bursting = draw >= section.burst_end if bursting else draw < section.burst_start
        states[k] = bursting
    return states, bursting


def _with_errors(
    frames: OctetArray, lost: BoolArray, bit_error_rate: FloatArray, settings: LinkSettings, rng: np.random.Generator
) -> tuple[OctetArray, BoolArray, int, int]:
    """(frames that came, which of them cannot be repaired, symbols to repair in the others, wrong bits)."""
    came = frames[~lost].copy()
    bits = 8 * settings.cadu_length
    wrong = rng.binomial(bits, bit_error_rate[~lost])
    bad = np.zeros(came.shape[0], dtype=np.bool_)
    repaired = 0
    code = settings.code
    for row in np.flatnonzero(wrong).tolist():
        places = rng.choice(bits, int(wrong[row]), replace=False)
        np.bitwise_xor.at(came[row], places >> 3, (0x80 >> (places & 7)).astype(np.uint8))
        symbols = np.unique(places >> 3) - cadu.ASM_LENGTH
        symbols = symbols[symbols >= 0]
        if code is None:
            bad[row] = symbols.size > 0
            continue
        by_codeword = np.bincount(symbols % code.interleave, minlength=code.interleave)
        bad[row] = bool(np.any(by_codeword > code.errors))
        # Repairs of the whole codewords of a lost frame count as well.
        repaired += int(by_codeword[by_codeword <= code.errors].sum())
    return came, bad, repaired, int(wrong.sum())


def _out_of_order(blocks: list[OctetArray], share: float, rng: np.random.Generator) -> list[OctetArray]:
    """The blocks, a share of them exchanged with the next one."""
    blocks = list(blocks)
    for k in range(len(blocks) - 1):
        if rng.random() < share:
            blocks[k], blocks[k + 1] = blocks[k + 1], blocks[k]
    return blocks
