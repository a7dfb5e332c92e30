"""Shortest kill campaign: API and jobs with SQLite, killed during ingest and commanding."""

import json
import random
import sys
from dataclasses import replace

from pytest import mark

from benchmarks.campaigns._clients import cut_pieces
from benchmarks.campaigns._ledger import FAULTS, AuditLine, Decision, Entered, HandOut, Ledger, judge
from benchmarks.campaigns.kill import holds, main, totals

SHORT = "--laptop --packets 400 --pieces 4 --reports 0 --pause 0.3 --json"


def campaign(monkeypatch, capsys, words):
    monkeypatch.setattr(sys, "argv", ["kill", *words.split()])
    return main(), json.loads(capsys.readouterr().out)


@mark.campaign
def test_nothing_is_lost_or_doubled_by_kills_and_a_campaign_goes_on_where_it_ended(monkeypatch, capsys, tmp_path):
    state = tmp_path / "state.json"
    code, figures = campaign(monkeypatch, capsys, f"{SHORT} --kills 3 --state {state}")
    assert code == 0, figures
    assert sum(figures["kills"].values()) == 3
    assert figures["telecommands"] >= 4
    assert figures["lost"] == figures["doubled"] == 0
    assert figures["jobs"] == figures["ingests"] == {"done": figures["uploads"]}
    assert campaign(monkeypatch, capsys, f"{SHORT} --kills 3 --state {state}") == (0, figures)


def test_a_lost_packet_or_an_unfinished_job_fails_the_campaign():
    run = {
        "kills": {"api": 2}, "jobs": {"done": 3}, "ingests": {"done": 2}, "uploads": 2, "attempts": 4, "lost": 0,
        "doubled": 0, "seconds": 5, "archive_identical": True, "telecommands": 3, "handed_out": 1,
        **dict.fromkeys(FAULTS, 0),
    }  # fmt: skip
    assert holds(totals([run, run]))
    for injury in (
        {"lost": 1},
        {"doubled": 1},
        {"archive_identical": False},
        {"jobs": {"failed": 1}},
        {"ingests": {"running": 1}},
        *({name: 1} for name in FAULTS),
    ):
        assert not holds(totals([run, {**run, **injury}]))


ROWS = [
    {"id": 1, "state": "sent", "sequence_count": 0, "octets": b"one", "decided_by": "ann"},
    {"id": 2, "state": "rejected", "sequence_count": None, "octets": None, "decided_by": "bob"},
    {"id": 3, "state": "released", "sequence_count": 1, "octets": b"three", "decided_by": "bob"},
    {"id": 4, "state": "queued", "sequence_count": None, "octets": None, "decided_by": None},
]
for row in ROWS:
    row.update(vehicle_id=1, requested_by="ann", arguments={"argument_1": 10.0 + row["id"]})
ENTRIES = "enter 1 ann,enter 2 ann,enter 3 ann,enter 4 ann,release 1 ann,send 1 bob,reject 2 bob,release 3 bob"
LINES = [AuditLine(kind, int(number), actor) for kind, number, actor in map(str.split, ENTRIES.split(","))]


def record_of_clients():
    return Ledger(
        entered=[Entered(10 + k, k, "ann") for k in (1, 2, 3)],
        decisions=[
            Decision(1, "released", "ann"),
            Decision(2, "rejected", "bob"),
            Decision(3, "released"),
            Decision(4, "queued"),
        ],
        hand_outs=[HandOut("bob", (1,), b"one"), HandOut("ann", (), b"")],
    )


def test_an_archive_that_holds_all_answered_requests_has_no_faults():
    assert judge(record_of_clients(), ROWS, LINES).total() == 0


def changed(number, **values):
    return [{**row, **values} if row["id"] == number else row for row in ROWS]


@mark.parametrize(
    "fault, rows",
    [
        ("commands_lost", ROWS[1:]), ("commands_lost", changed(2, arguments={"argument_1": 99.0})),
        ("commands_doubled", [*ROWS, {**ROWS[3], "id": 5}]), ("states_lost", changed(3, state="queued")),
        ("states_lost", changed(2, decided_by="ann")), ("states_lost", ROWS[:3]),
        ("shared_counts", changed(3, sequence_count=0)), ("hand_outs_wrong", changed(1, state="released")),
        ("hand_outs_wrong", changed(1, octets=b"another")), ("hand_outs_wrong", changed(3, state="sent")),
        ("audit_wrong", changed(4, state="rejected", decided_by="bob")),
    ],
)  # fmt: skip
def test_each_difference_of_a_row_is_a_fault(fault, rows):
    assert judge(record_of_clients(), rows, LINES)[fault] > 0


def test_every_change_has_one_audit_entry_of_its_actor():
    record = record_of_clients()
    for number in range(len(LINES)):
        assert judge(record, ROWS, [line for k, line in enumerate(LINES) if k != number])["audit_wrong"] == 1
        assert judge(record, ROWS, [*LINES, LINES[number]])["audit_wrong"] == 1
        other = [replace(line, actor="eve") if k == number else line for k, line in enumerate(LINES)]
        assert judge(record, ROWS, other)["audit_wrong"] == (LINES[number].command != 4 or 1)
    assert judge(record, ROWS, [*LINES, AuditLine("release", 4, "ann")])["audit_wrong"] == 1


def test_pieces_are_cut_at_any_octet_and_make_up_the_stream():
    stream = bytes(random.Random(1).randbytes(5000))
    pieces = cut_pieces(stream, 40, random.Random(2), "round")
    in_order = sorted(pieces, key=lambda piece: piece.offset)
    assert b"".join(one.octets for one in in_order) == stream and in_order != pieces
    assert all(stream[one.offset :].startswith(one.octets) for one in pieces)
