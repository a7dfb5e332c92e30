"""Kinds of attack, and the outcomes of a run that was held."""

EXPECTED: dict[str, tuple[str, ...]] = {
    "explore": ("ok",),
    "leave files": ("ok",),
    "memory bomb": ("memory",),
    # The limit is the file system's, or that of a look ten times a second.
    "disk fill": ("ok", "disk"),
    "outlive": ("timeout",),
    "daemon": ("ok",),
    "link out": ("nothing",),
    "hard link out": ("crashed",),
    "pipe out": ("nothing",),
    "folder out": ("nothing",),
    "sparse out": ("disk",),
    # The link may be there when the output is taken out, which then is not taken.
    "swap out": ("ok", "nothing"),
    "flood": ("ok",),
}
KINDS = tuple(EXPECTED)
