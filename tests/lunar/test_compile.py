"""A cached kernel is compiled again when the file of a kernel that it calls has changed."""

import os
import subprocess
import sys
from pathlib import Path

CALLEE = """
from lunar._compile import njit

@njit
def inner(x):
    return x + {step}
"""
CALLER = """
from callee import inner
from lunar._compile import njit

@njit
def outer(x):
    return inner(x) * 10
"""


def run(folder: Path) -> str:
    code = "import caller; print(caller.outer(1), sum(caller.outer.stats.cache_hits.values()))"
    path = os.pathsep.join([str(folder), str(Path(__file__).resolve().parents[2])])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    return result.stdout.strip()


def test_a_changed_callee_is_seen_through_the_cache(tmp_path: Path) -> None:
    (tmp_path / "callee.py").write_text(CALLEE.format(step=1))
    (tmp_path / "caller.py").write_text(CALLER)
    assert run(tmp_path) == "20 0"
    assert run(tmp_path) == "20 1"  # from the cache
    (tmp_path / "callee.py").write_text(CALLEE.format(step=12))
    assert run(tmp_path) == "130 0"
