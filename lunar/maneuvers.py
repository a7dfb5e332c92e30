"""Orbit maintenance by impulsive burns, the rule of the LINNA paper (section V-B.1).

Whenever the altitude of a periselene has fallen below the limit, a pair of burns follows, as in a Hohmann transfer:
at the next aposelene one along track that lifts the following periselene to a (1 - e) of the wanted orbit, at that
periselene one along track that brings the aposelene to a (1 + e).  Each burn leaves the velocity horizontal.  Apsides
are the zeros of radial speed on the dense output of the propagation: burns lie at apsides of the perturbed orbit.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar import constants
from lunar.arrays import FloatArray
from lunar.elements import Elements, elements_from_icrf_state
from lunar.errors import OrbitError
from lunar.propagation import MAX_STEP_S, RTOL, Arc, ForceModel, Trajectory, integrate_arc, join, state_vector
from lunar.timescales import utc_ns_from_tdb_s


@dataclass(frozen=True, slots=True)
class ManeuverRule:
    """Rule for burns, and the orbit to which they return."""

    periselene_altitude_m: float = 15_000.0
    semi_major_axis_m: float = 1_768_180.0
    eccentricity: float = 0.006


@dataclass(frozen=True, slots=True, eq=False)
class Maneuver:
    """One impulsive burn; elements are osculating, in the Moon's equator and node of date (MCI)."""

    utc_ns: int
    tdb_s: float
    place: str
    delta_v_icrf_m_s: FloatArray
    before: Elements
    after: Elements

    @property
    def delta_v_m_s(self) -> float:
        """Size of the burn, m/s."""
        return float(np.linalg.norm(self.delta_v_icrf_m_s))


def propagate_with_maneuvers(
    epoch_tdb_s: float,
    position_icrf_m: ArrayLike,
    velocity_icrf_m_s: ArrayLike,
    duration_s: float,
    model: ForceModel,
    rule: ManeuverRule,
    rtol: float = RTOL,
    max_step_s: float = MAX_STEP_S,
) -> tuple[Trajectory, tuple[Maneuver, ...]]:
    """Return the maintained orbit over ``duration_s`` (forwards only), and its burns in order of time.

    Raises
    ------
    ImpactError
        Where the orbit meets the ground in spite of the rule.
    OrbitError
        Where the span is negative or the rule asks for an orbit that dips below ground.
    """
    from lunar import _dynamics_kernel as kernel

    wanted_periselene = rule.semi_major_axis_m * (1.0 - rule.eccentricity)
    wanted_aposelene = rule.semi_major_axis_m * (1.0 + rule.eccentricity)
    limit = constants.MOON_RADIUS_M + rule.periselene_altitude_m
    if duration_s < 0.0:
        raise OrbitError(f"propagation with manoeuvres: expected a span of 0 s or more, found {duration_s} s")
    if not (0.0 <= rule.eccentricity < 1.0 and wanted_periselene > limit):
        raise OrbitError(
            "manoeuvre rule: expected an orbit whose periselene is above the limit of "
            f"{rule.periselene_altitude_m / 1e3:g} km, found one at "
            f"{(wanted_periselene - constants.MOON_RADIUS_M) / 1e3:.3f} km"
        )

    def arc_to(time_s: float, state: FloatArray, event: int, radius_m: float, step_s: float) -> Arc:
        return integrate_arc(
            epoch_tdb_s,
            time_s,
            state,
            float(duration_s),
            model,
            rtol,
            max_step_s,
            constants.MOON_RADIUS_M,
            event=event,
            event_radius_m=radius_m,
            first_step_s=step_s,
        )

    arcs: list[Arc] = []
    burns: list[Maneuver] = []
    time, state, step = 0.0, state_vector(position_icrf_m, velocity_icrf_m_s), 10.0
    # Wait for a low periselene; burn at the next aposelene (any radius); burn at the next periselene (any radius).
    phase = 0
    events = ((kernel.PERISELENE, limit), (kernel.APOSELENE, 0.0), (kernel.PERISELENE, math.inf))
    while True:
        arc = arc_to(time, state, *events[phase], step)
        arcs.append(arc)
        time, state, step = float(arc.elapsed_s[-1]), arc.states[-1].copy(), arc.next_step_s
        if arc.status != kernel.EVENT or time >= duration_s:
            break
        if phase:
            target = wanted_periselene if phase == 1 else wanted_aposelene
            state, burn = _burn(epoch_tdb_s + time, "aposelene" if phase == 1 else "periselene", state, target, model)
            burns.append(burn)
        phase = (phase + 1) % 3
    return join(epoch_tdb_s, arcs), tuple(burns)


def _burn(
    tdb_s: float, place: str, state: FloatArray, opposite_radius_m: float, model: ForceModel
) -> tuple[FloatArray, Maneuver]:
    """Return the state after a burn that sets the radius of the opposite apsis, and the burn."""
    position, velocity = state[:3], state[3:]
    gm = model.gm_m3_s2
    radius = float(np.linalg.norm(position))
    up = position / radius
    along = velocity - (velocity @ up) * up
    along /= np.linalg.norm(along)
    speed = math.sqrt(2.0 * gm * opposite_radius_m / (radius * (radius + opposite_radius_m)))
    after = np.concatenate([position, speed * along])
    burn = Maneuver(
        utc_ns_from_tdb_s(tdb_s),
        tdb_s,
        place,
        after[3:] - velocity,
        elements_from_icrf_state(position, velocity, tdb_s, gm),
        elements_from_icrf_state(position, after[3:], tdb_s, gm),
    )
    return after, burn
