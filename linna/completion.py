"""Shell completion of commands, options and names of shipped scenarios."""

from __future__ import annotations

import argparse
import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.parser import LinnaParser, all_commands

if TYPE_CHECKING:
    from collections.abc import Mapping

SHELLS = ("bash", "zsh", "fish")
_SCENARIO_ARGUMENTS = ("scenario", "recipe")
_SCENARIOS = Path(__file__).resolve().parents[1] / "scenarios"


def complete(groups: Mapping[str, tuple[str, str]]) -> None:
    """Answer a completion request of the shell and exit; only the module of the group typed is imported."""
    import argcomplete

    words = os.environ.get("COMP_LINE", "").split()
    argcomplete.autocomplete(command_parser(groups, words[1] if len(words) > 1 else ""))


def command_parser(groups: Mapping[str, tuple[str, str]], group: str) -> argparse.ArgumentParser:
    """Return a parser of all groups, with the commands and options of one of them."""
    top = LinnaParser(prog="linna")
    commands = top.add_subparsers()
    for name, (module_name, help_line) in groups.items():
        parser = commands.add_parser(name, help=help_line)
        if name == group:
            importlib.import_module(f"linna.commands.{module_name}").configure(parser)
            for _, one in [(name, parser), *all_commands(parser)]:
                _add_scenario_names(one)
    return top


def script(shell: str) -> str:
    """Return the text that a shell reads to complete `linna` commands."""
    from argcomplete.shell_integration import shellcode

    return str(shellcode(["linna"], shell=shell))


def _add_scenario_names(parser: argparse.ArgumentParser) -> None:
    for action in parser._actions:
        if action.dest in _SCENARIO_ARGUMENTS:
            completing: Any = action
            completing.completer = _scenario_names


def _scenario_names(prefix: str, **_: Any) -> list[str]:
    from argcomplete.completers import FilesCompleter

    names = sorted(path.stem for path in _SCENARIOS.glob("*.toml"))
    return [*(name for name in names if name.startswith(prefix)), *FilesCompleter(("toml",))(prefix)]
