"""Places of a data set along an ephemeris, by the paper's rule (section V-B.4), and the paper's split of them (V-C)."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera, ground_point_sphere, nadir_camera_from_mcmf
from lunar.constants import NS, SECONDS_PER_DAY
from lunar.datafolder import DataFolder, default_orientation
from lunar.frames import spherical_from_mcmf
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.errors import DatasetError
from payload_emulator.session.world.recipe import EVERYWHERE, PAPER_SHARES, PAPER_SPLIT, Source
from payload_emulator.training.data.shots import allowed, edge_pixels

_BATCH = 4096  # places looked at together: their footprints take a few MB
_STRIP_RAD = np.radians(10.0)  # a few footprints wide: the tiles of one crossing fit the terrain's cache


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Frames along an ephemeris in order of time: epochs (n,), places (n, 3) in MCMF m, split of each (n,).

    order : indices (n,) in the order in which the frames are best made: neighbours on the ground follow each other.
    """

    utc_ns: IntArray
    position_mcmf_m: FloatArray
    split: tuple[str, ...]
    order: IntArray

    @property
    def digest(self) -> str:
        """Hash of the epochs, the places to the millimetre and the order."""
        octets = self.utc_ns.tobytes() + np.rint(self.position_mcmf_m * 1e3).astype(np.int64).tobytes()
        return hashlib.sha256(octets + self.order.tobytes()).hexdigest()


def lay_track(source: Source, camera: PinholeCamera, terrain: Any, data: DataFolder, wanted: int, seed: int) -> Track:
    """The first `wanted` places of a source's ephemeris from which frames can be taken.

    Left out are places beyond the latitude limit, footprints that leave the terrain, and, where the source has boxes or
    boxes to avoid, those outside the former or within the buffer of the latter.

    Raises
    ------
    DatasetError
        The ephemeris has fewer such places.
    """
    utc_ns, position = _places(source, data)
    latitude, _, _ = spherical_from_mcmf(position)
    chosen = np.flatnonzero(np.abs(np.degrees(latitude)) <= source.latitude_limit_deg)
    kept: list[int] = []
    for first in range(0, chosen.size, _BATCH):
        batch = chosen[first : first + _BATCH]
        good = _can_look(source, camera, terrain, position[batch])
        kept.extend(int(k) for k in batch[good])
        if len(kept) >= wanted:
            break
    if len(kept) < wanted:
        raise DatasetError(
            f"data set source {source.name!r}: expected {wanted} places along {Path(source.ephemeris).name} within "
            f"{source.latitude_limit_deg:g} deg of the equator and on the terrain, found {len(kept)} of {utc_ns.size}: "
            f"a longer ephemeris, a shorter step or fewer frames"
        )
    taken = np.array(kept[:wanted], dtype=np.int64)
    order = order_by_ground(position[taken], camera, terrain)
    return Track(utc_ns[taken], position[taken], split_track(source.split, wanted, seed), order)


def order_by_ground(position_mcmf_m: FloatArray, camera: PinholeCamera, terrain: Any) -> IntArray:
    """Indices (n,) of places (n, 3) such that those over the same tiles of the terrain come together.

    By level of the terrain, which follows from the altitude, then by strips along meridians, north and south in turn.
    """
    latitude, longitude, altitude_m = spherical_from_mcmf(position_mcmf_m)
    level = np.array([terrain.level_for(above / camera.focal_px) for above in altitude_m], dtype=np.int64)
    strip = (longitude % (2.0 * np.pi) // _STRIP_RAD).astype(np.int64)
    northward = np.where((level + strip) % 2 == 0, latitude, -latitude)
    return np.lexsort((northward, strip, level)).astype(np.int64)


def split_track(split: str, count: int, seed: int) -> tuple[str, ...]:
    """The split of each of `count` frames in order of time; for the paper's, the test arc comes last."""
    if split != PAPER_SPLIT:
        return (split,) * count
    test = round(PAPER_SHARES[2] * count)
    rest = count - test
    validation = round(rest * PAPER_SHARES[1] / (PAPER_SHARES[0] + PAPER_SHARES[1]))
    rng = np.random.Generator(np.random.Philox(key=[seed, 0x53504C4954]))
    names = np.full(rest, "train", dtype="U5")
    names[rng.permutation(rest)[:validation]] = "val"
    return (*(str(name) for name in names), *("test",) * test)


def _can_look(source: Source, camera: PinholeCamera, terrain: Any, position: FloatArray) -> BoolArray:
    """Return whether the nadir footprint from each place (n, 3) is on the terrain and where the source may look."""
    rotation = nadir_camera_from_mcmf(position)
    ground = ground_point_sphere(camera, rotation[:, None], position[:, None], edge_pixels(camera))
    latitude, longitude, _ = spherical_from_mcmf(ground)
    good = np.isfinite(latitude).all(axis=1) & np.all(terrain.covers(latitude, longitude), axis=1)
    if source.boxes != EVERYWHERE or source.avoid:
        degrees = np.degrees(latitude), np.degrees(longitude)
        good &= [
            any(allowed(source, box, degrees[0][k], degrees[1][k]) for box in source.boxes)
            for k in range(position.shape[0])
        ]
    return np.asarray(good, dtype=bool)


def _places(source: Source, data: DataFolder) -> tuple[IntArray, FloatArray]:
    """Epochs (n,) every `step_s` and places (n, 3) in MCMF m of an ephemeris file or a scenario's orbit."""
    if source.ephemeris.endswith((".oem", ".e")):
        from lunar.messages.ephemeris_files import load_orbit

        ephemeris, orientation = load_orbit(Path(source.ephemeris)), default_orientation(data)
    else:
        from payload_emulator.session.scenario import load_scenario
        from payload_emulator.session.world.orbit import force_model, propagate_scenario, sample

        scenario = load_scenario(source.ephemeris)
        model = force_model(scenario, data)
        orbit = propagate_scenario(scenario, model, source.days * SECONDS_PER_DAY)
        ephemeris, orientation = sample(orbit, source.step_s)[0], model.orientation
    step_ns = round(source.step_s * NS)
    utc_ns: list[IntArray] = []
    position_icrf_m: list[FloatArray] = []
    for segment in ephemeris.segments:
        times = np.arange(segment.start_utc_ns, segment.stop_utc_ns + 1, step_ns, dtype=np.int64)
        if utc_ns:
            # The step goes on over burns and gaps: the first epoch of all sets the grid.
            origin = int(utc_ns[0][0])
            first = origin + -(-(segment.start_utc_ns - origin) // step_ns) * step_ns
            times = np.arange(first, segment.stop_utc_ns + 1, step_ns, dtype=np.int64)
            times = times[times > utc_ns[-1][-1]]
        if times.size:
            utc_ns.append(times)
            position_icrf_m.append(ephemeris.at(times)[0])
    epochs = np.concatenate(utc_ns)
    rotation = orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(epochs), dtype=np.float64))
    return epochs, np.einsum("nij,nj->ni", rotation, np.concatenate(position_icrf_m))
