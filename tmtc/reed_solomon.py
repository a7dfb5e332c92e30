"""Reed-Solomon (255,223) and (255,239) of CCSDS 131.0-B: interleaved, shortened, dual or conventional basis.

Encoding and the check whether codewords are clean are linear over bits, so both are sums (exclusive or) of
one table row per symbol, done for all codewords at once; the tables are made for the basis in use and no
symbol is converted. Only codewords with errors go through the decoder proper, in the conventional basis, again
many at once, so that a stream of nothing but noise does not hold up its reader.

References
----------
CCSDS 131.0-B section 4: field x^8 + x^7 + x^2 + x + 1, generator roots a^(11 j), j = 128 - E .. 127 + E;
annex F for the dual basis.
"""

from __future__ import annotations

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
    dirty = np.argwhere(~clean(blocks, code))
    if dirty.size:
        frames = frames.copy()
        words = blocks.reshape(blocks.shape[0], CODEWORD - code.virtual_fill, code.interleave)
        data = frames.reshape(-1, code.symbols, code.interleave)
        for start in range(0, dirty.shape[0], _BLOCK):
            block, column = dirty[start : start + _BLOCK].T
            data[block, :, column], corrected[block, column] = repair(words[block, :, column], code)
    return RsDecode(frames, corrected)


def clean(blocks: OctetArray, code: ReedSolomon) -> BoolArray:
    """Whether each codeword of codeblocks (n, block_length) is free of errors, shape (n, interleave)."""
    words = blocks.reshape(blocks.shape[0], CODEWORD - code.virtual_fill, code.interleave)
    result = np.empty((blocks.shape[0], code.interleave), dtype=np.bool_)
    for start in range(0, blocks.shape[0], _BLOCK):
        part = words[start : start + _BLOCK]
        same = _parity(part[:, : code.symbols], code) == part[:, code.symbols :]
        result[start : start + _BLOCK] = same.all(axis=1)
    return result


def repair(words: OctetArray, code: ReedSolomon) -> tuple[OctetArray, npt.NDArray[np.int16]]:
    """Data symbols (n, symbols) and corrected symbols (n,) of codewords (n, 255 - virtual fill) as sent.

    Where a codeword has more wrong symbols than the code repairs, its data stay as they are and the count is
    `UNCORRECTABLE`.

    References
    ----------
    Berlekamp and Massey's algorithm without inversions, Chien's search, Forney's formula (for example Blahut,
    Algebraic Codes for Data Transmission, chapter 7), each step for all codewords at once.
    """
    to_dual, from_dual = dual_basis_tables()
    received = np.zeros((words.shape[0], CODEWORD), dtype=np.uint8)
    received[:, code.virtual_fill :] = from_dual[words] if code.dual_basis else words
    syndromes = _syndromes(received, code.errors)
    locator = _error_locator(syndromes, code.errors)
    values = _error_values(syndromes, locator, code.errors)
    count = np.count_nonzero(values, axis=1)
    degree = locator.shape[1] - 1 - np.argmax(locator[:, ::-1] != 0, axis=1)
    # as many roots as the locator promises, none where zeros were never sent, and a codeword afterwards
    good = (degree == count) & (count <= code.errors) & ~values[:, : code.virtual_fill].any(axis=1)
    mended = received ^ values
    good &= ~_syndromes(mended, code.errors).any(axis=1)
    mended = np.where(good[:, None], mended, received)[:, code.virtual_fill : CODEWORD - code.parity]
    counts = np.where(good, count, UNCORRECTABLE).astype(np.int16)
    return (to_dual[mended] if code.dual_basis else mended), counts


def _syndromes(received: OctetArray, errors: int) -> OctetArray:
    """Values (n, parity) of codewords (n, 255) in the conventional basis at the generator's roots."""
    whole = ReedSolomon(errors, 1, 0, dual_basis=False)
    parity = _parity(received[:, : whole.symbols, None], whole)[:, :, 0]
    # a codeword plus the difference of check symbols: its value at a root is that of the difference alone
    difference = parity ^ received[:, whole.symbols :]
    times, roots = _multiplication_table(), _roots(errors)
    value = np.zeros((received.shape[0], 2 * errors), dtype=np.uint8)
    for k in range(2 * errors):
        value = times[roots, value] ^ difference[:, k : k + 1]
    return value


def _error_locator(syndromes: OctetArray, errors: int) -> OctetArray:
    """Coefficients (n, parity + 1), lowest power first, of the polynomial whose roots locate the errors."""
    times = _multiplication_table()
    n, parity = syndromes.shape
    locator = np.zeros((n, parity + 1), dtype=np.uint8)
    locator[:, 0] = 1
    before = locator.copy()
    scale = np.ones(n, dtype=np.uint8)
    length = np.zeros(n, dtype=np.int64)
    for step in range(parity):
        terms = times[locator[:, : step + 1], syndromes[:, step::-1][:, : step + 1]]
        discrepancy = np.bitwise_xor.reduce(terms, axis=1)
        shifted = np.zeros_like(before)
        shifted[:, 1:] = before[:, :-1]
        after = times[scale[:, None], locator] ^ times[discrepancy[:, None], shifted]
        longer = (discrepancy != 0) & (2 * length <= step)
        before = np.where(longer[:, None], locator, shifted)
        scale = np.where(longer, discrepancy, scale)
        length = np.where(longer, step + 1 - length, length)
        locator = after
    return locator


def _error_values(syndromes: OctetArray, locator: OctetArray, errors: int) -> OctetArray:
    """What was added (n, 255) to each symbol, by the roots of the locator."""
    times, inverse = _multiplication_table(), _inverses()
    n, parity = syndromes.shape
    locator = locator[:, : errors + 1]
    # evaluator: the product with the syndromes, powers below the parity
    evaluator = np.zeros((n, parity), dtype=np.uint8)
    for k in range(errors + 1):
        evaluator[:, k:] ^= times[locator[:, k : k + 1], syndromes[:, : parity - k]]
    powers = _inverse_powers(parity)
    total, odd = np.zeros((n, CODEWORD), dtype=np.uint8), np.zeros((n, CODEWORD), dtype=np.uint8)
    for k in range(errors + 1):
        term = times[locator[:, k : k + 1], powers[k]]
        total ^= term
        if k % 2:
            odd ^= term
    values = np.zeros((n, CODEWORD), dtype=np.uint8)
    word, place = np.nonzero((total == 0) & (odd != 0))
    numerator = np.zeros(word.size, dtype=np.uint8)
    for k in range(errors):
        numerator ^= times[evaluator[word, k], powers[k, place]]
    # the odd terms of the locator are its derivative divided by the place
    value = times[times[numerator, inverse[odd[word, place]]], _offsets(errors)[place]]
    values[word, place] = value
    return values


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
def _roots(errors: int) -> npt.NDArray[np.intp]:
    """The generator's roots."""
    exponent, _ = _field_tables()
    roots: npt.NDArray[np.intp] = exponent[11 * np.arange(128 - errors, 128 + errors) % 255].astype(np.intp)
    return roots


@functools.cache
def _inverse_powers(count: int) -> OctetArray:
    """(count, 255): powers 0, 1, ... of the inverse of every symbol's place b^(254 - index), b = a^11."""
    exponent, _ = _field_tables()
    places = 11 * (254 - np.arange(CODEWORD))
    powers: OctetArray = exponent[-np.arange(count)[:, None] * places % 255].astype(np.uint8)
    return powers


@functools.cache
def _offsets(errors: int) -> OctetArray:
    """(255,): the place of every symbol to the power -(128 - E)."""
    exponent, _ = _field_tables()
    places = 11 * (254 - np.arange(CODEWORD))
    return exponent[-(128 - errors) * places % 255].astype(np.uint8)


@functools.cache
def _inverses() -> OctetArray:
    exponent, logarithm = _field_tables()
    inverse = np.zeros(256, dtype=np.uint8)
    inverse[1:] = exponent[-logarithm[1:] % 255]
    return inverse


def _times(a: int, b: int) -> int:
    return int(_multiplication_table()[a, b])
