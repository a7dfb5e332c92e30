"""Operations of the ground service: one method for each operation of the HTTP API, under the same name."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from ground_service.access.model import AuditEntry, AuditHead, Session, Token, User, UserWithToken
from ground_service.alarms.model import Alarm, AlarmDetail
from ground_service.automation.model import AutomationAction, RuleInForce
from ground_service.client.connection import Body, Connection, Listing, new_key
from ground_service.client.problems import JobFailed
from ground_service.commanding.model import Telecommand, UplinkState
from ground_service.displays.model import Display, DisplaySummary
from ground_service.ephemerides.model import Ephemeris
from ground_service.errors import InvalidInput
from ground_service.evaluation.model import PassFigures, Report, ReportOverview, ReportSummary
from ground_service.exports.model import ExportFormatInfo, FormatName
from ground_service.ingest.model import Ingest, IngestAccepted
from ground_service.jobs.model import Job
from ground_service.landmarks.model import Landmark, LandmarkDetail, LandmarkUpdate
from ground_service.links.model import Contacts, LinkStatus
from ground_service.missions.model import HeldCatalogue, MissionDetail, MissionRevision
from ground_service.passes.model import (
    Completeness,
    Crater,
    Detection,
    Event,
    ExportFormat,
    Image,
    LiveParameter,
    ParameterInfo,
    ParameterSeries,
    PassDetail,
    PassParameters,
    PassSummary,
    SpacecraftEvent,
    SpacecraftInstance,
    States,
    Trend,
)
from ground_service.performance.model import MonthlyReport, Performance
from ground_service.planning.model import (
    CraterDensity,
    Imported,
    Plan,
    PlanForecast,
    SearchResult,
    Window,
)
from ground_service.planning.request_model import RequestPlan, StandingRequest
from ground_service.regression.model import Build, KeptArchive, Pruned, Regression, RegressionSummary
from ground_service.timekeeping.model import Correlation, TimeReport
from ground_service.worker.model import ServiceStatus

FIRST_WAIT_S, LONGEST_WAIT_S = 0.05, 2.0

ReportKind = Literal["html", "json", "pdf"]
Fields = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Uplink:
    """Octets to radiate now, and the ids of the telecommands in them."""

    octets: bytes
    telecommands: tuple[int, ...]


class Client(Connection):
    """Operations of a ground service.

    Operations that create something take an idempotency key: the service processes requests with the same key once. The
    default is a new key for each call, so that a request can be repeated after a broken connection.
    """

    # Telemetry

    def upload_telemetry(
        self,
        file: Path | bytes,
        *,
        name: str | None = None,
        spacecraft_id: int | None = None,
        instance: str = "flight",
        stream: str | None = None,
        offset: int = 0,
        station: str = "",
        link: str | None = None,
        key: str | None = None,
    ) -> IngestAccepted:
        """Upload a downlink, or a piece of one cut at any octet."""
        return self._post(
            IngestAccepted,
            "/telemetry",
            file,
            key=key or new_key(),
            name=name or _name_of(file),
            spacecraft_id=spacecraft_id,
            instance=instance,
            stream=stream,
            offset=None if stream is None else offset,
            station=station or None,
            link=link,
        )

    def list_ingests(self) -> Listing[Ingest]:
        """List ingests, newest first."""
        return self._list(Ingest, "/ingests")

    def get_ingest(self, ingest_id: int) -> Ingest:
        """Return an ingest: its state and the octet accounting of the file."""
        return self._get(Ingest, f"/ingests/{ingest_id}")

    def ingest_file(self, file: Path | bytes, **options: Any) -> Ingest:
        """Upload a downlink with the options of `upload_telemetry`, and wait until it is ingested."""
        accepted = self.upload_telemetry(file, **options)
        self.wait(accepted.job_id)
        return self.get_ingest(accepted.ingest_id)

    # Pass archives

    def upload_archive(self, file: Path, *, name: str | None = None, key: str | None = None) -> Job:
        """Upload a zipped pass archive; the job imports it."""
        return self._post(Job, "/archives", file, key=key or new_key(), name=name or file.name)

    def import_archive(self, archive: Path) -> int:
        """Upload a pass archive (folder or zip), wait until it is imported, and return the id of the pass."""
        try:
            return self._import_archive(archive)
        except JobFailed as error:
            raise JobFailed(error.status, f"{archive}: {error}") from None

    def _import_archive(self, archive: Path) -> int:
        if archive.is_file():
            return int(self._result(self.upload_archive(archive))["pass_id"])
        from ground_service.passes.archive_zip import zip_folder

        if not (archive / "manifest.json").is_file():
            raise InvalidInput(str(archive), "", "a pass archive with manifest.json", "no manifest.json")
        packed = zip_folder(archive)
        try:
            return int(self._result(self.upload_archive(packed, name=f"{archive.name}.zip"))["pass_id"])
        finally:
            packed.unlink()

    # Passes

    def list_passes(
        self,
        *,
        search: str | None = None,
        spacecraft_id: int | None = None,
        instance: str | None = None,
        verdict: str | None = None,
    ) -> Listing[PassSummary]:
        """List the passes that match, newest first.

        `search` is a part of the name; `verdict` is "met", "not met", "unknown", or "none" for passes without a report.
        """
        return self._list(
            PassSummary,
            "/passes",
            search=search,
            spacecraft_id=spacecraft_id,
            instance=instance,
            verdict=verdict,
        )

    def define_pass(self, definition: Fields, *, key: str | None = None) -> PassDetail:
        """Define an interval of a spacecraft's time as a pass."""
        return self._post(PassDetail, "/passes", definition, key=key or new_key())

    def get_pass(self, pass_id: int) -> PassDetail:
        """Return a pass with its manifest and the ids of its reports."""
        return self._get(PassDetail, f"/passes/{pass_id}")

    def evaluate_pass(self, pass_id: int) -> PassFigures:
        """Evaluate a pass now and return its metrics."""
        return self._get(PassFigures, f"/passes/{pass_id}/summary")

    def get_completeness(self, pass_id: int) -> Completeness:
        """Return the received and missing packets of a pass."""
        return self._get(Completeness, f"/passes/{pass_id}/completeness")

    def list_detections(self, pass_id: int) -> Listing[Detection]:
        """List the detections of a pass in time order."""
        return self._list(Detection, f"/passes/{pass_id}/detections")

    def list_craters(self, pass_id: int) -> Listing[Crater]:
        """List the craters of the catalogue of a pass, the largest first."""
        return self._list(Crater, f"/passes/{pass_id}/craters")

    def list_events(self, pass_id: int) -> Listing[Event]:
        """List the event reports of a pass in time order."""
        return self._list(Event, f"/passes/{pass_id}/events")

    def list_spacecraft_events(
        self,
        spacecraft_id: int,
        *,
        instance: str = "flight",
        severities: Sequence[str] = (),
        name: str | None = None,
        start: str | None = None,
        stop: str | None = None,
    ) -> Listing[SpacecraftEvent]:
        """List the event reports of all passes of a spacecraft, newest first; no severities: any."""
        return self._list(
            SpacecraftEvent,
            "/events",
            spacecraft_id=spacecraft_id,
            instance=instance,
            severity=list(severities) or None,
            name=name,
            start=start,
            stop=stop,
        )

    def get_states(
        self, pass_id: int, *, estimator: str = "paper", values: Sequence[str] = (), max_points: int = 1000
    ) -> States:
        """Return series of the states of an estimator: minimum, maximum and mean of each interval."""
        return self._get(
            States,
            f"/passes/{pass_id}/states",
            estimator=estimator,
            value=list(values) or None,
            max_points=max_points,
        )

    def list_parameters(self, pass_id: int) -> PassParameters:
        """Return the parameters of a pass with series, and the packets that its mission description defines."""
        return self._get(PassParameters, f"/passes/{pass_id}/parameters")

    def get_packets(self, pass_id: int, packet: str, target: Path, *, kind: ExportFormat = "csv") -> None:
        """Download the decoded packets of one kind in a pass into a file."""
        self._download(f"/passes/{pass_id}/packets/{_part(packet)}", target, format=kind)

    def export_pass(self, pass_id: int, kind: FormatName, target: Path, *, states: str = "reference") -> None:
        """Write a pass in a format of other tools into a file; formats of several files give a zip archive."""
        self._download("/exports", target, body={"pass_id": pass_id, "format": kind, "states": states})

    def list_export_formats(self) -> list[ExportFormatInfo]:
        """List the formats of exports."""
        return self._all(ExportFormatInfo, "/exports/formats")

    def get_parameter(self, pass_id: int, parameter: str, *, max_points: int = 1000) -> ParameterSeries:
        """Return the series of a parameter of a pass."""
        path = f"/passes/{pass_id}/telemetry/{_part(parameter)}"
        return self._get(ParameterSeries, path, max_points=max_points)

    def get_trend(
        self,
        spacecraft_id: int,
        parameter: str,
        *,
        instance: str = "flight",
        start: str | None = None,
        stop: str | None = None,
        max_points: int = 1000,
    ) -> ParameterSeries:
        """Return the series of a housekeeping parameter over any time span."""
        return self._get(
            ParameterSeries,
            f"/spacecraft/{spacecraft_id}/telemetry/{_part(parameter)}",
            instance=instance,
            start=start,
            stop=stop,
            max_points=max_points,
        )

    def list_spacecraft(self) -> list[SpacecraftInstance]:
        """List the spacecraft in all instances, flown ones first."""
        return self._all(SpacecraftInstance, "/spacecraft")

    def list_spacecraft_parameters(
        self, spacecraft_id: int, *, instance: str = "flight"
    ) -> Listing[ParameterInfo]:
        """List the parameters of a spacecraft with series."""
        path = f"/spacecraft/{spacecraft_id}/parameters"
        return self._list(ParameterInfo, path, paged=False, instance=instance)

    def list_images(
        self, spacecraft_id: int, start: str, stop: str, *, instance: str = "flight"
    ) -> Listing[Image]:
        """List the images of an interval: downlinked thumbnails, and frames of pass archives."""
        path = f"/spacecraft/{spacecraft_id}/images"
        return self._list(Image, path, paged=False, start=start, stop=stop, instance=instance)

    def get_thumbnail(
        self,
        spacecraft_id: int,
        ticks: int,
        target: Path,
        *,
        instance: str = "flight",
        detections: bool = False,
    ) -> None:
        """Download a downlinked thumbnail as PNG into a file."""
        path = f"/spacecraft/{spacecraft_id}/thumbnails/{ticks}"
        self._download(path, target, instance=instance, detections=detections)

    def get_image(self, pass_id: int, frame_number: int, target: Path, *, detections: bool = False) -> None:
        """Download a frame of a pass archive as PNG into a file."""
        self._download(f"/passes/{pass_id}/images/{frame_number}", target, detections=detections)

    def list_displays(self) -> Listing[DisplaySummary]:
        """List the stored objects of the telemetry displays."""
        return self._list(DisplaySummary, "/displays")

    def get_display(self, key: str) -> Display:
        """Return a stored object of the telemetry displays."""
        return self._get(Display, f"/displays/{_part(key)}")

    def keep_display(self, key: str, display: Body) -> Display:
        """Store an object of the telemetry displays; `version` is the one that it replaces."""
        return self._call(Display, "PUT", f"/displays/{_part(key)}", body=display)

    def delete_display(self, key: str) -> None:
        """Delete a stored object of the telemetry displays."""
        self._octets("DELETE", f"/displays/{_part(key)}")

    def list_live_parameters(self, spacecraft_id: int, *, instance: str = "flight") -> list[LiveParameter]:
        """List the newest value of every parameter, with its age and limit state."""
        return self._all(LiveParameter, "/parameters", spacecraft_id=spacecraft_id, instance=instance)

    def list_trends(self, spacecraft_id: int, *, instance: str = "flight") -> list[Trend]:
        """List the statistics of the housekeeping parameters over the last 30 days of on-board time."""
        return self._all(Trend, f"/spacecraft/{spacecraft_id}/trends", instance=instance)

    # Reports

    def list_newest_reports(self, pass_ids: Sequence[int]) -> list[ReportSummary]:
        """List verdict and main figures of the newest report of each of these passes that has one."""
        return self._all(ReportSummary, "/reports", pass_id=[str(one) for one in pass_ids])

    def get_performance(
        self,
        spacecraft_id: int,
        *,
        instance: str | None = None,
        start: str | None = None,
        stop: str | None = None,
        window_days: float = 7.0,
    ) -> Performance:
        """Return recall, drift and error over the reported passes of a spacecraft, with changes of level."""
        return self._get(
            Performance,
            f"/spacecraft/{spacecraft_id}/performance",
            instance=instance,
            start=start,
            stop=stop,
            window_days=window_days,
        )

    def add_monthly_report(
        self, spacecraft_id: int, month: str, *, instance: str = "flight"
    ) -> MonthlyReport:
        """Add the report of a month (YYYY-MM) of a spacecraft in one instance."""
        path = f"/spacecraft/{spacecraft_id}/monthly-reports/{_part(month)}"
        return self._post(MonthlyReport, path, instance=instance)

    def list_monthly_reports(self, *, spacecraft_id: int | None = None) -> Listing[MonthlyReport]:
        """List monthly reports, newest month first."""
        return self._list(MonthlyReport, "/monthly-reports", spacecraft_id=spacecraft_id)

    def get_monthly_report(self, report_id: str, target: Path, *, kind: ReportKind = "html") -> None:
        """Download a monthly report into a file."""
        self._download(f"/monthly-reports/{_part(report_id)}", target, format=kind)

    def list_reports(self, pass_id: int) -> Listing[Report]:
        """List the reports of a pass, newest first, with the changes that a re-evaluation made."""
        return self._list(Report, f"/passes/{pass_id}/reports")

    def request_report(self, pass_id: int, *, key: str | None = None) -> Job:
        """Start the job that evaluates a pass and renders its report."""
        return self._post(Job, f"/passes/{pass_id}/reports", key=key or new_key())

    def make_report(self, pass_id: int) -> str:
        """Request a report, wait until it is rendered, and return its id."""
        return str(self._result(self.request_report(pass_id))["report_id"])

    def get_report(self, report_id: str, target: Path, *, kind: ReportKind = "html") -> None:
        """Download a report into a file."""
        self._download(f"/reports/{_part(report_id)}", target, format=kind)

    def get_report_summary(self, report_id: str) -> PassFigures:
        """Return the metrics of a report."""
        return self._get(PassFigures, f"/reports/{_part(report_id)}/summary")

    def get_report_overview(self, report_id: str, *, max_points: int = 600) -> ReportOverview:
        """Return verdict, headline metrics and error series of a report."""
        return self._get(ReportOverview, f"/reports/{_part(report_id)}/overview", max_points=max_points)

    # Reference ephemerides

    def add_ephemeris(self, file: Path, *, name: str | None = None, precedence: int = 0) -> Ephemeris:
        """Upload a reference ephemeris (OEM in text or XML, STK .e or Horizons CSV)."""
        return self._post(Ephemeris, "/ephemerides", file, name=name or file.name, precedence=precedence)

    def list_ephemerides(self) -> Listing[Ephemeris]:
        """List reference ephemerides, newest first."""
        return self._list(Ephemeris, "/ephemerides")

    # Mission descriptions

    def list_missions(self) -> Listing[MissionRevision]:
        """List the revisions of mission descriptions, newest first."""
        return self._list(MissionRevision, "/missions")

    def add_mission(self, file: Path | bytes) -> MissionDetail:
        """Add a mission description (TOML) as a revision, with the XTCE files that it names."""
        from ground_service.missions.definitions import read_mission_file

        document = read_mission_file(file) if isinstance(file, Path) else file
        return self._post(MissionDetail, "/missions", document, name=_name_of(file))

    def get_mission(self, revision: str) -> MissionDetail:
        """Return a revision with its document."""
        return self._get(MissionDetail, f"/missions/{_part(revision)}")

    def list_catalogues(self) -> Listing[HeldCatalogue]:
        """List the crater catalogues that the ground holds, newest first."""
        return self._list(HeldCatalogue, "/catalogues")

    def add_catalogue(self, file: Path, *, name: str | None = None) -> HeldCatalogue:
        """Upload a crater catalogue, which mission descriptions name by its SHA-256."""
        return self._post(HeldCatalogue, "/catalogues", file, name=name or file.name)

    # Landmarks

    def list_landmarks(
        self, *, spacecraft_id: int | None = None, state: str | None = None
    ) -> Listing[Landmark]:
        """List the landmarks learned from flight, most passes first."""
        return self._list(Landmark, "/landmarks", spacecraft_id=spacecraft_id, state=state)

    def get_landmark(self, landmark_id: int) -> LandmarkDetail:
        """Return a landmark with its sightings and their images."""
        return self._get(LandmarkDetail, f"/landmarks/{landmark_id}")

    def accept_landmark(self, landmark_id: int, reason: str = "") -> LandmarkDetail:
        """Accept a proposed landmark as a crater of the next anchoring catalogue."""
        return self._post(LandmarkDetail, f"/landmarks/{landmark_id}/accept", {"reason": reason})

    def reject_landmark(self, landmark_id: int, reason: str = "") -> LandmarkDetail:
        """Reject a proposed landmark."""
        return self._post(LandmarkDetail, f"/landmarks/{landmark_id}/reject", {"reason": reason})

    def find_landmarks(self, pass_id: int) -> LandmarkUpdate:
        """Search a pass for landmarks and enter them; what the pass said before is replaced."""
        return self._post(LandmarkUpdate, f"/passes/{pass_id}/landmarks")

    # Automation

    def list_automation_rules(self) -> Listing[RuleInForce]:
        """List the automation rules in force."""
        return self._list(RuleInForce, "/automation/rules", paged=False)

    def list_automation_actions(
        self, *, state: str | None = None, pass_id: int | None = None
    ) -> Listing[AutomationAction]:
        """List the actions of rules with their causes and results, newest first."""
        return self._list(AutomationAction, "/automation/actions", state=state, pass_id=pass_id)

    def approve_automation_action(self, action_id: int) -> AutomationAction:
        """Approve an action that waits for approval, and those after it in its rule."""
        return self._post(AutomationAction, f"/automation/actions/{action_id}/approve")

    def refuse_automation_action(self, action_id: int) -> AutomationAction:
        """Refuse an action that waits for approval, and those after it in its rule."""
        return self._post(AutomationAction, f"/automation/actions/{action_id}/refuse")

    def repeat_automation_action(self, action_id: int) -> AutomationAction:
        """Queue a failed action again, and those of its rule that were skipped after it."""
        return self._post(AutomationAction, f"/automation/actions/{action_id}/repeat")

    # Telecommands

    def list_telecommands(self, *, state: str | None = None) -> Listing[Telecommand]:
        """List telecommands with their verification, newest first."""
        return self._list(Telecommand, "/telecommands", state=state)

    def enter_telecommand(
        self,
        name: str,
        arguments: Fields,
        *,
        spacecraft_id: int,
        instance: str = "flight",
        timeout_s: int = 600,
        key: str | None = None,
    ) -> Telecommand:
        """Queue a telecommand."""
        entry = {
            "name": name,
            "arguments": dict(arguments),
            "spacecraft_id": spacecraft_id,
            "instance": instance,
            "timeout_s": timeout_s,
        }
        return self._post(Telecommand, "/telecommands", entry, key=key or new_key())

    def get_telecommand(self, command_id: int) -> Telecommand:
        """Return a telecommand with its verification."""
        return self._get(Telecommand, f"/telecommands/{command_id}")

    def release_telecommand(self, command_id: int) -> Telecommand:
        """Release a queued telecommand."""
        return self._post(Telecommand, f"/telecommands/{command_id}/release")

    def reject_telecommand(self, command_id: int, reason: str) -> Telecommand:
        """Remove a queued telecommand from the queue."""
        return self._post(Telecommand, f"/telecommands/{command_id}/reject", {"reason": reason})

    def take_uplink(
        self,
        spacecraft_id: int,
        *,
        instance: str = "flight",
        format: Literal["cltu", "packets"] = "cltu",
        key: str | None = None,
    ) -> Uplink:
        """Take all released telecommands; they count as sent from then on."""
        response = self._send(
            "POST",
            "/uplink",
            query={"spacecraft_id": spacecraft_id, "instance": instance, "format": format},
            key=key or new_key(),
        )
        ids = response.headers.get("X-Telecommands", "").split(",")
        return Uplink(response.content, tuple(int(text) for text in ids if text))

    def get_uplink_state(self, spacecraft_id: int, *, instance: str = "flight") -> UplinkState:
        """Return the state of the telecommand receiver according to the newest telemetry."""
        return self._get(UplinkState, f"/spacecraft/{spacecraft_id}/uplink", instance=instance)

    # Standing requests

    def list_requests(self) -> Listing[StandingRequest]:
        """List the standing requests, newest first."""
        return self._list(StandingRequest, "/requests")

    def add_request(self, request: Fields, *, key: str | None = None) -> StandingRequest:
        """Add a standing request."""
        return self._post(StandingRequest, "/requests", dict(request), key=key or new_key())

    def get_request(self, request_id: int) -> StandingRequest:
        """Return a standing request."""
        return self._get(StandingRequest, f"/requests/{request_id}")

    def change_request(self, request_id: int, change: Fields) -> StandingRequest:
        """Pause or resume a standing request, or replace its terms."""
        return self._call(StandingRequest, "PATCH", f"/requests/{request_id}", body=dict(change))

    def delete_request(self, request_id: int) -> None:
        """Delete a standing request; its windows stay."""
        self._octets("DELETE", f"/requests/{request_id}")

    def get_request_plan(self, request_id: int) -> RequestPlan:
        """Return the last plan of a standing request."""
        return self._get(RequestPlan, f"/requests/{request_id}/plan")

    # Links and contacts

    def list_links(self) -> Listing[LinkStatus]:
        """List the links with their state."""
        return self._list(LinkStatus, "/links", paged=False)

    def get_link(self, name: str) -> LinkStatus:
        """Return a link with its state."""
        return self._get(LinkStatus, f"/links/{_part(name)}")

    def send_link(self, name: str) -> LinkStatus:
        """Have the released telecommands sent now, in a contact or not."""
        return self._post(LinkStatus, f"/links/{_part(name)}/send")

    def list_contacts(
        self, *, since: str | None = None, until: str | None = None, link: str | None = None
    ) -> Contacts:
        """Return contacts that took place, were missed or are predicted."""
        return self._get(Contacts, "/contacts", since=since, until=until, link=link)

    # Time correlation

    def list_correlations(self, spacecraft_id: int, *, instance: str = "flight") -> Listing[Correlation]:
        """List the time correlations of a spacecraft, newest first."""
        return self._list(
            Correlation, f"/spacecraft/{spacecraft_id}/correlations", paged=False, instance=instance
        )

    def add_correlations(
        self, spacecraft_id: int, points: Sequence[Fields], *, instance: str = "flight"
    ) -> list[Correlation]:
        """Fit the time correlation from time reports with their reception times."""
        path = f"/spacecraft/{spacecraft_id}/correlations"
        return self._items(Correlation, path, {"points": list(points)}, instance=instance)

    def run_correlation(self, spacecraft_id: int, *, instance: str = "flight") -> list[Correlation]:
        """Fit the time correlation from the received time reports; return the correlations in force."""
        return self._items(Correlation, f"/spacecraft/{spacecraft_id}/correlations/run", instance=instance)

    def add_receptions(
        self, spacecraft_id: int, receptions: Sequence[Fields], *, instance: str = "flight"
    ) -> list[Correlation]:
        """Enter reception times of time reports; return the correlations in force."""
        path = f"/spacecraft/{spacecraft_id}/receptions"
        return self._items(Correlation, path, {"receptions": list(receptions)}, instance=instance)

    def list_time_reports(self, spacecraft_id: int, *, instance: str = "flight") -> Listing[TimeReport]:
        """List received time reports with their residuals."""
        return self._list(
            TimeReport, f"/spacecraft/{spacecraft_id}/time-reports", paged=False, instance=instance
        )

    # Observation windows

    def search_windows(self, constraints: Body) -> SearchResult:
        """Search candidate windows over a reference ephemeris."""
        return self._post(SearchResult, "/windows/search", constraints)

    def get_forecast(
        self,
        spacecraft_id: int,
        start: str,
        stop: str,
        *,
        instance: str = "flight",
        ephemeris_id: int | None = None,
    ) -> PlanForecast:
        """Return conditions, resources and conflicts of the plan of a spacecraft between two times."""
        return self._get(
            PlanForecast,
            "/plan/forecast",
            spacecraft_id=spacecraft_id,
            start=start,
            stop=stop,
            instance=instance,
            ephemeris_id=ephemeris_id,
        )

    def get_crater_density(self, spacecraft_id: int) -> CraterDensity:
        """Return the crater density of the catalogue of the mission description in force."""
        return self._get(CraterDensity, "/plan/crater-density", spacecraft_id=spacecraft_id)

    def list_windows(self, *, state: str | None = None) -> Listing[Window]:
        """List planned windows, newest first."""
        return self._list(Window, "/windows", state=state)

    def add_window(self, window: Body, *, key: str | None = None) -> Window:
        """Enter a window as a draft."""
        return self._post(Window, "/windows", window, key=key or new_key())

    def get_window(self, window_id: int) -> Window:
        """Return a planned window."""
        return self._get(Window, f"/windows/{window_id}")

    def change_window(self, window_id: int, change: Body, *, if_match: str | None = None) -> Window:
        """Change a draft, or the state of a window; `if_match` is the entity tag of the expected version."""
        return self._call(Window, "PATCH", f"/windows/{window_id}", body=change, headers=_match(if_match))

    def delete_window(self, window_id: int, *, if_match: str | None = None) -> None:
        """Remove a window from the plan."""
        self._octets("DELETE", f"/windows/{window_id}", headers=_match(if_match))

    def uplink_window(self, window_id: int) -> list[Telecommand]:
        """Release the time-tagged telecommands of an approved window."""
        return self._items(Telecommand, f"/windows/{window_id}/uplink")

    def export_plan(self) -> Plan:
        """Return all windows that have not failed, as a plan."""
        return self._get(Plan, "/plan")

    def import_plan(self, plan: Body) -> Imported:
        """Enter all windows of a plan as drafts, or none of them."""
        return self._post(Imported, "/plan", plan)

    # Payload builds and regressions

    def list_builds(self) -> Listing[Build]:
        """List registered payload builds, newest first."""
        return self._list(Build, "/builds")

    def add_build(self, file: Path) -> Build:
        """Register a payload build: a zip of build.toml and the files that it names."""
        return self._post(Build, "/builds", file)

    def add_current_build(self) -> Build:
        """Register the flight code that is installed with the service."""
        return self._post(Build, "/builds/current")

    def list_kept_archives(self) -> list[KeptArchive]:
        """List the pass archives that are kept for regressions, oldest first."""
        return self._all(KeptArchive, "/regression-archives")

    def keep_archive(self, file: Path, *, pinned: bool = False) -> KeptArchive:
        """Upload a zipped pass archive to keep it for regressions."""
        return self._post(KeptArchive, "/regression-archives", file, pinned=pinned)

    def keep_pass_archive(self, pass_id: int, *, pinned: bool = False) -> KeptArchive:
        """Keep the regression archive of a pass."""
        return self._post(KeptArchive, f"/passes/{pass_id}/regression-archive", pinned=pinned)

    def render_kept_archive(self, digest: str) -> Job:
        """Render the missing frames of a kept archive as a job."""
        return self._post(Job, f"/regression-archives/{_part(digest)}/frames")

    def change_kept_archive(self, digest: str, *, pinned: bool) -> KeptArchive:
        """Change whether a kept archive is pinned."""
        path = f"/regression-archives/{_part(digest)}"
        return self._call(KeptArchive, "PATCH", path, body={"pinned": pinned})

    def delete_kept_archives(self, *, unused_days: float) -> Pruned:
        """Delete kept archives that are not pinned and were not used for a time."""
        return self._call(Pruned, "DELETE", "/regression-archives", query={"unused_days": unused_days})

    def start_regression(self, request: Body, *, key: str | None = None) -> Job:
        """Start the jobs that compare a candidate build with a baseline over archives."""
        return self._post(Job, "/regressions", request, key=key or new_key())

    def start_analysis(self, request: Body, *, key: str | None = None) -> Job:
        """Start the job that computes the metrics of one build; its result has no verdict."""
        return self._post(Job, "/analyses", request, key=key or new_key())

    def list_regressions(self) -> Listing[RegressionSummary]:
        """List verdicts, newest first."""
        return self._list(RegressionSummary, "/regressions")

    def get_regression(self, regression_id: str) -> Regression:
        """Return a verdict."""
        return self._get(Regression, f"/regressions/{_part(regression_id)}")

    def get_regression_report(self, regression_id: str, target: Path) -> None:
        """Download the report of a regression (HTML) into a file."""
        self._download(f"/regressions/{_part(regression_id)}/report", target)

    # Alarms

    def list_alarms(
        self,
        *,
        states: Sequence[str] = (),
        severity: str | None = None,
        spacecraft_id: int | None = None,
        instance: str | None = None,
    ) -> Listing[Alarm]:
        """List alarms, open ones first; no states: in any state."""
        return self._list(
            Alarm,
            "/alarms",
            state=list(states) or None,
            severity=severity,
            spacecraft_id=spacecraft_id,
            instance=instance,
        )

    def get_alarm(self, alarm_id: int) -> AlarmDetail:
        """Return an alarm with its history."""
        return self._get(AlarmDetail, f"/alarms/{alarm_id}")

    def acknowledge_alarm(self, alarm_id: int, *, comment: str = "") -> AlarmDetail:
        """Acknowledge an alarm; it is cleared when its condition has ended as well."""
        return self._post(AlarmDetail, f"/alarms/{alarm_id}/acknowledge", {"comment": comment})

    def shelve_alarm(self, alarm_id: int, until: str, *, comment: str = "") -> AlarmDetail:
        """Suppress an alarm until a time (RFC 3339); a time in the past ends this."""
        return self._post(AlarmDetail, f"/alarms/{alarm_id}/shelve", {"until": until, "comment": comment})

    # Jobs

    def get_status(self) -> ServiceStatus:
        """Return the condition of the deployment: waiting work, disk, backups, time correlations, scheduler."""
        return self._get(ServiceStatus, "/status")

    def list_jobs(self, *, kind: str | None = None) -> Listing[Job]:
        """List jobs, newest first."""
        return self._list(Job, "/jobs", kind=kind)

    def get_job(self, job_id: str) -> Job:
        """Return a job: its state, progress and result."""
        return self._get(Job, f"/jobs/{_part(job_id)}")

    def wait(self, job_id: str, *, progress: Callable[[Job], None] | None = None) -> Job:
        """Return a job when it is done.

        Raises
        ------
        JobFailed
            The job failed; the message is its error.
        """
        pause = FIRST_WAIT_S
        while True:
            job = self.get_job(job_id)
            if job.state == "failed":
                raise JobFailed(422, str(job.error))
            if progress is not None:
                progress(job)
            if job.state == "done":
                return job
            time.sleep(pause)
            pause = min(2.0 * pause, LONGEST_WAIT_S)

    # Users, tokens, sessions and the audit log

    def start_session(self, token: str) -> Session:
        """Start a browser session; its cookie is that of this client from now on."""
        return self._post(Session, "/session", {"token": token})

    def get_session(self) -> Session:
        """Return the user, role and end of validity of this client."""
        return self._get(Session, "/session")

    def end_session(self) -> None:
        """End the browser session of this client."""
        self._octets("DELETE", "/session")

    def list_users(self) -> Listing[User]:
        """List all users."""
        return self._list(User, "/users", paged=False)

    def add_user(self, name: str, role: str, *, days_valid: float | None = None) -> UserWithToken:
        """Add a user; the token cannot be read again."""
        return self._post(UserWithToken, "/users", {"name": name, "role": role, "days_valid": days_valid})

    def get_user(self, name: str) -> User:
        """Return a user."""
        return self._get(User, f"/users/{_part(name)}")

    def change_user(self, name: str, *, state: str | None = None, role: str | None = None) -> User:
        """Enable or disable a user, or change the role."""
        change = {key: value for key, value in (("state", state), ("role", role)) if value is not None}
        return self._call(User, "PATCH", f"/users/{_part(name)}", body=change)

    def add_token(
        self, name: str, *, days_valid: float | None = None, revoke_others: bool = False
    ) -> UserWithToken:
        """Create a token for a user; it cannot be read again."""
        request = {"days_valid": days_valid, "revoke_others": revoke_others}
        return self._post(UserWithToken, f"/users/{_part(name)}/tokens", request)

    def list_tokens(self, *, user: str | None = None) -> Listing[Token]:
        """List tokens without their secrets, newest first."""
        return self._list(Token, "/tokens", paged=False, user=user)

    def revoke_token(self, token_id: int) -> None:
        """Revoke a token."""
        self._octets("DELETE", f"/tokens/{token_id}")

    def list_audit(
        self,
        *,
        actor: str | None = None,
        action: str | None = None,
        target: str | None = None,
        since: str | None = None,
        until: str | None = None,
    ) -> Listing[AuditEntry]:
        """List the entries of the audit log, newest first."""
        return self._list(
            AuditEntry, "/audit", actor=actor, action=action, target=target, since=since, until=until
        )

    def get_audit_head(self) -> AuditHead:
        """Return number and hash of the newest entry of the audit log."""
        return self._get(AuditHead, "/audit/head")

    def _result(self, job: Job) -> dict[str, Any]:
        return self.wait(job.id).result or {}


def _part(text: str) -> str:
    """Return a text as one segment of a path."""
    return quote(text, safe="")


def _name_of(file: Path | bytes) -> str | None:
    return file.name if isinstance(file, Path) else None


def _match(tag: str | None) -> dict[str, str]:
    return {} if tag is None else {"If-Match": tag}
