"""A shift of one operator in Chromium, from the sign-in to the sign-out, with a ground station in the test."""

import json
import re
import socket
import threading
import time
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field

import numpy as np
from pytest import fixture

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.missions.service import add_mission
from ground_service.passes.archive_import import import_archive
from lunar.ephemeris import ephemeris_from_states
from lunar.messages.oem import save_oem
from lunar.timescales import ticks_from_utc_ns
from tests.ground_service.conftest import circular_states
from tests.ground_service.web.conftest import TIMEOUT_S, end_socket, press, shows, strict_page
from tests.lazy import expect
from tests.scenarios import GOLDEN, SELENITA
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import DownlinkEncoder
from tmtc.link.uplink import UplinkDecoder

NS = 1_000_000_000
SPACECRAFT = 76

# Names of the sections of the timeline that a bar covers.
COVERED_LABELS = """() => {
    const box = (one) => one.getBoundingClientRect();
    const bars = [...document.querySelectorAll("#timeline .span rect")].map(box);
    const covered = (label) => bars.some((bar) => bar.left < label.right && label.left < bar.right
        && bar.top < label.bottom - 2 && label.top + 2 < bar.bottom);
    const labels = [...document.querySelectorAll("#timeline .lane")];
    return labels.filter((one) => covered(box(one))).map((one) => one.textContent);
}"""

MISSION = (
    SELENITA
    + """[approval]
windows = "manual"
[link.stations.madrid]
latitude_deg = 40.43
longitude_deg = -4.25
minimum_elevation_deg = 0.0
[link.stations.canberra]
latitude_deg = -35.4
longitude_deg = 149.0
minimum_elevation_deg = 0.0
[[links]]
name = "madrid"
kind = "tcp"
station = "madrid"
send = "manual"
downlink = "127.0.0.1:{down}"
uplink = "127.0.0.1:{up}"
silence_s = 2.0
[[links]]
name = "canberra"
kind = "tcp"
station = "canberra"
send = "manual"
uplink = "127.0.0.1:{up}"
"""
)


@dataclass
class Spacecraft:
    """A station and a payload behind it: sends given reports, and verifies every telecommand it receives."""

    down: socket.socket = field(default_factory=lambda: socket.create_server(("127.0.0.1", 0)))
    up: socket.socket = field(default_factory=lambda: socket.create_server(("127.0.0.1", 0)))
    _encoder: DownlinkEncoder = field(default_factory=lambda: DownlinkEncoder(SPACECRAFT))
    _listeners: list[socket.socket] = field(default_factory=list)
    _connections: list[socket.socket] = field(default_factory=list)
    _tasks: list[threading.Thread] = field(default_factory=list)
    _count: int = 0
    _sending: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self):
        for task in self._accept_listeners, self._take_telecommands:
            self._start(task)

    def _start(self, task, *arguments):
        thread = threading.Thread(target=task, args=arguments, daemon=True)
        self._tasks.append(thread)
        thread.start()

    def report(self, name, **values):
        """Send a packet to the service, which has connected."""
        zeros = {one.name: 0 for one in DICTIONARY.packet(name).fields if one.size == 1}
        wait_for(lambda: bool(self._listeners), "the service has not connected")
        with self._sending:
            self._count += 1
            ticks = int(ticks_from_utc_ns(time.time_ns())) + self._count
            packet = DICTIONARY.pack(name, zeros | values, ticks=ticks, sequence_count=self._count)
            self._listeners[-1].sendall(self._encoder.encode([packet]))

    def replay(self, packets):
        """Send packets of a recorded pass."""
        wait_for(lambda: bool(self._listeners), "the service has not connected")
        with self._sending:
            self._listeners[-1].sendall(self._encoder.encode(packets))

    def _accept_listeners(self):
        while True:
            try:
                self._listeners.append(self.down.accept()[0])
            except OSError:
                return

    def _take_telecommands(self):
        while True:
            try:
                connection, _ = self.up.accept()
            except OSError:
                return
            self._connections.append(connection)
            self._start(self._verify, connection)

    def _verify(self, connection):
        decoder = UplinkDecoder(SPACECRAFT)
        with connection, suppress(OSError):  # the service may end first
            while octets := connection.recv(1 << 16):
                for packet in decoder.decode(octets).packets:
                    request = int.from_bytes(packet[:4], "big")
                    for stage in "accepted", "started", "completed":
                        self.report(f"verification_{stage}", request_id=request)

    def close(self):
        for one in self.down, self.up, *self._listeners, *self._connections:
            end_socket(one)
        for task in self._tasks:
            task.join(TIMEOUT_S)


@dataclass
class Shift:
    """The service of the shift, its spacecraft, and the token of the operator."""

    url: str
    token: str
    spacecraft: Spacecraft


@fixture
def shift(tmp_path, make_pass, console, serve):
    """A service with users, a mission, an ephemeris of the coming days, and one pass."""
    spacecraft = Spacecraft()
    every = time.time_ns() // NS * NS - 3 * 3600 * NS + np.arange(0, 3 * 86_400, 60, dtype=np.int64) * NS
    save_oem(ephemeris_from_states(every, *circular_states(every)), tmp_path / "coming.oem")
    ports = {"down": spacecraft.down.getsockname()[1], "up": spacecraft.up.getsockname()[1]}
    home = tmp_path / "home"
    with open_ground(home) as ground:
        add_user(ground, "root", "admin")
        token = add_user(ground, "ann", "operator")
        import_archive(ground, make_pass(mission=GOLDEN.replace("selenita", "archive")).folder)
        add_mission(ground, MISSION.format(**ports).encode(), actor="root")
        stored = ground.files.put_file(tmp_path / "coming.oem")
        add_ephemeris(ground, stored, name="coming.oem", precedence=0, actor="root")
    with serve(home, console.port) as running:
        yield Shift(running.url, token, spacecraft)
    spacecraft.close()


# Counted where they arrive: a click that the browser's driver stops, as its button has just moved, is made again.
COUNT_CLICKS = "addEventListener('click', () => (sessionStorage.n = 1 + Number(sessionStorage.n ?? 0)))"


def go(page, *links):
    """Follow links by their visible texts."""
    for text in links:
        page.get_by_role("link", name=text, exact=True).first.click()


@contextmanager
def telemetry(spacecraft):
    """Keep a contact open: telemetry comes more often than its silence ends it."""
    over = threading.Event()

    def send():
        while not over.wait(0.5):
            spacecraft.report("housekeeping", structure_id=1, bus_voltage_v=12.0, temperature_c=21.5)

    sending = threading.Thread(target=send)
    sending.start()
    try:
        yield
    finally:
        over.set()
        sending.join()


@fixture
def operator(browser, shift):
    """The operator's browser."""
    with strict_page(browser, shift.url, strict=False) as page:
        page.add_init_script(COUNT_CLICKS)
        yield page


def test_an_operator_works_a_shift(operator, shift):
    page, spacecraft = operator, shift.spacecraft

    # Sign in.
    page.goto("/")
    page.get_by_label("Token").fill(shift.token)
    page.locator("dialog").get_by_role("button", name="Sign in").click()
    expect(page.locator("#user")).to_have_text("ann, operator")

    # The mission in force.
    go(page, "Planner", "Missions")
    page.get_by_role("link", name="selenita").click()
    page.locator("#sections summary", has_text="approval").click()
    shows(page, "#sections", "manual")

    # A standing request becomes windows in mission time and in daylight.
    go(page, "Planner")
    shows(page, "#daylight", "Sun above the horizon")
    page.get_by_text("Add a standing request").click()
    page.locator("#request-name").fill("low Sun")
    page.locator("#request-windows").fill("3")
    page.locator("#request-period_days").fill("2")
    page.locator("#request-horizon_days").fill("1")
    page.locator("#add-request").get_by_role("button", name="Add").click()
    shows(page, "#requests tbody tr", "3 draft")
    page.locator("#requests").get_by_role("button", name="Plan", exact=True).click()
    shows(page, "#request-plan", "the number of windows of its period is planned")
    page.locator("#timeline .window.draft").first.click()
    shows(page, "#selected", "Sun elevation")
    expect(page.locator("#timeline .curve")).to_have_count(3)
    expect(page.locator("#timeline .contact.predicted").first).to_be_attached()
    assert page.evaluate(COVERED_LABELS) == []
    expect(page.locator("#timeline line.now:not([hidden])")).to_have_count(1)

    # Nothing is released while the spacecraft is on hold, not even by the planner.
    spacecraft.report("housekeeping", structure_id=1, bus_voltage_v=12.0, temperature_c=21.5)
    go(page, "Shift")
    craft = page.get_by_role("region", name="Spacecraft 76 flight")
    craft.get_by_label("Reason of the hold").fill("antenna is being repaired")
    craft.get_by_role("button", name="Hold").click()
    expect(craft).to_contain_text("On hold by ann since")
    window = craft.locator("tbody tr", has_text="low Sun").first
    expect(window).to_contain_text("waits for approval")
    window.get_by_role("button", name=re.compile("^Approve")).click()
    page.get_by_role("dialog", name=re.compile("^Approve")).get_by_role("button", name="Approve").click()
    expect(window).to_contain_text("waits for the release of its telecommands")
    page.reload()
    expect(craft).to_contain_text("On hold by ann since")
    craft.get_by_role("button", name="Resume").click()

    # The page says what is released and what is sent before it does so.
    window.get_by_role("button", name=re.compile("^Release")).click()
    page.get_by_role("dialog", name=re.compile("^Release")).get_by_role("button", name="Release", exact=True).click()
    expect(window).to_contain_text("waits for transmission")
    go(page, "Commands")
    expect(page.get_by_role("button", name="Send now").first).to_be_enabled()
    go(page, "Shift")
    window.get_by_role("button", name=re.compile("^Send")).click()
    question = page.get_by_role("dialog", name=re.compile(r"^Send \d+ telecommands over (madrid|canberra) now\?$"))
    expect(question).to_contain_text("insert activity")
    question.get_by_role("button", name="Send").click()
    expect(window.locator(".chain .now")).to_have_text("executed")  # all telecommands are verified
    expect(window).to_contain_text("begins in")

    # Six clicks lead from the search to telecommands that are sent, outside of a contact and in one.
    for during, window in (nullcontext(), 6), (telemetry(spacecraft), -1):  # apart; earlier ones are planned already
        go(page, "Shift", "Planner")
        expect(page.locator("#spacecraft")).to_have_value("76 flight")
        before = int(page.evaluate("sessionStorage.n"))
        with during:
            press(page, "Search")
            page.locator("#candidates").get_by_role("button", name="Plan").nth(window).click()
            page.locator("#selected").get_by_role("button", name="Approve").click()
            page.get_by_role("dialog").get_by_role("button", name="Approve").click()
            page.locator("#selected").get_by_role("button", name="Uplink").click()
            press(page, "Release and send")
            shows(page, "#notices", "sends what is released")
        assert int(page.evaluate("sessionStorage.n")) - before == 6
    go(page, "Shift", "Commands")
    # The planner uplinks approved windows that begin soon: the page has the name that the service recorded.
    recorded = json.loads(page.request.get("/api/v1/telecommands?limit=100").body())["items"]
    (decider,) = {one["decided_by"] for one in recorded if one["name"] == "insert_activity"}
    assert decider in ("ann", "planner")
    command = page.locator("#commands tbody tr", has_text="insert activity").first
    expect(command).to_contain_text(f" by {decider}")
    expect(command.locator(".state")).to_have_text("completed")
    expect(command.get_by_role("img", name="accepted, started, completed")).to_be_visible()
    expect(command).to_contain_text(re.compile(r"at 20\d\d-\d\d-\d\dT[\d:]+Z of the on-board clock"))
    started = page.locator("#commands tbody tr", has_text="start observation, duration").first
    expect(started).to_contain_text(re.compile(r"duration \d+(\.\d{1,3})? s, cadence \d+ s"))

    # Live telemetry.
    go(page, "Shift", "Telemetry")
    page.get_by_label("Packet").select_option("housekeeping")
    value = page.locator("#live tr", has_text="temperature")
    expect(value).to_contain_text("21.5 °C")
    spacecraft.report("housekeeping", structure_id=1, bus_voltage_v=12.0, temperature_c=70.25)
    expect(value).to_contain_text("70.25 °C")
    expect(value.locator(".state.warning")).to_be_visible()

    # Series of a pass: two parameters in one chart, limits, and modes with their names.
    page.goto("/telemetry?pass=1&chart=1:temperature_c,bus_voltage_v&chart=1:mode")
    expect(page.locator("#charts canvas")).to_have_count(2)
    shows(page, "#charts", "CSV of all samples")

    # An alarm.
    spacecraft.report("event_high", event_id=20, frame_number=7)
    go(page, "Shift", "All alarms")
    name = page.locator("td.keep", has_text=re.compile("^temperature$"))
    expect(page.locator("#alarms tbody tr").filter(has=name)).to_contain_text(re.compile(r"70\.[23] °C"))
    alarm = page.locator("#alarms tbody tr", has_text="camera fault")
    alarm.get_by_role("button", name="Acknowledge").click()
    page.get_by_label("State").select_option("cleared")  # the condition had ended
    expect(alarm).to_contain_text("ann")

    # Its event, with words.
    go(page, "Shift", "Events")
    page.get_by_label("Severity").select_option("high")
    expect(page.locator("#events tbody tr", has_text="camera fault")).to_contain_text("frame 7")
    go(page, "Shift")

    # The report of a pass.
    craft.get_by_role("link", name="Monthly reports").click()
    shows(page, "#monthly", "There is no monthly report.")
    page.get_by_role("link", name="synthetic pass").click()
    press(page, "Make a report")
    expect(page.locator("#verdict .verdict")).not_to_be_empty()
    expect(page.locator("#completeness tbody tr").first).to_be_visible()
    expect(page.locator("#verdict tr", has_text="detector recall")).to_contain_text(
        re.compile("^detector recall(met|not met)")
    )
    assert not re.search(r"\de-\d", page.locator("#verdict .glance").inner_text())  # no powers of ten
    go(page, "Shift", "All passes")
    page.get_by_label("Search").fill("SYNTHETIC")
    press(page, "Search")
    row = page.locator("#passes tbody tr", has_text="synthetic pass")
    expect(row.get_by_role("link", name="open")).to_have_attribute("href", re.compile("/reports/[0-9a-f]{32}"))
    expect(row.locator(".state").first).not_to_be_empty()
    page.get_by_label("Search").fill("no such pass")
    press(page, "Search")
    shows(page, "#passes", "No pass matches.")
    expect(page).to_have_url(re.compile("search=no"))

    # Hand over: one page shows windows, alarms, verdicts and the note.
    go(page, "Shift")
    craft.get_by_label("Note for the next shift").fill("Camera fault acknowledged; watch the temperature.")
    craft.get_by_role("button", name="Keep the note").click()
    expect(craft).to_contain_text("by ann")
    expect(craft.locator("section", has_text="Last verdicts")).to_contain_text("synthetic pass")
    expect(craft.locator("section", has_text="Open alarms")).to_contain_text("temperature")
    expect(page.locator("#feed-light")).to_have_class("light on")

    # Sign out: the next request needs a sign-in.
    page.locator("#caller").click()
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()
    assert page.request.get("/api/v1/passes").status == 401
