"""Builds judged over archived passes: good ones, planted bad ones, and everything that can be wrong with either."""

import dataclasses
import json
import re
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
from pytest import MonkeyPatch, approx, fixture, mark, raises
from sqlalchemy import select

from ground_service.client.local import local_client
from ground_service.errors import InvalidInput
from ground_service.ground import open_ground
from ground_service.regression.archives import (
    check_archive,
    check_out,
    keep_archive,
    kept_archives,
    let_go,
    pack_archive,
    pin_archive,
)
from ground_service.regression.builds import load_build, register_build, registered_build
from ground_service.regression.documents import regression_html, regression_junit, regression_text, verdict_document
from ground_service.regression.gates.policy import load_policy
from ground_service.regression.jobs import run_placebo
from ground_service.regression.model import TELEMETRY_ONLY, ArchiveRecord, KeptReplay
from ground_service.regression.service import (
    calibrations_of,
    condition_of_archive,
    find_replay,
    keep_regression,
    run_regression,
)
from ground_service.regression.store import ARCHIVES, REPLAYS, get_archive
from ground_service.regression.store import keep_archive as store_archive_record
from ground_service.settings import Settings
from ground_service.store.states import change_if
from ground_service.worker.upkeep import remove_archives
from lunar.constants import DAY_NS
from tests.ground_service.conftest import enter_files
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.space_packets import append_crc

Packets = dict[str, list[bytes]]


def altered(packets, change):
    """Packets changed one by one; `change` gets the number and name of each."""
    named = {name: enumerate(some) for name, some in packets.items()}
    return {name: [change(i, DICTIONARY.unpack(one)[0], one) for i, one in some] for name, some in named.items()}


def with_values(name, packet, **changed):
    """A packet with other values."""
    decoded = DICTIONARY.unpack_packet(packet)
    values = {key: value for key, value in decoded.values.items() if key != "count"} | changed
    count = int.from_bytes(packet[2:4], "big") & 0x3FFF
    return DICTIONARY.pack(name, values, ticks=decoded.ticks, sequence_count=count)


def late_headers(number, name, packet):
    """Set the on-board time of three packets of four 7 s late."""
    seconds = int.from_bytes(packet[14:18], "big") + 7 * (number % 4 > 0)
    return append_crc(packet[:14] + seconds.to_bytes(4, "big") + packet[18:-2])


def late_states(number, name, packet):
    """Let navigation states after the 100th packet name an image 7 s late."""
    if name != "navigation_state" or number < 100:
        return packet
    return with_values(name, packet, image_ticks=DICTIONARY.unpack_packet(packet).values["image_ticks"] + 7 * 65536)


def with_detections(packets, change):
    """Packets with the detections of each frame changed."""

    def changed(_, name, packet):
        if name != "detections":
            return packet
        return with_values(name, packet, items=change(DICTIONARY.unpack_packet(packet).values["items"]))

    return altered(packets, changed)


@fixture(scope="module")
def passes(make_flyable):
    return [make_flyable(frames=30, seed=seed, filter_nis=3.0) for seed in (41, 42)]


@fixture(scope="module")
def first(passes):
    return passes[0].folder


@fixture(scope="module")
def packets(passes):
    return {f"synthetic pass {seed}": one.packets for seed, one in zip((41, 42), passes, strict=True)}


@fixture(scope="module")
def home(tmp_path_factory):
    """A service shared by the tests of this file: replays of the good build are done once."""
    with open_ground(tmp_path_factory.mktemp("regressions")) as ground:
        yield ground


@fixture
def policy():
    return load_policy()


@fixture
def judge(home, passes, packets, make_build, policy):
    """Hold a build that sends these packets against the build that flew."""

    def run(given=None, archives=None, repeated=False, **options):
        baseline = register_build(home, load_build(make_build("good", packets)))
        candidate = register_build(home, load_build(make_build("candidate", given or packets, **options)))
        return run_regression(
            home, archives or [one.folder for one in passes], candidate, baseline, policy, workers=2, repeated=repeated
        )

    return run


def replays(connection):
    return list(connection.execute(select(REPLAYS.c.id, REPLAYS.c.downlink_sha256)))


def gate(outcome, name):
    return next(gate for gate in outcome.gates if gate.name == name and not gate.pass_id)


def ended(outcome):
    return outcome.verdict, verdict_document(outcome).exit_status


def failed(outcome):
    return {gate.name for gate in outcome.gates if gate.outcome == "fail"}


def test_a_build_that_says_the_same_passes(judge):
    outcome = judge()
    assert ended(outcome) == ("pass", 0)
    assert failed(outcome) == set()
    # One scored crater in four is left out by the synthetic pass, and some at the edges.
    assert 0.6 < gate(outcome, "detector.recall").baseline == gate(outcome, "detector.recall").candidate < 0.76
    assert gate(outcome, "detector.bias").baseline == approx(np.hypot(0.5, 1.25), abs=0.02)
    assert gate(outcome, "navigation.spherical.p50").baseline == approx(130.0, abs=0.5)


def test_a_bias_of_seven_tenths_of_a_pixel_fails_as_a_centre_error(judge, packets):
    outcome = judge(with_detections(packets, lambda items: items | {"u_px": items["u_px"] + 0.7}))
    assert verdict_document(outcome).exit_status == 1
    assert failed(outcome) == {"detector.localisation"}
    headline = verdict_document(outcome).headline
    assert re.match(r"fail: centre error rises by 0\.\d+ px \(", headline)
    assert headline.endswith("navigation holds: share of fixes 1 to 1, median position error 30 to 30 m")


def test_processor_times_are_compared_only_of_replays_at_the_same_time(judge, monkeypatch):
    judge()  # the baseline is replayed before
    outcome = judge(network_ms=20.0)
    assert (outcome.verdict, gate(outcome, "latency.total").outcome) == ("pass", "not judged")
    assert verdict_document(outcome).headline.endswith("; latency was not judged")
    message = "no latency is compared on 2 of 2 passes: the builds were not replayed at the same time"
    assert message in outcome.remarks
    one = KeptReplay(outcome="ok", detail="", machine="a", wall_s=8.0)
    changed = ({"created_utc_ns": at} for at in (3e9, 5e9))
    slow = {"created_utc_ns": 24e9, "wall_s": 32.0}  # begins with the other and takes four times as long
    overlaps = [one.overlaps(one.model_copy(update=values)) for values in (*changed, {"machine": "b"}, slow)]
    assert overlaps == [True, False, False, True]
    # Short replays of a loaded machine may miss each other.
    monkeypatch.setattr(KeptReplay, "overlaps", lambda _one, _other: True)
    again = judge(network_ms=20.0, repeated=True)
    assert {gate.name for gate in again.gates if gate.name.startswith("latency.")} >= failed(again) >= {"latency.total"}


@mark.parametrize(
    "fault, message",
    [
        (late_headers, "contradict the image or step that they report, by up to 7.0 s"),
        (late_states, "navigation_state packets name a time at which no image was taken"),
    ],
)
def test_packets_with_times_that_contradict_their_images_fail_in_one_sentence(judge, packets, fault, message):
    given = altered(packets, fault)
    outcome = judge(given)
    assert failed(outcome) - {"telemetry.frames_without_value"} == {"telemetry.times"}
    times = gate(outcome, "telemetry.times")
    moved = sum(a != b for name in given for a, b in zip(given[name], packets[name], strict=True))
    assert times.baseline == 0 < moved <= times.candidate
    assert message in verdict_document(outcome).headline


def test_packets_out_of_order_fail_in_one_sentence(judge, packets):
    outcome = judge({name: [*some[40:], *some[:40]] for name, some in packets.items()})
    assert failed(outcome) == {"telemetry.times"}
    assert "packets more than in the baseline are out of order in time" in verdict_document(outcome).headline


@mark.parametrize(
    "program, message",
    [
        ("raise SystemExit('no network found')", "candidate crashed: exit status 1: no network found"),
        ("import time; time.sleep(60)", "candidate hung: stopped at its time limit"),
        (
            "import sys, pathlib\npathlib.Path(sys.argv[2], 'downlink.packets').write_bytes(b'garbage' * 900)",
            "candidate wrote a downlink that is no telemetry",
        ),
        (
            "import sys, pathlib\npathlib.Path(sys.argv[2], 'x').write_bytes(bytes(9 << 20))",
            "candidate wrote more than it is allowed",
        ),
        ("x = bytearray(1 << 30)", "candidate ran out of the memory it is allowed"),
        ("pass", "candidate ended without a downlink"),
    ],
)
def test_a_build_that_fails_on_a_pass_is_reported_and_fails(judge, first, program, message):
    limits = "[limits]\nwall_s = 2\nmemory_mib = 300\nfile_mib = 4\n"
    outcome = judge(archives=[first], program=program, extra=limits)
    assert ended(outcome) == ("fail", 1)
    assert outcome.passes[0].state == "candidate failed"
    assert outcome.passes[0].detail.startswith(message)


def test_a_build_that_fails_on_one_pass_is_judged_on_the_others(judge, packets):
    name = "synthetic pass 41"
    outcome = judge({name: packets[name]})
    assert [item.state for item in outcome.passes] == ["judged", "candidate failed"]
    assert "crashed" in outcome.passes[1].detail
    assert outcome.gates and failed(outcome) == set()
    assert outcome.verdict == "fail"


@fixture
def copy(first, tmp_path):
    return shutil.copytree(first, tmp_path / "copy")


def test_a_placebo_leaves_the_noise_of_its_metrics_and_marks_gates_that_reject_equal_builds(
    judge, home, passes, packets, make_build, policy
):
    build = register_build(home, load_build(make_build("itself", packets)))
    digests = [keep_archive(home, one.folder).digest for one in passes]
    before = home.read(replays)
    outcome = run_placebo(home, digests, build, policy, 7, workers=2)
    assert (outcome.verdict, outcome.baseline, outcome.candidate) == ("pass", build, build)
    assert outcome.remarks[-1].endswith("other noise in the images, seed 7")
    recall = [one for one in outcome.noise if one.metric == "detector.recall"]
    assert [(one.loss, one.condition.split(", ")[1]) for one in recall] == 2 * [(0.0, "above 25 km")]
    assert home.read(replays) == before
    with MonkeyPatch.context() as patched:
        patched.setattr("ground_service.regression.service.publish", publish := MagicMock())
        keep_regression(home, outcome)
    publish.assert_not_called()  # nobody is notified
    assert all(one.calibrated for one in calibrations_of(home))
    recall = [one.model_copy(update={"p_value": 0.0}) for one in recall]
    for _ in range(2):
        keep_regression(home, dataclasses.replace(outcome, noise=tuple(recall)))
    message = "uncalibrated: detector.recall: 4 of 6 placebos rejected at 0.05"
    marked = judge()
    assert gate(marked, "detector.recall").reason == f"identical in every octet; {message}"
    assert message in marked.remarks
    assert verdict_document(marked).headline == "pass: identical in every octet on 60 frames"


def test_a_tampered_archive_is_reported_and_the_rest_goes_on(judge, passes, copy):
    (copy / "reference.oem").write_text((copy / "reference.oem").read_text().replace("1", "2", 1))
    outcome = judge(archives=[copy, passes[1].folder])
    assert [item.state for item in outcome.passes] == ["unusable", "judged"]
    assert "SHA-256" in outcome.passes[0].detail and "reference.oem" in outcome.passes[0].detail
    assert ended(outcome) == ("inconclusive", 2)
    assert verdict_document(outcome).headline.startswith("inconclusive: copy: ")


def test_a_program_does_not_replay_a_pass_without_frames(judge, passes, copy):
    for number in 7, 9:
        (copy / f"frames/{number:06d}.png").unlink()
    enter_files(copy)
    outcome = judge(archives=[copy, passes[1].folder])
    assert outcome.passes[0].state == "not judged"
    assert "2 of 30 frames are not stored, the first 7" in outcome.passes[0].detail


def test_an_archive_or_a_build_for_another_camera_is_reported(judge, first, copy):
    camera = json.loads((copy / "manifest.json").read_text())["camera"]
    enter_files(copy, camera=camera | {"width_px": 1024})
    of_build = judge(archives=[first], extra="[camera]\nfov_deg = 60\n").passes[0]
    assert of_build.state == "candidate failed"
    assert "made for another camera: expected fov_deg 60, found 120" in of_build.detail
    [of_archive] = judge(archives=[copy]).passes
    assert "expected an image of the camera of 1024 x 512 px, found 512 x 512 px" in of_archive.detail


def test_something_that_is_no_archive_is_reported(judge, first, tmp_path):
    (tmp_path / "note.txt").write_text("hello")
    outcome = judge(archives=[tmp_path / "note.txt", tmp_path / "gone", first])
    assert [item.state for item in outcome.passes] == ["unusable", "unusable", "judged"]


def test_a_replay_is_done_once_and_one_that_failed_again(home, judge, first, make_build, policy):
    outcome = judge()
    digest = keep_archive(home, first).digest
    before = find_replay(home, digest, outcome.candidate)
    flown = []

    def run(candidate):
        def progress(items, total):
            flown.append(total)
            return iter(items)

        run_regression(home, [first], candidate, outcome.baseline, policy, progress=progress)

    run(outcome.candidate)
    assert flown == []
    assert find_replay(home, digest, outcome.candidate) == before
    broken = register_build(home, load_build(make_build("broken", program="raise SystemExit(3)")))
    for _ in range(2):
        run(broken)
    assert flown == [1, 1]


JUNIT = {
    "testsuite": {"name", "timestamp", "hostname", "tests", "failures", "errors", "skipped", "time"},
    "properties": set(),
    "property": {"name", "value"},
    "testcase": {"name", "classname", "time"},
    "failure": {"message", "type"},
    "error": {"message", "type"},
    "skipped": {"message"},
    "system-out": set(),
    "system-err": set(),
}
"""Attributes that both the schema of the Jenkins xUnit plugin (junit-10.xsd) and that of Apache Ant permit and need."""


def test_the_verdict_is_written_as_json_junit_and_text(judge, packets, copy, passes):
    (copy / "catalogue.csv").write_text("")
    worse = with_detections(packets, lambda items: items | {"v_px": items["v_px"] - 1.0})
    outcome = judge(worse, archives=[copy, *(one.folder for one in passes)])
    verdict = verdict_document(outcome)
    figures = json.loads(json.dumps(verdict.document(), allow_nan=False))
    assert figures["verdict"] == "fail"
    assert {"name", "baseline", "candidate", "limit", "passed"} <= set(figures["gates"][0])
    assert [one["state"] for one in figures["passes"]] == ["unusable", "judged", "judged"]
    assert figures["passes"][1]["candidate"]["outcome_shares"]["paper"] == {"multi": 1.0}
    suite = ET.fromstring(regression_junit(verdict, 1_880_000_000 * 10**9 + 5))
    cases = suite.findall("testcase")
    counts = {name: int(suite.attrib[name]) for name in ("tests", "errors", "failures")}
    outcomes = [gate.outcome for gate in outcome.gates]
    assert counts == {
        "tests": len(cases), "errors": len(suite.findall("testcase/error")), "failures": outcomes.count("fail"),
    }  # fmt: skip
    assert len(cases) == len(outcomes) - outcomes.count("informs") + 3
    assert counts["errors"] == 1 and counts["failures"] > 0
    assert suite.attrib["name"] == "linna regress candidate"
    assert suite.attrib["timestamp"] == "2029-07-29T06:13:20"
    times = [float(case.attrib["time"]) for case in cases]
    assert times[0] == 0.0 and min(times[1:3]) > 0.0  # nothing was run on the unusable archive
    assert float(suite.attrib["time"]) == approx(sum(times), abs=0.01)
    for element in suite.iter():
        assert set(element.attrib) == JUNIT[element.tag], element.tag
    # The stricter schema demands this order, and one result for each case.
    order = ["properties", *["testcase"] * len(cases), "system-out", "system-err"]
    assert [child.tag for child in suite] == order
    for case in cases:
        assert len(case) <= 1 and case.attrib["name"] == " ".join(case.attrib["name"].split())
    text = regression_text(verdict)
    assert text.splitlines()[0] == figures["headline"]
    assert "detector.localisation" in text and "unusable" in text


def test_a_crash_is_one_failure_and_the_last_lines_of_its_program_are_in_every_output(home, judge, first):
    program = "for k in range(50): print('line', k)\nraise RuntimeError('no network')"
    outcome = judge(archives=[first], program=program)
    verdict = verdict_document(outcome)
    (one,) = verdict.document()["passes"]
    lines = one["candidate"]["printed"].splitlines()
    assert (len(lines), lines[-1], one["baseline"]["printed"]) == (40, "RuntimeError: no network", None)
    suite = ET.fromstring(regression_junit(verdict, 0))
    assert [suite.attrib[name] for name in ("tests", "failures", "errors", "skipped")] == ["1", "1", "0", "0"]
    message = f"candidate crashed: exit status 1: {lines[-1]}"
    assert suite.find("testcase[@name='synthetic pass 41']/failure").attrib["message"].endswith(message)
    assert verdict.headline == f"fail: {message}, on synthetic pass 41"
    page = regression_html(home, outcome, "0" * 32)
    for text in regression_text(verdict), suite.findtext("system-err"), page:
        assert "Traceback (most recent call last)" in text and "line 49" in text


def test_a_zip_of_an_archive_is_the_archive(first, tmp_path, ground):
    packed = [tmp_path / name for name in ("a.zip", "b.zip")]
    for one in packed:
        pack_archive(first, one)
    assert packed[0].read_bytes() == packed[1].read_bytes()
    kept = keep_archive(ground, packed[0])
    assert kept.digest == check_archive(first).digest
    out = check_out(ground, kept.digest, tmp_path / "out").folder
    assert (out / "downlink.cadu").read_bytes() == (first / "downlink.cadu").read_bytes()


def test_archives_go_by_age_and_by_size_with_a_record_and_pinned_ones_stay(passes, ground, tmp_path):
    first, second = (keep_archive(ground, one.folder) for one in passes)
    octets = {one.digest: one.octets for one in kept_archives(ground)}
    assert let_go(ground, unused_for_ns=10**18) == []
    assert remove_archives(ground, 0, 0) == remove_archives(ground, 1, 1 << 20) == 0
    assert let_go(ground, unused_for_ns=None, limit_octets=sum(octets.values())) == []
    # One without frames goes before one that was used earlier.
    with ground.database.writing() as connection:
        change_if(connection, ARCHIVES, second.digest, {}, state=TELEMETRY_ONLY)
    assert let_go(ground, unused_for_ns=None, limit_octets=octets[first.digest]) == [second.digest]
    keep_archive(ground, passes[1].folder)
    # The one that was used before the other goes first, and only as many as need to go.
    assert let_go(ground, unused_for_ns=None, limit_octets=octets[second.digest], actor="ann") == [first.digest]
    pin_archive(ground, second.digest, True)
    assert let_go(ground, unused_for_ns=0) == let_go(ground, unused_for_ns=None, limit_octets=0) == []
    # Both held the same gray image: it is still there for the one that stays.
    assert check_out(ground, second.digest, tmp_path / "out").frames == 30
    pin_archive(ground, second.digest, False)
    assert let_go(ground, unused_for_ns=None, limit_octets=0) == [second.digest]
    with local_client(ground, "ann") as client:
        entries = list(client.list_audit())
    removals = [one for one in entries if one.action == "remove regression archive"]
    assert [(one.actor, one.target) for one in removals] == [
        ("service", second.digest),
        ("ann", first.digest),
        ("service", second.digest),
    ]
    assert removals[1].detail["octets"] == octets[first.digest]


def test_the_archive_of_a_rare_condition_outlasts_one_that_was_used_later(passes, ground):
    kept = [keep_archive(ground, passes[0].folder).digest]
    for name in "xyz":
        add = ArchiveRecord(**ground.read(get_archive, kept[0]).model_dump() | {"digest": name})
        with ground.database.writing() as connection:
            store_archive_record(connection, add)
            change_if(connection, ARCHIVES, kept[0], {}, used_utc_ns=0)  # the longest unused
    place = {kept[0]: "sparse", "x": "cratered", "y": "cratered", "z": "cratered"}
    octets = kept_archives(ground)[0].octets
    assert let_go(ground, unused_for_ns=None, limit_octets=2 * octets, condition=place.__getitem__) == ["x", "y"]
    assert condition_of_archive(ground, kept[0]) == "cratered, above 25 km"


def test_the_settings_say_how_long_archives_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("LINNA_ARCHIVE_DAYS", "400")
    monkeypatch.setenv("LINNA_ARCHIVE_LIMIT_MIB", "2000")
    kept = Settings(home=tmp_path).kept
    assert kept == {
        "retention_days": 90,
        "archive_days": 400,
        "archive_limit_mib": 2000,
        "audit_heads": None,
        "placebo_passes": 3,
    }
    with MonkeyPatch.context() as patched:
        called = MagicMock(return_value=[])
        patched.setattr("ground_service.worker.upkeep.let_go", called)
        assert remove_archives(MagicMock(), kept["archive_days"], kept["archive_limit_mib"]) == 0
    kept_for = {"unused_for_ns": 400 * DAY_NS, "limit_octets": 2000 << 20}
    assert kept_for.items() <= called.call_args.kwargs.items()


def test_a_registered_build_is_found_by_the_beginning_of_its_identity(ground, make_build, packets):
    build = register_build(ground, load_build(make_build("kept", packets)))
    assert registered_build(ground, build.digest[:12]).digest == build.digest
    (build.folder / "fly.py").write_text("changed behind its back")
    with raises(InvalidInput, match="it was registered with"):
        registered_build(ground, build.digest)


WRONG_POLICIES = """
 -> schema_version: expected 3, found None
schema_version = 2 -> schema_version: expected 3, found 2
versoin = 'x' -> versoin: expected 'version', found unknown key 'versoin'
alpha = 0.01 -> alpha: expected schema_version, version, inconclusive, fail, gate
{metric='x', margn=1.0, reason='y'} -> gate.1.margn: expected 'margin', found unknown key 'margn'
{metric='x', margin=1.0} -> gate.1.reason: expected a value, found nothing
{metric='x', margin=1.0, reason=' '} -> gate.1.reason: expected
{metric='x', margin='much', reason='y'} -> gate.1.margin: expected a valid number, found 'much'
{metric='x', margin=0.1, reason='y'} -> gate.1.weight: expected a weight above 0, found 0
{metric='memory', weight=0.1, margin=0.1, reason='y'} \
-> gate.1.weight: expected no weight: the metric is exact, found 0.1
{metric='x', weight=0.1, materiality=0.1, margin=0.1, reason='y'} \
-> gate.1.margin: expected more than the materiality 0.1, found 0.1
{metric='x', weight=0.1, margin=0.1, reason='y'} -> gate: expected weights above 0 that sum to at most 1, found 1.1
fail = {level=1.5, reason='y'} -> fail.level: expected less than or equal to 0.2, found 1.5
"""


@mark.parametrize("row", WRONG_POLICIES.strip("\n").split("\n"))
def test_a_bad_policy_is_refused_with_its_key(row, tmp_path):
    text, message = row.split(" -> ")
    good = "{metric='detector.recall', weight=1, margin=0.1, reason='small'}"
    whole = {"schema_version": "3", "version": "'1'", "fail": "{level=0.01, reason='usual'}", "gate": f"[{good}]"}
    if text.startswith("{"):
        text = f"gate = [{good}, {text}]"
    whole.pop(text.partition(" ")[0] or "schema_version", None)
    lines = [text, *(f"{key} = {value}" for key, value in whole.items())]
    (tmp_path / "policy.toml").write_text("\n".join(lines))
    with raises(InvalidInput) as error:
        load_policy(tmp_path / "policy.toml")
    assert message in str(error.value)


def test_the_shipped_policy_gives_a_reason_for_every_number():
    policy = load_policy().policy
    assert (policy.fail_level, policy.inconclusive) == (0.01, "failure")
    assert all(len(rule.reason) > 20 for rule in policy.rules)
    assert sum(rule.weight for rule in policy.rules) == approx(1.0)
    assert load_policy(Path("ci")) == load_policy()


def changed_here_and_there(items):
    """Return detections of a slightly different build: every twelfth is missing in some frames."""
    kept = np.arange(len(items["u_px"])) % 12 != int(items["u_px"].sum()) % 17
    return {name: values[kept] for name, values in items.items()}


def test_a_build_that_differs_on_few_frames_is_inconclusive_with_the_frames_needed(judge, home, packets, policy):
    strict = tuple(
        dataclasses.replace(rule, window_margin=0.045, window_materiality=0.04)
        if rule.metric == "detector.recall"
        else rule
        for rule in policy.policy.rules
    )
    changed = judge(with_detections(packets, changed_here_and_there))
    outcome = run_regression(
        home,
        [one.digest for one in changed.passes],
        changed.candidate,
        changed.baseline,
        dataclasses.replace(policy, policy=dataclasses.replace(policy.policy, rules=strict)),
    )
    assert ended(outcome) == ("inconclusive", 3)
    recall = gate(outcome, "detector.recall")
    assert (recall.outcome, recall.frames) == ("inconclusive", 60)
    assert recall.change_high > recall.margin == 0.045 > recall.change_low
    assert outcome.frames_judged == 60
    assert outcome.frames_needed is not None and outcome.frames_needed >= (recall.frames_needed or 0) > 60
    verdict = verdict_document(outcome)
    assert f"about {outcome.frames_needed:,} frames decide, 60 were compared" in verdict.headline
    assert "inconclusive: detector.recall" in regression_text(verdict)
    figures = verdict.document()
    assert (figures["verdict"], figures["frames"]) == ("inconclusive", 60)
    assert figures["frames_needed"] == outcome.frames_needed
    for policy, kind in ("failure", "failure"), ("skip", "skipped"):
        chosen = verdict.model_copy(update={"policy": verdict.policy.model_copy(update={"inconclusive": policy})})
        case = ET.fromstring(regression_junit(chosen, 0)).find(f"testcase[@name='detector.recall']/{kind}")
        assert "frames decide it, 60 compared" in case.attrib["message"]


def test_a_regression_without_a_gate_is_never_a_pass(judge):
    nothing = dataclasses.replace(judge(), gates=())
    assert ended(nothing) == ("inconclusive", 3)
    verdict = verdict_document(nothing)
    assert verdict.headline == "inconclusive: no gate was judged"
    assert ET.fromstring(regression_junit(verdict, 0)).attrib["failures"] == "1"
