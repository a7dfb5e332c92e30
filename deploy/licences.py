"""Print the licence of every pinned package.

Exit status 1 if one is GPL or AGPL, states no licence or is not installed. A package whose marker excludes this Python
is named as not needed.
"""

from __future__ import annotations

import re
import sys
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

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


def pinned(files: list[Path]) -> list[Requirement]:
    """Return the packages of requirement files, by name."""
    lines = [
        line.partition("#")[0].strip() for file in files for line in file.read_text("utf-8").splitlines()
    ]
    pins = {pin.name.lower(): pin for pin in (Requirement(line) for line in lines if line)}
    return [pins[name] for name in sorted(pins)]


def main(words: list[str]) -> int:
    """Print the packages of requirement files with their licences."""
    faults = []
    for pin in pinned([Path(word) for word in words]):
        if pin.marker is not None and not pin.marker.evaluate():
            print(f"{pin.name}\tnot needed by this Python")
            continue
        try:
            stated = licences_of(pin.name)
        except metadata.PackageNotFoundError:
            faults.append(f"{pin.name}: expected the package, found it not installed")
            continue
        print(
            f"{pin.name}\t{metadata.version(pin.name)}\t{'; '.join(text[:60] for text in stated) or 'not stated'}"
        )
        if not stated:
            faults.append(f"{pin.name}: expected a licence, found none stated")
        elif is_copyleft(stated):
            faults.append(f"{pin.name}: expected no GPL or AGPL, found {'; '.join(stated)}")
    for fault in faults:
        print(f"licences: {fault}", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
