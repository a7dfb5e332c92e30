#!/usr/bin/env bash
# An OEM of two segments that meet at a manoeuvre (Python 3.11, anise 0.10.6, numpy 2.4.6)
#
# A segment of an OEM ends at a manoeuvre, and CCSDS 502.0-B permits no interpolation over its end. The spacecraft moves
# at 1 km/s; at 60 s, the epoch that both segments have, its speed becomes 2 km/s.
# Guess: both segments are kept apart, or the file is refused: 5 s before the manoeuvre the speed is 1 km/s.
# Seen:  both are one series of states without a message. Of the two states at the common epoch one is lost, and the
#        interpolation goes over the manoeuvre: 5 s before it, the speed is 0.67 km/s and the place 1.6 km behind. The OEM
#        that it writes has one segment.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile anise==0.10.6 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
from anise import Almanac
from anise.astro import DataType, Ephemeris
from anise.time import Epoch


def segment(first, last, state):
    at = [f"2029-08-18T00:{s // 60:02d}:{s % 60:02d}.000" for s in range(first, last + 1, 10)]
    rows = [f"{t} {state(s)[0]} 0 0 {state(s)[1]} 0 0" for t, s in zip(at, range(first, last + 1, 10))]
    head = [
        "META_START", "OBJECT_NAME = A", "OBJECT_ID = A", "CENTER_NAME = MOON", "REF_FRAME = ICRF", "TIME_SYSTEM = UTC",
        f"START_TIME = {at[0]}", f"STOP_TIME = {at[-1]}", "INTERPOLATION = HERMITE", "INTERPOLATION_DEGREE = 7", "META_STOP",
    ]
    return [*head, "", *rows, ""]


lines = ["CCSDS_OEM_VERS = 2.0", "CREATION_DATE = 2029-08-18T00:00:00", "ORIGINATOR = A", ""]
lines += segment(0, 60, lambda s: (2000.0 + s, 1.0)) + segment(60, 120, lambda s: (2060.0 + 2 * (s - 60), 2.0))
open("a.oem", "w").write("\n".join(lines))

orbit = Ephemeris.from_ccsds_oem_file("a.oem")
orbit.write_spice_bsp(-999, "a.bsp", DataType.Type13HermiteUnequalStep)
almanac = Almanac("a.bsp")
state = orbit.at(Epoch("2029-08-18T00:00:55 UTC"), almanac).orbit
print("states", orbit.len(), "position", state.x_km, "speed", state.vx_km_s)
assert orbit.len() == 13, orbit.len()
assert abs(state.vx_km_s - 0.666) < 0.001, state.vx_km_s
assert abs(state.x_km - 2053.377) < 0.001, state.x_km
orbit.write_ccsds_oem("b.oem", "a", "A")
assert open("b.oem").read().count("META_START") == 1
EOF
