"""Figures of a detector on labelled image sets from any source, with and without the azimuth of the Sun.

Two criteria, each one-to-one, detections best first. Strict: the box of the detection and the box of the label overlap
by at least half of their union, as in COCO; a detection's box is the square around its circle, cut at the image's edge.
Centre: the detection's centre lies within the label's radius. Size ranges follow COCO: labels outside the range are not
expected, a detection that takes one of them is not counted, and a detection that takes none is counted only if its own
diameter lies in the range. Labels of such sets are often incomplete, so precision is a lower bound.
"""

import enum
import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.catalogue import CLASS_LIMITS_M
from payload_emulator.errors import DatasetError
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.picture_search import PictureSearch, search_picture, sun_at_azimuth
from payload_emulator.session.world.external import read_picture
from payload_emulator.training.data.dataset import FrameTruth
from payload_emulator.training.data.pictures import LabelledPicture, load_pictures, set_words
from payload_emulator.training.evaluate import scoring
from payload_emulator.training.evaluate.metrics import bias_by_octant, bias_overall

DIAMETER_RANGE_PX = (8.0, 150.0)
DIAMETER_EDGES_PX = (8.0, 12.0, 16.0, 32.0, 64.0, 150.0)
LEAST_OVERLAP = 0.5
SUN_RIGHT_DEG = 67.5
"""An azimuth found within this of the true one has the Sun in the turn that is searched or near its edge."""


class Criterion(enum.StrEnum):
    """Criterion for matching a detection to a label."""

    strict = "strict"
    centre = "centre"


class SunKnowledge(enum.StrEnum):
    """Prior knowledge of the Sun for a search."""

    given = "given"
    found = "found"
    upright = "upright"


@dataclass(frozen=True, slots=True)
class PictureSetOptions:
    """Choices of an evaluation; None and NaN take what the set states.

    `level` is the evidence level that the user declares: the files do not tell photographs from renderings.
    """

    sun_azimuth_deg: float | None = None
    pixel_m: float = math.nan
    altitude_km: float = math.nan
    fov_deg: float = 120.0
    range_px: tuple[float, float] = DIAMETER_RANGE_PX
    two_scales: bool = False
    level: str = "5"
    category: str = ""


def evaluate_pictures(
    detector: OnnxDetector,
    folder: Path,
    threshold: float,
    options: PictureSetOptions | None = None,
    progress: Callable[[Sequence[Any]], Any] = iter,
) -> dict[str, Any]:
    """Figures of a detector on the labelled set of a folder.

    `upright` searches every image as it is, as if its Sun stood at the top: the detector without a search for the Sun.

    Raises
    ------
    DatasetError
        The set is broken, or holds no image or no crater.
    """
    options = options or PictureSetOptions()
    pictures = load_pictures(folder, options.category)
    craters = int(sum(np.count_nonzero(~picture.crowd) for picture in pictures))
    if not craters:
        raise DatasetError(f"{folder}: expected craters, found {len(pictures)} images without any")
    azimuths = np.array(
        [p.sun_azimuth_deg if options.sun_azimuth_deg is None else options.sun_azimuth_deg for p in pictures]
    )
    known = bool(np.isfinite(azimuths).all())
    searches: dict[SunKnowledge, list[PictureSearch]] = {way: [] for way in SunKnowledge}
    remarks = []
    for picture, azimuth in progress(list(zip(pictures, azimuths, strict=True))):
        image, remark = read_picture(picture.path)
        remarks += [f"{picture.path.name}: {remark}"] if remark else []
        for way, sun in (
            (SunKnowledge.given, sun_at_azimuth(azimuth)),
            (SunKnowledge.found, None),
            (SunKnowledge.upright, sun_at_azimuth(0.0)),
        ):
            if way is not SunKnowledge.given or known:
                searches[way].append(search_picture(detector, image, sun, two_scales=options.two_scales))
    headline = SunKnowledge.given if known else SunKnowledge.found
    scales = _scales_m(pictures, options)
    by_sun = {
        way.value: _figures(pictures, searches[way], way, azimuths, threshold, options, scales)
        for way in SunKnowledge
        if searches[way]
    }
    return {
        "model_sha256": detector.sha256,
        "dataset": str(folder),
        "rung": int(options.level[0]),
        "level": f"{options.level} (as declared)",
        "images": len(pictures),
        "craters": craters,
        "other_labels": dict(Counter(name for picture in pictures for name in picture.left_out)),
        "repeated_labels": sum(picture.repeated for picture in pictures),
        "labels": set_words(pictures),
        "remarks": remarks,
        "threshold": threshold,
        "two_scales": options.two_scales,
        "diameter_range_px": list(options.range_px),
        "pixel_m": sorted({round(scale, 6) for scale in scales if np.isfinite(scale)}) or None,
        "sun": _sun_figures(pictures, searches[SunKnowledge.found], azimuths) | {"headline": headline.value},
        "micro": by_sun[headline.value]["strict"],
        "by_sun": by_sun,
        **by_sun[headline.value],
    }


def tally_pictures(
    pictures: Sequence[LabelledPicture],
    found: Sequence[Detections],
    criterion: Criterion,
    ranges_px: Sequence[tuple[float, float]],
    sun_azimuth_deg: FloatArray,
) -> scoring.Tally:
    """Every detection and expected label after matching; `ranges_px` holds the least and greatest diameter by picture.

    Blocks of the tally are pictures, so intervals come from resampling pictures.
    """
    detections: list[tuple[NDArray[Any], ...]] = []
    craters: list[tuple[NDArray[Any], ...]] = []
    for number, (picture, part, limits) in enumerate(zip(pictures, found, ranges_px, strict=True)):
        expected = ~picture.crowd & _between(picture.diameter_px, limits)
        taken = _matched(picture, part, criterion, expected)
        right = (taken >= 0) & expected[taken] if expected.size else np.zeros(len(part), bool)
        wrong = (taken < 0) & _between(part.diameter_px, limits) & ~_in_crowd(picture, part)
        outcome = np.where(right, 1, np.where(wrong, 0, -1)).astype(np.int8)
        wanted = np.flatnonzero(expected)
        hit = np.where(right, np.searchsorted(wanted, taken), -1)
        truth = _truth(picture, float(np.nan_to_num(sun_azimuth_deg[number])), number)
        every = np.arange(len(part))
        detections.append(scoring.detection_columns(number, truth, part, wanted, every, hit, outcome))
        craters.append(scoring.crater_columns(number, truth, part.score, wanted, hit))
    return scoring.joined(detections, craters)


def format_picture_figures(figures: dict[str, Any]) -> str:
    """Return a short table of the figures of `evaluate_pictures`."""
    low, high = figures["diameter_range_px"]
    sun = figures["sun"]
    lines = [
        f"{figures['images']} images, {figures['craters']} labelled craters; evidence level {figures['level']}; "
        f"threshold {figures['threshold']:.2f}{', two scales' if figures['two_scales'] else ''}",
        *_left_out(figures),
        "precision is a lower bound where labels are incomplete; intervals of F1 from resampled images (95 %)",
        _sun_line(sun),
        f"{'':34}{'P':>7}{'R':>7}{'F1':>7}  {'interval':14}{'median px':>10}{'labels':>8}",
    ]
    words = {"given": "Sun given", "found": "Sun found", "upright": "no turn"}
    for way, rows in figures["by_sun"].items():
        for criterion in Criterion:
            lines.append(_row(f"{words[way]}, {low:g}-{high:g} px, {criterion.value}", rows[criterion.value]))
    for row in figures["by_diameter_px"]:
        lines.append(_row(f"{row['low']:g}-{row['high']:g} px, centre", row["centre"]))
    for row in figures["per_class"] or []:
        lines.append(_row(f"{row['low_km']:g}-{row['high_km']:g} km, centre", row["centre"]))
    bias = figures["bias_px"]
    lines.append(
        f"bias px (centre): right {bias['du_px']:+.2f}, down {bias['dv_px']:+.2f}, toward the Sun "
        f"{bias['toward_sun_px']:+.2f}, across {bias['across_sun_px']:+.2f} ({bias['pairs']} pairs)"
    )
    return "\n".join(lines)


def _left_out(figures: dict[str, Any]) -> list[str]:
    """Return lines about labels and pixels that do not count."""
    return [*figures["labels"], *figures["remarks"]]


def _between(values: FloatArray, limits: tuple[float, float]) -> BoolArray:
    with np.errstate(invalid="ignore"):
        inside: BoolArray = (values >= limits[0]) & (values < limits[1])
    return inside


def _matched(picture: LabelledPicture, found: Detections, criterion: Criterion, expected: BoolArray) -> IntArray:
    """Label that each detection (best first) takes, -1 for none; an expected label before any other."""
    taken = np.full(len(found), -1, np.int64)
    free = ~picture.crowd
    for k in range(len(found)):
        if criterion is Criterion.centre:
            distance = np.hypot(picture.u_px - found.u_px[k], picture.v_px - found.v_px[k])
            merit = np.where(distance <= 0.5 * picture.diameter_px, -distance, -np.inf)
        else:
            overlap = _overlap(picture, found.u_px[k], found.v_px[k], found.diameter_px[k])
            merit = np.where(overlap >= LEAST_OVERLAP, overlap, -np.inf)
        for chosen in (free & expected, free & ~expected):
            best = int(np.argmax(np.where(chosen, merit, -np.inf))) if chosen.any() else -1
            if best >= 0 and chosen[best] and np.isfinite(merit[best]):
                taken[k] = best
                free[best] = False
                break
    return taken


def _overlap(picture: LabelledPicture, u_px: float, v_px: float, diameter_px: float) -> FloatArray:
    """Intersection over union of a circle's square, cut at the image's edge, with each label's box (n,)."""
    left, top = max(u_px + 0.5 - 0.5 * diameter_px, 0.0), max(v_px + 0.5 - 0.5 * diameter_px, 0.0)
    right = min(u_px + 0.5 + 0.5 * diameter_px, float(picture.width_px))
    bottom = min(v_px + 0.5 + 0.5 * diameter_px, float(picture.height_px))
    x, y, width, height = picture.box_px.T
    across = np.clip(np.minimum(right, x + width) - np.maximum(left, x), 0.0, None)
    down = np.clip(np.minimum(bottom, y + height) - np.maximum(top, y), 0.0, None)
    shared = across * down
    union = (right - left) * (bottom - top) + width * height - shared
    ratio: FloatArray = shared / np.maximum(union, 1e-12)
    return ratio


def _in_crowd(picture: LabelledPicture, found: Detections) -> BoolArray:
    """Return whether each detection's centre lies in a region that stands for many craters."""
    inside = np.zeros(len(found), bool)
    for x, y, width, height in picture.box_px[picture.crowd]:
        inside |= (np.abs(found.u_px + 0.5 - x - 0.5 * width) <= 0.5 * width) & (
            np.abs(found.v_px + 0.5 - y - 0.5 * height) <= 0.5 * height
        )
    return inside


def _figures(
    pictures: Sequence[LabelledPicture],
    searches: Sequence[PictureSearch],
    way: SunKnowledge,
    azimuths: FloatArray,
    threshold: float,
    options: PictureSetOptions,
    scales: FloatArray,
) -> dict[str, Any]:
    found = [search.detections for search in searches]
    if way is SunKnowledge.found:
        azimuths = np.array([math.nan if s.sun is None else s.sun.azimuth_deg for s in searches])

    def tallied(criterion: Criterion, ranges: Sequence[tuple[float, float]]) -> scoring.Tally:
        return tally_pictures(pictures, found, criterion, ranges, azimuths)

    def both(ranges: Sequence[tuple[float, float]]) -> dict[str, Any]:
        return {c.value: scoring.with_interval(tallied(c, ranges), threshold) for c in Criterion}

    whole = [options.range_px] * len(pictures)
    centre = tallied(Criterion.centre, whole)
    truths = [_truth(p, azimuths[k], k) for k, p in enumerate(pictures)]
    octants = bias_by_octant(centre, threshold, truths) if np.isfinite(azimuths).all() else []
    rows: dict[str, Any] = both(whole)
    return {
        **rows,
        "average_precision": {c.value: scoring.average_precision(tallied(c, whole)) for c in Criterion},
        "by_diameter_px": [
            {"low": low, "high": high, **both([(low, high)] * len(pictures))}
            for low, high in itertools.pairwise(DIAMETER_EDGES_PX)
        ],
        "per_class": _per_class(both, scales),
        "bias_px_by_sun_octant": octants,
        "bias_px": bias_overall(centre, threshold, truths, octants),
        "recall_by_degradation": None,  # labels of images do not tell depths
    }


def _per_class(
    both: Callable[[Sequence[tuple[float, float]]], dict[str, Any]], scales: FloatArray
) -> list[dict[str, Any]] | None:
    """Figures of the paper's classes; None where the scale of an image is not known."""
    if not np.isfinite(scales).all():
        return None
    rows = []
    for low, high in itertools.pairwise(CLASS_LIMITS_M):
        figures = both([(low / scale, high / scale) for scale in scales])
        rows.append({"low_km": low / 1e3, "high_km": high / 1e3, **figures["strict"], **figures})
    return rows


def _truth(picture: LabelledPicture, sun_azimuth_deg: float, number: int) -> FrameTruth:
    unknown = np.full(picture.u_px.size, np.nan)
    return FrameTruth(
        picture.u_px,
        picture.v_px,
        picture.diameter_px,
        unknown,
        unknown,
        np.arange(picture.u_px.size),
        picture.width_px,
        picture.height_px,
        math.radians(sun_azimuth_deg),
        number,
    )


def _scales_m(pictures: Sequence[LabelledPicture], options: PictureSetOptions) -> FloatArray:
    """Ground covered by a pixel in the middle of each picture, m; NaN where nothing tells it."""
    half = math.tan(math.radians(options.fov_deg) / 2.0)
    scales = []
    for picture in pictures:
        pixel = picture.pixel_m if math.isnan(options.pixel_m) else options.pixel_m
        altitude = picture.altitude_km if math.isnan(options.altitude_km) else options.altitude_km
        scales.append(altitude * 1e3 * half / (0.5 * picture.width_px) if math.isnan(pixel) else pixel)
    return np.array(scales)


def _sun_figures(
    pictures: Sequence[LabelledPicture], searches: Sequence[PictureSearch], azimuths: FloatArray
) -> dict[str, Any]:
    """Return the found Sun azimuth of each image and its error."""
    rows: list[dict[str, Any]] = []
    errors = []
    for picture, search, azimuth in zip(pictures, searches, azimuths, strict=True):
        sun = search.sun
        rows.append(
            {
                "file": str(picture.path),
                "quality": search.quality.name.lower(),
                "azimuth_deg": None if sun is None else round(sun.azimuth_deg, 1),
                "confidence": None if sun is None else round(sun.confidence, 3),
                "determined": sun is not None and sun.determined,
                "given_deg": float(azimuth) if np.isfinite(azimuth) else None,
            }
        )
        if sun is not None and sun.determined and np.isfinite(azimuth):
            errors.append(abs((sun.azimuth_deg - float(azimuth) + 180.0) % 360.0 - 180.0))
    return {
        "images": rows,
        "not_found": sum(row["azimuth_deg"] is None for row in rows),
        "undetermined": sum(not row["determined"] for row in rows),
        "compared": len(errors),
        "right_share": float(np.mean(np.array(errors) <= SUN_RIGHT_DEG)) if errors else math.nan,
        "median_error_deg": float(np.median(errors)) if errors else math.nan,
    }


def _sun_line(sun: dict[str, Any]) -> str:
    line = f"Sun azimuth undetermined in {sun['undetermined']} of {len(sun['images'])} images"
    if not sun["compared"]:
        return line
    return (
        f"{line}; found within {SUN_RIGHT_DEG:g} degrees of the given one in {sun['right_share']:.1%} of "
        f"{sun['compared']}, median error {sun['median_error_deg']:.1f} degrees"
    )


def _row(name: str, row: dict[str, Any]) -> str:
    low, high = row["f1_interval_95"]
    return (
        f"{name:34}{row['precision']:7.3f}{row['recall']:7.3f}{row['f1']:7.3f}  [{low:.3f}, {high:.3f}]"
        f"{row['loc_median_px']:10.2f}{row['expected']:8d}"
    )
