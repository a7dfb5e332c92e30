"""Compare-and-set of states, counters of telecommands, and locks, on both databases."""

import ast
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pytest import raises

import ground_service
from ground_service.errors import NotFound, StateConflict
from ground_service.store import repository
from ground_service.store.states import JOB, TELECOMMAND, change_if, move, move_all
from ground_service.store.vehicles import hold, next_telecommand, vehicle_id


def add_command(ground, state="queued"):
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, 76, "flight")
        return int(
            repository.add(
                connection, repository.TELECOMMANDS, vehicle_id=vehicle, name="test_connection", arguments={},
                state=state, critical=0, timeout_s=1, requested_by="ann", created_utc_ns=1,
            )
        )  # fmt: skip


def state_of(ground, key):
    with ground.database.reading() as connection:
        return str(repository.get(connection, repository.TELECOMMANDS, key, "telecommand")["state"])


def test_a_transition_happens_once_and_the_second_is_refused_with_the_state_that_won(either):
    key = add_command(either)
    either.write(move, TELECOMMAND, key, "released", reason="first")
    with (
        raises(StateConflict, match=f"telecommand {key}: expected state queued, found released") as lost,
        either.database.writing() as connection,
    ):
        move(connection, TELECOMMAND, key, "released", reason="second")
    assert (lost.value.found, state_of(either, key)) == ("released", "released")
    with either.database.reading() as connection:
        assert repository.get(connection, repository.TELECOMMANDS, key, "t")["reason"] == "first"


def test_a_row_that_does_not_exist_is_not_found(either):
    with raises(NotFound, match="telecommand 99"), either.database.writing() as connection:
        move(connection, TELECOMMAND, 99, "released")


def test_a_transition_can_ask_for_more_than_the_state(either):
    either.write(
        repository.add, repository.JOBS, id="j", kind="report", state="running", arguments={}, progress=0.0,
        attempts=2, created_utc_ns=1,
    )  # fmt: skip
    with raises(StateConflict), either.database.writing() as connection:
        move(connection, JOB, "j", "done", where={"attempts": 1})
    either.write(move, JOB, "j", "done", where={"attempts": 2})


def test_only_rows_in_a_state_that_may_be_left_are_moved_together(either):
    keys = [add_command(either, state) for state in ("released", "queued", "released", "rejected", "sent")]
    with either.database.writing() as connection:
        moved = move_all(connection, TELECOMMAND, [], "sent")
        assert sorted(row["id"] for row in moved) == [keys[0], keys[2]]
        assert move_all(connection, TELECOMMAND, [], "sent") == []


def test_a_row_is_changed_only_as_it_was_found(either):
    key = add_command(either)
    table = repository.TELECOMMANDS
    with either.database.writing() as connection:
        assert change_if(connection, table, key, {"state": "queued", "reason": None}, reason="x")
        assert not change_if(connection, table, key, {"reason": None}, reason="y")
        assert not change_if(connection, table, key, {"state": "sent"}, reason="y")


def test_a_row_is_added_once(either):
    with either.database.writing() as connection:
        answers = repository.ANSWERS
        assert repository.add_new(connection, answers, key="k", request="a", created_utc_ns=1)
        assert not repository.add_new(connection, answers, key="k", request="b", created_utc_ns=2)
        assert repository.get(connection, answers, "k", "answer")["request"] == "a"


def test_counters_give_every_number_once_to_transactions_at_the_same_time(either):
    with either.database.writing() as connection:
        vehicles = [vehicle_id(connection, number, "flight") for number in (1, 2)]

    def count(vehicle):
        return either.write(next_telecommand, vehicle)

    with ThreadPoolExecutor(8) as pool:
        given = list(pool.map(count, vehicles * 20))
    assert sorted(given[::2]) == sorted(given[1::2]) == list(range(20))


def test_a_number_that_was_not_used_is_given_again(either):
    vehicle = either.write(vehicle_id, 1, "flight")
    with raises(RuntimeError), either.database.writing() as connection:
        next_telecommand(connection, vehicle)
        raise RuntimeError("the transaction fails")
    with either.database.writing() as connection:
        assert next_telecommand(connection, vehicle) == 0


def test_one_transaction_at_a_time_holds_a_name(either):
    inside, most, lock = 0, 0, threading.Lock()

    def work(_):
        nonlocal inside, most
        with either.database.writing() as connection:
            hold(connection, "archive")
            with lock:
                inside += 1
                most = max(most, inside)
            threading.Event().wait(0.01)
            with lock:
                inside -= 1

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(work, range(12)))
    assert most == 1


def test_nothing_writes_a_state_but_the_store():
    """`repository.change` and bare updates read first and write afterwards: states are changed by compare-and-set."""
    root = Path(ground_service.__file__).parent
    found = []
    for path in root.rglob("*.py"):
        if path.name == "states.py" or path in _ELSEWHERE:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            names = {keyword.arg for keyword in node.keywords}
            if name in ("change", "values") and names & {"state", "decision"}:
                found.append(f"{path.relative_to(root)}:{node.lineno}")
    assert found == []


_ROOT = Path(ground_service.__file__).parent
_ELSEWHERE = (_ROOT / "ingest/store.py", _ROOT / "links/store.py")
"""An ingest is done by its job alone; a link is taken by one statement that compares the end of its lease."""
