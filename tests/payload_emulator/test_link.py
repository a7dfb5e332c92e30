"""The radio link: what it says of itself is what the ground finds, to the octet."""

from dataclasses import replace

import numpy as np
from numpy import cos, cross, pi, sin
from numpy.linalg import norm
from pytest import approx, mark, raises

from lunar.ephemeris import ephemeris_from_states
from lunar.third_bodies import earth_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import LinkSection
from payload_emulator.sim.board.link import Receiver, Transmitter, contacts, station, transmit
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import LinkSettings, decode
from tmtc.link.frames import Clcw, pack_clcw, unpack_clcw
from tmtc.link.uplink import UplinkEncoder

EPOCH = parse_utc("2029-08-08T00:00:00Z")


def packets(count, start, rng):
    made = []
    for k in range(start, start + count):
        items = {"octet": rng.integers(0, 256, int(rng.integers(0, 900))).tolist()}
        values = {"transaction": 1, "part": 1, "table": 6, "items": items}
        made.append(DICTIONARY.pack("large_data_middle", values, ticks=65_536 * k, sequence_count=k % 16_384))
    return made


def transmitter(coding="rs", dumps=8, each=30):
    """Dumps of packets, every third in frames without an operational control field."""
    rng = np.random.default_rng(3)
    sender = Transmitter(76, LinkSettings(coding=coding))
    for k in range(dumps):
        clcw = None if k % 3 == 2 else pack_clcw(Clcw(0, k))
        sender.send(packets(each, k * each, rng), EPOCH + k, virtual_channel=k % 2, clcw=clcw)
    return sender


def test_a_perfect_link_loses_and_adds_nothing():
    sender = transmitter()
    reception = transmit(sender.dumps, sender.settings, LinkSection(), seed=1)
    assert reception.octets == b"".join(dump.cadus for dump in sender.dumps)
    account = reception.account
    assert (account["packets_lost"], account["duplicates"], account["frames_bad"]) == (0, 0, 0)
    assert decode(reception.octets).packets == account["packets"] == 240


def test_where_each_packet_lies_in_the_frames_is_right():
    sender = transmitter(dumps=1, each=60)
    dump = sender.dumps[0]
    length = sender.settings.cadu_length
    for lost in range(len(dump.cadus) // length):
        octets = dump.cadus[: lost * length] + dump.cadus[(lost + 1) * length :]
        whole = {
            packet
            for packet, first, last in zip(dump.packets, dump.first, dump.last, strict=True)
            if not first <= lost <= last
        }
        decoded = decode(octets, settings=sender.settings)
        got = {bytes(packet) for packet in decoded.cut.packets(decoded.buffer)}
        # The last frame is filled up with an idle packet.
        assert {packet for packet in got if packet[:2] != b"\x07\xff"} == whole, lost


LINKS = {
    "losses": LinkSection(frame_loss=0.1),
    "bit errors": LinkSection(bit_error_rate=1e-4),
    "bursts": LinkSection(burst_start=0.05, burst_end=0.5, burst_frame_loss=0.3, burst_bit_error_rate=6e-3),
    "copies": LinkSection(repeat_share=0.5),
    "disorder": LinkSection(reorder_share=0.5),
    "everything": LinkSection(
        frame_loss=0.02, bit_error_rate=1e-5, burst_start=0.02, burst_end=0.3, burst_frame_loss=0.3,
        burst_bit_error_rate=5e-3, repeat_share=0.3, reorder_share=0.3,
    ),
}  # fmt: skip


@mark.parametrize("name", sorted(LINKS))
@mark.parametrize("coding", ["rs", "none"])
def test_the_account_of_the_link_is_the_account_of_the_ground(name, coding):
    sender = transmitter(coding)
    section = replace(LINKS[name], coding=coding)
    reception = transmit(sender.dumps, sender.settings, section, 1)
    found = decode(reception.octets, settings=sender.settings).accounting()
    account = reception.account
    for key in ("frames", "frames_bad", "packets", "duplicates"):
        assert found[key] == account[key], key
    assert found["packets"] - found["duplicates"] == account["packets_received"]
    assert account["packets_received"] + account["packets_lost"] == account["packets_made"] == 240
    assert sum(found["octets"].values()) == account["octets"] == len(reception.octets)
    assert (found["crc_errors"], found["conflicts"], found["unknown"]) == (0, 0, 0)
    if coding == "rs" and account["frames_bad"] == 0:
        assert found["symbols_corrected"] == account["symbols_corrected"]
    assert transmit(sender.dumps, sender.settings, section, 1).octets == reception.octets


def test_errors_come_in_bursts_of_the_length_that_is_asked_for():
    sender = transmitter(dumps=16)
    section = LinkSection(burst_start=0.05, burst_end=0.25, burst_frame_loss=1.0)
    lost = frames = 0
    for seed in range(40):
        account = transmit(sender.dumps, sender.settings, section, seed).account
        lost += account["frames_lost_on_link"]
        frames += account["frames_sent"]
    # Share of time in the bad state of a two-state chain: 0.05 / (0.05 + 0.25); 3 sigma of so many correlated frames.
    assert lost / frames == approx(1 / 6, abs=0.03)


def test_the_receiver_reports_what_it_accepted_and_whether_it_hears_anybody():
    receiver = Receiver(76)
    ping = DICTIONARY.pack_command("test_connection", {}, sequence_count=1)

    def state():
        return unpack_clcw(receiver.clcw)

    assert state() == Clcw(0, 0)
    assert receiver.take(ping * 3) == ping * 3
    assert state() == Clcw(0, 0, farm_b_counter=3)
    # A sequence-controlled frame that does not follow is not accepted, and one far off locks the receiver.
    assert receiver.decoder.decode(UplinkEncoder(76, bypass=False, sequence_number=1).encode([ping])).packets == ()
    assert state().retransmit
    receiver.decoder.decode(UplinkEncoder(76, bypass=False, sequence_number=99).encode([ping]))
    assert state().lockout
    receiver.bit_lock = False
    assert state().no_bit_lock and not state().no_rf_available
    receiver.carrier = False
    assert state() == replace(state(), no_rf_available=True, no_bit_lock=True, farm_b_counter=3)


def circling(hours=4.0):
    """A circular polar orbit at 30 km whose plane holds the Earth at the epoch, in closed form."""
    times = EPOCH + np.arange(-300, int(3600 * hours) + 300, 10) * 10**9
    toward = np.asarray(earth_position_icrf_m(float(tdb_s_from_utc_ns(EPOCH))))
    u = toward / norm(toward)
    w = cross(u, cross([0.0, 0.0, 1.0], u))
    w /= norm(w)
    rate = np.sqrt(4.9028e12 / 1.7674e6**3)
    angle = rate * (times - EPOCH)[:, None] / 1e9
    position = 1.7674e6 * (cos(angle) * u + sin(angle) * w)
    return ephemeris_from_states(times, position, 1.7674e6 * rate * (cos(angle) * w - sin(angle) * u))


def test_contacts_end_behind_the_limb_of_the_moon_once_an_orbit():
    ephemeris = circling()
    times = EPOCH + np.arange(0, 4 * 3600, 20) * 10**9
    every = LinkSection(stations=("goldstone", "madrid", "canberra"), minimum_elevation_deg=5.0)
    in_contact, light_s = contacts(ephemeris, times, every)
    # The plane holds the Earth: hidden for the angle 180 deg - 2 acos(R / r), R / r = 1737.4 / 1767.4, of each orbit.
    hidden = (pi - 2.0 * np.arccos(1737.4 / 1767.4)) / (2.0 * pi)
    assert 1.0 - in_contact.mean() == approx(hidden, abs=0.04)
    assert np.all((light_s > 1.1) & (light_s < 1.4))
    always, way_s = contacts(ephemeris, times, LinkSection())
    assert always.all()
    # To the Earth's centre it is farther than to a station that sees the Moon, by an Earth's radius at most.
    assert np.all((way_s[in_contact] > light_s[in_contact] - 1e-3) & (way_s[in_contact] < light_s[in_contact] + 0.0213))
    one, _ = contacts(ephemeris, times, LinkSection(stations=("madrid",)))
    assert one.sum() < in_contact.sum()


def test_a_station_that_there_is_not_is_named():
    with raises(ScenarioError, match=r"expected names of goldstone, .* found 'atlantis'"):
        station("atlantis")
