"""Launcher process: it sets up a sandboxed run, supervises it, and extracts its outputs.

It is started by `ground_service.regression.sandbox.host` with an empty environment and the standard library only,
reads one JSON object from standard input (`host.Run`) and writes one to the descriptor named by its first
argument. Two modes:

`namespaces`: processes A, B, C and D. A (this one, outside) supervises time, memory and processor time. B enters new
namespaces, whose users A maps. C, forked by B, is process 1 of the new process namespace: it builds a file system
of read-only parts of this machine and one limited tmpfs, and starts D, the program. When D has ended, C kills
everything else inside and sends the output files through a pipe. When C ends, the kernel removes the rest.

`user`: for a container that is used only as a runner, without network, secrets and other programs. A runs D as a
separate user for this run. Remaining processes of that user are killed and its files are removed.

In both modes, D has no capabilities, cannot gain any, and runs with a system call filter and resource limits.
"""

import contextlib
import functools
import json
import os
import resource
import select
import signal
import stat
import struct
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, BinaryIO

from ground_service.regression.sandbox import kernel

POLL_S = 0.02
SAMPLE_S = 0.1
SETUP_S = 30.0
COLLECT_S = 60.0
PRINTED_OCTETS = 65_536
"""Number of octets kept from the end of the program's printed text."""

INODES = 65_536
BASE = "/tmp"
FIRST_BUILD_UID = 1_900_000_000
"""Lowest user id of builds, above the ranges of systemd and of user namespaces."""

HELPER_OFFSET = 1 << 22
"""From the user of a build to the user of the launcher's helpers for it; process ids are below this number."""

WORLD_WRITABLE = ("/tmp", "/dev/shm", "/var/tmp", "/run")
DEVICES = ("null", "zero", "full", "random", "urandom")
WRITABLE = ("/out", "/tmp", "/home/build", "/dev/shm")
_CHUNK = 1 << 16

Json = dict[str, Any]


class Refused(Exception):
    """A protection that cannot be enabled."""


def main() -> None:
    kernel.die_with_parent()
    kernel.hide_memory()
    kernel.adopt_orphans()
    run = json.load(sys.stdin)
    os.umask(0o077)
    try:
        report = {"namespaces": run_in_namespaces, "user": run_as_user}[run["mode"]](run)
    except Refused as error:
        report = {"refused": str(error)}
    with os.fdopen(int(sys.argv[1]), "w") as stream:
        json.dump(report, stream)


# Mode "namespaces"


def run_in_namespaces(run: Json) -> Json:
    mapping, uid = user_map()
    entered, mapped, control, reports, printed = (os.pipe() for _ in range(5))
    b = os.fork()
    if b == 0:
        try:
            close(entered[0], mapped[1], control[1], reports[0], printed[0])
            enter_namespaces(run, uid, entered[1], mapped[0], control[0], reports[1], printed[1])
        finally:
            os._exit(1)
    close(entered[1], mapped[0], control[0], reports[1], printed[1])
    watch = Watch(
        run,
        b,
        reports[0],
        printed[0],
        lambda: os.write(control[1], b"x"),
        memory=lambda processes: sum(map(proportional_memory, processes)),
        own=1,
    )
    try:
        failure = read_some(entered[0], SETUP_S)
        if failure == b"":
            raise Refused("the process that enters the namespaces did not start")
        if failure != b"ok":
            raise Refused(failure.decode(errors="replace"))
        for name, lines in mapping:
            if lines is not None:
                try:
                    with open(f"/proc/{b}/{name}", "w") as stream:
                        stream.write(lines)
                except OSError as error:
                    raise Refused(f"user namespace: {name}: {error.strerror}") from None
        os.write(mapped[1], b"x")
        report = watch.until_done()
        wait_for(b, SETUP_S)
        return report
    finally:
        # If B has ended, C has ended as well, and with it all processes in the process namespace.
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(b, signal.SIGKILL)
        reap()
        close(entered[0], mapped[1], control[1], reports[0], printed[0])


def user_map() -> tuple[tuple[tuple[str, str | None], ...], int]:
    """Return the maps of the user namespace, and the user of the build inside it.

    A service that runs as root assigns the build a unique user, derived from the process id: limits per user apply to
    it, and it cannot access files of other users. Any other service can map only its own user; limits per user are then
    counted in the new namespace.
    """
    me, group = os.geteuid(), os.getegid()
    with open("/proc/self/uid_map") as stream:
        ranges = [[int(word) for word in line.split()] for line in stream]
    if me == 0:
        uid = build_uid()
        if any(first <= uid < first + length for first, _, length in ranges):
            lines = f"0 0 1\n{uid} {uid} 1\n"
            return (("uid_map", lines), ("setgroups", None), ("gid_map", lines)), uid
        if any(first == 0 and outside == 0 for first, outside, _ in ranges):
            raise Refused(f"user namespace: expected user {uid} to be mapped, found root alone")
    return (
        ("uid_map", f"{me} {me} 1\n"),
        ("setgroups", "deny"),
        ("gid_map", f"{group} {group} 1\n"),
    ), me


def build_uid() -> int:
    """Return a user id for this run."""
    return FIRST_BUILD_UID + os.getpid()


def enter_namespaces(
    run: Json, uid: int, entered: int, mapped: int, control: int, reports: int, printed: int
) -> None:
    """Run process B."""
    kernel.die_with_parent()
    try:
        # A writes the maps; they belong to root while the process is not dumpable.
        kernel.hide_memory(False)
        kernel.unshare(kernel.NAMESPACES)
        kernel.die_with_parent()  # again, because a change of credentials can cancel it
    except OSError as error:
        os.write(entered, f"namespaces: {error.strerror}".encode())
        return
    os.write(entered, b"ok")
    if not read_some(mapped, SETUP_S):
        return
    kernel.hide_memory()
    c = os.fork()
    if c == 0:
        try:
            close(entered, mapped)
            be_init(run, uid, control, reports, printed)
        finally:
            os._exit(1)
    close(entered, mapped, control, reports, printed)
    os._exit(os.waitstatus_to_exitcode(os.waitpid(c, 0)[1]) & 0xFF)


def be_init(run: Json, uid: int, control: int, reports: int, printed: int) -> None:
    """Run process C, process 1 of the namespace."""
    try:
        kernel.die_with_parent()
        if os.getpid() != 1:
            raise Refused("process namespace: this is not its first process")
        isolation = build_root(run, uid)
        check_network()
        os.chdir("/")
    except (OSError, Refused) as error:
        send(reports, {"refused": str(getattr(error, "strerror", None) or error)})
        return
    d = os.fork()
    if d == 0:
        close(control, reports)
        become_build(run, uid, uid if os.getuid() == 0 else os.getgid(), printed, os.getuid() == 0)
    close(printed)
    send(reports, {"started": True, "isolation": isolation})
    status = None
    while status is None:
        stopped = bool(select.select([control], [], [], POLL_S)[0])
        status = reaped(d)
        if stopped:
            break
    with contextlib.suppress(ProcessLookupError):
        os.kill(-1, signal.SIGKILL)
    while True:
        try:
            process, found = os.waitpid(-1, 0)
        except ChildProcessError:
            break
        if process == d:
            status = found
    room = os.statvfs("/out")
    full = room.f_bavail == 0 or room.f_favail == 0
    send(reports, {"ended": status, "full": full, **usage()})
    send_outputs(reports, run)


def build_root(run: Json, uid: int) -> str:
    """Create a root with only the parts that the run needs; all other paths become unreachable."""
    limits = run["limits"]
    kernel.mount("", "/", "", kernel.MS_REC | kernel.MS_PRIVATE)
    kernel.mount("tmpfs", BASE, "tmpfs", kernel.MS_NOSUID | kernel.MS_NODEV, "mode=755,size=1m")
    os.mkdir(f"{BASE}/old")
    os.mkdir(f"{BASE}/new")
    kernel.pivot_root(BASE, f"{BASE}/old")
    os.chdir("/")
    os.umask(0o022)
    options = f"mode=755,size={limits['folder_mib']}m,nr_inodes={INODES}"
    kernel.mount("tmpfs", "/new", "tmpfs", kernel.MS_NOSUID | kernel.MS_NODEV, options)
    for path in WRITABLE:
        os.makedirs("/new" + path, exist_ok=True)
        # Separate mounts stay writable when the root is not, share one limit, and may contain parts, such as Python.
        kernel.mount("/new" + path, "/new" + path, "", kernel.MS_BIND)
        if os.getuid() == 0:
            os.chown("/new" + path, uid, uid)
        os.chmod("/new" + path, 0o700)
    for entry in run["view"]:
        target = "/new" + entry["target"]
        os.makedirs(os.path.dirname(target), exist_ok=True)
        if entry["kind"] == "link":
            os.symlink(entry["source"], target)
        elif entry["kind"] == "text":
            with open(target, "w") as stream:
                stream.write(entry["source"].replace("{uid}", str(uid)))
        else:
            bind("/old" + entry["source"], target)
            kernel.restrict_mount(
                target, kernel.MOUNT_ATTR_RDONLY | kernel.MOUNT_ATTR_NOSUID | kernel.MOUNT_ATTR_NODEV
            )
    for name in DEVICES:
        bind(f"/old/dev/{name}", f"/new/dev/{name}")
    os.makedirs("/new/proc")
    has_proc = True
    try:
        kernel.mount("proc", "/new/proc", "proc", kernel.MS_NOSUID | kernel.MS_NODEV | kernel.MS_NOEXEC)
        kernel.restrict_mount("/new/proc", kernel.MOUNT_ATTR_RDONLY)
    except OSError:
        has_proc = False  # A container engine hides parts of /proc: the folder stays empty.
    kernel.unmount("/old")
    os.chdir("/new")
    kernel.pivot_root(".", ".")
    kernel.unmount(".")
    os.chdir("/")
    root_only = kernel.MOUNT_ATTR_RDONLY | kernel.MOUNT_ATTR_NOSUID | kernel.MOUNT_ATTR_NODEV
    kernel.restrict_mount("/", root_only, below=False)
    whose = f"user {uid}" if os.getuid() == 0 else f"user {uid} in a user namespace"
    parts = ["namespaces", "private root", whose, "system call filter"]
    return ", ".join(parts if has_proc else [*parts, "no /proc"])


def bind(source: str, target: str) -> None:
    if os.path.isdir(source):
        os.makedirs(target, exist_ok=True)
    else:
        os.makedirs(os.path.dirname(target), exist_ok=True)
        close(os.open(target, os.O_CREAT | os.O_WRONLY, 0o644))
    kernel.mount(source, target, "", kernel.MS_BIND | kernel.MS_REC)


def check_network() -> None:
    """Refuse to continue with any network interface other than a loopback that is down."""
    try:
        with open("/proc/net/route") as stream:
            routes = stream.read().splitlines()[1:]
    except OSError:
        return  # There is no /proc; the namespace is new in any case.
    if routes:
        raise Refused("network namespace: expected no route, found some")


# Mode "user"


def run_as_user(run: Json) -> Json:
    """Run in a dedicated runner container, as a user that is used for this run only."""
    if os.geteuid() != 0:
        raise Refused("separate user: expected a runner with CAP_SETUID, CAP_SETGID and CAP_KILL")
    uid = build_uid()
    home = f"/tmp/build-{uid}"
    reports, printed = os.pipe(), os.pipe()
    as_user(uid, lambda: prepare_home(home))
    d = os.fork()
    if d == 0:
        close(reports[0], reports[1], printed[0])
        become_build(json.loads(json.dumps(run).replace("{private}", home)), uid, uid, printed[1], True)
    close(printed[1])
    watch = Watch(
        run,
        os.getpid(),
        reports[0],
        printed[0],
        lambda: kill_user(uid),
        memory=functools.partial(memory_of_user, uid),
        shared_disk=True,
    )
    try:
        send(reports[1], {"started": True, "isolation": f"runner, user {uid}, system call filter"})
        status = None
        while status is None:
            watch.turn(POLL_S)
            status = reaped(d)
            if watch.expired:
                raise Refused("separate user: processes of the build cannot be ended")
        kill_user(uid)
        reap()
        folder = f"{home}/out"
        send(reports[1], {"ended": status, "full": watch.folder_full(), **usage()})
        collector = os.fork()
        if collector == 0:
            try:
                act_as_user(uid)
                send_outputs(reports[1], {**run, "collect": folder})
            finally:
                os._exit(1)
        close(reports[1])
        report = watch.until_done()
        os.waitpid(collector, 0)
        return report
    finally:
        kill_user(uid)
        reap()
        as_user(uid, lambda: remove_owned(uid))
        close(reports[0], printed[0])


def prepare_home(home: str) -> None:
    for path in ("", "/out", "/tmp", "/home"):
        os.mkdir(home + path, 0o700)


def kill_user(uid: int) -> None:
    """Kill every process of a user."""
    as_user(uid, lambda: os.kill(-1, signal.SIGKILL))


def as_user(uid: int, action: Callable[[], object]) -> None:
    """Call a function in a child process that acts as this user, and wait for it."""
    child = os.fork()
    if child == 0:
        try:
            act_as_user(uid)
            with contextlib.suppress(ProcessLookupError):
                action()
        finally:
            os._exit(0)
    os.waitpid(child, 0)


def act_as_user(uid: int) -> None:
    """Take the rights of a user, out of reach of the signals of its processes.

    The effective user decides about access to files and processes. Signals are accepted from the real and the saved
    user, which are another user of this run: otherwise a build could stop or end the process that is to end it.
    """
    os.setgroups([])
    os.setresgid(uid, uid, uid)
    os.setresuid(uid + HELPER_OFFSET, uid, uid + HELPER_OFFSET)


def memory_of_user(uid: int, processes: Sequence[int]) -> int:
    """Return the sum of the proportional set sizes of processes of a user in octets.

    This process has no capability to read them. Without an answer the resident set sizes apply, which count shared
    pages for every process.
    """
    reading, writing = os.pipe()
    as_user(uid, lambda: os.write(writing, struct.pack(">Q", sum(map(proportional_memory, processes)))))
    close(writing)
    answer = os.read(reading, 8)
    close(reading)
    return struct.unpack(">Q", answer)[0] if len(answer) == 8 else sum(map(resident_memory, processes))


def remove_owned(uid: int) -> None:
    """Remove the files of this user in the world-writable folders."""
    for place in WORLD_WRITABLE:
        # A folder without permissions hides its content: make all folders accessible before os.walk reads them.
        for folder, names, _ in os.walk(place):
            for path in owned(folder, names, uid):
                if not os.path.islink(path):
                    os.chmod(path, 0o700)
        for folder, names, files in os.walk(place, topdown=False):
            for path in owned(folder, files + names, uid):
                with contextlib.suppress(OSError):
                    (os.rmdir if stat.S_ISDIR(os.lstat(path).st_mode) else os.unlink)(path)


def owned(folder: str, names: Iterable[str], uid: int) -> Iterator[str]:
    """Yield the paths of these names in a folder that belong to a user."""
    for name in names:
        path = os.path.join(folder, name)
        with contextlib.suppress(OSError):
            if os.lstat(path).st_uid == uid:
                yield path


# Both


def become_build(run: Json, uid: int, gid: int, printed: int, change_user: bool) -> None:
    """Replace this forked process by the program (process D)."""
    limits = run["limits"]
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        os.closerange(3, 1 << 20)
        if change_user:
            os.setgroups([])
        with contextlib.suppress(PermissionError):
            # Without CAP_SETPCAP, no_new_privs prevents a program from gaining capabilities of the bounding set.
            kernel.drop_bounding_set()
            kernel.lock_securebits()
        if change_user:
            os.setresgid(gid, gid, gid)
            os.setresuid(uid, uid, uid)
        kernel.drop_capabilities()
        kernel.forbid_new_privileges()
        os.umask(0o077)
        os.chdir(run["cwd"])
        for kind, value in (
            (resource.RLIMIT_AS, limits["memory_mib"] << 20),
            (resource.RLIMIT_CPU, limits["cpu_s"]),
            (resource.RLIMIT_FSIZE, limits["file_mib"] << 20),
            (resource.RLIMIT_NOFILE, limits["open_files"]),
            (resource.RLIMIT_NPROC, limits["processes"]),
            (resource.RLIMIT_MEMLOCK, 0),
            (resource.RLIMIT_MSGQUEUE, 0),
            (resource.RLIMIT_CORE, 0),
        ):
            # The soft limit sends SIGXCPU a second before the hard limit, to distinguish it from other kills.
            hard = value + (kind == resource.RLIMIT_CPU)
            resource.setrlimit(kind, (value, hard))
        kernel.install_filter(kernel.seccomp_filter())
    except BaseException as error:
        os.write(2, f"the sandbox is not complete: {error}\n".encode())
        os._exit(126)
    try:
        os.execvpe(run["command"][0], run["command"], run["environment"])
    except BaseException as error:
        os.write(2, f"cannot be started: {error}\n".encode())
        os._exit(127)


class Watch:
    """Supervision by process A: limits, printed text, and the report of process C."""

    def __init__(
        self,
        run: Json,
        root: int,
        reports: int,
        printed: int,
        stop: Callable[[], object],
        *,
        memory: Callable[[Sequence[int]], int],
        own: int = 0,
        shared_disk: bool = False,
    ) -> None:
        # `own`: number of first descendants that belong to the sandbox; their memory is not counted.
        self.run, self.root, self.stop, self.own, self.shared_disk = run, root, stop, own, shared_disk
        self.memory = memory
        self.occupied_before = occupied()
        self.reports, self.printed = reports, printed
        self.tail, self.octets_printed = b"", 0
        self.buffer, self.left = b"", 0
        self.file: BinaryIO | None = None
        self.report: Json = {
            "cause": "",
            "exit_status": None,
            "signal": None,
            "cpu_s": 0.0,
            "peak_rss_mib": 0.0,
        }
        self.started: float | None = None
        self.deadline, self.next_sample = time.monotonic() + SETUP_S, 0.0
        self.open = {reports, printed}
        self.done = False
        self.most_mib = self.cpu_s = 0.0

    @property
    def expired(self) -> bool:
        return time.monotonic() > self.deadline

    def until_done(self) -> Json:
        while not self.done and not self.expired and self.reports in self.open:
            self.turn(POLL_S)
        if self.file is not None:
            self.file.close()
        self.drain()
        if "refused" in self.report:
            return {"refused": self.report["refused"]}
        if self.started is None:
            raise Refused("the sandbox was not set up in time")
        if not self.done:
            self.report["cause"] = self.report["cause"] or "crashed"
        with open(self.run["printed"], "wb") as stream:
            stream.write(self.tail)
        self.report["peak_rss_mib"] = max(self.report["peak_rss_mib"], self.most_mib)
        self.report["cpu_s"] = max(self.report["cpu_s"], self.cpu_s)
        self.report.setdefault("wall_s", time.monotonic() - self.started)
        return self.report

    def turn(self, timeout_s: float) -> None:
        for descriptor in select.select(list(self.open), [], [], timeout_s)[0]:
            octets = os.read(descriptor, _CHUNK)
            if not octets:
                self.open.discard(descriptor)
            elif descriptor == self.printed:
                self.keep(octets)
            else:
                self.take(octets)
        now = time.monotonic()
        if self.started is not None and "wall_s" not in self.report and not self.report["cause"]:
            if now > self.next_sample:
                self.next_sample = now + SAMPLE_S
                self.sample()
            if now - self.started > self.run["limits"]["wall_s"]:
                self.end("timeout")

    def keep(self, octets: bytes) -> None:
        self.octets_printed += len(octets)
        self.tail = (self.tail + octets)[-PRINTED_OCTETS:]

    def drain(self) -> None:
        """Read the rest of the pipe after all writers have ended."""
        while self.printed in self.open and select.select([self.printed], [], [], 0)[0]:
            octets = os.read(self.printed, _CHUNK)
            if not octets:
                return
            self.keep(octets)

    def end(self, cause: str) -> None:
        self.report["cause"] = cause
        self.deadline = time.monotonic() + COLLECT_S
        self.stop()

    def sample(self) -> None:
        limits = self.run["limits"]
        rss, cpu, counted = 0, 0.0, []
        for place, process in enumerate(descendants(self.root)):
            with contextlib.suppress(OSError, IndexError, ValueError):
                with open(f"/proc/{process}/stat") as stream:
                    words = stream.read().rpartition(")")[2].split()
                cpu += sum(map(int, words[11:15])) / os.sysconf("SC_CLK_TCK")
                if place >= self.own:
                    rss += int(words[21]) * os.sysconf("SC_PAGE_SIZE")
                    counted.append(process)
        limit = limits["memory_mib"] << 20
        if rss > limit:
            # Shared pages were counted for each process above; the proportional size is exact but slower.
            rss = self.memory(counted)
        self.cpu_s = max(self.cpu_s, cpu)
        self.most_mib = max(self.most_mib, rss / (1 << 20))
        if rss > limit:
            self.end("memory")
        elif cpu > limits["cpu_s"] + 1:
            self.end("cpu")
        elif self.folder_full():
            self.end("disk")

    def folder_full(self) -> bool:
        """Return whether a run without its own file system has exceeded its file space, including deleted files."""
        written = occupied() - self.occupied_before
        return self.shared_disk and written > self.run["limits"]["folder_mib"] << 20

    def take(self, octets: bytes) -> None:
        """Process octets of the report: messages, each followed by the file that it announces."""
        self.buffer += octets
        while self.buffer:
            if self.file is not None:
                part = self.buffer[: self.left]
                self.file.write(part)
                self.buffer = self.buffer[len(part) :]
                self.left -= len(part)
                if self.left == 0:
                    self.file.close()
                    self.file = None
                continue
            if len(self.buffer) < 4:
                return
            length = struct.unpack(">I", self.buffer[:4])[0]
            if len(self.buffer) < 4 + length:
                return
            message = json.loads(self.buffer[4 : 4 + length])
            self.buffer = self.buffer[4 + length :]
            self.obey(message)

    def obey(self, message: Json) -> None:
        now = time.monotonic()
        if "started" in message:
            self.started, self.deadline = now, float("inf")
            self.report["isolation"] = message["isolation"]
        elif "ended" in message:
            self.deadline = now + COLLECT_S
            status = message["ended"]
            self.report["wall_s"] = now - (now if self.started is None else self.started)
            self.report["cpu_s"], self.report["peak_rss_mib"] = message["cpu_s"], message["peak_rss_mib"]
            self.report["full"] = message["full"]
            if status is not None and os.WIFEXITED(status):
                self.report["exit_status"] = os.WEXITSTATUS(status)
            elif status is not None:
                self.report["signal"] = os.WTERMSIG(status)
            if self.report["exit_status"] == 126 and not self.report["cause"]:
                self.report["unconfined"] = True
        elif "file" in message:
            wanted = message["file"] in self.run["outputs"]
            if not wanted or message["octets"] > self.run["limits"]["file_mib"] << 20:
                raise Refused("an output that was not requested")
            self.left = message["octets"]
            path = os.path.join(self.run["deliver"], message["file"])
            self.file = os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb")
            if self.left == 0:
                self.file.close()
                self.file = None
        elif "done" in message:
            self.done = True
        else:
            self.report.update(message)
            self.done = True


def send_outputs(reports: int, run: Json) -> None:
    """Send the output files: only regular files of a permitted size with requested names."""
    folder = os.open(run.get("collect", "/out"), os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    for name in run["outputs"]:
        try:
            descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
        except OSError:
            continue
        state = os.fstat(descriptor)
        if stat.S_ISREG(state.st_mode) and state.st_size <= run["limits"]["file_mib"] << 20:
            send(reports, {"file": name, "octets": state.st_size})
            left = state.st_size
            while left:
                part = os.read(descriptor, min(left, _CHUNK))
                if not part:
                    raise Refused("an output that became shorter")
                write_all(reports, part)
                left -= len(part)
        close(descriptor)
    send(reports, {"done": True})


def send(descriptor: int, message: Json) -> None:
    octets = json.dumps(message).encode()
    write_all(descriptor, struct.pack(">I", len(octets)) + octets)


def write_all(descriptor: int, octets: bytes) -> None:
    while octets:
        octets = octets[os.write(descriptor, octets) :]


def read_some(descriptor: int, timeout_s: float) -> bytes:
    """Return the octets that can be read within a time; empty if the other end is closed or sends nothing."""
    return os.read(descriptor, _CHUNK) if select.select([descriptor], [], [], timeout_s)[0] else b""


def reaped(wanted: int) -> int | None:
    """Return the status of a child that has ended, reaping all other ended children; None while it runs."""
    status = None
    while True:
        try:
            process, found = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return status
        if process == 0:
            return status
        if process == wanted:
            status = found


def wait_for(child: int, timeout_s: float) -> None:
    """Wait for a child to end, without reaping it."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return
        time.sleep(POLL_S)


def reap() -> None:
    """Wait for all children that have ended."""
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        try:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(POLL_S)
        except ChildProcessError:
            return


def usage() -> dict[str, float]:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"cpu_s": used.ru_utime + used.ru_stime, "peak_rss_mib": used.ru_maxrss / 1024.0}


def occupied() -> int:
    """Return the number of octets used in the world-writable folders."""
    total = 0
    for place in ("/tmp", "/dev/shm"):
        with contextlib.suppress(OSError):
            room = os.statvfs(place)
            total += (room.f_blocks - room.f_bfree) * room.f_frsize
    return total


def proportional_memory(process: int) -> int:
    """Return the proportional set size of a process in octets; the resident set size if that is not readable."""
    with (
        contextlib.suppress(OSError, IndexError, ValueError),
        open(f"/proc/{process}/smaps_rollup") as stream,
    ):
        for line in stream:
            if line.startswith("Pss:"):
                return int(line.split()[1]) << 10
    return resident_memory(process)


def resident_memory(process: int) -> int:
    """Return the resident set size of a process in octets; 0 if it has ended."""
    with contextlib.suppress(OSError, IndexError, ValueError), open(f"/proc/{process}/statm") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def descendants(root: int) -> list[int]:
    """Return the descendants of a process, parents first."""
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError), open(f"/proc/{name}/stat") as stream:
                parent = int(stream.read().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(name))
    found = list(children.get(root, ()))
    for process in found:
        found += children.get(process, ())
    return found


def close(*descriptors: int) -> None:
    for descriptor in descriptors:
        os.close(descriptor)


if __name__ == "__main__":
    main()
