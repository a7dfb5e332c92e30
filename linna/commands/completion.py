"""`linna completion`: text that makes a shell complete commands, options and scenario names."""

from __future__ import annotations

import argparse

from linna.completion import SHELLS, script
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Print the text that makes a shell complete linna commands, options and names of shipped scenarios. "
        'bash, zsh: eval "$(linna completion bash)"; fish: linna completion fish | source'
    )
    option(parser, "shell", SHELLS, "shell that reads the text")
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    print(script(arguments.shell))
    return 0
