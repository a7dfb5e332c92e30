"""Decoded columns as the store takes them."""

from ground_service.ingest.packets import batch_of_cut
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.cuc import NO_TICKS
from tmtc.packets.stream import cut_packets


def test_an_impossible_on_board_time_is_none_and_never_negative_garbage():
    octets = b"".join(
        DICTIONARY.pack(
            "time_report", {"reported_ticks": ticks, "rate_exponent": 0}, ticks=9, sequence_count=k
        )
        for k, ticks in enumerate((0, 2**48 - 1, 2**48, 2**63, 2**64 - 1))
    )
    rows = batch_of_cut(octets, cut_packets(octets)).rows
    reported = next(columns["reported_ticks"] for columns in rows.values() if "reported_ticks" in columns)
    assert reported.dtype == "int64"
    assert reported.tolist() == [0, 2**48 - 1, NO_TICKS, NO_TICKS, NO_TICKS]
