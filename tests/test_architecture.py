"""The import contracts hold and refuse what they have to; signature of a release; cost of the suite."""

import ast
import csv
import functools
import itertools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from pytest import fixture, mark

from tests import cost
from tests.serving import ran

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ["lunar", "tmtc", "reports", "payload_emulator", "studies", "ground_service", "linna", "kernels"]
LONGEST_FUNCTION = 80


def lint_imports(folder):
    program = str(Path(sys.executable).with_name("lint-imports"))
    command = [program, "--config", str(folder / "pyproject.toml"), "--no-cache"]
    return ran(command, cwd=folder, env={"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin", "COLUMNS": "300"})


@fixture()
def copy_of_the_tree(tmp_path):
    for package in PACKAGES:
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "*.onnx", "static")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_every_import_contract_is_kept():
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout


WALLS = """\
payload_emulator.flight.navigation.odometry.odometry -> payload_emulator.sim
payload_emulator.flight.navigation.odometry.odometry -> torch
payload_emulator.flight.payload -> payload_emulator.training
payload_emulator.session.archive.emulator -> ground_service
ground_service.errors -> payload_emulator
lunar.camera -> tmtc
ground_service.evaluation.core -> sqlalchemy
ground_service.ingest.service -> ground_service.evaluation.service
payload_emulator.sim.render.renderer -> payload_emulator.session.world.world
tmtc.dictionary.tables -> lunar.constants""".splitlines()


def plant(file, code):
    with file.open("a") as lines:
        lines.write(f"\n{code}\n")


def test_planted_imports_across_walls_are_refused(copy_of_the_tree):
    for wall in WALLS:
        module, imported = wall.split(" -> ")
        plant(copy_of_the_tree / f"{module.replace('.', '/')}.py", f"import {imported}")
    result = lint_imports(copy_of_the_tree)
    assert result.returncode == 1 and "BROKEN" in result.stdout
    printed = " ".join(result.stdout.split())
    assert [wall for wall in WALLS if f"{wall} (" not in printed] == []


def modules_of(root):
    """Modules and packages of the product by dotted name."""
    found = {}
    for package in PACKAGES:
        for file in sorted((root / package).rglob("*.py")):
            parts = file.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


@functools.cache
def contents_of(name, text, is_package):
    """Dotted names that a module imports anywhere, also for type checking; its long functions; its classes."""
    package = name if is_package else name.rpartition(".")[0]
    imported, long, classes = set[str](), list[str](), []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            origin = ".".join([*parts, *([node.module] if node.module else [])])
            imported |= {f"{origin}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
            lines = node.end_lineno - node.lineno + 1
            if lines > LONGEST_FUNCTION:
                long.append(f"{name}.{node.name}: {lines} lines")
        elif isinstance(node, ast.ClassDef):
            fields = [one.target for one in node.body if isinstance(one, ast.AnnAssign)]
            classes.append((node.name, {one.id for one in fields if isinstance(one, ast.Name)}))
    return imported, long, classes


def imported_names(name, file):
    """Dotted names that a module imports."""
    return contents_of(name, file.read_text(), file.name == "__init__.py")[0]


def import_cycles(root):
    """Groups of modules or packages of one package that import each other.

    An import from one module to another is an edge between the members of their closest common package.
    """
    modules = modules_of(root)
    edges = {}
    for name, file in modules.items():
        for imported in imported_names(name, file):
            target = imported if imported in modules else imported.rpartition(".")[0]
            if target not in modules:
                continue
            mine, theirs = name.split("."), target.split(".")
            common = next((k for k, (a, b) in enumerate(zip(mine, theirs, strict=False)) if a != b), None)
            if common is None:  # a package and its own member
                continue
            edges.setdefault(".".join(mine[:common]), {}).setdefault(mine[common], set()).add(theirs[common])
    cycles = []
    for package, graph in edges.items():
        reached = {start: reachable(graph, start) for start in graph}
        groups = {
            frozenset(other for other in reached[one] if one in reached.get(other, ()))
            for one in graph
            if one in reached[one]
        }
        cycles += [[f"{package}.{one}".lstrip(".") for one in sorted(group)] for group in groups]
    return sorted(cycles)


def reachable(graph, start):
    """Members that can be reached over at least one edge."""
    found = set()
    waiting = list(graph.get(start, ()))
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            waiting += graph.get(one, ())
    return found


def test_no_import_cycles_also_in_functions_and_for_type_checking():
    assert import_cycles(ROOT) == []


CYCLES = """\
ground_service/ingest/frames|def late():;    from ground_service.ingest import service|ground_service.ingest.frames
ground_service/store/files|if TYPE_CHECKING:;    from ground_service.store import database|ground_service.store.files
lunar/constants|import lunar.frames|lunar.constants
tmtc/packets/sequence|from tmtc.link import frames|tmtc.packets"""


def test_planted_cycles_are_found(copy_of_the_tree):
    for row in CYCLES.splitlines():
        module, planted, cycle = row.split("|")
        file = copy_of_the_tree / f"{module}.py"
        before = file.read_text()
        plant(file, planted.replace(";", "\n"))
        assert any(cycle in one for one in import_cycles(copy_of_the_tree)), row
        file.write_text(before)


SMALL = {
    f"ground_service.{name}"
    for name in (
        "evaluation.landmarks.service", "evaluation.performance.service", "jobs.service",
        "missions.ephemerides.service", "passes.alarms.service", "worker.condition", "worker.integrity",
    )
}  # fmt: skip
"""Modules of small capabilities, which hold their SQL."""


def modules_with_sql(root):
    """Modules of the ground service that import SQLAlchemy, tables or generic queries, or run SQL.

    Stores and `SMALL` are not among them. All may import `Connection` and `Engine`, to pass
    them on, and the exceptions of SQLAlchemy.
    """
    found = []
    for name, file in modules_of(root).items():
        parts = name.split(".")
        if (
            parts[0] != "ground_service"
            or parts[1:2] in (["store"], ["telemetry"])
            or re.fullmatch(r"(.*_)?store", parts[-1])
        ):
            continue
        if name in SMALL:
            continue
        if any(
            re.match(r"sqlalchemy\b(?!\.(Connection$|Engine$|exc\b))", one)
            or re.match(r"ground_service\.store\.(repository|models)\b", one)
            for one in imported_names(name, file)
        ) or re.search(r"connection\.(execute|exec_driver_sql)\(", file.read_text()):
            found.append(name)
    return found


def test_only_stores_contain_sql():
    assert modules_with_sql(ROOT) == []


SQL = """\
from sqlalchemy import Connection, select
import sqlalchemy
from sqlalchemy.dialects import sqlite
def late():;    from ground_service.store import repository
from ground_service.store.models import WINDOWS
def late(connection):;    connection.exec_driver_sql('SELECT 1')"""


def test_planted_sql_is_found(copy_of_the_tree):
    file = copy_of_the_tree / "ground_service/planning/service.py"
    before = file.read_text()
    for planted in SQL.splitlines():
        file.write_text(before)
        plant(file, planted.replace(";", "\n"))
        assert modules_with_sql(copy_of_the_tree) == ["ground_service.planning.service"], planted


def compiled_functions():
    """Functions of the product that numba compiles."""
    found = []
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            text = file.read_text()
            if "njit" not in text:
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(one) for one in node.decorator_list):
                    found.append((file, node))
    return found


def test_compiled_functions_use_no_linear_algebra_of_numba_which_asks_for_scipy():
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


UNSAFE = re.compile(
    r"\bimport (?:pickle|marshal|shelve|dill)\b|from (?:pickle|marshal|shelve) (?!import UnpicklingError$)"
    r"|weights_only=False|allow_pickle=True|yaml\.(?:unsafe_)?load\(|torch\.load\((?!.*weights_only=True)"
)


def test_no_module_reads_data_that_can_name_code():
    """Except compiled functions, whose files are machine code of the same user, and pipes to own processes."""
    found = [
        f"{name}: {line.strip()}"
        for name, file in modules_of(ROOT).items()
        for line in file.read_text().splitlines()
        if UNSAFE.search(line) and name not in ("kernels.compiled", "reports.drawings")
    ]
    assert found == []
    assert UNSAFE.search("stored = torch.load(path, map_location=device)")


def long_functions(root):
    """Functions of the product with more lines than `LONGEST_FUNCTION`, docstring and arguments included."""
    return [
        one
        for name, file in modules_of(root).items()
        for one in contents_of(name, file.read_text(), file.name == "__init__.py")[1]
    ]


def test_no_function_of_the_product_is_longer_than_eighty_lines():
    assert long_functions(ROOT) == []


def test_a_planted_function_of_one_line_more_is_found(tmp_path):
    (tmp_path / "lunar").mkdir()
    file = tmp_path / "lunar/planted.py"
    file.write_text("async def longest():\n" + "    pass\n" * (LONGEST_FUNCTION - 1))
    assert long_functions(tmp_path) == []
    file.write_text("async def longer():\n" + "    pass\n" * LONGEST_FUNCTION)
    assert long_functions(tmp_path) == ["lunar.planted.longer: 81 lines"]


TWO_ENTITIES = """Requirement RequirementFigures: stored summaries and the API state relation and margin
ApidAccounting ApidCompleteness: lists of passes must not import NumPy, which values of reports do
ReceptionQuality Reception: values have integer times, the API has texts
PacketAccounting Completeness: lists of passes must not import NumPy; the API has a list by APID
NavigationStatistics NavigationFigures: values have NaN for numbers, stored summaries and the API null
Gate JudgedGate: the stored verdict has null for NaN, and keys of earlier versions
Detections FrameDetections: detections that are scored always have a diameter on the ground
CameraSection Camera: the simulated camera has defaults, the declared one states only known values
Format ExportFormatInfo: the second says whether the library is installed
PassSummary EventFilter: an entity, and the query of another"""
"""Pairs of classes with nearly the same fields that are two entities, with the reason."""


def repeated_entities(root):
    """Pairs of classes of at least six fields that share 80 % of the fields of the larger one."""
    large = [
        one
        for name, file in modules_of(root).items()
        for one in contents_of(name, file.read_text(), file.name == "__init__.py")[2]
        if len(one[1]) >= 6
    ]
    return {
        (one, other)
        for (one, its), (other, others) in itertools.combinations(large, 2)
        if len(its & others) >= 0.8 * max(len(its), len(others))
    }


def test_no_class_repeats_the_fields_of_another():
    assert repeated_entities(ROOT) == {tuple(row.split(":")[0].split()) for row in TWO_ENTITIES.splitlines()}


def test_a_planted_repetition_of_fields_is_found(tmp_path):
    (tmp_path / "lunar").mkdir()
    shared = "".join(f"    {name}: float\n" for name in "abcd")
    planted = f"class A:\n{shared}    e: int\n    f: int\nclass B:\n{shared}    e: int\n    g: int\nclass C:\n{shared}"
    (tmp_path / "lunar/planted.py").write_text(planted)
    assert repeated_entities(tmp_path) == {("A", "B")}


DECODED = re.compile(
    r'(?<=""")(?:What|Where|Who|How|When|Why|Whether|Which)\b'  # the start of a docstring
    r"|(?<!kidnap )\b(?:told|heard(?!: UtcTime)|anew|at hand|beside|for good|lets? go of|came? to (?:an|no) end)\b"
    r"|\b(?:class|def) \w*(?<![a-z])(?:told|heard|beside|anew)(?![a-z])\w*"
    r"|\bclass (?:Moment|Turn|Given|Begun|Asked|Hand|Found|Shelving|Workshop|Patience|Craft|Facts|Eye|Told)\b"
)


def test_names_messages_and_docstrings_use_the_terms_of_the_field():
    found = {
        str(file.relative_to(ROOT)): words
        for package in (*PACKAGES, "benchmarks", "tests")
        for file in (ROOT / package).rglob("*.py")
        if file.name != "test_architecture.py" and (words := DECODED.findall(file.read_text()))
    }
    assert found == {}
    planted = 'class Moment:\n    """Where it is beside."""\n    def _told(): raise Lost("came to no end")\n'
    assert DECODED.findall(planted) == ["class Moment", "Where", "beside", "def _told", "came to no end"]


WHEEL = "linna-0.1.0-py3-none-any.whl"
FILES = {
    WHEEL: b"wheel", "linna-0.1.0.tar.gz": b"sdist", "linna.cdx.json": b"{}", "licences.txt": b"numpy\tBSD",
}  # fmt: skip


def release(*words):
    command = ["sh", str(ROOT / "deploy/release.sh"), *map(str, words)]
    done = ran(command)
    sys.stderr.write(done.stderr)
    return done.returncode


def made_key(path):
    """Make a key pair with the documented commands."""
    page = (ROOT / "docs/deployment.md").read_text()
    for command in re.findall(r"^    (\(umask.*|openssl pkey -in.*)$", page, re.MULTILINE):
        words = command.replace("linna-release.key", str(path)).replace("linna-release.pub", f"{path}.pub")
        subprocess.run(words, shell=True, check=True)
    return path


@fixture
def key(tmp_path):
    return made_key(tmp_path / "release.key")


@fixture
def signed(tmp_path, key):
    folder = tmp_path / "release"
    folder.mkdir()
    for name, octets in FILES.items():
        (folder / name).write_bytes(octets)
    assert release("sign", folder, key) == 0
    return folder


def verified(folder, key):
    return release("verify", folder, f"{key}.pub")


def test_a_release_as_it_was_signed_is_accepted(signed, key):
    assert verified(signed, key) == 0
    lines = (signed / "SHA256SUMS").read_text().splitlines()
    assert [line[66:] for line in lines] == sorted(FILES)


@mark.parametrize("name", [*FILES, "SHA256SUMS", "SHA256SUMS.sig"])
def test_one_changed_bit_of_any_file_and_a_missing_file_are_refused(signed, key, name, capsys):
    octets = bytearray((signed / name).read_bytes())
    octets[len(octets) // 2] ^= 1
    (signed / name).write_bytes(octets)
    assert verified(signed, key) == 1
    assert "REFUSED" in capsys.readouterr().err
    (signed / name).unlink()
    assert verified(signed, key) == 1
    assert name in capsys.readouterr().err


def test_an_added_file_and_a_link_are_refused(signed, key, capsys):
    (signed / "extra.whl").write_bytes(b"x")
    assert verified(signed, key) == 1
    assert "not listed" in capsys.readouterr().err
    (signed / "extra.whl").unlink()
    (signed / WHEEL).rename(signed.parent / WHEEL)
    (signed / WHEEL).symlink_to(signed.parent / WHEEL)
    assert verified(signed, key) == 1


def test_a_release_signed_with_another_key_is_refused(signed, key, tmp_path):
    other = made_key(tmp_path / "other.key")
    (signed / WHEEL).write_bytes(b"changed and signed again")
    release("sign", signed, other)
    assert verified(signed, other) == 0
    assert verified(signed, key) == 1


@mark.parametrize("name", FILES)
def test_an_incomplete_release_is_not_signed(signed, key, name, capsys):
    (signed / name).unlink()
    assert release("sign", signed, key) == 2
    assert "expected one" in capsys.readouterr().err


def test_the_private_key_is_private_and_outside_of_the_repository(signed, key, capsys):
    assert key.stat().st_mode & 0o777 == 0o600
    assert release("sign", signed, ROOT / "LICENSE") == 2
    assert "outside of the repository" in capsys.readouterr().err
    key.chmod(0o640)
    assert release("sign", signed, key) == 2
    assert "chmod 600" in capsys.readouterr().err


def test_make_release_builds_lists_and_signs():
    rules = (ROOT / "Makefile").read_text()
    rule = rules[rules.index("\nrelease:") :].split("\n\n")[0]
    words = "release: docs;-m build;deploy/materials.py bom;deploy/materials.py licences;deploy/release.sh sign"
    assert [word for word in (*words.split(";"), "LINNA_RELEASE_KEY") if word not in rule] == []
    assert "deploy/materials.py audit $(SHIPPED)" in rules[rules.index("\ncheck:") :].split("\n\n")[0]


def test_a_source_distribution_has_the_same_octets_whenever_and_wherever_it_is_packed(tmp_path):
    made = []
    for k in range(2):
        folder = tmp_path / str(k)
        (folder / "linna-0.1.0").mkdir(parents=True)
        for name in ("b", "a")[:: 1 - 2 * k]:
            (folder / "linna-0.1.0" / name).write_text(name)
            (folder / "linna-0.1.0" / name).chmod(0o600 + 0o44 * k)
            os.utime(folder / "linna-0.1.0" / name, (k, k))
        shutil.make_archive(str(folder / "sdist"), "gztar", folder, "linna-0.1.0")
        path = folder / "sdist.tar.gz"
        command = ["sh", str(ROOT / "deploy/reproducible.sh"), str(path)]
        subprocess.run(command, check=True, env={"PATH": os.environ["PATH"], "SOURCE_DATE_EPOCH": "1700000000"})
        made.append(path.read_bytes())
    assert made[0] == made[1]
    with tarfile.open(tmp_path / "0/sdist.tar.gz") as archive:
        assert archive.getnames() == ["linna-0.1.0", "linna-0.1.0/a", "linna-0.1.0/b"]


def test_the_collection_imports_no_heavy_library(imported_while_collecting):
    assert imported_while_collecting == []


def test_a_folder_that_costs_a_fifth_more_than_the_table_is_named_and_a_new_one_may_cost_little():
    measured = {"a": 119.0, "b": 121.0, "small": 19.0, "large": 21.0}
    found = ["b: 121 turns, limit 120", "large: 21 turns, limit 20"]
    assert cost.grown({"a": 100.0, "b": 100.0, "gone": 50.0}, measured) == found


def test_what_was_measured_is_written_and_read_as_turns_by_folder(tmp_path, monkeypatch):
    written = tmp_path / "build/cost.csv"
    monkeypatch.setattr(cost, "MEASURED", written)
    measured, lines = cost.Cost(), []
    costs = [("tests/b/test_x.py", 0.7, 0.5), ("tests/b/test_y.py", 0.5, 9.0), ("tests/a/test_z.py", 5.0, 0.4)]
    for one in (SimpleNamespace(cost=values) for values in costs):
        measured.pytest_runtest_logreport(one)
    report = SimpleNamespace(section=lines.append, write_line=lines.append)
    config = SimpleNamespace(
        args_source=pytest.Config.ArgsSource.TESTPATHS, getoption={"keyword": "", "markexpr": "not campaign"}.get
    )
    measured.pytest_terminal_summary(report, config)
    assert cost.read(written) == {"tests/a": 10.0, "tests/b": 2.0}
    assert [line.split()[-1] for line in lines[1:3]] == ["tests/a", "tests/b"]


def test_what_ends_with_the_last_test_is_no_cost_of_its_folder():
    measured, report = cost.Cost(), SimpleNamespace(nodeid="tests/a/test_z.py::test_z")
    measured.pytest_runtest_teardown(None)
    made = measured.pytest_runtest_makereport(SimpleNamespace(when="teardown"))
    next(made)
    with pytest.raises(StopIteration):
        made.send(report)
    assert report.cost[0] == cost.SHARED and report.cost[2] > 0.0


def test_every_entry_of_the_campaigns_is_a_test_with_a_twin_and_a_fault():
    tests = Path(__file__).parent
    with (tests / "campaigns.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len({row["test"] for row in rows}) == len(rows) > 50
    known = {name for path in tests.rglob("test_*.py") for name in re.findall(r"def (test_\w+)", path.read_text())}
    for row in rows:
        file, _, name = row["test"].partition("[")[0].partition("::")
        assert f"def {name}(" in (tests / file).read_text() or not name, row
        assert row["twin"] and row["fault"], row
        assert set(re.findall(r"\btest_\w+\b(?!\.py)", row["twin"])) <= known, row


def test_temporary_files_are_where_the_environment_says():
    assert tempfile.gettempdir() == os.environ.get("TMPDIR", tempfile.gettempdir())
