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
    from linna.commands import _detector_domain, _detector_make, _detector_studies

    verbs = parser.add_subparsers(title="verbs", required=True)

    _add_train(verbs)
    _add_export(verbs)
    _add_evaluate(verbs)
    _detector_studies.configure(verbs)
    _detector_make.configure(verbs)
    _detector_domain.configure(verbs)
    _add_detect(verbs)
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


def _add_evaluate(verbs: Any) -> None:
    from linna.output import add_json_flag

    evaluate = verbs.add_parser("evaluate", help="precision, recall and localisation on a data set")
    add_model(evaluate)
    evaluate.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
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


def _add_detect(verbs: Any) -> None:
    from linna.output import add_json_flag

    detect = verbs.add_parser("detect", help="craters in any PNG, TIFF or JPEG")
    detect.add_argument("images", type=Path, nargs="+", metavar="IMAGE")
    add_model(detect)
    detect.add_argument(
        "--altitude-km", type=float, default=None, help="above the ground; gives size classes"
    )
    detect.add_argument("--fov-deg", type=float, default=120.0)
    detect.add_argument(
        "--sun-azimuth-deg", type=float, default=None, help="of the Sun in the image, clockwise from its top"
    )
    detect.add_argument("--threshold", type=float, default=None)
    add_json_flag(detect)
    detect.set_defaults(handler=_detect)


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
    from payload_emulator.training.evaluate.landmarks import load_landmarks
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
        preparation=Preparation.normalise_first if arguments.normalise_first else Preparation.gray_first,
    )
    datasets = [Dataset(folder) for folder in arguments.datasets]
    landmarks = None if arguments.landmarks is None else load_landmarks(arguments.landmarks)
    figures = train(
        datasets,
        arguments.out,
        parameters,
        start_from=arguments.start_from,
        landmarks=landmarks,
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


def _evaluate(arguments: argparse.Namespace) -> int:
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.data.refits import load_refitted
    from payload_emulator.training.evaluate.evaluate import format_figures, open_for_evaluation, run, summary

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


def _detect(arguments: argparse.Namespace) -> int:
    import math

    import numpy as np

    from linna.errors import UsageError
    from linna.output import emit
    from lunar.catalogue import size_class
    from payload_emulator.flight.vision.detections import states
    from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector

    if arguments.altitude_km is not None and not arguments.altitude_km > 0.0:
        raise UsageError(
            f"--altitude-km: expected a positive number of kilometres, found {arguments.altitude_km:g}"
        )
    if not 0.0 < arguments.fov_deg < 180.0:
        raise UsageError(f"--fov-deg: expected an angle between 0 and 180, found {arguments.fov_deg:g}")
    detector = OnnxDetector(
        model_octets(arguments.model), DetectorParameters(score_threshold=arguments.threshold)
    )
    sun = None
    if arguments.sun_azimuth_deg is not None:
        azimuth = math.radians(arguments.sun_azimuth_deg)
        sun = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    images: list[dict[str, Any]] = []
    for path in arguments.images:
        image = _read_image(path)
        quality, found = detector.examine_any_size(image, sun)
        classes = np.full(len(found), -1)
        if arguments.altitude_km is not None:
            focal = 0.5 * image.shape[1] / math.tan(math.radians(arguments.fov_deg) / 2.0)
            classes = size_class(found.diameter_px * arguments.altitude_km * 1000.0 / focal)
        ratios, called = found.depth_ratio, states(found)
        detections = [
            {
                "u_px": round(float(found.u_px[k]), 3),
                "v_px": round(float(found.v_px[k]), 3),
                "diameter_px": round(float(found.diameter_px[k]), 3),
                "score": round(float(found.score[k]), 4),
                "sigma_px": round(float(found.sigma_px[k]), 3),
                "class": int(classes[k]),
                **({} if ratios is None else {"depth_ratio": round(float(ratios[k]), 3), "state": called[k]}),
            }
            for k in range(len(found))
        ]
        images.append({"file": str(path), "quality": quality.name.lower(), "detections": detections})
    text = "\n".join(
        f"{item['file']}: {item['quality']}, {len(item['detections'])} craters" for item in images
    )
    emit(arguments, {"images": images, "model_sha256": detector.sha256}, text)
    return 0


def _read_image(path: Path) -> Any:
    """Pixels of an image file, 8 or 16 bits or float; colours in RGB order.

    A 16-bit file whose greatest value would fit into 12 or 14 bits is taken for one of so many.
    """
    import cv2
    import numpy as np

    from linna.errors import UsageError

    octets = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(octets, cv2.IMREAD_UNCHANGED) if octets.size else None
    if image is None:
        raise UsageError(f"{path}: expected an image (PNG, TIFF, JPEG), found none that can be read")
    if image.dtype == np.uint16:
        held = next(bits for bits in (12, 14, 16) if int(image.max()) < 1 << bits)
        image = image << (16 - held)
    return image[..., [2, 1, 0]] if image.ndim == 3 and image.shape[2] >= 3 else image


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
