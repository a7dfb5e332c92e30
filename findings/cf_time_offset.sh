#!/usr/bin/env bash
# Zone offsets in the time units of CF NetCDF files (Python 3.11, cftime 1.6.6.1, numpy 2.4.6)
#
# The CF conventions show "seconds since 1992-10-8 15:15:42.5 -6:00" as an example of time units.
# Guess: cftime applies the offset and gives 21:15:42.5 UTC.
# Seen:  cftime applies an offset only if its hour has two digits. "-6:00", "-6" and "+5:30" have no effect and raise
#        nothing: the result is 15:15:42.5, six hours early. The name of another time scale (TAI) has no effect either.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile cftime==1.6.6.1 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import cftime

def reference(zone):
    return cftime.num2date(0, f"seconds since 1992-10-8 15:15:42.5 {zone}").strftime("%Y-%m-%dT%H:%M:%S")

seen = {zone: reference(zone) for zone in ("-06:00", "-0600", "-6:00", "-6", "+5:30", "UTC", "TAI")}
print(seen)
utc, local = "1992-10-08T21:15:42", "1992-10-08T15:15:42"
assert seen == {"-06:00": utc, "-0600": utc, "-6:00": local, "-6": local, "+5:30": local, "UTC": local, "TAI": local}
EOF
