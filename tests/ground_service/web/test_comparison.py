"""Passes side by side, in Chromium."""

import re
from urllib.parse import quote_plus

import pytest
from pytest import approx, fixture

from ground_service.evaluation.service import make_report
from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.passes.service import define_pass
from tests.ground_service.conftest import cells
from tests.ground_service.web.conftest import strict_page
from tests.ground_service.web.test_in_browser import answered, colour_of, settled
from tests.lazy import expect


@fixture(scope="module")
def compared(tmp_path_factory, make_pass, console, serve):
    """A service with two passes that have reports, and one that has none."""
    home = tmp_path_factory.mktemp("compared") / "home"
    with open_ground(home) as ground:
        for frames, seed in (40, 1), (30, 2):
            key = import_archive(ground, make_pass(frames=frames, seed=seed).folder)
            make_report(ground, key)
        start = 1_900_000_000_000_000_000
        define_pass(ground, name="empty", start_utc_ns=start, stop_utc_ns=start + 60 * 10**9, spacecraft_id=76)
    with serve(home, console.port) as running:
        yield running


@fixture
def view(browser, compared):
    """A page of the service."""
    with strict_page(browser, compared.url, strict=False) as page:
        yield page


def row(page, name):
    """Cells of the row of a figure."""
    line = page.locator("tbody tr").filter(has=page.locator("td:first-child", has_text=re.compile(f"^{name}$")))
    return line.locator("td").all_inner_texts()[1:]


def test_passes_chosen_on_the_list_are_compared_side_by_side(view):
    settled(view, "/passes")
    button = view.get_by_role("button", name="Compare")
    expect(button).to_be_disabled()
    for key in "1", "2":
        line = view.locator("#passes tbody tr").filter(has=view.locator(f'a[href="/passes/{key}"]'))
        line.get_by_role("checkbox").press("Space")
    expect(view).to_have_url(re.compile("compare=1&compare=2"))
    view.reload()
    expect(view.locator("#passes input:checked")).to_have_count(2)
    button.press("Enter")
    expect(view).to_have_url(re.compile(r"/comparison\?pass=1&pass=2"))
    answered(view)
    reports = [view.request.get("/api/v1/reports", params={"pass_id": key}).json()["items"][0] for key in (1, 2)]
    figures = [view.request.get(f"/api/v1/reports/{one['id']}/summary").json() for one in reports]
    estimator = reports[0]["estimator"]
    expect(view.get_by_label("Navigation solution")).to_have_value(estimator)
    medians = [one["navigation"][estimator]["median_3d_m"] for one in figures]
    first, second, change = row(view, f"Median error, {estimator}, m")
    assert [float(first), float(second)] == approx(medians, rel=6e-3)  # three figures
    assert change == "±0" and medians[0] == approx(medians[1], rel=1e-3)  # the same errors were put in
    high = [one["conditions"]["altitude_km"] for one in figures]
    assert [*map(float, row(view, "Altitude, km")[:2])] == approx(high, rel=6e-3)
    assert row(view, "Sun elevation, deg") == ["unknown", "unknown", ""]
    expect(view.locator("#figures thead")).to_contain_text("synthetic pass (2)")
    assert row(view, "Frames") == ["40", "30", "−10"]
    verdicts = row(view, "Verdict")
    for cell, one in zip(verdicts, reports, strict=False):
        assert one["verdict"] in cell
    lines = view.evaluate(
        """() => {
            const plot = document.querySelector(".chart").plot;
            const values = (index) => plot.data[index].filter((value) => value != null);
            const named = plot.series.map((one, index) => [one.label, values(index)]);
            return named.filter(([label]) => !["min", "max"].includes(label))
                .map(([label, found]) => [label, found.length, found[0]]);
        }"""
    )
    assert lines[0][0] == "since start" and lines[0][2] == 0.0
    assert [count for _, count, _ in lines[1:]] == [40, 30]


def test_a_comparison_keeps_its_solution_in_the_address(view):
    settled(view, "/comparison?pass=1&pass=2")
    answered(view)
    view.get_by_label("Navigation solution").select_option("spherical")
    expect(view).to_have_url(re.compile("solution=spherical"))
    view.reload()
    expect(view.get_by_label("Navigation solution")).to_have_value("spherical")
    expect(view.get_by_label("chart: error of spherical, m")).to_be_visible()


def test_a_pass_without_a_report_is_compared_by_what_is_known(view):
    settled(view, "/comparison?pass=1&pass=3")
    answered(view)
    assert row(view, "Verdict")[1] == "no report"
    assert row(view, "Recall")[1:] == ["unknown", ""]
    settled(view, "/comparison?pass=1")
    expect(view.locator("#figures")).to_contain_text("Choose two or more passes")


def test_passes_are_filtered_by_their_verdict(view):
    levels = {
        key: view.request.get("/api/v1/reports", params={"pass_id": key}).json()["items"][0]["verdict_level"]
        for key in (1, 2)
    }
    settled(view, "/passes?verdict=none")
    expect(view.locator("#passes tbody tr")).to_have_count(1)
    expect(view.locator("#passes tbody tr")).to_contain_text("empty")
    view.get_by_label("Verdict").select_option(levels[1])
    expect(view).to_have_url(re.compile(re.escape(f"verdict={quote_plus(levels[1])}")))
    alike = [key for key, level in levels.items() if level == levels[1]]
    expect(view.locator("#passes tbody tr")).to_have_count(len(alike))
    other = next(level for level in ("met", "unknown", "not met") if level not in levels.values())
    view.get_by_label("Verdict").select_option(other)
    expect(view.locator("#passes")).to_contain_text("No pass matches.")


COLOURS = """
met | --good
not met | --bad
unknown | --caution
| --caution
"""


@pytest.mark.parametrize("level, colour", cells(COLOURS))
def test_a_verdict_has_the_same_word_and_colour_on_every_page(view, level, colour):
    def with_level(route):
        document = route.fetch().json()
        for one in document.get("items", [document]):
            one["verdict_level"] = level
        route.fulfill(json=document)

    view.route(re.compile(r"/api/v1/reports(\?|/[^/]+/overview)"), with_level)
    word = level or "unknown"
    for address, mark in (
        ("/passes", "#passes tbody tr:has(a[href='/passes/1']) .state"),
        ("/comparison?pass=1&pass=2", "#figures .state"),
        ("/passes/1", "#verdict .state"),
    ):
        settled(view, address)
        shown = view.locator(mark).first
        expect(shown).to_have_text(word)
        expect(shown).to_have_css("color", colour_of(view, colour))


def test_the_report_of_a_pass_has_the_word_of_the_list(view):
    settled(view, "/passes")
    line = view.locator("#passes tbody tr").filter(has=view.locator('a[href="/passes/1"]'))
    word = line.locator(".state").inner_text()
    view.set_viewport_size({"width": 390, "height": 844})
    box = line.locator(".state").bounding_box()
    assert box["x"] + box["width"] < 390.0  # seen without scrolling the table
    with view.expect_popup() as opened:
        line.get_by_role("link", name="open").click()
    expect(opened.value.locator(".verdict .word")).to_have_text(f"Verdict: {word}")


def test_a_service_of_archives_alone_shows_the_date_of_its_data_and_the_next_step(view):
    settled(view, "/")
    expect(view.locator("#clock")).to_have_text(re.compile(r"^data of 20\d\d-\d\d-\d\d, recorded$"))
    card = view.get_by_role("region", name="Spacecraft 76 flight")
    expect(card).to_contain_text("A finished recording. Next step: open its pass and report")
    expect(card.get_by_role("link", name="pass", exact=True)).to_have_attribute("href", re.compile("^/passes/"))
