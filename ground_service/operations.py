"""The operators' work on a service of this machine, with the methods and values of `ground_service.client.Client`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ground_service.errors import InvalidInput
from ground_service.ground import Ground

View = dict[str, Any]


class LocalOperations:
    """Works on an opened service in the name of `actor`; closes the service at the end."""

    def __init__(self, ground: Ground, actor: str) -> None:
        self.ground = ground
        self._actor = actor

    def __enter__(self) -> LocalOperations:
        return self

    def __exit__(self, *_: object) -> None:
        self.ground.close()

    def list_passes(self, limit: int = 100) -> View:
        from ground_service.passes.service import list_passes

        return _page(*list_passes(self.ground, limit=limit))

    def pass_summary(self, pass_id: int) -> View:
        from ground_service.evaluation.service import pass_summary

        return pass_summary(self.ground, pass_id)

    def ingest_file(
        self,
        path: Path,
        *,
        spacecraft_id: int | None = None,
        instance: str = "flight",
        stream: str | None = None,
        offset: int = 0,
    ) -> View:
        from ground_service.ingest.service import Place, ingest_file

        place = None if stream is None else Place(stream, offset)
        return asdict(
            ingest_file(self.ground, path, spacecraft_id=spacecraft_id, instance=instance, place=place)
        )

    def import_archive(self, folder: Path) -> int:
        from ground_service.passes.archive_import import import_archive

        return import_archive(self.ground, folder)

    def make_report(self, pass_id: int, out: Path | None = None) -> View:
        from ground_service.evaluation.service import make_report

        made = make_report(self.ground, pass_id, out=out, pdf=True)
        return {
            "report": str(made.html),
            "report_json": str(made.json),
            "report_pdf": str(made.pdf),
            "report_id": made.report_id,
            **made.summary,
        }

    def add_ephemeris(self, path: Path, name: str | None = None, precedence: int = 0) -> View:
        from ground_service.ephemerides.service import add_ephemeris

        if not path.is_file():
            raise InvalidInput(str(path), "", "an ephemeris file", "nothing there")
        stored = self.ground.files.put_file(path)
        return add_ephemeris(
            self.ground, stored, name=name or path.name, precedence=precedence, actor=self._actor
        ).model_dump(mode="json")

    def list_missions(self, limit: int = 100) -> View:
        from ground_service.missions.service import list_missions

        return _page(*list_missions(self.ground, limit=limit))

    def add_mission(self, path: Path) -> View:
        from ground_service.missions.service import add_mission

        octets = _octets_of(path)
        return add_mission(self.ground, octets, source=str(path), actor=self._actor).model_dump(mode="json")

    def get_mission(self, revision: str) -> View:
        from ground_service.missions.service import get_mission

        return get_mission(self.ground, revision).model_dump(mode="json")

    def enter_command(self, name: str, arguments: Mapping[str, Any], **where: Any) -> View:
        from ground_service.commanding.service import enter_command

        return self.get_command(enter_command(self.ground, name, arguments, actor=self._actor, **where))

    def list_commands(self, limit: int = 100) -> View:
        from ground_service.commanding.service import list_commands

        views, total = list_commands(self.ground, limit=limit)
        return _page([view.telecommand for view in views], total)

    def get_command(self, command_id: int) -> View:
        from ground_service.commanding.service import get_command

        return get_command(self.ground, command_id).telecommand.model_dump(mode="json")

    def release_command(self, command_id: int) -> View:
        from ground_service.commanding.service import release_command

        release_command(self.ground, command_id, actor=self._actor)
        return self.get_command(command_id)

    def reject_command(self, command_id: int, reason: str) -> View:
        from ground_service.commanding.service import reject_command

        reject_command(self.ground, command_id, actor=self._actor, reason=reason)
        return self.get_command(command_id)

    def take_uplink(self, spacecraft_id: int, instance: str, form: str) -> tuple[bytes, list[int]]:
        from ground_service.commanding.service import take_uplink

        return take_uplink(
            self.ground,
            spacecraft_id=spacecraft_id,
            instance=instance,
            framed=form == "cltu",
            actor=self._actor,
        )

    def uplink_state(self, spacecraft_id: int, instance: str = "flight") -> View:
        from ground_service.commanding.receiver import uplink_state

        return uplink_state(self.ground, spacecraft_id, instance).model_dump(mode="json")

    def correlate(self, spacecraft_id: int, instance: str, points: list[View]) -> View:
        from ground_service.timekeeping.service import correlate_spacecraft, time_points

        rows = correlate_spacecraft(
            self.ground, spacecraft_id, instance, time_points(points), actor=self._actor
        )
        return _correlations(rows)

    def correlations(self, spacecraft_id: int, instance: str) -> View:
        from ground_service.timekeeping.service import spacecraft_correlations

        rows = spacecraft_correlations(self.ground, spacecraft_id, instance)
        return _correlations(rows)

    def correlate_again(self, spacecraft_id: int, instance: str) -> View:
        from ground_service.timekeeping.service import correlate_again

        rows = correlate_again(self.ground, spacecraft_id, instance, actor=self._actor)
        return _correlations(rows)

    def enter_receptions(self, spacecraft_id: int, instance: str, receptions: list[View]) -> View:
        from ground_service.timekeeping.recorrelation import enter_receptions, received_reports

        rows = enter_receptions(
            self.ground, spacecraft_id, instance, received_reports(receptions), actor=self._actor
        )
        return _correlations(rows)

    def time_reports(self, spacecraft_id: int, instance: str) -> View:
        from ground_service.timekeeping.model import TimeReport
        from ground_service.timekeeping.service import spacecraft_time_reports

        rows = spacecraft_time_reports(self.ground, spacecraft_id, instance)
        return _page([TimeReport.of(row) for row in rows], len(rows))

    def search_windows(self, request: Mapping[str, Any]) -> View:
        from ground_service.planning.service import search_windows

        return search_windows(self.ground, self._read("WindowSearch", request)).model_dump(mode="json")

    def add_window(self, request: Mapping[str, Any]) -> View:
        from ground_service.planning.service import add_window

        entry = self._read("WindowIn", request).entry()
        return add_window(self.ground, entry, actor=self._actor).model_dump(mode="json")

    def list_windows(self, limit: int = 100) -> View:
        from ground_service.planning.service import list_windows

        return _page(*list_windows(self.ground, limit=limit))

    def get_window(self, window_id: int) -> View:
        from ground_service.planning.service import get_window

        return get_window(self.ground, window_id).model_dump(mode="json")

    def change_window(self, window_id: int, request: Mapping[str, Any]) -> View:
        from ground_service.planning.service import change_window

        given = self._read("WindowChange", request)
        window = change_window(
            self.ground,
            window_id,
            actor=self._actor,
            changes=given.changes(),
            decision=given.state,
            reason=given.reason,
        )
        return window.model_dump(mode="json")

    def delete_window(self, window_id: int) -> None:
        from ground_service.planning.service import delete_window

        delete_window(self.ground, window_id, actor=self._actor)

    def uplink_window(self, window_id: int) -> View:
        from ground_service.planning.service import uplink_window

        views = [self.get_command(key) for key in uplink_window(self.ground, window_id, actor=self._actor)]
        return {"items": views, "total": len(views)}

    def export_plan(self) -> View:
        from ground_service.planning.exchange import export_plan

        return export_plan(self.ground).model_dump(mode="json")

    def import_plan(self, plan: Mapping[str, Any]) -> View:
        from ground_service.planning.exchange import import_plan

        windows = self._read("Plan", plan).windows
        return {"windows": import_plan(self.ground, windows, actor=self._actor)}

    def list_audit(
        self, *, limit: int = 100, since: str | None = None, until: str | None = None, **equal: Any
    ) -> View:
        from ground_service.access.audit_log import list_entries
        from ground_service.http.times import time_of

        entries, total = list_entries(
            self.ground,
            since_utc_ns=None if since is None else time_of(since, "since"),
            until_utc_ns=None if until is None else time_of(until, "until"),
            limit=limit,
            **equal,
        )
        return _page(entries, total)

    def audit_head(self) -> View:
        from ground_service.access.audit_log import audit_head

        return audit_head(self.ground).model_dump()

    def _read(self, name: str, request: Mapping[str, Any]) -> Any:
        """A request checked like one that comes over the wire."""
        from pydantic import ValidationError

        from ground_service.planning import model as plan_schemas

        try:
            return getattr(plan_schemas, name).model_validate(dict(request))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise InvalidInput(
                "request", where, first["msg"].lower(), repr(first.get("input"))[:80]
            ) from None


def _page(items: Any, total: int) -> View:
    return {"items": [one.model_dump(mode="json") for one in items], "total": total}


def _correlations(rows: Any) -> View:
    from ground_service.timekeeping.store import correlation_of

    return _page([correlation_of(row) for row in rows], len(rows))


def _octets_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidInput(str(path), "", "a file that can be read", error.strerror or str(error)) from None
