import numpy as np
import reedsolo
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import array_equal
from numpy.random import default_rng
from pytest import mark, raises

from tmtc.errors import LinkFormatError
from tmtc.link.reed_solomon import (
    UNCORRECTABLE,
    ReedSolomon,
    clean,
    code_for,
    decode,
    dual_basis_tables,
    encode,
    generator,
    repair,
)


def frames_for(code, count=3, seed=0):
    return default_rng(seed).integers(0, 256, (count, code.frame_length), dtype=np.uint8)


def independent(errors):
    return reedsolo.RSCodec(nsym=2 * errors, nsize=255, fcr=128 - errors, prim=0x187, generator=173)


def test_the_generator_polynomial_and_the_dual_basis_are_those_of_the_standard():
    # CCSDS 131.0-B annex: palindromic, E = 16; coefficients as published with libfec
    half = "015B7F56101E0DEB61A5082A3656AB20"
    assert bytes(generator(16)).hex().upper() == half + "71" + "".join(
        half[k : k + 2] for k in range(len(half) - 2, -1, -2)
    )
    assert len(generator(8)) == 17 and generator(8) == generator(8)[::-1]
    to_dual, from_dual = dual_basis_tables()
    assert to_dual[:8].tobytes().hex().upper() == "007BAFD499E2364D"
    assert [int(to_dual[1 << bit]) for bit in range(8)] == [0x7B, 0xAF, 0x99, 0xFA, 0x86, 0xEC, 0xEF, 0x8D]
    assert array_equal(from_dual[to_dual], np.arange(256))


@mark.parametrize("errors", [8, 16])
def test_conventional_codewords_are_those_of_an_independent_encoder(errors):
    code = ReedSolomon(errors=errors, interleave=1, dual_basis=False)
    frame = frames_for(code, 1)
    theirs = independent(errors).encode(frame.tobytes())
    assert encode(frame, code).tobytes() == bytes(theirs)


def test_dual_codewords_interleaving_and_virtual_fill_are_symbol_by_symbol_those_of_the_standard():
    to_dual, from_dual = dual_basis_tables()
    dual, conventional = ReedSolomon(interleave=1), ReedSolomon(interleave=1, dual_basis=False)
    frames = frames_for(dual)
    assert array_equal(encode(frames, dual), to_dual[encode(from_dual[frames], conventional)])
    code, single = ReedSolomon(interleave=5), ReedSolomon(interleave=1)
    blocks = encode(frames_for(code), code)
    for k in range(5):
        assert clean(np.ascontiguousarray(blocks[:, k::5]), single).all()
    short, full = ReedSolomon(interleave=1, virtual_fill=23), ReedSolomon(interleave=1)
    frames = frames_for(short)
    padded = np.pad(frames, ((0, 0), (23, 0)))
    assert array_equal(encode(frames, short), encode(padded, full)[:, 23:])


@mark.parametrize("row", ["1115 5 1275", "892 4 1020", "223 1 255", "446 2 510", "1784 8 2040", "1000 5 1160"])
def test_the_code_is_found_from_the_frame_length(row):
    frame_length, interleave, block_length = map(int, row.split())
    code = code_for(frame_length)
    assert (code.interleave, code.frame_length, code.block_length) == (interleave, frame_length, block_length)


def test_frames_that_no_code_carries_are_refused():
    for refused, message in (
        (lambda: code_for(1117), "found 1117"), (lambda: ReedSolomon(errors=4), "8 or 16"),
        (lambda: ReedSolomon(interleave=6), "expected interleave 1, 2, 3, 4, 5 or 8, found 6"),
        (lambda: encode(np.zeros((1, 10), dtype=np.uint8), ReedSolomon()), "expected frames of 1115 octets"),
    ):  # fmt: skip
        with raises(LinkFormatError, match=message):
            refused()


@mark.parametrize("code", [ReedSolomon(), ReedSolomon(8, 2, 5), ReedSolomon(16, 1, 40, False)], ids=str)
def test_as_many_wrong_symbols_as_promised_are_repaired_and_counted_in_each_codeword(code):
    rng = default_rng(1)
    frames = frames_for(code, code.errors + 2)
    blocks = encode(frames, code)
    words = blocks.reshape(frames.shape[0], -1, code.interleave)
    for n in range(frames.shape[0]):  # n errors in codeword 0 of block n, none elsewhere
        where = rng.choice(words.shape[1], n, replace=False)
        words[n, where, 0] ^= rng.integers(1, 256, n, dtype=np.uint8)
    result = decode(blocks, code)
    expected = [*range(code.errors + 1), UNCORRECTABLE]
    assert result.corrected[:, 0].tolist() == expected
    assert not result.corrected[:, 1:].any()
    assert array_equal(result.frames[:-1], frames[:-1])


def test_one_lost_codeword_does_not_hide_the_others():
    code = ReedSolomon()
    blocks = encode(frames_for(code, 1), code)
    blocks[0, 2 : 2 + 17 * 5 : 5] ^= 0x55  # seventeen errors in codeword 2
    blocks[0, 4] ^= 1  # one in codeword 4
    assert decode(blocks, code).corrected.tolist() == [[0, 0, UNCORRECTABLE, 0, 1]]


def test_errors_found_in_the_virtual_fill_mean_that_too_many_others_were_there():
    code, full = ReedSolomon(interleave=1, virtual_fill=10), ReedSolomon(interleave=1)
    # a codeword with nonzero symbols where the fill would be, those cut off: few "errors", all in the fill
    word = encode(frames_for(full, 1), full)[:, 10:]
    data, corrected = repair(word, code)
    assert corrected.tolist() == [UNCORRECTABLE]
    assert array_equal(data, word)


@mark.parametrize("errors", [8, 16])
def test_repair_agrees_with_an_independent_decoder_up_to_and_beyond_its_power(errors):
    theirs = independent(errors)
    code = ReedSolomon(errors=errors, interleave=1, dual_basis=False)
    rng = default_rng(errors)
    frames = frames_for(code, 60)
    words = encode(frames, code)
    for n in range(60):
        where = rng.choice(255, n % (errors + 4), replace=False)
        words[n, where] ^= rng.integers(1, 256, where.size, dtype=np.uint8)
    data, corrected = repair(words, code)
    for n in range(60):
        try:
            message, _, positions = theirs.decode(words[n].tobytes())
        except reedsolo.ReedSolomonError:
            assert corrected[n] == UNCORRECTABLE
            continue
        assert bytes(message) == data[n, : 255 - 2 * errors].tobytes() and len(positions) == corrected[n]
    assert array_equal(data[corrected >= 0, : 255 - 2 * errors], frames[corrected >= 0])


def test_noise_is_uncorrectable_and_no_blocks_are_no_frames():
    noise = default_rng(8).integers(0, 256, (300, 255), dtype=np.uint8)
    # by the count of codewords within reach, 1 word of noise in 16! = 2e13 decodes with E = 16
    assert (repair(noise, ReedSolomon(interleave=1))[1] == UNCORRECTABLE).all()
    code = ReedSolomon()
    assert decode(np.empty((0, 1275), dtype=np.uint8), code).frames.shape == (0, 1115)
    assert encode(np.empty((0, 1115), dtype=np.uint8), code).shape == (0, 1275)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from([8, 16]), st.sampled_from([1, 2, 3, 4, 5, 8]), st.integers(0, 200), st.booleans(),
    st.integers(0, 99),
)  # fmt: skip
def test_every_setting_encodes_to_clean_codewords_that_a_flipped_bit_spoils(errors, depth, fill, dual, seed):
    code = ReedSolomon(errors, depth, fill, dual)
    frames = frames_for(code, 2, seed)
    blocks = encode(frames, code)
    assert clean(blocks, code).all()
    at = seed % blocks.shape[1]
    blocks[1, at] ^= 1 << (seed % 8)
    assert clean(blocks, code).sum() == 2 * depth - 1
    result = decode(blocks, code)
    assert array_equal(result.frames, frames) and result.corrected.sum() == 1
