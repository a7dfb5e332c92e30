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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground_service.errors import GroundError
from ground_service.missions.ephemerides.attitudes import load_attitudes
from ground_service.missions.model import parse_mission
from ground_service.missions.timekeeping.recorrelation import read_receptions
from linna.data import load_orbit, orbit_words
from lunar.catalogue import load_catalogue
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.errors import LunarError
from lunar.frames import icrf_from_j2000
from lunar.gravity import acceleration, builtin_gravity, load_gravity
from lunar.messages.aem import AttitudeSegment, format_aem, parse_aem
from lunar.messages.oem import format_oem, parse_oem
from lunar.messages.oem_xml import format_oem_xml
from lunar.messages.spice import spk_kernel
from lunar.messages.stk import format_stk
from lunar.timescales import NS, from_tai_ns
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
        return np.hstack(ephemeris.at(ASKED)), orbit_words(ephemeris)

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


def second_segment(**fields: Any) -> Edit:
    def edit(path: Path) -> None:
        halves = [orbit(**extra).segments[0] for extra in ({}, fields)]
        first, last = (Ephemeris((one,)) for one in halves)
        middle = times(2700.0).item()
        from lunar.ephemeris import clipped

        parts = (
            *clipped(first, first.start_utc_ns, middle).segments,
            *clipped(last, middle, last.stop_utc_ns).segments,
        )
        path.write_text(format_oem(Ephemeris(parts)))

    return edit


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
    "identity: two objects in one file": second_segment(object_name="OTHER", object_id="OTHER"),
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
READERS: dict[str, Reader] = dict(ORBITS)


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
