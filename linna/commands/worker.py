"""`linna worker`: does jobs that the service sends over its broker."""

import argparse

from linna.commands._ground import add_service_options, settings_of
from linna.data import data_folder
from linna.output import checked
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "--concurrency N", int, "simultaneous jobs", 1)
    option(parser, "--check", bool, "exit 0 if the worker of this machine responds, otherwise 1")
    add_service_options(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.worker.app import run_worker, worker_answers

    if arguments.check:
        return checked(worker_answers(settings_of(arguments)), "an answer of the worker of this machine")
    run_worker(settings_of(arguments, data=data_folder().root), max(arguments.concurrency, 1))
    return 0
