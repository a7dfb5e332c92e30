"""`linna serve | worker | scheduler | runner | doctor | verify`: processes of the ground service, and checks of it."""

import argparse
import time
from pathlib import Path

from linna.commands._ground import add_service_options, event_of_signals, open_service, settings_of
from linna.data import data_folder
from linna.errors import UsageError
from linna.output import add_json_flag, checked, emit, finish, log
from linna.parser import option


def configure_serve(parser: argparse.ArgumentParser) -> None:
    option(parser, "--host", str, "address to bind to (default: 127.0.0.1)")
    option(parser, "--port", int, "port (default: 8042)")
    add_service_options(parser)
    parser.set_defaults(handler=run_serve)


def run_serve(arguments: argparse.Namespace) -> int:
    from ground_service.app import serve

    serve(settings_of(arguments, host=arguments.host, port=arguments.port, data=data_folder().root))
    return 0


def configure_worker(parser: argparse.ArgumentParser) -> None:
    option(parser, "--concurrency N", int, "simultaneous jobs", 1)
    option(parser, "--check", bool, "exit 0 if the worker of this machine responds, otherwise 1")
    add_service_options(parser)
    parser.set_defaults(handler=_work)


def _work(arguments: argparse.Namespace) -> int:
    from ground_service.worker.app import run_worker, worker_answers

    if arguments.check:
        return checked(worker_answers(settings_of(arguments)), "an answer of the worker of this machine")
    run_worker(settings_of(arguments, data=data_folder().root), max(arguments.concurrency, 1))
    return 0


def configure_scheduler(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Enter the nightly job and the jobs of the plan, send lost jobs again, and note overdue telecommands. "
        "One process of a deployment does this, by a lease in the database; each API process takes part as well."
    )
    option(parser, "--check", bool, "exit 0 if a process of the deployment has the lease, otherwise 1")
    add_service_options(parser)
    parser.set_defaults(handler=run_scheduler)


def run_scheduler(arguments: argparse.Namespace) -> int:
    import logging.config

    from ground_service.ground import ground_from_settings
    from ground_service.logs import logging_config
    from ground_service.missions.clocks import mission_clock
    from ground_service.worker.condition import present
    from ground_service.worker.dispatch import dispatcher_for
    from ground_service.worker.follow_up import follow_in_process
    from ground_service.worker.scheduler import Scheduler, has_scheduler

    settings = settings_of(arguments, data=data_folder().root)
    with ground_from_settings(settings) as ground:
        if arguments.check:
            return checked(has_scheduler(ground), "a process with the lease of the recurring work")
        logging.config.dictConfig(logging_config(settings.log_format))
        stopping = event_of_signals()
        dispatcher = dispatcher_for(ground, settings)
        follow_up = follow_in_process(ground, dispatcher.start)
        try:
            scheduler = Scheduler(ground, dispatcher, follow_up.drain, settings.kept, plan_hourly=settings.plan_hourly)
            with present(ground, settings, "scheduler"), mission_clock(ground):
                scheduler.run(stopping, first_s=0.0)
        finally:
            dispatcher.close()
    return 0


def configure_runner(parser: argparse.ArgumentParser) -> None:
    option(parser, "--exchange DIR", Path, "folder shared with the service (default: $LINNA_RUNNER_EXCHANGE)")
    option(parser, "--jobs N", int, "exit after N builds (default: never)")
    option(parser, "--check", bool, "only check whether a runner serves the exchange folder")
    parser.set_defaults(handler=run_runner)


def run_runner(arguments: argparse.Namespace) -> int:
    import logging.config

    from ground_service.logs import logging_config
    from ground_service.regression.runner import alive, serve_exchange
    from ground_service.regression.sandbox import SandboxRefused, protection
    from ground_service.settings import load_settings

    settings = load_settings()
    exchange = arguments.exchange or settings.runner_exchange
    if exchange is None:
        raise UsageError("--exchange: expected a folder shared with the service, found none")
    try:
        if arguments.check:
            return checked(alive(exchange), f"a runner that serves {exchange}")
        logging.config.dictConfig(logging_config(settings.log_format))
        print(f"builds are isolated by: {protection()}", flush=True)
        serve_exchange(exchange, jobs=arguments.jobs, stopping=event_of_signals(), data=settings.data)
    except SandboxRefused as error:
        raise UsageError(str(error)) from None
    return 0


def configure_doctor(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check schema, processes, clocks, recurring work, broker, archive, files, provider and channels. "
        "Run it with the settings of the service, for example in a container of it. Exit status 1: something is wrong."
    )
    add_service_options(parser)
    add_json_flag(parser)
    parser.set_defaults(handler=run_doctor)


def run_doctor(arguments: argparse.Namespace) -> int:
    from ground_service.ground import ground_from_settings
    from ground_service.worker.doctor import examine

    settings = settings_of(arguments, data=data_folder().root)
    with ground_from_settings(settings) as ground:
        checks = examine(ground, settings)
    broken = [one.name for one in checks if not one.ok]
    lines = [f"{'ok   ' if one.ok else 'FAULT'} {one.name}: {one.found}" for one in checks]
    verdict = "broken" if broken else "healthy"
    figures = {"checks": [one.model_dump() for one in checks], "verdict": verdict}
    emit(arguments, figures, text="\n".join([*lines, verdict]))
    return 1 if broken else 0


LINES = 50


def configure_verify(parser: argparse.ArgumentParser) -> None:
    option(
        parser,
        "--rebuild",
        bool,
        "also derive packets, values, roll-ups and time correlations again from the raw files and compare",
    )
    option(
        parser,
        "--head HEAD",
        str,
        "stored head of the audit chain, NUMBER:SHA256 ('linna audit head'), or a file or folder of signed heads",
    )
    add_service_options(parser)
    finish(parser, run_verify)


def run_verify(arguments: argparse.Namespace) -> int:
    from ground_service.worker.integrity import verify
    from ground_service.worker.upkeep import kept_heads

    head, began = arguments.head, time.monotonic()
    with open_service(arguments) as ground:
        heads = kept_heads(ground, head) if head else []
        result = verify(ground, rebuild=arguments.rebuild, heads=heads, say=log)
    figures = {**result.model_dump(), "wall_s": round(time.monotonic() - began, 3)}
    lines = [f"{one.kind} {one.key}: {one.reason}" for one in result.damaged[:LINES]]
    if result.damaged_total > len(lines):
        lines.append(f"… {result.damaged_total - len(lines)} more")
    lines += [f"not checked: {count} {reason}" for reason, count in result.unchecked.items()]
    lines.append(
        f"{result.verdict}: {sum(result.checked.values())} checked, {result.damaged_total} damaged; "
        f"audit head {result.audit_head}"
    )
    emit(arguments, figures, text="\n".join(lines))
    return 1 if result.damaged_total else 0
