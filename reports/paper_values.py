"""Values of the document that repeats the figures and tables of the LINNA paper; conventions as in `reports.values`."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from reports.arrays import FloatArray
from reports.values import ByteArray, ClassScore, GalleryFrame, NavigationSeries, ReportCommon, TimeSpan, TrackSeries


@dataclass(frozen=True, slots=True)
class PaperOrbit:
    """Altitudes of the propagated month, and the frames that one day can give."""

    elements: Mapping[str, str]
    mean_km: float
    min_km: float
    max_km: float
    days: float
    maneuvers: int
    frames_of_a_day: int
    gravity: str


@dataclass(frozen=True, slots=True, eq=False)
class FovCurves:
    """Probability of at least n craters in the footprint, by field of view: arrays (k,)."""

    fov_deg: FloatArray
    probability_at_least: Mapping[int, FloatArray]
    selected_fov_deg: float
    positions: int
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueClasses:
    """Diameters of 5 to 30 km in kilometres (n,), and the counts of the three classes."""

    diameter_km: FloatArray
    counts: tuple[int, int, int]
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class PaperPicture:
    """An image, gray or RGB, with its caption and evidence level."""

    image: ByteArray
    caption: str
    level: str


@dataclass(frozen=True, slots=True)
class DatasetCounts:
    """Frames and labels of a data set by class."""

    frames: int
    instances: tuple[int, int, int]
    terrain: str


@dataclass(frozen=True, slots=True, eq=False)
class DetectorResult:
    """A network on the test split: scores by class and detections over some of its frames."""

    name: str
    description: str
    frames: int
    level: str
    per_class: tuple[ClassScore, ...]
    micro: ClassScore
    gallery: tuple[GalleryFrame, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PaperSession:
    """A flown session with its estimators relative to the reference.

    ``own_method`` is True for the paper's own method: class-only network and odometry. ``also`` are solutions that only
    the table of errors shows.
    """

    key: str
    heading: str
    description: str
    level: str
    own_method: bool
    frames: int
    track: TrackSeries
    series: tuple[NavigationSeries, ...]
    arcs: tuple[TimeSpan, ...]
    also: tuple[NavigationSeries, ...] = ()
    view: GalleryFrame | None = None


@dataclass(frozen=True, slots=True)
class PaperValue:
    """A number at a place of the paper; `paper` is None where the paper gives none."""

    place: str
    quantity: str
    unit: str
    paper: float | None
    here: float
    level: str

    @property
    def difference(self) -> float | None:
        """This system minus paper."""
        return None if self.paper is None else self.here - self.paper

    def row(self) -> dict[str, str | float | None]:
        """Return the number with its difference as plain data."""
        return asdict(self) | {"difference": self.difference}


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference between the paper and this system, explained in one sentence."""

    subject: str
    paper: str
    here: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class PaperReport(ReportCommon):
    """Content of the document; what could not be made has its reason in ``not_available``."""

    identity: str
    quick: bool
    orbit: PaperOrbit | None = None
    catalogue: CatalogueClasses | None = None
    fov: FovCurves | None = None
    region: PaperPicture | None = None
    samples: PaperPicture | None = None
    dataset: DatasetCounts | None = None
    detectors: tuple[DetectorResult, ...] = ()
    sessions: tuple[PaperSession, ...] = ()
    differences: tuple[Difference, ...] = ()
