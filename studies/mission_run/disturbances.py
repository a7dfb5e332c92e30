"""Disturbances of a mission run: what a file of them changes at the spacecraft, the stations and flight dynamics.

All of them are faults that spacecraft, link and reference can have anyway; a file states when in hours after the start
of the run. The ground service is not informed: neither its mission description nor its requests change.
"""

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

from lunar.constants import NS as NS
from lunar.timescales import format_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import SHIPPED, Scenario, format_scenario, parse_scenario
from payload_emulator.session.typed_toml import TableFault, read_table

HOUR_NS = 3600 * NS


@dataclass(frozen=True, slots=True)
class LinkDisturbances:
    """Losses, and contacts that do not happen: `STATION FROM TO` in hours, or every station with `all`.

    A stated probability replaces that of the scenario: of the loss of a frame, and of the begin and the end of a burst.
    So do the shares of frames that a station sends twice or out of order.
    `clocks` are errors of station clocks: `STATION SECONDS`, positive where the clock is fast.
    """

    frame_loss: float = 0.0
    burst_start: float = 0.0
    burst_end: float = 0.2
    repeat_share: float = 0.0
    reorder_share: float = 0.0
    missed_contacts: tuple[str, ...] = ()
    clocks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PayloadDisturbances:
    """Faults of the payload: its events are lines of `[faults]` of a scenario, with seconds after the start.

    `clock_steps` are `HOURS SECONDS`. The bias of the attitude is not declared. Hot pixels are a share of all.
    """

    clock_steps: tuple[str, ...] = ()
    attitude_bias_deg: float = 0.0
    hot_pixels: float = 0.0
    events: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ReferenceDisturbances:
    """Orbit determinations by day of the run, from 0: not delivered, and delivered with an offset in R/T/N."""

    late_days: tuple[int, ...] = ()
    wrong_days: tuple[int, ...] = ()
    wrong_by_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Disturbances:
    """Content of a file."""

    link: LinkDisturbances = field(default_factory=LinkDisturbances)
    payload: PayloadDisturbances = field(default_factory=PayloadDisturbances)
    reference: ReferenceDisturbances = field(default_factory=ReferenceDisturbances)

    def apply(self, scenario: Scenario) -> Scenario:
        """Return a scenario with these disturbances.

        Raises
        ------
        ScenarioError
            A line has another form, or a value cannot be flown.
        """
        link, payload, epoch = self.link, self.payload, scenario.epoch_utc_ns
        missed = []
        for text in link.missed_contacts:
            name, start_h, stop_h = _words(text, "link.missed_contacts", "STATION FROM TO")
            spans = scenario.link.stations if name == "all" else (name,)
            start, stop = (format_utc(epoch + round(hours * HOUR_NS)) for hours in (start_h, stop_h))
            missed += [f"{one} {start} {stop}" for one in spans]
        steps = []
        for text in payload.clock_steps:
            _, at_h, size_s = _words(f"- {text}", "payload.clock_steps", "HOURS SECONDS")
            steps.append(f"clock_jump at {3600.0 * at_h!r} size {size_s!r}")
        attitude, sensor = scenario.attitude, scenario.sensor
        bias_deg = attitude.knowledge_bias_deg
        declared_deg = attitude.declared_bias_deg
        if payload.attitude_bias_deg and declared_deg < 0.0:
            declared_deg = bias_deg
        changed = replace(
            scenario,
            link=replace(
                scenario.link,
                frame_loss=link.frame_loss or scenario.link.frame_loss,
                burst_start=link.burst_start or scenario.link.burst_start,
                burst_end=link.burst_end if link.burst_start else scenario.link.burst_end,
                repeat_share=link.repeat_share or scenario.link.repeat_share,
                reorder_share=link.reorder_share or scenario.link.reorder_share,
                missed=(*scenario.link.missed, *missed),
                clock_errors=(*scenario.link.clock_errors, *link.clocks),
            ),
            attitude=replace(
                attitude, knowledge_bias_deg=bias_deg + payload.attitude_bias_deg, declared_bias_deg=declared_deg
            ),
            sensor=replace(sensor, hot_pixels=payload.hot_pixels or sensor.hot_pixels),
            faults=replace(scenario.faults, events=(*scenario.faults.events, *steps, *payload.events)),
        )
        return parse_scenario(format_scenario(changed), "disturbances")


UNDISTURBED = Disturbances()


def load_disturbances(path: Path | str) -> Disturbances:
    """Return the disturbances of a TOML file, or of a shipped one by its name.

    Raises
    ------
    ScenarioError
        The file is missing, no TOML, or has an unknown key or a wrong value.
    """
    where = SHIPPED / "disturbances" / f"{path}.toml"
    if not where.is_file():
        where = Path(path)
    try:
        table = tomllib.loads(where.read_text(encoding="utf-8"))
        return read_table(Disturbances, table)
    except (OSError, ValueError) as error:
        if not isinstance(error, TableFault):
            raise ScenarioError(f"{where}: expected a TOML file of disturbances, found {error}") from None
        expected = f"{error.expected}, found {error.found}"
        if error.known:
            expected = repr(error.nearest) if error.nearest else f"one of {', '.join(error.known)}"
            expected += ", found an unknown key"
        raise ScenarioError(f"{where}, {error.place}: expected {expected}") from None


def _words(text: str, key: str, form: str) -> tuple[str, float, float]:
    """Return the name and the two numbers of a line."""
    name, *rest = text.split() or [""]
    try:
        first, second = map(float, rest)
    except ValueError:
        raise ScenarioError(f"disturbances, {key}: expected {form}, found {text!r}") from None
    return name, first, second
