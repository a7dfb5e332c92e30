"""Error rates of the regression gates on recorded passes and planted builds: python -m benchmarks.gate_error_rates.

Passes of 49 frames are recorded once, over procedural terrain and, where the data are present, over real terrain. The
installed flight code is replayed over them with other noise in the images, other networks and other thresholds; further
faults are planted into what these builds sent. Each resampling draws windows without replacement, and for each window
the noise of baseline and candidate. Windows with fewer than 90 crater tracks are left out.
"""

import argparse
import json
import pickle
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.regression.archives import check_archive
from ground_service.regression.gates.core import FEWEST_TRACKS, judge, verdict_of
from ground_service.regression.gates.policy import load_policy
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.replay_samples import PassContext, pass_context, read_downlink
from linna.data import data_folder
from lunar.datafolder import DataFolder
from payload_emulator.errors import ScenarioError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.calibration import CALIBRATION_KEY, network_sha256, with_metadata
from payload_emulator.session.archive.recording import load_record
from payload_emulator.session.archive.replay import FlightBuild, replay, stored_images
from payload_emulator.session.archive.suite import SUITE, suite_scenarios, write_suite
from payload_emulator.session.scenario import Scenario, parse_scenario
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.crc import append_crc

FRAMES = 49
SEEDS = 7
NOISES = 4
NOISE_DN = 1.0
FAULTY_EVERY = 5
PROCEDURAL = ("paper-light", "plains", "real-sun", "faults", "low")
BANDS_DEG = ((-60.0, -20.5), (-20.0, 19.5), (20.0, 59.5))
"""Latitudes of the windows over real terrain: 49 frames each."""

TIME_OCTETS = slice(14, 18)
"""Seconds of the on-board time in a packet: after primary header, seven octets and the P-field."""

LONGITUDES_DEG = (270.0, 285.0, 300.0, 315.0)
SPREAD = 0.003
"""Relative change of the weights of a network of similar quality."""

REAL = """
name = "real"
title = "Window over real terrain"
[window]
search = "terrain"
[terrain]
source = "raster"
[navigation]
initial_position_error_m = 1000.0
initial_velocity_error_m_s = 1.0
catalogue_error_fraction_of_diameter = 0.01
catalogue_height_error_m = 20.0
[reference]
radial_m = 10.0
transverse_m = 30.0
normal_m = 15.0
"""

Packets = list[bytes]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A recorded pass, and what each build sent: `frames` by build."""

    name: str
    context: PassContext
    packets: Mapping[str, Packets]
    frames: Mapping[str, PassFrames]


def scenarios(data: DataFolder) -> Iterator[Scenario]:
    """Yield the scenarios of the windows."""
    yield from suite_scenarios(
        [str(SUITE / f"{name}.toml") for name in PROCEDURAL], frames=FRAMES, seeds=SEEDS
    )
    for i, west in enumerate(LONGITUDES_DEG if data.root is not None else ()):
        for j, (low, high) in enumerate(BANDS_DEG):
            scenario = parse_scenario(REAL)
            window = replace(
                scenario.window,
                longitude_min_deg=west,
                longitude_max_deg=west + 15.0,
                latitude_min_deg=low,
                latitude_max_deg=high,
            )
            yield replace(scenario, name=f"real-{i}-{j}", seed=50 + 3 * i + j, window=window)


Images = Iterator[Any]


def noise(seed: int) -> Callable[[Images], Images]:
    """Return a function that adds noise to images; none for seed 0."""

    def noisy(images: Images) -> Images:
        rng = np.random.default_rng(seed)
        for image in images:
            changed = np.rint(image + NOISE_DN * rng.standard_normal(image.shape))
            yield np.clip(changed, 0, 255).astype(image.dtype) if seed else image

    return noisy


def frozen(images: Images) -> Images:
    """Repeat every image once, in place of the next."""
    kept = None
    for number, image in enumerate(images):
        kept = image if number % 2 == 0 or kept is None or image.size != kept.size else kept
        yield kept


Build = tuple[FlightBuild, Callable[[Images], Images]]
"""A build, and what it does to its images."""


def builds(faulty: bool) -> dict[str, Build]:
    """Return the builds that are replayed, with those whose faults were not looked at while the gates were designed."""
    current = FlightBuild()
    made = {f"noise {k}": (current, noise(k)) for k in range(NOISES)}
    made |= {f"similar {k}": (FlightBuild(model=network(k, SPREAD)), noise(0)) for k in (1, 2)}
    made |= {
        f"threshold {t}": (FlightBuild(parameters=f"detector.score_threshold = {t}"), noise(1))
        for t in (0.8, 0.3)
    }
    if faulty:
        made["other weights"] = (FlightBuild(model=network(3, 0.1)), noise(1))
        made["image offset"] = (current, lambda images: (np.roll(image, 3, axis=1) for image in images))
        made["exposure"] = (
            current,
            lambda images: (np.clip(3.0 * image, 0, 255).astype(np.uint8) for image in images),
        )
        made["frozen frame"] = (current, frozen)
    return made


@cache
def network(seed: int, spread: float) -> bytes:
    """Return the shipped network with every weight changed by this share, 1 sigma."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load_from_string(load_shipped_model())
    rng = np.random.default_rng(seed)
    for tensor in model.graph.initializer:
        weights = numpy_helper.to_array(tensor)
        if weights.dtype == np.float32 and weights.ndim == 4:
            drawn = weights * (1.0 + spread * rng.standard_normal(weights.shape))
            tensor.CopyFrom(numpy_helper.from_array(drawn.astype(np.float32), tensor.name))
    octets = bytes(model.SerializeToString())
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    # The calibration is kept: the scores of so similar a network mean the same.
    calibration = json.loads(metadata[CALIBRATION_KEY]) | {"network_sha256": network_sha256(octets)}
    return with_metadata(octets, metadata | {CALIBRATION_KEY: json.dumps(calibration)})


def replayed(archive: Path, build: FlightBuild, seen: Callable[[Images], Images]) -> Packets:
    """Return the packets of a build over a pass."""
    record = load_record(archive)
    return replay(record, seen(stored_images(archive, record)), build).packets


def record(folder: Path) -> list[Window]:
    """Record the passes and replay the builds, as far as that was not done before; return the windows."""
    data, windows = data_folder(), []
    for scenario in scenarios(data):
        try:
            write_suite([scenario], data, folder)
        except ScenarioError as error:
            print(f"{scenario.name}: not recorded: {error}")
            continue
        archive = check_archive(folder / scenario.name)
        context = pass_context(archive, data)
        sent: dict[str, Packets] = {}
        for name, (build, seen) in builds(len(windows) % FAULTY_EVERY == 0).items():
            kept = archive.folder.parent / f"{scenario.name}.{name.replace(' ', '-')}.packets"
            if not kept.exists():
                kept.write_bytes(pickle.dumps(replayed(archive.folder, build, seen)))
            sent[name] = pickle.loads(kept.read_bytes())
        read = {name: frames_of(context, packets) for name, packets in sent.items()}
        tracks = len(np.unique(read["noise 0"].craters.track))
        print(f"{scenario.name}: {tracks} tracks", flush=True)
        if tracks >= FEWEST_TRACKS:
            windows.append(Window(scenario.name, context, sent, read))
    return windows


def frames_of(context: PassContext, packets: Packets) -> PassFrames:
    """Return what the ground reads of the packets of a build."""
    octets = encode_cadus(packets, spacecraft_id=int(context.manifest["spacecraft_id"]))
    return read_downlink(context, octets, None, 250.0).frames


# Planted builds: what the ground would read of them.

Plant = Callable[[PassFrames, np.random.Generator], PassFrames]


def lost_tracks(loss: float) -> Plant:
    """Lose whole tracks, so that the recall falls by `loss`; a negative loss finds missed ones."""

    def plant(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
        rows = frames.craters
        chosen = rows.hit if loss > 0.0 else ~rows.hit
        share = abs(loss) * len(rows.hit) / max(int(np.count_nonzero(chosen)), 1)
        drawn = rng.random(int(rows.track.max(initial=-1)) + 1)[rows.track] < share
        centres = (np.where(drawn, np.nan if loss > 0.0 else 1.0, one) for one in (rows.du_px, rows.dv_px))
        return replace(frames, craters=replace(rows, du_px=next(centres), dv_px=next(centres)))

    return plant


def false_detections(loss: float) -> Plant:
    """Add features that are no craters, each detected in five frames, so that the precision falls by `loss`."""

    def plant(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
        rows = frames.detections
        true = int(np.count_nonzero(rows.true))
        added = round(true / (true / len(rows.true) - loss)) - len(rows.true)
        found = replace(
            rows,
            frame=np.concatenate((rows.frame, rng.integers(0, len(frames), added))),
            cell=np.concatenate((rows.cell, -2 - np.arange(added) // 5)),
            true=np.concatenate((rows.true, np.zeros(added, np.bool_))),
        )
        return replace(frames, detections=found)

    return plant


def noisy_centres(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
    """Add 1 px of noise to each coordinate of the centres."""
    rows = frames.craters
    u, v = rng.standard_normal((2, len(rows.track)))
    return replace(frames, craters=replace(rows, du_px=rows.du_px + u, dv_px=rows.dv_px + v))


def of_anchored(frames: PassFrames, **values: Any) -> PassFrames:
    """Return the frames with other values of the anchored estimator."""
    changed = replace(frames.estimators["anchored"], **values)
    return replace(frames, estimators={**frames.estimators, "anchored": changed})


def larger_errors(factor: float) -> Plant:
    """Scale the position errors."""
    return lambda frames, rng: of_anchored(frames, error_m=factor * frames.estimators["anchored"].error_m)


def one_wrong_fix(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
    """Claim a fix that is far off in one frame."""
    wrong, error = (getattr(frames.estimators["anchored"], name).copy() for name in ("wrong", "error_m"))
    row = int(rng.integers(len(wrong)))
    wrong[row], error[row] = 1.0, 20e3
    return of_anchored(frames, wrong=wrong, error_m=error)


def silent_frames(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
    """Send no navigation state in a fifth of the frames."""
    return of_anchored(frames, stated=frames.estimators["anchored"].stated & (rng.random(len(frames)) > 0.2))


Change = Callable[[Packets], Packets]


def with_values(name: str, packet: bytes, **changed: Any) -> bytes:
    """Return the packet with other values."""
    decoded = DICTIONARY.unpack_packet(packet)
    values = {key: value for key, value in decoded.values.items() if key != "count"} | changed
    count = int.from_bytes(packet[2:4], "big") & 0x3FFF
    return DICTIONARY.pack(name, values, ticks=decoded.ticks, sequence_count=count)


def late_headers(number: int, name: str, packet: bytes) -> bytes:
    """Set the on-board time of three packets of four 7 s late."""
    if number % 4 == 0:
        return packet
    seconds = int.from_bytes(packet[TIME_OCTETS], "big") + 7
    return append_crc(
        packet[: TIME_OCTETS.start] + seconds.to_bytes(4, "big") + packet[TIME_OCTETS.stop : -2]
    )


def late_states(number: int, name: str, packet: bytes) -> bytes:
    """Let navigation states after the 100th packet name an image 7 s late."""
    if name != "navigation_state" or number < 100:
        return packet
    ticks = DICTIONARY.unpack_packet(packet).values["image_ticks"]
    return with_values(name, packet, image_ticks=ticks + 7 * 65536)


def longer_packet(number: int, name: str, packet: bytes) -> bytes:
    """Append an octet to one packet, with a right checksum."""
    if number != 40:
        return packet
    body = packet[:-2] + b"\0"
    return append_crc(body[:4] + (len(body) + 2 - 7).to_bytes(2, "big") + body[6:])


def each(change: Callable[[int, str, bytes], bytes]) -> Change:
    """Return a change of every packet: by its number, name and octets."""
    return lambda packets: [change(i, DICTIONARY.unpack(one)[0], one) for i, one in enumerate(packets)]


def next_frame_tag(number: int, name: str, packet: bytes) -> bytes:
    """Let every packet that names an image name the next one."""
    ticks = DICTIONARY.unpack_packet(packet).values.get("image_ticks")
    return packet if ticks is None else with_values(name, packet, image_ticks=ticks + 15 * 65536)


def without_class(number: int, name: str, packet: bytes) -> bytes:
    """Drop the detections of 10 to 15 km."""
    if name != "detections":
        return packet
    items = DICTIONARY.unpack_packet(packet).values["items"]
    kept = np.asarray(items["size_class"]) != 1
    return with_values(name, packet, items={key: np.asarray(column)[kept] for key, column in items.items()})


def states_of_the_frame_before(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
    """Report the position of the frame before: an error of the 24 km between two frames."""
    return of_anchored(frames, error_m=frames.estimators["anchored"].error_m + 24e3)


def shifted_registration(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
    """Anchor to a table that lies 200 m from the catalogue of the ground."""
    return of_anchored(frames, error_m=np.hypot(frames.estimators["anchored"].error_m, 200.0))


def leaking(frames: PassFrames, rng: np.random.Generator) -> PassFrames:
    """Keep 2 MiB of each frame."""
    return replace(frames, memory_mib=frames.memory_mib + 2.0 * len(frames))


@dataclass(frozen=True, slots=True)
class Case:
    """A row of the table.

    Attributes
    ----------
    sizes
        Numbers of windows.
    candidate
        A build by the beginning of its name, a change of frames, or a change of packets.
    """

    what: str
    sizes: tuple[int, ...]
    candidate: str = "noise"
    plant: Plant | None = None
    change: Change | None = None


CASES = (
    Case("equal build, other noise", (1, 5, 20)),
    Case("similar network", (5, 20), "similar"),
    Case("threshold 0.8", (1, 5), "threshold 0.8"),
    Case("threshold 0.3", (1, 5), "threshold 0.3"),
    Case("recall -0.15", (1,), plant=lost_tracks(0.15)),
    Case("centre noise +1 px", (1,), plant=noisy_centres),
    Case("recall -0.05", (5,), plant=lost_tracks(0.05)),
    Case("precision -0.06", (5,), plant=false_detections(0.06)),
    Case("recall -0.02", (20,), plant=lost_tracks(0.02)),
    Case("anchored error x 2", (5, 20), plant=larger_errors(2.0)),
    Case("anchored error +25 %", (5, 20), plant=larger_errors(1.25)),
    Case("one frame in 50 a wrong fix", (5,), plant=one_wrong_fix),
    Case("no navigation in 20 % of frames", (5,), plant=silent_frames),
    Case("header times 7 s late", (1,), change=each(late_headers)),
    Case("states 7 s late after packet 100", (1,), change=each(late_states)),
    Case("one undecodable packet", (1,), change=each(longer_packet)),
    Case("recall +0.03", (5,), plant=lost_tracks(-0.03)),
    *(Case(name, (5,), name) for name in ("other weights", "image offset", "exposure", "frozen frame")),
    Case("dropped class", (5,), change=each(without_class)),
    Case("wrong registration, 200 m", (5,), plant=shifted_registration),
    Case("memory leak, 2 MiB a frame", (5,), plant=leaking),
    Case("reordered packets", (5,), change=lambda sent: [*sent[20:40], *sent[:20], *sent[40:]]),
    Case("time tag of the next frame", (5,), change=each(next_frame_tag)),
    Case("state of the frame before", (5,), plant=states_of_the_frame_before),
)


def measured(
    windows: Sequence[Window], case: Case, size: int, resamplings: int
) -> tuple[Counter[str], dict[str, Counter[str]], int]:
    """Return the verdicts and the outcomes of each gate over resamplings of so many windows, and their number."""
    rng, policy = np.random.default_rng(size), load_policy().policy
    verdicts: Counter[str] = Counter()
    gates: dict[str, Counter[str]] = {}
    changed: dict[tuple[str, str], PassFrames] = {}
    windows = [one for one in windows if any(name.startswith(case.candidate) for name in one.frames)]
    for _ in range(resamplings):
        before, after = {}, {}
        for i in rng.choice(len(windows), min(size, len(windows)), replace=False).tolist():
            window = windows[i]
            names = [name for name in window.frames if name.startswith(case.candidate)]
            first, second = (f"noise {k}" for k in rng.choice(NOISES, 2, replace=False))
            if case.candidate != "noise":
                second = names[int(rng.integers(len(names)))]
            before[window.name] = window.frames[first]
            after[window.name] = window.frames[second]
            if case.plant is not None:
                after[window.name] = case.plant(after[window.name], rng)
            if case.change is not None:
                # The same build with the fault alone: what differs is the fault.
                key = (window.name, first)
                if key not in changed:
                    changed[key] = frames_of(window.context, case.change(window.packets[first]))
                after[window.name] = changed[key]
        found = judge(before, after, policy)
        verdicts[verdict_of(found)] += 1
        for gate in found:
            name = f"{gate.name} (part)" if gate.pass_name else gate.name
            gates.setdefault(name, Counter())[gate.outcome] += 1
    return verdicts, gates, len(windows)


def share(count: int, total: int) -> tuple[float, float, float]:
    """Return the share and its 95 % interval (Clopper and Pearson 1934)."""
    from scipy.stats import binomtest

    bounds = binomtest(count, total).proportion_ci()
    return count / total, bounds.low, bounds.high


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--passes", type=Path, default="gate-passes", help="folder of the recorded passes")
    parser.add_argument("--resamplings", type=int, default=400)
    given = parser.parse_args(arguments)
    windows = record(given.passes)
    for case in CASES:
        for size in case.sizes:
            verdicts, gates, of = measured(windows, case, size, given.resamplings)
            shares = [
                "{} {:.3f} ({:.3f} to {:.3f})".format(name, *share(verdicts[name], given.resamplings))
                for name in ("fail", "pass", "inconclusive")
            ]
            print(f"{case.what}, {size} of {of} windows: {', '.join(shares)}", flush=True)
            print("   ", {name: dict(n) for name, n in gates.items() if set(n) - {"pass", "informs"}})


if __name__ == "__main__":
    main()
