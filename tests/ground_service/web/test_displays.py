"""Telemetry displays at /mct: Open MCT in Chromium, and the service without it."""

import calendar
import gzip
import io
import json
import math
import re
import urllib.error
import urllib.request

import numpy as np
from PIL import Image
from pytest import fixture, mark

from ground_service.ground import open_ground
from ground_service.passes.archive_import import import_archive
from ground_service.web import pages
from ground_service.web.pages import POLICY
from lunar.timescales import parse_utc, ticks_from_utc_ns
from tests.ground_service.web.conftest import press, strict_page
from tests.lazy import expect
from tests.serving import wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

AFTER = parse_utc("2029-08-07T06:15:00Z")
HOUSEKEEPING = {"structure_id": 1, "bus_voltage_v": 12.0, "mode": 1}


def ask(url, body=None, **headers):
    """Status, body and headers of a GET."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, body, headers), timeout=60) as answer:
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read(), error.headers


@fixture(scope="module")
def shown(tmp_path_factory, synthetic_pass, serve, openmct):
    """A service with the pages, the synthetic pass imported."""
    home = tmp_path_factory.mktemp("displays") / "home"
    with open_ground(home) as ground:
        import_archive(ground, synthetic_pass.folder)
    with serve(home, 1, openmct) as running:
        yield running


@fixture
def mct(browser, shown):
    """A page for the displays; the test fails on an error in the console or a violation of the policy."""
    with strict_page(browser, shown.url) as opened:
        yield opened


def alarm_states(url):
    """States of the alarms by name."""
    return {one["name"]: one["state"] for one in json.loads(ask(f"{url}/api/v1/alarms")[1])["items"]}


def spacecraft(url):
    """The only spacecraft: that of the synthetic pass."""
    (found,) = json.loads(ask(f"{url}/api/v1/spacecraft")[1])["items"]
    return found


def receive(url, temperature_c, second):
    """Upload a housekeeping packet and a camera fault, later than the packets of the pass."""
    fault = {"event_id": 20, "frame_number": second}
    upload(url, second, {"housekeeping": HOUSEKEEPING | {"temperature_c": temperature_c}, "event_high": fault})


def upload(url, second, packets):
    """Upload packets, fields by name, of a second after the end of the synthetic pass; return its time in ms."""
    ticks = int(ticks_from_utc_ns(AFTER)) + second * 65_536
    packed = []
    for name, values in packets.items():
        fields = DICTIONARY.packet(name).fields
        zeros = {field.name: 0 if field.size == 1 else (0.0,) * field.size for field in fields}
        packed.append(DICTIONARY.pack(name, zeros | values, ticks=ticks, sequence_count=900 + second))
    request = urllib.request.Request(
        f"{url}/api/v1/telemetry?name=live-{second}.cadu&instance={spacecraft(url)['instance']}",
        data=encode_cadus(packed, spacecraft_id=76),
        headers={"Content-Type": "application/octet-stream"},
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        assert answer.status == 202
    return AFTER // 1_000_000 + 1_000 * second


def test_without_open_mct_the_page_says_how_to_install_it(service):
    status, body, headers = ask(service.url + "/mct")
    assert status == 200 and headers["Content-Security-Policy"] == POLICY
    assert b"<code>make openmct</code>" in body and b"LINNA_OPENMCT" in body
    assert ask(service.url + "/mct/4.2.0/openmct.js")[0] == 404
    assert ask(service.url + "/telemetry")[0] == 200


def test_only_the_page_of_the_displays_permits_eval(shown):
    _, body, headers = ask(shown.url + "/mct")
    assert headers["Content-Security-Policy"] == pages.DISPLAY_POLICY
    assert pages.DISPLAY_POLICY.count("unsafe-eval") == 1 and "http" not in pages.DISPLAY_POLICY
    for source in re.findall(rb'src="([^"]+)"', body):
        assert ask(shown.url + source.decode())[0] == 200, source
    assert ask(shown.url + "/")[2]["Content-Security-Policy"] == POLICY


def test_files_of_open_mct_are_compressed_kept_and_no_others_are_reached(shown, openmct):
    version = json.loads((openmct / "package.json").read_text())["version"]
    _, plain, headers = ask(f"{shown.url}/mct/{version}/openmct.js")
    assert "Content-Encoding" not in headers and "immutable" in headers["Cache-Control"]
    assert plain == (openmct / "dist/openmct.js").read_bytes()
    _, packed, headers = ask(f"{shown.url}/mct/{version}/openmct.js", **{"Accept-Encoding": "gzip"})
    assert headers["Content-Encoding"] == "gzip" and gzip.decompress(packed) == plain
    assert len(packed) < len(plain) / 3
    for path in "../package.json", "%2e%2e/package.json", "openmct.js.map", "package.json", "", "/etc/passwd":
        assert ask(f"{shown.url}/mct/{version}/{path}")[0] == 404, path
    assert ask(f"{shown.url}/mct/4.1.0/openmct.js")[0] == 404


def test_a_parameter_is_found_in_the_tree_and_its_plot_is_drawn(mct):
    mct.goto("/mct")
    tree = mct.get_by_role("tree", name="Main Tree")
    tree.get_by_label("Expand Spacecraft linna.packet").click()
    tree.get_by_label("Expand Spacecraft 76").click()
    tree.get_by_label("Expand housekeeping linna.packet").click()
    with mct.expect_response(lambda answer: "/telemetry/temperature_c?" in answer.url) as received:
        tree.get_by_label("Navigate to temperature linna.parameter").click()
    assert len(received.value.json()["buckets"]) >= 40  # the whole pass is in the interval
    expect(mct.locator(".c-plot").get_by_text("temperature °C")).to_be_visible()
    expect(mct.locator(".gl-plot-display-area canvas").first).to_be_visible()


def test_values_alarms_and_limits_follow_the_telemetry(mct, shown):
    mct.goto("/mct")
    row = mct.get_by_label("lad row").filter(has=mct.get_by_text("temperature", exact=True))
    expect(row).to_contain_text("23.9")
    expect(mct.get_by_text("Live feed connected")).to_be_visible()
    receive(shown.url, 95.25, 1)
    expect(row).to_contain_text("95.25")
    expect(row.locator(".is-limit--red")).to_have_count(1)
    mode = mct.get_by_label("lad row").filter(has=mct.get_by_text("mode", exact=True))
    expect(mode).to_contain_text(DICTIONARY.labels("housekeeping", "mode")[1].replace("_", " "))
    fault = mct.get_by_label("Select fault: temperature")
    fault.check()
    press(mct, "Acknowledge")
    mct.get_by_label("Save", exact=True).click()
    expect(mct.locator(".c-fault-mgmt__list.is-acknowledged, .is-acknowledged").first).to_be_visible()
    mct.get_by_label("Select fault: camera fault").check()
    press(mct, "Shelve")
    mct.get_by_label("Save", exact=True).click()
    wait_for(lambda: alarm_states(shown.url)["camera_fault"] == "shelved", "the alarm is not shelved")
    assert alarm_states(shown.url) == {"temperature_c": "acknowledged", "camera_fault": "shelved"}
    listed = mct.locator(".c-fault-mgmt__list").filter(has=mct.get_by_label("Select fault: temperature"))
    current = listed.get_by_label("Live Value")
    expect(current).to_have_text("95.25 °C")
    for second, temperature_c, colour in (2, 97.5, "red"), (3, 70.0, "yellow"):
        upload(shown.url, second, {"housekeeping": HOUSEKEEPING | {"temperature_c": temperature_c}})
        expect(current).to_have_text(f"{temperature_c:g} °C")
        expect(current).to_have_class(re.compile(f"is-limit--upr is-limit--{colour}"))
    mct.reload()
    expect(mct.get_by_label("Select fault: temperature")).to_be_visible()
    expect(mct.locator(".is-acknowledged").first).to_be_visible()
    expect(mct.get_by_label("Select fault: camera fault")).to_have_count(0)
    event = mct.locator(".c-telemetry-table tr").filter(has_text="camera fault")
    expect(event).to_contain_text("high")


def choose_in_create_menu(page, name):
    """Choose an entry of the menu: the new object becomes part of the one that is shown."""
    page.wait_for_function("() => window.openmct?.router?.path?.length > 0")
    press(page, "Create")
    page.get_by_role("menuitem", name=name, exact=True).click()


def open_plot(page, url):
    """Open the plot of the temperature in the interval of the pass; return its drawing area."""
    instance = spacecraft(url)["instance"]
    end = int(parse_utc("2029-08-07T07:00:00Z")) // 1_000_000
    bounds = f"tc.mode=fixed&tc.startBound={end - 2 * 3_600_000}&tc.endBound={end}&tc.timeSystem=utc"
    page.goto("about:blank")
    page.goto(
        f"/mct#/browse/linna:spacecraft/linna:vehicle~76~{instance}/linna:parameter~76~{instance}~temperature_c?{bounds}"
    )
    area = page.locator(".gl-plot-display-area").first
    expect(area.locator("canvas").first).to_be_visible()
    expect(page.get_by_label("Plot Series Loading")).to_have_count(0)
    return area


def drag_over(page, area, keys):
    """Drag from one corner of a plot to the other with keys held."""
    box = area.bounding_box()
    for key in keys:
        page.keyboard.down(key)
    page.mouse.move(box["x"] + 0.05 * box["width"], box["y"] + 0.05 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.move(box["x"] + 0.95 * box["width"], box["y"] + 0.95 * box["height"])
    page.mouse.up()
    for key in keys:
        page.keyboard.up(key)


def marked(area):
    """Number of coloured pixels of a plot: marks of annotations have the colour of the series."""
    picture = np.asarray(Image.open(io.BytesIO(area.screenshot())).convert("RGB")).astype(int)
    return int((np.ptp(picture, axis=2) > 60).sum())


def test_the_annotation_of_a_plot_is_kept_in_the_browser(mct, shown):
    area = open_plot(mct, shown.url)
    plain = marked(area)
    drag_over(mct, area, ("Alt", "Shift"))
    mct.get_by_role("tab", name="Annotations").click()
    mct.locator(".js-add-tag-button").click()
    mct.get_by_placeholder("Type to select tag").click()
    mct.locator(".js-tag-option", has_text="Anomaly").click()
    expect(mct.locator(".c-tag__label", has_text="Anomaly")).to_be_visible()
    for scheme in "dark", "light":
        mct.emulate_media(color_scheme=scheme)
        again = open_plot(mct, shown.url)
        wait_for(lambda plot=again: marked(plot) > plain + 300, f"the marks are not drawn in the {scheme} theme")


FOLLOW = """async (key) => {
    const object = await openmct.objects.get({ namespace: "linna", key });
    window.followed = [];
    const interval = openmct.time.getBounds();
    const had = await openmct.telemetry.request(object, { ...interval, size: 1000, strategy: "minmax" });
    window.had = Math.max(...had.map((one) => one.utc));
    openmct.telemetry.subscribe(object, (given) => followed.push(...[given].flat()), { strategy: "batch" });
}"""


@mark.parametrize("kind, second", [("events", 10), ("parameter", 20)])
def test_what_comes_within_a_minute_of_the_newest_telemetry_is_shown_once(mct, shown, kind, second):
    instance = spacecraft(shown.url)["instance"]
    receive(shown.url, 20.0, second - 1)
    mct.goto(f"/mct#/browse/linna:spacecraft/linna:vehicle~76~{instance}")
    expect(mct.get_by_text("Live feed connected")).to_be_visible()
    labels = DICTIONARY.labels("navigation_state", "estimator")
    (estimator,) = (code for code, name in labels.items() if name == "spherical")
    state = "navigation_state.spherical.altitude_m"
    key = {"events": f"events~76~{instance}", "parameter": f"parameter~76~{instance}~{state}"}[kind]
    mct.evaluate(FOLLOW, key)
    for at in second, second + 1:
        ticks = int(ticks_from_utc_ns(AFTER)) + at * 65_536
        packets = {
            "navigation_state": {"image_ticks": ticks, "estimator": estimator},
            "event_high": {"event_id": 20, "frame_number": at},
        }
        # Open MCT shows the interval until a minute after the newest telemetry.
        time = upload(shown.url, at, packets)
        mct.wait_for_function(
            "(time) => followed.some((one) => Math.abs(one.utc - time) < 500)", arg=time, timeout=60_000
        )
    if kind == "parameter":  # plots append
        assert mct.evaluate("Number.isFinite(had) && followed.every((one) => one.utc > had)")
    given = mct.evaluate("followed.map((one) => JSON.stringify(one))")
    assert len(given) == len(set(given))
    assert sorted(mct.evaluate("followed.map((one) => one.utc)"))[-2:] == mct.evaluate(
        "followed.map((one) => one.utc).slice(-2)"
    )


def test_the_layout_of_a_payload_engineer_shows_states_series_and_images(mct, shown):
    name = "payload-engineer"
    instance = spacecraft(shown.url)["instance"]
    mct.goto(f"/mct#/browse/linna:spacecraft/linna:vehicle~76~{instance}/linna:{name}~76~{instance}")
    row = mct.get_by_label("lad row").filter(has=mct.get_by_text("frames processed", exact=True))
    expect(row).to_contain_text("2029-08-07")
    # The estimator of the newest state, of the series of all estimators.
    expect(mct.get_by_text("altitude, spherical").first).to_be_visible()
    expect(mct.locator(".gl-plot-display-area canvas").first).to_be_visible()


def test_a_layout_is_kept_in_the_browser(mct):
    mct.goto("/mct#/browse/mine")
    choose_in_create_menu(mct, "Folder")
    mct.get_by_label("Title", exact=True).fill("Shift of Monday")
    mct.get_by_label("Save", exact=True).click()
    expect(mct.get_by_role("region", name="Shift of Monday Object View")).to_be_visible()
    mct.goto("about:blank")
    mct.goto("/mct#/browse/mine")
    expect(mct.get_by_text("Shift of Monday").first).to_be_visible()


def bucket(start, stop, count, low, high, mean, after_gap=False):
    times = {"start": f"2029-08-07T06:00:{start:02d}.000000Z", "stop": f"2029-08-07T06:00:{stop:02d}.000000Z"}
    return times | {"count": count, "min": low, "max": high, "mean": mean, "after_gap": after_gap}


def test_intervals_become_extremes_and_gaps_interrupt_the_line(page):
    page.goto("/licences")
    buckets = [bucket(0, 0, 1, 5.0, 5.0, 5.0), bucket(10, 20, 9, 1.0, 8.0, 4.0, after_gap=True)]
    found = page.evaluate(
        """async (buckets) => {
            const { samplesOf } = await import("/static/mct/telemetry.js");
            const pairs = (samples) => samples.map((one) => [one.utc, one.value]);
            return [pairs(samplesOf(buckets, true)), pairs(samplesOf(buckets, false))];
        }""",
        buckets,
    )
    start = 1_000 * calendar.timegm((2029, 8, 7, 6, 0, 0))
    extremes, means = found
    assert extremes[0] == [start, 5.0] and extremes[2:] == [[start + 10_000, 1.0], [start + 20_000, 8.0]]
    assert extremes[1][0] == start + 1 and math.isnan(extremes[1][1])
    assert means == [[start, 5.0], [start + 15_000, 4.0]]


def test_limits_have_sides_and_severities(page):
    page.goto("/licences")
    found = page.evaluate(
        """async () => {
            const { limitOf } = await import("/static/mct/telemetry.js");
            const limits = { warning: [-10, 50], alarm: [null, 60] };
            return [-11, -10, 50, 51, 60, 61].map((value) => limitOf(value, limits)?.cssClass ?? "");
        }"""
    )
    low, high, alarm = (
        f"is-limit--{side} is-limit--{colour}"
        for side, colour in (("lwr", "yellow"), ("upr", "yellow"), ("upr", "red"))
    )
    assert found == [low, "", "", high, high, alarm]
