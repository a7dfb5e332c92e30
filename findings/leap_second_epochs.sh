#!/usr/bin/env bash
# A leap second of UTC in two libraries of one purpose (Python 3.11, anise 0.10.6, satkit 0.24.1, numpy 2.4.6)
#
# Guess: 2016-12-31T23:59:60 UTC, one second after 23:59:59 and one second before midnight, is kept.
# Seen:  satkit keeps it and prints it. anise accepts the text without an error and gives 23:59:59, the second before:
#        the two epochs are equal. Two seconds of TAI lie between that epoch and midnight.
# Guess: the difference of two UTC epochs is elapsed time, thus 86401 s for this day.
# Seen:  it is 86401 s in satkit and 86400 s in anise; in TAI it is 86401 s in anise, too.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile anise==0.10.6 satkit==0.24.1 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import satkit
from anise.time import Epoch

before, leap, after = Epoch("2016-12-31T23:59:59 UTC"), Epoch("2016-12-31T23:59:60 UTC"), Epoch("2017-01-01T00:00:00 UTC")
print("anise", before, leap, after)
assert leap == before and str(leap) == "2016-12-31T23:59:59 UTC"
assert after.to_tai_seconds() - leap.to_tai_seconds() == 2.0
day = Epoch("2016-12-31T00:00:00 UTC")
assert (after - day).to_seconds() == 86400.0
assert after.to_tai_seconds() - day.to_tai_seconds() == 86401.0

before, leap = satkit.time(2016, 12, 31, 23, 59, 59.0), satkit.time(2016, 12, 31, 23, 59, 60.0)
after = satkit.time(2017, 1, 1)
print("satkit", before, leap, after)
assert str(leap) == "2016-12-31T23:59:60.000000Z"
assert ((leap - before).seconds, (after - leap).seconds) == (1.0, 1.0)
assert (after - satkit.time(2016, 12, 31)).seconds == 86401.0
EOF
