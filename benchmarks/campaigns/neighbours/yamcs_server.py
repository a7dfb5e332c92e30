"""Yamcs as our ground system: started with what `linna tm yamcs` writes, receives a pass, commands the live payload.

It runs with the interpreter of this project; `NEIGHBOUR` names the one with the jars of Yamcs and a JDK.
"""

import contextlib
import json
import os
import subprocess
import sys
from functools import partial

import numpy as np
from _cells import run

from benchmarks._yamcs import ANSWER_S, START_S, Server, start, until
from studies.harness.parts import free_port, listens

STAGES = ["accepted", "completed", "started"]
SCENARIO = """name = "commanded"
title = "A payload that waits for telecommands"
seed = 1
dynamics = { degree = 20 }
window = { search = "none", start = "2029-08-07T01:40:00Z", duration_s = 900.0 }
camera = { images = "reduced" }
terrain = { source = "procedural" }
navigation = { estimators = ["spherical"] }
"""


TELECOMMANDS = """\
test_connection
enable_housekeeping "structure_id": 1
request_housekeeping "structure_id": 1
set_housekeeping_interval "structure_id": 1, "interval_s": 60
disable_housekeeping "structure_id": 1
create_housekeeping "structure_id": 16, "interval_s": 60, "count": 2, "items": "0001000c"
report_housekeeping_definition "structure_id": 16
delete_housekeeping "structure_id": 16
disable_event "event_id": "image_dark"
report_disabled_events
enable_event "event_id": "image_dark"
request_parameter "parameter_id": "temperature_high_c"
set_parameter "parameter_id": "temperature_high_c", "value": 55
set_time_report_rate "rate_exponent": 4
enable_schedule
insert_activity "release_ticks": %(ahead)d, %(activity)s
report_schedule
delete_activity "request_id": %(request)d
reset_schedule
disable_schedule
uplink_first "transaction": 7, "part": 1, "table": "burns", %(part_1)s
uplink_middle "transaction": 7, "part": 2, "table": "burns", %(part_2)s
uplink_last "transaction": 7, "part": 3, "table": "burns", %(part_3)s
report_store
replay_store "start_ticks": 0, "stop_ticks": %(now)d
delete_store "stop_ticks": 1
perform_function "function_id": "check_tables", "argument_1": 0, "argument_2": 0"""


def _linna(*arguments):
    return [sys.executable, "-m", "linna", *map(str, arguments)]


def _is_linked(server):
    return server.get("/links/linna/telecommands")["status"] == "OK"


def _by_count(records):
    return {f"{one['packet']} {one['SRC_SEQ_CTR']}": one for one in records}


def receive_pass(cells, server, frame_port):
    """Send the frames of the pass and return all values of all packets."""
    command = _linna("tm", "frames", cells.sample("downlink.cadu"), "--to", f"127.0.0.1:{frame_port}")
    subprocess.run(command, check=True, stdout=sys.stderr)
    number = len(cells.expected["packets"])
    until(lambda: len(server.packets()) >= number, ANSWER_S, f"{number} packets in the archive")
    return _by_count(map(server.values, server.packets()))


def _telecommands(now_ticks):
    """Return all telecommands with arguments that the payload carries out."""
    from tmtc.dictionary.payload import DICTIONARY
    from tmtc.dictionary.tables import BurnTable, pack_burn_table

    ahead = now_ticks + (86_400 << 16)
    inner = DICTIONARY.pack_command("test_connection", {}, sequence_count=9000, source=1)
    table = pack_burn_table(BurnTable(np.array([ahead]), np.zeros((1, 3)), np.ones(1)))

    ends = (20, 40, len(table))
    parts = {f"part_{k}": table[a:b] for k, (a, b) in enumerate(zip((0, *ends), ends, strict=False), 1)}
    given = {"ahead": ahead, "now": now_ticks, "request": int.from_bytes(inner[:4], "big")}
    for name, octets in {**parts, "activity": inner}.items():
        given[name] = f'"count": {len(octets)}, "items": "{octets.hex()}"'
    lines = (line.partition(" ") for line in (TELECOMMANDS % given).splitlines())
    return {name: json.loads(f"{{{arguments}}}") for name, _, arguments in lines}


def command_payload(cells, server, frame_port, telemetry, telecommands, console, mission):
    """Send each telecommand to the live payload and return the stages that its verification reports state."""
    (cells.out / "live.toml").write_text(SCENARIO)
    options = ["--port", telemetry, "--tc-port", telecommands, "--console-port", console, "--mission-port", mission]
    before = set(server.packets())
    reports = [f"/LINNA/verification_{stage}" for stage in STAGES]

    def fresh(*names):
        return [one for one in server.packets(*names) if one not in before]

    with contextlib.ExitStack() as stack:
        start(
            stack,
            _linna("emulate", cells.out / "live.toml", "--live", "--no-operator", "--rate", 60, *options),
            cells.out / "live.log",
        )
        until(lambda: listens(console), START_S, "the live payload")
        frames = _linna("tm", "frames", f"127.0.0.1:{telemetry}", "--to", f"127.0.0.1:{frame_port}")
        start(stack, frames, cells.out / "frames.log")
        until(lambda: fresh("/LINNA/housekeeping"), ANSWER_S, "telemetry of the live payload")
        until(partial(_is_linked, server), ANSWER_S, "the link of telecommands")
        now = max(server.values(one)["TIME_COARSE"] for one in fresh("/LINNA/housekeeping")) << 16
        sent = {name: server.issue(name, arguments) for name, arguments in _telecommands(now).items()}
        (cells.out / "telecommands.json").write_text(json.dumps([octets.hex() for octets in sent.values()]))
        with contextlib.suppress(TimeoutError):
            until(lambda: len(fresh(*reports)) >= 3 * len(sent), ANSWER_S, "the verification of all")
        stages = {name: [] for name in sent}
        names = {int.from_bytes(octets[:4], "big"): name for name, octets in sent.items()}
        for one in map(server.values, fresh(*reports)):
            name = names.get(one[f"{one['packet']}_request_id"])
            if name:
                stages[name].append(one["packet"].removeprefix("verification_"))
        return {name: sorted(found) for name, found in stages.items()}


def yamcs(cells):
    http, frames, telemetry, telecommands, console, mission = (free_port() for _ in range(6))
    folder, names = cells.out / "instance", list(_telecommands(0))
    options = ("--frame-port", frames, "--station", f"127.0.0.1:{telecommands}")
    subprocess.run(_linna("tm", "yamcs", "--out", folder, *options), check=True)
    with contextlib.ExitStack() as stack:
        server = Server(stack, folder, http, os.environ["NEIGHBOUR"])
        right = _by_count(cells.expected["packets"])
        cells.reads("frames and XTCE, all values of a pass", right, lambda: receive_pass(cells, server, frames))
        cells.reads(
            "27 telecommands of XTCE, verified by the live payload",
            dict.fromkeys(names, STAGES),
            lambda: command_payload(cells, server, frames, telemetry, telecommands, console, mission),
        )
    cells.writes("telecommand packets", "telecommands.json", "telecommands", lambda _: names)


run(globals())
