"""`linna tm`: decode and check telemetry files; the packet dictionary as ICD and XTCE."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from tmtc.downlink import DownlinkDecode


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    decode = commands.add_parser(
        "decode", help="packets of a downlink (CADUs or bare packets) as JSON, CSV or Parquet"
    )
    decode.add_argument("file", type=Path, metavar="FILE")
    decode.add_argument("--format", choices=("json", "csv", "parquet"), default="json")
    decode.add_argument("--out", type=Path, metavar="F", help="write there (default: standard output)")
    decode.add_argument(
        "--packet", metavar="NAME", action="append", help="only packets of this name (repeatable)"
    )
    _add_link_options(decode)
    add_json_flag(decode)
    decode.set_defaults(handler=run_decode)

    check = commands.add_parser("check", help="account for every octet of a downlink")
    check.add_argument("file", type=Path, metavar="FILE")
    check.add_argument(
        "--strict", action="store_true", help="exit 1 when anything is damaged, missing or skipped"
    )
    _add_link_options(check)
    add_json_flag(check)
    check.set_defaults(handler=run_check)

    icd = commands.add_parser("icd", help="the interface control document, in Markdown")
    icd.add_argument("--out", type=Path, metavar="F", help="write there (default: standard output)")
    add_json_flag(icd)
    icd.set_defaults(handler=run_icd)

    xtce = commands.add_parser("xtce", help="the dictionary as XTCE 1.2")
    xtce.add_argument("--out", type=Path, metavar="F", help="write there (default: standard output)")
    add_json_flag(xtce)
    xtce.set_defaults(handler=run_xtce)


def run_decode(arguments: argparse.Namespace) -> int:
    from tmtc.dictionary import DICTIONARY
    from tmtc.export import format_records, packet_records

    for name in arguments.packet or ():
        DICTIONARY.packet(name)
    decoded = _read(arguments)
    tables = decoded.tables()
    if arguments.packet:
        tables = {name: table for name, table in tables.items() if name in arguments.packet}
    records = packet_records(tables)
    if arguments.json and arguments.out is None:
        emit(arguments, {**decoded.accounting(), "telemetry": records})
        return 0
    octets = format_records(records, arguments.format)
    if arguments.out is None:
        sys.stdout.buffer.write(octets)
        return 0
    _save(arguments.out, octets)
    figures = {**decoded.accounting(), "written": len(records), "out": str(arguments.out)}
    emit(arguments, figures, text=f"{len(records)} packets written to {arguments.out}\n{_describe(decoded)}")
    return 0


def run_check(arguments: argparse.Namespace) -> int:
    decoded = _read(arguments)
    emit(arguments, decoded.accounting(), text=_describe(decoded))
    return 1 if arguments.strict and not decoded.complete else 0


def run_icd(arguments: argparse.Namespace) -> int:
    from payload_emulator.flight.interfaces import format_interfaces
    from tmtc.icd import format_icd

    return _document(arguments, f"{format_icd()}\n{format_interfaces()}")


def run_xtce(arguments: argparse.Namespace) -> int:
    from tmtc.xtce import format_xtce

    return _document(arguments, format_xtce())


def _document(arguments: argparse.Namespace, text: str) -> int:
    from tmtc.dictionary import DICTIONARY

    figures = {"dictionary_version": DICTIONARY.version, "dictionary_hash": DICTIONARY.hash}
    if arguments.out is None:
        emit(arguments, {**figures, "text": text}, text=text.rstrip("\n"))
        return 0
    _save(arguments.out, text.encode())
    emit(arguments, {**figures, "out": str(arguments.out)}, text=f"written to {arguments.out}")
    return 0


def _add_link_options(parser: argparse.ArgumentParser) -> None:
    link = parser.add_argument_group("link", "settings of the link; found out from the file where not given")
    link.add_argument("--frame-length", type=int, metavar="N", help="octets of a transfer frame")
    link.add_argument("--coding", choices=("rs", "none"))
    link.add_argument("--randomiser", choices=("none", "legacy", "long"))
    link.add_argument("--interleave", type=int, metavar="I")
    link.add_argument("--no-frame-checksum", action="store_true", help="frames carry no frame error control")
    link.add_argument("--spacecraft-id", type=lambda text: int(text, 0), metavar="ID")


def _read(arguments: argparse.Namespace) -> DownlinkDecode:
    from linna.errors import UsageError
    from tmtc.downlink import LinkSettings, decode

    octets = arguments.file.read_bytes()
    given = {
        "frame_length": arguments.frame_length,
        "coding": arguments.coding,
        "randomiser": arguments.randomiser,
        "interleave": arguments.interleave,
    }
    chosen = {name: value for name, value in given.items() if value is not None}
    if arguments.no_frame_checksum:
        chosen["checksum"] = False
    settings = LinkSettings(**chosen) if chosen else None
    decoded = decode(octets, settings=settings, spacecraft_id=arguments.spacecraft_id)
    if not decoded.packets and not decoded.frame_count:
        raise UsageError(
            f"{arguments.file}: expected CADUs or space packets, found none in its {len(octets)} octets"
        )
    return decoded


def _save(path: Path, octets: bytes) -> None:
    """Write all or nothing."""
    unfinished = path.with_name(path.name + ".unfinished")
    try:
        unfinished.write_bytes(octets)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _describe(decoded: DownlinkDecode) -> str:
    lines = []
    if decoded.settings is not None:
        link = decoded.settings
        coding = "uncoded"
        if link.code is not None:
            coding = f"Reed-Solomon E={link.code.errors} I={link.code.interleave}"
        lines.append(
            f"link: {decoded.frame_count} frames of {link.frame_length} octets, {coding}, "
            f"randomiser {link.randomiser}, spacecraft {decoded.spacecraft_id}"
        )
        lines.append(
            f"frames bad {decoded.frames_bad}, lost {decoded.frames_lost}; "
            f"symbols corrected {decoded.symbols_corrected}"
        )
    lines.append(
        f"packets {decoded.packets}: missing {decoded.packets_missing} in {decoded.gaps} gaps, "
        f"duplicates {decoded.duplicates}, conflicts {decoded.conflicts}, "
        f"wrong checksum {decoded.crc_errors}, not in the dictionary {decoded.unknown}"
    )
    lines += [f"  APID 0x{apid:03X}: {count}" for apid, count in decoded.by_apid.items()]
    total = sum(decoded.octets.values())
    parts = [f"{name.replace('_', ' ')} {count}" for name, count in decoded.octets.items() if count]
    lines.append(f"octets {total}: " + ", ".join(parts))
    return "\n".join(lines)
