"""Learning from flight with known truth: python -m benchmarks learning.

A seeded share of the craters is withheld from the anchoring table on board and from the catalogue of the ground.
Several passes over one region are flown and searched for landmarks, all proposed landmarks are accepted, and later
passes over the same region are flown with the thinned table, with the learned craters added, and with all craters.

With real terrain the region is one that no detector was trained on (evidence level 3), otherwise the procedural Moon
(level 2). The reference ephemeris has the declared errors of orbit determination.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.evaluation.detection.recall import expected_craters, match_detections
from ground_service.evaluation.inputs import load_pass_inputs
from ground_service.evaluation.navigation.alignment import reference_states
from ground_service.evaluation.service import pass_summary
from ground_service.ground import Ground, open_ground
from ground_service.http.model import PageOf
from ground_service.landmarks.core import PASSES_NEEDED, SIGHTINGS_NEEDED
from ground_service.landmarks.documents import extended_catalogue, extended_table
from ground_service.landmarks.model import Landmark, LandmarkFilter
from ground_service.landmarks.service import decide_landmark, update_landmarks
from ground_service.landmarks.store import list_landmarks
from ground_service.passes.archive_import import import_archive
from linna.data import data_folder
from lunar.arrays import IntArray
from lunar.catalogue import CraterCatalogue, load_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.timescales import format_utc, parse_utc
from payload_emulator.session.emulator import emulate, file_entries
from payload_emulator.session.loading import onboard_catalogue
from payload_emulator.session.scenario import Scenario, load_scenario
from payload_emulator.session.world import scenario_terrain
from tmtc.tables import CatalogueTable, pack_catalogue_table

MARGIN_DEG = 8.0
RADII = 0.5
"""A landmark is a crater if its centre lies within half a radius of it."""

SIZE_RATIO = 1.5


def main(words: Sequence[str]) -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning")
    parser.add_argument("--scenario", default="selenita")
    parser.add_argument("--passes", type=int, default=4, help="passes to learn from (default: 4)")
    parser.add_argument("--later", type=int, default=2, help="later passes (default: 2)")
    parser.add_argument(
        "--later-days", type=float, default=0.0, help="days after the last of them (default: 0)"
    )
    parser.add_argument("--withheld", type=float, default=0.5, help="share of the craters (default: 0.5)")
    parser.add_argument("--latitude-deg", type=float, default=25.0, help="on both sides of the equator")
    parser.add_argument("--seed", type=int, default=1, help="of the withheld craters")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as folder:
        figures = learn(arguments, data_folder(), Path(folder))
    print(json.dumps(figures, indent=None if arguments.json else 1))
    return 0


def learn(arguments: argparse.Namespace, data: DataFolder, work: Path) -> dict[str, Any]:
    """Return the figures of the whole chain."""
    scenario = load_scenario(arguments.scenario)
    window = replace(scenario.window, latitude_limit_deg=arguments.latitude_deg)
    scenario = replace(scenario, window=window)
    terrain = scenario_terrain(scenario, data)
    # The list of real craters has no rim heights: they are measured on the terrain, as for the table on board.
    craters = terrain.measured(_in_region(terrain.catalogue, scenario))
    rng = np.random.default_rng(arguments.seed)
    hidden = np.sort(rng.permutation(craters.ids)[: round(arguments.withheld * len(craters))])
    full = onboard_catalogue(scenario, craters)
    thin = full.select(~np.isin(full.ids, hidden))
    if arguments.later and not len(thin.ids):
        raise SystemExit(
            f"{terrain.name}: expected craters with rim heights for the table on board, found none of {len(craters)}; "
            "use --later 0, which needs no table"
        )
    with open_ground(work / "home", data=data) as ground:
        start, learned = "", []
        for k in range(arguments.passes):
            archive = work / f"pass-{k}"
            start = _flown(scenario, data, thin, archive, start, scenario.window.direction)
            _thinned(archive, lambda one: one.select(~np.isin(one.ids, hidden)))
            learned.append(import_archive(ground, archive))
            update = update_landmarks(ground, learned[-1])
            print(f"pass {k + 1}: {update.model_dump_json()}", file=sys.stderr)
            shutil.rmtree(archive)
        recoverable = _recoverable(ground, learned, craters.select(np.isin(craters.ids, hidden)))
        for one in _all(ground, "proposed"):
            decide_landmark(ground, one.id, accept=True, reason="benchmark", actor="benchmark")
        accepted = _all(ground, "accepted")
        tables = {"withheld": thin, "learned": extended_table(thin, accepted), "all": full}
        epoch = parse_utc(start) + round(arguments.later_days * 86_400e9)
        later = {
            name: _later(
                ground,
                scenario,
                data,
                table,
                work,
                format_utc(epoch),
                arguments.later,
                hidden,
                accepted if name == "learned" else (),
            )
            for name, table in tables.items()
        }
    return {
        "scenario": scenario.name,
        "terrain": terrain.name,
        "evidence_level": "3" if terrain.is_real else "2",
        "passes": arguments.passes,
        "craters": len(craters),
        "withheld": len(hidden),
        **recoverable[0],
        **_compared(accepted, terrain.catalogue, hidden, recoverable[1]),
        "later_passes": later,
    }


def _in_region(catalogue: CraterCatalogue, scenario: Scenario) -> IntArray:
    window, navigation = scenario.window, scenario.navigation
    west = window.longitude_min_deg - MARGIN_DEG
    width = window.longitude_max_deg - window.longitude_min_deg + 2.0 * MARGIN_DEG
    inside = np.mod(np.degrees(catalogue.longitude_rad) - west, 360.0) <= width
    inside &= np.abs(np.degrees(catalogue.latitude_rad)) <= window.latitude_limit_deg + MARGIN_DEG
    inside &= catalogue.diameter_m >= 1e3 * navigation.catalogue_min_diameter_km
    inside &= catalogue.diameter_m <= 1e3 * navigation.catalogue_max_diameter_km
    return np.flatnonzero(inside)


def _flown(
    scenario: Scenario, data: DataFolder, table: CatalogueTable, archive: Path, start: str, direction: str
) -> str:
    """Fly the first window after a time; return the time at which it has ended."""
    path = archive.with_suffix(".table")
    path.write_bytes(pack_catalogue_table(table))
    flown = replace(
        scenario,
        window=replace(scenario.window, start=start, direction=direction),
        navigation=replace(scenario.navigation, anchoring_catalogue=str(path)),
    )
    emulate(flown, data, archive)
    manifest = json.loads((archive / "manifest.json").read_text())
    return format_utc(parse_utc(manifest["stop_utc"]) + 600 * 10**9)


def _thinned(archive: Path, change: Callable[[CraterCatalogue], CraterCatalogue]) -> None:
    """Replace the catalogue of an archive by the one that the ground has."""
    save_catalogue(change(load_catalogue(archive / "catalogue.csv")), archive / "catalogue.csv")
    manifest = json.loads((archive / "manifest.json").read_text())
    manifest["files"] = file_entries(archive)
    (archive / "manifest.json").write_text(json.dumps(manifest))


def _later(
    ground: Ground,
    scenario: Scenario,
    data: DataFolder,
    table: CatalogueTable,
    work: Path,
    start: str,
    passes: int,
    hidden: IntArray,
    accepted: Sequence[Landmark],
) -> list[dict[str, Any]]:
    """Return the figures of later passes that are flown with a table; the ground has the same craters.

    Parameters
    ----------
    accepted
        Landmarks that the table contains.
    """
    rows = []
    complete = bool(np.isin(hidden, table.ids).any())

    def known(catalogue: CraterCatalogue) -> CraterCatalogue:
        if complete:
            return catalogue
        thin = catalogue.select(~np.isin(catalogue.ids, hidden))
        return extended_catalogue(thin, accepted) if accepted else thin

    for k in range(passes):
        archive = work / f"later-{k}"
        start = _flown(scenario, data, table, archive, start, scenario.window.direction)
        _thinned(archive, known)
        pass_id = import_archive(ground, archive)
        summary = pass_summary(ground, pass_id)
        anchored = summary["navigation"].get("anchored", {})  # absent if the estimator gave no state
        rows.append(
            {
                "start": json.loads((archive / "manifest.json").read_text())["start_utc"],
                "frames": summary["frames"],
                "recall": summary["detector"]["recall"],
                "precision": summary["detector"]["precision"],
                "median_3d_m": anchored.get("median_3d_m"),
                "p95_3d_m": anchored.get("p95_3d_m"),
                "fixes": _fixes(ground, pass_id),
            }
        )
        shutil.rmtree(archive)
    return rows


def _fixes(ground: Ground, pass_id: int) -> int:
    for one in load_pass_inputs(ground, pass_id).outcomes:
        if one.estimator == "anchored":
            return sum(outcome == "fixed" for outcome in one.outcome)
    return 0


def _recoverable(
    ground: Ground, passes: Sequence[int], withheld: CraterCatalogue
) -> tuple[dict[str, int], IntArray]:
    """Count the withheld craters that were in view, and that were detected, as often as a landmark has to be."""
    in_view, detected = np.zeros((2, len(passes), len(withheld)), dtype=np.int64)
    for k, pass_id in enumerate(passes):
        inputs = load_pass_inputs(ground, pass_id)
        detections, viewing = inputs.detections, inputs.viewing
        track = reference_states(inputs.reference, inputs.orientation, detections.utc_ns)
        rotation = viewing.camera_from_mcmf(detections.utc_ns, track.position_mcmf_m, track.mcmf_from_icrf)
        expected = expected_craters(withheld, viewing.camera, track.position_mcmf_m, rotation)
        found = match_detections(detections, expected).detection_of_crater >= 0
        in_view[k] = np.bincount(expected.index, minlength=len(withheld))
        detected[k] = np.bincount(expected.index[found], minlength=len(withheld))

    def often(counts: IntArray) -> Any:
        return (np.count_nonzero(counts >= 2, axis=0) >= PASSES_NEEDED) & (
            counts.sum(axis=0) >= SIGHTINGS_NEEDED
        )

    figures = {
        "withheld_in_view": int(np.count_nonzero(often(in_view))),
        "withheld_detected": int(np.count_nonzero(often(detected))),
    }
    return figures, withheld.ids[often(detected)]


def _compared(
    landmarks: Sequence[Landmark], craters: CraterCatalogue, hidden: IntArray, detected: IntArray
) -> dict[str, Any]:
    """Compare landmarks with all craters of the terrain.

    Other craters are those that no catalogue of the exercise has, such as those below its smallest diameter.
    """
    recovered: set[int] = set()
    errors, ratios, kinds = [], [], {"withheld": 0, "other_crater": 0, "no_crater": 0}
    for one in landmarks:
        latitude, longitude = np.radians([one.latitude_deg, one.longitude_deg])
        near = craters.near(float(latitude), float(longitude), one.diameter_m)
        near = near[np.abs(np.log(craters.diameter_m[near] / one.diameter_m)) < np.log(SIZE_RATIO)]
        turn = np.mod(longitude - craters.longitude_rad[near] + np.pi, 2.0 * np.pi) - np.pi
        offset = MOON_RADIUS_M * np.column_stack(
            [turn * np.cos(latitude), latitude - craters.latitude_rad[near]]
        )
        apart = np.hypot(*offset.T)
        close = np.flatnonzero(apart <= RADII * craters.diameter_m[near] / 2.0)
        if not close.size:
            kinds["no_crater"] += 1
            continue
        best = int(close[np.argmin(apart[close])])
        crater = int(craters.ids[near[best]])
        if crater not in hidden:
            kinds["other_crater"] += 1
            continue
        kinds["withheld"] += 1
        recovered.add(crater)
        errors.append(float(apart[best]))
        ratios.append(offset[best] / [one.sigma_east_m, one.sigma_north_m])
    return {
        "landmarks": len(landmarks),
        "landmarks_are": kinds,
        "recovered": len(recovered),
        "recovered_of_detected": len(recovered & set(detected.tolist())),
        "position_error_median_m": float(np.median(errors)) if errors else None,
        "position_error_p95_m": float(np.percentile(errors, 95)) if errors else None,
        "mean_square_error_over_sigma": float(np.mean(np.square(ratios))) if errors else None,
    }


def _all(ground: Ground, state: Any) -> list[Landmark]:
    def page(offset: int) -> PageOf[Landmark]:
        return ground.read(list_landmarks, LandmarkFilter(state=state, limit=1000, offset=offset))

    return [one for offset in range(0, page(0).total, 1000) for one in page(offset).items]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
