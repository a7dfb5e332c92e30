"""`linna ingest`: ingest of downlink files and pass archives."""

import argparse
from pathlib import Path
from typing import Any

from linna.commands._ground import add_operator_options, ground_client
from linna.errors import UsageError
from linna.output import emit, finish, log
from linna.parser import number, option


def configure_ingest(parser: argparse.ArgumentParser) -> None:
    option(parser, "files FILE", Path, "downlink file or pass archive folder", nargs="+")
    option(
        parser,
        "--spacecraft-id N",
        number(int, least=0, most=1023),
        "spacecraft of the files, 0 to 1023; required for packets without frames",
    )
    option(parser, "--instance", str, "instance of the spacecraft", "flight")
    option(
        parser,
        "--recording NAME",
        str,
        "name of the recording of which the files are consecutive pieces (default: each file is a recording)",
    )
    option(parser, "--offset N", number(int, least=0), "offset of the first file in the recording, octets (default: 0)")
    option(parser, "--station NAME", str, "station that received the files, as in the mission description", "")
    option(
        parser,
        "--link SETTINGS",
        str,
        "link settings, such as frame_length=1115,coding=rs,randomiser=legacy,checksum=true "
        "(default: those of the mission description)",
    )
    add_operator_options(parser)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.client.connection import InvalidRequest, JobFailed
    from ground_service.errors import InvalidInput

    if arguments.offset is not None and arguments.recording is None:
        raise UsageError("--offset: expected --recording NAME with it, found none")
    done: list[dict[str, Any]] = []
    offset = arguments.offset or 0
    with ground_client(arguments) as service:

        def ingest(path: Path, offset: int) -> dict[str, Any]:
            if path.is_dir():
                return {"file": str(path), "pass_id": service.import_archive(path)}
            made = service.ingest_file(
                path,
                spacecraft_id=arguments.spacecraft_id,
                instance=arguments.instance,
                stream=arguments.recording,
                offset=None if arguments.recording is None else offset,
                station=arguments.station,
                link=arguments.link,
            )
            kept = (
                "packets", "packets_new", "crc_errors", "octets_skipped", "octets_pending", "frames_bad",
                "symbols_corrected", "packets_implausible", "remark",
            )  # fmt: skip
            assert made.accounting is not None
            figures = made.accounting.model_dump(include=set(kept))
            return {"file": str(path), "ingest_id": made.id, **figures}

        for path in arguments.files:
            log(f"ingesting {path} ...")
            try:
                done.append(ingest(path, offset))
            except (InvalidInput, InvalidRequest, JobFailed) as error:
                if len(arguments.files) == 1:
                    raise
                log(str(error))
                done.append({"file": str(path), "error": str(error)})
            if arguments.recording is not None and path.is_file():
                offset += path.stat().st_size
    emit(arguments, {"ingested": done}, text="\n".join(_line(one) for one in done))
    return 2 if any("error" in one for one in done) else 0


def _line(one: dict[str, Any]) -> str:
    if "error" in one:
        return f"{one['file']}: {one['error']}"
    if "pass_id" in one:
        return f"{one['file']}: pass {one['pass_id']}"
    line = (
        f"{one['file']}: {one['packets']} packets, {one['packets_new']} new, {one['crc_errors']} damaged, "
        f"{one['frames_bad']} bad frames, {one['octets_skipped']} octets skipped"
    )
    if one["remark"]:
        line += f"; {one['remark']}"
    if one["packets_implausible"]:
        line += (
            f"; {one['packets_implausible']} packets with an implausible on-board time are kept apart and not used "
            "(linna correlate implausible)"
        )
    if one["octets_pending"]:
        line += (
            f"; {one['octets_pending']} octets of an incomplete frame or packet at the ends "
            "(--recording NAME FILE... names the files of one recording in order)"
        )
    return line
