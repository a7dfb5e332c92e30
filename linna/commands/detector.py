"""`linna detector`: train, export, evaluate and run the crater detector."""

import argparse
from pathlib import Path
from typing import Any

from linna.commands._detector_common import add_model, model_octets, need_torch, restart_for_training
from linna.output import emit, finish, log, progress, save
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    from linna.commands import _detector_pictures

    verbs = parser.add_subparsers(title="verbs", required=True)

    _add_train(verbs)
    _add_export(verbs)
    _add_calibrate(verbs)
    _add_evaluate(verbs)
    _detector_pictures.configure(verbs)
    _add_bench_and_info(verbs)


def _add_train(verbs: Any) -> None:
    train = verbs.add_parser("train", help="train a network; resumes the run of the same folder")
    option(train, "datasets DATASET", Path, nargs="+")
    option(train, "--out RUN", Path, required=True)
    option(train, "--minutes", float, "wall-clock budget of the learning-rate schedule", 90.0)
    option(train, "--steps", int, "budget in optimiser steps instead", 0)
    option(train, "--seed", int, "", 1)
    option(train, "--crop PX", int, "", 384)
    option(train, "--learning-rate", float, "", 2.5e-3)
    option(train, "--landmarks F.csv", Path, "uncatalogued landmarks as further labels", None)
    option(train, "--start-from FILE", Path, "first weights: a checkpoint or an ONNX network", None)
    option(
        train, "--normalise-first", bool, "the paper's order: channels of an RGB data set are normalised, then averaged"
    )
    option(
        train,
        "--enlarge",
        int,
        "factor by which the network enlarges images, for high altitudes; --crop is in pixels before enlargement",
        1,
        choices=(1, 2),
    )
    option(train, "--replicas", int, "threads that train side by side (0: one per core)", 0)
    finish(train, _train)


def _add_export(verbs: Any) -> None:
    export = verbs.add_parser("export", help="write the ONNX network of a run, checked against torch")
    option(export, "run RUN", Path, "folder of a run, a checkpoint file, or an exported network")
    option(export, "--out M.onnx", Path, required=True)
    option(export, "--dataset DIR", Path, "whose validation split fixes the thresholds", [], nargs="*")
    option(export, "--revision", str, "source revision for the model's metadata", "")
    option(export, "--paper-classes", bool, "keep the heatmaps of the paper's three classes")
    option(
        export, "--classes-only", bool, "the paper's detector: class heatmaps and offsets, no sizes; flies as a build"
    )
    option(
        export,
        "--enlarge",
        int,
        "factor by which the network first enlarges images (0: factor of the network)",
        0,
        choices=(0, 1, 2),
    )
    option(export, "--test", bool, "score the test splits and write the figures into the model")
    finish(export, _export)


def _add_calibrate(verbs: Any) -> None:
    calibrate = verbs.add_parser(
        "calibrate", help="fit the standard deviations of centres on validation frames, and store them"
    )
    add_model(calibrate)
    option(calibrate, "--dataset DIR", Path, nargs="+", required=True)
    option(calibrate, "--out M.onnx", Path, required=True)
    finish(calibrate, _calibrate)


def _add_evaluate(verbs: Any) -> None:
    from linna.commands import _detector_pictures

    evaluate = verbs.add_parser("evaluate", help="precision, recall and localisation on a data set")
    add_model(evaluate)
    tested = evaluate.add_mutually_exclusive_group(required=True)
    option(tested, "--dataset DIR", Path, nargs="+")
    _detector_pictures.add_evaluation(evaluate, tested)
    option(evaluate, "--split", ("train", "val", "test"), "", "test")
    option(evaluate, "--source", str, "only the frames of this source", "")
    option(evaluate, "--threshold", float, "instead of the model's own", None)
    option(
        evaluate,
        "--paper-classes",
        bool,
        "the paper's design: the class from its own heatmap instead of diameter and altitude",
    )
    option(evaluate, "--report F.html", Path, "write one HTML report", None)
    option(evaluate, "--run", Path, "training run whose curves the report shows", None)
    finish(evaluate, _evaluate)


def _add_bench_and_info(verbs: Any) -> None:
    bench = verbs.add_parser("bench", help="latency and memory on this machine")
    add_model(bench)
    option(bench, "--threads", int, "", 1)
    option(bench, "--frames", int, "", 100)
    finish(bench, _bench)

    info = verbs.add_parser("info", help="what a model says of itself, and files of the shipped networks")
    add_model(info)
    finish(info, _info)


def _train(arguments: argparse.Namespace) -> int:

    need_torch()
    from payload_emulator.flight.vision.preprocess import Preparation
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.data.feeder import TrainParameters
    from payload_emulator.training.data.landmarks import load_landmarks
    from payload_emulator.training.model.train import train

    restart_for_training()
    parameters = TrainParameters(
        minutes=0.0 if arguments.steps else arguments.minutes,
        steps=arguments.steps,
        crop_px=arguments.crop,
        learning_rate=arguments.learning_rate,
        seed=arguments.seed,
        replicas=arguments.replicas,
        enlarge=arguments.enlarge,
        preparation=Preparation.normalise_first if arguments.normalise_first else Preparation.gray_first,
    )
    datasets = [Dataset(folder) for folder in arguments.datasets]
    landmarks = None if arguments.landmarks is None else load_landmarks(arguments.landmarks)
    figures = train(
        datasets, arguments.out, parameters, start_from=arguments.start_from, landmarks=landmarks, report=log
    )
    return emit(arguments, figures)


def _export(arguments: argparse.Namespace) -> int:

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
        paper_classes=arguments.paper_classes,
        classes_only=arguments.classes_only,
        enlarge=arguments.enlarge,
        test=arguments.test,
    )
    return emit(arguments, figures)


def _calibrate(arguments: argparse.Namespace) -> int:
    from payload_emulator.training.data.dataset import Dataset, write_whole
    from payload_emulator.training.model.fit_calibration import fit_calibration, format_calibration_figures

    octets, document = fit_calibration(
        model_octets(arguments.model),
        [Dataset(folder) for folder in arguments.dataset],
        lambda frames: progress(frames, len(frames), "calibrate", "frames"),
    )
    sha256 = write_whole(arguments.out, octets)
    document = {"model": str(arguments.out), "sha256": sha256, **document}
    return emit(arguments, document, format_calibration_figures(document))


def _evaluate(arguments: argparse.Namespace) -> int:
    from linna.commands._detector_pictures import evaluate_set, refuse_options_of_sets
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.evaluate.evaluate import format_figures, open_for_evaluation, run, summary

    if arguments.coco is not None:
        return evaluate_set(arguments)
    refuse_options_of_sets(arguments)
    datasets = [Dataset(folder) for folder in arguments.dataset]
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
    figures = summary(detector, datasets, scored, arguments.split, arguments.source)
    if arguments.report is not None:
        from payload_emulator.training.evaluate.report import detector_report
        from reports.render import render_html

        arguments.report.parent.mkdir(parents=True, exist_ok=True)
        report = detector_report(detector, scored, figures, arguments.run)
        save(arguments.report, render_html(report).encode())
    return emit(arguments, figures, format_figures(figures))


def _bench(arguments: argparse.Namespace) -> int:
    from payload_emulator.training.model.bench import bench

    return emit(arguments, bench(model_octets(arguments.model), arguments.threads, arguments.frames))


def _info(arguments: argparse.Namespace) -> int:
    import json

    from payload_emulator.flight.models import describe_networks
    from payload_emulator.flight.vision.detector import OnnxDetector

    octets = model_octets(arguments.model)
    detector = OnnxDetector(octets)
    metadata = {key: json.loads(text) if text[:1] in ("{", "[") else text for key, text in detector.metadata.items()}
    figures = {"sha256": detector.sha256, "model_bytes": len(octets), **metadata}
    shipped = describe_networks()
    lines = [f"{key}: {value}" for key, value in figures.items()] + [
        f"shipped network {name}: {one['file']}, SHA-256 {one['sha256']}, {one['purpose']}"
        for name, one in shipped.items()
    ]
    return emit(arguments, figures | {"shipped": shipped}, "\n".join(lines))
