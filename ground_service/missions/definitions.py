"""Definitions of the packets that a mission description declares: XTCE documents, time codes and error control."""

import base64
import binascii
import gzip
import hashlib
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from ground_service.errors import InvalidInput
from ground_service.missions.model import XTCE_COMPRESSED, Mission, PacketSource, format_toml
from ground_service.toml import read_table
from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import DefinitionError
from tmtc.packets.space_packets import IDLE_APID
from tmtc.packets.stream import CHECKED, PacketForm
from tmtc.xtce.decode import Decoder
from tmtc.xtce.definition import packet_apids
from tmtc.xtce.importing import parse_xtce
from tmtc.xtce.nodes import MAX_OCTETS
from tmtc.xtce.series import SeriesValue, packet_layouts

DECODING_VERSION = 2
"""Version of the values that decoding gives. Stored packets are decoded again if it changes."""

DOCUMENTS_LIMIT_OCTETS = 16 << 20
"""Largest size of all XTCE documents of a mission description together: their elements take ten times as much."""

EMBEDDED_AS_TEXT_OCTETS = 64 << 10
"""Longer XTCE files are embedded compressed, since a mission description has a limited length."""


@dataclass(frozen=True, slots=True, eq=False)
class DeclaredPackets:
    """Packets of some APIDs: `decoder` and `layouts` of their definition, None and empty without one.

    `first_number` is the number of the first container in the archive; the others follow in the order of `layouts`.
    """

    source: PacketSource
    decoder: Decoder | None
    layouts: dict[str, tuple[SeriesValue, ...]]
    first_number: int

    @property
    def numbers(self) -> dict[str, int]:
        """Numbers of the containers by name."""
        return {name: self.first_number + place for place, name in enumerate(self.layouts)}


@dataclass(frozen=True, slots=True, eq=False)
class PacketDefinitions:
    """All declared packets of a mission description; `digest` identifies what is declared.

    `form`: if there are packets without a checksum, it is unknown whether those have one that neither the description
    nor the dictionary of the payload declares.
    """

    digest: str = ""
    declared: tuple[DeclaredPackets, ...] = ()
    form: PacketForm = CHECKED

    @property
    def apids(self) -> tuple[int, ...]:
        """APIDs with a definition."""
        return tuple(sorted(apid for one in self.declared if one.decoder for apid in one.source.apids))


def packet_definitions(mission: Mission) -> PacketDefinitions:
    """Return what a mission description declares, compiled; the same declarations are compiled once.

    Raises
    ------
    DefinitionError
        A document is not XTCE that is supported.
    """
    return _compiled(mission.packets or ())


def definition_faults(mission: Mission, source: str) -> list[InvalidInput]:
    """Return one fault for each declaration that cannot be used: documents of packets, approval; empty if all can."""
    faults = []
    if mission.approval.windows == "automatic" and mission.critical_in_windows:
        expected = "approval.one_person_for with the telecommands of a window that is approved automatically"
        needed = ", ".join(mission.critical_in_windows)
        faults.append(InvalidInput(source, "approval.windows", expected, f"a second person needed for {needed}"))
    sources, unpacked = mission.packets or (), 0
    for index, one in enumerate(sources):
        try:
            unpacked += sum(len(_document(entry, DOCUMENTS_LIMIT_OCTETS)) for entry in one.xtce or ())  # one at a time
            if unpacked > DOCUMENTS_LIMIT_OCTETS:
                raise DefinitionError(f"expected {DOCUMENTS_LIMIT_OCTETS >> 20} MiB of documents in all, found more")
            _decoder(one)
        except DefinitionError as error:
            faults.append(InvalidInput(source, f"packets.{index}.xtce", "XTCE that is supported", str(error)))
    return faults


def read_mission_file(path: Path) -> bytes:
    """Return the octets of a mission description with the XTCE files that it names embedded.

    Raises
    ------
    InvalidInput
        The file, or an XTCE file that it names, cannot be read.
    """
    try:
        octets = path.read_bytes()
    except OSError as error:
        raise InvalidInput(str(path), "", "a file that can be read", error.strerror or str(error)) from None
    try:
        text = octets.decode("utf-8")
    except UnicodeDecodeError:
        return octets
    return embed_documents(text, path.parent, str(path)).encode()


def minimal_description(xtce: Path, spacecraft_id: int) -> str:
    """Return a mission description of packets without checksum that an XTCE file defines.

    Their APIDs are the numbers with which its containers compare the APID of the primary header.

    Raises
    ------
    InvalidInput
        The file cannot be read, is not XTCE that is supported, or compares no APID.
    """
    document = _embedded(xtce, str(xtce), "")
    try:
        decoder = Decoder(parse_xtce({xtce.name: _document(document)}))
    except DefinitionError as error:
        raise InvalidInput(str(xtce), "", "XTCE that is supported", str(error)) from None
    apids = sorted({apid for root in decoder.roots for apid in packet_apids(root)[0] if apid < IDLE_APID})
    if not apids:
        raise InvalidInput(str(xtce), "Comparison", "a container that compares its APID with a number", "none")
    packets = {"name": xtce.stem[:64], "apids": apids, "packet_checksum": "none", "xtce": [document]}
    return format_toml({"name": xtce.stem, "spacecraft": {"id": spacecraft_id}, "packets": [packets]})


def definition_remarks(mission: Mission) -> list[str]:
    """Return what a person should know of the XTCE documents of a mission description, one line each."""
    return [
        f"packets {one.source.name}: {remark}"
        for one in packet_definitions(mission).declared
        if one.decoder is not None
        for remark in one.decoder.definition.remarks
    ]


def embed_documents(text: str, folder: Path, source: str) -> str:
    """Return a mission description with the XTCE files that it names as paths, relative to `folder`, embedded.

    Text that is not TOML is returned as it is.

    Raises
    ------
    InvalidInput
        A file is not readable or not text.
    """
    try:
        table = read_table(text, source, "TOML")
    except InvalidInput:
        return text
    packets = table.get("packets")
    named = False
    for index, one in enumerate(packets if isinstance(packets, list) else ()):
        documents = one.get("xtce") if isinstance(one, dict) else None
        if not isinstance(documents, list):
            continue
        for place, entry in enumerate(documents):
            if isinstance(entry, str) and not entry.lstrip().startswith(("<", XTCE_COMPRESSED)):
                documents[place] = _embedded(folder / entry, source, f"packets.{index}.xtce")
                named = True
    return format_toml(table) if named else text


def _embedded(path: Path, source: str, place: str) -> str:
    try:
        octets = path.read_bytes()
    except OSError as error:
        raise InvalidInput(source, place, f"the file {path}", error.strerror or "none") from None
    try:
        text = octets.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = ""
    if text.lstrip().startswith("<") and len(octets) <= EMBEDDED_AS_TEXT_OCTETS:
        return text
    return XTCE_COMPRESSED + base64.b64encode(gzip.compress(octets, mtime=0)).decode()


def _document(entry: str, limit_octets: int = MAX_OCTETS) -> str | bytes:
    """Return an embedded document."""
    if not entry.startswith(XTCE_COMPRESSED):
        return entry
    try:
        packed = base64.b64decode(entry.removeprefix(XTCE_COMPRESSED), validate=True)
        unpacking = zlib.decompressobj(zlib.MAX_WBITS | 16)
        octets = unpacking.decompress(packed, limit_octets + 1)
    except (binascii.Error, ValueError, zlib.error):
        raise DefinitionError("embedded document: expected gzip in base64, found other text") from None
    if not unpacking.eof or len(octets) > limit_octets:
        raise DefinitionError(f"embedded document: expected at most {limit_octets} whole octets, found others")
    return octets


def _decoder(source: PacketSource) -> Decoder | None:
    if not source.xtce:
        return None
    documents = {f"{source.name} [{index}]": _document(entry) for index, entry in enumerate(source.xtce)}
    return Decoder(parse_xtce(documents, source.leading_size), source.container)


@lru_cache(maxsize=16)
def _compiled(sources: Sequence[PacketSource]) -> PacketDefinitions:
    if not sources:
        return PacketDefinitions()
    listed = [one.model_dump(mode="json", exclude_none=True) for one in sources]
    stated = json.dumps([DECODING_VERSION, listed], sort_keys=True)
    declared = []
    number = 0
    for source in sources:
        decoder = _decoder(source)
        layouts = {} if decoder is None else dict(sorted(packet_layouts(*decoder.roots).items()))
        declared.append(DeclaredPackets(source, decoder, layouts, number))
        number += len(layouts)
    unchecked = {apid for one in sources if one.packet_checksum == "none" for apid in one.apids}
    known = {apid for one in sources for apid in one.apids} | {one.apid for one in DICTIONARY.telemetry}
    unknown = frozenset(range(IDLE_APID)) - known if unchecked else frozenset()
    form = PacketForm(unchecked=frozenset(unchecked), unknown=unknown)
    return PacketDefinitions(hashlib.sha256(stated.encode()).hexdigest(), tuple(declared), form)
