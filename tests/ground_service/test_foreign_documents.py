"""Documents of others are read with limits of depth, digits, size and count: each fault is one line."""

import hashlib
import json
import shutil
import tracemalloc

import numpy as np
from pytest import mark, raises

from ground_service.errors import InvalidInput
from ground_service.missions.service import read_mission
from ground_service.passes.archive_import import import_archive
from ground_service.passes.model import PassFilter
from ground_service.passes.store import list_passes
from ground_service.regression.build_runs import read_performance
from ground_service.regression.builds import load_build
from ground_service.toml import read_table
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import DataFileError
from lunar.messages import ephemeris_files, oem
from lunar.messages.oem import format_oem
from lunar.messages.oem_xml import format_oem_xml
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import parse_scenario
from tests.ground_service.conftest import cells
from tmtc.dictionary.definitions import parse_dictionary
from tmtc.errors import MalformedPacket

DEEP = "a = " + "[" * 50_000 + "]" * 50_000
LONG = "a = " + "9" * 5_000


@mark.parametrize("text, message", [(DEEP, "nested too deeply"), (LONG, "too many digits")])
def test_toml_without_end_is_refused_in_one_line(text, message, tmp_path):
    with raises(InvalidInput, match=message):
        read_mission(text.encode(), "body")
    (tmp_path / "build.toml").write_text(text)
    with raises(InvalidInput, match=message):
        load_build(tmp_path / "build.toml")
    with raises(ScenarioError, match="not TOML"):
        parse_scenario(text)


@mark.parametrize(
    "text, message",
    [
        ("a" + ".a" * 16 + " = 1", "a deeper or longer one"),
        ("[a" + ' . "b.c"' * 16 + "]", "a deeper or longer one"),
        ("k" * 201 + " = 1", "a deeper or longer one"),
        ("a = [" + "[], [" * 17 + "]" * 18, "nested too deeply"),
        ("[a.a]\n" * 60_000, "at most 100000 keys and values, found 120000"),
        ("# " + "x" * (4 << 20), "at most 4 MiB"),
    ],
)
def test_toml_that_would_cost_much_is_not_parsed(text, message, monkeypatch):
    monkeypatch.delattr("tomllib.loads")
    with raises(InvalidInput, match=message):
        read_table(text, "body", "TOML")


def test_toml_in_its_limits_is_parsed_whatever_its_strings_contain():
    text = "a" + ".a" * 15 + " = 1\n" + "b = '''" + "x.[" * 60_000 + "'''\nc = \"\\\"[[[[[[[[[[[[[[[[[[\"\n"
    found = read_table(text, "body", "TOML")
    assert found["b"] == "x.[" * 60_000 and found["c"] == '"' + "[" * 18


@mark.parametrize(
    "text",
    [
        "[" * 50_000, '{"stages": {"a": [' + "9" * 5_000 + "]}}", '{"stages": {"a": [1' + "0" * 400 + "]}}",
        '{"stages": {"a": [NaN]}}', '{"stages": {"a": [-5]}}', '{"stages": {"a": [1.0]}}' + " " * (8 << 20),
    ],
    ids=["deep", "digits", "overflow", "not a number", "negative", "long"],
)  # fmt: skip
def test_costs_that_a_build_states_without_end_are_not_read(text, tmp_path):
    (tmp_path / "performance.json").write_text('{"stages": {"a": [1.0]}}')
    assert read_performance(tmp_path / "performance.json") == {"stages": {"a": [1.0]}}
    (tmp_path / "performance.json").write_text(text)
    assert read_performance(tmp_path / "performance.json") is None
    with raises(MalformedPacket, match="expected a packet dictionary"):
        parse_dictionary(text)


def test_limits_of_a_build_are_bounded_and_belong_to_a_program(tmp_path):
    def digest(limits):
        file = tmp_path / "build.toml"
        file.write_text(f'name = "x"\ncommand = ["x", "{{archive}}", "{{out}}"]\n{limits}')
        return load_build(file).digest

    assert digest("") == digest("[limits]\nwall_s = 900") != digest("[limits]\nwall_s = 901")
    for name in ("wall_s", "cpu_s", "memory_mib", "file_mib", "folder_mib", "open_files", "processes"):
        with raises(InvalidInput, match=f"limits.{name}: expected less than or equal to"):
            digest(f"[limits]\n{name} = 1_000_000_000")


IMPOSSIBLE = r"""
{"camera": {"width_px": 1000000000, "height_px": 512}} | camera.width_px: expected a number from 1 to
{"camera": {"fov_deg": NaN}} | camera.fov_deg: expected
{"cadence_s": -1} | cadence_s: expected
{"octets": -1} | expected -1 octets as in the manifest
{"receptions": "packet_ticks\n1\n"} | receptions.csv, line 1: expected a column sequence_count
"""


@mark.parametrize("change, message", cells(IMPOSSIBLE))
def test_an_archive_with_impossible_numbers_leaves_no_pass(change, message, ground, synthetic_pass, tmp_path):
    folder, change = tmp_path / "archive", json.loads(change)
    shutil.copytree(synthetic_pass.folder, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    if "octets" in change:
        manifest["files"]["downlink.cadu"]["bytes"] = change["octets"]
    elif "receptions" in change:
        octets = change["receptions"].encode()
        (folder / "receptions.csv").write_bytes(octets)
        manifest["files"]["receptions.csv"] = {"sha256": hashlib.sha256(octets).hexdigest()}
    else:
        manifest |= change
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with raises(InvalidInput, match=message):
        import_archive(ground, folder)
    assert ground.read(list_passes, PassFilter()).items == []


def test_ephemerides_are_limited_in_size_and_lines(monkeypatch, tmp_path):
    path = tmp_path / "a.oem"
    path.write_text("CCSDS_OEM_VERS = 2.0\n" + "COMMENT\n" * 100)
    monkeypatch.setattr(ephemeris_files, "LINES_LIMIT", 100)
    monkeypatch.setattr(ephemeris_files, "LINE_OCTETS", 1000)
    with raises(DataFileError, match="expected at most 100 lines, found 101"):
        ephemeris_files.load_ephemeris(path)
    path.write_bytes(bytes(ephemeris_files.OCTETS_LIMIT + 1))
    with raises(DataFileError, match="expected at most 96 MiB"):
        ephemeris_files.load_ephemeris(path)


@mark.parametrize("name", ["a.oem", "a.xml"])
def test_an_ephemeris_is_read_as_a_stream_with_a_limit_on_states(monkeypatch, tmp_path, name):
    """Reading takes less than twice the size of the file, and 4 MiB."""
    count = 20_000
    utc_ns = np.int64(1_800_000_000_000_000_000) + np.arange(count, dtype=np.int64) * 60_000_000_000
    states = np.full((count, 3), 1.8e6)
    made = Ephemeris((EphemerisSegment(utc_ns, states, states / 1e3, "MOON", "ICRF"),))
    path = tmp_path / name
    path.write_text(format_oem_xml(made) if name == "a.xml" else format_oem(made))
    size = path.stat().st_size
    monkeypatch.setattr(ephemeris_files, "OCTETS_LIMIT", size)  # the reserved, unused memory of the reader
    ephemeris_files.load_ephemeris(path)  # what is imported and kept
    tracemalloc.start()
    found = ephemeris_files.load_ephemeris(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found.segments[0].utc_ns) == count
    assert peak < 2 * size + 4 * 2**20
    monkeypatch.setattr(oem, "STATES_LIMIT", count - 1)
    with raises(DataFileError, match="expected at most 19999 states, found more"):
        ephemeris_files.load_ephemeris(path)
