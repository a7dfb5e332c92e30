"""Writer of small EXR files, after the format's own description."""

import struct


def attribute(name, kind, octets):
    return name + b"\0" + kind + b"\0" + struct.pack("<i", len(octets)) + octets


def exr_octets(planes, *, kind=2, compression=0, version=2, first_line=0, upward=False):
    """A single-part scan-line file: magic, attributes, line offsets, then lines of channels in name order."""
    names = sorted(planes)
    high, wide = planes[names[0]].shape
    channels = b"".join(n.encode() + b"\0" + struct.pack("<iiii", kind, 0, 1, 1) for n in names) + b"\0"
    window = struct.pack("<4i", 0, first_line, wide - 1, first_line + high - 1)
    header = struct.pack("<ii", 20_000_630, version)
    header += attribute(b"channels", b"chlist", channels)
    header += attribute(b"compression", b"compression", bytes([compression]))
    header += attribute(b"dataWindow", b"box2i", window)
    header += attribute(b"lineOrder", b"lineOrder", bytes([int(upward)])) + b"\0"
    size = 4 * wide * len(names)
    start = len(header) + 8 * high
    offsets, body = [], b""
    for line in reversed(range(high)) if upward else range(high):
        offsets.append(start + len(body))
        values = b"".join(planes[name][line].astype("<f4").tobytes() for name in names)
        body += struct.pack("<ii", first_line + line, size) + values
    return header + struct.pack(f"<{high}Q", *offsets) + body
