"""Shipped packages: licences, known vulnerabilities, and the bill of materials (CycloneDX).

`licences FILE...` prints the licence of each pinned package; exit status 1 if one is GPL or AGPL, states none or is not
installed. `audit FILE...` looks the packages up in the OSV database; exit status 1 if a vulnerability is known; if the
database cannot be reached, this is reported (with --strict it is status 2). `bom FILE...` reads requirement files with
hashes and writes names, versions, hashes, licences and dependencies, also those of a lock file of npm, and the packages
of the operating system. A package whose marker excludes this Python is not needed.
"""

import argparse
import base64
import hashlib
import json
import re
import subprocess
import sys
import urllib.request
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

OSV = "https://api.osv.dev/v1/querybatch"
TIMEOUT_S = 30.0
LOCK = Path("deploy/openmct/package-lock.json")
COPYLEFT = re.compile(r"\b(A?GPL|GNU (Affero )?General Public)", re.IGNORECASE)
WEAK = re.compile(r"LGPL|Lesser|Library General", re.IGNORECASE)

Json = dict[str, Any]


def licences_of(package: str) -> list[str]:
    """Return what an installed package states about its licence."""
    about = metadata.distribution(package).metadata
    stated = [about.get("License-Expression") or "", *(about.get("License") or "").splitlines()[:1]]
    stated += [
        line.rpartition(" :: ")[2] for line in about.get_all("Classifier") or [] if line.startswith("License ::")
    ]
    return list(dict.fromkeys(text.strip()[:100] for text in stated if text.strip()))


def is_copyleft(stated: list[str]) -> bool:
    """Return whether one of the stated licences is the GPL or AGPL; the LGPL is permitted."""
    return any(COPYLEFT.search(text) and not WEAK.search(text) for text in stated)


def pinned(files: list[Path]) -> dict[str, tuple[Requirement, list[str]]]:
    """Return the packages of requirement files with their SHA-256 hashes, by name."""
    pins = {}
    for file in files:
        for line in file.read_text("utf-8").replace("\\\n", "").splitlines():
            if stated := line.partition("#")[0].partition(" --hash")[0].strip():
                pin = Requirement(stated)
                pins[canonicalize_name(pin.name)] = pin, re.findall(r"sha256:([0-9a-f]{64})", line)
    return dict(sorted(pins.items()))


def print_licences(files: list[Path]) -> int:
    """Print the packages of requirement files with their licences."""
    faults = []
    for name, (pin, _) in pinned(files).items():
        if pin.marker is not None and not pin.marker.evaluate():
            print(f"{name}\tnot needed by this Python")
            continue
        try:
            stated = licences_of(name)
        except metadata.PackageNotFoundError:
            faults.append(f"{name}: expected the package, found it not installed")
            continue
        print(f"{name}\t{metadata.version(name)}\t{'; '.join(text[:60] for text in stated) or 'not stated'}")
        if not stated:
            faults.append(f"{name}: expected a licence, found none stated")
        elif is_copyleft(stated):
            faults.append(f"{name}: expected no GPL or AGPL, found {'; '.join(stated)}")
    for fault in faults:
        print(f"licences: {fault}", file=sys.stderr)
    return 1 if faults else 0


def audited(files: list[Path], url: str, strict: bool) -> int:
    """Print the known vulnerabilities of the packages of requirement files."""
    packages = [(name, str(pin.specifier).removeprefix("==")) for name, (pin, _) in pinned(files).items()]
    queries = [{"package": {"name": name, "ecosystem": "PyPI"}, "version": version} for name, version in packages]
    body, kind = json.dumps({"queries": queries}).encode(), {"Content-Type": "application/json"}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, body, kind), timeout=TIMEOUT_S) as answer:
            results = json.load(answer)["results"]
        vulnerable = {
            package: ids
            for package, result in zip(packages, results, strict=True)
            if (ids := sorted(str(one["id"]) for one in (result or {}).get("vulns", [])))
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        print(f"audit: NOT CHECKED: the vulnerability database {url} cannot be used: {error}", file=sys.stderr)
        return 2 if strict else 0
    for (name, version), ids in vulnerable.items():
        print(f"audit: {name} {version}: {', '.join(ids)}", file=sys.stderr)
    print(f"audit: {len(packages)} packages, {len(vulnerable)} with known vulnerabilities")
    return 1 if vulnerable else 0


def bill_of_materials(files: list[Path], wheel: Path | None, lock: Path, status: Path | None) -> Json:
    """Return the CycloneDX document of the packages of requirement files with hashes.

    Parameters
    ----------
    wheel
        Wheel of this project, whose hash is stated.
    lock
        Lock file of npm, for the telemetry displays.
    status
        List of the packages of Debian, for the image.
    """
    command = [sys.executable, "-m", "cyclonedx_py", "environment", "--pyproject", "pyproject.toml"]
    made = subprocess.run([*command, "--output-reproducible", sys.executable], check=True, stdout=subprocess.PIPE)
    document: Json = json.loads(made.stdout)
    pins, root = pinned(files), document["metadata"]["component"]
    parts = [one for one in document["components"] if canonicalize_name(one["name"]) in pins]
    for one in parts:
        _, hashes = pins[canonicalize_name(one["name"])]
        one["hashes"] = [{"alg": "SHA-256", "content": sha256} for sha256 in hashes]
        one.setdefault("licenses", [{"license": {"name": text}} for text in licences_of(one["name"])])
    if wheel is not None:
        root["hashes"] = [{"alg": "SHA-256", "content": hashlib.sha256(wheel.read_bytes()).hexdigest()}]
    for place, one in json.loads(lock.read_text("utf-8"))["packages"].items():
        if place:
            part = _part("npm", place.removeprefix("node_modules/"), one["version"])
            sha512 = base64.b64decode(one["integrity"].removeprefix("sha512-")).hex()
            part |= {"hashes": [{"alg": "SHA-512", "content": sha512}], "licenses": [{"expression": one["license"]}]}
            parts.append(part)
    for entry in status.read_text("utf-8").split("\n\n") if status else ():
        field = dict(re.findall(r"^(Package|Version|Status): (.*)$", entry, re.MULTILINE))
        if field.get("Status", "").endswith(" installed"):
            parts.append(_part("deb/debian", field["Package"], field["Version"]))
    refs = {root["bom-ref"], *(one["bom-ref"] for one in parts)}
    edges = {one["ref"]: refs.intersection(one.get("dependsOn", ())) for one in document["dependencies"]}
    edges[root["bom-ref"]] |= {one["bom-ref"] for one in parts if one.get("purl", "").startswith("pkg:npm/")}
    graph = [{"ref": ref, "dependsOn": sorted(edges[ref])} for ref in sorted(refs & edges.keys())]
    return document | {"components": parts, "dependencies": graph}


def _part(kind: str, name: str, version: str) -> Json:
    purl = f"pkg:{kind}/{name}@{version}"
    return {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}


def main(words: list[str] | None = None) -> int:
    """Print what is asked about the packages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("licences", "audit", "bom"))
    parser.add_argument("files", nargs="+", type=Path, help="requirement files with exact versions")
    parser.add_argument("--url", default=OSV, help="address of the database")
    parser.add_argument("--strict", action="store_true", help="the database has to answer")
    parser.add_argument("--wheel", type=Path, help="wheel of this project")
    parser.add_argument("--status", type=Path, help="/var/lib/dpkg/status of the image")
    given = parser.parse_args(words)
    if given.what == "licences":
        return print_licences(given.files)
    if given.what == "audit":
        return audited(given.files, given.url, given.strict)
    print(json.dumps(bill_of_materials(given.files, given.wheel, LOCK, given.status), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
