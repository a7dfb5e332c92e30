"""Labelled image sets in COCO form, from any source.

A set is a folder with one or more COCO files (`*.json`, at any depth). Image files lie in the folder of their COCO file
or in its folder `images`. Craters are the annotations whose category says crater in its name or supercategory, or all
if the file has no categories. A crater is a box or one or more polygons; of a polygon, centre and diameter are those
of its area. Equal labels count once.
Further keys are read where present: `centre` and `diameter` of an annotation (as `linna dataset build` writes them),
`sun_azimuth_deg`, `pixel_m` and `altitude_km` of an image. Pixel centres are integers, so the centre of a box that
starts at x and is w wide is x + w / 2 - 0.5.

References
----------
T.-Y. Lin et al., "Microsoft COCO: Common Objects in Context", 2014; data format of the COCO object detection task.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from payload_emulator.errors import DatasetError
from payload_emulator.session.world.external import IMAGE_SUFFIXES, read_picture

_EQUAL_PX = 0.5
"""Labels whose boxes differ by less are one: tools round what they write."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPicture:
    """One image of a set with its craters; arrays (n,), boxes (n, 4) as left, top, width, height from the image corner.

    `crowd` marks regions that stand for many craters. `left_out` are the names of other categories, one for each label
    that was left out; `repeated` is the number of labels equal to another.
    `sun_azimuth_deg` is that of the Sun in the image, clockwise from its top; NaN where the set does not state it, as
    `pixel_m` and `altitude_km`.
    """

    path: Path
    width_px: int
    height_px: int
    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    box_px: FloatArray
    crowd: BoolArray
    sun_azimuth_deg: float = math.nan
    pixel_m: float = math.nan
    altitude_km: float = math.nan
    left_out: tuple[str, ...] = ()
    repeated: int = 0


def load_pictures(folder: Path, category: str = "") -> list[LabelledPicture]:
    """Images of a labelled set with their craters, in the order of the COCO files and of the images in them.

    `category` names the category of craters; "": those that say crater.

    Raises
    ------
    DatasetError
        The folder holds no COCO file, or one that contradicts itself or its images; the message names the place.
    """
    files = sorted(path for path in folder.rglob("*.json") if path.is_file())
    documents = [(path, document) for path in files if (document := _coco(path)) is not None]
    if not documents:
        raise DatasetError(
            f"{folder}: expected a COCO file (*.json with images, annotations and categories), found "
            f"{'none' if folder.is_dir() else 'no such folder'}"
        )
    found = [picture for path, document in documents for picture in _pictures(path, document, category)]
    name, count = Counter(str(picture.path.resolve()) for picture in found).most_common(1)[0] if found else ("", 0)
    if count > 1:
        raise DatasetError(f"{folder}: expected each image once, found {name} {count} times (two files joined?)")
    return found


def set_words(pictures: Sequence[LabelledPicture]) -> list[str]:
    """Return what is taken from a set, as printed with figures of it."""
    box = np.concatenate([picture.box_px for picture in pictures] or [np.zeros((0, 4))])
    crowds = sum(np.count_nonzero(picture.crowd) for picture in pictures)
    others = Counter(name for picture in pictures for name in picture.left_out)
    repeated = sum(picture.repeated for picture in pictures)
    words = []
    if len(box):
        low, high = box[:, :2].min(axis=0), (box[:, :2] + box[:, 2:]).max(axis=0)
        wide, tall = max(one.width_px for one in pictures), max(one.height_px for one in pictures)
        span = f"{low[0]:g}, {low[1]:g} to {high[0]:g}, {high[1]:g} px of {wide} x {tall}"
        words.append(f"boxes from {span}, {crowds} for many craters")
    if others:
        listed = ", ".join(f"{count} {name}" for name, count in others.items())
        words.append(f"labels of other categories, not counted: {listed}")
    if repeated:
        words.append(f"labels equal to another, counted once: {repeated}")
    stated = {"Sun at deg": "sun_azimuth_deg", "m of a pixel": "pixel_m", "altitude in km": "altitude_km"}
    for what, name in stated.items():
        values = np.array([getattr(picture, name) for picture in pictures])
        if np.isfinite(values).any():
            words.append(f"{what}: {np.nanmin(values):g} to {np.nanmax(values):g}")
    return words


def _coco(path: Path) -> dict[str, Any] | None:
    """The document of a COCO file; None where a JSON file is of another kind."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{path}: expected JSON, found none ({error})") from error
    if not isinstance(document, dict) or "annotations" not in document or "images" not in document:
        return None
    for name in ("images", "annotations"):
        if not isinstance(document[name], list) or not all(isinstance(item, dict) for item in document[name]):
            raise DatasetError(f"{path}, {name}: expected a list of objects, found another value")
    return document


def _pictures(path: Path, document: dict[str, Any], category: str) -> list[LabelledPicture]:
    images = _identified(document["images"], "an image", f"{path}, images")
    _identified([item for item in document["annotations"] if "id" in item], "an annotation", f"{path}, annotations")
    craters, names = _categories(path, document, category)
    labels: dict[Any, list[_Label]] = {number: [] for number in images}
    others: dict[Any, list[str]] = {number: [] for number in images}
    for k, item in enumerate(document["annotations"]):
        place = f"{path}, annotations[{k}]"
        number = _value(item, "image_id", place)
        if number not in labels:
            raise DatasetError(f"{place}.image_id: expected the id of an image, found {number!r}")
        kind = _value(item, "category_id", place) if names else None
        if names and kind not in names:
            raise DatasetError(f"{place}.category_id: expected the id of a category, found {kind!r}")
        if kind in craters or not names:
            labels[number].append(_label(item, place))
        else:
            others[number].append(names[kind])
    found = [
        _picture(path, item, labels[item["id"]], others[item["id"]], f"{path}, images[{k}]")
        for k, item in enumerate(document["images"])
    ]
    _require_boxes_in_pixels(path, found)
    return found


def _identified(items: Sequence[Mapping[str, Any]], what: str, place: str) -> dict[Any, Mapping[str, Any]]:
    """Return items by their ids, which are whole numbers or texts, each once."""
    first: dict[Any, int] = {}
    for k, item in enumerate(items):
        number = _value(item, "id", f"{place}[{k}]")
        if isinstance(number, bool) or not isinstance(number, (int, str)):
            raise DatasetError(f"{place}[{k}].id: expected a whole number or a text, found {number!r}")
        if number in first:
            raise DatasetError(
                f"{place}[{k}].id: expected {what} with a number of its own, found {number!r} twice "
                f"(also {place.rpartition(', ')[2]}[{first[number]}])"
            )
        first[number] = k
    return {number: items[k] for number, k in first.items()}


def _categories(path: Path, document: dict[str, Any], category: str) -> tuple[set[Any], dict[Any, str]]:
    """Return the ids of the categories of craters, and the names of all categories; none where there are none."""
    listed = document.get("categories") or []
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        raise DatasetError(f"{path}, categories: expected a list of objects, found another value")
    items = _identified(listed, "a category", f"{path}, categories")
    names = {number: str(item.get("name", number)) for number, item in items.items()}
    wanted = category.casefold()
    craters = {
        number
        for number, item in items.items()
        if (names[number].casefold() == wanted if wanted else "crater" in _words(item))
    }
    if (items or wanted) and not craters:
        found = ", ".join(names.values()) or "none"
        expected = f"the category {category!r}" if wanted else "a category that says crater, or --category"
        raise DatasetError(f"{path}, categories: expected {expected}, found {found}")
    return craters, names


def _words(item: Mapping[str, Any]) -> str:
    return f"{item.get('name')} {item.get('supercategory')}".casefold()


def _require_boxes_in_pixels(path: Path, pictures: Sequence[LabelledPicture]) -> None:
    """Refuse boxes with two corners in place of a size, and coordinates from 0 to 1."""
    box = np.concatenate([picture.box_px for picture in pictures] or [np.zeros((0, 4))])
    ends = np.concatenate([p.box_px[:, :2] + p.box_px[:, 2:] for p in pictures] or [np.zeros((0, 2))])
    sizes = np.concatenate(
        [np.tile([p.width_px, p.height_px], (len(p.box_px), 1)) for p in pictures] or [np.zeros((0, 2))]
    )
    if not len(box):
        return
    is_share, is_small = ends.max() <= 2.0 < sizes.min() / 2.0, (ends / sizes).max() < 0.55 and len(box) >= 20
    if is_share or is_small:
        raise DatasetError(
            f"{path}, annotations: expected boxes and polygons in pixels of images of {sizes[0, 0]:g} x "
            f"{sizes[0, 1]:g}, found none over {ends.max():.3g}: "
            f"{'coordinates from 0 to 1' if is_share else 'per cent, or labels of images of another size'}?"
        )
    corners = (box[:, 2:] > box[:, :2]).all() and len(box) > 2
    beyond = np.count_nonzero((ends > sizes + 1.0).any(axis=1))
    outside = np.flatnonzero((box[:, :2] + 0.5 * box[:, 2:] > sizes + 1.0).any(axis=1))
    if (corners and beyond) or outside.size:
        raise DatasetError(
            f"{path}, annotations: expected boxes [x, y, width, height] in the image, found {beyond} of {len(box)} "
            f"beyond its edge, such as {np.round(box[(ends > sizes + 1.0).any(axis=1)][0], 2).tolist()}: "
            "[x1, y1, x2, y2]?"
        )


@dataclass(frozen=True, slots=True)
class _Label:
    u_px: float
    v_px: float
    diameter_px: float
    box: tuple[float, float, float, float]
    crowd: bool


def _picture(
    path: Path, item: Mapping[str, Any], labels: list[_Label], others: Sequence[str], place: str
) -> LabelledPicture:
    every = len(labels)
    box = np.array([label.box for label in labels], dtype=np.float64).reshape(-1, 4)
    again = [(np.abs(box[:k] - box[k]).max(axis=1) < _EQUAL_PX).any() for k in range(every)]
    labels = [label for label, is_repeated in zip(labels, again, strict=True) if not is_repeated]
    name = _value(item, "file_name", place)
    if not isinstance(name, str) or not name:
        raise DatasetError(f"{place}.file_name: expected the name of an image file, found {name!r}")
    found = next((file for file in (path.parent / name, path.parent / "images" / name) if file.is_file()), None)
    if found is None:
        raise DatasetError(f"{place}.file_name: expected an image file, found no {path.parent / name}")
    if found.suffix.lower() not in IMAGE_SUFFIXES:
        raise DatasetError(
            f"{place}.file_name: expected a file with one of {' '.join(IMAGE_SUFFIXES)}, found {found.name}"
        )
    height_px, width_px = read_picture(found)[0].shape[:2]
    stated = (_number(item, "width", place, width_px), _number(item, "height", place, height_px))
    if stated != (width_px, height_px):
        raise DatasetError(
            f"{place}: expected the size of {found.name}, {width_px} x {height_px} pixels, "
            f"found {stated[0]:g} x {stated[1]:g}"
        )
    box = np.array([label.box for label in labels], dtype=np.float64).reshape(-1, 4)
    return LabelledPicture(
        path=found,
        width_px=width_px,
        height_px=height_px,
        u_px=np.array([label.u_px for label in labels], dtype=np.float64),
        v_px=np.array([label.v_px for label in labels], dtype=np.float64),
        diameter_px=np.array([label.diameter_px for label in labels], dtype=np.float64),
        box_px=box,
        crowd=np.array([label.crowd for label in labels], dtype=bool),
        sun_azimuth_deg=_number(item, "sun_azimuth_deg", place, math.nan),
        pixel_m=_positive(item, "pixel_m", place),
        altitude_km=_positive(item, "altitude_km", place),
        left_out=tuple(others),
        repeated=every - len(labels),
    )


def _label(item: Mapping[str, Any], place: str) -> _Label:
    crowd = item.get("iscrowd") or 0
    if crowd not in (0, 1):
        raise DatasetError(f"{place}.iscrowd: expected 0 or 1, found {crowd!r}")
    polygons = item.get("segmentation")
    if isinstance(polygons, list) and polygons:
        box, u, v, diameter = _of_polygons(polygons, place)
        stated = _box(item["bbox"], place) if item.get("bbox") else box
        if max(map(abs, np.subtract(stated, box))) > max(*stated[2:], *box[2:]):
            raise DatasetError(
                f"{place}: expected a box about the polygons, {np.round(box, 2).tolist()}, found {item['bbox']}"
            )
        if math.isclose(math.pi / 4.0 * diameter**2, box[2] * box[3], rel_tol=1e-9):
            diameter = math.sqrt(box[2] * box[3])  # the polygon is its box, about the crater
    elif item.get("bbox"):
        box = _box(item["bbox"], place)
        u, v = box[0] + 0.5 * box[2] - 0.5, box[1] + 0.5 * box[3] - 0.5
        diameter = math.sqrt(box[2] * box[3])
    else:
        found = "a run-length mask" if isinstance(polygons, dict) else "neither"
        raise DatasetError(f"{place}: expected a box (bbox) or polygons (segmentation), found {found}")
    if "centre" in item and "diameter" in item:
        u, v = _numbers(item["centre"], 2, f"{place}.centre")
        diameter = _positive(item, "diameter", place)
    return _Label(u, v, diameter, box, bool(crowd))


def _box(value: Any, place: str) -> tuple[float, float, float, float]:
    x, y, width, height = _numbers(value, 4, f"{place}.bbox")
    if width <= 0.0 or height <= 0.0:
        raise DatasetError(f"{place}.bbox: expected [x, y, width, height] with a size above zero, found {value}")
    return x, y, width, height


def _of_polygons(polygons: list[Any], place: str) -> tuple[tuple[float, float, float, float], float, float, float]:
    """Box, centre and diameter of the circle of equal area of polygons, whose parts do not overlap."""
    area, moment = 0.0, np.zeros(2)
    corners = []
    for k, polygon in enumerate(polygons):
        where = f"{place}.segmentation[{k}]"
        if not isinstance(polygon, list) or len(polygon) < 6 or len(polygon) % 2:
            raise DatasetError(f"{where}: expected at least three pairs x, y in one list, found {polygon!s:.60}")
        points = np.array(_numbers(polygon, len(polygon), where)).reshape(-1, 2)
        start = points[0]
        x, y = (points - start).T  # about a corner, so that little is lost far from the origin
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        part = 0.5 * float(cross.sum())
        if part == 0.0:
            raise DatasetError(f"{where}: expected a polygon with an area, found {polygon!s:.60}")
        middle = np.array([((p + np.roll(p, -1)) * cross).sum() for p in (x, y)]) / (6.0 * part) + start
        area += abs(part)
        moment += abs(part) * middle
        corners.append(points)
    every = np.concatenate(corners)
    low, size = every.min(axis=0), np.ptp(every, axis=0)
    centre = moment / area - 0.5
    box = (float(low[0]), float(low[1]), float(size[0]), float(size[1]))
    return box, float(centre[0]), float(centre[1]), math.sqrt(4.0 * area / math.pi)


def _value(item: Mapping[str, Any], key: str, place: str) -> Any:
    if key not in item or isinstance(item[key], (list, dict)):
        raise DatasetError(f"{place}.{key}: expected a value, found {'none' if key not in item else 'a list'}")
    return item[key]


def _numbers(value: Any, count: int, place: str) -> list[float]:
    """`count` finite numbers."""
    right = isinstance(value, list) and len(value) == count
    if not right or not all(_is_number(part) for part in value):
        raise DatasetError(f"{place}: expected {count} numbers, found {value!s:.60}")
    return [float(part) for part in value]


def _number(item: Mapping[str, Any], key: str, place: str, default: float) -> float:
    value = item.get(key)
    if value is None:
        return default
    if not _is_number(value):
        raise DatasetError(f"{place}.{key}: expected a number, found {value!r}")
    return float(value)


def _positive(item: Mapping[str, Any], key: str, place: str) -> float:
    value = _number(item, key, place, math.nan)
    if value <= 0.0:
        raise DatasetError(f"{place}.{key}: expected a number above zero, found {value:g}")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
