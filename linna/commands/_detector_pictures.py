"""`linna detector detect` and `linna detector evaluate --coco`: single pictures and labelled sets of them."""

import argparse
import math
from pathlib import Path
from typing import Any

from linna.commands._detector_common import add_model, model_octets
from linna.errors import UsageError
from linna.output import emit, finish, log, progress
from linna.parser import ABOVE_ZERO, number, option

FIELD_OF_VIEW = number(above=0, below=180)


def configure(verbs: Any) -> None:
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
