"""Loads of the flight software at boot: parameters of its build, and tables."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, fields

from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.odometry.odometry import OdometryParameters
from payload_emulator.flight.navigation.outcomes import Mode
from tmtc.dictionary import tables

# Numbers of tables, as in the dictionary's table of tables.
TABLE_NUMBERS = {"anchor_ephemeris": 1, "catalogue": 2, "gravity": 3, "orientation": 8, "initial_state": 9, "burns": 10}
MODEL_NUMBER = 5
UNPACKERS: dict[str, Callable[[bytes], object]] = {
    "anchor_ephemeris": tables.unpack_anchor_table,
    "catalogue": tables.unpack_catalogue_table,
    "gravity": tables.unpack_gravity_table,
    "orientation": tables.unpack_orientation_table,
    "initial_state": tables.unpack_initial_state,
    "burns": tables.unpack_burn_table,
}


@dataclass(frozen=True, slots=True)
class FlightParameters:
    """Constants of a build of the payload; those that may change in flight are in `parameters`.

    Attributes
    ----------
    camera
        The camera as calibrated on the ground.
    modes
        Estimators to run on each frame's detections.
    odometry
        Rules of `paper` and `spherical`.
    anchored
        Rules of `anchored`.
    housekeeping_interval_s
        Time between housekeeping packets until it is changed by telecommand.
    image_reports
        Whether each image is reported with checksums until it is changed by telecommand.
    time_reports
        Whether a time report is sent each 16 frames of telemetry until it is changed by telecommand.
    scrub_interval_s
        Time between checks of memory until it is changed by telecommand.
    """

    camera: PinholeCamera = field(default_factory=PinholeCamera)
    modes: tuple[Mode, ...] = (Mode.paper, Mode.spherical)
    odometry: OdometryParameters = field(default_factory=OdometryParameters)
    anchored: AnchoredParameters = field(default_factory=AnchoredParameters)
    housekeeping_interval_s: float = 60.0
    # Without reports the text, and so the hash in telemetry, is that of builds that knew none.
    image_reports: bool = field(default=False, repr=False)
    time_reports: bool = field(default=False, repr=False)
    scrub_interval_s: float = field(default=60.0, repr=False)

    @property
    def hash(self) -> int:
        """First 32 bits of the SHA-256 of the parameters as text."""
        return int(self.sha256[:8], 16)

    @property
    def sha256(self) -> str:
        """SHA-256 of the parameters as text, hexadecimal."""
        reports = "image_reports" if self.image_reports else ""
        # Parameters that older builds did not have enter the hash only if they differ from the default.
        added = ((getattr(self.anchored, one.name), one.default) for one in fields(AnchoredParameters) if not one.repr)
        changed = "".join(repr(value) for value, default in added if value != default)
        return hashlib.sha256((repr(self) + reports + changed).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class FlightTables:
    """Tables as uploaded; empty octets where there is none.

    `paper` and `spherical` need the anchor ephemeris; `anchored` needs all the others but the burns, which are only
    there where some are planned, and never reads that one.
    """

    anchor_ephemeris: bytes = b""
    catalogue: bytes = b""
    gravity: bytes = b""
    orientation: bytes = b""
    initial_state: bytes = b""
    burns: bytes = b""
