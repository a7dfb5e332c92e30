"""A small client of the HTTP interface, on the standard library alone.

`Client` has the methods of `ground_service.operations.LocalOperations` and gives the same values, so that a program
need not know whether the service is on this machine.
"""

from __future__ import annotations

import http.client
import json
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from ground_service.errors import GroundError, InvalidInput

API_PREFIX = "/api/v1"
TIMEOUT_S = 120.0
BUSY_S = 120.0
"""Total time for which requests are repeated after 503 with Retry-After."""

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 2.0

View = dict[str, Any]


class ServiceProblem(GroundError):
    """The service refused a request, or could not be reached; `status` is 0 then."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


class Client:
    """A service at `server` (http://host:port), asked as the owner of `token`."""

    def __init__(self, server: str, token: str | None = None) -> None:
        if not server.startswith(("http://", "https://")):
            raise InvalidInput("--server", "", "a URL such as http://127.0.0.1:8042", repr(server))
        self._server = server.rstrip("/")
        self._token = token
        # No redirects are followed: a token must not be carried to another machine.
        self._opener = urllib.request.build_opener(_NoRedirects)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    # Passes, ingest, reports

    def list_passes(self, limit: int = 100) -> View:
        """A page of passes, the newest first."""
        return self._json("GET", "/passes", query={"limit": limit})

    def pass_summary(self, pass_id: int) -> View:
        """The figures of one pass."""
        return self._json("GET", f"/passes/{pass_id}/summary")

    def ingest_file(
        self,
        path: Path,
        *,
        spacecraft_id: int | None = None,
        instance: str = "flight",
        stream: str | None = None,
        offset: int = 0,
    ) -> View:
        """Upload a downlink and wait until it is ingested: its accounting with `ingest_id`."""
        if not path.is_file():
            raise InvalidInput(
                str(path), "", "a downlink file", "a folder" if path.is_dir() else "nothing there"
            )
        query = {
            "name": path.name,
            "instance": instance,
            "spacecraft_id": spacecraft_id,
            "stream": stream,
            "offset": None if stream is None else offset,
        }
        with path.open("rb") as body:
            accepted = self._json("POST", "/telemetry", query=query, body=body, octets=path.stat().st_size)
        self._finished(accepted["job_id"])
        ingest = self._json("GET", f"/ingests/{accepted['ingest_id']}")
        return {**ingest["accounting"], "ingest_id": ingest["id"]}

    def import_archive(self, folder: Path) -> int:
        """Upload a pass archive and wait until it is imported; the id of its pass."""
        from ground_service.passes.archive_zip import zip_folder

        if not (folder / "manifest.json").is_file():
            raise InvalidInput(str(folder), "", "a pass archive with manifest.json", "no manifest.json")
        packed = zip_folder(folder)
        try:
            with packed.open("rb") as stream:
                job = self._json(
                    "POST",
                    "/archives",
                    query={"name": f"{folder.name}.zip"},
                    body=stream,
                    octets=packed.stat().st_size,
                )
        finally:
            packed.unlink()
        return int(self._finished(job["id"])["result"]["pass_id"])

    def make_report(self, pass_id: int, out: Path | None = None) -> View:
        """Have a report made and fetch its documents: their paths, `report_id` and the figures of the pass."""
        job = self._json("POST", f"/passes/{pass_id}/reports")
        report_id = self._finished(job["id"])["result"]["report_id"]
        folder = out if out is not None else Path(f"pass-{pass_id}")
        folder.mkdir(parents=True, exist_ok=True)
        for kind in ("html", "json", "pdf"):
            octets = self._octets("GET", f"/reports/{report_id}", query={"format": kind})
            (folder / f"report.{kind}").write_bytes(octets)
        return {
            "report": str(folder / "report.html"),
            "report_json": str(folder / "report.json"),
            "report_pdf": str(folder / "report.pdf"),
            "report_id": report_id,
            **self._json("GET", f"/reports/{report_id}/summary"),
        }

    def add_ephemeris(self, path: Path, name: str | None = None, precedence: int = 0) -> View:
        """Upload a reference ephemeris."""
        with path.open("rb") as stream:
            return self._json(
                "POST",
                "/ephemerides",
                query={"name": name or path.name, "precedence": precedence},
                body=stream,
                octets=path.stat().st_size,
            )

    # Mission descriptions

    def list_missions(self, limit: int = 100) -> View:
        """List the revisions of mission descriptions, newest first."""
        return self._json("GET", "/missions", query={"limit": limit})

    def add_mission(self, path: Path) -> View:
        """Add a mission description as a revision."""
        with path.open("rb") as stream:
            return self._json("POST", "/missions", body=stream, octets=path.stat().st_size)

    def get_mission(self, revision: str) -> View:
        """Return a revision with its document."""
        return self._json("GET", f"/missions/{urllib.parse.quote(revision, safe='')}")

    # Telecommands

    def enter_command(self, name: str, arguments: Mapping[str, Any], **where: Any) -> View:
        """Queue a telecommand."""
        return self._json("POST", "/telecommands", body={"name": name, "arguments": dict(arguments), **where})

    def list_commands(self, limit: int = 100) -> View:
        """A page of telecommands, the newest first."""
        return self._json("GET", "/telecommands", query={"limit": limit})

    def get_command(self, command_id: int) -> View:
        """One telecommand."""
        return self._json("GET", f"/telecommands/{command_id}")

    def release_command(self, command_id: int) -> View:
        """Release a queued telecommand."""
        return self._json("POST", f"/telecommands/{command_id}/release")

    def reject_command(self, command_id: int, reason: str) -> View:
        """Take a queued telecommand out of the queue."""
        return self._json("POST", f"/telecommands/{command_id}/reject", body={"reason": reason})

    def take_uplink(self, spacecraft_id: int, instance: str, form: str) -> tuple[bytes, list[int]]:
        """What is to be sent now, and the ids of the telecommands in it."""
        query = {"spacecraft_id": spacecraft_id, "instance": instance, "format": form}
        with self._answer("POST", "/uplink", query=query) as answer:
            ids = [int(text) for text in answer.headers.get("X-Telecommands", "").split(",") if text]
            return answer.read(), ids

    def uplink_state(self, spacecraft_id: int, instance: str = "flight") -> View:
        """The state of a spacecraft's telecommand receiver, by its newest telemetry."""
        return self._json("GET", f"/spacecraft/{spacecraft_id}/uplink", query={"instance": instance})

    # Time

    def correlate(self, spacecraft_id: int, instance: str, points: list[View]) -> View:
        """Fit the time correlation of a spacecraft."""
        return self._json(
            "POST",
            f"/spacecraft/{spacecraft_id}/correlations",
            query={"instance": instance},
            body={"points": points},
        )

    def correlations(self, spacecraft_id: int, instance: str) -> View:
        """Time correlations of a spacecraft, the newest first."""
        return self._json("GET", f"/spacecraft/{spacecraft_id}/correlations", query={"instance": instance})

    def correlate_again(self, spacecraft_id: int, instance: str) -> View:
        """Fit the time correlation of a spacecraft from its received time reports."""
        return self._json(
            "POST", f"/spacecraft/{spacecraft_id}/correlations/run", query={"instance": instance}
        )

    def enter_receptions(self, spacecraft_id: int, instance: str, receptions: list[View]) -> View:
        """Tell when time reports were received; the correlations then in force."""
        return self._json(
            "POST",
            f"/spacecraft/{spacecraft_id}/receptions",
            query={"instance": instance},
            body={"receptions": receptions},
        )

    def time_reports(self, spacecraft_id: int, instance: str) -> View:
        """Received time reports with their residuals."""
        return self._json("GET", f"/spacecraft/{spacecraft_id}/time-reports", query={"instance": instance})

    # Plan

    def search_windows(self, request: Mapping[str, Any]) -> View:
        """Candidate windows."""
        return self._json("POST", "/windows/search", body=dict(request))

    def add_window(self, request: Mapping[str, Any]) -> View:
        """Enter a window as a draft."""
        return self._json("POST", "/windows", body=dict(request))

    def list_windows(self, limit: int = 100) -> View:
        """A page of windows, the newest first."""
        return self._json("GET", "/windows", query={"limit": limit})

    def get_window(self, window_id: int) -> View:
        """One window."""
        return self._json("GET", f"/windows/{window_id}")

    def change_window(self, window_id: int, request: Mapping[str, Any]) -> View:
        """Change a draft, or decide on a window."""
        return self._json("PATCH", f"/windows/{window_id}", body=dict(request))

    def delete_window(self, window_id: int) -> None:
        """Take a window off the plan."""
        self._octets("DELETE", f"/windows/{window_id}")

    def uplink_window(self, window_id: int) -> View:
        """Release the telecommands of an approved window."""
        return self._json("POST", f"/windows/{window_id}/uplink")

    def export_plan(self) -> View:
        """All windows as a plan."""
        return self._json("GET", "/plan")

    def import_plan(self, plan: Mapping[str, Any]) -> View:
        """Enter the windows of a plan."""
        return self._json("POST", "/plan", body=dict(plan))

    # Audit log

    def list_audit(self, **query: Any) -> View:
        """Return a page of the audit log, newest entry first."""
        return self._json("GET", "/audit", query=query)

    def audit_head(self) -> View:
        """Return number and hash of the newest entry of the audit log."""
        return self._json("GET", "/audit/head")

    # The wire

    def _finished(self, job_id: str) -> View:
        """The job when it is done; its failure is raised."""
        wait = FIRST_WAIT_S
        while True:
            job = self._json("GET", f"/jobs/{job_id}")
            if job["state"] == "failed":
                raise ServiceProblem(422, str(job["error"]))
            if job["state"] == "done":
                return job
            time.sleep(wait)
            wait = min(2.0 * wait, LONGEST_WAIT_S)

    def _json(self, method: str, path: str, **request: Any) -> View:
        octets = self._octets(method, path, **request)
        try:
            document = json.loads(octets)
        except ValueError:
            raise ServiceProblem(
                0, f"{self._server}: expected JSON of a LINNA service, found other"
            ) from None
        return document if isinstance(document, dict) else {"items": document}

    def _octets(self, method: str, path: str, **request: Any) -> bytes:
        with self._answer(method, path, **request) as answer:
            octets: bytes = answer.read()
            return octets

    def _answer(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        body: Mapping[str, Any] | BinaryIO | None = None,
        octets: int | None = None,
    ) -> Any:
        given = {name: value for name, value in (query or {}).items() if value is not None}
        url = f"{self._server}{API_PREFIX}{path}" + (f"?{urllib.parse.urlencode(given)}" if given else "")
        headers = {"Accept": "application/json"}
        if self._token:
            headers["Authorization"] = f"Bearer {self._token}"
        data: Any = body
        if isinstance(body, Mapping):
            data = json.dumps(body).encode()
            headers["Content-Type"] = "application/json"
        elif octets is not None:
            headers |= {"Content-Type": "application/octet-stream", "Content-Length": str(octets)}
        until = time.monotonic() + BUSY_S
        while True:
            try:
                return self._open(url, data, headers, method)
            except _Busy as busy:
                if time.monotonic() + busy.wait_s > until:
                    raise ServiceProblem(503, busy.detail) from None
                time.sleep(busy.wait_s)

    def _open(self, url: str, data: Any, headers: dict[str, str], method: str) -> Any:
        if hasattr(data, "seek"):
            data.seek(0)
        request = urllib.request.Request(url, data=data, headers=headers, method=method)
        try:
            return self._opener.open(request, timeout=TIMEOUT_S)
        except urllib.error.HTTPError as error:
            wait = error.headers.get("Retry-After", "")
            if (
                error.code == 503 and wait.isdigit()
            ):  # the request was not processed: too many simultaneous requests
                raise _Busy(_detail(error), float(min(int(wait), 10))) from None
            raise ServiceProblem(error.code, _detail(error)) from None
        except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
            reason = getattr(error, "reason", error)
            raise ServiceProblem(0, f"{self._server}: cannot be reached: {reason}") from None


class _Busy(Exception):
    """Busy service that requests a retry."""

    def __init__(self, detail: str, wait_s: float) -> None:
        super().__init__(detail)
        self.detail, self.wait_s = detail, wait_s


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def _detail(error: urllib.error.HTTPError) -> str:
    try:
        return str(json.loads(error.read())["detail"])
    except (ValueError, KeyError, TypeError, OSError):
        return f"{error.url}: answered {error.code} {error.reason}"
