"""Packets that a mission description defines: received, decoded, read as series, exported, decoded again."""

import base64
import gzip
import hashlib
import json
import math
import shutil
import struct
import warnings
from itertools import pairwise
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
from pytest import approx, fixture, mark, raises

from ground_service.errors import EvaluationError, InvalidInput, NotFound
from ground_service.http.model import Paging
from ground_service.ingest.doubt_store import list_implausible
from ground_service.ingest.model import ImplausibleFilter
from ground_service.ingest.service import PiecePosition, decode_all_again, ingest_file, undecoded_vehicles
from ground_service.missions import definitions
from ground_service.missions import store as missions
from ground_service.missions.definitions import definition_remarks, minimal_description, read_mission_file
from ground_service.missions.model import XTCE_COMPRESSED, Mission, PacketTime, read_document
from ground_service.missions.service import add_mission, check_mission_file
from ground_service.missions.store import packets_in_force
from ground_service.passes import series
from ground_service.passes.alarms.model import AlarmFilter
from ground_service.passes.alarms.service import list_alarms
from ground_service.passes.archive_import import import_archive
from ground_service.passes.live import live_parameters
from ground_service.passes.parameters import export_packets, pass_parameters
from ground_service.passes.service import completeness, define_pass, get_pass, parameter_series, trend_series
from ground_service.store import repository
from ground_service.telemetry import decoding
from ground_service.telemetry.values import newest_declared_ticks, readable_decoding
from ground_service.toml import read_table
from ground_service.worker import follow_up
from ground_service.worker.integrity import verify
from lunar.timescales import parse_utc, ticks_from_utc_ns, utc_ns_from_ticks
from tests.tmtc import foreign
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.pus import NO_TICKS
from tmtc.packets.space_packets import crc16, pack_packet
from tmtc.packets.stream import whole_packets

NS = 1_000_000_000
START = parse_utc("2029-08-07T00:00:00Z")
EPOCH_DAY = parse_utc("1958-01-01T00:00:00Z") // (86_400 * NS)
CDS = (
    '{ code = "cds", offset = 6, p_field = false, whole_octets = 2, fraction_octets = 2, '
    'epoch = "1958-01-01T00:00:00Z", clock = "own" }'
)
DEFINED = f"[[packets]]\nname = 'bus'\napids = [100, 101]\npacket_checksum = 'none'\nxtce = ['bus.xml']\ntime = {CDS}\n"
MISSION = "name = 'test'\nspacecraft = { id = 76 }\n"


def mission(folder, text=DEFINED, document=foreign.BUS):
    folder.mkdir(exist_ok=True)
    (folder / "bus.xml").write_text(document)
    (folder / "mission.toml").write_text(MISSION + text)
    return folder / "mission.toml"


def enter(ground, text=DEFINED, document=foreign.BUS):
    add_mission(ground, read_mission_file(mission(ground.home / "m", text, document)))


RENAMED = foreign.BUS.replace('"VOLTAGE"', '"BATTERY"')


@fixture
def declared(ground):
    enter(ground)
    return ground


def at(packet, second):
    """The packet with this time, in seconds after `START`, in its CDS header."""
    day, rest = divmod(START + round(second * 1e9), 86_400 * NS)
    time = struct.pack(">HIH", day - EPOCH_DAY, rest // 1_000_000, rest // 1000 % 1000)
    return packet[:6] + time + packet[14:]


def bus_packets(count, seed=1):
    """Housekeeping every second and an event every fourth second."""
    rng = np.random.default_rng(seed)
    packets = []
    for k in range(count):
        packets.append(at(foreign.housekeeping(rng, k), k))
        if k % 4 == 0:
            packets.append(at(foreign.event(rng, k // 4), k + 0.5))
    return packets


def longer(packet):
    """The packet with a length that includes a checksum of two octets."""
    return packet[:4] + (int.from_bytes(packet[4:6], "big") + 2).to_bytes(2, "big") + packet[6:]


def take(ground, packets):
    path = ground.home / "bus.cadu"
    path.write_bytes(encode_cadus(packets, spacecraft_id=76))
    return ingest_file(ground, path)


def define(ground, seconds=600.0):
    return define_pass(ground, name="p", start_utc_ns=START, stop_utc_ns=START + round(seconds * 1e9), spacecraft_id=76)


def interpreted(packets, tmp_path):
    """Return the values that space_packet_parser reads in the packets."""
    import space_packet_parser

    path = tmp_path / "interpreter.xml"
    path.write_text(foreign.BUS)
    definition = space_packet_parser.load_xtce(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [definition.parse_bytes(packet) for packet in packets]


def test_packets_without_a_checksum_between_others_become_series(either, tmp_path, synthetic_pass):
    enter(either)
    own, bus = synthetic_pass.packets, bus_packets(300)
    mixed = [packet for pair in zip(own, bus, strict=False) for packet in pair]
    mixed += own[len(bus) :] + bus[len(own) :]
    result = take(either, mixed)
    assert (result.packets, result.packets_new) == (len(mixed), len(mixed))
    assert (result.crc_errors, result.octets_skipped, result.unknown) == (0, 0, 0)
    newest = {one.name: one for one in live_parameters(either, 76, "flight")}  # without a pass
    found = parameter_series(either, define(either), "VOLTAGE", 1000)
    housekeeping = [packet for packet in bus if packet[1] == foreign.APID_HOUSEKEEPING]
    expected = [packet["VOLTAGE"] for packet in interpreted(housekeeping, tmp_path)]
    assert found.unit == "V"
    assert found.buckets.mean.tolist() == expected
    voltage = newest["VOLTAGE"]
    assert (voltage.packet, voltage.value, voltage.unit) == ("Housekeeping", expected[-1], "V")
    assert voltage.time.utc_ns == approx(START + 299 * NS, abs=15_259)
    assert "temperature_c" in newest
    assert found.buckets.start_utc_ns.tolist() == approx([START + k * NS for k in range(300)], abs=15_259)
    assert parameter_series(either, 1, "MODE", 1000).samples == 300  # codes
    listed = pass_parameters(either, 1)
    assert {one.packet: one.packets for one in listed.packets} == {
        "Bare": 0,
        "Dump": 0,
        "Event": sum(p[14] < 200 for p in bus if p[1] == foreign.APID_EVENT),
        "Housekeeping": 300,
        "UrgentEvent": sum(p[14] >= 200 for p in bus if p[1] == foreign.APID_EVENT),
    }
    assert listed.outcomes == {"100": {"decoded": 300}, "101": {"decoded": 75}}
    whole = define_pass(either, name="whole", start_utc_ns=0, stop_utc_ns=1 << 62, spacecraft_id=76)
    assert completeness(either, whole).crc_errors == 0


def test_a_minimal_description_of_a_definition_decodes_its_packets(ground, tmp_path):
    add_mission(ground, written(tmp_path, foreign.BUS).encode())
    result = take(ground, bus_packets(8))
    assert ground.read(readable_decoding, result.vehicle_id).counts["100"] == {"decoded": 8}
    bare = foreign.document(foreign.integer("u8", 8), {"a": "u8"}, foreign.container("P", ["a"]))
    with raises(InvalidInput, match="compares its APID with a number, found none"):
        written(tmp_path, bare)


def written(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "bus.xml").write_text(text)
    return minimal_description(folder / "bus.xml", 76)


def test_a_minimal_description_is_one_that_the_check_accepts(tmp_path):
    bus = foreign.document(
        foreign.HEADER_TYPES,
        foreign.HEADER_PARAMETERS,
        foreign.HEADER_CONTAINER
        + foreign.container("A", [], "CCSDSPacket", foreign._either(("PKT_APID", "==", 7), ("PKT_APID", "==", 2047))),
    )
    found, faults = check_mission_file(saved(tmp_path, written(tmp_path / "a", bus)))
    assert not faults and found is not None and found.packets is not None and found.packets[0].apids == (7,)
    with raises(InvalidInput, match=r"XTCE that is supported, found bus\.xml, line 1.*UnitsSet"):
        written(tmp_path / "b", foreign.BUS.replace("UnitSet", "UnitsSet"))
    same = bus.replace('name="CCSDSPacket" abstract="true"', 'name="CCSDSPacket"')
    assert '"apids" = [7]' in written(tmp_path / "c", same)
    own = bus.replace("<Value>7<", "<Value>160<")
    assert "160" in str(check_mission_file(saved(tmp_path, written(tmp_path / "d", own)))[1])


def saved(folder, text):
    (folder / "mission.toml").write_text(text)
    return folder / "mission.toml"


UNIX = (
    '{ code = "cuc", offset = 6, p_field = false, whole_octets = 4, fraction_octets = 2, '
    'epoch = "EPOCH", clock = "unix" }'
)


@mark.parametrize("epoch", ["1970-01-01T00:00:00Z", "1980-01-01T00:00:00Z", "2000-01-01T00:00:00Z"])
def test_a_unix_clock_counts_no_leap_seconds(epoch):
    time = PacketTime.model_validate(read_table(f"t = {UNIX.replace('EPOCH', epoch)}", "t", "TOML")["t"])
    count = (START - parse_utc(epoch)) // NS
    packet = foreign.space_packet(100, struct.pack(">IH", count, 1 << 15), 0)
    bare = foreign.space_packet(100, struct.pack(">IH", count, 1 << 15), 0, secondary=False)
    ticks = decoding.packet_times(packet + bare, whole_packets(np.array([len(packet), len(bare)])), time)
    assert utc_ns_from_ticks(ticks[:1]).tolist() == [START + NS // 2]
    assert ticks[1] == NO_TICKS  # its header says that it has no time
    with raises(ValueError, match="an epoch in UTC for a CDS code or a Unix clock"):
        PacketTime.model_validate({**time.model_dump(), "epoch": "1970-01-01T00:00:00 TAI"})


def test_parts_of_segmented_packets_are_counted_and_packets_without_header_have_no_time(declared):
    """The definition asks for the secondary header flag, but not for the sequence flags."""
    packets = bus_packets(8)
    parts = [packets[3][:2] + struct.pack(">H", flags << 14 | 50 + flags) + packets[3][4:] for flags in (1, 0, 2)]
    boot = bytes((packets[2][0] & ~0x08, *packets[2][1:]))
    take(declared, [*packets, *parts, boot])
    listed = pass_parameters(declared, define(declared))
    assert listed.outcomes["100"] == {"decoded": 8, "segments_not_joined": 3, "no_container": 1}
    assert parameter_series(declared, 1, "VOLTAGE", 100).samples == 8


def test_an_entry_may_name_several_containers_and_the_unit_of_sizes(tmp_path):
    text = DEFINED.replace("time = ", "container = ['CCSDSPacket', 'TIMED']\nleading_size = 'octets'\ntime = ")
    found, faults = check_mission_file(mission(tmp_path, text))
    assert not faults and found is not None
    assert definition_remarks(found) == ["packets bus: sizes before texts count octets"]
    assert "expected the name of a container" in check_mission_file(mission(tmp_path, text.replace("TIMED", "X")))[1][0]


def test_the_parameters_are_listed_with_names_of_codes_units_and_limits(ground):
    limits = (
        "<DefaultAlarm><StaticAlarmRanges><WarningRange minInclusive='-1' maxInclusive='1000.5'/>"
        "<CriticalRange maxExclusive='1020'/></StaticAlarmRanges></DefaultAlarm>"
    )
    kind = '<FloatParameterType name="VOLT"><UnitSet><Unit>V</Unit></UnitSet>'
    assert kind in foreign.BUS
    end = foreign.BUS.index("</FloatParameterType>", foreign.BUS.index(kind))
    text = foreign.BUS[:end] + limits + foreign.BUS[end:]
    enter(ground, document=text)
    take(ground, bus_packets(4))
    newest = next(one for one in live_parameters(ground, 76, "flight") if one.name == "VOLTAGE")
    assert newest.limits == "-1 to 1000.5" and newest.value is not None
    broken = "alarm" if newest.value > 1020.0 else "warning" if newest.value > 1000.5 else "within"
    assert newest.limit_state == broken
    listed = {one.name: one for one in pass_parameters(ground, define(ground)).parameters}
    assert (listed["VOLTAGE"].warning, listed["VOLTAGE"].alarm) == ((-1.0, 1000.5), (None, math.nextafter(1020.0, 0.0)))
    assert listed["MODE"].labels == {"0": "SAFE", "1": "NOMINAL", "7": "DETUMBLE"}
    assert listed["ENABLED"].labels == {"0": "false", "1": "true"}
    assert listed["Housekeeping.DAY"].packet == "Housekeeping"  # several containers have this one
    assert listed["temperature_c"].source == "dictionary"
    assert "TEXT" not in listed


def test_a_series_has_least_greatest_and_mean_value_from_samples_and_from_rollups(either, tmp_path, monkeypatch):
    enter(either)
    bus = bus_packets(2000)
    for piece in (bus[:900], bus[900:]):
        take(either, piece)
    pass_id = define(either, 3000.0)
    exact = parameter_series(either, pass_id, "RATE", 10)
    housekeeping = [packet for packet in bus if packet[1] == foreign.APID_HOUSEKEEPING]
    values = np.array([packet["RATE"] for packet in interpreted(housekeeping, tmp_path)])
    assert exact.buckets.low.min() == values.min()
    assert exact.buckets.high.max() == values.max()
    assert np.average(exact.buckets.mean, weights=exact.buckets.count) == approx(values.mean())
    monkeypatch.setattr(series, "FEW_ROWS", 10)
    for coarse in (10**9, 0):  # from roll-ups, from samples
        monkeypatch.setattr(series, "COARSE", coarse)
        rolled = parameter_series(either, pass_id, "RATE", 11).buckets
        assert int(rolled.count.sum()) == 2000
        assert (rolled.low.min(), rolled.high.max()) == (values.min(), values.max())
        assert np.average(rolled.mean, weights=rolled.count) == approx(values.mean())
    assert trend_series(either, 76, "flight", "RATE", 11).samples == 2000


def test_a_later_definition_decodes_what_is_stored_and_packets_without_one_are_kept_as_unknown(either, monkeypatch):
    monkeypatch.setattr(decoding, "BLOCK_PACKETS", 50)
    monkeypatch.setitem(cast(dict[str, Any], follow_up.DOING), "decode", lambda *_given: None)  # no job decodes
    declared = "[[packets]]\nname = 'bus'\napids = [100, 101]\npacket_checksum = 'none'\n"
    enter(either, declared)
    result = take(either, bus_packets(100))
    assert (result.packets_new, result.unknown, result.octets_skipped) == (125, 125, 0)
    pass_id = define(either)
    with raises(NotFound):
        parameter_series(either, pass_id, "VOLTAGE", 100)
    enter(either)
    assert decoding.decode_declared(either, result.vehicle_id) == 125
    assert parameter_series(either, pass_id, "VOLTAGE", 100).samples == 100
    enter(either, document=RENAMED)
    with monkeypatch.context() as patch, raises(KeyboardInterrupt):
        whole = Mock(side_effect=[decoding._next_block, KeyboardInterrupt])
        patch.setattr(decoding, "_next_block", lambda *given: whole()(*given))
        decoding.decode_declared(either, result.vehicle_id)
    assert parameter_series(either, pass_id, "VOLTAGE", 100).samples == 100  # still as the earlier one decoded it
    assert decoding.decode_declared(either, result.vehicle_id) == 75
    assert parameter_series(either, pass_id, "BATTERY", 100).samples == 100
    with raises(NotFound):
        parameter_series(either, pass_id, "VOLTAGE", 100)
    assert decoding.decode_declared(either, result.vehicle_id) == 0
    assert either.read(repository.newest, SAMPLES, Paging())[1] == 125
    progress = either.read(readable_decoding, result.vehicle_id)
    assert progress.counts == {"100": {"decoded": 100}, "101": {"decoded": 25}}


def test_a_revision_reads_raw_files_again_whose_packets_were_taken_for_damaged(either, synthetic_pass):
    own, bus = synthetic_pass.packets, bus_packets(100)
    mixed = [packet for pair in zip(own, bus, strict=False) for packet in pair]
    result = take(either, mixed)
    assert result.packets_new <= len(own) and result.crc_errors + result.octets_skipped > 0
    enter(either)  # the event of the revision has the job run
    assert parameter_series(either, define(either), "VOLTAGE", 1000).samples == 100
    assert undecoded_vehicles(either, 76) == []
    assert [job["state"] for job in redecodings(either)] == ["done"]
    enter(either, DEFINED + "[evidence]\nseed = 1\n")  # the same packets
    assert len(redecodings(either)) == 1


def redecodings(ground):
    return ground.read(repository.newest, repository.JOBS, Paging(), kind="redecode")[0]


def test_the_integrity_check_finds_packets_without_a_checksum_intact(declared):
    take(declared, bus_packets(30))
    found = verify(declared, rebuild=True)
    assert (found.verdict, found.damaged, found.unchecked) == ("intact", [], {})
    assert found.checked["packets"] == found.checked["parameter_samples"] == 38


SAMPLES = repository.PARAMETER_SAMPLES


@mark.parametrize(
    "changes, reason",
    [
        ({"values": bytes(8)}, "values of its packet"),
        ({"container": 77}, "raw data do not give"),
        ({"ticks": SAMPLES.c.ticks + 1}, "raw data do not give"),
        ({"packet_id": 999}, "raw data do not give"),
        ({"definition_id": 5}, "raw data do not give"),
        ({"vehicle_id": 9}, "raw data do not give"),
        (None, "expected this row"),
    ],
)
def test_the_integrity_check_finds_a_damaged_sample(either, changes, reason):
    enter(either)
    take(either, bus_packets(8))
    with either.database.writing() as connection:
        (row, *_) = connection.execute(SAMPLES.select().order_by(SAMPLES.c.ticks)).mappings()
        here = (SAMPLES.c.ticks == row["ticks"]) & (SAMPLES.c.packet_id == row["packet_id"])
        change = SAMPLES.delete() if changes is None else SAMPLES.update().values(changes)
        assert connection.execute(change.where(here)).rowcount == 1
    found = [one for one in verify(either, rebuild=True).damaged if one.kind == "parameter_samples"]
    assert reason in " ".join(one.reason for one in found)


def test_the_integrity_check_does_not_expect_samples_of_packets_that_are_not_yet_decoded(either, monkeypatch):
    monkeypatch.setitem(cast(dict[str, Any], follow_up.DOING), "decode", lambda *_given: None)
    enter(either)
    result = take(either, bus_packets(10))
    enter(either, document=RENAMED)
    found = verify(either, rebuild=True)
    assert found.damaged == []
    rest = "rows of parameter_samples not yet decoded"
    assert (
        found.unchecked["rows of parameter_samples decoded with an earlier mission description"]
        == found.unchecked[rest]
        == 13
    )
    monkeypatch.setattr(decoding, "BLOCK_PACKETS", 5)
    assert either.write(decoding._next_block, result.vehicle_id) == 5
    found = verify(either, rebuild=True)
    assert (found.damaged, found.unchecked[rest]) == ([], 8)
    decoding.decode_declared(either, result.vehicle_id)
    found = verify(either, rebuild=True)
    assert (found.damaged, found.unchecked, found.checked["parameter_samples"]) == ([], {}, 13)


def archived(made, folder, packets, text=DEFINED):
    """The synthetic archive with other packets in its downlink, and a mission description that declares them."""
    archive = shutil.copytree(made.folder, folder / "archive")
    written = {
        "downlink.cadu": encode_cadus(packets, spacecraft_id=76),
        "mission.toml": read_mission_file(mission(folder / "described", text)),
    }
    manifest = json.loads((archive / "manifest.json").read_text())
    for name, octets in written.items():
        (archive / name).write_bytes(octets)
        manifest["files"][name] = {"sha256": hashlib.sha256(octets).hexdigest(), "bytes": len(octets)}
    (archive / "manifest.json").write_text(json.dumps(manifest))
    return archive


def test_an_archive_is_decoded_with_the_packets_that_it_declares_and_the_live_spacecraft_is_not(
    either, tmp_path, synthetic_pass
):
    bus = bus_packets(40)
    folder = archived(synthetic_pass, tmp_path, [*synthetic_pass.packets, *bus])
    live = define(either)
    take(either, synthetic_pass.packets)
    pass_id = import_archive(either, folder)
    instance = get_pass(either, pass_id).instance
    found = trend_series(either, 76, instance, "VOLTAGE", 1000)
    expected = [packet["VOLTAGE"] for packet in interpreted(bus[:1], tmp_path)]
    assert found.samples == 40 and found.buckets.mean.tolist()[:1] == expected
    assert pass_parameters(either, pass_id).outcomes == {"100": {"decoded": 40}, "101": {"decoded": 10}}
    assert {one.packets for one in pass_parameters(either, pass_id).packets} == {0}  # their times are not in the pass
    with raises(EvaluationError, match="expected packets 'Housekeeping', found none"):
        export_packets(either, pass_id, "Housekeeping", "json")
    assert pass_parameters(either, live).packets == ()
    assert either.read(packets_in_force, 76, "flight") is None
    # a description that a person adds holds for the spacecraft, and not for the archive
    enter(either, document=RENAMED)
    take(either, bus)
    assert trend_series(either, 76, "flight", "BATTERY", 1000).samples == 40
    assert trend_series(either, 76, instance, "VOLTAGE", 1000).samples == 40
    with raises(NotFound):
        trend_series(either, 76, instance, "BATTERY", 1000)
    assert undecoded_vehicles(either, 76) == []
    checked = verify(either, rebuild=True)
    assert (checked.damaged, checked.unchecked) == ([], {})


def test_an_archive_that_was_imported_before_is_decoded_with_its_packets_on_redecoding(
    either, tmp_path, synthetic_pass, monkeypatch
):
    checked = DEFINED.replace("'none'", "'crc16'")
    packets = [packet + crc16(packet).to_bytes(2, "big") for packet in map(longer, bus_packets(20))]
    folder = archived(synthetic_pass, tmp_path, packets, checked)
    with monkeypatch.context() as patched:  # as it was when the packets of archives were not decoded
        patched.setattr(missions, "packets_in_force", lambda *_given: None)
        pass_id = import_archive(either, folder)
    instance = get_pass(either, pass_id).instance
    with raises(NotFound):
        trend_series(either, 76, instance, "VOLTAGE", 1000)
    assert len(undecoded_vehicles(either, 76)) == 1
    assert decode_all_again(either) >= 25
    assert trend_series(either, 76, instance, "VOLTAGE", 1000).samples == 20
    assert undecoded_vehicles(either, 76) == []


def test_an_archive_that_declares_no_packets_is_decoded_with_the_description_of_the_spacecraft(
    either, tmp_path, synthetic_pass
):
    enter(either)
    pass_id = import_archive(either, archived(synthetic_pass, tmp_path, bus_packets(20), ""))
    instance = get_pass(either, pass_id).instance
    assert trend_series(either, 76, instance, "VOLTAGE", 1000).samples == 20


def test_pieces_cut_at_any_octet_in_any_order_give_every_packet(declared, tmp_path):
    octets = encode_cadus(bus_packets(120), spacecraft_id=76)
    rng = np.random.default_rng(5)
    cuts = [0, *sorted(rng.choice(len(octets), 11, replace=False).tolist()), len(octets)]
    pieces = list(pairwise(cuts))
    for index in rng.permutation(len(pieces)).tolist():
        start, stop = pieces[index]
        path = tmp_path / f"{index}.piece"
        path.write_bytes(octets[start:stop])
        ingest_file(declared, path, spacecraft_id=76, place=PiecePosition("s", start))
    assert parameter_series(declared, define(declared), "VOLTAGE", 1000).samples == 120


@mark.parametrize("window", [0, 5_000, 1 << 20])
def test_packets_that_nothing_declares_are_kept_between_declared_ones(declared, tmp_path, window, monkeypatch):
    """In frames, and as a bare stream in windows and at once."""
    packets = bus_packets(274)
    for k in range(49):
        packets.insert(8 * k + 3, pack_packet(300, bytes(40), sequence_count=k))
    path = tmp_path / "bus"
    path.write_bytes(b"".join(packets) if window else encode_cadus(packets, spacecraft_id=76))
    if window:
        monkeypatch.setattr("ground_service.ingest.reception.WINDOW_OCTETS", window)
    result = ingest_file(declared, path, spacecraft_id=76)
    assert (result.packets_new, result.crc_errors, result.octets_skipped) == (len(packets), 0, 0)
    assert result.unknown == 49
    assert parameter_series(declared, define(declared), "VOLTAGE", 1000).samples == 274


def test_decoded_packets_of_a_pass_are_exported_with_utc(declared, synthetic_pass):
    packets = [*synthetic_pass.packets]
    (event,) = (one for one in map(DICTIONARY.unpack_packet, packets) if one.name == "event_info")
    packets.append(DICTIONARY.pack("event_low", event.values, ticks=event.ticks, sequence_count=1))
    take(declared, [*packets, *bus_packets(20)])
    pass_id = define(declared, 86_400.0)
    records = json.loads(export_packets(declared, pass_id, "Housekeeping", "json"))
    assert [one["utc"][:23] for one in records] == [f"2029-08-07T00:00:{k:02d}.000" for k in range(20)]
    assert {one["MODE"] for one in records} <= {"SAFE", "NOMINAL", "DETUMBLE"}
    lines = export_packets(declared, pass_id, "Event", "csv").decode().splitlines()
    assert lines[0].startswith("utc,packet,VERSION")
    own = json.loads(export_packets(declared, pass_id, "event_low", "json"))
    assert {one["packet"] for one in own} == {"event_low"}
    with raises(NotFound, match="packet"):
        export_packets(declared, pass_id, "nothing", "csv")
    with raises(EvaluationError, match="pass 1: expected packets 'store_report', found none"):
        export_packets(declared, pass_id, "store_report", "csv")
    assert export_packets(declared, pass_id, "Housekeeping", "parquet")[:4] == b"PAR1"


def test_the_http_interface_gives_parameters_series_and_packets(client):
    ground = client.app.state.ground
    enter(ground)
    take(ground, bus_packets(20))
    url = f"/api/v1/passes/{define(ground)}"
    listed = client.get(f"{url}/parameters").json()
    assert "VOLTAGE" in {one["name"] for one in listed["parameters"]}
    found = client.get(f"{url}/telemetry/VOLTAGE").json()
    assert (found["samples"], found["unit"]) == (20, "V")
    answer = client.get(f"{url}/packets/Housekeeping?format=csv")
    assert answer.headers["content-type"].startswith("text/csv")
    assert len(answer.text.splitlines()) == 21
    assert client.get(f"{url}/packets/none").status_code == 404


FAULTS = """\
[100, 101] | [100, 2047] | packets.0.apids.1: expected less than or equal to 2046
'none' | 'maybe' | packets.0.packet_checksum: expected 'crc16' or 'none'
whole_octets = 2 | whole_octets = 4 | packets.0.time: expected 2 or 3 octets of days
1958-01-01T00:00:00Z | long ago | packets.0.time: expected an epoch such as
clock | clok | packets.0.time.clok: expected 'clock', found unknown key 'clok'
'bus' | 'two' | each APID in one entry of packets, found 100
[100, 101] | [160] | APIDs that the packet dictionary does not use, found 160"""


@mark.parametrize("row", FAULTS.splitlines())
def test_each_fault_of_a_declaration_is_one_line(tmp_path, row):
    old, new, message = row.split(" | ")
    text = DEFINED * (new == "'two'") + DEFINED.replace(old, new)
    found, [fault] = check_mission_file(mission(tmp_path, text))
    assert found is None and message in fault and "\n" not in fault


def test_each_faulty_document_is_one_line(tmp_path):
    two = DEFINED + DEFINED.replace("'bus'", "'two'").replace("[100, 101]", "[102]")
    path = mission(tmp_path, two, foreign.BUS.replace("UnitSet", "UnitsSet"))
    found, faults = check_mission_file(path)
    assert found is None
    assert [fault.split(": ")[0].split(", ")[-1] for fault in faults] == ["packets.0.xtce", "packets.1.xtce"]
    assert "line 1" in faults[0] and "UnitsSet" in faults[0]
    (tmp_path / "bus.xml").unlink()
    with raises(InvalidInput, match=r"packets.0.xtce: expected the file .*bus\.xml"):
        check_mission_file(path)
    assert "expected texts of XTCE documents" in str(read_document(path.read_text(), "m.toml")[0])


def test_documents_have_one_limit_for_their_sum(monkeypatch):
    monkeypatch.setattr(definitions, "DOCUMENTS_LIMIT_OCTETS", 1000)
    packed = XTCE_COMPRESSED + base64.b64encode(gzip.compress(b"<x>" + b" " * 600)).decode()
    source = {"name": "a", "apids": [5], "packet_checksum": "none", "xtce": [packed]}
    mission = Mission.model_validate({"name": "m", "packets": [source, {**source, "name": "b", "apids": [6]}]})
    faults = [str(one) for one in definitions.definition_faults(mission, "m")]
    assert "of documents in all, found more" in faults[-1] and "in all" not in faults[0]


def test_a_long_document_is_embedded_compressed(ground, tmp_path):
    padded = foreign.BUS.replace("<TelemetryMetaData>", "<TelemetryMetaData><!--" + "x" * 2_000_000 + "-->")
    path = mission(tmp_path, DEFINED, padded)
    octets = read_mission_file(path)
    assert b"gzip:" in octets and len(octets) < 100_000
    assert add_mission(ground, octets).id == add_mission(ground, read_mission_file(path)).id
    take(ground, bus_packets(5))
    assert parameter_series(ground, define(ground), "VOLTAGE", 100).samples == 5


def test_a_declared_packet_from_the_future_is_kept_apart_until_others_agree(declared):
    rng = np.random.default_rng(7)
    take(declared, bus_packets(40))
    pass_id = define(declared)
    late = [at(foreign.housekeeping(rng, 40 + k), 3 * 86_400.0 + k) for k in range(12)]
    for packets in ([at(foreign.housekeeping(rng, 99), 70 * 365 * 86_400.0)], late[:1]):
        take(declared, packets)
    [one, other] = declared.read(list_implausible, ImplausibleFilter(limit=9)).items
    assert (one.apid, other.apid) == (100, 100) and "after all other telemetry" in one.reason
    assert parameter_series(declared, pass_id, "VOLTAGE", 500).samples == 40
    raised = declared.read(list_alarms, AlarmFilter(limit=99, state=["raised"])).items
    assert {one.name for one in raised} == {"implausible_time"}
    take(declared, late[1:])
    assert len(declared.read(list_implausible, ImplausibleFilter(limit=9)).items) == 1
    assert declared.read(newest_declared_ticks, 1) < int(ticks_from_utc_ns(START + 4 * 86_400 * NS))
