"""An operator's hour by HTTP: from an empty folder to a report with the tutorial alone, then a shift with mistakes.

`python -m benchmarks.campaigns.operator_http [--rate 20]`: the commands of `tutorials/first-spacecraft.md` as printed,
at 20 times real time, then telecommands, a window that is taken back, and requests that a service must refuse. The
exit status is 1 if there was a wrong turn of the classes A or B, or the report took more than `LIMIT_S`.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import httpx

from benchmarks.campaigns._strangers import Diary, commands_of
from lunar.timescales import format_utc, parse_utc
from studies.harness.parts import bare_environment, free_port, kill_family

LIMIT_S = 360.0
WAIT_S = 900.0


def main(words: Sequence[str] | None = None) -> int:
    """Spend the hour; 1 if there was a wrong turn."""
    parser = argparse.ArgumentParser(prog="operator_http", description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, default=20.0, help="simulated seconds per second")
    given = parser.parse_args(words)
    diary = Diary("operator by HTTP")
    with tempfile.TemporaryDirectory(prefix="operator-") as name:
        folder = Path(name)
        api, hook = free_port(), free_port()
        lines = [
            line.replace("--rate 120", f"--rate {given.rate:g}").replace(
                "linna serve", f"linna serve --port {api}"
            )
            for line in commands_of("tutorials/first-spacecraft.md", folder)
            if not line.startswith("kill ")
        ]
        script = "\n".join(["set -e", *lines, "touch report-is-here", "sleep 3600"])
        for path in (*folder.glob("*.py"), *folder.glob("*.toml")):
            path.write_text(path.read_text().replace("8042", str(api)).replace("8099", str(hook)))
        script = script.replace("8042", str(api)).replace("8099", str(hook))
        environment = bare_environment(
            PATH=f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            PYTHONPATH=str(Path(__file__).resolve().parents[2]),
            XDG_DATA_HOME=str(folder / "data"),
        )
        environment.pop("LINNA_DATA", None)
        with (folder / "log").open("w") as log:
            shell = subprocess.Popen(
                ["bash", "-c", script], cwd=folder, env=environment, stdout=log, stderr=log
            )
            try:
                wait_until(lambda: (folder / "report-is-here").exists() or shell.poll() is not None)
                spent = time.monotonic() - diary.started
                is_there = (folder / "report-is-here").exists()
                diary.expect("B", "the commands of the page lead to a report", is_there, tail(folder / "log"))
                if is_there:
                    diary.expect("C", f"it takes at most {LIMIT_S:.0f} s", spent <= LIMIT_S, f"{spent:.0f} s")
                    headers = {"Authorization": f"Bearer {(folder / 'token').read_text().strip()}"}
                    url = f"http://127.0.0.1:{api}/api/v1/"
                    with httpx.Client(base_url=url, headers=headers, timeout=60.0) as client:
                        shift(diary, client, folder)
            finally:
                kill_family(shell.pid)
    return diary.close() or int(spent > LIMIT_S)


def tail(path: Path) -> str:
    """Return the end of a file."""
    return path.read_text(errors="replace")[-800:]


def wait_until(reached: Callable[[], Any], seconds: float = WAIT_S) -> bool:
    """Wait until a condition holds; return whether it does in time."""
    until = time.monotonic() + seconds
    while not reached():
        if time.monotonic() > until:
            return False
        time.sleep(0.5)
    return True


def shift(diary: Diary, client: httpx.Client, folder: Path) -> None:
    """Operate the spacecraft: look, command, take a window back, and make mistakes."""
    status = client.get("status").json()
    diary.expect(
        "B",
        "the status names mission time and time of day",
        {"mission_time", "time"} <= status.keys(),
        status,
    )
    now = parse_utc(status["mission_time"])
    refusals(diary, client, folder, now)
    telecommands(diary, client)
    take_back(diary, client)


def refused(diary: Diary, kind: Any, step: str, answer: httpx.Response, status: int, *named: str) -> None:
    """Record whether a mistake was answered with a status and a line that names these words."""
    detail = str(answer.json().get("detail", "")) if answer.content else ""
    held = answer.status_code == status and all(one in detail for one in named)
    diary.expect(kind, step, held, f"{answer.status_code}: {detail}")


def refusals(diary: Diary, client: httpx.Client, folder: Path, now: int) -> None:
    """Make the mistakes that would harm operations."""

    def window(start_s: float, **fields: Any) -> httpx.Response:
        start = now + int(start_s * 1e9)
        body = {"spacecraft_id": 76, "start": format_utc(start), "stop": format_utc(start + 600 * 10**9)}
        return client.post("windows", json=body | fields)

    refused(diary, "A", "a window in the past is refused", window(-7200), 409, "after the mission time")
    refused(diary, "A", "an unknown spacecraft is refused", window(7200, spacecraft_id=77), 409, "77", "76")
    refused(diary, "B", "a misspelled field is named", window(7200, cadance_s=15), 422, "cadance_s")
    oem = (folder / "reference.oem").read_text()
    lines = oem.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("META_STOP")) + 1
    metres = lines[:first] + [_in_metres(line) for line in lines[first:]]
    answer = client.post("ephemerides", content="\n".join(metres).encode())
    refused(diary, "A", "metres for kilometres are refused", answer, 422, "kilometres")
    renamed = "\n".join("OBJECT_NAME = OTHER" if one.startswith("OBJECT_NAME") else one for one in lines)
    answer = client.post("ephemerides", content=renamed.encode())
    diary.expect(
        "A", "an ephemeris of another object is refused", answer.status_code in (409, 422), answer.text
    )
    answer = client.post("telemetry?spacecraft_id=76&station=kourou", content=b"x" * 100)
    diary.expect("A", "an unknown station is refused", answer.status_code in (409, 422), answer.text)
    refused(
        diary,
        "B",
        "a misspelled parameter is named",
        client.get("passes?spacecraft=76"),
        422,
        "spacecraft_id",
    )
    deep = b"a" + b".a" * 40 + b" = 1\n"
    refused(diary, "B", "too deep TOML is one line", client.post("missions/check", content=deep), 422, "body")


def _in_metres(line: str) -> str:
    """Return a state of an OEM with metres in place of kilometres; other lines as they are."""
    time, *values = line.split() or [""]
    return " ".join([time, *(f"{float(one) * 1e3:.6f}" for one in values)]) if time[:4].isdigit() else line


def telecommands(diary: Diary, client: httpx.Client) -> None:
    """Enter and release a telecommand, and see it on board."""
    entered = client.post("telecommands", json={"name": "test_connection", "spacecraft_id": 76})
    diary.expect("A", "a telecommand is entered", entered.status_code == 201, entered.text)
    key = entered.json()["id"]
    released = client.post(f"telecommands/{key}/release")
    diary.expect("A", "it is released", released.status_code == 200, released.text)
    done = wait_until(lambda: client.get(f"telecommands/{key}").json()["state"] in ("completed", "failed"))
    found = client.get(f"telecommands/{key}").json()
    diary.expect("A", "it is sent in a contact and verified", done and found["state"] == "completed", found)
    critical = {"name": "perform_function", "spacecraft_id": 76, "arguments": {"function_id": "reboot"}}
    number = client.post("telecommands", json=critical).json()["id"]
    answer = client.post(f"telecommands/{number}/release")
    refused(diary, "A", "a critical telecommand needs another person", answer, 409, "a person other than")
    answer = client.post(f"telecommands/{number}/reject", json={"reason": "not needed"})
    diary.expect("A", "it is rejected", answer.status_code == 200, answer.text)


def take_back(diary: Diary, client: httpx.Client) -> None:
    """Take a window back that is on board."""

    def on_board() -> Any:
        windows = client.get("windows").json()["items"]
        return next((one for one in windows if one["state"] == "uplinked"), None)

    if not wait_until(on_board):
        diary.expect("A", "another window is on board", False, client.get("windows").text)
        return
    window = on_board()
    answer = client.patch(f"windows/{window['id']}", json={"state": "failed"})
    is_early = answer.status_code == 200 and answer.json()["state"] == "cancelling"
    is_late = answer.status_code == 409 and "stop_observation" in answer.text
    diary.expect("A", "a window on board is cancelled, or it is too late", is_early or is_late, answer.text)

    def state() -> str:
        return str(client.get(f"windows/{window['id']}").json()["state"])

    ended = ("failed",) if is_early else ("executed", "downlinked", "processed")
    diary.expect("A", f"it is {' or '.join(ended)}", wait_until(lambda: state() in ended), state())


if __name__ == "__main__":
    sys.exit(main())
