"""Valid files of every reader with one field changed to another unit, zero, scale, order, sign, frame, time scale or identity.

Such a file is refused, gives the same figures, or the words that the product prints with the figures name the field:
other figures in silence are a fault. `python -m tests.test_changed_inputs` prints the table of all of them.
"""

from __future__ import annotations

import json
import math
import re
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service.errors import GroundError
from ground_service.missions.ephemerides.service import check_attitudes, load_attitudes
from ground_service.missions.model import parse_mission
from ground_service.missions.timekeeping.recorrelation import read_receptions
from linna.data import load_orbit
from lunar.catalogue import catalogue_words, load_catalogue
from lunar.comparison import check_pointing
from lunar.ephemeris import Ephemeris, clipped, ephemeris_from_states
from lunar.errors import LunarError
from lunar.frames import icrf_from_j2000, matrix_from_quaternion, quaternion_from_matrix
from lunar.gravity import acceleration, builtin_gravity, load_gravity
from lunar.messages.aem import AttitudeSegment, format_aem, parse_aem
from lunar.messages.oem import format_oem, parse_oem
from lunar.messages.oem_xml import format_oem_xml
from lunar.messages.spice import spk_kernel
from lunar.messages.stk import format_stk
from lunar.timescales import NS, format_utc, from_tai_ns, ticks_from_utc_ns, utc_ns_from_ticks
from payload_emulator.errors import PayloadError
from payload_emulator.session.scenario import format_scenario, parse_scenario, Scenario
from payload_emulator.session.world.external import load_external, read_picture
from payload_emulator.sim.terrain.registration import parse_registration
from payload_emulator.sim.terrain.rasters import open_layers
from payload_emulator.training.data.pictures import load_pictures
from tests.lunar.orbits import RADIUS_M, START, TILTED, circle, times
from tmtc.errors import TmtcError

REFUSALS = (LunarError, GroundError, PayloadError, TmtcError)
Edit = Callable[[Path], None]


@dataclass(frozen=True)
class Reader:
    """A reader with a valid file, the figures and words that it gives of it, and changes of the file by name."""

    write: Callable[[Path], Path]
    figures: Callable[[Path], tuple[Any, str]]
    changes: dict[str, Edit]
    tolerance: float = 1e-9


def text(pattern: str, new: str, count: int = 1) -> Edit:
    """Replace what a pattern finds in a text file, as often as stated (0: everywhere)."""

    def edit(path: Path) -> None:
        changed, found = re.subn(pattern, new, path.read_text(), count=count, flags=re.MULTILINE)
        assert found, pattern
        path.write_text(changed)

    return edit


# Orbits ---------------------------------------------------------------------------------------------------------------

ELAPSED_S = np.arange(0.0, 5401.0, 60.0)
ASKED = times([65.0, 605.0, 2675.0, 5000.0, 5300.0])


def orbit(states: Callable[[np.ndarray, np.ndarray], Any] = lambda t, x: x, **fields: Any) -> Ephemeris:
    """A circular orbit whose states (n, 6) in m and m/s a function of their times changes."""
    values = states(ELAPSED_S, np.hstack(circle(ELAPSED_S, node=(0.8, 0.6, 0.0), north=(-0.36, 0.48, 0.8))))
    return ephemeris_from_states(times(ELAPSED_S), values[:, :3], values[:, 3:], **fields)


def scaled(*factors: float) -> Callable[[Any, np.ndarray], np.ndarray]:
    return lambda t, x: x * np.array(factors)


def ordered(*columns: int) -> Callable[[Any, np.ndarray], np.ndarray]:
    return lambda t, x: np.ascontiguousarray(x[:, list(columns)])


def turning(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return states in axes that turn with the Moon."""
    angle = 2.6617e-6 * (t + 3e5)
    matrix = np.zeros((len(t), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = np.cos(angle)
    matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    turned = np.einsum("nij,nkj->nki", matrix, x.reshape(-1, 2, 3)).reshape(-1, 6)
    turned[:, 3] += 2.6617e-6 * turned[:, 1]
    turned[:, 4] -= 2.6617e-6 * turned[:, 0]
    return turned


KM_MILES, KM_FEET = 1 / 1.609344, 3280.84
STATES: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "unit: positions in m": scaled(1e3, 1e3, 1e3, 1, 1, 1),
    "unit: velocities in m/s": scaled(1, 1, 1, 1e3, 1e3, 1e3),
    "unit: velocities in km/min": scaled(1, 1, 1, 60, 60, 60),
    "unit: velocities in km/day": scaled(1, 1, 1, 86400, 86400, 86400),
    "unit: positions and velocities in m": scaled(*(1e3,) * 6),
    "unit: positions and velocities in miles": scaled(*(KM_MILES,) * 6),
    "unit: positions in radii of the Moon": scaled(*(1 / 1.7374e6,) * 3, 1, 1, 1),
    "zero: positions from the surface": lambda t, x: np.hstack(
        [x[:, :3] * (1 - 1_737_400.0 / RADIUS_M), x[:, 3:]]
    ),
    "zero: centre of the Earth": lambda t, x: x + [3.6e8, 1e8, 5e7, -250.0, 900.0, 300.0],
    "zero: x moved by 10 km": lambda t, x: x + [1e4, 0, 0, 0, 0, 0],
    "scale: z one per cent greater": scaled(1, 1, 1.01, 1, 1, 1),
    "scale: velocities one per cent greater": scaled(1, 1, 1, 1.01, 1.01, 1.01),
    "scale: all one per cent greater": scaled(*(1.01,) * 6),
    "order: y and z of positions": ordered(0, 2, 1, 3, 4, 5),
    "order: x and y of velocities": ordered(0, 1, 2, 4, 3, 5),
    "order: velocities before positions": ordered(3, 4, 5, 0, 1, 2),
    "sign: z of positions": scaled(1, 1, -1, 1, 1, 1),
    "sign: velocities": scaled(1, 1, 1, -1, -1, -1),
    "sign: y of velocities": scaled(1, 1, 1, 1, -1, 1),
    "frame: axes that turn with the Moon": turning,
    "frame: velocities relative to the ground": lambda t, x: x
    - np.hstack([0 * x[:, :3], np.cross([0, 0, 2.6617e-4], x[:, :3])]),
    "identity: the first state everywhere": lambda t, x: np.repeat(x[:1], len(x), axis=0),
}


def orbit_reader(name: str, form: Callable[[Ephemeris], str | bytes], more: dict[str, Edit]) -> Reader:
    def save(path: Path, ephemeris: Ephemeris) -> Path:
        octets = form(ephemeris)
        path.write_bytes(octets if isinstance(octets, bytes) else octets.encode())
        return path

    def figures(path: Path) -> tuple[Any, str]:
        ephemeris = load_orbit(path)
        return np.hstack(ephemeris.at(ASKED)), ephemeris.words

    changes = {
        label: lambda path, change=change: (save(path, orbit(change)), None)[1]
        for label, change in STATES.items()
    }
    return Reader(
        lambda folder: save(folder / f"orbit.{name}", orbit()), figures, changes | more, tolerance=1e-3
    )


def epochs_in(system: str, stated: bool) -> Edit:
    """Write the epochs of an OEM in another time scale, which it states or not."""

    def edit(path: Path) -> None:
        written = format_oem(orbit(), time_system=system)
        path.write_text(written if stated else written.replace(f"TIME_SYSTEM = {system}", "TIME_SYSTEM = UTC"))

    return edit


def in_j2000(path: Path) -> None:
    turned = orbit(lambda t, x: (x.reshape(-1, 2, 3) @ icrf_from_j2000()).reshape(-1, 6))
    path.write_text(format_oem(turned).replace("REF_FRAME = ICRF", "REF_FRAME = EME2000"))


def second_object(path: Path) -> None:
    """Write two segments and name another object in the second one."""
    middle = int(times(2700.0))
    halves = [clipped(orbit(), int(a), int(b)) for a, b in ((START, middle), (middle, times(5400.0)))]
    written = format_oem(Ephemeris(sum((one.segments for one in halves), ())))
    first, _, second = written.rpartition("META_START")
    path.write_text(f"{first}META_START{second.replace('SELENITA', 'OTHER')}")


def swapped_lines(path: Path) -> None:
    lines = path.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("2029") and k > 30)
    lines[at], lines[at + 1] = lines[at + 1], lines[at]
    path.write_text("\n".join(lines))


def wrong_line(factor: float, columns: slice = slice(0, 3), row: int = 44) -> Edit:
    """Scale the position or the velocity of one state."""

    def change(t: np.ndarray, x: np.ndarray) -> np.ndarray:
        x = x.copy()
        x[row, columns] *= factor
        return x

    return lambda path: (path.write_text(format_oem(orbit(change))), None)[1]


OEM_EDITS: dict[str, Edit] = {
    "time scale: epochs and TIME_SYSTEM in TAI": epochs_in("TAI", True),
    "time scale: epochs and TIME_SYSTEM in TDB": epochs_in("TDB", True),
    "time scale: epochs and TIME_SYSTEM in GPS": epochs_in("GPS", True),
    "time scale: TIME_SYSTEM only": text("TIME_SYSTEM = UTC", "TIME_SYSTEM = TAI"),
    "time scale: TIME_SYSTEM unknown": text("TIME_SYSTEM = UTC", "TIME_SYSTEM = MET"),
    "frame: EME2000, states and REF_FRAME": in_j2000,
    "frame: REF_FRAME of the Earth": text("REF_FRAME = ICRF", "REF_FRAME = ITRF2000"),
    "frame: REF_FRAME of the equator of date": text("REF_FRAME = ICRF", "REF_FRAME = TOD"),
    "frame: REF_FRAME that turns with the Moon": text("REF_FRAME = ICRF", "REF_FRAME = MOON_ME"),
    "frame: CENTER_NAME of the Earth": text("CENTER_NAME = MOON", "CENTER_NAME = EARTH"),
    "identity: OBJECT_NAME": text("OBJECT_NAME = SELENITA", "OBJECT_NAME = OTHER"),
    "identity: two objects in one file": second_object,
    "order: lines of two states": swapped_lines,
    "zero: STOP_TIME before the last state": text("^STOP_TIME = .*", "STOP_TIME = 2029-08-07T01:00:00"),
    "zero: START_TIME a day before": text("^START_TIME = .*", "START_TIME = 2029-08-06T00:00:00"),
    "unit: epoch of one state in another form": text(
        "^2029-08-07T00:30:00.000", "2029-219T00:30:00.000"
    ),
    "zero: epoch of one state a month later": text("^2029-08-07T00:30:00.000", "2029-09-07T00:30:00.000"),
    "unit: INTERPOLATION unknown": text("INTERPOLATION = HERMITE", "INTERPOLATION = CUBIC"),
    "zero: INTERPOLATION_DEGREE 0": text("INTERPOLATION_DEGREE = 7", "INTERPOLATION_DEGREE = 0"),
    "scale: one position ten times as great": wrong_line(10.0),
    "scale: one position one per cent greater": wrong_line(1.01),
    "sign: one position": wrong_line(-1.0),
    "sign: z of one position": wrong_line(-1.0, slice(2, 3)),
    "unit: velocity of one state in m/s": wrong_line(1e3, slice(3, 6)),
    "sign: x of one velocity": wrong_line(-1.0, slice(3, 4)),
    "unit: position of the second state": wrong_line(1e3, slice(0, 3), 1),
    "unit: position of the first state": wrong_line(1e3, slice(0, 3), 0),
    "unit: velocity of the last state": wrong_line(1e3, slice(3, 6), -1),
    "identity: an unknown keyword": text("^META_STOP", "GRAVITY = NONE\nMETA_STOP"),
    "identity: version of the format": text("OEM_VERS = 2.0", "OEM_VERS = 9.0"),
}
XML_EDITS: dict[str, Edit] = {
    "unit: units of a position": text('<X units="km">', '<X units="m">'),
    "unit: units of a velocity": text('<X_DOT units="km/s">', '<X_DOT units="m/s">'),
    "order: elements of a state": text(r"(<X units.*?</X>)(<Y units.*?</Y>)", r"\2\1"),
    "time scale: TIME_SYSTEM only": text("<TIME_SYSTEM>UTC", "<TIME_SYSTEM>TT"),
    "frame: CENTER_NAME": text("<CENTER_NAME>MOON", "<CENTER_NAME>EARTH"),
    "frame: REF_FRAME": text("<REF_FRAME>ICRF", "<REF_FRAME>TEME"),
    "identity: OBJECT_NAME": text("<OBJECT_NAME>SELENITA", "<OBJECT_NAME>OTHER"),
    "identity: one state twice": text(r"(<stateVector>.*?</stateVector>)", r"\1\1"),
}
STK_EDITS: dict[str, Edit] = {
    "unit: DistanceUnit": text("DistanceUnit Meters", "DistanceUnit Kilometers"),
    "unit: DistanceUnit unknown": text("DistanceUnit Meters", "DistanceUnit Feet"),
    "frame: CentralBody": text("CentralBody Moon", "CentralBody Earth"),
    "frame: CentralBody absent": text("CentralBody Moon\n", ""),
    "frame: CoordinateSystem": text("CoordinateSystem ICRF", "CoordinateSystem Fixed"),
    "frame: CoordinateSystem absent": text("CoordinateSystem ICRF\n", ""),
    "time scale: TimeFormat": text("DistanceUnit", "TimeFormat JDate\nDistanceUnit"),
    "zero: ScenarioEpoch without a day": text("ScenarioEpoch 7 Aug 2029", "ScenarioEpoch Aug 2029"),
    "identity: NumberOfEphemerisPoints": text("Points 91", "Points 90"),
    "scale: InterpolationSamplesM1 of 0": text("SamplesM1 3", "SamplesM1 0"),
    "unit: TimeUnit": text("DistanceUnit", "TimeUnit Minutes\nDistanceUnit"),
}


def horizons(ephemeris: Ephemeris) -> str:
    """Return a vector table as Horizons writes it."""
    one = ephemeris.segments[0]
    rows = []
    for count, x, v in zip(
        from_tai_ns(one.tai_ns, "TDB").tolist(), one.position_m / 1e3, one.velocity_m_s / 1e3, strict=True
    ):
        date = np.datetime_as_string(np.datetime64(count, "ns"))
        month = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep")[int(date[5:7]) - 1]
        day = f"A.D. {date[:4]}-{month}-{date[8:10]} {date[11:]}"
        rows.append(f"{count / 864e11 + 2440587.5:.9f}, {day}, " + ", ".join(f"{a:.12e}" for a in (*x, *v)) + ",")
    head = """Target body name: SELENITA (-85)                  {source: test}
Center body name: Moon (301)                      {source: DE441}
Output units    : KM-S
Calendar mode   : Gregorian
Output type     : GEOMETRIC cartesian states
Reference frame : ICRF
JDTDB, Calendar Date (TDB), X, Y, Z, VX, VY, VZ,
$$SOE"""
    return "\n".join([head, *rows, "$$EOE", ""])


HORIZONS_EDITS: dict[str, Edit] = {
    "unit: Output units": text("KM-S", "AU-D"),
    "unit: velocities of a day": text("KM-S", "KM-D"),
    "frame: Center body name": text(r"Moon \(301\)", "Earth (399)"),
    "frame: Center body name of the barycentre": text(r"Moon \(301\)", "Earth-Moon Barycenter (3)"),
    "frame: Reference frame": text("Reference frame : ICRF", "Reference frame : Ecliptic of J2000.0"),
    "frame: Reference frame of FK4": text("Reference frame : ICRF", "Reference frame : FK4/B1950.0"),
    "time scale: dates in UT": text(r"Date \(TDB\)", "Date (UT)"),
    "order: columns X and Y": text("TDB\\), X, Y,", "TDB), Y, X,"),
    "order: columns with their values": text(r"^(JDTDB|2\d{6}\.\d+), ([^,]+), ([^,]+), ([^,]+),", r"\1, \2, \4, \3,", 0),
    "identity: Target body name": text("SELENITA", "OTHER"),
    "unit: light time corrected": text("GEOMETRIC cartesian states", "LT+S cartesian states"),
}
ORBITS = {
    "OEM": orbit_reader("oem", format_oem, OEM_EDITS),
    "OEM in XML": orbit_reader("xml", format_oem_xml, XML_EDITS),
    "STK": orbit_reader("e", format_stk, STK_EDITS),
    "Horizons": orbit_reader("txt", horizons, HORIZONS_EDITS),
    "SPK": orbit_reader("spk", lambda one: spk_kernel(one, -85).octets, {}),
}

# Attitudes ------------------------------------------------------------------------------------------------------------


def attitudes(**fields: Any) -> tuple[AttitudeSegment, ...]:
    """Attitudes of a camera that looks down from the orbit, with the velocity upward in the image."""
    position, velocity = np.hsplit(np.hstack(orbit().at(times(ELAPSED_S))), 2)
    down = -position / np.linalg.norm(position, axis=1, keepdims=True)
    ahead = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    rotations = np.stack([np.cross(-ahead, down), -ahead, down], axis=1)
    q_wxyz = np.array([quaternion_from_matrix(one) for one in rotations])
    return (AttitudeSegment(times(ELAPSED_S), q_wxyz, **fields),)


def external(folder: Path) -> Path:
    """Frames of another camera with orbit and attitudes."""
    import cv2

    folder.joinpath("orbit.oem").write_text(format_oem(orbit()))
    rows = ["file,utc"]
    for k, elapsed_s in enumerate((605.0, 2718.0, 5000.0)):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((64, 64), 50 + 50 * k, np.uint8))
        rows.append(f"{k}.png,{format_utc(int(times(elapsed_s)))}")
    folder.joinpath("frames.csv").write_text("\n".join(rows) + "\n")
    path = folder / "attitude.aem"
    path.write_text(format_aem(attitudes(), "1.0"))
    return path


def pointing(path: Path) -> tuple[Any, str]:
    """Attitudes and pictures at the times of the frames, as a flight over external frames takes them."""
    scenario = replace(Scenario("x"), camera=replace(Scenario("x").camera, width_px=64, height_px=64))
    frames = load_external(path.parent, scenario)
    ephemeris = load_orbit(frames.ephemeris)
    check_pointing(ephemeris, frames.attitude_utc_ns, frames.q_wxyz)
    rotations = np.array([frames.camera_from_icrf(t) for t in frames.utc_ns.tolist()])
    shades = np.array([float(np.mean(frames.image(t))) for t in frames.utc_ns.tolist()])
    return np.concatenate([rotations.ravel(), shades, (frames.utc_ns - START) / NS]), frames.words


def beside(name: str, edit: Edit) -> Edit:
    return lambda path: edit(path.parent / name)


def quaternions(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """Change the four numbers (n, 4) of an AEM, scalar last."""

    def edit(path: Path) -> None:
        lines = path.read_text().splitlines()
        at = [k for k, line in enumerate(lines) if line[:4] == "2029"]
        values = change(np.array([[float(v) for v in lines[k].split()[1:]] for k in at]))
        for k, row in zip(at, values.tolist(), strict=True):
            lines[k] = lines[k].split()[0] + "".join(f" {v:.12f}" for v in row)
        path.write_text("\n".join(lines) + "\n")

    return edit


def single(change: Callable[[np.ndarray], None]) -> Callable[[np.ndarray], np.ndarray]:
    def all_of(q: np.ndarray) -> np.ndarray:
        change(q[45])
        return q

    return all_of


ATTITUDES = Reader(
    external,
    pointing,
    {
        "sign: all quaternions": quaternions(lambda q: -q),
        "sign: one quaternion": quaternions(single(lambda q: np.negative(q, out=q))),
        "sign: vector parts": quaternions(lambda q: q * [-1, -1, -1, 1]),
        "order: scalar first without QUATERNION_TYPE": quaternions(lambda q: np.roll(q, 1, axis=1)),
        "order: QUATERNION_TYPE only": text("QUATERNION_TYPE = LAST", "QUATERNION_TYPE = FIRST"),
        "order: ATTITUDE_DIR only": text("ATTITUDE_DIR = A2B", "ATTITUDE_DIR = B2A"),
        "order: ATTITUDE_DIR and quaternions": lambda path: (
            text("ATTITUDE_DIR = A2B", "ATTITUDE_DIR = B2A")(path),
            quaternions(lambda q: q * [-1, -1, -1, 1])(path),
            None,
        )[2],
        "scale: quaternions in per cent": quaternions(lambda q: 100 * q),
        "unit: angles in place of quaternions": text("ATTITUDE_TYPE = QUATERNION", "ATTITUDE_TYPE = EULER_ANGLE"),
        "frame: REF_FRAME_A of the Moon": text("REF_FRAME_A = ICRF", "REF_FRAME_A = MOON_ME"),
        "frame: REF_FRAME_B of the body": text("REF_FRAME_B = INSTRUMENT_1", "REF_FRAME_B = SC_BODY_1"),
        "frame: the camera looks along another axis": quaternions(lambda q: q[:, [1, 2, 0, 3]]),
        "time scale: epochs and TIME_SYSTEM in TAI": lambda path: (
            path.write_text(format_aem(attitudes(time_system="TAI"), "1.0")),
            None,
        )[1],
        "time scale: TIME_SYSTEM of AEM only": text("TIME_SYSTEM = UTC", "TIME_SYSTEM = TAI"),
        "zero: START_TIME of the attitudes": text("^START_TIME = .*", "START_TIME = 2029-08-07T00:10:00"),
        "zero: STOP_TIME of the attitudes": text("^STOP_TIME = .*", "STOP_TIME = 2029-08-07T02:10:00"),
        "scale: useable interval": text("^STOP_TIME", "USEABLE_STOP_TIME = 2029-08-07T00:20:00\nSTOP_TIME"),
        "identity: INTERPOLATION_METHOD": text(
            "^META_STOP", "INTERPOLATION_METHOD = LAGRANGE\nINTERPOLATION_DEGREE = 7\nMETA_STOP"
        ),
        "zero: times of the frames a day late": beside("frames.csv", text("2029-08-07", "2029-08-08", 0)),
        "order: two frames": beside("frames.csv", text(r"(0.png.*)\n(1.png.*)", r"\2\n\1")),
        "order: columns of the frames": beside("frames.csv", text(r"^([^,]*),(.*)$", r"\2,\1", 0)),
        "unit: times of the frames in seconds": beside("frames.csv", text(r",2029.*$", ",1249", 0)),
        "identity: one picture twice": beside("frames.csv", text("1.png", "0.png")),
    },
    tolerance=1e-6,
)


def attitude_table(folder: Path) -> Path:
    (one,) = attitudes()
    ticks = ticks_from_utc_ns(one.utc_ns)
    rows = [",".join(map(repr, (t, *q))) for t, q in zip(ticks.tolist(), one.q_wxyz.tolist(), strict=True)]
    path = folder / "attitude.csv"
    path.write_text("\n".join(["image_ticks,q_w,q_x,q_y,q_z", *rows, ""]))
    return path


def table_pointing(path: Path) -> tuple[Any, str]:
    """Attitudes of a pass archive, as its import takes them."""
    table = load_attitudes(path)
    check_attitudes(table, orbit(), START, int(times(5400.0)))
    utc_ns = utc_ns_from_ticks(table.image_ticks)
    return np.column_stack([(utc_ns - START) / NS, matrix_from_quaternion(table.q_wxyz).reshape(-1, 9)]), ""


def scale_ticks(factor: float) -> Edit:
    def edit(path: Path) -> None:
        path.write_text(re.sub(r"^\d+", lambda found: str(round(int(found[0]) * factor)), path.read_text(), flags=re.M))

    return edit


TABLE_ROW = r"^(\d+),([^,]+),([^,]+),([^,]+),([^,\n]+)$"
ATTITUDE_TABLE = Reader(
    attitude_table,
    table_pointing,
    {
        "order: scalar last": text(TABLE_ROW, r"\1,\3,\4,\5,\2", 0),
        "order: columns with their names": text(r"^([^,]+),([^,]+),([^,]+),", r"\1,\3,\2,", 0),
        "sign: scalar of all": text(TABLE_ROW, r"\1,-\2,\3,\4,\5".replace("--", ""), 0),
        "unit: times in ms": scale_ticks(1000 / 65536),
        "unit: times in s": scale_ticks(1 / 65536),
        "scale: quaternions in per cent": text(TABLE_ROW, r"\1,\g<2>e2,\g<3>e2,\g<4>e2,\g<5>e2", 0),
        "identity: the same time twice": text(r"^(\d+),(.*)\n\d+,", r"\1,\2\n\1,"),
        "zero: quaternion of zeros": text(TABLE_ROW, r"\1,0,0,0,0"),
    },
    tolerance=1e-6,
)

# Gravity --------------------------------------------------------------------------------------------------------------

DEGREE = 12
FIELD = builtin_gravity()
AT_M = np.array([[1.77e6, 1e5, 2e5], [-9e5, 1.4e6, -7e5], [3e5, -4e5, 1.75e6]])


def coefficients() -> list[tuple[int, int, float, float]]:
    return [
        (n, m, FIELD.c_bar[n, m], FIELD.s_bar[n, m]) for n in range(2, DEGREE + 1) for m in range(n + 1)
    ]


def icgem(folder: Path) -> Path:
    head = (
        f"modelname TEST\nearth_gravity_constant {FIELD.gm_m3_s2:.12e}\nradius {FIELD.radius_m:.6e}\n"
        f"max_degree {DEGREE}\nnorm fully_normalized\ntide_system zero_tide\nend_of_head\ngfc 0 0 1.0 0.0\n"
    )
    path = folder / "field.gfc"
    path.write_text(head + "".join(f"gfc {n} {m} {c:.15e} {s:.15e}\n" for n, m, c, s in coefficients()))
    return path


def shadr(folder: Path) -> Path:
    path = folder / "field.sha"
    head = f"{FIELD.radius_m / 1e3:.6E}, {FIELD.gm_m3_s2 / 1e9:.15E}, 0.0, {DEGREE}, {DEGREE}, 1, 0.0, 0.0\n"
    path.write_text(head + "".join(f"{n}, {m}, {c:.15E}, {s:.15E}, 0, 0\n" for n, m, c, s in coefficients()))
    return path


def cof(folder: Path) -> Path:
    path = folder / "field.cof"
    head = f"POTFIELD {DEGREE} {DEGREE}  0 {FIELD.gm_m3_s2:.14e} {FIELD.radius_m:.14e} 1.00000000000000e+00\n"
    rows = "".join(f"RECOEF  {n:3d}{m:3d}   {c:21.14e}{s:21.14e}\n" for n, m, c, s in coefficients())
    path.write_text(head + rows + "END\n")
    return path


def shtools(folder: Path) -> Path:
    path = folder / "field.txt"
    head = f"{FIELD.radius_m:.6e}, {FIELD.gm_m3_s2:.12e}, 2.66e-06, {DEGREE}\n0, 0, 1.0, 0.0\n"
    path.write_text(head + "".join(f"{n}, {m}, {c:.15e}, {s:.15e}\n" for n, m, c, s in coefficients()))
    return path


def pull(path: Path) -> tuple[Any, str]:
    field = load_gravity(path)
    return acceleration(field, AT_M), field.words


def terms(change: Callable[[int, int, float, float], tuple[Any, Any, Any, Any]], row: str) -> Edit:
    """Change degree, order and coefficients of the rows of a field, which `row` finds with its beginning."""

    def edit(path: Path) -> None:
        def changed(found: re.Match[str]) -> str:
            n, m, c, s = change(int(found[2]), int(found[3]), float(found[5]), float(found[7]))
            return f"{found[1]}{n}{found[0][found.end(2) - found.start():found.start(3) - found.start()]}{m}{found[4]}{c:.15e}{found[6]}{s:.15e}"

        path.write_text(re.sub(row, changed, path.read_text(), flags=re.MULTILINE))

    return edit


def gravity_changes(row: str) -> dict[str, Edit]:
    unnormalised = {
        (n, m): math.sqrt((2 - (m == 0)) * (2 * n + 1) * math.factorial(n - m) / math.factorial(n + m))
        for n in range(DEGREE + 1)
        for m in range(n + 1)
    }
    return {
        label: terms(change, row)
        for label, change in {
            "scale: coefficients not normalised": lambda n, m, c, s: (
                n, m, c * unnormalised[n, m], s * unnormalised[n, m],
            ),
            "scale: coefficients times a thousand": lambda n, m, c, s: (n, m, 1e3 * c, 1e3 * s),
            "scale: coefficients above degree 2 times ten": lambda n, m, c, s: (n, m, c * (1 + 9 * (n > 2)), s * (1 + 9 * (n > 2))),
            "scale: one coefficient times a thousand": lambda n, m, c, s: (n, m, c * (1 + 999 * ((n, m) == (7, 1))), s),
            "sign: all coefficients": lambda n, m, c, s: (n, m, -c, -s),
            "sign: sine terms (longitudes to the west)": lambda n, m, c, s: (n, m, c, -s),
            "sign: zonal terms (J in place of C)": lambda n, m, c, s: (n, m, -c if m == 0 else c, s),
            "sign: Condon-Shortley phase": lambda n, m, c, s: (n, m, c * (-1) ** m, s * (-1) ** m),
            "sign: north and south": lambda n, m, c, s: (n, m, c * (-1) ** (n + m), s * (-1) ** (n + m)),
            "order: sine before cosine": lambda n, m, c, s: (n, m, s, c),
            "order: order before degree": lambda n, m, c, s: (m, n, c, s),
            "frame: longitudes from another meridian": lambda n, m, c, s: (
                n, m,
                c * math.cos(m * math.pi / 2) + s * math.sin(m * math.pi / 2),
                s * math.cos(m * math.pi / 2) - c * math.sin(m * math.pi / 2),
            ),
            "zero: degrees from 1 less": lambda n, m, c, s: (n - 1 if n > 2 else n, m, c, s),
            "zero: sine terms of zero": lambda n, m, c, s: (n, m, c, 0.0),
            "identity: one degree and order twice": lambda n, m, c, s: ((3, 1) if (n, m) == (3, 2) else (n, m)) + (c, s),
        }.items()
    }  # fmt: skip


NUMBER = r"\s*([-+.\deE]+)"
GRAVITY = {
    "gravity, ICGEM": Reader(icgem, pull, {
        "unit: GM in km3/s2": text(r"constant 4.9(\d+)e\+12", r"constant 4.9\1e+03"),
        "unit: radius in km": text(r"radius 1.7(\d+)e\+06", r"radius 1.7\1e+03"),
        "scale: radius of the Earth": text("radius 1.7\\d+e", "radius 6.378137e"),
        "scale: GM of the Earth": text(r"constant \S+", "constant 3.986004415e14"),
        "scale: radius of the mean sphere": text(r"radius \S+", "radius 1.737400e+06"),
        "scale: norm": text("fully_normalized", "unnormalized"),
        "identity: modelname": text("TEST", "OTHER"),
        "zero: max_degree": text("max_degree 12", "max_degree 6"),
        **gravity_changes(rf"^(gfc\s+)(\d+)\s+(\d+)(\s)\s*([-+.\deE]+)(\s){NUMBER}"),
    }, 1e-12),
    "gravity, SHADR": Reader(shadr, pull, {
        "unit: radius in m": text(r"^1.73\d+E\+03", "1.738E+06"),
        "unit: GM in m3/s2": text(r"E\+03, 0.0", "E+12, 0.0"),
        "scale: normalisation state": text("12, 12, 1,", "12, 12, 0,"),
        "order: GM before radius": text(r"^([^,]+), ([^,]+),", r"\2, \1,"),
        **gravity_changes(r"^()(\d+), (\d+)(, )([-+.\deE]+)(, )([-+.\deE]+)(?=, 0)"),
    }, 1e-12),
    "gravity, GMAT": Reader(cof, pull, {
        "unit: GM in km3/s2": text(r"e\+12", "e+03"),
        "unit: radius in km": text(r"e\+06", "e+03"),
        "scale: normalisation flag": text("1.00000000000000e.00$", "0.00000000000000e+00"),
        "order: GM after radius": text(r"(4.9\S+) (1.7\S+)", r"\2 \1"),
    }, 1e-12),
    "gravity, pyshtools": Reader(shtools, pull, {
        "unit: radius in km, GM in m": text(r"e\+06,", "e+03,"),
        "unit: radius and GM in km": lambda path: (
            text(r"e\+06,", "e+03,")(path), text(r"e\+12,", "e+03,")(path), None)[2],
        "unit: GM in km": text(r"e\+12,", "e+03,"),
        "zero: central term": text("^0, 0, 1.0", "0, 0, 0.0"),
        "scale: degree": text("12\n0, 0", "13\n0, 0"),
    }, 1e-12),
}  # fmt: skip

# Craters --------------------------------------------------------------------------------------------------------------


def craters() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    diameter_m = 3_000.0 * (1.0 - rng.random(60)) ** -0.5
    return {
        "id": np.arange(60.0),
        "latitude": rng.uniform(20.0, 24.0, 60),
        "longitude": rng.uniform(250.0, 254.0, 60),
        "diameter_m": diameter_m,
        "rim_height_m": rng.normal(-1_000.0, 800.0, 60),
        "depth_m": 0.08 * diameter_m,
        "complete": np.ones(60),
    }


def list_of(names: dict[str, str], change: Callable[[dict[str, np.ndarray]], Any] = lambda c: None) -> str:
    """Return a list of craters with columns by name of the file; a name ending in km has the diameter in km."""
    columns = craters()
    change(columns)
    columns["source"] = np.zeros(60)
    rows = [",".join(names)]
    for k in range(60):
        scale = {"km": 1e-3}
        rows.append(
            ",".join(
                f"{columns[key.removesuffix(' km')][k] * scale.get(key[-2:], 1.0):.9g}" for key in names.values()
            )
        )
    return "\n".join(rows) + "\n"


LISTS = {
    "craters, own": {
        "id": "id", "latitude_deg": "latitude", "longitude_deg": "longitude", "diameter_m": "diameter_m",
        "rim_height_m": "rim_height_m", "depth_m": "depth_m", "complete": "complete",
    },
    "craters, LU1319381": {
        "id": "id", "longitude_deg": "longitude", "latitude_deg": "latitude", "diameter_m": "diameter_m",
        "depth_m": "depth_m",
    },
    "craters, composite": {
        "latitude_deg": "latitude", "longitude_deg": "longitude", "diameter_km": "diameter_m km", "source": "source",
        "tile_complete": "complete",
    },
    "craters, Robbins": {"lat": "latitude", "lon": "longitude", "diam": "diameter_m km"},
    "craters, Robbins whole": {
        "LAT_CIRC_IMG": "latitude", "LON_CIRC_IMG": "longitude", "DIAM_CIRC_IMG": "diameter_m km",
    },
}  # fmt: skip


def times_of(name: str, factor: float, plus: float = 0.0) -> Callable[[dict[str, np.ndarray]], None]:
    def change(columns: dict[str, np.ndarray]) -> None:
        columns[name] = columns[name] * factor + plus

    return change


def exchanged(columns: dict[str, np.ndarray]) -> None:
    columns["latitude"], columns["longitude"] = columns["longitude"], columns["latitude"]


def one_twice(columns: dict[str, np.ndarray]) -> None:
    columns["id"][5] = columns["id"][4]


def one_wrong(name: str, factor: float) -> Callable[[dict[str, np.ndarray]], None]:
    def change(columns: dict[str, np.ndarray]) -> None:
        columns[name][7] *= factor

    return change


LIST_CHANGES: dict[str, tuple[str, Callable[[dict[str, np.ndarray]], None]]] = {
    "unit: latitudes in radians": ("latitude", times_of("latitude", math.pi / 180)),
    "unit: longitudes in radians": ("longitude", times_of("longitude", math.pi / 180)),
    "unit: longitudes in hours": ("longitude", times_of("longitude", 1 / 15)),
    "unit: diameters times a thousand": ("diameter_m", times_of("diameter_m", 1e3)),
    "unit: diameters by a thousand": ("diameter_m", times_of("diameter_m", 1e-3)),
    "scale: radii in place of diameters": ("diameter_m", times_of("diameter_m", 0.5)),
    "unit: depths in km": ("depth_m", times_of("depth_m", 1e-3)),
    "unit: depths in mm": ("depth_m", times_of("depth_m", 1e3)),
    "unit: depths in feet": ("depth_m", times_of("depth_m", 3.28084)),
    "sign: depths": ("depth_m", times_of("depth_m", -1.0)),
    "unit: rim heights in km": ("rim_height_m", times_of("rim_height_m", 1e-3)),
    "unit: rim heights in feet": ("rim_height_m", times_of("rim_height_m", 3.28084)),
    "sign: rim heights": ("rim_height_m", times_of("rim_height_m", -1.0)),
    "zero: rim heights from the centre": ("rim_height_m", times_of("rim_height_m", 1.0, 1_737_400.0)),
    "sign: longitudes to the west": ("longitude", times_of("longitude", -1.0)),
    "sign: latitudes": ("latitude", times_of("latitude", -1.0)),
    "zero: longitudes from -180 to 180": ("longitude", times_of("longitude", 1.0, -360.0)),
    "zero: longitudes from the far side": ("longitude", times_of("longitude", 1.0, -180.0)),
    "zero: colatitudes": ("latitude", times_of("latitude", -1.0, 90.0)),
    "order: latitudes and longitudes": ("latitude", exchanged),
    "identity: one id twice": ("id", one_twice),
    "identity: fractional ids": ("id", times_of("id", 0.1)),
    "scale: one diameter times a thousand": ("diameter_m", one_wrong("diameter_m", 1e3)),
    "scale: one diameter by a hundred": ("diameter_m", one_wrong("diameter_m", 0.01)),
    "scale: one depth times ten": ("depth_m", one_wrong("depth_m", 10.0)),
    "sign: one depth": ("depth_m", one_wrong("depth_m", -1.0)),
    "unit: flags in per cent": ("complete", times_of("complete", 100.0)),
}


def catalogue_figures(path: Path) -> tuple[Any, str]:
    found = load_catalogue(path)
    columns = (found.latitude_rad, found.longitude_rad, found.diameter_m, found.depth_m, found.rim_height_m)
    return np.column_stack([*columns, found.complete]), catalogue_words(found)


def list_reader(names: dict[str, str]) -> Reader:
    def write(folder: Path) -> Path:
        path = folder / "craters.csv"
        path.write_text(list_of(names))
        return path

    changes: dict[str, Edit] = {
        label: lambda path, change=change: (path.write_text(list_of(names, change)), None)[1]
        for label, (column, change) in LIST_CHANGES.items()
        if any(column == key.removesuffix(" km") for key in names.values())
    }
    reverse = dict(reversed(names.items()))
    changes["order: columns with their names"] = lambda path: (path.write_text(list_of(reverse)), None)[1]
    first = next(iter(names))
    changes["identity: a column of another name"] = text(f"^{first}", f"{first}_x")
    changes["identity: a row twice"] = text(r"^(.*)\Z".replace(r"\Z", r"\n(?=[^\n]+\n\Z)"), r"\1\n\1\n")
    return Reader(write, catalogue_figures, changes, tolerance=2e-6)


# Rasters --------------------------------------------------------------------------------------------------------------


def raster(**form: Any) -> Callable[[Path], Path]:
    from tests.payload_emulator.sim.test_terrain_formats import write_form

    return lambda path: write_form(path, **form)

READERS: dict[str, Reader] = (
    ORBITS
    | {"attitudes (AEM)": ATTITUDES, "attitudes (table)": ATTITUDE_TABLE}
    | GRAVITY
    | {name: list_reader(names) for name, names in LISTS.items()}
)


def outcome(reader: Reader, edit: Edit | None, folder: Path) -> str:
    """Return "refused: why", "same", "stated: words", or "SILENT: difference" of a changed file."""
    path = reader.write(folder)
    before, words = reader.figures(path)
    if edit is None:
        return "same"
    edit(path)
    try:
        after, now = reader.figures(path)
    except REFUSALS as error:
        return f"refused: {str(error).replace(str(folder), '')[:150]}"
    before, after = (np.asarray(one, dtype=np.float64) for one in (before, after))
    if before.shape == after.shape and np.allclose(before, after, rtol=0.0, atol=reader.tolerance, equal_nan=True):
        return "same"
    if now != words:
        return f"stated: {now[:150]}"
    return f"SILENT: {np.nanmax(np.abs(before - after)) if before.shape == after.shape else after.shape}"


CASES = [(name, label) for name, reader in READERS.items() for label in reader.changes]


@pytest.mark.parametrize(("name", "label"), CASES)
def test_a_changed_field_never_gives_other_figures_in_silence(name: str, label: str, tmp_path: Path) -> None:
    found = outcome(READERS[name], READERS[name].changes[label], tmp_path)
    assert not found.startswith("SILENT"), found


def main() -> None:
    counts: dict[str, int] = {}
    for name, label in CASES:
        with tempfile.TemporaryDirectory() as folder:
            found = outcome(READERS[name], READERS[name].changes[label], Path(folder))
        counts[found.partition(":")[0]] = counts.get(found.partition(":")[0], 0) + 1
        print(f"{name:<20} {label:<50} {found}")
    print(f"{len(CASES)} changed inputs of {len(READERS)} readers:", counts)


if __name__ == "__main__":
    sys.exit(main())
