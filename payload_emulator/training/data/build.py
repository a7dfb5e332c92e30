"""Rendering of a data set, shard by shard: a pure function of recipe, data and shard number, whatever the workers.

Resumable: a shard whose labels file exists is not made again, and that file is written after everything else of the
shard, in one move. Memory: each worker keeps one terrain at a time, and of that the tiles last looked at.
"""

import hashlib
import itertools
import json
import math
import multiprocessing
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lunar.camera import PinholeCamera
from lunar.datafolder import DataFolder, find_data
from payload_emulator.errors import DatasetError
from payload_emulator.session.world.frame import find_renderer
from payload_emulator.session.world.recipe import Recipe, Source
from payload_emulator.training.data import dataset as store
from payload_emulator.training.data.finishing import write_index
from payload_emulator.training.data.frames import describe, take_frame
from payload_emulator.training.data.shots import ShardBox, draw_box, draw_pose, pose_at, view_position_mcmf_m
from payload_emulator.training.data.track import Track, lay_track

_FOLDERS = ("images", "metadata", "shards")
_LONGEST_RUN = 8  # shards that one worker makes in turn
_TERRAIN_KINDS = {"real": "raster", "procedural": "procedural", "catalogue": "catalogue"}


@dataclass(frozen=True, slots=True)
class Shard:
    """Frames of one source by their numbers; along an ephemeris with their epochs, places in MCMF m and splits."""

    name: str
    source: Source
    seed: int
    number: int
    frame_numbers: tuple[int, ...]
    utc_ns: tuple[int, ...] = ()
    position_mcmf_m: tuple[tuple[float, float, float], ...] = ()
    split: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        return len(self.frame_numbers)


def plan_shards(recipe: Recipe, frames: int, tracks: Mapping[str, Track] | None = None) -> list[Shard]:
    """Shards of a data set of about `frames` frames; each source gets its share, rounded to whole frames.

    `tracks` holds the places of the sources that follow an ephemeris, by name.
    """
    shards: list[Shard] = []
    first = 0
    for source, wanted in _wanted(recipe, frames):
        track = (tracks or {}).get(source.name)
        for done in range(0, wanted, recipe.frames_per_shard):
            count = min(wanted - done, recipe.frames_per_shard)
            # Runs of one seed, so that a worker seldom has to open another terrain.
            seed = source.seeds[done * len(source.seeds) // wanted]
            # Along an ephemeris neighbours on the ground share a shard; frames keep their numbers by time.
            places = range(done, done + count) if track is None else track.order[done : done + count].tolist()
            numbers = tuple(first + place for place in places)
            along = _along(track, places) if track is not None else {}
            shards.append(Shard(f"{len(shards):05d}", source, seed, len(shards), numbers, **along))
        first += wanted
    return shards


def build(
    recipe: Recipe, folder: Path, frames: int, data: DataFolder, workers: int = 1, blender_python: str = sys.executable
) -> Iterator[tuple[int, int]]:
    """Make or finish a data set; yields (frames done, frames in all) after every shard.

    `blender_python` is the interpreter that has Blender, for the renderer cycles.

    Raises
    ------
    ScenarioError
        There is no such renderer.
    DatasetError
        The folder holds another data set or is being written, the recipe needs data that are not there, a file cannot
        be written, or a worker died; what was finished before is kept.
    RendererError
        There is no Blender, or it failed.
    """
    find_renderer(recipe.renderer)
    _check_data(recipe, data)
    tracks = _lay_tracks(recipe, frames, data)
    shards = plan_shards(recipe, frames, tracks)
    total = sum(shard.frames for shard in shards)
    _claim(folder, recipe, frames, tracks)
    with _locked(folder):
        for place in (folder, *(folder / name for name in _FOLDERS)):
            for path in place.glob(".*"):  # what a killed build left half-written
                path.unlink(missing_ok=True)
        todo = [shard for shard in shards if not _shard_path(folder, shard).is_file()]
        done = total - sum(shard.frames for shard in todo)
        yield done, total
        try:
            for shard in _make(recipe, todo, folder, str(data.root or ""), workers, blender_python):
                done += shard.frames
                yield done, total
            hashes = {
                shard.name: hashlib.sha256(_shard_path(folder, shard).read_bytes()).hexdigest() for shard in shards
            }
            write_index(folder, recipe, total, hashes, _data_names(recipe, data))
        except OSError as error:
            where = f" ({error.filename})" if error.filename else ""
            raise DatasetError(
                f"{folder}: {error.strerror or error}{where}; {done} of {total} frames are kept, "
                "the same command goes on from there"
            ) from error
        except BrokenProcessPool:
            raise DatasetError(
                f"{folder}: a worker process died (killed, or out of memory); {done} of {total} frames are kept, "
                "the same command goes on from there"
            ) from None


def make_shard(
    recipe: Recipe, shard: Shard, folder: Path, data_root: str, blender_python: str = sys.executable
) -> None:
    """Render the frames of one shard and write them with their labels."""
    source = shard.source
    render = find_renderer(recipe.renderer, blender_python)
    terrain = _terrain(source, shard.seed, data_root)
    rng = np.random.Generator(np.random.Philox(key=[recipe.seed, shard.number]))
    camera = _camera(recipe)
    place = None if source.ephemeris else ShardBox(draw_box(source, rng))
    shots: list[Any] = []
    hashes = []
    for k, number in enumerate(shard.frame_numbers):
        view = k % source.views
        first = shots[k - view] if view else None

        def pose_of(
            generator: np.random.Generator, k: int = k, number: int = number, view: int = view, first: Any = first
        ) -> Any:
            if place is not None and first is None:
                return draw_pose(terrain, camera, source, place, generator)
            position = (
                np.array(shard.position_mcmf_m[k]) if first is None else view_position_mcmf_m(source, first.pose, view)
            )
            return pose_at(terrain, camera, source, position, f"frame {number}", generator)

        sun_mcmf = None if first is None else first.sun_mcmf
        shot = take_frame(terrain, camera, source, pose_of, number, recipe, render, rng, sun_mcmf)
        split = shard.split[k] if shard.split else source.split
        utc_ns = shard.utc_ns[k] if shard.utc_ns else None
        document = describe(camera, shot, source, split, terrain, utc_ns)
        hashes.append(
            (
                store.write_frame(folder / "images" / f"{number:06d}.png", shot.image),
                store.write_json(folder / "metadata" / f"{number:06d}.json", document),
            )
        )
        shots.append(shot)
    labels = store.ShardLabels(
        source=source.name,
        split=source.split,
        complete=source.terrain != "real",
        frames={key: np.array([shot.row[key] for shot in shots]) for key in store.FRAME_COLUMNS},
        sun_camera=np.array([shot.pose.camera_from_mcmf @ shot.sun_mcmf for shot in shots]),
        camera_from_mcmf=np.array([shot.pose.camera_from_mcmf for shot in shots]),
        position_mcmf_m=np.array([shot.pose.position_mcmf_m for shot in shots]),
        craters={key: np.concatenate([shot.craters[key] for shot in shots]) for key in shots[0].craters},
        first=np.concatenate([[0], np.cumsum([shot.craters["id"].size for shot in shots])]).astype(np.int64),
        frame_split=shard.split,
        image_sha256=tuple(image for image, _ in hashes),
        metadata_sha256=tuple(metadata for _, metadata in hashes),
    )
    store.write_shard(folder, shard.name, labels)


def _make(
    recipe: Recipe, todo: Sequence[Shard], folder: Path, data_root: str, workers: int, blender_python: str
) -> Iterator[Shard]:
    """Make shards; yields each when it is on disk."""
    if workers <= 1:
        for shard in todo:
            make_shard(recipe, shard, folder, data_root, blender_python)
            yield shard
        return
    if not todo:
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(todo)), mp_context=context, initializer=_follow_parent)
    try:
        running: dict[Future[None], Sequence[Shard]] = {
            pool.submit(_make_run, recipe, run, folder, data_root, blender_python): run for run in _runs(todo, workers)
        }
        for finished in as_completed(running):
            finished.result()
            yield from running.pop(finished)
    finally:
        # After an error nothing more is begun; shards under way are finished.
        pool.shutdown(wait=True, cancel_futures=True)


def _runs(todo: Sequence[Shard], workers: int) -> Iterator[Sequence[Shard]]:
    """Neighbouring shards of one terrain together, so that a worker finds much of the ground still in its memory."""
    longest = max(1, min(_LONGEST_RUN, len(todo) // (4 * workers)))
    for _, group in itertools.groupby(todo, key=lambda shard: (shard.source.name, shard.seed)):
        shards = list(group)
        yield from (shards[first : first + longest] for first in range(0, len(shards), longest))


def _make_run(recipe: Recipe, shards: Sequence[Shard], folder: Path, data_root: str, blender_python: str) -> None:
    for shard in shards:
        make_shard(recipe, shard, folder, data_root, blender_python)


def _follow_parent() -> None:
    """In a worker: leave interrupts to the parent, and end when it does, however it ends."""
    import signal
    import threading

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _wanted(recipe: Recipe, frames: int) -> list[tuple[Source, int]]:
    """Return the number of frames of each source."""
    total = sum(source.share for source in recipe.sources)
    if frames < len(recipe.sources) or total <= 0.0:
        raise DatasetError(f"data set: expected at least one frame per source ({len(recipe.sources)}), found {frames}")
    return [(source, max(1, round(frames * source.share / total))) for source in recipe.sources]


def _lay_tracks(recipe: Recipe, frames: int, data: DataFolder) -> dict[str, Track]:
    root = str(data.root or "")
    return {
        source.name: lay_track(
            source, _camera(recipe), _terrain(source, source.seeds[0], root), data, wanted, recipe.seed
        )
        for source, wanted in _wanted(recipe, frames)
        if source.ephemeris
    }


def _along(track: Track, places: Sequence[int]) -> dict[str, Any]:
    chosen = list(places)
    return {
        "utc_ns": tuple(int(value) for value in track.utc_ns[chosen]),
        "position_mcmf_m": tuple((float(x), float(y), float(z)) for x, y, z in track.position_mcmf_m[chosen]),
        "split": tuple(track.split[place] for place in chosen),
    }


def _camera(recipe: Recipe) -> PinholeCamera:
    return PinholeCamera(recipe.width_px, recipe.height_px, math.radians(recipe.fov_deg))


_open_terrains: dict[tuple[str, int, str, bool], Any] = {}


def _terrain(source: Source, seed: int, data_root: str) -> Any:
    """The terrain of a shard; a worker keeps the last one it used."""
    from payload_emulator.sim.terrain.opening import open_terrain

    key = (source.terrain, seed, data_root, source.sharpen)
    if key not in _open_terrains:
        _open_terrains.clear()
        data = find_data(Path(data_root) if data_root else None)
        options: dict[str, Any] = {} if source.sharpen else {"sharpen": False}
        _open_terrains[key] = open_terrain(_TERRAIN_KINDS[source.terrain], data, seed, **options)
    return _open_terrains[key]


def _shard_path(folder: Path, shard: Shard) -> Path:
    return folder / "shards" / f"{shard.name}.npz"


def _check_data(recipe: Recipe, data: DataFolder) -> None:
    kinds = {source.terrain for source in recipe.sources}
    if "real" in kinds and not data.dem_tiles:
        raise DatasetError(f"data set {recipe.name}: expected terrain tiles in the data folder, found none")


def _claim(folder: Path, recipe: Recipe, frames: int, tracks: Mapping[str, Track]) -> None:
    """Make the folder for this recipe, or refuse one that holds another data set."""
    claim = folder / "recipe.json"
    wanted: dict[str, Any] = {"recipe_sha256": recipe.digest, "frames": frames}
    if tracks:
        wanted["places_sha256"] = {name: track.digest for name, track in sorted(tracks.items())}
    if claim.is_file():
        found = json.loads(claim.read_text(encoding="utf-8"))
        if found != wanted:
            raise DatasetError(
                f"{folder}: expected an empty folder or the same data set (recipe {recipe.digest[:12]}, "
                f"{frames} frames{', the same places' if tracks else ''}), "
                f"found one of recipe {str(found.get('recipe_sha256'))[:12]}, {found.get('frames')} frames"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise DatasetError(f"{folder}: expected an empty folder or a data set, found other files")
    for name in _FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    if not claim.is_file():
        store.write_json(claim, wanted)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder alone; the lock falls with the process, however it ends."""
    import fcntl

    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DatasetError(
                f"{folder}: expected a folder that no other build uses, found a build in progress"
            ) from None
        yield
    finally:
        os.close(handle)


def _data_names(recipe: Recipe, data: DataFolder) -> list[str]:
    if any(source.terrain != "procedural" for source in recipe.sources):
        return list(data.names())
    return ["procedural Moon (no data)"]
