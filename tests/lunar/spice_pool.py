"""SPICE with kernels loaded for one test, and a leap-second kernel of the project's own writing."""

from contextlib import contextmanager

import spiceypy

LEAP_SECONDS = """KPL/LSK

\\begindata

DELTET/DELTA_T_A = 32.184
DELTET/K         = 1.657D-3
DELTET/EB        = 1.671D-2
DELTET/M         = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT  = ( 36, @2015-JUL-1
                     37, @2017-JAN-1 )

\\begintext
"""


@contextmanager
def kernels(folder, **octets):
    """Yield spiceypy with leap seconds and the given kernels (name = content) loaded."""
    spiceypy.kclear()
    try:
        for name, content in {"leap": LEAP_SECONDS, **octets}.items():
            path = folder / f"{name}.kernel"
            path.write_bytes(content.encode() if isinstance(content, str) else content)
            spiceypy.furnsh(str(path))
        yield spiceypy
    finally:
        spiceypy.kclear()
