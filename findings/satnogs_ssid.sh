#!/usr/bin/env bash
# SSIDs of AX.25 addresses in the SatNOGS decoders (Python 3.11, satnogs-decoders 1.131.0, kaitaistruct 0.10)
#
# An AX.25 address has an SSID of four bits (0 to 15) in bits 1 to 4 of its last octet.
# Guess: all decoders of the package give SSID 11 as 11, as the definition of the header is the same.
# Seen:  the decoder of any AX.25 frame (ax25frames) and more than half of the others mask with 15 before the shift, and
#        give 3: SSIDs of 8 and more lose 8. The decoder ax25monitor of the same package gives 11.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile satnogs-decoders==1.131.0
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import pathlib
from satnogsdecoders import decoder

def address(call, ssid, last):
    return bytes(ord(letter) << 1 for letter in call.ljust(6)) + bytes([0x60 | ssid << 1 | last])

def ssids(name, ssid):
    frame = address("DEST", ssid, 0) + address("SOURCE", ssid, 1) + b"\x03\xf0hello"
    fields = decoder.get_fields(getattr(decoder, name).from_bytes(frame))
    return fields["dest_ssid"], fields["src_ssid"]

for name in ("Ax25frames", "Ax25monitor"):
    print(name, [ssids(name, ssid) for ssid in (5, 11)])
    assert ssids(name, 5) == (5, 5)
assert ssids("Ax25frames", 11) == (3, 3) and ssids("Ax25monitor", 11) == (11, 11)
sources = [path.read_text() for path in pathlib.Path(decoder.__file__).parent.glob("*.py")]
narrow = sum("(self.ssid_mask & 15) >> 1" in source for source in sources)
every = sum("self.ssid_mask" in source for source in sources)
print(narrow, "of", every)
assert narrow * 2 > every
EOF
