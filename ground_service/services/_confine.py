"""Runs one program inside limits and reports what became of it; started as a script, with nothing but the library.

``python -I _confine.py REPORT_FD`` reads one JSON object from standard input: `command`, `cwd`, `environment`,
`limits` (`wall_s`, `cpu_s`, `memory_mib`, `file_mib`, `folder_mib`, `open_files`), `prefix` (a command that shuts the
program off from the network) and `output` (file for what the program prints). It writes one JSON object to the
descriptor.

The program gets a process group of its own. When it ends, or passes a limit, everything it started is killed.
"""

import contextlib
import ctypes
import json
import os
import resource
import signal
import sys
import time

POLL_S = 0.02
FOLDER_CHECK_S = 0.25
PR_SET_CHILD_SUBREAPER = 36


def main() -> None:
    descriptor = int(sys.argv[1])
    job = json.load(sys.stdin)
    adopt_orphans()
    report = run(job)
    with os.fdopen(descriptor, "w") as stream:
        json.dump(report, stream)


def run(job: dict) -> dict:
    limits = job["limits"]
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        become(job)
    cause, status, next_look = "", None, 0.0
    while status is None:
        done, found = os.waitpid(child, os.WNOHANG)
        if done:
            status = found
            break
        elapsed = time.monotonic() - started
        if elapsed > limits["wall_s"]:
            cause = "timeout"
        elif elapsed > next_look:
            next_look = elapsed + FOLDER_CHECK_S
            if folder_octets(job["cwd"]) > limits["folder_mib"] << 20:
                cause = "disk"
        if cause:
            kill_group(child)
            status = os.waitpid(child, 0)[1]
        else:
            time.sleep(POLL_S)
    wall_s = time.monotonic() - started
    kill_group(child)
    kill_descendants()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    if not cause and folder_octets(job["cwd"]) > limits["folder_mib"] << 20:
        cause = "disk"
    return {
        "cause": cause,
        "exit_status": os.WEXITSTATUS(status) if os.WIFEXITED(status) else None,
        "signal": os.WTERMSIG(status) if os.WIFSIGNALED(status) else None,
        "wall_s": wall_s,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_rss_mib": used.ru_maxrss / 1024.0,
    }


def become(job: dict) -> None:
    """Turn this forked process into the program."""
    limits = job["limits"]
    try:
        os.setsid()
        os.umask(0o077)
        os.chdir(job["cwd"])
        nothing = os.open(os.devnull, os.O_RDONLY)
        printed = os.open(job["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
        os.dup2(nothing, 0)
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        os.closerange(3, 256)
        for kind, value in (
            (resource.RLIMIT_AS, limits["memory_mib"] << 20),
            (resource.RLIMIT_CPU, limits["cpu_s"]),
            (resource.RLIMIT_FSIZE, limits["file_mib"] << 20),
            (resource.RLIMIT_NOFILE, limits["open_files"]),
            (resource.RLIMIT_CORE, 0),
        ):
            # The processor time has a second of warning, by a signal that tells it from other kills.
            resource.setrlimit(kind, (value, value + (kind == resource.RLIMIT_CPU)))
        command = [*job["prefix"], *job["command"]]
        os.execvpe(command[0], command, job["environment"])
    except OSError as error:
        with contextlib.suppress(OSError):
            os.write(2, f"cannot be started: {error}\n".encode())
    finally:
        os._exit(127)


def adopt_orphans() -> None:
    """Make processes whose parents died children of this one, so that none gets away."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def kill_group(leader: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def kill_descendants() -> None:
    """Kill and reap whatever is left of what the program started."""
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        left = children_of(os.getpid())
        for process in left:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(POLL_S)


def children_of(parent: int) -> list:
    found = []
    for name in os.listdir("/proc"):
        if not name.isdigit():
            continue
        with contextlib.suppress(OSError, IndexError, ValueError), open(f"/proc/{name}/stat") as stream:
            if int(stream.read().rpartition(")")[2].split()[1]) == parent:
                found.append(int(name))
    return found


def folder_octets(folder: str) -> int:
    total = 0
    for where, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(where, name)).st_size
    return total


if __name__ == "__main__":
    main()
