"""`linna serve`: the HTTP interface of the ground service."""

import argparse

from linna.commands._ground import add_service_options, settings_of
from linna.data import data_folder
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "--host", str, "address to bind to (default: 127.0.0.1)")
    option(parser, "--port", int, "port (default: 8042)")
    add_service_options(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.app import serve

    serve(settings_of(arguments, host=arguments.host, port=arguments.port, data=data_folder().root))
    return 0
