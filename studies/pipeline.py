"""From a recipe to the model that flies: data set, training, export, evaluation on every test source, in turn.

Every stage leaves its result in one folder and is not done again when it is there and made from the same things; the
two long ones (data set and training) also go on from where they were killed. Files of the folder: dataset/, run/,
rims.bin, model.onnx, paper.onnx, report-<source>.html, and stages/ with what each stage was made from.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lunar.datafolder import DataFolder
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.session.recipe import Recipe
from payload_emulator.training.data.dataset import Dataset, write_json, write_whole
from payload_emulator.training.data.feeder import TrainParameters
from payload_emulator.training.data.refits import RefittedRims, load_refitted

Report = Callable[[str], None]
Progress = Callable[[Sequence[Any]], Iterable[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """What is to be made, and where.

    dataset, run : made elsewhere and taken as they are; None: made under `out`.
    rims : a table of `linna catalogue curate`; None: made where the data set shows real terrain and the data allow it.
    revision, note : of the source and on the training, for the model's metadata.
    """

    out: Path
    recipe: Recipe
    frames: int
    parameters: TrainParameters
    data: DataFolder
    workers: int = 1
    dataset: Path | None = None
    run: Path | None = None
    rims: Path | None = None
    revision: str = ""
    note: str = ""


def make_dataset(job: Job, report: Report = lambda line: None) -> Path:
    """The data set's folder, rendered or finished where it is not given.

    Raises
    ------
    DatasetError
        As `build.build`; or there is no data set where one is given.
    """
    from payload_emulator.training.data.build import build

    folder = job.dataset or job.out / "dataset"
    wanted = {"recipe_sha256": job.recipe.digest, "frames": job.frames}
    if job.dataset is None and _stage(job, "dataset", wanted) is None:
        for done, total in build(job.recipe, folder, job.frames, job.data, job.workers):
            report(f"data set: {done}/{total} frames")
        _finish(job, "dataset", wanted, {"labels_sha256": Dataset(folder).digest})
    return folder


def make_model(
    job: Job, report: Report = lambda line: None, progress: Progress = lambda frames: frames
) -> dict[str, Any]:
    """Every stage; the figures of both models come back.

    Raises
    ------
    DatasetError
        The data set cannot be made or holds no training or no test frames.
    ModelError
        The run given holds no checkpoint, or torch and the exported network disagree.
    """
    dataset = Dataset(make_dataset(job, report))
    sources = sorted({frame.source for frame in dataset.frames("test")})
    if not sources:
        raise DatasetError(f"{dataset.folder}: expected frames of the split 'test', found none")
    checkpoint, training = _train(job, dataset, report)
    model = _export(job, dataset, checkpoint, "model", report)
    paper = _export(job, dataset, checkpoint, "paper", report)
    rims = _rims(job, dataset, report)
    return {
        "dataset": {
            "folder": str(dataset.folder),
            "frames": len(dataset.frames()),
            "labels_sha256": dataset.digest,
        },
        "training": training,
        "model": model,
        "paper": paper,
        "test": {source: _evaluate(job, dataset, source, rims, report, progress) for source in sources},
    }


def _train(job: Job, dataset: Dataset, report: Report) -> tuple[Path, dict[str, Any]]:
    """The checkpoint to export and what the training says of itself."""
    from payload_emulator.training.model.train import train

    run = job.run or job.out / "run"
    figures: dict[str, Any] | None = None
    if job.run is None:
        wanted = {
            "labels_sha256": dataset.digest,
            "parameters": json.loads(json.dumps(asdict(job.parameters))),
        }
        figures = _stage(job, "train", wanted)
        if figures is None:
            figures = train([dataset], run, job.parameters, report=report)
            _finish(job, "train", wanted, figures)
    for name in ("best.pt", "checkpoint.pt"):
        if (run / name).is_file():
            return run / name, figures or {"run": str(run)}
    raise ModelError(f"{run}: expected a run with a checkpoint, found none")


def _export(job: Job, dataset: Dataset, checkpoint: Path, name: str, report: Report) -> dict[str, Any]:
    """The exported network, `name` "model" or "paper", with its test figures in its metadata."""
    from payload_emulator.training.model.export import export

    out = job.out / f"{name}.onnx"
    wanted = {
        "checkpoint_sha256": hashlib.sha256(checkpoint.read_bytes()).hexdigest(),
        "labels_sha256": dataset.digest,
        "revision": job.revision,
        "note": job.note,
    }
    figures = _stage(job, f"export-{name}", wanted) if out.is_file() else None
    if figures is None:
        report(f"export: {out.name}")
        figures = export(
            checkpoint,
            out,
            [dataset],
            job.revision,
            {"training_note": job.note} if job.note else None,
            paper_classes=name == "paper",
            test=True,
        )
        _finish(job, f"export-{name}", wanted, figures)
    return figures


def _rims(job: Job, dataset: Dataset, report: Report) -> RefittedRims | None:
    """Rims measured on the terrain of the test frames, where it is real and there are rasters to measure them on."""
    if job.rims is not None:
        return load_refitted(job.rims)
    tiles = [path for path in job.data.dem_tiles if "128ppd" in path.name]
    if not tiles or job.data.catalogue_lu is None or all(frame.complete for frame in dataset.frames("test")):
        return None
    path = job.out / "rims.bin"
    wanted = {"catalogue": job.data.catalogue_lu.name, "tiles": sorted(tile.name for tile in tiles)}
    if _stage(job, "rims", wanted) is None or not path.is_file():
        from lunar.catalogue import load_catalogue
        from payload_emulator.sim.terrain.curation import RasterHeights, curate
        from tmtc.tables import pack_catalogue_table

        report("rims: measured on the terrain")
        curation = curate(load_catalogue(job.data.catalogue_lu), RasterHeights(tiles))
        write_whole(path, pack_catalogue_table(curation.table))
        _finish(job, "rims", wanted, {"rims": len(curation.table)})
    return load_refitted(path)


def _evaluate(
    job: Job,
    dataset: Dataset,
    source: str,
    rims: RefittedRims | None,
    report: Report,
    progress: Progress,
) -> dict[str, Any]:
    """Figures of both models on one test source; with the report of the first."""
    from payload_emulator.training.evaluate.evaluate import evaluate, open_for_evaluation, run, summary
    from payload_emulator.training.evaluate.report import detector_report
    from reports.render import render_html

    models = {name: (job.out / f"{name}.onnx").read_bytes() for name in ("model", "paper")}
    page = job.out / f"report-{source}.html"
    wanted: dict[str, Any] = {name: hashlib.sha256(octets).hexdigest() for name, octets in models.items()} | {
        "labels_sha256": dataset.digest,
        "rims": 0 if rims is None else len(rims),
    }
    figures = _stage(job, f"evaluate-{source}", wanted) if page.is_file() else None
    if figures is None:
        report(f"evaluation: {source}")
        detector = open_for_evaluation(models["model"])
        scored = run(detector, [dataset], "test", source, progress=progress)
        figures = {"model": summary(detector, [dataset], scored, "test", source, rims)}
        drawn = detector_report(detector, scored, figures["model"], job.run or job.out / "run")
        write_whole(page, render_html(drawn).encode())
        figures["paper"] = evaluate(
            models["paper"], dataset, "test", source, progress=progress, paper_classes=True
        )
        _finish(job, f"evaluate-{source}", wanted, figures)
    return figures


def _stage(job: Job, name: str, wanted: Mapping[str, Any]) -> dict[str, Any] | None:
    """The result of a stage that was finished with the same things, else None."""
    path = job.out / "stages" / f"{name}.json"
    if not path.is_file():
        return None
    stored = json.loads(path.read_text(encoding="utf-8"))
    result: dict[str, Any] = stored["result"]
    return result if stored["made_from"] == dict(wanted) else None


def _finish(job: Job, name: str, wanted: Mapping[str, Any], result: Mapping[str, Any]) -> None:
    folder = job.out / "stages"
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / f"{name}.json", {"made_from": dict(wanted), "result": dict(result)})


def format_comparison(document: Mapping[str, Any]) -> str:
    """Both models on every test source as one table."""
    lines = [
        f"{'test source':18}{'frames':>7}{'':3}{'':14}{'P':>6}{'R':>6}{'F1':>6}{'':4}{'95 %':>12}"
        f"{'loc mean':>10}{'median':>8}{'bias':>7}"
    ]
    for source, both in document["test"].items():
        figures = both["model"]
        low, high = figures["micro"]["f1_interval_95"]
        interval = f"{low:.2f}-{high:.2f}"
        for title, row in (
            ("strict", figures["micro"]),
            ("ignore-aware", figures["ignore_aware"]),
            ("balanced", figures["balanced"]["strict"]),
            ("navigation", figures["navigation"]["strict"]),
            ("paper's design", both["paper"]["micro"]),
        ):
            first = title == "strict"
            lines.append(
                f"{source if first else '':18}{figures['frames'] if first else '':>7}   {title:14}"
                f"{row['precision']:6.2f}{row['recall']:6.2f}{row['f1']:6.2f}    {interval if first else '':>12}"
                f"{row['loc_px']:10.2f}{row['loc_median_px']:8.2f}"
                f"{format(figures['bias_px']['worst_octant_px'], '.2f') if first else '':>7}"
            )
        lines += [
            f"{'':18}class {k}: P / R / loc px {_class(row)}; paper's design {_class(theirs)}; published "
            f"{_class(row['paper'])}"
            for k, (row, theirs) in enumerate(
                zip(figures["per_class"], both["paper"]["per_class"], strict=True)
            )
        ]
        lines.append(f"{'':18}evidence level {figures['level']}")
    model = document["model"]
    lines.append(
        f"{model['model']}: {model['model_bytes'] / 1e6:.2f} MB, thresholds {model['score_threshold']:.2f} on board, "
        f"{model['f1_threshold']:.2f} balanced, {model['navigation_threshold']:.2f} navigation (fixed on validation)"
    )
    return "\n".join(lines)


def _class(row: Mapping[str, float]) -> str:
    return f"{row['precision']:.2f} / {row['recall']:.2f} / {row['loc_px']:.2f}"
