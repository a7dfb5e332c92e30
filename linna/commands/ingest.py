"""`linna ingest`: ingest of downlink files and pass archives."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.commands._ground import add_operator_options, ground_client, settings_of
from linna.output import emit, finish, log
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "files FILE", Path, "downlink file or pass archive folder", nargs="*")
    option(parser, "--watch DIR", Path, "ingest the files that appear in a folder")
    option(parser, "--follow", bool, "with --watch: continue to watch until Ctrl-C")
    option(
        parser,
        "--spacecraft-id N",
        int,
        "spacecraft of the files, 0 to 1023; required for packets without frames",
    )
    option(parser, "--instance", str, "instance of the spacecraft", "flight")
    option(
        parser,
        "--recording --stream NAME",
        str,
        "name of the recording of which the files are consecutive pieces (default: each file is a recording)",
        dest="recording",
    )
    option(parser, "--offset N", int, "offset of the first file in the recording, octets (default: 0)")
    option(
        parser, "--station NAME", str, "station that received the files, as in the mission description", ""
    )
    option(
        parser,
        "--link SETTINGS",
        str,
        "link settings, used without evidence, such as frame_length=1115,coding=rs,randomiser=legacy,"
        "checksum=true (default: mission description, last good settings, or the evidence of the file)",
    )
    add_operator_options(parser)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.client.problems import InvalidRequest, JobFailed, Unavailable, Unreachable
    from ground_service.errors import InvalidInput, StoreError

    _check(arguments)
    done: list[dict[str, Any]] = []
    offset = arguments.offset or 0
    with ground_client(arguments) as service:

        def ingest(path: Path, offset: int = 0) -> dict[str, Any]:
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
                "symbols_corrected",
            )  # fmt: skip
            assert made.accounting is not None
            figures = made.accounting.model_dump(include=set(kept))
            return {"file": str(path), "ingest_id": made.id, **figures}

        def ingest_watched(path: Path) -> dict[str, Any]:
            try:
                return ingest(path)
            except (Unreachable, Unavailable) as error:  # no fault of the file, which remains to be ingested
                raise StoreError(str(error)) from None

        def report(path: Path, result: Any) -> None:
            one = result if isinstance(result, dict) else {"file": str(path), "error": str(result)}
            done.append(one)
            log(_line(one))

        if arguments.watch is not None:
            _watch(arguments, ingest_watched, report)
        else:
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
    if arguments.files:
        emit(arguments, {"ingested": done}, text="\n".join(_line(one) for one in done))
        return 2 if any("error" in one for one in done) else 0
    else:
        figures = _totals(done)
        text = f"{figures['packets']} packets, {figures['packets_new']} new, in {figures['ingests']} ingests"
        emit(arguments, {**figures, "ingested": done}, text=text)
    return 0


def _check(arguments: argparse.Namespace) -> None:
    from linna.errors import UsageError

    if arguments.spacecraft_id is not None and not 0 <= arguments.spacecraft_id <= 1023:
        raise UsageError(f"--spacecraft-id: expected 0 to 1023, found {arguments.spacecraft_id}")
    if bool(arguments.files) == (arguments.watch is not None):
        raise UsageError("ingest: expected either FILE... or --watch")
    if arguments.offset is not None and (arguments.recording is None or arguments.offset < 0):
        raise UsageError(
            f"--offset: expected octets from the beginning of --recording, found {arguments.offset}"
        )
    if arguments.recording is not None and not arguments.files:
        raise UsageError("--recording: expected the files of the recording, found none")


def _watch(arguments: argparse.Namespace, ingest: Any, report: Any) -> None:
    import hashlib
    import time

    from ground_service.ingest.live import SETTLED_S, WatchedFolder

    folder = arguments.watch.resolve()
    name = hashlib.sha256(str(folder).encode()).hexdigest()[:16]
    watched = WatchedFolder(folder, settings_of(arguments).home / "watched" / f"{name}.json", ingest, report)
    try:
        watched.look(time.time())
        while arguments.follow:
            time.sleep(SETTLED_S / 2.0)
            watched.look(time.time())
    except KeyboardInterrupt:
        pass


def _totals(done: list[dict[str, Any]]) -> dict[str, int]:
    names = ("packets", "packets_new", "crc_errors", "octets_skipped", "frames_bad")
    return {"ingests": len(done), **{name: sum(one.get(name, 0) for one in done) for name in names}}


def _line(one: dict[str, Any]) -> str:
    if "error" in one:
        return f"{one['file']}: {one['error']}"
    if "pass_id" in one:
        return f"{one['file']}: pass {one['pass_id']}"
    line = (
        f"{one['file']}: {one['packets']} packets, {one['packets_new']} new, {one['crc_errors']} damaged, "
        f"{one['frames_bad']} bad frames, {one['octets_skipped']} octets skipped"
    )
    if one["octets_pending"]:
        line += (
            f"; {one['octets_pending']} octets of an incomplete frame or packet at the ends "
            "(--recording NAME FILE... names the files of one recording in order)"
        )
    return line
