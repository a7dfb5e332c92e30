"""`linna detector`: train, export, evaluate and run the crater detector."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.commands._detector_common import (
    add_model,
    model_octets,
    need_torch,
    restart_for_training,
    write_text,
)


def configure(parser: argparse.ArgumentParser) -> None:
    from linna.commands import _detector_pictures

    verbs = parser.add_subparsers(title="verbs", required=True)

    _add_train(verbs)
    _add_export(verbs)
    _add_calibrate(verbs)
    _add_evaluate(verbs)
    _add_compare(verbs)
    _detector_pictures.configure(verbs)
    _add_bench_and_info(verbs)


def _add_train(verbs: Any) -> None:
    from linna.output import add_json_flag

    train = verbs.add_parser("train", help="train a network; resumes the run of the same folder")
    train.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    train.add_argument("--out", type=Path, required=True, metavar="RUN")
    train.add_argument(
        "--minutes", type=float, default=90.0, help="wall-clock budget of the learning-rate schedule"
    )
    train.add_argument("--steps", type=int, default=0, help="budget in optimiser steps instead")
    train.add_argument("--seed", type=int, default=1)
    train.add_argument("--crop", type=int, default=384, metavar="PX")
    train.add_argument("--batch", type=int, default=8)
    train.add_argument(
        "--patience", type=int, default=0, help="stop after this many validations without gain (0: never)"
    )
    train.add_argument("--learning-rate", type=float, default=2.5e-3)
    train.add_argument(
        "--landmarks",
        type=Path,
        default=None,
        metavar="F.csv",
        help="uncatalogued landmarks as further labels",
    )
    train.add_argument(
        "--start-from",
        type=Path,
        default=None,
        metavar="FILE",
        help="first weights: a checkpoint or an ONNX network",
    )
    train.add_argument(
        "--normalise-first",
        action="store_true",
        help="the paper's order: channels of an RGB data set are normalised, then averaged",
    )
    train.add_argument(
        "--enlarge",
        type=int,
        choices=(1, 2),
        default=1,
        help="factor by which the network enlarges images, for high altitudes; --crop is in pixels before enlargement",
    )
    train.add_argument(
        "--visible-labels",
        action="store_true",
        help="choose and weigh labels by their visibility in the frame instead of their depth/diameter",
    )
    train.add_argument(
        "--least-emphasis",
        type=float,
        default=0.5,
        metavar="W",
        help="least factor of a label's weight by diameter; 1 weighs all craters below 28 px the same (default: 0.5)",
    )
    train.add_argument(
        "--rims",
        type=Path,
        default=None,
        metavar="TABLE",
        help="labels on rims (binary table of `linna catalogue curate`) instead of the catalogue's circles",
    )
    train.add_argument(
        "--replicas", type=int, default=0, help="threads that train side by side (0: one per core)"
    )
    add_json_flag(train)
    train.set_defaults(handler=_train)


def _add_export(verbs: Any) -> None:
    from linna.output import add_json_flag

    export = verbs.add_parser("export", help="write the ONNX network of a run, checked against torch")
    export.add_argument(
        "run", type=Path, metavar="RUN", help="folder of a run, a checkpoint file, or an exported network"
    )
    export.add_argument("--out", type=Path, required=True, metavar="M.onnx")
    export.add_argument(
        "--dataset",
        type=Path,
        nargs="*",
        default=[],
        metavar="DIR",
        help="whose validation split fixes the thresholds",
    )
    export.add_argument("--revision", default="", help="source revision for the model's metadata")
    export.add_argument("--note", default="", help="a remark on the training for the model's metadata")
    export.add_argument(
        "--paper-classes", action="store_true", help="keep the heatmaps of the paper's three classes"
    )
    export.add_argument(
        "--classes-only",
        action="store_true",
        help="the paper's detector: class heatmaps and offsets, no sizes; flies as a build",
    )
    export.add_argument(
        "--enlarge",
        type=int,
        choices=(0, 1, 2),
        default=0,
        help="factor by which the network first enlarges images (0: factor of the network)",
    )
    export.add_argument(
        "--test", action="store_true", help="score the test splits and write the figures into the model"
    )
    add_json_flag(export)
    export.set_defaults(handler=_export)


def _add_calibrate(verbs: Any) -> None:
    from linna.output import add_json_flag
    from payload_emulator.flight.vision.calibration import PARTS

    calibrate = verbs.add_parser(
        "calibrate",
        help="fit scores by size, position errors and the pull of the Sun on validation frames, and store them",
    )
    add_model(calibrate)
    calibrate.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
    calibrate.add_argument("--out", type=Path, required=True, metavar="M.onnx")
    calibrate.add_argument(
        "--parts",
        nargs="*",
        choices=PARTS,
        default=["score", "sigma"],
        help="what is stored (default: score and sigma)",
    )
    calibrate.add_argument(
        "--precision",
        type=float,
        default=0.85,
        metavar="P",
        help="share of the detections used on board that are catalogued craters of 3 to 30 km (default: 0.85)",
    )
    add_json_flag(calibrate)
    calibrate.set_defaults(handler=_calibrate)


def _add_evaluate(verbs: Any) -> None:
    from linna.commands import _detector_pictures
    from linna.output import add_json_flag

    evaluate = verbs.add_parser("evaluate", help="precision, recall and localisation on a data set")
    add_model(evaluate)
    tested = evaluate.add_mutually_exclusive_group(required=True)
    tested.add_argument("--dataset", type=Path, nargs="+", metavar="DIR")
    _detector_pictures.add_evaluation(evaluate, tested)
    evaluate.add_argument("--split", choices=("train", "val", "test"), default="test")
    evaluate.add_argument("--source", default="", help="only the frames of this source")
    evaluate.add_argument("--threshold", type=float, default=None, help="instead of the model's own")
    evaluate.add_argument(
        "--paper-classes",
        action="store_true",
        help="the paper's design: the class from its own heatmap instead of diameter and altitude",
    )
    evaluate.add_argument(
        "--rims",
        type=Path,
        default=None,
        metavar="TABLE",
        help="rims from `linna catalogue curate`: distances from these in addition to the catalogue positions",
    )
    evaluate.add_argument(
        "--rims-shift",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("EAST_M", "NORTH_M"),
        help="offset of the terrain in the images from the table (default: 0 0)",
    )
    evaluate.add_argument("--report", type=Path, default=None, metavar="F.html", help="write one HTML report")
    evaluate.add_argument("--run", type=Path, default=None, help="training run whose curves the report shows")
    add_json_flag(evaluate)
    evaluate.set_defaults(handler=_evaluate)


def _add_compare(verbs: Any) -> None:
    from linna.output import add_json_flag

    compare = verbs.add_parser("compare", help="two networks on the same frames, with paired intervals")
    compare.add_argument("model", type=Path, metavar="M.onnx", help="ONNX file or name of a shipped network")
    compare.add_argument("reference", type=Path, metavar="REFERENCE.onnx")
    compare.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
    compare.add_argument("--split", choices=("train", "val", "test"), default="val")
    compare.add_argument("--source", default="", help="only the frames of this source")
    compare.add_argument(
        "--picture",
        type=Path,
        default=None,
        metavar="F.png",
        help="draw both networks' detections on some frames",
    )
    add_json_flag(compare)
    compare.set_defaults(handler=_compare)


def _add_bench_and_info(verbs: Any) -> None:
    from linna.output import add_json_flag

    bench = verbs.add_parser("bench", help="latency and memory on this machine")
    add_model(bench)
    bench.add_argument("--threads", type=int, default=1)
    bench.add_argument("--frames", type=int, default=100)
    add_json_flag(bench)
    bench.set_defaults(handler=_bench)

    info = verbs.add_parser("info", help="what a model says of itself")
    add_model(info)
    add_json_flag(info)
    info.set_defaults(handler=_info)


def _train(arguments: argparse.Namespace) -> int:
    from linna.output import emit, log

    need_torch()
    from payload_emulator.flight.vision.preprocess import Preparation
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.data.feeder import TrainParameters
    from payload_emulator.training.data.landmarks import load_landmarks
    from payload_emulator.training.data.refits import load_refitted
    from payload_emulator.training.model.train import train

    restart_for_training()
    parameters = TrainParameters(
        minutes=0.0 if arguments.steps else arguments.minutes,
        steps=arguments.steps,
        batch=arguments.batch,
        crop_px=arguments.crop,
        learning_rate=arguments.learning_rate,
        patience=arguments.patience,
        seed=arguments.seed,
        replicas=arguments.replicas,
        enlarge=arguments.enlarge,
        visible_labels=arguments.visible_labels,
        least_emphasis=arguments.least_emphasis,
        preparation=Preparation.normalise_first if arguments.normalise_first else Preparation.gray_first,
    )
    datasets = [Dataset(folder) for folder in arguments.datasets]
    landmarks = None if arguments.landmarks is None else load_landmarks(arguments.landmarks)
    rims = None if arguments.rims is None else load_refitted(arguments.rims)
    figures = train(
        datasets,
        arguments.out,
        parameters,
        start_from=arguments.start_from,
        landmarks=landmarks,
        rims=rims,
        report=log,
    )
    emit(arguments, figures)
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from linna.output import emit

    need_torch()
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.model.export import export

    checkpoint = arguments.run
    if checkpoint.is_dir():
        best = checkpoint / "best.pt"
        checkpoint = best if best.is_file() else checkpoint / "checkpoint.pt"
    datasets = [Dataset(folder) for folder in arguments.dataset]
    figures = export(
        checkpoint,
        arguments.out,
        datasets,
        arguments.revision,
        {"training_note": arguments.note} if arguments.note else None,
        paper_classes=arguments.paper_classes,
        classes_only=arguments.classes_only,
        enlarge=arguments.enlarge,
        test=arguments.test,
    )
    emit(arguments, figures)
    return 0


def _calibrate(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset, write_whole
    from payload_emulator.training.model.fit_calibration import fit_calibration, format_calibration_figures

    if not 0.0 < arguments.precision < 1.0:
        raise UsageError(f"--precision: expected a value between 0 and 1, found {arguments.precision:g}")
    octets, document = fit_calibration(
        model_octets(arguments.model),
        [Dataset(folder) for folder in arguments.dataset],
        arguments.parts,
        arguments.precision,
        lambda frames: progress(frames, len(frames), "calibrate", "frames"),
    )
    sha256 = write_whole(arguments.out, octets)
    document = {"model": str(arguments.out), "sha256": sha256, **document}
    emit(arguments, document, format_calibration_figures(document))
    return 0


def _evaluate(arguments: argparse.Namespace) -> int:
    from linna.commands._detector_pictures import evaluate_set, refuse_options_of_sets
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.data.refits import load_refitted
    from payload_emulator.training.evaluate.evaluate import format_figures, open_for_evaluation, run, summary

    if arguments.coco is not None:
        return evaluate_set(arguments)
    refuse_options_of_sets(arguments)
    datasets = [Dataset(folder) for folder in arguments.dataset]
    rims = None if arguments.rims is None else load_refitted(arguments.rims, *arguments.rims_shift)
    detector = open_for_evaluation(model_octets(arguments.model))
    scored = run(
        detector,
        datasets,
        arguments.split,
        arguments.source,
        arguments.threshold,
        lambda frames: progress(frames, len(frames), "evaluate", "frames"),
        paper_classes=arguments.paper_classes,
    )
    figures = summary(detector, datasets, scored, arguments.split, arguments.source, rims)
    if arguments.report is not None:
        from payload_emulator.training.evaluate.report import detector_report
        from reports.render import render_html

        report = detector_report(detector, scored, figures, arguments.run)
        write_text(arguments.report, render_html(report))
    emit(arguments, figures, format_figures(figures))
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.evaluate.compare import compare, draw_comparison, format_comparison

    document, pair = compare(
        (model_octets(arguments.model), model_octets(arguments.reference)),
        [Dataset(folder) for folder in arguments.dataset],
        arguments.split,
        arguments.source,
        lambda frames: progress(frames, len(frames), "compare", "frames"),
    )
    if arguments.picture is not None:
        draw_comparison(pair, arguments.picture)
    emit(arguments, document, format_comparison(document))
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    from linna.output import emit
    from payload_emulator.training.model.bench import bench

    emit(arguments, bench(model_octets(arguments.model), arguments.threads, arguments.frames))
    return 0


def _info(arguments: argparse.Namespace) -> int:
    import json

    from linna.output import emit
    from payload_emulator.flight.vision.detector import OnnxDetector

    octets = model_octets(arguments.model)
    detector = OnnxDetector(octets)
    metadata = {
        key: json.loads(text) if text[:1] in ("{", "[") else text for key, text in detector.metadata.items()
    }
    emit(arguments, {"sha256": detector.sha256, "model_bytes": len(octets), **metadata})
    return 0
