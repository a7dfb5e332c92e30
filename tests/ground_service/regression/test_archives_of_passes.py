"""Regression archives of passes: kept by a rule, named by the pass, rendered or without frames."""

import dataclasses
import hashlib
import json
import shutil
import threading
from unittest.mock import MagicMock

import numpy as np
from PIL import Image
from pytest import approx, fixture, mark, raises

from ground_service.client.local import local_client
from ground_service.errors import InvalidInput
from ground_service.ground import open_ground
from ground_service.http.model import UtcTime
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import JobFilter, list_jobs
from ground_service.passes.archive_import import import_archive, read_manifest
from ground_service.passes.service import define_pass
from ground_service.regression import rendering, service, store
from ground_service.regression.archives import (
    check_out,
    keep_archive,
    kept_archives,
    let_go,
    store_of,
    write_flight_view,
)
from ground_service.regression.builds import load_build, register_build
from ground_service.regression.documents import regression_junit, regression_text, verdict_document
from ground_service.regression.gates.policy import load_policy
from ground_service.regression.jobs import compared, missing_replays
from ground_service.regression.model import ArchiveRecord, Comparison, KeptReplay
from ground_service.regression.pass_archives import LIVE, NO_INPUTS, archive_of_pass, keep_pass
from ground_service.regression.service import find_replay, run_regression
from linna.commands import regress
from lunar.datafolder import find_data
from tests.ground_service.conftest import SPACECRAFT, START, encode_downlink, enter_files

REPLAY = KeptReplay(
    outcome="ok", detail="", downlink_sha256=None, performance_sha256=None, wall_s=1.0, cpu_s=1.0, peak_rss_mib=1.0,
    isolation="", machine="",
)  # fmt: skip


def live_pass(ground):
    stop = START + 600_000_000_000
    return define_pass(ground, name="live", start_utc_ns=START, stop_utc_ns=stop, spacecraft_id=SPACECRAFT)


def good(ground, make_build, packets):
    return register_build(ground, load_build(make_build("good", packets)))


@fixture(scope="module")
def archive(make_pass):
    return make_pass(frames=4, seed=3)


@fixture(scope="module")
def flown(make_flyable):
    return make_flyable(frames=4, seed=5)


def test_a_kept_archive_is_found_by_its_pass(either, archive):
    _, digest = read_manifest(archive.folder)
    record = ArchiveRecord(
        digest=digest, name="", frames=4, frames_stored=4, state="complete", reason="", octets=1, pinned=True,
        kept_since=UtcTime(0), manifest_sha256="",
    )  # fmt: skip
    either.write(store.keep_archive, record)
    with local_client(either, "ann") as service:
        assert [one.pass_id for one in service.list_kept_archives()] == [None]
        pass_id = import_archive(either, archive.folder)
        assert [one.pass_id for one in service.list_kept_archives()] == [pass_id]
        assert regress._kept(service, [str(pass_id)]) == [digest]
        with raises(InvalidInput, match="identity or the pass of one that is kept"):
            regress._kept(service, ["99"])


def test_an_imported_pass_is_kept_without_a_request(either, flown):
    pass_id = import_archive(either, flown.folder)
    _, digest = read_manifest(flown.folder)
    assert keep_pass(either, pass_id).digest == digest
    [kept] = kept_archives(either)
    stated = {"frames": 4, "state": "complete", "reason": ""}
    assert kept.model_dump().items() >= {**stated, "digest": digest, "pass_id": pass_id, "frames_stored": 4}.items()
    [job] = either.read(list_jobs, JobFilter(kind="automation")).items
    assert job.result["archive of pass 1"] == {**stated, "archive": digest}
    given = Comparison(candidate="current", passes=[pass_id])
    assert compared(either, given)["archives"] == [digest]


def test_an_archive_without_inputs_of_the_payload_is_telemetry_only(ground, archive):
    pass_id = import_archive(ground, archive.folder)
    [kept] = kept_archives(ground)
    assert (kept.pass_id, kept.state, kept.reason) == (pass_id, "telemetry only", NO_INPUTS)


def test_images_that_the_ground_did_not_store_are_left_out(ground, flown, tmp_path, monkeypatch):
    folder = shutil.copytree(flown.folder, tmp_path / "pass")
    for number in range(4):
        image = Image.fromarray(np.full((512, 512), 90 + number, np.uint8))
        image.save(folder / f"frames/{number:06d}.png")
    enter_files(folder)
    monkeypatch.setattr("ground_service.passes.archive_import.FRAMES_KEPT", 2)
    pass_id = import_archive(ground, folder)
    [kept] = kept_archives(ground)
    assert (kept.pass_id, kept.frames, kept.frames_stored, kept.state) == (pass_id, 4, 2, "telemetry only")
    assert kept.reason.startswith("2 of 4 frames are not stored, the first 1, ")
    assert kept.digest == read_manifest(folder)[1]


def test_a_live_pass_keeps_its_received_data_and_is_replaced_by_late_data(either, archive, tmp_path):
    half = len(archive.packets) // 2
    for number, packets in enumerate((archive.packets[:half], archive.packets)):
        file = tmp_path / f"{number}.cadu"
        file.write_bytes(encode_downlink(packets))
        ingest_file(either, file, spacecraft_id=SPACECRAFT)
        if number == 0:
            pass_id = live_pass(either)
            first = archive_of_pass(either, pass_id)
            assert archive_of_pass(either, pass_id).digest == first.digest
    assert (first.pass_id, first.state, first.reason) == (pass_id, "telemetry only", LIVE)
    second = keep_pass(either, pass_id)
    assert second.digest != first.digest and second.frames == 4 > first.frames
    assert [one.digest for one in kept_archives(either)] == [second.digest]
    found = check_out(either, second.digest, tmp_path / "out")
    assert len((tmp_path / "out/downlink.packets").read_bytes()) == sum(map(len, archive.packets))
    assert not found.has_inputs
    arguments = compared(either, Comparison(candidate="current", passes=[pass_id]))
    assert missing_replays(either, arguments) == []


def test_a_pass_without_telemetry_has_no_archive(ground):
    pass_id = live_pass(ground)
    with raises(InvalidInput, match=f"pass {pass_id}: expected received telemetry, found none"):
        keep_pass(ground, pass_id)


@fixture
def unrendered(flown, tmp_path):
    """An archive without two of its frames, whose scenario is not one."""
    folder = shutil.copytree(flown.folder, tmp_path / "unrendered")
    for number in 1, 3:
        (folder / f"frames/{number:06d}.png").unlink()
    enter_files(folder, scenario_toml="no scenario")
    return folder


@fixture
def render_whole(flown, monkeypatch):
    """From its call on, rendering an archive gives the flown one."""

    def render(_ground, given, out):
        assert not (given.folder / "payload/detections.jsonl").exists()
        shutil.copytree(flown.folder, out)
        return ""

    return lambda: monkeypatch.setattr(rendering, "_render", render)


def test_frames_that_cannot_be_rendered_leave_telemetry_only_with_the_reason(
    either, unrendered, flown, make_build, tmp_path
):
    digest = keep_archive(either, unrendered).digest
    [kept] = kept_archives(either)
    assert (kept.frames, kept.frames_stored, kept.state, kept.reason) == (4, 2, "to render", "")
    build = good(either, make_build, {"synthetic pass 5": flown.packets})
    outcome = run_regression(either, [digest], build, build, load_policy())
    [kept] = kept_archives(either)
    assert kept.state == "telemetry only"
    assert kept.reason.startswith("the frames cannot be rendered: ")
    assert str(tmp_path) not in kept.reason and str(either.home) not in kept.reason
    [one] = outcome.passes
    assert (one.state, outcome.verdict, outcome.gates) == ("not judged", "inconclusive", ())
    reason = "good is a program, which needs frames: the frames cannot be rendered"
    assert one.detail.startswith(reason)
    verdict = verdict_document(outcome)
    assert verdict.headline.startswith(f"inconclusive: synthetic pass 5: {reason}")
    assert "0 of 0 gates passed" in regression_text(verdict)
    assert 'failures="1" errors="0" skipped="1"' in regression_junit(verdict, 0)
    check_out(either, digest, tmp_path / "kept")
    lines = (tmp_path / "kept/payload/detections.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    assert [row["quality"] for row in rows] == [0, 0, 0, 0]
    assert all(len(row["u_px"]) == len(row["sigma_px"]) > 0 for row in rows)


@mark.parametrize(
    "words, limit, found",
    [
        (("sleep", "9"), {"wall_s": 1}, "timeout"),
        (("{python}", "-c", "import sys; sys.exit('linna: error: x')"), {}, "exit status 1"),
        (
            ("{python}", "-c", "print('linna: error: data product missing: DEM'); exit(2)"),
            {},
            "data product missing: DEM",
        ),
    ],
)
def test_a_renderer_that_fails_without_a_refusal_leaves_the_archive_to_render(
    ground, unrendered, make_build, monkeypatch, words, limit, found
):
    """The renderer exceeds its time, fails, or lacks declared data; the pass is unusable in this verdict only."""
    asked = rendering.RENDERING
    monkeypatch.setattr(
        rendering, "RENDERING", dataclasses.replace(asked, words=words, limits={**asked.limits, **limit})
    )
    digest = keep_archive(ground, unrendered).digest
    with raises(rendering.RenderingFailed, match=f"found {found}"):
        rendering.settle_archive(ground, digest)
    build = good(ground, make_build, {})
    outcome = run_regression(ground, [digest], build, build, load_policy())
    [one], [kept] = outcome.passes, kept_archives(ground)
    assert (one.state, outcome.verdict) == ("unusable", "inconclusive")
    assert (kept.state, kept.reason) == ("to render", "")


def test_only_a_message_of_the_renderer_itself_is_a_refusal():
    refusal = "archive: expected pixels with SHA-256 0, found 1"
    error = f"linna: error: {refusal}"
    assert rendering._refusal(2, f"progress\n{error}\n") == refusal
    full = ("No space left on device (/x)", "[('a', 'b', '[Errno 28] No space left on device')]")
    printed = ["Traceback\nMemoryError", "", *(f"linna: error: {one}" for one in full)]
    for given in (1, error), (-9, error), *((2, one) for one in printed):
        assert rendering._refusal(*given) == "", given


def test_the_renderer_sees_neither_the_archive_of_the_service_nor_a_network(ground, unrendered, monkeypatch):
    probe = (
        f"import os; seen = os.path.exists({str(ground.home)!r}), os.path.exists('/archive/manifest.json'); "
        "print('linna: error: sees', *seen, len(open('/proc/net/dev').readlines()) - 2); exit(2)"
    )
    asked = dataclasses.replace(rendering.RENDERING, words=("{python}", "-c", probe))
    monkeypatch.setattr(rendering, "RENDERING", asked)
    kept = rendering.settle_archive(ground, keep_archive(ground, unrendered).digest)
    assert kept.reason == "the frames cannot be rendered: sees False True 1"


def test_an_archive_that_cannot_be_rendered_is_settled_once(ground, unrendered, monkeypatch):
    (unrendered / "downlink.cadu").unlink()
    enter_files(unrendered)
    first = rendering.settle_archive(ground, keep_archive(ground, unrendered).digest)
    assert first.reason.count("no received detections") == 1
    assert rendering.settle_archive(ground, first.digest, again=True) == first
    monkeypatch.setattr(rendering, "check_out", None)
    assert rendering.settle_archive(ground, first.digest) == first


def test_an_unchanged_archive_keeps_its_replays(ground, unrendered, make_build):
    digest = keep_archive(ground, unrendered).digest
    rendering.settle_archive(ground, digest)
    build = good(ground, make_build, {})
    with ground.database.writing() as connection:
        manifest = store.get_archive(connection, digest).manifest_sha256
        assert store.keep_replay(connection, digest, build.digest, REPLAY, 0, manifest_sha256=manifest)
    assert rendering.settle_archive(ground, digest, again=True).state == "telemetry only"
    assert find_replay(ground, digest, build) == REPLAY


def test_a_replay_of_an_archive_that_is_completed_meanwhile_is_done_again(
    either, unrendered, flown, make_build, render_whole, monkeypatch
):
    digest = keep_archive(either, unrendered).digest
    assert rendering.settle_archive(either, digest).state == "telemetry only"
    render_whole()
    build = good(either, make_build, {"synthetic pass 5": flown.packets})
    replayed, seen = service._replayed, []

    def completed_meanwhile(*given):
        result = replayed(*given)
        seen.append(result[0].outcome)
        if len(seen) == 1:
            rendering.settle_archive(either, digest, again=True)
        return result

    monkeypatch.setattr(service, "_replayed", completed_meanwhile)
    assert service.do_replay(either, digest, build).outcome == "ok"
    assert seen == ["refused", "ok"]
    kept = find_replay(either, digest, build)
    assert kept.outcome == "ok"


def test_detections_besides_all_frames_are_refused_and_not_given_to_a_build(ground, flown, tmp_path):
    folder = shutil.copytree(flown.folder, tmp_path / "pass")
    (folder / "payload/detections.jsonl").write_text("")
    enter_files(folder)
    with raises(InvalidInput, match="received detections only where frames are missing"):
        keep_archive(ground, folder)
    write_flight_view(folder, tmp_path / "view")
    assert (tmp_path / "view/frames/000000.png").is_file()
    assert not (tmp_path / "view/payload/detections.jsonl").exists()
    (folder / "frames/000001.png").unlink()
    enter_files(folder)
    write_flight_view(folder, tmp_path / "partial")
    assert (tmp_path / "partial/payload/detections.jsonl").is_file()
    assert not (tmp_path / "partial/frames").exists()


def test_a_placebo_sees_images_with_noise_of_its_seed_and_their_hashes(flown, tmp_path):
    images, hashes = [], []
    for k, seed in enumerate((5, 5, 6)):
        view = tmp_path / str(k)
        write_flight_view(flown.folder, view, noise=seed)
        images.append(np.asarray(Image.open(view / "frames/000001.png"), dtype=float))
        rows = map(json.loads, (view / "payload/inputs.jsonl").read_text().splitlines())
        hashes += [row["pixels_sha256"] for row in rows if row["frame"] == 1]
    assert hashes[0] == hashlib.sha256(images[0].astype(np.uint8).tobytes()).hexdigest()
    assert hashes[0] == hashes[1] != hashes[2]
    one, _, other = (image - 90.0 for image in images)
    # Noise of 1 DN, rounded: variance 1 + 1/12.
    assert np.var(one) == approx(13 / 12, rel=0.02) == np.var(other)
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.01


def test_archives_of_one_regression_are_rendered_at_the_same_time(ground, make_flyable, monkeypatch):
    digests = [keep_archive(ground, make_flyable(frames=4, seed=seed).folder).digest for seed in (1, 2)]
    both, settle = threading.Barrier(2, timeout=900.0), service.settle_archive

    def rendered(ground, digest):
        both.wait()  # broken if the second archive waits for the first one
        return settle(ground, digest)

    monkeypatch.setattr(service, "settle_archive", rendered)
    monkeypatch.setattr(service, "fly_shards", lambda *_, **__: None)
    build = register_build(ground, load_build("current"))
    outcome = run_regression(ground, digests, build, build, load_policy(), workers=2)
    assert [one.detail for one in outcome.passes] == 2 * ["it was not flown"]


def test_data_products_that_are_mounted_later_are_noticed(tmp_path):
    listed = tmp_path / "data/craters/lu1319381.csv"
    (tmp_path / "data").mkdir()
    with open_ground(tmp_path / "home", find_data(tmp_path / "data")) as ground:
        assert ground.data.catalogue_lu is None
        listed.parent.mkdir()
        listed.touch()
        assert ground.data.catalogue_lu == listed


def test_files_are_removed_after_the_commit_and_only_if_all_kept_archives_are_known(
    either, flown, unrendered, monkeypatch
):
    log = MagicMock()
    monkeypatch.setattr("ground_service.regression.archives._log", log)
    first, second = keep_archive(either, flown.folder), keep_archive(either, unrendered, pinned=True)
    files = store_of(either)
    manifest, other = (
        files.path(hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest())
        for folder in (flown.folder, unrendered)
    )
    fail = MagicMock(side_effect=OSError("commit"))
    with monkeypatch.context() as failing, raises(OSError, match="commit"):
        failing.setattr("ground_service.store.audit.append_pending", fail)
        let_go(either, unused_for_ns=0)
    assert manifest.is_file() and len(kept_archives(either)) == 2
    lost = other.rename(other.with_suffix(".lost"))
    # An archive with an unreadable manifest hinders neither the keeping of others nor their removal.
    assert keep_archive(either, flown.folder).digest == first.digest
    assert let_go(either, unused_for_ns=0) == [first.digest]
    assert manifest.is_file()
    ((text, digest, _), _) = log.warning.call_args
    assert (text.partition(":")[0], digest) == ("no files of archives are removed", second.digest)
    lost.rename(other)
    keep_archive(either, flown.folder)
    assert let_go(either, unused_for_ns=0) == [first.digest]
    assert not manifest.is_file()
    assert keep_archive(either, unrendered).digest == second.digest


def test_an_archive_is_rendered_again_on_request(ground, unrendered, render_whole):
    digest = keep_archive(ground, unrendered).digest
    assert rendering.settle_archive(ground, digest).state == "telemetry only"
    render_whole()
    assert rendering.settle_archive(ground, digest).state == "telemetry only"
    kept = rendering.settle_archive(ground, digest, again=True)
    assert (kept.digest, kept.state, kept.reason, kept.frames_stored) == (digest, "complete", "", 4)
    assert keep_archive(ground, unrendered).digest == digest
    assert [one.state for one in kept_archives(ground)] == ["complete"]


def test_an_archive_of_an_older_version_asks_for_another_import(ground, archive):
    pass_id = import_archive(ground, archive.folder)
    ground.files.path(read_manifest(archive.folder)[1]).unlink()
    with raises(InvalidInput, match="import the archive again"):
        keep_pass(ground, pass_id)
    import_archive(ground, archive.folder)
    assert keep_pass(ground, pass_id).pass_id == pass_id


def test_the_operations_keep_and_render_the_archive_of_a_pass(ground, flown):
    pass_id = import_archive(ground, flown.folder)
    with local_client(ground, "ann") as service:
        kept = service.keep_pass_archive(pass_id, pinned=True)
        assert (kept.pass_id, kept.pinned) == (pass_id, True)
        job = service.wait(service.render_kept_archive(kept.digest).id)
        assert job.result["state"] == "complete"
