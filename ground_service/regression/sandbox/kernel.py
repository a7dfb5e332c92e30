"""Linux system calls that isolate a process, with the standard library only.

Namespaces, mounts, capabilities and a seccomp filter. Every function raises `OSError` if the kernel
refuses. No function fails silently, because a missing protection must not go unnoticed.
"""

import ctypes
import errno
import os
import platform
import struct

CLONE_NEWNS = 0x0002_0000
CLONE_NEWCGROUP = 0x0200_0000
CLONE_NEWUTS = 0x0400_0000
CLONE_NEWIPC = 0x0800_0000
CLONE_NEWUSER = 0x1000_0000
CLONE_NEWPID = 0x2000_0000
CLONE_NEWNET = 0x4000_0000
NAMESPACES = (
    CLONE_NEWNS | CLONE_NEWCGROUP | CLONE_NEWUTS | CLONE_NEWIPC | CLONE_NEWUSER | CLONE_NEWPID | CLONE_NEWNET
)

MS_NOSUID, MS_NODEV, MS_NOEXEC = 0x2, 0x4, 0x8
MS_BIND, MS_REC, MS_PRIVATE = 0x1000, 0x4000, 0x4_0000
MNT_DETACH = 2

MOUNT_ATTR_RDONLY, MOUNT_ATTR_NOSUID, MOUNT_ATTR_NODEV = 0x1, 0x2, 0x4
_AT_FDCWD, _AT_RECURSIVE = -100, 0x8000

_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_SECCOMP, _PR_CAPBSET_DROP = 1, 4, 22, 24
_PR_SET_SECUREBITS, _PR_SET_CHILD_SUBREAPER, _PR_SET_NO_NEW_PRIVS, _PR_CAP_AMBIENT = 28, 36, 38, 47
_PR_CAP_AMBIENT_CLEAR_ALL = 4
# SECBIT_NOROOT, NO_SETUID_FIXUP and NO_CAP_AMBIENT_RAISE, each with its lock bit.
_SECUREBITS = 0b1100_1111
_CAPABILITY_VERSION_3 = 0x2008_0522
_SECCOMP_MODE_FILTER = 2

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
# System calls that the default profile of container engines refuses to a process without CAP_SYS_ADMIN.
ENGINE_DENIED = ("unshare", "setns", "mount", "umount2", "pivot_root", "mount_setattr", "open_tree", "move_mount",
                 "fsopen", "fsmount", "fsconfig", "fspick", "keyctl", "add_key", "request_key", "bpf",
                 "perf_event_open", "userfaultfd", "open_by_handle_at", "name_to_handle_at")  # fmt: skip

_TIOCSTI, _TIOCLINUX = 0x5412, 0x541C
_AF_UNIX = 1
_ALLOW, _KILL, _ERRNO = 0x7FFF_0000, 0x8000_0000, 0x0005_0000
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16

_libc = ctypes.CDLL(None, use_errno=True)


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def _checked(result: int, what: str) -> int:
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, f"{what}: {os.strerror(code)}")
    return result


def _prctl(option: int, value: int, what: str, third: int = 0) -> None:
    arguments = (ctypes.c_ulong(value), ctypes.c_ulong(third), ctypes.c_ulong(0), ctypes.c_ulong(0))
    _checked(_libc.prctl(ctypes.c_int(option), *arguments), what)


def unshare(flags: int) -> None:
    """Enter new namespaces."""
    _checked(_libc.unshare(ctypes.c_int(flags)), "unshare")


def mount(source: str, target: str, kind: str = "", flags: int = 0, options: str = "") -> None:
    """Mount a file system; see mount(2)."""
    words = (source.encode(), target.encode(), kind.encode() or None)
    _checked(
        _libc.mount(*words, ctypes.c_ulong(flags), options.encode() or None),
        f"mount {kind or source} {target}",
    )


def unmount(target: str) -> None:
    """Detach a mount from the tree, also if it is in use."""
    _checked(_libc.umount2(target.encode(), ctypes.c_int(MNT_DETACH)), f"umount {target}")


def pivot_root(new: str, old: str) -> None:
    """Make `new` the root and move the former root to `old`."""
    call = number("pivot_root")
    _checked(_libc.syscall(ctypes.c_long(call), new.encode(), old.encode()), "pivot_root")


def restrict_mount(target: str, attributes: int, *, cleared: int = 0, below: bool = True) -> None:
    """Set and clear attributes of a mount, and of all mounts below it unless `below` is False (Linux 5.12)."""
    values = struct.pack("QQQQ", attributes, cleared, 0, 0)
    _checked(
        _libc.syscall(
            ctypes.c_long(number("mount_setattr")),
            ctypes.c_int(_AT_FDCWD),
            target.encode(),
            ctypes.c_uint(_AT_RECURSIVE if below else 0),
            values,
            ctypes.c_size_t(len(values)),
        ),
        f"mount_setattr {target}",
    )


def die_with_parent() -> None:
    """Request that this process is killed when the thread that started it ends."""
    _prctl(_PR_SET_PDEATHSIG, 9, "PR_SET_PDEATHSIG")


def adopt_orphans() -> None:
    """Become the parent of descendants whose own parents have ended."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1, "PR_SET_CHILD_SUBREAPER")


def hide_memory(hidden: bool = True) -> None:
    """Deny other processes of this user access to memory, environment, descriptors and user maps of this process."""
    _prctl(_PR_SET_DUMPABLE, int(not hidden), "PR_SET_DUMPABLE")


def forbid_new_privileges() -> None:
    """Disable set-user-id programs and file capabilities permanently."""
    _prctl(_PR_SET_NO_NEW_PRIVS, 1, "PR_SET_NO_NEW_PRIVS")


def drop_bounding_set(kept: tuple[int, ...] = ()) -> None:
    """Drop capabilities, except those in `kept`, for all programs executed later; needs CAP_SETPCAP."""
    for capability in range(64):
        if capability in kept:
            continue
        try:
            _prctl(_PR_CAPBSET_DROP, capability, "PR_CAPBSET_DROP")
        except OSError as error:
            if error.errno == errno.EINVAL:  # the kernel has no further capabilities
                return
            raise


def lock_securebits() -> None:
    """Lock the securebits so that user 0 has no capabilities and user changes keep none; needs CAP_SETPCAP."""
    _prctl(_PR_SET_SECUREBITS, _SECUREBITS, "PR_SET_SECUREBITS")


def drop_capabilities(kept: tuple[int, ...] = ()) -> None:
    """Drop all effective, permitted, inheritable and ambient capabilities, except those in `kept` (below 32)."""
    _prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL, "PR_CAP_AMBIENT")
    header = struct.pack("Ii", _CAPABILITY_VERSION_3, 0)
    mask = sum(1 << capability for capability in kept)
    _checked(_libc.capset(header, struct.pack("IIIIII", mask, mask, 0, 0, 0, 0)), "capset")


def number(call: str) -> int:
    """Return the number of a system call on this machine.

    Raises
    ------
    OSError
        If the processor architecture is not supported.
    """
    found = _NUMBERS[call][_architecture()[1]]
    if found is None:
        raise OSError(errno.ENOSYS, f"{call}: not on this architecture")
    return found


def seccomp_filter(denied: tuple[str, ...] = DENIED, *, sockets: bool = False) -> bytes:
    """Return the filter program that refuses system calls with EPERM and permits all others.

    `clone` with any namespace flag is refused; `clone3`, whose flags a filter cannot read, returns ENOSYS.
    Unless `sockets` is set, only socket pairs (`socketpair`) are permitted.
    """
    audit, column = _architecture()
    steps = [_step(_LOAD, _ARCHITECTURE_AT), _step(_EQUAL, audit, 1, 0), _step(_RETURN, _KILL)]
    steps.append(_step(_LOAD, _NUMBER_AT))
    if column == 0:
        steps += [_step(_AT_LEAST, _X32_BIT, 0, 1), _step(_RETURN, _KILL)]
    for call in denied:
        code = _NUMBERS[call][column]
        if code is not None and not (sockets and call == "socket"):
            steps += [_step(_EQUAL, code, 0, 1), _step(_RETURN, _ERRNO | errno.EPERM)]
    steps += [_step(_EQUAL, number("clone3"), 0, 1), _step(_RETURN, _ERRNO | errno.ENOSYS)]
    steps += _on_argument("clone", 0, [_step(_ANY_BIT, NAMESPACES, 0, 1)], errno.EPERM)
    if not sockets:
        steps += _on_argument("socketpair", 0, [_step(_EQUAL, _AF_UNIX, 1, 0)], errno.EAFNOSUPPORT)
    for request in (_TIOCSTI, _TIOCLINUX):
        steps += _on_argument("ioctl", 1, [_step(_EQUAL, request, 0, 1)], errno.EPERM)
    steps.append(_step(_RETURN, _ALLOW))
    return b"".join(steps)


def install_filter(program: bytes) -> None:
    """Install a filter for this process and all its descendants; requires `forbid_new_privileges` before."""
    buffer = ctypes.create_string_buffer(program, len(program))
    holder = _Program(len(program) // 8, ctypes.cast(buffer, ctypes.c_void_p))
    pointer = ctypes.cast(ctypes.pointer(holder), ctypes.c_void_p).value
    assert pointer is not None
    _prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, "PR_SET_SECCOMP", pointer)


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
    return [_step(_EQUAL, number(call), 0, len(body)), *body]
