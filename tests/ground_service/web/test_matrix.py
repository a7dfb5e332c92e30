"""Every page with and without data: layout, barriers, keyboard; the campaign takes every width, scheme and font.

LINNA_PAGE_TABLE=FILE writes the results as the table of the documentation: `make page-table`.
"""

import itertools
import os
from pathlib import Path

import numpy as np
from pytest import fixture, mark, param

from ground_service.access.service import add_user
from ground_service.client import Client
from ground_service.evaluation.landmarks.service import update_landmarks
from ground_service.evaluation.service import make_report
from ground_service.ground import open_ground
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.passes.archive_import import import_archive
from ground_service.regression.archives import keep_archive
from ground_service.regression.builds import load_build, register_build
from ground_service.web.pages import DISPLAYS, PAGES
from lunar.catalogue import load_catalogue, save_catalogue
from lunar.timescales import format_utc
from tests.ground_service.conftest import SPACECRAFT, START, cells, enter_files
from tests.ground_service.web.conftest import COUNT_REQUESTS, patient
from tests.ground_service.web.test_in_browser import answered, settled
from tests.ground_service.web.test_shift import MISSION, Spacecraft
from tests.lazy import Lazy, expect
from tests.scenarios import GOLDEN
from tests.serving import ran, wait_for

FONTS = {"DejaVu": "DejaVu Sans", "Arial": "Liberation Sans"}
"""Fonts by the name in the table; Liberation Sans has the widths of Arial."""

EVERY_LOOK = tuple(itertools.product(("light", "dark"), FONTS, (1280, 768, 390)))
FEW_LOOKS = (
    ("light", "Arial", 1280), ("dark", "Arial", 768), ("light", "DejaVu", 390), ("dark", "Arial", 390),
)  # fmt: skip
"""Each scheme, font and width at least once; the last width is that of the keyboard."""

LOOKS = mark.parametrize("looks", [FEW_LOOKS, param(EVERY_LOOK, marks=mark.campaign)], ids=["few", "every"])
AXE_WIDTHS = (1280, 768, 390)
LONG_LOG = """() => {
  const feed = document.getElementById("feed");
  for (let k = 0; feed && k < 60; k++)
    feed.append(Object.assign(document.createElement("li"), {textContent: `line ${k}`}));
}"""
"""A log that is longer than its box, as after a long pass."""

COLUMNS = ("wider than the window", "axe", "console errors", "not reached by Tab", "without a focus mark")
SIGN_IN = "sign-in"
API_PAGE = "/docs"
"""Page of Swagger UI, which has tests of its own."""

PATHS = [page.path for page in PAGES if page is not DISPLAYS and page.path != API_PAGE]
DETAILS = ("/passes/{pass_id}", "/missions/{revision}")
MOST_STEPS = 400
NS = 1_000_000_000

USABLE = """() => {
    const usable = "a[href], button, input, select, textarea, summary, [role=button], [tabindex]";
    const shown = (one) => one.checkVisibility({visibilityProperty: true}) && !one.disabled && one.tabIndex >= 0;
    const place = document.querySelector("dialog[open]") ?? document;
    const all = [...place.querySelectorAll(usable)].filter(shown);
    window.linnaUsable = new Set(all.filter((one) => one.type !== "radio"));
    window.linnaVisited = new Set();
    window.linnaUnmarked = [];
    return linnaUsable.size;
}"""
# The focus is seen by an outline of the element or of its button, or by the edge of a bar of the timeline.
VISIT = """() => {
    const one = document.activeElement;
    if (one === document.body) return false;
    const again = linnaVisited.has(one);
    linnaVisited.add(one);
    const css = (each) => getComputedStyle(each);
    const outlined = (each) => each && css(each).outlineStyle !== "none" && parseFloat(css(each).outlineWidth) >= 1;
    const bar = one.querySelector(":scope > rect");
    const box = one.getBoundingClientRect();
    const inside = box.bottom > 0 && box.top < innerHeight && box.right > 0 && box.left < innerWidth;
    const marked = outlined(one) || outlined(one.closest(".button")) || (bar && parseFloat(css(bar).strokeWidth) >= 3);
    if (!again && !(marked && inside)) linnaUnmarked.push(one.outerHTML.slice(0, 120));
    return again;
}"""
MISSED = """() => [...linnaUsable].filter((one) => one.isConnected && !linnaVisited.has(one))
    .map((one) => one.outerHTML.slice(0, 120))"""
FRAMES_DRAWN = "() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(() => drawn())))"
# Width of the content; charts take the width of the window in the frame after the change.
WIDTH = "document.documentElement.scrollWidth"


@fixture(scope="module")
def empty_service(tmp_path_factory, console, serve):
    """A service without any data."""
    home = tmp_path_factory.mktemp("empty") / "home"
    home.mkdir()
    with serve(home, console.port) as running:
        yield running


class Worked:
    """A service with users and data, and the token of an administrator."""

    def __init__(self, service, token, paths):
        self.url = service.url
        self.token = token
        self.paths = paths


@fixture(scope="module")
def worked(tmp_path_factory, make_pass, make_flyable, make_build, console, serve):
    """A service with a pass received over TCP, a report, landmarks, a window, telecommands, an alarm and a build."""
    folder = tmp_path_factory.mktemp("worked")
    home = folder / "home"
    spacecraft = Spacecraft()
    received = make_pass(mission=GOLDEN)
    learned = make_pass(frames=24, seed=4)
    catalogue = load_catalogue(learned.folder / "catalogue.csv")
    save_catalogue(catalogue.select(np.arange(len(catalogue)) % 3 > 0), learned.folder / "catalogue.csv")
    flyable = make_flyable(frames=12, seed=61)
    build = make_build("good", {"synthetic pass 61": flyable.packets})
    ports = {"down": spacecraft.down.getsockname()[1], "up": spacecraft.up.getsockname()[1]}
    with open_ground(home) as ground:
        token = add_user(ground, "root", "admin")
        make_report(ground, import_archive(ground, received.folder))
        for name in "first pass", "second pass":
            enter_files(learned.folder, pass_name=name)
            update_landmarks(ground, import_archive(ground, learned.folder))
        mission = add_mission(ground, MISSION.format(**ports).encode(), actor="root")
        stored = ground.files.put_file(received.folder / "reference.oem")
        add_ephemeris(ground, stored, name="reference.oem", precedence=0, actor="root")
        keep_archive(ground, flyable.folder)
        register_build(ground, load_build(build.parent), actor="root")
    with serve(home, console.port) as running:
        with Client(running.url, token) as api:
            live = work(api, spacecraft, received.packets)
        revision = mission.revision[:16]
        yield Worked(
            running,
            token,
            {
                "/passes/{pass_id}": f"/passes/{live}",
                "/missions/{revision}": f"/missions/{revision}",
                "/comparison": f"/comparison?pass=1&pass={live}",
                "/telemetry": f"/telemetry?spacecraft={SPACECRAFT}+flight&packet=housekeeping",
                "/landmarks": "/landmarks",
            },
        )
    spacecraft.close()


def work(api, spacecraft, packets):
    """Receive a pass over TCP, and leave traces on every page; return the number of the pass."""
    spacecraft.replay(packets)
    spacecraft.report("event_high", event_id=20, frame_number=7)
    wait_for(lambda: api.list_alarms().total > 0, "no alarm was raised")
    live = api.define_pass("live pass", format_utc(START - 600 * NS), format_utc(START + 1200 * NS), SPACECRAFT).id
    window = api.add_window(
        {
            "name": "morning", "start": format_utc(START - 300 * NS), "stop": format_utc(START + 300 * NS),
            "spacecraft_id": SPACECRAFT,
        }
    ).id  # fmt: skip
    api.change_window(window, {"state": "approved"})
    api.uplink_window(window)
    api.send_link("madrid")
    api.make_report(live)
    return live


class Faults:
    """Faults of a page by kind, in the order of the columns of the table."""

    def __init__(self, page):
        self.console = []
        page.on("console", lambda one: self.console.append(one.text) if one.type == "error" else None)
        page.on("pageerror", lambda error: self.console.append(str(error)))
        self.layout = []
        self.barriers = []
        self.keyboard = []
        self.unmarked = []

    def find(self, page, looks):
        """Look at an opened page in some forms: scheme, font and width."""
        page.evaluate(LONG_LOG)
        for scheme, font, width in looks:
            page.emulate_media(color_scheme=scheme)
            page.evaluate("(one) => document.documentElement.style.setProperty('--sans', `\"${one}\"`)", FONTS[font])
            page.set_viewport_size({"width": width, "height": 844})
            page.evaluate(FRAMES_DRAWN)
            if (wide := page.evaluate(WIDTH)) > width:
                self.layout.append(f"{scheme}, {font}, {width} px: {wide} px wide")
            if font == "Arial" and width in AXE_WIDTHS:
                self.barriers += [f"{scheme}, {width} px: {one}" for one in barriers(page)]
        for width in (1280, 390) if looks == EVERY_LOOK else (390,):
            page.set_viewport_size({"width": width, "height": 844})
            self.tab_through(page, width)

    def tab_through(self, page, width):
        """Find what the Tab key does not reach, from the start of the page to its end, and what it does not mark."""
        count = page.evaluate(USABLE)
        page.evaluate("document.activeElement.blur()")
        for _ in range(min(count + 20, MOST_STEPS)):
            page.keyboard.press("Tab")
            if page.evaluate(VISIT):
                break
        self.keyboard += [f"{width} px: {one}" for one in page.evaluate(MISSED)]
        self.unmarked += [f"{width} px: {one}" for one in page.evaluate("linnaUnmarked")]

    def columns(self):
        """Return the faults by the name of their column."""
        found = (self.layout, self.barriers, self.console, self.keyboard, self.unmarked)
        return dict(zip(COLUMNS, found, strict=True))


def barriers(page):
    """Return the serious and critical findings of axe."""
    return [
        f"{one['id']} {[node['html'][:100] for node in one['nodes'][:2]]}"
        for one in Lazy("axe_playwright_python.sync_playwright").Axe().run(page).response["violations"]
        if one["impact"] in ("serious", "critical")
    ]


@fixture(scope="module")
def rows():
    """Rows of the table, written at the end where a file is named."""
    lines = []
    yield lines
    if file := os.environ.get("LINNA_PAGE_TABLE"):
        head = Path(file).read_text().split("| page |")[0]
        heading = f"| page | data | {' | '.join(COLUMNS)} |"
        Path(file).write_text("\n".join([f"{head}{heading}", "|---" * (2 + len(COLUMNS)) + "|", *lines, ""]))


def record(rows, path, state, found):
    """Add a row of the table, and fail if the page has faults."""
    columns = found.columns()
    counts = " | ".join(str(len(texts)) if texts else "none" for texts in columns.values())
    rows.append(f"| `{path}` | {state} | {counts} |")
    assert {kind: texts for kind, texts in columns.items() if texts} == {}


def look(context, rows, path, state, looks, address=None):
    """Open a page, and record its faults."""
    page = new_page(context)
    found = Faults(page)
    settled(page, address or path)
    answered(page)
    found.find(page, looks)
    page.close()
    record(rows, path, state, found)


def new_page(context):
    """Return a page that counts its requests."""
    page = context.new_page()
    page.add_init_script(COUNT_REQUESTS)
    return page


@fixture(scope="module")
def administrator(browser, worked):
    """The browser of somebody who is signed in."""
    context = patient(browser.new_context(base_url=worked.url, viewport={"width": 1280, "height": 844}))
    page = context.new_page()
    page.goto("/licences")
    page.get_by_label("Token").fill(worked.token)
    page.locator("dialog").get_by_role("button", name="Sign in").click()
    expect(page.locator("#user")).to_have_text("root, admin")
    page.close()
    yield context
    context.close()


@fixture(scope="module")
def newcomer(browser, empty_service):
    """The browser of somebody at a service without data."""
    context = patient(browser.new_context(base_url=empty_service.url, viewport={"width": 1280, "height": 844}))
    yield context
    context.close()


def test_the_fonts_of_the_matrix_are_installed():
    listed = ran(["fc-list", ":", "family"], check=True).stdout
    assert [family for family in FONTS.values() if family not in listed] == []


@LOOKS
@mark.parametrize("path", PATHS)
def test_a_page_with_data_has_no_fault(administrator, worked, rows, path, looks):
    look(administrator, rows, path, "with", looks, worked.paths.get(path))


NEEDED = """
/ | td button:has-text('Acknowledge')
/ | td a:has-text('Report')
/alarms | td button:has-text('Acknowledge')
/commands | td button:has-text('Send now')
/passes | #passes a:has-text('open')
/passes | #passes td.num
"""


@mark.parametrize("path, needed", cells(NEEDED))
def test_a_telephone_shows_what_a_shift_needs_without_scrolling_tables(administrator, path, needed):
    page = new_page(administrator)
    page.set_viewport_size({"width": 390, "height": 844})
    settled(page, path)
    answered(page)
    box = page.locator(needed).first.bounding_box()
    page.close()
    assert box is not None and box["x"] >= 0 and box["x"] + box["width"] <= 390


@LOOKS
@mark.parametrize("path", [path for path in PATHS if path not in DETAILS])
def test_a_page_without_data_has_no_fault(newcomer, rows, path, looks):
    look(newcomer, rows, path, "without", looks)


@LOOKS
def test_the_sign_in_has_no_fault(browser, worked, rows, looks):
    context = patient(browser.new_context(base_url=worked.url, viewport={"width": 1280, "height": 844}))
    page = new_page(context)
    page.goto("/")
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()
    answered(page)
    found = Faults(page)
    found.find(page, looks)
    context.close()
    record(rows, SIGN_IN, "with", found)
