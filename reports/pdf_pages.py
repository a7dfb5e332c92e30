"""A document as an A4 PDF, typeset by Typst from the template `pdf_pages.typ`.

The template receives every text and number as JSON data, so that no text is interpreted as markup. That data is the
print form of a document, which can be typeset later: figures are those of the HTML page in the light colours. Fonts are
those that matplotlib ships; no date and no system font is used, so the same document gives the same octets.
"""

import hashlib
import json
import re
import subprocess
import sys
from array import array
from collections.abc import Iterator
from dataclasses import asdict
from functools import lru_cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from kernels import made_once
from reports.document import (
    VERDICT_ROLES,
    Block,
    Document,
    Heading,
    Headline,
    Listing,
    Paragraph,
    Picture,
    Table,
    Verdict,
    cells,
    evidence_label,
)
from reports.figures.canvas import WIDTH_IN
from reports.figures.theme import LIGHT, color
from reports.text import NOT_A_VALUE, headline_text

_PAGE_IN = (8.27 - 2 * 0.66, 11.69 - 0.62 - 0.78)
_TEXT_IN = 1.2
"""Height kept free for the heading and the caption of a figure."""
_LEAST_SHRINKING = 0.7
"""A figure shrinks by no more than this to leave room for others: its text must remain legible."""

_TYPESET = """
import sys, typst
root, fonts, out = sys.argv[1:]
typst.compile(root + "/main.typ", root=root, font_paths=[fonts], ignore_system_fonts=True, format="pdf", output=out)
"""

_LONG_WORD = re.compile(r"\S{32}")
_BREAK = "\u200b"
_FIGURE = re.compile(r'<figure id="[^"]*">(<svg.*?</svg>)<figcaption>', re.DOTALL)
_ROLE = re.compile(r"var\(--f-([a-z0-9]+)\)")
_SVG = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" font-family="DejaVu Sans"'


def print_form(document: Document) -> bytes:
    """Return all of a document but its figures, as JSON."""
    given = {
        "kicker": document.kicker,
        "title": document.title,
        "identity": document.identity,
        "footer": " · ".join(text for text in ("LINNA", document.kicker, document.identity) if text),
        "facts": "   ".join(f"{name} {value}" for name, value in document.facts),
        "blocks": list(_blocks(document)),
    }
    return json.dumps(given, separators=(",", ":")).encode()


def pdf_of(form: bytes, page: str) -> bytes:
    """Return the octets of the PDF of a print form and the figures of its HTML page."""
    with TemporaryDirectory(prefix="linna-report-") as folder:
        root = Path(folder)
        for number, svg in enumerate(_FIGURE.findall(page), 1):
            light = _ROLE.sub(lambda role: LIGHT[role.group(1)], svg)
            (root / f"figure-{number}.svg").write_text(light.replace("<svg", _SVG, 1), encoding="utf-8")
        (root / "document.json").write_text(json.dumps(_printable(json.loads(form))), encoding="utf-8")
        (root / "main.typ").write_text(_template(), encoding="utf-8")
        return _typeset(root)


def _typeset(root: Path) -> bytes:
    """Return the PDF of `main.typ` in a folder, typeset by a process of its own.

    Typst keeps what it has computed until its process ends, about 20 MiB for each report.
    """
    out = root / "document.pdf"
    words = [sys.executable, "-P", "-c", _TYPESET, str(root), str(_font_folder()), str(out)]
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        reason = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise RuntimeError(f"PDF of a report: expected a document, found: {reason[0]}")
    return out.read_bytes()


@lru_cache(maxsize=1)
def _template() -> str:
    text = (files("reports") / "pdf_pages.typ").read_text(encoding="utf-8")
    for role, tint in LIGHT.items():
        text = text.replace(f'rgb("{role.upper()}")', f'rgb("{tint}")')
    return text


@lru_cache(maxsize=1)
def _font_folder() -> Path:
    """Return the folder of the fonts of matplotlib, whose import takes longer than all that is made here."""
    found = find_spec("matplotlib")
    assert found is not None and found.origin is not None
    return Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"


@lru_cache(maxsize=1)
def _characters() -> frozenset[int]:
    """Return the characters of the font; kept on disk by the hash of its file."""
    file = _font_folder() / "DejaVuSans.ttf"

    def read() -> bytes:
        from matplotlib.ft2font import FT2Font

        return array("I", sorted(FT2Font(str(file)).get_charmap())).tobytes()

    name = f"figure-characters-{hashlib.sha256(file.read_bytes()).hexdigest()}"
    return frozenset(array("I", made_once(name, read)))


def _printable(value: Any) -> Any:
    """Return a JSON value with a question mark for each missing character, and with break points in long words."""
    if isinstance(value, str):
        known = "".join(c if ord(c) in _characters() or c == "\n" else "?" for c in value)
        return _LONG_WORD.sub(lambda part: part.group(0) + _BREAK, known)
    if isinstance(value, dict):
        return {key: _printable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_printable(item) for item in value]
    return value


def _blocks(document: Document) -> Iterator[dict[str, Any]]:
    section = table = figure = 0
    for block in document.blocks:
        match block:
            case Heading(text, 2):
                section += 1
                made = {"kind": "section", "number": str(section), "text": text}
            case Table():
                table += 1
                made = _table(block, table)
            case Picture():
                figure += 1
                made = _picture(block, figure)
            case _:
                made = _plain(block)
        yield made


def _plain(block: Block) -> dict[str, Any]:
    match block:
        case Verdict(text, level) as verdict:
            role = VERDICT_ROLES.get(level, "gray2")
            return {"kind": "verdict", "word": verdict.word, "text": text, "color": color(role)}
        case Headline():
            return _headline(block)
        case Listing(title):
            return _plain(Paragraph(f"{title}: in full in the HTML and JSON forms of this report.", small=True))
        case _:
            return {"kind": type(block).__name__.lower(), **asdict(block)}


def _headline(block: Headline) -> dict[str, Any]:
    figures = []
    for figure in block.figures:
        value = headline_text(figure.value)
        value = "not available" if value == NOT_A_VALUE else value
        label = evidence_label(figure.evidence_level or block.evidence_level)
        level = f"level {label}" if label else "level not stated"
        figures.append(asdict(figure) | {"value": value, "words": len(value) > 9, "level": level})
    return {"kind": "headline", "figures": figures, "ladder": block.ladder}


def _table(block: Table, number: int) -> dict[str, Any]:
    return {
        "kind": "table",
        "number": str(number),
        "caption": block.caption,
        "columns": [asdict(column) for column in block.columns],
        "rows": [
            [asdict(cell) | {"swatch": color(cell.swatch) if cell.swatch else ""} for cell in cells(row)]
            for row in block.rows
        ],
        "note": block.note,
    }


def _picture(block: Picture, number: int) -> dict[str, Any]:
    width_in, height_in = _PAGE_IN
    # One scale for all figures, unless a page is too small.
    scale = min(width_in / max(block.width_in, WIDTH_IN), (height_in - _TEXT_IN) / block.height_in)
    # A page that a figure of up to half a page does not fit is itself half full.
    half = (height_in / 2.0 - _TEXT_IN) / block.height_in
    if half >= _LEAST_SHRINKING * scale:
        scale = min(scale, half)
    return {
        "kind": "picture",
        "number": str(number),
        "caption": block.caption,
        "file": f"figure-{number}.svg",
        "share": scale * block.width_in / width_in,
    }
