"""`linna detector train | export | calibrate | evaluate | detect | bench | info`: the crater detector."""

import argparse
import math
from pathlib import Path
from typing import Any

from linna.commands._choices import add_model, model_octets, need_torch, restart_for_training
from linna.errors import UsageError
from linna.output import emit, finish, log, progress, save
from linna.parser import ABOVE_ZERO, number, option


def configure_detector(parser: argparse.ArgumentParser) -> None:

    verbs = parser.add_subparsers(title="verbs", required=True)

    _add_train(verbs)
    _add_export(verbs)
    _add_calibrate(verbs)
    _add_evaluate(verbs)
    configure_detect(verbs)
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

    evaluate = verbs.add_parser("evaluate", help="precision, recall and localisation on a data set")
    add_model(evaluate)
    tested = evaluate.add_mutually_exclusive_group(required=True)
    option(tested, "--dataset DIR", Path, nargs="+")
    add_evaluation(evaluate, tested)
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
    from payload_emulator.training.model.export import bench

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


FIELD_OF_VIEW = number(above=0, below=180)


def configure_detect(verbs: Any) -> None:
    """Add the verb `detect`."""
    detect = verbs.add_parser("detect", help="craters in any PNG, TIFF, JPEG or NPY")
    option(detect, "images IMAGE", Path, nargs="+")
    add_model(detect)
    option(detect, "--altitude-km", ABOVE_ZERO, "above the ground; gives size classes", None)
    option(detect, "--fov-deg", FIELD_OF_VIEW, "", 120.0)
    option(detect, "--threshold", float, "", None)
    option(detect, "--picture F.png", Path, "the image with the rims of its craters; of one image")
    _add_search(detect)
    finish(detect, _detect)


def add_evaluation(evaluate: argparse.ArgumentParser, tested: Any) -> None:
    """Add the options of an evaluation on a labelled set; `tested` holds what can be evaluated on."""
    option(tested, "--coco DIR", Path, "a set of images with crater boxes or polygons in COCO files")
    of_set = evaluate.add_argument_group("with --coco")
    option(of_set, "--category NAME", str, "category of craters (default: those whose name says crater)", "")
    _add_search(of_set)
    option(of_set, "--pixel-m", ABOVE_ZERO, "ground covered by a pixel; gives classes in km", default=math.nan)
    option(of_set, "--altitude-km", ABOVE_ZERO, "above the ground, with --fov-deg, instead", default=math.nan)
    option(of_set, "--fov-deg", FIELD_OF_VIEW, "", 120.0)
    option(of_set, "--range-px LOW HIGH", float, "diameters that are scored (default: 8 150)", (8.0, 150.0))
    option(of_set, "--level", ("2", "3s", "3", "4", "5"), "evidence level of the images (default: 5, photographs)", "5")


def evaluate_set(arguments: argparse.Namespace) -> int:
    """Evaluate on a labelled set."""
    from payload_emulator.training.evaluate.evaluate import open_for_evaluation
    from payload_emulator.training.evaluate.pictures import PictureSetOptions, evaluate_pictures, format_picture_figures

    for name in ("report", "run", "source", "paper_classes"):
        if getattr(arguments, name):
            option = f"--{name.replace('_', '-')}"
            raise UsageError(f"{option}: expected together with --dataset, found with --coco")
    low, high = arguments.range_px
    if not 0.0 <= low < high:
        raise UsageError(f"--range-px: expected two diameters in rising order, found {low:g} {high:g}")
    detector = open_for_evaluation(model_octets(arguments.model))
    own = float(detector.metadata.get("score_threshold", "0.4"))
    figures = evaluate_pictures(
        detector,
        arguments.coco,
        own if arguments.threshold is None else arguments.threshold,
        PictureSetOptions(
            sun_azimuth_deg=arguments.sun_azimuth_deg,
            pixel_m=arguments.pixel_m,
            altitude_km=arguments.altitude_km,
            fov_deg=arguments.fov_deg,
            range_px=(low, high),
            two_scales=arguments.two_scales,
            level=arguments.level,
            category=arguments.category,
        ),
        lambda pictures: progress(pictures, len(pictures), "evaluate", "images"),
    )
    return emit(arguments, figures, format_picture_figures(figures))


def refuse_options_of_sets(arguments: argparse.Namespace) -> None:
    """Refuse options of labelled sets where a data set of the project is evaluated.

    Raises
    ------
    UsageError
        One of them was given.
    """

    if arguments.two_scales:
        raise UsageError("--two-scales: expected together with --coco, found with --dataset")
    if arguments.sun_azimuth_deg is not None:
        raise UsageError("--sun-azimuth-deg: expected together with --coco, found with --dataset")
    if arguments.category:
        raise UsageError("--category: expected together with --coco, found with --dataset")


def _add_search(parser: Any) -> None:
    option(
        parser,
        "--sun-azimuth-deg",
        float,
        "of the Sun in the image, clockwise from its top; without it, the azimuth is found from the image",
        None,
    )
    option(
        parser,
        "--two-scales",
        bool,
        "also search the image enlarged twice, for small craters; up to ten times the time",
    )


def _detect(arguments: argparse.Namespace) -> int:
    from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector
    from payload_emulator.flight.vision.picture_search import search_picture, sun_at_azimuth
    from payload_emulator.flight.vision.preprocess import quality_reason
    from payload_emulator.session.world.external import read_picture
    from payload_emulator.training.evaluate.sheets import draw_detections, format_detections, save_png

    if arguments.picture and len(arguments.images) > 1:
        raise UsageError(f"--picture: expected one image, found {len(arguments.images)}")
    detector = OnnxDetector(model_octets(arguments.model), DetectorParameters(score_threshold=arguments.threshold))
    sun = None if arguments.sun_azimuth_deg is None else sun_at_azimuth(arguments.sun_azimuth_deg)
    images: list[dict[str, Any]] = []
    for path in arguments.images:
        image, remark = read_picture(path)
        outcome = search_picture(detector, image, sun, two_scales=arguments.two_scales)
        item: dict[str, Any] = {
            "file": str(path),
            "quality": outcome.quality.name.lower(),
            "reason": quality_reason(image, outcome.quality),
            "pixels": remark,
            "sun": _sun(outcome, arguments.sun_azimuth_deg),
            "detections": _detections(outcome.detections, image.shape[1], arguments),
        }
        if sun is None and item["quality"] == "ok":
            log(f"{path}: {_sun_sentence(item['sun'])}")
        images.append(item)
        if arguments.picture:
            save_png(draw_detections(image, item["detections"]), arguments.picture)
    text = "\n".join(map(format_detections, images))
    emit(arguments, {"images": images, "model_sha256": detector.sha256}, text)
    return 0 if any(item["quality"] == "ok" for item in images) else 1


def _sun(outcome: Any, given_deg: float | None) -> dict[str, Any]:
    """Azimuth that a search used, and where it comes from."""
    if given_deg is not None:
        return {"source": "given", "azimuth_deg": given_deg, "confidence": None}
    if outcome.sun is None:
        return {"source": "unknown", "azimuth_deg": None, "confidence": None}
    return {
        "source": "found" if outcome.sun.determined else "undetermined",
        "azimuth_deg": round(outcome.sun.azimuth_deg, 1),
        "confidence": round(outcome.sun.confidence, 3),
    }


def _sun_sentence(sun: dict[str, Any]) -> str:
    if sun["azimuth_deg"] is None:
        return "Sun azimuth not given and not found: no turn of the image shows a crater; searched as it is"
    word = "found" if sun["source"] == "found" else "undetermined by half a turn, most likely"
    return (
        f"Sun azimuth not given; {word} {sun['azimuth_deg']:.0f} degrees clockwise from the top "
        f"(confidence {sun['confidence']:.2f})"
    )


def _detections(found: Any, width_px: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    import numpy as np

    from lunar.catalogue import size_class
    from payload_emulator.flight.vision.detections import states

    classes = np.full(len(found), -1)
    if arguments.altitude_km is not None:
        focal = 0.5 * width_px / math.tan(math.radians(arguments.fov_deg) / 2.0)
        classes = size_class(found.diameter_px * arguments.altitude_km * 1000.0 / focal)
    ratios, called = found.depth_ratio, states(found)
    return [
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
