#!/usr/bin/env bash
# Little-endian integers of 24, 40 and 48 bits (Python 3.11, ccsdspy 2.0.1, numpy 2.4.6)
#
# Guess: byte_order="little" and the explicit order "321" of a field of 24 bits give the same value, and a signed field
#        has its sign in either order.
# Seen:  with "little" the value is 2**8 times too large (2**24 times for 40 bits, 2**16 times for 48 bits): the octets are
#        reversed in the next wider NumPy type. With "321" an unsigned value is right and a signed value loses its sign.
#        Fields of 16, 32 and 64 bits are right.
# Guess: the packet sequence count 0 after 16383 is in order.
# Seen:  ccsdspy logs "Sequence count are out of order" for it, and does not for 0, 1, 2.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile ccsdspy==2.0.1 numpy==2.4.6
cd "$dir"
export HOME="$dir"
"$dir/venv/bin/python" - <<'EOF'
import io
import logging
import struct
from ccsdspy import FixedLength, PacketField

def packet(count, data):
    return struct.pack(">HHH", 0x0864, 0xC000 | count, len(data) - 1) + data

def decoded(kind, data, order):
    field = PacketField("a", kind, 8 * len(data), byte_order=order)
    return int(FixedLength([field]).load(io.BytesIO(packet(0, data)))["a"][0])

for length, excess in ((2, 1), (3, 2**8), (4, 1), (5, 2**24), (6, 2**16)):
    data = bytes(range(1, length)) + b"\xff"
    order = "".join(str(number) for number in range(length, 0, -1))
    unsigned, signed = int.from_bytes(data, "little"), int.from_bytes(data, "little", signed=True)
    print(length, decoded("uint", data, "little"), unsigned, decoded("int", data, order), signed)
    assert decoded("uint", data, "little") == unsigned * excess
    assert decoded("int", data, "little") == signed * excess
    assert decoded("uint", data, order) == unsigned
    assert decoded("int", data, order) == (signed if excess == 1 else unsigned)

messages = []
handler = logging.Handler()
handler.emit = lambda record: messages.append(record.getMessage())
logging.getLogger("ccsdspy").addHandler(handler)
for counts, warned in (((16382, 16383, 0), True), ((0, 1, 2), False)):
    messages.clear()
    FixedLength([PacketField("a", "uint", 8)]).load(io.BytesIO(b"".join(packet(count, b"a") for count in counts)))
    assert any("out of order" in message for message in messages) == warned, messages
EOF
