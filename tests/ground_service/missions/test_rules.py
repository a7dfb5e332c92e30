"""Automation rules of a mission description: which are refused, and with which line."""

from __future__ import annotations

import pytest

from ground_service.missions.model import Mission, format_mission, parse_mission, read_document
from ground_service.missions.rules import ACTIONS, CAUSES, CONDITIONS, DEFAULT_RULES, FOLLOWS, TRIGGERS
from ground_service.worker.actions import DOING

HEAD = 'name = "m"\n'


def rule(name: str = "a", on: str = "window ended", do: str = '["report"]', more: str = "") -> str:
    return f'[[automation.rules]]\nname = "{name}"\non = "{on}"\ndo = {do}\n{more}\n'


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (rule(on="windw ended"), "automation.rules.0.on: expected 'window ended', found 'windw ended'"),
        (rule(do='["reprt"]'), "automation.rules.0.do.0: expected 'report', found 'reprt'"),
        (rule(do="[]"), "automation.rules.0: expected rule 'a': at least one action, found none"),
        (
            rule(more="when = { windw_state = [] }"),
            "automation.rules.0.when.windw_state: expected 'window_state', found unknown key 'windw_state'",
        ),
        (
            rule(on="report done", do='["compute_trends"]', more='when = { window_state = ["failed"] }'),
            "automation.rules.0: expected rule 'a': the condition window_state on 'window ended' or "
            "'contact ended' only, found 'report done'",
        ),
        (
            rule(on="alarm"),
            "automation.rules.0: expected rule 'a': report on an event of a pass ('window ended', "
            "'window processed', 'contact ended', 'archive imported', 'report done'), found 'alarm'",
        ),
        (
            rule() + rule(do='["align"]'),
            "automation: expected each name of a rule once, found 'a' again",
        ),
        (
            rule() + rule("b", more="approval = true"),
            "automation: expected one rule for each action, found report with approval and without it in "
            "'a' and 'b'",
        ),
        (
            rule() + rule("b"),
            "automation: expected one rule for each action, found report on 'window ended' in 'a' and 'b'",
        ),
        (
            rule(on="report done"),
            "automation: expected rules that do not trigger themselves, found 'a': 'report done' → report → "
            "'report done'",
        ),
        (
            rule(on="window processed"),
            "automation: expected rules that do not trigger themselves, found 'a': 'window processed' → "
            "report → 'report done' → 'window processed'",
        ),
        (
            rule(do='["correlate"]'),
            "automation: expected rules that do not trigger themselves, found 'a': 'window ended' → "
            "correlate → 'correlation changed' → 'window ended'",
        ),
        (
            rule("a", "alarm", '["correlate"]') + rule("b", "correlation changed", '["compute_trends"]'),
            "automation: expected rules that do not trigger themselves, found 'a': 'alarm' → correlate → "
            "'correlation changed' → 'alarm'",
        ),
        (
            rule(do='["notify"]', more='notify = ["op"]\n[automation.channels.ops]\nemail = ["a@b"]'),
            "automation: expected rule 'a': a known channel ('ops'), found 'op'",
        ),
        (
            rule(do='["notify"]'),
            "automation.rules.0: expected rule 'a': the action notify and the channels to notify, found one of them",
        ),
        (
            "[automation.channels.ops]\nwebhook = 'http://x/'\nemail = ['a@b']\n",
            "automation.channels.ops: expected either webhook or email, found",
        ),
        (
            "[automation.channels.ops]\nwebhook = 'http://x/'\nsigning_secret = '..'\n",
            "automation.channels.ops.signing_secret: expected ",
        ),
        (
            "[automation]\nevaluate = false\n" + rule(),
            "automation: expected no rule with a report where evaluate is false, found 'a'",
        ),
        (
            rule(on="gate done", do='["run_regression"]'),
            "automation.rules.0: expected rule 'a': the candidate build of run_regression, found none",
        ),
        (
            rule(more='candidate = "current"'),
            "automation.rules.0: expected rule 'a': builds with the action run_regression only",
        ),
    ],
)
def test_a_rule_that_cannot_hold_is_refused_with_one_line(text: str, line: str) -> None:
    [fault] = read_document(HEAD + text, "mission.toml")
    assert str(fault).startswith(f"mission.toml, {line}")


def test_rules_that_differ_in_their_conditions_do_not_contradict_each_other() -> None:
    complete = rule(more='when = { window_state = ["downlinked"] }')
    failed = rule("b", more='when = { window_state = ["failed"] }\napproval = true')
    assert isinstance(read_document(HEAD + complete + failed, "mission.toml"), Mission)


def test_stated_rules_survive_the_format_and_change_the_revision() -> None:
    mission = parse_mission(HEAD + rule(more='when = { window_state = ["downlinked"] }'))
    assert parse_mission(format_mission(mission)) == mission
    assert mission.revision != parse_mission(HEAD + rule()).revision


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", [one.name for one in DEFAULT_RULES]),
        ("[automation]\nrules = []", []),
        ("[automation]\nevaluate = false", []),
        (rule("a", "gate done", '["compute_trends"]'), ["a"]),
        (
            "[automation]\nevaluate = true\n" + rule("a", "gate done", '["compute_trends"]'),
            ["a", *(one.name for one in DEFAULT_RULES)],
        ),
    ],
)
def test_default_rules_apply_where_none_are_stated_or_where_asked_for(text: str, names: list[str]) -> None:
    mission = parse_mission(HEAD + text)
    assert [one.name for one in mission.automation.rules_in_force] == names


def test_every_action_has_a_function_and_every_table_names_known_triggers() -> None:
    assert set(DOING) == set(ACTIONS)
    named = {
        *FOLLOWS,
        *(one for table in (CAUSES, FOLLOWS, CONDITIONS) for values in table.values() for one in values),
    }
    assert named <= set(TRIGGERS)
