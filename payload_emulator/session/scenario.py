"""Emulation scenarios: one TOML file, parsed into frozen values; unknown keys are refused with the nearest known one.

Degrees, kilometres and seconds stand in the file and in these values' names; users of a scenario convert once.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from lunar.constants import MOON_RADIUS_M
from lunar.errors import LunarError
from lunar.plausible import (
    CAMERA_FIELD_DEG,
    CAMERA_PIXELS,
    CRATER_DIAMETER_M,
    MAP_SHIFT_M,
    OFF_NADIR_DEG,
    ORBIT_RADIUS_M,
    ORBIT_SPEED_M_S,
    UTC_NS,
)
from lunar.timescales import parse_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.session.typed_toml import TableFault, read_table, toml_text
from payload_emulator.sim.board.contact_plan import parse_clock_error, parse_outage
from payload_emulator.sim.board.link import LinkSection
from payload_emulator.sim.board.platform import parse_fault
from payload_emulator.sim.render.sensor import SensorModel
from reports.values import Requirements

SPACECRAFT_ID = 76
"""Spacecraft of a scenario that states none."""

_WITHDRAWN = {"altimeter", "star_tracker"}

SHIPPED = Path(__file__).resolve().parents[2] / "scenarios"


@dataclass(frozen=True, slots=True)
class OrbitSection:
    """Orbit at the epoch: osculating Keplerian elements, a Cartesian state, or an OEM file.

    `position_km` and `velocity_km_s` (three numbers each, axes of `frame`) replace the elements. An OEM file gives the
    whole trajectory.
    """

    epoch: str = "2029-08-07T00:00:00Z"
    frame: Literal["MCI", "ICRF"] = "MCI"
    semi_major_axis_km: float = 1768.180
    eccentricity: float = 0.006908
    inclination_deg: float = 89.076
    raan_deg: float = 3.164
    argument_of_perilune_deg: float = 333.604
    true_anomaly_deg: float = 8.882
    position_km: tuple[float, ...] = ()
    velocity_km_s: tuple[float, ...] = ()
    oem: str = ""


@dataclass(frozen=True, slots=True)
class DynamicsSection:
    """Forces on the true spacecraft. `gravity`: "auto" (best available field), "builtin", or a coefficient file.

    Sunlight pushes where the cross-section over mass is positive; the reflection is 1 for black, 2 for a mirror.
    """

    gravity: str = "auto"
    degree: int = 100
    orientation: Literal["auto", "iau", "de421"] = "auto"
    earth: bool = True
    sun: bool = True
    solar_area_to_mass_m2_kg: float = 0.0
    solar_reflection: float = 1.3


@dataclass(frozen=True, slots=True)
class ManeuverSection:
    """The paper's orbit maintenance (section V-B.1).

    The payload knows the planned burns; what is carried out differs from the plan by a share of it (1 sigma per axis).
    """

    enabled: bool = True
    periselene_altitude_km: float = 15.0
    semi_major_axis_km: float = 1768.180
    eccentricity: float = 0.006
    execution_error_fraction: float = 0.02


@dataclass(frozen=True, slots=True)
class WindowSection:
    """Observation windows of the payload.

    `search`: "terrain" takes the first window of the wanted direction that lies entirely over the available terrain,
    no earlier than `start` (the orbit's epoch when empty), between the two longitudes (east-positive; the second may
    exceed 360); "none" observes from `start` for `duration_s`.
    Frames are taken where the sub-satellite latitude is within `latitude_limit_deg` of the equator and between
    `latitude_min_deg` and `latitude_max_deg`, on every `arc_interval`-th arc (1: on all).
    """

    search: Literal["terrain", "none"] = "terrain"
    start: str = ""
    duration_s: float = 0.0
    passes: int = 1
    direction: Literal["ascending", "descending", "any"] = "ascending"
    latitude_limit_deg: float = 60.0
    latitude_min_deg: float = -90.0
    latitude_max_deg: float = 90.0
    arc_interval: int = 1
    longitude_min_deg: float = 0.0
    longitude_max_deg: float = 360.0
    search_days: float = 30.0

    @property
    def latitude_band_deg(self) -> tuple[float, float]:
        """Lowest and highest sub-satellite latitude of frames."""
        limit = self.latitude_limit_deg
        return max(self.latitude_min_deg, -limit), min(self.latitude_max_deg, limit)


@dataclass(frozen=True, slots=True)
class CameraSection:
    """The camera (paper, section V-B.3).

    `yaw_deg` turns it clockwise from image up to the north, then `tilt_deg` leans it from nadir toward image up.
    `k1` to `p2` are Brown's coefficients of the true lens: flight software knows a pinhole, so they are what its
    calibration missed.
    """

    width_px: int = 512
    height_px: int = 512
    fov_deg: float = 120.0
    frame_interval_s: float = 15.0
    images: Literal["rendered", "reduced"] = "rendered"
    tilt_deg: float = 0.0
    yaw_deg: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


@dataclass(frozen=True, slots=True)
class LightSection:
    """`paper`: the Sun drawn again for each frame (section V-B.4); `real`: from the ephemeris.

    `photometry` is the law by which the ground scatters it.
    """

    mode: Literal["paper", "real"] = "paper"
    photometry: Literal["lunar-lambert", "lambert", "hapke", "matt"] = "lunar-lambert"
    elevation_min_deg: float = 5.0
    elevation_max_deg: float = 15.0
    azimuth_min_deg: float = -45.0
    azimuth_max_deg: float = 45.0


@dataclass(frozen=True, slots=True)
class TerrainSection:
    """`auto`: the real terrain where its rasters are available, else the procedural Moon.

    `catalogue`: the craters of the data folder's catalogue, at their places and sizes, on a procedural base.
    `photograph`: the light of georeferenced photographs (`photographs`) over height rasters (`heights`; empty: those of
    the data folder), both named by their paths in the data folder. The Sun of the scenario must be that of the
    photographs, for example `light.mode = "paper"` with equal limits.
    `registration_north_east_m` shifts height rasters on the ground, in metres to the north and to the east; empty: the
    none. The catalogue is registered to the rasters as they are georeferenced; a procedural Moon has no registration.
    """

    source: Literal["auto", "raster", "procedural", "catalogue", "photograph"] = "auto"
    registration_north_east_m: tuple[float, ...] = ()
    photographs: tuple[str, ...] = ()
    heights: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class DetectorSection:
    """Crater network on board and its use.

    `network` is the name of a shipped network (`linna detector info --help` lists them) or an ONNX file. A negative
    `score_threshold` takes the threshold stored in the network. `max_detections` limits the detections of a frame, the
    best first; the detections packet holds up to 255.
    """

    network: str = "craters"
    score_threshold: float = -1.0
    max_detections: int = 120


@dataclass(frozen=True, slots=True)
class NavigationSection:
    """Estimators on board, and what they are started and fed with.

    The initial errors are of the state that starts the filter (1 sigma per axis declared, that length drawn). Errors of
    the on-board catalogue come on top of those that the terrain's own catalogue has. `anchoring_catalogue` names a
    table made by `linna catalogue curate`; it is uploaded in place of the terrain's catalogue. The uploaded craters are
    displaced by a smooth distortion of the map of `catalogue_distortion_m` (1 sigma east and north) over an arc of
    `catalogue_distortion_deg`, of which the payload does not know.
    """

    estimators: tuple[str, ...] = ("paper", "spherical", "anchored")
    initial_position_error_m: float = 1000.0
    initial_velocity_error_m_s: float = 1.0
    filter_gravity: str = "auto"
    filter_degree: int = 100
    anchoring_catalogue: str = ""
    catalogue_min_diameter_km: float = 3.0
    catalogue_max_diameter_km: float = 30.0
    catalogue_error_fraction_of_diameter: float = 0.0
    catalogue_height_error_m: float = 0.0
    catalogue_distortion_m: float = 0.0
    catalogue_distortion_deg: float = 10.0
    safety_timeout_s: float = 0.0


@dataclass(frozen=True, slots=True)
class AttitudeSection:
    """Pointing of the camera and what the ADCS knows of it, 1 sigma per axis.

    `declared_noise_deg` and `declared_bias_deg` are what its data sheet states; negative: the true ones.
    """

    pointing_error_deg: float = 0.0
    knowledge_noise_deg: float = 0.0
    knowledge_bias_deg: float = 0.0
    declared_noise_deg: float = -1.0
    declared_bias_deg: float = -1.0


@dataclass(frozen=True, slots=True)
class DisturbancesSection:
    """Disturbances of the flight; times in seconds after the first frame, none where a size is zero.

    - kidnap: the spacecraft is found elsewhere, turned about the Moon's centre by a distance on the ground;
      `kidnap_told`: the payload is informed by telecommand that its estimate is worth no more than that distance;
    - outage: the camera gives no image;
    - burn: along the velocity; `declared`: the payload has it in its burn table. `maneuvers` gives its execution error.
    """

    kidnap_at_s: float = 0.0
    kidnap_distance_km: float = 0.0
    kidnap_told: bool = False
    outage_at_s: float = 0.0
    outage_duration_s: float = 0.0
    burn_at_s: float = 0.0
    burn_delta_v_m_s: float = 0.0
    burn_declared: bool = True


@dataclass(frozen=True, slots=True)
class ClockSection:
    """The on-board clock: reading minus ideal = offset + drift x elapsed since `reference`, UTC; empty: first frame."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    reference: str = ""


@dataclass(frozen=True, slots=True)
class FaultsSection:
    """Faults: a line each, `KIND at SECONDS [for SECONDS] [size NUMBER]`; the kinds are in `sim.faults`."""

    events: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ReferenceSection:
    """Errors of the ground's reference ephemeris, 1 sigma.

    `radial_m`, `transverse_m` and `normal_m` are the errors of one orbit determination: an orbit of the same period
    that differs in eccentricity, phase and plane, so that errors are correlated over the whole arc and repeat with each
    revolution. The orbital dynamics require a transverse error of at least twice the radial error. `position_error_m`
    adds a constant offset in R/T/N.
    """

    position_error_m: float = 0.0
    radial_m: float = 0.0
    transverse_m: float = 0.0
    normal_m: float = 0.0

    @property
    def sigma_rtn_m(self) -> tuple[float, float, float]:
        """Standard deviations of the whole error in radial, transverse and normal."""
        own = (self.radial_m, self.transverse_m, self.normal_m)
        return (
            math.hypot(self.position_error_m, own[0]),
            math.hypot(self.position_error_m, own[1]),
            math.hypot(self.position_error_m, own[2]),
        )


REQUIREMENTS = Requirements(
    median_error_m=100.0,
    p95_error_m=300.0,
    better_than=("propagate-only", "snapshot"),
    consistency_inside_percent=90.0,
    packets_percent=99.9,
    frames_percent=99.0,
    images_percent=95.0,
    recall=0.25,
    precision=0.8,
    anchor_reads=0.0,
    resets=0.0,
    cpu_percent=80.0,
    storage_percent=80.0,
    temperature_max_c=60.0,
)
"""Limits of a scenario that states none; negative ones are not stated, except `temperature_min_c`."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything an emulation is made of; two runs of equal scenarios give equal octets."""

    name: str
    title: str = ""
    seed: int = 1
    spacecraft: str = "SelenITA"
    spacecraft_id: int = SPACECRAFT_ID
    orbit: OrbitSection = field(default_factory=OrbitSection)
    dynamics: DynamicsSection = field(default_factory=DynamicsSection)
    maneuvers: ManeuverSection = field(default_factory=ManeuverSection)
    window: WindowSection = field(default_factory=WindowSection)
    camera: CameraSection = field(default_factory=CameraSection)
    sensor: SensorModel = field(default_factory=SensorModel)
    light: LightSection = field(default_factory=LightSection)
    terrain: TerrainSection = field(default_factory=TerrainSection)
    detector: DetectorSection = field(default_factory=DetectorSection)
    navigation: NavigationSection = field(default_factory=NavigationSection)
    attitude: AttitudeSection = field(default_factory=AttitudeSection)
    disturbances: DisturbancesSection = field(default_factory=DisturbancesSection)
    clock: ClockSection = field(default_factory=ClockSection)
    link: LinkSection = field(default_factory=LinkSection)
    faults: FaultsSection = field(default_factory=FaultsSection)
    reference: ReferenceSection = field(default_factory=ReferenceSection)
    requirements: Requirements = REQUIREMENTS

    @property
    def has_flat_ground(self) -> bool:
        """Return whether the ground is the sphere: no image is rendered, and no estimator needs heights."""
        return self.camera.images == "reduced" and "anchored" not in self.navigation.estimators

    @property
    def epoch_utc_ns(self) -> int:
        return parse_utc(self.orbit.epoch)

    @property
    def words(self) -> str:
        """Return the values that differ from the defaults, as printed with figures of the scenario."""
        default, listed = Scenario(""), []
        for item in dataclasses.fields(self):
            section, plain = getattr(self, item.name), getattr(default, item.name)
            if dataclasses.is_dataclass(section):
                names = (key.name for key in dataclasses.fields(section))
                changed = [name for name in names if getattr(section, name) != getattr(plain, name)]
                listed += [f"{item.name}.{name} {toml_text(getattr(section, name))}" for name in changed]
        return ", ".join(listed)

    def with_choices(
        self, *, modes: Sequence[str] | None = None, seed: int | None = None, anchoring_catalogue: Path | None = None
    ) -> Scenario:
        """Return the same scenario with other estimators, seed or table of craters; None keeps what it has."""
        navigation = self.navigation
        if modes is not None:
            navigation = dataclasses.replace(navigation, estimators=tuple(dict.fromkeys(modes)))
        if anchoring_catalogue is not None:
            navigation = dataclasses.replace(navigation, anchoring_catalogue=str(anchoring_catalogue))
        return dataclasses.replace(self, navigation=navigation, seed=self.seed if seed is None else seed)


def shipped_file(path: Path) -> Path:
    """Return the file of a shipped scenario for its bare name; other paths as they are."""
    shipped = SHIPPED / f"{path.name}.toml"
    return shipped if not path.is_file() and path.name == str(path) and not path.suffix and shipped.is_file() else path


def load_scenario(path: Path | str) -> Scenario:
    """Load the scenario of a TOML file; a bare name means one of those shipped (`scenarios/NAME.toml`).

    Raises
    ------
    ScenarioError
        The file is missing, no TOML, has unknown keys, values of a wrong type, an impossible orbit, or a key without
        effect.
    """
    where = shipped_file(Path(path))
    try:
        text = where.read_text(encoding="utf-8")
    except FileNotFoundError:
        shipped = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        raise ScenarioError(f"{path}: no such scenario file; shipped scenarios: {shipped}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(
            f"{where}: expected UTF-8 text, found octet {error.object[error.start]:#04x} at {error.start}"
        ) from None
    scenario = parse_scenario(text, source=str(where))
    _check_unused(scenario, str(where))
    return scenario


def parse_scenario(text: str, source: str = "scenario") -> Scenario:
    """Parse the scenario in `text`; `source` names it in error messages.

    Archives state every key, so keys without effect are allowed.
    """
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{source}: not TOML: {error}") from None
    if "name" not in table:
        raise ScenarioError(f"{source}: key 'name' is missing, expected a short text")
    for name in _WITHDRAWN & table.keys():
        raise ScenarioError(
            f"{source}: section [{name}]: instruments other than the camera were withdrawn; leave the section out, "
            "or declare the packets of the instrument in the mission description"
        )
    dynamics = table.get("dynamics")
    # Scenarios of archives state the integrator of versions that had two, and an empty estimator.
    if isinstance(dynamics, dict) and dynamics.pop("integrator", "rkn86") != "rkn86":
        raise ScenarioError(f"{source}: dynamics.integrator: only 'rkn86' is left; leave the key out")
    requirements = table.get("requirements")
    if isinstance(requirements, dict) and requirements.get("estimator") == "":
        del requirements["estimator"]
    scenario = _read(table, source)
    _check(scenario, source)
    return scenario


def format_scenario(scenario: Scenario) -> str:
    """Return TOML text that parses to an equal scenario (every key written out)."""
    lines: list[str] = []
    sections: list[str] = []
    for item in dataclasses.fields(scenario):
        value = getattr(scenario, item.name)
        if dataclasses.is_dataclass(value):
            sections += _section(item.name, value)
        else:
            lines.append(f"{item.name} = {toml_text(value)}")
    return "\n".join(lines + sections) + "\n"


def _section(name: str, values: Any) -> list[str]:
    stated = ((key.name, getattr(values, key.name)) for key in dataclasses.fields(values))
    return ["", f"[{name}]", *(f"{key} = {toml_text(value)}" for key, value in stated if value is not None)]


def _read(table: object, source: str) -> Scenario:
    """Return the scenario from its table; a fault becomes one line that names source and key."""
    try:
        return read_table(Scenario, table, present=Scenario(""))
    except TableFault as fault:
        if not fault.known:
            raise ScenarioError(f"{source}: {fault.place} must be {fault.expected}, found {fault.found}") from None
        hint = f"did you mean '{fault.nearest}'?" if fault.nearest else f"known keys: {', '.join(fault.known)}"
        raise ScenarioError(f"{source}: unknown key '{fault.place}'; {hint}") from None


ESTIMATORS = ("paper", "spherical", "anchored")

_MOON_RADIUS_KM = MOON_RADIUS_M / 1e3


class Require(Protocol):
    """Refuses a value unless `good` holds; None for what was found: the value of the key."""

    def __call__(self, good: bool, key: str, expected: str, found: object = None) -> None: ...


def _check_cartesian(orbit: OrbitSection, require: Require) -> None:
    """Refuse a Cartesian state that is incomplete, contradicts other keys or lies in the Moon."""
    for key in ("position_km", "velocity_km_s"):
        values = getattr(orbit, key)
        require(len(values) == 3, f"orbit.{key}", "three numbers", values)
    default = OrbitSection()
    for key in _ELEMENT_KEYS:
        require(getattr(orbit, key) == getattr(default, key), f"orbit.{key}", "absent where orbit.position_km is given")
    require(not orbit.oem, "orbit.oem", "absent where orbit.position_km is given")
    require(
        math.hypot(*orbit.position_km) > _MOON_RADIUS_KM,
        "orbit.position_km",
        f"a place above the ground (radius over {_MOON_RADIUS_KM} km)",
        list(orbit.position_km),
    )
    require(any(orbit.velocity_km_s), "orbit.velocity_km_s", "a velocity", list(orbit.velocity_km_s))
    for key, limit in (("position_km", ORBIT_RADIUS_M), ("velocity_km_s", ORBIT_SPEED_M_S)):
        values = getattr(orbit, key)
        good = bool(limit.holds(1e3 * math.hypot(*values)))
        require(good, f"orbit.{key}", f"of {limit} in all, stated with km", list(values))


_ELEMENT_KEYS = (
    "semi_major_axis_km",
    "eccentricity",
    "inclination_deg",
    "raan_deg",
    "argument_of_perilune_deg",
    "true_anomaly_deg",
)


def _check(scenario: Scenario, source: str) -> None:
    """Refuse what cannot be flown; each message names the key, what is expected and what was found."""

    def require(good: bool, key: str, expected: str, found: object = None) -> None:
        if not good:
            section, _, name = key.partition(".")
            found = getattr(getattr(scenario, section), name) if found is None else found
            raise ScenarioError(f"{source}: {key} must be {expected}, found {found!r}")

    for check in (
        _check_limits,
        _check_orbit,
        _check_window,
        _check_terrain,
        _check_detector,
        _check_disturbances,
        _check_light,
        _check_navigation,
    ):
        check(scenario, require)
    for text in scenario.faults.events:
        parse_fault(text)
    for text in (*scenario.link.outages, *scenario.link.missed):
        parse_outage(text)
    clocks = [parse_clock_error(text)[0] for text in scenario.link.clock_errors]
    for key, names in (("link.stations", scenario.link.stations), ("link.clock_errors", clocks)):
        require(len(set(names)) == len(names), key, "one entry for each station", list(names))
    require(0 <= scenario.spacecraft_id < 1024, "spacecraft_id", "from 0 to 1023", scenario.spacecraft_id)


_ANY = math.inf
_POSITIVE = math.ulp(0.0)
_LIMITS: dict[str, tuple[float, float]] = {
    "orbit.inclination_deg": (0.0, 180.0),
    "dynamics.degree": (2, 1200),
    "dynamics.solar_area_to_mass_m2_kg": (0.0, 1e3),
    "dynamics.solar_reflection": (0.0, 2.0),
    "camera.width_px": (CAMERA_PIXELS.low, CAMERA_PIXELS.high),
    "camera.height_px": (CAMERA_PIXELS.low, CAMERA_PIXELS.high),
    "camera.fov_deg": (CAMERA_FIELD_DEG.low, CAMERA_FIELD_DEG.high),
    "camera.tilt_deg": (-OFF_NADIR_DEG, OFF_NADIR_DEG),
    "camera.frame_interval_s": (_POSITIVE, _ANY),
    "clock.drift_ppm": (-1e5, 1e5),
    "navigation.initial_position_error_m": (0.0, MOON_RADIUS_M),
    "navigation.initial_velocity_error_m_s": (0.0, ORBIT_SPEED_M_S.high),
    "navigation.catalogue_min_diameter_km": (CRATER_DIAMETER_M.low / 1e3, CRATER_DIAMETER_M.high / 1e3),
    "navigation.catalogue_max_diameter_km": (CRATER_DIAMETER_M.low / 1e3, CRATER_DIAMETER_M.high / 1e3),
    "window.passes": (1, _ANY),
    "window.arc_interval": (1, _ANY),
    "detector.max_detections": (1, 255),
    "disturbances.kidnap_distance_km": (0.0, _ANY),
    **{
        f"reference.{key}": (0.0, _ANY) for key in ("position_error_m", "radial_m", "transverse_m", "normal_m")
    },
    **{
        f"link.{key}": (0.0, 1.0)
        for key in (
            "frame_loss", "burst_start", "burst_end", "burst_frame_loss", "repeat_share", "reorder_share",
        )
    },
    "link.bit_error_rate": (0.0, 0.5),
    "link.burst_bit_error_rate": (0.0, 0.5),
    "link.rate_bps": (_POSITIVE, _ANY),
    "link.uplink_bps": (_POSITIVE, _ANY),
}  # fmt: skip
"""Least and greatest value of a key."""


def _check_limits(scenario: Scenario, require: Require) -> None:
    for key, (low, high) in _LIMITS.items():
        section, _, name = key.partition(".")
        found = getattr(getattr(scenario, section), name)
        words = {_POSITIVE: "positive", 0.0: "zero or more"}.get(low, f"at least {low:g}")
        require(low <= found <= high, key, words if high == _ANY else f"from {low:g} to {high:g}", found)


def _check_orbit(scenario: Scenario, require: Require) -> None:
    orbit, window = scenario.orbit, scenario.window
    texts = {"orbit.epoch": orbit.epoch, "window.start": window.start, "clock.reference": scenario.clock.reference}
    for key, text in texts.items():
        try:
            good = bool(UTC_NS.holds(parse_utc(text))) if text or key == "orbit.epoch" else True
        except (LunarError, ValueError):
            good = False
        require(good, key, "a UTC time such as 2029-08-07T00:00:00Z, from 1972 to 2100", text)
    if orbit.position_km or orbit.velocity_km_s:
        _check_cartesian(orbit, require)
    elif not orbit.oem:
        require(0.0 <= orbit.eccentricity < 1.0, "orbit.eccentricity", "from 0 to below 1")
        perilune_km = orbit.semi_major_axis_km * (1.0 - orbit.eccentricity)
        require(
            perilune_km > _MOON_RADIUS_KM,
            "orbit.semi_major_axis_km and eccentricity",
            f"an orbit above the ground (perilune radius over {_MOON_RADIUS_KM} km)",
            round(perilune_km, 3),
        )
        apolune_m = 1e3 * orbit.semi_major_axis_km * (1.0 + orbit.eccentricity)
        require(
            bool(ORBIT_RADIUS_M.holds(apolune_m)),
            "orbit.semi_major_axis_km",
            f"of an orbit about the Moon, {ORBIT_RADIUS_M}",
        )


_BURNS = "maneuvers periselene_altitude_km semi_major_axis_km eccentricity"
_SEARCH = "window passes direction longitude_min_deg longitude_max_deg search_days"
_PAPER_SUN = "light elevation_min_deg elevation_max_deg azimuth_min_deg azimuth_max_deg"
_TABLE_ERRORS = "navigation catalogue_error_fraction_of_diameter catalogue_height_error_m"
_SENSOR = " ".join(("sensor", *(item.name for item in dataclasses.fields(SensorModel))))
_UNUSED: tuple[tuple[str, str, Callable[[Scenario], bool]], ...] = (
    ("window duration_s", "without window.search = 'none'", lambda s: s.window.search != "none"),
    (_SEARCH, "where window.search is 'none'", lambda s: s.window.search == "none"),
    (f"orbit frame {' '.join(_ELEMENT_KEYS)}", "with orbit.oem", lambda s: bool(s.orbit.oem)),
    ("dynamics earth sun solar_area_to_mass_m2_kg", "with orbit.oem", lambda s: bool(s.orbit.oem)),
    ("dynamics solar_reflection", "without a solar area", lambda s: not s.dynamics.solar_area_to_mass_m2_kg),
    (_BURNS, "without maneuvers", lambda s: not s.maneuvers.enabled or bool(s.orbit.oem)),
    (
        "maneuvers execution_error_fraction",
        "without burns",
        lambda s: not s.maneuvers.enabled and not s.disturbances.burn_delta_v_m_s,
    ),
    (_SENSOR, "with reduced images", lambda s: s.camera.images == "reduced"),
    ("light photometry", "with reduced images", lambda s: s.camera.images == "reduced"),
    ("light photometry", "with photographs", lambda s: bool(s.terrain.photographs)),
    (_PAPER_SUN, "where light.mode is 'real'", lambda s: s.light.mode == "real"),
    (_TABLE_ERRORS, "with anchoring_catalogue", lambda s: bool(s.navigation.anchoring_catalogue)),
    (
        "navigation catalogue_distortion_deg",
        "without catalogue_distortion_m",
        lambda s: not s.navigation.catalogue_distortion_m,
    ),
    (
        "disturbances kidnap_at_s kidnap_told",
        "without kidnap_distance_km",
        lambda s: not s.disturbances.kidnap_distance_km,
    ),
    ("disturbances outage_at_s", "without outage_duration_s", lambda s: not s.disturbances.outage_duration_s),
    ("disturbances burn_at_s burn_declared", "without burn_delta_v_m_s", lambda s: not s.disturbances.burn_delta_v_m_s),
    ("link burst_end burst_frame_loss burst_bit_error_rate", "without burst_start", lambda s: not s.link.burst_start),
    ("link playback outages missed", "without link.stations", lambda s: not s.link.stations),
)
"""Keys that have no effect (section, then keys), in which case, and whether a scenario is one."""


def _check_unused(scenario: Scenario, source: str) -> None:
    """Refuse keys that are stated otherwise than by default and have no effect."""
    default = Scenario("")
    for keys, words, is_case in _UNUSED:
        section, *names = keys.split() if is_case(scenario) else [""]
        for name in names:
            found = getattr(getattr(scenario, section), name)
            if found != getattr(getattr(default, section), name):
                key = f"{section}.{name}"
                raise ScenarioError(f"{source}: {key} has no effect {words}: expected it left out, found {found!r}")


def _check_window(scenario: Scenario, require: Require) -> None:
    window = scenario.window
    require(0.0 < window.latitude_limit_deg <= 90.0, "window.latitude_limit_deg", "over 0 and up to 90")
    lowest_deg, highest_deg = window.latitude_band_deg
    require(
        lowest_deg < highest_deg,
        "window.latitude_min_deg and latitude_max_deg",
        "a band of latitudes within window.latitude_limit_deg, lower limit first",
        (window.latitude_min_deg, window.latitude_max_deg),
    )
    require(
        0.0 < window.longitude_max_deg - window.longitude_min_deg <= 360.0,
        "window.longitude_max_deg",
        "over window.longitude_min_deg by up to 360",
    )
    require(
        window.search != "none" or window.duration_s > 0.0, "window.duration_s", "positive when window.search is 'none'"
    )


def _check_terrain(scenario: Scenario, require: Require) -> None:
    shift = scenario.terrain.registration_north_east_m
    require(
        not shift or (len(shift) == 2 and max(map(abs, shift)) <= MAP_SHIFT_M),
        "terrain.registration_north_east_m",
        f"empty or two numbers of at most {MAP_SHIFT_M:g} m",
    )
    require(
        not shift or scenario.terrain.source in ("auto", "raster", "photograph"),
        "terrain.registration_north_east_m",
        f"empty where terrain.source is {scenario.terrain.source!r}",
    )

    photographs = scenario.terrain.photographs
    require(
        bool(photographs) == (scenario.terrain.source == "photograph"),
        "terrain.photographs",
        "files where terrain.source is 'photograph', and none elsewhere",
    )
    require(
        not scenario.terrain.heights or scenario.terrain.source == "photograph",
        "terrain.heights",
        f"empty where terrain.source is {scenario.terrain.source!r}",
    )


def _check_detector(scenario: Scenario, require: Require) -> None:
    detector = scenario.detector
    require(
        detector.score_threshold < 0.0 or 0.0 < detector.score_threshold < 1.0,
        "detector.score_threshold",
        "between 0 and 1, or negative for that of the network",
    )
    require(detector.network != "", "detector.network", "a shipped network or an ONNX file")


def _check_disturbances(scenario: Scenario, require: Require) -> None:
    orbit = scenario.orbit
    moved = scenario.disturbances.kidnap_distance_km > 0.0 or scenario.disturbances.burn_delta_v_m_s != 0.0
    require(
        not (moved and (scenario.maneuvers.enabled or orbit.oem)),
        "maneuvers.enabled",
        "false, and orbit.oem empty, where [disturbances] change the orbit",
    )


def _check_light(scenario: Scenario, require: Require) -> None:
    light = scenario.light
    require(
        light.elevation_min_deg <= light.elevation_max_deg,
        "light.elevation_min_deg",
        "no more than light.elevation_max_deg",
    )
    require(
        light.azimuth_min_deg <= light.azimuth_max_deg, "light.azimuth_min_deg", "no more than light.azimuth_max_deg"
    )


def _check_navigation(scenario: Scenario, require: Require) -> None:
    require(
        scenario.navigation.catalogue_min_diameter_km < scenario.navigation.catalogue_max_diameter_km,
        "navigation.catalogue_min_diameter_km",
        "less than navigation.catalogue_max_diameter_km",
    )
    for name in scenario.navigation.estimators:
        require(name in ESTIMATORS, "navigation.estimators", f"of {', '.join(ESTIMATORS)}", name)
    require(len(scenario.navigation.estimators) > 0, "navigation.estimators", "at least one estimator", ())
    reference = scenario.reference
    require(
        reference.transverse_m >= 2.0 * reference.radial_m,
        "reference.transverse_m",
        "at least twice reference.radial_m",
    )
