"""Meaning of the values of event reports, for the interface control document and for texts that people read."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

from tmtc.dictionary.codes import EVENTS, FAILURES, IMAGE_QUALITIES, MODES, RESET_TRIGGERS, TABLES, Labels
from tmtc.packets.pus import TICKS_PER_SECOND

_EPOCH = datetime(2000, 1, 1)


def number_text(value: float) -> str:
    """Return a number without needless digits."""
    return f"{value:.0f}" if value.is_integer() else f"{value:.6g}"


def _number(unit: str = "") -> Callable[[float], str]:
    return lambda value: f"{number_text(value)} {unit}".rstrip()


def _label(labels: Labels) -> Callable[[float], str]:
    names = {float(code): name.replace("_", " ") for code, name in labels}
    return lambda value: names.get(value, number_text(value))


def _hash(value: float) -> str:
    return f"{int(value) & 0xFFFFFFFF:08x}"


def request_text(value: float) -> str:
    """Return a telecommand by its first four octets: the last 14 bits are its sequence count."""
    return f"telecommand with sequence count {int(value) & 0x3FFF}"


def time_text(value: float) -> str:
    """Return an on-board time, in ticks, as TAI."""
    return (_EPOCH + timedelta(seconds=value / TICKS_PER_SECOND)).strftime("%Y-%m-%dT%H:%M:%S TAI")


def _time(value: float, write: Callable[[float], str] = time_text) -> str:
    return write(value) if value > 0 else "open end"


def _interval(value: float) -> str:
    return f"{number_text(value / TICKS_PER_SECOND)} s"


_MODE, _TABLE, _FAILURE = _label(MODES), _label(TABLES), _label(FAILURES)
_EVENT, _QUALITY, _TRIGGER = _label(EVENTS), _label(IMAGE_QUALITIES), _label(RESET_TRIGGERS)
_ESTIMATOR = _label(((0, "paper"), (1, "spherical"), (2, "anchored")))
_RESET = _label(((0, "power on"), (1, "commanded"), (2, "watchdog"), (3, "brown-out")))
_RECOVERY = _label(((0, "blank"), (1, "newest copy"), (2, "older copy"), (3, "lost")))
_SWITCH = _label(((0, "disabled"), (1, "enabled")))


@dataclass(frozen=True, slots=True)
class EventText:
    """Meaning of the two values of an event.

    Attributes
    ----------
    text
        Text with `{0}` and `{1}` for the values.
    values
        Meaning of each value, for the interface control document; fewer than two if the event does not use both.
    formats
        Functions that write the values.
    """

    text: str
    values: tuple[str, ...]
    formats: tuple[Callable[[float], str], ...]


def _of(text: str, *values: tuple[str, Callable[[float], str]]) -> EventText:
    return EventText(text, tuple(name for name, _ in values), tuple(write for _, write in values))


_LIMIT = ("limit", _number())
EVENT_TEXTS: Mapping[str, EventText] = {
    "boot": _of("boot {0}, cause: {1}", ("boot count", _number()), ("cause of the reset", _RESET)),
    "mode_changed": _of("from {0} to {1}", ("mode before", _MODE), ("mode after", _MODE)),
    "observation_started": _of(
        "until {0}, every {1}", ("end, on-board time (0: none)", _time), ("cadence, 2^-16 s", _interval)
    ),
    "observation_stopped": _of("{0} frames since boot", ("frames since boot", _number())),
    "activity_released": _of("{0}", ("request id", request_text)),
    "activity_expired": _of("{0}, {1} late", ("request id", request_text), ("delay, s", _number("s"))),
    "activity_failed": _of("{0}", ("request id", request_text)),
    "table_loaded": _of("{0}, hash {1}", ("table", _TABLE), ("first 32 bits of its SHA-256", _hash)),
    "table_refused": _of("{0} ({1})", ("table", _TABLE), ("hash, or octets of an upload", _number())),
    "telecommand_rejected": _of("{1}: {0}", ("failure code", _FAILURE), ("request id", request_text)),
    "parameter_changed": _of("parameter {0} = {1}", ("parameter", _number()), ("value", _number())),
    "report_definition_changed": _of(
        "structure {0} with {1} quantities", ("structure", _number()), ("quantities", _number())
    ),
    "event_reporting_changed": _of("{0} {1}", ("event", _EVENT), ("0 disabled, 1 enabled", _SWITCH)),
    "thumbnail_stored": _of("frame {0}, {1}", ("frame", _number()), ("octets", _number("octets"))),
    "image_streak": _of(
        "{1} frames, last quality: {0}", ("image quality (0: end of the streak)", _QUALITY), ("frames", _number())
    ),
    "camera_fault": _of(
        "{0} frames without image, camera switched {1} times", ("frames", _number()), ("power cycles", _number())
    ),
    "camera_recovered": _of(
        "after {0} frames without image and {1} power cycles", ("frames", _number()), ("power cycles", _number())
    ),
    "frame_skipped": _of("in mode {0}", ("mode", _MODE)),
    "detector_timeout": _of("{0}, limit {1}", ("duration, s", _number("s")), ("limit, s", _number("s"))),
    "detector_error": _of("message of {0} characters", ("characters of the message", _number())),
    "estimator_error": _of("{0} estimator", ("estimator", _ESTIMATOR)),
    "filter_reset": _of(
        "{0} craters matched, sigma {1}", ("craters matched", _number()), ("largest sigma, m", _number("m"))
    ),
    "filter_divergence": _of("sigma {0}", ("largest sigma, m", _number("m"))),
    "fix_refused": _of("{0} candidates, {1} expected", ("candidate pairs", _number()), ("expected craters", _number())),
    "attitude_degraded": _of(
        "noise {0} per axis, declared {1}",
        ("estimated noise per axis, deg", _number("deg")),
        ("declared noise per axis, deg", _number("deg")),
    ),
    "attitude_restored": _of("declared noise {0} per axis", ("declared noise per axis, deg", _number("deg"))),
    "map_offset": _of(
        "{0} east and north, from {1} fixes",
        ("1 sigma of the offset of the list, m", _number("m")),
        ("fixes that it was learned from; 0: the prior", _number()),
    ),
    "detection_noise": _of(
        "{0} times the stated noise, from {1} fixes",
        ("factor on the stated noise", _number()),
        ("fixes that it was learned from; 0: the prior", _number()),
    ),
    "anchor_read": _of("trigger: {0}, {1} estimator", ("trigger", _TRIGGER), ("estimator", _ESTIMATOR)),
    "clock_jump": _of("{0}", ("jump, s", _number("s"))),
    "clock_synchronised": _of("{0}", ("on-board time", _time)),
    "watchdog_reset": _of("{0} since manufacture", ("resets", _number())),
    "state_recovered": _of("{0}, {1} packets stored", ("settings found", _RECOVERY), ("packets", _number())),
    "state_lost": _of("{0} packets stored", ("packets", _number())),
    "memory_unrepairable": _of("{0}", ("table", _TABLE)),
    "memory_repaired": _of("{0}, repair {1}", ("table", _TABLE), ("repairs since boot", _number())),
    "safe_mode_entered": _of("from {0}, reason {1}", ("mode before", _MODE), ("reason", _number())),
    "storage_corrupt": _of("{0} records, {1} since boot", ("records", _number()), ("since boot", _number())),
    "storage_full": _of("{0} packets not stored", ("packets", _number())),
    "store_overwritten": _of("{0} packets overwritten", ("packets", _number())),
    "power_low": _of("{0}, limit {1}", ("voltage, V", _number("V")), ("limit, V", _number("V"))),
    "temperature_high": _of("{0}, limit {1}", ("temperature, degC", _number("degC")), _LIMIT),
    "temperature_low": _of("{0}, limit {1}", ("temperature, degC", _number("degC")), _LIMIT),
    "memory_high": _of("{0}, limit {1}", ("memory, KiB", _number("KiB")), _LIMIT),
    **{
        f"{table}_hash_mismatch": _of("{0}, hash found {1}", ("table", _TABLE), ("hash found", _hash))
        for table in ("model", "parameters", "catalogue", "anchor_table", "table")
    },
}
"""Texts by event name; an event that is missing has no values."""


def event_text(
    name: str,
    value_1: float | None,
    value_2: float | None,
    *,
    time: Callable[[float], str] = time_text,
    telecommand: Callable[[float], str] = request_text,
) -> str:
    """Return the values of an event as a text; empty without values.

    Values that the text does not use, or that are not known (None, NaN), appear as plain numbers or not at all.

    Parameters
    ----------
    time, telecommand
        Write an on-board time in ticks, and a telecommand by its first four octets.
    """
    known = [None if value is None or math.isnan(value) else float(value) for value in (value_1, value_2)]
    text = EVENT_TEXTS.get(name)
    used = 0 if text is None else len(text.formats)
    if text is None or any(value is None for value in known[:used]):
        return ", ".join(number_text(value) for value in known if value is not None and value != 0.0)
    own: dict[Callable[..., str], Callable[[float], str]] = {
        request_text: telecommand,
        _time: lambda value: _time(value, time),
    }
    written = (
        own.get(write, write)(value) for write, value in zip(text.formats, known, strict=False) if value is not None
    )
    return text.text.format(*written)
