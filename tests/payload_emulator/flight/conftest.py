"""A smooth spherical Moon with point craters and a Kepler orbit, made without the code under test."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import cos, nan, pi, radians, sin, sqrt, tan
from pytest import fixture

from lunar.arrays import FloatArray
from payload_emulator.flight.payload import FlightParameters, FlightTables, Payload, PayloadMode
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.spacecraft.loop import new_board
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.tables import pack_anchor_table
from tmtc.packets.pus import TICKS_PER_SECOND

RADIUS_M = 1_737_400.0
GM_M3_S2 = 4.902800066e12
MOON_RATE_RAD_S = 2.661699e-6
EPOCH_TICKS = 61_000_000_000_000
# 120 degrees over 512 pixels, written out here on purpose.
FOCAL_PX = 256.0 / tan(radians(60.0))
CENTRE_PX = 255.5
# Craters of 5 to 30 km per square metre, and the shares of the three classes (paper, section V-B).
DENSITY_M2 = 2.09e-9
CLASS_SHARES = (58_649 / 79_387, 12_830 / 79_387, 7_908 / 79_387)
CLASS_DIAMETERS_M = (7_000.0, 12_000.0, 20_000.0)


def paper_orbit_mcmf_m(seconds):
    """Return positions (n, 3) on the Kepler orbit of the paper's Table I over a uniformly turning Moon."""
    time = np.array(seconds, float)
    a, e = 1_768_180.0, 0.006908
    i, node, perilune, start = radians([89.076, 3.164, 333.604, 8.882])
    anomaly = 2.0 * np.arctan(sqrt((1.0 - e) / (1.0 + e)) * tan(start / 2.0))
    mean = anomaly - e * sin(anomaly) + sqrt(GM_M3_S2 / a**3) * time
    eccentric = mean.copy()
    for _ in range(12):
        eccentric = mean + e * sin(eccentric)
    true = 2.0 * np.arctan2(sqrt(1.0 + e) * sin(eccentric / 2.0), sqrt(1.0 - e) * cos(eccentric / 2.0))
    radius, u, turned = a * (1.0 - e * cos(eccentric)), perilune + true, node - MOON_RATE_RAD_S * time
    return radius[:, None] * np.stack(
        [
            cos(turned) * cos(u) - sin(turned) * sin(u) * cos(i),
            sin(turned) * cos(u) + cos(turned) * sin(u) * cos(i),
            sin(u) * sin(i),
        ],
        axis=1,
    )


def place(position_m):
    """Return latitude, longitude, altitude."""
    radius = float(np.linalg.norm(position_m))
    return float(np.arcsin(position_m[2] / radius)), float(np.arctan2(position_m[1], position_m[0])), radius - RADIUS_M


def ticks_at(second):
    return EPOCH_TICKS + round(second * TICKS_PER_SECOND)


@dataclass(frozen=True)
class CraterField:
    """Point craters on the smooth sphere, ordered by z."""

    position_m: FloatArray
    diameter_m: FloatArray

    def perfect_detections(self, position_m):
        """Return every crater in view of a nadir camera, image up to the north, by true perspective."""
        latitude, longitude, altitude = place(position_m)
        reach = RADIUS_M * sin(np.arccos(RADIUS_M / (RADIUS_M + altitude)))
        low, high = np.searchsorted(self.position_m[:, 2], [position_m[2] - reach, position_m[2] + reach])
        points, diameter = self.position_m[low:high], self.diameter_m[low:high]
        up = np.array([cos(latitude) * cos(longitude), cos(latitude) * sin(longitude), sin(latitude)])
        east = np.array([-sin(longitude), cos(longitude), 0.0])
        away = points - position_m
        depth = -away @ up
        depth[depth <= 0.0] = nan
        u = CENTRE_PX + FOCAL_PX * (away @ east) / depth
        v = CENTRE_PX - FOCAL_PX * (away @ np.cross(up, east)) / depth
        seen = (np.abs(u - 255.5) < 256.0) & (np.abs(v - 255.5) < 256.0)
        seen &= points @ up > RADIUS_M**2 / (RADIUS_M + altitude)
        return detections(u[seen], v[seen], (FOCAL_PX * diameter / depth)[seen])


def make_crater_field(seed):
    rng = np.random.default_rng(seed)
    count = int(4.0 * pi * RADIUS_M**2 * DENSITY_M2)
    z = np.sort(rng.uniform(-1.0, 1.0, count))
    longitude = rng.uniform(-pi, pi, count)
    ring = sqrt(1.0 - z * z)
    position = RADIUS_M * np.stack([ring * cos(longitude), ring * sin(longitude), z], axis=1)
    return CraterField(position, rng.choice(CLASS_DIAMETERS_M, size=count, p=CLASS_SHARES))


def detections(u_px, v_px, diameter_px):
    return Detections(u_px, v_px, diameter_px, np.ones_like(u_px), np.full_like(u_px, nan))


@dataclass(frozen=True)
class Toolbox:
    """Helpers that tests of flight share, since test files cannot import each other."""

    orbit: Callable[..., FloatArray] = paper_orbit_mcmf_m
    place: Callable[[FloatArray], tuple[float, float, float]] = place
    ticks_at: Callable[[float], int] = ticks_at
    crater_field: Callable[[int], CraterField] = make_crater_field
    radius_m: float = RADIUS_M

    def anchor(self, seconds):
        """The anchor table of these times, as octets."""
        return pack_anchor_table([ticks_at(second) for second in seconds], self.orbit(seconds))


@fixture(scope="session")
def moon():
    return Toolbox()


class Rig:
    """A payload on a simulated board, commanded as from the ground, its telemetry read as on the ground."""

    image = np.full((16, 16, 3), 90, dtype=np.uint8)
    attitude = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])

    def __init__(self, tables=None, model=b"network" * 40):
        self.board = new_board(5, store_octets=1 << 18)
        self.tables, self.model = tables or FlightTables(), model
        self.quality = ImageQuality.OK
        self.examined = self.detectors_made = self.count = 0
        self.second = 0.0
        self.skew_ticks = 0
        self.failing = False
        self.boot()

    def boot(self, cause=None):
        if cause is not None:
            self.board.reset(cause)
        self.payload = Payload(
            self, FlightParameters(), self.tables, model_octets=self.model, board=self.board, mode=PayloadMode.standby,
            make_detector=self._make_detector
        )  # fmt: skip

    def _make_detector(self, octets):
        assert octets == self.model
        self.detectors_made += 1
        return self

    def examine(self, image, sun_in_camera=None):
        self.examined += 1
        if self.failing:
            raise RuntimeError("no such operator")
        return self.quality, detections(*np.empty((3, 0)))

    @property
    def mode(self):
        return self.payload.mode

    @property
    def ticks(self):
        return ticks_at(self.second) + self.skew_ticks

    def command(self, name, **values):
        """The next telecommand packet."""
        self.count += 1
        return DICTIONARY.pack_command(name, values, sequence_count=self.count)

    def function(self, name, first=0.0, second=0.0):
        return self.command("perform_function", function_id=name, argument_1=first, argument_2=second)

    def at(self, second, packet):
        """A telecommand that puts another one into the schedule."""
        octets = np.frombuffer(packet, dtype=np.uint8)
        return self.command("insert_activity", release_ticks=ticks_at(second), items={"octet": octets})

    def step(self, orders=b"", seconds=15.0, image="frame"):
        """Let time pass, then take a step; `image` None: none is taken."""
        self.second += seconds
        self.board.advance(seconds, 1.0)
        picture = np.zeros((0, 0), np.uint8) if image is None else self.image if isinstance(image, str) else image
        packets = self.payload.step(picture, self.attitude, self.ticks, orders)
        if self.board.reset_requested is not None:
            self.boot(self.board.reset_requested)
        return packets

    @staticmethod
    def named(packets, name):
        decoded = [DICTIONARY.unpack(packet) for packet in packets]
        return [values for found, values in decoded if found == name]

    @staticmethod
    def events(packets):
        labels = DICTIONARY.labels("event_info", "event_id")
        decoded = [DICTIONARY.unpack(packet) for packet in packets]
        return [labels[values["event_id"]] for name, values in decoded if name.startswith("event_")]

    def refusals(self, packets):
        """Reasons of all refusals, at acceptance and at start."""
        labels = DICTIONARY.labels("verification_not_accepted", "failure_code")
        kinds = ("verification_not_accepted", "verification_not_started")
        return [labels[v["failure_code"]] for kind in kinds for v in self.named(packets, kind)]

    def send(self, name, **values):
        """Take a step with one telecommand."""
        return self.step(self.command(name, **values))

    def perform(self, *function):
        return self.step(self.function(*function))

    def refused(self, orders, **options):
        """Reasons of the refusals of telecommands."""
        return self.refusals(self.step(orders, **options))

    def report(self, command):
        """The report, named like the telecommand that asks for it."""
        (found,) = self.named(self.send(command), command.removeprefix("report_") + "_report")
        return found


@fixture
def rig():
    return Rig()


@fixture
def make_rig():
    return Rig
