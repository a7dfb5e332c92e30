"""Sandbox of builds: file system view, start with bubblewrap, supervision from outside, and outputs.

bubblewrap makes the namespaces and a private root of read-only parts of this machine. `/tmp`, a tmpfs of limited size,
is the only writable folder. Inside, `setpriv` and `prlimit` give the program a user without capabilities and its
limits; the system call filter of `kernel` applies to all of them. This process opens the output folder before the
program starts, measures memory, processor time and files of the run, ends it at a limit, and copies the outputs after
every process of the run has ended.
"""

import contextlib
import errno
import functools
import os
import platform
import re
import secrets
import select
import shutil
import signal
import stat
import struct
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

_kernel_NAMESPACES = 0x7E02_0000
"""Flags of `clone` for namespaces: mount, cgroup, UTS, IPC, user, process and network."""

# Audit architecture, and for x86-64 the bit that marks calls of the x32 interface.
_ARCHITECTURES = {"x86_64": (0xC000_003E, 0), "aarch64": (0xC000_00B7, 1)}
_X32_BIT = 0x4000_0000

# Numbers on x86-64 and AArch64; None: not available.
_NUMBERS: dict[str, tuple[int | None, int | None]] = {
    "_sysctl": (156, None), "acct": (163, 89), "add_key": (248, 217), "adjtimex": (159, 171), "bpf": (321, 280),
    "chroot": (161, 51), "clock_adjtime": (305, 266), "clock_settime": (227, 112), "clone": (56, 220),
    "clone3": (435, 435), "delete_module": (176, 106), "fanotify_init": (300, 262), "finit_module": (313, 273),
    "fsconfig": (431, 431), "fsmount": (432, 432), "fsopen": (430, 430), "fspick": (433, 433),
    "init_module": (175, 105), "io_uring_enter": (426, 426), "io_uring_register": (427, 427),
    "io_uring_setup": (425, 425), "ioctl": (16, 29), "ioperm": (173, None), "iopl": (172, None),
    "kcmp": (312, 272), "kexec_file_load": (320, 294), "kexec_load": (246, 104), "keyctl": (250, 219),
    "lookup_dcookie": (212, 18), "memfd_create": (319, 279), "memfd_secret": (447, 447),
    "modify_ldt": (154, None), "mount": (165, 40), "mount_setattr": (442, 442), "move_mount": (429, 429),
    "mq_open": (240, 180), "msgget": (68, 186), "name_to_handle_at": (303, 264), "nfsservctl": (180, 42),
    "open_by_handle_at": (304, 265), "open_tree": (428, 428), "perf_event_open": (298, 241),
    "personality": (135, 92), "pidfd_getfd": (438, 438), "pivot_root": (155, 41),
    "process_madvise": (440, 440), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271),
    "ptrace": (101, 117), "quotactl": (179, 60), "quotactl_fd": (443, 443), "reboot": (169, 142),
    "request_key": (249, 218), "semget": (64, 190), "setdomainname": (171, 162), "sethostname": (170, 161),
    "setns": (308, 268), "settimeofday": (164, 170), "shmget": (29, 194), "socket": (41, 198),
    "socketpair": (53, 199), "swapoff": (168, 225), "swapon": (167, 224), "syslog": (103, 116),
    "umount2": (166, 39), "unshare": (272, 97), "uselib": (134, None), "userfaultfd": (323, 282),
    "vhangup": (153, 58),
}  # fmt: skip

# Refused with any arguments. Sockets can reach resources outside all namespaces (AF_VSOCK: the host of a virtual
# machine). memfd_create and System V shared memory allocate memory that no file limit counts. io_uring performs other
# system calls without the filter. Keys belong to the user, not to a namespace.
DENIED = tuple(sorted(set(_NUMBERS) - {"clone", "clone3", "ioctl", "socketpair"}))
_TIOCSTI, _TIOCLINUX = 0x5412, 0x541C
_AF_UNIX = 1
_ALLOW, _KILL, _ERRNO = 0x7FFF_0000, 0x8000_0000, 0x0005_0000
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16


def seccomp_filter(denied: Sequence[str] = DENIED) -> bytes:
    """Return the filter program that refuses system calls with EPERM and permits all others.

    With `unshare`, `clone` with any namespace flag is refused, and `clone3`, whose flags a filter cannot read, returns
    ENOSYS. With `socket`, only socket pairs of the Unix domain are permitted.
    """
    audit, column = _architecture()
    steps = [_step(_LOAD, _ARCHITECTURE_AT), _step(_EQUAL, audit, 1, 0), _step(_RETURN, _KILL)]
    steps.append(_step(_LOAD, _NUMBER_AT))
    if column == 0:
        steps += [_step(_AT_LEAST, _X32_BIT, 0, 1), _step(_RETURN, _KILL)]
    for call in denied:
        code = _NUMBERS[call][column]
        if code is not None:
            steps += [_step(_EQUAL, code, 0, 1), _step(_RETURN, _ERRNO | errno.EPERM)]
    if "unshare" in denied:
        steps += [_step(_EQUAL, _number("clone3"), 0, 1), _step(_RETURN, _ERRNO | errno.ENOSYS)]
        steps += _on_argument("clone", 0, [_step(_ANY_BIT, _kernel_NAMESPACES, 0, 1)], errno.EPERM)
    if "socket" in denied:
        steps += _on_argument("socketpair", 0, [_step(_EQUAL, _AF_UNIX, 1, 0)], errno.EAFNOSUPPORT)
    for request in (_TIOCSTI, _TIOCLINUX):
        steps += _on_argument("ioctl", 1, [_step(_EQUAL, request, 0, 1)], errno.EPERM)
    steps.append(_step(_RETURN, _ALLOW))
    return b"".join(steps)


def _number(call: str) -> int:
    found = _NUMBERS[call][_architecture()[1]]
    assert found is not None
    return found


def _architecture() -> tuple[int, int]:
    machine = platform.machine()
    if machine not in _ARCHITECTURES:
        known = " or ".join(_ARCHITECTURES)
        raise OSError(errno.ENOSYS, f"system calls: expected a {known} processor, found {machine}")
    return _ARCHITECTURES[machine]


def _step(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("HBBI", code, if_true, if_false, value)


def _on_argument(call: str, position: int, test: list[bytes], code: int) -> list[bytes]:
    """Return filter steps that refuse `call`, unless the test of the low half of an argument skips the refusal."""
    load = _step(_LOAD, _ARGUMENTS_AT + 8 * position)
    body = [load, *test, _step(_RETURN, _ERRNO | code), _step(_LOAD, _NUMBER_AT)]
    return [_step(_EQUAL, _number(call), 0, len(body)), *body]


WRITABLE, OUT, HOME = "/tmp", "/tmp/out", "/tmp/home"
"""The writable folder of a run, and its folders for the outputs and as home."""

FIRST_BUILD_UID, BUILD_UIDS = 1_900_000_000, 1 << 27
"""User ids of builds of a service that runs as root, outside the ranges of systemd and of user namespaces."""

SETUP_S, SAMPLE_S = 30.0, 0.1
PRINTED_OCTETS = 65_536
"""Number of octets kept from the end of the program's printed text."""

INODES = 65_536
_PARENT = (
    "import os, resource, sys; status = os.spawnv(os.P_WAIT, sys.argv[1], sys.argv[1:]); "
    "print(status, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, flush=True); sys.stdin.readline()"
)
"""The parent of the program: it writes its exit status and peak memory, and waits while its processor time is read."""

PACKAGES = ("kernels", "lunar", "tmtc", "reports", "payload_emulator", "ground_service", "linna")
"""Packages that the flight code of this project needs; scenarios, migrations and tests are not visible."""

_DEVICES = ("null", "zero", "full", "random", "urandom")
_NAMESPACES = ("--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts", "--unshare-cgroup")
_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib64", "/lib32")
_SYSTEM_FILES = ("/etc/ld.so.cache", "/etc/alternatives", "/sys/devices/system/cpu")
REMEDY = (
    "install the Debian package bubblewrap and permit user namespaces for this process, or run builds in the runner: "
    "set LINNA_RUNNER_EXCHANGE and start `linna runner` (docs/build-contract.md)"
)


class SandboxRefused(Exception):
    """A run that was not started because it could not be isolated."""

    def __init__(self, reason: str, remedy: str = REMEDY) -> None:
        super().__init__(f"{reason}; remedy: {remedy}" if remedy else reason)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Part:
    """Part of the file system of a run: a read-only `bind` of a path, or a `link`."""

    kind: Literal["bind", "link"]
    source: str
    target: str


@dataclass(frozen=True, slots=True)
class Run:
    """Description of a run.

    Attributes
    ----------
    limits
        As in the build file; see `ground_service.regression.builds.Limits`.
    outputs
        Names of the files that are copied from the output folder.
    deliver, printed
        Folder of the caller for the outputs, and file for the end of the program's printed text.
    """

    command: tuple[str, ...]
    environment: Mapping[str, str]
    limits: Mapping[str, int]
    outputs: tuple[str, ...]
    deliver: Path
    printed: Path
    view: tuple[Part, ...]


def execute(run: Run) -> dict[str, Any]:
    """Run a program in the sandbox; return cause, exit status, times, peak memory and isolation of the run.

    A service that runs as root gives the program a unique user of this machine. Any other service can use only its own
    user, in a user namespace, in which limits of processes are then counted.

    Raises
    ------
    SandboxRefused
        The program was not run because a protection could not be enabled.
    """
    bwrap = shutil.which("bwrap")
    if bwrap is None:
        raise SandboxRefused("expected the program bwrap (Debian package bubblewrap), found none")
    root = os.geteuid() == 0
    uid = FIRST_BUILD_UID + secrets.randbelow(BUILD_UIDS) if root else os.geteuid()
    user = [
        *("/usr/bin/setpriv", f"--reuid={uid}", f"--regid={uid}", "--clear-groups"),
        *("--bounding-set=-all", "--inh-caps=-all", "--"),
    ]
    capabilities = ["--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", "--cap-add", "CAP_SETPCAP"]
    with contextlib.ExitStack() as opened:
        try:
            texts = (seccomp_filter(), f"build:x:{uid}:{uid}::{HOME}:/bin/sh\n".encode(), f"build:x:{uid}:\n".encode())
            files = [opened.enter_context(_file_in_memory(text)) for text in texts]
            process = subprocess.Popen(
                [
                    *(bwrap, *_NAMESPACES, *(() if root else ["--unshare-user"])),
                    *("--cap-drop", "ALL", *(capabilities if root else ())),
                    *("--die-with-parent", "--new-session", "--clearenv", "--chdir", OUT),
                    *(word for name, value in run.environment.items() for word in ("--setenv", name, value)),
                    *_root(run, *files[1:]),
                    *("--seccomp", str(files[0]), "--"),
                    *_inside(run, user if root else []),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                env={},
                umask=0o077,
                pass_fds=files,
            )
        except OSError as error:
            raise SandboxRefused(f"bubblewrap: {error}") from None
        report = _Supervisor(run, opened.enter_context(process)).run_program()
    whose = f"user {uid}" if root else f"user {uid} in a user namespace"
    return {**report, "isolation": f"bubblewrap, private root, {whose}, system call filter"}


@contextlib.contextmanager
def _file_in_memory(octets: bytes) -> Iterator[int]:
    descriptor = os.memfd_create("sandbox")
    try:
        os.pwrite(descriptor, octets, 0)
        yield descriptor
    finally:
        os.close(descriptor)


def _root(run: Run, users: int, groups: int) -> list[str]:
    """Return the arguments of bubblewrap for a root with only the parts that the run needs."""
    words = ["--proc", "/proc", "--remount-ro", "/proc"]
    words += ["--perms", "0777", "--size", str(run.limits["folder_mib"] << 20), "--tmpfs", WRITABLE]
    words += ["--perms", "0777", "--dir", OUT, "--perms", "0777", "--dir", HOME]
    # bubblewrap would close a folder that it makes for a part to other users than its own.
    for folder in (
        "/dev",
        "/etc",
        *(str(one) for part in run.view for one in reversed(Path(part.target).parents[:-1])),
    ):
        words += ["--dir", folder]
    words += ["--symlink", WRITABLE, "/dev/shm"]
    for name in _DEVICES:
        words += ["--dev-bind", f"/dev/{name}", f"/dev/{name}"]
    for descriptor, path in ((users, "/etc/passwd"), (groups, "/etc/group")):
        words += ["--perms", "0644", "--file", str(descriptor), path]
    for part in run.view:
        words += ["--symlink" if part.kind == "link" else "--ro-bind", part.source, part.target]
    return [*words, "--remount-ro", "/"]


def _inside(run: Run, user: Sequence[str]) -> list[str]:
    """Return the command that starts the program: change the user, set the limits, write `ready`, wait for a line."""
    limits = {
        "as": run.limits["memory_mib"] << 20,
        # The soft limit sends SIGXCPU a second before the hard limit, to distinguish it from other kills.
        "cpu": f"{run.limits['cpu_s']}:{run.limits['cpu_s'] + 1}",
        "fsize": run.limits["file_mib"] << 20,
        "nofile": run.limits["open_files"],
        "nproc": run.limits["processes"],
        "memlock": 0,
        "msgqueue": 0,
        "core": 0,
    }
    return [
        *(sys.executable, "-I", "-S", "-c", _PARENT),
        *(*user, "/usr/bin/prlimit", *(f"--{name}={value}" for name, value in limits.items()), "--"),
        *("/bin/sh", "-c", 'echo ready; read -r start; exec "$@" </dev/null >&2', "sh", *run.command),
    ]


class _Supervisor:
    """Supervision of one run from outside."""

    def __init__(self, run: Run, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin and process.stdout and process.stderr
        self.run, self.process, self.start = run, process, process.stdin
        self.control, self.printed = process.stdout.fileno(), process.stderr.fileno()
        self.open = {self.control, self.printed}
        self.messages, self.tail = b"", b""
        self.init = self.out = -1
        self.cause, self.cpu_s, self.peak_octets = "", 0.0, 0

    def run_program(self) -> dict[str, Any]:
        """Start the program, wait for its end or a limit, end all processes and copy the outputs."""
        try:
            self.prepare()
            report = self.report()
            self.end()
            self.deliver()
            return report
        finally:
            self.end()
            for descriptor in (self.init, self.out):
                if descriptor >= 0:
                    os.close(descriptor)

    def prepare(self) -> None:
        """Wait until all protections are enabled, and open the output folder."""
        deadline = time.monotonic() + SETUP_S
        while b"\n" not in self.messages and self.control in self.open and time.monotonic() < deadline:
            self.read(SAMPLE_S)
        if self.messages != b"ready\n":
            self.drain()
            said = self.tail.decode(errors="replace").strip().splitlines() or ["not set up in time"]
            raise SandboxRefused("bubblewrap: " + said[-1].removeprefix("bwrap: ").partition(". See")[0][:200])
        try:
            child = descendants(self.process.pid)[0]
            self.init = os.pidfd_open(child)
            self.out = os.open(f"/proc/{child}/root{OUT}", os.O_RDONLY | os.O_DIRECTORY)
        except (OSError, IndexError) as error:
            raise SandboxRefused(f"bubblewrap: {error}") from None

    def report(self) -> dict[str, Any]:
        self.messages, started = b"", time.monotonic()
        with contextlib.suppress(BrokenPipeError):
            self.start.write(b"\n")
        sampled = started
        while not self.cause and self.control in self.open and b"\n" not in self.messages:
            self.read(SAMPLE_S)
            now = time.monotonic()
            if now - sampled > SAMPLE_S:
                sampled = now
                self.sample()
            if not self.cause and now - started > self.run.limits["wall_s"]:
                self.cause = "timeout"
        wall_s = time.monotonic() - started
        if not self.cause:
            self.sample()
        ended = re.fullmatch(rb"(-?\d{1,3}) (\d{1,12})\n", self.messages) if not self.cause else None
        status, peak_kib = map(int, ended.groups()) if ended else (0, 0)
        return {
            "cause": self.cause or ("" if ended else "crashed"),
            "exit_status": (128 - status if status < 0 else status) if ended else None,
            "full": os.fstatvfs(self.out).f_bavail == 0,
            "wall_s": wall_s,
            "cpu_s": self.cpu_s,
            "peak_rss_mib": max(self.peak_octets / (1 << 20), peak_kib / (1 << 10)),
        }

    def read(self, timeout_s: float) -> None:
        """Read what the shells and the program have written."""
        for descriptor in select.select(list(self.open), [], [], timeout_s)[0]:
            octets = os.read(descriptor, 1 << 16)
            if not octets:
                self.open.discard(descriptor)
            elif descriptor == self.printed:
                self.tail = (self.tail + octets)[-PRINTED_OCTETS:]
            else:
                self.messages = (self.messages + octets)[:64]

    def drain(self) -> None:
        """Read the rest of the printed text after all writers have ended."""
        self.process.kill()
        while self.printed in self.open and select.select([self.printed], [], [], SAMPLE_S)[0]:
            self.read(0.0)

    def sample(self) -> None:
        """Measure all processes of the run; set the cause of its end at a limit."""
        processes, limit = descendants(self.process.pid), self.run.limits["memory_mib"] << 20
        resident, cpu_s = dict[int, int](), 0.0
        for place, process in enumerate(processes):
            # Only the ended children of the first two, process 1 and the parent of the program, count.
            own = place > 1
            with contextlib.suppress(OSError, IndexError, ValueError):
                words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
                cpu_s += sum(map(int, words[11 if own else 13 : 15])) / os.sysconf("SC_CLK_TCK")
                resident[process] = own * int(words[21]) * os.sysconf("SC_PAGE_SIZE")
        memory = sum(resident.values())
        if memory > limit:
            # Shared pages were counted for each process above; the proportional size is exact but slower.
            memory = sum(_proportional_memory(*one) for one in resident.items() if one[1])
        self.cpu_s, self.peak_octets = max(self.cpu_s, cpu_s), max(self.peak_octets, memory)
        files = os.fstatvfs(self.out)
        if memory > limit:
            self.cause = "memory"
        elif cpu_s > self.run.limits["cpu_s"] + 1:
            self.cause = "cpu"
        elif files.f_files - files.f_ffree > INODES:
            self.cause = "disk"

    def end(self) -> None:
        """Kill the first process of the namespace, and wait until the kernel has ended all others."""
        self.process.kill()
        if self.init >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self.init, signal.SIGKILL)
            if not select.select([self.init], [], [], SETUP_S)[0]:
                raise SandboxRefused("bubblewrap: processes of the run cannot be ended")

    def deliver(self) -> None:
        """Copy the outputs, only regular files of a permitted size with requested names, and the printed text."""
        self.drain()
        self.run.printed.write_bytes(self.tail)
        for name in self.run.outputs:
            try:
                source = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=self.out)
            except OSError:
                continue
            state = os.fstat(source)
            if stat.S_ISREG(state.st_mode) and state.st_size <= self.run.limits["file_mib"] << 20:
                with open(source, "rb", closefd=False) as stream, (self.run.deliver / name).open("xb") as copy:
                    shutil.copyfileobj(stream, copy)
            os.close(source)


def descendants(root: int) -> list[int]:
    """Return the descendants of a process, parents first."""
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                parent = int(Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(name))
    found = list(children.get(root, ()))
    for process in found:
        found += children.get(process, ())
    return found


def _proportional_memory(process: int, resident: int) -> int:
    """Return the proportional set size of a process in octets; `resident` if that is not readable."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) << 10
    return resident


def program_view() -> tuple[Part, ...]:
    """Return the parts of this machine that a program needs: system libraries, Python, the packages of this project."""
    parts: list[Part] = []
    for name in _SYSTEM:
        path = Path(name)
        if path.is_symlink():
            parts.append(Part("link", os.readlink(path), name))
        elif path.is_dir():
            parts.append(Part("bind", os.path.realpath(path), name))
    parts += [Part("bind", os.path.realpath(name), name) for name in _SYSTEM_FILES if Path(name).exists()]
    for folder in [*_python_folders(), *(package_root() / name for name in PACKAGES)]:
        for target in dict.fromkeys((str(folder), os.path.realpath(folder))):
            if os.path.isdir(target) and not _covered(target, parts):
                parts.append(Part("bind", os.path.realpath(target), target))
    return tuple(parts)


def check_private(folders: Sequence[Path], shown: Sequence[Path] = ()) -> None:
    """Refuse a layout in which a folder of the service is inside a folder that a program can read, such as `shown`.

    Raises
    ------
    SandboxRefused
        If there is such a folder.
    """
    parts = [*program_view(), *(Part("bind", "", os.path.realpath(one)) for one in shown)]
    for folder in folders:
        if _covered(os.path.realpath(folder), parts):
            raise SandboxRefused(
                f"{folder}: expected a folder outside those of Python, of the system and of data, which are readable"
            )


def package_root() -> Path:
    """Return the folder of the packages of this checkout or installation."""
    return Path(__file__).resolve().parents[2]


def tail(path: Path, octets: int = 2000) -> str:
    """Return the end of a text file; "" if there is none."""
    try:
        return path.read_text(errors="replace")[-octets:]
    except OSError:
        return ""


def make_readable(folder: Path) -> None:
    """Let every user read a folder of copies; the parent folder restricts who can reach it."""
    for where, _, names in os.walk(folder):
        Path(where).chmod(0o755)
        for name in names:
            path = Path(where) / name
            path.chmod(0o755 if path.stat().st_mode & stat.S_IXUSR else 0o644)


@functools.cache
def protection() -> str:
    """Return how builds are isolated here.

    Raises
    ------
    SandboxRefused
        A trial run was refused, or Python did not run in it.
    """
    limits = {
        "wall_s": 30,
        "cpu_s": 20,
        "memory_mib": 512,
        "file_mib": 1,
        "folder_mib": 8,
        "open_files": 64,
        "processes": 16,
    }
    with tempfile.TemporaryDirectory(prefix="sandbox-") as folder:
        printed = Path(folder) / "printed.txt"
        command = (sys.executable, "-I", "-S", "-c", "print('ready')")
        report = execute(Run(command, {}, limits, (), Path(folder), printed, program_view()))
        if report["exit_status"] != 0 or tail(printed).strip() != "ready":
            said = tail(printed)[-200:].strip() or f"no text, exit status {report['exit_status']}"
            raise SandboxRefused(f"Python does not run in the sandbox: {said}")
    return str(report["isolation"])


def _python_folders() -> list[Path]:
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    found = [sys.base_prefix, sys.prefix, *(sysconfig.get_path(name) for name in names)]
    return [Path(name) for name in dict.fromkeys(found) if Path(name) != Path("/")]


def _covered(path: str, parts: Sequence[Part]) -> bool:
    return any(part.kind == "bind" and (path + "/").startswith(part.target + "/") for part in parts)
