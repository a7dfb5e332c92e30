"""Innovation monitoring of the attitude: detection of a sensor with more noise than its declared standard deviation.

An error of the attitude turns all craters of a frame about the camera. Let a frame have innovations v with covariance
S, which contains the declared variance s^2 of the attitude about each axis, and let A be the derivative of the
predicted pixels by a rotation. With g = A' S^-1 v and F = A' S^-1 A, a sensor of variance t^2 gives

    E[g g'] = F + (t^2 - s^2) F F,

so that s^2 + (g'g - tr F) / tr(F F) is an estimate of t^2 without bias, of one frame. The estimates of a window of
frames are averaged. A rotation common to all frames is removed first: it comes from a position in error, which the
search for craters corrects, and not from noise of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import FloatArray

# Share of the frames, those with the largest rotations, that the rotation common to all frames is fitted without.
_STANDING_OUT = 0.2
# Of the three axes of a frame the best known one counts most: together they are worth one and a half.
_AXES = 1.5


@dataclass(frozen=True, slots=True)
class DetectionRule:
    """Rule by which some frames show that the attitude is degraded.

    Attributes
    ----------
    frames
        Newest frames that are judged, at most.
    left_out
        Share of these frames, those with the largest estimates, that are left out: wrong pairs in some frames are no
        evidence of a bad sensor.
    significance
        Standard errors by which the mean of the others has to exceed the limit.
    """

    frames: int
    left_out: float
    significance: float


@dataclass(frozen=True, slots=True)
class MonitorParameters:
    """Window and thresholds of the monitor.

    Attributes
    ----------
    moderate, sudden
        Rules, any of which detects: the first a moderate excess of noise, the second a large one at once. In 20
        simulated passes with the declared noise the largest significances were 1.5 and 1.4.
    least_frames
        With fewer frames there is no judgement.
    least_craters
        Fewer pairs than these tell a rotation hardly from a shift.
    floor_px
        Shift of the detections at the image centre by the smallest noise that is monitored: innovations hardly show
        less, and it does no harm.
    worse, restored
        The attitude counts as degraded above, and as restored below, this multiple of the declared sigma or of the
        floor, whichever is larger.
    trial_rad
        Standard deviation with which a frame that disagrees with the map is searched for a rotation.
    largest_rad
        Largest standard deviation that is used.
    """

    moderate: DetectionRule = DetectionRule(24, 0.2, 2.5)
    sudden: DetectionRule = DetectionRule(5, 0.4, 3.0)
    least_frames: int = 5
    least_craters: int = 3
    floor_px: float = 0.15
    worse: float = 1.5
    restored: float = 1.2
    trial_rad: float = math.radians(1.0)
    largest_rad: float = math.radians(2.0)

    @property
    def window_frames(self) -> int:
        return max(self.moderate.frames, self.sudden.frames)


@dataclass(frozen=True, slots=True, eq=False)
class RotationEvidence:
    """Evidence of a rotation of the camera in the innovations of a frame.

    Attributes
    ----------
    gradient
        g, 1/rad, shape (3,).
    information
        F, 1/rad^2, shape (3, 3).
    sigma_rad
        Standard deviation s per axis that the innovation covariance contains.
    trial
        The frame disagrees with the map unless it is turned.
    """

    gradient: FloatArray
    information: FloatArray
    sigma_rad: float
    trial: bool = False

    @property
    def finite(self) -> bool:
        return bool(np.all(np.isfinite(self.gradient)) and np.all(np.isfinite(self.information)))


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeMonitor:
    """Evidence of the frames in the window, oldest first, and the present judgement.

    Attributes
    ----------
    noise_rad
        Estimated standard deviation per axis while the attitude is degraded, else 0.
    """

    window: tuple[RotationEvidence, ...] = field(default=())
    noise_rad: float = 0.0

    @property
    def degraded(self) -> bool:
        """Return whether the attitude is noisier than declared."""
        return self.noise_rad > 0.0

    def sigma_rad(self, declared_rad: float) -> float:
        """Return the standard deviation per axis to be used in place of the declared one."""
        return max(declared_rad, self.noise_rad)


def monitored(
    monitor: AttitudeMonitor,
    evidence: RotationEvidence | None,
    declared_rad: float,
    focal_px: float,
    parameters: MonitorParameters,
) -> AttitudeMonitor:
    """Return the monitor after one more frame; it stays as it is without evidence.

    Parameters
    ----------
    declared_rad
        Standard deviation of the attitude per axis that the sensor states.
    """
    if evidence is None or not evidence.finite:
        return monitor
    window = (*monitor.window, evidence)[-parameters.window_frames :]
    if len(window) < parameters.least_frames:
        return replace(monitor, window=window)
    smallest_rad = max(declared_rad, parameters.floor_px / focal_px)
    shown = frame_variances(window, parameters.floor_px / focal_px)
    if monitor.degraded:
        worse = shown.mean > (parameters.restored * smallest_rad) ** 2
    else:
        limit = (parameters.worse * smallest_rad) ** 2
        rules = (parameters.moderate, parameters.sudden)
        found = [rule.frames for rule in rules if exceeds(shown.newest(rule.frames), limit, rule)]
        worse = bool(found)
        if found:  # frames before the change say nothing of the present noise
            window, shown = window[-min(found) :], shown.newest(min(found))
    # Few frames tell little about the noise: one standard error more is used.
    variance = shown.mean * (1.0 + math.sqrt(2.0 / (_AXES * shown.effective_frames)))
    noise_rad = min(math.sqrt(max(variance, smallest_rad**2)), parameters.largest_rad)
    return AttitudeMonitor(window, noise_rad if worse else 0.0)


def is_examined(monitor: AttitudeMonitor, parameters: MonitorParameters) -> bool:
    """Return whether the newest frame needs to be turned and too few such frames tell noise from a common rotation."""
    trials = sum(one.trial for one in monitor.window)
    return bool(monitor.window) and monitor.window[-1].trial and trials < parameters.least_frames


@dataclass(frozen=True, slots=True, eq=False)
class FrameVariances:
    """Variance of the attitude per axis (rad^2) that each frame shows, shape (n,), with weight and standard error."""

    squares: FloatArray
    weights: FloatArray
    errors: FloatArray

    def newest(self, count: int) -> FrameVariances:
        return FrameVariances(self.squares[-count:], self.weights[-count:], self.errors[-count:])

    @property
    def mean(self) -> float:
        return float(self.squares @ self.weights / max(float(self.weights.sum()), 1e-30))

    @property
    def effective_frames(self) -> float:
        """Number of frames of equal weight with the same standard error of the mean."""
        return float(self.weights.sum()) ** 2 / max(float(self.weights @ self.weights), 1e-30) or 1.0


def frame_variances(window: tuple[RotationEvidence, ...], floor_rad: float) -> FrameVariances:
    """Return the variance of the attitude that each frame shows.

    The weights are those of estimates whose standard deviations grow with the square of what else is uncertain about a
    rotation: position, craters, detections. Weights of single frames of a kind, agreeing or turned, are zero.
    """
    gradient = np.stack([one.gradient for one in window])
    information = np.stack([one.information for one in window])
    declared = np.array([one.sigma_rad for one in window]) ** 2
    power = np.maximum(np.einsum("nij,nij->n", information, information), 1e-30)
    trace = np.einsum("nii->n", information)
    others = np.maximum(np.sqrt(3.0 / power) - declared, 0.0)
    weights = 1.0 / (others + floor_rad**2) ** 2
    squares = np.empty(len(window))
    trial = np.array([one.trial for one in window])
    for group in (np.flatnonzero(trial), np.flatnonzero(~trial)):
        left = gradient[group]
        kept = group
        for _ in range(2):  # the second time without frames that stand out
            left = gradient[group] - information[group] @ _common_rotation(
                gradient[kept], information[kept], weights[kept] / power[kept]
            )
            order = np.argsort(np.einsum("ni,ni->n", left, left) / power[group], kind="stable")
            kept = group[order[: math.ceil((1.0 - _STANDING_OUT) * group.size)]]
        squares[group] = np.einsum("ni,ni->n", left, left) * (group.size / max(group.size - 1, 1))
        weights[group] *= group.size > 1
    # Standard error for a sensor at the floor: g then has the covariance F + (floor^2 - s^2) F F.
    square = information @ information
    spread = information + (floor_rad**2 - declared)[:, None, None] * square
    errors = np.sqrt(2.0 * np.einsum("nij,nij->n", spread, spread)) / power
    return FrameVariances(declared + (squares - trace) / power, weights, errors)


def _common_rotation(gradient: FloatArray, information: FloatArray, share: FloatArray) -> FloatArray:
    """Return the rotation m (3,) that fits g = F m best over some frames, by weighted least squares."""
    normal = np.einsum("n,nij,njk->ik", share, information, information)
    right = np.einsum("n,nij,nj->i", share, information, gradient)
    return np.asarray(np.linalg.pinv(normal, hermitian=True) @ right)


def exceeds(shown: FrameVariances, limit: float, rule: DetectionRule) -> bool:
    """Return whether the frames show a variance significantly above a limit (rad^2)."""
    count = len(shown.squares)
    kept = np.argsort(shown.squares, kind="stable")[: count - math.floor(rule.left_out * count)]
    weights = shown.weights[kept]
    total = float(weights.sum())
    if not total > 0.0:
        return False
    mean = float(shown.squares[kept] @ weights) / total
    error = math.sqrt(float(weights**2 @ shown.errors[kept] ** 2)) / total
    return mean > limit + rule.significance * error
