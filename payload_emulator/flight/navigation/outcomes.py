"""Codes shared by the estimators and the telemetry: estimator, outcome of a frame, trigger of a reset."""

from enum import IntEnum


class Mode(IntEnum):
    """Estimators the payload can run, any number of them on the same detections."""

    paper = 0
    spherical = 1
    anchored = 2


class Outcome(IntEnum):
    """Outcome of one frame: 0 to 5 are the paper's six (section VII-A), 6 to 9 belong to `anchored`."""

    anchored = 0
    multi = 1
    single = 2
    predicted = 3
    missed = 4
    rejected = 5
    fixed = 6
    coasted = 7
    refused = 8
    no_image = 9


class ResetTrigger(IntEnum):
    """Reasons for a reset of an odometry estimate to the anchor ephemeris (section VII-B of the paper)."""

    none = 0
    initialization = 1
    time_gap = 2
    manual_step = 3
    safety_timeout = 4
