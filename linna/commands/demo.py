"""`linna demo`: one observation window from the orbit to the report, or a spacecraft that flies on."""

import argparse
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from linna.commands._ground import event_of_signals, local_actor
from linna.commands.results import requirement_lines
from linna.data import data_folder
from linna.output import emit, finish, log, progress, watched_rims
from linna.parser import option

KERNELS = (
    (
        "payload_emulator.sim.terrain.kernels",
        *(f"payload_emulator.sim.render._{part}_kernel" for part in ("grid", "trace", "shade", "sensor")),
    ),
    (
        "payload_emulator.flight.navigation.filter._dynamics_kernel",
        "tmtc.packets._cutting",
        *(f"tmtc.link.{part}" for part in ("_rs_kernel", "_markers")),
        "lunar._dynamics_kernel",
    ),
)
"""Modules of kernels that are compiled at the same time, while the orbit is propagated."""


def configure_demo(parser: argparse.ArgumentParser) -> None:
    option(
        parser, "--out DIR", Path, "folder for the pass archive, the ground database and the report", Path("linna-demo")
    )
    option(parser, "--scenario", str, "scenario file or name (default: selenita; live: live-demo)")
    option(parser, "--seed", int, "another seed than the scenario's")
    option(parser, "--live", bool, "fly and operate a spacecraft until Ctrl-C, with the pages of the service")
    option(parser, "--rate R", float, "live: simulated seconds per second", 60.0)
    option(parser, "--port P", int, "live: port of the service", 8042)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.client.local import local_client
    from ground_service.ground import open_ground
    from kernels.compiled import compiling_ahead
    from payload_emulator.session.archive.emulator import emulate
    from payload_emulator.session.scenario import load_scenario

    started = time.monotonic()
    data = data_folder()
    chosen = arguments.scenario or ("live-demo" if arguments.live else "selenita")
    scenario = load_scenario(chosen).with_choices(seed=arguments.seed)
    if arguments.live:
        from studies.mission_run.living import living_demo

        stopping = event_of_signals()
        living_demo(scenario, data, arguments.out, arguments.rate, arguments.port, log, stopping, watched_rims)
        return 0
    archive = arguments.out / "pass"
    log("emulating the payload ...")
    with compiling_ahead(KERNELS, log) as wait:

        def frames(items: Iterable[Any], total: int) -> Iterator[Any]:
            wait()
            return progress(items, total, "frames", "frame")

        emulated = emulate(scenario, data, archive, frames_kept=8, progress=frames)
    log("ingesting the downlink, aligning, reporting ...")
    home = arguments.out / "ground"
    with local_client(open_ground(home, data), local_actor()) as service:
        pass_id = service.import_archive(archive)
        summary = service.get_report_summary(service.make_report(pass_id))
        spacecraft_id = service.get_pass(pass_id).spacecraft_id
    figures = {
        "report": str(home.absolute() / "reports" / f"pass-{pass_id}" / "report.html"),
        "archive": str(archive),
        "pass_id": pass_id,
        "spacecraft_id": spacecraft_id,
        "frames": emulated["frames"],
        **summary.model_dump(mode="json"),
        "wall_s": round(time.monotonic() - started, 2),
        "data": emulated["data"],
    }
    return emit(
        arguments, figures, text=describe(figures) + "\n\nnext steps:\n" + "\n".join(next_steps(arguments, figures))
    )


def next_steps(arguments: argparse.Namespace, figures: dict[str, Any]) -> list[str]:
    """The rest of the tour with the result of this run: serve, plan, send, report."""
    import shutil
    import sys

    linna = "linna" if shutil.which("linna") else sys.argv[0]
    home = arguments.out / "ground"
    spacecraft, day = figures["spacecraft_id"], "2029-08-20"
    steps = (
        (f"serve --home {home}", "pages at http://127.0.0.1:8042/, Ctrl-C ends"),
        (
            f"plan add --home {home} --spacecraft-id {spacecraft} --start {day}T01:00:00Z --stop {day}T01:20:00Z "
            "--approve",
            "plan an observation window",
        ),
        (f"plan uplink 1 --home {home} --out {arguments.out / 'window.cltu'}", "send its telecommands to a file"),
        (f"report {figures['pass_id']} --home {home} --out {arguments.out / 'report'}", "report as HTML, PDF, JSON"),
    )
    return [f"  # {purpose}\n  {linna} {command}" for command, purpose in steps]


def describe(figures: dict[str, Any]) -> str:
    """The short table at the end of the demo."""
    detector = figures["detector"]
    lines = [
        "",
        f"pass {figures['pass_id']}: {figures['frames']} frames, {figures['packets']} packets, "
        f"{figures['packets_lost']} lost",
        f"detector, 5-30 km against the catalogue: precision {_number(detector['precision'], '.2f')}, "
        f"recall {_number(detector['recall'], '.2f')}, localisation {_number(detector['loc_px'], '.2f')} px",
        "",
        f"{'navigation':<28}{'median':>10}{'p95':>10}{'max':>10}{'drift':>10}",
        f"{'':<28}{'m':>10}{'m':>10}{'m':>10}{'% of path':>10}",
    ]
    for name, row in {**figures["navigation"], **figures["smoothed"]}.items():
        lines.append(
            f"{name:<28}{_number(row['median_3d_m'], '.0f'):>10}{_number(row['p95_3d_m'], '.0f'):>10}"
            f"{_number(row['max_3d_m'], '.0f'):>10}{_number(row['drift_percent'], '.3f'):>10}"
        )
    lines += ["", figures["verdict"], *requirement_lines(figures.get("requirements") or [])]
    lines += [
        "",
        f"evidence: level {figures['evidence_level'] or 'not stated'}",
        f"data: {'; '.join(figures['data'])}",
        f"{figures['wall_s']:.1f} s",
        f"report: {figures['report']}",
        f"fly this pass again, with any build: linna replay {figures['archive']} --out DIR [--build BUILD]",
    ]
    return "\n".join(lines)


def _number(value: float | None, layout: str) -> str:
    return "-" if value is None or value != value else format(value, layout)
