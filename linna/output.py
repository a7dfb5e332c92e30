"""Output of commands: one JSON object or plain text on stdout, progress on stderr."""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from linna.parser import option

Item = TypeVar("Item")
_PLAIN_LINE_INTERVAL_S = 5.0


def add_json_flag(parser: argparse.ArgumentParser) -> None:
    option(parser, "--json", bool, "print one JSON object on stdout, everything else on stderr")


def finish(parser: argparse.ArgumentParser, handler: Callable[[argparse.Namespace], int]) -> None:
    """Add --json and the handler, after the options of a command."""
    add_json_flag(parser)
    parser.set_defaults(handler=handler)


def emit(arguments: argparse.Namespace, figures: Mapping[str, Any], text: str | None = None) -> int:
    """Print `figures` as one JSON object if --json was given, else `text` (or the figures, a line each); return 0."""
    if getattr(arguments, "json", False):
        print(as_json(figures))
    elif text is not None:
        print(text)
    else:
        for key, value in figures.items():
            print(f"{key}: {value}")
    return 0


def as_json(figures: Mapping[str, Any]) -> str:
    """`figures` as one JSON object; NaN and infinity are null."""
    return json.dumps(_plain(figures), allow_nan=False)


def save(path: Path, octets: bytes) -> None:
    """Write a file whole or not at all."""
    unfinished = path.with_name(f"{path.name}.part")
    try:
        unfinished.write_bytes(octets)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def checked(is_good: bool, expected: str) -> int:
    """Return the exit status of a check, with a line on stderr if it failed."""
    if not is_good:
        log(f"linna: expected {expected}, found none")
    return 0 if is_good else 1


def log(message: str) -> None:
    """One line of progress on stderr."""
    print(message, file=sys.stderr, flush=True)


def progress(items: Iterable[Item], total: int | None = None, label: str = "", unit: str = "") -> Iterator[Item]:
    """Yield `items`, showing a bar with rate and time left on a terminal, plain lines otherwise."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(items, total=total, desc=label, unit=f" {unit}" if unit else "it", file=sys.stderr)
        return
    started = last = time.monotonic()
    count = 0
    for count, item in enumerate(items, start=1):
        yield item
        now = time.monotonic()
        if now - last >= _PLAIN_LINE_INTERVAL_S:
            last = now
            rate = count / (now - started)
            left = f", {(total - count) / rate:.0f} s left" if total else ""
            log(f"{label}: {count}{f'/{total}' if total else ''} {unit} ({rate:.1f}/s{left})")
    log(f"{label}: {count} {unit} in {time.monotonic() - started:.1f} s")


def watched_rims(parts: Sequence[Item]) -> Iterator[Item]:
    """Yield parts of the craters that are measured, and show the progress."""
    return progress(parts, len(parts), "rims of craters", "part")


def _plain(value: Any) -> Any:
    """`value` with arrays as lists, numpy scalars as Python's, and NaN or infinity as null (JSON has neither)."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple, set)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, (str, int, float, bool)) else str(value)
