"""Rasters of formulas, written for the tests."""

import numpy as np

MOON = "+proj=longlat +R=1737400 +no_defs"
PPD = 32


def write_raster(path, west, north, size_deg, formula, crs=MOON, dtype="float32", ppd=PPD, **profile):
    """A raster of ``formula(latitude_deg, longitude_deg)`` at pixel centres."""
    import rasterio

    size = round(size_deg * ppd)
    index = np.arange(size) + 0.5
    latitude, longitude = north - index / ppd, west + index / ppd
    values = np.broadcast_to(formula(latitude[:, None], longitude[None, :]), (size, size)).astype(dtype)
    transform = rasterio.Affine(1.0 / ppd, 0.0, west, 0.0, -1.0 / ppd, north)
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": dtype} | profile
    with rasterio.open(path, "w", crs=crs, transform=transform, **profile) as target:
        target.write(values, 1)
    return path
