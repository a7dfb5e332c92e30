#!/usr/bin/env bash
# Fractions of days in time strings (Python 3.11, spiceypy 8.3.0 with CSPICE N0067, numpy 2.4.6)
#
# Guess: str2et takes "2026 Jan 1.5" as noon, as it takes the hour 12.5 as 12:30, or it refuses the string.
# Seen:  it returns midnight: the fraction of the day is dropped without an error, in several orders of the fields.
#        Fractions of hours and of minutes count. The fraction of a day of the year is refused.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile spiceypy==8.3.0 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import spiceypy

spiceypy.lmpool(["DELTET/DELTA_T_A = ( 32.184 )", "DELTET/K = ( 1.657D-3 )", "DELTET/EB = ( 1.671D-2 )",
                 "DELTET/M = ( 6.239996D0 1.99096871D-7 )", "DELTET/DELTA_AT = ( 36, @2015-JUL-1, 37, @2017-JAN-1 )"])

def utc(text):
    return spiceypy.et2utc(spiceypy.str2et(text), "ISOC", 0)

for text in ("2026 Jan 1.5", "1.5 Jan 2026", "Jan 1.5, 2026", "2026-01-01.5"):
    print(text, utc(text))
    assert utc(text) == "2026-01-01T00:00:00"
assert utc("2026-01-01T12.5") == "2026-01-01T12:30:00"
assert utc("2026-01-01T12:30.5") == "2026-01-01T12:30:30"
try:
    utc("2026-001.5")
except spiceypy.utils.exceptions.SpiceyError as error:
    print(type(error).__name__)
else:
    raise AssertionError("the fraction of a day of the year is accepted")
EOF
