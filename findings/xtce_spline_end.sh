#!/usr/bin/env bash
# The last point of an XTCE spline calibrator (Python 3.11, space_packet_parser 6.2.0)
#
# Guess: a raw value that is equal to the last point of the spline has the calibrated value of that point, as the first
#        point has.
# Seen:  the first point and the points between are evaluated. The last point raises a ValueError, for orders 0 and 1, with
#        and without extrapolation. It is not the CalibrationError that values outside the spline raise, and with
#        extrapolation a larger value is evaluated.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile space_packet_parser==6.2.0
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
from space_packet_parser.exceptions import CalibrationError
from space_packet_parser.xtce.calibrators import SplineCalibrator, SplinePoint

def result(value, order, extrapolate):
    points = [SplinePoint(0, 0.0), SplinePoint(10, 100.0), SplinePoint(20, 50.0)]
    try:
        return SplineCalibrator(points, order=order, extrapolate=extrapolate).calibrate(value)
    except (CalibrationError, ValueError) as error:
        return type(error).__name__

for order, beyond in ((0, 50.0), (1, 25.0)):
    for extrapolate in (False, True):
        seen = [result(value, order, extrapolate) for value in (0, 10, 20, 25)]
        print(order, extrapolate, seen)
        assert seen == [0.0, 100.0, "ValueError", beyond if extrapolate else "CalibrationError"]
EOF
