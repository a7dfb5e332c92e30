"""System call filter of the sandbox (seccomp), as a program of the classic Berkeley packet filter."""

import errno
import platform
import struct
from collections.abc import Sequence

_NAMESPACES = 0x7E02_0000
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
        steps += _on_argument("clone", 0, [_step(_ANY_BIT, _NAMESPACES, 0, 1)], errno.EPERM)
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
