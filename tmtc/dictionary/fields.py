"""Fields of packets, those of housekeeping, and on-board parameters. Tables of names need no numerical library."""

import math
from dataclasses import dataclass

from tmtc.dictionary.codes import CLOCK_STATES, IMAGE_QUALITIES, MODES


@dataclass(frozen=True, slots=True)
class Field:
    """One number of a packet, or `size` numbers of one kind.

    `minimum` and `maximum` are engineering values refused on packing; `warning` and `alarm` are (low, high)
    limits for monitoring on the ground. `saturate` clips what does not fit instead of refusing it.
    `missing` is the raw code of "not known" (engineering NaN).
    """

    name: str
    type: str
    description: str
    unit: str = ""
    size: int = 1
    scale: float = 1.0
    offset: float = 0.0
    labels: tuple[tuple[int, str], ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    missing: int | None = None
    saturate: bool = False
    warning: tuple[float, float] | None = None
    alarm: tuple[float, float] | None = None

    @property
    def is_float(self) -> bool:
        """Return whether it is stored as an IEEE 754 number."""
        return self.type[0] == "f"

    @property
    def is_calibrated(self) -> bool:
        """Return whether the engineering value differs from the raw one."""
        return self.scale != 1.0 or self.offset != 0.0 or self.missing is not None

    @property
    def octets(self) -> int:
        """Octets on the link."""
        return self.size * int(self.type[1:]) // 8

    @property
    def dtype(self) -> str:
        """The name of the big-endian numpy type of one element."""
        return f">{self.type[0]}{int(self.type[1:]) // 8}"

    @property
    def raw_limits(self) -> tuple[int, int]:
        """Least and greatest raw integer (integer types only)."""
        bits = int(self.type[1:])
        return (0, (1 << bits) - 1) if self.type[0] == "u" else (-(1 << bits - 1), (1 << bits - 1) - 1)

    def label(self, code: int) -> str:
        """The name of a raw code, or the number itself where it has none."""
        return dict(self.labels).get(int(code), str(int(code)))


HOUSEKEEPING_FIELDS = (
    Field("structure_id", "u16", "Housekeeping structure, always 1", minimum=1, maximum=1),
    Field("boot_count", "u16", "Boots since manufacture"),
    Field("mode", "u8", "Mode of the payload", labels=MODES),
    Field("frames_processed", "u32", "Frames handed to the detector since boot"),
    Field("frames_bad", "u32", "Frames refused for their image quality since boot"),
    Field("detections_total", "u32", "Craters detected since boot"),
    Field("packets_sent", "u32", "Telemetry packets made since boot"),
    Field("anchor_reads", "u32", "Reads of the anchor ephemeris since boot, all estimators"),
    Field("events_sent", "u32", "Event packets made since boot"),
    Field("telecommands_accepted", "u16", "Telecommands accepted since boot"),
    Field("telecommands_rejected", "u16", "Telecommands rejected since boot"),
    Field("last_image_quality", "u8", "Verdict on the last image", labels=IMAGE_QUALITIES),
    Field(
        "temperature_c", "i16", "Temperature of the processor board", "degC", scale=0.01,
        saturate=True, warning=(-20.0, 60.0), alarm=(-40.0, 85.0),
    ),
    Field(
        "bus_voltage_v", "u16", "Voltage of the supply bus", "V", scale=0.001, saturate=True,
        warning=(11.0, 13.0), alarm=(10.0, 14.0),
    ),
    Field(
        "power_w", "u16", "Power drawn by the payload", "W", scale=0.01, saturate=True,
        warning=(0.0, 15.0), alarm=(0.0, 20.0),
    ),
    Field("memory_used_kib", "u32", "Memory in use", "KiB"),
    Field("queue_depth", "u16", "Telemetry packets waiting for downlink"),
    Field(
        "storage_used_permille", "u16", "Packet store in use", "1/1000", maximum=1000,
        warning=(0.0, 800.0), alarm=(0.0, 950.0),
    ),
    Field("model_hash", "u32", "First 32 bits of the SHA-256 of the detector model"),
    Field("parameters_hash", "u32", "First 32 bits of the SHA-256 of the parameter table"),
    Field("catalogue_hash", "u32", "First 32 bits of the SHA-256 of the catalogue table"),
    Field("anchor_table_hash", "u32", "First 32 bits of the SHA-256 of the anchor ephemeris"),
    Field("clock_status", "u8", "State of the on-board clock", labels=CLOCK_STATES),
    Field("watchdog_resets", "u16", "Resets by the watchdog since manufacture"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Parameter:
    """One on-board parameter; `whole` ones take integers only."""

    number: int
    name: str
    default: float
    minimum: float
    maximum: float
    unit: str
    meaning: str
    whole: bool = False

    def accepts(self, value: float) -> bool:
        """Return whether the value lies within the limits (NaN does not) and is whole where it must be."""
        return self.minimum <= value <= self.maximum and not (self.whole and value != math.floor(value))


PARAMETERS = (
    Parameter(1, "housekeeping_interval_s", 60.0, 1.0, 3600.0, "s", "Time between housekeeping packets"),
    Parameter(2, "performance_interval_s", 300.0, 1.0, 86_400.0, "s", "Time between performance packets"),
    Parameter(3, "detector_score_floor", 0.0, 0.0, 1.0, "", "Detections with a lower score are not used"),
    Parameter(
        4, "detector_timeout_s", 12.0, 0.05, 120.0, "s", "Detections that take longer are not used any more"
    ),
    Parameter(
        5, "detector_failures", 5.0, 1.0, 1000.0, "", "Failures of the detector in a row that end in safe", True
    ),
    Parameter(6, "temperature_low_c", -20.0, -60.0, 20.0, "degC", "Board temperature reported as low"),
    Parameter(7, "temperature_high_c", 60.0, 20.0, 100.0, "degC", "Board temperature reported as high"),
    Parameter(8, "temperature_safe_c", 75.0, 30.0, 120.0, "degC", "Board temperature that ends in safe"),
    Parameter(9, "voltage_low_v", 10.5, 6.0, 14.0, "V", "Bus voltage reported as low"),
    Parameter(10, "voltage_safe_v", 9.5, 5.0, 14.0, "V", "Bus voltage that ends in safe"),
    Parameter(11, "memory_high_kib", 262_144.0, 1024.0, 16_777_216.0, "KiB", "Memory in use reported as high"),
    Parameter(12, "streak_frames", 8.0, 2.0, 1000.0, "", "Dark or saturated images in a row reported once", True),
    Parameter(13, "camera_fault_frames", 3.0, 1.0, 100.0, "", "Frames without image that cycle the camera", True),
    Parameter(14, "camera_cycles", 3.0, 1.0, 100.0, "", "Cycles without effect that end the observation", True),
    Parameter(15, "scrub_interval_s", 60.0, 1.0, 86_400.0, "s", "Time between checks of memory"),
    Parameter(16, "store_overwrite", 1.0, 0.0, 1.0, "", "Full store: 1 overwrites the oldest, 0 keeps it", True),
    Parameter(17, "schedule_tolerance_s", 30.0, 0.0, 86_400.0, "s", "Activities later than this are expired"),
    Parameter(18, "autoresume", 1.0, 0.0, 1.0, "", "Whether an unwanted reset resumes the observation", True),
    Parameter(19, "watchdog_limit", 3.0, 1.0, 100.0, "", "Watchdog resets within an hour that end in safe", True),
    Parameter(20, "clock_jump_s", 2.0, 0.1, 3600.0, "s", "Disagreement of clocks that is a jump"),
    Parameter(21, "thumbnail_interval", 0.0, 0.0, 100_000.0, "", "Frames between thumbnails, 0 for none", True),
    Parameter(22, "thumbnail_factor", 8.0, 1.0, 64.0, "", "Pixels averaged along each axis of a thumbnail", True),
    Parameter(23, "large_data_part", 900.0, 16.0, 4096.0, "", "Octets in a part of large data", True),
    Parameter(24, "image_reports", 0.0, 0.0, 1.0, "", "Whether each image is reported with checksums", True),
)  # fmt: skip

_BY_NUMBER = {parameter.number: parameter for parameter in PARAMETERS}
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


def find_parameter(number: object) -> Parameter | None:
    """The parameter of that number, None where there is none."""
    return _BY_NUMBER.get(number) if type(number) is int else None
