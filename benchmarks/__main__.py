"""`python -m benchmarks [name ...]`: all benchmarks in sequence, each compared with its named alternatives."""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent


def main(wanted: list[str]) -> int:
    """Run the benchmarks named (all when none is); the number of those that failed comes back."""
    files = sorted(file for file in HERE.glob("*.py") if not file.name.startswith("_"))
    unknown = set(wanted) - {file.stem for file in files}
    if unknown:
        known = ", ".join(file.stem for file in files)
        print(
            f"benchmarks: no benchmark named {', '.join(sorted(unknown))}; there are {known}", file=sys.stderr
        )
        return 2
    failed = 0
    for file in files:
        if wanted and file.stem not in wanted:
            continue
        print(f"\n== {file.stem}", flush=True)
        command = [sys.executable, "-m", f"benchmarks.{file.stem}"]
        failed += subprocess.run(command, cwd=HERE.parent, check=False).returncode != 0
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
