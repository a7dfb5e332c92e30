"""The mission description (`mission.toml`) of a scenario, and the attitude table of a pass.

The description states what a ground segment needs to know about the spacecraft and the simulated world. It is plain
TOML, read by the ground service.
"""

import functools
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, replace
from pathlib import Path

import numpy as np

from lunar.arrays import IntArray
from lunar.boxes import Region, share_outside
from lunar.constants import MOON_RADIUS_M
from lunar.constants import NS as NS
from lunar.datafolder import DataFolder
from lunar.frames import IauOrientation, spherical_from_mcmf
from lunar.timescales import format_utc
from payload_emulator.flight.models import NETWORKS
from payload_emulator.flight.navigation.filter.filter import CommonErrors
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.session.archive.recording import RecordedStep
from payload_emulator.session.live.station_ports import RECORD_HEADER
from payload_emulator.session.scenario import SHIPPED, SPACECRAFT_ID, Scenario, format_scenario
from payload_emulator.session.spacecraft.loading import detector_parameters, filter_field, network_octets
from payload_emulator.session.spacecraft.loop import PLAYBACK_CHANNEL
from payload_emulator.session.typed_toml import toml_text
from payload_emulator.session.world.recipe import load_recipe
from payload_emulator.session.world.world import World, build_world, open_world, registered_share
from payload_emulator.sim.board.contact_plan import parse_outage
from payload_emulator.sim.board.link import STATIONS, LinkSection
from payload_emulator.sim.terrain.tiles import POLE_LIMIT_RAD
from tmtc.dictionary.payload import DICTIONARY
from tmtc.link.settings import LinkSettings
from tmtc.packets.pus import TICKS_PER_SECOND

MISSION_FILE = "mission.toml"
ATTITUDE_FILE = "attitude.csv"
ATTITUDE_HEADER = "image_ticks,q_w,q_x,q_y,q_z"
"""Columns: on-board time of the image, and the quaternion from ICRF axes to the camera reported by attitude control."""

DETECTOR_RECIPE = SHIPPED / "detector-dataset.toml"
"""Data set that the shipped detector was trained on."""

SEEN_SPLITS = ("train", "val")
"""Splits whose terrain counts as seen; the validation split was used to choose thresholds."""

SILENCE_S = 1_800.0
"""Mission time without telemetry after which a contact has ended: at maximum speed minutes pass between two reads."""

TELEMETRY_PORT, TELECOMMAND_PORT = 10015, 10025
"""Ports of the first station of a spacecraft that is flown live."""

OPERATIONS = """
[automation]
evaluate = true

[approval]
windows = "automatic"
one_person_for = ["uplink_first", "uplink_middle", "uplink_last", "perform_function/set_mode"]

[resources]
windows_on_board = 8
"""
"""Automation and approval of a simulated spacecraft: windows that the ground plans are flown without a person.

The schedule holds 64 telecommands, seven of each window.
"""

CLOCK_STEP_S = 0.1
"""Limit of a step of the on-board clock where stations measure it: 170 m along the track."""

ORBIT_AGE_H = 24.0
"""Age of the orbit that windows of a simulated spacecraft start from: that of the day before."""

_TRACK_STEP_S = 60.0
_ALTITUDE_MARGIN = 1.3
"""Altitudes of the mission in addition to those of the flight so far."""

CLOCK_EPOCH = "2000-01-01T00:00:00 TAI"

Value = bool | int | float | str | Sequence["Value"] | Mapping[str, "Value"] | None


def scenario_mission_text(scenario: Scenario, data: DataFolder) -> str:
    """Return the mission description of a scenario; the scenario is simulated as far as its windows require.

    That of a scenario with stations has links to their default ports, and describes a spacecraft that the ground
    commands.
    """
    if not scenario.link.stations:
        return mission_text(build_world(scenario, data), data)
    ports = default_ports(scenario.link.stations)
    return live_mission_text(open_world(scenario, data), data, "127.0.0.1", ports, OPERATIONS)


def default_ports(
    stations: Sequence[str], telemetry: int = TELEMETRY_PORT, telecommand: int = TELECOMMAND_PORT
) -> dict[str, tuple[int, int]]:
    """Return telemetry and telecommand port of each station, from those of the first on."""
    return {name: (telemetry + k, telecommand + k) for k, name in enumerate(stations)}


def mission_text(world: World, data: DataFolder, orbit_age_h: float | None = None) -> str:
    """Return the mission description of a world as TOML; unknown values are left out.

    The estimators start from an orbit with the error of the scenario; the ground takes one of the age `orbit_age_h`.
    """
    scenario, camera = world.scenario, world.scenario.camera
    link = LinkSettings(coding=scenario.link.coding)
    errors, rule = CommonErrors(), OffsetRule()
    flown_field = filter_field(scenario.navigation.filter_gravity, scenario.navigation.filter_degree, data)
    sections: dict[str, dict[str, Value]] = {
        "spacecraft": {"id": scenario.spacecraft_id, "name": scenario.spacecraft},
        "dictionary": {"version": DICTIONARY.version, "hash": DICTIONARY.hash},
        "link": {
            "frame_length": link.frame_length,
            "coding": link.coding,
            "randomiser": link.randomiser,
            "interleave": None if link.code is None else link.code.interleave,
            "rs_errors": link.rs_errors,
            "dual_basis": link.dual_basis,
            "frame_checksum": link.checksum,
            "packet_checksum": "crc16",
            "virtual_channels": [0, PLAYBACK_CHANNEL],
        },
        "time": {
            "epoch": CLOCK_EPOCH,
            "ticks_per_second": TICKS_PER_SECOND,
            "clock": "CUC 4+2",
            "correlation": "automatic",
        },
        "frames": {
            "orientation": world.truth.orientation.name,
            "gravity_field": world.gravity.name,
            "gravity_degree": min(world.gravity.degree, scenario.dynamics.degree),
            "onboard_orientation": IauOrientation().name,
            "onboard_gravity_field": flown_field.name,
            "onboard_gravity_degree": flown_field.degree,
        },
        "camera": {
            **{name: getattr(camera, name) for name in ("width_px", "height_px", "fov_deg")},
            **{name: getattr(camera, name) for name in ("k1", "k2", "k3", "p1", "p2")},
            "pointing": "nadir",
            **{name: getattr(camera, name) for name in ("tilt_deg", "yaw_deg", "frame_interval_s")},
        },
        "catalogue": {
            "source": world.terrain.catalogue.source,
            **_registration(world),
            "offset_sigma_m": [rule.prior_m, rule.prior_m, errors.catalogue_offset_m[2]],
            "offset_correlation_deg": round(math.degrees(rule.correlation_rad), 6),
        },
        "detector": _detector(scenario),
        "reference": {
            "source": "simulated orbit determination, one solution for the whole pass",
            "sigma_rtn_m": list(scenario.reference.sigma_rtn_m),
        },
        "evidence": _evidence(world),
        "observation": {
            "latitude_limit_deg": _latitude_limit_deg(world),
            "needs_daylight": scenario.light.mode != "paper",
        },
        "requirements": _requirements(scenario),
        "experiment": {
            "orbit_error_m": scenario.navigation.initial_position_error_m or None,
            "orbit_age_h": orbit_age_h,
        },
    }
    lines = ["schema_version = 1", f"name = {_toml(scenario.name)}"]
    for name, values in sections.items():
        stated = [f"{key} = {_toml(value)}" for key, value in values.items() if value is not None]
        if stated:
            lines += ["", f"[{name}]", *stated]
    return "\n".join(lines) + "\n"


def _latitude_limit_deg(world: World) -> float | None:
    """Return the largest latitude of the spacecraft from which all ground in view can be rendered; None: any."""
    camera = world.scenario.camera
    if camera.images == "reduced" or world.external is not None:
        return None
    highest_m = _ALTITUDE_MARGIN * float(spherical_from_mcmf(world.truth.positions_mcmf(_track_utc_ns(world)))[2].max())
    # Central angle of a corner of the image at nadir; without ground there, that of the limb.
    off_nadir = math.atan(
        math.hypot(1.0, camera.height_px / camera.width_px) * math.tan(math.radians(camera.fov_deg / 2.0))
    )
    ratio = 1.0 + highest_m / MOON_RADIUS_M
    sine = ratio * math.sin(off_nadir)
    reach = math.asin(sine) - off_nadir if sine < 1.0 else math.acos(1.0 / ratio)
    return math.floor(math.degrees(POLE_LIMIT_RAD - reach))


def _track_utc_ns(world: World) -> IntArray:
    """Return times of the flight so far (n,), one a minute."""
    return np.arange(world.truth.start_utc_ns, world.truth.stop_utc_ns, round(_TRACK_STEP_S * NS), dtype=np.int64)


def _registration(world: World) -> dict[str, float | int]:
    """Return the terrain that the catalogue is registered to, and its shift near the frames."""
    registration = world.terrain.registration
    share = registered_share(world.terrain, world.truth, world.frame_utc_ns)
    if registration is None or not share:
        return {} if registration is None and not world.terrain.is_real else {"registered_share": 0.0}
    latitude, longitude, _ = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    shift, sigma = registration.at(latitude, longitude)
    known = np.isfinite(sigma)
    return {
        "registered_share": round(share, 3),
        "registration_north_m": round(float(shift[known, 1].mean()), 1),
        "registration_east_m": round(float(shift[known, 0].mean()), 1),
        "registration_sigma_m": round(float(sigma[known].mean()), 1),
        "registration_rims": registration.rims_near(latitude, longitude),
    }


def live_mission_text(
    world: World,
    data: DataFolder,
    host: str,
    ports: Mapping[str, tuple[int, int]],
    operations: str | None = None,
    acknowledge: bool = False,
    catalogue: Path | None = None,
) -> str:
    """Return the mission description of a spacecraft that is flown live.

    Parameters
    ----------
    ports
        Telemetry and telecommand port of each station on `host`.
    operations
        TOML of automation and approval, and further sections where the ground commands; None: the operator of the
        scenario commands its windows.
    acknowledge
        Whether the stations keep telemetry until the ground acknowledges it, and confirm telecommands.
    catalogue
        Craters that were on board at launch.
    """
    scenario, link = world.scenario, world.scenario.link
    if operations is None:
        lines = [mission_text(world, data).rstrip()]
    else:
        times = _track_utc_ns(world)
        latitude, _, _ = spherical_from_mcmf(world.truth.positions_mcmf(times))
        low_deg, high_deg = scenario.window.latitude_band_deg
        band = times[(np.degrees(latitude) >= low_deg) & (np.degrees(latitude) <= high_deg)]
        if "clock_step_s" not in _requirements(scenario):
            timed = replace(scenario.requirements, clock_step_s=CLOCK_STEP_S)
            world = replace(world, scenario=replace(scenario, requirements=timed))
        lines = [mission_text(replace(world, frame_utc_ns=band), data, ORBIT_AGE_H).rstrip()]
        lines += [
            "",
            "[uploads]",
            f"tables = {_toml(_uploaded_tables(scenario))}",
            f"sigma_position_m = {max(scenario.navigation.initial_position_error_m, 1.0)!r}",
            f"sigma_velocity_m_s = {max(scenario.navigation.initial_velocity_error_m_s, 1e-3)!r}",
        ]
        if scenario.camera.images != "reduced":
            lines += ["", "[world]", f"scenario = {_toml(format_scenario(scenario))}"]
    if catalogue is not None:
        digest = hashlib.sha256(catalogue.read_bytes()).hexdigest()
        lines[0] = lines[0].replace("[catalogue]\n", f'[catalogue]\nsha256 = "{digest}"\n')
    for name, (telemetry, telecommand) in ports.items():
        lines += ["", *_section(f"[link.stations.{name}]", _station(name, link))]
        connection: dict[str, Value] = {
            "name": name if scenario.spacecraft_id == SPACECRAFT_ID else f"{name}-{scenario.spacecraft_id}",
            "kind": "tcp",
            "station": name,
            "downlink": f"{host}:{telemetry}",
            "uplink": f"{host}:{telecommand}",
            "format": "cltu",
            "send": "automatic",
            "acknowledge": acknowledge,
            "confirm": acknowledge,
            "silence_s": SILENCE_S,
        }
        lines += ["", *_section("[[links]]", connection)]
    return "\n".join(lines) + "\n" + (operations or "")


def _section(title: str, values: Mapping[str, Value]) -> list[str]:
    return [title, *(f"{key} = {_toml(value)}" for key, value in values.items())]


def _station(name: str, link: LinkSection) -> dict[str, Value]:
    """Return place, rates and outages of a station of the scenario, and its records."""
    records: dict[str, Value] = {"header_octets": RECORD_HEADER.size, "time_code": "unix_ns", "time_offset": 0}
    if name not in link.stations:
        return records
    latitude_deg, longitude_deg, height_m = STATIONS[name]
    own = [one for one in map(parse_outage, link.outages) if one.station == name]
    return {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "height_m": height_m,
        "minimum_elevation_deg": link.minimum_elevation_deg,
        "downlink_bps": link.rate_bps,
        "uplink_bps": link.uplink_bps,
        "outages": [f"{format_utc(one.start_utc_ns)}/{format_utc(one.stop_utc_ns)}" for one in own],
        **records,
    }


def _uploaded_tables(scenario: Scenario) -> list[str]:
    """Return the tables that the estimators of a scenario need for each window."""
    estimators = scenario.navigation.estimators
    anchored = ["orientation"] if "anchored" in estimators else []
    odometry = ["anchor_ephemeris"] if set(estimators) - {"anchored"} else []
    return [*anchored, *odometry, *(["initial_state"] if anchored else [])]


def save_attitudes(folder: Path, inputs: Iterable[RecordedStep]) -> None:
    """Write the attitude of every frame, as attitude control gave it, into an archive."""
    rows = []
    for item in inputs:
        q_wxyz = item.attitude[:4]
        if item.number >= 0 and np.isfinite(q_wxyz).all():
            rows.append(f"{item.clock_ticks},{','.join(repr(float(value)) for value in q_wxyz)}\n")
    (folder / ATTITUDE_FILE).write_text(f"{ATTITUDE_HEADER}\n{''.join(rows)}", encoding="utf-8")


def unseen_share(world: World) -> float | None:
    """Return the share of frames none of whose ground was used in training; None without real terrain."""
    if not world.terrain.is_real:
        return None
    positions = world.truth.positions_mcmf(world.frame_utc_ns)
    return share_outside(trained_ground(), world.camera, *spherical_from_mcmf(positions))


@functools.lru_cache(maxsize=1)
def trained_ground() -> tuple[Region, ...]:
    """Return the real ground in the training and validation data of the shipped detector."""
    sources = load_recipe(DETECTOR_RECIPE).sources
    used = [one for one in sources if one.terrain == "real" and one.split in SEEN_SPLITS]
    return tuple(Region(one.boxes, one.avoid, one.buffer_km) for one in used)


def level_of(world: str, unseen: float | None) -> str:
    """Return the evidence level ("2", "3s", "3", "5") of a world; "" if unknown.

    Parameters
    ----------
    world
        World as the mission description names it: "procedural", "real-terrain" or "photographs".
    unseen
        Share of frames over unseen terrain.
    """
    if world in ("procedural", "photographs"):
        return "2" if world == "procedural" else "5"
    if world != "real-terrain" or unseen is None:
        return ""
    return "3" if unseen == 1.0 else "3s"


def level_text(level: str, unseen: float | None) -> str:
    """Return a level with the share of frames over unseen terrain where it is 3s; "not stated" for an unknown level."""
    share = f", {100.0 * unseen:.0f} % of frames unseen" if level == "3s" and unseen is not None else ""
    return f"{level or 'not stated'}{share}"


def _evidence(world: World) -> dict[str, Value]:
    if world.external is not None:
        return {"world": world.external.evidence or None}
    if world.scenario.terrain.source == "photograph":
        return {"world": "photographs", "seed": world.scenario.seed}
    if world.terrain.is_real:
        if world.terrain.name.startswith("own "):
            return {"world": None}
        ground: list[Mapping[str, Value]] = [
            {
                "boxes": [astuple(box) for box in one.boxes],
                "avoid": [astuple(box) for box in one.avoid],
                "buffer_km": one.buffer_km,
            }
            for one in trained_ground()
        ]
        return {"world": "real-terrain", "seed": world.scenario.seed, "trained_on": ground}
    return {"world": "procedural", "seed": world.scenario.seed}


def _detector(scenario: Scenario) -> dict[str, Value]:
    """Network on board with the threshold in force."""
    section = scenario.detector
    onnx = OnnxDetector(network_octets(section.network), detector_parameters(scenario))
    return {
        "network": section.network if section.network in NETWORKS else Path(section.network).name,
        "sha256": onnx.sha256,
        "score_threshold": onnx.score_threshold,
        "max_detections": section.max_detections,
    }


def _requirements(scenario: Scenario) -> dict[str, Value]:
    section, flown = scenario.requirements, scenario.navigation.estimators
    values = asdict(section) | {"estimator": section.estimator or ("anchored" if "anchored" in flown else flown[0])}
    negative = {name for name, limit in values.items() if isinstance(limit, float) and limit < 0.0}
    left_out = negative - {"temperature_min_c"}
    return {name: limit for name, limit in values.items() if limit is not None and name not in left_out}


def _toml(value: Value) -> str:
    if isinstance(value, str) and "\n" in value and "'''" not in value:
        return f"'''\n{value}'''"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return toml_text(value)
