"""Preparation of a live pass for its evaluation: reference, time correlation, and the crater catalogue of its track.

An archive brings these with it. For a pass that was received live they follow from the mission description in force.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError, InvalidInput
from ground_service.evaluation.inputs import reference_of
from ground_service.evaluation.navigation.alignment import ReferenceStates, reference_states
from ground_service.ground import Ground
from ground_service.missions.catalogues import catalogue_of
from ground_service.missions.frames import assumed_camera, camera_of, declared_frames
from ground_service.missions.model import Mission
from ground_service.missions.service import mission_of_pass
from ground_service.passes import store as passes
from ground_service.passes.model import PassRecord
from ground_service.passes.span import pass_span
from ground_service.store.files import register_file
from lunar.catalogue import CraterCatalogue, format_catalogue
from lunar.constants import MOON_RADIUS_M, NANOSECONDS_PER_SECOND
from lunar.ephemeris import Ephemeris
from lunar.messages.ephemeris_files import load_ephemeris

TRACK_STEP_S = 15.0
MARGIN_M = 10_000.0
"""Added to the view of the camera, for errors of pointing and of the reference."""

REACH_LIMIT = 0.1
"""Largest reach as a share of the lunar radius: beyond it craters are foreshortened at the limb."""


def align_pass(ground: Ground, pass_id: int) -> dict[str, Any]:
    """Relate a pass to its reference, correlations and crater catalogue; return what was found and what is missing.

    The catalogue of a live pass is cut from the one that its mission description names and stored with the pass, once.
    What is missing is no error: the pass is evaluated without it, and again when it arrives.
    """
    with ground.database.reading() as connection:
        record = passes.get_pass(connection, pass_id)
        mission = mission_of_pass(connection, record.mission_id, record.manifest)
        span = pass_span(connection, record)
        reference = reference_of(connection, record)
    missing: dict[str, str] = {}
    if reference is None:
        missing["reference"] = "no reference ephemeris covers the pass"
    if not span.correlations:
        missing["correlation"] = "no time correlation: the on-board clock is taken as ideal"
    if not record.manifest.get("start_state"):
        missing["start_state"] = "no start state was uploaded"
    if assumed := assumed_camera(mission.camera):
        missing["camera"] = assumed
    sha256 = record.catalogue_sha256
    if sha256 is None and record.archive_digest is None and reference is not None:
        try:
            ephemeris = load_ephemeris(ground.files.path(reference.sha256))
            sha256 = _store_catalogue(ground, mission, ephemeris, record)
        except GroundError as error:
            missing["catalogue"] = str(error)
    elif sha256 is None:
        missing["catalogue"] = (
            "no reference to cut the catalogue along" if reference is None else "none archived"
        )
    return {
        "reference": None if reference is None else reference.name,
        "correlations": [one.id for one in span.correlations],
        "catalogue_sha256": sha256,
        "missing": missing,
    }


def _store_catalogue(ground: Ground, mission: Mission, reference: Ephemeris, record: PassRecord) -> str:
    """Cut the catalogue of a mission to the track of a pass, and store it with the pass; return its SHA-256."""
    catalogue = catalogue_of(ground, mission)
    orientation = declared_frames(mission.frames, ground.data).orientation
    if orientation is None:
        raise InvalidInput(mission.name, "frames.orientation", "an available lunar orientation", "none")
    half_diagonal = math.sqrt(2.0) * math.tan(camera_of(mission.camera).fov_rad / 2.0)
    reach = half_diagonal + math.tan(math.radians(abs(mission.camera.tilt_deg or 0.0)))
    step_ns = round(TRACK_STEP_S * NANOSECONDS_PER_SECOND)
    utc_ns = np.arange(record.start_utc_ns, record.stop_utc_ns + step_ns, step_ns, dtype=np.int64)
    track = reference_states(reference, orientation, utc_ns)
    octets = format_catalogue(along_track(catalogue, track, reach)).encode("ascii")
    stored = ground.files.put_octets(octets)
    with ground.database.writing() as connection:
        register_file(connection, stored, "pass catalogue", catalogue.source, utc_now_ns())
        passes.set_catalogue(connection, record, stored.sha256, catalogue.source)
    return stored.sha256


def along_track(catalogue: CraterCatalogue, track: ReferenceStates, reach: float) -> CraterCatalogue:
    """Return the craters that a camera can see from any covered position of a track.

    Parameters
    ----------
    reach
        Distance on the ground from the sub-satellite point to the edge of the view, over the altitude.
    """
    near = [
        catalogue.near(
            float(track.latitude_rad[i]),
            float(track.longitude_rad[i]),
            float(min(reach * track.altitude_m[i], REACH_LIMIT * MOON_RADIUS_M)) + MARGIN_M,
        )
        for i in np.flatnonzero(track.covered)
    ]
    return catalogue.select(np.unique(np.concatenate(near)) if near else np.zeros(0, dtype=np.int64))
