"""Studies of the detector: `linna detector quantise|landmarks|trials|ablate`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from linna.commands._detector_common import (
    add_model,
    model_octets,
    need_torch,
    restart_for_training,
    write_text,
)


def configure(verbs: Any) -> None:
    """Add the verbs."""
    from linna.output import add_json_flag

    quantise = verbs.add_parser(
        "quantise", help="compare the network in 8-bit integers with the original one"
    )
    add_model(quantise)
    quantise.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
    quantise.add_argument("--out", type=Path, required=True, metavar="M.onnx")
    add_json_flag(quantise)
    quantise.set_defaults(handler=_quantise)

    landmarks = verbs.add_parser(
        "landmarks", help="places that are found again and again under different Suns and no catalogue lists"
    )
    add_model(landmarks)
    landmarks.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
    landmarks.add_argument("--split", choices=("train", "val", "test"), default="train")
    landmarks.add_argument("--source", default="", help="only the frames of this source")
    landmarks.add_argument("--threshold", type=float, default=None, help="instead of the model's own")
    landmarks.add_argument("--sightings", type=int, default=3, help="frames that must show it")
    landmarks.add_argument(
        "--hide",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="hide this share of the catalogue first and report how many landmarks were hidden craters",
    )
    landmarks.add_argument("--out", type=Path, default=None, metavar="F.csv")
    add_json_flag(landmarks)
    landmarks.set_defaults(handler=_landmarks)

    trials = verbs.add_parser(
        "trials", help="compare input and output processing of the trained network on the validation split"
    )
    add_model(trials)
    trials.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
    _add_test(trials, "way")
    trials.add_argument("--source", default="", help="with --test: only the test frames of this source")
    trials.add_argument(
        "--two-suns",
        action="store_true",
        help="instead of the other ways: pairs of frames that show the same ground under different Suns",
    )
    add_json_flag(trials)
    trials.set_defaults(handler=_trials)

    choose = verbs.add_parser(
        "choose",
        help="which of several models flies, by the validation split alone (shipped: the one that does)",
    )
    choose.add_argument("models", nargs="+", metavar="M.onnx", help='files, or "shipped"')
    choose.add_argument("--dataset", type=Path, nargs="+", required=True, metavar="DIR")
    add_json_flag(choose)
    choose.set_defaults(handler=_choose)

    _add_ablate(verbs)


def _add_ablate(verbs: Any) -> None:
    from linna.output import add_json_flag

    ablate = verbs.add_parser(
        "ablate", help="train the recipe with one thing changed at a time, at equal small budgets"
    )
    ablate.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    ablate.add_argument(
        "--out", type=Path, required=True, metavar="RUNS", help="a run folder for each variant"
    )
    ablate.add_argument("--only", nargs="+", default=None, metavar="NAME", help="variants (default: all)")
    ablate.add_argument("--steps", type=int, default=600, help="of 8 crops, for every variant (default: 600)")
    ablate.add_argument("--crop", type=int, default=256, metavar="PX")
    ablate.add_argument(
        "--frames",
        type=int,
        nargs=2,
        default=[480, 240],
        metavar=("REAL", "PROCEDURAL"),
        help="training frames of every variant (default: 480 240)",
    )
    ablate.add_argument(
        "--validation-frames", type=int, default=150, help="maximum for each kind of terrain (default: 150)"
    )
    _add_test(ablate, "variant")
    ablate.add_argument(
        "--test-frames", type=int, default=160, help="with --test: maximum for each kind of terrain"
    )
    ablate.add_argument(
        "--seeds", type=int, nargs="+", default=[1, 2], help="of the baseline; the others take the first"
    )
    ablate.add_argument("--every-seed", action="store_true", help="train the variants with every seed too")
    ablate.add_argument(
        "--plain", type=Path, default=None, metavar="DATASET", help="real terrain with `sharpen = false`"
    )
    ablate.add_argument(
        "--rims", type=Path, default=None, metavar="TABLE", help="rims from `linna catalogue curate`"
    )
    add_json_flag(ablate)
    ablate.set_defaults(handler=_ablate)


def _add_test(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument(
        "--test",
        action="store_true",
        help=f"also score the test split once, for the {what} chosen on the validation split",
    )


def _choose(arguments: argparse.Namespace) -> int:
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.evaluate.choice import choose, format_choice

    document = choose(
        {name: model_octets(None if name == "shipped" else Path(name)) for name in arguments.models},
        [Dataset(folder) for folder in arguments.dataset],
        lambda frames: progress(frames, len(frames), "validate", "frames"),
    )
    emit(arguments, document, format_choice(document))
    return 0


def _ablate(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError
    from linna.output import emit, log

    need_torch()
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.data.refits import load_refitted
    from studies.ablation import (
        VARIANTS,
        AblationParameters,
        Material,
        ablate,
        choose_variant,
        format_ablation,
        score_chosen_variant,
    )

    known = {variant.name: variant for variant in VARIANTS}
    wanted = list(known) if arguments.only is None else arguments.only
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise UsageError(f"--only: expected names among {', '.join(known)}, found {', '.join(unknown)}")
    if arguments.steps < 1:
        raise UsageError(f"--steps: expected 1 or more, found {arguments.steps}")
    restart_for_training()
    material = Material(
        [Dataset(folder) for folder in arguments.datasets],
        None if arguments.plain is None else Dataset(arguments.plain),
        None if arguments.rims is None else load_refitted(arguments.rims),
    )
    parameters = AblationParameters(
        steps=arguments.steps,
        crop_px=arguments.crop,
        real_frames=arguments.frames[0],
        procedural_frames=arguments.frames[1],
        validation_frames=arguments.validation_frames,
        test_frames=arguments.test_frames,
        seeds=tuple(arguments.seeds),
        every_seed=arguments.every_seed,
    )
    rows = ablate(material, arguments.out, [known[name] for name in wanted], parameters, log)
    document: dict[str, Any] = {"variants": rows, "chosen": choose_variant(rows)}
    test = score_chosen_variant(material, arguments.out, rows, parameters) if arguments.test else None
    if test is not None:
        document["test"] = test
    emit(arguments, document, format_ablation(rows, test))
    return 0


def _quantise(arguments: argparse.Namespace) -> int:
    import importlib.util

    from linna.errors import UsageError
    from linna.output import emit
    from payload_emulator.errors import install_hint
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.evaluate.evaluate import evaluate
    from payload_emulator.training.model.bench import compare_models
    from payload_emulator.training.model.quantise import quantise

    if importlib.util.find_spec("onnx") is None:
        raise UsageError(f"quantisation needs onnx: {install_hint('train')}")
    datasets = [Dataset(folder) for folder in arguments.dataset]
    octets = model_octets(arguments.model)
    small = quantise(octets, datasets)
    unfinished = arguments.out.with_name(f".{arguments.out.name}.unfinished")
    unfinished.write_bytes(small)
    unfinished.replace(arguments.out)
    times = compare_models({"float32": octets, "int8": small})
    kept = ("precision", "recall", "f1", "loc_px")
    scores = {
        name: {key: figures["micro"][key] for key in kept}
        for name, figures in (
            ("float32", evaluate(octets, datasets, "val")),
            ("int8", evaluate(small, datasets, "val")),
        )
    }
    emit(
        arguments,
        {
            "model": str(arguments.out),
            "bytes": {"float32": len(octets), "int8": len(small)},
            "network_ms": {name: row["network_ms"] for name, row in times.items()},
            "latency_ratio": times["int8"]["of_first"],
            "strict_validation": scores,
        },
    )
    return 0


def _landmarks(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.evaluate.evaluate import open_for_evaluation, run
    from payload_emulator.training.evaluate.landmarks import RecurrenceRule, format_landmarks, study

    if not 0.0 <= arguments.hide < 1.0:
        raise UsageError(f"--hide: expected a share from 0 to below 1, found {arguments.hide:g}")
    if arguments.sightings < 2:
        raise UsageError(f"--sightings: expected 2 or more, found {arguments.sightings}")
    detector = open_for_evaluation(model_octets(arguments.model))
    scored = run(
        detector,
        [Dataset(folder) for folder in arguments.dataset],
        arguments.split,
        arguments.source,
        arguments.threshold,
        lambda frames: progress(frames, len(frames), "detect", "frames"),
    )
    landmarks, figures = study(
        scored.frames,
        scored.found,
        scored.thresholds.on_board,
        arguments.hide,
        RecurrenceRule(sightings=arguments.sightings),
    )
    if arguments.out is not None:
        write_text(arguments.out, format_landmarks(landmarks))
    emit(arguments, {**figures, "model_sha256": detector.sha256})
    return 0


def _trials(arguments: argparse.Namespace) -> int:
    from linna.output import emit, progress
    from payload_emulator.training.data.dataset import Dataset
    from payload_emulator.training.evaluate.evaluate import open_for_evaluation, run
    from studies.trials import format_trials, run_trials, score_chosen_trial
    from studies.two_suns import format_two_suns, score_chosen_way, study_two_suns

    def shown(frames: Sequence[Any]) -> Any:
        return progress(frames, len(frames), "trial", "frames")

    detector = open_for_evaluation(model_octets(arguments.model))
    datasets = [Dataset(folder) for folder in arguments.dataset]
    test: dict[str, Any] | None = None
    if arguments.two_suns:
        study = study_two_suns(run(detector, datasets, "val", progress=shown))
        if arguments.test:
            test = score_chosen_way(run(detector, datasets, "test", arguments.source, progress=shown), study)
        text = format_two_suns(study, test)
    else:
        study = run_trials(detector, datasets, progress=shown)
        if arguments.test:
            test = score_chosen_trial(detector, datasets, study, arguments.source, progress=shown)
        text = format_trials(study, test)
    document = {**study, "model_sha256": detector.sha256} | ({} if test is None else {"test": test})
    emit(arguments, document, text)
    return 0
