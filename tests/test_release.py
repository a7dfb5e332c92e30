"""Signature of a release; cost of the suite: collection without heavy libraries, and the table of folders."""

import csv
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import cost

ROOT = Path(__file__).resolve().parent.parent
WHEEL = "linna-0.1.0-py3-none-any.whl"
FILES = {
    WHEEL: b"wheel", "linna-0.1.0.tar.gz": b"sdist", "linna.cdx.json": b"{}", "licences.txt": b"numpy\tBSD",
}  # fmt: skip


def release(*words):
    command = ["sh", str(ROOT / "deploy" / "release.sh"), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    sys.stderr.write(done.stderr)
    return done.returncode


def made_key(path):
    """Make a key pair with the documented commands."""
    page = (ROOT / "docs" / "deployment.md").read_text()
    for command in re.findall(r"^    (\(umask.*|openssl pkey -in.*)$", page, re.MULTILINE):
        words = command.replace("linna-release.key", str(path)).replace("linna-release.pub", f"{path}.pub")
        subprocess.run(words, shell=True, check=True)
    return path


@pytest.fixture
def key(tmp_path):
    return made_key(tmp_path / "release.key")


@pytest.fixture
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


@pytest.mark.parametrize("name", [*FILES, "SHA256SUMS", "SHA256SUMS.sig"])
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


@pytest.mark.parametrize("name", FILES)
def test_an_incomplete_release_is_not_signed(signed, key, name, capsys):
    (signed / name).unlink()
    assert release("sign", signed, key) == 2
    assert "expected one" in capsys.readouterr().err


def test_the_private_key_is_private_and_outside_of_the_repository(signed, key, capsys):
    assert key.stat().st_mode & 0o777 == 0o600
    inside = ROOT / "LICENSE"
    assert release("sign", signed, inside) == 2
    assert "outside of the repository" in capsys.readouterr().err
    key.chmod(0o640)
    assert release("sign", signed, key) == 2
    assert "chmod 600" in capsys.readouterr().err


def test_make_release_builds_lists_and_signs():
    rules = (ROOT / "Makefile").read_text()
    rule = rules[rules.index("\nrelease:") :].split("\n\n")[0]
    words = "release: docs;-m build;deploy/materials.py bom;deploy/materials.py licences;deploy/release.sh sign"
    assert [word for word in (*words.split(";"), "LINNA_RELEASE_KEY") if word not in rule] == []
    check = rules[rules.index("\ncheck:") :].split("\n\n")[0]
    assert "deploy/materials.py audit $(SHIPPED)" in check


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


@pytest.mark.parametrize(("turns", "named"), [(119.0, []), (121.0, ["a: 121 turns, limit 120"])])
def test_a_folder_that_costs_a_fifth_more_than_the_table_is_named(turns, named):
    assert cost.grown({"a": 100.0, "gone": 50.0}, {"a": turns}) == named


def test_a_new_folder_may_cost_little():
    assert cost.grown({}, {"small": 19.0, "large": 21.0}) == ["large: 21 turns, limit 20"]


def test_what_was_measured_is_written_and_read_as_turns_by_folder(tmp_path, monkeypatch):
    written = tmp_path / "build" / "cost.csv"
    monkeypatch.setattr(cost, "MEASURED", written)
    monkeypatch.setattr(cost, "turn_s", lambda: 0.5)
    measured, lines = cost.Cost(), []
    measured.files = Counter({"tests/b/test_x.py": 0.7, "tests/b/test_y.py": 0.5, "tests/a/test_z.py": 5.0})
    report = SimpleNamespace(section=lines.append, write_line=lines.append)
    config = SimpleNamespace(
        args_source=pytest.Config.ArgsSource.TESTPATHS, getoption={"keyword": "", "markexpr": "not campaign"}.get
    )
    measured.pytest_terminal_summary(report, config)
    assert cost.read(written) == {"tests/a": 10.0, "tests/b": 2.0}
    assert [line.split()[-1] for line in lines[1:3]] == ["tests/a", "tests/b"]


def test_every_entry_of_the_campaigns_is_a_test_with_a_twin():
    tests = Path(__file__).parent
    with (tests / "campaigns.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len({row["test"] for row in rows}) == len(rows) > 50
    for row in rows:
        file, _, name = row["test"].partition("[")[0].partition("::")
        assert f"def {name}(" in (tests / file).read_text() or not name, row
        assert row["twin"], row


def test_temporary_files_are_where_the_environment_says():
    assert tempfile.gettempdir() == os.environ.get("TMPDIR", tempfile.gettempdir())
