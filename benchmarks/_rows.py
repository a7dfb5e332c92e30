"""Rows of a benchmark: a figure, its peer of the same run, and whether it contradicts the expectation."""

import importlib
import io
import json
import shutil
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parent.parent
LIMIT_S = 300.0
"""Time limit of one benchmark of the list."""

MORE_IS_BETTER = ("packets", "windows", "share")


class NotMeasured(Exception):
    """Something is missing on this machine; the message names it."""


@dataclass(frozen=True, slots=True)
class Row:
    """A figure with its peer.

    Attributes
    ----------
    unit
        Of rates ("/s") and of the units in `MORE_IS_BETTER` a larger figure is better, of all others a smaller one.
    peer, theirs
        What the figure is compared with in the same run, and its figure in the same unit; None: no peer.
    wrong
        How the figure contradicts the expectation; empty if it does not.
    """

    what: str
    ours: float
    unit: str
    peer: str = ""
    theirs: float | None = None
    wrong: str = ""

    @property
    def ratio(self) -> float | None:
        """Return the factor by which the figure is better than the peer; None without one."""
        if self.theirs is None or not self.ours or not self.theirs:
            return None
        more = "/s" in self.unit or self.unit in MORE_IS_BETTER
        return self.ours / self.theirs if more else self.theirs / self.ours


def needs(program: str, *names: str) -> str:
    """Return the path of a program by any of its names.

    Raises
    ------
    NotMeasured
        It is not installed.
    """
    found = next((path for path in map(shutil.which, names) if path), None)
    if found is None:
        raise NotMeasured(f"{program} is not installed")
    return found


def best_s(run: Callable[[], object], rounds: int = 5) -> float:
    """Return the least processor time of some runs after one to warm up, or of a single run (0), in seconds."""
    times = []
    for _ in range(rounds + 1):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times[1:] or times)


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Yield a folder with the files of a commit of this project.

    Raises
    ------
    NotMeasured
        There is no such commit.
    """
    command = ["git", "-C", str(ROOT), "archive", commit]
    packed = subprocess.run(command, capture_output=True, check=False)
    if packed.returncode:
        raise NotMeasured(f"expected a commit of this project, found {commit}")
    with TemporaryDirectory(prefix="linna-before-") as folder:
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as files:
            files.extractall(folder, filter="data")
        yield Path(folder)


def line(row: Row, before: float | None = None) -> str:
    """Return a row as a line of the table, with how many times better it is than its figure before."""
    earlier = replace(row, theirs=before).ratio
    peer = "no peer" if row.theirs is None else f"{row.peer}: {row.theirs:,.4g}"
    ratio = "" if row.ratio is None else f"{row.ratio:8.2f} x"
    since = "" if earlier is None else f"  ratio to the build before: {earlier:.2f}"
    different = f"  DIFFERENT: {row.wrong}" if row.wrong else ""
    return f"{row.what:<58}{row.ours:>12,.4g} {row.unit:<14}{ratio:>10}  {peer}{since}{different}"


def measure(name: str) -> None:
    """Print the rows of a benchmark as JSON lines, the reason if it cannot be measured here."""
    try:
        for row in importlib.import_module(f"benchmarks.{name}").rows():
            print(json.dumps(asdict(row)), flush=True)
    except NotMeasured as missing:
        print(json.dumps({"missing": str(missing)}), flush=True)


def run(names: Sequence[str], root: Path = ROOT) -> Iterator[tuple[str, list[Row], str]]:
    """Run the benchmarks of a checkout one after the other, each in a process of its own.

    Yields
    ------
    name
        Benchmark.
    rows
        Its rows.
    fault
        Why it has no rows or did not finish; "not measured: …" if something is missing on this machine.
    """
    for name in names:
        command = [sys.executable, "-m", "benchmarks", "--rows-of", name]
        try:
            ended = subprocess.run(command, cwd=root, stdout=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False)
        except subprocess.TimeoutExpired:
            yield name, [], f"did not finish in {LIMIT_S:.0f} s"
            continue
        found = [json.loads(text) for text in ended.stdout.splitlines() if text.startswith("{")]
        rows = [Row(**one) for one in found if "missing" not in one]
        fault = next((f"not measured: {one['missing']}" for one in found if "missing" in one), "")
        if ended.returncode:
            fault = f"exit status {ended.returncode}"
        elif not found:
            fault = "no rows"
        yield name, rows, fault


def report(names: Sequence[str], *, as_json: bool, before: Path | None = None) -> int:
    """Print the table of benchmarks; return 1 if one failed or a row contradicts the expectation.

    Each benchmark is run in the checkout ``before`` in turn with this one.
    """
    begun, failed, table = time.monotonic(), False, []
    for name, rows, fault in run(names):
        failed |= any(row.wrong for row in rows) or (bool(fault) and not fault.startswith("not measured"))
        earlier = {one.what: one.ours for _, old, _ in run([name], before) for one in old} if before else {}
        values = [{**asdict(row), "ratio": row.ratio, "before": earlier.get(row.what)} for row in rows]
        table.append({"benchmark": name, "rows": values, "fault": fault})
        if not as_json:
            lines = [line(row, earlier.get(row.what)) for row in rows]
            print("\n".join([f"\n== {name}", *lines, *([fault] if fault else [])]), flush=True)
    if as_json:
        print(json.dumps(table))
    else:
        print(f"\n{time.monotonic() - begun:.0f} s", flush=True)
    return int(failed)
