"""Kinds of attack, and the permitted outcomes of their runs."""

EXPECTED: dict[str, tuple[str, ...]] = {
    "explore": ("ok",),
    "leave files": ("ok",),
    "memory bomb": ("memory",),
    # The limit of the file system, or the limit checked ten times a second, applies.
    "disk fill": ("ok", "disk"),
    "outlive": ("timeout",),
    "daemon": ("ok",),
    "stop others": ("timeout",),
    "link out": ("nothing",),
    "hard link out": ("crashed",),
    "pipe out": ("nothing",),
    "folder out": ("nothing",),
    "sparse out": ("disk",),
    # If the link exists during the copy, the output is not copied.
    "swap out": ("ok", "nothing"),
    "flood": ("ok",),
}
KINDS = tuple(EXPECTED)
