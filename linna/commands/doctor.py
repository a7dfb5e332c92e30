"""`linna doctor`: check a deployment from one of its processes."""

import argparse

from linna.commands._ground import add_service_options, settings_of
from linna.data import data_folder
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check schema, processes, clocks, recurring work, broker, archive, files, provider and channels. "
        "Run it with the settings of the service, for example in a container of it. Exit status 1: something is wrong."
    )
    add_service_options(parser)
    add_json_flag(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.ground import ground_from_settings
    from ground_service.worker.doctor import examine

    settings = settings_of(arguments, data=data_folder().root)
    with ground_from_settings(settings) as ground:
        checks = examine(ground, settings)
    broken = [one.name for one in checks if not one.ok]
    lines = [f"{'ok   ' if one.ok else 'FAULT'} {one.name}: {one.found}" for one in checks]
    verdict = "broken" if broken else "healthy"
    figures = {"checks": [one.model_dump() for one in checks], "verdict": verdict}
    emit(arguments, figures, text="\n".join([*lines, verdict]))
    return 1 if broken else 0
