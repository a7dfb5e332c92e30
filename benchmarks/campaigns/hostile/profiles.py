"""Process profiles of the service: user, capabilities, and restrictions of the container engine.

    python -m benchmarks.campaigns.hostile.profiles PROFILE [--keep PATH ...] -- COMMAND ...

No container engine is needed: `runner` reproduces the restrictions of docker-compose.yml with namespaces, a read-only
root and the engine's system call filter. All profiles except `user` need root.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import stat
import sys
from collections.abc import Sequence
from pathlib import Path

from ground_service.regression.sandbox import kernel

PROFILES = {
    "user": "the user that runs the campaign, unchanged",
    "root": "root, as on a laptop",
    "uid 10001": "user 10001, as a service without a container",
    "image": "user 10001, no capability, no-new-privileges: the image as compose runs it",
    "no unshare": "as `image`, and the engine's filter denies namespaces",
    "runner": "user 0 with SETUID, SETGID and KILL, no network, read-only root, the engine's filter",
}
SERVICE_UID = 10_001
RUNNER_CAPABILITIES = (5, 6, 7)
TMP_MIB = 256


def enter(profile: str, keep: Sequence[Path], exchange: Path | None = None) -> None:
    """Apply a profile to this process, and make the `keep` paths accessible to every user."""
    if profile in ("user", "root"):
        return
    kernel.unshare(kernel.CLONE_NEWNS)
    kernel.mount("", "/", "", kernel.MS_REC | kernel.MS_PRIVATE)
    reveal([Path(sys.prefix), Path(sys.base_prefix), *keep])
    if profile == "runner":
        assert exchange is not None
        become_container(exchange)
        os.setgroups([])
        os.setresgid(SERVICE_UID, SERVICE_UID, SERVICE_UID)
        kernel.drop_bounding_set(RUNNER_CAPABILITIES)
        kernel.drop_capabilities(RUNNER_CAPABILITIES)
    else:
        if profile != "uid 10001":
            kernel.drop_bounding_set()
        os.setgroups([])
        os.setresgid(SERVICE_UID, SERVICE_UID, SERVICE_UID)
        os.setresuid(SERVICE_UID, SERVICE_UID, SERVICE_UID)
    # A change of user resets the parent-death signal, so it is set afterwards.
    kernel.die_with_parent()
    if profile != "uid 10001":
        kernel.forbid_new_privileges()
    if profile in ("no unshare", "runner"):
        kernel.install_filter(kernel.seccomp_filter(kernel.ENGINE_DENIED, sockets=True))


def become_container(exchange: Path) -> None:
    """Enter a container without network: separate namespaces, mostly read-only, with the exchange folder."""
    kernel.unshare(
        kernel.CLONE_NEWPID
        | kernel.CLONE_NEWNET
        | kernel.CLONE_NEWIPC
        | kernel.CLONE_NEWUTS
        | kernel.CLONE_NEWCGROUP
    )
    child = os.fork()
    if child:
        os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) & 0xFF)
    kernel.die_with_parent()
    kernel.mount("proc", "/proc", "proc")
    held = os.open(exchange, os.O_PATH)
    kernel.restrict_mount("/", kernel.MOUNT_ATTR_RDONLY)
    kernel.mount("tmpfs", "/tmp", "tmpfs", kernel.MS_NOSUID | kernel.MS_NODEV, f"size={TMP_MIB}m,mode=1777")
    kernel.mount("tmpfs", "/dev/shm", "tmpfs", kernel.MS_NOSUID | kernel.MS_NODEV, "size=64m,mode=1777")
    # Mount this folder writable at the path that the service uses, without the rest of the disk.
    exchange.mkdir(parents=True, exist_ok=True)
    kernel.mount(f"/proc/self/fd/{held}", str(exchange), "", kernel.MS_BIND)
    kernel.restrict_mount(str(exchange), 0, cleared=kernel.MOUNT_ATTR_RDONLY)
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
        kernel.mount("tmpfs", str(parent), "tmpfs", 0, "mode=755")
        for path, descriptor in zip(inside, held, strict=True):
            if not path.exists():
                path.mkdir(parents=True)
                with contextlib.suppress(OSError):
                    kernel.mount(f"/proc/self/fd/{descriptor}", str(path), "", kernel.MS_BIND | kernel.MS_REC)
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
