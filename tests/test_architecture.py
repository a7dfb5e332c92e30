"""The import contracts of pyproject.toml hold, and they refuse what they are there to refuse."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("lunar", "tmtc", "reports", "payload_emulator", "studies", "ground_service", "linna")


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [
        str(Path(sys.executable).with_name("lint-imports")),
        "--config",
        str(folder / "pyproject.toml"),
        "--no-cache",
    ]
    return subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin"},
    )


@pytest.fixture()
def copy_of_the_tree(tmp_path: Path) -> Path:
    for package in PACKAGES:
        shutil.copytree(
            ROOT / package,
            tmp_path / package,
            ignore=shutil.ignore_patterns("__pycache__", "*.onnx", "static"),
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_every_import_contract_is_kept() -> None:
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize(
    ("module", "planted"),
    [
        ("payload_emulator/flight/navigation/odometry.py", "import payload_emulator.sim"),
        ("payload_emulator/flight/navigation/odometry.py", "import torch"),
        ("payload_emulator/flight/payload.py", "import payload_emulator.training"),
        ("payload_emulator/session/emulator.py", "import ground_service"),
        ("ground_service/__init__.py", "import payload_emulator"),
        ("lunar/camera.py", "import tmtc"),
        ("ground_service/evaluation/core.py", "import sqlalchemy"),
        ("ground_service/ingest/service.py", "import ground_service.evaluation.service"),
        ("payload_emulator/sim/render/lens.py", "import payload_emulator.session.world"),
        ("tmtc/tables.py", "import lunar.constants"),
    ],
)
def test_a_planted_import_across_a_wall_is_refused(copy_of_the_tree: Path, module: str, planted: str) -> None:
    file = copy_of_the_tree / module
    file.write_text(file.read_text() + f"\n{planted}\n")
    result = lint_imports(copy_of_the_tree)
    assert result.returncode == 1, result.stdout
    assert "BROKEN" in result.stdout


def compiled_functions() -> list[tuple[Path, ast.FunctionDef]]:
    """Functions of the product that numba compiles."""
    found = []
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            text = file.read_text(encoding="utf-8")
            if "njit" not in text:
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef) and any(
                    "njit" in ast.unparse(one) for one in node.decorator_list
                ):
                    found.append((file, node))
    return found


def test_compiled_functions_use_no_linear_algebra_of_numba_which_asks_for_scipy() -> None:
    functions = compiled_functions()
    assert len(functions) > 20
    asking = [
        f"{file.relative_to(ROOT)}:{part.lineno}"
        for file, function in functions
        for part in ast.walk(function)
        if (isinstance(part, ast.BinOp) and isinstance(part.op, ast.MatMult))
        or (isinstance(part, ast.Attribute) and ast.unparse(part) in ("np.linalg", "np.dot", "np.vdot"))
    ]
    assert asking == []
