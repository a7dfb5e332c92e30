"""The Celery application: the jobs of `ground_service.worker.jobs`, done by workers over a broker.

Tasks are acknowledged when they are done and given to another worker when theirs dies; since every job may be done
twice without harm, that loses and doubles nothing.
"""

import contextlib
import json
import logging.config
import socket
from typing import Any

from celery import Celery
from celery.signals import setup_logging
from kombu.exceptions import OperationalError

from ground_service.errors import PASSING, SettingsError
from ground_service.ground import Ground, ground_from_settings
from ground_service.logs import logging_config
from ground_service.missions.clocks import read_mission_clock
from ground_service.settings import Settings, start_tracing
from ground_service.worker.condition import present
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.jobs import run_job
from kernels.memory import limit_heaps

RUN_JOB = "ground_service.run_job"
JOB_HEADER = "linna-job"
TIME_LIMIT_S = 1800
RETRIES = 5
QUEUE = "linna"
VISIBILITY_TIMEOUT_S = 2 * TIME_LIMIT_S


def make_app(settings: Settings) -> Celery:
    """A Celery application over the deployment's broker; without one, tasks run where they are called."""
    broker = settings.resolved_broker_url()
    app = Celery("linna", broker=broker or "memory://", backend=None)
    app.conf.update(
        task_always_eager=broker is None,
        task_eager_propagates=True,
        task_ignore_result=True,
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        task_time_limit=TIME_LIMIT_S,
        task_soft_time_limit=TIME_LIMIT_S - 30,
        task_serializer="json",
        accept_content=["json"],
        worker_prefetch_multiplier=1,
        worker_hijack_root_logger=False,
        broker_connection_retry_on_startup=True,
        broker_transport_options={
            "visibility_timeout": VISIBILITY_TIMEOUT_S,
            "socket_timeout": 10.0,
            "max_retries": 1,  # a job is kept and sent again later
            "interval_start": 0.2,
        },
        task_default_queue=QUEUE,
        worker_max_tasks_per_child=200,
        timezone="UTC",
    )

    @app.task(
        name=RUN_JOB,
        bind=True,
        autoretry_for=(OSError, *PASSING),
        retry_backoff=2,
        retry_backoff_max=120,
        max_retries=RETRIES,
    )
    def run(_task: Any, job_id: str) -> None:
        start_tracing(settings)
        run_job(_ground_of(settings), job_id)

    return app


def send_job(settings: Settings, job_id: str) -> None:
    """Hand a job that was entered to the workers.

    Raises
    ------
    kombu.exceptions.OperationalError
        If the broker cannot be reached.
    """
    _app_of(settings).send_task(RUN_JOB, args=(job_id,), headers={JOB_HEADER: job_id}, retry=False)


def queued_jobs(settings: Settings) -> list[str]:
    """Return the ids of the jobs that wait at a Redis broker for a worker, the next one last.

    Raises
    ------
    kombu.exceptions.OperationalError
        If the broker cannot be reached.
    """
    from redis import RedisError

    app = _app_of(settings)
    try:
        with app.connection_for_read() as connection:
            messages = connection.default_channel.client.lrange(QUEUE, 0, -1)
    except RedisError as error:
        raise OperationalError(str(error)) from error
    return [job for job in map(_job_of, messages) if job is not None]


def _job_of(message: bytes) -> str | None:
    """Return the id of the job of a message in the queue; None for a message of another program."""
    try:
        job = json.loads(message).get("headers", {}).get(JOB_HEADER)
    except (ValueError, AttributeError):
        return None
    return None if job is None else str(job)


def worker_answers(settings: Settings, timeout_s: float = 4.0) -> bool:
    """Return whether the worker of this machine answers over the broker.

    Raises
    ------
    SettingsError
        If no broker is set.
    """
    from redis import RedisError

    _require_broker(settings)
    name = f"celery@{socket.gethostname()}"
    inspect = _app_of(settings).control.inspect(destination=[name], timeout=timeout_s)
    try:
        return bool(inspect.ping())
    except (OperationalError, RedisError, OSError):
        return False


_grounds: dict[str, Ground] = {}
_apps: dict[str, Celery] = {}


def _key(settings: Settings) -> str:
    return f"{settings.resolved_database_url()} {settings.home} {settings.resolved_broker_url()}"


def _ground_of(settings: Settings) -> Ground:
    """Return the service, opened once per process, with the mission time as stated now.

    Jobs of its follow-up work go to all workers.
    """
    key = _key(settings)
    if key not in _grounds:
        ground = ground_from_settings(settings)

        def start(job_id: str) -> None:
            with contextlib.suppress(OperationalError):  # sent again by the sweep of the server
                send_job(settings, job_id)

        follow_in_process(ground, start)
        _grounds[key] = ground
    read_mission_clock(_grounds[key])
    return _grounds[key]


def _app_of(settings: Settings) -> Celery:
    key = _key(settings)
    if key not in _apps:
        _apps[key] = make_app(settings)
    return _apps[key]


def _require_broker(settings: Settings) -> None:
    if settings.resolved_broker_url() is None:
        raise SettingsError("LINNA_BROKER_URL", "a broker such as redis://localhost:6379/0", "nothing")


def run_worker(settings: Settings, concurrency: int = 1) -> None:
    """Do jobs until stopped.

    Raises
    ------
    SettingsError
        If no broker is set: jobs are then done by the service itself.
    """
    _require_broker(settings)
    limit_heaps()
    ground = _ground_of(settings)
    ground.close()

    @setup_logging.connect(weak=False)
    def configure(**_: Any) -> None:
        logging.config.dictConfig(logging_config(settings.log_format))

    words = ["worker", "--loglevel=INFO", f"--concurrency={concurrency}", "--without-gossip", "--without-mingle"]
    with present(ground, settings, "worker"):
        ground.close()  # its processes are forked without connections
        make_app(settings).worker_main(words)
