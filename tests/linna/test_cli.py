"""The command line's shell: help, unknown commands, errors as one line."""

import subprocess
import sys

import pytest

from linna import cli


def linna(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "linna", *arguments], capture_output=True, text=True, check=False
    )


def test_help_names_every_group() -> None:
    result = linna("--help")
    assert result.returncode == 0
    for group in cli.GROUPS:
        assert f"  {group}" in result.stdout


def test_help_imports_no_numerical_library() -> None:
    code = (
        "import sys, linna.cli; linna.cli.run(['--help']); print([m for m in sys.modules if m in "
        "('numpy', 'numba', 'matplotlib', 'cv2', 'sqlalchemy', 'fastapi', 'onnxruntime')])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip().endswith("[]")


@pytest.mark.parametrize("group", sorted(cli.GROUPS))
def test_each_group_explains_itself(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run([group, "--help"]) == 0
    assert f"linna {group}" in capsys.readouterr().out


def test_an_unknown_command_is_one_line_with_the_nearest_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["dmo"]) == 2
    captured = capsys.readouterr()
    assert (
        captured.err.strip() == "linna: error: unknown command 'dmo' (did you mean 'demo'?); see linna --help"
    )


def test_a_missing_scenario_is_one_line_and_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["emulate", "no-such-scenario", "--out", "nowhere"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "no such scenario file" in lines[0]
