"""From nothing to the model: every stage once, again only where something changed, from what is there already."""

import json
from dataclasses import replace

import pytest

from linna.output import as_json
from lunar.datafolder import DataFolder
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.session.recipe import procedural_recipe
from payload_emulator.training.data import build
from payload_emulator.training.data.feeder import TrainParameters
from payload_emulator.training.evaluate import evaluate
from payload_emulator.training.model import export, train
from studies import pipeline
from studies.pipeline import Job, format_comparison, make_dataset, make_model

TINY = TrainParameters(
    minutes=0.0, steps=1, batch=2, crop_px=96, validation_frames=1, replicas=1, detail_blocks=0
)


@pytest.fixture(scope="module")
def job(blob_dataset, tmp_path_factory):
    return Job(
        tmp_path_factory.mktemp("made"),
        procedural_recipe(),
        10,
        TINY,
        DataFolder(),
        dataset=blob_dataset.folder,
        revision="abc",
    )


@pytest.fixture(scope="module")
def made(job):
    """As in earnest, but the first of the two exports, which takes seconds, gives the shipped network instead."""
    real = export.export

    def quick(checkpoint, out, *rest, paper_classes=False, **options):
        if paper_classes:
            return real(checkpoint, out, *rest, paper_classes=True, **options)
        out.write_bytes(load_shipped_model())
        return {"model": str(out), "model_bytes": 1, "score_threshold": 0.4, "f1_threshold": 0.3} | {
            "navigation_threshold": 0.6
        }

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "export", quick)
        return make_model(job)


def test_both_models_lie_in_the_folder_with_their_figures_and_report(job, made):
    for name, channels in (("model", 1), ("paper", 4)):
        detector = OnnxDetector((job.out / f"{name}.onnx").read_bytes())
        assert made["test"]["test"][name]["model_sha256"] == detector.sha256
        assert detector._session.get_outputs()[0].shape[1] == channels
    assert detector.metadata["git_revision"] == "abc"
    assert set(json.loads(detector.metadata["test_figures"])) == {"test"}
    assert "By Sun azimuth" in (job.out / "report-test.html").read_text(encoding="utf-8")
    table = format_comparison(made)
    assert "paper's design" in table and "evidence level 2 (procedural Moon, held out)" in table


def test_the_same_command_again_does_nothing_twice(job, made, monkeypatch):
    def never(*_, **__):
        raise AssertionError("a finished stage was done again")

    for module, name in ((train, "train"), (export, "export"), (evaluate, "run"), (evaluate, "evaluate")):
        monkeypatch.setattr(module, name, never)
    assert as_json(make_model(job)) == as_json(made)


def test_a_stage_made_from_other_things_is_made_again(job, made, monkeypatch):
    asked = []

    def refuse(checkpoint, out, *_, **__):
        asked.append(out.name)
        raise ModelError("asked to export again")

    monkeypatch.setattr(export, "export", refuse)
    with pytest.raises(ModelError, match="asked to export again"):
        make_model(replace(job, revision="def"))
    assert asked == ["model.onnx"]


def test_a_run_trained_elsewhere_is_taken_as_it_is(job, made, tmp_path, monkeypatch):
    monkeypatch.setattr(train, "train", lambda *_, **__: pytest.fail("trained again"))
    monkeypatch.setattr(
        export, "export", lambda checkpoint, *_, **__: (_ for _ in ()).throw(ModelError(str(checkpoint)))
    )
    with pytest.raises(ModelError, match=r"run.best\.pt"):
        make_model(replace(job, out=tmp_path, run=job.out / "run"))


def test_a_run_without_a_checkpoint_is_refused(job, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ModelError, match="expected a run with a checkpoint, found none"):
        make_model(replace(job, out=tmp_path, run=tmp_path / "empty"))


def test_a_data_set_without_test_frames_is_refused(job, make_blob_dataset, tmp_path):
    other = make_blob_dataset(tmp_path / "set", {"train": 1})
    with pytest.raises(DatasetError, match="split 'test'"):
        make_model(replace(job, dataset=other.folder))


def test_a_data_set_is_built_once_and_finished_after_a_kill(tmp_path, make_blob_dataset, monkeypatch):
    calls = []

    def half(recipe, folder, frames, data, workers):
        calls.append(frames)
        yield 5, frames
        if len(calls) == 1:
            raise KeyboardInterrupt
        make_blob_dataset(folder, {"train": 1})
        yield frames, frames

    monkeypatch.setattr(build, "build", half)
    job = Job(tmp_path, procedural_recipe(), 10, TINY, DataFolder())
    with pytest.raises(KeyboardInterrupt):
        make_dataset(job)
    lines = []
    assert make_dataset(job, lines.append) == tmp_path / "dataset"
    assert make_dataset(job) == tmp_path / "dataset"
    assert calls == [10, 10]
    assert lines[-1] == "data set: 10/10 frames"
    assert pipeline._stage(job, "dataset", {"recipe_sha256": job.recipe.digest, "frames": 11}) is None
