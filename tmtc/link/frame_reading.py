"""Frames of synchronised CADUs: de-randomised, corrected and checked."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray, as_octets
from tmtc.link import cadu, reed_solomon
from tmtc.link.frames import TmFrameHeaders, frame_checksums_hold, frame_headers, randomise
from tmtc.link.settings import LinkSettings

_BATCH = 512


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Frames (n, frame_length) of CADUs, and their headers.

    `corrected` (n, interleave): corrected symbols of each codeword, -1 where it is lost. `wrong_bits` (n,): corrected
    bits. `valid` (n,): codes and checksum are valid; True for frames that have neither.
    """

    octets: OctetArray
    header: TmFrameHeaders
    corrected: npt.NDArray[np.int16]
    wrong_bits: IntArray
    valid: BoolArray


def read_frames(stream: OctetArray, sync: cadu.CaduSync, settings: LinkSettings) -> Frames:
    """Return the frames of synchronised CADUs of a stream."""
    code = settings.code
    n = sync.start_bits.size
    frames = np.empty((n, settings.frame_length), dtype=np.uint8)
    corrected = np.zeros((n, code.interleave if code else 1), dtype=np.int16)
    wrong_bits = np.zeros(n, dtype=np.int64)
    for first in range(0, n, _BATCH):
        part = slice(first, min(first + _BATCH, n))
        cadus = cadu.cadu_octets(stream, sync.take(np.arange(part.start, part.stop)))
        blocks = randomise(cadus[:, cadu.ASM_LENGTH :], settings.randomiser)
        if code is None:
            frames[part] = blocks
        else:
            repaired = reed_solomon.decode(blocks, code)
            frames[part], corrected[part] = repaired.frames, repaired.corrected
            wrong_bits[part] = repaired.wrong_bits
    valid: BoolArray = np.all(corrected >= 0, axis=1)
    if settings.checksum and n:
        usable = np.flatnonzero(valid)
        valid[usable[~frame_checksums_hold(frames[usable])]] = False
    return Frames(frames, frame_headers(frames), corrected, wrong_bits, valid)


def plain_frames(pieces: Iterable[bytes], settings: LinkSettings) -> Iterator[bytes]:
    """Yield the valid frames of a stream of CADUs that arrives in pieces, corrected and without code and marker."""
    rest = b""
    for piece in pieces:
        rest += piece
        stream = as_octets(rest)
        sync = cadu.synchronise(stream, settings.cadu_length, verify=proof_of(stream, settings))
        found = read_frames(stream, sync, settings)
        yield from map(bytes, found.octets[found.valid])
        behind = int(sync.start_bits[-1]) // 8 + settings.cadu_length if sync.start_bits.size else 0
        rest = rest[max(behind, len(rest) - settings.cadu_length) :]


def proof_of(stream: OctetArray, settings: LinkSettings) -> cadu.Verify | None:
    """Return a function that checks the code or checksum of CADUs; None if frames have neither."""
    if not settings.proves_frames:
        return None
    return lambda sync: read_frames(stream, sync, settings).valid
