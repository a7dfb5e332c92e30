"""Place of the camera from a few frames that an orbit links, where no frame alone is safe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import GM_MOON_M3_S2
from payload_emulator.flight.navigation.lost_in_space import LostParameters, Place, distance_m
from payload_emulator.flight.vision.detections import Detections

FRAMES_COMBINED = 4

# Candidates of each frame that take part.
_CANDIDATES_COMBINED = 12
# Two places of one orbit: what relief and a bent track add to their sigmas, the number of sigmas, the share by which
# the speed of an elliptical orbit differs from a circular one, and the radial speed at an eccentricity of 0.02.
_TRACK_DOUBT_M, _DOUBT_SIGMAS, _SPEED_SHARE, _RADIAL_SPEED_M_S = 1_500.0, 3.0, 0.05, 33.0
# Legs longer than this show the direction of flight, which two legs of an orbit share to this cosine.
_SHORTEST_LEG_M, _LEG_COSINE = 5_000.0, 0.9


@dataclass(frozen=True, slots=True, eq=False)
class LostFrame:
    """One frame of a search over several: detections, one sigma of each centre, and the time since the first."""

    found: Detections
    sigma_px: FloatArray
    elapsed_s: float


def place_of_frames(
    candidates: Sequence[Sequence[Place]],
    frames: Sequence[LostFrame],
    parameters: LostParameters,
) -> tuple[Place, ...] | None:
    """Return the places of frames in order of time from the candidate places of each; None where none is safe.

    Places of different frames support each other if an orbit leads from one to the next: the distance is that of a
    circular orbit to five per cent, altitude changes little, the heading stays.
    """
    per_frame = [places[:_CANDIDATES_COMBINED] for places in candidates]
    chains: list[tuple[float, tuple[tuple[int, Place], ...]]] = []
    for number, places in enumerate(per_frame):
        grown: list[tuple[float, tuple[tuple[int, Place], ...]]] = []
        grown += [(place.log_false, ((number, place),)) for place in places]
        for _, chain in list(chains):
            for place in places:
                longer = (*chain, (number, place))
                if _one_orbit(longer, frames):
                    grown.append((_log_false_of_chain(longer, parameters), longer))
        chains += grown
    chains.sort(key=lambda item: item[0])
    if not chains or chains[0][0] > math.log(parameters.false_fix_limit):
        return None
    best = chains[0][1]
    # A rival is what comes near the best, and a place of one frame that would be safe if it were alone.
    near, alone = chains[0][0] + math.log(parameters.rival_ratio), math.log(parameters.false_fix_limit)
    for log_false, chain in chains[1:]:
        if log_false > near and (len(chain) > 1 or log_false > alone):
            continue
        if not _one_orbit(tuple(sorted((*best, *chain), key=lambda item: item[0])), frames):
            return None
    return tuple(place for _, place in best)


def _log_false_of_chain(chain: tuple[tuple[int, Place], ...], parameters: LostParameters) -> float:
    """Return the logarithm of the largest probability that chance makes up a chain as good as this.

    The first place may be anywhere; the next lies on a ring about it, a further one near a point. What a ring and a
    point leave of the poses of a whole search is at most one in two thousand and one in two million.
    """
    total = 0.0
    for number, (_, place) in enumerate(chain):
        freed = (0.0, math.log(2e3), math.log(2e6))[min(number, 2)]
        total += place.log_false - freed
        # A place takes part only where it has something to say.
        if number and place.log_false - freed > 0.0:
            return math.inf
    return total


def _one_orbit(chain: Sequence[tuple[int, Place]], frames: Sequence[LostFrame]) -> bool:
    """Return whether a low circular orbit leads through places in order of time."""
    for (a, first), (b, second) in pairwise(chain):
        elapsed_s = frames[b].elapsed_s - frames[a].elapsed_s
        apart_m = distance_m(first, second)
        doubt_m = _TRACK_DOUBT_M + _DOUBT_SIGMAS * float(np.hypot(first.sigma_m.max(), second.sigma_m.max()))
        if elapsed_s <= 0.0:
            if apart_m > doubt_m:
                return False
            continue
        radius = float(np.linalg.norm(first.position_mcmf_m))
        expected_m = math.sqrt(GM_MOON_M3_S2 / radius) * elapsed_s
        climb_m = abs(radius - float(np.linalg.norm(second.position_mcmf_m)))
        if (
            abs(apart_m - expected_m) > _SPEED_SHARE * expected_m + doubt_m
            or climb_m > _RADIAL_SPEED_M_S * elapsed_s + 2.0 * doubt_m
        ):
            return False
    for k in range(len(chain) - 2):
        legs = [chain[k + 1 + j][1].position_mcmf_m - chain[k + j][1].position_mcmf_m for j in range(2)]
        lengths = [float(np.linalg.norm(leg)) for leg in legs]
        if min(lengths) > _SHORTEST_LEG_M and legs[0] @ legs[1] < _LEG_COSINE * lengths[0] * lengths[1]:
            return False
    return True
