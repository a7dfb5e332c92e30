"""A document as an A4 PDF, drawn with the same figures and tables as the page on the screen.

Lengths on a page are inches from its upper left corner. The document is first cut into pieces that are not to be
divided (a line of text, a row of a table, a figure); these are set on pages one after another; then each page is drawn.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import TYPE_CHECKING, Any

from reports.document import (
    Absent,
    Block,
    Bullets,
    Cell,
    Column,
    Document,
    Facts,
    Heading,
    Headline,
    Listing,
    NewPage,
    Paragraph,
    Picture,
    Table,
    Verdict,
    cells,
    evidence_label,
    evidence_ladder,
    evidence_text,
)
from reports.figures.canvas import Canvas
from reports.figures.theme import LIGHT, color, drawing
from reports.html_page import VERDICT_WORDS
from reports.text import headline_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from reports.figures.print import Print

_PAPER_IN = (8.27, 11.69)
_LEFT, _TOP, _FOOT = 0.66, 0.62, 0.78
_WIDTH = _PAPER_IN[0] - 2 * _LEFT
_HEIGHT = _PAPER_IN[1] - _TOP - _FOOT
_BODY, _SMALL, _TABLE = 8.6, 7.4, 7.4
_LEADING = 1.42
_TEXT_WIDTH = 6.1
_MOST_LISTING_LINES = 400
_WHOLE_TABLE_ROWS = 14
_ALIGNED = {"center": 0.5, "right": 1.0}
_VERDICT_ROLES = {"good": "green", "caution": "orange", "bad": "vermillion"}


@dataclass(frozen=True, slots=True)
class _Page:
    """One sheet being drawn: figures on the figure, all else on the print."""

    figure: Figure
    print: Print

    def text(
        self,
        x: float,
        y: float,
        text: str,
        size: float,
        *,
        color: str = LIGHT["ink"],
        weight: str = "normal",
        family: str = "DejaVu Sans",
        ha: str = "left",
    ) -> None:
        """Text whose first line has its top at ``y``; ``ha`` says which end or the centre of it stands at ``x``."""
        known = _known(text)
        left = x - _ALIGNED[ha] * _width(known, size, weight) if ha != "left" else x
        baseline = _PAPER_IN[1] - y - 0.80 * size / 72
        self.print.word(72 * left, 72 * baseline, known, size, color, family, weight)

    def rule(self, x0: float, x1: float, y: float, role: str = "ink", width: float = 0.6) -> None:
        """A horizontal line, ``width`` points thick."""
        self.box(x0, y - width / 144, x1 - x0, width / 72, role)

    def box(self, x: float, y: float, width: float, height: float, role: str) -> None:
        """A filled rectangle from its upper left corner."""
        self.print.box(72 * x, 72 * (_PAPER_IN[1] - y - height), 72 * width, 72 * height, color(role))

    def picture(self, block: Picture, y: float, scale: float) -> None:
        """A figure over the width of the text."""
        width, height = block.width_in * scale, block.height_in * scale
        grid = self.figure.add_gridspec(
            3,
            3,
            width_ratios=[_LEFT, width, _PAPER_IN[0] - _LEFT - width],
            height_ratios=[y, height, max(_PAPER_IN[1] - y - height, 1e-6)],
        )
        part = self.figure.add_subfigure(grid[1, 1])
        with drawing(scale):
            block.draw(Canvas(part, block.width_in, block.height_in, scale))


@dataclass(frozen=True, slots=True)
class _Piece:
    """Something that stands on one page: its height, how it is drawn from a height downwards.

    ``keep`` holds it on the page of what follows; ``head`` is repeated above it when it begins a page.
    """

    height: float
    draw: Callable[[_Page, float], None]
    keep: bool = False
    head: _Piece | None = None
    new_page: bool = False


def pdf_pages(document: Document) -> bytes:
    """The octets of the PDF; the same document gives the same octets."""
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    from reports.figures.print import Print

    pages = _paginated(_pieces(document))
    footer = " · ".join(t for t in ("LINNA", document.kicker, document.identity) if t)
    buffer = io.BytesIO()
    about: dict[str, Any] = {
        "Title": f"{document.kicker}: {document.title}",
        "Creator": "LINNA",
        "Producer": "LINNA",
        "CreationDate": None,
    }
    with drawing(), PdfPages(buffer, metadata=about) as sheets:
        for number, pieces in enumerate(pages, 1):
            figure = Figure(figsize=_PAPER_IN)
            page = _Page(figure, Print())
            figure.add_artist(page.print)
            for y, piece in pieces:
                piece.draw(page, y)
            foot = _PAPER_IN[1] - 0.52
            page.text(_LEFT, foot, footer, 6.8, color=color("muted"))
            page.text(_LEFT + _WIDTH, foot, f"{number} / {len(pages)}", 6.8, color=color("muted"), ha="right")
            sheets.savefig(figure)
    return buffer.getvalue()


def _paginated(pieces: Sequence[_Piece]) -> list[list[tuple[float, _Piece]]]:
    pages: list[list[tuple[float, _Piece]]] = [[]]
    y = 0.0
    for i, piece in enumerate(pieces):
        together, k = piece.height, i
        while pieces[k].keep and k + 1 < len(pieces):
            k += 1
            together += pieces[k].height
        if pages[-1] and (piece.new_page or y + min(together, _HEIGHT) > _HEIGHT):
            pages.append([])
            y = 0.0
            if piece.head is not None:
                pages[-1].append((_TOP, piece.head))
                y = piece.head.height
        pages[-1].append((_TOP + y, piece))
        y += piece.height
    return pages


def _pieces(document: Document) -> list[_Piece]:
    pieces = _title(document)
    section = table = figure = 0
    fresh = False
    for block in document.blocks:
        if isinstance(block, NewPage):
            fresh = True
            continue
        if isinstance(block, Heading) and block.level == 2:
            section += 1
            made = [_section(section, block.text)]
        elif isinstance(block, Table):
            table += 1
            made = _table(block, table)
        elif isinstance(block, Picture):
            figure += 1
            made = [_picture(block, figure)]
        else:
            made = _plain(block)
        if fresh and made:
            made[0] = replace(made[0], new_page=True)
            fresh = False
        pieces.extend(made)
    return pieces


# ------------------------------------------------------------------------------------------------------- text on paper


@lru_cache(maxsize=8)
def _font(weight: str) -> Any:
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font = get_font(findfont(FontProperties(family="DejaVu Sans", weight=weight)))
    return font


@lru_cache(maxsize=4096)
def _advance(character: str, weight: str) -> float:
    """Width of a character at a size of one inch; that of a question mark where the type does not have it."""
    if ord(character) not in _characters():
        return _advance("?", weight)
    with drawing():
        font = _font(weight)
        font.set_size(100.0, 72.0)
        return float(font.load_char(ord(character)).linearHoriAdvance) / 65_536 / 100.0


@lru_cache(maxsize=1)
def _characters() -> frozenset[int]:
    return frozenset(_font("normal").get_charmap())


def _known(text: str) -> str:
    """Text with a question mark for each character that the type does not have."""
    characters = _characters()
    return "".join(c if ord(c) in characters or c == "\n" else "?" for c in text)


def _width(text: str, size: float, weight: str = "normal") -> float:
    """Width of a line in inches."""
    return sum(_advance(c, weight) for c in text) * size / 72


def _wrapped(text: str, width: float, size: float, weight: str = "normal") -> list[str]:
    """Lines no wider than ``width``; a word that is wider is broken."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split(" "):
            trial = f"{line} {word}" if line else word
            if line and _width(trial, size, weight) > width:
                lines.append(line)
                line = word
            else:
                line = trial
            while _width(line, size, weight) > width and len(line) > 1:
                cut = len(line) - 1
                while cut > 1 and _width(line[:cut], size, weight) > width:
                    cut -= 1
                lines.append(line[:cut])
                line = line[cut:]
        lines.append(line)
    return lines


def _lines(
    lines: Sequence[str],
    size: float,
    *,
    x: float = _LEFT,
    before: float = 0.0,
    after: float = 0.0,
    **style: Any,
) -> list[_Piece]:
    """One piece for each line; space before the first and after the last."""
    leading = size * _LEADING / 72
    pieces = []
    for i, line in enumerate(lines):
        top = before if i == 0 else 0.0
        height = top + leading + (after if i == len(lines) - 1 else 0.0)

        def draw(page: _Page, y: float, line: str = line, top: float = top) -> None:
            page.text(x, y + top, line, size, **style)

        pieces.append(_Piece(height, draw, keep=i == 0 and len(lines) > 1))
    return pieces


def _block_of(pieces: Sequence[_Piece], keep: bool = False) -> _Piece:
    """Several pieces as one that is not divided."""

    def draw(page: _Page, y: float) -> None:
        for piece in pieces:
            piece.draw(page, y)
            y += piece.height

    return _Piece(sum(p.height for p in pieces), draw, keep=keep)


# -------------------------------------------------------------------------------------------------------------- blocks


def _title(document: Document) -> list[_Piece]:
    def kicker(page: _Page, y: float) -> None:
        page.text(_LEFT, y, f"LINNA · {document.kicker}".upper(), 7.2, weight="bold")
        page.text(_LEFT + _WIDTH, y, document.identity, 7.2, ha="right", color=color("muted"))
        page.rule(_LEFT, _LEFT + _WIDTH, y + 0.20, width=1.4)

    facts = "   ".join(f"{name} {value}" for name, value in document.facts)
    pieces = [_Piece(0.42, kicker)]
    pieces += _lines(_wrapped(document.title, _WIDTH, 18, "bold"), 18, weight="bold", after=0.03)
    pieces += _lines(_wrapped(facts, _WIDTH, 7.8), 7.8, color=color("muted"), after=0.16)
    return pieces


def _section(number: int, text: str) -> _Piece:
    def draw(page: _Page, y: float) -> None:
        page.rule(_LEFT, _LEFT + _WIDTH, y + 0.20)
        page.text(_LEFT, y + 0.27, str(number), 12, color=color("muted"))
        page.text(_LEFT + 0.34, y + 0.27, text, 12, weight="bold")

    return _Piece(0.62, draw, keep=True)


def _plain(block: Block) -> list[_Piece]:
    match block:
        case Heading(text):
            return [
                replace(p, keep=True) for p in _lines([text], 9.2, before=0.08, after=0.05, weight="bold")
            ]
        case Paragraph(text, small):
            size, tint = (_SMALL, color("muted")) if small else (_BODY, color("ink"))
            return _lines(_wrapped(text, _TEXT_WIDTH, size), size, after=0.10, color=tint)
        case Verdict(text, level):
            return [_verdict(text, level)]
        case Headline():
            return _headline(block)
        case Facts(pairs):
            return _facts(pairs)
        case Bullets(items):
            pieces: list[_Piece] = []
            for item in items:
                lines = _wrapped(item, _TEXT_WIDTH - 0.16, _BODY)
                pieces += _lines(
                    [f"•  {lines[0]}", *(f"    {line}" for line in lines[1:])], _BODY, after=0.02
                )
            return [*pieces, _Piece(0.08, lambda page, y: None)]
        case Absent(what, why):
            return [_absent(what, why)]
        case Listing(title, text):
            lines = [
                part for line in text.split("\n") for part in (_wrapped(line, _WIDTH, 6.6) if line else [""])
            ]
            rest = len(lines) - _MOST_LISTING_LINES
            shown = lines[:_MOST_LISTING_LINES] + ([f"… {rest} further lines"] if rest > 0 else [])
            heading = [
                replace(p, keep=True) for p in _lines([title], 9.2, before=0.08, after=0.05, weight="bold")
            ]
            return heading + _lines(shown, 6.4, family="DejaVu Sans Mono", color=color("gray1"))
        case _:
            raise AssertionError(f"no PDF for {type(block).__name__}")


def _verdict(text: str, level: str) -> _Piece:
    lines = _wrapped(text, 6.2, 11)
    height = 0.24 + len(lines) * 11 * 1.4 / 72

    def draw(page: _Page, y: float) -> None:
        role = _VERDICT_ROLES.get(level, "gray2")
        page.box(_LEFT, y, 0.05, height - 0.03, role)
        page.text(
            _LEFT + 0.18,
            y,
            VERDICT_WORDS.get(level, "Verdict").upper(),
            7,
            weight="bold",
            color=color("muted"),
        )
        for i, line in enumerate(lines):
            page.text(_LEFT + 0.18, y + 0.20 + i * 11 * 1.4 / 72, line, 11)

    return _Piece(height + 0.2, draw)


def _headline(block: Headline) -> list[_Piece]:
    count = max(len(block.figures), 1)
    width = _WIDTH / count
    inner = width - 0.16
    labels = [_wrapped(f.label, inner, 7.2) for f in block.figures]
    notes = [_wrapped(f.note, inner, 6.4) if f.note else [] for f in block.figures]
    above = max((len(lines) for lines in labels), default=1) * 7.2 * 1.35 / 72
    below = max((len(lines) for lines in notes), default=0) * 6.4 * 1.4 / 72
    height = 0.10 + above + 0.40 + below + 0.26

    def draw(page: _Page, y: float) -> None:
        page.rule(_LEFT, _LEFT + _WIDTH, y, "faint")
        page.rule(_LEFT, _LEFT + _WIDTH, y + height, "faint")
        for i, figure in enumerate(block.figures):
            x = _LEFT + i * width
            for k, line in enumerate(labels[i]):
                page.text(x, y + 0.10 + k * 7.2 * 1.35 / 72, line, 7.2, color=color("muted"))
            value = headline_text(figure.value)
            value = "not available" if value == "–" else value
            size = _headline_size(value, figure.unit, inner)
            page.text(x, y + 0.12 + above + (18 - size) / 72 * 0.8, value, size, weight="bold")
            if figure.unit and size > 10:
                offset = _width(value, size, "bold") + 0.05
                page.text(x + offset, y + 0.12 + above + 10 / 72 * 0.8, figure.unit, 8, color=color("muted"))
            for k, line in enumerate(notes[i]):
                top = y + 0.10 + above + 0.38 + k * 6.4 * 1.4 / 72
                page.text(x, top, line, 6.4, color=color("muted"))
            if block.evidence_level is None:
                continue
            level = evidence_label(figure.evidence_level or block.evidence_level)
            words = f"level {level}" if level else "level not stated"
            page.text(x, y + height - 0.18, words, 6.4, color=color("muted"))

    if block.evidence_level is None:
        return [_Piece(height + 0.1, draw)]
    ladder = evidence_ladder()
    stands = "No evidence level was stated for these figures."
    if block.evidence_level:
        stands = f"These figures are at {evidence_text(block.evidence_level)}."
    text = f"{stands} Evidence levels: {ladder}."
    note = _lines(_wrapped(text, _WIDTH, 6.8), 6.8, before=0.06, after=0.06, color=color("muted"))
    return [_Piece(height, draw, keep=True), *note]


def _headline_size(value: str, unit: str, width: float) -> float:
    """The largest size at which a value and its unit stand beside one another; 9 for words."""
    if len(value) > 9:
        return 9.0
    room = width - (_width(unit, 8) + 0.05 if unit else 0.0)
    return next((size for size in (18.0, 16.0, 14.0, 12.0) if _width(value, size, "bold") <= room), 11.0)


def _facts(pairs: Sequence[tuple[str, str]]) -> list[_Piece]:
    pieces = []
    for i, (name, value) in enumerate(pairs):
        lines = _wrapped(value, _WIDTH - 2.0, 7.8)
        height = 0.05 + len(lines) * 7.8 * 1.35 / 72 + 0.03

        def draw(
            page: _Page, y: float, name: str = name, lines: Sequence[str] = lines, height: float = height
        ) -> None:
            page.text(_LEFT, y + 0.04, name, 7.8, color=color("muted"))
            for k, line in enumerate(lines):
                page.text(_LEFT + 2.0, y + 0.04 + k * 7.8 * 1.35 / 72, line, 7.8)
            page.rule(_LEFT, _LEFT + _WIDTH, y + height, "grid", 0.5)

        pieces.append(_Piece(height + (0.14 if i == len(pairs) - 1 else 0.0), draw))
    return pieces


def _absent(what: str, why: str) -> _Piece:
    start = _width(what, _BODY, "bold") + 0.14
    lines = _wrapped(f"not available: {why}", max(_WIDTH - start - 0.3, 2.5), _BODY)
    height = 0.16 + len(lines) * _BODY * _LEADING / 72

    def draw(page: _Page, y: float) -> None:
        page.box(_LEFT, y + 0.02, 0.03, height - 0.06, "faint")
        page.text(_LEFT + 0.14, y + 0.07, what, _BODY, weight="bold")
        for i, line in enumerate(lines):
            page.text(
                _LEFT + 0.14 + start, y + 0.07 + i * _BODY * _LEADING / 72, line, _BODY, color=color("muted")
            )

    return _Piece(height + 0.1, draw)


def _picture(block: Picture, number: int) -> _Piece:
    lead = f"Figure {number}. "
    caption = _captioned(lead, block.caption)
    room = _HEIGHT - caption.height - 0.2
    scale = min(_WIDTH / block.width_in, room / block.height_in)

    def draw(page: _Page, y: float) -> None:
        page.picture(block, y, scale)

    return _block_of(
        [_Piece(block.height_in * scale + 0.06, draw), caption, _Piece(0.2, lambda page, y: None)]
    )


def _captioned(lead: str, text: str) -> _Piece:
    """A caption whose first words are bold."""
    start = _width(lead, _SMALL, "bold") + 0.03
    lines = _wrapped(text, _WIDTH - 0.2 - start, _SMALL)
    first, rest = lines[0], " ".join(lines[1:])
    others = _wrapped(rest, _WIDTH - 0.2, _SMALL) if rest else []
    leading = _SMALL * 1.38 / 72

    def draw(page: _Page, y: float) -> None:
        page.text(_LEFT, y, lead, _SMALL, weight="bold")
        page.text(_LEFT + start, y, first, _SMALL, color=color("muted"))
        for i, line in enumerate(others, 1):
            page.text(_LEFT, y + i * leading, line, _SMALL, color=color("muted"))

    return _Piece((1 + len(others)) * leading, draw)


# -------------------------------------------------------------------------------------------------------------- tables


def _table(block: Table, number: int) -> list[_Piece]:
    rows = [cells(row) for row in block.rows]
    widths, size = _column_widths(block.columns, rows)
    total = sum(widths)
    leading = size * 1.32 / 72
    starts = [
        _LEFT + sum(widths[:i]) + (0.14 if i and block.columns[i - 1].numeric and not c.numeric else 0.0)
        for i, c in enumerate(block.columns)
    ]
    caption = _captioned(f"Table {number}. ", block.caption)
    head = _table_head(block.columns, starts, widths, size)
    pieces = [
        _block_of(
            [_Piece(0.08, lambda page, y: None), caption, _Piece(0.06, lambda page, y: None)], keep=True
        ),
        replace(head, keep=True),
    ]
    for i, row in enumerate(rows):
        texts = [
            _cell_lines(cell, column, width, size)
            for cell, column, width in zip(row, block.columns, widths, strict=True)
        ]
        height = max(len(t) for t in texts) * leading + 0.075
        last = i == len(rows) - 1

        def draw(
            page: _Page,
            y: float,
            row: tuple[Cell, ...] = row,
            texts: list[list[str]] = texts,
            height: float = height,
            last: bool = last,
        ) -> None:
            for cell, lines, column, start, width in zip(
                row, texts, block.columns, starts, widths, strict=True
            ):
                _draw_cell(page, y + 0.057, cell, lines, column, start, width, size)
            page.rule(_LEFT, _LEFT + total, y + height, "ink" if last else "grid", 0.6 if last else 0.5)

        pieces.append(
            _Piece(height, draw, keep=not last and (i == 0 or len(rows) <= _WHOLE_TABLE_ROWS), head=head)
        )
    if block.note:
        pieces += _lines(_wrapped(block.note, _WIDTH - 0.2, 6.8), 6.8, before=0.05, color=color("muted"))
    pieces.append(_Piece(0.2, lambda page, y: None))
    return pieces


def _cell_lines(cell: Cell, column: Column, width: float, size: float) -> list[str]:
    if column.numeric:
        return [cell.text]
    indent = 0.14 if cell.swatch else 0.0
    return _wrapped(cell.text, width - indent - 0.08, size, "bold" if cell.strong else "normal")


def _draw_cell(
    page: _Page,
    y: float,
    cell: Cell,
    lines: Sequence[str],
    column: Column,
    start: float,
    width: float,
    size: float,
) -> None:
    weight = "bold" if cell.strong else "normal"
    x = start
    if cell.swatch:
        page.box(x, y + 0.012, 0.085, 0.085, cell.swatch)
        x += 0.14
    if cell.share is not None:
        page.box(x, y + 0.03, width - 0.1, 0.055, "grid")
        page.box(x, y + 0.03, max((width - 0.1) * min(max(cell.share, 0.0), 1.0), 1e-4), 0.055, "blue")
    for i, line in enumerate(lines):
        top = y + i * size * 1.32 / 72
        if column.numeric:
            page.text(start + width - 0.04, top, line, size, ha="right", weight=weight)
        else:
            page.text(x, top, line, size, weight=weight)


def _table_head(columns: Sequence[Column], starts: list[float], widths: list[float], size: float) -> _Piece:
    grouped = any(c.group for c in columns)
    leading = size * 1.25 / 72
    labels = [_label_lines(c, w, size) for c, w in zip(columns, widths, strict=True)]
    deepest = max(len(lines) for lines in labels)
    top = leading + 0.07 if grouped else 0.0
    height = 0.05 + top + deepest * leading + 0.05

    def draw(page: _Page, y: float) -> None:
        end = starts[-1] + widths[-1]
        page.rule(_LEFT, end, y, width=1.0)
        page.rule(_LEFT, end, y + height)
        index = 0
        for group, members in groupby(columns, key=lambda c: c.group):
            count = len(list(members))
            if group:
                left, right = (
                    starts[index] + 0.06,
                    starts[index + count - 1] + widths[index + count - 1] - 0.02,
                )
                page.text((left + right) / 2, y + 0.045, group, size, ha="center")
                page.rule(left, right, y + 0.05 + leading + 0.02, "gray3", 0.5)
            index += count
        for lines, column, start, width in zip(labels, columns, starts, widths, strict=True):
            base = y + 0.05 + top + (deepest - len(lines)) * leading
            for i, line in enumerate(lines):
                if column.numeric:
                    page.text(
                        start + width - 0.04, base + i * leading, line, size, ha="right", color=color("muted")
                    )
                else:
                    page.text(start, base + i * leading, line, size, color=color("muted"))

    return _Piece(height, draw)


def _label_lines(column: Column, width: float, size: float) -> list[str]:
    lines = _wrapped(column.label, max(width - 0.06, 0.3), size)
    return [*lines, column.unit] if column.unit else lines


def _column_widths(columns: Sequence[Column], rows: Sequence[tuple[Cell, ...]]) -> tuple[list[float], float]:
    """Widths in inches and the size of type with which a table fits the page."""
    size = _TABLE
    while True:
        natural = []
        for i, column in enumerate(columns):
            body = [
                _width(row[i].text, size, "bold" if row[i].strong else "normal")
                + (0.14 if row[i].swatch else 0.0)
                for row in rows
            ]
            words = max((_width(w, size) for w in [*column.label.split(" "), column.unit]), default=0.0)
            bar = 1.2 if any(row[i].share is not None for row in rows) else 0.0
            natural.append(max([words, bar, *body]) + 0.16)
        index = 0
        for group, members in groupby(columns, key=lambda c: c.group):
            count = len(list(members))
            missing = _width(group, size) + 0.16 - sum(natural[index : index + count])
            if group and missing > 0:
                natural[index : index + count] = [w + missing / count for w in natural[index : index + count]]
            index += count
        spare = _WIDTH - sum(natural)
        if spare >= 0:
            if len(columns) <= 4:
                return natural, size
            return [w + spare / len(columns) for w in natural], size
        texts = [i for i, c in enumerate(columns) if not c.numeric and natural[i] > 1.1]
        if texts and sum(natural[i] for i in texts) + spare >= 1.0 * len(texts):
            taken = -spare / sum(natural[i] for i in texts)
            return [w * (1 - taken) if i in texts else w for i, w in enumerate(natural)], size
        if size <= 5.0:
            return [w * _WIDTH / sum(natural) for w in natural], size
        size -= 0.4
