"""The EXR reader against files written after the format's description, field by field."""

import numpy as np
import pytest

from payload_emulator.errors import RendererError
from payload_emulator.sim.render.cycles import read_exr
from tests.payload_emulator.sim.exr_file import exr_octets

PLANES = {
    "A.Position.X": np.arange(12, dtype=np.float32).reshape(3, 4),
    "A.Combined.R": np.arange(12, dtype=np.float32).reshape(3, 4) * -0.5,
}


@pytest.mark.parametrize("options", [{}, {"first_line": 7}, {"upward": True}, {"version": 2 | 0x400}])
def test_planes_come_back_by_name(tmp_path, options):
    file = tmp_path / "a.exr"
    file.write_bytes(exr_octets(PLANES, **options))
    read = read_exr(file)
    assert sorted(read) == sorted(PLANES)
    for name, plane in PLANES.items():
        np.testing.assert_array_equal(read[name], plane)


@pytest.mark.parametrize(
    ("octets", "message"),
    [
        (exr_octets(PLANES)[:-5], "expected 3 lines"),
        (exr_octets(PLANES, kind=1), "32-bit floats"),
        (exr_octets(PLANES, compression=3), "uncompressed EXR, found method 3"),
        (exr_octets(PLANES, version=2 | 0x1000), "single-part EXR"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "single-part EXR"),
        (exr_octets(PLANES)[:30], "damaged"),
        (b"", "damaged"),
    ],
)
def test_anything_else_is_refused_with_what_is_wrong(tmp_path, octets, message):
    file = tmp_path / "b.exr"
    file.write_bytes(octets)
    with pytest.raises(RendererError, match=message):
        read_exr(file)
