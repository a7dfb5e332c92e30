"""Parameters of the anchored estimator: what may be tuned, and the limits of plausibility."""

from dataclasses import dataclass, field

from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.filter.attitude_monitor import MonitorParameters
from payload_emulator.flight.navigation.filter.dynamics import ProcessNoise
from payload_emulator.flight.navigation.filter.filter import CommonErrors
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule
from payload_emulator.flight.navigation.landmark_map import MappingParameters
from payload_emulator.flight.navigation.search.acquisition import AcquisitionParameters
from payload_emulator.flight.navigation.search.identification import IdentificationParameters
from payload_emulator.flight.navigation.search.lost_in_space import LostParameters


@dataclass(frozen=True, slots=True)
class AnchoredLimits:
    """Plausibility limits, gap limits and gates of the anchored mode, each with its reason.

    Attributes
    ----------
    lowest_radius_m, highest_radius_m
        Distances from the Moon's centre outside which an estimate is invalid: 10 km below the reference sphere, below
        all terrain, and 1,000 km above it, far above the altitudes at which craters are resolved.
    correction_sigmas
        A position correction larger than this number of predicted standard deviations is rejected: a correct fix
        exceeds 7 once in 1e10 fixes (chi-square of 3 degrees above 49), so the cause is a wrong identification.
    crater_memory_s
        Longest gap over which craters remain in the state vector. At 50 km altitude a crater crosses the image in 105
        s, at 100 km in 215 s; after that it is out of view.
    search_sigmas, search_margin_px
        Craters outside the predicted image are searched up to this number of standard deviations of the position (3.5
        misses 1 in 2,000 per axis), and at most this distance outside: with 200 px around a 512 px image the search
        area, and therefore the number of chance matches, is three times that of the image.
    map_margin_px
        Craters up to this distance outside the predicted image are matched to detections at its edge before these are
        mapped as new landmarks.
    lowest_altitude_m
        Lower bound of the altitude that scales pixels to metres, so that a poor prediction does not divide by zero.
    smallest_variance_px2
        The repeatability of a detector is not better than 0.2 px: without a floor, two sightings of a crater would give
        the same equation twice.
    frame_gate_sigmas
        Normal quantile of the probability that the NIS of a correct fix passes: 4.265 is 1 - 1e-5, one correct fix
        rejected in 35 days with a frame every 15 s for half of the time.
    agreement_share
        A fix must explain this share of the possible detections or craters, whichever are fewer; otherwise image and
        map disagree. A correct fix explains a share equal to the detector's recall, 0.6, a chance match a few craters.
    judged_craters
        With fewer craters or detections a frame does not show whether image and map agree.
    lost_search_every
        Search without a prior only in every n-th frame: a search takes up to a second.
    search_radius_sigmas
        Number of standard deviations that the half width of the widened search represents.
    search_largest_m
        Largest standard deviation of the position that a search by votes covers. Its time grows with the area: 28 km
        are an area of 200 km by 200 km (`AcquisitionParameters.prior_sigmas`), beyond that the search without a prior
        is faster.
    found_sigmas, found_position_m, found_velocity_m_s
        Initial uncertainty of the filter after a search without a prior: this multiple of the standard deviation of the
        position plus a floor, which covers the offset of the catalogue, and a floor of the velocity.
    """

    lowest_radius_m: float = MOON_RADIUS_M - 10e3
    highest_radius_m: float = MOON_RADIUS_M + 1_000e3
    correction_sigmas: float = 7.0
    crater_memory_s: float = 240.0
    search_sigmas: float = 3.5
    search_margin_px: float = 200.0
    map_margin_px: float = 20.0
    lowest_altitude_m: float = 1_000.0
    smallest_variance_px2: float = 0.04
    frame_gate_sigmas: float = 4.265
    agreement_share: float = 0.25
    judged_craters: int = 4
    lost_search_every: int = 3
    search_radius_sigmas: float = 3.0
    search_largest_m: float = 28e3
    found_sigmas: float = 3.0
    found_position_m: float = 200.0
    found_velocity_m_s: float = 1.0


@dataclass(frozen=True, slots=True)
class AnchoredParameters:
    """Tunable parameters of the anchored mode.

    Attributes
    ----------
    gravity_degree
        Degree to which the gravity table is used.
    noise
        Process noise; None uses the noise that belongs to the gravity table and the degree.
    detection_sigma_px, detection_sigma_floor_px, detection_sigma_scale
        Sigma per axis of a detection if the detector gives none; smallest accepted sigma; factor on the detector's
        sigma.
    detection_persistence
        Share of a detection's variance that is common to all frames of a crater, where the detector does not state it.
    tracking_limit_m
        Largest position sigma with which the search uses a linear prediction; above it, the search uses votes. It is
        valid at mission altitudes and grows above them (`ground_scale`).
    search_radius_m
        Half width of the widened search after a disagreement between map and images.
    divergence_limit_m
        Position sigma beyond which the estimate counts as lost.
    suspicion_frames
        Number of consecutive disagreeing frames before the search is widened.
    lost_frames, lost
        Number of consecutive disagreeing frames before the position is searched without a prior, and the parameters of
        that search.
    map_landmarks, mapping
        Whether craters that are not in the catalogue are mapped and used on later passes, and the parameters of this.
    monitor
        Parameters of the monitor of the attitude.
    limits
        Plausibility limits, gap limits and gates.
    offset
        How the size of the catalogue's common offset is learned; None keeps that of `errors`.
    crater_limit
        Largest number of craters used in one frame, the most certain first. More craters add little, because the errors
        of attitude and catalogue are common to all.
    """

    gravity_degree: int = 100
    noise: ProcessNoise | None = None
    errors: CommonErrors = field(default_factory=CommonErrors)
    identification: IdentificationParameters = field(default_factory=IdentificationParameters)
    acquisition: AcquisitionParameters = field(default_factory=AcquisitionParameters)
    detection_sigma_px: float = 1.5
    detection_sigma_floor_px: float = 0.5
    detection_sigma_scale: float = 1.0
    detection_persistence: float = 0.3
    tracking_limit_m: float = 1_500.0
    search_radius_m: float = 25_000.0
    divergence_limit_m: float = 5_000.0
    suspicion_frames: int = 4
    lost_frames: int = 6
    lost: LostParameters = field(default_factory=LostParameters)
    map_landmarks: bool = True
    mapping: MappingParameters = field(default_factory=MappingParameters)
    crater_limit: int = 32
    monitor: MonitorParameters = field(default_factory=MonitorParameters)
    limits: AnchoredLimits = field(default_factory=AnchoredLimits)
    # Without it the text, and so the hash in telemetry, is that of builds that learned nothing.
    offset: OffsetRule | None = field(default=None, repr=False)
