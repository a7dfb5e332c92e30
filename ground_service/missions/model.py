"""Mission description: `mission.toml` as a typed value, and its revisions.

A value that the document does not state is None ("not stated"); there are no defaults. Unknown keys are refused with
the nearest known key. Angles are in degrees; lengths are in metres or kilometres, as given by the key.
"""

from __future__ import annotations

import difflib
import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import AfterValidator, Field, ValidationError, model_validator

from ground_service.errors import InvalidInput
from ground_service.http.model import Entity, InstanceName, UtcTime
from ground_service.missions.automation import Array, Automation, Channel, ChannelName, Section, Table, without_rules
from ground_service.toml import faults, keys_at, read_table
from lunar.boxes import Box, Region
from lunar.errors import TimeFormatError
from lunar.plausible import CAMERA_FIELD_DEG, CAMERA_PIXELS, EXPOSURE_S, MAP_SHIFT_M, REFERENCE_SIGMA_M, Limit
from lunar.timescales import parse_utc
from reports.values import NotNegative, Positive, Requirements, Share
from tmtc.dictionary.effects import EFFECTS, FUNCTION, Effect
from tmtc.dictionary.payload import DICTIONARY

SCHEMA_VERSION: Final = 1
MISSION_LIMIT_OCTETS = 1 << 20
LINKS_LIMIT = 100
"""Most links of a description: each takes threads of a process."""

EPOCH_TAI = " TAI"
XTCE_COMPRESSED = "gzip:"
DICTIONARY_APIDS = frozenset(one.apid for one in (*DICTIONARY.telemetry, *DICTIONARY.telecommands))
NOT_STATED = "not stated"


def _within(limit: Limit) -> Any:
    return Field(ge=limit.low, le=limit.high)


MapShift = Annotated[float, Field(ge=-MAP_SHIFT_M, le=MAP_SHIFT_M)]
ReferenceSigma = Annotated[float, _within(REFERENCE_SIGMA_M)]


def _known_subject(subject: str) -> str:
    if subject not in EFFECTS:
        near = difflib.get_close_matches(subject, EFFECTS, n=1)
        raise ValueError(f"'{near[0]}'" if near else "a telecommand or function of the dictionary")
    return subject


CommandSubject = Annotated[str, AfterValidator(_known_subject)]


class Spacecraft(Section):
    """Spacecraft identification; `object_names` are those in ephemerides (OBJECT_NAME), in addition to `name`."""

    id: Annotated[int, Field(ge=0, le=1023)] | None = None
    name: str | None = None
    object_names: Annotated[tuple[str, ...], Array] | None = None

    def is_object(self, name: str) -> bool:
        """Return whether an ephemeris of an object is one of this spacecraft; any is if no name is stated."""
        known = [one.casefold() for one in (self.name, *(self.object_names or ())) if one]
        return not known or name.casefold() in known


class DictionarySection(Section):
    """Packet dictionary of the telemetry."""

    version: int | None = None
    hash: str | None = None


class FrameSettings(Section):
    """Settings of frames; `frame_checksum` is the frame error control field (FECF).

    `packet_prefix_octets`: octets before each packet of recordings without frames.
    """

    frame_length: int | None = None
    coding: Literal["rs", "none"] | None = None
    randomiser: Literal["legacy", "long", "none"] | None = None
    interleave: int | None = None
    rs_errors: int | None = None
    dual_basis: bool | None = None
    frame_checksum: bool | None = None
    packet_prefix_octets: Annotated[int, Field(ge=0, le=1024)] | None = None


def _span(text: str) -> str:
    start, _, stop = text.partition("/")
    try:
        forwards = parse_utc(start) < parse_utc(stop)
    except TimeFormatError as error:
        raise ValueError(f"START/STOP in UTC: {error}") from None
    if not forwards:
        raise ValueError("START/STOP with a stop after the start")
    return text


Span = Annotated[str, AfterValidator(_span)]


class StationLink(FrameSettings):
    """Place of a ground station, its records, and settings of its link that differ from those of the spacecraft.

    Attributes
    ----------
    header_octets, trailer_octets
        Octets before and after each CADU.
    time_code, time_offset
        Reception time in the header, from this octet on: "cds" (16-bit days from 1958-01-01, 32-bit milliseconds) or
        "unix_ns" (64-bit nanoseconds from 1970-01-01), both UTC and most significant octet first.
    latitude_deg, longitude_deg, height_m
        WGS 84, longitude to the east.
    minimum_elevation_deg
        Lowest elevation at which the station works.
    downlink_bps, uplink_bps
        Rates, bits of packets in a second.
    outages
        Spans without contacts, such as ``2029-08-10T00:00:00Z/2029-08-10T06:00:00Z``.
    """

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180.0, le=360.0)] | None = None
    height_m: Annotated[float, Field(ge=-500.0, le=9000.0)] | None = None
    minimum_elevation_deg: Annotated[float, Field(ge=0.0, lt=90.0)] | None = None
    downlink_bps: Positive | None = None
    uplink_bps: Positive | None = None
    outages: Annotated[tuple[Span, ...], Array] | None = None
    header_octets: Annotated[int, Field(ge=0, le=1024)] | None = None
    trailer_octets: Annotated[int, Field(ge=0, le=1024)] | None = None
    time_code: Literal["cds", "unix_ns"] | None = None
    time_offset: Annotated[int, Field(ge=0, le=1024)] | None = None

    @model_validator(mode="after")
    def _whole_place(self) -> StationLink:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("latitude_deg and longitude_deg together, found one of them")
        return self

    @model_validator(mode="after")
    def _time_in_header(self) -> StationLink:
        if (self.time_code is None) != (self.time_offset is None):
            raise ValueError("time_code and time_offset together, found one of them")
        if self.time_code is not None and self.time_offset is not None:
            end = self.time_offset + (6 if self.time_code == "cds" else 8)
            if end > (self.header_octets or 0):
                raise ValueError(f"a header of at least {end} octets for its time, found {self.header_octets or 0}")
        return self


StationName = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]*$")]


class Link(FrameSettings):
    """Settings of the telemetry link, by station where they differ."""

    packet_checksum: Literal["crc16", "none"] | None = None
    virtual_channels: Annotated[tuple[int, ...], Array] | None = None
    stations: dict[StationName, StationLink] | None = None


def _utc(text: str) -> str:
    try:
        parse_utc(text)
    except TimeFormatError as error:
        raise ValueError(f"a time in UTC: {error}") from None
    return text


def _epoch(text: str) -> str:
    try:
        parse_utc(text.removesuffix(EPOCH_TAI))
    except TimeFormatError as error:
        raise ValueError(f"an epoch such as 1958-01-01T00:00:00 TAI: {error}") from None
    return text


class MissionClock(Section):
    """Clock of the mission time, at which plans, contacts and ages of values are counted.

    Attributes
    ----------
    source
        "wall": the time of day. "telemetry": it stands at the newest telemetry. "simulated": it was `mission` when the
        time of day was `wall` (UTC), and `rate` seconds pass in a second.
    """

    source: Literal["wall", "telemetry", "simulated"]
    mission: Annotated[str, AfterValidator(_utc)] | None = None
    wall: Annotated[str, AfterValidator(_utc)] | None = None
    rate: Positive = 1.0

    @model_validator(mode="after")
    def _both_times(self) -> MissionClock:
        stated = (self.mission is not None, self.wall is not None)
        if stated != (self.source == "simulated",) * 2:
            raise ValueError("mission and wall with a simulated clock, and with no other")
        return self


class Time(Section):
    """On-board time and its correlation with UTC."""

    epoch: Annotated[str, AfterValidator(_epoch)] | None = None
    ticks_per_second: Annotated[int, Field(ge=1)] | None = None
    clock: str | None = None
    correlation: Literal["automatic", "manual", "ideal"] | None = None
    mission_clock: MissionClock | None = None


class Frames(Section):
    """Orientation of the Moon and gravity fields, by name.

    The `onboard` values are those of the on-board tables; the ground smoother uses the on-board gravity field.
    """

    orientation: str | None = None
    gravity_field: str | None = None
    gravity_degree: Annotated[int, Field(ge=0)] | None = None
    onboard_orientation: str | None = None
    onboard_gravity_field: str | None = None
    onboard_gravity_degree: Annotated[int, Field(ge=0)] | None = None


class Camera(Section):
    """Intrinsics, lens, mounting and exposure.

    `pointing` "nadir": the body points to the centre of the Moon with north up. The camera is rotated from this
    attitude by `yaw_deg` clockwise and then by `tilt_deg` from the boresight toward image up. `k1` to `p2` are Brown's
    coefficients of the lens.
    """

    width_px: Annotated[int, _within(CAMERA_PIXELS)] | None = None
    height_px: Annotated[int, _within(CAMERA_PIXELS)] | None = None
    fov_deg: Annotated[float, _within(CAMERA_FIELD_DEG)] | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    p1: float | None = None
    p2: float | None = None
    pointing: Literal["nadir", "attitude"] | None = None
    tilt_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    yaw_deg: Annotated[float, Field(ge=-360.0, le=360.0)] | None = None
    exposure_s: Annotated[float, _within(EXPOSURE_S)] | None = None
    frame_interval_s: Positive | None = None


class Catalogue(Section):
    """Crater catalogue and its registration to the terrain.

    `sha256` names a catalogue that the ground holds; without it, `source` is the name of a public product. The
    registration is the mean shift from the listed craters to the terrain near the frames, with its standard deviation
    per axis and the number of rims that it was fitted to; it is contained in the positions of an archive's catalogue.
    `registered_share` is the share of frames over ground where there is one: 0 if the catalogue is not registered.
    `offset_sigma_m` (east, north, up) is the 1-sigma offset that all craters have in common, as the payload assumes it
    at its start, `offset_correlation_deg` the arc over which it is similar (1/e).
    """

    source: str | None = None
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    registration_north_m: MapShift | None = None
    registration_east_m: MapShift | None = None
    registration_sigma_m: NotNegative | None = None
    registration_rims: Annotated[int, Field(ge=0)] | None = None
    registered_share: Share | None = None
    offset_sigma_m: Annotated[tuple[NotNegative, NotNegative, NotNegative], Array] | None = None
    offset_correlation_deg: Positive | None = None


class Detector(Section):
    """Crater network on board: name, hash of its file, threshold in force, largest number of detections of a frame."""

    network: str | None = None
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    score_threshold: Share | None = None
    max_detections: Annotated[int, Field(ge=1)] | None = None


class Reference(Section):
    """Source of the reference ephemeris, and its 1-sigma error in radial, transverse and normal."""

    source: str | None = None
    sigma_rtn_m: Annotated[tuple[ReferenceSigma, ReferenceSigma, ReferenceSigma], Array] | None = None
    correlation_time_s: Positive | None = None


World = Literal["unit-geometry", "procedural", "real-terrain", "other-renderer", "photographs"]
Level = Literal["1", "2", "3s", "3", "4", "5"]

LEVEL_WORDS: dict[Level, str] = {
    "1": "unit geometry",
    "2": "procedural Moon",
    "3s": "real terrain seen in training",
    "3": "real terrain never used in training",
    "4": "another renderer",
    "5": "real photographs",
}


def _box(limits: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    west, east, south, north = limits
    if not (-360.0 <= west < east <= west + 360.0 <= 1080.0 and -90.0 <= south < north <= 90.0):
        raise ValueError("west, east, south and north in degrees")
    return limits


BoxLimits = Annotated[tuple[float, float, float, float], Array, AfterValidator(_box)]


class TrainedGround(Section):
    """Ground used in training: in `boxes`, and further than `buffer_km` from those of `avoid`.

    Boxes are west, east, south and north in degrees.
    """

    boxes: Annotated[tuple[BoxLimits, ...], Array]
    avoid: Annotated[tuple[BoxLimits, ...], Array] = ()
    buffer_km: NotNegative = 0.0


class Evidence(Section):
    """Simulated or real world of the flight, from which the evidence level follows.

    `unseen_share` is the share of frames over real terrain that was not used in training. With `trained_on` it is that
    of each pass, by the ground track of its frames.
    """

    world: World | None = None
    seed: int | None = None
    unseen_share: Share | None = None
    trained_on: Annotated[tuple[TrainedGround, ...], Array] | None = None

    @property
    def trained_regions(self) -> tuple[Region, ...] | None:
        """Return the ground used in training; None if it is not stated."""
        if self.trained_on is None:
            return None
        return tuple(
            Region(tuple(Box(*one) for one in part.boxes), tuple(Box(*one) for one in part.avoid), part.buffer_km)
            for part in self.trained_on
        )

    @property
    def level(self) -> Level | None:
        """Evidence level; None if the stated values do not determine it."""
        if self.world == "real-terrain":
            if self.unseen_share is None:
                return None
            return "3" if self.unseen_share == 1.0 else "3s"
        levels: dict[str | None, Level] = {
            "unit-geometry": "1",
            "procedural": "2",
            "other-renderer": "4",
            "photographs": "5",
        }
        return levels.get(self.world)

    @property
    def text(self) -> str:
        """Level with its words, such as "3s (real terrain seen in training; 25 % of frames unseen)"; "" if unknown."""
        level = self.level
        if level is None:
            return ""
        words = LEVEL_WORDS[level]
        if level == "3s" and self.unseen_share:
            words += f"; {100.0 * self.unseen_share:.0f} % of frames over unseen terrain"
        return f"{level} ({words})"


def weakest_evidence(worlds: Sequence[Evidence]) -> str:
    """Return the text of the lowest of several levels; "" if there are none or one is unknown."""
    order = list(LEVEL_WORDS)
    levels = [one.level for one in worlds]
    if not levels or None in levels:
        return ""
    return min(worlds, key=lambda one: order.index(one.level or "1")).text


class Observation(Section):
    """Limits of where and when images can be taken.

    Attributes
    ----------
    latitude_limit_deg
        Largest latitude of the sub-satellite point, north and south: beyond it the ground in view has no data.
    needs_daylight
        Whether the Sun has to be above the horizon of the sub-satellite point; a simulated world can draw its light.
        Not stated: yes with a stated camera.
    """

    latitude_limit_deg: Annotated[float, Field(gt=0.0, le=90.0)] | None = None
    needs_daylight: bool | None = None


class DeclaredWorld(Section):
    """Simulated world of an emulated mission, from which images of a pass are rendered again; a real mission has none.

    Attributes
    ----------
    scenario
        Scenario of the emulator (TOML) with all seeds. The ground gives it to the renderer and does not read it.
    """

    scenario: Annotated[str, Field(max_length=100_000)] | None = None


class Experiment(Section):
    """Start of the windows for measuring how well the payload navigates without help.

    A window of the experiment starts from an orbit of a stated age and error. Other windows start from the best known
    orbit, and propagating it is no rival.

    Attributes
    ----------
    windows
        Windows of the experiment: all, or the first one of each day in UTC. Not stated: all.
    orbit_error_m
        Error of the position that estimators start from, 1 sigma per axis. That of the velocity is this error times the
        mean motion. Without it, there is no experiment.
    orbit_age_h
        The orbit is that of an ephemeris whose arc begins so long before the window, or earlier; not stated: the best.
    """

    windows: Literal["all", "first_of_day"] | None = None
    orbit_error_m: Positive | None = None
    orbit_age_h: NotNegative | None = None


class Uploads(Section):
    """Tables that the ground makes and uploads for each observation window.

    With this section, the payload is commanded to standby before a window and to the downlink after it.

    Attributes
    ----------
    sigma_position_m, sigma_velocity_m_s
        Declared accuracy of the uploaded start state, 1 sigma per axis.
    """

    tables: Annotated[tuple[Literal["orientation", "anchor_ephemeris", "initial_state"], ...], Array] = ()
    sigma_position_m: Positive | None = None
    sigma_velocity_m_s: Positive | None = None


class Approval(Section):
    """Rules for the approval of telecommands.

    `second_person_for` and `one_person_for` change the rule of the packet dictionary. They list telecommands, or
    functions such as ``perform_function/set_mode``, that need two persons or one person for release.
    """

    windows: Literal["manual", "automatic"] | None = None
    second_person_for: Annotated[tuple[CommandSubject, ...], Array] | None = None
    one_person_for: Annotated[tuple[CommandSubject, ...], Array] | None = None

    @model_validator(mode="after")
    def _not_both(self) -> Approval:
        both = set(self.second_person_for or ()) & set(self.one_person_for or ())
        if both:
            raise ValueError(f"each telecommand in one list, found {min(both)} in both")
        return self

    def needs_second_person(self, subject: str) -> bool:
        """Return whether a telecommand, or one of its functions, needs a second person for release.

        By the packet dictionary: all that change on-board state or destroy data, and those whose effect is unknown.
        """
        if subject not in EFFECTS or subject in (self.second_person_for or ()):
            return True
        return subject not in (self.one_person_for or ()) and EFFECTS[subject].effect is not Effect.ROUTINE


LinkName = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class StationConnection(Section):
    """Connection of the service to a ground station: telemetry in, telecommands out.

    Attributes
    ----------
    kind
        "tcp": the service connects to ports of the station. "file": the station shares folders with the service.
    station
        Name in `link.stations`, with the records and the place of the station.
    downlink, uplink
        ``HOST:PORT`` of a TCP connection, or the absolute path of a folder.
    send
        "automatic": released telecommands are sent in the next contact. "manual": on request only.
    acknowledge
        The service returns the number of durably stored octets on the telemetry connection.
    confirm
        The station takes telecommands as numbered transmissions and confirms each; it sends no number up twice.
    silence_s
        A contact has ended when no telemetry was received for this time.
    """

    name: LinkName
    kind: Literal["tcp", "file"]
    station: StationName | None = None
    instance: InstanceName = "flight"
    downlink: str | None = None
    uplink: str | None = None
    format: Literal["cltu", "packets"] = "cltu"
    send: Literal["automatic", "manual"] = "automatic"
    reconnect: bool = True
    acknowledge: bool = False
    confirm: bool = False
    silence_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = 60.0

    @model_validator(mode="after")
    def _addresses(self) -> StationConnection:
        if self.downlink is None and self.uplink is None:
            raise ValueError("downlink, uplink or both, found neither")
        for key in ("downlink", "uplink"):
            value = getattr(self, key)
            if value is None:
                continue
            host, _, port = value.rpartition(":")
            if self.kind == "tcp" and not (host and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
                raise ValueError(f"{key} as HOST:PORT, found {value[:80]!r}")
            if self.kind == "file" and not value.startswith("/"):
                raise ValueError(f"{key} as the absolute path of a folder, found {value[:80]!r}")
        if self.kind == "file" and self.downlink == self.uplink:
            raise ValueError("different folders for downlink and uplink, found one for both")
        return self


class SpacecraftResources(Section):
    """Resources of the spacecraft for the plan; values that are not stated are those of the request or the defaults.

    Attributes
    ----------
    observe_hours_per_day
        Largest duration of observation windows that begin within 24 hours.
    windows_on_board
        Largest number of windows whose telecommands wait on board; later ones are planned when one has flown.
    """

    storage_mib: Positive | None = None
    downlink_kbit_s: Positive | None = None
    battery_wh: Positive | None = None
    generation_w: NotNegative | None = None
    idle_w: NotNegative | None = None
    observing_w: NotNegative | None = None
    minimum_battery: Share | None = None
    observe_hours_per_day: Annotated[float, Field(gt=0.0, le=24.0)] | None = None
    windows_on_board: Annotated[int, Field(ge=1)] | None = None


class PacketTime(Section):
    """Time code in the secondary header of packets.

    Attributes
    ----------
    offset
        Octets from the start of the packet to the first octet of the code, its P-field included if there is one.
    whole_octets, fraction_octets
        CUC: octets of seconds (1 to 7) and of their fraction (0 to 10). CDS: octets of days (2 or 3) and below the
        millisecond (0, 2 or 4).
    epoch
        UTC of the zero of the code; with `` TAI`` at its end, TAI.
    clock
        "payload": the clock whose time reports are correlated with UTC. "own": another one, taken as correct. "unix":
        as "own", but seconds are counted without leap seconds, as by Unix time.
    """

    code: Literal["cuc", "cds"]
    offset: Annotated[int, Field(ge=6, le=4096)]
    p_field: bool
    whole_octets: Annotated[int, Field(ge=1, le=7)]
    fraction_octets: Annotated[int, Field(ge=0, le=10)]
    epoch: str
    clock: Literal["payload", "own", "unix"]

    @model_validator(mode="after")
    def _possible(self) -> PacketTime:
        if self.code == "cds" and self.whole_octets not in (2, 3):
            raise ValueError(f"2 or 3 octets of days in a CDS code, found {self.whole_octets}")
        if self.code == "cds" and self.fraction_octets not in (0, 2, 4):
            raise ValueError(f"0, 2 or 4 octets below the millisecond in a CDS code, found {self.fraction_octets}")
        if self.epoch.endswith(EPOCH_TAI) and (self.code == "cds" or self.clock == "unix"):
            raise ValueError("an epoch in UTC for a CDS code or a Unix clock, found one in TAI")
        _epoch(self.epoch)
        return self


class PacketSource(Section):
    """Packets of some APIDs that the packet dictionary of the payload does not define.

    `xtce` holds one or more XTCE documents, as texts or compressed (``gzip:`` and base64). In a file for
    `linna mission`, an entry can be the path of a document, which is embedded when the file is read. `container` names
    one container or several that packets begin with; by default all that inherit from none. `leading_size` is what the
    size before a text counts, if the documents do not show it.
    """

    name: Annotated[str, Field(min_length=1, max_length=64)]
    apids: Annotated[tuple[Annotated[int, Field(ge=0, le=2046)], ...], Array, Field(min_length=1)]
    packet_checksum: Literal["crc16", "none"]
    xtce: Annotated[tuple[str, ...], Array] | None = None
    container: str | Annotated[tuple[str, ...], Array, Field(min_length=1)] | None = None
    leading_size: Literal["octets", "bits"] | None = None
    time: PacketTime | None = None

    @model_validator(mode="after")
    def _texts(self) -> PacketSource:
        for text in self.xtce or ():
            if not text.lstrip().startswith(("<", XTCE_COMPRESSED)):
                raise ValueError(f"texts of XTCE documents, or files that `linna mission` reads, found {text[:80]!r}")
        for key in ("container", "leading_size"):
            if getattr(self, key) is not None and not self.xtce:
                raise ValueError(f"xtce documents with a {key}, found none")
        return self


class Mission(Section):
    """Mission description of one spacecraft."""

    schema_version: Literal[1] = SCHEMA_VERSION
    name: Annotated[str, Field(min_length=1, max_length=200)]
    spacecraft: Spacecraft = Spacecraft()
    dictionary: DictionarySection = DictionarySection()
    link: Link = Link()
    time: Time = Time()
    frames: Frames = Frames()
    camera: Camera = Camera()
    catalogue: Catalogue = Catalogue()
    detector: Detector = Detector()
    reference: Reference = Reference()
    evidence: Evidence = Evidence()
    observation: Observation = Observation()
    world: DeclaredWorld = DeclaredWorld()
    requirements: Annotated[Requirements, Table] = Requirements()
    experiment: Experiment = Experiment()
    automation: Automation = Automation()
    notify: dict[ChannelName, Channel] = Field(default_factory=dict)
    """Receivers of notifications by name."""

    approval: Approval = Approval()
    uploads: Uploads | None = None
    resources: SpacecraftResources = SpacecraftResources()
    links: Annotated[tuple[StationConnection, ...], Array, Field(max_length=LINKS_LIMIT)] | None = None
    packets: Annotated[tuple[PacketSource, ...], Array] | None = None
    procedures: dict[str, Annotated[str, Field(min_length=1, max_length=4000)]] = Field(default_factory=dict)
    """Procedures of the operator for alarms, by the name of event or parameter."""

    @model_validator(mode="after")
    def _links_once(self) -> Mission:
        names = Counter(one.name for one in self.links or ())
        for name, number in names.items():
            if number > 1:
                raise ValueError(f"each name of links once, found {name!r} again")
        if names and self.spacecraft.id is None:
            raise ValueError("a spacecraft id with links, found none")
        return self

    @model_validator(mode="after")
    def _apids_once(self) -> Mission:
        owner: dict[int, str] = {}
        for source in self.packets or ():
            for apid in source.apids:
                if apid in owner:
                    raise ValueError(f"each APID in one entry of packets, found {apid} in {owner[apid]!r} and again")
                if apid in DICTIONARY_APIDS:
                    raise ValueError(f"APIDs that the packet dictionary does not use, found {apid} in {source.name!r}")
                owner[apid] = source.name
        names = [source.name for source in self.packets or ()]
        if len(set(names)) < len(names):
            raise ValueError("each name of packets once, found one again")
        return self

    @property
    def critical_in_windows(self) -> tuple[str, ...]:
        """Telecommands of the sequence of a window that need a second person."""
        subjects = ["enable_schedule", f"{FUNCTION}/start_observation", f"{FUNCTION}/stop_observation"]
        if self.uploads is not None:
            subjects.append(f"{FUNCTION}/set_mode")
            if self.uploads.tables:
                subjects += ["uplink_first", "uplink_middle", "uplink_last"]
        return tuple(one for one in subjects if self.approval.needs_second_person(one))

    @property
    def revision(self) -> str:
        """SHA-256 of the stated values: the revision depends on the content and not on the layout of the document."""
        stated = self.model_dump(mode="json", exclude_none=True)
        text = json.dumps({k: v for k, v in stated.items() if v != {}}, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def words(self) -> str:
        """Return the stated numbers and times as read, by section, for `linna mission check`."""
        stated = self.model_dump(mode="json", exclude_none=True, exclude={"procedures", "notify", "world"})
        return "\n".join(
            f"{name}: {', '.join(_listed(section))}"
            for name, section in stated.items()
            if isinstance(section, (dict, list)) and section
        )

    @property
    def unknown(self) -> tuple[str, ...]:
        """Keys that are not stated, as ``section.key``, in the order of the document."""
        return tuple(_not_stated(self))


class MissionRevision(Entity):
    """Stored revision of a mission description."""

    id: int = Field(examples=[1])
    mission: str = Field(examples=["selenita"])
    revision: str = Field(description="SHA-256 of the stated values")
    spacecraft_id: int | None = Field(examples=[76])
    unknown: tuple[str, ...] = Field(description="Keys that the document does not state")
    entered: UtcTime
    entered_by: str


class MissionCheck(Entity):
    """Result of checking a text as a mission description; it was not added."""

    faults: tuple[str, ...] = Field(description="One line for each fault; empty if it can be added")
    unknown: tuple[str, ...] = Field(description="Keys that it does not state")
    changes: tuple[str, ...] = Field(description="Unified difference to the revision in force")
    windows: tuple[tuple[UtcTime, UtcTime], ...] = Field(default=(), description="Windows of the dry run")
    contradictions: tuple[str, ...] = Field(
        default=(), description="Findings of the dry run, such as a limit that excludes all windows"
    )


class HeldCatalogue(Entity):
    """Crater catalogue that the ground holds, for mission descriptions that name its hash."""

    sha256: str
    name: str = Field(examples=["craters.csv"])
    octets: int
    received: UtcTime


class MissionDetail(MissionRevision):
    """Stored revision with its document."""

    document: Mission
    text: str = Field(description="mission.toml as it was added")


def parse_mission(text: str, source: str = "mission.toml", *, stored: bool = False) -> Mission:
    """Return the mission description in `text`; an earlier version may have `stored` it, with rules that are ignored.

    Raises
    ------
    InvalidInput
        The text is not TOML, or has an unknown key or an invalid value; the message states the first fault.
    """
    result = read_document(text, source, stored=stored)
    if isinstance(result, Mission):
        return result
    raise result[0]


def read_document(text: str, source: str, *, stored: bool = False) -> Mission | list[InvalidInput]:
    """Return the mission description in `text` as `parse_mission` does, or all its faults."""
    try:
        table = read_table(text, source, "TOML")
        return Mission.model_validate(without_rules(table, source) if stored else table)
    except InvalidInput as error:
        return [error]
    except ValidationError as error:
        return faults(Mission, error, source)


def _listed(value: Any, path: str = "") -> Iterator[str]:
    """Yield the numbers, flags and short texts in a section, with their keys."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _listed(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for number, item in enumerate(value):
            yield from _listed(item, f"{path}.{number}" if path else str(number))
    else:
        yield f"{path} {json.dumps(value)[:80]}"


def _not_stated(section: Section | Requirements, path: str = "") -> Iterator[str]:
    for name in keys_at(type(section), ()):
        value = getattr(section, name)
        place = f"{path}{name}"
        if isinstance(value, Section | Requirements):
            yield from _not_stated(value, f"{place}.")
        elif value is None:
            yield place


def format_mission(mission: Mission) -> str:
    """Return TOML text that parses to an equal mission; values that are not stated are left out."""
    return format_toml(mission.model_dump(mode="json", exclude_none=True))


def format_toml(table: Mapping[str, Any]) -> str:
    """Return TOML text of a mission description that is given as a table."""
    lines = [f"{key} = {_toml(value)}" for key, value in table.items() if not isinstance(value, dict)]
    for name, section in table.items():
        if isinstance(section, dict) and section:
            lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in section.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(value)


assert set(LEVEL_WORDS) == set(get_args(Level))
