"""`linna data`: the public data products, their licences and checksums; fetching and re-checking them."""

import argparse
import sys
from pathlib import Path

from linna.data import data_directory
from linna.errors import UsageError
from linna.output import emit, finish, log
from linna.parser import option


def configure_data(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", required=True)
    listing = verbs.add_parser("list", help="list the products: available files, size, licence, address")
    fetch = verbs.add_parser("fetch", help="download products into the data folder")
    option(fetch, "names PRODUCT", str, "default: the small ones all need", nargs="*")
    option(fetch, "--only TEXT", str, "only files with this in their name (tiles)", "")
    option(fetch, "--mirror URL", str, "take files from URL/<path in the data folder> instead", "")
    verify = verbs.add_parser("verify", help="read every file again and compare checksums")
    for verb, handler in ((listing, _list), (fetch, _fetch), (verify, _verify)):
        option(verb, "--to DIR", Path, "data folder; default $LINNA_DATA or the user's", None)
        finish(verb, handler)


def _list(arguments: argparse.Namespace) -> int:
    from payload_emulator.data_products import PRODUCTS
    from payload_emulator.fetching import survey

    root = _root(arguments)
    rows = survey(root, PRODUCTS)
    lines = [f"data folder: {root}{'' if root.is_dir() else ' (does not exist)'}"]
    for row in rows:
        have = f"{row['files_present']} of {row['files']}" if row["files"] else "none known"
        own = f", {row['files_of_its_own']} other files of it" if row["files_of_its_own"] else ""
        lines += [
            f"\n{row['name']}: {row['title']}",
            f"  available files: {have}{own}; to download: {_size(row['octets'])}; "
            f"checksums: {', '.join(row['checksums']) or 'unknown'}",
            f"  licence: {row['licence']}",
            f"  cite: {row['citation']}",
            f"  from: {row['address'] or 'no address known'}",
        ]
        if row["note"]:
            lines.append(f"  {row['note']}")
    return emit(arguments, {"root": str(root), "products": rows}, "\n".join(lines))


def _fetch(arguments: argparse.Namespace) -> int:
    from payload_emulator.data_products import PRODUCTS, find_product
    from payload_emulator.fetching import fetch, from_mirror

    root = _root(arguments)
    products = [find_product(name) for name in arguments.names] or [p for p in PRODUCTS if p.basic]
    for name, product in zip(arguments.names, products, strict=False):
        if product is None:
            known = ", ".join(product.name for product in PRODUCTS)
            raise UsageError(f"data fetch: expected one of {known}, found {name!r}")
        if not product.files:
            raise UsageError(f"data fetch: {name}: expected a product with an address, found none: {product.note}")
    files = [file for product in products if product for file in product.files if arguments.only in file.path]
    if not files:
        raise UsageError(f"data fetch: expected files with {arguments.only!r} in their name, found none")
    done = []
    for file in files:
        chosen = from_mirror(file, arguments.mirror) if arguments.mirror else file
        log(f"{file.path}: from {chosen.url or 'nowhere known'} ({_size(chosen.octets)})")
        found = fetch(chosen, root, progress=sys.stderr.isatty())
        log(f"{file.path}: {found.status}, {_size(found.octets)}")
        done.append({"path": found.path, "status": found.status, "octets": found.octets})
    return emit(arguments, {"root": str(root), "files": done}, f"{len(done)} files in {root}")


def _verify(arguments: argparse.Namespace) -> int:
    from payload_emulator.fetching import verify

    root = _root(arguments)
    checked = verify(root)
    counts = {status: sum(c.status == status for c in checked) for status in ("whole", "damaged", "missing", "unknown")}
    for c in checked:
        if c.status != "whole":
            log(f"{root / c.path}: {c.status} ({c.against})")
    bad = counts["damaged"] + counts["missing"]
    rows = [{"path": c.path, "status": c.status, "against": c.against, "sha256": c.sha256} for c in checked]
    text = ", ".join(f"{count} {status}" for status, count in counts.items())
    emit(arguments, {"root": str(root), **counts, "files": rows}, f"{root}: {text}")
    return 1 if bad else 0


def _root(arguments: argparse.Namespace) -> Path:

    chosen: Path | None = arguments.to
    return data_directory() if chosen is None else chosen


def _size(octets: int) -> str:
    if not octets:
        return "size unknown"
    return f"{octets / 1e9:.2f} GB" if octets >= 1e9 else f"{octets / 1e6:.2f} MB"
