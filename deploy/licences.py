"""Print the licence of every pinned package that is installed; exit status 1 if one is GPL or AGPL."""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path

PIN = re.compile(r"^([A-Za-z0-9._-]+)==", re.MULTILINE)
COPYLEFT = re.compile(r"\b(A?GPL|GNU (Affero )?General Public)", re.IGNORECASE)
WEAK = re.compile(r"LGPL|Lesser|Library General", re.IGNORECASE)


def licences_of(package: str) -> list[str]:
    """Return what an installed package states about its licence."""
    about = metadata.distribution(package).metadata
    stated = [about.get("License-Expression") or "", *(about.get("License") or "").splitlines()[:1]]
    stated += [
        line.rpartition(" :: ")[2]
        for line in about.get_all("Classifier") or []
        if line.startswith("License ::")
    ]
    return list(dict.fromkeys(text.strip()[:100] for text in stated if text.strip()))


def is_copyleft(stated: list[str]) -> bool:
    """Return whether one of the stated licences is the GPL or AGPL; the LGPL is permitted."""
    return any(COPYLEFT.search(text) and not WEAK.search(text) for text in stated)


def main(words: list[str]) -> int:
    """Print the packages of requirement files with their licences."""
    status = 0
    names = sorted(
        {name for word in words for name in PIN.findall(Path(word).read_text(encoding="utf-8"))},
        key=str.lower,
    )
    for name in names:
        try:
            stated = licences_of(name)
        except metadata.PackageNotFoundError:
            print(f"{name}\tnot installed")
            continue
        print(f"{name}\t{metadata.version(name)}\t{'; '.join(text[:60] for text in stated) or 'not stated'}")
        if is_copyleft(stated):
            print(f"licences: {name}: expected no GPL or AGPL, found {'; '.join(stated)}", file=sys.stderr)
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
