"""Actions of operators on the pages, in Chromium, also with the keyboard while the pages change."""

import re
import time
from shutil import make_archive

from ground_service.regression.archives import pack_archive
from tests.ground_service.regression.test_regressions import with_detections
from tests.ground_service.web.conftest import press, shows
from tests.lazy import expect
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus


def newest_revision(page):
    return page.request.get("/api/v1/missions").json()["items"][0]["revision"]


def packet(name, second, **values):
    zeros = {field.name: 0 for field in DICTIONARY.packet(name).fields}
    ticks = (900_000_000 + second) * 65_536
    return DICTIONARY.pack(name, zeros | values, ticks=ticks, sequence_count=second)


def camera_fault(second):
    return packet("event_high", second, event_id=20, frame_number=second)


def housekeeping(second, temperature_c):
    return packet("housekeeping", second, structure_id=1, bus_voltage_v=12.0, temperature_c=temperature_c)


def receive(page, packets, spacecraft_id=77):
    """Upload packets as a downlink of a spacecraft."""
    answer = page.request.post(
        f"/api/v1/telemetry?name={hash(tuple(packets)) & 0xFFFF}.cadu",
        data=encode_cadus(packets, spacecraft_id=spacecraft_id),
        headers={"Content-Type": "application/octet-stream"},
    )
    job = answer.json()["job_id"]
    while page.request.get(f"/api/v1/jobs/{job}").json()["state"] != "done":
        time.sleep(0.05)


def colour_of(page, variable):
    """The computed colour of a variable of the style sheet."""
    return page.evaluate(
        """variable => {
            const probe = document.createElement("span");
            document.body.append(probe);
            probe.style.color = `var(${variable})`;
            const found = getComputedStyle(probe).color;
            probe.remove();
            return found;
        }""",
        variable,
    )


def settled(page, path):
    if "{revision}" in path:
        path = path.format(revision=newest_revision(page)[:16])
    page.goto(path)
    expect(page.locator("#feed-light")).to_have_class("light on")


def answered(page):
    """Wait until no script of the page waits for an answer."""
    wait_for(lambda: page.evaluate("window.underWay === 0"), "requests are not answered")


def test_a_pass_is_exported_with_a_button(page):
    settled(page, "/passes/1")
    with page.expect_download() as started:
        page.get_by_role("button", name="oem", exact=True).click()
    assert started.value.suggested_filename == "pass-1.oem"
    with open(started.value.path()) as file:
        assert file.readline() == "CCSDS_OEM_VERS = 2.0\n"


def test_a_telephone_scrolls_wide_tables_rather_than_break_words(page):
    page.set_viewport_size({"width": 390, "height": 844})
    for path in "/missions", "/missions/{revision}", "/audit":
        settled(page, path)
        expect(page.locator("tbody tr:visible").first).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, path
    settled(page, "/missions")
    cell = page.locator("#items tbody td").first
    assert cell.locator("a").bounding_box()["height"] < 30.0  # one line


def test_marks_of_a_legend_stay_with_their_text_on_a_telephone(page):
    page.set_viewport_size({"width": 390, "height": 844})
    for path in "/commands", "/live":
        settled(page, path)
        loose, heights = page.evaluate(
            """() => {
                const [legend] = document.querySelectorAll(".legend:has(.light, .key)");
                const loose = [...legend.childNodes].filter((one) => one.nodeType === 3 && one.textContent.trim());
                return [loose.length, [...legend.children].map((one) => one.getBoundingClientRect().height)];
            }"""
        )
        assert loose == 0 and len(heights) == 3 and max(heights) < 30.0, path


def pixels_of(page, colour):
    """Number of pixels of the first chart that have a colour, "#rrggbb"."""
    return page.evaluate(
        """colour => {
            const canvas = document.querySelector(".chart canvas");
            const found = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
            const [red, green, blue] = [1, 3, 5].map((start) => parseInt(colour.slice(start, start + 2), 16));
            let count = 0;
            for (let at = 0; at < found.length; at += 4)
                count += found[at] === red && found[at + 1] === green && found[at + 2] === blue;
            return count;
        }""",
        colour,
    )


def test_the_grid_of_a_chart_follows_a_change_of_the_colours(page):
    light, dark = "#e3e7ec", "#2c343e"  # --grid
    settled(page, "/passes/1")
    answered(page)
    expect(page.locator(".chart canvas").first).to_be_visible()
    wait_for(lambda: pixels_of(page, light) > 500, "the grid is not drawn")
    assert pixels_of(page, dark) == 0
    page.emulate_media(color_scheme="dark")
    wait_for(lambda: pixels_of(page, dark) > 500, "the grid has the colour of the light scheme")
    assert pixels_of(page, light) == 0
    page.emulate_media(color_scheme="light")


def test_small_figures_have_a_power_of_ten_and_zero_has_none_and_long_times_have_days(page):
    page.goto("/licences")
    found = page.evaluate(
        """async () => {
            const { element, figure, lengthText } = await import("/static/page.js");
            const lengths = [59, 3600 * 47 + 60, 3600 * 49];
            const title = element("h1", {}, "selenita-2029-08-18T08:17:55Z").querySelector(".keep").textContent;
            const figures = [0, 4.51e-11, -2e-5, 0.00012, 0.5, 1544].map((value) => figure(value));
            return [figures, lengths.map(lengthText), title];
        }"""
    )
    figures = ["0", "4.51 × 10⁻¹¹", "-2 × 10⁻⁵", "0.00012", "0.5", "1\u00a0544"]
    assert found == [figures, ["59 s", "47 h 1 min", "2 d 1 h"], "2029-08-18T08:17"]


def test_a_slow_answer_is_not_shown_over_a_newer_one(page):
    page.goto("/licences")
    found = page.evaluate(
        """async () => {
            const { inTurn } = await import("/static/page.js");
            const waits = [60, 0, 0];
            const shown = [];
            let asked = "first";
            const load = inTurn(async () => {
                const answer = asked;
                await new Promise((resolve) => setTimeout(resolve, waits[shown.length]));
                shown.push(answer);
                if (shown.length === 1) throw new Error("no connection");
            });
            const first = load().catch((error) => shown.push(error.message));
            await Promise.resolve();
            asked = "second";
            const second = load();
            asked = "third";
            await Promise.all([first, second, load()]);
            return shown;
        }"""
    )
    assert found == ["first", "no connection", "third"]


def test_the_pass_page_shows_what_came_and_makes_a_report(page):
    settled(page, "/passes")
    page.get_by_role("link", name="synthetic pass").click()
    expect(page.get_by_role("heading", name="synthetic pass")).to_be_visible()
    shows(page, "#completeness", "0 lost")
    expect(page.locator("#mission").get_by_role("link")).to_contain_text("synthetic, revision")
    expect(page.get_by_label("chart: altitude, m")).to_be_visible()
    shows(page, "#map-legend", "spherical")
    press(page, "Make a report")
    expect(page.locator("#verdict .verdict")).not_to_be_empty()
    shows(page, "#verdict", "Median position error")
    with page.expect_popup() as opened:
        page.get_by_role("link", name="Open report").click()
    report = opened.value
    expect(report.get_by_role("heading", level=1)).to_be_visible()
    assert re.search(r"/reports/[0-9a-f]{32}$", report.url)
    # With its styles and figures: not the defaults of the browser, and no black shapes.
    assert report.evaluate("getComputedStyle(document.body).marginTop") == "0px"
    assert report.evaluate("document.styleSheets.length") >= 1
    line = report.locator("svg path[style*='fill: none']").first
    assert line.evaluate("node => getComputedStyle(node).fill") == "none"


def test_an_alarm_is_acknowledged_on_its_page_and_keeps_its_history(page):
    receive(page, [camera_fault(second) for second in range(3)])
    settled(page, "/alarms?state=open")
    row = page.locator("#alarms tbody tr", has_text="camera fault").filter(has_text="77, flight")
    expect(row.locator(".state.raised")).to_have_css("border-top-color", colour_of(page, "--vermillion"))
    row.get_by_role("checkbox").check()
    receive(page, [camera_fault(0)], spacecraft_id=78)
    shows(page, "#alarms", "78, flight")  # drawn again
    expect(row.get_by_role("checkbox")).to_be_checked()
    press(page, "Acknowledge the chosen")
    expect(row).to_have_count(0)
    page.get_by_label("State").select_option("cleared")
    expect(page).to_have_url(re.compile("state=cleared"))
    row.get_by_role("button", name="Detail").click()
    shows(page, "#detail", "3 packets from")
    shows(page, "#history", "acknowledged")


MISSION = """name = "shown"

[spacecraft]
id = 76

[frames]
orientation = "DE421"

[requirements]
estimator = "anchored"
median_error_m = 100.0

[approval]
windows = "manual"
second_person_for = ["perform_function/set_mode"]
"""


def test_a_mission_description_is_shown_and_changed_on_its_page(page):
    entered = page.request.post("/api/v1/missions", data=MISSION, headers={"Content-Type": "text/plain"})
    assert entered.status == 201
    settled(page, "/missions")
    row = page.locator("#items tbody tr").first
    expect(row).to_contain_text("shown")
    expect(row).to_contain_text(entered.json()["revision"][:12])
    shows(page, "#range", "1 to 2 of 2")
    row.get_by_role("link", name="shown").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("shown")
    sections = page.locator("#sections")
    expect(sections.locator("tr", has_text="median error, m")).to_contain_text("100")
    expect(sections.locator("tr", has_text="recall")).to_contain_text("not stated")
    sections.locator("summary", has_text="approval").click()
    expect(sections.locator("tr", has_text="second person for")).to_contain_text("perform_function/set_mode")
    shows(page, "#unknown", "camera.width_px")
    editor = page.get_by_label("mission.toml")
    text = editor.input_value()
    enter = page.get_by_role("button", name="Enter as a revision")
    expect(enter).to_be_disabled()
    editor.fill(text.replace("median_error_m", "medain_error_m"))
    shows(page, "#faults", "expected 'median_error_m', found unknown key")
    editor.fill(text.replace("median_error_m = 100.0", "median_error_m = 80.0"))
    shows(page, "#faults", "+median_error_m = 80.0")
    enter.click()
    shows(page, "#confirm-text", "-median_error_m = 100.0")
    page.get_by_role("button", name="Enter", exact=True).click()
    expect(sections.locator("tr", has_text="median error, m")).to_contain_text("80")
    page.goto("/missions/new")
    editor.fill('name = "')
    shows(page, "#faults", "mission.toml: expected TOML")


def test_links_and_stations_are_forms_over_the_text_and_the_planner_makes_a_dry_run(page):
    page.goto("/missions/new")
    editor, part = page.get_by_label("mission.toml"), page.locator("#part")
    editor.fill(f"{MISSION}[link.stations.here] # the mast\nlatitude_deg = 10.0\nlongitude_deg = 60.0\n")
    press(page, "Change station here")
    part.get_by_label("Longitude, °").fill("")
    part.get_by_label("Latitude, °").fill("-10.5")
    part.get_by_role("button", name="Write into the text").click()
    shows(page, "#faults", "latitude_deg and longitude_deg together")
    assert editor.input_value().endswith("[link.stations.here] # the mast\nlatitude_deg = -10.5\n")
    press(page, "Change station here")
    part.get_by_label("Longitude, °").fill("61")
    part.get_by_label("Name").fill("New here")
    part.get_by_role("button", name="Write into the text").click()
    press(page, "Add a link")
    part.get_by_label("Name").fill("mast")
    part.get_by_label("Kind").select_option("tcp")
    part.get_by_label("Station").select_option("New here")
    part.get_by_label("Uplink").fill("127.0.0.1:9")
    part.get_by_role("button", name="Write into the text").click()
    shows(page, "#faults", '+[link.stations."New here"]')
    assert editor.input_value().endswith(
        '[link.stations."New here"]\nlatitude_deg = -10.5\nlongitude_deg = 61\n\n[[links]]\nname = "mast"\n'
        'kind = "tcp"\nstation = "New here"\nuplink = "127.0.0.1:9"\n'
    )
    flight = page.locator("#flight")
    press(page, "Dry run")
    expect(flight).to_contain_text("1 window, nothing contradicts the flight")
    expect(flight.locator("tbody tr")).to_contain_text("2029-08-07 06:")
    press(page, "Remove link mast")
    assert "[[links]]" not in editor.input_value()
    shows(page, "#links", "None stated.")
    press(page, "Dry run")
    expect(flight).to_contain_text("1 window, and what contradicts the flight")
    expect(flight).to_contain_text("found no link with an uplink")


def test_a_list_has_the_columns_and_filters_of_its_operation(page):
    settled(page, "/ephemerides")
    document = page.request.get("/api/v1/openapi.json").json()
    fields = document["components"]["schemas"]["Ephemeris"]["properties"]
    expect(page.locator("#items thead th")).to_have_count(len(fields))
    expect(page.locator("#items tbody tr").first).to_contain_text("reference of")
    settled(page, "/audit")
    rows = page.locator("#items tbody tr")
    expect(rows.first).to_be_visible()
    page.get_by_label("Action").fill("nothing of the kind")
    press(page, "Show")
    expect(page.locator("#items")).to_have_text("No entry.")
    page.reload()
    expect(page.get_by_label("Action")).to_have_value("nothing of the kind")
    expect(page.locator("#items")).to_have_text("No entry.")


def test_a_received_file_is_withdrawn_on_its_page(page):
    receive(page, [camera_fault(5000)])
    newest = page.request.get("/api/v1/ingests").json()["items"][0]["id"]
    settled(page, "/ingests")
    page.get_by_role("button", name=f"Withdraw ingest {newest}").click()
    page.get_by_role("dialog").get_by_label("Reason").fill("another flight")
    page.get_by_role("dialog").get_by_role("button", name="Withdraw").click()
    wait_for(lambda: page.request.get(f"/api/v1/ingests/{newest}").json()["state"] == "withdrawn", "the withdrawal")
    entry = page.request.get("/api/v1/audit?action=withdraw%20ingest").json()["items"][0]
    assert entry["detail"]["reason"] == "another flight"


def test_arguments_have_names_units_and_ranges(page):
    settled(page, "/commands")
    page.locator("#name").select_option("perform_function")
    page.locator("#argument-function_id").select_option("start_observation")
    expect(page.get_by_label("duration, s (0 to 31 622 400)")).to_be_visible()
    page.get_by_label("duration, s").fill("900")
    page.get_by_label("cadence, s").fill("15")
    press(page, "Queue")
    row = page.locator("#commands tbody tr").first
    expect(row).to_contain_text("function start observation, duration 900 s, cadence 15 s")
    expect(row).to_contain_text("queued")
    row.get_by_role("button", name="Release").click()
    expect(row).to_contain_text("released")
    expect(row.get_by_role("img", name="no report yet")).to_be_visible()
    settled(page, "/audit?action=enter+telecommand")
    expect(page.locator("#items tbody tr").first).to_contain_text(
        "arguments function start observation, duration 900 s"
    )
    settled(page, "/commands")
    page.locator("#name").select_option("set_parameter")
    page.locator("#argument-parameter_id").select_option("temperature_high_c")
    value = page.get_by_label("value, degC (20 to 100)")
    expect(value).to_have_value("60")
    value.fill("101")
    press(page, "Queue")
    assert not value.evaluate("input => input.validity.valid")


def test_a_telecommand_that_the_dictionary_refuses_is_reported(page):
    settled(page, "/commands")
    page.locator("#name").select_option("insert_activity")
    page.locator("#argument-items").fill("300\n4")
    press(page, "Queue")
    expect(page.locator("#notices .bad")).to_be_visible()


def _draft(page, name, hour):
    times = {"start": f"2030-01-01T{hour}:00:00Z", "stop": f"2030-01-01T{hour}:20:00Z"}
    page.request.post("/api/v1/windows", data=times | {"name": name, "spacecraft_id": 76})


def test_a_window_is_found_moved_approved_and_uplinked(page, day_of_orbits):
    settled(page, "/")
    page.get_by_text("Upload a downlink or an ephemeris").click()
    page.locator("#file").set_input_files(day_of_orbits)
    page.locator("#kind").select_option("ephemerides")
    press(page, "Upload")
    shows(page, "#notices", "361 states")

    settled(page, "/planner")
    page.locator("#ephemeris").select_option(label="orbits.oem, 2030-01-01 00:00:00")
    press(page, "Search")
    expect(page.locator("#candidates tbody tr").first).to_be_visible()
    page.locator("#candidates").get_by_role("button", name="Plan").nth(1).click()
    bar = page.locator("#timeline .window.draft")
    expect(bar).to_have_count(1)
    start = page.locator("#windows tbody td").nth(1).inner_text()
    bar.focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#windows tbody td").nth(1)).not_to_have_text(start)

    press(page, "Approve")
    expect(page.get_by_role("dialog")).to_contain_text("an image every 15 s")
    shows(page, "#selected", "draft")
    page.get_by_role("dialog").get_by_role("button", name="Approve").click()
    shows(page, "#selected", "approved")
    press(page, "Uplink")
    question = page.get_by_role("dialog", name=re.compile("^Release the telecommands of"))
    expect(question).to_contain_text("on reception")
    expect(question).to_contain_text("function start observation, duration")
    question.get_by_role("button", name="Release").click()
    shows(page, "#notices", "telecommands released")
    expect(page.get_by_role("button", name="Send now")).to_be_visible()
    expect(page.get_by_role("button", name="Uplink")).to_be_hidden()

    page.locator("#altitude-max").fill("10")
    press(page, "Search")
    shows(page, "#candidates", "excluded by altitude at most 10 km")
    page.get_by_text("Enter a window").click()
    page.locator("#enter-name").fill("by hand")
    page.locator("#enter-start").fill("2030-01-01T05:00:00Z")
    page.locator("#enter-stop").fill("2030-01-01T05:10:00Z")
    page.get_by_role("button", name="Enter", exact=True).click()
    shows(page, "#selected", "2030-01-01 05:10:00")
    press(page, "Telecommands")
    sequence = page.get_by_role("table", name="Telecommands of the window").locator("tbody tr")
    expect(sequence.last).to_contain_text("2030-01-01 05:10:00")
    _draft(page, "of another user", "04")
    shows(page, "#windows", "of another user")
    expect(sequence.last).to_contain_text("2030-01-01 05:10:00")
    settled(page, "/commands")
    expect(page.locator("#commands tbody tr", has_text="insert activity").first).to_contain_text("released")
    approved = page.request.get("/api/v1/windows?state=approved").json()["items"]
    settled(page, f"/planner?window={approved[0]['id']}")
    press(page, "Take back")
    page.get_by_role("dialog").get_by_role("button", name="Take back").click()
    shows(page, "#selected", "failed")


def test_a_draft_is_dragged_and_taken_off_the_plan(page, day_of_orbits):
    settled(page, "/planner")
    _draft(page, "to be moved", "03")
    bar = page.get_by_role("button", name="to be moved, draft")
    expect(bar).to_be_visible()
    before = bar.get_attribute("aria-label")
    answered(page)
    box = None
    while box is None:  # the timeline is drawn again after each message
        box = bar.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 60, box["y"] + box["height"] / 2, steps=4)
    page.mouse.up()
    expect(page.get_by_role("button", name=before, exact=True)).to_have_count(0)
    press(page, "to be moved, draft")
    press(page, "Delete")
    expect(page.get_by_role("button", name="to be moved, draft")).to_have_count(0)


def test_a_live_payload_is_watched_and_steered(page, console, live_frames):
    settled(page, "/live")
    expect(page.locator("#state")).to_have_text("connected")
    for message in live_frames:
        console.say(message)
    shows(page, "#numbers", "fixed, error 84 m")
    shows(page, "#log", "medium: image dark: mean grey level 1")
    expect(page.get_by_label("chart: distance from the reference, m")).to_be_visible()
    grey = page.evaluate(
        "Array.from(document.getElementById('frame').getContext('2d').getImageData(300, 300, 1, 1).data).slice(0, 3)"
    )
    assert grey == [24, 24, 24]  # the last frame's level
    console.received.clear()
    press(page, "Pause")
    press(page, "Step")
    page.get_by_label("Rate").select_option("60")
    wait_for(lambda: len(console.received) >= 3, f"received no more than {console.received}")
    assert console.received == ["pause", "step", "rate 60"]


def test_words_that_could_do_harm_do_not_reach_the_payload(page, console):
    settled(page, "/live")
    expect(page.locator("#state")).to_have_text("connected")
    console.received.clear()
    answer = page.evaluate(
        """() => new Promise((resolve) => {
          const socket = new WebSocket(`ws://${location.host}/api/v1/payload`);
          socket.onopen = () => ["quit", "run\\nquit", "rate -1", "x".repeat(3000)].forEach((one) => socket.send(one));
          const received = [];
          socket.onmessage = (event) => {
            const message = JSON.parse(event.data);
            if (message.kind === "error") received.push(message);
            if (received.length === 4) resolve(received);
          };
        })"""
    )
    assert [one["kind"] for one in answer] == ["error"] * 4
    assert console.received == []


KEYBOARD = 79
"""Not that of other tests of this service."""

FOCUSED = """() => {
    const one = document.activeElement;
    const row = one.closest("[data-row]");
    return [row?.dataset.row ?? "", one === row ? "row" : one.id || one.textContent.trim()];
}"""


def focused(page):
    """Return the row of the focused element, and its identifier or text."""
    row, name = page.evaluate(FOCUSED)
    return row, name


def queue(page):
    """Enter a telecommand; return its number."""
    answer = page.request.post("/api/v1/telecommands", data={"name": "test_connection", "spacecraft_id": KEYBOARD})
    return str(answer.json()["id"])


def test_the_focus_stays_on_a_button_when_rows_are_added_above_it(page):
    settled(page, "/commands")
    before, first = queue(page), queue(page)
    row = page.locator(f'#commands tr[data-row="{first}"]')
    row.get_by_role("button", name="Release").focus()
    second = queue(page)
    expect(page.locator(f'#commands tr[data-row="{second}"]')).to_be_visible()
    assert focused(page) == (first, "Release")
    page.keyboard.press("Enter")
    expect(row).to_contain_text("released")
    answered(page)
    # The button is gone, and no other one is under the finger.
    wait_for(lambda: focused(page) == (first, "row"), "the focus is not in the row")
    page.keyboard.press("Shift+Tab")
    assert focused(page) == (second, "Reject")
    page.keyboard.press("Tab")
    assert focused(page) == (before, "Release")


def test_an_alarm_that_is_acknowledged_leaves_the_focus_in_the_table(page):
    receive(page, [camera_fault(3000)], KEYBOARD)
    settled(page, "/alarms")
    row = page.locator("#alarms tbody tr", has_text=f"{KEYBOARD}, flight")
    row.get_by_role("button", name="Acknowledge").press("Enter")
    expect(row).to_have_count(0)  # its condition had ended
    answered(page)
    assert page.evaluate("document.activeElement.id") == "alarms"


def test_the_last_page_of_a_list_leaves_the_focus_at_the_pager(page):
    for _ in range(26):
        queue(page)
    settled(page, "/commands")
    older, newer = (page.get_by_role("button", name=name) for name in ("Older", "Newer"))
    expect(older).to_be_enabled()
    older.focus()
    while older.is_enabled():
        shown = page.locator("#range").inner_text()
        older.press("Enter")
        expect(page.locator("#range")).not_to_have_text(shown)
        answered(page)
    expect(newer).to_be_focused()


def test_a_table_keeps_focus_and_scroll_position_while_values_arrive(page):
    receive(page, [housekeeping(3000, 21.5)], KEYBOARD)
    page.set_viewport_size({"width": 390, "height": 844})
    settled(page, f"/telemetry?spacecraft={KEYBOARD}+flight&packet=housekeeping")
    row = page.locator("#live tr", has_text="temperature")
    expect(row).to_contain_text("21.5 °C")
    expect(row).to_contain_text("within")
    expect(page.get_by_role("row", name="mode safe")).to_be_visible()
    place = page.get_by_role("group", name="Newest values")
    place.focus()
    place.evaluate("(one) => one.scrollTo(60, 0)")
    receive(page, [housekeeping(3005, 70.25)], KEYBOARD)
    expect(row).to_contain_text("70.25 °C")
    expect(row.locator(".state.warning")).to_have_css("color", colour_of(page, "--caution"))
    expect(row.locator("svg.spark polyline")).to_have_css("stroke-width", "1.4px")
    assert place.evaluate("(one) => [one.scrollLeft, document.activeElement === one]") == [60, True]


def test_a_series_of_a_chart_is_hidden_with_its_band_and_shown_again_with_keys(page):
    settled(page, "/telemetry?pass=1&chart=1:temperature_c")
    label = page.locator(".chart .u-legend").get_by_role("button", name="temperature")
    shown = "document.querySelector('.chart').plot.series.slice(1).map((one) => one.show)"
    for key, pressed in ("Enter", "false"), (" ", "true"):
        label.press(key)
        expect(label).to_have_attribute("aria-pressed", pressed)
        assert set(page.evaluate(shown)) == {pressed == "true"}
    label.click()
    expect(label).to_have_attribute("aria-pressed", "false")


def test_a_build_is_brought_run_and_judged(page, make_flyable, make_build, tmp_path):
    flown = make_flyable(frames=12, seed=61)
    pack_archive(flown.folder, tmp_path / "pass.zip")
    files = [("regression-archives", tmp_path / "pass.zip")]
    found = {"synthetic pass 61": flown.packets}
    half = with_detections(found, lambda items: {name: values[::2] for name, values in items.items()})
    broken = {"program": "raise SystemExit(4)"}
    for name, packets, options in ("good", found, {}), ("half", half, {}), ("broken", found, broken):
        build = make_build(name, packets, **options)
        files.append(("builds", make_archive(str(tmp_path / name), "zip", build.parent)))
    settled(page, "/regression")
    for kind, file in files:
        page.locator("#zip-kind").select_option(kind)
        page.locator("#zip").set_input_files(file)
        press(page, "Upload")
        expect(page.locator("#notices .good")).to_have_count(1 + files.index((kind, file)))
    for candidate, verdict in ("good", "pass"), ("half", "fail"), ("broken", "fail"):
        for select, build in ("#candidate", candidate), ("#baseline", "good"):
            option = page.locator(f"{select} option", has_text=build)
            page.locator(select).select_option(option.get_attribute("value"))
        page.get_by_role("button", name="Run", exact=True).click()
        latest = page.locator("#regressions tbody tr").first
        expect(latest).to_contain_text(candidate)
        expect(latest.locator(f".state.{verdict}")).to_be_visible()
    expect(latest.locator(".reasons li").first).to_contain_text("exit")
    page.locator("#regressions").get_by_role("button", name="Gates and craters").nth(1).click()
    expect(page.locator("#regressions table").nth(1)).to_contain_text("recall")
    changed = page.locator("#regressions .report")
    expect(changed).to_contain_text("tracks of craters lost")
    expect(changed.locator("#fig-changed")).to_contain_text("candidate: not detected")
    lost = changed.locator("table").first.locator("tbody tr td:nth-child(6)").all_inner_texts()
    assert lost == sorted(lost, key=int, reverse=True) and int(lost[0]) > 0
    expect(changed.locator("#fig-changed image")).to_have_count(2 * len(lost))
    shape = changed.locator("#fig-changed [style]").first
    assert shape.evaluate("(one) => getComputedStyle(one).fill") == "none"
    expect(changed.locator("table").nth(1).locator("tbody td:nth-child(3)")).to_have_text("0")
    expect(changed.locator("table").nth(1)).to_contain_text("first different frame")
    with page.expect_popup() as opened:
        page.locator("#regressions").get_by_role("link", name="Report").first.click()
    expect(opened.value.get_by_role("heading", level=1)).to_be_visible()
