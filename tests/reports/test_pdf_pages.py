"""The PDF of a report: A4, reproducible, complete, and free of markup."""

import io
import logging
import os
import re
import sys
from dataclasses import replace
from functools import partial
from itertools import pairwise

from pypdf import PdfReader
from pytest import approx, fixture, raises

from reports import drawings
from reports.document import Column, Document, Heading, Listing, Paragraph, Picture, Properties, Table
from reports.drawings import KeptDrawings, drawing_hash, drawing_processes
from reports.figures.theme import drawing
from reports.html_page import html_page
from reports.pass_report import pass_document
from reports.pdf_pages import _typeset, pdf_of, print_form
from reports.render import render_html, render_pages
from tests.reports import example
from tests.serving import ran

_POINTS = 72.0


@fixture(scope="module")
def small():
    return example.pass_report(hours=0.2, gallery=1, worst=0)


def pdf_pages(made):
    return pdf_of(print_form(made), html_page(made))


@fixture(scope="module")
def octets(small):
    page, form = render_pages(small)
    return pdf_of(form, page)


def pages_of(octets):
    return [page.extract_text().replace("\u200b", "") for page in PdfReader(io.BytesIO(octets)).pages]


def document(*blocks):
    return Document("Test", "Title", "t", (), blocks)


def test_it_is_a_pdf_of_numbered_a4_pages_without_date_and_machine(octets):
    reader = PdfReader(io.BytesIO(octets))
    assert len(reader.pages) > 2
    for number, page in enumerate(reader.pages, 1):
        # 210 by 297 mm are 595.3 by 841.9 points; half a point is a fifth of a millimetre.
        assert [float(v) for v in page.mediabox] == approx([0, 0, 595.3, 841.9], abs=0.5)
        assert f"{number} / {len(reader.pages)}" in page.extract_text()
    assert b"CreationDate" not in octets and b"ModDate" not in octets
    assert PdfReader(io.BytesIO(octets)).metadata["/Title"].startswith("Pass report: ")


def test_all_figures_and_tables_of_the_page_are_in_it(small, octets):
    page, text = render_html(small), "\n".join(pages_of(octets))
    for kind in ("Figure", "Table"):
        count = page.count(f"<b>{kind} ")
        assert count > 1
        assert all(f"{kind} {number}." in text for number in range(1, count + 1))


def test_text_stays_inside_the_margins(whole_pass):
    for page in PdfReader(io.BytesIO(pdf_pages(pass_document(whole_pass)))).pages:
        places = []

        def note(text, cm, tm, *_, places=places):
            if text.strip():
                x, y = tm[4:6]
                places.append((x * cm[0] + y * cm[2] + cm[4], x * cm[1] + y * cm[3] + cm[5]))

        page.extract_text(visitor_text=note)
        assert places, "no page is empty"
        for x, y in places:
            assert 0.6 * _POINTS <= x <= 595.3 - 0.6 * _POINTS
            assert 0.2 * _POINTS <= y <= 841.9 - 0.5 * _POINTS


def test_a_long_table_repeats_its_head_and_loses_no_row():
    rows = tuple((str(i), f"row-{i}.") for i in range(200))
    table = Table("Long.", (Column("n"), Column("what", numeric=False)), rows)
    pages = pages_of(pdf_pages(document(Heading("Section"), table)))
    assert len(pages) > 2
    assert all("what" in page for page in pages)
    assert all(f"row-{i}." in "".join(pages) for i in range(200))


def test_two_figures_of_little_more_than_half_a_page_share_a_page():
    first, second = (Picture(key, key, key, 6.8, lambda canvas: None) for key in ("first", "second"))
    (page,) = pages_of(pdf_pages(document(Heading("Section"), first, second)))
    assert "first" in page and "second" in page


def test_a_wide_table_is_set_in_smaller_type():
    """Twenty numeric columns do not overlap: each number starts right of the previous one."""
    columns = tuple(Column(f"c{i}") for i in range(20))
    row = tuple(f"{12_345 + i}" for i in range(20))
    text = PdfReader(io.BytesIO(pdf_pages(document(Table("Wide.", columns, (row,)))))).pages[0].extract_text()
    assert all(number in text for number in row)
    places = [text.index(number) for number in row]
    assert all(a < b for a, b in pairwise(places))


def test_a_long_word_is_broken_inside_the_width():
    pages = pages_of(pdf_pages(document(Paragraph("x" * 400), Properties((("path", "/" + "long" * 80),)))))
    lines = [line for line in pages[0].splitlines() if "xxxx" in line or "longlong" in line]
    assert len(lines) > 6
    assert sum(line.count("x") for line in lines) == 400


def test_awkward_text_is_printed_and_not_interpreted():
    text = "\n".join(
        pages_of(
            pdf_pages(
                Document(
                    "Test",
                    "T $\\frac$ 月",
                    "i",
                    (),
                    (
                        Heading("Ω $x$ 月"),
                        Paragraph("costs 5$ and 7$, 100 % of \\alpha, #read(1) *bold* _x_ <label> @ref"),
                        Listing("file", "a = 1\n\nb = '$'\n" * 300),
                    ),
                )
            )
        )
    )
    assert "T $\\frac$ ?" in text and "Ω $x$ ?" in text
    assert "#read(1) *bold* _x_ <label> @ref" in text and "100 % of \\alpha" in text
    assert "file: in full in the HTML and JSON forms" in text and "a = 1" not in text


def test_the_process_of_a_report_does_not_keep_what_typesetting_computes():
    program = (
        "import sys; from reports.document import Document, Paragraph\n"
        "from reports.pdf_pages import pdf_of, print_form\n"
        "octets = pdf_of(print_form(Document('Test', 'Title', 't', (), (Paragraph('x'),))), '')\n"
        "print(octets[:5], any(name.partition('.')[0] == 'typst' for name in sys.modules))"
    )
    done = ran([sys.executable, "-c", program], check=True)
    assert done.stdout == "b'%PDF-' False\n"


def test_a_fault_of_typesetting_is_one_line(tmp_path):
    (tmp_path / "main.typ").write_text("#unknown-function()")
    with raises(RuntimeError, match=r"^PDF of a report: expected a document, found: .*unknown") as raised:
        _typeset(tmp_path)
    assert "\n" not in str(raised.value)


def test_the_characters_of_the_font_are_known_without_matplotlib_the_second_time(tmp_path):
    program = (
        "import sys\n"
        "from reports.pdf_pages import _characters\n"
        "print(ord('σ') in _characters(), ord('月') in _characters(), 'matplotlib' in sys.modules)"
    )
    said = [
        ran(
            [sys.executable, "-c", program], env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}, check=True
        ).stdout
        for _ in range(2)
    ]
    assert said == ["True False True\n", "True False False\n"]


def test_a_kept_figure_is_shown_again_unless_it_is_damaged_or_of_another_version(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    picture, drawn = Picture("one", "one", "one", 1.0, partial(len)), 0

    def draw(*_):
        nonlocal drawn
        drawn += 1
        return "<svg/>"

    monkeypatch.setattr(drawings, "draw_svg", draw)
    assert [KeptDrawings().svg(picture) for _ in range(2)] == ["<svg/>"] * 2
    assert drawn == 1
    (file,) = (tmp_path / "kept-ground").iterdir()  # where no build under test reads
    file.write_bytes(file.read_bytes()[:-1])
    assert KeptDrawings().svg(picture) == "<svg/>"
    assert drawn == 2
    monkeypatch.setattr(drawings, "_code_hash", lambda: b"another version")
    KeptDrawings().svg(picture)
    assert drawn == 3
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(file / "folder"))  # under a file: nothing can be kept
    with caplog.at_level(logging.WARNING):
        assert [KeptDrawings().svg(picture) for _ in range(2)] == ["<svg/>"] * 2
    assert drawn == 5
    assert [record.getMessage() for record in caplog.records] == [
        f"nothing is kept in {file}/folder-ground: Not a directory"
    ]


def test_late_telemetry_changes_only_the_figures_that_show_it(small):
    def hashes(report):
        return {one.key: drawing_hash(one) for one in pass_document(report).blocks if isinstance(one, Picture)}

    before = hashes(example.pass_report(hours=0.2, gallery=1, worst=0))
    assert before == hashes(small)  # equal values, other objects
    assert len(set(before.values())) == len(before) > 15
    late = replace(small.housekeeping[0], values=small.housekeeping[0].values + 1.0)
    after = hashes(replace(small, housekeeping=(late, *small.housekeeping[1:])))
    assert [key for key in before if after[key] != before[key]] == ["housekeeping"]


def test_an_axis_of_one_tick_shows_what_matplotlib_does():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from reports.figures.axes import QuickAxes

    def shown(kind):
        """Texts and their places, ends of lines of the grid, and places of ticks."""
        figure, svg = Figure(figsize=(4.0, 3.0)), io.StringIO()
        with drawing({"axes.formatter.useoffset": True, "svg.hashsalt": "x"}):
            for left in (0.1, 0.6):
                axes = figure.add_axes((left, 0.2, 0.35, 0.6), axes_class=kind)
                axes.plot([1e6 + 1.0, 1e6 + 2.0], [3.0, 400.0])
                axes.grid(True, axis="both")
            axes.set_yscale("log")
            axes.set_xticks([1e6 + 1.25, 1e6 + 5.0], ["quarter", "out of view"])
            axes.set_xlim(1e6 + 1.0, 1e6 + 2.0)
            axes.tick_params(axis="y", labelleft=False)
            figure.savefig(svg, format="svg", metadata={"Date": None})
        text = svg.getvalue()
        grid = re.findall(r'<path d="([^"]*)"[^>]*style="[^"]*#e3e7ec', text)
        lines = sorted(re.findall(r"M ([\d.]+ [\d.]+)\s+L ([\d.]+ [\d.]+)", " ".join(grid)))
        return lines, sorted(re.findall(r"<use [^>]* (x=.*?)style", text)), sorted(re.findall("<text.*</text>", text))

    ours, theirs = shown(QuickAxes), shown(Axes)
    assert ours[0] == theirs[0] and ours[2] == theirs[2]
    assert set(ours[1]) <= set(theirs[1])  # marks of length 0 are not drawn
    assert len(ours[0]) > 8 and any("quarter" in text for text in ours[2]) and any("+1e6" in text for text in ours[2])


def test_two_processes_draw_as_one_does(small, tmp_path, monkeypatch):
    """The process that asks draws the rest."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    pictures = [one for one in pass_document(small).blocks if isinstance(one, Picture)][:3]
    with drawing_processes(True) as processes:
        ahead = KeptDrawings(processes)
        ahead.prepare(pictures)
    alone = drawings.Drawings()
    assert [ahead[one.key] == alone.svg(one) for one in pictures] == [True] * 3
    with drawing_processes(True) as processes:
        assert processes.draw([replace(pictures[0], draw=lambda canvas: None)]) == []
        assert KeptDrawings(processes).svg(pictures[0]) == ahead[pictures[0].key]
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    with drawing_processes(True) as processes:
        assert processes is None
