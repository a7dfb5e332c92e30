#!/usr/bin/env bash
# Planetographic and planetocentric frames in GeoTIFF (Python 3.11, rasterio 1.4.4 with GDAL 3.10.3, numpy 2.4.6)
#
# Mars has a frame with planetographic latitude and longitude positive to the west (IAU_2015:49901) and one with
# planetocentric latitude and longitude positive to the east (IAU_2015:49902), both on the same ellipsoid.
# Guess: GeoTIFF loses the authority code but keeps the directions of the axes.
# Seen:  a GeoTIFF written in either frame reads back as the same kind of frame: longitude to the east, geodetic latitude.
#        The point 30, 10 of the western frame is 30 degrees west before and 30 degrees east after. In memory the
#        transformation returns x and y of the western frame in the order latitude, longitude. The latitude of the
#        planetocentric frame changes by 0.12 degrees.
set -euo pipefail
dir=$(mktemp -d)
trap 'rm -rf "$dir"' EXIT
python3 -m venv --without-pip "$dir/venv"
python3 -m pip --python "$dir/venv/bin/python" install --quiet --no-compile rasterio==1.4.4 numpy==2.4.6
cd "$dir"
"$dir/venv/bin/python" - <<'EOF'
import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.transform import from_origin
from rasterio.warp import transform

SPHERE = CRS.from_string("IAU_2015:49900")

def stored(code):
    frame = CRS.from_string(code)
    with rasterio.open("a.tif", "w", driver="GTiff", width=2, height=2, count=1, dtype="uint8", crs=frame,
                       transform=from_origin(30, 10, 1, 1)) as image:
        image.write(np.zeros((1, 2, 2), "uint8"))
    with rasterio.open("a.tif") as image:
        return frame, image.crs

def point(frame):
    (x,), (y,) = transform(frame, SPHERE, [30.0], [10.0])
    return round(x, 2), round(y, 2)

west, west_back = stored("IAU_2015:49901")
centric, centric_back = stored("IAU_2015:49902")
print(rasterio.__version__, rasterio.__gdal_version__)
print([point(frame) for frame in (west, west_back, centric, centric_back)])
assert 'AXIS["Longitude",WEST]' in west.to_wkt() and 'AXIS["Longitude",EAST]' in west_back.to_wkt()
assert point(west) == (-10.0, 30.0) and point(west_back) == (30.0, 10.0)
assert point(centric) == (30.0, 10.12) and point(centric_back) == (30.0, 10.0)
assert west_back.to_authority() is None and centric_back.to_authority() is None
EOF
