"""`linna ingest`: downlink files and pass archives into the ground database."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.commands._ground import add_service_options, open_service
from linna.output import add_json_flag, emit, log


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help="downlink file or pass archive folder"
    )
    parser.add_argument(
        "--spacecraft-id",
        type=int,
        metavar="N",
        help="whose the files are; needed for bare packets, 0 to 1023",
    )
    parser.add_argument("--instance", default="flight", help="instance of the spacecraft (default: flight)")
    add_service_options(parser)
    add_json_flag(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.services.archive_import import import_archive
    from ground_service.services.ingest import ingest_file

    if arguments.spacecraft_id is not None and not 0 <= arguments.spacecraft_id <= 1023:
        from linna.errors import UsageError

        raise UsageError(f"--spacecraft-id: expected 0 to 1023, found {arguments.spacecraft_id}")
    done: list[dict[str, Any]] = []
    with open_service(arguments) as ground:
        for path in arguments.files:
            log(f"ingesting {path} ...")
            if path.is_dir():
                done.append({"file": str(path), "pass_id": import_archive(ground, path)})
                continue
            result = ingest_file(
                ground, path, spacecraft_id=arguments.spacecraft_id, instance=arguments.instance
            )
            done.append(
                {
                    "file": str(path),
                    "ingest_id": result.ingest_id,
                    "packets": result.packets,
                    "packets_new": result.packets_new,
                    "crc_errors": result.crc_errors,
                    "octets_skipped": result.octets_skipped,
                    "frames_bad": result.frames_bad,
                    "symbols_corrected": result.symbols_corrected,
                }
            )
    emit(arguments, {"ingested": done}, text="\n".join(_line(one) for one in done))
    return 0


def _line(one: dict[str, Any]) -> str:
    if "pass_id" in one:
        return f"{one['file']}: pass {one['pass_id']}"
    return (
        f"{one['file']}: {one['packets']} packets, {one['packets_new']} new, {one['crc_errors']} damaged, "
        f"{one['frames_bad']} bad frames, {one['octets_skipped']} octets skipped"
    )
