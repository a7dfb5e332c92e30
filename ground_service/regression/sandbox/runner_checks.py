"""Requirements for a runner without namespaces: a dedicated container without other content."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from ground_service.regression.sandbox import launcher

_PERMITTED = {5: "CAP_KILL", 6: "CAP_SETGID", 7: "CAP_SETUID", 8: "CAP_SETPCAP"}
_NEEDED = (5, 6, 7)
_SECRET_WORDS = ("PASSWORD", "SECRET", "TOKEN", "URL", "CREDENTIAL")
_MEMORY_KINDS = (
    *("tmpfs", "ramfs", "devtmpfs", "hugetlbfs"),
    *("proc", "sysfs", "devpts", "mqueue", "cgroup", "cgroup2"),
)
# Files of the container engine, owned by root, which a build cannot change.
_ENGINE_FILES = ("/etc/hosts", "/etc/hostname", "/etc/resolv.conf", "/sbin/docker-init")


def runner_faults(exchange: Path) -> list[str]:
    """Return the unmet requirements for isolation of builds by separate users; empty if all are met."""
    status = dict(
        line.split(":\t", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":\t" in line
    )
    held = int(status["CapEff"], 16)
    names = sorted(name for name in os.environ if set(name.upper().split("_")) & set(_SECRET_WORDS))
    faults = {
        "user 0 of a container (a build gets a separate user)": os.geteuid() == 0,
        "the capabilities SETUID, SETGID and KILL": all(held >> bit & 1 for bit in _NEEDED),
        "no other capability": held & ~sum(1 << bit for bit in _PERMITTED) == 0,
        "no-new-privileges": status["NoNewPrivs"].strip() == "1",
        f"no secrets in its environment (found {', '.join(names)})": not names,
        "a read-only root": bool(os.statvfs("/").f_flag & os.ST_RDONLY),
        "a /tmp in memory with a size limit": _limited_memory("/tmp"),
        "no other writable disk": not _writable_disks(exchange),
        "no network": not _routes(),
        f"an exchange folder closed to others ({exchange})": exchange.is_dir()
        and not exchange.stat().st_mode & 0o007,
    }
    return [name for name, holds in faults.items() if not holds]


def build_remains() -> Iterator[str]:
    """Yield the processes of build users, and their files in the world-writable folders.

    Processes in other PID namespaces end with these and are not those of a runner's builds.
    """
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            words = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
            user, numbers = int(words["Uid"].split()[0]), words["NSpid"].split()
        except (OSError, KeyError):
            continue
        # A process has a number in each namespace, from that of /proc to its own.
        if user >= launcher.FIRST_BUILD_UID and len(numbers) == 1:
            yield f"process {status.parent.name}"
    for place in launcher.WORLD_WRITABLE:
        for folder, names, files in os.walk(place):
            for path in (Path(folder, name) for name in (*names, *files)):
                try:
                    if path.lstat().st_uid >= launcher.FIRST_BUILD_UID:
                        yield str(path)
                except FileNotFoundError:
                    continue


def _mounts() -> list[tuple[str, str, set[str]]]:
    """Return mount point, type and options of every mount."""
    rows = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    return [(row[1].replace("\\040", " "), row[2], set(row[3].split(","))) for row in rows]


def _limited_memory(path: str) -> bool:
    return any(
        point == path and kind == "tmpfs" and any(option.startswith("size=") for option in options)
        for point, kind, options in _mounts()
    )


def _writable_disks(exchange: Path) -> list[str]:
    own = os.path.realpath(exchange)
    return [
        point
        for point, kind, options in _mounts()
        if "rw" in options and kind not in _MEMORY_KINDS and point not in (own, *_ENGINE_FILES)
    ]


def _routes() -> list[str]:
    """Return the interfaces with a route, except the loopback."""
    found = [line.split()[0] for line in Path("/proc/net/route").read_text().splitlines()[1:]]
    six = Path("/proc/net/ipv6_route")
    if six.exists():
        found += [line.split()[-1] for line in six.read_text().splitlines()]
    return [name for name in found if name != "lo"]
