"""Tables, maps, trajectories, data sets and labels in other programs."""

import json
import math
import shutil
from pathlib import Path

from _cells import run


def _columns(cells, table, available):
    """Return names of columns of numbers that a program has, and their values by row."""
    header, *rows = cells.expected("tables")[table]
    chosen = [
        k
        for k, name in enumerate(header)
        if name in available and all(isinstance(row[k], float) or row[k] is None for row in rows)
    ]
    return [header[k] for k in chosen], [[row[k] for k in chosen] for row in rows]


def _plain(value):
    number = None if value is None else float(value)
    return None if number is None or math.isnan(number) else number


def _table(cells, what, table, load):
    """Compare a table whose columns `load()` gives by name."""
    try:
        found = load()
    except Exception as error:  # recorded as what the program says

        def refuse(error=error):
            raise error

        cells.reads(what, [], refuse)
        return
    names, right = _columns(cells, table, set(found))
    cells.reads(
        what, right, lambda: [list(map(_plain, row)) for row in zip(*(found[n] for n in names), strict=True)]
    )


def _parquet(cells):
    return cells.sample("parquet/housekeeping.parquet")


def pyarrow(cells):
    import pyarrow.parquet as pq

    _table(cells, "Parquet", "housekeeping", lambda: pq.read_table(_parquet(cells)).to_pydict())


def fastparquet(cells):
    import fastparquet as fp

    _table(
        cells, "Parquet", "housekeeping", lambda: dict(fp.ParquetFile(_parquet(cells)).to_pandas().items())
    )


def duckdb(cells):
    import duckdb as db

    def load():
        found = db.sql(f"select * from '{_parquet(cells)}'")
        rows = found.fetchall()
        return {name: [row[k] for row in rows] for k, name in enumerate(found.columns)}

    _table(cells, "Parquet", "housekeeping", load)


def polars(cells):
    import polars as pl

    _table(
        cells, "Parquet", "housekeeping", lambda: pl.read_parquet(_parquet(cells)).to_dict(as_series=False)
    )
    _table(
        cells,
        "CSV",
        "residuals",
        lambda: pl.read_csv(cells.sample("csv/residuals.csv")).to_dict(as_series=False),
    )


def pandas(cells):
    import pandas as pd

    _table(cells, "CSV", "residuals", lambda: dict(pd.read_csv(cells.sample("csv/residuals.csv")).items()))
    _table(cells, "Parquet", "housekeeping", lambda: dict(pd.read_parquet(_parquet(cells)).items()))


def xarray(cells):
    import xarray as xr

    tree = xr.open_datatree(cells.sample("pass.nc"))
    for table in ("residuals", "reference", "detections"):
        _table(
            cells,
            f"netCDF, {table}",
            table,
            lambda table=table: {k: v.values for k, v in tree[table].items()},
        )


def compliance_checker(cells):
    from compliance_checker.runner import CheckSuite, ComplianceChecker

    def failures():
        CheckSuite.load_all_available_checkers()
        out = cells.out / "cf.json"
        ComplianceChecker.run_checker(
            cells.sample("pass.nc"),
            ["cf:1.11"],
            verbose=0,
            criteria="normal",
            output_filename=str(out),
            output_format="json",
        )
        report = json.loads(out.read_text())
        report = report[next(iter(report))] if "high_priorities" not in report else report
        print(json.dumps(report, indent=1)[:4000])
        return [len([one for one in report["high_priorities"] if one["value"][0] < one["value"][1]])]

    cells.reads("netCDF, failures of the CF conventions 1.11", [0], failures)


def evo(cells):
    from evo.core import metrics, sync
    from evo.tools import file_interface

    def load(name):
        return file_interface.read_tum_trajectory_file(cells.sample(f"tum/{name}.tum"))

    def values():
        one = load("anchored")
        q = one.orientations_quat_wxyz
        return [
            [float(t), *map(float, p), *map(float, o[[1, 2, 3, 0]])]
            for t, p, o in zip(one.timestamps, one.positions_xyz, q, strict=True)
        ]

    def error():
        pair = sync.associate_trajectories(load("anchored-reference"), load("anchored"))
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data(pair)
        return [
            [
                float(ape.get_statistic(metrics.StatisticsType.rmse)),
                float(ape.get_statistic(metrics.StatisticsType.max)),
            ]
        ]

    header, *rows = cells.expected("tables")["residuals"]
    place = header.index("error_3d_m")
    errors = [row[place] for row in rows if row[1] == "anchored" and row[2] == "estimate"]
    right = [[math.sqrt(sum(one * one for one in errors) / len(errors)), max(errors)]]
    cells.reads("TUM", "tum", values)
    cells.reads("rms and greatest error of the trajectory", right, error)


def gdal(cells):
    import numpy as np
    import pyogrio
    import rasterio

    features = json.loads(Path(cells.sample("pass.geojson")).read_text())["features"]

    def points(layer, key):
        return [
            [float(one["properties"][key]), *map(float, one["geometry"]["coordinates"][:2])]
            for one in features
            if one["properties"]["layer"] == layer
        ]

    def read(layer, key):
        meta, _, geometry, values = pyogrio.raw.read(cells.sample("pass.gpkg"), layer=layer, columns=[key])
        if "Moon" not in meta["crs"]:
            raise ValueError(f"coordinate reference system {meta['crs'][:60]}")
        places = [np.frombuffer(one, dtype="<f8", offset=5)[:2].tolist() for one in geometry]
        return [[float(v), *p] for v, p in zip(values[0].tolist(), places, strict=True)]

    names = sorted({one["properties"]["layer"] for one in features})
    counts = {name: sum(one["properties"]["layer"] == name for one in features) for name in names}

    def listed():
        layers = sorted(str(name) for name, _ in pyogrio.list_layers(cells.sample("pass.gpkg")))
        return {
            name: int(pyogrio.read_info(cells.sample("pass.gpkg"), layer=name)["features"]) for name in layers
        }

    def types():
        info = pyogrio.read_info(cells.sample("pass.gpkg"), layer="footprints")
        return {
            str(k): str(v)
            for k, v in zip(info["fields"], info["dtypes"], strict=True)
            if k in ("utc", "complete")
        }

    cells.reads("GeoPackage, layers", counts, listed)
    cells.reads(
        "GeoPackage, detections", points("detections", "crater_id"), lambda: read("detections", "crater_id")
    )
    cells.reads("GeoPackage, craters", points("craters", "crater"), lambda: read("craters", "crater"))
    cells.reads(
        "GeoPackage, types for the temporal controller", {"utc": "datetime64[ms]", "complete": "bool"}, types
    )
    cells.reads(
        "GeoJSON, features",
        [len(features)],
        lambda: [int(pyogrio.read_info(cells.sample("pass.geojson"))["features"])],
    )

    def raster(path):
        crs = "IAU_2015:30100"
        heights = (np.arange(64 * 64, dtype="float32").reshape(64, 64) % 97) * 3.5 - 100
        step = 1 / 64
        with rasterio.open(
            path, "w", driver="GTiff", width=64, height=64, count=1, dtype="float32", crs=crs,
            transform=rasterio.transform.from_origin(10.0, 5.0, step, step),
        ) as file:  # fmt: skip
            file.write(heights, 1)
        return heights.astype(float).tolist()

    cells.writes("GeoTIFF of heights", "heights.tif", "raster", raster, window=[85 * 64, 10 * 64, 64, 64])


def craterpy(cells):
    import craterpy as cp
    import pandas as pd

    table = pd.read_csv(cells.sample("catalogue.csv"))

    def values():
        found = cp.CraterDatabase(
            table, "Moon", units="m", lat_col="latitude_deg", lon_col="longitude_deg", diam_col="diameter_m"
        )
        return [
            [float(a), float(b) % 360, float(r)]
            for a, b, r in zip(found.lat, found.lon, found.rad, strict=True)
        ]

    right = [
        [float(a), float(b) % 360, float(d) / 2]
        for a, b, d in zip(table["latitude_deg"], table["longitude_deg"], table["diameter_m"], strict=True)
    ]
    cells.reads("crater catalogue (CSV)", right, values)


def _labels(cells, COCO, COCOeval):
    """Read our labels, score them against themselves, and write labels of our own kind."""
    source = Path(cells.sample("dataset")) / "coco_val.json"
    right = json.loads(source.read_text())
    boxes = sorted((one["id"], *map(float, one["bbox"])) for one in right["annotations"])
    cells.reads(
        "labels of a data set", [list(map(float, one)) for one in boxes],
        lambda: [[float(k), *map(float, one["bbox"])] for k, one in sorted(COCO(str(source)).anns.items())],
    )  # fmt: skip

    def score():
        truth = COCO(str(source))
        results = [
            {
                "image_id": one["image_id"],
                "category_id": one["category_id"],
                "bbox": one["bbox"],
                "score": 1.0,
            }
            for one in right["annotations"]
        ]
        judged = COCOeval(truth, truth.loadRes(results), "bbox")
        judged.params.maxDets = [10000, 10000, 10000]
        judged.evaluate()
        judged.accumulate()
        precision = judged.eval["precision"]
        return [float(precision[precision >= 0].mean())]

    cells.reads("score of labels against themselves", [1.0], score)

    def written(path):
        results = [
            {
                "image_id": one["image_id"],
                "category_id": one["category_id"],
                "bbox": one["bbox"],
                "score": 1.0,
            }
            for one in right["annotations"]
        ]
        made = COCO(str(source)).loadRes(results).dataset
        made = {name: made[name] for name in ("images", "annotations", "categories")}
        Path(path).write_text(json.dumps(made))
        shutil.copytree(
            Path(cells.sample("dataset")) / "images", Path(path).parent / "images", dirs_exist_ok=True
        )
        return sorted(list(map(float, one["bbox"])) for one in made["annotations"])

    cells.writes("labels made of results", "labels.json", "labels", written)


def pycocotools(cells):
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    _labels(cells, COCO, COCOeval)


def faster_coco_eval(cells):
    from faster_coco_eval import COCO, COCOeval_faster

    _labels(cells, COCO, COCOeval_faster)


run(globals())
