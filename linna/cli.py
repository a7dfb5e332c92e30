"""The `linna` command: it imports only the module of the given group and reports known errors in one line.

Exit status: 0 done, 1 a gate or requirement not met, 2 bad usage or bad input, 3 inconclusive, 130 interrupted.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence

from linna import __version__
from linna.parser import BadUsage, LinnaParser, configure_group

# Threads of numerical libraries that spin while they wait make two busy cores ten times slower: wait passively.
_THREAD_POLICY = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "NUMBA_SLP_VECTORIZE": "1"}

# task -> group -> (module, one line of help); the order is that of `linna --help`. See `configure_group`.
TASKS: dict[str, dict[str, tuple[str, str]]] = {
    "simulate": {
        "demo": ("demo", "emulate one observation window, ingest its downlink and write the report"),
        "emulate": ("emulate", "run the payload over a scenario and write a pass archive"),
        "orbit": ("orbit", "propagate, compare and convert ephemerides"),
        "render": ("render", "render one frame of a scenario"),
    },
    "operate": {
        "mission": ("mission", "write, check, add, list and show mission descriptions"),
        "link": ("link", "link settings of a recorded downlink; links to ground stations and their contacts"),
        "ingest": ("ingest", "ingest downlink files or pass archives"),
        "pass": ("results", "list and show passes"),
        "report": ("results", "write the report of a pass"),
        "performance": ("results", "recall, drift and error over many passes, and monthly reports"),
        "export": ("results", "write a pass in the formats of other tools: ephemerides, SPICE, maps, tables"),
        "correlate": ("correlate", "time correlation of a spacecraft: segments, residuals, reception times"),
        "plan": ("plan", "search, enter, approve and uplink observation windows"),
        "alarm": ("results", "list, acknowledge and shelve alarms"),
        "landmarks": ("landmarks", "craters learned from flight: candidates, decisions, new catalogue, labels, upload"),
        "command": ("command", "queue, release, uplink and verify telecommands"),
    },
    "build and gate": {
        "replay": ("emulate", "replay an archived pass with a payload build"),
        "regress": ("regress", "compare a payload build with a baseline over archived passes"),
        "dataset": ("dataset", "build and check detector data sets"),
        "detector": ("detector", "train, export, evaluate and run the crater detector"),
    },
    "study": {
        "paper": ("study", "every figure and table of the LINNA paper, next to the values of the paper"),
        "montecarlo": ("study", "Monte Carlo runs of anchored navigation: errors compared with covariances"),
        "navigation": ("study", "survey detection and navigation over the terrain of a region"),
        "camera": ("study", "probability of craters in the footprint over the field of view"),
        "catalogue": ("catalogue", "crater catalogues: registration to terrain and on-board curation"),
        "tm": ("tm", "decode and check telemetry; export the dictionary as ICD and XTCE"),
        "data": ("data", "list, fetch and verify the public data products"),
    },
    "administer": {
        "serve": ("service", "run the HTTP server of the ground service"),
        "worker": ("service", "run a job worker of the ground service"),
        "scheduler": ("service", "run the recurring work of a distributed ground service"),
        "runner": ("service", "run payload builds for the ground service, in a separate container"),
        "db": ("db", "schema, backup and restore of the database"),
        "verify": ("service", "check the integrity of the archive: files, packets, audit chain"),
        "audit": ("user", "list the audit log, and show the head of its hash chain"),
        "user": ("user", "manage the users of the ground service and their tokens"),
        "doctor": ("service", "check a deployment: processes, clocks, broker, files, provider"),
    },
}
GROUPS = {name: group for groups in TASKS.values() for name, group in groups.items()}


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return the exit status."""
    try:
        return _run(arguments)
    except BrokenPipeError:  # the reader of the output has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _run(arguments: Sequence[str]) -> int:
    for name, value in _THREAD_POLICY.items():
        os.environ.setdefault(name, value)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(f"linna {__version__}")
        return 0
    group = arguments[0]
    if group not in GROUPS:
        return _refused(f"unknown command '{group}'{_nearest(group)}; see linna --help", arguments)
    module_name, help_line = GROUPS[group]
    parser = LinnaParser(prog=f"linna {group}", description=help_line[0].upper() + help_line[1:])
    configure_group(parser, module_name, group)
    try:
        namespace = parser.parse_args(list(arguments[1:]))
    except SystemExit as stop:  # --help
        return int(stop.code or 0)
    except BadUsage as fault:
        return _refused(str(fault), arguments, fault.command)
    handler = getattr(namespace, "handler", None)
    if handler is None:
        parser.print_usage(sys.stderr)
        return 2
    return _guarded(handler, namespace, arguments)


def _guarded(
    handler: Callable[[argparse.Namespace], int | None], namespace: argparse.Namespace, arguments: Sequence[str]
) -> int:
    try:
        return int(handler(namespace) or 0)
    except KeyboardInterrupt:
        print("linna: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _refused(f"{error.strerror or error}{where}", arguments)
    except _known_errors() as error:
        from linna.help import help_page

        return _refused(str(error), arguments, page=help_page(error, arguments[0]))


def _refused(message: str, arguments: Sequence[str], command: str = "linna", page: str = "") -> int:
    """Print an error as one line on stderr, with --json also as one JSON object on stdout; return the status 2."""
    line = " ".join(message.split())
    print(f"{command}: error: {line}{f' (help: {page})' if page else ''}", file=sys.stderr)
    if "--json" in arguments:
        print(json.dumps({"error": line, "status": 2}))
    return 2


def _known_errors() -> tuple[type[Exception], ...]:
    """The base errors of the packages that have been imported by now (none is imported for this)."""
    bases = {
        "lunar": "LunarError",
        "tmtc": "TmtcError",
        "reports": "ReportError",
        "payload_emulator": "PayloadError",
        "ground_service": "GroundError",
        "linna": "UsageError",
    }
    loaded = (getattr(sys.modules.get(f"{package}.errors"), name, None) for package, name in bases.items())
    return tuple(error for error in loaded if error is not None)


def _nearest(name: str) -> str:
    import difflib

    close = difflib.get_close_matches(name, GROUPS, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _overview() -> str:
    width = max(map(len, GROUPS))
    lines = [
        "usage: linna COMMAND [options]",
        "",
        "LINNA: crater-based navigation for a lunar CubeSat, payload emulator and ground segment.",
    ]
    for task, groups in TASKS.items():
        lines += ["", f"{task}:", *(f"  {name:<{width}}  {line}" for name, (_, line) in groups.items())]
    lines += ["", "linna COMMAND --help describes a command; --version prints the version."]
    return "\n".join(lines)
