"""A report as a sequence of blocks, before it is HTML or PDF."""

import re
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


VERDICT_ROLES = {
    "met": "green",
    "partly met": "orange",
    "unknown": "orange",
    "not met": "vermillion",
    "pass": "green",
    "inconclusive": "orange",
    "fail": "vermillion",
}
"""Levels of verdicts of passes and runs, then of gates, and their colours."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement of the whole: a sentence, and a key of `VERDICT_ROLES` or ""."""

    text: str
    level: str = ""
    subject: str = "Verdict"

    @property
    def word(self) -> str:
        """Heading of the sentence."""
        return f"{self.subject}: {self.level}" if self.level else self.subject


@dataclass(frozen=True, slots=True)
class Headline:
    """Numbers of the first page and their evidence level, empty if it is not stated."""

    figures: tuple[HeadlineFigure, ...]
    evidence_level: str

    @property
    def ladder(self) -> str:
        """The level of the figures, and what the levels mean."""
        stated = "No evidence level was stated for these figures."
        if self.evidence_level:
            stated = f"These figures are at {evidence_text(self.evidence_level)}."
        return f"{stated} Evidence levels: {evidence_ladder()}."


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
class Properties:
    """Names and their values."""

    pairs: tuple[tuple[str, str], ...]
    mono: bool = False


@dataclass(frozen=True, slots=True)
class Bullets:
    """A plain list."""

    items: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Picture:
    """Figure with its drawing function, caption and text alternative (alt)."""

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


Block = Heading | Paragraph | Verdict | Headline | Table | Properties | Bullets | Picture | Absent | Listing


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


EVIDENCE_LEVELS = (
    "unit geometry",
    "procedural Moon",
    "real terrain never used in training",
    "another renderer",
    "real photographs",
)


SEEN_MARK = "s"
"""Suffix of an evidence level whose terrain was used in training: 3s."""

SEEN_WORDS = "real terrain seen in training"


def evidence_ladder() -> str:
    """Return all evidence levels in one line."""
    named = [f"{number} {words}" for number, words in enumerate(EVIDENCE_LEVELS, 1)]
    return ", ".join([*named[:2], f"3{SEEN_MARK} {SEEN_WORDS}", *named[2:]])


def evidence_number(level: str) -> int | None:
    """Return the number at the start of the text of an evidence level; None for other text."""
    found = re.match(r"\s*(?:level)?[ (:]*([1-5])(?!\d)", level, re.IGNORECASE)
    return int(found[1]) if found else None


def evidence_label(level: str) -> str:
    """Return the label of an evidence level, such as "3" or "3s"; empty if none is stated."""
    number = evidence_number(level)
    seen = level.lower().partition(str(number))[2].startswith(SEEN_MARK)
    return "" if number is None else f"{number}{SEEN_MARK if seen else ''}"


def evidence_text(level: str) -> str:
    """Return a level in words: "level 2 of 5, procedural Moon", or the words in parentheses in the text itself."""
    number = evidence_number(level)
    if number is None:
        return level.strip() or "evidence not stated"
    label = evidence_label(level)
    own = level.partition("(")[2].rpartition(")")[0].strip()
    words = own or (SEEN_WORDS if label.endswith(SEEN_MARK) else EVIDENCE_LEVELS[number - 1])
    return f"level {label} of {len(EVIDENCE_LEVELS)}, {words}"
