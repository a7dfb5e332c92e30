"""Shortest race campaign: two API processes over HTTP and one PostgreSQL database."""

from pytest import mark

from benchmarks.campaigns import race
from benchmarks.campaigns.race import FAULTS, Answer, Tally, holds, run, table


@mark.campaign
def test_of_contradicting_requests_to_two_processes_one_wins_and_all_others_are_refused(
    new_postgres_database, tmp_path
):
    figures = run(tmp_path, new_postgres_database(), races=60, seed=3)
    assert {name: figures[name] for name in FAULTS} == dict.fromkeys(FAULTS, 0), figures["examples"]
    assert holds(figures)
    kinds = figures["kinds"]
    assert set(kinds) == set(race.SHARES) and all(kinds[kind]["races"] > 0 for kind in kinds)
    # five requests a race, of which one is carried out
    assert kinds["release"]["requests"] == 5 * kinds["release"]["races"]
    assert kinds["release"]["won"] == kinds["release"]["races"]


@mark.parametrize("name", FAULTS)
def test_any_fault_fails_the_campaign_and_is_in_its_table(name):
    figures = {one: int(one == name) for one in FAULTS}
    assert not holds(figures)
    text = table({**figures, "kinds": {}, "seconds": 1, "examples": ["what happened"]})
    assert f"{name.replace('_', ' ')} 1".split() in [line.split() for line in text.splitlines()]
    assert "what happened" in text


def test_answers_are_counted():
    tally = Tally()
    stated, empty = b'{"state": "released"}', b"{}"
    tally.add("release", [Answer("release", 200, stated), Answer("release", 409, stated), Answer("reject", 409, empty)])
    tally.add("uplink", [Answer("hand out", 200, b"", (7, 8)), Answer("hand out", 200, b"", (8,))])
    tally.add("ingest", [Answer("upload", 503, b"gone")])
    assert (tally.requests["release"], tally.won["release"]) == (3, 1)
    assert tally.handed_out == {7: 1, 8: 2}
    faults = {name: counts.total() for name, counts in tally.faults.items() if counts}
    assert faults == {"unnamed_losers": 1, "server_errors": 1}
