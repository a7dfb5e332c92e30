"""A document as one self-contained HTML page: no script, no outside host, the same bytes every time."""

from collections.abc import Iterator
from html import escape
from itertools import groupby

from reports.document import (
    EVIDENCE_LEVELS,
    VERDICT_ROLES,
    Absent,
    Block,
    Bullets,
    Cell,
    Column,
    Document,
    Heading,
    Headline,
    Listing,
    Paragraph,
    Picture,
    Properties,
    Table,
    Verdict,
    cells,
    evidence_label,
    evidence_number,
    evidence_text,
)
from reports.drawings import Drawings
from reports.stylesheet import page_style
from reports.text import NOT_A_VALUE, headline_text

_SHORT_TABLE_ROWS = 14


def html_page(document: Document, drawings: Drawings | None = None) -> str:
    """Return the page as text; `drawings` keeps figures that another rendering has drawn."""
    drawn = Drawings() if drawings is None else drawings
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    footer = " · ".join(t for t in ("LINNA", document.kicker, document.identity) if t)
    sections = [b.text for b in document.blocks if isinstance(b, Heading) and b.level == 2]
    about = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in document.facts)
    contents = "".join(
        f'<li><a href="#s{i}"><span>{i}</span><span>{escape(text)}</span></a></li>'
        for i, text in enumerate(sections, 1)
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{escape(document.kicker)}: {escape(document.title)}</title>"
        '<link rel="icon" href="data:,">'
        f"<style>{page_style(footer)}</style></head>\n<body>"
        '<a class="skip" href="#top">Skip to the report</a><div class="sheet">'
        f'<nav class="contents" aria-label="Contents"><p>Contents</p><ol>{contents}</ol></nav>'
        f'<main id="top"><header><p class="kicker"><b>LINNA · {escape(document.kicker)}</b>'
        f"<span>{escape(document.identity)}</span></p><h1>{escape(document.title)}</h1>"
        f'<dl class="about">{about}</dl></header>\n{"".join(_blocks(document, drawn))}'
        f'<footer class="colophon">{escape(footer)}. Times are UTC. Figures and tables come from the same values.'
        "</footer></main></div></body></html>\n"
    )


def _blocks(document: Document, drawings: Drawings) -> Iterator[str]:
    section = table = figure = 0
    for block in document.blocks:
        if isinstance(block, Heading) and block.level == 2:
            section += 1
            yield f'\n<h2 id="s{section}"><span class="n">{section}</span>{escape(block.text)}</h2>'
        elif isinstance(block, Table):
            table += 1
            yield _table(block, table)
        elif isinstance(block, Picture):
            figure += 1
            yield _picture(block, figure, drawings)
        else:
            yield _plain(block)


def _plain(block: Block) -> str:
    match block:
        case Heading(text):
            return f"\n<h3>{escape(text)}</h3>"
        case Paragraph(text, small):
            return f"\n<p{' class=small' if small else ''}>{escape(text)}</p>"
        case Verdict(text, level) as verdict:
            role, word = VERDICT_ROLES.get(level, ""), escape(verdict.word)
            return f'\n<div class="verdict {role}"><p class="word">{word}</p><p class="says">{escape(text)}</p></div>'
        case Headline():
            return _headline(block)
        case Properties(pairs, mono):
            body = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in pairs)
            return f'\n<dl class="pairs{" mono" if mono else ""}">{body}</dl>'
        case Bullets(items):
            return f"\n<ul>{''.join(f'<li>{escape(i)}</li>' for i in items)}</ul>"
        case Absent(what, why):
            reason = f"<span>not available: {escape(why)}</span>"
            return f'\n<div class="absent" role="note"><b>{escape(what)}</b>{reason}</div>'
        case Listing(title, text):
            return f"\n<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"
        case _:
            raise AssertionError(f"no HTML for {type(block).__name__}")


def _headline(block: Headline) -> str:
    items = []
    for figure in block.figures:
        value = headline_text(figure.value)
        words = isinstance(figure.value, str) and len(figure.value) > 9
        if value == NOT_A_VALUE:
            value, words = "not available", True
        unit = f"<small>{escape(figure.unit)}</small>" if figure.unit and not words else ""
        note = f'<dd class="note">{escape(figure.note)}</dd>' if figure.note else ""
        level = _evidence(figure.evidence_level or block.evidence_level)
        items.append(
            f"<div><dt>{escape(figure.label)}</dt>"
            f'<dd class="number{" words" if words else ""}">{escape(value)}{unit}</dd>{note}{level}</div>'
        )
    return f'\n<dl class="headline">{"".join(items)}</dl><p class="ladder">{escape(block.ladder)}</p>'


def _evidence(level: str) -> str:
    number = evidence_number(level)
    if number is None:
        return f'<dd class="level">{escape(evidence_text(level))}</dd>'
    dots = "".join(f"<i{' class=on' if i < number else ''}></i>" for i in range(len(EVIDENCE_LEVELS)))
    title = escape(evidence_text(level))
    words = f"level {evidence_label(level)}"
    return f'<dd class="level" title="{title}"><span aria-hidden="true">{dots}</span> {words}</dd>'


def _picture(block: Picture, number: int, drawings: Drawings) -> str:
    svg = drawings.svg(block)
    return (
        f'\n<figure id="fig-{escape(block.key)}">{svg}'
        f"<figcaption><b>Figure {number}.</b> {escape(block.caption)}</figcaption></figure>"
    )


def _table(block: Table, number: int) -> str:
    heads = []
    if any(c.group for c in block.columns):
        cells_of_groups = []
        for group, members in groupby(block.columns, key=lambda c: c.group):
            span = len(list(members))
            head = f'<th colspan="{span}" class="group" scope="colgroup"><span>{escape(group)}</span></th>'
            cells_of_groups.append(head if group else f'<td colspan="{span}"></td>')
        heads.append(f"<tr>{''.join(cells_of_groups)}</tr>")
    heads.append(f"<tr>{''.join(_head(c) for c in block.columns)}</tr>")
    rows = []
    for row in block.rows:
        pairs = zip(cells(row), block.columns, strict=True)
        rows.append(f"<tr>{''.join(_cell(cell, column, i == 0) for i, (cell, column) in enumerate(pairs))}</tr>")
    note = f'<p class="tablenote">{escape(block.note)}</p>' if block.note else ""
    short = " short" if len(rows) <= _SHORT_TABLE_ROWS else ""
    narrow = ' class="narrow"' if len(block.columns) <= 4 else ""
    return (
        f'\n<div class="tablewrap{short}"><table{narrow}>'
        f"<caption><b>Table {number}.</b> {escape(block.caption)}</caption>"
        f"<thead>{''.join(heads)}</thead><tbody>{''.join(rows)}</tbody></table>{note}</div>"
    )


def _head(column: Column) -> str:
    unit = f'<span class="unit">{escape(column.unit)}</span>' if column.unit else ""
    return f'<th scope="col"{" class=num" if column.numeric else ""}>{escape(column.label)}{unit}</th>'


def _cell(cell: Cell, column: Column, first: bool) -> str:
    text = escape(cell.text)
    if cell.strong:
        text = f"<b>{text}</b>"
    if cell.swatch:
        text = f'<span class="swatch" style="background:var(--f-{escape(cell.swatch)})"></span>{text}'
    kind = " class=num" if column.numeric else ""
    if cell.share is not None:
        width = f"{100 * min(max(cell.share, 0.0), 1.0):.1f}"
        text = f'<span class="gauge" role="presentation"><i style="width:{width}%"></i></span>{text}'
        kind = " class=bar"
    tag = 'th scope="row"' if first else "td"
    return f"<{tag}{kind}>{text}</{'th' if first else 'td'}>"
