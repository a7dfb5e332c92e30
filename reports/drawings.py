"""Figures of a document: drawn once for its renderings, by two processes, kept for later documents, and as files."""

from __future__ import annotations

import csv
import dataclasses
import functools
import gc
import hashlib
import io
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kernels import keep, kept, made_once
from reports.document import Picture
from reports.figures.canvas import Canvas
from reports.figures.svg import draw_svg
from reports.figures.theme import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PNG_DPI = 200

KEPT_FIGURES = 1024
"""Figures that are kept on disk: those of forty reports."""


class Drawings(dict[str, str]):
    """SVG of the figures of one document by key, each drawn once for all its renderings."""

    def svg(self, one: Picture) -> str:
        """Return the SVG of a picture; the keys of the pictures of a document are unique."""
        if one.key not in self:
            self[one.key] = self._drawn(one)
        return self[one.key]

    def _drawn(self, one: Picture) -> str:
        return _svg_of(one)

    def prepare(self, pictures: Sequence[Picture]) -> None:
        """Draw pictures ahead, where that takes less time; nothing here."""


def _svg_of(one: Picture) -> str:
    return draw_svg(one.key, one.width_in, one.height_in, one.draw, one.alt)


class KeptDrawings(Drawings):
    """Drawings that are kept on disk by the hash of what they show, and drawn again if that or the code changed."""

    def __init__(self, processes: DrawingProcesses | None = None) -> None:
        super().__init__()
        self._processes = processes

    def prepare(self, pictures: Sequence[Picture]) -> None:
        if self._processes is None:
            return
        names = {one.key: f"figure-{drawing_hash(one)}" for one in pictures}
        self.update({key: octets.decode() for key, name in names.items() if (octets := kept(name)) is not None})
        missing = [one for one in pictures if one.key not in self]
        for one, svg in zip(missing, self._processes.draw(missing), strict=False):
            keep(names[one.key], svg.encode(), KEPT_FIGURES)
            self[one.key] = svg

    def _drawn(self, one: Picture) -> str:
        return made_once(f"figure-{drawing_hash(one)}", lambda: _svg_of(one).encode(), KEPT_FIGURES).decode()


class DrawingProcesses:
    """Two processes that draw the figures of one document; they load matplotlib while its values are computed.

    They are started without `multiprocessing`, which would import the script of a user again.
    """

    def __init__(self) -> None:
        program = f"import sys; sys.path[:] = {sys.path!r}; from reports.drawings import draw_given; draw_given()"
        words = [sys.executable, "-P", "-c", program]
        pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
        self._started = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=nothing)

    def draw(self, pictures: Sequence[Picture]) -> list[str]:
        """Return the SVG of pictures, once; none if the processes failed: who asked draws them, and sees the fault."""
        try:
            octets, _ = self._started.communicate(pickle.dumps(list(pictures)))
            drawn: list[str] = pickle.loads(octets)
        except (OSError, ValueError, EOFError, AttributeError, TypeError, pickle.PickleError):
            return []
        return drawn

    def close(self) -> None:
        """End the processes."""
        self._started.kill()
        self._started.communicate()


@contextmanager
def drawing_processes(wanted: bool) -> Iterator[DrawingProcesses | None]:
    """Yield started processes if they are wanted and the machine has room for them."""
    started = None
    with suppress(OSError):
        started = DrawingProcesses() if wanted else None
    try:
        yield started
    finally:
        if started is not None:
            started.close()


def draw_given() -> None:
    """Draw the pictures of standard input, each second one in a copy of this process, onto standard output."""
    gc.disable()  # the process ends soon
    import reports.figures.axes  # noqa: F401  # before there is something to draw

    pictures = pickle.load(sys.stdin.buffer)
    ours, theirs = os.pipe()
    half = 1 if os.fork() == 0 else 0
    drawn = [_svg_of(one) for one in pictures[half::2]]
    if half == 1:
        with os.fdopen(theirs, "wb") as out:
            pickle.dump(drawn, out)
        os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as other:
        whole = [""] * len(pictures)
        whole[::2], whole[1::2] = drawn, pickle.load(other)
    pickle.dump(whole, sys.stdout.buffer)
    gc.freeze()  # the last collection would look at every object


def drawing_hash(one: Picture) -> str:
    """Return the hash of all that the SVG of a picture depends on: size, text, function, values and code."""
    key = hashlib.sha256(_code_hash())
    for octets in _octets((one.key, one.width_in, one.height_in, one.alt, one.draw)):
        key.update(octets)
    return key.hexdigest()


def _octets(value: Any) -> Iterator[bytes]:
    """Yield octets that are equal for equal values only."""
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        yield f"{value.dtype.str}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, list | tuple) and all(type(part) in (str, int, float) for part in value):
        yield f"{tuple(value)!r} ".encode()
    elif isinstance(value, list | tuple | np.ndarray):
        yield f"{len(value)} of ".encode()
        for part in value:
            yield from _octets(part)
    elif isinstance(value, Mapping):
        yield from _octets(tuple(value.items()))
    elif isinstance(value, partial):
        yield from _octets((value.func, value.args, value.keywords))
    elif dataclasses.is_dataclass(value):
        yield from _octets([getattr(value, field.name) for field in dataclasses.fields(value)])
    elif callable(value):
        yield f"{value.__module__}.{value.__qualname__} ".encode()
        yield from _octets([cell.cell_contents for cell in getattr(value, "__closure__", None) or ()])
    else:
        yield f"{value!r} ".encode()


@functools.cache
def _code_hash() -> bytes:
    """Return the hash of the code of figures and of the versions of the libraries that draw."""
    key = hashlib.sha256(" ".join(version(name) for name in ("matplotlib", "numpy", "pillow")).encode())
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        key.update(file.read_bytes())
    return key.digest()


def picture_files(picture: Picture) -> tuple[bytes, str]:
    """Return a figure as PNG, and what it plots as CSV; x of an axis of UTC is in seconds from the start of the axis.

    An image has no rows.
    """
    from matplotlib.figure import Figure

    octets, text = io.BytesIO(), io.StringIO()
    with drawing():
        figure = Figure(figsize=(picture.width_in, picture.height_in))
        picture.draw(Canvas(figure, picture.width_in, picture.height_in))
        figure.savefig(octets, format="png", dpi=PNG_DPI, metadata={"Software": None})
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["panel", "x_axis", "series", "x", "y"])
    for axes in figure.axes:
        for series, x, y in _plotted(axes):
            table.writerow([axes.get_title(), axes.get_xlabel(), series, f"{x:.9g}", f"{y:.9g}"])
    return octets.getvalue(), text.getvalue()


def _plotted(axes: Axes) -> Iterator[tuple[str, float, float]]:
    """Yield name, x and y of named lines, of bars (their middle) and of rings (number, share)."""
    from matplotlib.patches import Wedge

    for line in axes.lines:
        name = str(line.get_label())
        if name and not name.startswith("_"):
            yield from ((name, float(x), float(y)) for x, y in np.asarray(line.get_xydata()))
    for bars in axes.containers:
        for bar in bars:
            yield str(bars.get_label()), bar.get_x() + bar.get_width() / 2.0, bar.get_height()
    for number, patch in enumerate(axes.patches):
        if isinstance(patch, Wedge):
            yield str(patch.get_label()), number, (patch.theta2 - patch.theta1) / 360.0
