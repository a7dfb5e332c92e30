"""Payload builds: what a build file says, and builds as they are registered.

A build is a program (any command that keeps the contract in docs/build-contract.md), or a network and a parameter file
on the installed flight code. Its identity is the hash of everything that decides what it does: command and files, or
network, parameters and the flight code itself. The limits of a program belong to it, those of the flight code do not.
"""

import datetime
import hashlib
import importlib.util
import io
import json
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveInt

from ground_service.clock import utc_now_ns
from ground_service.errors import BuildNotChecked, InvalidInput, NotFound, storage_error
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.regression import model, store
from ground_service.regression.runner import RunRequest, run_confined
from ground_service.regression.sandbox import SandboxRefused, tail
from ground_service.store.files import make_durable_folder, register_file, replace_durably
from ground_service.toml import parse_table, read_table, require_line

CURRENT = "current"
BUILD_FILE = "build.toml"
CURRENT_FILE = b'schema_version = 1\nname = "current"\n'
BUILD_FILE_LIMIT_OCTETS = 1 << 20
FLIGHT_COMMAND = (
    "{python}", "-m", "linna", "replay", "{archive}", "--build", "{build}", "--out", "{out}", "--recorded-only",
)  # fmt: skip
CHECK_COMMAND = ("{python}", "-m", "linna", "replay", "--check-build", "{folder}/" + BUILD_FILE, "--json")
CHECK_FAILED = 2
CHECK_LIMIT_OCTETS = 1 << 14
# Packages of the flight code of this installation, in addition to the shipped network.
_FLIGHT_CODE = (
    "payload_emulator/flight",
    "payload_emulator/session/archive/replay.py",
    "payload_emulator/session/archive/recording.py",
    "payload_emulator/session/spacecraft/parameter_file.py",
    "kernels",
    "lunar",
    "tmtc",
)
_PLAIN, _PROGRAM = 0o644, 0o755
_SHIPPED_MODEL = "payload_emulator/flight/models/craters.onnx"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False, defer_build=True)


class Limits(_Table):
    """Resource limits of a run of a build: seconds, MiB, open files, processes and threads.

    `cpu_s` and `memory_mib` count all processes of the run together, and `folder_mib` everything that it writes.
    """

    wall_s: PositiveInt = Field(default=900, le=7_200)
    cpu_s: PositiveInt = Field(default=900, le=28_800)
    memory_mib: PositiveInt = Field(default=6144, le=65_536)
    file_mib: PositiveInt = Field(default=256, le=4_096)
    folder_mib: PositiveInt = Field(default=512, le=8_192)
    open_files: PositiveInt = Field(default=256, le=4_096)
    processes: PositiveInt = Field(default=128, le=4_096)


class CameraTable(_Table):
    """Camera for which a build is made."""

    width_px: float | None = None
    height_px: float | None = None
    fov_deg: float | None = None


def _without_controls(text: str) -> str:
    if "\0" in text or "\x1b" in text:
        raise ValueError(f"a text without control characters, found {ascii(text)[:80]}")
    return text


Text = Annotated[str, AfterValidator(_without_controls)]
Texts = Annotated[tuple[str, ...], Field(strict=False)]
Whole = Annotated[int, Field(ge=-(2**63), lt=2**63)]


class BuildTable(_Table):
    """Content of a build file."""

    schema_version: Literal[1] = 1
    name: Text
    version: Text = ""
    description: Text = ""
    command: Texts = ()
    files: Texts = ()
    model: Text = ""
    parameters: Text = ""
    camera: CameraTable = CameraTable()
    limits: Limits = Limits()
    provenance: dict[str, bool | Whole | float | Text | datetime.date | datetime.time] = {}


CHECK_LIMITS = Limits(wall_s=120, cpu_s=60, memory_mib=2048, file_mib=1, folder_mib=16, processes=32)
"""Limits of the parameter check, which imports the flight code and reads a text file."""


@dataclass(frozen=True, slots=True)
class Build:
    """Payload build under test.

    Attributes
    ----------
    file
        The build file; other file names in it are relative to its folder.
    command
        Program and arguments with the places {archive}, {out} and {build}; empty for a build on the flight code.
    files
        SHA-256 of every file that belongs to the build, by name.
    parameters
        Name of the parameter file of a build on the flight code; "" without one.
    camera
        Camera for which the build is made; None if it is not specific to a camera.
    digest
        Identity of the build.
    noise
        Seed of noise in the images that it is given in a placebo; 0: none.
    """

    name: str
    version: str
    digest: str
    file: Path
    command: tuple[str, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    description: str = ""
    camera: tuple[tuple[str, float], ...] = ()
    limits: Limits = field(default_factory=Limits)
    provenance: tuple[tuple[str, str], ...] = ()
    flight_code: str = ""
    parameters: str = ""
    noise: int = 0

    @property
    def title(self) -> str:
        """Name, version and the beginning of the identity."""
        return " ".join(filter(None, (self.name, self.version, f"({self.digest[:12]})")))

    @property
    def folder(self) -> Path:
        return self.file.parent

    @property
    def words(self) -> tuple[str, ...]:
        """Return the command line, with the placeholders {python}, {archive}, {out} and {folder}."""
        place = "{folder}" if self.command else ("{folder}/" + BUILD_FILE if self.folder_needed else CURRENT)
        words = [word.replace("{build}", place) for word in self.command or FLIGHT_COMMAND]
        if words[0] in dict(self.files):
            words[0] = "{folder}/" + words[0]
        return tuple(words)

    @property
    def folder_needed(self) -> bool:
        """Return whether the build has its own files; the flight code of this installation has none."""
        return str(self.file) != CURRENT

    def stage(self, folder: Path) -> None:
        """Copy the build file and the files it names into a new folder, the only one that a run can access."""
        folder.mkdir(parents=True)
        if not self.folder_needed:
            return
        for name, source in ((BUILD_FILE, self.file), *((name, self.folder / name) for name, _ in self.files)):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, folder / name)


def load_build(given: str | Path) -> Build:
    """The build that a file describes; "current" is this flight code with its own network.

    Raises
    ------
    InvalidInput
        The file is missing, is no build, or names files that are not there.
    """
    if str(given) == CURRENT:
        return _current()
    path = Path(given)
    if path.is_dir():
        path = path / BUILD_FILE
    source = str(path)
    table = parse_table(BuildTable, _read(path), source)
    require_line(table.name, source, "name")
    if table.version:
        require_line(table.version, source, "version")
    command = table.command
    if command and (table.model or table.parameters):
        raise InvalidInput(source, "command", "a command, or a model and parameters", "both")
    names = {*table.files, table.model, table.parameters} - {""}
    files = tuple((item, _file_hash(path, item)) for item in sorted(names))
    camera = table.camera.model_dump(exclude_unset=True)
    code = "" if command else flight_code_hash()
    if command:
        if not any("{archive}" in word for word in command) or not any("{out}" in word for word in command):
            raise InvalidInput(source, "command", "the places {archive} and {out} in it", " ".join(command))
        content: dict[str, Any] = {"command": command, "files": files}
        if table.limits != Limits():
            content["limits"] = table.limits.model_dump()
    else:
        model = dict(files).get(table.model) or _hash_of(_root() / _SHIPPED_MODEL)
        content = {"model": model, "parameters": dict(files).get(table.parameters, ""), "flight_code": code}
    return Build(
        name=table.name,
        version=table.version,
        digest=_digest({**content, "camera": camera}),
        file=path,
        command=command,
        files=files,
        description=table.description,
        camera=tuple(sorted(camera.items())),
        limits=table.limits,
        provenance=tuple((key, str(value)) for key, value in sorted(table.provenance.items())),
        flight_code=code,
        parameters=table.parameters,
    )


def changes(baseline: Build, candidate: Build, flown: Sequence[Mapping[str, Any]] = ({},)) -> list[str]:
    """Return what differs between two builds on the flight code; nothing is known of the inside of a program.

    `flown` are the parameters of each pass, by dotted name, which a build keeps unless it sets them.
    """
    if baseline.command or candidate.command:
        return []
    (old_network, old), (new_network, new) = _contents(baseline), _contents(candidate)
    found = ["flight code"] if baseline.flight_code != candidate.flight_code else []
    found += ["network"] if old_network != new_network else []

    def effective(own: Mapping[str, Any], name: str) -> str:
        values = {str(own.get(name, parameters.get(name, "not set"))) for parameters in flown}
        return " or ".join(sorted(values))

    return found + [
        f"{name} = {effective(new, name)} (baseline: {effective(old, name)})"
        for name in sorted({*old, *new})
        if effective(old, name) != effective(new, name)
    ]


def flat(table: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return the values of a table and of those in it by dotted name."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        found |= flat(value, f"{path}{key}.") if isinstance(value, dict) else {f"{path}{key}": value}
    return found


def _contents(build: Build) -> tuple[str | None, dict[str, Any]]:
    """Return the SHA-256 of the network of a build (None: the shipped one) and its parameters by dotted name."""
    network = _read(build.file).get("model") if build.folder_needed else None
    table = _read(build.folder / build.parameters) if build.parameters else {}
    return dict(build.files).get(str(network)), flat(table)


def register_build(ground: Ground, build: Build, *, actor: str = "local") -> Build:
    """Store a build: its files by content, its identity and origin; return the stored build.

    Raises
    ------
    InvalidInput
        Its parameters are not valid for the flight code.
    BuildNotChecked
        Its parameters cannot be checked here.
    """
    folder = _folder_of(ground, build.digest)
    if not folder.exists():
        check_parameters(build, runner=ground.runner, private=(ground.home,))
    try:
        packed = packed_build(build)
    except OSError as error:
        raise storage_error(error, build.folder) from None
    stored = ground.files.put_octets(packed)
    _unpack(packed, folder)
    with ground.database.writing() as connection:
        register_file(connection, stored, "build", f"{build.digest}.zip", utc_now_ns())
        entry = model.Build(
            digest=build.digest,
            name=build.name,
            version=build.version,
            description=build.description,
            kind="command" if build.command else "flight",
            files=dict(build.files),
            flight_code=build.flight_code or None,
            provenance=dict(build.provenance),
            registered_by=actor,
            registered=UtcTime(utc_now_ns()),
        )
        store.add_build(connection, entry, stored.sha256)
    return load_build(folder)


def _folder_of(ground: Ground, digest: str) -> Path:
    """Return the folder of a build on this machine: a copy of what the file archive has."""
    return ground.home / "regression" / "builds" / digest


def packed_build(build: Build) -> bytes:
    """Return a zip file with the build file and the files of a build; the same files give the same octets."""
    octets = io.BytesIO()
    with zipfile.ZipFile(octets, "w") as packed:
        text = build.file.read_bytes() if build.file.is_file() else CURRENT_FILE
        packed.writestr(zipfile.ZipInfo(BUILD_FILE), text, zipfile.ZIP_DEFLATED)
        for name, _ in build.files:
            path, entry = build.folder / name, zipfile.ZipInfo(name)
            entry.external_attr = (_PROGRAM if path.stat().st_mode & stat.S_IXUSR else _PLAIN) << 16
            packed.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return octets.getvalue()


def _unpack(packed: bytes, folder: Path) -> None:
    """Write the files of a build into its folder, unless it is there already."""
    if folder.exists():
        return
    try:
        make_durable_folder(folder.parent)
        # a unique name: another process may write the same build at the same time
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name[:16]}.", dir=folder.parent))
        try:
            with zipfile.ZipFile(io.BytesIO(packed)) as files:
                for entry in files.infolist():
                    path = Path(files.extract(entry, partial))
                    path.chmod(_PROGRAM if entry.external_attr >> 16 == _PROGRAM else _PLAIN)
            partial.chmod(0o755)
            replace_durably(partial, folder)
        except OSError:
            shutil.rmtree(partial, ignore_errors=True)
            if not folder.exists():  # otherwise the other process was first, with the same files
                raise
    except OSError as error:
        raise storage_error(error, folder) from None


def check_parameters(build: Build, *, runner: Path | None = None, private: Sequence[Path] = ()) -> None:
    """Check the parameter file of a build with the flight code; other builds are not checked.

    The flight code runs in the sandbox like a build, with a copy of the files of the build.

    Raises
    ------
    InvalidInput
        A parameter is unknown or has an invalid value.
    BuildNotChecked
        The check cannot be isolated here, or did not finish.
    """
    if not build.parameters:
        return
    with tempfile.TemporaryDirectory(prefix="build-check-") as name:
        work = Path(name)
        (work / "archive").mkdir()
        (work / "out").mkdir()
        build.stage(work / "build")
        request = RunRequest(CHECK_COMMAND, CHECK_LIMITS.model_dump())
        printed = work / "printed.txt"
        try:
            report = run_confined(request, work, work / "out", printed, runner=runner, private=private)
        except SandboxRefused as error:
            raise BuildNotChecked(build.title, str(error)) from None
        message = tail(printed, CHECK_LIMIT_OCTETS).strip()
    if report["exit_status"] == 0 and not report["cause"]:
        return
    fault = _fault_of(message) if report["exit_status"] == CHECK_FAILED else None
    if fault is None:
        last = message.splitlines()[-1][:200] if message else "nothing printed"
        status = report["cause"] or f"status {report['exit_status']}"
        raise BuildNotChecked(build.title, f"the check of the parameters ended with {status}: {last}")
    raise fault


def _fault_of(message: str) -> InvalidInput | None:
    """Return the fault that the check printed as JSON; None if it printed none."""
    try:
        fault = json.loads(message[message.index('{"fault"') :])["fault"]
        return InvalidInput(*(str(fault[name]) for name in ("file", "key", "expected", "found")))
    except (ValueError, KeyError, TypeError):
        return None


def registered_build(ground: Ground, digest: str) -> Build:
    """A build that was registered, found by its identity or the unmistakable beginning of it.

    Raises
    ------
    NotFound
        If there is none.
    InvalidInput
        If its files are no longer those that were registered.
    """
    whole = ground.read(store.find_build, digest)
    if whole is None or len(digest) < 8:
        raise NotFound("build", digest)
    folder = _folder_of(ground, whole)
    if not folder.exists():  # registered on another machine, or before the service was restored
        _unpack(ground.files.get(ground.read(store.file_of_build, whole)), folder)
    build = load_build(folder)
    if build.digest != whole:
        raise InvalidInput(
            f"build {whole[:12]}", "", "the files and flight code it was registered with", f"{build.digest[:12]}"
        )
    return build


def flight_code_hash() -> str:
    """Return the SHA-256 of the sources of the installed flight code, which is never imported here."""
    digest = hashlib.sha256()
    root = _root()
    for place in _FLIGHT_CODE:
        where = root / place
        for path in [where] if where.is_file() else sorted(where.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _root() -> Path:
    """Folder that holds the packages of this checkout or installation."""
    spec = importlib.util.find_spec("ground_service")
    assert spec is not None and spec.submodule_search_locations
    return Path(next(iter(spec.submodule_search_locations))).parent


def _current() -> Build:
    code = flight_code_hash()
    model = _hash_of(_root() / _SHIPPED_MODEL)
    return Build(
        name="current",
        version="",
        digest=_digest({"model": model, "parameters": "", "flight_code": code, "camera": {}}),
        file=Path(CURRENT),
        description="the installed flight code with its own network and the parameters used in flight",
        flight_code=code,
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        octets = path.read_bytes()
    except FileNotFoundError:
        raise InvalidInput(str(path), "", "a build file (TOML) or 'current'", "nothing there") from None
    except OSError as error:
        raise storage_error(error, path) from None
    if len(octets) > BUILD_FILE_LIMIT_OCTETS:
        raise InvalidInput(str(path), "", f"at most {BUILD_FILE_LIMIT_OCTETS} octets", str(len(octets)))
    return read_table(octets, str(path), "a build file (TOML)")


def _file_hash(build_file: Path, name: str) -> str:
    path = build_file.parent / name
    inside = not Path(name).is_absolute() and path.resolve().is_relative_to(build_file.parent.resolve())
    if inside and path.is_file():
        return _hash_of(path)
    found = "nothing there" if inside else "one elsewhere"
    raise InvalidInput(str(build_file), name, "a file in the folder of the build file", found)


def _hash_of(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise storage_error(error, path) from None


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
