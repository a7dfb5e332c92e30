"""Self-test inside the sandbox before the first build: every protection must be in force.

It attempts the actions of a hostile program and writes `/out/result.json`: name → true if the protection held.
"""

import ctypes
import errno
import json
import os
import socket
import sys
from collections.abc import Callable

LIBC = ctypes.CDLL(None, use_errno=True)


def main() -> None:
    status = {}
    if os.path.exists("/proc/self/status"):
        with open("/proc/self/status") as stream:
            status = dict(line.split(":\t", 1) for line in stream if ":\t" in line)
    results = {
        "no capabilities": all(
            int(status.get(f"Cap{kind}", "0"), 16) == 0 for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb")
        ),
        "no new privileges": status.get("NoNewPrivs", "1").strip() == "1",
        "system call filter": status.get("Seccomp", "2").strip() == "2",
        "processes of others": not os.path.exists(f"/proc/{sys.argv[1]}") or own_processes_only(),
        "environment": not [name for name in os.environ if name != "LC_CTYPE"],
        "root read-only": refused(lambda: os.mkdir("/probe")),
        "program read-only": refused(lambda: os.mkdir(os.path.join(sys.prefix, "probe"))),
        "sockets": refused(lambda: socket.socket(socket.AF_INET, socket.SOCK_STREAM)),
        "namespaces": not called("unshare", 0x1000_0000) and not called("unshare", 0x2_0000),
        "mounts": not called("mount", b"none", b"/tmp", b"tmpfs", 0, None),
        "processes": forks_end(),
        "disk": disk_ends(),
    }
    with open("/out/result.json", "w") as stream:
        json.dump(results, stream)


def refused(action: Callable[[], object]) -> bool:
    try:
        action()
    except OSError as error:
        return error.errno in (errno.EPERM, errno.EACCES, errno.EROFS)
    return False


def called(name: str, *arguments: int | bytes | None) -> bool:
    return bool(getattr(LIBC, name)(*arguments) == 0)


def own_processes_only() -> bool:
    return all(int(name) < 50 for name in os.listdir("/proc") if name.isdigit())


def forks_end() -> bool:
    """Return whether the process limit is effective: forks must fail before 100 processes."""
    reading, writing = os.pipe()
    children = []
    try:
        for _ in range(100):
            child = os.fork()
            if child == 0:
                os.close(writing)
                os.read(reading, 1)
                os._exit(0)
            children.append(child)
    except OSError:
        pass
    os.close(writing)
    for child in children:
        os.waitpid(child, 0)
    return len(children) < 64


def disk_ends() -> bool:
    """Return whether the limit on the total size of all files is effective."""
    made = []
    try:
        for number in range(64):
            made.append(f"/tmp/probe-{number}")
            with open(made[-1], "wb") as stream:
                stream.write(bytes(1 << 20))
    except OSError as error:
        return error.errno == errno.ENOSPC
    finally:
        for name in made:
            if os.path.exists(name):
                os.unlink(name)
    return False


if __name__ == "__main__":
    main()
