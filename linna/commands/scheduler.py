"""`linna scheduler`: recurring work of a distributed ground service."""

import argparse

from linna.commands._ground import add_service_options, event_of_signals, settings_of
from linna.data import data_folder
from linna.output import checked
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Enter the nightly job and the jobs of the plan, send lost jobs again, and note overdue telecommands. "
        "One process of a deployment does this, by a lease in the database; each API process takes part as well."
    )
    option(parser, "--check", bool, "exit 0 if a process of the deployment has the lease, otherwise 1")
    add_service_options(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    import logging.config

    from ground_service.ground import ground_from_settings
    from ground_service.logs import logging_config
    from ground_service.missions.clocks import mission_clock
    from ground_service.worker.condition import present
    from ground_service.worker.dispatch import dispatcher_for
    from ground_service.worker.follow_up import follow_in_process
    from ground_service.worker.scheduler import Scheduler, has_scheduler

    settings = settings_of(arguments, data=data_folder().root)
    with ground_from_settings(settings) as ground:
        if arguments.check:
            return checked(has_scheduler(ground), "a process with the lease of the recurring work")
        logging.config.dictConfig(logging_config(settings.log_format))
        stopping = event_of_signals()
        dispatcher = dispatcher_for(ground, settings)
        follow_up = follow_in_process(ground, dispatcher.start)
        try:
            scheduler = Scheduler(ground, dispatcher, follow_up.drain, settings.kept, plan_hourly=settings.plan_hourly)
            with present(ground, settings, "scheduler"), mission_clock(ground):
                scheduler.run(stopping, first_s=0.0)
        finally:
            dispatcher.close()
    return 0
