"""An engineer's hour by command line: a build that is worse, one that is slow, one that crashes, and mistakes.

`python -m benchmarks.campaigns.engineer [--frames 8]`: the commands of `tutorials/own-build.md` as printed, with passes
of some frames, then programs after the template of `build-contract.md`. The exit status is 1 if there was a wrong turn
of the classes A or B.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.campaigns._strangers import DOCS, Diary, commands_of
from studies.harness.parts import bare_environment

BUSY = "import time; until = time.process_time() + {seconds}\nwhile time.process_time() < until: pass\n"


@dataclass(frozen=True, slots=True)
class Shell:
    """A folder with a shell, in which `linna` is in the path."""

    folder: Path

    def run(self, line: str) -> tuple[int, str]:
        """Return the exit status of a command line, and what it printed."""
        environment = bare_environment(
            PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            PYTHONPATH=str(Path(__file__).resolve().parents[2]),
            XDG_DATA_HOME=str(self.folder / "data"),
        )
        environment.pop("LINNA_DATA", None)
        done = subprocess.run(
            ["bash", "-c", line],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr


def template(folder: Path, before: str = "", **changes: str) -> None:
    """Write the program of the page into a folder, with code before it and changed texts."""
    contract = (DOCS / "build-contract.md").read_text().split("### Template of a program")[1]
    folder.mkdir()
    for name, kind in (("build.toml", "toml"), ("fly.py", "python")):
        text = re.findall(rf"```{kind}\n(.*?)```", contract, re.DOTALL)[0]
        for old, new in changes.items():
            text = text.replace(old, new)
        (folder / name).write_text(before + text if kind == "python" else text)


def main(words: Sequence[str] | None = None) -> int:
    """Spend the hour; 1 if there was a wrong turn."""
    parser = argparse.ArgumentParser(prog="engineer", description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=8, help="frames of the recorded pass")
    given = parser.parse_args(words)
    diary = Diary("engineer by command line")
    with tempfile.TemporaryDirectory(prefix="engineer-") as name:
        shell = Shell(Path(name))
        for line in commands_of("tutorials/own-build.md", shell.folder):
            status, printed = shell.run(line.replace("--frames 40", f"--frames {given.frames}"))
            diary.expect("B", f"as printed: {line[:60]}", status in (0, 1), f"{status}: {printed}")
        first = next((one for one in printed.splitlines() if re.match("(fail|pass|inconclusive):", one)), "")
        diary.expect(
            "A",
            "the worse detector fails, and the line says what fell",
            first.startswith("fail: recall falls"),
            printed,
        )
        diary.expect("B", "the report exists", (shell.folder / "gate.html").exists())
        programs(diary, shell)
        mistakes(diary, shell)
    return diary.close()


def programs(diary: Diary, shell: Shell) -> None:
    """Judge the program of the template, one that takes more processor time, and one that crashes."""
    run = "linna regress run --archive passes --baseline current --home gate-ground --build"
    template(shell.folder / "same")
    status, printed = shell.run(f"{run} same/build.toml")
    diary.expect(
        "A",
        "the template is identical in every octet",
        status == 0 and "identical in every octet" in printed,
        printed,
    )
    template(shell.folder / "slow", BUSY.format(seconds=30), program="slow")
    status, printed = shell.run(f"{run} slow/build.toml --repeat-baseline --junit slow.xml")
    is_named = "processor time" in printed or "latency" in printed
    diary.expect(
        "A",
        "a program with more processor time does not pass in silence",
        status != 0 and is_named,
        f"{status}: {printed}",
    )
    template(
        shell.folder / "crash", "def stop():\n    raise ValueError('wrong turn')\nstop()\n", program="crash"
    )
    status, printed = shell.run(f"{run} crash/build.toml --junit crash.xml")
    diary.expect(
        "B",
        "the traceback of a crash is in the text",
        status != 0 and "wrong turn" in printed,
        f"{status}: {printed}",
    )
    junit = shell.folder / "crash.xml"
    text = junit.read_text() if junit.exists() else "no file"
    diary.expect("B", "and in JUnit", "system-err" in text and "wrong turn" in text, text)


def mistakes(diary: Diary, shell: Shell) -> None:
    """Make mistakes in build files: the check refuses what a run refuses."""
    run = "linna regress run --archive passes --baseline current --home gate-ground --build"
    for what, old, new in (
        ("a wrong schema version", "schema_version = 1", "schema_version = 7"),
        ("a misspelled key", 'files = ["fly.py"]', 'filse = ["fly.py"]'),
        ("a missing file", 'files = ["fly.py"]', 'files = ["fyl.py"]'),
    ):
        folder = shell.folder / what.replace(" ", "-")
        template(folder, **{old: new})
        for command in (
            f"linna replay --check-build {folder.name}/build.toml",
            f"{run} {folder.name}/build.toml",
        ):
            status, printed = shell.run(command)
            held = status == 2 and "Traceback" not in printed and "expected" in printed
            diary.expect("B", f"{what} is refused by {command.split()[1]}", held, f"{status}: {printed}")
    (shell.folder / "parameters.toml").write_text("detector.score_treshold = 0.8\n")
    status, printed = shell.run("linna replay --check-build build.toml")
    diary.expect(
        "B",
        "a misspelled parameter is named",
        status == 2 and "score_threshold" in printed,
        f"{status}: {printed}",
    )
    status, printed = shell.run(f"{run} build.toml --archive nowhere")
    diary.expect(
        "B", "a missing archive is one line", status == 2 and "nowhere" in printed, f"{status}: {printed}"
    )


if __name__ == "__main__":
    sys.exit(main())
