"""Overview of a report for the web pages: verdict, headline figures and downsampled error series."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from ground_service.evaluation import store
from ground_service.evaluation.model import PassFigures, ReportOverview, ReportSummary, StoredReport
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.passes.core import downsample
from ground_service.store.files import FileArchive

PREFERRED_ESTIMATORS = ("anchored", "spherical", "paper")
"""Order in which the estimator of the main figures is chosen."""

_TEXTS = ("title", "verdict", "verdict_level", "evidence_level", "created_utc", "headline", "not_available")


def report_overview(ground: Ground, report_id: str, max_points: int) -> ReportOverview:
    """Return the header of a report and the 3-D error of each navigation solution in at most `max_points` intervals.

    The columns of a series have equal length: UTC in seconds at the middle of each interval, minimum, maximum and mean
    error in metres, and whether a gap precedes the interval.
    """
    sha256 = ground.read(store.get_report, report_id).json_sha256
    return ReportOverview(report_id=report_id, **_overview(ground.files, sha256, max_points))


def newest_reports(ground: Ground, pass_ids: Sequence[int]) -> list[ReportSummary]:
    """Return verdict and main figures of the newest report of each of these passes that has one."""
    with ground.database.reading() as connection:
        return [_summary(one) for one in store.newest_reports(connection, pass_ids)]


def _summary(report: StoredReport) -> ReportSummary:
    figures = PassFigures.model_validate(report.summary)
    names = [name for name in PREFERRED_ESTIMATORS if name in figures.navigation]
    estimator = names[0] if names else None
    return ReportSummary(
        id=report.id,
        pass_id=report.pass_id,
        created=UtcTime(report.created_utc_ns),
        verdict=figures.verdict,
        verdict_level=figures.verdict_level,
        evidence_level=figures.evidence_level,
        estimator=estimator,
        median_error_m=None if estimator is None else figures.navigation[estimator].median_3d_m,
        recall=figures.detector.recall,
        frames=figures.frames,
    )


@lru_cache(maxsize=64)
def _overview(files: FileArchive, sha256: str, max_points: int) -> dict[str, Any]:
    """Return the overview of a stored document; documents never change, so results are cached."""
    document = json.loads(files.get(sha256))
    return {
        **{name: document.get(name) for name in _TEXTS},
        # Reports of earlier versions have no table.
        "requirements": document.get("requirements") or [],
        "navigation": [_series(one, max_points) for one in document["navigation"]],
    }


def _series(one: Mapping[str, Any], max_points: int) -> dict[str, Any]:
    error = np.array(one["error_rtn_m"], dtype=np.float64).reshape(-1, 3)
    times = np.array(one["utc_ns"], dtype=np.int64)
    buckets = downsample(times, np.sqrt(np.sum(error**2, axis=1)), max_points)
    middle = (buckets.start_utc_ns // 2 + buckets.stop_utc_ns // 2) / 1e9
    return {
        "name": one["name"],
        "kind": one["kind"],
        "time_s": np.round(middle, 3).tolist(),
        "min_m": np.round(buckets.low, 3).tolist(),
        "max_m": np.round(buckets.high, 3).tolist(),
        "mean_m": np.round(buckets.mean, 3).tolist(),
        "after_gap": buckets.after_gap.tolist(),
    }
