"""Flown sessions of the document on the paper's figures: emulated, ingested and evaluated by the ground service."""

import dataclasses
import hashlib
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.client.local import local_client
from ground_service.ground import open_ground
from payload_emulator.session.archive.emulator import emulate
from payload_emulator.session.scenario import Scenario, format_scenario, load_scenario
from reports.paper_values import PaperSession
from reports.values import DriftSample, GalleryFrame, NavigationSeries, NavigationStatistics, TimeSpan, TrackSeries
from studies.paper_steps import StepFolder, load_png

ACTOR = "linna paper"
ODOMETRY = ("paper", "spherical")
FILTER = ("anchored", "smoothed")
BASELINE = ("propagate-only",)


@dataclass(frozen=True, slots=True)
class Flight:
    """A session to fly and how the document shows it."""

    key: str
    heading: str
    description: str
    scenario: Scenario
    own_method: bool


def flights(steps: StepFolder, network: Path | None) -> tuple[Flight, ...]:
    """The sessions: the paper's method, this system's estimators, and real terrain never used in training."""
    day = load_scenario("paper-day")
    day = replace(day, window=replace(day.window, duration_s=steps.effort.hours * 3600.0))
    ours = replace(day, navigation=replace(day.navigation, estimators=("paper", "spherical", "anchored")))
    found = []
    if network is not None:
        detector = replace(day.detector, network=str(network.resolve()))
        navigation = replace(day.navigation, estimators=ODOMETRY)
        found.append(
            Flight(
                "own",
                "State estimation by the paper's method (Figs. 7 to 10)",
                f"{steps.effort.hours:g} hours from the paper's epoch, an image each 15 s within 60° of latitude, Sun "
                "5–15° high. The network is class-only, as in the paper: it gives positions and classes, no sizes. "
                "“paper” is the odometry of Section VI on a flat Moon, “spherical” the same odometry with exact "
                "back-projection to the sphere. Both read the ground-truth ephemeris at resets and for the scale.",
                replace(day, detector=detector, navigation=navigation),
                True,
            )
        )
    found.append(
        Flight(
            "ours",
            "The same with the estimators of this system",
            f"The same {steps.effort.hours:g} hours with the shipped network, which also measures sizes. “anchored” is "
            "the on-board filter that identifies craters of an uploaded catalogue. It starts 5 km and 5 m/s off and "
            "never reads the truth. “smoothed” is the same filter improved on the ground with later data.",
            ours,
            False,
        )
    )
    if steps.real:
        unseen = load_scenario("unseen-strip")
        unseen = replace(
            unseen,
            window=replace(unseen.window, passes=steps.effort.unseen_passes),
            navigation=replace(unseen.navigation, estimators=("paper", "spherical", "anchored")),
        )
        found.append(
            Flight(
                "unseen",
                "The same over real terrain never used in training",
                f"{steps.effort.unseen_passes} passes over 285–300° E of GLD100 with the shipped network, which was "
                "trained on other ground.",
                unseen,
                False,
            )
        )
    return tuple(found)


def fly(steps: StepFolder, flight: Flight) -> PaperSession:
    """Fly, ingest and evaluate a session, or read the results of an earlier run of the same."""
    network = Path(flight.scenario.detector.network)
    made_from = {
        "scenario": format_scenario(flight.scenario),
        "network": hashlib.sha256(network.read_bytes()).hexdigest() if network.is_file() else network.name,
    }
    archive, report = steps.out / "flights" / flight.key, steps.out / f"session-{flight.key}.json"
    if not (archive / "manifest.json").is_file():
        (steps.out / "steps" / f"flight {flight.key}.json").unlink(missing_ok=True)

    def make_flight() -> dict[str, Any]:
        archive.parent.mkdir(parents=True, exist_ok=True)
        summary = emulate(flight.scenario, steps.data, archive, frames_kept=8, progress=steps.progress)
        return {"frames": summary["frames"], "wall_s": summary["wall_s"]}

    def make_report() -> dict[str, Any]:
        home = steps.out / "ground" / flight.key
        shutil.rmtree(home, ignore_errors=True)  # of an interrupted run, or of another version
        with local_client(open_ground(home, steps.data), ACTOR) as service:
            pass_id = service.import_archive(archive)
            service.get_report(service.make_report(pass_id), report, format="json")
        return {"pass_id": pass_id}

    flown = steps.step(f"flight {flight.key}", made_from, make_flight)
    if not report.is_file():
        (steps.out / "steps" / f"report {flight.key}.json").unlink(missing_ok=True)
    steps.step(f"report {flight.key}", made_from, make_report)
    return session_of(flight, int(flown["frames"]), archive, json.loads(report.read_text(encoding="utf-8")))


def session_of(flight: Flight, frames: int, archive: Path, report: dict[str, Any]) -> PaperSession:
    """The session of a pass report in JSON."""
    solutions = {str(row["name"]): _series(row) for row in report["navigation"]}
    shown = ODOMETRY if flight.own_method else FILTER
    also = () if flight.own_method else (*ODOMETRY, *BASELINE)
    return PaperSession(
        key=flight.key,
        heading=flight.heading,
        description=flight.description,
        level=str(report["evidence_level"]),
        own_method=flight.own_method,
        frames=frames,
        track=TrackSeries(**{name: _array(values) for name, values in report["reference"].items()}),
        series=tuple(solutions[name] for name in shown if name in solutions),
        arcs=tuple(TimeSpan(**row) for row in report["imaging_arcs"]),
        also=tuple(solutions[name] for name in also if name in solutions),
        view=_view(archive, report["gallery"]),
    )


def _view(archive: Path, gallery: list[dict[str, Any]]) -> GalleryFrame | None:
    """The gallery frame in the middle of those whose image is in the archive."""
    kept = [row for row in gallery if (archive / "frames" / f"{row['frame_number']:06d}.png").is_file()]
    if not kept:
        return None
    row = kept[len(kept) // 2]
    image = load_png(archive / "frames" / f"{row['frame_number']:06d}.png")
    fields: dict[str, Any] = {name: _array(value) if isinstance(value, list) else value for name, value in row.items()}
    for name in ("detection_matched", "catalogue_matched"):
        if row[name] is not None:
            fields[name] = np.array(row[name], dtype=np.bool_)
    if image.dtype != np.uint8:
        image = (image >> (8 * (image.dtype.itemsize - 1))).astype(np.uint8)
    return GalleryFrame(**{**fields, "image": image})


def _series(row: dict[str, Any]) -> NavigationSeries:
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(NavigationSeries):
        value = row.get(field.name)
        if value is None:
            continue
        if field.name == "statistics":
            value = NavigationStatistics(**{k: np.nan if v is None else v for k, v in value.items()})
        elif field.name == "drift_by_length":
            value = tuple(DriftSample(**sample) for sample in value)
        elif field.name in ("outcome", "reset_trigger", "terrain"):
            value = tuple(str(text or "") for text in value)
        elif field.name == "error_budget":
            continue
        elif isinstance(value, list):
            value = _array(value)
        fields[field.name] = value
    return NavigationSeries(**fields)


def _array(values: list[Any]) -> Any:
    """Numbers as an array: integers stay integers, null becomes NaN."""
    if values and all(isinstance(value, int) and not isinstance(value, bool) for value in values):
        return np.array(values, dtype=np.int64)
    return np.array(values, dtype=np.float64)
