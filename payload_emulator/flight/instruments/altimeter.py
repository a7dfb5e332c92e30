"""Laser altimeter on board: ranges to a surface that is known from the rims of catalogued craters only.

The surface below the beam is the weighted mean of the rim radii of near craters, lowered by the height of rims above
the ground between them. Its error is estimated from the scatter of those radii, so that mare is trusted more than
highland. The error is the same for ranges to neighbouring ground: `lasting_share` of a measurement says by how much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.frames import matrix_from_rotation_vector, rotation_vector_from_matrix
from payload_emulator.flight.instruments import FlightInstrument, Knowledge, Measured, Reading
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.filter import FilterState
from payload_emulator.flight.navigation.scalar import Model, ScalarMeasurement, ScalarPrediction
from payload_emulator.flight.navigation.sighting import LandmarkMap
from tmtc.cuc import TICKS_PER_SECOND

_NAN = float("nan")
_UP = 2


@dataclass(frozen=True, slots=True)
class AltimeterParameters:
    """Use of the ranges.

    Attributes
    ----------
    range_sigma_m
        Standard deviation of a range to known ground.
    surface_reach_m, surface_smoothing_m, surface_craters
        The surface is known from this number of craters or more up to this distance; a crater at a distance d has the
        weight 1 / (d^2 + smoothing^2).
    rim_height_share
        Height of rims above the ground between craters as a share of the diameter.
    surface_sigma_floor_m
        Relief between craters, added to the scatter of their rims as a variance: where the rims scatter by 110 m, the
        real ground between them differs from their mean by 200 to 270 m.
    surface_correlation_m
        Distance on the ground after which the correlation of the surface error has decreased to 1/e.
    attitude_sigma_rad
        Uncertainty of the boresight where attitude comes without one.
    gate_sigmas
        Ranges beyond this number of predicted standard deviations are refused. Terrain has longer tails than a normal
        distribution.
    attitude_age_s
        Longest time between two frames over which the attitude is interpolated.
    """

    range_sigma_m: float = 1.0
    surface_reach_m: float = 50_000.0
    surface_smoothing_m: float = 5_000.0
    surface_craters: int = 3
    rim_height_share: float = 0.03
    surface_sigma_floor_m: float = 250.0
    surface_correlation_m: float = 15_000.0
    attitude_sigma_rad: float = 2e-4
    gate_sigmas: float = 4.0
    attitude_age_s: float = 60.0


def step(
    parameters: AltimeterParameters, newest_ticks: int | None, samples: FloatArray, knowledge: Knowledge
) -> Reading:
    """Return the ranges as measurements of the orbit; the state is the on-board time of the newest range."""
    rows: list[dict[str, object]] = []
    measurements: list[Measured] = []
    for k, (time, range_m) in enumerate(samples.tolist()):
        ticks = int(time)
        camera_from_icrf = attitude_at(ticks, knowledge, parameters.attitude_age_s)
        row: dict[str, object] = {"sample_ticks": ticks, "range_m": range_m}
        if not math.isfinite(range_m):
            row |= {"sample_status": "no_data", "innovation": _NAN, "innovation_sigma": _NAN}
        elif camera_from_icrf is None:
            row |= {"sample_status": "no_model", "innovation": _NAN, "innovation_sigma": _NAN}
        else:
            since_s = math.inf if newest_ticks is None else (ticks - newest_ticks) / TICKS_PER_SECOND
            sigma_rad = knowledge.attitude.sigma_rad
            model = range_model(
                parameters,
                camera_from_icrf[_UP],
                parameters.attitude_sigma_rad if sigma_rad is None else sigma_rad,
                since_s,
            )
            measurements.append(Measured(k, ScalarMeasurement(ticks, range_m, model, parameters.gate_sigmas)))
            newest_ticks = ticks
        rows.append(row)
    return Reading(newest_ticks, tuple(rows), measurements=tuple(measurements))


def attitude_at(ticks: int, knowledge: Knowledge, longest_s: float) -> FloatArray | None:
    """Return the attitude between two frames, turned at a constant rate from one to the other; None where unknown."""
    now = knowledge.attitude.camera_from_icrf
    if now is None:
        return None
    if ticks == knowledge.ticks:
        return now
    if knowledge.before is None:
        return None
    before_ticks, before = knowledge.before
    span = knowledge.ticks - before_ticks
    if not 0 < span <= longest_s * TICKS_PER_SECOND or ticks < before_ticks:
        return None
    turn = rotation_vector_from_matrix(now @ before.T)
    return matrix_from_rotation_vector((ticks - before_ticks) / span * turn) @ before


def range_model(
    parameters: AltimeterParameters, boresight_icrf: FloatArray, attitude_sigma_rad: float, since_s: float
) -> Model:
    """Return the model of a range along a boresight, `since_s` after the range before.

    With the place p, the unit boresight b and the ground point f = p + t b on the sphere of radius rho the derivatives
    of the range t are dt/dp = -f / (f . b) and dt/drho = rho / (f . b), from |p + t b| = rho.
    """

    def model(
        prior: FilterState, mcmf_from_icrf: FloatArray, landmarks: LandmarkMap
    ) -> ScalarPrediction | None:
        position = mcmf_from_icrf @ prior.mean[kalman.POSITION]
        boresight = mcmf_from_icrf @ boresight_icrf
        ground = _meeting(position, boresight, MOON_RADIUS_M)
        known = None if ground is None else surface(parameters, landmarks, ground)
        if known is None:
            return None
        radius_m, sigma_m = known
        radius_m += float(prior.mean[kalman.OFFSET][_UP])
        ground = _meeting(position, boresight, radius_m)
        if ground is None:
            return None
        slant = float(ground @ boresight)
        design = np.zeros(prior.mean.size)
        design[kalman.POSITION] = -(mcmf_from_icrf.T @ ground) / slant
        design[kalman.OFFSET.start + _UP] = radius_m / slant
        range_m = float(np.linalg.norm(ground - position))
        # A turn of the boresight moves the ground point; the range changes with the tangent of the incidence.
        aside = range_m * math.sqrt(max((radius_m / slant) ** 2 - 1.0, 0.0))
        sigma_m = math.sqrt(
            (sigma_m * radius_m / slant) ** 2
            + parameters.range_sigma_m**2
            + (attitude_sigma_rad * aside) ** 2
        )
        along_m = float(np.linalg.norm(prior.mean[kalman.VELOCITY])) * since_s
        share = math.exp(-along_m / parameters.surface_correlation_m)
        return ScalarPrediction(range_m, design, sigma_m, share)

    return model


def surface(
    parameters: AltimeterParameters, landmarks: LandmarkMap, ground_mcmf_m: FloatArray
) -> tuple[float, float] | None:
    """Return radius of the surface below a place and its standard deviation; None with too few craters around."""
    direction = ground_mcmf_m / np.linalg.norm(ground_mcmf_m)
    near = landmarks.near(direction, parameters.surface_reach_m / MOON_RADIUS_M)
    if near.size < parameters.surface_craters:
        return None
    places = landmarks.position_mcmf_m[near]
    radii = np.linalg.norm(places, axis=1)
    distance_m = MOON_RADIUS_M * np.linalg.norm(places / radii[:, None] - direction, axis=1)
    weight = 1.0 / (distance_m**2 + parameters.surface_smoothing_m**2)
    weight /= weight.sum()
    heights = radii - parameters.rim_height_share * landmarks.diameter_m[near]
    mean = float(weight @ heights)
    # The place itself scatters like the craters do, and their weighted mean by the sum of squared weights less.
    scatter = float(weight @ (heights - mean) ** 2) * (1.0 + float(weight @ weight))
    return mean, math.hypot(math.sqrt(scatter), parameters.surface_sigma_floor_m)


def _meeting(position_m: FloatArray, boresight: FloatArray, radius_m: float) -> FloatArray | None:
    """Return where a ray meets a sphere about the origin first, shape (3,); None where it passes or leads away."""
    along = float(position_m @ boresight)
    inside = along**2 - float(position_m @ position_m) + radius_m**2
    if along >= 0.0 or inside <= 0.0:
        return None
    return np.asarray(position_m + (-along - math.sqrt(inside)) * boresight)


INSTRUMENT = FlightInstrument(
    name="altimeter",
    columns=("ticks", "range_m"),
    parameters=AltimeterParameters,
    start=lambda parameters: None,
    step=step,
)
