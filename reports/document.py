"""A report as a sequence of blocks, before it is HTML or PDF."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from reports.figures.canvas import WIDTH_IN, Canvas
from reports.values import HeadlineFigure


@dataclass(frozen=True, slots=True)
class Heading:
    """Start of a section (level 2, numbered) or of a part of one (level 3)."""

    text: str
    level: int = 2


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Running text; ``small`` for notes."""

    text: str
    small: bool = False


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement of the whole, in words."""

    text: str
    level: str = ""


@dataclass(frozen=True, slots=True)
class Headline:
    """The numbers of the first page and the rung of evidence on which they stand; None where they need no evidence."""

    figures: tuple[HeadlineFigure, ...]
    evidence_rung: str | None


@dataclass(frozen=True, slots=True)
class Cell:
    """A table cell: text, a colour swatch of a role before it, a share (0 to 1) drawn as a bar behind it."""

    text: str
    swatch: str = ""
    share: float | None = None
    strong: bool = False


@dataclass(frozen=True, slots=True)
class Column:
    """A table column; columns of the same non-empty ``group`` that stand together share a heading."""

    label: str
    numeric: bool = True
    group: str = ""
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table with a caption."""

    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell | str, ...], ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """Names and their values."""

    pairs: tuple[tuple[str, str], ...]
    mono: bool = False


@dataclass(frozen=True, slots=True)
class Bullets:
    """A plain list."""

    items: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure: how it is drawn, what it shows (caption), what a reader who cannot see it is told (alt)."""

    key: str
    caption: str
    alt: str
    height_in: float
    draw: Callable[[Canvas], None]
    width_in: float = WIDTH_IN


@dataclass(frozen=True, slots=True)
class Absent:
    """Says that something is not available, and why."""

    what: str
    why: str


@dataclass(frozen=True, slots=True)
class Listing:
    """Verbatim text, folded away on a screen."""

    title: str
    text: str


@dataclass(frozen=True, slots=True)
class NewPage:
    """The next block starts a page where there are pages."""


Block = (
    Heading | Paragraph | Verdict | Headline | Table | Facts | Bullets | Picture | Absent | Listing | NewPage
)


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report: ``kicker`` names its kind, ``identity`` what it is about, ``facts`` stand under the title."""

    kicker: str
    title: str
    identity: str
    facts: tuple[tuple[str, str], ...]
    blocks: tuple[Block, ...]


def cells(row: Sequence[Cell | str]) -> tuple[Cell, ...]:
    """A row with every text made a cell."""
    return tuple(c if isinstance(c, Cell) else Cell(c) for c in row)


EVIDENCE_RUNGS = (
    "unit geometry",
    "procedural Moon",
    "real terrain",
    "another renderer",
    "images nobody rendered",
)


def rung_number(rung: str) -> int | None:
    """Number of a rung of the evidence ladder, from text that starts with it or names it."""
    text = rung.strip().lower().removeprefix("rung").strip(" (:")
    if text[:1].isdigit():
        number = int(text[0])
        return number if 1 <= number <= len(EVIDENCE_RUNGS) else None
    return next((i + 1 for i, name in enumerate(EVIDENCE_RUNGS) if name in text), None)


def rung_text(rung: str) -> str:
    """Words for a rung: "rung 3 of 5, real terrain"."""
    number = rung_number(rung)
    if number is None:
        return rung.strip() or "evidence not stated"
    return f"rung {number} of {len(EVIDENCE_RUNGS)}, {EVIDENCE_RUNGS[number - 1]}"
