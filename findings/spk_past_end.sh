#!/usr/bin/env bash
# Times outside a segment of a binary kernel (Python 3.11, jplephem 2.24, spiceypy 8.3.0 with CSPICE N0067, numpy 2.4.6)
#
# The kernel covers two days in two records of one day: x is 100 km after half a day and grows by 200 km a day.
# Guess: jplephem refuses each time outside the segment, as CSPICE does.
# Seen:  it refuses a time before the start. After the end it evaluates the polynomial of the last record, up to one
#        record length too late, without a warning, and refuses only later times. The lunar orientation (PCK) does the same.
# Guess: rates of a PCK segment are per day, like the velocities of an SPK segment of the same package.
# Seen:  rates of PCK are per second (2 rad per day is 2.3e-5), velocities of SPK are per day.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile jplephem==2.24 numpy==2.4.6 spiceypy==8.3.0
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import numpy as np
import spiceypy
from jplephem.exceptions import OutOfRangeError
from jplephem.pck import PCK
from jplephem.spk import SPK

DAY, START = 86400.0, 2451545.0
handle = spiceypy.spkopn("a.bsp", "a", 0)
records = np.array([100.0, 100, 0, 0, 0, 0, 300, 100, 0, 0, 0, 0])
spiceypy.spkw02(handle, -999, 301, "J2000", 0.0, 2 * DAY, "a", DAY, 2, 1, records, 0.0)
spiceypy.spkcls(handle)
handle = spiceypy.pckopn("a.bpc", "a", 0)
records = np.array([0.1, 0, 0.3, 0, 1, 1, 0.1, 0, 0.3, 0, 3, 1])
spiceypy.pckw02(handle, 31006, "J2000", 0.0, 2 * DAY, "a", DAY, 2, 1, records, 0.0)
spiceypy.pckcls(handle)

orbit = SPK.open("a.bsp")[301, -999]
turn = PCK.open("a.bpc").segments[0]

def refused(call, error):
    try:
        call()
    except error:
        return True
    return False

spiceypy.furnsh("a.bsp")
assert refused(lambda: spiceypy.spkgps(-999, 2.5 * DAY, "J2000", 301), spiceypy.utils.exceptions.SpiceyError)
late, turned = orbit.compute(START + 2.5)[0], turn.compute(START + 2.5, 0.0, False)[2]
print("position", late, "angle", turned)
assert abs(late - 500.0) < 1e-6, late
assert abs(turned - 5.0) < 1e-9, turned
assert refused(lambda: orbit.compute(START - 0.5), OutOfRangeError)
assert refused(lambda: orbit.compute(START + 3.5), OutOfRangeError)
velocity, rate = orbit.compute_and_differentiate(START + 0.5)[1][0], turn.compute(START + 0.5, 0.0)[1][2]
print("velocity", velocity, "rate", rate)
assert abs(velocity - 200.0) < 1e-9 and abs(rate - 2.0 / DAY) < 1e-15
EOF
