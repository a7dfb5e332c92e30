"""Look up pinned packages in the OSV database of known vulnerabilities.

Exit status 0: none known, or the database cannot be reached (this is reported; with --strict it is status 2); 1: found.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

OSV = "https://api.osv.dev/v1/querybatch"
PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s\\;]+)", re.MULTILINE)
TIMEOUT_S = 30.0


def pins(files: list[Path]) -> list[tuple[str, str]]:
    """Return names and versions of the packages of requirement files."""
    return sorted({found for file in files for found in PIN.findall(file.read_text(encoding="utf-8"))})


def known_vulnerabilities(url: str, packages: list[tuple[str, str]]) -> dict[tuple[str, str], list[str]]:
    """Return the ids of the known vulnerabilities of packages that have any.

    Raises
    ------
    OSError, ValueError
        If the database cannot be reached, or does not answer as expected.
    """
    queries = [
        {"package": {"name": name, "ecosystem": "PyPI"}, "version": version} for name, version in packages
    ]
    request = urllib.request.Request(
        url, json.dumps({"queries": queries}).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
        document: Any = json.load(answer)
    results = document.get("results") if isinstance(document, dict) else None
    if not isinstance(results, list) or len(results) != len(packages):
        raise ValueError(f"expected {len(packages)} results")
    found = {}
    for package, result in zip(packages, results, strict=True):
        if ids := sorted(str(one["id"]) for one in (result or {}).get("vulns", [])):
            found[package] = ids
    return found


def main(words: list[str] | None = None) -> int:
    """Print what is known about the packages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path, help="requirement files with exact versions")
    parser.add_argument("--url", default=OSV, help="address of the database")
    parser.add_argument(
        "--strict", action="store_true", help="exit status 2 if the database cannot be reached"
    )
    given = parser.parse_args(words)
    packages = pins(given.files)
    try:
        found = known_vulnerabilities(given.url, packages)
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(
            f"audit: NOT CHECKED: the vulnerability database {given.url} cannot be used: {error}",
            file=sys.stderr,
        )
        return 2 if given.strict else 0
    for (name, version), ids in found.items():
        print(f"audit: {name} {version}: {', '.join(ids)}", file=sys.stderr)
    print(f"audit: {len(packages)} packages, {len(found)} with known vulnerabilities")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
