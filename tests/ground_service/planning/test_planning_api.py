"""Windows over the interface: searched, entered, decided on, uplinked, followed by telemetry, exchanged."""

from pytest import fixture, mark

from ground_service.app import create_app
from ground_service.passes.span import ObservationSpan, Planned, belongs_to
from ground_service.settings import Settings
from lunar.timescales import format_utc, parse_utc, ticks_from_utc_ns
from tests.ground_service.conftest import Downlink, event_packet
from tests.serving import TestClient
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.link.uplink import UplinkDecoder

V1 = "/api/v1"
NS = 1_000_000_000
START = parse_utc("2029-08-07T06:00:00Z")


def at(seconds):
    return format_utc(START + int(seconds * NS), 0)


@fixture
def client(synthetic_pass, tmp_path, monkeypatch):
    """A service with the reference ephemeris of the synthetic pass and nothing else, not even public data."""
    monkeypatch.delenv("LINNA_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "nothing"))
    with TestClient(create_app(Settings(home=tmp_path), inline_jobs=True)) as opened:
        octets = (synthetic_pass.folder / "reference.oem").read_bytes()
        assert opened.post(f"{V1}/ephemerides", content=octets).status_code == 201
        yield opened


def window(client, start_s, stop_s, **fields):
    body = {"start": at(start_s), "stop": at(stop_s), "spacecraft_id": 76} | fields
    return client.post(f"{V1}/windows", json=body)


def approved(client, start_s, stop_s, **fields):
    made = window(client, start_s, stop_s, **fields)
    assert made.status_code == 201, made.text
    key = made.json()["id"]
    answer = change(client, key)
    assert answer.status_code == 200, answer.text
    return int(key)


def shown(client, key):
    return client.get(f"{V1}/windows/{key}").json()


def change(client, key, state="approved", **fields):
    return client.patch(f"{V1}/windows/{key}", json={"state": state, **fields})


def uplink(client, key):
    return client.post(f"{V1}/windows/{key}/uplink")


def sent(client, key):
    """Release the telecommands of a window and take the uplink."""
    uplink(client, key)
    return client.post(f"{V1}/uplink?spacecraft_id=76").content


def receive(client, packets):
    assert client.post(f"{V1}/telemetry", content=encode_cadus(packets, spacecraft_id=76)).status_code == 202


def test_windows_are_searched_over_the_uploaded_ephemeris(client):
    def search(asked):
        return client.post(f"{V1}/windows/search", json=asked)

    body = {
        "altitude_km": {"min": 29, "max": 31}, "maximum_duration_s": 600, "spacecraft_id": 76,
        "minimum_battery": 0.1,
    }  # fmt: skip
    document = search(body).json()
    altitude = document["candidates"][0]["altitude_km"]
    assert 29.9 < altitude["min"] <= altitude["max"] < 30.1
    assert document["contacts"]
    assert search({"altitude_km": {"min": 50, "max": 60}}).json()["candidates"] == []
    for refused in (
        {"craters_per_frame": 5},  # no catalogue here
        {"terrain": "mare"},  # no map here
        {"start": at(0), "stop": at(-60)},
        {"start": "2001-01-01T00:00:00Z", "stop": "2001-01-02T00:00:00Z", "ephemeris_id": 1},
        {"altitude_km": {"min": 2, "max": 1}},
        {"start": "yesterday"},
    ):
        answer = search(refused)
        assert answer.status_code == 422, (refused, answer.text)


def test_what_overlaps_a_committed_window_is_answered_with_409(client):
    first = approved(client, 0, 300)
    overlapping = window(client, 299, 500)
    assert overlapping.status_code == 409
    assert overlapping.json()["errors"] == [
        {"where": f"window {first}", "detail": f"window {first} (approved) covers part of the same time"}
    ]
    assert window(client, 300, 500).status_code == 201
    assert window(client, 400, 600, predecessor_id=99).status_code == 404
    assert window(client, 200, 600, instance="other", predecessor_id=first).status_code == 404
    assert window(client, 310, 300).status_code == 422


def test_drafts_may_overlap_but_only_one_can_be_approved(client):
    keys = [window(client, 0, 300).json()["id"] for _ in range(2)]
    assert change(client, keys[0]).status_code == 200
    assert change(client, keys[1]).status_code == 409
    assert change(client, keys[1], start=at(300), stop=at(400)).status_code == 200
    assert client.patch(f"{V1}/windows/{keys[1]}", json={"cadence_s": 5}).status_code == 409


def test_resources_that_do_not_suffice_are_a_conflict(client):
    for stated, expected in (
        ("storage_mib = 0.001", "octets would be stored on board"),
        ("battery_wh = 1.0\ngeneration_w = 0.0", "the battery would fall to"),
    ):
        text = f'name = "small"\n[spacecraft]\nid = 76\n[resources]\n{stated}\n'
        assert client.post(f"{V1}/missions", content=text).status_code == 201
        refused = window(client, 0, 300)
        assert refused.status_code == 409 and expected in refused.json()["detail"]


def test_a_change_of_what_somebody_else_changed_is_refused(client):
    made = window(client, 0, 300)
    tag = made.headers["etag"]
    path = f"{V1}/windows/{made.json()['id']}"
    assert client.patch(path, json={"name": "mine"}, headers={"If-Match": tag}).status_code == 200
    assert client.patch(path, json={"name": "theirs"}, headers={"If-Match": tag}).status_code == 412
    assert client.delete(path, headers={"If-Match": tag}).status_code == 412
    assert client.delete(path).status_code == 204
    assert client.get(path).status_code == 404


def test_an_approved_window_becomes_time_tagged_telecommands(client):
    key = approved(client, 60, 360, cadence_s=10)
    preview = client.get(f"{V1}/windows/{key}/telecommands").json()["items"]
    assert [one["name"] for one in preview] == ["enable_schedule", "perform_function", "perform_function"]
    assert [one["time"] for one in preview[1:]] == [f"{at(seconds)[:-1]}.000000Z" for seconds in (60, 360)]
    assert preview[1]["text"] == "function start observation, duration 310 s, cadence 10 s"
    assert client.get(f"{V1}/telecommands").json()["total"] == 0
    assert uplink(client, key).json()["total"] == 3
    again = uplink(client, key).json()
    assert [one["name"] for one in again["items"]] == ["enable_schedule", "insert_activity", "insert_activity"]
    stream = client.post(f"{V1}/uplink?spacecraft_id=76").content
    packets = [DICTIONARY.unpack_command(packet) for packet in UplinkDecoder(76).decode(stream).packets]
    assert [packet.name for packet in packets] == ["enable_schedule", "insert_activity", "insert_activity"]
    inner = []
    for packet, seconds in zip(packets[1:], (60, 360), strict=True):
        assert packet.values["release_ticks"] == ticks_at(seconds)
        inner.append(DICTIONARY.unpack_command(bytes(packet.values["items"]["octet"].astype("u1"))))
    assert [one.values["function_id"] for one in inner] == [2, 3]
    assert (inner[0].values["argument_1"], inner[0].values["argument_2"]) == (310.0, 10.0)
    counts = [one.sequence_count for one in (*packets, *inner)]
    assert len(set(counts)) == len(counts)
    assert shown(client, key)["state"] == "uplinked"
    assert client.delete(f"{V1}/windows/{key}").status_code == 409
    assert change(client, key, "draft").status_code == 409
    failed = change(client, key, "failed", reason="spacecraft in safe mode")
    assert failed.json()["reason"] == "spacecraft in safe mode"


def test_a_draft_or_a_failed_window_is_not_uplinked(client):
    key = window(client, 0, 300).json()["id"]
    assert uplink(client, key).status_code == 409
    before = approved(client, 400, 500)
    after = approved(client, 600, 700, predecessor_id=before)
    change(client, before, "failed", reason="x")
    assert uplink(client, after).status_code == 409


def ticks_at(seconds):
    return int(ticks_from_utc_ns(START + int(seconds * NS)))


class Observations(Downlink):
    """Packets of a payload; times in seconds after START."""

    def event(self, name, seconds, frame=0, until=None):
        planned = float(ticks_at(until)) if until else 0.0
        values = {"event_id": name, "frame_number": frame, "value_1": planned, "value_2": 0.0}
        self.send("event_info", values, ticks_at(seconds))

    def images(self, first, times):
        for number, seconds in enumerate(times, first):
            image = {"frame_number": number, "image_ticks": ticks_at(seconds)}
            self.send("detections", {**image, "image_quality": 0, "items": []}, ticks_at(seconds))


def telemetry(frames=5):
    """Return the packets of a payload about an observation that begins at START + 60 s and ends 60 s later."""
    sent = Observations()
    sent.event("observation_started", 60)
    sent.images(0, range(60, 60 + 15 * frames, 15))
    sent.event("observation_stopped", 120)
    sent.event("mode_changed", 600)
    return sent.packets


@mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_the_state_follows_telemetry_in_whatever_order_it_comes(client, order):
    key = approved(client, 60, 120)
    sent(client, key)
    packets = telemetry()
    pieces = [packets[:3], packets[3:7], packets[7:]]
    seen = []
    for number in order:
        receive(client, pieces[number])
        seen.append(shown(client, key)["state"])
    assert seen[-1] == "processed"  # the default rules have made its report
    if order == (0, 1, 2):
        assert seen[:2] == ["executing", "executed"]
    window = shown(client, key)
    assert client.get(f"{V1}/passes/{window['pass_id']}").json()["manifest"]["window_id"] == key
    assert client.post(f"{V1}/passes/{window['pass_id']}/reports").status_code == 202
    assert shown(client, key)["state"] == "processed"


@mark.parametrize(
    "received, last_s, expected",
    [
        ((8, 9), 600, "failed"),  # nothing is missing
        ((1, 9), 600, "uplinked"),
        ((1, 9), 13 * 3600, "failed"),  # what is missing is not expected any more
    ],
)
def test_a_window_without_images_fails_when_no_packet_of_its_time_may_come(
    client, mission_time, received, last_s, expected
):
    key = approved(client, 1860, 1920)
    sent(client, key)
    mission_time.utc_ns = START + (1920 + last_s) * NS
    for count, seconds in zip(received, (1700, 1920 + last_s), strict=True):
        receive(client, [event_packet(ticks_at(seconds), count)])
    assert shown(client, key)["state"] == expected


def test_a_window_with_a_value_of_another_kind_is_refused(client):
    names = [("name", name) for name in ("two\nlines", "\x1b[2J", "nul\x00")]
    for field, value in (*names, ("cadence_s", True), ("spacecraft_id", True), ("spacecraft_id", 1024)):
        assert window(client, 0, 300, **{"name": "n", field: value}).status_code == 422, field
    assert client.get(f"{V1}/windows").json()["total"] == 0


def test_of_two_decisions_the_second_is_refused_with_the_state_that_won(client):
    key = approved(client, 0, 300)
    assert change(client, key, "failed").status_code == 200
    answer = change(client, key)
    assert (answer.status_code, answer.json()["state"]) == (409, "failed")
    assert uplink(client, key).json()["state"] == "failed"


def test_each_window_has_the_frames_that_its_event_reports_enclose(client):
    """Adjacent windows, one that was interrupted and begun again, and one whose images were lost."""
    spans = ((60, 120), (120, 180), (200, 260), (270, 330))
    keys = [approved(client, *span, cadence_s=10) for span in spans]
    sent = Observations()

    def observe(first, times, stop, until, lost=0):
        sent.event("observation_started", times[0], first, until)
        sent.images(first, times)
        del sent.packets[len(sent.packets) - lost :]
        if stop:
            sent.event("observation_stopped", stop, first + len(times))

    observe(0, range(60, 120, 10), None, 120)  # the next window begins at its end
    observe(6, range(120, 180, 10), 181, 180)
    observe(12, range(200, 230, 10), 225, 260)  # aborted, and begun again
    observe(15, range(240, 270, 10), 262, 260)
    observe(18, range(270, 330, 10), 331, 330, lost=4)
    sent.event("mode_changed", 900)
    receive(client, sent.packets)
    found = [shown(client, key) for key in keys]
    counts = []
    for one in found:
        account = client.get(f"{V1}/passes/{one['pass_id']}/completeness").json()
        images = next(row for row in account["by_apid"] if row["name"] == "detections")
        counts.append((images["packets"], images["lost_at_edges"]))
    assert counts == [(6, 0), (6, 0), (6, 0), (2, 4)]


def test_an_observation_has_one_window_the_nearest_and_of_equal_ones_the_last():
    first, later, same = Planned(0, 100, 1), Planned(30, 130, 2), Planned(0, 100, 3)
    begun = ObservationSpan(30, 131, 130)
    assert not belongs_to(begun, first, [later], 60) and belongs_to(begun, later, [first], 60)
    again = ObservationSpan(0, 100, 100)
    assert not belongs_to(again, first, [same], 60) and belongs_to(again, same, [first], 60)
    assert not belongs_to(ObservationSpan(None, 40), later, [], 60)  # the end of the one before
    assert belongs_to(begun, Planned(-50, 150), [], 60)
