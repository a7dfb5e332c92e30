"""Frames of synchronised CADUs: de-randomised and corrected."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tmtc import cadu, reed_solomon
from tmtc.arrays import BoolArray, OctetArray
from tmtc.frames import frame_checksums_hold
from tmtc.link import LinkSettings
from tmtc.randomiser import randomise

_BATCH = 512


def read_frames(
    stream: OctetArray, sync: cadu.CaduSync, settings: LinkSettings
) -> tuple[OctetArray, npt.NDArray[np.int16]]:
    """Return frames (n, frame_length) and corrected symbols (n, interleave), -1 where a codeword is lost."""
    code = settings.code
    n = sync.start_bits.size
    frames = np.empty((n, settings.frame_length), dtype=np.uint8)
    corrected = np.zeros((n, code.interleave if code else 1), dtype=np.int16)
    for first in range(0, n, _BATCH):
        part = slice(first, min(first + _BATCH, n))
        cadus = cadu.cadu_octets(stream, sync.take(np.arange(part.start, part.stop)))
        blocks = randomise(cadus[:, cadu.ASM_LENGTH :], settings.randomiser)
        if code is None:
            frames[part] = blocks
        else:
            repaired = reed_solomon.decode(blocks, code)
            frames[part], corrected[part] = repaired.frames, repaired.corrected
    return frames, corrected


def proof_of(stream: OctetArray, settings: LinkSettings) -> cadu.Verify | None:
    """Return a function that checks the code or checksum of CADUs; None if frames have neither."""
    if not settings.proves_frames:
        return None

    def proves(sync: cadu.CaduSync) -> BoolArray:
        frames, corrected = read_frames(stream, sync, settings)
        repaired: BoolArray = np.all(corrected >= 0, axis=1)
        return repaired & frame_checksums_hold(frames) if settings.checksum else repaired

    return proves
