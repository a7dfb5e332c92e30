#!/usr/bin/env bash
# Order of coordinates with longitude positive to the west (Python 3.11, pyproj 3.7.2 with PROJ 9.5.1)
#
# Guess: Transformer.from_crs(..., always_xy=True) takes and returns longitude, latitude of every geographic frame,
#        thus -30, 10 for the point at 30 degrees east in the planetographic frame of Mars (IAU_2015:49901).
# Seen:  always_xy exchanges axes only if the second axis points east. The result is 10, -30: latitude first, although
#        the planetocentric sphere (IAU_2015:49900) in the same call has longitude first. As an input, 30, 10 is
#        latitude 30, longitude 10 west.
#        The latitude is the same number on the sphere and on the ellipsoid (a ballpark transformation).
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile pyproj==3.7.2
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import pyproj
from pyproj import Transformer

sphere, graphic = "IAU_2015:49900", "IAU_2015:49901"
to_west = Transformer.from_crs(sphere, graphic, always_xy=True).transform(30.0, 10.0)
from_west = Transformer.from_crs(graphic, sphere, always_xy=True).transform(30.0, 10.0)
print(pyproj.__version__, pyproj.proj_version_str, to_west, from_west)
rounded = [tuple(round(value, 6) for value in pair) for pair in (to_west, from_west)]
assert rounded == [(10.0, -30.0), (-10.0, 30.0)], rounded
assert [axis.direction for axis in pyproj.CRS(graphic).axis_info] == ["north", "west"]
EOF
