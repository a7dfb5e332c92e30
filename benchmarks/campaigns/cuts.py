"""Campaign that ingests a downlink split at random octets: the archives of all splits must be equal.

    python -m benchmarks.campaigns.cuts [--splits 1000] [--kind cadus|packets|both] [--seed S] [--json]

Every split cuts the downlink at random octets into 2 to `--pieces` pieces, ingests them in order or shuffled, with or
without repetitions, and compares the hash of the archive with that of the downlink ingested as a whole. `--placed`
passes the position of each piece to the ingest. No piece is shorter than `--smallest` octets. The exit status is 1 if
an archive differs.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ground import mixed_downlink
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import Place, ingest_file
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.archive_hash import archive_hash
from tmtc.downlink import decode

SPACECRAFT = 76
ORDERS = ("in order", "shuffled", "reversed", "interleaved", "repeated")


@dataclass(frozen=True, slots=True)
class Split:
    """Pieces of a downlink: start and end of each, in the order of ingest."""

    order: str
    pieces: tuple[tuple[int, int], ...]


def random_split(octets: int, rng: np.random.Generator, order: str, pieces: int, smallest: int) -> Split:
    """Return a random split into a limited number of pieces, none shorter than `smallest`."""
    count = int(rng.integers(1, pieces))
    cuts = np.unique(rng.integers(1, octets, count))
    kept = [0]
    for cut in cuts.tolist():
        if cut - kept[-1] >= smallest and octets - cut >= smallest:
            kept.append(cut)
    return ordered(list(itertools.pairwise([*kept, octets])), rng, order)


def ordered(pieces: list[tuple[int, int]], rng: np.random.Generator, order: str) -> Split:
    """Return the pieces in one of the `ORDERS`."""
    if order == "reversed":
        pieces = pieces[::-1]
    elif order == "interleaved":
        pieces = pieces[::2] + pieces[1::2]
    elif order != "in order":
        pieces = [pieces[i] for i in rng.permutation(len(pieces))]
    if order == "repeated":
        again = [pieces[i] for i in rng.integers(0, len(pieces), max(len(pieces) // 3, 1))]
        pieces = [*pieces, *again]
        pieces = [pieces[i] for i in rng.permutation(len(pieces))]
    return Split(order, tuple(pieces))


def hash_of(
    ground: Ground,
    instance: str,
    stream: bytes,
    pieces: Sequence[tuple[int, int]],
    *,
    placed: bool,
    bare: bool,
) -> tuple[str, int]:
    """Return the hash of the archive of these pieces, in a separate instance, and its number of packets."""
    path = ground.home / "piece.bin"
    for start, stop in pieces:
        path.write_bytes(stream[start:stop])
        ingest_file(
            ground,
            path,
            spacecraft_id=SPACECRAFT if bare else None,
            instance=instance,
            place=Place("campaign", start) if placed else None,
        )
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, SPACECRAFT, instance)
        packets = repository.page(connection, repository.PACKETS, limit=1, vehicle_id=vehicle).total
        return archive_hash(connection, vehicle), packets


def streams(packets: int, kinds: Sequence[str]) -> dict[str, bytes]:
    """Return a downlink as CADUs and as bare packets."""
    cadus = mixed_downlink(packets)
    found = decode(cadus)
    octets = b"".join(found.cut.packets(found.buffer))
    return {kind: {"cadus": cadus, "packets": octets}[kind] for kind in kinds}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--splits", type=int, default=1000)
    parser.add_argument("--kind", choices=("cadus", "packets", "both"), default="both")
    parser.add_argument("--packets", type=int, default=200)
    parser.add_argument("--pieces", type=int, default=24)
    parser.add_argument("--smallest", type=int, default=1, help="octets of the shortest piece")
    parser.add_argument("--placed", action="store_true", help="pass the position of each piece to the ingest")
    parser.add_argument("--orders", nargs="+", choices=ORDERS, default=ORDERS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    kinds = ("cadus", "packets") if given.kind == "both" else (given.kind,)
    sources = streams(given.packets, kinds)
    with tempfile.TemporaryDirectory() as folder, open_ground(Path(folder)) as ground:
        return campaign(ground, given, sources)


def campaign(ground: Ground, given: argparse.Namespace, sources: dict[str, bytes]) -> int:
    """Ingest all splits; return the exit status."""
    kinds = list(sources)
    whole = {
        kind: hash_of(
            ground, f"whole-{kind}", octets, [(0, len(octets))], placed=False, bare=kind == "packets"
        )
        for kind, octets in sources.items()
    }
    identical: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    lost: dict[str, Any] = {}
    pieces_in_all = 0
    started = time.monotonic()
    for number in range(given.splits):
        kind = kinds[number % len(kinds)]
        order = given.orders[number // len(kinds) % len(given.orders)]
        rng = np.random.default_rng((given.seed, number))
        octets = sources[kind]
        split = random_split(len(octets), rng, order, given.pieces, given.smallest)
        found = hash_of(
            ground, f"split-{number}", octets, split.pieces, placed=given.placed, bare=kind == "packets"
        )
        name = f"{kind} {order}"
        tried[name] += 1
        pieces_in_all += len(split.pieces)
        identical[name] += found[0] == whole[kind][0]
        if found[0] != whole[kind][0]:
            lost[f"split {number} ({name})"] = whole[kind][1] - found[1]
            print(
                f"split {number} ({name}): {found[1]} of {whole[kind][1]} packets",
                file=sys.stderr,
                flush=True,
            )
    figures = {
        "splits": given.splits,
        "pieces": pieces_in_all,
        "octets": {kind: len(octets) for kind, octets in sources.items()},
        "packets": {kind: packets for kind, (_, packets) in whole.items()},
        "identical": {name: f"{identical[name]} of {count}" for name, count in sorted(tried.items())},
        "identical_share": identical.total() / max(tried.total(), 1),
        "packets_lost": lost,
        "seconds": round(time.monotonic() - started),
    }
    if given.json:
        print(json.dumps(figures, indent=2))
    else:
        for name, count in sorted(tried.items()):
            print(f"{name:<24}{identical[name]:>6} of {count} identical")
        print(f"all {identical.total()} of {tried.total()}, {pieces_in_all} pieces, {figures['seconds']} s")
    return 0 if identical.total() == tried.total() else 1


if __name__ == "__main__":
    sys.exit(main())
