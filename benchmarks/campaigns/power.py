"""Campaign of power failures during ingest: every possible disk state must contain all acknowledged data.

    python -m benchmarks.campaigns.power [--cuts 1000] [--pieces 40] [--seed S] [--json]

A process ingests pieces of a downlink into SQLite and writes a line for each that it acknowledges. A library that is
loaded into it (compiled from C with gcc) records every change that it makes to files, in order and with the octets:
open, write, truncate, synchronise, rename, unlink, mkdir. The disk is then rebuilt at random cuts: everything that was
synchronised before the cut, and of the rest a random part, writes torn at 512 octets, names in the order of their
folder. The archive has to open, hold every acknowledged piece intact, take the others and be the same in the end.

What is taken for granted: a synchronised file has its octets and length, a synchronised folder its names, and one
folder's names reach the disk in order. Exit status 1 where anything is lost.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import select

from benchmarks.campaigns._deployment import service_environment
from benchmarks.ground import mixed_downlink
from ground_service.ground import open_ground
from ground_service.ingest.service import Place, ingest_file
from ground_service.store import repository
from ground_service.store.vehicles import vehicle_id
from tests.ground_service.archive_hash import archive_hash

SPACECRAFT = 76
SECTOR_OCTETS = 512
_RECORD = struct.Struct("<BxxxIqqq")
OPEN, WRITE, TRUNCATE, SYNC, RENAME, UNLINK, MKDIR, NOTE = range(1, 9)

SHIM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static int journal = -1;
static char root[PATH_MAX];
static size_t root_length;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static char *names[65536];

static ssize_t (*real_write)(int, const void *, size_t);

#define REAL(type, name, ...) \
  static type (*real)(__VA_ARGS__); if (!real) real = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

__attribute__((constructor)) static void start(void) {
  const char *where = getenv("POWER_JOURNAL"), *folder = getenv("POWER_ROOT");
  real_write = (ssize_t(*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
  if (!where || !folder) return;
  strncpy(root, folder, sizeof root - 1);
  root_length = strlen(root);
  int (*real_open)(const char *, int, ...) = (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open");
  journal = real_open(where, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
}

struct record { uint8_t kind, pad[3]; uint32_t path; int64_t offset, length, other; };

static void put(int kind, const char *path, int64_t offset, const void *octets, int64_t length, int64_t other) {
  if (journal < 0) return;
  struct record r = {(uint8_t)kind, {0, 0, 0}, (uint32_t)strlen(path), offset, length, other};
  struct iovec v[3] = {{&r, sizeof r}, {(void *)path, r.path}, {(void *)octets, octets ? (size_t)length : 0}};
  pthread_mutex_lock(&lock);
  for (int i = 0; i < 3; i++) {
    const char *at = v[i].iov_base; size_t left = v[i].iov_len;
    while (left) { ssize_t n = real_write(journal, at, left); if (n < 0) abort(); at += n; left -= (size_t)n; }
  }
  pthread_mutex_unlock(&lock);
}

static const char *inside(const char *path, char *buffer) {
  if (journal < 0 || !path) return NULL;
  if (path[0] != '/') {
    if (!getcwd(buffer, PATH_MAX)) return NULL;
    strcat(buffer, "/"); strcat(buffer, path); path = buffer;
  }
  return strncmp(path, root, root_length) == 0 ? path : NULL;
}

static void opened(int fd, const char *path, int flags) {
  char buffer[PATH_MAX * 2];
  const char *name = inside(path, buffer);
  if (fd < 0 || fd >= 65536) return;
  free(names[fd]); names[fd] = NULL;
  if (!name) return;
  names[fd] = strdup(name);
  if (flags & (O_CREAT | O_TRUNC)) put(1, name, flags & O_TRUNC ? 1 : 0, NULL, 0, 0);
}

#define OPENER(symbol) \
int symbol(const char *path, int flags, ...) { \
  REAL(int, #symbol, const char *, int, ...); \
  mode_t mode = 0; if (flags & O_CREAT) { va_list a; va_start(a, flags); mode = va_arg(a, mode_t); va_end(a); } \
  int fd = real(path, flags, mode); opened(fd, path, flags); return fd; }
OPENER(open)
OPENER(open64)

int openat(int folder, const char *path, int flags, ...) {
  REAL(int, "openat", int, const char *, int, ...);
  mode_t mode = 0; if (flags & O_CREAT) { va_list a; va_start(a, flags); mode = va_arg(a, mode_t); va_end(a); }
  int fd = real(folder, path, flags, mode); opened(fd, path, flags); return fd; }

int close(int fd) {
  REAL(int, "close", int);
  if (fd >= 0 && fd < 65536) { free(names[fd]); names[fd] = NULL; }
  return real(fd); }

static void wrote(int fd, const void *octets, ssize_t n, off_t at) {
  if (n > 0 && fd >= 0 && fd < 65536 && names[fd]) put(2, names[fd], at, octets, n, 0); }

ssize_t write(int fd, const void *octets, size_t length) {
  if (!real_write) real_write = (ssize_t(*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
  ssize_t n = real_write(fd, octets, length);
  if (n > 0 && fd >= 0 && fd < 65536 && names[fd]) wrote(fd, octets, n, lseek(fd, 0, SEEK_CUR) - n);
  return n; }
ssize_t pwrite(int fd, const void *octets, size_t length, off_t at) {
  REAL(ssize_t, "pwrite", int, const void *, size_t, off_t);
  ssize_t n = real(fd, octets, length, at); wrote(fd, octets, n, at); return n; }
ssize_t pwrite64(int fd, const void *octets, size_t length, off64_t at) {
  REAL(ssize_t, "pwrite64", int, const void *, size_t, off64_t);
  ssize_t n = real(fd, octets, length, at); wrote(fd, octets, n, at); return n; }
#define TRUNCATER(symbol, kind) \
int symbol(int fd, kind size) { REAL(int, #symbol, int, kind); int r = real(fd, size); \
  if (!r && fd < 65536 && names[fd]) put(3, names[fd], size, NULL, 0, 0); return r; }
TRUNCATER(ftruncate, off_t)
TRUNCATER(ftruncate64, off64_t)
#define SYNCER(symbol) \
int symbol(int fd) { REAL(int, #symbol, int); int r = real(fd); \
  if (!r && fd >= 0 && fd < 65536 && names[fd]) put(4, names[fd], 0, NULL, 0, 0); return r; }
SYNCER(fsync)
SYNCER(fdatasync)
int rename(const char *from, const char *to) {
  REAL(int, "rename", const char *, const char *); char a[PATH_MAX * 2], b[PATH_MAX * 2];
  int r = real(from, to); const char *x = inside(from, a), *y = inside(to, b);
  if (!r && x && y) put(5, x, 0, y, (int64_t)strlen(y), 0);
  return r; }
int unlink(const char *path) {
  REAL(int, "unlink", const char *); char a[PATH_MAX * 2]; int r = real(path); const char *x = inside(path, a);
  if (!r && x) put(6, x, 0, NULL, 0, 0);
  return r; }
int mkdir(const char *path, mode_t mode) {
  REAL(int, "mkdir", const char *, mode_t); char a[PATH_MAX * 2];
  int r = real(path, mode); const char *x = inside(path, a);
  if (!r && x) put(7, x, 0, NULL, 0, 0);
  return r; }
"""

CHILD = """
import os, sys
from pathlib import Path
from ground_service.ground import open_ground
from ground_service.ingest.service import Place, ingest_file
home, pieces = Path(sys.argv[1]), Path(sys.argv[2])
offset = 0
with open_ground(home) as ground:
    for path in sorted(pieces.iterdir()):
        ingest_file(ground, path, place=Place("power", offset))
        offset += path.stat().st_size
        with open(home / "acknowledged" / path.name, "w") as note:
            note.write("done")
"""


@dataclass(frozen=True, slots=True)
class Operation:
    """Change of the disk."""

    kind: int
    path: str
    offset: int
    octets: bytes


@dataclass(slots=True)
class Node:
    """File with its synchronised content, and changes that are not synchronised."""

    octets: bytearray = field(default_factory=bytearray)
    pending: list[Operation] = field(default_factory=list)


def record(folder: Path, pieces: list[bytes]) -> list[Operation]:
    """Ingest the pieces in a separate process with the recorder; return the disk operations."""
    source, library, journal = folder / "shim.c", folder / "shim.so", folder / "journal"
    source.write_text(SHIM)
    subprocess.run(
        ["gcc", "-O1", "-w", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl", "-lpthread"],
        check=True,
    )
    home, given = folder / "home", folder / "pieces"
    given.mkdir()
    (home / "acknowledged").mkdir(parents=True)
    for number, octets in enumerate(pieces):
        (given / f"{number:05d}").write_bytes(octets)
    environment = service_environment(
        LD_PRELOAD=str(library), POWER_JOURNAL=str(journal), POWER_ROOT=str(home)
    )
    subprocess.run([sys.executable, "-c", CHILD, str(home), str(given)], check=True, env=environment)
    return read_journal(journal.read_bytes(), str(home))


def read_journal(octets: bytes, root: str) -> list[Operation]:
    """Return the operations of a journal, with paths relative to `root`; acknowledgements become notes."""
    operations = []
    at = 0
    while at < len(octets):
        kind, path_length, offset, length, _ = _RECORD.unpack_from(octets, at)
        at += _RECORD.size
        path = octets[at : at + path_length].decode().removeprefix(root).strip("/")
        at += path_length
        data = octets[at : at + length]
        at += length
        if kind == RENAME:
            data = data.decode().removeprefix(root).strip("/").encode()
        if path.startswith("acknowledged/"):
            if kind == OPEN:
                operations.append(Operation(NOTE, path.removeprefix("acknowledged/"), 0, b""))
            continue
        if not path.endswith("-shm"):  # recreated by SQLite, never synchronised
            operations.append(Operation(kind, path, offset, data))
    return operations


class Disk:
    """Model of the disk: names and octets, synchronised or not."""

    def __init__(self) -> None:
        self.nodes: dict[str, Node] = {}  # as visible to running programs
        self.folders = {""}
        self.durable: dict[str, Node | None] = {"": None}  # names on the disk; None: a folder
        self.changes: dict[str, list[tuple[str, str, Node | None]]] = {}  # name changes by folder

    def apply(self, operation: Operation) -> None:
        """Apply an operation."""
        path = operation.path
        if operation.kind == MKDIR:
            self.folders.add(path)
            self._name(path, "add", None)
        elif operation.kind == OPEN:
            if path not in self.nodes:
                self.nodes[path] = Node()
                self._name(path, "add", self.nodes[path])
            elif operation.offset:
                self.nodes[path].pending.append(Operation(TRUNCATE, path, 0, b""))
        elif operation.kind in (WRITE, TRUNCATE):
            self.nodes.setdefault(path, Node()).pending.append(operation)
        elif operation.kind == RENAME:
            target = operation.octets.decode()
            node = self.nodes.pop(path)
            self.nodes[target] = node
            self._name(target, "add", node)
            self._name(path, "remove", node)
        elif operation.kind == UNLINK:
            self._name(path, "remove", self.nodes.pop(path, None))
        elif operation.kind == SYNC and path in self.nodes:
            node = self.nodes[path]
            for one in node.pending:
                change(node.octets, one, None)
            node.pending.clear()
        elif operation.kind == SYNC:
            for change_of in self.changes.pop(path, []):
                self._settle(self.durable, change_of)

    def _name(self, path: str, what: str, node: Node | None) -> None:
        folder = path.rpartition("/")[0]
        self.changes.setdefault(folder, []).append((path, what, node))

    @staticmethod
    def _settle(names: dict[str, Node | None], change_of: tuple[str, str, Node | None]) -> None:
        path, what, node = change_of
        if what == "add":
            names[path] = node
        else:
            names.pop(path, None)

    def write(self, folder: Path, rng: random.Random) -> None:
        """Write a disk state that is possible after a power failure now, under `folder`."""
        names = dict(self.durable)
        for changes in self.changes.values():
            for one in changes[: rng.randint(0, len(changes))]:
                self._settle(names, one)
        torn: dict[int, bytes] = {}
        for path, node in sorted(names.items(), key=lambda item: item[0]):
            target = folder / path
            if not (folder / path).parent.is_dir():
                continue  # its folder was not written to the disk
            if node is None:
                target.mkdir(exist_ok=True)
                continue
            if id(node) not in torn:
                octets = bytearray(node.octets)
                mode = rng.random()
                for one in node.pending:
                    if mode < 0.2 or (mode < 0.8 and rng.random() < 0.5):
                        continue
                    change(octets, one, rng if mode < 0.9 else None)
                torn[id(node)] = bytes(octets)
            target.write_bytes(torn[id(node)])


def change(octets: bytearray, operation: Operation, rng: random.Random | None) -> None:
    """Write or truncate a file; with `rng` only some sectors of a write are on the disk."""
    if operation.kind == TRUNCATE:
        del octets[operation.offset :]
        octets.extend(bytes(max(operation.offset - len(octets), 0)))
        return
    end = operation.offset + len(operation.octets)
    octets.extend(bytes(max(end - len(octets), 0)))
    if rng is None or rng.random() < 0.5:
        octets[operation.offset : end] = operation.octets
        return
    at = operation.offset
    while at < end:
        stop = min((at // SECTOR_OCTETS + 1) * SECTOR_OCTETS, end)
        if rng.random() < 0.5:
            octets[at:stop] = operation.octets[at - operation.offset : stop - operation.offset]
        at = stop


def check(folder: Path, pieces: list[bytes], acknowledged: list[str], expected: str | None) -> str:
    """Return the fault of the archive after a power failure; empty if there is none."""
    try:
        with open_ground(folder) as ground:
            with ground.database.reading() as connection:
                rows = list(connection.execute(select(repository.INGESTS)).mappings())
            done = {row["file_sha256"] for row in rows if row["state"] == "done"}
            for name in acknowledged:
                sha256 = hashlib.sha256(pieces[int(name)]).hexdigest()
                if sha256 not in done or ground.files.get(sha256) != pieces[int(name)]:
                    return f"acknowledged piece {name} is lost"
            for row in rows:
                ground.files.get(row["file_sha256"])
            if expected is not None:
                offset = sum(map(len, pieces[: len(acknowledged)]))
                for octets in pieces[len(acknowledged) :]:
                    (folder / "piece").write_bytes(octets)
                    ingest_file(ground, folder / "piece", place=Place("power", offset))
                    offset += len(octets)
                with ground.database.writing() as connection:
                    vehicle = vehicle_id(connection, SPACECRAFT, "flight")
                    if archive_hash(connection, vehicle) != expected:
                        return "the archive differs after the rest was ingested"
    except Exception as error:  # any error means that the archive is not usable
        return f"{type(error).__name__}: {error}"
    return ""


def campaign(cuts: int, pieces: int, packets: int, seed: int, resumed: int = 10) -> dict[str, Any]:
    """Cut the power at random operations of one run; ingest the remaining pieces in every `resumed`-th state."""
    rng = random.Random(seed)
    stream = mixed_downlink(packets)
    places = sorted(rng.sample(range(1, len(stream)), pieces - 1))
    parts = [stream[a:b] for a, b in zip([0, *places], [*places, len(stream)], strict=True)]
    started = time.monotonic()
    faults: Counter[str] = Counter()
    checked = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        operations = record(folder, parts)
        with open_ground(folder / "home") as ground, ground.database.writing() as connection:
            expected = archive_hash(connection, vehicle_id(connection, SPACECRAFT, "flight"))
        wanted = Counter(rng.randrange(len(operations)) for _ in range(cuts))
        disk, acknowledged = Disk(), []
        for number, operation in enumerate(operations):
            if operation.kind == NOTE:
                acknowledged.append(operation.path)
            else:
                disk.apply(operation)
            for _ in range(wanted[number]):
                state = folder / "state"
                state.mkdir()
                disk.write(state, rng)
                full = checked % resumed == 0
                if wrong := check(state, parts, acknowledged, expected if full else None):
                    faults[wrong] += 1
                    print(f"cut after operation {number}: {wrong}", file=sys.stderr, flush=True)
                checked += 1
                shutil.rmtree(state)
    return {
        "cuts": checked,
        "operations": len(operations),
        "synchronised": sum(one.kind == SYNC for one in operations),
        "pieces": pieces,
        "resumed": -(-checked // resumed),
        "faults": dict(faults),
        "lost": sum(faults.values()),
        "seconds": round(time.monotonic() - started),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cuts", type=int, default=1000)
    parser.add_argument("--pieces", type=int, default=40)
    parser.add_argument("--packets", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    figures = campaign(given.cuts, given.pieces, given.packets, given.seed)
    if given.json:
        print(json.dumps(figures, indent=2))
    else:
        print("\n".join(f"{name:<14}{value}" for name, value in figures.items()))
    return 0 if figures["lost"] == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
