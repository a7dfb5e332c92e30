"""Payload part of the interface control document: ports, modes, parameters and faults."""

import inspect

from payload_emulator.flight.onboard.modes import ALL_MODES, ALLOWED, TRANSITIONS, PayloadMode
from payload_emulator.flight.ports import SENSORS, Board, Load, ResetCause, Stage
from payload_emulator.flight.telemetry.store import SHARES, StoreClass
from tmtc.dictionary.fields import PARAMETERS, Parameter

_PORTS = {
    "EPS": (("sensors", "switch"), "power in, switched loads"),
    "ADCS and OBDH": (("uptime_ticks",), "attitude and time; see also the arguments of a step"),
    "TM/TC": (("downlink_octets",), "telemetry out, telecommands in; see also the arguments of a step"),
    "Processor": (("enter", "memory_octets", "load", "request_reset"), "the board that runs the software"),
    "Non-volatile memory": (("read_table", "write_table"), "in addition to the attributes `store` and `settings`"),
}

_STEP = """\
# Interface control document: the payload in its spacecraft

The interfaces of Fig. 1 of the paper. Only arrays, counts and octets cross them.

## A step

The spacecraft calls `Payload.step(image, attitude, clock_ticks, telecommand_octets)` for every frame, and
occasionally without an image. It returns telemetry packets.

| argument | from | content |
|---|---|---|
| image | camera | (H, W) or (H, W, 3), unsigned integers or fractions; no pixels if the camera delivered no image |
| attitude | ADCS | seven f64: q_wxyz of camera from ICRF, unit Sun vector in the camera frame; NaN where absent |
| clock_ticks | OBDH | on-board time of the image, 2^-16 s |
| telecommand_octets | TM/TC | telecommand packets received since the preceding step, concatenated |
| returned | TM/TC | telemetry packets, at most `downlink_octets` in total |
"""

_FAULTS = """\
## Faults and reactions

| fault | event | reaction |
|---|---|---|
| dark, saturated or uniform images | image_dark, image_saturated, image_uniform | the frame is not used; a \
lasting streak is reported at its beginning and end (image_streak) |
| no image | camera_fault, camera_recovered | the camera is switched off and on; after `camera_cycles` the \
observation ends |
| no attitude | attitude_missing | only the odometry estimators process the frame |
| detector too slow | detector_timeout | its detections are not used; `detector_failures` in a row: safe |
| detector raises an exception | detector_error | the frame is not used; `detector_failures` in a row: safe |
| estimate cannot be inverted | estimator_error | the estimator restarts from its tables |
| filter diverges | filter_divergence, filter_reset | the search for craters is widened until it is found again |
| attitude noisier than declared | attitude_degraded, attitude_restored | the estimated noise is used in place of \
the declared one until it is restored |
| the crater list has an offset of another size than believed | map_offset | the size, learned from the fixes, is \
used from then on; it is kept until another catalogue is loaded or the estimators are reset |
| detections have another noise than stated | detection_noise | the factor, learned from the fixes, is used and kept \
like the offset |
| processor hangs | watchdog_reset | reset by the watchdog; the observation is resumed; `watchdog_limit` within an \
hour: safe |
| bits of model, parameters or tables change | model_hash_mismatch, parameters_hash_mismatch, \
catalogue_hash_mismatch, anchor_table_hash_mismatch, table_hash_mismatch | restored from the backup copy \
(memory_repaired); if it is also damaged: memory_unrepairable, safe |
| bits of the packet store change | storage_corrupt | the packet is dropped |
| packet store full | store_overwritten, storage_full | the oldest of its class is overwritten, or the newest is \
rejected (`store_overwrite`) |
| reset | boot, state_recovered | settings, schedule, sequence counts and unsent packets are retained; a requested \
reset ends in standby |
| settings lost | state_lost | defaults; safe |
| clock jumps | clock_jump | housekeeping restarts; skipped activities expire (activity_expired) |
| bus voltage low | power_low | below `voltage_safe_v`: safe |
| board too hot or too cold | temperature_high, temperature_low | above `temperature_safe_c`: safe |
| much memory in use | memory_high | none |
"""

_PRODUCTS = """\
## Large data products

Thumbnail (table 6): frame number (u32), on-board time (u64), rows (u16), columns (u16), then the gray levels (u8, row
by row) compressed by zlib. Landmark map (table 7): for every crater used, sorted by identity: identity (u32), frames
that used it (u16).
"""


def format_interfaces() -> str:
    """Return the payload part of the document in Markdown."""
    return "\n".join([_STEP, *_ports(), *_modes(), *_parameters(), *_store(), _PRODUCTS, _FAULTS])


def _ports() -> list[str]:
    lines = ["## Ports of the board\n"]
    for name, (methods, text) in _PORTS.items():
        lines += [f"### {name}\n", f"{text[0].upper()}{text[1:]}.\n", "| port | carries |\n|---|---|"]
        for method in methods:
            member = getattr(Board, method)
            signature = str(inspect.signature(member)).replace("(self, ", "(").replace("(self)", "()")
            summary = (inspect.getdoc(member) or "").replace("\n", " ")
            lines.append(f"| `{method}{signature}` | {summary} |")
        lines.append("")
    lines += ["Sensors, in this order: " + ", ".join(f"`{name}`" for name in SENSORS) + ".\n"]
    for title, codes in (("Loads (bits)", Load), ("Stages", Stage), ("Causes of a reset", ResetCause)):
        lines.append(f"{title}: " + ", ".join(f"{code.value} {code.name}" for code in codes) + ".\n")
    return lines


def _modes() -> list[str]:
    head = " | ".join(mode.name for mode in PayloadMode)
    lines = [
        "## Modes\n",
        "By telecommand or schedule; fault reactions lead to safe or standby from any mode.\n",
        f"| from \\ to | {head} |\n|---|---|---|---|---|",
    ]
    for present in PayloadMode:
        cells = ["yes" if wanted in TRANSITIONS[present] else "no" for wanted in PayloadMode]
        lines.append(f"| {present.name} | {' | '.join(cells)} |")
    lines.append(
        f"\nTelecommands and functions that are not allowed in every mode:\n\n| | {head} |\n|---|---|---|---|---|"
    )
    for name, modes in ALLOWED.items():
        cells = ["yes" if mode in modes else "no" for mode in PayloadMode]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    assert all(modes <= ALL_MODES for modes in ALLOWED.values())
    return [*lines, ""]


def _parameters() -> list[str]:
    lines = [
        "## Parameters\n",
        "| number | name | unit | minimum | maximum | default | |\n|---|---|---|---|---|---|---|",
    ]
    lines += [_parameter(parameter) for parameter in PARAMETERS]
    return [*lines, ""]


def _parameter(parameter: Parameter) -> str:
    numbers = (f"{value:g}" for value in (parameter.minimum, parameter.maximum, parameter.default))
    whole = ", whole" if parameter.whole else ""
    return (
        f"| {parameter.number} | {parameter.name} | {parameter.unit} | {' | '.join(numbers)} "
        f"| {parameter.meaning}{whole} |"
    )


def _store() -> list[str]:
    lines = [
        "## Packet store\n",
        "Sent in this order. Safe and standby send the first two classes only.\n",
        "| class | share of the memory |\n|---|---|",
    ]
    return [*lines, *(f"| {kind.name} | {SHARES[kind]:.0%} |" for kind in StoreClass), ""]
