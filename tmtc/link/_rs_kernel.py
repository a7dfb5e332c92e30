"""Compiled check symbols of Reed-Solomon codewords, and their correction in the conventional basis.

Products of field elements by fixed powers are rows of tables, added eight symbols at a time as 64-bit words. If the
shortest recurrence of the syndromes has length L <= E and its polynomial has L different roots, the errors at these
places explain all syndromes; no further check is needed.

References
----------
Berlekamp and Massey's algorithm, Chien's search, Forney's formula (for example Blahut, Algebraic Codes for Data
Transmission, chapter 7).
"""

# numba wants numpy integers where annotations say int
# mypy: disable-error-code="return-value,arg-type,no-any-return"

import numpy as np

from kernels.compiled import njit
from tmtc.arrays import RecordArray

CODEWORD = 255
_GROUP = 16


@njit(nogil=True, ahead="u1[:, :, ::1].copy(readonly=True), i8, i8, u8[:, :, ::1], u8[:, :, ::1]")
def add_checks(words: RecordArray, first: int, symbols: int, table: RecordArray, check: RecordArray) -> None:
    """Add the check symbols of each codeword to `check` (n, interleave, parity / 8) uint64.

    `words` (n, at least symbols, interleave) are the codewords as sent; the table has a row for each place from the
    first symbol of a whole codeword, of which `first` are not sent.
    """
    lanes = table.shape[2]
    for start in range(0, words.shape[0], _GROUP):
        stop = min(start + _GROUP, words.shape[0])
        for k in range(symbols):
            rows = table[first + k]
            for n in range(start, stop):
                for c in range(words.shape[2]):
                    value = words[n, k, c]
                    if lanes == 4:
                        check[n, c, 0] ^= rows[value, 0]
                        check[n, c, 1] ^= rows[value, 1]
                        check[n, c, 2] ^= rows[value, 2]
                        check[n, c, 3] ^= rows[value, 3]
                    else:
                        check[n, c, 0] ^= rows[value, 0]
                        check[n, c, 1] ^= rows[value, 1]


@njit(nogil=True)
def correct(
    words: RecordArray,
    fill: int,
    errors: int,
    parity_table: RecordArray,
    syndrome_table: RecordArray,
    place_table: RecordArray,
    exponent: RecordArray,
    logarithm: RecordArray,
    places: RecordArray,
    offsets: RecordArray,
    counts: RecordArray,
) -> None:
    """Correct codewords (n, 255) in place; `counts` (n,) becomes the corrected symbols, -1 where there are too many.

    Parameters
    ----------
    fill
        Number of leading zeros that were not sent.
    parity_table : (symbols, 256, errors / 4) uint64
        Check symbols of a codeword that has one value at one place and zeros elsewhere.
    syndrome_table : (parity, 256, errors / 4) uint64
        Values at the generator's roots of one value at one place of the check symbols.
    place_table : (errors + 1, 256, 32) uint64
        Products of a value and the inverses of all places to the power of the first index.
    exponent, logarithm
        Of the field; `exponent` (510,) goes round twice.
    places, offsets : (255,)
        Logarithms of the places, and of the places to the power -(128 - E).
    """
    parity = 2 * errors
    symbols = CODEWORD - parity
    lanes = parity_table.shape[2]
    check = np.zeros(lanes, dtype=np.uint64)
    packed = np.zeros(lanes, dtype=np.uint64)
    syndromes = packed.view(np.uint8)
    check_octets = check.view(np.uint8)
    locator = np.zeros(parity + 1, dtype=np.uint8)
    before = np.zeros(parity + 1, dtype=np.uint8)
    kept = np.zeros(parity + 1, dtype=np.uint8)
    evaluator = np.zeros(errors, dtype=np.uint8)
    sums = np.zeros(32, dtype=np.uint64)
    sum_octets = sums.view(np.uint8)
    found = np.zeros(errors, dtype=np.int64)
    values = np.zeros(errors, dtype=np.uint8)
    for n in range(words.shape[0]):
        word = words[n]
        check[:] = 0
        for k in range(fill, symbols):
            row = parity_table[k, word[k]]
            for lane in range(lanes):
                check[lane] ^= row[lane]
        packed[:] = 0
        for k in range(parity):
            row = syndrome_table[k, check_octets[k] ^ word[symbols + k]]
            for lane in range(lanes):
                packed[lane] ^= row[lane]
        clean = True
        for lane in range(lanes):
            if packed[lane] != 0:
                clean = False
        if clean:
            counts[n] = 0
            continue
        counts[n] = -1
        degree = _locate(syndromes, parity, errors, locator, before, kept, exponent, logarithm)
        if degree > errors:
            continue
        if not _find_places(locator, degree, fill, place_table, sums, sum_octets, found):
            continue
        _evaluate(syndromes, locator, degree, evaluator, exponent, logarithm)
        if not _error_values(found, locator, evaluator, degree, exponent, logarithm, places, offsets, values):
            continue
        for i in range(degree):
            word[found[i]] ^= values[i]
        counts[n] = degree


@njit(nogil=True)
def _find_places(
    locator: RecordArray,
    degree: int,
    fill: int,
    place_table: RecordArray,
    sums: RecordArray,
    sum_octets: RecordArray,
    found: RecordArray,
) -> bool:
    """Write the roots of the locator, evaluated at every place at once; False unless their number is its degree."""
    sums[:] = 0
    for k in range(degree + 1):
        row = place_table[k, locator[k]]
        for lane in range(32):
            sums[lane] ^= row[lane]
    number = 0
    for place in range(CODEWORD):
        if sum_octets[place] == 0:
            if number == degree or place < fill:
                return False
            found[number] = place
            number += 1
    return number == degree


@njit(nogil=True)
def _evaluate(
    syndromes: RecordArray,
    locator: RecordArray,
    degree: int,
    evaluator: RecordArray,
    exponent: RecordArray,
    logarithm: RecordArray,
) -> None:
    """Write the evaluator: the product of syndromes and locator, powers below the degree."""
    for k in range(degree):
        total = np.uint8(0)
        for j in range(k + 1):
            if locator[j] and syndromes[k - j]:
                total ^= exponent[logarithm[locator[j]] + logarithm[syndromes[k - j]]]
        evaluator[k] = total


@njit(nogil=True)
def _error_values(
    found: RecordArray,
    locator: RecordArray,
    evaluator: RecordArray,
    degree: int,
    exponent: RecordArray,
    logarithm: RecordArray,
    places: RecordArray,
    offsets: RecordArray,
    values: RecordArray,
) -> bool:
    """Write the errors at the found places by Forney's formula; False if one of them is zero or undefined."""
    for i in range(degree):
        place = found[i]
        inverse = (255 - places[place]) % 255
        numerator = np.uint8(0)
        power = 0
        for k in range(degree):
            if evaluator[k]:
                numerator ^= exponent[logarithm[evaluator[k]] + power]
            power += inverse
            if power >= 255:
                power -= 255
        # the odd terms of the locator are its derivative divided by the place
        odd = np.uint8(0)
        power = inverse
        step = 2 * inverse % 255
        for k in range(1, degree + 1, 2):
            if locator[k]:
                odd ^= exponent[logarithm[locator[k]] + power]
            power += step
            if power >= 255:
                power -= 255
        if numerator == 0 or odd == 0:
            return False
        values[i] = exponent[(logarithm[numerator] + 255 - logarithm[odd] + offsets[place]) % 255]
    return True


@njit(nogil=True)
def _locate(
    syndromes: RecordArray,
    parity: int,
    errors: int,
    locator: RecordArray,
    before: RecordArray,
    kept: RecordArray,
    exponent: RecordArray,
    logarithm: RecordArray,
) -> int:
    """Write the error locator, lowest power first; return its degree, or more than `errors` if there is none."""
    locator[:] = 0
    before[:] = 0
    locator[0] = 1
    before[0] = 1
    length = 0
    reach = 0
    gap = 1
    scale = 0  # logarithm of the last discrepancy that changed the length
    for step in range(parity):
        discrepancy = syndromes[step]
        for k in range(1, length + 1):
            if locator[k] and syndromes[step - k]:
                discrepancy ^= exponent[logarithm[locator[k]] + logarithm[syndromes[step - k]]]
        if discrepancy == 0:
            gap += 1
            continue
        factor = (logarithm[discrepancy] + 255 - scale) % 255
        longer = 2 * length <= step
        if longer:
            for k in range(length + 1):
                kept[k] = locator[k]
        for k in range(min(reach, parity - gap) + 1):
            if before[k]:
                locator[k + gap] ^= exponent[logarithm[before[k]] + factor]
        if longer:
            for k in range(length + 1):
                before[k] = kept[k]
            reach = length
            length = step + 1 - length
            if length > errors:
                return errors + 1
            scale = logarithm[discrepancy]
            gap = 1
        else:
            gap += 1
    return length if locator[length] else errors + 1
