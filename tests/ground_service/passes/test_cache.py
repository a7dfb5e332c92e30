"""Cached answers: kept while other data come, made again with new data of their interval, made once for many."""

import threading

from pytest import fixture, mark
from sqlalchemy import delete

from ground_service.passes import series
from ground_service.passes.series import Cache
from ground_service.store.event_kinds import CorrelationChanged, LinkChanged, TelemetryReceived, publish
from ground_service.store.models import EVENT_LOG
from ground_service.store.vehicles import change_vehicle, vehicle_id

START, STOP = 1000, 2000


class Archive:
    """Events of two vehicles, and a cached answer on an interval of the first: how often it was made."""

    def __init__(self, ground):
        self.ground = ground
        with ground.database.writing() as connection:
            self.vehicle, self.other = (vehicle_id(connection, 76, name) for name in ("flight", "other"))
            publish(connection, LinkChanged(link="first", state="open"))
        self.made = 0

    def happens(self, *events):
        with self.ground.database.writing() as connection:
            for one in events:
                publish(connection, one)

    def telemetry(self, first, last, **more):
        vehicle = more.pop("vehicle", self.vehicle)
        self.happens(TelemetryReceived(vehicle_id=vehicle, packets=1, first_ticks=first, last_ticks=last, **more))

    def make(self):
        self.made += 1
        return self.made

    def ask(self, state=None):
        with self.ground.database.reading() as connection:
            cache = Cache(self.ground, connection, self.vehicle)
            return cache.answer("answer", self.make, start_ticks=START, stop_ticks=STOP, state=state)


@fixture
def archive(ground):
    return Archive(ground)


def test_an_answer_is_kept_while_data_of_other_intervals_and_vehicles_come(archive):
    assert archive.ask() == 1
    archive.telemetry(0, START - 1)
    archive.telemetry(STOP + 1, STOP + 9)
    archive.telemetry(START, STOP, vehicle=archive.other)
    archive.happens(CorrelationChanged(vehicle_id=archive.other, segments=1))
    archive.happens(LinkChanged(link="first", state="closed"))
    assert archive.ask() == 1


@mark.parametrize("first, last", [(0, START), (STOP, STOP + 9), (None, None), (1200, 1300)])
def test_an_answer_is_made_again_with_new_data_of_its_interval(archive, first, last):
    assert archive.ask() == 1
    archive.telemetry(first, last)
    assert archive.ask() == archive.ask() == 2


def test_samples_correlations_decodings_and_other_states_make_an_answer_again(archive):
    """Samples may have other times than their packets."""
    assert archive.ask() == 1
    archive.telemetry(STOP + 5, STOP + 9, first_sample_ticks=STOP)
    assert archive.ask() == 2
    archive.telemetry(0, START - 5, last_sample_ticks=START)
    assert archive.ask() == 3
    archive.happens(CorrelationChanged(vehicle_id=archive.vehicle, segments=1))
    assert archive.ask() == 4
    with archive.ground.database.writing() as connection:
        change_vehicle(connection, archive.vehicle, decoded_version=7)
    assert archive.ask() == 5
    assert archive.ask("other") == archive.ask("other") == 6


def test_a_gap_in_the_events_or_more_than_are_looked_at_forget_all_answers(archive):
    assert archive.ask() == 1
    archive.telemetry(START, STOP)
    archive.telemetry(0, 1)
    with archive.ground.database.writing() as connection:
        newest = connection.execute(EVENT_LOG.select().order_by(EVENT_LOG.c.id.desc())).first()
        connection.execute(delete(EVENT_LOG).where(EVENT_LOG.c.id < newest.id))
    assert archive.ask() == archive.ask() == 2
    for _ in range(2):
        archive.happens(*[LinkChanged(link="first", state="open")] * (series.CHANGES_KEPT // 2))
    assert archive.ask() == 3


def test_an_answer_older_than_a_change_that_is_known_is_not_kept(archive):
    with archive.ground.database.reading() as connection:
        cache = Cache(archive.ground, connection, archive.vehicle)

        def slow():
            archive.telemetry(START, STOP)
            with archive.ground.database.reading() as other:
                Cache(archive.ground, other, archive.vehicle)
            return "before the change"

        assert cache.answer("answer", slow, start_ticks=START, stop_ticks=STOP) == "before the change"
    assert archive.ask() == 1


def test_an_answer_that_many_need_at_once_is_made_once(archive):
    begun, go_on = threading.Event(), threading.Event()
    found = []

    def slow():
        begun.set()
        assert go_on.wait()
        return archive.make()

    def ask(make):
        with archive.ground.database.reading() as connection:
            cache = Cache(archive.ground, connection, archive.vehicle)
            found.append(cache.answer("answer", make))

    first = threading.Thread(target=ask, args=(slow,))
    first.start()
    assert begun.wait()
    others = [threading.Thread(target=ask, args=(archive.make,)) for _ in range(3)]
    for one in others:
        one.start()
    turns = series._databases[archive.ground.database.engine]._turns
    while max(turn.threads for turn in list(turns.values())) < 4:
        assert all(one.is_alive() for one in others)
    go_on.set()
    for one in first, *others:
        one.join()
    assert found == [1, 1, 1, 1]
    assert not turns
