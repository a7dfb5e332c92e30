"""Valid files of every reader with one field changed: unit, zero, scale, order, sign, frame, time scale or identity.

Such a file is refused, gives the same figures, or the words that the product prints with the figures name the field:
other figures in silence are a fault. `python -m tests.test_changed_inputs` prints the table of all of them.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
from tmtc.downlink import decode, encode_cadus
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


def text(pattern: str, new: str | Callable[[re.Match[str]], str], count: int = 1) -> Edit:
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
    "zero: centre of the Earth": lambda t, x: x + np.array([3.6e8, 1e8, 5e7, -250.0, 900.0, 300.0]),
    "zero: x moved by 10 km": lambda t, x: x + np.array([1e4, 0, 0, 0, 0, 0]),
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
    "frame: velocities relative to the ground": lambda t, x: (
        x - np.hstack([0 * x[:, :3], np.cross([0, 0, 2.6617e-4], x[:, :3])])
    ),
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
        path.write_text(
            written if stated else written.replace(f"TIME_SYSTEM = {system}", "TIME_SYSTEM = UTC")
        )

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
    "unit: epoch of one state in another form": text("^2029-08-07T00:30:00.000", "2029-219T00:30:00.000"),
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
        rows.append(
            f"{count / 864e11 + 2440587.5:.9f}, {day}, " + ", ".join(f"{a:.12e}" for a in (*x, *v)) + ","
        )
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
    "order: columns with their values": text(
        r"^(JDTDB|2\d{6}\.\d+), ([^,]+), ([^,]+), ([^,]+),", r"\1, \2, \4, \3,", 0
    ),
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
        "unit: angles in place of quaternions": text(
            "ATTITUDE_TYPE = QUATERNION", "ATTITUDE_TYPE = EULER_ANGLE"
        ),
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
        path.write_text(
            re.sub(r"^\d+", lambda found: str(round(int(found[0]) * factor)), path.read_text(), flags=re.M)
        )

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
    return [(n, m, FIELD.c_bar[n, m], FIELD.s_bar[n, m]) for n in range(2, DEGREE + 1) for m in range(n + 1)]


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
            between = found[0][found.end(2) - found.start() : found.start(3) - found.start()]
            return f"{found[1]}{n}{between}{m}{found[4]}{c:.15e}{found[6]}{s:.15e}"

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
            "scale: coefficients above degree 2 times ten": lambda n, m, c, s: (
                n, m, c * (1 + 9 * (n > 2)), s * (1 + 9 * (n > 2)),
            ),
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
            "identity: one degree and order twice": lambda n, m, c, s: (
                *((3, 1) if (n, m) == (3, 2) else (n, m)), c, s,
            ),
        }.items()
    }  # fmt: skip


NUMBER = r"\s*([-+.\deE]+)"
GRAVITY = {
    "gravity ICGEM": Reader(icgem, pull, {
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
    "gravity SHADR": Reader(shadr, pull, {
        "unit: radius in m": text(r"^1.73\d+E\+03", "1.738E+06"),
        "unit: GM in m3/s2": text(r"E\+03, 0.0", "E+12, 0.0"),
        "scale: normalisation state": text("12, 12, 1,", "12, 12, 0,"),
        "order: GM before radius": text(r"^([^,]+), ([^,]+),", r"\2, \1,"),
        **gravity_changes(r"^()(\d+), (\d+)(, )([-+.\deE]+)(, )([-+.\deE]+)(?=, 0)"),
    }, 1e-12),
    "gravity GMAT": Reader(cof, pull, {
        "unit: GM in km3/s2": text(r"e\+12", "e+03"),
        "unit: radius in km": text(r"e\+06", "e+03"),
        "scale: normalisation flag": text("1.00000000000000e.00$", "0.00000000000000e+00"),
        "order: GM after radius": text(r"(4.9\S+) (1.7\S+)", r"\2 \1"),
    }, 1e-12),
    "gravity pyshtools": Reader(shtools, pull, {
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
                f"{columns[key.removesuffix(' km')][k] * scale.get(key[-2:], 1.0):.9g}"
                for key in names.values()
            )
        )
    return "\n".join(rows) + "\n"


LISTS = {
    "craters own": {
        "id": "id", "latitude_deg": "latitude", "longitude_deg": "longitude", "diameter_m": "diameter_m",
        "rim_height_m": "rim_height_m", "depth_m": "depth_m", "complete": "complete",
    },
    "craters LU1319381": {
        "id": "id", "longitude_deg": "longitude", "latitude_deg": "latitude", "diameter_m": "diameter_m",
        "depth_m": "depth_m",
    },
    "craters composite": {
        "latitude_deg": "latitude", "longitude_deg": "longitude", "diameter_km": "diameter_m km", "source": "source",
        "tile_complete": "complete",
    },
    "craters Robbins": {"lat": "latitude", "lon": "longitude", "diam": "diameter_m km"},
    "craters Robbins whole": {
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


def form(**changes: Any) -> Edit:
    from tests.payload_emulator.sim.test_terrain_formats import write_form

    return lambda path: (write_form(path, **changes), None)[1]


def raster(folder: Path) -> Path:
    path = folder / "heights.tif"
    form()(path)
    return path


def heights(path: Path) -> tuple[Any, str]:
    """Heights as the curation of craters and the emulator take them, with the words that both print."""
    found = RasterHeights([path])
    terrain = RasterTerrain([path], NO_CRATERS, sharpen=False, registration_north_m=0.0, smoothing_pixels=0.0)
    figures = terrain.height_m(*np.radians(PLACES))
    found.window(73.0, 80.0, 11.0, 24.0)
    return figures, "; ".join(found.readings)


NO_CRATERS = make_catalogue([], [], [], source="none")
PLACES = np.array([[75.3, 77.1, 78.9], [12.7, 16.2, 23.4]])
DEGREE_M = math.radians(1_737_400.0)
RASTERS = Reader(
    raster,
    heights,
    {
        "unit: km, not stated": form(convert=lambda h: h / 1e3),
        "unit: km, stated": form(convert=lambda h: h / 1e3, unit="km"),
        "unit: km stated, values in m": form(unit="km"),
        "unit: feet, not stated": form(convert=lambda h: h / 0.3048),
        "unit: feet, stated": form(convert=lambda h: h / 0.3048, unit="ft"),
        "unit: half metres, not stated": form(convert=lambda h: 2 * h),
        "unit: half metres in a scale tag": form(
            convert=lambda h: np.rint(2 * h), dtype="int16", scales=(0.5, 0.0)
        ),
        "unit: double metres, not stated": form(convert=lambda h: h / 2),
        "unit: dm, not stated": form(convert=lambda h: 10 * h),
        "unit: cm, not stated": form(convert=lambda h: 100 * h),
        "unit: mm, not stated": form(convert=lambda h: 1000 * h),
        "unit: dm, stated": form(convert=lambda h: 10 * h, unit="dm"),
        "unit: K": form(unit="K"),
        "unit: degrees of slope": form(convert=lambda h: np.abs(h) % 30, unit="deg"),
        "zero: radii in m": form(convert=lambda h: h + 1_737_400.0),
        "zero: radii in km": form(convert=lambda h: h / 1e3 + 1_737.4, dtype="float64"),
        "zero: radii in an offset tag": form(scales=(1.0, 1_737_400.0)),
        "zero: above a sphere of 1738 km": form(convert=lambda h: h - 600.0),
        "zero: above a sphere of 1738 km, stated": form(crs="+proj=longlat +R=1738000 +no_defs"),
        "zero: above the geoid, 20 km off": form(convert=lambda h: h + 2e4),
        "zero: of an ellipsoid": form(crs="+proj=longlat +a=1738100 +b=1736000 +no_defs"),
        "zero: of the Earth": form(crs="EPSG:4326"),
        "zero: of Mars": form(crs="+proj=longlat +R=3396190 +no_defs"),
        "scale: tag of 2": form(convert=np.rint, dtype="int16", scales=(2.0, 0.0)),
        "scale: tag of 0.5": form(convert=np.rint, dtype="int16", scales=(0.5, 0.0)),
        "scale: tag of 1000": form(convert=np.rint, dtype="int16", scales=(1000.0, 0.0)),
        "scale: degrees of coordinates in a projection": form(crs="+proj=eqc +R=1737400"),
        "scale: coordinates in km": form(crs="+proj=eqc +R=1737400 +units=km", scale=DEGREE_M / 1e3),
        "scale: coordinates in m": form(crs="+proj=eqc +R=1737400", scale=DEGREE_M),
        "scale: coordinates in radians": form(scale=math.pi / 180),
        "order: rows from the south": form(high=-1 / 16),
        "order: pixels that are not square": form(high=1 / 32),
        "sign: depths in place of heights": form(convert=lambda h: -h),
        "sign: western longitudes": form(west=-350.0),
        "frame: longitudes beyond a turn": form(west=370.0),
        "frame: another middle meridian": form(
            crs="+proj=eqc +R=1737400 +lon_0=180", scale=DEGREE_M, west=-170.0
        ),
        "frame: longitudes to the west": form(west=-25.0),
        "identity: bands": form(count=2),
        "identity: a picture of 8 bits": form(convert=lambda h: h / 20 + 120, dtype="uint8"),
        "zero: no data of -32768, not stated": form(convert=np.rint, dtype="int16", edge=-32768),
        "zero: no data of 1e20, not stated": form(edge=1e20),
        "zero: no data of 0 with a mask": form(edge=0.0, mask=True),
        "zero: no data stated": form(edge=5.0, nodata=5.0),
    },
    tolerance=1.0,
)


def polar(
    crs: str = "+proj=stere +lat_0=90 +R=1737400", step: float = 2_000.0, true: str = "", **changes: Any
) -> Edit:
    """Write a polar stereographic map of the same ground; `true` is the projection of its values."""
    from rasterio import Affine, warp
    from rasterio import crs as systems

    from tests.payload_emulator.sim.test_terrain_formats import ground, write_tiff

    own = true or "+proj=stere +lat_0=90 +R=1737400"

    def edit(path: Path) -> None:
        size, pixel = 250, 2_000.0
        column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
        x, y = pixel * (column - 20.0).ravel(), -pixel * (row + 130.0).ravel()
        sphere = systems.CRS.from_string("+proj=longlat +R=1737400 +no_defs")
        east, north = map(np.array, warp.transform(systems.CRS.from_string(own), sphere, x, y))
        values = changes.get("convert", lambda h: h)(ground(north, east).reshape(size, size))
        transform = Affine(step, 0, -20 * step, 0, -step, -130 * step)
        settings = {"nodata": changes["nodata"]} if "nodata" in changes else {}
        write_tiff(path, transform, values.astype("float32"), crs, **settings)
        if "unit" in changes:
            import rasterio

            with rasterio.open(path, "r+") as target:
                target.units = (changes["unit"],)

    return edit


POLAR_PLACES = np.array([[76.5, 77.5, 78.5], [8.0, 16.2, 25.0]])


def polar_heights(path: Path) -> tuple[Any, str]:
    found = RasterHeights([path])
    terrain = RasterTerrain([path], NO_CRATERS, sharpen=False, registration_north_m=0.0, smoothing_pixels=0.0)
    figures = terrain.height_m(*np.radians(POLAR_PLACES))
    found.window(76.5, 79.0, 8.0, 25.0)
    return figures, "; ".join(found.readings)


def polar_map(folder: Path) -> Path:
    path = folder / "polar.tif"
    polar()(path)
    return path


STERE = "+proj=stere +lat_0=90 +R=1737400"
POLAR = Reader(
    polar_map,
    polar_heights,
    {
        "unit: coordinates in km, stated": polar(f"{STERE} +units=km", step=2.0),
        "unit: coordinates in km, not stated": polar(step=2.0),
        "unit: coordinates in m, km stated": polar(f"{STERE} +units=km"),
        "unit: heights in km, stated": polar(convert=lambda h: h / 1e3, unit="km"),
        "unit: heights in km, not stated": polar(convert=lambda h: h / 1e3),
        "unit: heights in feet, not stated": polar(convert=lambda h: h / 0.3048),
        "unit: heights in half metres, not stated": polar(convert=lambda h: 2 * h),
        "zero: radii in m": polar(convert=lambda h: h + 1_737_400.0),
        "zero: radii in km": polar(convert=lambda h: h / 1e3 + 1_737.4),
        "zero: of another sphere": polar("+proj=stere +lat_0=90 +R=1738000"),
        "zero: of an ellipsoid": polar("+proj=stere +lat_0=90 +a=1738100 +b=1736000"),
        "zero: of the Earth": polar("EPSG:3413"),
        "sign: the other pole": polar("+proj=stere +lat_0=-90 +R=1737400"),
        "frame: another meridian down": polar(f"{STERE} +lon_0=90"),
        "frame: another meridian down, values too": polar(f"{STERE} +lon_0=10", true=f"{STERE} +lon_0=10"),
        "scale: true at another latitude": polar(f"{STERE} +lat_ts=70"),
        "scale: pixels of 1 km": polar(step=1_000.0),
        "frame: another projection": polar("+proj=laea +lat_0=90 +R=1737400"),
        "zero: no data stated": polar(nodata=-9999.0),
    },
    tolerance=2.0,
)

# Labels and pictures --------------------------------------------------------------------------------------------------


def labels() -> dict[str, Any]:
    rng = np.random.default_rng(5)
    boxes = [
        [float(x), float(y), float(w), float(w)]
        for x, y, w in zip(
            rng.uniform(10, 400, 30), rng.uniform(10, 400, 30), rng.uniform(9, 60, 30), strict=True
        )
    ]
    return {
        "images": [
            {
                "id": 7,
                "file_name": "a.png",
                "width": 512,
                "height": 480,
                "sun_azimuth_deg": 30.0,
                "pixel_m": 90.0,
            }
        ],
        "annotations": [
            {"id": k, "image_id": 7, "category_id": 1 if k % 3 else 2, "bbox": box}
            for k, box in enumerate(boxes)
        ],
        "categories": [{"id": 1, "name": "crater"}, {"id": 2, "name": "boulder"}],
    }


def coco(folder: Path) -> Path:
    import cv2

    cv2.imwrite(str(folder / "a.png"), np.full((480, 512), 99, np.uint8))
    path = folder / "labels.json"
    path.write_text(json.dumps(labels()))
    return path


def tree(change: Callable[[dict[str, Any]], Any]) -> Edit:
    """Change a JSON document."""

    def edit(path: Path) -> None:
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    return edit


def every(change: Callable[[list[float]], list[float]]) -> Edit:
    def edit(document: dict[str, Any]) -> None:
        for item in document["annotations"]:
            item["bbox"] = change(item["bbox"])

    return tree(edit)


def of_polygons(document: dict[str, Any]) -> None:
    for item in document["annotations"]:
        x, y, w, h = item.pop("bbox")
        item["segmentation"] = [[x, y, x + w, y, x + w, y + h, x, y + h]]


def labelled(path: Path) -> tuple[Any, str]:
    (picture,) = load_pictures(path.parent)
    rows = [picture.u_px, picture.v_px, picture.diameter_px, picture.crowd.astype(float)]
    stated = [picture.sun_azimuth_deg, picture.pixel_m, picture.altitude_km]
    craters = np.count_nonzero(~picture.crowd)
    words = "; ".join([f"{craters} labelled craters", *set_words([picture])])
    return np.concatenate([np.sort(np.array(rows), axis=1).ravel(), stated]), words


def at(path: str, value: Any) -> Edit:
    """Set a value in a JSON document by a path such as images/0/id; None removes it."""
    *keys, last = [int(key) if key.isdigit() else key for key in path.split("/")]

    def edit(document: Any) -> None:
        for key in keys:
            document = document[key]
        document[last] = value
        if value is None:
            del document[last]

    return tree(edit)


COCO = Reader(
    coco,
    labelled,
    {
        "unit: boxes from 0 to 1": every(lambda b: [b[0] / 512, b[1] / 480, b[2] / 512, b[3] / 480]),
        "unit: boxes in per cent": every(lambda b: [b[0] / 5.12, b[1] / 4.8, b[2] / 5.12, b[3] / 4.8]),
        "unit: boxes of an image of twice the size": every(lambda b: [2 * v for v in b]),
        "order: boxes as two corners": every(lambda b: [b[0], b[1], b[0] + b[2], b[1] + b[3]]),
        "order: boxes as centre and size": every(lambda b: [b[0] + b[2] / 2, b[1] + b[3] / 2, b[2], b[3]]),
        "order: boxes as y, x, height, width": every(lambda b: [b[1], b[0], b[3], b[2]]),
        "sign: boxes of negative height": every(lambda b: [b[0], b[1] + b[3], b[2], -b[3]]),
        "zero: boxes of no size": every(lambda b: [b[0], b[1], 0, 0]),
        "zero: one box outside": at("annotations/1/bbox", [900, 900, 20, 20]),
        "unit: polygons in place of boxes": tree(of_polygons),
        "identity: category of one label": at("annotations/1/category_id", 2),
        "identity: categories exchanged": tree(
            lambda d: [item.update(id=3 - item["id"]) for item in d["categories"]]
        ),
        "identity: unknown category": at("annotations/1/category_id", 9),
        "identity: no category of craters": at("categories/0/name", "rock"),
        "identity: image id": at("images/0/id", 8),
        "identity: fractional image id": at("images/0/id", 7.5),
        "identity: image id as a text": at("images/0/id", "7"),
        "identity: one label id twice": at("annotations/1/id", 0),
        "identity: a label twice": tree(lambda d: d["annotations"].append(d["annotations"][1] | {"id": 99})),
        "identity: category id twice": at("categories/1/id", 1),
        "order: width and height": tree(lambda d: d["images"][0].update(width=480, height=512)),
        "scale: width": at("images/0/width", 1024),
        "unit: Sun in radians": at("images/0/sun_azimuth_deg", 0.5236),
        "sign: Sun": at("images/0/sun_azimuth_deg", -30.0),
        "zero: Sun by a turn": at("images/0/sun_azimuth_deg", 390.0),
        "unit: Sun as a text": at("images/0/sun_azimuth_deg", "30"),
        "unit: scale in km": at("images/0/pixel_m", 0.09),
        "sign: scale": at("images/0/pixel_m", -90.0),
        "unit: altitude in m": at("images/0/altitude_km", 30000.0),
        "identity: crowd": at("annotations/1/iscrowd", 1),
        "scale: area": at("annotations/1/area", 1.0),
        "scale: score": at("annotations/1/score", 0.1),
        "zero: file of another name": at("images/0/file_name", "b.png"),
    },
)


def shades() -> np.ndarray:
    return (np.random.default_rng(2).random((48, 64)) ** 2 * 60_000).astype(np.uint16)


def picture(folder: Path) -> Path:
    path = folder / "a.tif"
    save_picture(lambda a: a)(path)
    return path


def save_picture(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    import cv2

    return lambda path: (cv2.imwrite(str(path), np.ascontiguousarray(change(shades()))), None)[1]


def one_pixel(value: float, kind: type = np.float32) -> Callable[[np.ndarray], np.ndarray]:
    def change(pixels: np.ndarray) -> np.ndarray:
        out = (pixels / 60_000).astype(kind) if kind is np.float32 else pixels.copy()
        out[5, 6] = value
        return out

    return change


def seen(path: Path) -> tuple[Any, str]:
    """Median and spread of the shades, which decide what is found, and the remark that is printed."""
    image, remark = read_picture(path)
    prepared = prepare_image(image)
    plane = prepared.gray
    why = quality_reason(image, prepared.quality)
    return np.quantile(plane, [0.1, 0.5, 0.9]), f"{remark} {prepared.quality} {why}"


PICTURES = Reader(
    picture,
    seen,
    {
        "unit: 8 bits": save_picture(lambda a: (a >> 8).astype(np.uint8)),
        "unit: 12 in 16 bits": save_picture(lambda a: a >> 4),
        "unit: 14 in 16 bits": save_picture(lambda a: a >> 2),
        "unit: floating point": save_picture(lambda a: (a / 65_535).astype(np.float32)),
        "unit: percent": save_picture(lambda a: (a / 655.35).astype(np.float32)),
        "unit: counts in floating point": save_picture(lambda a: a.astype(np.float32)),
        "unit: colours": save_picture(lambda a: np.stack([a] * 3, axis=2)),
        "scale: one hot pixel": save_picture(one_pixel(300.0)),
        "zero: one pixel not a number": save_picture(one_pixel(math.nan)),
        "zero: one pixel of -3.4e38": save_picture(one_pixel(-3.4e38)),
        "zero: one pixel of -32768": save_picture(one_pixel(-32768.0)),
        "zero: one pixel without end": save_picture(one_pixel(math.inf)),
        "zero: all black": save_picture(lambda a: 0 * a),
        "zero: all white": save_picture(lambda a: 0 * a + 65_535),
        "sign: negative": save_picture(lambda a: -(a / 65_535).astype(np.float32)),
    },
    tolerance=0.05,
)

# Packets of others ----------------------------------------------------------------------------------------------------


def bus(folder: Path) -> Path:
    """An XTCE document and packets of a bus."""
    from tests.tmtc import foreign as x

    types = x.HEADER_TYPES + x.calibrated("VOLT", 12, "unsigned", x.default(x.polynomial(-1.5, 0.25)))
    types += x.integer("I20", 20, "twosComplement") + x.floating("F32", 32) + x.integer("APID2", 11)
    types += (
        '<EnumeratedParameterType name="MODE"><UnitSet/><IntegerDataEncoding sizeInBits="8"/><EnumerationList>'
        '<Enumeration value="1" label="SAFE"/><Enumeration value="2" label="ON"/></EnumerationList>'
        "</EnumeratedParameterType>"
    )
    names = {"VOLTAGE": "VOLT", "OFFSET": "I20", "RATE": "F32", "STATE": "MODE"}
    packet = x.container("HK", list(names), "CCSDSPacket", x.comparison("PKT_APID", 100))
    path = folder / "bus.xml"
    path.write_text(x.document(types, x.HEADER_PARAMETERS | names, x.HEADER_CONTAINER + packet))
    octets = b""
    for k in range(20):
        body = ((100 + 7 * k) << 20 | (-5 * k & 0xFFFFF)).to_bytes(4, "big") + struct.pack(
            ">fB", 1.5 * k, 1 + k % 2
        )
        octets += struct.pack(">HHH", 100, 0xC000 | k, len(body) - 1) + body
    folder.joinpath("bus.bin").write_bytes(octets)
    return path


def decoded_bus(path: Path) -> tuple[Any, str]:
    """Values and accounting as `linna tm decode` and `check` print them."""
    options = ["--xtce", str(path), "--no-error-control", "--prefix-octets", "0"]
    recording = str(path.with_suffix(".bin"))
    records = json.loads(printed("tm", "decode", recording, *options))
    rows = [[one.get(key) for key in ("VOLTAGE", "OFFSET", "RATE", "STATE")] for one in records]
    states = {"SAFE": 1.0, "ON": 2.0}
    figures = [[states.get(v, v) if isinstance(v, str) else v for v in row] for row in rows]
    return np.array(figures, dtype=np.float64), printed("tm", "check", recording, *options)


def printed(*words: str) -> str:
    """Return what a command prints; its refusal is raised."""
    out, err = io.TextIOWrapper(io.BytesIO()), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = linna(list(words))
    out.seek(0)
    if status == 2:
        raise TmtcError(err.getvalue().strip())
    return out.read()


XTCE = Reader(
    bus,
    decoded_bus,
    {
        "unit: size of a value": text('sizeInBits="20"', 'sizeInBits="16"'),
        "unit: size of the last value": text(r'("MODE"><UnitSet/><Int\S+ sizeInBits=)"8"', r'\1"16"'),
        "zero: size of a value": text('sizeInBits="20"', 'sizeInBits="0"'),
        "sign: encoding unknown": text('encoding="twosComplement"', 'encoding="packedBCD"'),
        "order: bits reversed": text(
            'sizeInBits="20"', 'bitOrder="leastSignificantBitFirst" sizeInBits="20"'
        ),
        "scale: calibrator without terms": text("<Term.*/>", ""),
        "scale: an exponent twice": text('exponent="1"', 'exponent="0"'),
        "order: terms of the calibrator": text(r"(<Term[^>]*/>)(<Term[^>]*/>)", r"\2\1"),
        "scale: a calibrator that is not read": text("PolynomialCalibrator", "MathOperationCalibrator", 0),
        "unit: name of the unit": text("<Unit>V</Unit>", "<Unit>mV</Unit>"),
        "identity: APID of the packet": text(
            'parameterRef="PKT_APID" value="100"', 'parameterRef="PKT_APID" value="101"'
        ),
        "identity: one code of a state twice": text('value="2" label="ON"', 'value="1" label="ON"'),
        "identity: one name of a parameter twice": text('Parameter name="RATE"', 'Parameter name="OFFSET"'),
        "identity: type that is not there": text('parameterTypeRef="I20"', 'parameterTypeRef="I21"'),
        "identity: an entry of another name": text('parameterRef="RATE"', 'parameterRef="RATES"'),
        "identity: namespace of another version": text("20180204", "20250101"),
        "order: a value left out": text('<ParameterRefEntry parameterRef="RATE"/>', ""),
        "order: a value twice": text('(<ParameterRefEntry parameterRef="RATE"/>)', r"\1\1"),
        "zero: place beyond the packet": text(
            '<ParameterRefEntry parameterRef="STATE"/>',
            '<ParameterRefEntry parameterRef="STATE"><LocationInContainerInBits referenceLocation="containerStart">'
            "<FixedValue>4000</FixedValue></LocationInContainerInBits></ParameterRefEntry>",
        ),
        "unit: an element that is not read": text("<EntryList>", "<RateInStream/><EntryList>"),
    },
)


def recording(folder: Path) -> Path:
    from tests.tmtc.test_downlink import make_packets

    path = folder / "pass.cadu"
    path.write_bytes(encode_cadus(make_packets(60), spacecraft_id=76, frame_length=892))
    return path


def received(path: Path) -> tuple[Any, str]:
    """Octets of the packets, and the accounting that `linna tm check` prints."""
    found = decode(path.read_bytes())
    packets = [np.frombuffer(one, np.uint8).astype(np.float64) for one in found.cut.packets(found.buffer)]
    return np.concatenate([np.zeros(0), *packets]), printed("tm", "check", str(path))


def octets(change: Callable[[np.ndarray], Any]) -> Edit:
    """Change the octets of a file; a returned array takes their place."""

    def edit(path: Path) -> None:
        values = np.frombuffer(path.read_bytes(), np.uint8).copy()
        changed = change(values)
        path.write_bytes((values if changed is None else changed).tobytes())

    return edit


def cadus(**settings: Any) -> Edit:
    from tests.tmtc.test_downlink import make_packets

    return lambda path: (
        path.write_bytes(
            encode_cadus(make_packets(60), **({"spacecraft_id": 76, "frame_length": 892} | settings))
        ),
        None,
    )[1]


def flip(*places: int) -> Edit:
    def change(values: np.ndarray) -> None:
        values[list(places)] ^= 0x55

    return octets(change)


RECORDINGS = Reader(
    recording,
    received,
    {
        "scale: frame length": cadus(frame_length=1000),
        "unit: coding": cadus(coding="none"),
        "unit: randomiser": cadus(randomiser="none"),
        "unit: no checksum of frames": cadus(checksum=False),
        "identity: spacecraft": cadus(spacecraft_id=77),
        "sign: bits inverted": octets(lambda v: np.bitwise_not(v)),
        "order: octets of words exchanged": octets(
            lambda v: v[: len(v) // 2 * 2].reshape(-1, 2)[:, ::-1].copy()
        ),
        "order: bits of octets reversed": octets(
            lambda v: np.packbits(np.unpackbits(v).reshape(-1, 8)[:, ::-1])
        ),
        "order: second half first": octets(lambda v: np.concatenate([v[len(v) // 2 :], v[: len(v) // 2]])),
        "zero: a hundred octets lost": octets(lambda v: np.delete(v, np.arange(5000, 5100))),
        "zero: begins in a frame": octets(lambda v: v[700:]),
        "zero: octets before the first frame": octets(lambda v: np.concatenate([np.zeros(50, np.uint8), v])),
        "identity: everything twice": octets(lambda v: np.concatenate([v, v])),
        "scale: one octet": flip(3000),
        "scale: forty octets": flip(*range(3000, 3040)),
        "scale: a marker": flip(*range(1027 * 2, 1027 * 2 + 4)),
    },
)

# Tables of the ground -------------------------------------------------------------------------------------------------

MISSION_TOML = """name = "bus"
[spacecraft]
id = 76
name = "SELENITA"
[time]
epoch = "2000-01-01T00:00:00 TAI"
ticks_per_second = 65536
correlation = "automatic"
[camera]
width_px = 512
height_px = 512
fov_deg = 120.0
tilt_deg = 20.0
yaw_deg = 10.0
exposure_s = 0.01
frame_interval_s = 15.0
[catalogue]
registration_north_m = -59.0
registration_east_m = 12.0
registration_sigma_m = 15.0
[reference]
sigma_rtn_m = [10.0, 30.0, 15.0]
[frames]
gravity_degree = 100
[link]
frame_length = 1115
[link.stations.Madrid]
latitude_deg = 40.4
longitude_deg = 355.7
height_m = 700.0
minimum_elevation_deg = 10.0
downlink_bps = 256000.0
time_code = "cds"
time_offset = 0
header_octets = 8
outages = ["2029-08-10T00:00:00Z/2029-08-10T06:00:00Z"]
[observation]
latitude_limit_deg = 60.0
[evidence]
world = "real-terrain"
unseen_share = 0.5
trained_on = [{ boxes = [[0.0, 30.0, -10.0, 10.0]], buffer_km = 50.0 }]
[requirements]
median_error_m = 100.0
recall = 0.3
packets_percent = 99.9
temperature_max_c = 60.0
[resources]
storage_mib = 512.0
battery_wh = 40.0
minimum_battery = 0.3
observe_hours_per_day = 6.0
[[packets]]
name = "bus"
apids = [100, 101]
packet_checksum = "none"
[packets.time]
code = "cuc"
offset = 6
p_field = false
whole_octets = 4
fraction_octets = 2
epoch = "1980-01-06T00:00:00Z"
clock = "own"
"""


def toml(document: str, name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / name
        path.write_text(document)
        return path

    return write


def mission_values(path: Path) -> tuple[Any, str]:
    """Numbers of a mission description, and the words of `linna mission check`."""
    mission = parse_mission(path.read_text())
    return leaves(mission.model_dump(mode="json")), mission.words


def leaves(value: Any) -> list[float]:
    """Return the numbers in a tree of values; texts count by their hash."""
    if isinstance(value, dict):
        return [one for key in sorted(value) for one in leaves(value[key])]
    if isinstance(value, list):
        return [one for item in value for one in leaves(item)]
    return [float(value) if isinstance(value, (int, float)) else float(zlib.crc32(repr(value).encode()))]


def key(name: str, value: str) -> Edit:
    return text(rf"^{name} = .*$", f"{name} = {value}")


MISSIONS = Reader(
    toml(MISSION_TOML, "mission.toml"),
    mission_values,
    {
        "identity: id of the spacecraft": key("id", "1024"),
        "identity: id as a text": key("id", '"76"'),
        "unit: field of view in radians": key("fov_deg", "2.0944"),
        "unit: field of view in arc minutes": key("fov_deg", "7200.0"),
        "zero: field of view": key("fov_deg", "0.0"),
        "zero: width": key("width_px", "0"),
        "scale: width": key("width_px", "512000"),
        "unit: tilt in arc minutes": key("tilt_deg", "1200.0"),
        "unit: yaw beyond a turn": key("yaw_deg", "3600.0"),
        "unit: exposure in ms": key("exposure_s", "10.0"),
        "unit: exposure in us": key("exposure_s", "10000.0"),
        "unit: interval in ms": key("frame_interval_s", "15000.0"),
        "sign: exposure": key("exposure_s", "-0.01"),
        "unit: registration in km": key("registration_north_m", "-59000.0"),
        "unit: reference error in km": key("sigma_rtn_m", "[0.01, 0.03, 0.015]"),
        "unit: reference error in mm": key("sigma_rtn_m", "[10000000.0, 30000000.0, 15000000.0]"),
        "order: reference error without a part": key("sigma_rtn_m", "[10.0, 30.0]"),
        "time scale: epoch without a scale": text('^epoch = "2000.*', 'epoch = "2000-01-01T00:00:00"'),
        "time scale: epoch in TDB": text('^epoch = "2000.*', 'epoch = "2000-01-01T00:00:00 TDB"'),
        "zero: epoch": text('^epoch = "2000.*', 'epoch = "1970-01-01T00:00:00 TAI"'),
        "unit: ticks of a second": key("ticks_per_second", "1000"),
        "unit: latitude of a station in arc minutes": key("latitude_deg", "2424.0"),
        "unit: latitude of a station in radians": key("latitude_deg", "0.7051"),
        "sign: latitude of a station": key("latitude_deg", "-40.4"),
        "sign: longitude of a station": key("longitude_deg", "4.3"),
        "zero: longitude of a station by a turn": key("longitude_deg", "-4.3"),
        "order: latitude and longitude of a station": lambda path: (
            key("latitude_deg", "355.7")(path), key("longitude_deg", "40.4")(path), None)[2],
        "unit: height of a station in km": key("height_m", "0.7"),
        "unit: height of a station in mm": key("height_m", "700000.0"),
        "zero: height of a station from the centre": key("height_m", "6371700.0"),
        "unit: elevation in radians": key("minimum_elevation_deg", "0.1745"),
        "unit: rate in kbit/s": key("downlink_bps", "256.0"),
        "zero: rate": key("downlink_bps", "0.0"),
        "order: outage": key("outages", '["2029-08-10T06:00:00Z/2029-08-10T00:00:00Z"]'),
        "unit: place of the time in bits": key("time_offset", "32"),
        "identity: time code": key("time_code", '"cuc"'),
        "unit: latitude limit in radians": key("latitude_limit_deg", "1.0472"),
        "unit: share in per cent": key("unseen_share", "50.0"),
        "unit: recall in per cent": key("recall", "30.0"),
        "unit: packets as a share": key("packets_percent", "0.999"),
        "unit: temperature in K": key("temperature_max_c", "333.15"),
        "unit: median error in km": key("median_error_m", "0.1"),
        "unit: battery in per cent": key("minimum_battery", "30.0"),
        "unit: hours in minutes": key("observe_hours_per_day", "360.0"),
        "unit: storage in MB of octets": key("storage_mib", "536870912.0"),
        "order: box of trained ground": text(r"\[\[0.0, 30.0, -10.0, 10.0\]\]", "[[-10.0, 10.0, 30.0, 0.0]]"),
        "unit: box of trained ground": text(r"\[\[0.0, 30.0, -10.0, 10.0\]\]", "[[0.0, 3000.0, -1000.0, 1000.0]]"),
        "identity: APID twice": key("apids", "[100, 100]"),
        "identity: APID of the payload": key("apids", "[160, 101]"),
        "zero: offset of the time": text("offset = 6", "offset = 0"),
        "unit: octets of the time": text("whole_octets = 4", "whole_octets = 32"),
        "time scale: clock of the packets": text('clock = "own"', 'clock = "gps"'),
        "zero: epoch of the packets": text("1980-01-06T00:00:00Z", "2980-01-06T00:00:00Z"),
        "frame: gravity of degree 0": key("gravity_degree", "-1"),
        "identity: a key of another name": text("fov_deg", "fov_rad"),
        "identity: a section twice": text(r"^\[observation\]", "[camera]"),
    },
)  # fmt: skip


def scenario_values(path: Path) -> tuple[Any, str]:
    """Values of a scenario, and the words of `linna emulate --check` about them."""
    scenario = load_scenario(path)
    return leaves(json.loads(json.dumps(asdict(scenario)))), scenario.words


SCENARIO_TOML = """name = "own"
[orbit]
epoch = "2029-08-07T00:00:00Z"
position_km = [1768.0, 0.0, 0.0]
velocity_km_s = [0.0, 0.2, 1.65]
[maneuvers]
enabled = false
[window]
search = "none"
start = "2029-08-07T01:00:00Z"
duration_s = 600.0
[camera]
fov_deg = 120.0
width_px = 512
frame_interval_s = 15.0
tilt_deg = 20.0
[terrain]
source = "raster"
registration_north_east_m = [-59.0, 12.0]
[navigation]
initial_position_error_m = 1000.0
catalogue_min_diameter_km = 3.0
catalogue_max_diameter_km = 30.0
[reference]
radial_m = 10.0
transverse_m = 30.0
[clock]
offset_s = 0.5
drift_ppm = 2.0
[faults]
events = ["sensor_noise at 60 for 30"]
"""
SCENARIOS = Reader(
    toml(SCENARIO_TOML.replace('[faults]\nevents = ["sensor_noise at 60 for 30"]\n', ""), "own.toml"),
    scenario_values,
    {
        "unit: position in m": key("position_km", "[1768000.0, 0.0, 0.0]"),
        "unit: position in radii": key("position_km", "[1.0176, 0.0, 0.0]"),
        "unit: velocity in m/s": key("velocity_km_s", "[0.0, 200.0, 1650.0]"),
        "unit: velocity in km/h": key("velocity_km_s", "[0.0, 720.0, 5940.0]"),
        "zero: velocity": key("velocity_km_s", "[0.0, 0.0, 0.0]"),
        "scale: velocity a tenth": key("velocity_km_s", "[0.0, 0.02, 0.165]"),
        "order: two numbers of a position": key("position_km", "[1768.0, 0.0]"),
        "order: position and velocity": lambda path: (
            key("velocity_km_s", "[1768.0, 0.0, 0.0]")(path), key("position_km", "[0.0, 0.2, 1.65]")(path), None)[2],
        "frame: axes": text(r"^epoch", 'frame = "MCMF"\nepoch'),
        "time scale: epoch": key("epoch", '"2029-08-07T00:00:00 TAI"'),
        "zero: epoch": key("epoch", '"1969-08-07T00:00:00Z"'),
        "unit: start in seconds": key("start", '"3600"'),
        "zero: start a century later": key("start", '"2129-08-07T01:00:00Z"'),
        "zero: duration": key("duration_s", "0.0"),
        "unit: field of view in arc minutes": key("fov_deg", "7200.0"),
        "zero: width": key("width_px", "0"),
        "unit: tilt in arc minutes": key("tilt_deg", "1200.0"),
        "sign: interval": key("frame_interval_s", "-15.0"),
        "unit: registration in km": key("registration_north_east_m", "[-59000.0, 12000.0]"),
        "order: registration of one number": key("registration_north_east_m", "[-59.0]"),
        "order: diameters of craters": lambda path: (
            key("catalogue_min_diameter_km", "30.0")(path), key("catalogue_max_diameter_km", "3.0")(path), None)[2],
        "unit: diameters of craters in m": lambda path: (
            key("catalogue_min_diameter_km", "3000.0")(path),
            key("catalogue_max_diameter_km", "30000.0")(path),
            None,
        )[2],
        "order: radial and transverse": lambda path: (
            key("radial_m", "30.0")(path), key("transverse_m", "10.0")(path), None)[2],
        "unit: drift in s/s": key("drift_ppm", "2e6"),
        "unit: offset in ms": key("offset_s", '"500 ms"'),
        "identity: a key of another name": text("fov_deg", "fov_rad"),
        "identity: terrain": key("source", '"procedural"'),
        "sign: position error": key("initial_position_error_m", "-1000.0"),
    },
)  # fmt: skip

RECEPTIONS_CSV = "packet_ticks,sequence_count,received_utc,station\n" + "".join(
    f"{ticks_from_utc_ns(START + k * 10 * NS)},{k},{format_utc(START + k * 10 * NS + 1_300_000_000)},Madrid\n"
    for k in range(30)
)


def receptions(path: Path) -> tuple[Any, str]:
    found = read_receptions(path)
    names = sorted({one.station for one in found})
    return [
        [one.ticks, one.sequence_count, one.earth_utc_ns / NS, names.index(one.station)] for one in found
    ], str(names)


RECEPTIONS = Reader(
    toml(RECEPTIONS_CSV, "receptions.csv"),
    receptions,
    {
        "unit: ticks in s": text(r"^(\d+),", lambda m: f"{int(m[1]) / 65536:.3f},", 0),
        "unit: ticks of 64 bits": text(r"^(\d+),", r"\g<1>00000,", 0),
        "unit: reception in seconds": text(r"2029-08-07T[^,]*", "1249", 0),
        "sign: count": text(r"^(\d+),(\d+)", r"\1,-\2", 0),
        "scale: count of 16 bits": text(r"^(\d+),(\d+)", r"\1,20000", 0),
        "identity: station": text("Madrid", "Teneriffa", 0),
        "order: columns with their names": text(r"^([^,]+),([^,]+),", r"\2,\1,", 0),
        "identity: name of a column": text("received_utc", "received"),
        "time scale: reception in local time": text(r"Z,Madrid", "+02:00,Madrid", 0),
    },
)


def registration(folder: Path) -> Path:
    nodes = 12
    one = Registration(
        np.arange(nodes), np.arange(nodes) + 40, np.linspace(-50, 50, nodes), np.linspace(10, 90, nodes),
        np.full(nodes, 15.0), np.full(nodes, 30), "a" * 64, {"dem.tif": "b" * 64}, "2026-01-01T00:00:00Z",
    )  # fmt: skip
    path = folder / "registration.json"
    path.write_text(format_registration(one))
    return path


def registered_shift(path: Path) -> tuple[Any, str]:
    one = parse_registration(path.read_text(), str(path))
    return np.column_stack([one.row, one.column, one.east_m, one.north_m, one.sigma_m, one.rims]), one.words


def nodes(column: int, factor: float, plus: float = 0.0, row: int | None = None) -> Edit:
    def change(document: dict[str, Any]) -> None:
        for k, one in enumerate(document["nodes"]):
            if row in (None, k):
                one[column] = one[column] * factor + plus

    return tree(change)


REGISTRATIONS = Reader(
    registration,
    registered_shift,
    {
        "unit: places in radians": lambda path: (nodes(0, math.pi / 180)(path), nodes(1, math.pi / 180)(path), None)[2],
        "unit: latitudes in hundredths": nodes(0, 100.0),
        "unit: shifts in km": nodes(2, 1e-3),
        "unit: shifts in mm": nodes(2, 1e3),
        "zero: shifts of 8 km": nodes(3, 1.0, 8_000.0),
        "sign: sigma": nodes(4, -1.0),
        "zero: sigma": nodes(4, 0.0),
        "sign: rims": nodes(5, -1.0),
        "order: columns": at("columns", ["longitude_deg", "latitude_deg", "east_m", "north_m", "sigma_m", "rims"]),
        "scale: lattice": at("lattice_deg", 30.0),
        "identity: kind": at("kind", "shift"),
        "identity: version": at("version", 99),
        "identity: catalogue": at("catalogue_sha256", None),
        "identity: a node twice": tree(lambda d: d["nodes"].append(d["nodes"][0])),
    },
)  # fmt: skip


def orientation(folder: Path) -> Path:
    data = Path(os.environ["LINNA_DATA"]) / "kernels"
    folder.joinpath("moon.bpc").write_bytes((data / "moon_pa_de421_1900-2050.bpc").read_bytes())
    path = folder / "moon.tf"
    path.write_text((data / "moon_080317.tf").read_text())
    return path


def orientation_figures(path: Path) -> tuple[Any, str]:
    found = load_orientation(path.parent / "moon.bpc", path)
    return found.mcmf_from_icrf(np.array([9.34e8, 1e9])), ""


ANGLES = r"(TKFRAME_31007_ANGLES\s*=\s*\()([^)]*)(\))"
ORIENTATIONS = Reader(
    orientation,
    orientation_figures,
    {
        "unit: angles in degrees": text(r"(TKFRAME_31007_UNITS\s*=\s*)'ARCSECONDS'", r"\1'DEGREES'"),
        "unit: angles in radians": text(r"(TKFRAME_31007_UNITS\s*=\s*)'ARCSECONDS'", r"\1'RADIANS'"),
        "unit: unknown": text(r"(TKFRAME_31007_UNITS\s*=\s*)'ARCSECONDS'", r"\1'MINUTES'"),
        "sign: angles": text(ANGLES, lambda m: m[1] + re.sub(r"(?<![\d.])(\d)", r"-\1", m[2]) + m[3]),
        "order: axes": text(r"(TKFRAME_31007_AXES\s*=\s*\()\s*3\s*,\s*2\s*,\s*1", r"\1 1, 2, 3"),
        "order: two angles": text(ANGLES, r"\1 67.92 78.56 \3"),
        "zero: angles": text(ANGLES, r"\1 0.0 0.0 0.0 \3"),
        "identity: frame of the angles": text(r"(TKFRAME_31007_RELATIVE\s*=\s*)'\w+'", r"\1'J2000'"),
    },
    tolerance=1e-8,
)

READERS: dict[str, Reader] = (
    ORBITS
    | {"attitudes (AEM)": ATTITUDES, "attitudes (table)": ATTITUDE_TABLE}
    | GRAVITY
    | {name: list_reader(names) for name, names in LISTS.items()}
    | {
        "height rasters": RASTERS,
        "polar rasters": POLAR,
        "COCO": COCO,
        "pictures": PICTURES,
        "XTCE": XTCE,
        "recordings": RECORDINGS,
        "missions": MISSIONS,
        "scenarios": SCENARIOS,
        "receptions": RECEPTIONS,
        "registrations": REGISTRATIONS,
        "orientation kernels": ORIENTATIONS,
    }
)


def outcome(reader: Reader, edit: Edit, folder: Path) -> str:
    """Return "refused: why", "same", "stated: words", or "SILENT: difference" of a changed file."""
    path = reader.write(folder)
    before, words = reader.figures(path)
    edit(path)
    try:
        after, now = reader.figures(path)
    except REFUSALS as error:
        return f"refused: {str(error).replace(str(folder), '')[:150]}"
    before, after = (np.asarray(one, dtype=np.float64) for one in (before, after))
    if before.shape == after.shape and np.allclose(
        before, after, rtol=0.0, atol=reader.tolerance, equal_nan=True
    ):
        return "same"
    if now != words:
        return f"stated: {now[:150]}"
    return f"SILENT: {np.nanmax(np.abs(before - after)) if before.shape == after.shape else after.shape}"


@pytest.mark.parametrize("name", READERS)
def test_a_changed_field_never_gives_other_figures_in_silence(name: str, tmp_path: Path) -> None:
    if name == "orientation kernels" and "LINNA_DATA" not in os.environ:
        pytest.skip("LINNA_DATA is not set: no kernels on this machine")
    for number, (label, edit) in enumerate(READERS[name].changes.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        found = outcome(READERS[name], edit, folder)
        assert not found.startswith("SILENT"), f"{label}: {found}"


def main() -> None:
    counts: dict[str, int] = {}
    for name, reader in READERS.items():
        for label, edit in reader.changes.items():
            with tempfile.TemporaryDirectory() as folder:
                found = outcome(reader, edit, Path(folder))
            kind = found.partition(":")[0]
            counts[kind] = counts.get(kind, 0) + 1
            print(f"{name:<20} {label:<50} {found}", flush=True)
    print(f"{sum(counts.values())} changed inputs of {len(READERS)} readers: {counts}")


if __name__ == "__main__":
    main()
