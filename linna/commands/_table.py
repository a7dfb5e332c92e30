"""Tables of commands that call the client: options from the signature of an operation, results as text or JSON."""

import argparse
import inspect
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from linna.commands._ground import add_operator_options, ground_client
from linna.output import emit, finish
from linna.parser import LinnaParser, add_commands

LIMIT = 50
HELP = {
    "spacecraft_id": "CCSDS spacecraft identifier",
    "instance": "instance of the spacecraft",
    "limit": "largest number of items",
    "since": "from this time on (RFC 3339)",
    "until": "before this time (RFC 3339)",
}
METAVARS = {
    "spacecraft_id": "N", "instance": "NAME", "since": "UTC", "until": "UTC", "start": "UTC", "stop": "UTC",
    int: "N", float: "X", str: "TEXT", Path: "FILE",
}  # fmt: skip
NOT_ASKED = {"self", "service", "key", "if_match"}


def as_json(entity: Any) -> dict[str, Any]:
    """Return an entity as plain values; plain values stay as they are."""
    return entity if isinstance(entity, dict) else entity.model_dump(mode="json")


@dataclass(frozen=True, slots=True)
class Option:
    """Presentation of an argument: help, name of its value, and another name of the option."""

    help: str = ""
    metavar: str | tuple[str, str] | None = None
    name: str | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """A command that prints the result of an operation.

    Parameters
    ----------
    work
        Name of a method of the client, or a function of the client and options by keyword.
    help
        One line.
    text
        Text of the result, or of one item of a list.
    items
        Key of a list in the figures; None if the result is one entity.
    none
        Text of an empty list.
    figures
        Plain values of the result, or of one item of a list.
    options
        Arguments as a person sees them; a text is the help.
    positional
        Arguments without a dash after the first required one, which has none either.
    preset
        Arguments that the command decides.
    limit
        Default number of items of a list that comes in pages; None is all of them.
    """

    work: str | Callable[..., Any]
    help: str
    text: Callable[[Any], str]
    items: str | None = None
    none: str = ""
    figures: Callable[[Any], dict[str, Any]] = as_json
    options: Mapping[str, Option | str] = field(default_factory=dict)
    positional: Sequence[str] = ()
    preset: Mapping[str, Any] = field(default_factory=dict)
    limit: int | None = LIMIT

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the options and the handler."""
        work = self._work()
        signature = inspect.signature(work)
        scope = inspect.unwrap(work).__globals__
        first = True
        for name, one in signature.parameters.items():
            if name in NOT_ASKED or name in self.preset:
                continue
            is_first = (
                first and one.default is one.empty and one.kind is not one.KEYWORD_ONLY and name != "spacecraft_id"
            )
            first = first and not is_first
            stated = self.options.get(name, "")
            option = Option(stated) if isinstance(stated, str) else stated
            _add(parser, name, eval(one.annotation, scope), one.default, option, is_first or name in self.positional)
        if self.limit is not None and signature.return_annotation.startswith("Listing["):
            _add(parser, "limit", int, self.limit, Option(), False)
        add_operator_options(parser)
        finish(parser, self.run)

    def run(self, arguments: argparse.Namespace) -> int:
        """Call the operation and print its result."""
        work = self._work()
        given = {
            name: getattr(arguments, name)
            for name in inspect.signature(work).parameters
            if name not in NOT_ASKED and name not in self.preset
        }
        with ground_client(arguments) as service:
            found = work(service, **given, **self.preset)
            page = found.page(arguments.limit) if hasattr(arguments, "limit") else None
            rows = [] if self.items is None else list(found) if page is None else page.items
        if self.items is None:
            return emit(arguments, self.figures(found), text=self.text(found))
        figures: dict[str, Any] = {self.items: [self.figures(one) for one in rows]}
        if page is not None:
            figures["total"] = page.total
        return emit(arguments, figures, text="\n".join(self.text(one) for one in rows) or self.none)

    def _work(self) -> Callable[..., Any]:
        if not isinstance(self.work, str):
            return self.work
        from ground_service.client import Client

        work: Callable[..., Any] = getattr(Client, self.work)
        return work


Commands = Mapping[str, "Command | Group | CustomCommand"]


@dataclass(frozen=True, slots=True)
class Group:
    """Commands with a common first word."""

    help: str
    commands: Commands

    def configure(self, parser: LinnaParser) -> None:
        """Add the commands."""
        add_commands(parser, self.commands)


@dataclass(frozen=True, slots=True)
class CustomCommand:
    """A command whose options are added by a function, which sets a handler as well."""

    help: str
    configure: Callable[[LinnaParser], None]


def _add(parser: argparse.ArgumentParser, name: str, kind: Any, default: Any, option: Option, positional: bool) -> None:
    """Add an argument of a type: choices of a literal, repeated values of a sequence, a switch for a truth value."""
    required = default is inspect.Parameter.empty
    inner = [one for one in get_args(kind) if one is not types.NoneType]
    if get_origin(kind) in (Union, types.UnionType):
        kind, inner = (inner[0], list(get_args(inner[0]))) if len(inner) == 1 else (inner[0], [])
    origin = get_origin(kind)
    text = option.help or HELP.get(name, "")
    words: dict[str, Any] = {"help": text}
    if kind is bool:
        words["action"] = "store_true"
    else:
        if origin is tuple:
            words["nargs"], kind = len(inner), inner[0]
        elif origin in (list, Sequence):
            words |= {"nargs": "+" if required else "*"} if positional else {"action": "append"}
            kind, inner = inner[0], list(get_args(inner[0]))
            origin = get_origin(kind)
        if origin is Literal:
            words["choices"] = inner
            words["metavar"] = option.metavar
        else:
            words["type"] = kind
            words["metavar"] = option.metavar or METAVARS.get(name) or METAVARS.get(kind)
        if not required:
            words["default"] = default
            if default not in (None, "", ()):
                shown = f"{default:g}" if isinstance(default, float) else default
                words["help"] = f"{text} (default: {shown})".strip()
    if positional:
        metavar = option.metavar or ("ID" if name.endswith("_id") else name.upper())
        words |= {"metavar": metavar} if words.get("metavar") is None or option.metavar is None else {}
        if not required and "nargs" not in words:
            words["nargs"] = "?"
        parser.add_argument(name, **words)
        return
    flag = option.name or f"--{name.replace('_', '-')}"
    parser.add_argument(flag, dest=name, required=required, **words)
