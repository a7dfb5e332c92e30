"""Execution of the actions of automation rules.

A job runs all actions that one event has caused. An action that is done is not repeated; one that a killed process left
is done again under the same identity, so that it has one result.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
from itertools import groupby
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import (
    EvaluationError,
    GroundError,
    InvalidInput,
    StateConflict,
    fault_of,
    public_text,
)
from ground_service.evaluation.landmarks.service import update_landmarks
from ground_service.evaluation.preparation import align_pass
from ground_service.evaluation.service import make_report, pass_summary, reevaluate
from ground_service.evaluation.store import newest_report
from ground_service.events import AutomationChanged, LimitsBroken, publish
from ground_service.ground import Ground
from ground_service.jobs.service import add_job
from ground_service.missions.rules import DEFAULT_RULES, Rule
from ground_service.missions.timekeeping.recorrelation import recorrelate
from ground_service.planning.progress import close_window, note_reason
from ground_service.regression.jobs import prepared, regression_job
from ground_service.regression.pass_archives import keep_pass
from ground_service.worker.automation import store
from ground_service.worker.automation.model import OPEN_STATES, AutomationAction
from ground_service.worker.notifications import send
from ground_service.worker.outgoing import NotDelivered
from ground_service.worker.upkeep import broken_limits

log = logging.getLogger(__name__)


ATTEMPTS = 3
RETRY_NS = (0, 60_000_000_000)
"""Time from a failed attempt to the next one: at once, then after a minute."""


def run_actions(ground: Ground, event: int, *, notify: bool = False) -> dict[str, Any]:
    """Run the actions of an event that are queued; return their numbers by state.

    Notifications wait for other people's computers. They are the work of a separate job, which runs this with `notify`.
    """
    due: list[AutomationAction] = []
    with ground.alone(f"actions of event {event}"):
        actions = ground.read(store.actions_of_event, event)
        for _, chain in groupby(actions, key=lambda one: (one.rule, one.subject)):
            due += _run_chain(ground, list(chain), notify)
    for one in due:
        ground.write(publish, AutomationChanged(id=one.id, event=event, action=one.action, state="sending"))
    after = ground.read(store.actions_of_event, event)
    counts: dict[str, int] = {}
    for one in after:
        counts[one.state] = counts.get(one.state, 0) + 1
    return {"event": event, **counts}


def _run_chain(ground: Ground, chain: list[AutomationAction], notify: bool) -> list[AutomationAction]:
    """Run the actions of one rule on one subject in order, up to one that waits or is to be repeated later.

    Actions after one that finally failed are skipped. Without `notify`, return the notification that is due.
    """
    stopped = ""
    for action in chain:
        ground.check_stopping()
        if action.state == "waiting" and not stopped:
            return []
        if action.state in ("failed", "refused", "skipped"):
            stopped = action.action
        if action.state not in OPEN_STATES:
            continue
        if stopped:
            _end(ground, action, "skipped", error=f"{stopped} before it was not done")
            continue
        if action.action == "notify" and not notify:
            return [action]
        state = _run_attempts(ground, action)
        if state == "queued":
            return []
        if state == "failed":
            stopped = action.action
    return []


def _run_attempts(ground: Ground, action: AutomationAction) -> str:
    """Run one action, again after a failure if it is due at once; return its state then."""
    while action.next_attempt is None or action.next_attempt.utc_ns <= utc_now_ns():
        ground.check_stopping()
        error = _run_one(ground, action)
        if error is None:
            return "done"
        attempts = action.attempts + 1
        if action.action == "notify":  # each channel has had its attempts
            _give_up(ground, action, error)
            return "failed"
        if attempts >= ATTEMPTS:
            _give_up(ground, action, f"{error} (attempt {attempts} of {ATTEMPTS})")
            return "failed"
        now = utc_now_ns()
        with ground.database.writing() as connection:
            due = now + RETRY_NS[attempts - 1]
            store.note_attempt(connection, action, error=error, now_utc_ns=now, next_utc_ns=due)
            action = store.get_action(connection, action.id)
        if action.state != "queued":  # another process has decided it meanwhile
            return action.state
    return "queued"


def _run_one(ground: Ground, action: AutomationAction) -> str | None:
    """Run one action and record its success; return None, or why it failed."""
    with fault_of(f"automation action {action.id} ({action.action})") as faults:
        _end(ground, action, "done", result=DOING[action.action](ground, action))
    return faults[0] if faults else None


def _give_up(ground: Ground, action: AutomationAction, error: str) -> None:
    """Record that an action finally failed, and the reason at its window, which stays as it is."""
    _end(ground, action, "failed", error=error)
    if action.window_id is not None:
        note_reason(ground, action.window_id, f"{action.action} failed: {error}")


def repeat_due(ground: Ground) -> list[str]:
    """Add the jobs of actions whose next attempt is due; return their ids."""
    due = ground.read(store.events_to_repeat, utc_now_ns())
    if not due:
        return []
    with ground.database.writing() as connection:
        return [
            add_job(
                connection,
                "automation",
                {"event": event},
                job_id=hashlib.blake2b(name, digest_size=16).hexdigest(),
            )
            for event, name in ((event, f"repeat {event} {attempts}".encode()) for event, attempts in due)
        ]


def has_repetitions(ground: Ground) -> bool:
    """Return whether failed actions are to be done again, now or later."""
    with ground.database.reading() as connection:
        return bool(store.events_to_repeat(connection, utc_now_ns() + sum(RETRY_NS)))


def _end(ground: Ground, action: AutomationAction, state: str, **values: Any) -> None:
    """Record the end of an action, unless another process has recorded it."""
    try:
        ground.write(store.change_state, action, state, now_utc_ns=utc_now_ns(), **values)
    except StateConflict as error:
        log.warning("%s", error)


def _rule(ground: Ground, action: AutomationAction) -> Rule:
    """Return the rule of an action in the revision that caused it."""
    rules = ground.read(store.rules_of_revision, action.mission_id)
    for rule in (*rules, *DEFAULT_RULES):
        if rule.name == action.rule:
            return rule
    raise InvalidInput("rule", "", "a rule of the mission description", action.rule)


def _pass_of(action: AutomationAction) -> int:
    if action.pass_id is None:
        raise EvaluationError(f"{action.action}: the event concerns no pass")
    return action.pass_id


def _identity(action: AutomationAction) -> str:
    """Return the id of what an action makes: the same action again makes the same."""
    return hashlib.blake2b(f"automation {action.id}".encode(), digest_size=16).hexdigest()


def _correlate(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    if action.vehicle_id is None:
        raise EvaluationError("correlate: the event concerns no spacecraft")
    return {"changed": recorrelate(ground, action.vehicle_id)}


def _evaluate(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    found = pass_summary(ground, _pass_of(action))
    kept = ("frames", "packets", "packets_lost", "navigation", "verdict", "verdict_level", "evidence_level")
    return {name: found[name] for name in kept} | {"recall": found["detector"]["recall"]}


def _report(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    """Make the first report of a pass, or a new one if anything in it differs from the last."""
    pass_id, identity = _pass_of(action), _identity(action)
    previous = ground.read(newest_report, pass_id, other_than=identity)
    if previous is None:
        made = make_report(ground, pass_id, report_id=identity, pdf=True)
        return {"report_id": made.report_id, "verdict": made.summary["verdict"]}
    again = reevaluate(ground, pass_id, report_id=identity, event=action.event)
    if again is None:
        return {"report_id": previous.id, "unchanged": True}
    return {"report_id": again.report_id, "verdict": again.summary["verdict"], "previous": previous.id}


def _mark_processed(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    if action.window_id is None:
        raise EvaluationError("mark_processed: the pass belongs to no window")
    return {"window_id": action.window_id, "state": close_window(ground, action.window_id)}


def _keep_archive(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    kept = keep_pass(ground, _pass_of(action))
    return {"archive": kept.digest, "frames": kept.frames, "state": kept.state, "reason": kept.reason}


def _find_landmarks(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    return update_landmarks(ground, _pass_of(action)).model_dump(mode="json")


def _run_regression(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    rule = _rule(ground, action)
    arguments = prepared(ground, rule.candidate or "current", rule.baseline or "current", ())
    return regression_job(ground, arguments, _identity(action))


def _compute_trends(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    """Compute the trends of a spacecraft; broken limits alarm unless the last such action found the same."""
    if action.vehicle_id is None:
        raise EvaluationError("compute_trends: the event concerns no spacecraft")
    broken = broken_limits(ground, action.vehicle_id)
    with ground.database.writing() as connection:
        last = store.last_result(connection, action)
        if broken and (last is None or last.get("limits_broken") != broken):
            publish(connection, LimitsBroken(broken=broken))
    return {"limits_broken": broken}


def _monthly_report(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    """Make the report of the last complete month; late data in that month give a new one."""
    from ground_service.evaluation.performance.service import due_report_of_vehicle

    if action.vehicle_id is None:
        raise EvaluationError("monthly_report: the event concerns no spacecraft")
    made = due_report_of_vehicle(ground, action.vehicle_id)
    return (
        {"report": None} if made is None else {"report": made.id, "month": made.month, "passes": made.passes}
    )


def _notify(ground: Ground, action: AutomationAction) -> dict[str, Any]:
    """Send the event over the channels of the rule; each gets it, also if another one fails."""
    rule = _rule(ground, action)
    channels = ground.read(store.channels_of_revision, action.mission_id)
    content = {
        name: value
        for name, value in action.model_dump(mode="json").items()
        if name in ("event", "trigger", "rule", "text", "subject", "pass_id", "window_id", "created")
    }
    faults = {}
    for name in rule.notify or ():
        ground.check_stopping()
        try:
            identity = f"{_identity(action)}.{name}"
            send(
                ground.home,
                channels[name],
                identity,
                f"LINNA: {action.text}",
                content,
                networks=ground.networks,
            )
        except GroundError as error:
            faults[name] = public_text(error)
    if faults:
        raise NotDelivered("; ".join(f"{name}: {fault}" for name, fault in faults.items()))
    return dict.fromkeys(rule.notify or (), "delivered")


DOING: Mapping[str, Callable[[Ground, AutomationAction], dict[str, Any]]] = {
    "correlate": _correlate,
    "align": lambda ground, action: align_pass(ground, _pass_of(action)),
    "evaluate": _evaluate,
    "report": _report,
    "mark_processed": _mark_processed,
    "keep_archive": _keep_archive,
    "find_landmarks": _find_landmarks,
    "run_regression": _run_regression,
    "compute_trends": _compute_trends,
    "monthly_report": _monthly_report,
    "notify": _notify,
}
"""Functions of the actions; each may be repeated without harm."""
