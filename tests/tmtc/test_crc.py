import pytest

from tmtc.errors import ChecksumError, TruncatedPacket
from tmtc.packets.crc import append_crc, check_crc, crc16


def test_the_checksum_has_the_published_check_value():
    # CRC-16/IBM-3740, the "CRC-16/CCITT-FALSE" of ECSS-E-ST-70-41C annex B: check value of "123456789"
    assert crc16(b"123456789") == 0x29B1


@pytest.mark.parametrize(
    ("data", "checksum"),
    # ECSS-E-ST-70-41C annex B.1.5 (verification of compliance)
    [("0000", 0x1D0F), ("000000", 0xCC9C), ("ABCDEF01", 0x04A2), ("1456F89A0001", 0x7FD5)],
)
def test_the_checksum_agrees_with_the_vectors_of_the_standard(data, checksum):
    assert crc16(bytes.fromhex(data)) == checksum


def test_octets_with_their_checksum_leave_no_remainder():
    assert crc16(append_crc(b"any octets")) == 0
    check_crc(append_crc(b"any octets"), "test")


def test_a_wrong_checksum_is_told_with_both_values():
    with pytest.raises(ChecksumError, match="expected checksum 0x29B1, found 0x0000"):
        check_crc(b"123456789\0\0", "test")
    with pytest.raises(TruncatedPacket):
        check_crc(b"\0", "test")
