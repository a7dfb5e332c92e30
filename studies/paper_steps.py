"""Steps of the document on the paper's figures: each leaves its result in a folder and is done once.

A step is finished when `steps/NAME.json` states what it was made from and that still holds. Long steps (data set,
training) also continue from where they stopped.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue, class_counts, completed_to_paper, load_catalogue, paper_density_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder, default_orientation
from lunar.fov_study import study_field_of_view
from lunar.frames import mcmf_from_spherical
from lunar.visibility import even_epochs, ground_track
from payload_emulator.session.scenario import SHIPPED, load_scenario
from payload_emulator.session.world.orbit import force_model, propagate_scenario, sample
from payload_emulator.session.world.recipe import Recipe, load_recipe
from payload_emulator.training.data.dataset import Dataset, write_json

Log = Callable[[str], None]
Progress = Callable[[Iterable[Any], int], Iterator[Any]]

VAVILOV_DEG = (-0.8, 221.2)
"""Latitude and east longitude of the crater of the paper's Fig. 3."""

VAVILOV_ALTITUDE_M = 110e3
VAVILOV_SUN_DEG = 8.0
SAMPLE_COLUMNS, SAMPLE_ROWS = 4, 2
GALLERY_FRAMES = 6
ELEMENTS = {
    "Semi-major axis": ("semi_major_axis_km", "{:.3f} km"),
    "Eccentricity": ("eccentricity", "{:.6f}"),
    "Inclination": ("inclination_deg", "{:.3f}°"),
    "RAAN": ("raan_deg", "{:.3f}°"),
    "Argument of perilune": ("argument_of_perilune_deg", "{:.3f}°"),
    "True anomaly": ("true_anomaly_deg", "{:.3f}°"),
}


@dataclass(frozen=True, slots=True)
class Effort:
    """Size of every step.

    `hours` of the session; `unseen_passes` over real terrain never used in training; `sample_frames` of the paper's
    data set; `method_frames` and `training_steps` of the class-only network; `fov_step_s` between positions of the
    study.
    """

    hours: float = 24.0
    unseen_passes: int = 6
    sample_frames: int = 400
    method_frames: int = 600
    training_steps: int = 420
    days: float = 30.0
    fov_step_s: float = 30.0


QUICK = Effort(hours=3.0, unseen_passes=1, sample_frames=40, method_frames=120, training_steps=60, fov_step_s=300.0)


@dataclass(frozen=True, slots=True, eq=False)
class StepFolder:
    """Working folder and inputs of the steps.

    `model` is a class-only network made elsewhere; None: it is trained, if torch is installed.
    """

    out: Path
    data: DataFolder
    effort: Effort
    model: Path | None
    log: Log
    progress: Progress

    def step(self, name: str, made_from: Mapping[str, Any], make: Callable[[], Any]) -> Any:
        """Return the result of a step, which is made only if it has not been made from the same things."""
        path = self.out / "steps" / f"{name}.json"
        wanted = json.loads(json.dumps({**made_from, "data": list(self.data.names())}))
        if path.is_file():
            stored = json.loads(path.read_text(encoding="utf-8"))
            if stored["made_from"] == wanted:
                self.log(f"{name}: already done")
                return stored["result"]
        self.log(f"{name} ...")
        result = json.loads(json.dumps(make()))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"made_from": wanted, "result": result})
        return result

    @property
    def real(self) -> bool:
        """True if height rasters and a catalogue of the real Moon are available."""
        return bool((self.data.dem_sldem or self.data.dem_tiles) and self.catalogue_path)

    @property
    def catalogue_path(self) -> Path | None:
        """The most complete crater catalogue of the data folder."""
        return self.data.catalogue_composite or self.data.catalogue_lu or self.data.catalogue_robbins


def orbit(steps: StepFolder) -> dict[str, Any]:
    """Altitudes over the month, and the images that a day can give."""

    def make() -> dict[str, Any]:
        scenario = load_scenario("selenita")
        model = force_model(scenario, steps.data)
        flown = propagate_scenario(scenario, model, steps.effort.days * 86_400.0)
        _, states = sample(flown, 30.0)
        altitude_km = (np.linalg.norm(states[:, :3], axis=1) - MOON_RADIUS_M) / 1e3
        ephemeris, _ = sample(flown, 15.0)
        orientation = default_orientation(steps.data)
        first_day = even_epochs(ephemeris, 15.0)[: 24 * 240]
        latitude = np.degrees(ground_track(ephemeris, orientation, first_day).latitude_rad)
        return {
            "elements": {name: text.format(getattr(scenario.orbit, key)) for name, (key, text) in ELEMENTS.items()},
            "altitude_km": {
                "mean": float(altitude_km.mean()),
                "min": float(altitude_km.min()),
                "max": float(altitude_km.max()),
            },
            "days": steps.effort.days,
            "maneuvers": len(flown.maneuvers),
            "frames_of_a_day": int(np.count_nonzero(np.abs(latitude) <= 60.0)),
            "gravity": f"{model.gravity.name} to degree {model.degree}",
        }

    return dict(steps.step("orbit", {"days": steps.effort.days}, make))


def open_catalogue(steps: StepFolder) -> CraterCatalogue:
    """The most complete real catalogue, or a synthetic one of the paper's density."""
    return paper_density_catalogue(1) if steps.catalogue_path is None else load_catalogue(steps.catalogue_path)


def paper_density(steps: StepFolder) -> CraterCatalogue:
    """A catalogue with the paper's class counts: the real one with random craters in its empty tiles, or synthetic."""
    path = steps.data.catalogue_lu
    return paper_density_catalogue(1) if path is None else completed_to_paper(load_catalogue(path), 1)


def field_of_view(steps: StepFolder) -> dict[str, Any]:
    """The paper's study of the field of view over the month's orbit."""

    def make() -> dict[str, Any]:
        scenario = load_scenario("selenita")
        flown = propagate_scenario(scenario, force_model(scenario, steps.data), steps.effort.days * 86_400.0)
        ephemeris, _ = sample(flown, steps.effort.fov_step_s)
        track = ground_track(
            ephemeris, default_orientation(steps.data), even_epochs(ephemeris, steps.effort.fov_step_s)
        )
        position = mcmf_from_spherical(track.latitude_rad, track.longitude_rad, track.altitude_m)
        study = study_field_of_view(position, paper_density(steps))
        return {
            "fov_deg": study.fov_deg.tolist(),
            "probability": {str(n): values.tolist() for n, values in study.probability_at_least.items()},
            "selected_fov_deg": None if math.isnan(study.selected_fov_deg) else study.selected_fov_deg,
            "positions": int(study.positions_covered),
            "source": study.source,
        }

    return dict(
        steps.step(
            "fov",
            {"days": steps.effort.days, "step_s": steps.effort.fov_step_s, "density": "paper", "places": "all"},
            make,
        )
    )


def classes(steps: StepFolder) -> tuple[FloatArray, tuple[int, int, int], str]:
    """Diameters of 5 to 30 km, kilometres, the counts of the classes, and the source."""
    catalogue = open_catalogue(steps)
    first, second, third = (int(n) for n in class_counts(catalogue))
    return catalogue.diameter_m / 1e3, (first, second, third), catalogue.source


def region(steps: StepFolder) -> dict[str, Any]:
    """A picture of the place of the paper's Fig. 3, `region.png`."""
    path = steps.out / "region.png"

    def make() -> dict[str, Any]:
        from payload_emulator.sim.render.photometry import Photometry
        from payload_emulator.sim.render.renderer import render
        from payload_emulator.sim.terrain.opening import open_terrain

        terrain = (
            open_terrain("raster", steps.data, 1, sharpen=False)
            if steps.real
            else open_terrain("procedural", steps.data, 1)
        )
        latitude, longitude = (math.radians(v) for v in VAVILOV_DEG)
        position = mcmf_from_spherical(latitude, longitude, VAVILOV_ALTITUDE_M)
        up = position / np.linalg.norm(position)
        east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
        elevation = math.radians(VAVILOV_SUN_DEG)
        sun = math.sin(elevation) * up - math.cos(elevation) * east
        camera = PinholeCamera(768, 768, math.radians(90.0))
        radiance = render(
            terrain, camera, position, nadir_camera_from_mcmf(position), sun, Photometry("lunar-lambert")
        ).radiance
        gray = radiance if radiance.ndim == 2 else radiance.mean(axis=-1)
        shown = np.clip(255.0 * gray / max(float(np.percentile(gray, 99.7)), 1e-12), 0, 255).astype(np.uint8)
        save_png(path, shown)
        return {"terrain": terrain.name, "data": list(terrain.data_names)}

    if not path.is_file():
        (steps.out / "steps" / "region.json").unlink(missing_ok=True)
    return dict(steps.step("region", {"place": VAVILOV_DEG, "altitude_m": VAVILOV_ALTITUDE_M}, make))


def sample_dataset(steps: StepFolder) -> dict[str, Any]:
    """The paper's data set in small, with a sheet of its frames, `samples.png`."""
    recipe = load_recipe(SHIPPED / "paper-dataset.toml")
    if steps.real:
        recipe = replace(recipe, sources=tuple(replace(source, terrain="real") for source in recipe.sources))
    folder = steps.out / f"samples-{recipe.digest[:8]}-{steps.effort.sample_frames}"

    def make() -> dict[str, Any]:
        from payload_emulator.training.data.integrity import summarise
        from payload_emulator.training.evaluate.sheets import draw_sheet

        _build(steps, recipe, folder, steps.effort.sample_frames)
        sheet = draw_sheet(Dataset(folder), "", SAMPLE_COLUMNS, SAMPLE_ROWS, 320)
        save_png(steps.out / "samples.png", sheet)
        figures = summarise(folder)
        return {name: figures[name] for name in ("frames", "instances", "labels_sha256", "data")}

    made_from = {"recipe": recipe.digest, "frames": steps.effort.sample_frames}
    return dict(steps.step("samples", made_from, make))


def method_dataset(steps: StepFolder) -> Path:
    """Data set of the paper's own detector; without real terrain, its procedural sources alone."""
    recipe = load_recipe(SHIPPED / "paper-method-dataset.toml")
    if not steps.real:
        kept = [source for source in recipe.sources if source.terrain == "procedural"]
        total = sum(source.share for source in kept)
        recipe = replace(recipe, sources=tuple(replace(source, share=source.share / total) for source in kept))
    folder = steps.out / f"method-{recipe.digest[:8]}-{steps.effort.method_frames}"

    def make() -> dict[str, Any]:
        _build(steps, recipe, folder, steps.effort.method_frames)
        return {"labels_sha256": Dataset(folder).digest}

    steps.step("method data set", {"recipe": recipe.digest, "frames": steps.effort.method_frames}, make)
    return folder


def class_only_network(steps: StepFolder, dataset: Path) -> Path | None:
    """The paper's own detector: class heatmaps and offsets; None where it cannot be trained here."""
    import importlib.util

    if steps.model is not None:
        return steps.model
    if importlib.util.find_spec("torch") is None:
        return None
    path = steps.out / "class-only.onnx"

    def make() -> dict[str, Any]:
        from payload_emulator.flight.models import DEFAULT_NETWORK, load_shipped_model
        from payload_emulator.flight.vision.preprocess import Preparation
        from payload_emulator.training.data.feeder import TrainParameters
        from payload_emulator.training.model.export import export
        from payload_emulator.training.model.train import train

        run = steps.out / f"run-{dataset.name}-{steps.effort.training_steps}"
        start = steps.out / "start.onnx"
        start.write_bytes(load_shipped_model(DEFAULT_NETWORK))
        parameters = TrainParameters(
            minutes=0.0,
            steps=steps.effort.training_steps,
            learning_rate=1e-3,
            replicas=1,
            seed=5,
            preparation=Preparation.normalise_first,
        )
        sets = [Dataset(dataset)]
        train(sets, run, parameters, start_from=start, report=steps.log)
        best = run / "best.pt"
        export(best if best.is_file() else run / "checkpoint.pt", path, sets, classes_only=True)
        return {"steps": steps.effort.training_steps}

    made_from = {"labels": Dataset(dataset).digest, "steps": steps.effort.training_steps}
    if not path.is_file():
        (steps.out / "steps" / "class-only network.json").unlink(missing_ok=True)
    steps.step("class-only network", made_from, make)
    return path


def evaluation(steps: StepFolder, name: str, octets: bytes, dataset: Path, paper_classes: bool) -> dict[str, Any]:
    """Scores of a network on the test frames of the highest evidence level available.

    The gallery goes to `gallery-NAME.npz`.
    """
    import hashlib

    path = steps.out / f"gallery-{name}.npz"
    source = "real-strip" if steps.real else "procedural-world"

    def make() -> dict[str, Any]:
        from payload_emulator.training.evaluate.evaluate import open_for_evaluation, run, summary
        from payload_emulator.training.evaluate.report import detector_report

        detector, sets = open_for_evaluation(octets), [Dataset(dataset)]
        scored = run(
            detector, sets, "test", source, None, lambda f: steps.progress(f, len(f)), paper_classes=paper_classes
        )
        figures = summary(detector, sets, scored, "test", source)
        gallery = detector_report(detector, scored, figures).gallery[:GALLERY_FRAMES]
        save_gallery(path, gallery)
        kept = ("frames", "level", "per_class", "micro", "data")
        return {key: figures[key] for key in kept}

    if not path.is_file():
        (steps.out / "steps" / f"evaluation of {name}.json").unlink(missing_ok=True)
    made_from = {"model": hashlib.sha256(octets).hexdigest(), "labels": Dataset(dataset).digest, "source": source}
    return dict(steps.step(f"evaluation of {name}", made_from, make))


def _build(steps: StepFolder, recipe: Recipe, folder: Path, frames: int) -> None:
    from payload_emulator.training.data.build import build

    for done, total in build(recipe, folder, frames, steps.data, 1):
        if done % 20 == 0 or done == total:
            steps.log(f"{folder.name}: {done}/{total} frames")


def save_png(path: Path, picture: Any) -> None:
    """Write a gray or RGB picture in one move."""
    from payload_emulator.training.data.dataset import write_picture

    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, picture if picture.ndim == 2 else picture[..., ::-1])


def load_png(path: Path) -> Any:
    """Return a gray or RGB picture."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return picture if picture.ndim == 2 else np.ascontiguousarray(picture[..., ::-1])


def save_gallery(path: Path, frames: Iterable[Any]) -> None:
    """Write frames of a gallery as one archive of arrays."""
    arrays: dict[str, Any] = {}
    for k, frame in enumerate(frames):
        for name, value in asdict(frame).items():
            if value is not None:
                arrays[f"{k}/{name}"] = value
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def load_gallery(path: Path) -> tuple[Any, ...]:
    """Return the frames of a gallery."""
    from reports.values import GalleryFrame

    frames: dict[int, dict[str, Any]] = {}
    with np.load(path) as arrays:
        for key in arrays.files:
            number, _, name = key.partition("/")
            value = arrays[key]
            frames.setdefault(int(number), {})[name] = value.item() if value.ndim == 0 else value
    return tuple(GalleryFrame(**{"utc_ns": None, **frames[k]}) for k in sorted(frames))
