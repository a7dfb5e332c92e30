"""Pages keep their state in the address, differ by role, and show what was flown, in Chromium."""

import re

from pytest import approx, fixture

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.passes.archive_import import import_archive
from ground_service.planning.model import WindowEntry
from ground_service.planning.service import add_window
from ground_service.regression.pass_archives import NO_INPUTS
from ground_service.web.pages import PAGES
from lunar.timescales import parse_utc
from tests.ground_service.web.conftest import COUNT_REQUESTS, Pictures, patient, press, shows, strict_page
from tests.ground_service.web.test_in_browser import answered, camera_fault, receive, settled
from tests.lazy import expect
from tests.serving import wait_for
from tmtc.downlink import encode_cadus

PATHS_OF_VIEWERS = [
    page.path.replace("{pass_id}", "1")
    for page in PAGES
    if not page.needs and "{revision}" not in page.path and page.path not in ("/mct", "/docs")
]
ORBITS = parse_utc("2030-01-01T00:00:00Z")


def test_the_navigation_of_a_telephone_is_one_button_until_it_is_opened(page):
    page.set_viewport_size({"width": 390, "height": 844})
    settled(page, "/planner")
    assert page.locator("header").bounding_box()["height"] < 100.0
    link = page.get_by_role("link", name="Payload")
    expect(link).to_be_hidden()
    page.get_by_role("button", name="Menu").press("Enter")
    link.click()
    expect(page).to_have_url(re.compile("/telemetry"))
    page.set_viewport_size({"width": 1280, "height": 844})
    expect(page.get_by_role("button", name="Menu")).to_be_hidden()
    expect(page.get_by_role("link", name="Plan", exact=True)).to_be_visible()


def test_zoom_and_charts_are_in_the_address(page):
    settled(page, "/telemetry")
    chart = page.locator(".chart").first
    expect(chart.locator("canvas")).to_be_visible()
    page.locator("#parameter").select_option("bus_voltage_v")
    page.locator("#chart").select_option("0")
    press(page, "Add")
    expect(page.get_by_label("chart: temperature and bus voltage")).to_be_visible()
    expect(page.locator(".chart")).to_have_count(1)
    scales = page.evaluate("document.querySelector('.chart').plot.series.map((one) => one.scale)")
    assert {"y", "second"} <= set(scales)
    page.locator(".chart").first.focus()
    page.keyboard.press("+")
    expect(page).to_have_url(re.compile("zoom="))
    wanted = page.evaluate("(({min, max}) => [min, max])(document.querySelector('.chart').plot.scales.x)")
    page.reload()
    expect(page.get_by_label("chart: temperature and bus voltage")).to_be_visible()
    found = page.evaluate("(({min, max}) => [min, max])(document.querySelector('.chart').plot.scales.x)")
    assert found == approx(wanted, abs=1.0)
    page.locator(".chart").first.focus()
    page.keyboard.press("0")
    expect(page).not_to_have_url(re.compile("zoom="))


def test_codes_are_steps_with_their_names_and_hashes_are_listed(page):
    settled(page, "/telemetry?chart=1:mode&chart=1:model_hash")
    expect(page.get_by_label("chart: mode")).to_be_visible()
    stepped = page.evaluate(
        """() => {
            const plot = document.querySelector(".chart").plot;
            const texts = plot.axes[1].values(plot, [0, 2]);
            return {texts, path: plot.series[1].paths.toString() === uPlot.paths.stepped({align: 1}).toString()};
        }"""
    )
    assert stepped["path"] and stepped["texts"][1] == "observing"
    listed = page.get_by_label("values: model hash")
    expect(listed.locator("code").first).to_have_text(re.compile("^[0-9a-f]{8}$"))
    expect(listed.locator("canvas")).to_have_count(0)


def test_events_of_all_passes_are_filtered_in_the_address(page):
    receive(page, [camera_fault(second) for second in range(900, 903)])
    settled(page, "/events?spacecraft=77+flight&name=camera")
    expect(page.locator("#events tbody tr").first).to_contain_text("camera fault")
    page.get_by_label("Severity").select_option("medium")
    expect(page).to_have_url(re.compile("severity=medium"))
    expect(page.locator("#events tbody tr").first).to_contain_text("high")
    page.get_by_label("Event contains").fill("nothing of the kind")
    press(page, "Show")
    shows(page, "#events", "No event matches.")


NOTE_ZOOMS = """
window.zooms = 0;
new MutationObserver(() => { window.zooms += document.querySelectorAll(".leaflet-zoom-anim").length; })
    .observe(document, { subtree: true, attributeFilter: ["class"] });
"""


def test_the_map_of_a_pass_shows_the_flown_terrain_and_tracks_that_differ(page):
    page.add_init_script(NOTE_ZOOMS)
    settled(page, "/passes/1")
    shows(page, "#terrain", "Terrain:")
    shows(page, "#terrain", "craters of the catalogue of the pass")
    expect(page.locator("#map-legend li")).to_have_count(2)
    expect(page.locator("#map")).to_have_class(re.compile("bare"))  # no picture of the Moon under other terrain
    expect(page.locator("#map img")).to_have_count(0)
    assert page.evaluate("window.zooms") == 0  # drawn at its scale at once, not blurred by an animation
    page.locator("#map-legend").get_by_label("spherical").uncheck()
    expect(page.locator("#map-legend").get_by_label("spherical")).not_to_be_checked()


def test_an_archive_without_frames_is_listed_with_its_reason_and_not_chosen(page):
    kept = "/api/v1/regression-archives"
    # The service keeps the archive of the imported pass, which has no images, some time after the start.
    wait_for(lambda: 1 in [one["pass_id"] for one in page.request.get(kept).json()], "the archive is not kept")
    settled(page, "/regression")
    row = page.locator("#archives label").filter(has=page.get_by_role("link", name="pass 1", exact=True))
    expect(row).to_contain_text(f"pass 1: telemetry only, {NO_INPUTS}")
    expect(row.locator("input")).to_be_enabled()
    expect(row.locator("input")).not_to_be_checked()


def test_passes_without_a_kept_archive_are_listed_with_what_to_do(browser, tmp_path, console, serve, synthetic_pass):
    home = tmp_path / "home"
    with open_ground(home) as ground:
        text = 'name = "manual"\n[spacecraft]\nid = 76\n[camera]\nfov_deg = 120.0\n[automation]\nevaluate = false\n'
        add_mission(ground, text.encode(), actor="ann")
        import_archive(ground, synthetic_pass.folder)
    with serve(home, console.port) as running:
        page = browser.new_page(base_url=running.url)
        settled(page, "/regression")
        row = page.locator("#archives label", has_text="synthetic pass").filter(has_text="pass 1,")
        expect(row).to_contain_text("no archive is kept; upload it below")
        expect(row.locator("input")).to_be_disabled()


@fixture(scope="module")
def guarded(tmp_path_factory, console, serve, synthetic_pass):
    """A service with a viewer and an operator, one pass and an alarm."""
    home = tmp_path_factory.mktemp("roles") / "home"
    faults = home.with_name("faults.cadu")
    faults.write_bytes(encode_cadus([camera_fault(second) for second in range(3)], spacecraft_id=77))
    with open_ground(home) as ground:
        tokens = {role: add_user(ground, role, role) for role in ("viewer", "operator")}
        import_archive(ground, synthetic_pass.folder)
        ingest_file(ground, faults)
    with serve(home, console.port) as running:
        yield running.url, tokens


@fixture
def signed_in(browser, guarded):
    """A page of a signed-in user: ``signed_in(role)``."""
    contexts = []

    def open_page(role):
        context = patient(browser.new_context(base_url=guarded[0]))
        contexts.append(context)
        headers = {"Content-Type": "application/json"}
        context.request.post("/api/v1/session", data={"token": guarded[1][role]}, headers=headers)
        page = context.new_page()
        page.add_init_script(COUNT_REQUESTS)
        return page

    yield open_page
    for one in contexts:
        one.close()


# Press the first button on which nothing was pressed yet, in one step, so that no redraw of the page comes between.
PRESS = """(pressed) => {
    const named = (one) => one.getAttribute("aria-label") ?? one.textContent.trim();
    const usable = (one) => one.checkVisibility({visibilityProperty: true}) && !one.disabled;
    const fit = (one) => usable(one) && !pressed.includes(named(one));
    const found = [...document.querySelectorAll("main button, main [role=button]")].find(fit);
    if (!found) return null;
    if (found.click) found.click();
    else found.dispatchEvent(new MouseEvent("click", {bubbles: true}));
    return named(found);
}"""
MOST_BUTTONS = 12


def test_no_button_that_a_viewer_sees_is_refused(signed_in):
    operator = signed_in("operator")
    operator.goto("/")
    window = {"name": "draft", "start": "2029-08-07T07:00:00Z", "stop": "2029-08-07T07:20:00Z"}
    for path, body in (
        ("windows", {**window, "spacecraft_id": 76}),
        ("telecommands", {"name": "test_connection", "spacecraft_id": 76}),
    ):
        made = operator.evaluate(
            """async ([path, body]) => (await fetch(`/api/v1/${path}`, {method: "POST", body: JSON.stringify(body),
            headers: {"Content-Type": "application/json"}})).status""",
            [path, body],
        )
        assert made == 201, path
    page = signed_in("viewer")
    total = 0
    for path in PATHS_OF_VIEWERS:
        settled(page, path)
        expect(page.locator("#user")).to_have_text("viewer, viewer")
        answered(page)
        pressed = []
        while len(pressed) < MOST_BUTTONS and (name := page.evaluate(PRESS, pressed)) is not None:
            pressed.append(name)
            answered(page)
        assert page.evaluate("window.refused") == [], (path, pressed)
        total += len(pressed)
    assert total > 20
    page.goto("/status")
    expect(page.locator("#user")).to_have_text("viewer, viewer")
    expect(page.get_by_role("link", name="Licences")).to_be_visible()
    expect(page.get_by_role("link", name="Audit")).to_be_hidden()
    expect(page.get_by_role("link", name="Users")).to_be_hidden()
    page.goto("/users")
    shows(page, "main", "Only administrators manage users.")
    expect(page.get_by_role("button", name="Add user")).to_be_hidden()
    page.goto("/commands")
    expect(page.get_by_role("heading", name="Enter")).to_be_hidden()


def home_with_orbits(home, orbits, more=""):
    """Make the home of a service with a mission description and an ephemeris."""
    with open_ground(home) as ground:
        text = f'name = "camera"\n[spacecraft]\nid = 76\n[camera]\nfov_deg = 120.0\n{more}'
        add_mission(ground, text.encode(), actor="ann")
        add_ephemeris(ground, ground.files.put_file(orbits), name="orbits", precedence=0, actor="ann")


def test_the_planner_opens_in_the_time_of_the_ephemeris_and_searches_for_its_spacecraft(
    browser, tmp_path, console, serve, day_of_orbits
):
    home = tmp_path / "home"
    home_with_orbits(home, day_of_orbits)
    with serve(home, console.port) as running:
        page = browser.new_page(base_url=running.url, viewport={"width": 390, "height": 844})
        page.goto("/planner")
        shows(page, "#timeline", "01-01")
        expect(page.locator("#from")).to_have_attribute("placeholder", "2030-01-01T00:00:00Z")
        shows(page, "#daylight", "Sun above the horizon")
        page.locator("#latitude-min").fill("-90")
        page.locator("#latitude-max").fill("90")
        press(page, "Search")
        rows = page.locator("#candidates tbody tr")
        expect(rows.first).to_be_visible()
        for row in range(rows.count()):
            least = rows.nth(row).locator("td").nth(4).inner_text().split(" to ")[0]
            assert float(least) >= -0.5, least  # degrees, rounded
        Pictures(tmp_path).take(page, "planner-telephone")
        press(page, "Closer")
        expect(page).to_have_url(re.compile("view=2030-01-01"))
        expect(page).to_have_url(re.compile("latitude-min=-90"))
        page.reload()
        expect(page.locator("#latitude-min")).to_have_value("-90")


@fixture
def planner(browser, tmp_path, console, serve, day_of_orbits):
    """The planner of a spacecraft with an ephemeris of six hours, a small battery and two drafts."""
    home = tmp_path / "home"
    battery = "[resources]\nbattery_wh = 100.0\ngeneration_w = 0.0\nidle_w = 6.0\nobserving_w = 60.0\n"
    home_with_orbits(home, day_of_orbits, battery)
    with open_ground(home) as ground:
        for name, minute in ("first", 60), ("second", 90):
            start = ORBITS + minute * 60 * 10**9
            add_window(ground, WindowEntry(name, start, start + 1200 * 10**9, 15.0, 76), actor="ann")
    with serve(home, console.port) as running, strict_page(browser, running.url, strict=False) as page:
        page.goto("/planner")
        expect(page.locator("#timeline .curve")).to_have_count(3)
        answered(page)
        yield page


def times(page, key):
    """Start and stop of a window in minutes after the start of the ephemeris."""
    found = page.request.get(f"/api/v1/windows/{key}").json()
    return tuple((parse_utc(found[end]) - ORBITS) / 60e9 for end in ("start", "stop"))


def test_the_planner_shows_sun_and_resources_of_the_plan(planner):
    page = planner
    span = {"spacecraft_id": 76, "start": "2030-01-01T00:30:00Z", "stop": "2030-01-01T02:30:00Z"}
    found = page.request.get("/api/v1/plan/forecast", params=span).json()
    page.goto(f"/planner?view={span['start']}~{span['stop']}")
    expect(page.locator("#timeline .curve")).to_have_count(3)
    day = sum(one >= 0 for one in found["sun_elevation_deg"]) / len(found["time_s"])
    label = page.locator("#timeline .sun").get_attribute("aria-label")
    night = re.search(r"night (\d+) %", label)
    assert int(night[1] if night else 0) == approx(100 * (1 - day), abs=0.51), label
    battery = page.locator("#timeline .curve.battery").get_attribute("aria-label")
    least, most = (100 * limit(found["battery_share"]) for limit in (min, max))
    assert battery == f"battery: {least:.3g} to {most:.3g} %, at least 30"
    slider = page.get_by_label("Time", exact=True)
    slider.press("Home")
    shows(page, "#values", "2030-01-01 00:30:00: Sun elevation")
    slider.press("ArrowRight")
    shows(page, "#values", "2030-01-01 00:30:07")
    expect(page.locator("#bands li")).to_have_count(5)
    expect(page.locator("#map canvas")).to_be_visible()
    shows(page, "#map-text", "No crater density: ")


def test_a_draft_is_moved_and_resized_by_keys_by_the_form_and_with_the_pointer(planner):
    page = planner
    bar = page.locator('#timeline [data-window="1"]')
    bar.press("ArrowRight")
    wait_for(lambda: times(page, 1) == (61.0, 81.0), "not moved")
    for key, expected in ("ArrowDown", (61.0, 80.0)), ("]", (62.0, 80.0)), ("Shift+ArrowUp", (62.0, 80.0 + 1 / 6)):
        answered(page)
        bar.press(key)
        wait_for(lambda expected=expected: times(page, 1) == approx(expected), key)
    answered(page)
    page.locator("#selected").get_by_label("Stop, UTC").fill("2030-01-01T01:15:00Z")
    page.locator("#selected").get_by_role("button", name="Change").click()
    wait_for(lambda: times(page, 1) == (62.0, 75.0), "not changed by the form")
    answered(page)
    # In one step, and again while there is none: an update of the page replaces the bar.
    page.evaluate("document.querySelector('#timeline [data-window=\"1\"]').scrollIntoView()")
    boxes = [None]
    wait_for(lambda: boxes.append(bar.locator("rect").bounding_box()) or boxes[-1] is not None, "no bar")
    box = boxes[-1]
    page.mouse.move(box["x"] + 3, box["y"] + 5)  # the start
    page.mouse.down()
    page.mouse.move(box["x"] + 3 - box["width"] / 2, box["y"] + 5, steps=4)
    shown = bar.locator("rect").bounding_box()
    assert shown["width"] == approx(1.5 * box["width"], rel=0.02)
    page.mouse.up()
    wait_for(lambda: times(page, 1)[0] < 60.0, "not resized with the pointer")
    start, stop = times(page, 1)
    assert stop == 75.0 and start == approx(62.0 - 13.0 / 2, abs=0.3)


def test_times_being_typed_survive_an_update_of_the_planner(planner):
    page = planner
    bar = page.locator('#timeline [data-window="1"]')
    bar.press(" ")
    expect(bar).to_be_focused()
    field = page.locator("#selected").get_by_label("Start, UTC")
    field.fill("2030-01-01T01:05:00Z")
    assert page.request.patch("/api/v1/windows/2", data={"state": "approved"}).ok
    expect(page.locator("#windows tbody tr", has_text="second")).to_contain_text("approved")
    answered(page)
    expect(field).to_have_value("2030-01-01T01:05:00Z")
    expect(field).to_be_focused()
    field.press("Enter")
    wait_for(lambda: times(page, 1) == (65.0, 80.0), "not changed by the form")
    answered(page)
    expect(field).to_be_focused()
    # A change that another operator made replaces what is shown.
    assert page.request.patch("/api/v1/windows/1", data={"start": "2030-01-01T01:00:00Z"}).ok
    expect(field).to_have_value("2030-01-01T01:00:00Z")


def test_conflicts_and_refused_changes_are_explained_on_the_planner(planner):
    page = planner
    for _ in range(11):  # into the time of the second
        page.locator('#timeline [data-window="1"]').press("ArrowRight")
        answered(page)
    expect(page.locator('#timeline [data-window="1"]')).to_have_class(re.compile("conflict"))
    shows(page, "#selected .conflicts", "window 2 (second, draft) covers part")
    path = "/api/v1/windows/2"
    assert page.request.patch(path, data={"state": "approved"}).ok
    page.locator('#timeline [data-window="1"]').press("ArrowRight")
    expect(page.locator("#selected .conflicts").first).to_contain_text(
        "window 2 (approved) covers part of the same time"
    )
    expect(page.locator("#selected .conflicts").first).to_contain_text("Not changed to 2030-01-01 01:12:00")
    page.locator("#search").get_by_role("button", name="Search").click()
    page.locator("#rejected summary").click()
    expect(page.locator("#rejected tbody tr").first).to_contain_text("too short")
    expect(page.locator("#timeline .rejected").first).to_be_attached()
