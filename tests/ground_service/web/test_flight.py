"""A payload flown live, seen in the telemetry displays and on the page of the live payload, in Chromium.

LINNA_PICTURES=FOLDER keeps the pictures of the documentation: `make pictures`.
"""

from __future__ import annotations

import re
import socket
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pytest import fixture, mark

from ground_service.ground import open_ground
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.planning.model import WindowEntry
from ground_service.planning.service import add_window
from lunar.datafolder import find_data
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.oem import save_oem
from lunar.timescales import parse_utc
from payload_emulator.session.live.session import LiveSession
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.spacecraft.loading import load_scenario_payload
from payload_emulator.session.world.world import build_world
from tests.ground_service.conftest import circular_states
from tests.ground_service.web.conftest import TIMEOUT_S, Pictures, press, strict_page
from tests.lazy import expect
from tests.scenarios import SELENITA
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY

if TYPE_CHECKING:
    from playwright.sync_api import Page

NS = 1_000_000_000
START = parse_utc("2029-08-07T01:40:00Z")
FRAMES = 16
SCENARIO = """
name = "live"
seed = 3
[dynamics]
gravity = "builtin"
degree = 8
orientation = "iau"
[window]
search = "none"
start = "2029-08-07T01:40:00Z"
duration_s = 240.0
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical", "anchored"]
filter_gravity = "builtin"
filter_degree = 8
[faults]
events = ["overheating at 60 for 45 size 60", "camera_lost at 150 for 30"]
"""
MISSION = (
    SELENITA
    + """[link.stations.madrid]
latitude_deg = 40.43
longitude_deg = -4.25
minimum_elevation_deg = 0.0
header_octets = 8
time_code = "unix_ns"
time_offset = 0
[[links]]
name = "madrid"
kind = "tcp"
station = "madrid"
downlink = "127.0.0.1:{port}"
silence_s = 1.0
"""
)
ORDERS = (
    ("set_housekeeping_interval", {"structure_id": 1, "interval_s": 15}),
    ("set_parameter", {"parameter_id": 21, "value": 2.0}),  # frames between thumbnails
    ("set_parameter", {"parameter_id": 22, "value": 4.0}),  # pixels averaged along each axis
)
SOURCE = 3
"""Source of these telecommands: each source has sequence counts of its own."""


@dataclass
class Flown:
    """A service that received a flight over its link, and two pages that were open during the flight."""

    url: str
    layout: Page
    live: Page

    def ask(self, path, **query):
        """Return an answer of the service."""
        answer = self.layout.request.get(f"{self.url}/api/v1/{path}", params=query)
        assert answer.ok, answer.text()
        return answer.json()

    def alarm(self, name):
        """Return the alarm with a name."""
        (found,) = (one for one in self.ask("alarms")["items"] if one["name"] == name)
        return found

    def events(self):
        """Return the number of events."""
        return int(self.ask("events", spacecraft_id=76, instance="flight")["total"])

    def newest(self):
        """Return the newest housekeeping values by name."""
        items = self.ask("parameters", spacecraft_id=76, instance="flight")["items"]
        return {one["name"]: one["value"] for one in items if one["packet"] == "housekeeping"}


@fixture(scope="module")
def flown(tmp_path_factory, serve, openmct, browser):
    """A payload flown live with its operator and `ORDERS`, started on the live page, followed in a layout."""
    folder = tmp_path_factory.mktemp("flight")
    data = find_data(None)
    world = build_world(parse_scenario(SCENARIO), data)
    loaded, _, _ = load_scenario_payload(world, data)
    payload = LiveSession(world, loaded, has_operator=True, paused=True, ends_with_scenario=True)
    thread = threading.Thread(target=payload.run, daemon=True)
    home = prepared_home(folder, payload.ports["telemetry earth"])
    thread.start()
    try:
        with (
            serve(home, payload.ports["console"], openmct) as service,
            strict_page(browser, service.url) as layout,
            strict_page(browser, service.url) as live,
            socket.create_connection(("127.0.0.1", payload.ports["telecommand earth"])) as station,
        ):
            sent = [
                DICTIONARY.pack_command(name, values, sequence_count=count, source=SOURCE)
                for count, (name, values) in enumerate(ORDERS)
            ]
            station.sendall(b"".join(sent))
            octets = sum(len(one) for one in sent)
            wait_for(
                lambda: sum(len(one) for _, one in payload.contacts._uplink) == octets, "no telecommands have arrived"
            )
            clients = payload.contacts.stations["earth"].telemetry.clients
            wait_for(lambda: bool(clients), "the link is not connected")
            found = Flown(service.url, layout, live)
            follow(found)
            yield found
    finally:
        payload.stopping.set()
        thread.join(TIMEOUT_S)
    assert not thread.is_alive()


def prepared_home(folder, telemetry_port):
    """Return the folder of a service with a mission description, an ephemeris and two windows."""
    every = START + np.arange(-12 * 3600, 12 * 3600, 60, dtype=np.int64) * NS
    save_oem(ephemeris_from_states(every, *circular_states(every)), folder / "orbits.oem")
    home = folder / "home"
    with open_ground(home) as ground:
        add_mission(ground, MISSION.format(port=telemetry_port).encode(), actor="ann")
        stored = ground.files.put_file(folder / "orbits.oem")
        add_ephemeris(ground, stored, name="orbits", precedence=0, actor="ann")
        for name, minute in (("morning", 0), ("noon", 60)):
            start = START + minute * 60 * NS
            add_window(ground, WindowEntry(name, start, start + 180 * NS, 15.0, 76), actor="ann")
    return home


def follow(flown):
    """Start the flight on the live page, and wait until its last values are in the layout."""
    flown.live.goto("/live")
    expect(flown.live.locator("#state")).to_have_text("connected")
    flown.layout.set_viewport_size({"width": 1280, "height": 800})
    flown.layout.goto(address("pass-shift"))
    expect(flown.layout.get_by_text("Live feed connected")).to_be_visible()
    flown.live.get_by_role("button", name="Run").click()
    expect(lad_row(flown.layout, "mode")).to_be_visible()
    wait_for(lambda: flown.newest().get("frames_processed") == FRAMES, "not all frames were received")


def lad_row(page, name):
    """Return the row of a table of newest values."""
    return page.get_by_label("lad row").filter(has=page.get_by_text(name, exact=True))


def address(kind):
    """Return the address of an object of the spacecraft, with the time of the flight."""
    objects = ("linna:spacecraft", "linna:vehicle~76~flight", f"linna:{kind}~76~flight")
    return f"/mct#/browse/{'/'.join(objects)}?{SHOWN}"


SHOWN = "tc.mode=newest&tc.startDelta=480000&tc.endDelta=60000&tc.timeSystem=utc&hideInspector=true&hideTree=true"
PLOT_GREYS = (239, 40)  # backgrounds of plots in the light and the dark theme
PLOT = ".gl-plot-display-area canvas"
IMAGES_LOADED = """() => {
    const images = [...document.querySelectorAll(".c-thumb__image")];
    return images.length > 0 && images.every((one) => one.complete && one.naturalWidth > 0);
}"""


@fixture
def opened(flown, browser):
    """A page of its own for the displays."""
    with strict_page(browser, flown.url) as page:
        page.set_viewport_size({"width": 1280, "height": 800})
        yield page


def test_the_layout_of_a_pass_shift_follows_a_flight(flown, tmp_path):
    page = flown.layout
    wait_for(
        lambda: f"{flown.newest()['packets_sent']:.0f}" in lad_row(page, "packets sent").inner_text(),
        "the newest number of packets is not shown",
    )
    expect(page.locator(PLOT)).to_have_count(2 * 3)  # of each plot, one for the lines and one for highlights
    all_events_are_shown(page, flown)
    # The value is within its limits again; the alarm is kept until somebody acknowledges it.
    wait_for(lambda: not flown.alarm("temperature_c")["active"], "the condition of the alarm has not ended")
    fault = fault_named(page, "temperature")
    value = fault.get_by_label("Live Value")
    expect(value).to_contain_text("°C")
    expect(value).not_to_have_class(re.compile("is-limit"))  # the newest value is within the limits
    fault.get_by_role("checkbox").check()
    press(page, "Acknowledge")
    page.get_by_label("Save", exact=True).click()
    expect(fault).to_have_count(0)
    swatches = page.locator(".plot-series-color-swatch").evaluate_all(
        "all => all.map((one) => getComputedStyle(one).backgroundColor)"
    )
    for swatch in set(swatches):
        line = [int(part) for part in re.findall(r"\d+", swatch)[:3]]
        assert min(contrast(line, [level] * 3) for level in PLOT_GREYS) >= 3.0, swatch
    assert len(set(swatches)) == 3
    # Windows and contacts change while they are shown.
    expect(activity(page, "morning, draft")).to_be_visible()
    assert page.request.patch("/api/v1/windows/1", data={"state": "approved"}).ok
    expect(activity(page, "morning, approved")).to_be_visible()
    expect(page.get_by_text("Contacts, madrid").first).to_be_visible()
    # The plot has the peak, which may have come together with later packets.
    wait_for(lambda: highest_tick(page) >= 60.0, "the peak of the temperature is not shown")
    Pictures(tmp_path).take(page, "displays-shift")


def highest_tick(page):
    """Return the greatest value on the y axis of the first plot."""
    labels = page.locator(".gl-plot").first.locator(".gl-plot-y-tick-label")
    return max((float(one) for one in labels.all_inner_texts()), default=0.0)


def contrast(*colours):
    """Return the contrast ratio of two colours (WCAG 2.2)."""
    weights = np.array([0.2126, 0.7152, 0.0722])
    parts = np.array(colours) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    dark, light = sorted(linear @ weights)
    return float((light + 0.05) / (dark + 0.05))


def fault_named(page, name):
    """Return an item of the list of faults."""
    checkbox = page.get_by_label(f"Select fault: {name} in Spacecraft 76, flight", exact=True)
    return page.get_by_role("listitem").filter(has=checkbox)


def all_events_are_shown(page, flown):
    """Wait until the table has as many events as the service, which may still be receiving the last ones."""
    rows = event_rows(page)
    wait_for(lambda: rows.count() == flown.events(), "the table does not show each event once")


def event_rows(page):
    """Return the rows of the table of events."""
    return page.locator(".c-telemetry-table__body tr")


def activity(page, name):
    """Return an activity of the plan."""
    return page.locator(".c-plan__activity").filter(has_text=name)


def test_the_layout_of_a_payload_engineer_shows_the_flight(flown, opened, tmp_path):
    opened.goto(address("payload-engineer"))
    expect(lad_row(opened, "frames processed")).to_contain_text(str(FRAMES))
    expect(opened.locator(PLOT)).to_have_count(2 * 6)
    all_events_are_shown(opened, flown)
    opened.wait_for_function(IMAGES_LOADED)
    Pictures(tmp_path).take(opened, "displays-payload")


def test_the_live_page_shows_what_the_payload_matched(flown, tmp_path):
    expect(flown.live.locator("#numbers")).to_contain_text("matched")
    expect(flown.live.locator("#state")).to_have_text("the scenario has ended")
    background, reference = (
        [int(part) for part in re.findall(r"\d+", one.evaluate("one => getComputedStyle(one).backgroundColor"))[:3]]
        for one in (
            flown.live.locator("#map"),
            flown.live.locator("#map-legend li", has_text="reference").locator(".mark"),
        )
    )
    assert contrast(background, reference) >= 3.0  # no picture of the Moon is shown under the tracks
    Pictures(tmp_path).take(flown.live, "live")


@mark.parametrize("kind, width_px", [("images", 128), ("detections", 512)])
def test_downlinked_images_are_shown(flown, opened, tmp_path, kind, width_px):
    opened.goto(address(kind))
    # The camera gave no image of one of every second frame.
    expect(opened.locator(".c-imagery__thumb")).to_have_count(FRAMES // 2 - 1)
    opened.wait_for_function(IMAGES_LOADED)
    widths = "[...document.querySelectorAll('.c-thumb__image')].map((one) => one.naturalWidth)"
    assert set(opened.evaluate(widths)) == {width_px}
    Pictures(tmp_path, documented=False).take(opened, f"displays-{kind}")


def test_events_are_shown_once_in_their_order(flown, opened, tmp_path):
    opened.goto(address("events"))
    all_events_are_shown(opened, flown)
    listed = flown.ask("events", spacecraft_id=76, instance="flight", limit=100)["items"]
    cells = "(rows) => rows.map((one) => [...one.querySelectorAll('td')].slice(-2).map((td) => td.textContent.trim()))"
    shown = event_rows(opened).evaluate_all(cells)
    assert shown == [[one["name"].replace("_", " "), one["detail"]] for one in listed]
    expect(event_rows(opened).filter(has_text="temperature high").locator(".is-limit--yellow")).to_have_count(1)
    Pictures(tmp_path, documented=False).take(opened, "displays-events")


def test_windows_and_contacts_are_a_plan(flown, opened, tmp_path):
    span = {"since": "2029-08-07T01:00:00Z", "until": "2029-08-07T03:00:00Z"}
    # The open contact of the link ends without telemetry; until then none is predicted after it.
    wait_for(lambda: bool(flown.ask("contacts", **span)["contacts"]), "no contact is predicted")
    start, stop = (int(parse_utc(one)) // 1_000_000 for one in span.values())
    hours = f"tc.mode=fixed&tc.startBound={start}&tc.endBound={stop}&tc.timeSystem=utc"
    opened.goto(address("plan").replace(SHOWN, f"{hours}&hideInspector=true&hideTree=true"))
    expect(activity(opened, "madrid, predicted").first).to_be_visible()
    Pictures(tmp_path, documented=False).take(opened, "displays-plan")


def test_faults_have_the_values_and_times_of_alarms(flown, opened, tmp_path):
    opened.goto(f"/mct#/browse/faults.taxonomy:faultManagement.view?{SHOWN}")
    fault = fault_named(opened, "temperature high")
    alarm = flown.alarm("temperature_high")
    expect(fault).to_contain_text(f"{alarm['last'][:10]} {alarm['last'][11:19]}Z")
    expect(fault).to_contain_text("ended")
    Pictures(tmp_path, documented=False).take(opened, "displays-faults")
