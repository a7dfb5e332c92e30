"""Process profiles of the service: user, capabilities, and restrictions of the container engine.

    python -m benchmarks.campaigns.hostile.profiles PROFILE [--keep PATH ...] -- COMMAND ...

No container engine is needed: `runner` reproduces the restrictions of docker-compose.yml with namespaces, a read-only
root and its system call filter. All profiles except `user` need root.
"""

import argparse
import contextlib
import ctypes
import json
import os
import stat
import struct
import sys
from collections.abc import Sequence
from pathlib import Path

from ground_service.regression.sandbox import seccomp_filter

PROFILES = {
    "user": "the user that runs the campaign, unchanged",
    "root": "root, as on a laptop",
    "uid 10001": "user 10001, as a service without a container",
    "image": "user 10001, no capability, no-new-privileges: the image as compose runs it",
    "no unshare": "as `image`, and the engine's filter denies namespaces",
    "runner": "as `image`, no network, read-only root, the filter of deploy/runner-seccomp.json",
}
SERVICE_UID = 10_001
TMP_MIB = 256
# System calls that the default profile of container engines refuses to a process without CAP_SYS_ADMIN.
ENGINE_DENIED = ("unshare", "setns", "mount", "umount2", "pivot_root", "mount_setattr", "open_tree", "move_mount",
                 "fsopen", "fsmount", "fsconfig", "fspick", "keyctl", "add_key", "request_key", "bpf",
                 "perf_event_open", "userfaultfd", "open_by_handle_at", "name_to_handle_at")  # fmt: skip
RUNNER_FILTER = Path(__file__).parents[3] / "deploy" / "runner-seccomp.json"

CLONE_NEWNS, CONTAINER = 0x0002_0000, 0x6E00_0000
"""Namespaces: mount; and cgroup, UTS, IPC, process and network."""

MS_NOSUID_NODEV, MS_BIND, MS_REC, MS_PRIVATE = 0x6, 0x1000, 0x4000, 0x4_0000
MOUNT_ATTR_RDONLY = 0x1
_AT_FDCWD, _AT_RECURSIVE, _MOUNT_SETATTR = -100, 0x8000, 442
_PR_SET_PDEATHSIG, _PR_SET_SECCOMP, _PR_CAPBSET_DROP, _PR_SET_NO_NEW_PRIVS = 1, 22, 24, 38
_LIBC = ctypes.CDLL(None, use_errno=True)


def enter(profile: str, keep: Sequence[Path], exchange: Path | None = None) -> None:
    """Apply a profile to this process, and make the `keep` paths accessible to every user."""
    if profile in ("user", "root"):
        return
    call("unshare", CLONE_NEWNS)
    mount("", "/", "", MS_REC | MS_PRIVATE)
    reveal([Path(sys.prefix), Path(sys.base_prefix), *keep])
    if profile == "runner":
        assert exchange is not None
        become_container(exchange)
    if profile != "uid 10001":
        for capability in range(int(Path("/proc/sys/kernel/cap_last_cap").read_text()) + 1):
            prctl(_PR_CAPBSET_DROP, capability)
    os.setgroups([])
    os.setresgid(SERVICE_UID, SERVICE_UID, SERVICE_UID)
    os.setresuid(SERVICE_UID, SERVICE_UID, SERVICE_UID)
    # A change of user resets the parent-death signal, so it is set afterwards.
    prctl(_PR_SET_PDEATHSIG, 9)
    if profile != "uid 10001":
        prctl(_PR_SET_NO_NEW_PRIVS, 1)
    if profile == "no unshare":
        install_filter(seccomp_filter(ENGINE_DENIED))
    elif profile == "runner":
        (refused,) = json.loads(RUNNER_FILTER.read_text())["syscalls"]
        install_filter(seccomp_filter(refused["names"]))


def call(name: str, *words: object) -> None:
    """Call a function of the C library; raise `OSError` if it fails."""
    if getattr(_LIBC, name)(*(ctypes.c_ulong(word) if isinstance(word, int) else word for word in words)) < 0:
        code = ctypes.get_errno()
        raise OSError(code, f"{name}: {os.strerror(code)}")


def prctl(option: int, value: int, third: int = 0) -> None:
    """Change a property of this process; see prctl(2)."""
    call("prctl", option, value, third, 0, 0)


def mount(source: str, target: str, kind: str = "", flags: int = 0, options: str = "") -> None:
    """Mount a file system; see mount(2)."""
    call("mount", source.encode(), target.encode(), kind.encode() or None, flags, options.encode() or None)


def restrict_mount(target: str, attributes: int, cleared: int = 0) -> None:
    """Set and clear attributes of a mount and of all mounts below it."""
    values = struct.pack("QQQQ", attributes, cleared, 0, 0)
    call("syscall", _MOUNT_SETATTR, _AT_FDCWD, target.encode(), _AT_RECURSIVE, values, len(values))


def install_filter(program: bytes) -> None:
    """Install a system call filter for this process and all its descendants."""
    buffer = ctypes.create_string_buffer(program, len(program))
    holder = ctypes.create_string_buffer(struct.pack("HxxxxxxQ", len(program) // 8, ctypes.addressof(buffer)))
    prctl(_PR_SET_SECCOMP, 2, ctypes.addressof(holder))


def become_container(exchange: Path) -> None:
    """Enter a container without network: separate namespaces, mostly read-only, with the exchange folder."""
    call("unshare", CONTAINER)
    child = os.fork()
    if child:
        os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) & 0xFF)
    prctl(_PR_SET_PDEATHSIG, 9)
    held = os.open(exchange, os.O_PATH)
    restrict_mount("/", MOUNT_ATTR_RDONLY)
    mount("proc", "/proc", "proc")
    mount("tmpfs", "/tmp", "tmpfs", MS_NOSUID_NODEV, f"size={TMP_MIB}m,mode=1777")
    mount("tmpfs", "/dev/shm", "tmpfs", MS_NOSUID_NODEV, "size=64m,mode=1777")
    # Mount this folder writable at the path that the service uses, without the rest of the disk.
    exchange.mkdir(parents=True, exist_ok=True)
    mount(f"/proc/self/fd/{held}", str(exchange), "", MS_BIND)
    restrict_mount(str(exchange), 0, MOUNT_ATTR_RDONLY)
    os.close(held)


def reveal(paths: Sequence[Path]) -> None:
    """Make paths accessible to every user regardless of their parent folders, in this mount namespace only."""
    closed: dict[Path, list[Path]] = {}
    for path in dict.fromkeys(path.resolve() for path in paths):
        for parent in reversed(path.parents):
            if not parent.stat().st_mode & stat.S_IXOTH:
                closed.setdefault(parent, []).append(path)
                break
    for parent, inside in closed.items():
        held = [os.open(path, os.O_PATH) for path in inside]
        mount("tmpfs", str(parent), "tmpfs", 0, "mode=755")
        for path, descriptor in zip(inside, held, strict=True):
            if not path.exists():
                path.mkdir(parents=True)
                with contextlib.suppress(OSError):
                    mount(f"/proc/self/fd/{descriptor}", str(path), "", MS_BIND | MS_REC)
            os.close(descriptor)


def main(words: Sequence[str]) -> int:
    """Apply a profile and execute a command."""
    parser = argparse.ArgumentParser(prog="profiles")
    parser.add_argument("profile", choices=PROFILES)
    parser.add_argument("--keep", type=Path, action="append", default=[])
    parser.add_argument("--exchange", type=Path)
    parser.add_argument("command", nargs="+")
    arguments = parser.parse_args(words)
    enter(arguments.profile, [*arguments.keep, Path.cwd()], arguments.exchange)
    os.execvp(arguments.command[0], arguments.command)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
