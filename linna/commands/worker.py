"""`linna worker`: does jobs that the service sends over its broker."""

from __future__ import annotations

import argparse

from linna.commands._ground import add_service_options, settings_of


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--concurrency", type=int, default=1, metavar="N", help="jobs at a time (default: 1)")
    parser.add_argument(
        "--beat", action="store_true", help="enter the nightly job, too (one worker of a deployment has to)"
    )
    add_service_options(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.worker.app import run_worker
    from linna.data import data_folder

    run_worker(
        settings_of(arguments, data=data_folder().root), max(arguments.concurrency, 1), beat=arguments.beat
    )
    return 0
