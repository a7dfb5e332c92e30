"""On-board parameters (PUS service 20): what can be changed in flight, between which limits."""

import math
from dataclasses import dataclass


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
