"""Automation and receivers of notifications in a mission description, and those of earlier versions."""

from __future__ import annotations

import logging

import pytest

from ground_service.ground import Ground
from ground_service.missions import store
from ground_service.missions.model import format_mission, parse_mission, read_document
from ground_service.missions.service import without_tokens

HEAD = 'name = "m"\n'
RULE = '[[automation.rules]]\nname = "a"\non = "window ended"\ndo = ["report"]\n'
PEOPLE = '[automation.channels.people]\nemail = ["a@b"]\n'


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (RULE, "automation: expected no rules (the follow-up of an event is fixed, and alert rules are those of "
               "Prometheus), found automation.rules"),
        (PEOPLE, "automation: expected receivers of notifications as [notify.NAME], found automation.channels"),
        ("[automation]\nrules = []\n", "automation: expected no rules"),
        ("[automation]\nevalute = true\n", "automation.evalute: expected 'evaluate', found unknown key 'evalute'"),
        (
            "[notify.ops]\nwebhook = 'http://x/'\nemail = ['a@b']\n",
            "notify.ops: expected either webhook or email, found",
        ),
        (
            "[notify.ops]\nwebhook = 'http://x/'\nsigning_secret = '..'\n",
            "notify.ops.signing_secret: expected ",
        ),
        ("[notify.ops]\nemail = ['a@b']\nsigning_secret = 'x'\n", "notify.ops: expected signing_secret with a webhook"),
    ],
)  # fmt: skip
def test_a_new_description_with_rules_or_an_impossible_receiver_is_refused_with_one_line(
    text: str, line: str
) -> None:
    [fault] = read_document(HEAD + text, "mission.toml")
    assert str(fault).startswith(f"mission.toml, {line}")


def test_rules_of_a_stored_description_are_ignored_with_a_remark_and_its_channels_are_notified(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with caplog.at_level(logging.WARNING):
        found = parse_mission(HEAD + RULE + PEOPLE, "revision 1", stored=True)
    assert found == parse_mission(HEAD + PEOPLE.replace("automation.channels", "notify"))
    [remark] = caplog.messages
    assert remark.startswith("revision 1: 1 rules of an earlier version have no effect")


def test_a_stored_description_with_an_empty_list_of_rules_evaluates_nothing() -> None:
    assert parse_mission(f"{HEAD}[automation]\nrules = []\n", stored=True).automation.evaluate is False
    assert parse_mission(HEAD + RULE, stored=True).automation.evaluate is None
    stated = f"{HEAD}[automation]\nevaluate = true\nrules = []\n"
    assert parse_mission(stored=True, text=stated).automation.evaluate is True


def test_a_stored_revision_with_rules_opens_and_names_its_receivers(either: Ground) -> None:
    text = f"{HEAD}[spacecraft]\nid = 76\n{RULE}[automation.channels.hook]\nwebhook = 'https://x.example/T0KEN'\n"
    mission = parse_mission(text, stored=True)
    key, _ = either.write(store.add_revision, mission, text, actor="ann", now_utc_ns=1)
    [(spacecraft, name, channel)] = either.read(store.channels_in_force)
    assert (spacecraft, name, channel.webhook) == (76, "hook", "https://x.example/T0KEN")
    shown = without_tokens(either.read(store.detail, key))
    assert "T0KEN" not in shown.text and RULE in shown.text
    assert shown.document.notify["hook"].webhook == "https://x.example/..."


def test_receivers_survive_the_format() -> None:
    mission = parse_mission(f"{HEAD}[notify.ops]\nwebhook = 'http://x/'\nsigning_secret = 'ops'\n")
    assert parse_mission(format_mission(mission)) == mission
    assert mission.notify["ops"].server == ("x", 80)
