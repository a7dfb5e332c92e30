"""Checksums and signature of the files of a release.

`sign FOLDER --key FILE` writes SHA256SUMS and its Ed25519 signature SHA256SUMS.sig; `verify FOLDER --public-key FILE`
checks both; `key FILE` makes a key pair: FILE and FILE.pub. The private key stays outside of the repository.

Exit status 0: done; 1: the files are not those that were signed; 2: wrong use.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SUMS, SIGNATURE = "SHA256SUMS", "SHA256SUMS.sig"
CONTENTS = {
    "wheel": "*.whl",
    "source distribution": "*.tar.gz",
    "bill of materials": "*.cdx.json",
    "list of licences": "licences.txt",
}
"""What a release has, one of each."""

REPOSITORY = Path(__file__).resolve().parents[1]
_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9._+-]+)")


class Refused(Exception):
    """A release that is not as it was signed."""


class Misused(Exception):
    """A command that cannot be carried out."""


def sign(folder: Path, key_file: Path) -> list[str]:
    """Write checksums and signature; return the names of the signed files.

    Raises
    ------
    Misused
        If the release is not complete or the key cannot be used.
    """
    names = _names(folder)
    for what, pattern in CONTENTS.items():
        found = len(list(folder.glob(pattern)))
        if found != 1:
            raise Misused(f"{folder}: expected one {what} ({pattern}), found {found or 'none'}")
    key = _private_key(key_file)
    sums = "".join(f"{_sha256(folder / name)}  {name}\n" for name in names).encode()
    (folder / SUMS).write_bytes(sums)
    (folder / SIGNATURE).write_bytes(key.sign(sums))
    return names


def verify(folder: Path, public_key: Path) -> list[str]:
    """Check signature and checksums of a release; return the names of its files.

    Raises
    ------
    Refused
        If a file is not as it was signed, is missing, or was added.
    """
    try:
        sums, signature = (folder / SUMS).read_bytes(), (folder / SIGNATURE).read_bytes()
    except FileNotFoundError as error:
        raise Refused(f"{folder}: expected {Path(error.filename).name}, found none") from None
    try:
        _public_key(public_key).verify(signature, sums)
    except InvalidSignature:
        raise Refused(f"{folder / SUMS}: expected the signature of {public_key}, found another") from None
    stated: dict[str, str] = {}
    for line in sums.decode("ascii").splitlines():
        match = _LINE.fullmatch(line)
        if match is None or match[2] in stated:
            raise Refused(f"{folder / SUMS}: expected lines of a SHA-256 and a new name, found {line[:80]!r}")
        stated[match[2]] = match[1]
    found = _names(folder)
    for name in sorted({*stated, *found}):
        if name not in found:
            raise Refused(f"{folder / name}: expected the file, found none")
        if name not in stated:
            raise Refused(f"{folder / name}: expected signed files only, found one that is not listed")
        if _sha256(folder / name) != stated[name]:
            raise Refused(f"{folder / name}: expected the file that was signed, found another")
    return found


def make_key(path: Path) -> None:
    """Write a new key pair.

    Raises
    ------
    Misused
        If the file exists or is inside of the repository.
    """
    _outside(path)
    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise Misused(f"{path}: expected a new file, found one") from None
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(private)
    path.with_name(f"{path.name}.pub").write_bytes(public)


def _outside(path: Path) -> None:
    if path.resolve().is_relative_to(REPOSITORY):
        raise Misused(f"{path}: expected a key outside of the repository, found it inside")


def _private_key(path: Path) -> Ed25519PrivateKey:
    _outside(path)
    if path.is_file() and path.stat().st_mode & 0o077:
        raise Misused(f"{path}: expected a key that only its owner can read; run 'chmod 600'")
    found = _loaded(path, lambda octets: serialization.load_pem_private_key(octets, None))
    if not isinstance(found, Ed25519PrivateKey):
        raise Misused(f"{path}: expected an Ed25519 key, found another")
    return found


def _public_key(path: Path) -> Ed25519PublicKey:
    found = _loaded(path, serialization.load_pem_public_key)
    if not isinstance(found, Ed25519PublicKey):
        raise Misused(f"{path}: expected an Ed25519 key, found another")
    return found


def _loaded(path: Path, load: Any) -> Any:
    try:
        return load(path.read_bytes())
    except OSError as error:
        raise Misused(f"{path}: expected a key file, found {error.strerror}") from None
    except (ValueError, TypeError):
        raise Misused(
            f"{path}: expected a key in PEM format without a password, found something else"
        ) from None


def _names(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise Misused(f"{folder}: expected the folder of a release, found none")
    return sorted(path.name for path in folder.iterdir() if path.name not in (SUMS, SIGNATURE))


def _sha256(path: Path) -> str:
    if not path.is_file() or path.is_symlink():
        raise Refused(f"{path}: expected a plain file, found another")
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def main(words: Sequence[str] | None = None) -> int:
    """Sign or verify a release, or make a key."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    signing = commands.add_parser("sign", help="write checksums and signature")
    signing.add_argument("folder", type=Path)
    signing.add_argument("--key", type=Path, required=True, help="private key (PEM, Ed25519)")
    checking = commands.add_parser("verify", help="check signature and checksums")
    checking.add_argument("folder", type=Path)
    checking.add_argument("--public-key", type=Path, required=True, help="public key (PEM, Ed25519)")
    commands.add_parser("key", help="make a key pair").add_argument("file", type=Path)
    given = parser.parse_args(words)
    try:
        if given.command == "key":
            make_key(given.file)
            print(f"{given.file}: private key; publish {given.file}.pub")
        elif given.command == "sign":
            print(f"{given.folder}: {len(sign(given.folder, given.key))} files signed")
        else:
            print(f"{given.folder}: {len(verify(given.folder, given.public_key))} files as they were signed")
    except Refused as error:
        print(f"REFUSED: {error}", file=sys.stderr)
        return 1
    except Misused as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
