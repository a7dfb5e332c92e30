"""The PDF of a report: A4, the same octets, nothing beyond the foot of a page."""

import re

import pytest

from reports.document import Column, Document, Facts, Heading, Listing, Paragraph, Table
from reports.pass_report import pass_document
from reports.pdf_pages import _HEIGHT, _TOP, _paginated, _pieces, _width, _wrapped, pdf_pages
from reports.render import render_pdf
from reports.values import PassReport
from tests.reports import example


@pytest.fixture(scope="module")
def small() -> PassReport:
    return example.pass_report(hours=0.2, gallery=1, worst=0)


@pytest.fixture(scope="module")
def octets(small: PassReport) -> bytes:
    return render_pdf(small)


def test_it_is_a_pdf_of_a4_pages(octets: bytes, small: PassReport) -> None:
    assert octets.startswith(b"%PDF-") and octets.rstrip().endswith(b"%%EOF")
    boxes = re.findall(rb"/MediaBox \[ ?([\d. ]+)\]", octets)
    assert len(boxes) == len(_paginated(_pieces(pass_document(small))))
    for box in boxes:
        # 210 by 297 mm are 595.3 by 841.9 points; half a point is a fifth of a millimetre.
        assert [float(v) for v in box.split()] == pytest.approx([0, 0, 595.3, 841.9], abs=0.5)


def test_the_same_value_gives_the_same_octets(octets: bytes) -> None:
    assert render_pdf(example.pass_report(hours=0.2, gallery=1, worst=0)) == octets


def test_no_date_and_no_machine_is_in_it(octets: bytes) -> None:
    assert b"CreationDate" not in octets and b"ModDate" not in octets


def test_everything_stands_between_head_and_foot(whole_pass: PassReport) -> None:
    for page in _paginated(_pieces(pass_document(whole_pass))):
        assert page, "no page is empty"
        for y, piece in page:
            assert y >= _TOP
            assert y + piece.height <= _TOP + _HEIGHT + 1e-6
        tops = [y for y, _ in page]
        assert tops == sorted(tops)


def test_a_long_table_goes_on_under_its_heading() -> None:
    rows = tuple((str(i), "row") for i in range(200))
    table = Table("Long.", (Column("n"), Column("what", numeric=False)), rows)
    pages = _paginated(_pieces(Document("Test", "Long table", "t", (), (Heading("Section"), table))))
    assert len(pages) > 2
    heads = {id(piece) for _, piece in pages[1][:1]}
    assert all(id(page[0][1]) in heads for page in pages[1:-1])


def test_text_wider_than_a_line_is_broken_inside_the_width() -> None:
    for text in ("a word " * 60, "x" * 400, "mixed " + "y" * 200 + " words"):
        lines = _wrapped(text, 3.0, 9.0)
        assert all(_width(line, 9.0) <= 3.0 + 1e-9 for line in lines)
        assert "".join("".join(lines).split()) == "".join(text.split())


def test_awkward_text_is_printed_and_not_interpreted() -> None:
    blocks = (
        Heading("Ω $x$ 月"),
        Paragraph("costs 5$ and 7$, 100 % of \\alpha"),
        Facts((("path", "/" + "long" * 80),)),
        Listing("file", "a = 1\n\nb = '$'\n" * 300),
    )
    assert pdf_pages(Document("Test", "T $\\frac$ 月", "i", (), blocks)).startswith(b"%PDF-")


def test_a_pass_with_nothing_in_it_is_one_honest_document() -> None:
    assert render_pdf(PassReport(title="Nothing", pass_id="p0")).startswith(b"%PDF-")
