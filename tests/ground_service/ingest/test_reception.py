"""Declared link settings of ingests, remarks where octets do not fit, station records, link quality."""

import itertools
import struct

import numpy as np
from pytest import approx, mark, param, raises
from sqlalchemy import select

from benchmarks.downlink import (
    OTHER_SPACECRAFT,
    SHORT,
    SPACECRAFT,
    cadus,
    can_be_read,
    packets_of,
    telemetry,
    two_receivers,
    two_spacecraft,
    with_bit_errors,
    without_error_control,
)
from ground_service.errors import InvalidInput
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import PiecePosition, ingest_file
from ground_service.missions.service import add_mission
from ground_service.missions.store import links_in_force
from ground_service.passes.archive_import import import_archive
from ground_service.passes.model import Completeness
from ground_service.passes.service import completeness, define_pass, get_pass
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from lunar.timescales import utc_ns_from_ticks
from tests.ground_service.archive_hash import archive_hash
from tmtc.link.settings import LinkSettings

NS = 1_000_000_000
START = 1_900_000_000 * NS
HEADER = 16

MISSION = """
schema_version = 1
name = "selenita"
[spacecraft]
id = 76
[link]
frame_length = 1115
coding = "rs"
randomiser = "legacy"
frame_checksum = true
[link.stations.madrid]
header_octets = 16
trailer_octets = 4
time_code = "unix_ns"
time_offset = 8
[link.stations.canberra]
frame_length = 892
interleave = 4
randomiser = "long"
"""


FOREIGN = b'name = "foreign"\n[spacecraft]\nid = 76\n[link]\npacket_checksum = "none"\n'


def ingest(ground, octets, **options):
    path = ground.home / "downlink.bin"
    path.write_bytes(octets)
    return ingest_file(ground, path, **options)


def section(result):
    (one,) = result.reception.sections
    return one.model_dump()


def stored(ground, spacecraft=SPACECRAFT):
    table = repository.PACKETS
    with ground.database.reading() as connection:
        vehicle = vehicle_id(connection, spacecraft, "flight")
        rows = connection.execute(select(table.c.octets).where(table.c.vehicle_id == vehicle))
        return {bytes(row) for row in rows.scalars()}


def recorded(rows):
    """CADUs in records with a header that holds the reception time, and a trailer."""
    rng = np.random.default_rng(5)
    parts = []
    for number, row in enumerate(rows):
        parts += [rng.bytes(8), struct.pack(">Q", START + number * NS), row.tobytes(), rng.bytes(4)]
    return b"".join(parts)


def test_settings_come_from_the_sender_then_from_the_mission_and_else_from_the_defaults(ground):
    rows = cadus(30)
    assert section(ingest(ground, rows[:10]))["source"] == "default"
    add_mission(ground, MISSION.encode())
    assert section(ingest(ground, rows[10:20]))["source"] == "mission"
    stated = ingest(ground, rows[20:], link="frame_length=1115")
    assert (section(stated)["source"], stated.remark) == ("stated", "")


def test_an_archive_is_read_with_the_settings_of_its_own_mission(ground, make_pass):
    """The description of the archive holds for its instance only, not for the spacecraft in flight."""
    archive = make_pass(mission=MISSION)
    pass_id = import_archive(ground, archive.folder)
    assert set(ground.read(links_in_force, SPACECRAFT, get_pass(ground, pass_id).instance)) == {SPACECRAFT}
    assert ground.read(links_in_force, SPACECRAFT, "flight") == {}
    [kept], _ = ground.read(repository.newest, repository.INGESTS, Paging())
    assert {one["source"] for one in kept["accounting"]["reception"]["sections"]} == {"mission"}


def test_stated_settings_are_used_as_they_are_and_impossible_ones_are_refused(ground):
    octets = cadus(30)
    right = "frame_length=1115,coding=rs,randomiser=legacy,checksum=true"
    wrong = ingest(ground, octets, link=right.replace("legacy", "long"))
    assert (wrong.packets, section(wrong)["source"]) == (0, "stated")
    assert f"0 of {wrong.frames} frames are valid with the stated link settings" in wrong.remark
    assert ingest(ground, octets, link=right).packets == len(telemetry(30))
    for text in ("frame_length=many", "colour=red", "coding=turbo", "frame_length=3"):
        with raises(InvalidInput, match="link"):
            ingest(ground, octets, link=text)


def test_a_station_may_have_settings_of_its_own(ground):
    add_mission(ground, MISSION.encode())
    settings = LinkSettings(frame_length=892, interleave=4, randomiser="long")
    result = ingest(ground, cadus(30, 1, settings), station="canberra")
    assert (section(result)["source"], section(result)["frame_length"]) == ("mission", 892)


def test_octets_that_do_not_fit_the_declared_settings_are_kept_with_a_remark(ground):
    add_mission(ground, MISSION.encode())
    settings = LinkSettings(frame_length=1024, coding="none")
    octets = cadus(30, 1, settings)
    result = ingest(ground, octets, spacecraft_id=SPACECRAFT)
    assert (section(result)["source"], result.packets) == ("mission", 0)
    assert (result.octets, result.octets_skipped > 0) == (octets.size, True)
    assert f"0 of {result.frames} frames are valid with the mission link settings (frame_length" in result.remark
    assert "`linna link check FILE`" in result.remark
    add_mission(ground, MISSION.replace("1115", "1024").replace('"rs"', '"none"').encode())
    again = ingest(ground, octets, spacecraft_id=SPACECRAFT)
    assert (again.packets, again.remark) == (len(telemetry(30, 1, settings)), "")


def test_a_file_with_few_frames_of_the_declared_settings_has_a_remark(ground):
    other = cadus(30, 1, LinkSettings(frame_length=1024, coding="none")).tobytes()
    result = ingest(ground, cadus(30)[:10].tobytes() + other)
    assert f"10 of {result.frames} frames are valid with the default link settings" in result.remark


def test_each_section_has_the_declared_settings_of_its_spacecraft(ground):
    other = LinkSettings(frame_length=1024, coding="none")
    add_mission(ground, b'name = "other"\n[spacecraft]\nid = 33\n[link]\nframe_length = 1024\ncoding = "none"\n')
    octets = cadus(200).tobytes() + cadus(200, 1, other, OTHER_SPACECRAFT).tobytes()
    result = ingest(ground, octets)
    assert [one.source for one in result.reception.sections] == ["default", "mission"]
    assert result.packets == len(telemetry(200)) + len(telemetry(200, 1, other))


def test_records_of_a_station_give_reception_times_and_their_octets_are_accounted_for(ground):
    add_mission(ground, MISSION.encode())
    rows = with_bit_errors(cadus(60), 2e-3, 3)
    octets = recorded(rows)
    result = ingest(ground, octets, station="madrid")
    quality = result.reception
    n = len(rows)
    assert result.packets == len(packets_of(can_be_read(rows, LinkSettings()), telemetry(60), LinkSettings()))
    assert (quality.first_utc_ns, quality.last_utc_ns) == (START, START + (n - 1) * NS)
    assert (quality.octets_frames, quality.octets_records, quality.octets_other) == (n * 1279, n * 20, 0)
    assert (quality.frames, quality.lock_losses, quality.station) == (n, 0, "madrid")


def test_the_bit_error_rate_is_estimated_from_the_corrected_bits(ground):
    quality = ingest(ground, with_bit_errors(cadus(SHORT), 2e-3, 3)).reception
    assert quality.codewords_lost == 0
    # of 4e6 bits 8,200 are wrong: one standard deviation is 1.1 %
    assert quality.bit_error_rate == approx(2e-3, rel=0.05)
    assert quality.symbols_corrected > 7_000


def test_lost_bits_and_inverted_frames_are_lock_losses(ground):
    bits = np.unpackbits(cadus(30).reshape(-1))
    rows = np.packbits(np.delete(bits, [9 * 8 * 1279 + 4000]))
    quality = ingest(ground, rows).reception
    assert quality.lock_losses == 1 and quality.frames_inverted == 0
    quality = ingest(ground, 255 - cadus(30)).reception
    assert quality.frames_inverted == len(cadus(30))


def test_packets_without_error_control_are_read_if_the_mission_says_so(ground):
    capture = without_error_control()
    with raises(InvalidInput):
        ingest(ground, capture.files[0], spacecraft_id=SPACECRAFT)
    add_mission(ground, FOREIGN)
    result = ingest(ground, capture.files[0], spacecraft_id=SPACECRAFT)
    assert (result.packets, result.octets_skipped) == (7200, 0)
    assert stored(ground) == capture.packets[SPACECRAFT]


def test_packets_behind_octets_of_a_recorder_are_read_if_the_mission_says_so(ground):
    packets = without_error_control().packets[SPACECRAFT]
    octets = b"".join(bytes(3) + packet for packet in sorted(packets))
    with raises(InvalidInput, match=r"`linna link check FILE` shows"):
        ingest(ground, octets, spacecraft_id=SPACECRAFT)
    add_mission(ground, FOREIGN + b"[link.stations.recorder]\npacket_prefix_octets = 3\n")
    result = ingest(ground, octets, spacecraft_id=SPACECRAFT, station="recorder")
    assert (result.packets, result.octets_skipped) == (7200, 0)
    assert stored(ground) == packets


@mark.parametrize("seed", [0, *(param(k, marks=mark.campaign) for k in (1, 2, 3))])
def test_receptions_of_two_stations_are_merged_in_any_order_and_split(ground, seed):
    rng = np.random.default_rng(seed)
    stream = two_receivers(one_file=False)
    pieces = []
    for station, octets in zip(("madrid-x", "goldstone"), stream.files, strict=True):
        cuts = [0, *sorted(rng.integers(0, len(octets), 2).tolist()), len(octets)]
        pieces += [(station, a, octets[a:b]) for a, b in itertools.pairwise(cuts) if b > a]
    for k in rng.permutation(len(pieces)).tolist():
        station, start, octets = pieces[k]
        ingest(ground, octets, station=station, place=PiecePosition(station, start))
    assert stored(ground) == stream.packets[SPACECRAFT]


def test_two_spacecraft_have_the_same_archives_whatever_the_split(tmp_path):
    stream = two_spacecraft()
    hashes = set()
    for cut in (0, 1279 * 301, 400_001):
        with open_ground(tmp_path / str(cut)) as ground:
            for start, part in ((cut, stream.files[0][cut:]), (0, stream.files[0][:cut])):
                if part:
                    ingest(ground, part, place=PiecePosition("both", start))
            assert {one: stored(ground, one) for one in stream.packets} == stream.packets
            vehicles = [ground.read(vehicle_id, one, "flight") for one in sorted(stream.packets)]
            hashes.add(tuple(ground.read(archive_hash, vehicle) for vehicle in vehicles))
    assert len(hashes) == 1


def test_the_link_quality_of_both_stations_is_shown_with_the_merged_packets_of_the_pass(ground):
    add_mission(ground, f"{MISSION}\n[link.stations.goldstone]\n".encode())
    stream = two_receivers(one_file=False)
    for station, octets in zip(("madrid", "goldstone"), stream.files, strict=True):
        rows = np.frombuffer(octets, dtype=np.uint8).reshape(-1, 1279)
        ingest(ground, recorded(rows) if station == "madrid" else octets, station=station)
    start, stop = (utc_ns_from_ticks(ticks) for ticks in (0, 10_000 << 16))
    key = define_pass(
        ground, name="both", start_utc_ns=start, stop_utc_ns=stop, spacecraft_id=SPACECRAFT, instance="flight"
    )
    found = completeness(ground, key)
    goldstone, madrid = found.receptions
    assert (found.packets, goldstone.station, madrid.station) == (stream.true, "goldstone", "madrid")
    assert (goldstone.first_utc_ns, madrid.first_utc_ns) == (None, START)
    assert [one.frames for one in found.receptions] == [len(stream.files[1]) // 1279, len(stream.files[0]) // 1279]
    assert found.frames == sum(one.frames for one in found.receptions)
    assert {one.source for one in found.receptions} == {"mission"}
    receptions = Completeness.of_accounting(found).receptions
    assert [one.station for one in receptions] == ["goldstone", "madrid"]
