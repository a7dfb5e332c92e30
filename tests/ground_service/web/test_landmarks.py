"""Landmarks learned from flight, reviewed in Chromium."""

import numpy as np
from pytest import fixture

from ground_service.access.service import add_user
from ground_service.evaluation.landmarks.model import LandmarkFilter
from ground_service.evaluation.landmarks.service import list_landmarks, update_landmarks
from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from lunar.catalogue import load_catalogue, save_catalogue
from tests.ground_service.conftest import enter_files
from tests.ground_service.web.conftest import COUNT_REQUESTS, patient, press, shows
from tests.ground_service.web.test_in_browser import answered
from tests.ground_service.web.test_matrix import barriers
from tests.ground_service.web.test_sign_in import sign_in
from tests.lazy import expect

FRAMES = 12


@fixture(scope="module")
def searched(tmp_path_factory, make_flyable, console, serve):
    """A service whose catalogue lacks every third crater of two passes, with their images; tokens of two users."""
    home = tmp_path_factory.mktemp("searched") / "home"
    folder = make_flyable(frames=FRAMES, seed=8).folder
    full = load_catalogue(folder / "catalogue.csv")
    save_catalogue(full.select(np.arange(len(full)) % 3 != 0), folder / "catalogue.csv")
    with open_ground(home) as ground:
        for name in ("first pass", "second pass"):
            enter_files(folder, pass_name=name)
            update_landmarks(ground, import_archive(ground, folder))
        assert ground.read(list_landmarks, LandmarkFilter(state="proposed")).total > 25  # more than a page
        tokens = {role: add_user(ground, f"ann-{role}", role) for role in ("viewer", "operator")}
    with serve(home, console.port) as running:
        yield running.url, tokens


@fixture
def review(browser, searched):
    """Open the page as a user of a role; the test fails if a script of a page fails."""
    contexts, errors = [], []

    def open_page(role):
        context = patient(browser.new_context(base_url=searched[0], viewport={"width": 1280, "height": 900}))
        contexts.append(context)
        page = context.new_page()
        page.add_init_script(COUNT_REQUESTS)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto("/landmarks")
        sign_in(page, searched[1][role])
        expect(page.locator("#user")).to_have_text(f"ann-{role}, {role}")
        expect(page.locator("#landmarks tbody tr")).to_have_count(25)
        return page

    yield open_page
    for one in contexts:
        one.close()
    assert errors == []


def test_an_operator_reviews_landmarks_with_the_keyboard(review):
    page, other = review("operator"), review("viewer")
    first = page.get_by_role("button", name="Sightings of landmark").first
    number = first.inner_text()
    first.focus()
    page.keyboard.press("Enter")
    expect(page.locator("#sightings-title")).to_be_focused()
    expect(page.locator("#sightings-title")).to_have_text(f"Sightings of landmark {number}")
    expect(page.locator("#passes tbody tr")).to_have_count(2)
    drawing = page.locator("#images svg[role=img]").first
    expect(drawing).to_be_visible()
    image = drawing.locator("image").get_attribute("href")
    assert page.request.get(image).headers["content-type"] == "image/png"
    answered(page)
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        assert barriers(page) == [], scheme
    page.keyboard.press("Tab")
    expect(page.get_by_label("Reason")).to_be_focused()
    page.keyboard.type("no rim")
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    expect(page.get_by_role("button", name="Reject")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#decision-text")).to_have_text("rejected by ann-operator")
    expect(page.get_by_role("button", name="Reject")).to_be_hidden()
    expect(page.get_by_role("button", name="Accept")).to_be_visible()
    expect(page.locator("#sightings-title")).to_be_focused()
    # both pages no longer propose it: the other one by the live feed
    for one in (page, other):
        expect(one.get_by_role("button", name=f"Sightings of landmark {number}", exact=True)).to_have_count(0)
    page.get_by_label("State").select_option("rejected")
    expect(page.locator("#landmarks tbody tr")).to_have_count(1)
    shows(page, "#landmarks tbody tr", "no rim")


def test_a_viewer_sees_landmarks_and_does_not_decide(review):
    page = review("viewer")
    page.get_by_role("button", name="Sightings of landmark").first.click()
    expect(page.locator("#decision-text")).to_have_text("proposed")
    for name in ("Accept", "Reject"):
        expect(page.get_by_role("button", name=name)).to_be_hidden()
    expect(page.get_by_label("Reason")).to_be_hidden()
    press(page, "Next")
    shows(page, "#range", "26 to ")
    answered(page)
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
