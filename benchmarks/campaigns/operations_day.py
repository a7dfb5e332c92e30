"""Campaign of a day of operations with a live payload: plan, uplink, execution, downlink, ingest, report.

    python -m benchmarks.campaigns.operations_day [SCENARIO] [--minutes M] [--distributed] [--json]

Starts the ground service (SQLite; `--distributed`: PostgreSQL with a database role that owns nothing, Redis, two API
processes and two workers) and `linna emulate SCENARIO --live --no-operator` on private ports, works as two operators
would, with `linna` and over HTTP, and prints what was typed and what was answered. Ann enters the window and a critical
telecommand, Bob approves and releases them. Nothing commands the payload but the ground. Exit status 1 where the day
does not end as planned: window processed, every telecommand completed, no packet lost, requests refused that have to be
(no token, another name of the service, a page of another origin, a release by the person who entered it), and every
change in the audit log, whose chain is whole.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import os
import signal
import socket
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.campaigns._deployment import Deployment, Laptop, wait_until
from ground_service.access.model import AuditFilter
from ground_service.access.service import add_user
from ground_service.access.store import list_audit
from ground_service.client import Client
from ground_service.ground import Ground, open_ground
from ground_service.worker.integrity import verify
from linna.cli import run
from lunar.timescales import format_utc, parse_utc
from payload_emulator.session.scenario import load_scenario
from payload_emulator.session.spacecraft import SPACECRAFT_ID
from studies.harness.parts import Part, free_port, listens

NS = 1_000_000_000
DAY_NS = 86_400 * NS
LEAD_S = 300
"""From the payload's first moment to the first planned one: time for the telecommands to take effect."""

AFTER_S = 90
SLOW_RATE = 3
"""While the operators look; a pause would make the payload's odometries start again."""
PATIENCE_S = 120.0


@dataclass(slots=True)
class Transcript:
    """Operator inputs and the responses to them."""

    where: list[str]
    tokens: dict[str, str]
    echo: bool = True
    lines: list[str] = field(default_factory=list)

    def say(self, text: str) -> None:
        self.lines.append(text)
        if self.echo:
            print(text, flush=True)

    def linna(self, *words: object, by: str = "ann", refused: bool = False) -> None:
        """Run one operator command with the server; `refused` if it must be refused."""
        typed = [str(word) for word in words]
        self.say(f"{by} $ linna " + " ".join(typed))
        os.environ["LINNA_TOKEN"] = self.tokens[by]
        printed, told = io.StringIO(), io.StringIO()
        remote = [] if typed[0] == "orbit" or typed[:2] == ["mission", "write"] else self.where
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(told):
            code = run([*typed, *remote])
        del os.environ["LINNA_TOKEN"]
        for line in printed.getvalue().rstrip().splitlines():
            self.say(f"  {line}")
        if refused and code:
            self.say(f"  {told.getvalue().strip()}")
        elif code or refused:
            raise SystemExit(f"linna {' '.join(typed)}: exit status {code}: {told.getvalue().strip()}")


OPERATIONS = "[automation]\nevaluate = true\n"
"""Windows and critical telecommands need a second person, as without a statement of the mission."""


class Payload:
    """`linna emulate --live --no-operator`, watched on its console."""

    def __init__(self, scenario: str, folder: Path) -> None:
        self.mission, telemetry, telecommands, console = (free_port() for _ in range(4))
        (folder / "operations.toml").write_text(OPERATIONS)
        words = [scenario, "--live", "--no-operator", "--paused", "--rate", "0", "--port", telemetry]
        words += ["--tc-port", telecommands, "--console-port", console, "--mission-port", self.mission]
        words += ["--operations", folder / "operations.toml"]
        command = [sys.executable, "-m", "linna", "emulate", *map(str, words)]
        self._part = Part(command, folder / "payload.log", lambda: listens(console), 1)
        self._part.start()
        self._console = socket.create_connection(("127.0.0.1", console), timeout=PATIENCE_S)
        self._messages = self._console.makefile("r")
        self.order("watch")

    def mission_text(self) -> bytes:
        """Return the mission description with the links to the stations."""
        with socket.create_connection(("127.0.0.1", self.mission), timeout=PATIENCE_S) as connection:
            return connection.makefile("rb").read()

    def order(self, word: str) -> None:
        """A word to the console."""
        self._console.sendall(word.encode() + b"\n")

    def fly(self, until_utc_ns: int | None = None) -> tuple[int, str]:
        """Go on until a time, and slowly from then on (one moment without a time); the payload's time and mode."""
        for word in ["step"] if until_utc_ns is None else ["rate 0", "run"]:
            self.order(word)
        for line in self._messages:
            message = json.loads(line)
            if "utc" not in message:
                continue
            now = parse_utc(message["utc"])
            if until_utc_ns is None or now >= until_utc_ns:
                if until_utc_ns is not None:
                    self.order(f"rate {SLOW_RATE}")
                return now, str(message["mode"])
        raise SystemExit("the payload's console ended")

    def stop(self) -> None:
        self._console.close()
        self._part.end(signal.SIGTERM)


def rehearse(
    scenario: str, folder: Path, *, distributed: bool, minutes: float, echo: bool
) -> tuple[list[str], dict[str, Any]]:
    """Do it; the transcript, and how it ended."""
    started = time.monotonic()
    service = Deployment(folder, apis=2) if distributed else Laptop(folder)
    payload: Payload | None = None
    try:
        with open_ground(service.home, database_url=service.url) as ground:
            tokens = {name: add_user(ground, name, "operator") for name in ("ann", "bob")}
            tokens["eve"] = add_user(ground, "eve", "admin")
        desk = Transcript(["--server", service.api], tokens, echo)
        desk.say(f"# processes: payload, {', '.join(service.parts)}; users: {', '.join(tokens)}")
        refusals = [refuse_strangers(desk, api) for api in service.apis]
        payload = Payload(scenario, folder)
        now, mode = payload.fly()
        desk.say(
            f"# the payload is alive at {format_utc(now)[:19]}Z, mode {mode}; telemetry and telecommands over TCP"
        )
        with Client(service.apis[-1], tokens["bob"]) as api:
            (folder / "mission.toml").write_bytes(payload.mission_text())
            desk.linna("mission", "add", folder / "mission.toml", by="eve")
            for state in ("connected", "contact"):
                wait_until(
                    lambda wanted=state: {one.state for one in api.list_links()} == {wanted},
                    f"link: {state}",
                    PATIENCE_S,
                )
                now, _ = payload.fly()
            window = plan(desk, api, scenario, folder, now, minutes)
            execute(desk, api, payload, window)
            payload.stop()
            figures = evaluate(desk, api, window, folder)
        with open_ground(service.home, database_url=service.url) as ground:
            figures |= look_at_audit(desk, ground)
        figures["refused"] = sorted({status for one in refusals for status in one})
    finally:
        if payload is not None:
            payload.stop()
        service.stop()
    figures |= {"distributed": distributed, "scenario": scenario, "wall_s": round(time.monotonic() - started)}
    return desk.lines, figures


def refuse_strangers(desk: Transcript, api: str) -> list[int]:
    """Send requests without a token, with another host name, and from a page of another origin."""
    own = {"Authorization": f"Bearer {desk.tokens['bob']}"}
    asked: tuple[tuple[str, str, dict[str, str]], ...] = (
        ("GET", "/api/v1/windows", {}),
        ("GET", "/api/v1/windows", {**own, "Host": "rebound.example"}),
        ("POST", "/api/v1/uplink?spacecraft_id=76", {**own, "Origin": "https://other.example"}),
    )
    answered = []
    for method, path, headers in asked:
        request = urllib.request.Request(f"{api}{path}", method=method, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                status = int(answer.status)
        except urllib.error.HTTPError as error:
            status = error.code
        told = ", ".join(f"{name}: {text}" for name, text in headers.items() if name != "Authorization")
        desk.say(f"# {method} {path} ({told or 'no token'}): {status}")
        answered.append(status)
    return answered


def look_at_audit(desk: Transcript, ground: Ground) -> dict[str, Any]:
    """Return the audit summary of the day, and whether its chain and the rows are undamaged."""
    page = ground.read(list_audit, AuditFilter(limit=1000))
    entries, total = page.items, page.total
    for (action, actor), count in sorted(Counter((one.action, one.actor) for one in entries).items()):
        desk.say(f"# audit: {actor} {action} {count}")
    result = verify(ground, rebuild=True)
    desk.say(f"# verify: {result.verdict}, audit head {result.audit_head}")
    return {"audit_entries": total, "verify": result.verdict}


def plan(desk: Transcript, api: Client, scenario: str, folder: Path, now_utc_ns: int, minutes: float) -> int:
    """Add reference ephemeris, window, approval and telecommands; return the window."""
    given = load_scenario(scenario)
    start = now_utc_ns + LEAD_S * NS
    stop = start + round(minutes * 60) * NS
    epoch = parse_utc(given.orbit.epoch)
    days = math.ceil(10 * ((stop + 3600 * NS - epoch) / DAY_NS)) / 10
    reference = folder / "reference.oem"
    desk.linna("orbit", "propagate", scenario, "--days", days, "--step", 60, "--out", reference)
    desk.linna("plan", "ephemeris", reference)
    desk.linna(
        "plan",
        "search",
        "--start",
        format_utc(start),
        "--stop",
        format_utc(stop),
        "--step-s",
        10,
        "--minimum-duration-s",
        60,
        "--maximum-duration-s",
        round(minutes * 60),
    )
    desk.linna(
        "plan",
        "add",
        "--start",
        format_utc(start),
        "--stop",
        format_utc(stop),
        "--spacecraft-id",
        SPACECRAFT_ID,
        "--name",
        "observation of the day",
    )
    window = api.list_windows().page(1).items[0].id
    desk.linna("plan", "approve", window, by="bob")
    desk.linna("plan", "uplink", window, by="bob")
    desk.linna("command", "enter", "disable_event", "event_id=3", "--spacecraft-id", SPACECRAFT_ID)
    critical = api.list_telecommands().page(1).items[0].id
    desk.linna("command", "release", critical, refused=True)
    desk.linna("command", "release", critical, by="bob")
    return window


def execute(desk: Transcript, api: Client, payload: Payload, window: int) -> None:
    """Fly the payload through the window; the link sends it telecommands and receives its telemetry."""
    planned = api.get_window(window)
    start, stop = parse_utc(str(planned.start)), parse_utc(str(planned.stop))
    wait_until(lambda: not any(one.unsent for one in api.list_links()), "telecommands sent", PATIENCE_S)
    desk.linna("link", "list")
    for until, state in (((start + stop) // 2, "executing"), (stop + AFTER_S * NS, "downlinked")):
        now, mode = payload.fly(until)
        desk.say(f"# the payload at {format_utc(now)[:19]}Z: mode {mode}")

        def is_reached(wanted: str = state) -> bool:
            return bool(api.get_window(window).state == wanted)

        wait_until(
            is_reached,
            f"window {state}, found {api.get_window(window).state}",
            PATIENCE_S,
        )
        desk.linna("plan", "show", window)


def evaluate(desk: Transcript, api: Client, window: int, folder: Path) -> dict[str, Any]:
    """Verification of the telecommands, completeness, report; how the day ended."""
    desk.linna("command", "list")
    pass_id = api.get_window(window).pass_id
    assert pass_id is not None
    desk.linna("report", pass_id, "--out", folder / "report")
    desk.linna("plan", "show", window)
    desk.linna("pass", "show", pass_id)
    summary = api.evaluate_pass(pass_id)
    done = api.get_window(window)
    commands = Counter(one.state for one in api.list_telecommands())
    return {
        "window": done.state,
        "frames": summary.frames,
        "frames_planned": done.predicted.frames,
        "packets": summary.packets,
        "packets_lost": summary.packets_lost,
        "telecommands": dict(commands),
        "median_error_m": {name: row.median_3d_m for name, row in summary.navigation.items()},
        "report": sorted(path.name for path in (folder / "report").iterdir()),
    }


def went_well(figures: dict[str, Any]) -> bool:
    """Whether the day ended as planned."""
    return (
        figures["window"] == "processed"
        and figures["packets_lost"] == 0
        and set(figures["telecommands"]) == {"completed"}
        and figures["refused"] == [401, 403, 421]
        and figures["verify"] == "intact"
        and figures["frames"] == figures["frames_planned"]
        and any(median is not None for median in figures["median_error_m"].values())
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario", nargs="?", default="selenita")
    parser.add_argument("--minutes", type=float, default=5.0, help="length of the window (default: 5)")
    parser.add_argument(
        "--distributed", action="store_true", help="PostgreSQL, Redis, two APIs and two workers"
    )
    parser.add_argument("--json", action="store_true", help="the figures instead of the transcript")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    for name in [name for name in os.environ if name.startswith("LINNA_") and name != "LINNA_DATA"]:
        del os.environ[name]
    with tempfile.TemporaryDirectory() as name:
        _, figures = rehearse(
            given.scenario,
            Path(name),
            distributed=given.distributed,
            minutes=given.minutes,
            echo=not given.json,
        )
    print(json.dumps(figures, indent=2))
    return 0 if went_well(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
