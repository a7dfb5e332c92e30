"""Campaign of a hostile payload build against the service, with every process profile of the service.

    python -m benchmarks.campaigns.hostile_build [--profile NAME ...]

The build knows every path, port and process of the service and tries to read its secrets, change its files, reach its
network, leave its limits, outlive its time, and deliver outputs that are no files (`hostile/attack.py`). For every
profile the service's own code runs it over a small pass; what the build achieved is judged by what it reports and by
what can be seen from outside: connections at decoys, changed files, living processes, files left behind.

Exit status 1 if anything succeeded, or a profile that can confine a build refused it. Root can take all profiles, any
other user `user` alone. The transcript goes to stderr, the table to stdout.
"""

import argparse
import contextlib
import hashlib
import json
import os
import re
import selectors
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.campaigns.hostile.attack_kinds import EXPECTED, KINDS
from benchmarks.campaigns.hostile.profiles import PROFILES, SERVICE_UID
from studies.harness.parts import Part

ATTACK = Path(__file__).parent / "hostile" / "attack.py"
ROOT = Path(__file__).resolve().parents[2]
SECRET = "hostile-campaign-secret"
LEFTOVER = "hostile-campaign-leftover"
FILES = """\
home/.pgpass|db:5432:linna:linna:{secret}
home/secret.txt|{secret}
home/linna.toml|database_url = "postgresql://linna:{secret}@db/linna"
home/linna.db|{secret}
home/files/ab/raw|{secret}
home/regression/reference.oem|{secret}
home/regression/expected.json|{secret}
home/regression/builds/other/inputs-of-another.jsonl|{secret}"""
LIMITS = {
    "wall_s": 60,
    "cpu_s": 20,
    "memory_mib": 384,
    "file_mib": 8,
    "folder_mib": 24,
    "open_files": 256,
    "processes": 32,
}
SHORT_S = 2
MANIFEST = """{
  "schema_version": 1, "pass_name": "small", "spacecraft_id": 76, "start_utc": "2029-08-07T01:40:00Z",
  "stop_utc": "2029-08-07T01:44:00Z", "cadence_s": 15.0, "frames_expected": 0
}"""
SCENARIOS = ("root", "uid 10001", "image", "no unshare", "no unshare, runner")


@dataclass(frozen=True, slots=True)
class Finding:
    """Attempt of the build.

    Attributes
    ----------
    kind
        The kind of run.
    succeeded
        Whether the attempt was successful.
    """

    profile: str
    kind: str
    name: str
    succeeded: bool
    seen: str


@dataclass(frozen=True, slots=True)
class ProfileResult:
    """Result of a profile.

    Attributes
    ----------
    refusals
        Number of refused runs, of `runs`.
    isolation
        Isolation of the other runs.
    """

    profile: str
    runs: int
    refusals: int
    refusal: str
    isolation: str
    attempts: int
    findings: tuple[Finding, ...]

    @property
    def successes(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.succeeded)


class Decoys:
    """Ports and sockets on the loopback of the service, which a build must not reach."""

    def __init__(self, folder: Path) -> None:
        self.connections = 0
        self._stop = threading.Event()
        self._selector = selectors.DefaultSelector()
        self.ports = [self._listen(socket.AF_INET, ("127.0.0.1", 0)) for _ in range(3)]
        self.sockets = [str(folder / ".s.PGSQL.5432"), f"@{SECRET}-{os.getpid()}"]
        for name in self.sockets:
            self._listen(socket.AF_UNIX, name.replace("@", "\0", 1))
        os.chmod(self.sockets[0], 0o777)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _listen(self, family: int, address: Any) -> int:
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.bind(address)
        listener.listen()
        self._selector.register(listener, selectors.EVENT_READ)
        return int(listener.getsockname()[1]) if family == socket.AF_INET else 0

    def _serve(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(0.1):
                assert isinstance(key.fileobj, socket.socket)
                with contextlib.suppress(OSError):
                    key.fileobj.accept()[0].close()
                self.connections += 1

    def close(self) -> None:
        """Close all listeners."""
        self._stop.set()
        self._thread.join()
        for key in list(self._selector.get_map().values()):
            assert isinstance(key.fileobj, socket.socket)
            key.fileobj.close()
        self._selector.close()


class Service:
    """Files, secrets and processes of a service as targets of a build, accessible to every user of the machine.

    File permissions would prevent some attempts; here only the sandbox prevents them.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.home = folder / "home"
        texts = dict(line.split("|") for line in FILES.format(secret=SECRET).splitlines())
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        self.secrets = [str(folder / name) for name in texts]
        self.secrets_sha256 = sorted({hashlib.sha256(text.encode()).hexdigest() for text in texts.values()})
        self.decoys = Decoys(folder)
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", f"import time; secret = {SECRET!r}; time.sleep(3600)"],
            env={"LINNA_DATABASE_URL": f"postgresql://linna:{SECRET}@db/linna"},
            cwd=self.home,
        )
        self.open_to_all()
        self._before = self.state()

    def open_to_all(self) -> None:
        """Let every user read and change all files."""
        for where, _, names in os.walk(self.folder):
            os.chmod(where, 0o777)
            for name in names:
                with contextlib.suppress(OSError):
                    os.chmod(os.path.join(where, name), 0o666)

    def state(self) -> dict[str, str | None]:
        """Return the contents of the files of the service."""
        return {path: Path(path).read_text(errors="replace") if Path(path).exists() else None for path in self.secrets}

    def damage(self) -> list[str]:
        """Return the effects of a build on the service, by name."""
        now = self.state()
        found = [f"{path} changed" for path, text in self._before.items() if now[path] != text]
        if self.process.poll() is not None:
            found.append("a process of the service was ended")
        if self.decoys.connections:
            found.append(f"{self.decoys.connections} connections to the service")
            self.decoys.connections = 0
        return found

    def close(self) -> None:
        """End the started processes."""
        self.process.kill()
        self.process.wait()
        self.decoys.close()


def write_build(folder: Path, kind: str, service: Service, leftover: str, writable: Sequence[Path]) -> Path:
    """Write a build with one kind of attack."""
    folder.mkdir()
    shutil.copy(ATTACK, folder / "attack.py")
    targets = {
        "marker": SECRET,
        "leftover": leftover,
        "secrets": service.secrets,
        "secrets_sha256": service.secrets_sha256,
        "writable": [*service.secrets, *map(str, writable)],
        "victims": [service.process.pid, os.getpid()],
        "ports": service.decoys.ports,
        "sockets": [*service.decoys.sockets, "/var/run/postgresql/.s.PGSQL.5432"],
        "folders": [str(service.home), str(ROOT)],
        **LIMITS,
    }
    (folder / "targets.json").write_text(json.dumps(targets))
    limits = {**LIMITS, "wall_s": SHORT_S} if kind in ("outlive", "stop others") else LIMITS
    (folder / "build.toml").write_text(
        f'schema_version = 1\nname = "{kind}"\nfiles = ["attack.py", "targets.json"]\n'
        f'command = ["{{python}}", "-I", "-S", "{{build}}/attack.py", "{kind}", "{{archive}}", "{{out}}",'
        f' "{leftover}"]\n[limits]\n' + "".join(f"{name} = {value}\n" for name, value in limits.items())
    )
    return folder / "build.toml"


def write_archive(folder: Path) -> None:
    """Write the smallest pass archive that can be replayed."""
    listed = {}
    for name in ("payload/inputs.jsonl", "payload/parameters.toml", "reference.oem", "truth.oem"):
        text = SECRET if name.endswith("oem") else ""
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
        listed[name] = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "bytes": len(text)}
    manifest = json.loads(MANIFEST) | {"files": listed}
    (folder / "manifest.json").write_text(json.dumps(manifest))


RUN = """
import json, sys
from pathlib import Path
from ground_service.regression.build_runs import run_build
from ground_service.regression.builds import load_build
archive, out, runner, home, *builds = sys.argv[1:]
for build in builds:
    place = Path(out) / Path(build).parent.name
    run = run_build(load_build(build), Path(archive), place, runner=Path(runner) if runner else None,
                    private=(Path(home),))
    print(json.dumps({**run.summary(), "build": Path(build).parent.name}), flush=True)
"""


def campaign(profile: str, kinds: Sequence[str] = KINDS) -> ProfileResult:
    """Run every kind of attack with a profile of the service."""
    name, _, with_runner = profile.partition(", ")
    with tempfile.TemporaryDirectory(prefix="hostile-") as temporary:
        folder = Path(temporary)
        folder.chmod(0o755)
        service = Service(folder)
        try:
            return _campaign(profile, name, bool(with_runner), kinds, folder, service)
        finally:
            service.close()


def _campaign(
    profile: str, name: str, with_runner: bool, kinds: Sequence[str], folder: Path, service: Service
) -> ProfileResult:
    exchange = folder / "exchange"
    write_archive(folder / "archive")
    leftovers = {kind: f"{LEFTOVER}-{os.getpid()}-{number}" for number, kind in enumerate(kinds)}
    writable = [ROOT / "ground_service" / "__init__.py", exchange / "runner.json"]
    builds = [write_build(folder / kind.replace(" ", "-"), kind, service, leftovers[kind], writable) for kind in kinds]
    out = folder / "out"
    out.mkdir()
    exchange.mkdir()
    if os.geteuid() == 0:
        for place in (out, exchange):
            os.chown(place, SERVICE_UID, SERVICE_UID)
    exchange.chmod(0o2770)
    program = (ROOT / "ground_service" / "__init__.py").read_bytes()
    findings: list[Finding] = []
    refusals: list[str] = []
    isolation = ""
    with _runner(exchange, folder) if with_runner else contextlib.nullcontext():
        words = [str(folder / "archive"), str(out), str(exchange) if with_runner else "", str(service.home)]
        worker = subprocess.Popen(
            _in_profile(name, [sys.executable, "-c", RUN, *words, *map(str, builds)], folder),
            stdout=subprocess.PIPE,
            cwd=ROOT,
            env=_environment({"LINNA_DATABASE_URL": f"postgresql://linna:{SECRET}@db/linna", "PGPASSWORD": SECRET}),
            text=True,
        )
        assert worker.stdout is not None
        for line, kind in zip(worker.stdout, kinds, strict=False):
            run = json.loads(line)
            if run["outcome"] == "refused":
                refusals.append(run["detail"])
            else:
                isolation = run["isolation"]
                findings += _judged(profile, kind, run, out / kind.replace(" ", "-"))
            findings += [
                Finding(profile, kind, "seen from outside", True, text)
                for text in [*service.damage(), *_left(leftovers[kind], folder, out)]
            ]
            _tell(profile, kind, run, findings)
        worker.stdout.close()
        if worker.wait() != 0:
            raise SystemExit(f"{profile}: the service ended with status {worker.returncode}")
    if (ROOT / "ground_service" / "__init__.py").read_bytes() != program:
        findings.append(Finding(profile, "explore", "seen from outside", True, "the program was changed"))
    attempts = len(findings) + sum(kind != "explore" for kind in kinds) if isolation else 0
    return ProfileResult(
        profile, len(kinds), len(refusals), refusals[0] if refusals else "", isolation, attempts, tuple(findings)
    )


def _judged(profile: str, kind: str, run: Mapping[str, Any], place: Path) -> list[Finding]:
    """Return the findings of a run, from its report and its outputs."""
    found: list[Finding] = []
    delivered = {path.name: path for path in place.iterdir()}

    def add(name: str, seen: str, succeeded: bool = True) -> None:
        found.append(Finding(profile, kind, name, succeeded, seen))

    said = f"{run['outcome']} {run['detail']}"
    if kind == "explore" and "downlink.packets" not in delivered:
        add("the build", f"did not report: {said}")
        return found
    if kind == "explore":
        for name, (won, seen) in json.loads(delivered["downlink.packets"].read_text()).items():
            add(name, str(seen), bool(won))
    elif run["outcome"] not in EXPECTED[kind]:
        add("outcome", said)
    for name, path in delivered.items():
        if name not in ("downlink.packets", "performance.json", "printed.txt"):
            add("delivered", name)
        elif path.is_symlink() or not path.is_file():
            add("delivered", f"{name} is no file")
        elif path.stat().st_size > (1 << 17 if name == "printed.txt" else LIMITS["file_mib"] << 20):
            add("delivered", f"{name}: {path.stat().st_size} octets")
        elif kind != "explore" and SECRET.encode() in path.read_bytes():
            add("delivered", f"{name} holds the secret")
    return found


def _left(leftover: str, folder: Path, out: Path) -> list[str]:
    """Return processes and files of a build that remain after its run, while others may run."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if re.search(rf"{leftover}\b", (entry / "cmdline").read_text(errors="replace")):
                found.append(f"process {entry.name} is alive")
    for place in map(Path, ("/tmp", "/dev/shm", "/var/tmp", "/run", "/", folder, out, ROOT)):
        if (place / leftover).exists():
            found.append(f"{place / leftover} was left")
    for where, folders, names in os.walk(folder):  # tolerates folders that are removed meanwhile
        if leftover in (*folders, *names):
            found.append(f"{where}/{leftover} was left")
    return found


def _runner(exchange: Path, folder: Path) -> Part:
    command = [sys.executable, "-m", "linna", "runner", "--exchange", str(exchange)]
    words, environment = (_in_profile("runner", command, folder, exchange), _environment({"LINNA_HOME": "/tmp"}))
    return Part(words, folder / "runner.log", (exchange / "runner.json").exists, 1, cwd=ROOT, env=environment)


def _in_profile(name: str, command: list[str], folder: Path, exchange: Path | None = None) -> list[str]:
    words = [sys.executable, "-m", "benchmarks.campaigns.hostile.profiles", name, "--keep", str(folder)]
    if exchange is not None:
        words += ["--exchange", str(exchange)]
    return [*words, "--", *command]


def _environment(given: Mapping[str, str]) -> dict[str, str]:
    return {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **given}


def _tell(profile: str, kind: str, run: Mapping[str, Any], findings: Sequence[Finding]) -> None:
    print(f"[{profile}] {kind}: {run['text']}", file=sys.stderr)
    for finding in findings:
        if finding.kind == kind:
            word = "SUCCEEDED" if finding.succeeded else "failed"
            print(f"[{profile}]   {word:9} {finding.name}: {finding.seen}", file=sys.stderr)


def went_well(result: ProfileResult) -> bool:
    """Return whether no attempt succeeded, and builds were refused exactly if they cannot be isolated."""
    expected = result.runs if result.profile == "no unshare" else 0
    return not result.successes and result.refusals == expected


def table(results: Sequence[ProfileResult]) -> str:
    """Return a table with one line for each profile."""
    lines = [f"{'profile':20} {'runs':>5} {'refused':>8} {'attempts':>9} {'successes':>10}  confined by"]
    for one in results:
        by = one.isolation or f"not run: {one.refusal.split(';')[0]}"
        lines.append(f"{one.profile:20} {one.runs:5} {one.refusals:8} {one.attempts:9} {len(one.successes):10}  {by}")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Run the campaign; 1 if anything succeeded."""
    parser = argparse.ArgumentParser(prog="hostile_build", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--profile", action="append", choices=(*SCENARIOS, "user"), help="default: all that can be taken"
    )
    arguments = parser.parse_args(words)
    chosen = arguments.profile or (list(SCENARIOS) if os.geteuid() == 0 else ["user"])
    for name in chosen:
        print(f"[{name}] {PROFILES[name.partition(', ')[0]]}", file=sys.stderr)
    results = [campaign(name) for name in chosen]
    print(table(results))
    for one in results:
        for finding in one.successes:
            print(f"SUCCEEDED [{finding.profile}] {finding.kind}, {finding.name}: {finding.seen}")
    return 0 if all(map(went_well, results)) else 1


if __name__ == "__main__":
    sys.exit(main())
