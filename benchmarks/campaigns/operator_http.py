"""An operator's hour by HTTP: from an empty folder to a report with the tutorial alone, then a shift with mistakes.

`python -m benchmarks.campaigns.operator_http [RATE]`: the commands of `tutorials/first-spacecraft.md` as printed, at 20
times real time, then telecommands, a window that is taken back, and requests that a service must refuse. The exit
status is 1 if there was a wrong turn of the classes A or B, or the report took more than `LIMIT_S` on a free machine.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

from benchmarks.campaigns._strangers import Diary, commands_of, environment, is_loaded
from lunar.timescales import format_utc, parse_utc
from studies.harness.parts import descendants, free_port, kill_family

LIMIT_S = 360.0
STANDSTILL_S = 25.0
ON_BOARD = {"name": "test_connection", "spacecraft_id": 76}
CRITICAL = {"name": "perform_function", "spacecraft_id": 76, "arguments": {"function_id": "reboot"}}


def main(rate: float = 20.0) -> int:
    """Spend the hour; 1 if there was a wrong turn, or the report was late."""
    diary = Diary("operator by HTTP")
    with tempfile.TemporaryDirectory(prefix="operator-") as name:
        folder, api, hook = Path(name), free_port(), free_port()

        def ported(text: str) -> str:
            text = text.replace("linna serve", f"linna serve --port {api}").replace("--rate 120", f"--rate {rate:g}")
            return text.replace("8042", str(api)).replace("8099", str(hook))

        lines = [one for one in commands_of("tutorials/first-spacecraft.md", folder) if not one.startswith("kill ")]
        for path in (*folder.glob("*.py"), *folder.glob("*.toml")):
            path.write_text(ported(path.read_text()))
        script = ported("\n".join(["set -e", *lines, "touch end", "sleep 7200"]))
        with (folder / "log").open("w") as log:
            shell = subprocess.Popen(
                ["bash", "-c", script], cwd=folder, env=environment(folder), stdout=log, stderr=log
            )
            try:
                wait(lambda: (folder / "end").exists() or shell.poll() is not None)
                spent = time.monotonic() - diary.started
                printed = (folder / "log").read_text(errors="replace")
                if not diary.expect("B", "the page leads to a report", (folder / "end").exists(), printed):
                    return diary.close()
                diary.expect("C" if is_loaded() else "B", f"within {LIMIT_S:.0f} s", spent <= LIMIT_S, f"{spent:.0f} s")
                headers = {"Authorization": f"Bearer {(folder / 'token').read_text().strip()}"}
                url = f"http://127.0.0.1:{api}/api/v1/"
                with httpx.Client(base_url=url, headers=headers, timeout=60.0) as client:
                    refusals(diary, client, (folder / "reference.oem").read_text())
                    standstill(diary, client, shell.pid)
                    commands(diary, client)
                return diary.close()
            finally:
                kill_family(shell.pid)
                shell.wait()


def wait(reached: Callable[[], Any], seconds: float = 3600.0) -> bool:
    """Wait until a condition holds; return whether it does in time."""
    until = time.monotonic() + seconds
    while not reached() and time.monotonic() < until:
        time.sleep(0.5)
    return bool(reached())


def refusals(diary: Diary, client: httpx.Client, oem: str) -> None:
    """Make mistakes that would harm operations or mislead."""
    status = client.get("status").json()
    diary.expect("B", "the status names both times", {"mission_time", "time"} <= status.keys(), status)
    now = parse_utc(status["mission_time"])

    def window(hours: float, **fields: Any) -> tuple[str, dict[str, Any]]:
        start = now + int(hours * 3600e9)
        times = {"start": format_utc(start), "stop": format_utc(start + 600 * 10**9)}
        return "windows", {"json": {"spacecraft_id": 76, **times, **fields}}

    def states(line: str) -> str:
        time_utc, *values = line.split() or [""]
        scaled = [f"{float(one) * 1e3:.6f}" for one in values] if time_utc[:4].isdigit() else values
        return " ".join([time_utc, *scaled])

    metres = "\n".join(map(states, oem.splitlines()))
    other = oem.replace("OBJECT_NAME = ", "OBJECT_NAME = X")
    for kind, mistake, (path, body), named in (
        ("A", "a window in the past", window(-2), "after the mission time"),
        ("A", "an unknown spacecraft", window(2, spacecraft_id=77), "(76)"),
        ("B", "a misspelled field", window(2, cadance_s=15), "cadence_s"),
        ("A", "metres for kilometres", ("ephemerides", {"content": metres}), "kilometres"),
        ("A", "another object", ("ephemerides", {"content": other}), "X"),
        ("A", "an unknown station", ("telemetry?spacecraft_id=76&station=mars", {"content": b"x"}), "madrid"),
        ("B", "TOML that is too deep", ("missions/check", {"content": "a" + ".a" * 40 + " = 1"}), "16 parts"),
    ):
        answer = client.post(path, **body)
        held = named in answer.text and (answer.status_code in (409, 422) or path == "missions/check")
        diary.expect(kind, f"{mistake} is refused", held, f"{answer.status_code}: {answer.text}")


def standstill(diary: Diary, client: httpx.Client, shell: int) -> None:
    """Stop the service for longer than its leases; the links are in contact or connected afterwards."""
    family = descendants(shell)
    serving = [one for one in family if b"\0serve\0" in Path(f"/proc/{one}/cmdline").read_bytes()]
    for one, pause in ((signal.SIGSTOP, STANDSTILL_S), (signal.SIGCONT, 0.0)):
        for pid in serving:
            os.kill(pid, one)
        time.sleep(pause)

    def states() -> list[str]:
        return [one["state"] for one in client.get("links").json()["items"]]

    diary.expect("A", "links recover from a standstill", wait(lambda: "waiting" not in states(), 120.0), states())


def commands(diary: Diary, client: httpx.Client) -> None:
    """Command the spacecraft, and take a window back that is on board."""

    def state(path: str) -> str:
        return str(client.get(path).json()["state"])

    keys = [client.post("telecommands", json=one).json()["id"] for one in (ON_BOARD, CRITICAL)]
    answers = [client.post(f"telecommands/{key}/release") for key in keys]
    diary.expect("A", "a telecommand is released", answers[0].status_code == 200, answers[0].text)
    diary.expect("A", "a critical one needs another person", "a person other than" in answers[1].text, answers[1].text)
    wait(lambda: state(f"telecommands/{keys[0]}") in ("completed", "failed"))
    diary.expect("A", "it is verified", state(f"telecommands/{keys[0]}") == "completed")

    def on_board() -> list[Any]:
        return [one for one in client.get("windows").json()["items"] if one["state"] == "uplinked"]

    if not diary.expect("A", "a window is on board", wait(on_board), client.get("windows").text):
        return
    path = f"windows/{on_board()[0]['id']}"
    answer = client.patch(path, json={"state": "failed"})
    is_early, is_late = '"cancelling"' in answer.text, "stop_observation" in answer.text
    diary.expect("A", "it is cancelled, or it is too late", is_early or is_late, answer.text)
    ends = ("failed",) if is_early else ("executed", "downlinked", "processed")
    diary.expect("A", f"it becomes {ends[0]}", wait(lambda: state(path) in ends), state(path))


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:])))
