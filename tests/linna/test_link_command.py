"""`linna link check`: proposals, contradictions with a mission description, and unknown settings."""

import json
from pathlib import Path

import numpy as np
import pytest

from linna.cli import run
from tests.tmtc.test_downlink import make_packets
from tmtc.downlink import encode_cadus
from tmtc.link.cadu import ASM
from tmtc.packets.space_packets import pack_packet


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "station.cadu"
    path.write_bytes(encode_cadus(make_packets(120), spacecraft_id=76))
    return path


def figures(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict]:
    status = run(["link", "check", *arguments, "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_settings_come_with_their_evidence(recording, capsys):
    status, found = figures(capsys, str(recording))
    assert status == 0 and not found["ambiguous"]
    assert found["settings"]["frame_length"] == 1115 and found["settings"]["randomiser"] == "legacy"
    best = found["evidence"][0]
    assert best["codewords_clean"] == best["checksums_hold"] == best["headers_regular"] == 1.0
    assert best["packets"] > 100


@pytest.mark.parametrize(("randomiser", "status"), [("legacy", 0), ("long", 1)])
def test_a_mission_description_is_compared(recording, capsys, tmp_path, randomiser, status):
    mission = tmp_path / "mission.toml"
    mission.write_text(f'name = "test"\n[link]\nframe_length = 1115\nrandomiser = "{randomiser}"\n')
    code, found = figures(capsys, str(recording), "--mission", str(mission))
    assert code == status
    expected = ["randomiser: the mission states long, the recording has legacy"] if status else []
    assert found["contradicts_mission"] == expected


def test_frames_that_nothing_proves_are_inconclusive(capsys, tmp_path):
    noise = np.random.default_rng(3).integers(0, 256, (30, 700), dtype=np.uint8)
    noise[:, :4] = np.frombuffer(ASM, dtype=np.uint8)
    path = tmp_path / "noise.cadu"
    path.write_bytes(noise.tobytes())
    status, found = figures(capsys, str(path))
    assert status == 3 and found["settings"] is None and found["distances"]["700"] == 29


def test_packets_without_frames_are_told_and_noise_is_refused(capsys, tmp_path):
    path = tmp_path / "packets.bin"
    path.write_bytes(b"".join(make_packets(20)))
    status, found = figures(capsys, str(path))
    assert status == 0 and found["packets_without_frames"] == 42
    path.write_bytes(np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8).tobytes())
    assert run(["link", "check", str(path)]) == 2
    assert "expected CADUs or space packets, found none in its 5000 octets" in capsys.readouterr().err


@pytest.mark.parametrize("prefix", [0, 3])
def test_the_form_of_packets_without_checksum_is_proposed(capsys, tmp_path, prefix):
    packets = [bytes(prefix) + pack_packet(0x200, bytes(range(60)), sequence_count=k) for k in range(30)]
    path = tmp_path / "foreign.bin"
    path.write_bytes(b"".join(packets))
    assert run(["link", "check", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "30 space packets without checksum" in shown and 'packet_checksum = "none"' in shown
    assert (f"packet_prefix_octets = {prefix}" in shown) == (prefix > 0)
