import csv
import io
import json
import sys

import numpy as np
import pytest

from tests.lazy import Lazy
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import MissingLibrary, UnknownPacket
from tmtc.export import format_onboard_time, format_records, packet_records, parquet_octets
from tmtc.packets.stream import cut_packets

parquet = Lazy("pyarrow.parquet")

STATE = {f.name: [0.0] * 3 if f.size > 1 else 1 for f in DICTIONARY.packet("navigation_state").fields}


def tables():
    items = {
        "u_px": [1.5, 2.0], "v_px": [3.0, 4.0], "diameter_px": [10.0, 20.0], "score": [1.0, 0.0],
        "size_class": [0, -1], "sigma_px": [0.5, np.nan],
    }  # fmt: skip
    detections = {"frame_number": 1, "image_ticks": 7, "image_quality": "dark"}
    event = {"event_id": "boot", "frame_number": 0, "value_1": 0.25, "value_2": np.nan}
    state = STATE | {"velocity_icrf_m_s": [1.0, 2.0, 3.0], "sigma_rtn_m": [4.0, 5.0, np.nan]}
    octets = b"".join(
        (
            DICTIONARY.pack("event_info", event, ticks=0, sequence_count=0),
            DICTIONARY.pack("detections", {**detections, "items": items}, ticks=3 << 15, sequence_count=0),
            DICTIONARY.pack("detections", {**detections, "items": []}, ticks=2 << 16, sequence_count=1),
            DICTIONARY.pack("navigation_state", state, ticks=2 << 16, sequence_count=0),
        )
    )
    return DICTIONARY.unpack_many(octets, cut_packets(octets))


def test_on_board_time_is_exported_in_tai():
    assert format_onboard_time(0) == "2000-01-01T00:00:00.000000"
    # 2029-08-07T00:00:00 TAI is 10811 days after the epoch
    assert format_onboard_time(10811 * 86400 << 16 | 0x8000) == "2029-08-07T00:00:00.500000"
    assert format_onboard_time((1 << 48) - 1).startswith("2136-02-07T06:28:15.99998")


def test_records_stand_in_the_order_of_the_stream_with_names_for_codes():
    records = packet_records(tables())
    assert [r["packet"] for r in records] == ["event_info", "detections", "detections", "navigation_state"]
    assert records[0]["event_id"] == "boot" and records[0]["value_2"] is None
    assert records[1]["image_quality"] == "dark" and records[1]["onboard_tai"].endswith("00:00:01.500000")
    rows = [list(item.values()) for item in records[1]["items"]]
    assert rows == [[1.5, 3.0, 10.0, 1.0, "5-10 km", 0.5], [2.0, 4.0, 20.0, 0.0, "none", None]]
    assert list(records[1]["items"][0]) == ["u_px", "v_px", "diameter_px", "score", "size_class", "sigma_px"]
    assert records[2]["items"] == []
    assert records[3]["sigma_rtn_m"] == [4.0, 5.0, None]


def test_json_and_csv_hold_the_records():
    records = packet_records(tables())
    assert json.loads(format_records(records, "json")) == records
    rows = list(csv.DictReader(io.StringIO(format_records(records, "csv").decode())))
    assert [row["frame_number"] for row in rows] == ["0", "1", "1", "1"]
    assert rows[3]["velocity_icrf_m_s_2"] == "2.0" and rows[3]["sigma_rtn_m_3"] == ""
    assert json.loads(rows[1]["items"]) == records[1]["items"]


def test_no_packets_are_empty_files():
    assert json.loads(format_records([], "json")) == []
    assert format_records([], "csv") == b"\n"


def test_an_unknown_format_is_refused():
    with pytest.raises(UnknownPacket, match="expected one of json, csv, parquet, found 'xml'"):
        format_records([], "xml")


def read_parquet(octets):
    return parquet.read_table(io.BytesIO(octets))


def test_parquet_columns_keep_values_and_gaps():
    table = read_parquet(parquet_octets({"n": [1, None, -3], "x": [0.5, 1, None], "t": ["a", None, "\u00b5"]}))
    assert table.to_pydict() == {"n": [1, None, -3], "x": [0.5, 1.0, None], "t": ["a", None, "\u00b5"]}
    assert [str(field.type) for field in table.schema] == ["int64", "double", "string"]


def test_parquet_writes_truth_values_as_integers():
    assert read_parquet(parquet_octets({"b": [True, None, np.True_.item(), False]})).to_pydict() == {
        "b": [1, None, 1, 0]
    }


def test_parquet_without_rows_keeps_its_columns():
    assert read_parquet(parquet_octets({"n": [], "t": []})).column_names == ["n", "t"]


def test_parquet_without_its_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingLibrary, match=r"expected the library pyarrow, found none; install linna\[parquet\]"):
        parquet_octets({"n": [1]})


def test_unsigned_integers_of_64_bits_are_written_whole():
    state = STATE | {"image_ticks": 2**64 - 1}
    octets = DICTIONARY.pack("navigation_state", state, ticks=0, sequence_count=0)
    records = packet_records(DICTIONARY.unpack_many(octets, cut_packets(octets)))
    assert json.loads(format_records(records, "json"))[0]["image_ticks"] == 18446744073709551615
    rows = list(csv.DictReader(io.StringIO(format_records(records, "csv").decode())))
    assert rows[0]["image_ticks"] == "18446744073709551615"
    assert read_parquet(format_records(records, "parquet")).column("image_ticks").to_pylist() == [2**64 - 1]


def test_parquet_columns_beyond_signed_integers_stay_exact():
    table = read_parquet(parquet_octets({"u": [0, None, 2**64 - 1], "both": [-1, 2**63, 5]}))
    assert table.to_pydict() == {"u": [0, None, 2**64 - 1], "both": ["-1", "9223372036854775808", "5"]}
    assert [str(field.type) for field in table.schema] == ["uint64", "string"]


def test_records_are_the_rows_of_the_parquet_file():
    records = packet_records(tables())
    table = read_parquet(format_records(records, "parquet"))
    assert table.num_rows == len(records)
    assert table.column("apid").to_pylist() == [record["apid"] for record in records]
