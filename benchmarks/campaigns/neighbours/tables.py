"""Tables, maps, trajectories, data sets and labels in other programs."""

import json
import math
import shutil
from pathlib import Path

from _cells import run


def _plain(value):
    number = None if value is None else float(value)
    return None if number is None or math.isnan(number) else number


def _table(cells, what, table, load):
    """Compare the columns of numbers of a table that `load()` gives by name."""
    header, *rows = cells.expected["tables"][table]
    numbers = [k for k in range(len(header)) if all(isinstance(row[k], float | None) for row in rows)]
    found = load()
    chosen = [k for k in numbers if header[k] in found]
    columns = [found[header[k]] for k in chosen]
    cells.reads(
        what,
        [[row[k] for k in chosen] for row in rows],
        lambda: [list(map(_plain, row)) for row in zip(*columns, strict=True)],
    )


def _parquet(read):
    return lambda cells: _table(
        cells, "Parquet", "housekeeping", lambda: read(cells.sample("parquet/housekeeping.parquet"))
    )


@_parquet
def pyarrow(path):
    import pyarrow.parquet as pq

    return pq.read_table(path).to_pydict()


@_parquet
def fastparquet(path):
    import fastparquet as fp

    return dict(fp.ParquetFile(path).to_pandas().items())


@_parquet
def duckdb(path):
    import duckdb as db

    found = db.sql(f"select * from '{path}'")
    return dict(zip(found.columns, zip(*found.fetchall(), strict=True), strict=True))


@_parquet
def polars(path):
    import polars as pl

    return pl.read_parquet(path).to_dict(as_series=False)


def pandas(cells):
    import pandas as pd

    _table(cells, "CSV", "residuals", lambda: dict(pd.read_csv(cells.sample("csv/residuals.csv")).items()))
    _parquet(lambda path: dict(pd.read_parquet(path).items()))(cells)


def xarray(cells):
    import xarray as xr

    tree = xr.open_datatree(cells.sample("pass.nc"))
    for table in ("residuals", "reference", "detections"):
        _table(cells, f"netCDF, {table}", table, lambda table=table: {k: v.values for k, v in tree[table].items()})


def compliance_checker(cells):
    from compliance_checker.runner import CheckSuite, ComplianceChecker

    def failures():
        CheckSuite.load_all_available_checkers()
        out, form = str(cells.out / "cf.json"), {"criteria": "normal", "output_format": "json"}
        ComplianceChecker.run_checker(cells.sample("pass.nc"), ["cf:1.11"], 0, output_filename=out, **form)
        (report,) = json.loads(Path(out).read_text()).values()
        return [report["high_count"], report["possible_points"] - report["scored_points"]]

    cells.reads("netCDF, failures of the CF conventions 1.11", [0, 0], failures)


def evo(cells):
    from evo.core import metrics, sync
    from evo.tools import file_interface

    def load(name):
        return file_interface.read_tum_trajectory_file(cells.sample(f"tum/{name}.tum"))

    def values():
        one = load("anchored")
        parts = zip(one.timestamps, one.positions_xyz, one.orientations_quat_wxyz, strict=True)
        return [[float(v) for v in (t, *p, x, y, z, w)] for t, p, (w, x, y, z) in parts]

    def error():
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data(sync.associate_trajectories(load("anchored-reference"), load("anchored")))
        return [[float(ape.get_statistic(metrics.StatisticsType[name])) for name in ("rmse", "max")]]

    header, *rows = cells.expected["tables"]["residuals"]
    place = header.index("error_3d_m")
    errors = [row[place] for row in rows if row[1:3] == ["anchored", "estimate"]]
    right = [[math.sqrt(sum(one * one for one in errors) / len(errors)), max(errors)]]
    cells.reads("TUM", "tum", values)
    cells.reads("rms and greatest error of the trajectory", right, error)


def gdal(cells):
    import numpy as np
    import pyogrio
    import rasterio

    path, json_path = cells.sample("pass.gpkg"), cells.sample("pass.geojson")
    features = json.loads(Path(json_path).read_text())["features"]
    layers = [one["properties"]["layer"] for one in features]

    def read(layer, key):
        meta, _, geometry, values = pyogrio.raw.read(path, layer=layer, columns=[key])
        if "Moon" not in meta["crs"]:
            raise ValueError(f"coordinate reference system {meta['crs'][:60]}")
        places = [np.frombuffer(one, dtype="<f8", offset=5)[:2].tolist() for one in geometry]
        return [[float(v), *p] for v, p in zip(values[0], places, strict=True)]

    def listed():
        return {
            str(name): int(pyogrio.read_info(path, layer=name)["features"]) for name, _ in pyogrio.list_layers(path)
        }

    def types():
        info = pyogrio.read_info(path, layer="footprints")
        kinds = dict(zip(map(str, info["fields"]), map(str, info["dtypes"]), strict=True))
        return {name: kinds[name] for name in ("utc", "complete")}

    def raster(name):
        heights = (np.arange(64 * 64, dtype="float32").reshape(64, 64) % 97) * 3.5 - 100
        place = rasterio.transform.from_origin(10.0, 5.0, 1 / 64, 1 / 64)
        form = {"width": 64, "height": 64, "count": 1, "dtype": "float32", "crs": "IAU_2015:30100"}
        with rasterio.open(name, "w", driver="GTiff", transform=place, **form) as file:
            file.write(heights, 1)
        return heights.astype(float).tolist()

    cells.reads("GeoPackage, layers", {name: layers.count(name) for name in set(layers)}, listed)
    for layer, key in (("detections", "crater_id"), ("craters", "crater")):
        chosen = [one for one, name in zip(features, layers, strict=True) if name == layer]
        right = [[float(one["properties"][key]), *map(float, one["geometry"]["coordinates"][:2])] for one in chosen]
        cells.reads(f"GeoPackage, {layer}", right, lambda layer=layer, key=key: read(layer, key))
    cells.reads("GeoPackage, types for the temporal controller", {"utc": "datetime64[ms]", "complete": "bool"}, types)
    cells.reads("GeoJSON, features", [len(features)], lambda: [int(pyogrio.read_info(json_path)["features"])])
    cells.writes("GeoTIFF of heights", "heights.tif", "raster", raster, window=[85 * 64, 10 * 64, 64, 64])


def craterpy(cells):
    import craterpy as cp
    import pandas as pd

    table = pd.read_csv(cells.sample("catalogue.csv"))
    names = {"lat_col": "latitude_deg", "lon_col": "longitude_deg", "diam_col": "diameter_m"}

    def rows(latitude, longitude, radius):
        return [[float(a), float(b) % 360, float(r)] for a, b, r in zip(latitude, longitude, radius, strict=True)]

    def values():
        found = cp.CraterDatabase(table, "Moon", units="m", **names)
        return rows(found.lat, found.lon, found.rad)

    latitude, longitude, diameter = (table[name] for name in names.values())
    cells.reads("crater catalogue (CSV)", rows(latitude, longitude, diameter / 2), values)


def _labels(cells, coco, evaluation):
    folder = Path(cells.sample("dataset"))
    truth = coco(str(folder / "coco_val.json"))
    right = json.loads((folder / "coco_val.json").read_text())["annotations"]
    results = [{key: one[key] for key in ("image_id", "category_id", "bbox")} | {"score": 1.0} for one in right]

    def boxes(annotations):
        return sorted(list(map(float, one["bbox"])) for one in annotations)

    def score():
        judged = evaluation(truth, truth.loadRes(results), "bbox")
        judged.params.maxDets = [10000] * 3
        judged.evaluate()
        judged.accumulate()
        precision = judged.eval["precision"]
        return [float(precision[precision >= 0].mean())]

    def written(path):
        made = truth.loadRes(results).dataset
        Path(path).write_text(json.dumps({name: made[name] for name in ("images", "annotations", "categories")}))
        shutil.copytree(folder / "images", Path(path).parent / "images")
        return boxes(made["annotations"])

    cells.reads("labels of a data set", boxes(right), lambda: boxes(truth.anns.values()))
    cells.reads("score of labels against themselves", [1.0], score)
    cells.writes("labels made of results", "labels.json", "labels", written)


def pycocotools(cells):
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    _labels(cells, COCO, COCOeval)


def faster_coco_eval(cells):
    from faster_coco_eval import COCO, COCOeval_faster

    _labels(cells, COCO, COCOeval_faster)


run(globals())
