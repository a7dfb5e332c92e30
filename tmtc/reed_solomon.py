"""Reed-Solomon (255,223) and (255,239) of CCSDS 131.0-B: interleaved, shortened, dual or conventional basis.

Encoding and the check whether codewords are clean are linear over bits, so both are sums (exclusive or) of
one table row per symbol, done for all codewords at once; the tables are made for the basis at hand and no
symbol is converted. Only codewords with errors go to the scalar decoder of `reedsolo`, in the conventional
basis.

References
----------
CCSDS 131.0-B section 4: field x^8 + x^7 + x^2 + x + 1, generator roots a^(11 j), j = 128 - E .. 127 + E;
annex F for the dual basis.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.errors import LinkFormatError, UncorrectableCodeword

OctetArray = npt.NDArray[np.uint8]

CODEWORD = 255
INTERLEAVES = (1, 2, 3, 4, 5, 8)
UNCORRECTABLE = -1

_FIELD = 0x187
_BLOCK = 2048


@dataclass(frozen=True, slots=True)
class ReedSolomon:
    """One setting of the code: `errors` (E) corrected per codeword, interleaving depth, leading zeros not sent."""

    errors: int = 16
    interleave: int = 5
    virtual_fill: int = 0
    dual_basis: bool = True

    def __post_init__(self) -> None:
        if self.errors not in (8, 16):
            raise LinkFormatError(f"Reed-Solomon: expected 8 or 16 corrected errors, found {self.errors}")
        if self.interleave not in INTERLEAVES:
            raise LinkFormatError(
                f"Reed-Solomon: expected interleave 1, 2, 3, 4, 5 or 8, found {self.interleave}"
            )
        if not 0 <= self.virtual_fill < CODEWORD - 2 * self.errors:
            raise LinkFormatError(
                f"Reed-Solomon: expected 0..{CODEWORD - 2 * self.errors - 1} symbols of virtual fill, "
                f"found {self.virtual_fill}"
            )

    @property
    def parity(self) -> int:
        """Check symbols of a codeword."""
        return 2 * self.errors

    @property
    def symbols(self) -> int:
        """Data symbols of a codeword as sent."""
        return CODEWORD - self.parity - self.virtual_fill

    @property
    def frame_length(self) -> int:
        """Octets of data in a codeblock."""
        return self.symbols * self.interleave

    @property
    def block_length(self) -> int:
        """Octets of a codeblock."""
        return (CODEWORD - self.virtual_fill) * self.interleave


@dataclass(frozen=True, slots=True, eq=False)
class RsDecode:
    """Frames (n, frame_length) and corrected symbols (n, interleave), `UNCORRECTABLE` where a codeword is lost."""

    frames: OctetArray
    corrected: npt.NDArray[np.int16]


def code_for(
    frame_length: int, errors: int = 16, interleave: int | None = None, dual_basis: bool = True
) -> ReedSolomon:
    """The code that carries frames of that length; the least interleave that does, unless one is given."""
    most = CODEWORD - 2 * errors
    for depth in INTERLEAVES if interleave is None else (interleave,):
        if frame_length > 0 and frame_length % depth == 0 and frame_length // depth <= most:
            return ReedSolomon(errors, depth, most - frame_length // depth, dual_basis)
    wanted = "1, 2, 3, 4, 5 or 8" if interleave is None else str(interleave)
    raise LinkFormatError(
        f"Reed-Solomon: expected a frame of interleave ({wanted}) times at most {most} octets, found {frame_length}"
    )


def encode(frames: OctetArray, code: ReedSolomon) -> OctetArray:
    """Codeblocks (n, block_length) of frames (n, frame_length)."""
    if frames.ndim != 2 or frames.shape[1] != code.frame_length:
        raise LinkFormatError(
            f"Reed-Solomon: expected frames of {code.frame_length} octets, found {frames.shape}"
        )
    blocks = np.empty((frames.shape[0], code.block_length), dtype=np.uint8)
    blocks[:, : code.frame_length] = frames
    data = frames.reshape(-1, code.symbols, code.interleave)
    check = blocks[:, code.frame_length :].reshape(-1, code.parity, code.interleave)
    for start in range(0, frames.shape[0], _BLOCK):
        part = slice(start, start + _BLOCK)
        check[part] = _parity(data[part], code)
    return blocks


def decode(blocks: OctetArray, code: ReedSolomon) -> RsDecode:
    """Frames and corrected symbols of codeblocks (n, block_length)."""
    if blocks.ndim != 2 or blocks.shape[1] != code.block_length:
        raise LinkFormatError(
            f"Reed-Solomon: expected codeblocks of {code.block_length} octets, found {blocks.shape}"
        )
    corrected = np.zeros((blocks.shape[0], code.interleave), dtype=np.int16)
    frames = blocks[:, : code.frame_length]
    dirty = ~clean(blocks, code)
    if dirty.any():
        frames = frames.copy()
        words = blocks.reshape(blocks.shape[0], CODEWORD - code.virtual_fill, code.interleave)
        data = frames.reshape(-1, code.symbols, code.interleave)
        for n, k in np.argwhere(dirty):
            try:
                data[n, :, k], corrected[n, k] = repair(words[n, :, k], code)
            except UncorrectableCodeword:
                corrected[n, k] = UNCORRECTABLE
    return RsDecode(frames, corrected)


def clean(blocks: OctetArray, code: ReedSolomon) -> npt.NDArray[np.bool_]:
    """Whether each codeword of codeblocks (n, block_length) is free of errors, shape (n, interleave)."""
    words = blocks.reshape(blocks.shape[0], CODEWORD - code.virtual_fill, code.interleave)
    result = np.empty((blocks.shape[0], code.interleave), dtype=np.bool_)
    for start in range(0, blocks.shape[0], _BLOCK):
        part = words[start : start + _BLOCK]
        same = _parity(part[:, : code.symbols], code) == part[:, code.symbols :]
        result[start : start + _BLOCK] = same.all(axis=1)
    return result


def repair(word: OctetArray, code: ReedSolomon) -> tuple[OctetArray, int]:
    """(data symbols, corrected symbols) of one codeword with errors, as sent (without its virtual fill).

    Raises
    ------
    UncorrectableCodeword
        More than `code.errors` symbols are wrong.
    """
    import reedsolo

    to_dual, from_dual = dual_basis_tables()
    conventional = from_dual[word] if code.dual_basis else word
    full = bytes(code.virtual_fill) + conventional.tobytes()
    try:
        message, _, positions = _scalar_codec(code.errors).decode(full)
    except reedsolo.ReedSolomonError:
        raise UncorrectableCodeword(
            f"Reed-Solomon: more than {code.errors} symbol errors in a codeword"
        ) from None
    data = np.frombuffer(bytes(message), dtype=np.uint8)
    # errors "found" in symbols that were never sent are not errors: too many others were
    if any(position < code.virtual_fill for position in positions):
        raise UncorrectableCodeword(f"Reed-Solomon: more than {code.errors} symbol errors in a codeword")
    data = data[code.virtual_fill :]
    return (to_dual[data] if code.dual_basis else data), len(positions)


@functools.cache
def dual_basis_tables() -> tuple[OctetArray, OctetArray]:
    """(dual of conventional, conventional of dual), each (256,); 131.0-B annex F: bit j is Tr(z a^(117 j))."""
    exponent, logarithm = _field_tables()
    to_dual = np.zeros(256, dtype=np.uint8)
    for value in range(1, 256):
        for j in range(8):
            z = int(exponent[(logarithm[value] + 117 * j) % 255])
            trace = 0
            for _ in range(8):
                trace ^= z
                z = int(exponent[2 * logarithm[z] % 255])
            to_dual[value] |= (trace & 1) << (7 - j)
    from_dual = np.zeros(256, dtype=np.uint8)
    from_dual[to_dual] = np.arange(256, dtype=np.uint8)
    return to_dual, from_dual


@functools.cache
def generator(errors: int) -> tuple[int, ...]:
    """Coefficients of the generator polynomial, highest power first."""
    exponent, _ = _field_tables()
    polynomial = [1]
    for j in range(128 - errors, 128 + errors):
        root = int(exponent[11 * j % 255])
        polynomial = [a ^ _times(root, b) for a, b in zip([*polynomial, 0], [0, *polynomial], strict=True)]
    return tuple(polynomial)


def _parity(data: OctetArray, code: ReedSolomon) -> OctetArray:
    """Check symbols (n, parity, interleave) of data symbols (n, symbols, interleave)."""
    table = _parity_table(code.errors, code.dual_basis)
    n = data.shape[0] * code.interleave
    # one row per symbol, so that each step reads a contiguous row of all codewords
    rows = np.ascontiguousarray(data.transpose(1, 0, 2)).reshape(code.symbols, n).astype(np.intp)
    total = np.zeros((n, table.shape[2]), dtype=np.uint64)
    row = np.empty_like(total)
    for position in range(code.symbols):
        np.take(table[code.virtual_fill + position], rows[position], axis=0, out=row, mode="clip")
        total ^= row
    parity = total.view(np.uint8).reshape(data.shape[0], code.interleave, code.parity)
    return parity.transpose(0, 2, 1)


@functools.cache
def _parity_table(errors: int, dual_basis: bool) -> npt.NDArray[np.uint64]:
    """(symbols, 256, parity / 8): check symbols of a codeword that has one value at one place and zeros elsewhere."""
    polynomial = generator(errors)
    symbols = CODEWORD - 2 * errors
    times = _multiplication_table()
    to_dual, from_dual = dual_basis_tables()
    # x^(parity + k) modulo the generator, k = 0 for the last data symbol
    remainder = np.array(polynomial[1:], dtype=np.uint8)
    table = np.empty((symbols, 256, 2 * errors), dtype=np.uint8)
    for position in range(symbols - 1, -1, -1):
        table[position] = to_dual[times[from_dual][:, remainder]] if dual_basis else times[:, remainder]
        lead = remainder[0]
        remainder = np.append(remainder[1:], np.uint8(0)) ^ times[lead, list(polynomial[1:])]
    return table.view(np.uint64)


@functools.cache
def _field_tables() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    exponent = np.zeros(255, dtype=np.int64)
    logarithm = np.zeros(256, dtype=np.int64)
    value = 1
    for power in range(255):
        exponent[power], logarithm[value] = value, power
        value = value << 1 ^ (_FIELD if value & 0x80 else 0)
    return exponent, logarithm


@functools.cache
def _multiplication_table() -> OctetArray:
    exponent, logarithm = _field_tables()
    table = np.zeros((256, 256), dtype=np.uint8)
    powers = logarithm[1:, None] + logarithm[None, 1:]
    table[1:, 1:] = exponent[powers % 255]
    return table


def _times(a: int, b: int) -> int:
    return int(_multiplication_table()[a, b])


@functools.cache
def _scalar_codec(errors: int) -> Any:
    import reedsolo

    exponent, _ = _field_tables()
    return reedsolo.RSCodec(
        nsym=2 * errors, nsize=CODEWORD, fcr=128 - errors, prim=_FIELD, generator=int(exponent[11])
    )
