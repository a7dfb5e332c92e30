"""Imported XTCE compared with the interpreter of space_packet_parser: python -m benchmarks.xtce.

Both read the same definition and decode packets of the same capture on one thread. Rates are per processor time, best
of a few rounds; the interpreter decodes the first packets of the capture. Every value that it reads is compared. The
time to read the definition is not part of the rates.

Three captures: fixed layout (24 numbers), all supported scalar types with texts (29 parameters), and a mix of packets
in which three of four consist of texts, octets or a single number. Both get packets that are already cut.

On one core of a shared virtual machine (Python 3.11, space_packet_parser 6.2.0), three runs: 466 to 489, 64 to 79 and
49.6 to 56.7 times as many packets per second as the interpreter, all values equal.
"""

from __future__ import annotations

import json
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._rows import Row
from benchmarks.tmtc import DICTIONARY, fixed_packets
from tests.tmtc import foreign
from tmtc.stream import PacketCut, cut_packets
from tmtc.xtce.decode import Decoder, XtceDecode
from tmtc.xtce.export import format_xtce
from tmtc.xtce.importing import parse_xtce

PACKETS = 100_000
INTERPRETED = 1_000


def bench(packets: int = PACKETS, interpreted: int = INTERPRETED) -> dict[str, Any]:
    """Packets per second of both, their ratio, and whether all values are equal."""
    rng = np.random.default_rng(1)
    repeated = [foreign.housekeeping(rng, k) for k in range(interpreted)]
    mixed = foreign.capture(interpreted, 2)
    times = -(-packets // interpreted)
    fixed = fixed_packets(packets)
    captures = {
        "fixed, 24 numbers": (format_xtce(DICTIONARY, unrolled=True), fixed, cut_packets(fixed)),
        "housekeeping, 29 parameters with texts": (foreign.BUS, *_capture(repeated * times)),
        "mixed, dynamic sizes": (foreign.BUS, *_capture(mixed * times)),
    }
    return {name: _compare(*given, interpreted) for name, given in captures.items()}


def rows() -> Iterator[Row]:
    """Yield rates of the compiled definition beside the interpreter."""
    for name, one in bench().items():
        wrong = "" if one["values_equal"] else "values of the interpreter differ"
        rates = one["linna_packets_per_s"], one["space_packet_parser_packets_per_s"]
        yield Row(name, rates[0], "packets/s", "space_packet_parser", rates[1], wrong)


def _capture(packets: list[bytes]) -> tuple[bytes, PacketCut]:
    octets = b"".join(packets)
    lengths = np.array([len(p) for p in packets], dtype=np.int64)
    none = np.empty((0, 2), dtype=np.int64)
    ok = np.ones(len(packets), dtype=np.bool_)
    return octets, PacketCut(np.cumsum(lengths) - lengths, lengths, ok, none, none, len(octets))


def _compare(definition: str, octets: bytes, cut: PacketCut, interpreted: int) -> dict[str, Any]:
    import space_packet_parser

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "definition.xml")
        path.write_text(definition, encoding="utf-8")
        interpreter = space_packet_parser.load_xtce(path)
    decoder = Decoder(parse_xtce(definition))
    pieces = list(cut.packets(octets))[:interpreted]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs, their_seconds = _best(lambda: [interpreter.parse_bytes(piece) for piece in pieces], 3)
    ours, our_seconds = _best(lambda: decoder.decode(octets, cut), 5)
    our_rate, their_rate = len(cut) / our_seconds, len(pieces) / their_seconds
    return {
        "linna_packets_per_s": round(our_rate),
        "space_packet_parser_packets_per_s": round(their_rate),
        "ratio": round(our_rate / their_rate, 1),
        "values_compared": sum(len(packet) for packet in theirs),
        "values_equal": _equal(ours, theirs),
    }


def _equal(found: XtceDecode, theirs: list[Any]) -> bool:
    """Whether every value and every raw value of the interpreter is ours."""
    compared = 0
    for table in found.tables.values():
        rows = np.flatnonzero(table.packet_index < len(theirs))
        packets = table.packet_index[rows].tolist()
        for name, column in table.columns.items():
            taken = column.take(rows)
            pairs = zip(packets, taken.to_list(), taken.to_list(raw=True), strict=True)
            for packet, value, raw in pairs:
                expected = theirs[packet][name]
                if not (_same(value, expected) and _same(raw, expected.raw_value)):
                    return False
                compared += 1
    return compared == sum(len(packet) for packet in theirs)


def _same(ours: Any, expected: Any) -> bool:
    return bool(ours == expected or (ours != ours and expected != expected))


def _best(run: Any, rounds: int) -> tuple[Any, float]:
    seconds = []
    for _ in range(rounds):
        started = time.process_time()
        result = run()
        seconds.append(time.process_time() - started)
    return result, min(seconds)


if __name__ == "__main__":
    print(json.dumps({"xtce": bench()}, indent=1))
