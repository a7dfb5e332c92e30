"""`linna runner`: execution of payload builds for a ground service, in a separate container."""

import argparse
from pathlib import Path

from linna.commands._ground import event_of_signals
from linna.errors import UsageError
from linna.output import checked
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "--exchange DIR", Path, "folder shared with the service (default: $LINNA_RUNNER_EXCHANGE)")
    option(parser, "--jobs N", int, "exit after N builds (default: never)")
    option(parser, "--check", bool, "only check whether a runner serves the exchange folder")
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
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
