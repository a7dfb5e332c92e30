"""Builds, archives and regressions over HTTP."""

import json
from functools import partial
from pathlib import Path
from shutil import make_archive

from pytest import mark

from ground_service.regression.archives import pack_archive
from linna.cli import run
from tests.serving import wait_for

V1 = "/api/v1"


def found(client, path, **params):
    return client.get(f"{V1}/{path}", params=params).json()


def is_done(client, job_id):
    return found(client, f"jobs/{job_id}")["state"] == "done"


def zipped(build):
    return Path(make_archive(str(build.parent), "zip", build.parent)).read_bytes()


def test_a_build_is_registered_held_against_another_and_judged(client, make_flyable, make_build, tmp_path):
    flown = make_flyable(frames=12, seed=51)
    pack_archive(flown.folder, tmp_path / "pass.zip")
    kept = client.post(f"{V1}/regression-archives?pinned=true", content=(tmp_path / "pass.zip").read_bytes())
    assert kept.status_code == 201, kept.text
    assert (kept.json()["frames"], kept.json()["pinned"]) == (12, True)
    digests = []
    for name, options in ("good", {}), ("broken", {"program": "raise SystemExit(4)"}):
        file = make_build(name, {"synthetic pass 51": flown.packets}, **options)
        answer = client.post(f"{V1}/builds", content=zipped(file))
        assert answer.status_code == 201, answer.text
        assert (answer.json()["name"], answer.json()["kind"]) == (name, "command")
        digests.append(answer.json()["digest"])
    assert {item["digest"] for item in found(client, "builds")["items"]} == set(digests)
    for candidate, verdict in zip(digests, ("pass", "fail"), strict=True):
        job = client.post(f"{V1}/regressions", json={"candidate": candidate, "baseline": digests[0]})
        assert job.status_code == 202, job.text
        assert job.json()["kind"] == "regression"
        wait_for(partial(is_done, client, job.json()["id"]), "the end of the regression")
        judged = client.get(job.headers["location"]).json()
        assert judged["verdict"] == verdict
        assert judged["result"]["passes"][0]["archive"] == kept.json()["digest"]
        report = client.get(f"{job.headers['location']}/report")
        assert "Regression report" in report.text
        junit = client.get(f"{job.headers['location']}/report", params={"format": "junit"})
        assert f'<property name="verdict" value="{verdict}" />' in junit.text
    listed = found(client, "regressions")
    assert [(one["verdict"], one["candidate"], one["baseline"]) for one in listed["items"]] == [
        ("fail", digests[1], digests[0]),
        ("pass", digests[0], digests[0]),
    ]
    failed, passed = listed["items"]
    # A program that gives up leaves nothing to hold a gate against.
    assert (failed["gates"], failed["gates_failed"], failed["gates_inconclusive"]) == (0, 0, 0)
    assert (failed["frames"], passed["frames"], passed["frames_needed"]) == (0, 12, None)
    whole = found(client, f"regressions/{passed['id']}")
    deciding = [gate for gate in whole["result"]["gates"] if gate["outcome"] != "informs"]
    assert (passed["gates"], passed["gates_failed"]) == (len(deciding), 0)
    assert whole["result"]["headline"] == "pass: identical in every octet on 12 frames"
    assert passed["gates"] > 0
    second = found(client, "regressions", limit=1, offset=1)
    assert (second["items"], second["total"]) == ([passed], 2)
    assert {one["kind"] for one in found(client, "jobs", kind="regression")["items"]} == {"regression"}
    kinds = [one["kind"] for one in found(client, "jobs")["items"]]
    assert kinds.count("replay") == 2  # the good build's was not done again


@mark.parametrize(
    "body",
    [
        {"candidate": "../../etc/passwd"}, {"candidate": "0" * 64},
        {"candidate": "current", "archives": ["0" * 64]}, {},
    ],
)  # fmt: skip
def test_a_regression_of_nothing_known_is_refused(client, body):
    assert client.post(f"{V1}/regressions", json=body).status_code == 422


def test_something_else_than_a_zip_is_no_build(client):
    refused = client.post(f"{V1}/builds", content=b"name = 'x'")
    assert refused.status_code == 422
    assert "expected a complete zip file, found something else, or a part of one" in refused.text


def test_only_an_administrator_registers_a_program(guarded, make_build):
    client, heads = guarded
    body = zipped(make_build("program"))
    found = {role: client.post(f"{V1}/builds", content=body, headers=one).status_code for role, one in heads.items()}
    assert found == {"viewer": 403, "operator": 403, "admin": 201}


def test_the_suite_states_what_its_passes_can_detect_before_anything_is_run(capsys):
    assert run(["regress", "suite", "low", "plains", "--frames", "49", "--seeds", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["passes"] == [{"scenario": name, "frames": 49} for name in ("low", "low-1", "plains", "plains-1")]
    rows = {one["metric"]: one for one in found["detectable"]}
    assert (rows["detector.recall"]["frames"], rows["detector.recall"]["minutes"]) == (196, 1.0)
    assert 0.03 < rows["detector.recall"]["change"] < 0.15
