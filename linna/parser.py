"""Parser of the command line: descriptions for every command, required options marked."""

from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from linna.help import example

REQUIRED = "(required)"


class BadUsage(Exception):
    """Arguments that the parser of a command refuses."""

    def __init__(self, command: str, message: str) -> None:
        super().__init__(message)
        self.command = command


class LinnaFormatter(argparse.HelpFormatter):
    """Help layout that marks required options."""

    def _format_action(self, action: argparse.Action) -> str:
        if action.required and action.option_strings and REQUIRED not in (action.help or ""):
            action.help = f"{action.help or ''} {REQUIRED}".strip()
        return super()._format_action(action)


class RawFormatter(LinnaFormatter, argparse.RawDescriptionHelpFormatter):
    """The same for descriptions and epilogues whose lines stay as they are."""


class LinnaParser(argparse.ArgumentParser):
    """Argument parser of all commands; errors are raised as `BadUsage`."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        options.setdefault("formatter_class", LinnaFormatter)
        super().__init__(*arguments, **options)
        self.register("action", "parsers", _Subcommands)
        self._fill: Callable[[LinnaParser], None] | None = None

    def fill(self, configure: Callable[[LinnaParser], None]) -> None:
        """Add the options by a function when the command is parsed or described."""
        self._fill = configure

    def filled(self) -> LinnaParser:
        """Return the parser with its options."""
        configure, self._fill = self._fill, None
        if configure is not None:
            configure(self)
        return self

    def parse_known_args(self, *arguments: Any, **options: Any) -> Any:
        """Return the parsed arguments and the unknown ones."""
        self.filled()
        return super().parse_known_args(*arguments, **options)

    def format_help(self) -> str:
        """Return the help text."""
        self.filled()
        return f"{super().format_help()}\nexample: {example(self.prog)}\n"

    def error(self, message: str) -> NoReturn:
        raise BadUsage(self.prog, message)


class _Subcommands(argparse._SubParsersAction):  # type: ignore[type-arg]  # generic in the stubs only
    """Subcommands whose one line of help is also their description."""

    def add_parser(self, name: str, **options: Any) -> Any:
        help_line = options.get("help")
        if help_line and "description" not in options:
            options["description"] = help_line[0].upper() + help_line[1:]
        return super().add_parser(name, **options)


def option(
    parser: argparse._ActionsContainer, name: str, kind: Any = str, help: str = "", default: Any = None, **words: Any
) -> argparse.Action:
    """Add an argument to a parser.

    Parameters
    ----------
    name
        As in the usage line, such as ``--step S``; the attribute comes first if the argument has no dash.
    kind
        Type of the value, `bool` for a switch, or the choices.
    default
        Value without the argument; the help states it.
    """
    flags = [word for word in name.split() if word.startswith("-")] or name.split()[:1]
    shown = tuple(name.split()[len(flags) :])
    if shown:
        words["metavar"] = shown if len(shown) > 1 else shown[0]
        words |= {"nargs": len(shown)} if len(shown) > 1 else {}
    if kind is bool:
        words["action"] = "store_true"
    else:
        words["type" if callable(kind) else "choices"] = kind
    if default not in (None, "", [], False) and default == default and "default" not in help:
        help = f"{help} (default: {f'{default:g}' if isinstance(default, float) else default})".strip()
    return parser.add_argument(*flags, help=help, default=default, **words)


def number(
    kind: type[int] | type[float] = float,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
    below: float = math.inf,
) -> Callable[[str], Any]:
    """Return the type of an option: a finite number within limits."""
    limits = {"from": least, "above": above, "up to": most, "below": below}
    stated = " and ".join(f"{word} {limit:g}" for word, limit in limits.items() if math.isfinite(limit))

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not (least <= value <= most and above < value < below):
            raise argparse.ArgumentTypeError(f"expected a number {stated}, found {text!r}")
        return value

    return parse


ABOVE_ZERO = number(above=0)


def all_commands(parser: argparse.ArgumentParser) -> list[tuple[str, argparse.ArgumentParser]]:
    """Return every command below a parser with its full name, in the order of its help."""
    found: list[tuple[str, argparse.ArgumentParser]] = []
    if isinstance(parser, LinnaParser):
        parser.filled()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                found += [(one.prog, one), *all_commands(one)]
    return found


def command_parser(groups: Mapping[str, tuple[str, str]], group: str) -> argparse.ArgumentParser:
    """Return a parser of all groups, with the commands and options of one of them."""
    top = LinnaParser(prog="linna")
    commands = top.add_subparsers()
    for name, (module_name, help_line) in groups.items():
        parser = commands.add_parser(name, help=help_line)
        if name == group:
            configure_group(parser, module_name, group)
    return top


def configure_group(parser: argparse.ArgumentParser, module_name: str, group: str) -> None:
    """Add the commands or options of a group: the table with its name in a module, or a function `configure_GROUP`."""
    module = importlib.import_module(f"linna.commands.{module_name}")
    table = getattr(module, group.upper(), None)
    if table is None:
        getattr(module, f"configure_{group}")(parser)
    else:
        add_commands(parser, table)


def add_commands(parser: argparse.ArgumentParser, commands: Mapping[str, Any]) -> None:
    """Add the commands of a table."""
    actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=LinnaParser)
    for name, one in commands.items():
        actions.add_parser(name, help=one.help).fill(one.configure)
