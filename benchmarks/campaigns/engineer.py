"""An engineer's hour by command line: a build that is worse, one that is slow, one that crashes, and mistakes.

`python -m benchmarks.campaigns.engineer [FRAMES]`: the commands of `tutorials/own-build.md` as printed, with a pass of
some frames (default 8), then programs after the template of `build-contract.md`. The exit status is 1 if there was a
wrong turn of the classes A or B.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.campaigns._strangers import ROOT, Diary, commands_of, environment

RUN = "linna regress run --archive passes --baseline current --home gate-ground --junit junit.xml --build"
CHECK = "linna replay --check-build"
SLOW = "import time\nuntil = time.process_time() + 30\nwhile time.process_time() < until: pass\n"
CRASH = "def stop():\n    raise ValueError('a wrong turn')\nstop()\n"


def main(frames: str = "8") -> int:
    """Spend the hour; 1 if there was a wrong turn."""
    diary = Diary("engineer by command line")
    with tempfile.TemporaryDirectory(prefix="engineer-") as name:
        folder = Path(name)

        def run(line: str) -> tuple[int, str]:
            done = subprocess.run(
                ["bash", "-c", line], cwd=folder, env=environment(folder), capture_output=True, text=True, check=False
            )
            return done.returncode, done.stdout + done.stderr

        def build(where: str, before: str = "", old: str = "", new: str = "") -> str:
            contract = (ROOT / "docs" / "build-contract.md").read_text().split("### Template of a program")[1]
            (folder / where).mkdir()
            toml, program = (re.findall(rf"```{one}\n(.*?)```", contract, re.DOTALL)[0] for one in ("toml", "python"))
            (folder / where / "build.toml").write_text(toml.replace(old or where, new or where))
            (folder / where / "fly.py").write_text(before + program)
            return f"{where}/build.toml"

        printed = ""
        for line in commands_of("tutorials/own-build.md", folder):
            status, printed = run(line.replace("--frames 40", f"--frames {frames}"))
            diary.expect("B", f"as printed: {line[:70]}", status in (0, 1), printed)
        diary.expect("A", "the worse detector fails with what fell", "\nfail: recall falls" in "\n" + printed, printed)
        for kind, step, line, expected, text in (
            ("A", "the template is identical", f"{RUN} {build('same')}", (0,), "identical in every octet"),
            ("A", "a slow program fails", f"{RUN} {build('slow', SLOW)} --repeat-baseline", (1, 3), "processor time"),
            ("B", "a crash shows its traceback", f"{RUN} {build('crash', CRASH)}", (1, 2), "a wrong turn"),
            ("B", "JUnit as well", "cat junit.xml", (0,), "a wrong turn"),
            ("B", "a missing archive is named", f"{RUN.replace('passes', 'nowhere')} build.toml", (2,), "nowhere"),
        ):
            status, printed = run(line)
            held = status in expected and text in printed and "internal error" not in printed
            diary.expect(kind, step, held, f"{status}: {printed}")
        for where, old, new in (
            ("version", "schema_version = 1", "schema_version = 7"),
            ("key", "files =", "filse ="),
            ("file", 'files = ["fly.py"]', 'files = ["fyl.py"]'),
        ):
            toml = build(where, "", old, new)
            for command in (CHECK, RUN):
                status, printed = run(f"{command} {toml}")
                held = status == 2 and "expected" in printed
                diary.expect("B", f"a wrong {where} is refused: {command[:14]}", held, printed)
        (folder / "parameters.toml").write_text("detector.score_treshold = 0.8\n")
        status, printed = run(f"{CHECK} build.toml")
        diary.expect("B", "a misspelled parameter is named", status == 2 and "score_threshold" in printed, printed)
    return diary.close()


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
