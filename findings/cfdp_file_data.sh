#!/usr/bin/env bash
# File data PDUs of CFDP (Python 3.11, spacepackets 0.32.0, cfdp 0.2.0)
#
# Guess: a decoder takes only the octets that the data field length in the PDU header names. The next PDU may follow.
# Seen:  both libraries take all octets after the header as file data: a PDU of 4 octets of data followed by a second
#        PDU gives 4 octets of data and the whole second PDU. With a CRC, spacepackets gives the CRC, too, and drops
#        the last two octets of the buffer.
# Guess: cfdp reads the segment metadata that spacepackets writes, or refuses it, as its encoder does.
# Seen:  it takes the segment metadata as the offset: 3259845888 instead of 5.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile cfdp==0.2.0 spacepackets==0.32.0
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
from cfdp.pdu.filedata import FiledataPdu
from spacepackets.cfdp import CrcFlag, PduConfig, TransmissionMode
from spacepackets.cfdp.pdu.file_data import FileDataParams, FileDataPdu, RecordContinuationState, SegmentMetadata
from spacepackets.util import ByteFieldU8

def encoded(data, offset, crc=CrcFlag.NO_CRC, metadata=None):
    config = PduConfig(source_entity_id=ByteFieldU8(1), dest_entity_id=ByteFieldU8(2), transaction_seq_num=ByteFieldU8(7),
                       trans_mode=TransmissionMode.UNACKNOWLEDGED, crc_flag=crc)
    return bytes(FileDataPdu(config, FileDataParams(file_data=data, offset=offset, segment_metadata=metadata)).pack())

first, second = encoded(b"abcd", 0), encoded(b"efgh", 4)
assert FileDataPdu.unpack(first).file_data == b"abcd"
print(FileDataPdu.unpack(first + second).file_data)
assert FileDataPdu.unpack(first + second).file_data == b"abcd" + second
assert FiledataPdu.decode(first + second).file_data == b"abcd" + second

checked = encoded(b"abcd", 0, CrcFlag.WITH_CRC)
assert FileDataPdu.unpack(checked).file_data == b"abcd"
assert FileDataPdu.unpack(checked + second).file_data == b"abcd" + checked[-2:] + second[:-2]

marked = encoded(b"abcd", 5, metadata=SegmentMetadata(RecordContinuationState.START_AND_END, b"MM"))
assert (FileDataPdu.unpack(marked).offset, FileDataPdu.unpack(marked).file_data) == (5, b"abcd")
other = FiledataPdu.decode(marked)
print(other.segment_offset, other.file_data)
assert (other.segment_offset, other.file_data) == (3259845888, b"\0\0\5abcd")
EOF
