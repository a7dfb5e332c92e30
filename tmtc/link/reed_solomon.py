"""Reed-Solomon (255,223) and (255,239) of CCSDS 131.0-B: interleaved, shortened, dual or conventional basis.

Encoding and the check whether codewords are clean are linear over bits, so both are sums (exclusive or) of
one table row per symbol; the tables are made for the basis in use and no symbol is converted. Only codewords with
errors go through the decoder proper, in the conventional basis.

References
----------
CCSDS 131.0-B section 4: field x^8 + x^7 + x^2 + x + 1, generator roots a^(11 j), j = 128 - E .. 127 + E;
annex F for the dual basis.
"""

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray
from tmtc.errors import LinkFormatError

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
            raise LinkFormatError(f"Reed-Solomon: expected interleave 1, 2, 3, 4, 5 or 8, found {self.interleave}")
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
    """Frames (n, frame_length) and corrected symbols (n, interleave), `UNCORRECTABLE` where a codeword is lost.

    `wrong_bits` (n,): corrected bits of all codewords of a block.
    """

    frames: OctetArray
    corrected: npt.NDArray[np.int16]
    wrong_bits: npt.NDArray[np.int64]


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
        raise LinkFormatError(f"Reed-Solomon: expected frames of {code.frame_length} octets, found {frames.shape}")
    blocks = np.empty((frames.shape[0], code.block_length), dtype=np.uint8)
    blocks[:, : code.frame_length] = frames
    data = frames.reshape(-1, code.symbols, code.interleave)
    check = blocks[:, code.frame_length :].reshape(-1, code.parity, code.interleave)
    check[:] = _parity(data, code).transpose(0, 2, 1)
    return blocks


def decode(blocks: OctetArray, code: ReedSolomon) -> RsDecode:
    """Frames and corrected symbols of codeblocks (n, block_length)."""
    if blocks.ndim != 2 or blocks.shape[1] != code.block_length:
        raise LinkFormatError(f"Reed-Solomon: expected codeblocks of {code.block_length} octets, found {blocks.shape}")
    corrected = np.zeros((blocks.shape[0], code.interleave), dtype=np.int16)
    wrong_bits = np.zeros(blocks.shape[0], dtype=np.int64)
    frames = blocks[:, : code.frame_length]
    dirty = np.argwhere(~clean(blocks, code))
    if dirty.size:
        frames = frames.copy()
        words = blocks.reshape(blocks.shape[0], CODEWORD - code.virtual_fill, code.interleave)
        data = frames.reshape(-1, code.symbols, code.interleave)
        for start in range(0, dirty.shape[0], _BLOCK):
            block, column = dirty[start : start + _BLOCK].T
            received = words[block, :, column]
            mended, corrected[block, column] = repair(received, code)
            data[block, :, column] = mended[:, : code.symbols]
            np.add.at(wrong_bits, block, np.bitwise_count(received ^ mended).sum(axis=1, dtype=np.int64))
    return RsDecode(frames, corrected, wrong_bits)


def clean(blocks: OctetArray, code: ReedSolomon) -> BoolArray:
    """Return whether each codeword of codeblocks (n, block_length) is free of errors, shape (n, interleave)."""
    words = blocks.reshape(blocks.shape[0], CODEWORD - code.virtual_fill, code.interleave)
    sent = words[:, code.symbols :].transpose(0, 2, 1)
    result: npt.NDArray[np.bool_] = (_parity(words, code) == sent).all(axis=2)
    return result


def repair(words: OctetArray, code: ReedSolomon) -> tuple[OctetArray, npt.NDArray[np.int16]]:
    """Return codewords (n, 255 - virtual fill) as sent, corrected, and the number of corrected symbols (n,).

    A codeword with more wrong symbols than the code corrects is returned as it is, with the count `UNCORRECTABLE`.
    """
    from tmtc.link import _rs_kernel

    to_dual, from_dual = dual_basis_tables()
    received = np.zeros((words.shape[0], CODEWORD), dtype=np.uint8)
    received[:, code.virtual_fill :] = from_dual[words] if code.dual_basis else words
    counts = np.empty(words.shape[0], dtype=np.int16)
    exponent, logarithm = _field_tables()
    _rs_kernel.correct(
        received,
        code.virtual_fill,
        code.errors,
        _parity_table(code.errors, False),
        _syndrome_table(code.errors),
        _place_table(code.errors),
        np.concatenate((exponent, exponent)).astype(np.uint8),
        logarithm,
        _places(),
        -(128 - code.errors) * _places() % 255,
        counts,
    )
    mended = received[:, code.virtual_fill :]
    return (to_dual[mended] if code.dual_basis else mended), counts


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
    times = _multiplication_table()
    polynomial = [1]
    for j in range(128 - errors, 128 + errors):
        root = int(exponent[11 * j % 255])
        polynomial = [a ^ int(times[root, b]) for a, b in zip([*polynomial, 0], [0, *polynomial], strict=True)]
    return tuple(polynomial)


def _parity(words: OctetArray, code: ReedSolomon) -> OctetArray:
    """Check symbols (n, interleave, parity) of codewords (n, at least symbols, interleave)."""
    from tmtc.link import _rs_kernel

    table = _parity_table(code.errors, code.dual_basis)
    total = np.zeros((words.shape[0], code.interleave, table.shape[2]), dtype=np.uint64)
    readable = words.view()
    readable.flags.writeable = False  # one compiled variant for frames of every origin
    _rs_kernel.add_checks(readable, code.virtual_fill, code.symbols, table, total)
    return total.view(np.uint8)


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
def _field_tables() -> tuple[IntArray, IntArray]:
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


@functools.cache
def _places() -> npt.NDArray[np.int64]:
    """(255,): logarithm of the place b^(254 - index) of every symbol, b = a^11."""
    places: npt.NDArray[np.int64] = 11 * (254 - np.arange(CODEWORD)) % 255
    return places


@functools.cache
def _syndrome_table(errors: int) -> npt.NDArray[np.uint64]:
    """(parity, 256, parity / 8): values at the generator's roots of one value at one place of the check symbols."""
    exponent, _ = _field_tables()
    powers = 11 * np.arange(128 - errors, 128 + errors)
    place = 2 * errors - 1 - np.arange(2 * errors)
    table = _multiplication_table()[:, exponent[np.outer(place, powers) % 255]].transpose(1, 0, 2)
    return np.ascontiguousarray(table).view(np.uint64)


@functools.cache
def _place_table(errors: int) -> npt.NDArray[np.uint64]:
    """(errors + 1, 256, 32): products of a value and the inverses of all 255 places to a power; the last octet is 1."""
    exponent, _ = _field_tables()
    powers = exponent[-np.outer(np.arange(errors + 1), _places()) % 255]
    table = np.ones((errors + 1, 256, 256), dtype=np.uint8)
    table[:, :, :CODEWORD] = _multiplication_table()[:, powers].transpose(1, 0, 2)
    return table.view(np.uint64)
