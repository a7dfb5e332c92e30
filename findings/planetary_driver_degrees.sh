#!/usr/bin/env bash
# Lunar images in degrees written as PDS4 and ISIS3 (Python 3.11, rasterio 1.4.4 with GDAL 3.10.3, numpy 2.4.6)
#
# Guess: an image in the geographic frame of the Moon (IAU_2015:30100), of 1 degree per pixel, reads back in degrees, or
#        the driver refuses it.
# Seen:  both drivers write an equirectangular projection: the image reads back in metres, 30323.35 m per pixel, with the
#        corner at 303233.5, 151616.75 instead of 10, 5. GeoTIFF keeps degrees.
# Guess: the ISIS3 file of an image of octets without a nodata value has none.
# Seen:  0 is its nodata value, so valid samples of 0 are masked. PDS4 has none.
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

def stored(driver, name):
    with rasterio.open(name, "w", driver=driver, width=4, height=4, count=1, dtype="uint8",
                       crs=CRS.from_string("IAU_2015:30100"), transform=from_origin(10, 5, 1, 1)) as image:
        image.write(np.arange(16, dtype="uint8").reshape(1, 4, 4))
    with rasterio.open(name) as image:
        geometry = [round(value, 2) for value in image.transform[:6]]
        masked = np.ma.count_masked(image.read(1, masked=True))
        return image.crs.is_geographic, geometry, image.nodata, masked

degrees, metres = [1.0, 0.0, 10.0, 0.0, -1.0, 5.0], [30323.35, 0.0, 303233.5, 0.0, -30323.35, 151616.75]
expected = {"GTiff": (True, degrees, None, 0), "PDS4": (False, metres, None, 0), "ISIS3": (False, metres, 0.0, 1)}
for driver, name in (("GTiff", "a.tif"), ("PDS4", "a.xml"), ("ISIS3", "a.cub")):
    seen = stored(driver, name)
    print(driver, seen)
    assert seen == expected[driver]
EOF
