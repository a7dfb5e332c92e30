"""`linna tm` as its users type it."""

import csv
import json

import pytest

from linna.cli import run
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets import PacketSequencer


def make_packets(count: int) -> list[bytes]:
    sequencer = PacketSequencer()
    return [
        DICTIONARY.pack(
            "event_info",
            {"event_id": "anchor_read", "frame_number": k, "value_1": k / 2, "value_2": float("nan")},
            ticks=k << 16,
            sequence_count=sequencer.next(0xA4),
        )
        for k in range(count)
    ]


PACKETS = make_packets(100)


@pytest.fixture
def downlink(tmp_path):
    path = tmp_path / "downlink.cadu"
    path.write_bytes(encode_cadus(PACKETS, spacecraft_id=76))
    return path


def figures(capsys) -> dict:
    return json.loads(capsys.readouterr().out)


def test_check_tells_the_account_of_an_undamaged_downlink(downlink, capsys):
    assert run(["tm", "check", str(downlink), "--json", "--strict"]) == 0
    told = figures(capsys)
    assert told["packets"] == 100 and told["by_apid"] == {"0x0A4": 100}
    zeros = ("gaps", "duplicates", "crc_errors", "octets_skipped", "frames_bad", "symbols_corrected")
    assert {name: told[name] for name in zeros} == dict.fromkeys(zeros, 0)
    assert sum(told["octets"].values()) == downlink.stat().st_size


def test_check_tells_damage_and_fails_only_when_asked_to(downlink, capsys):
    octets = bytearray(downlink.read_bytes())
    octets[1279 + 9] ^= 0xFF
    del octets[2 * 1279 : 3 * 1279]
    downlink.write_bytes(octets)
    assert run(["tm", "check", str(downlink), "--json"]) == 0
    told = figures(capsys)
    assert told["symbols_corrected"] == 1 and told["frames_lost"] == 1 and told["gaps"] == 1
    assert told["packets"] + told["packets_missing"] == 100
    assert run(["tm", "check", str(downlink), "--strict"]) == 1
    assert "symbols corrected 1" in capsys.readouterr().out


def test_decode_writes_json_to_a_file_or_to_standard_output(downlink, tmp_path, capsys):
    out = tmp_path / "packets.json"
    assert run(["tm", "decode", str(downlink), "--out", str(out), "--json"]) == 0
    told = figures(capsys)
    assert told["packets"] == told["written"] == 100 and told["out"] == str(out)
    records = json.loads(out.read_text())
    assert [r["frame_number"] for r in records] == list(range(100)) and records[3]["value_1"] == 1.5
    assert run(["tm", "decode", str(downlink)]) == 0
    assert json.loads(capsys.readouterr().out) == records
    assert run(["tm", "decode", str(downlink), "--json"]) == 0
    told = figures(capsys)
    assert told["telemetry"] == records and told["packets"] == 100


def test_decode_writes_csv_and_parquet(downlink, tmp_path):
    out = tmp_path / "packets.csv"
    assert run(["tm", "decode", str(downlink), "--format", "csv", "--out", str(out)]) == 0
    assert [row["event_id"] for row in csv.DictReader(out.read_text().splitlines())] == ["anchor_read"] * 100
    out = tmp_path / "packets.parquet"
    assert run(["tm", "decode", str(downlink), "--format", "parquet", "--out", str(out)]) == 0
    assert out.read_bytes()[:4] == b"PAR1"


def test_bare_packets_are_decoded_as_well(tmp_path, capsys):
    path = tmp_path / "packets.bin"
    path.write_bytes(b"".join(PACKETS))
    assert run(["tm", "check", str(path), "--json"]) == 0
    told = figures(capsys)
    assert (told["kind"], told["packets"], told["link"]) == ("packets", 100, None)


def test_only_the_wanted_packets_are_decoded(downlink, capsys):
    assert run(["tm", "decode", str(downlink), "--packet", "detections"]) == 0
    assert json.loads(capsys.readouterr().out) == []
    assert run(["tm", "decode", str(downlink), "--packet", "nonsense"]) == 2
    assert "found 'nonsense'" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"this is no telemetry at all, not even nearly"])
def test_a_file_without_telemetry_is_refused_in_one_line(tmp_path, capsys, content):
    path = tmp_path / "file.bin"
    path.write_bytes(content)
    assert run(["tm", "check", str(path)]) == 2
    error = capsys.readouterr().err
    assert (
        error
        == f"linna: error: {path}: expected CADUs or space packets, found none in its {len(content)} octets\n"
    )


def test_a_missing_file_is_refused_in_one_line(tmp_path, capsys):
    assert run(["tm", "decode", str(tmp_path / "absent")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_an_unwritable_place_leaves_nothing_behind(downlink, tmp_path, capsys):
    assert run(["tm", "decode", str(downlink), "--out", str(tmp_path / "absent" / "out.json")]) == 2
    assert [p.name for p in tmp_path.iterdir()] == [downlink.name]


def test_settings_of_the_link_may_be_given(downlink, capsys):
    arguments = [
        "--frame-length",
        "1115",
        "--coding",
        "rs",
        "--randomiser",
        "none",
        "--spacecraft-id",
        "0x4C",
    ]
    assert run(["tm", "check", str(downlink), "--json", *arguments]) == 0
    told = figures(capsys)
    assert told["link"]["randomiser"] == "none" and told["packets"] == 0
    assert run(["tm", "check", str(downlink), "--frame-length", "7"]) == 2


def test_the_icd_and_the_xtce_are_written(tmp_path, capsys):
    assert run(["tm", "icd"]) == 0
    assert capsys.readouterr().out.startswith("# Interface control document")
    out = tmp_path / "linna.xml"
    assert run(["tm", "xtce", "--out", str(out), "--json"]) == 0
    assert figures(capsys)["dictionary_hash"] == DICTIONARY.hash
    assert out.read_text().startswith("<?xml")
