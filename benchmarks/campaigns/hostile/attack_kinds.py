"""Kinds of attack, and the permitted outcomes of their runs."""

EXPECTED = {
    kind: outcomes.split()
    for kind, outcomes in (
        line.split(": ")
        for line in """\
explore: ok
leave files: ok
memory bomb: memory
disk fill: ok disk
outlive: timeout
daemon: ok
stop others: timeout
link out: nothing
hard link out: crashed
pipe out: nothing
folder out: nothing
sparse out: disk
swap out: ok nothing
flood: ok""".splitlines()
    )
}
"""Of `disk fill` the limit of the file system, or the limit checked ten times a second, applies; of `swap out` the
output is not copied if the link exists during the copy."""
KINDS = tuple(EXPECTED)
