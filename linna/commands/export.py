"""`linna export PASS --format F --out F`: a pass in the formats of other tools."""

import argparse
import tempfile
import zipfile
from pathlib import Path

from linna.commands._ground import add_operator_options, ground_client
from linna.errors import UsageError
from linna.output import emit, finish, log
from linna.parser import RawFormatter, option


def configure(parser: argparse.ArgumentParser) -> None:
    from ground_service.exports.model import FORMATS, REFERENCE

    parser.formatter_class = RawFormatter
    parser.epilog = "formats:\n" + "\n".join(f"  {one.name:<8} {one.description}" for one in FORMATS.values())
    option(parser, "pass_id PASS", int, "number of the pass (see linna pass list)")
    option(parser, "--format FORMAT", FORMATS, "one of the list below", required=True)
    option(
        parser,
        "--out F",
        Path,
        "file to write; for formats of several files a folder, or a name ending in .zip",
        required=True,
    )
    option(
        parser,
        "--states NAME",
        str,
        f"states of orbits and maps: {REFERENCE} (default), or the name of an estimator",
        default=REFERENCE,
    )
    option(parser, "--version V", ("1.0", "2.0"), "version of a CCSDS AEM", "2.0")
    add_operator_options(parser)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.exports.model import FORMATS

    out: Path = arguments.out
    unpacked = FORMATS[arguments.format].several_files and out.suffix.lower() != ".zip"
    if out.exists() and out.is_dir() != unpacked:
        expected, found = ("a folder", "a file") if unpacked else ("a file", "a folder")
        raise UsageError(f"--out: expected {expected} for {arguments.format}, found {found} {str(out)!r}")
    log(f"exporting pass {arguments.pass_id} as {arguments.format} ...")
    with ground_client(arguments) as service, tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "export.zip" if unpacked else out
        service.export_pass(
            arguments.pass_id, arguments.format, target, states=arguments.states, version=arguments.version
        )
        files = _unpack(target, out) if unpacked else [out]
    figures = {
        "pass_id": arguments.pass_id,
        "format": arguments.format,
        "files": [str(file) for file in files],
        "octets": sum(file.stat().st_size for file in files),
    }
    return emit(arguments, figures, text="\n".join(figures["files"]))


def _unpack(archive: Path, folder: Path) -> list[Path]:
    """Write the files of an archive into a folder, under their plain names."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with zipfile.ZipFile(archive) as opened:
        for entry in opened.infolist():
            path = folder / Path(entry.filename).name
            path.write_bytes(opened.read(entry))
            written.append(path)
    return written
