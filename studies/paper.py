"""The figures and tables of the LINNA paper, produced by this system and set against the paper's values."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reports import published
from reports.paper_values import (
    CatalogueClasses,
    DatasetCounts,
    DetectorResult,
    Difference,
    FovCurves,
    PaperOrbit,
    PaperPicture,
    PaperReport,
    PaperSession,
)
from reports.statistics import completed
from reports.text import count_text, length_text
from reports.values import ClassScore, HeadlineFigure
from studies import paper_steps
from studies.paper_sessions import flights, fly
from studies.paper_steps import StepFolder

CLASS_ONLY = "class-only network"
SHIPPED_NETWORK = "shipped network"
_METHODS = {
    "own": "the paper’s method",
    "ours": "the filter of this system",
    "unseen": "the same over real terrain never used in training",
}
_LABELS = ("5–10 km", "10–15 km", "15–30 km")


def make_paper(steps: StepFolder, *, quick: bool) -> PaperReport:
    """Run every step that is not done yet and return the document's content.

    Parameters
    ----------
    quick
        States in the document that sizes were reduced.
    """
    missing: dict[str, str] = {}
    orbit, curves = paper_steps.orbit(steps), paper_steps.field_of_view(steps)
    diameters, counts, source = paper_steps.classes(steps)
    region, samples = paper_steps.region(steps), paper_steps.sample_dataset(steps)
    dataset = paper_steps.method_dataset(steps)
    network = paper_steps.class_only_network(steps, dataset)
    if network is None:
        missing["sessions"] = (
            "the paper's own network is trained with torch, which is not installed (make install-dev), and no "
            "--model was given"
        )
    detectors = _detectors(steps, network, dataset)
    sessions = tuple(fly(steps, flight) for flight in flights(steps, network))
    classes = CatalogueClasses(diameters, counts, source)
    altitude = orbit["altitude_km"]
    month = PaperOrbit(
        orbit["elements"], altitude["mean"], altitude["min"], altitude["max"], orbit["days"],
        orbit["maneuvers"], orbit["frames_of_a_day"], orbit["gravity"],
    )  # fmt: skip
    return PaperReport(
        title=f"The figures of the LINNA paper, produced by this system{': quick run, not a result' if quick else ''}",
        identity="AI-Based Navigation for Lunar Satellites in VLLO",
        quick=quick,
        orbit=month,
        catalogue=classes,
        fov=_fov(curves),
        region=_region(steps, region),
        samples=PaperPicture(
            paper_steps.load_png(steps.out / "samples.png"),
            "Form of the paper's Fig. 5: samples of the data set with labels (cyan: class 0, lime: class 1, yellow: "
            "class 2).",
            "3s (real terrain)" if steps.real else "2 (procedural Moon)",
        ),
        dataset=DatasetCounts(
            samples["frames"], _three(samples["instances"]), "GLD100" if steps.real else "procedural Moon"
        ),
        detectors=detectors,
        sessions=sessions,
        differences=differences(month, classes, _fov(curves), samples["frames"], detectors, sessions, steps),
        verdict=_verdict(sessions),
        evidence_level=sessions[0].level,
        headline=_headline(month, () if quick else detectors, sessions),
        provenance=_provenance(steps, network),
        data_sources=tuple(steps.data.names()) or ("procedural Moon, low-degree gravity and IAU orientation",),
        remarks=_remarks(quick, steps),
        not_available=missing,
    )


def _detectors(steps: StepFolder, network: Path | None, dataset: Path) -> tuple[DetectorResult, ...]:
    from payload_emulator.flight.models import load_shipped_model

    networks = [(SHIPPED_NETWORK, "shipped", "measures sizes as well", load_shipped_model(), False)]
    if network is not None:
        words = "class heatmaps and offsets, as in the paper"
        networks.insert(0, (CLASS_ONLY, "class-only", words, network.read_bytes(), True))
    found = []
    for name, key, description, octets, paper_classes in networks:
        figures = paper_steps.evaluation(steps, key, octets, dataset, paper_classes)
        found.append(
            DetectorResult(
                name,
                description,
                figures["frames"],
                figures["level"],
                tuple(_score(k, _LABELS[k], row) for k, row in enumerate(figures["per_class"])),
                _score(-1, "5–30 km", figures["micro"]),
                paper_steps.load_gallery(steps.out / f"gallery-{key}.npz"),
            )
        )
    return tuple(found)


def _score(size_class: int, label: str, row: dict[str, Any]) -> ClassScore:
    precision, recall, loc_px = (
        float("nan") if row[key] is None else float(row[key]) for key in ("precision", "recall", "loc_px")
    )
    counts = (int(row["expected"]), int(row["detected_true"]), int(row["false_alarms"]))
    return ClassScore(size_class, label, *counts, precision, recall, loc_px)


def _fov(curves: dict[str, Any]) -> FovCurves:
    selected = curves["selected_fov_deg"]
    return FovCurves(
        np.array(curves["fov_deg"]),
        {int(n): np.array(values) for n, values in curves["probability"].items()},
        float("nan") if selected is None else float(selected),
        curves["positions"],
        curves["source"],
    )


def _region(steps: StepFolder, region: dict[str, Any]) -> PaperPicture:
    latitude, longitude = paper_steps.VAVILOV_DEG
    place = f"{abs(latitude):g}° S, {longitude:g}° E"
    if steps.real:
        caption = (
            f"Form of the paper's Fig. 3: crater Vavilov ({place}) rendered from 110 km, Sun in the west "
            f"{paper_steps.VAVILOV_SUN_DEG:g}° high, over {region['terrain']}."
        )
        return PaperPicture(paper_steps.load_png(steps.out / "region.png"), caption, "3s (real terrain)")
    caption = (
        f"Form of the paper's Fig. 3: the procedural Moon at the place of the crater Vavilov ({place}), which is not "
        "on it, rendered from 110 km."
    )
    return PaperPicture(paper_steps.load_png(steps.out / "region.png"), caption, "2 (procedural Moon)")


def _three(values: Sequence[int]) -> tuple[int, int, int]:
    first, second, third = values
    return first, second, third


def differences(
    orbit: PaperOrbit,
    classes: CatalogueClasses,
    fov: FovCurves,
    samples: int,
    detectors: Sequence[DetectorResult],
    sessions: Sequence[PaperSession],
    steps: StepFolder,
) -> tuple[Difference, ...]:
    """Return every difference between the paper and this run, each with one sentence."""
    rows = [*_orbit_differences(orbit, classes, fov, sessions[0], steps), *_image_differences(samples, steps)]
    if any(d.name == CLASS_ONLY for d in detectors):
        rows.append(
            Difference(
                "Class-only head",
                "15 h of training on an RTX 4060",
                f"{steps.effort.training_steps} steps on a CPU",
                "Both networks give class heatmaps and offsets; this one starts from the shipped weights and sees "
                f"{steps.effort.method_frames} images, so precision and recall are those of a short training.",
            )
        )
    return (*rows, *_METHOD_DIFFERENCES)


def _orbit_differences(
    orbit: PaperOrbit, classes: CatalogueClasses, fov: FovCurves, first: PaperSession, steps: StepFolder
) -> list[Difference]:
    return [
        Difference(
            "Images of the session",
            f"{count_text(published.SESSION_FRAMES)} in about 24 h",
            f"{count_text(first.frames)} in {steps.effort.hours:g} h",
            f"24 h at 15 s within 60° of latitude, the limit of Section V-B.4, give at most "
            f"{count_text(orbit.frames_of_a_day)} images; 5,196 need either images up to 81° of latitude or 32.5 h.",
        ),
        Difference(
            "Altitude",
            "mean 30.8, 14.0 to 48.6 km",
            f"mean {orbit.mean_km:.1f}, {orbit.min_km:.1f} to {orbit.max_km:.1f} km",
            f"The paper propagates in STK; here the gravity field is {orbit.gravity}, "
            "and the manoeuvre rule is that of the paper.",
        ),
        Difference(
            "Crater catalogue",
            " / ".join(count_text(n) for n in published.CATALOGUE),
            " / ".join(count_text(n) for n in classes.counts),
            f"The paper uses the full catalogue of its reference [6]; here it is {classes.source}.",
        ),
        Difference(
            "Field of view",
            "120°",
            f"{fov.selected_fov_deg:g}°" if np.isfinite(fov.selected_fov_deg) else "none",
            "The smallest field with three craters in over 90 % of positions depends on the catalogue's density and "
            "on which positions it covers.",
        ),
    ]


def _image_differences(samples: int, steps: StepFolder) -> list[Difference]:
    return [
        Difference(
            "Pictures",
            "Blender Cycles on SLDEM2015 at 256 px/deg",
            f"own renderer on {'GLD100' if steps.real else 'a procedural Moon'}",
            "The fast renderer agrees with Cycles in shadows and radiance (documentation, renderers) and makes "
            "24 h of images in minutes.",
        ),
        Difference(
            "Data set",
            f"{count_text(published.FRAMES)} images",
            f"{count_text(samples)} images for Fig. 5",
            "The network is trained on a small set of its own; the full one is a single command (linna dataset build "
            "paper-dataset --frames 51924).",
        ),
        Difference(
            "Photograph of Fig. 3a",
            "Artemis II photograph of Vavilov",
            "rendered view",
            "The photograph is not a public data product of this project, so only the rendered view is shown.",
        ),
    ]


_METHOD_DIFFERENCES = (
    Difference(
        "Planar and spherical",
        "projection onto a plane",
        "both are flown",
        "At 120° the edge of an image is 3 % farther on the sphere than on a plane (30 km), which the planar "
        "odometry reads as motion; the spherical one removes this error.",
    ),
    Difference(
        "Reference",
        "the simulator's truth",
        "an uploaded ephemeris with orbit-determination errors",
        "In flight nobody has the truth, so the ground compares with an ephemeris of 10, 30 and 15 m (1 sigma, "
        "radial, along-track, cross-track).",
    ),
    Difference(
        "Resets",
        "at time gaps and on time-out, to the truth",
        "the same triggers, reads counted",
        "The reset rules are those of Section VI-C, with the optional time-out at 300 s; each read of the anchor "
        "ephemeris is counted and downlinked.",
    ),
)


def _verdict(sessions: Sequence[PaperSession]) -> str:
    words = []
    for session in sessions:
        best = session.series[0]
        figures = completed(best)
        words.append(
            f"{_METHODS[session.key]}: median {length_text(figures.median_3d_m)} (evidence level "
            f"{session.level.split(' ')[0]})"
        )
    return f"Position error: {'; '.join(words)}."


def _headline(
    orbit: PaperOrbit, detectors: Sequence[DetectorResult], sessions: Sequence[PaperSession]
) -> tuple[HeadlineFigure, ...]:
    figures = [
        HeadlineFigure("Mean altitude", orbit.mean_km, "km", "paper: 30.8", "1 (unit geometry)"),
        HeadlineFigure("Images", sessions[0].frames, "", "paper: 5,196"),
        *(
            HeadlineFigure("Recall, 15–30 km", one.per_class[2].recall, "", "paper: .47", one.level)
            for one in detectors[:1]
        ),
    ]
    for session in sessions[:2]:
        one = session.series[0]
        median = completed(one).median_3d_m
        figures.append(HeadlineFigure(f"Median error, {one.name}", median, "m", _METHODS[session.key], session.level))
    return tuple(figures)


def _provenance(steps: StepFolder, network: Path | None) -> dict[str, str]:
    rows = {
        "Command": "linna paper",
        "Session": f"paper-day, {steps.effort.hours:g} h, seed 2029",
        "Training": f"{steps.effort.method_frames} images, {steps.effort.training_steps} steps",
    }
    if network is not None:
        rows["Class-only network SHA-256"] = hashlib.sha256(network.read_bytes()).hexdigest()
    return rows


def _remarks(quick: bool, steps: StepFolder) -> tuple[str, ...]:
    rows = [
        "Figs. 1 and 2 of the paper are block diagrams of the payload; the documentation of this system has its own.",
        "The paper's Figs. 7, 8 and 10 are drawings without a table of values; only their form can be compared.",
        "The session circles the Moon, where real height data of the project are available only in places; it is flown "
        "over the procedural Moon (level 2).",
    ]
    if quick:
        effort = steps.effort
        rows.insert(
            0,
            f"Quick run: {effort.hours:g} h instead of 24 h, {effort.sample_frames} and {effort.method_frames} images "
            f"instead of 400 and 600, {effort.training_steps} training steps instead of 420, positions of the "
            f"field-of-view study each {effort.fov_step_s:g} s.",
        )
    return tuple(rows)
