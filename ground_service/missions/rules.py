"""Automation rules of a mission description: triggers, conditions, actions, channels, and their contradictions.

A rule names one trigger, optional conditions and the actions that follow in their order. Validation finds rules that
contradict each other, and rules that would trigger themselves through the events that their actions cause.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Final, Literal, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, model_validator

from ground_service.missions.section import Array, Section

TRIGGERS: Final = (
    "window ended",
    "window processed",
    "contact started",
    "contact ended",
    "telemetry received",
    "archive imported",
    "correlation changed",
    "report done",
    "gate done",
    "alarm",
)
"""What a rule can react to; `automation.core` derives them from the event log."""

ACTIONS: Final = (
    "correlate",
    "align",
    "evaluate",
    "report",
    "mark_processed",
    "keep_archive",
    "find_landmarks",
    "run_regression",
    "compute_trends",
    "monthly_report",
    "notify",
)

CONDITIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "window_state": ("window ended", "contact ended"),
    "verdict": ("report done", "gate done"),
    "requirement_failed": ("report done",),
    "reevaluation": ("report done",),
    "min_frames": ("report done",),
}
"""Triggers that have the value of each condition."""

PASS_ACTIONS: Final = ("align", "evaluate", "report", "mark_processed", "keep_archive", "find_landmarks")
"""Actions on one pass."""

PASS_TRIGGERS: Final = (
    "window ended", "window processed", "contact ended", "archive imported", "report done",
)  # fmt: skip
"""Triggers that concern one pass, or the passes whose telemetry a contact has delivered."""

CAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    "correlate": ("correlation changed",),
    "report": ("report done",),
    "mark_processed": ("window processed",),
    "run_regression": ("gate done",),
    "compute_trends": ("alarm",),
}
"""Triggers that the events of an action are."""

FOLLOWS: Final[Mapping[str, tuple[str, ...]]] = {
    "telemetry received": ("correlation changed", "window ended"),
    "correlation changed": ("window ended",),
    "report done": ("window processed",),
}
"""Triggers that follow others without a rule: the service keeps derived data up to date."""

VERDICTS: Final = ("met", "not met", "unknown", "pass", "fail", "inconclusive")
"""Levels of the verdict of a report, and verdicts of a gate."""


def _known(kind: str, names: Sequence[str]) -> Callable[[str], str]:
    def check(name: str) -> str:
        if name in names:
            return name
        near = difflib.get_close_matches(name, names, n=1)
        raise ValueError(f"'{near[0]}'" if near else f"{kind}: {', '.join(names)}")

    return check


Trigger = Annotated[str, AfterValidator(_known("an event", TRIGGERS))]
Action = Annotated[str, AfterValidator(_known("an action", ACTIONS))]
Verdict = Annotated[str, AfterValidator(_known("a verdict", VERDICTS))]
ChannelName = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9._-]+$")]


class Conditions(Section):
    """Conditions of a rule; all that are stated must hold.

    Attributes
    ----------
    window_state
        States of the window: executed (telemetry is missing), downlinked or failed.
    verdict
        Verdict of the report or of the gate.
    requirement_failed
        Whether a requirement of the report is not met.
    reevaluation
        Whether the report is a re-evaluation because of late data.
    min_frames
        Smallest number of frames in the report.
    """

    window_state: Annotated[tuple[Literal["executed", "downlinked", "failed"], ...], Array] | None = None
    verdict: Annotated[tuple[Verdict, ...], Array] | None = None
    requirement_failed: bool | None = None
    reevaluation: bool | None = None
    min_frames: Annotated[int, Field(ge=1)] | None = None

    @property
    def stated(self) -> tuple[str, ...]:
        """Names of the stated conditions."""
        return tuple(name for name in type(self).model_fields if getattr(self, name) is not None)

    def overlaps(self, other: Conditions) -> bool:
        """Return whether one event can fulfil both."""
        for name in set(self.stated) & set(other.stated) - {"min_frames"}:
            mine, its = getattr(self, name), getattr(other, name)
            if isinstance(mine, tuple) and not set(mine) & set(its):
                return False
            if isinstance(mine, bool) and mine != its:
                return False
        return True


class Channel(Section):
    """Receiver of notifications.

    Attributes
    ----------
    webhook
        Address (http or https) that receives a JSON document by POST.
    email
        Addresses that receive a message.
    smtp, sender
        Mail server as HOST:PORT, and the sender of messages.
    signing_secret
        Name of the file in the folder `secrets` of the service with the key of the webhook's HMAC-SHA256 signature.
    """

    webhook: Annotated[str, Field(pattern=r"^https?://[^\s]+$", max_length=1000)] | None = None
    email: Annotated[tuple[Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$")], ...], Array] | None = None
    smtp: Annotated[str, Field(pattern=r"^[^\s:/]+:[0-9]{1,5}$")] = "localhost:25"
    sender: Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$")] = "linna@localhost"
    signing_secret: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9._-]*$", max_length=64)] | None = (
        None
    )

    @property
    def server(self) -> tuple[str, int]:
        """Host and port of the webhook or of the mail server."""
        if self.webhook is not None:
            parts = urlsplit(self.webhook)
            return parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
        host, _, port = self.smtp.rpartition(":")
        return host, int(port)

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.webhook is None) == (not self.email):
            raise ValueError("either webhook or email")
        if self.signing_secret is not None and self.webhook is None:
            raise ValueError("signing_secret with a webhook only")
        return self


class Rule(Section):
    """What follows an event.

    Attributes
    ----------
    on
        The trigger.
    when
        Conditions.
    do
        Actions in their order; after one that fails, the others are skipped.
    approval
        Whether the actions wait for the approval of a person.
    notify
        Names of the channels of the action `notify`.
    baseline, candidate
        Builds of the action `run_regression`: identities, or current.
    """

    name: Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f]*$")]
    on: Trigger
    when: Conditions = Conditions()
    do: Annotated[tuple[Action, ...], Array]
    approval: bool = False
    notify: Annotated[tuple[ChannelName, ...], Array] | None = None
    candidate: Annotated[str, Field(pattern=r"^(current|[0-9a-f]{8,64})$")] | None = None
    baseline: Annotated[str, Field(pattern=r"^(current|[0-9a-f]{8,64})$")] | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.do:
            raise ValueError(f"rule '{self.name}': at least one action, found none")
        for name in self.when.stated:
            if self.on not in CONDITIONS[name]:
                known = " or ".join(f"'{one}'" for one in CONDITIONS[name])
                raise ValueError(
                    f"rule '{self.name}': the condition {name} on {known} only, found '{self.on}'"
                )
        for action in self.do:
            if self.do.count(action) > 1:
                raise ValueError(f"rule '{self.name}': each action once, found {action} again")
            if action in PASS_ACTIONS and self.on not in PASS_TRIGGERS:
                known = ", ".join(f"'{one}'" for one in PASS_TRIGGERS)
                raise ValueError(
                    f"rule '{self.name}': {action} on an event of a pass ({known}), found '{self.on}'"
                )
        if ("notify" in self.do) != bool(self.notify):
            raise ValueError(
                f"rule '{self.name}': the action notify and the channels to notify, found one of them"
            )
        if "run_regression" in self.do and self.candidate is None:
            raise ValueError(f"rule '{self.name}': the candidate build of run_regression, found none")
        if "run_regression" not in self.do and (self.candidate or self.baseline):
            raise ValueError(f"rule '{self.name}': builds with the action run_regression only")
        return self


DEFAULT_RULES: Final = (
    Rule(
        name="report of a complete window",
        on="window ended",
        when=Conditions(window_state=("downlinked",)),
        do=("align", "report"),
    ),
    Rule(
        name="report of an incomplete window",
        on="contact ended",
        when=Conditions(window_state=("executed",)),
        do=("align", "report", "mark_processed"),
    ),
    Rule(name="trends", on="window processed", do=("compute_trends", "monthly_report")),
    Rule(name="regression archive of a window", on="window processed", do=("keep_archive",)),
    Rule(
        name="regression archive after late data",
        on="report done",
        when=Conditions(reevaluation=True),
        do=("keep_archive",),
    ),
    Rule(name="regression archive of an imported pass", on="archive imported", do=("keep_archive",)),
)
"""Rules of a mission description that states none."""


class Automation(Section):
    """Automatic operation.

    Attributes
    ----------
    evaluate
        Whether the default rules apply: true with the stated rules, false never. Not stated: if no rules are stated.
    rules
        Stated rules; an empty list means that nothing follows an event.
    channels
        Receivers of notifications by name.
    """

    evaluate: bool | None = None
    rules: Annotated[tuple[Rule, ...], Array] | None = None
    channels: dict[ChannelName, Channel] | None = None

    @property
    def rules_in_force(self) -> tuple[Rule, ...]:
        """Stated rules and default rules that apply."""
        default = self.evaluate if self.evaluate is not None else self.rules is None
        return (*(self.rules or ()), *(DEFAULT_RULES if default else ()))

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.evaluate is False:
            for rule in self.rules or ():
                if "report" in rule.do:
                    raise ValueError(f"no rule with a report where evaluate is false, found '{rule.name}'")
        check_rules(self.rules_in_force, self.channels or {})
        return self


def check_rules(rules: Sequence[Rule], channels: Mapping[str, Channel]) -> None:
    """Check rules together.

    Raises
    ------
    ValueError
        Two rules have one name or contradict each other, a channel is unknown, or a rule triggers itself.
    """
    names = [rule.name for rule in rules]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"each name of a rule once, found '{name}' again")
    for rule in rules:
        for channel in rule.notify or ():
            if channel not in channels:
                near = difflib.get_close_matches(channel, channels, n=1)
                expected = (
                    f"'{near[0]}'" if near else ", ".join(channels) or "channels in automation.channels"
                )
                raise ValueError(f"rule '{rule.name}': a known channel ({expected}), found '{channel}'")
    _check_approval(rules)
    _check_cycles(rules)


def _check_approval(rules: Sequence[Rule]) -> None:
    """Check that no action both waits for approval and is done without it."""
    for number, one in enumerate(rules):
        for other in rules[number + 1 :]:
            shared = set(one.do) & set(other.do) - {"notify"}
            if one.on == other.on and shared and one.when.overlaps(other.when):
                action = min(shared)
                if one.approval != other.approval:
                    raise ValueError(
                        f"one rule for each action, found {action} with approval and without it in "
                        f"'{one.name}' and '{other.name}'"
                    )
                if action == "run_regression":
                    continue
                raise ValueError(
                    f"one rule for each action, found {action} on '{one.on}' in '{one.name}' and '{other.name}'"
                )


def _check_cycles(rules: Sequence[Rule]) -> None:
    """Check that no event of an action of a rule leads to the trigger of the same rule."""
    steps: dict[str, set[str]] = {trigger: set(FOLLOWS.get(trigger, ())) for trigger in TRIGGERS}
    for rule in rules:
        for action in rule.do:
            steps[rule.on] |= set(CAUSES.get(action, ()))
    for rule in rules:
        for action in rule.do:
            for caused in CAUSES.get(action, ()):
                path = _path(steps, caused, rule.on)
                if path is not None:
                    events = " → ".join(f"'{one}'" for one in path)
                    raise ValueError(
                        f"rules that do not trigger themselves, found '{rule.name}': "
                        f"'{rule.on}' → {action} → {events}"
                    )


def _path(steps: Mapping[str, set[str]], start: str, goal: str) -> list[str] | None:
    """Return the shortest path between two triggers, both included; None without any."""
    paths = [[start]]
    seen = {start}
    while paths:
        path = paths.pop(0)
        if path[-1] == goal:
            return path
        for following in sorted(steps[path[-1]] - seen):
            seen.add(following)
            paths.append([*path, following])
    return None
