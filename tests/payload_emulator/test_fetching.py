"""Downloads from a server on this machine that breaks off, sends other octets and is overloaded."""

import hashlib
import io
import json
import threading
import zipfile
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
from pytest import fixture, raises

from linna.cli import run
from lunar.datafolder import find_data
from payload_emulator.data_products import PRODUCTS, Product, ProductFile
from payload_emulator.errors import DataProductError
from payload_emulator.fetching import fetch, verify

BODY = np.random.default_rng(1).integers(0, 256, 300_000, dtype=np.uint8).tobytes()
SHA256 = hashlib.sha256(BODY).hexdigest()


@fixture(autouse=True)
def quick(monkeypatch):
    """Leave out the pauses between attempts."""
    monkeypatch.setattr("pooch.core.time.sleep", lambda _seconds: None)


@dataclass
class Behaviour:
    """Answers of the server: octets after which it breaks off (one for each answer), statuses to answer first."""

    body: bytes = BODY
    break_after: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self):
        b = self.server.behaviour
        b.requests.append(self.path)
        if b.statuses:
            self.send_response(b.statuses.pop(0))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(b.body)))
        self.end_headers()
        stop = b.break_after.pop(0) if b.break_after else len(b.body)
        self.wfile.write(b.body[:stop])
        if stop < len(b.body):
            self.close_connection = True

    def log_message(self, *arguments):
        pass


@fixture
def server():
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        running.behaviour = Behaviour()
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def wanted(server, **changes):
    url = f"http://127.0.0.1:{server.server_address[1]}/a.bin"
    plain = ProductFile("dem/a.bin", url, len(BODY), sha256=SHA256, origin="published", checksum_source="the test")
    return replace(plain, **changes)


def refused(match, *wanted, **options):
    with raises(DataProductError, match=match):
        fetch(*wanted, **options)


def leftovers(root):
    return sorted(p.name for p in root.rglob("*") if p.is_file() and p.name not in ("a.bin", "SHA256SUMS"))


def test_a_file_arrives_whole_is_recorded_and_is_not_asked_for_again(server, tmp_path):
    found = fetch(wanted(server), tmp_path)
    assert (found.status, found.octets) == ("fetched", len(BODY))
    assert (tmp_path / "dem/a.bin").read_bytes() == BODY
    assert (tmp_path / "SHA256SUMS").read_text() == f"{SHA256}  ./dem/a.bin\n"
    assert leftovers(tmp_path) == []
    assert fetch(wanted(server), tmp_path).status == "present"
    assert len(server.behaviour.requests) == 1


def test_an_interrupted_transfer_is_repeated_and_leaves_nothing(server, tmp_path):
    server.behaviour.break_after = [100_000, 50_000]
    fetch(wanted(server), tmp_path)
    assert (tmp_path / "dem/a.bin").read_bytes() == BODY
    server.behaviour.break_after = [10, 10]
    refused("found no whole transfer in 2 attempts", wanted(server, path="dem/b.bin"), tmp_path, attempts=2)
    assert [p.name for p in (tmp_path / "dem").iterdir()] == ["a.bin"]


def test_a_file_with_another_checksum_is_refused(server, tmp_path):
    server.behaviour.body = BODY[:-1] + bytes([BODY[-1] ^ 1])
    refused(rf"expected the checksum {SHA256} \(the test\), found", wanted(server), tmp_path)
    assert list((tmp_path / "dem").iterdir()) == []


def test_a_file_that_differs_from_the_tested_copy_is_kept_and_said_to(server, tmp_path):
    server.behaviour.body = BODY[:-1] + b"x"
    assert fetch(wanted(server, origin="copy"), tmp_path).status.endswith("differs from the tested copy")


def test_an_md5_is_enough(server, tmp_path):
    right = wanted(server, sha256="", md5=hashlib.md5(BODY).hexdigest())
    assert fetch(right, tmp_path).status == "fetched"
    refused("expected the checksum 00", replace(right, path="dem/b.bin", md5="00"), tmp_path)


def test_a_file_of_another_size_is_refused(server, tmp_path):
    refused("expected 5 octets, found 300000: another file", wanted(server, octets=5), tmp_path)
    assert leftovers(tmp_path) == []


def test_an_overloaded_server_is_asked_again_and_the_last_status_is_reported(server, tmp_path):
    server.behaviour.statuses = [503, 429]
    assert fetch(wanted(server), tmp_path).status == "fetched"
    server.behaviour.statuses = [404, 404]
    refused("expected the file, found HTTP status 404", wanted(server, path="dem/b.bin"), tmp_path, attempts=2)
    assert len(server.behaviour.requests) == 5


def test_a_server_that_does_not_answer_is_reported_in_one_line(tmp_path):
    nowhere = ProductFile("dem/a.bin", "http://127.0.0.1:9/a.bin")
    with raises(DataProductError, match="found no whole transfer in 3 attempts") as caught:
        fetch(nowhere, tmp_path, attempts=3)
    assert "\n" not in str(caught.value)


def test_a_full_disk_is_reported_in_one_line(server, tmp_path, monkeypatch):
    def full(*_arguments):
        raise OSError(28, "No space left on device", "a.bin")

    monkeypatch.setattr("pooch.HTTPDownloader.__call__", full)
    refused(r"a\.bin: No space left on device", wanted(server), tmp_path)


def test_a_folder_that_cannot_be_made_is_named(server, tmp_path):
    (tmp_path / "dem").write_text("a file where a folder should be")
    refused("dem", wanted(server), tmp_path)


def test_the_member_of_a_zip_file_is_taken_out(server, tmp_path):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as bundle:
        bundle.writestr("bundle/data/craters.csv", BODY)
        bundle.writestr("bundle/readme.txt", "no")
    server.behaviour.body = packed.getvalue()
    file = wanted(server, path="craters/a.csv", octets=len(packed.getvalue()), member="craters.csv")
    fetch(file, tmp_path)
    assert (tmp_path / "craters/a.csv").read_bytes() == BODY
    assert sorted(p.name for p in (tmp_path / "craters").iterdir()) == ["a.csv"]
    refused(r"expected one member other\.csv", replace(file, path="craters/b.csv", member="other.csv"), tmp_path)


def test_verifying_finds_every_change(server, tmp_path):
    plain = wanted(server, sha256="", origin="unknown")
    products = (Product("a", "a", "none", "none", (plain, wanted(server, path="dem/b.bin"))),)
    fetch(plain, tmp_path)
    fetch(products[0].files[1], tmp_path)
    assert [c.status for c in verify(tmp_path, products)] == ["whole", "whole"]
    for name in ("a.bin", "b.bin"):
        octets = bytearray(BODY)
        octets[1234] ^= 4
        (tmp_path / "dem" / name).write_bytes(octets)
    assert [c.status for c in verify(tmp_path, products)] == ["damaged", "damaged"]
    (tmp_path / "dem/a.bin").unlink()
    assert [c.status for c in verify(tmp_path, products)] == ["missing", "damaged"]
    # A damaged file is fetched again.
    assert fetch(products[0].files[1], tmp_path).status == "fetched"


def test_what_nobody_vouches_for_is_unknown(tmp_path):
    (tmp_path / "dem").mkdir()
    (tmp_path / "dem/a.bin").write_bytes(BODY)
    products = (Product("a", "a", "none", "none", (ProductFile("dem/a.bin"),)),)
    assert [c.status for c in verify(tmp_path, products)] == ["unknown"]


def test_the_registry_names_files_where_the_data_folder_is_searched(tmp_path):
    for product in PRODUCTS:
        for file in product.files:
            path = tmp_path / file.path
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
    data = find_data(tmp_path)
    assert data.gravity is not None and data.gravity.name.startswith("gggrx")
    assert data.gravity_alternative is not None and data.gravity_alternative.name == "jgl165p1.sha"
    assert data.orientation_bpc is not None and data.orientation_tf is not None
    assert data.catalogue_robbins is not None and "robbins" in data.catalogue_robbins.name
    assert (len(data.dem_sldem), len(data.dem_tiles), len(data.albedo_tiles)) == (6, 8, 8)


def test_the_registry_promises_nothing_it_does_not_know():
    paths = [file.path for product in PRODUCTS for file in product.files]
    assert len(paths) == len(set(paths))
    for product in PRODUCTS:
        assert product.licence and product.citation
        assert product.files or product.note
        for file in product.files:
            assert file.url.startswith("https://")
            # A checksum has a length of its kind and says where it comes from; none has neither.
            assert len(file.sha256) in (0, 64) and len(file.md5) in (0, 32)
            assert bool(file.sha256 or file.md5) == (file.origin != "unknown") == bool(file.checksum_source)


def test_the_command_fetches_from_a_mirror_and_verifies(server, tmp_path, capsys):
    server.behaviour.body = b"KPL/PCK\n"
    mirror = f"http://127.0.0.1:{server.server_address[1]}/copies"
    # The mirror's file has another size than the registry says: refused, and said in one line.
    there = f"--mirror {mirror} --to {tmp_path}"
    assert run(f"data fetch constants {there}".split()) == 2
    assert "expected 126143 octets, found 8" in capsys.readouterr().err
    assert run(f"data fetch grgm660prim {there} --json".split()) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert files == [{"path": "gravity/gggrx_0660pm_sha.tab", "status": "fetched", "octets": 8}]
    assert run(f"data verify --to {tmp_path} --json".split()) == 0
    assert json.loads(capsys.readouterr().out)["whole"] == 1
    (tmp_path / files[0]["path"]).write_bytes(b"KPL/PCX\n")
    assert run(f"data verify --to {tmp_path}".split()) == 1


def test_the_command_lists_and_refuses_unknown_names(tmp_path, capsys):
    assert run(f"data list --to {tmp_path} --json".split()) == 0
    listed = json.loads(capsys.readouterr().out)["products"]
    assert {"robbins2018", "sldem2015", "gld100", "wac-mosaic", "grgm660prim"} <= {p["name"] for p in listed}
    for name in ("moonstone", "lu1319381"):
        assert run(f"data fetch {name} --to {tmp_path}".split()) == 2
    assert "address of the file unknown" in capsys.readouterr().err
