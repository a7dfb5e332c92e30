"""Dependencies of the project: pinned, installed as pinned, under licences that a product can carry."""

import importlib.util
import json
import re
import threading
import tomllib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import metadata
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from pytest import fixture, mark

ROOT = Path(__file__).resolve().parent.parent


def script(name):
    """Return a script of the folder deploy as a module."""
    found = importlib.util.spec_from_file_location(name, ROOT / "deploy" / f"{name}.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


materials = script("materials")
NORMAL = re.compile(r"[-_.]+")


def name_of(text):
    return NORMAL.sub("-", re.split(r"[\[<>=!~ ;]", text, maxsplit=1)[0]).lower()


def pins(name):
    lines = (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
    entries = [line.split("#")[0].strip() for line in lines]
    return {name_of(entry): Requirement(entry) for entry in entries if entry}


def version_of(pin):
    return str(pin.specifier).removeprefix("==")


def applies(requirement, python=None, extras=frozenset()):
    """Return whether a requirement holds for a version of Python (without one: for this)."""
    here = dict(default_environment())
    if python is not None:
        here |= {"python_version": python.rpartition(".")[0], "python_full_version": python}
    marker = requirement.marker
    return marker is None or any(marker.evaluate({**here, "extra": extra}) for extra in ("", *extras))


RUNTIME = {
    name: pin
    for file in ["runtime", "postgres", "parquet", "terrain", "exports", "traces", "oidc", "objects"]
    for name, pin in pins(file).items()
}
EVERYTHING = {**RUNTIME, **pins("train"), **pins("dev")}


def test_every_requirement_is_pinned_to_one_version():
    for pin in EVERYTHING.values():
        assert re.fullmatch(r"==[^=<>~*, ]+", str(pin.specifier)) and not pin.url and not pin.extras, pin


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]


def needed(python, files):
    """Return what the pinned packages of files require of each package, for a version of Python."""
    texts = PROJECT["dependencies"] + [text for file in files for text in EXTRAS.get(file, [])]
    waiting, seen = [Requirement(text) for text in texts], set()
    found = {}
    while waiting:
        one = waiting.pop()
        name = name_of(one.name)
        found.setdefault(name, []).append(one)
        if (name, frozenset(one.extras)) in seen:
            continue
        seen.add((name, frozenset(one.extras)))
        try:
            listed = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            assert name in RUNTIME and not applies(RUNTIME[name]), f"{name} is not installed"
            continue
        inner = [Requirement(text) for text in listed]
        waiting += [it for it in inner if applies(it, python, frozenset(one.extras))]
    return found


@mark.parametrize("python", ["3.11.0", "3.11.2", "3.11.3", "3.12.0"])
@mark.parametrize("names", ["runtime", "runtime terrain", "runtime postgres parquet traces oidc objects"])
def test_what_packages_require_is_pinned_for_every_python(names, python):
    """An installation with hashes fails for a package without a pin, also one that only some versions need."""
    files = names.split()
    known = {name: pin for file in files for name, pin in pins(file).items() if applies(pin, python)}
    requirements = needed(python, files)
    assert len(requirements) > 40
    assert set(requirements) <= set(known)
    for name, asked in requirements.items():
        for one in asked:
            assert one.specifier.contains(version_of(known[name]), prereleases=True), one


def test_every_declared_dependency_has_its_pin_also_what_only_older_pythons_need():
    assert "async-timeout" in needed("3.11.2", ("runtime",))
    assert "async-timeout" not in needed("3.11.3", ("runtime",))
    assert {name_of(text) for text in PROJECT["dependencies"]} <= pins("runtime").keys()
    for extra in ["terrain", "postgres", "parquet", "traces", "oidc", "objects", "docs"]:
        assert {name_of(text) for text in EXTRAS[extra]} <= (pins("runtime") | pins(extra)).keys()


@mark.parametrize("name", sorted(name for name, pin in RUNTIME.items() if applies(pin)))
def test_what_runs_is_what_was_pinned_and_may_be_carried(name):
    found = metadata.distribution(name)
    assert version_of(RUNTIME[name]) == found.version
    stated = materials.licences_of(name)
    assert stated and not materials.is_copyleft(stated), f"{name}: {stated}"


HASHED = ["runtime", "postgres", "parquet", "traces", "oidc", "objects", "terrain", "exports", "site"]


@mark.parametrize("name", HASHED)
def test_the_requirements_with_hashes_are_the_same_versions(name):
    text = (ROOT / "requirements/hashed" / f"{name}.txt").read_text().replace("\\\n", " ")
    entries = {name_of(line): line for line in text.splitlines() if line and not line.startswith("#")}
    assert {key: Requirement(line.partition("--hash")[0].strip()) for key, line in entries.items()} == pins(name)
    for line in entries.values():
        assert re.fullmatch("(--hash=sha256:[0-9a-f]{64} *)+", line[line.index("--hash") :])


def test_what_is_installed_for_users_is_installed_with_hashes():
    installed = re.findall(r"pip install (.*(?:\\\n.*)*)", (ROOT / "Dockerfile").read_text())
    assert [line.startswith("--require-hashes") or "--no-deps ." in line for line in installed] == [True] * 3
    image = (ROOT / "Dockerfile").read_text()
    assert {f"-r requirements/{name}.txt" for name in HASHED} <= set(re.findall(r"-r \S+", image))
    assert pins("site").items() <= {**EVERYTHING, **pins("docs")}.items()
    rules = (ROOT / "Makefile").read_text()
    for name in ("runtime", "terrain"):
        assert re.search(rf"--require-hashes .*-r requirements/hashed/{name}\.txt", rules)


def test_the_gpl_is_found_and_the_lgpl_permitted():
    named = ["GPL-3.0-only", "AGPL-3.0", "GNU General Public License v2 (GPLv2)", "GNU Affero General Public License"]
    assert [text for text in named if not materials.is_copyleft(["MIT", text])] == []
    others = ["LGPL-3.0", "GNU Lesser General Public License v3", "MIT", "BSD-3-Clause", "MPL-2.0"]
    assert [text for text in others if materials.is_copyleft([text])] == []


def test_a_package_without_licence_or_not_installed_is_a_fault(tmp_path, capsys, monkeypatch):
    file = tmp_path / "a.txt"
    file.write_text("# packages\nnumpy==1.0\nabsent==1.0 ; python_version < '3'\n")
    assert materials.main(["licences", str(file)]) == 0
    assert "absent\tnot needed" in capsys.readouterr().out
    file.write_text("numpy==1.0\nabsent==1.0\n")
    assert materials.main(["licences", str(file)]) == 1
    assert "absent: expected the package, found it not installed" in capsys.readouterr().err
    file.write_text("numpy==1.0\n")
    monkeypatch.setattr(materials, "licences_of", lambda _name: [])
    assert materials.main(["licences", str(file)]) == 1
    assert "numpy: expected a licence" in capsys.readouterr().err


class Osv(BaseHTTPRequestHandler):
    """A database in which version 1.0 of the package bad has a vulnerability."""

    def do_POST(self):
        given = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        bad = {"package": {"name": "bad", "ecosystem": "PyPI"}, "version": "1.0"}
        results = [{"vulns": [{"id": "OSV-1"}]} if query == bad else {} for query in given["queries"]]
        body = json.dumps({"results": results}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_): ...


@fixture
def osv():
    with ThreadingHTTPServer(("127.0.0.1", 0), Osv) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_the_audit_finds_a_known_vulnerability(osv, tmp_path, capsys):
    file = tmp_path / "a.txt"
    file.write_text("# packages\nbad==1.1\ngood==1.0 \\\n    --hash=sha256:00\n")
    assert materials.main(["audit", str(file), "--url", osv]) == 0
    assert "2 packages, 0 with known" in capsys.readouterr().out
    file.write_text("bad==1.0\ngood==1.0\n")
    assert materials.main(["audit", str(file), "--url", osv]) == 1
    assert "bad 1.0: OSV-1" in capsys.readouterr().err


def test_the_audit_reports_a_database_that_cannot_be_reached(tmp_path, capsys):
    (tmp_path / "a.txt").write_text("bad==1.0\n")
    words = ["audit", str(tmp_path / "a.txt"), "--url", "http://127.0.0.1:1/"]
    assert materials.main(words) == 0
    assert "NOT CHECKED" in capsys.readouterr().err
    assert materials.main([*words, "--strict"]) == 2
