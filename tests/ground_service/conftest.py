"""A synthetic pass made of packets, an ephemeris and a catalogue: what any emulator or spacecraft would hand over.

The orbit is an exact circle, the craters are placed by chance, the detections are their exact projections with known
noise and known faults, and the navigation states carry errors put in on purpose, so every figure is known beforehand.
"""

import functools
import hashlib
import itertools
import json
import os
import re
import shutil
import socket
import subprocess
import tempfile
import threading
from collections import defaultdict
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from fastapi import routing
from httpx._transports import default as httpx_transports
from pytest import MonkeyPatch, fixture, skip
from sqlalchemy import create_engine, text
from sqlalchemy.util import LRUCache

from ground_service.access.service import add_user
from ground_service.app import DescribedApi, create_app
from ground_service.clock import set_mission_clock, utc_now_ns
from ground_service.ground import open_ground
from ground_service.missions.ephemerides.service import add_ephemeris
from ground_service.passes.service import define_pass
from ground_service.settings import Settings
from ground_service.store import database as databases
from ground_service.store.database import open_database, prepare_database, schema_revisions
from ground_service.worker.follow_up import follow_in_process
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import make_catalogue, save_catalogue, size_class
from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.ephemeris import ephemeris_from_states
from lunar.frames import IauOrientation, rtn_from_inertial, spherical_from_mcmf
from lunar.messages.oem import save_oem
from lunar.timescales import format_utc, parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from reports import drawings
from reports.drawings import Drawings
from tests.serving import TestClient, wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus
from tmtc.packets.space_packets import PacketSequencer

NS = 1_000_000_000
START = parse_utc("2029-08-07T06:00:00Z")
CADENCE_S = 15
SPACECRAFT = 76
ALTITUDE_M = 30_000.0
RESET_FRAME = 20
PAPER_DRIFT_PER_FRAME_M = 400.0
SPHERICAL_ERROR_RTN_M = np.array([30.0, -40.0, 120.0])  # 130 m in 3-D
FILTER_ERROR_RTN_M = np.array([10.0, 20.0, -20.0])  # 30 m in 3-D
PIXEL_OFFSET = (0.5, -1.25)
MANIFEST = """{"schema_version": 1, "pass_name": "synthetic pass", "scenario": "synthetic", "light": "paper",
    "data_sources": ["circular orbit", "synthetic craters", "orientation IAU WGCCRE 2009"],
    "camera": {"width_px": 512, "height_px": 512, "fov_deg": 120.0}, "estimators": ["paper", "spherical"],
    "gravity": {"truth": "GRGM1200L (12x12, built in)", "degree": 12}}"""


def cells(table):
    """Return the cells of a table: each line is a row, and bars separate its cells."""
    return [[cell.strip() for cell in row.split("|")] for row in table.strip().splitlines()]


@fixture(scope="session", autouse=True)
def name_of_the_test_client():
    """Allow the host name that the test client of the web framework gives itself."""
    with MonkeyPatch.context() as environment:
        environment.setenv("LINNA_ALLOWED_HOSTS", "testserver")
        yield


@fixture(scope="session", autouse=True)
def one_tls_context():
    """Read the trusted certificates once: each HTTP client would read them."""
    with MonkeyPatch.context() as patch:
        made = functools.cache(httpx_transports.create_ssl_context)
        patch.setattr(httpx_transports, "create_ssl_context", made)
        yield


@fixture(scope="session", autouse=True)
def one_description():
    """Make the OpenAPI document, which is the same for every application, once: it takes two seconds."""
    describe, made = DescribedApi.openapi, []

    def openapi(app):
        made[:] = made or [describe(app)]
        return made[0]

    with MonkeyPatch.context() as patch:
        patch.setattr(DescribedApi, "openapi", openapi)
        yield


@fixture(scope="session", autouse=True)
def one_set_of_routes():
    """Resolve the routes, which are the same for every application, once: the first request would do it in 0.2 s."""
    resolve, made = routing._EffectiveRouteContext.from_api_route, {}

    def from_api_route(*, original_route, include_context):
        key = (id(original_route), include_context.path_for(original_route))
        if key not in made:
            made[key] = resolve(original_route=original_route, include_context=include_context)
        return made[key]

    with MonkeyPatch.context() as patch:
        patch.setattr(routing._EffectiveRouteContext, "from_api_route", from_api_route)
        yield


class Statements(LRUCache):
    """Compiled statements by all of their key but its first part, the dialect, of which each engine has its own."""

    def get(self, key, default=None):
        return super().get(key[1:], default)

    def __setitem__(self, key, value):
        super().__setitem__(key[1:], value)


@fixture(scope="session", autouse=True)
def one_set_of_statements():
    """Compile a statement once for all databases of a kind: it is half of the time of an import into a new one."""
    create, kept = databases.create_engine, defaultdict(lambda: Statements(4000))

    def create_engine(*given, **options):
        engine = create(*given, **options)
        engine._compiled_cache = kept[engine.dialect.name]
        return engine

    with MonkeyPatch.context() as patch:
        patch.setattr(databases, "create_engine", create_engine)
        yield


@fixture(scope="session", autouse=True)
def undrawn_figures():
    """Leave figures of reports blank in this folder: they take most of the time of a report; what draws is yielded."""
    draw = Drawings.svg

    def svg(*given):
        is_here = os.environ.get("PYTEST_CURRENT_TEST", "").startswith("tests/ground_service/")
        return '<svg viewBox="0 0 1 1"></svg>' if is_here else draw(*given)

    with MonkeyPatch.context() as patch:
        patch.setattr(Drawings, "svg", svg)
        patch.setattr(drawings, "drawing_processes", lambda _wanted: nullcontext())
        yield draw


@fixture
def client(tmp_path):
    """An empty service without users that does its jobs in the requests."""
    with TestClient(create_app(Settings(home=tmp_path / "home"), inline_jobs=True)) as opened:
        yield opened


@fixture
def guarded(tmp_path):
    """An empty service with one user of each role, and the headers of each."""
    with TestClient(create_app(Settings(home=tmp_path / "guarded"), inline_jobs=True)) as opened:
        ground = opened.app.state.ground
        tokens = {role: add_user(ground, role, role) for role in ("viewer", "operator", "admin")}
        yield opened, {role: {"Authorization": f"Bearer {token}"} for role, token in tokens.items()}


@fixture(scope="session", autouse=True)
def copied_schema(tmp_path_factory):
    """Copy the tables of new SQLite databases from one that was migrated; the migration itself is yielded."""
    migrate, lock = databases.upgrade_database, threading.Lock()
    made = open_database(f"sqlite:///{tmp_path_factory.mktemp('schema') / 'linna.db'}")
    migrate(made)
    whole = schema_revisions(made)

    def upgrade(database, revision="head"):
        with lock:
            is_new = database.dialect == "sqlite" and schema_revisions(database) == (None, *whole[1:])
            if revision != "head" or not is_new:
                return migrate(database, revision)
            with made.engine.connect() as source, database.engine.connect() as target:
                source.connection.driver_connection.backup(target.connection.driver_connection)

    with MonkeyPatch.context() as patch:
        patch.setattr(databases, "upgrade_database", upgrade)
        yield migrate
    made.engine.dispose()


@dataclass(frozen=True)
class SyntheticPass:
    """A pass archive folder and what was put into it."""

    folder: Path
    packets: list[bytes]
    utc_ns: np.ndarray
    expected: int
    missed: int


class Downlink:
    """Packets of a payload with the sequence counts of their APIDs."""

    def __init__(self):
        self.sequencer, self.packets = PacketSequencer(), []

    def send(self, name, values, ticks):
        count = self.sequencer.next(DICTIONARY.packet(name).apid)
        self.packets.append(DICTIONARY.pack(name, values, ticks=ticks, sequence_count=count))


def encode_downlink(packets):
    """CADUs of the synthetic spacecraft."""
    return encode_cadus(packets, spacecraft_id=SPACECRAFT)


def circular_states(utc_ns):
    """ICRF states (n, 3) of a circular orbit, inclined by 80 degrees to the ICRF equator."""
    radius = MOON_RADIUS_M + ALTITUDE_M
    rate = np.sqrt(GM_MOON_M3_S2 / radius**3)
    angle = rate * (np.asarray(utc_ns) - START) / NS - 0.3
    tilt = np.radians(80.0)
    across = np.array([0.0, np.cos(tilt), np.sin(tilt)])
    along = np.array([1.0, 0.0, 0.0])
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return radius * (c * along + s * across), radius * rate * (c * across - s * along)


def save_circle(path, start_utc_ns=START, hours=4.0):
    """Write an ephemeris of the circular orbit."""
    utc_ns = start_utc_ns + np.arange(0, round(hours * 3600), 60, dtype=np.int64) * NS
    save_oem(ephemeris_from_states(utc_ns, *circular_states(utc_ns)), path)
    return path


def _catalogue(latitude_rad, longitude_rad, rng):
    """Craters on a jittered grid of half a degree around the track, so that no two are near one another."""
    cells = np.unique(np.round(np.degrees(np.column_stack([latitude_rad, longitude_rad])) / 0.5).astype(int), axis=0)
    grid = np.unique(
        (cells[:, None, :] + np.array([[i, j] for i in range(-3, 4) for j in range(-3, 4)])).reshape(-1, 2), axis=0
    )
    places = np.radians(grid * 0.5 + rng.uniform(-0.08, 0.08, grid.shape))
    diameter = rng.choice([6e3, 8e3, 11e3, 14e3, 4e3], len(grid))
    return make_catalogue(
        places[:, 0], places[:, 1], diameter, source="synthetic", rim_height_m=rng.uniform(-500.0, 500.0, len(grid))
    )


@fixture(scope="session")
def make_pass(tmp_path_factory):
    """A function that writes a synthetic pass archive of `frames` frames."""

    def make(
        frames=40, seed=1, encode=encode_downlink, camera=PinholeCamera(), tilt_rad=0.0, filter_nis=None, mission=""
    ):
        folder = tmp_path_factory.mktemp("archive")
        rng = np.random.default_rng(seed)
        utc_ns = START + np.arange(frames, dtype=np.int64) * CADENCE_S * NS
        every = START + np.arange(-40, frames + 40, dtype=np.int64) * CADENCE_S * NS
        position, velocity = circular_states(utc_ns)
        save_oem(ephemeris_from_states(every, *circular_states(every)), folder / "reference.oem")
        rotation = IauOrientation().mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(utc_ns)))
        position_mcmf = np.einsum("nij,nj->ni", rotation, position)
        latitude, longitude, _ = spherical_from_mcmf(position_mcmf)
        catalogue = _catalogue(latitude, longitude, rng)
        save_catalogue(catalogue, folder / "catalogue.csv")

        classes = size_class(catalogue.diameter_m)
        sent, tally = Downlink(), {"expected": 0, "missed": 0}

        for k in range(frames):
            ticks = int(ticks_from_utc_ns(int(utc_ns[k])))
            # Leaning from nadir toward image up turns the camera about its x axis.
            c, s = np.cos(tilt_rad), np.sin(tilt_rad)
            lean = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
            pointing = lean @ nadir_camera_from_mcmf(position_mcmf[k])
            in_camera = (catalogue.position_mcmf_m - position_mcmf[k]) @ pointing.T
            uv = camera.project(in_camera)
            crater = catalogue.position_mcmf_m
            above = np.einsum("ni,ni->n", position_mcmf[k] - crater, crater) > 0.0  # its own horizon
            inside = np.flatnonzero(camera.contains(uv) & (in_camera[:, 2] > 0) & above)
            scored = inside[classes[inside] != 3]
            missed = scored[::4]
            seen = np.setdiff1d(inside, missed)
            tally["expected"] += len(scored)
            tally["missed"] += len(missed)
            seen = seen[camera.contains(uv[seen] + PIXEL_OFFSET, 2.0)]
            tally["missed"] += len(scored) - len(missed) - np.count_nonzero(classes[seen] != 3)
            items = {
                "u_px": np.append(uv[seen, 0] + PIXEL_OFFSET[0], 3.0),
                "v_px": np.append(uv[seen, 1] + PIXEL_OFFSET[1], 3.0),
                "diameter_px": np.append(camera.focal_px * catalogue.diameter_m[seen] / in_camera[seen, 2], 200.0),
                "score": np.append(np.full(len(seen), 0.9), 0.4),
                "size_class": np.append(classes[seen], 2),
                "sigma_px": np.full(len(seen) + 1, 1.0),
            }
            frame = {"frame_number": k, "image_ticks": ticks}
            sent.send("detections", {**frame, "image_quality": 0, "items": items}, ticks + 100)
            since = k - (RESET_FRAME if k >= RESET_FRAME else 0)
            flown = [(0, np.array([0.0, PAPER_DRIFT_PER_FRAME_M * since, 0.0])), (1, SPHERICAL_ERROR_RTN_M)]
            if filter_nis is not None:
                flown.append((2, FILTER_ERROR_RTN_M))
            for estimator, error in flown:
                filtered = estimator == 2
                rtn = rtn_from_inertial(position[k], velocity[k])
                place = spherical_from_mcmf(rotation[k] @ (position[k] + rtn.T @ error))
                solution = {**frame, "estimator": estimator, "outcome": "fixed" if filtered else "multi"}
                state = {
                    "latitude_deg": float(np.degrees(place[0])), "longitude_deg": float(np.degrees(place[1])),
                    "altitude_m": float(place[2]), "velocity_icrf_m_s": [np.nan] * 3,
                    "sigma_rtn_m": [1.0 if filtered else np.nan] * 3, "nis": filter_nis if filtered else np.nan,
                    "matched": 5,
                }  # fmt: skip
                sent.send("navigation_state", solution | state, ticks + 200 + estimator)
                resets = {0: "initialization", RESET_FRAME: "safety_timeout"} if estimator == 0 else {}
                outcome = {
                    "reset_trigger": resets.get(k, "none"), "detections": len(seen) + 1, "candidate_pairs": 9,
                    "pairs": 5, "shift_east_m": 0.0, "shift_north_m": 24_500.0,
                    "anchor_reads": (1 + (k >= RESET_FRAME)) if estimator == 0 else int(not filtered),
                }  # fmt: skip
                sent.send("frame_outcome", solution | outcome, ticks + 300 + estimator)
            sent.send("housekeeping", _housekeeping(k), ticks + 400)
        values = {"event_id": "observation_stopped", "frame_number": frames, "value_1": 0.0, "value_2": 0.0}
        sent.send("event_info", values, ticks + 500)

        (folder / "downlink.cadu").write_bytes(encode(sent.packets))
        start = {
            "utc": format_utc(int(utc_ns[0])),
            "position_icrf_m": list(position[0]),
            "velocity_icrf_m_s": list(velocity[0]),
        }
        if mission:
            (folder / "mission.toml").write_text(mission)
        build = {"name": "nothing", "version": "0", "model_sha256": "00" * 32, "parameters_sha256": "11" * 32}
        given = {
            "spacecraft_id": SPACECRAFT, "seed": seed, "build": build, "start_utc": start["utc"],
            "stop_utc": format_utc(int(utc_ns[-1])), "cadence_s": CADENCE_S, "frames_expected": frames,
            "start_state": start,
        }  # fmt: skip
        write_manifest(folder, json.loads(MANIFEST) | given)
        return SyntheticPass(folder, sent.packets, utc_ns, tally["expected"], tally["missed"])

    return make


def write_manifest(folder, manifest):
    """Write manifest.json over the files that lie in `folder`."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != "manifest.json":
            octets = path.read_bytes()
            entry = {"sha256": hashlib.sha256(octets).hexdigest(), "bytes": len(octets)}
            files[str(path.relative_to(folder))] = entry
    (folder / "manifest.json").write_text(json.dumps({**manifest, "files": files}))


def enter_files(folder, **changed):
    """Enter the files of a pass archive in its manifest again, and change other keys of it."""
    write_manifest(folder, json.loads((folder / "manifest.json").read_text()) | changed)


def add_reference(ground, path):
    """Add a reference ephemeris."""
    return add_ephemeris(ground, ground.files.put_file(path), name="reference").id


def event_packet(ticks, count, event="mode_changed", frame=0):
    """Return the packet of an event report without values."""
    values = {"event_id": event, "frame_number": frame, "value_1": 0.0, "value_2": 0.0}
    return DICTIONARY.pack("event_info", values, ticks=ticks, sequence_count=count)


def define_pass_of(ground, made):
    """Define a pass of the spacecraft from a second before the first frame to a second after the last one."""
    start, stop = int(made.utc_ns[0]) - NS, int(made.utc_ns[-1]) + NS
    return define_pass(ground, name="p", start_utc_ns=start, stop_utc_ns=stop, spacecraft_id=SPACECRAFT)


def _housekeeping(k):
    values = {field.name: 0 for field in DICTIONARY.packet("housekeeping").fields}
    known = json.loads('{"structure_id": 1, "boot_count": 1, "mode": "observing", "bus_voltage_v": 12.0}')
    return values | known | {"frames_processed": k, "temperature_c": 20.0 + 0.1 * k}


@fixture(scope="session")
def synthetic_pass(make_pass):
    """The pass that most tests look at; not to be altered."""
    return make_pass()


@fixture(params=["sqlite", "postgresql"])
def either(request, tmp_path):
    """An empty service on each database."""
    url = request.getfixturevalue("migrated_postgres")() if request.param == "postgresql" else None
    with open_ground(tmp_path / "home", database_url=url) as ground:
        follow_in_process(ground)
        yield ground


@fixture
def ground(tmp_path):
    """An empty ground service with a SQLite database of its own."""
    opened = open_ground(tmp_path / "home")
    follow_in_process(opened)
    yield opened
    opened.close()


@dataclass(frozen=True)
class FlyablePass:
    """A pass archive that can be flown again, and the packets that it came down with."""

    folder: Path
    packets: list[bytes]


@fixture(scope="session")
def make_flyable(make_pass):
    """A function that writes a synthetic pass archive with what its payload was given: plain gray images."""
    import io

    from PIL import Image

    from tmtc.dictionary.definitions import format_dictionary

    def make(frames=12, seed=1, **options):
        made = make_pass(frames=frames, seed=seed, **options)
        folder = made.folder
        (folder / "payload").mkdir()
        (folder / "frames").mkdir()
        buffer = io.BytesIO()
        Image.fromarray(np.full((512, 512), 90, np.uint8)).save(buffer, "PNG")
        rows = []
        for k in range(frames):
            (folder / f"frames/{k:06d}.png").write_bytes(buffer.getvalue())
            ticks = int(ticks_from_utc_ns(int(made.utc_ns[k])))
            rows.append({"frame": k, "ticks": ticks, "image": f"frames/{k:06d}.png", "shape": [512, 512]})
        (folder / "payload/inputs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        (folder / "payload/parameters.toml").write_text("")
        (folder / "payload/dictionary.json").write_text(format_dictionary(DICTIONARY))
        enter_files(folder, pass_name=f"synthetic pass {seed}")
        return FlyablePass(folder, made.packets)

    return make


PROGRAM = """
import json, pathlib, sys, time
archive, out, build = (pathlib.Path(word) for word in sys.argv[1:4])
name = json.loads((archive / "manifest.json").read_text())["pass_name"].replace(" ", "-")
(out / "downlink.packets").write_bytes((build / f"{name}.packets").read_bytes())
frames = sum(1 for _ in (archive / "payload/inputs.jsonl").open())
costs = json.loads((build / "costs.json").read_text())
(out / "performance.json").write_text(json.dumps(
    {"stages": {stage: [ms] * frames for stage, ms in costs.items()}}))
"""


@fixture(scope="session")
def make_build(tmp_path_factory):
    """A function that writes a build: a program that sends packets prepared for each pass, or any other script."""

    def make(name, packets=None, *, program=PROGRAM, network_ms=10.0, extra=""):
        folder = tmp_path_factory.mktemp("builds") / f"build-{name}"
        folder.mkdir()
        files = {"fly.py": program, "costs.json": json.dumps({"network": network_ms})}
        for file, content in files.items():
            (folder / file).write_text(content)
        for pass_name, octets in (packets or {}).items():
            (folder / f"{pass_name.replace(' ', '-')}.packets").write_bytes(b"".join(octets))
        names = sorted(path.name for path in folder.iterdir())
        (folder / "build.toml").write_text(
            f'schema_version = 1\nname = "{name}"\nfiles = {json.dumps(names)}\n'
            'command = ["{python}", "-I", "-S", "{build}/fly.py", "{archive}", "{out}", "{build}"]\n' + extra
        )
        return folder / "build.toml"

    return make


def free_port():
    """A port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@fixture(scope="module")
def redis_url():
    """A Redis server of the tests' own, its user as restricted as in the distributed form."""
    program = shutil.which("redis-server")
    if program is None:
        skip("redis-server is not installed")
    port = free_port()
    script = (Path(__file__).resolve().parents[2] / "deploy/redis.sh").read_text()
    (rights,) = re.findall(r"^rights='(.*)'$", script, re.MULTILINE)
    with tempfile.TemporaryDirectory() as folder:
        users = Path(folder) / "users.acl"
        users.write_text(f"user default off\nuser linna on >tests ~* &* {rights}\n")
        words = f"--aclfile {users} --port {port} --bind 127.0.0.1 --dir {folder} --appendonly no".split()
        server = subprocess.Popen([program, *words, "--save", ""], stdout=subprocess.DEVNULL)

        def answers():
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", port)) == 0

        try:
            wait_for(answers, "redis-server")
            yield f"redis://linna:tests@127.0.0.1:{port}/0"
        finally:
            server.terminate()
            server.wait()


@fixture(scope="session")
def postgres_server():
    """URL of a PostgreSQL server of the tests' own, without the name of a database."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
    if not found:
        skip("PostgreSQL is not installed")
    as_user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
    port = free_port()
    folder = Path(tempfile.mkdtemp(prefix="linna-postgres-"))
    if as_user:
        shutil.chown(folder, "postgres", "postgres")
    data = folder / "data"

    def run(command, *arguments, check=True):
        program, *words = command.split()
        whole = [*as_user, str(found[-1].with_name(program)), *words, *arguments]
        subprocess.run(whole, check=check, cwd=folder, stdout=subprocess.DEVNULL)

    try:
        run(f"initdb -D {data} -U linna -A trust -E UTF8 --no-sync")
        options = f"-p {port} -k {folder} -h 127.0.0.1 -c fsync=off -c synchronous_commit=off"
        run(f"pg_ctl -D {data} -w -l {folder}/log start -o", options)
        yield f"postgresql+psycopg://linna@127.0.0.1:{port}"
    finally:
        run(f"pg_ctl -D {data} -m immediate -w stop", check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _create_database(server, name, template="template1"):
    engine = create_engine(f"{server}/postgres", isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE {template}"))
    engine.dispose()
    return f"{server}/{name}"


@fixture(scope="session")
def new_postgres_database(postgres_server):
    """A function that makes an empty database on the PostgreSQL server and returns its URL."""
    numbers = itertools.count(1)
    return lambda: _create_database(postgres_server, f"empty_{next(numbers)}")


@fixture(scope="session")
def migrated_postgres(postgres_server):
    """A function that makes a database with the newest schema, a copy of one that was migrated; it returns the URL."""
    numbers = itertools.count(1)
    prepare_database(_create_database(postgres_server, "migrated"), upgrade=True).engine.dispose()
    return lambda: _create_database(postgres_server, f"linna_{next(numbers)}", "migrated")


@fixture(scope="module")
def postgres_url(new_postgres_database):
    """URL of an empty PostgreSQL database that the tests of one module share."""
    return new_postgres_database()


@dataclass
class Clock:
    """Mission time in nanoseconds since 1970, which passes only when a test says so."""

    utc_ns: int = field(default_factory=utc_now_ns)

    def advance(self, seconds):
        self.utc_ns += round(seconds * 1e9)


@fixture
def mission_time():
    made = Clock()
    set_mission_clock(lambda: made.utc_ns)
    return made


@fixture
def now(mission_time):
    """Mission time at the start of the synthetic passes."""
    mission_time.utc_ns = START
    return mission_time


@fixture(autouse=True)
def wall_clock_again():
    """Let mission time be the wall clock after a test."""
    yield
    set_mission_clock()


def steps_of(connection, work):
    """Return the result of reading on a SQLite connection, and how much work the database did, in ten operations."""
    database, done = connection.connection.driver_connection, []
    database.set_progress_handler(lambda: done.append(1), 10)
    found = work(connection)
    database.set_progress_handler(None, 0)
    return found, len(done)
