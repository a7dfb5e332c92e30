"""Valid files of every reader with one field changed: unit, zero, scale, order, sign, frame, time scale or identity.

Such a file is refused, gives the same figures, or the words that the product prints with the figures name the field:
other figures in silence are a fault. The changes are in `references/changed_inputs.csv`: texts by a regular expression,
values in JSON by their place, all others by an expression of numpy. `python -m tests.test_changed_inputs` prints the
table of all of them.
"""

import contextlib
import csv
import importlib
import io
import math
import os
import re
import struct
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from json import dumps, loads
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from pytest import mark, skip

from ground_service.errors import GroundError
from ground_service.missions.ephemerides.service import check_attitudes, load_attitudes
from ground_service.missions.model import parse_mission
from ground_service.missions.timekeeping.recorrelation import read_receptions
from linna.cli import run as linna
from linna.data import load_orbit
from lunar.catalogue import catalogue_words, load_catalogue, make_catalogue
from lunar.comparison import check_pointing
from lunar.constants import NS
from lunar.ephemeris import Ephemeris, clipped, ephemeris_from_states
from lunar.errors import LunarError
from lunar.frames import icrf_from_j2000, load_orientation, matrix_from_quaternion, quaternion_from_matrix
from lunar.gravity import acceleration, builtin_gravity, load_gravity
from lunar.messages.aem import AttitudeSegment, format_aem
from lunar.messages.oem import format_oem
from lunar.messages.oem_xml import format_oem_xml
from lunar.messages.spice import spk_kernel
from lunar.messages.stk import format_stk
from lunar.timescales import format_utc, from_tai_ns, ticks_from_utc_ns, utc_ns_from_ticks
from payload_emulator.errors import PayloadError
from payload_emulator.flight.vision.preprocess import prepare_image, quality_reason
from payload_emulator.session.scenario import Scenario, load_scenario
from payload_emulator.session.world.external import load_external, read_picture
from payload_emulator.sim.terrain.curation import RasterHeights
from payload_emulator.sim.terrain.raster import RasterTerrain
from payload_emulator.sim.terrain.registration import Registration, format_registration, parse_registration
from payload_emulator.training.data.pictures import load_pictures, set_words
from tests.lunar.orbits import RADIUS_M, START, circle, times
from tests.payload_emulator.sim.test_terrain_formats import ground, write_form, write_tiff
from tests.tmtc import foreign as x_tce
from tests.tmtc.test_downlink import make_packets
from tmtc.downlink import decode, encode_cadus
from tmtc.errors import TmtcError

TABLE_NAMES = (RADIUS_M, icrf_from_j2000)
"""Inputs that only the table of changes uses."""

REFUSALS = (LunarError, GroundError, PayloadError, TmtcError)
REFERENCES = Path(__file__).with_name("references")
Figures = Callable[[Path], tuple[Any, str]]


class Reader(NamedTuple):
    """Valid file in a folder, its figures with their words, other names of its changes, and a tolerance."""

    write: Callable[[Path], Path]
    figures: Figures
    changes: tuple[str, ...] = ()
    tolerance: float = 1e-9


def text(name, content):
    def write(folder):
        found = content()
        path = folder / name
        path.write_bytes(found if isinstance(found, bytes) else found.encode())
        return path

    return write


# Orbits and attitudes: a circular orbit, and a camera that looks down.

ELAPSED_S = np.arange(0.0, 5401.0, 60.0)
ASKED = times([65.0, 605.0, 2675.0, 5000.0, 5300.0])


def orbit(change="x"):
    """Return the orbit with a changed state `x` (n, 6) in m and m/s at times `t`."""
    states = np.hstack(circle(ELAPSED_S, node=(0.8, 0.6, 0.0), north=(-0.36, 0.48, 0.8)))
    x = np.ascontiguousarray(value(change, x=states, t=ELAPSED_S))
    return ephemeris_from_states(times(ELAPSED_S), x[:, :3], x[:, 3:])


def turning(t, x):
    """Return states in axes that turn with the Moon."""
    angle, zero = 2.6617e-6 * (t + 3e5), np.zeros_like(t)
    rows = [[np.cos(angle), np.sin(angle), zero], [-np.sin(angle), np.cos(angle), zero], [zero, zero, zero + 1.0]]
    turned = np.einsum("ijn,nkj->nki", rows, x.reshape(-1, 2, 3)).reshape(-1, 6)
    turned[:, 3:5] += 2.6617e-6 * np.column_stack([turned[:, 1], -turned[:, 0]])
    return turned


def one(x, row, first, stop, factor):
    x = x.copy()
    x[row, first:stop] *= factor
    return x


def two_objects():
    middle, stop = map(int, times([2700.0, 5400.0]))
    halves = [clipped(orbit(), a, b).segments for a, b in ((START, middle), (middle, stop))]
    first, _, second = format_oem(Ephemeris(halves[0] + halves[1])).rpartition("META_START")
    return f"{first}META_START{second.replace('SELENITA', 'OTHER')}"


def horizons(ephemeris):
    segment = ephemeris.segments[0]
    rows, states = [], np.hstack([segment.position_m, segment.velocity_m_s]) / 1e3
    for count, state in zip(from_tai_ns(segment.tai_ns, "TDB").tolist(), states, strict=True):
        date = str(np.datetime64(count, "ns")).replace("-08-", "-Aug-").replace("T", " ")
        rows.append(f"{count / 864e11 + 2440587.5:.9f}, A.D. {date}, " + ", ".join(f"{v:.12e}" for v in state) + ",")
    head = """Target body name: SELENITA (-85)                  {source: test}
Center body name: Moon (301)                      {source: DE441}
Output units    : KM-S
Output type     : GEOMETRIC cartesian states
Reference frame : ICRF
JDTDB, Calendar Date (TDB), X, Y, Z, VX, VY, VZ,
$$SOE"""
    return "\n".join([head, *rows, "$$EOE", ""])


ORBITS = {
    "OEM": ("oem", format_oem),
    "OEM in XML": ("xml", format_oem_xml),
    "STK": ("e", format_stk),
    "Horizons": ("txt", horizons),
    "SPK": ("bsp", lambda ephemeris: spk_kernel(ephemeris, -85).octets),
}


def orbit_figures(path):
    ephemeris = load_orbit(path)
    return np.hstack(ephemeris.at(ASKED)), ephemeris.words


def attitudes(**fields):
    position, velocity = orbit().at(times(ELAPSED_S))
    down = -position / norm(position, axis=1, keepdims=True)
    ahead = velocity / norm(velocity, axis=1, keepdims=True)
    q_wxyz = [quaternion_from_matrix(m) for m in np.stack([np.cross(-ahead, down), -ahead, down], axis=1)]
    return (AttitudeSegment(times(ELAPSED_S), np.array(q_wxyz), **fields),)


def external(folder):
    import cv2

    (folder / "orbit.oem").write_text(format_oem(orbit()))
    rows = ["file,utc"]
    for k, elapsed_s in enumerate((605.0, 2718.0, 5000.0)):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((64, 64), 50 + 50 * k, np.uint8))
        rows.append(f"{k}.png,{format_utc(int(times(elapsed_s)))}")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    return text("attitude.aem", lambda: format_aem(attitudes(), "1.0"))(folder)


def pointing(path):
    plain = Scenario("x")
    frames = load_external(path.parent, replace(plain, camera=replace(plain.camera, width_px=64, height_px=64)))
    check_pointing(load_orbit(frames.ephemeris), frames.attitude_utc_ns, frames.q_wxyz)
    found = [(frames.camera_from_icrf(t), float(np.mean(frames.image(t)))) for t in frames.utc_ns.tolist()]
    return np.concatenate([np.append(m, shade) for m, shade in found] + [(frames.utc_ns - START) / NS]), frames.words


def attitude_table():
    rows = zip(ticks_from_utc_ns(times(ELAPSED_S)).tolist(), attitudes()[0].q_wxyz.tolist(), strict=True)
    return "\n".join(["image_ticks,q_w,q_x,q_y,q_z", *(",".join(map(repr, (t, *q))) for t, q in rows), ""])


def table_pointing(path):
    table = load_attitudes(path)
    check_attitudes(table, orbit(), START, int(times(5400.0)))
    seconds = (utc_ns_from_ticks(table.image_ticks) - START) / NS
    return np.column_stack([seconds, matrix_from_quaternion(table.q_wxyz).reshape(-1, 9)]), ""


# Gravity: the built-in field.

FIELD = builtin_gravity()
TERMS = [(n, m, FIELD.c_bar[n, m], FIELD.s_bar[n, m]) for n in range(2, 13) for m in range(n + 1)]
AT_M = np.array([[1.77e6, 1e5, 2e5], [-9e5, 1.4e6, -7e5], [3e5, -4e5, 1.75e6]])
GM, RADIUS = FIELD.gm_m3_s2, FIELD.radius_m
HEADS = {
    "gravity ICGEM": (
        f"modelname TEST\nearth_gravity_constant {GM:.12e}\nradius {RADIUS:.6e}\nmax_degree 12\nnorm fully_normalized\n"
        "end_of_head\ngfc 0 0 1.0 0.0\n",
        "gfc {} {} {:.15e} {:.15e}\n",
    ),
    "gravity SHADR": (
        f"{RADIUS / 1e3:.6E}, {GM / 1e9:.15E}, 0.0, 12, 12, 1, 0.0, 0.0\n",
        "{}, {}, {:.15E}, {:.15E}, 0, 0\n",
    ),
    "gravity GMAT": (
        f"POTFIELD 12 12  0 {GM:.14e} {RADIUS:.14e} 1.00000000000000e+00\n",
        "RECOEF  {:3d}{:3d}   {:21.14e}{:21.14e}\n",
    ),
    "gravity pyshtools": (f"{RADIUS:.6e}, {GM:.12e}, 2.66e-06, 12\n0, 0, 1.0, 0.0\n", "{}, {}, {:.15e}, {:.15e}\n"),
}


def plain(n, m):
    """Return the factor of coefficients that are not normalised."""
    return math.sqrt((2 - (m == 0)) * (2 * n + 1) * math.factorial(n - m) / math.factorial(n + m))


def field_text(name, change="n, m, c, s"):
    head, row = HEADS[name]
    rows = (row.format(*value(change, n=n, m=m, c=c, s=s)) for n, m, c, s in TERMS)
    return head + "".join(rows) + ("END\n" if "GMAT" in name else "")


def pull(path):
    field = load_gravity(path)
    return acceleration(field, AT_M), field.words


# Craters, rasters, registrations, orientation.

NAMES = ("id", "latitude", "longitude", "diameter_m", "rim_height_m", "depth_m", "complete", "source")
LISTS = {
    "craters own": "id,latitude_deg,longitude_deg,diameter_m,rim_height_m,depth_m,complete,",
    "craters LU1319381": "id,latitude_deg,longitude_deg,diameter_m,,depth_m,,",
    "craters composite": ",latitude_deg,longitude_deg,diameter_km,,,tile_complete,source",
    "craters Robbins": ",lat,lon,diam,,,,",
    "craters Robbins whole": ",LAT_CIRC_IMG,LON_CIRC_IMG,DIAM_CIRC_IMG,,,,",
}


def list_text(name, column="id", change="v"):
    rng = default_rng(3)
    diameter_m = 3_000.0 * (1.0 - rng.random(60)) ** -0.5
    columns = dict(
        zip(
            NAMES,
            (
                *(np.arange(60.0), rng.uniform(20.0, 24.0, 60), rng.uniform(250.0, 254.0, 60), diameter_m),
                *(rng.normal(-1_000.0, 800.0, 60), 0.08 * diameter_m, np.ones(60), np.zeros(60)),
            ),
            strict=True,
        )
    )
    columns[column] = np.asarray(value(change, v=columns[column], columns=columns))
    heads = LISTS[name].split(",")
    if heads[3] != "diameter_m":
        columns["diameter_m"] = columns["diameter_m"] / 1e3
    kept = [k for k, head in enumerate(heads) if head]
    rows = zip(*(columns[NAMES[k]].tolist() for k in kept), strict=True)
    return "\n".join([",".join(heads[k] for k in kept), *(",".join(f"{v:.9g}" for v in row) for row in rows), ""])


def catalogue_figures(path):
    found = load_catalogue(path)
    columns = (found.latitude_rad, found.longitude_rad, found.diameter_m, found.depth_m, found.rim_height_m)
    return np.column_stack([*columns, found.complete]), catalogue_words(found)


NO_CRATERS = make_catalogue([], [], [], source="none")
DEGREE_M, STERE = math.radians(1_737_400.0), "+proj=stere +lat_0=90 +R=1737400"


def polar(path, crs=STERE, step=2_000.0, own=STERE, convert=np.array, unit=""):
    """Write the ground as a polar map with places of the projection `own`."""
    import rasterio
    from rasterio.warp import transform

    column, row = np.meshgrid(np.arange(250) + 0.5, np.arange(250) + 0.5)
    x, y = 2_000.0 * (column - 20.0), -2_000.0 * (row + 130.0)
    systems = [rasterio.crs.CRS.from_string(one) for one in (own, "+proj=longlat +R=1737400 +no_defs")]
    east, north = map(np.array, transform(*systems, x.ravel(), y.ravel()))
    values = convert(ground(north, east).reshape(250, 250)).astype("float32")
    write_tiff(path, rasterio.Affine(step, 0, -20 * step, 0, -step, -130 * step), values, crs)
    if unit:
        with rasterio.open(path, "r+") as target:
            target.units = (unit,)


def heights(path):
    """Return heights as the emulator takes them, with the words of the curation."""
    is_polar = path.stem == "polar"
    places = [[76.5, 77.5, 78.5], [8.0, 16.2, 25.0]] if is_polar else [[75.3, 77.1, 78.9], [12.7, 16.2, 23.4]]
    terrain = RasterTerrain([path], NO_CRATERS, sharpen=False, registration_north_m=0.0, smoothing_pixels=0.0)
    figures = terrain.height_m(*np.radians(places))
    found = RasterHeights([path])
    found.window(76.5, 79.0, *((8.0, 25.0) if is_polar else (11.0, 24.0)))
    return figures, "; ".join(found.readings)


def raster(name, make):
    return lambda folder: (make(folder / name), folder / name)[1]


def registration():
    k = np.arange(12)
    shifts = (np.linspace(-50, 50, 12), np.linspace(10, 90, 12), np.full(12, 15.0))
    return format_registration(Registration(k, k + 40, *shifts, 0 * k + 30, "a" * 64, {"dem.tif": "b" * 64}))


def shifts(path):
    found = parse_registration(path.read_text(), str(path))
    columns = (found.row, found.column, found.east_m, found.north_m, found.sigma_m, found.rims)
    return np.column_stack(columns), found.words


def kernels(folder):
    data = Path(os.environ["LINNA_DATA"]) / "kernels"
    (folder / "moon.bpc").symlink_to(data / "moon_pa_de421_1900-2050.bpc")
    return text("moon.tf", (data / "moon_080317.tf").read_text)(folder)


def turned(path):
    return load_orientation(path.with_suffix(".bpc"), path).mcmf_from_icrf(np.array([9e8, 1e9])), ""


# Labels and pictures.


def labels():
    rng = default_rng(5)
    boxes = np.column_stack([rng.uniform(10, 400, (30, 2)), *[rng.uniform(9, 60, 30)] * 2]).tolist()
    image = {"id": 7, "file_name": "a.png", "width": 512, "height": 480, "sun_azimuth_deg": 30.0, "pixel_m": 90.0}
    listed = [{"id": k, "image_id": 7, "category_id": 2 - (k % 3 > 0), "bbox": box} for k, box in enumerate(boxes)]
    kinds = [{"id": 1, "name": "crater"}, {"id": 2, "name": "boulder"}]
    return dumps({"images": [image], "annotations": listed, "categories": kinds})


def coco(folder):
    import cv2

    cv2.imwrite(str(folder / "a.png"), np.full((480, 512), 99, np.uint8))
    return text("labels.json", labels)(folder)


def corners(box):
    x, y, w, h = box
    return [x, y, x + w, y, x + w, y + h, x, y + h]


def labelled(path):
    (found,) = load_pictures(path.parent)
    rows = np.sort([found.u_px, found.v_px, found.diameter_px, found.crowd.astype(float)], axis=1)
    figures = np.append(rows, [found.sun_azimuth_deg, found.pixel_m, found.altitude_km])
    return figures, "; ".join([f"{np.count_nonzero(~found.crowd)} labelled craters", *set_words([found])])


def picture(path, change="a"):
    import cv2

    shades = (default_rng(2).random((48, 64)) ** 2 * 60_000).astype(np.uint16)
    cv2.imwrite(str(path), np.ascontiguousarray(value(change, a=shades)))


def pixel(a, shade):
    out = (a / 60_000).astype(np.float32)
    out[5, 6] = shade
    return out


def seen(path):
    """Return quantiles of what the network sees, and the printed remark."""
    image, remark = read_picture(path)
    prepared = prepare_image(image)
    why = quality_reason(image, prepared.quality)
    return np.quantile(prepared.gray, [0.1, 0.5, 0.9]), f"{remark} {prepared.quality} {why}"


# Packets.


MODE = """<EnumeratedParameterType name="MODE"><UnitSet/><IntegerDataEncoding sizeInBits="8"/><EnumerationList>
<Enumeration value="1" label="SAFE"/><Enumeration value="2" label="ON"/></EnumerationList></EnumeratedParameterType>"""


def bus(folder):
    types = x_tce.HEADER_TYPES + x_tce.calibrated("VOLT", 12, "unsigned", x_tce.default(x_tce.polynomial(-1.5, 0.25)))
    types += x_tce.integer("I20", 20, "twosComplement") + x_tce.floating("F32", 32) + MODE
    names = {"VOLTAGE": "VOLT", "OFFSET": "I20", "RATE": "F32", "STATE": "MODE"}
    packet = x_tce.container("HK", list(names), "CCSDSPacket", x_tce.comparison("PKT_APID", 100))
    octets = b""
    for k in range(20):
        body = ((100 + 7 * k) << 20 | (-5 * k & 0xFFFFF)).to_bytes(4, "big") + struct.pack(">fB", 1.5 * k, 1 + k % 2)
        octets += struct.pack(">HHH", 100, 0xC000 | k, len(body) - 1) + body
    (folder / "bus.bin").write_bytes(octets)
    document = x_tce.document(types, x_tce.HEADER_PARAMETERS | names, x_tce.HEADER_CONTAINER + packet)
    return text("bus.xml", lambda: document)(folder)


def decoded(path):
    options = ["--xtce", str(path), "--no-error-control", "--prefix-octets", "0"]
    recording = str(path.with_suffix(".bin"))
    records = loads(printed("tm", "decode", recording, *options))
    rows = [[record.get(key) for key in ("VOLTAGE", "OFFSET", "RATE", "STATE")] for record in records]
    states = {"SAFE": 1.0, "ON": 2.0}
    figures = [[states.get(v, v) if isinstance(v, str) else v for v in row] for row in rows]
    return np.array(figures, dtype=np.float64), printed("tm", "check", recording, *options)


def printed(*words):
    """Return what a command prints; its refusal is raised."""
    out, err = io.TextIOWrapper(io.BytesIO()), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = linna(list(words))
    out.seek(0)
    if status == 2:
        raise TmtcError(err.getvalue().strip())
    return out.read()


def cadus(**settings):
    return encode_cadus(make_packets(60), **({"spacecraft_id": 76, "frame_length": 892} | settings))


def received(path):
    found = decode(path.read_bytes())
    octets = b"".join(found.cut.packets(found.buffer))
    return np.frombuffer(octets, np.uint8).astype(np.float64), printed("tm", "check", str(path))


# Documents of the ground.


def leaves(tree):
    """Return the numbers in a tree of values; texts count by a checksum."""
    if isinstance(tree, dict):
        return [number for key in sorted(tree) for number in leaves(tree[key])]
    if isinstance(tree, list):
        return [number for item in tree for number in leaves(item)]
    return [float(tree) if isinstance(tree, (int, float)) else float(zlib.crc32(repr(tree).encode()))]


def mission_values(path):
    mission = parse_mission(path.read_text())
    return leaves(mission.model_dump(mode="json")), mission.words


def scenario_values(path):
    scenario = load_scenario(path)
    return leaves(loads(dumps(asdict(scenario)))), scenario.words


def receptions():
    rows = (
        f"{ticks_from_utc_ns(START + k * 10 * NS)},{k},{format_utc(START + k * 10 * NS + NS)},Madrid\n"
        for k in range(9)
    )
    return "packet_ticks,sequence_count,received_utc,station\n" + "".join(rows)


def reception_values(path):
    found = read_receptions(path)
    return [[r.ticks, r.sequence_count, r.earth_utc_ns / NS] for r in found], str({r.station for r in found})


READERS = {
    **{name: Reader(text(f"orbit.{ending}", lambda form=form: form(orbit())), orbit_figures, ("orbits",), 1e-3)
       for name, (ending, form) in ORBITS.items()},
    "attitudes (AEM)": Reader(external, pointing, (), 1e-6),
    "attitudes (table)": Reader(text("attitude.csv", attitude_table), table_pointing, (), 1e-6),
    **{name: Reader(text("field", lambda name=name: field_text(name)), pull,
                    ("gravity",) if name in ("gravity ICGEM", "gravity SHADR") else (), 1e-12) for name in HEADS},
    **{name: Reader(text("craters.csv", lambda name=name: list_text(name)), catalogue_figures, ("craters",), 2e-6)
       for name in LISTS},
    "height rasters": Reader(raster("a.tif", write_form), heights, (), 1.0),
    "polar rasters": Reader(raster("polar.tif", polar), heights, (), 2.0),
    "registrations": Reader(text("registration.json", registration), shifts),
    "orientation kernels": Reader(kernels, turned, (), 1e-8),
    "COCO": Reader(coco, labelled),
    "pictures": Reader(raster("a.tif", picture), seen, (), 0.05),
    "XTCE": Reader(bus, decoded),
    "recordings": Reader(text("pass.cadu", cadus), received),
    "missions": Reader(text("mission.toml", (REFERENCES / "changed_inputs_mission.toml").read_text), mission_values),
    "scenarios": Reader(text("own.toml", (REFERENCES / "changed_inputs_scenario.toml").read_text), scenario_values),
    "receptions": Reader(text("receptions.csv", receptions), reception_values),
}  # fmt: skip


# Changes.


def value(expression, **names):
    """Return the value of an expression of the table of changes."""
    return eval(expression, globals() | names)


def change(reader, kind, place, new, path):
    """Change one field of a file."""
    if kind == "frames":
        path, kind = path.with_name("frames.csv"), "every"
    if kind in ("text", "every"):
        changed, found = re.subn(place, new, path.read_text(), count=kind == "text", flags=re.MULTILINE)
        assert found, place
        path.write_text(changed)
    elif kind == "state":
        written = ORBITS[reader][1](orbit(new))
        path.write_bytes(written if isinstance(written, bytes) else written.encode())
    elif kind == "written":
        path.write_text(value(new))
    elif kind == "quaternions":
        rows = [line.split() for line in path.read_text().splitlines()]
        at = [k for k, row in enumerate(rows) if row and row[0][:4] == "2029"]
        changed = value(new, q=np.array([rows[k][1:] for k in at], dtype=np.float64))
        for k, q in zip(at, changed.tolist(), strict=True):
            rows[k][1:] = [f"{v:.12f}" for v in q]
        path.write_text("\n".join(map(" ".join, rows)) + "\n")
    elif kind == "terms":
        path.write_text(field_text(reader, new))
    elif kind == "column" and reader.startswith("craters"):
        path.write_text(list_text(reader, place, new))
    elif kind == "column":
        path.write_text(
            re.sub(r"^\d+", lambda found: str(value(new, v=int(found[0]))), path.read_text(), flags=re.MULTILINE)
        )
    elif kind == "form":
        (polar if reader == "polar rasters" else write_form)(path, **value(f"dict({new})"))
    elif kind == "picture":
        picture(path, new)
    elif kind == "cadus":
        path.write_bytes(cadus(**value(f"dict({new})")))
    elif kind == "octets":
        octets = value(new, v=np.frombuffer(path.read_bytes(), np.uint8))
        path.write_bytes(np.ascontiguousarray(octets).tobytes())
    else:
        document = loads(path.read_text())
        change_tree(document, kind, place, new)
        path.write_text(dumps(document))


def change_tree(document, kind, place, new):
    if kind == "json":
        *keys, last = [int(key) if key.isdigit() else key for key in place.split("/")]
        for key in keys:
            document = document[key]
        document[last] = loads(new)
    elif kind == "tree":
        value(new, d=document)
    for item in document["annotations"] if kind == "boxes" else ():
        item["bbox"] = value(new, b=item["bbox"])
    for node in document["nodes"] if kind == "nodes" else ():
        node[int(place)] = value(new, v=node[int(place)])


def changes_of(name):
    with (REFERENCES / "changed_inputs.csv").open(newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row["reader"] in (name, *READERS[name].changes)]
    heads = dict(zip(NAMES, LISTS.get(name, "").split(","), strict=False))
    return [row for row in rows if row["reader"] != "craters" or heads.get(row["place"])]


def outcome(name, row, folder):
    """Return "refused: why", "same", "stated: words", or "SILENT: difference" of a changed file."""
    reader = READERS[name]
    path = reader.write(folder)
    before, words = reader.figures(path)
    change(name, row["kind"], row["place"], row["new"], path)
    try:
        after, now = reader.figures(path)
    except REFUSALS as error:
        return f"refused: {str(error).replace(str(folder), '')[:150]}"
    before, after = (np.asarray(figures, dtype=np.float64) for figures in (before, after))
    if before.shape == after.shape and np.allclose(before, after, 0.0, reader.tolerance, equal_nan=True):
        return "same"
    if now != words:
        return f"stated: {now[:150]}"
    return f"SILENT: {np.nanmax(np.abs(before - after)) if before.shape == after.shape else after.shape}"


@mark.parametrize("name", READERS)
def test_a_changed_field_never_gives_other_figures_in_silence(name, tmp_path):
    if name == "orientation kernels" and "LINNA_DATA" not in os.environ:
        skip("LINNA_DATA is not set: no kernels on this machine")
    rows = changes_of(name)
    assert rows
    for number, row in enumerate(rows):
        folder = tmp_path / str(number)
        folder.mkdir()
        found = outcome(name, row, folder)
        assert not found.startswith("SILENT"), f"{row['change']}: {found}"


CODE = {
    "Ephemerides": ("lunar.messages.oem", "lunar.messages.kvn", "lunar.messages.stk", "lunar.messages.horizons"),
    "Attitudes": ("lunar.messages.aem",),
    "Gravity and orientation": ("lunar.frames",),
    "Height rasters": ("payload_emulator.sim.terrain.rasters",),
    "Crater lists": ("lunar.catalogue",),
    "COCO files": ("payload_emulator.training.data.pictures",),
    "Documents of the ground": (
        "payload_emulator.sim.terrain.registration",
        "ground_service.missions.timekeeping.recorrelation",
        "payload_emulator.session.world.external",
    ),
}
KEYS = re.compile(r"""(?m)^_(?:META|HEADER)_KEYS\b|^_(?:MANDATORY|IGNORED|READERS|COLUMNS)\b|^OWN_COLUMNS\b""")
LOOKED_UP = re.compile(
    r'(?:\b(?:item|row|document|head|one)(?:\.get\(|\[)|_(?:value|number|positive)\(item, |prefix \+ )"(\w+)"'
    r'|"(\w+)" (?:not )?in (?:item|document)\b'
)
NOT_OF_FILES = {"received"}
"""Keys of requests to the service."""


def code_of(names):
    return "\n".join(Path(importlib.import_module(name).__file__ or "").read_text() for name in names)


def keys_of(code):
    """Return the names that a reader takes from a file: its constants of keys and columns, and what it looks up."""
    constants = [code[at.start() : code.index("\n)\n" if "(\n" in code[at.start() : at.end() + 60] else "\n", at.end())]
                 for at in KEYS.finditer(code)]  # fmt: skip
    found = {name for one in constants for name in re.findall(r'"(\w+)"', one)}
    return found | {name for pair in LOOKED_UP.findall(code) for name in pair if name}


@mark.parametrize("section", CODE)
def test_the_table_of_readers_has_the_names_that_the_code_reads_and_no_others(section):
    page = Path(__file__).parents[1] / "docs/reference/readers.md"
    body = page.read_text().partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    rows = "\n".join(line for line in body.splitlines() if line.startswith("|"))
    stated = {name.casefold() for name in re.findall(r"`(\w[\w ()]*)`", rows)}
    code = code_of(CODE[section])
    assert {name.casefold() for name in keys_of(code)} - NOT_OF_FILES <= stated
    assert {name for name in stated if name not in code.casefold() and " " not in name} == set()


def main():
    counts = Counter()
    for name in READERS:
        for row in changes_of(name):
            with tempfile.TemporaryDirectory() as folder:
                found = outcome(name, row, Path(folder))
            counts[found.partition(":")[0]] += 1
            print(f"{name:<22} {row['change']:<50} {found}", flush=True)
    print(f"{counts.total()} changed inputs of {len(READERS)} readers: {dict(counts)}")


if __name__ == "__main__":
    main()
