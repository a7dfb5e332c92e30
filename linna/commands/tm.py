"""`linna tm`: decode and check telemetry files; the packet dictionary as ICD and XTCE."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from linna.errors import UsageError
from linna.output import checked, emit, finish, save
from linna.parser import option

if TYPE_CHECKING:
    from tmtc.dictionary.schema import Dictionary
    from tmtc.downlink import DownlinkDecode
    from tmtc.link.settings import LinkSettings
    from tmtc.xtce.decode import XtceDecode
    from tmtc.xtce.definition import Definition

_PAUSE_S = 0.03
"""Time between two frames of a file, so that a receiver loses none."""


def configure_tm(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    decode = commands.add_parser("decode", help="packets of a downlink (CADUs or bare packets) as JSON, CSV or Parquet")
    option(decode, "file FILE", Path)
    option(decode, "--format", ("json", "csv", "parquet"), "", "json")
    option(decode, "--out F", Path, "write there (default: standard output)")
    _add_definition_options(decode)
    option(decode, "--raw", bool, "values as transmitted, neither calibrated nor named (with --xtce)")
    option(decode, "--packet NAME", str, "only packets of this name (repeatable)", action="append")
    _add_link_options(decode)
    finish(decode, run_decode)

    check = commands.add_parser("check", help="account for every octet of a downlink")
    option(check, "file FILE", Path)
    option(check, "--strict", bool, "exit 1 when anything is damaged, missing or skipped")
    _add_definition_options(check)
    _add_link_options(check)
    finish(check, run_check)

    icd = commands.add_parser("icd", help="the interface control document, in Markdown")
    option(icd, "--out F", Path, "write there (default: standard output)")
    finish(icd, run_icd)

    xtce = commands.add_parser("xtce", help="the dictionary as XTCE 1.2")
    option(xtce, "--out F", Path, "write there (default: standard output)")
    option(xtce, "--unrolled", bool, "without arrays, for decoders that do not support them")
    finish(xtce, run_xtce)

    yamcs = commands.add_parser("yamcs", help="configuration of a Yamcs instance for our frames and telecommands")
    option(yamcs, "--out DIR", Path, "folder in which Yamcs is started", required=True)
    option(yamcs, "--frame-port N", int, "UDP port of Yamcs for frames", 10016)
    option(yamcs, "--station HOST:PORT", str, "TCP port of the station for telecommands", "127.0.0.1:10025")
    option(yamcs, "--spacecraft-id ID", lambda text: int(text, 0), "", 76)
    option(yamcs, "--frame-length N", int, "octets of a transfer frame", 1115)
    option(yamcs, "--no-frame-checksum", bool, "frames carry no frame error control")
    finish(yamcs, run_yamcs)

    frames = commands.add_parser("frames", help="send plain frames of a downlink as UDP datagrams, as Yamcs takes them")
    option(frames, "source SOURCE", str, "file of CADUs, or HOST:PORT of a station")
    option(frames, "--to HOST:PORT", str, "", "127.0.0.1:10016")
    _add_link_options(frames)
    finish(frames, run_frames)


def run_decode(arguments: argparse.Namespace) -> int:
    from tmtc.dictionary.payload import DICTIONARY
    from tmtc.export import format_records, packet_records

    if arguments.xtce:
        return _decode_foreign(arguments)
    _refuse_without_definition(arguments)
    for name in arguments.packet or ():
        DICTIONARY.packet(name)
    decoded = _read(arguments)
    tables = decoded.tables()
    if arguments.packet:
        tables = {name: table for name, table in tables.items() if name in arguments.packet}
    records = packet_records(tables)
    if arguments.json and arguments.out is None:
        emit(arguments, {**decoded.accounting(), "telemetry": records})
        return _checked(arguments, records, decoded)
    octets = format_records(records, arguments.format)
    return _write(arguments, octets, len(records), decoded.accounting(), _describe(decoded)) or _checked(
        arguments, records, decoded
    )


def _decode_foreign(arguments: argparse.Namespace) -> int:
    """Decode packets of another mission through its XTCE."""
    from tmtc.xtce.series import format_xtce_records, xtce_records

    decoded, found, definition = _read_foreign(arguments)
    wanted, known = set(arguments.packet or ()), set(definition.containers)
    if wanted - known:
        listed = ", ".join(sorted(known)[:12])
        raise UsageError(f"--packet: expected a container ({listed}), found {min(wanted - known)!r}")
    if wanted:
        found = replace(found, tables={name: t for name, t in found.tables.items() if name in wanted})
    records = xtce_records(found, raw=arguments.raw)
    figures = {**decoded.accounting(), **_definition_figures(found, definition)}
    if arguments.json and arguments.out is None:
        emit(arguments, {**figures, "telemetry": records})
        return _checked(arguments, records, decoded)
    octets = format_xtce_records(records, arguments.format)
    text = f"{_describe(decoded)}\n{_describe_definition(found, definition)}"
    return _write(arguments, octets, len(records), figures, text) or _checked(arguments, records, decoded)


def _checked(arguments: argparse.Namespace, records: Sequence[object], decoded: DownlinkDecode) -> int:
    names = " or ".join(arguments.packet or ()) or "any that can be decoded"
    return checked(bool(records), f"a packet ({names}) among {decoded.packets}")


def _write(arguments: argparse.Namespace, octets: bytes, count: int, figures: dict[str, object], text: str) -> int:
    if arguments.out is None:
        sys.stdout.buffer.write(octets)
        return 0
    if count:
        save(arguments.out, octets)
    figures = {**figures, "written": count, "out": str(arguments.out)}
    done = f"{count} packets written to {arguments.out}" if count else f"{arguments.out}: not written"
    return emit(arguments, figures, text=f"{done}\n{text}")


def run_check(arguments: argparse.Namespace) -> int:
    if arguments.xtce:
        decoded, found, definition = _read_foreign(arguments)
        figures = {**decoded.accounting(), **_definition_figures(found, definition)}
        emit(arguments, figures, text=f"{_describe(decoded)}\n{_describe_definition(found, definition)}")
    else:
        _refuse_without_definition(arguments)
        decoded = _read(arguments)
        emit(arguments, decoded.accounting(), text=_describe(decoded))
    return 1 if arguments.strict and not decoded.complete else 0


def _read_foreign(arguments: argparse.Namespace) -> tuple[DownlinkDecode, XtceDecode, Definition]:
    """The downlink, its packets through the definition, and the definition."""
    from tmtc.dictionary.schema import Dictionary
    from tmtc.xtce.decode import DECODED, JOINED, Decoder
    from tmtc.xtce.importing import parse_xtce

    documents = {str(path): path.read_bytes() for path in arguments.xtce}
    definition = parse_xtce(documents, arguments.leading_size)
    decoder = Decoder(definition, arguments.container)
    decoded = _read(arguments, Dictionary(version=0, telemetry=()))
    checksum = 0 if arguments.no_error_control else 2
    found = decoder.decode(decoded.buffer, decoded.cut, decoded.headers, whole_stream=True, checksum_octets=checksum)
    known = (found.verdict == DECODED) | (found.verdict == JOINED)
    unknown = int((decoded.cut.crc_ok & ~known).sum())
    return replace(decoded, unknown=unknown), found, definition


def _refuse_without_definition(arguments: argparse.Namespace) -> None:

    for name in ("container", "leading_size", "raw"):
        if getattr(arguments, name, None):
            raise UsageError(f"--{name.replace('_', '-')}: expected --xtce DEFINITION with it, found none")


def run_icd(arguments: argparse.Namespace) -> int:
    from payload_emulator.flight.onboard.icd import format_interfaces
    from tmtc.dictionary.icd import format_icd

    return _document(arguments, f"{format_icd()}\n{format_interfaces()}")


def run_xtce(arguments: argparse.Namespace) -> int:
    from tmtc.xtce.export import format_xtce

    return _document(arguments, format_xtce(unrolled=arguments.unrolled))


def run_yamcs(arguments: argparse.Namespace) -> int:
    from tmtc.xtce.export import yamcs_files

    checksum, station = not arguments.no_frame_checksum, _address("--station", arguments.station)
    files = yamcs_files(arguments.spacecraft_id, arguments.frame_length, checksum, arguments.frame_port, station)
    for name, text in files.items():
        path = arguments.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path, text.encode())
    paths = [str(arguments.out / name) for name in files]
    return emit(arguments, {"files": paths}, text="\n".join(paths))


def run_frames(arguments: argparse.Namespace) -> int:
    import socket
    import time

    from tmtc.link.frame_reading import plain_frames
    from tmtc.link.settings import LinkSettings

    target, count = _address("--to", arguments.to), 0
    settings = _link_settings(arguments) or LinkSettings()
    path = Path(arguments.source)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        pieces = _file_pieces(path) if path.is_file() else _received(_address("SOURCE (no file)", arguments.source))
        for frame in plain_frames(pieces, settings):
            sender.sendto(frame, target)
            count += 1
            if path.is_file():
                time.sleep(_PAUSE_S)
    return emit(arguments, {"frames": count}, text=f"{count} frames sent to {arguments.to}")


def _file_pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        while piece := stream.read(1 << 20):
            yield piece


def _received(address: tuple[str, int]) -> Iterator[bytes]:
    import socket

    try:
        connection = socket.create_connection(address)
    except OSError as error:
        host, port = address
        raise UsageError(f"SOURCE: expected a station at {host}:{port}, found {error.strerror}") from None
    with connection:
        while piece := connection.recv(1 << 16):
            yield piece


def _address(option: str, text: str) -> tuple[str, int]:

    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise UsageError(f"{option}: expected HOST:PORT, found {text!r}")
    return host, int(port)


def _document(arguments: argparse.Namespace, text: str) -> int:
    from tmtc.dictionary.payload import DICTIONARY

    figures = {"dictionary_version": DICTIONARY.version, "dictionary_hash": DICTIONARY.hash}
    if arguments.out is None:
        return emit(arguments, {**figures, "text": text}, text=text.rstrip("\n"))
    save(arguments.out, text.encode())
    return emit(arguments, {**figures, "out": str(arguments.out)}, text=f"written to {arguments.out}")


def _add_definition_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("packets of other missions")
    option(
        group,
        "--xtce DEFINITION",
        Path,
        "decode through this XTCE file in place of the payload's dictionary (repeatable)",
        action="append",
    )
    option(
        group,
        "--container NAME",
        str,
        "container that packets begin with (repeatable; default: those without a base)",
        action="append",
    )
    option(
        group,
        "--leading-size",
        ("octets", "bits"),
        "what a size before a text counts (default: octets in documents of Yamcs and F Prime, else bits)",
    )
    option(group, "--no-error-control", bool, "packets do not end with a checksum (CRC-16)")
    option(group, "--prefix-octets N", int, "octets before each packet of a file without frames (default: tried)")


def _add_link_options(parser: argparse.ArgumentParser) -> None:
    link = parser.add_argument_group("link", "settings of the link; found out from the file where not given")
    option(link, "--frame-length N", int, "octets of a transfer frame")
    option(link, "--coding", ("rs", "none"))
    option(link, "--randomiser", ("none", "legacy", "long"))
    option(link, "--interleave I", int)
    option(link, "--no-frame-checksum", bool, "frames carry no frame error control")
    option(link, "--spacecraft-id ID", lambda text: int(text, 0))


def _link_settings(arguments: argparse.Namespace) -> LinkSettings | None:
    """Return the stated settings of the link, None without any."""
    from tmtc.link.settings import LinkSettings

    names = ("frame_length", "coding", "randomiser", "interleave")
    chosen = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    if arguments.no_frame_checksum:
        chosen["checksum"] = False
    return LinkSettings(**chosen) if chosen else None


def _read(arguments: argparse.Namespace, dictionary: Dictionary | None = None) -> DownlinkDecode:
    from tmtc.arrays import as_octets
    from tmtc.dictionary.payload import DICTIONARY
    from tmtc.downlink import decode
    from tmtc.errors import UnknownCoding
    from tmtc.packets.stream import PacketForm, find_prefix

    octets = arguments.file.read_bytes()
    form = PacketForm(not arguments.no_error_control, prefix_octets=arguments.prefix_octets or 0)
    settings = _link_settings(arguments)
    own = DICTIONARY if dictionary is None else dictionary
    read = partial(decode, octets, settings=settings, spacecraft_id=arguments.spacecraft_id, dictionary=own)
    try:
        decoded = read(form=form)
        is_bare = decoded.settings is None and arguments.prefix_octets is None
        if is_bare and decoded.octets_skipped > decoded.packets:
            prefixed = read(form=replace(form, prefix_octets=find_prefix(as_octets(octets), form)))
            decoded = max(decoded, prefixed, key=lambda one: one.octets["packets"])
    except UnknownCoding as error:
        raise UsageError(f"{arguments.file}: expected {error.expected}, found {error.found}") from error
    if not decoded.packets and not decoded.frame_count:
        raise UsageError(f"{arguments.file}: expected CADUs or space packets, found none in its {len(octets)} octets")
    return decoded


def _definition_figures(found: XtceDecode, definition: Definition) -> dict[str, object]:
    return {
        "verdicts": found.counts(),
        "values_unknown": found.values_unknown(),
        "alarms_not_read": definition.alarms_not_read,
        "leading_size": definition.size_tags or None,
    }


def _describe_definition(found: XtceDecode, definition: Definition) -> str:
    counts = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in found.counts().items() if count)
    lines = ["definition: " + (counts or "no packets")]
    unknown = ", ".join(f"{name} {count}" for name, count in found.values_unknown().items())
    if unknown:
        lines.append(f"  values not known (outside their calibrator, or no text): {unknown}")
    behind = ", ".join(f"{name} {low} to {high}" for name, (low, high) in found.bits_not_read().items())
    if behind:
        lines.append(f"  bits behind the last entry, not read: {behind}")
    return "\n".join([*lines, *(f"  {remark}" for remark in definition.remarks)])


def _describe(decoded: DownlinkDecode) -> str:
    lines, sequence = [], decoded.sequence
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
        f"packets {decoded.packets}: missing {sequence.missing} in {sequence.gaps} gaps, "
        f"duplicates {sequence.duplicates}, conflicts {sequence.conflicts}, "
        f"wrong checksum {decoded.crc_errors}, not in the dictionary {decoded.unknown}"
    )
    if sequence.conflicts:
        lines.append("  conflict: a packet with the count of another one of its APID and other content")
    if sequence.restarts:
        times = "once" if sequence.restarts == 1 else f"{sequence.restarts} times"
        lines.append(f"  counts restart {times}; how many packets are missing around a restart is unknown")
    if decoded.prefix_octets:
        lines.append(f"  each behind {decoded.prefix_octets} other octets")
    lines += [f"  APID 0x{apid:03X}: {count}" for apid, count in decoded.by_apid.items()]
    total = sum(decoded.octets.values())
    parts = [f"{name.replace('_', ' ')} {count}" for name, count in decoded.octets.items() if count]
    lines.append(f"octets {total}: " + ", ".join(parts))
    return "\n".join(lines)
