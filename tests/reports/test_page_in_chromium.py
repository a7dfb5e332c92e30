"""The page in a real browser: silent, self-contained, legible in both themes, whole on paper."""

import base64
import dataclasses

from pytest import fixture, mark

from reports.render import render_html
from tests.reports import example
from tests.reports.browser import CHROMIUM, tab

pytestmark = [mark.slow, mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]

# WCAG 2.1 contrast of text against the ground of the page, for the page and its figures.
_CONTRAST = """
(() => {
  const parse = c => (c.match(/[\\d.]+/g) || []).map(Number);
  const light = ([r, g, b]) => [r, g, b].map(v => v / 255)
    .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((s, v, i) => s + v * [0.2126, 0.7152, 0.0722][i], 0);
  const ground = light(parse(getComputedStyle(document.body).backgroundColor));
  const weak = [];
  for (const e of document.querySelectorAll('h1,h2,h3,p,dt,dd,th,td,figcaption,caption,li,summary,svg text')) {
    if (!e.textContent.trim()) continue;
    const style = getComputedStyle(e);
    const ink = light(parse(e instanceof SVGElement ? style.fill : style.color));
    const ratio = (Math.max(ink, ground) + 0.05) / (Math.min(ink, ground) + 0.05);
    if (ratio < LIMIT) weak.push(e.textContent.trim().slice(0, 30) + ' ' + ratio.toFixed(2));
  }
  return weak;
})()
"""


@fixture(scope="module")
def path(whole_page, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(whole_page, encoding="utf-8")
    return file


@fixture(scope="module")
def browser(path, tmp_path_factory):
    with tab(tmp_path_factory.mktemp("profile")) as page:
        page.size(1280, 900)
        page.open(path)
        yield page


def test_the_page_loads_without_a_word_on_the_console_and_without_a_request(browser, path):
    assert browser.complaints == []
    assert [r for r in browser.requests if not r.startswith("data:")] == [path.as_uri()]


def test_every_figure_is_drawn(browser):
    sizes = browser.value("[...document.querySelectorAll('figure svg')].map(s => s.getBoundingClientRect().height)")
    assert len(sizes) > 15
    assert min(sizes) > 60
    assert browser.value("[...document.querySelectorAll('svg image')].every(i => i.getBoundingClientRect().width > 50)")


@mark.parametrize("width", [1280, 1000, 800])
def test_nothing_runs_out_of_the_window(browser, width):
    browser.size(width, 900)
    assert browser.value("document.documentElement.scrollWidth") <= width
    browser.size(1280, 900)


@mark.parametrize("scheme", ["light", "dark"])
def test_text_and_figures_are_legible_in_both_themes(browser, scheme):
    browser.theme(scheme)
    # 4.5 is WCAG AA for text; labels in the colour of their line are held to the 3 of graphics.
    assert browser.value(_CONTRAST.replace("LIMIT", "3.0")) == []
    assert browser.value(_CONTRAST.replace("LIMIT", "4.5").replace(",svg text", "")) == []
    browser.theme("light")


def test_dark_and_light_differ_in_ground_and_ink(browser):
    colours = []
    for scheme in ("light", "dark"):
        browser.theme(scheme)
        colours.append(browser.value("getComputedStyle(document.body).backgroundColor"))
    browser.theme("light")
    assert colours == ["rgb(254, 254, 254)", "rgb(20, 24, 30)"]


def test_the_contents_lead_to_the_sections(browser):
    broken = browser.value(
        "[...document.querySelectorAll('.contents a')].filter(a => !document.querySelector(a.hash)).length"
    )
    assert broken == 0
    assert browser.value("document.querySelectorAll('.contents a').length") == browser.value(
        "document.querySelectorAll('h2').length"
    )


def test_figures_have_words_for_those_who_cannot_see_them(browser):
    assert browser.value("[...document.querySelectorAll('figure svg')].every(s => s.getAttribute('aria-label'))")
    assert browser.value("[...document.querySelectorAll('table')].every(t => t.caption && t.tHead)")


def test_on_paper_no_figure_is_taller_than_a_page_and_paper_is_white(browser):
    browser.theme("dark", media="print")
    # A4 less the margins of the sheet is 265 mm or 1001 CSS pixels high, 178 mm or 673 wide.
    browser.size(673, 1001)
    heights = browser.value("[...document.querySelectorAll('figure')].map(f => f.getBoundingClientRect().height)")
    ground = browser.value("getComputedStyle(document.body).backgroundColor")
    browser.size(1280, 900)
    browser.theme("light")
    assert max(heights) < 1001
    assert ground == "rgb(255, 255, 255)"


@mark.parametrize("kind", ["regression", "detector"])
def test_the_other_reports_are_as_silent_and_as_legible(browser, kind, path):
    other = path.with_name(f"{kind}.html")
    other.write_text(render_html(getattr(example, f"{kind}_report")()), encoding="utf-8")
    browser.requests.clear()
    browser.open(other)
    assert browser.complaints == []
    assert [r for r in browser.requests if not r.startswith("data:")] == [other.as_uri()]
    assert browser.value("document.documentElement.scrollWidth") <= 1280
    for scheme in ("light", "dark"):
        browser.theme(scheme)
        assert browser.value(_CONTRAST.replace("LIMIT", "3.0")) == []
    browser.theme("light")
    browser.open(path)


FONTS = ("DejaVu Sans", "Liberation Sans")
"""The widest of the usual faces, and the metrics of Arial. A face that is not installed falls back to another."""

_GEOMETRY = """
(() => {
  const cut = [], small = [], outside = [];
  for (const wrap of document.querySelectorAll('.tablewrap'))
    if (wrap.scrollWidth > wrap.clientWidth + 1)
      cut.push([wrap.querySelector('caption').textContent.slice(0, 60), wrap.scrollWidth, wrap.clientWidth]);
  for (const cell of document.querySelectorAll('td, th, dd, dt'))
    if (cell.scrollWidth > cell.clientWidth + 1 && getComputedStyle(cell).display !== 'inline')
      cut.push([cell.textContent.slice(0, 60), cell.scrollWidth, cell.clientWidth]);
  for (const svg of document.querySelectorAll('figure svg')) {
    const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
    const frame = svg.getBoundingClientRect();
    for (const text of svg.querySelectorAll('text')) {
      if (!text.textContent.trim()) continue;
      const size = parseFloat(getComputedStyle(text).fontSize) * scale;
      if (size < 9.5) small.push([text.textContent.slice(0, 30), size]);
      const box = text.getBoundingClientRect();
      if (box.right > frame.right + 8 || box.left < frame.left - 8)
        outside.push([text.textContent.slice(0, 30), box.right - frame.right, frame.left - box.left]);
    }
  }
  return {cut, small, outside, width: document.documentElement.scrollWidth};
})()
"""


@mark.parametrize("kind", ["pass", "regression", "detector"])
def test_nothing_is_cut_and_every_number_can_be_read(browser, kind, path):
    """At 1,280 px every table is whole; at 390 px tables and figures scroll in their frames, the page does not."""
    other = path.with_name(f"{kind}-geometry.html")
    other.write_text(render_html(getattr(example, f"{kind}_report")()), encoding="utf-8")
    browser.open(other)
    for font in FONTS:
        browser.value(f"document.documentElement.style.setProperty('--sans', '\"{font}\", sans-serif')")
        for width in (1280, 390):
            browser.size(width, 900)
            found = browser.value(_GEOMETRY)
            assert found["width"] <= width, (font, width)
            assert found["small"] == [], (font, width)
            assert found["outside"] == [], (font, width)
            if width == 1280:
                assert found["cut"] == [], font
    browser.size(1280, 900)
    browser.open(path)


def test_long_names_of_solutions_cut_no_column(browser, path):
    report = example.pass_report()
    renamed = tuple(
        dataclasses.replace(one, name=f"{one.name}, propagate-only with a perfect start") for one in report.navigation
    )
    other = path.with_name("long-names.html")
    other.write_text(render_html(dataclasses.replace(report, navigation=renamed)), encoding="utf-8")
    browser.open(other)
    browser.value("document.documentElement.style.setProperty('--sans', '\"DejaVu Sans\", sans-serif')")
    assert browser.value(_GEOMETRY)["cut"] == []
    browser.open(path)


def test_it_prints_to_a4(browser):
    pdf = base64.b64decode(browser.call("Page.printToPDF", preferCSSPageSize=True)["data"])
    assert pdf.startswith(b"%PDF-")
    # 594.96 by 841.92 points are A4 in whole CSS pixels.
    assert b"594.9" in pdf or b"595" in pdf
