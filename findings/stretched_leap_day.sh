#!/usr/bin/env bash
# Modified Julian dates and Unix times of a day with a leap second (Python 3.11, astropy 8.0.2, pyerfa 2.0.1.5, numpy 2.4.6)
#
# Guess: noon UTC of 2016-12-31 is MJD 57753.5 and the Unix time 1483185600, as on other days.
# Seen:  it is MJD 57753.49999421 and 1483185599.500006: the day is stretched, its fraction counts 86401 s. Times of that
#        day are up to 1 s before those of POSIX, and the Unix time of the leap second is 1483228799.00001.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile astropy==8.0.2 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
from astropy.time import Time

noon, leap = Time("2016-12-31T12:00:00", scale="utc"), Time("2016-12-31T23:59:60", scale="utc")
usual = Time("2016-12-30T12:00:00", scale="utc")
print(noon.mjd, noon.unix, leap.unix)
assert usual.mjd == 57752.5 and usual.unix == 1483099200.0
assert abs(noon.mjd - (57753 + 43200 / 86401)) < 1e-10
assert abs(noon.unix - (1483142400 + 43200 * 86400 / 86401)) < 1e-5 and round(noon.unix, 2) == 1483185599.5
assert abs(leap.unix - 1483228799.0000117) < 1e-5
EOF
