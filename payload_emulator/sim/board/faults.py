"""Faults to inject: what breaks, when, for how long, how badly; written as a line of text each.

`KIND at SECONDS [for SECONDS] [size NUMBER]`, seconds after the first frame of the scenario.
"""

import re
from dataclasses import dataclass

from payload_emulator.errors import ScenarioError


@dataclass(frozen=True, slots=True)
class FaultKind:
    """Effect of a kind of fault; `size` is its default and its unit."""

    name: str
    meaning: str
    size: float = 1.0
    unit: str = ""
    lasts: bool = False


FAULT_KINDS = {
    kind.name: kind
    for kind in (
        FaultKind("camera_dark", "the camera sees nothing but its noise", lasts=True),
        FaultKind("camera_saturated", "every pixel is full", lasts=True),
        FaultKind("camera_dead", "the camera gives no image until it is switched off and on", lasts=True),
        FaultKind("camera_lost", "the camera gives no image, whatever is done", lasts=True),
        FaultKind("detector_slow", "the detector takes longer", 30.0, "times", lasts=True),
        FaultKind("detector_error", "the inference library throws", lasts=True),
        FaultKind("processor_hang", "the processor stops in the detector"),
        FaultKind("model_flip", "bits of the model in memory change", 1.0, "bits"),
        FaultKind("table_flip", "bits of the catalogue in memory change", 1.0, "bits"),
        FaultKind("parameters_flip", "bits of the parameters in memory change", 1.0, "bits"),
        FaultKind("model_lost", "the model changes in memory and in its kept copy", 1.0, "bits"),
        FaultKind("store_flip", "bits of the packet store change", 64.0, "bits"),
        FaultKind("settings_flip", "bits of the newest settings change before a reset", 64.0, "bits"),
        FaultKind("settings_lost", "both copies of the settings are overwritten before a reset"),
        FaultKind("clock_jump", "the clock jumps", 30.0, "s"),
        FaultKind("attitude_lost", "the ADCS sends nothing", lasts=True),
        FaultKind("power_cut", "the supply fails for a moment"),
        FaultKind("undervoltage", "the bus voltage drops", 3.0, "V", lasts=True),
        FaultKind("overheating", "the board gets hotter", 70.0, "K", lasts=True),
    )
}
_PATTERN = re.compile(
    r"(?P<kind>\w+)\s+at\s+(?P<at>[-+.\w]+)(?:\s+for\s+(?P<lasts>[-+.\w]+))?(?:\s+size\s+(?P<size>[-+.\w]+))?"
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; it is present from `at_s` to before `at_s + duration_s`."""

    kind: str
    at_s: float
    duration_s: float
    size: float

    def present(self, second: float) -> bool:
        """Return whether it is present at a second after the first frame."""
        return self.at_s <= second < self.at_s + self.duration_s


def parse_fault(text: str) -> Fault:
    """The fault of a line of text.

    Raises
    ------
    ScenarioError
        The line is of another form, or names a kind that there is not.
    """
    match = _PATTERN.fullmatch(text.strip())
    try:
        if match is None:
            raise ValueError
        at_s = float(match["at"])
        lasts_s = float(match["lasts"] or 0.0)
        size = None if match["size"] is None else float(match["size"])
    except ValueError:
        raise ScenarioError(
            f"fault {text!r}: expected KIND at SECONDS [for SECONDS] [size NUMBER], found something else"
        ) from None
    kind = FAULT_KINDS.get(match["kind"])
    if kind is None:
        raise ScenarioError(f"fault {text!r}: expected one of {', '.join(FAULT_KINDS)}, found {match['kind']!r}")
    if kind.lasts and lasts_s <= 0.0:
        raise ScenarioError(f"fault {text!r}: expected how long it lasts ('for SECONDS'), found no time above 0")
    return Fault(kind.name, at_s, lasts_s, kind.size if size is None else size)
