"""The payload as the spacecraft sees it: images, attitude, clock and telecommands in, space packets out.

`Payload.step` is the only door of flight software; what else it needs of the spacecraft comes through the `Board` that
it runs on. Everything it takes is an array, a count or octets; everything it says comes back as packets of the
dictionary. It reads no clock but the ticks it is given.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from payload_emulator.flight.onboard.commanding import Command, Refusal, failure, parse_commands
from payload_emulator.flight.onboard.fdir import Monitors, Reaction
from payload_emulator.flight.onboard.housekeeping import StageTimer
from payload_emulator.flight.onboard.housekeeping_packets import send_large_data, send_structure
from payload_emulator.flight.onboard.loads import MODEL_NUMBER, TABLE_NUMBERS, FlightParameters, FlightTables
from payload_emulator.flight.onboard.machine import PARAMETERS_NUMBER, Machine, ObservationWindow, ProtectedMemory
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.onboard.observer import Observer
from payload_emulator.flight.onboard.settings import ParameterStore, Recovery, Settings
from payload_emulator.flight.onboard.telecommands import check, execute, name_of
from payload_emulator.flight.ports import BareBoard, Board, Load, ResetCause, Stage
from payload_emulator.flight.telemetry.packets import Telemetry, image_report, thumbnail_octets
from payload_emulator.flight.telemetry.store import PacketStore, StoreClass
from payload_emulator.flight.vision.detections import Detector
from tmtc.packets.pus import ACK_ACCEPTANCE, ACK_COMPLETION, ACK_START, TICKS_LIMIT, TICKS_PER_SECOND

__all__ = ["FlightParameters", "FlightTables", "Payload", "PayloadMode"]


_PARAMETERS, _NO_TABLES = FlightParameters(), FlightTables()
# Octets of packets in a transfer frame, for time reports.
_FRAME_OCTETS = 1_107
_TIME_EXPONENT = 4
_HOUR_TICKS = 3_600 * TICKS_PER_SECOND
_SCRUBBED_RECORDS = 256
# What is sent in modes without a science downlink.
_SMALL_CLASSES = (StoreClass.critical, StoreClass.housekeeping)
# Events of 32-bit hashes by region; other regions have one event between them.
_MISMATCH_EVENTS = {
    MODEL_NUMBER: "model_hash_mismatch",
    PARAMETERS_NUMBER: "parameters_hash_mismatch",
    TABLE_NUMBERS["catalogue"]: "catalogue_hash_mismatch",
    TABLE_NUMBERS["anchor_ephemeris"]: "anchor_table_hash_mismatch",
}


class Payload:
    """Flight software, running since its construction.

    Parameters
    ----------
    detector
        Finds craters in images.
    parameters, tables
        As loaded at boot; tables kept by the board from before a reset go first.
    model_hash
        First 32 bits of the SHA-256 of the detector model, for housekeeping.
    model_octets
        The detector model itself, which is then protected, or its size in octets.
    boot_count
        Boots since manufacture, where the board remembers none.
    board
        What it runs on.
    mode
        Mode after the first boot of a board; later boots come up in `standby`, or resume.
    make_detector
        Builds a detector from model octets, so that a damaged model can be replaced by its kept copy.
    """

    def __init__(
        self,
        detector: Detector,
        parameters: FlightParameters = _PARAMETERS,
        tables: FlightTables = _NO_TABLES,
        *,
        model_hash: int = 0,
        model_octets: bytes | int = 0,
        boot_count: int = 1,
        board: Board | None = None,
        mode: PayloadMode = PayloadMode.observing,
        make_detector: Callable[[bytes], Detector] | None = None,
    ) -> None:
        board = BareBoard() if board is None else board
        self._first_mode = mode
        self._make_detector = make_detector
        self._model = model_octets if isinstance(model_octets, bytes) else b""
        values = ParameterStore(
            defaults={
                "housekeeping_interval_s": parameters.housekeeping_interval_s,
                "image_reports": float(parameters.image_reports),
                "scrub_interval_s": parameters.scrub_interval_s,
            }
        )
        store = PacketStore(board.store)
        telemetry = Telemetry(store)
        timer = StageTimer(board)
        self._machine = Machine(
            board=board,
            telemetry=telemetry,
            store=store,
            timer=timer,
            settings=Settings(board.settings),
            observer=Observer(detector, parameters, telemetry, timer),
            monitors=Monitors(telemetry, values),
            parameters=values,
            memory=ProtectedMemory(board),
            tables=tables,
            mode=PayloadMode.standby,
            build=parameters,
            model_hash=model_hash,
            model_octets=0 if isinstance(model_octets, bytes) else model_octets,
            boot_count=boot_count,
            time_exponent=_TIME_EXPONENT if parameters.time_reports else -1,
        )
        self._last_ticks: int | None = None
        self._last_uptime = -1
        self._next_scrub: int | None = None
        self._camera_off = False
        self._sent_octets = 0

    def step(
        self, image: NDArray[Any] | None, attitude: FloatArray, clock_ticks: int, telecommand_octets: bytes
    ) -> list[bytes]:
        """Return the space packets that go down after one frame, or one turn without a frame.

        Parameters
        ----------
        image
            (H, W) or (H, W, 3); without pixels for a camera that gave none; None in a turn in which none was taken.
        attitude
            Message of the ADCS, shape (7,): q_wxyz of camera_from_icrf, then the unit Sun vector in the
            camera frame; NaN where absent.
        clock_ticks
            On-board time of the image, units of 2^-16 s.
        telecommand_octets
            Telecommand packets that arrived since the frame before, one after another.
        """
        machine = self._machine
        machine.timer.enter(Stage.commands)
        machine.telemetry.ticks = min(max(int(clock_ticks), 0), TICKS_LIMIT - 1)
        if self._last_ticks is None:
            self._boot()
        self._check_clock(int(clock_ticks))
        for item in parse_commands(telecommand_octets):
            self._receive(item)
        self._release_activities()
        self._look(image, np.asarray(attitude, dtype=np.float64).reshape(-1))
        machine.timer.enter(Stage.monitoring)
        self._monitor()
        machine.timer.enter(Stage.telemetry)
        machine.timer.steps += 1
        for number in machine.housekeeping.due(machine.telemetry.ticks):
            send_structure(machine, number)
        packets = self._downlink()
        machine.save()
        if machine.reset_wanted is not None:
            machine.board.request_reset(machine.reset_wanted)
        machine.timer.enter(Stage.idle)
        return packets

    @property
    def mode(self) -> PayloadMode:
        """The present mode."""
        return self._machine.mode

    @property
    def frames(self) -> int:
        """Frames that were handed to the detector since boot."""
        return self._machine.observer.counts["frames"]

    @property
    def waiting(self) -> int:
        """Packets that wait for downlink."""
        return self._machine.store.waiting

    @property
    def next_turn_ticks(self) -> int | None:
        """On-board time of the next activity, frame or end of the observation; None without any.

        For simulations that skip the time in which nothing is due.
        """
        machine = self._machine
        due = [one.release_ticks for one in machine.schedule.activities[:1] if machine.schedule.enabled]
        if machine.mode is PayloadMode.observing:
            window = machine.observation
            due += [ticks for ticks in (window.next_ticks, window.stop_ticks) if ticks]
        return min(due, default=None)

    @property
    def has_cadence(self) -> bool:
        """Return whether the observation was commanded with an interval of frames; else every image is looked at."""
        return self._machine.observation.cadence_ticks > 0

    def will_look(self, ticks: int, telecommand_octets: bytes) -> bool:
        """Return whether a step at an on-board time with these telecommands may look at its image.

        For simulations that make an image only where it is needed.
        """
        machine, window = self._machine, self._machine.observation
        if machine.mode is PayloadMode.observing and not 0 < window.stop_ticks <= ticks:
            return ticks >= window.next_ticks
        schedule = machine.schedule
        due = [one.packet for one in schedule.activities if schedule.enabled and one.release_ticks <= ticks]
        telecommands = [*parse_commands(telecommand_octets), *parse_commands(b"".join(due))]
        return any(
            not isinstance(order, Refusal)
            and (
                name_of(order) == "start_observation"
                or (name_of(order) == "set_mode" and order.values["argument_1"] == PayloadMode.observing)
            )
            for order in telecommands
        )

    def summary(self) -> dict[str, Any]:
        """Return what the payload counted since boot, for the operators of the emulator."""
        return self._machine.observer.summary()

    # Boot

    def _boot(self) -> None:
        machine = self._machine
        board, telemetry = machine.board, machine.telemetry
        machine.start_housekeeping(machine.parameters["housekeeping_interval_s"])
        recovery, kept = machine.settings.read()
        before = None
        try:
            before = machine.restore(kept) if kept else None
        except (KeyError, TypeError, ValueError):
            # Whole, but of another build: worth no more than lost ones.
            recovery = Recovery.lost
        stored = machine.store.recover()
        if stored:
            telemetry.resume()
        telemetry.event("info", "boot", float(machine.boot_count), float(board.reset_cause))
        if recovery in (Recovery.whole, Recovery.older):
            severity = "info" if recovery is Recovery.whole else "low"
            telemetry.event(severity, "state_recovered", float(recovery), float(stored))
        elif recovery is Recovery.lost:
            telemetry.event("high", "state_lost", float(stored))
        machine.store.overwrite = bool(machine.parameters["store_overwrite"])
        self._load_memory()
        machine.mode = PayloadMode.standby
        window = machine.observation
        machine.observation = ObservationWindow()
        if board.reset_cause == ResetCause.watchdog:
            self._after_watchdog()
        if machine.mode is PayloadMode.safe:
            pass
        elif before is None:
            wanted = PayloadMode.safe if recovery is Recovery.lost else self._first_mode
            self._begin(wanted, window)
        elif before is PayloadMode.safe:
            self._begin(PayloadMode.safe, window)
        elif before is PayloadMode.observing and self._may_resume(window):
            self._begin(PayloadMode.observing, window)
        machine.switch_loads()
        machine.changed = True

    def _begin(self, mode: PayloadMode, window: ObservationWindow) -> None:
        """The mode after a boot, and the observation that goes on in it."""
        machine = self._machine
        machine.mode = mode
        machine.observation = window if mode is PayloadMode.observing else ObservationWindow()

    def _may_resume(self, window: ObservationWindow) -> bool:
        machine = self._machine
        if machine.board.reset_cause == ResetCause.commanded or not machine.parameters["autoresume"]:
            return False
        return window.stop_ticks == 0 or machine.telemetry.ticks < window.stop_ticks

    def _after_watchdog(self) -> None:
        """Report the reset; too many of them end in safe mode."""
        machine = self._machine
        now = machine.telemetry.ticks
        machine.counts["watchdog_resets"] += 1
        recent = [ticks for ticks in machine.watchdog_ticks if 0 <= now - ticks < _HOUR_TICKS]
        machine.watchdog_ticks = [*recent, now]
        machine.telemetry.event("high", "watchdog_reset", float(machine.counts["watchdog_resets"]))
        if len(machine.watchdog_ticks) >= machine.parameters["watchdog_limit"]:
            self._go_safe(float(ResetCause.watchdog))

    def _load_memory(self) -> None:
        """Tables and model into protected memory; those that the board kept go before those given."""
        machine = self._machine
        kept = {
            name: machine.board.read_table(number) or getattr(machine.tables, name)
            for name, number in TABLE_NUMBERS.items()
        }
        machine.tables = replace(machine.tables, **kept)
        for name, octets in kept.items():
            if octets:
                machine.memory.load(TABLE_NUMBERS[name], octets)
        if self._model:
            machine.memory.load(MODEL_NUMBER, self._model)
        machine.protect_parameters()
        machine.observer.load_tables(machine.tables)

    # Time, telecommands, schedule

    def _check_clock(self, ticks: int) -> None:
        """Notice a clock that jumps; what depends on it starts again."""
        machine = self._machine
        uptime = machine.board.uptime_ticks()
        if self._last_ticks is not None:
            ran = uptime - self._last_uptime if uptime >= 0 and self._last_uptime >= 0 else None
            jump_s = machine.monitors.clock(ticks - self._last_ticks, ran)
            if jump_s != 0.0 or ticks == self._last_ticks:
                machine.counts["clock_status"] = 2
                machine.telemetry.event("medium", "clock_jump", jump_s)
                machine.housekeeping.restart()
                self._next_scrub = None
                machine.observation.next_ticks = 0
        self._last_ticks, self._last_uptime = ticks, uptime

    def _receive(self, item: Command | Refusal) -> None:
        """Carry out one telecommand that came over the link, unless it came before or out of sequence."""
        machine = self._machine
        if isinstance(item, Refusal):
            self._refuse(item.request_id, item.failure_code)
            return
        in_sequence = name_of(item) != "resynchronise_commands"
        code = machine.history.judge(item.packet, in_sequence=in_sequence) or check(machine, item)
        if code:
            self._refuse(item.request_id, code)
            return
        machine.history.note(item.packet)
        machine.changed = True
        self._carry_out(item)

    def _release_activities(self) -> None:
        """Carry out what the schedule holds for this time; what is too late is refused."""
        machine = self._machine
        tolerance = round(machine.parameters["schedule_tolerance_s"] * TICKS_PER_SECOND)
        for activity in machine.schedule.due(machine.telemetry.ticks):
            machine.changed = True
            late = machine.telemetry.ticks - activity.release_ticks
            if late > tolerance:
                machine.telemetry.event(
                    "medium", "activity_expired", float(activity.request_id), late / TICKS_PER_SECOND
                )
                self._refuse(activity.request_id, failure("expired"))
                continue
            command = next(parse_commands(activity.packet))
            if isinstance(command, Refusal):
                self._refuse(activity.request_id, command.failure_code)
                continue
            machine.telemetry.event("info", "activity_released", float(activity.request_id))
            if not self._carry_out(command):
                machine.telemetry.event("medium", "activity_failed", float(activity.request_id))

    def _carry_out(self, command: Command) -> bool:
        """Execute a command that is acceptable, and report the stages that it asked to have reported."""
        machine = self._machine
        request = {"request_id": command.request_id}
        if command.acknowledgements & ACK_ACCEPTANCE:
            machine.telemetry.send("verification_accepted", request)
        code = execute(machine, command)
        if code:
            machine.counts["telecommands_rejected"] += 1
            machine.telemetry.send("verification_not_started", {**request, "failure_code": code})
            machine.telemetry.event("low", "telecommand_rejected", float(code), float(command.request_id))
            return False
        machine.counts["telecommands_accepted"] += 1
        for flag, name in ((ACK_START, "started"), (ACK_COMPLETION, "completed")):
            if command.acknowledgements & flag:
                machine.telemetry.send(f"verification_{name}", request)
        return True

    def _refuse(self, request_id: int, code: int) -> None:
        machine = self._machine
        machine.counts["telecommands_rejected"] += 1
        machine.telemetry.send("verification_not_accepted", {"request_id": request_id, "failure_code": code})
        machine.telemetry.event("low", "telecommand_rejected", float(code), float(request_id))

    # Frames

    def _look(self, image: NDArray[Any] | None, attitude: FloatArray) -> None:
        """Work on a frame, if it is time for one; end the observation when its time is over."""
        machine = self._machine
        ticks, window = machine.telemetry.ticks, machine.observation
        if machine.mode is PayloadMode.observing and window.stop_ticks and ticks >= window.stop_ticks:
            machine.enter(PayloadMode.standby)
        if image is None:
            return
        if machine.mode is not PayloadMode.observing:
            if image.size:
                machine.telemetry.event("info", "frame_skipped", float(machine.mode))
            return
        if window.cadence_ticks:
            if ticks < window.next_ticks - window.cadence_ticks // 2:
                return
            window.next_ticks = max(window.next_ticks, ticks - window.cadence_ticks) + window.cadence_ticks
        if self._camera_off:
            machine.switch_loads()
            self._camera_off = False
        parameters, observer = machine.parameters, machine.observer
        frame_number = machine.telemetry.frame_number
        observer.frame(
            image,
            attitude,
            parameters["detector_score_floor"],
            parameters["detector_timeout_s"],
            machine.monitors.in_streak,
        )
        if parameters["image_reports"]:
            frame = {"frame_number": frame_number, "image_ticks": ticks}
            machine.telemetry.send("image_report", {**frame, **image_report(image, attitude)})
        machine.timer.detector_max_ms = max(machine.timer.detector_max_ms, observer.detector_ms)
        interval = int(parameters["thumbnail_interval"])
        if machine.thumbnail_wanted or (interval and frame_number % interval == 0):
            self._keep_thumbnail(image, frame_number)
        self._react(machine.monitors.image(image.size > 0, observer.last_quality))
        self._react(machine.monitors.detector(observer.detector_failed))

    def _keep_thumbnail(self, image: NDArray[Any], frame_number: int) -> None:
        machine = self._machine
        machine.thumbnail_wanted = False
        if image.ndim < 2 or image.dtype.kind not in "uif":
            return
        factor = int(machine.parameters["thumbnail_factor"])
        octets = thumbnail_octets(image, factor, frame_number, machine.telemetry.ticks)
        send_large_data(machine, "thumbnail", octets)
        machine.telemetry.event("info", "thumbnail_stored", float(frame_number), float(len(octets)))

    # Faults

    def _monitor(self) -> None:
        machine = self._machine
        ticks = machine.telemetry.ticks
        self._react(machine.monitors.sensors(machine.board.sensors()))
        machine.monitors.memory(machine.board.memory_octets() / 1024.0)
        if self._next_scrub is None or ticks >= self._next_scrub:
            self._next_scrub = ticks + round(machine.parameters["scrub_interval_s"] * TICKS_PER_SECOND)
            self._scrub()
        machine.monitors.store(machine.store.overwritten, machine.store.refused)

    def _scrub(self) -> None:
        """Compare memory with what was loaded; restore what radiation has changed."""
        machine = self._machine
        for number, found in machine.memory.damaged():
            event = _MISMATCH_EVENTS.get(number, "table_hash_mismatch")
            machine.telemetry.event("high", event, float(number), float(found))
            octets = machine.memory.repair(number)
            if octets is None:
                machine.telemetry.event("high", "memory_unrepairable", float(number))
                self._go_safe(float(number))
                continue
            if number == MODEL_NUMBER and self._make_detector is not None:
                machine.observer.detector = self._make_detector(octets)
            machine.telemetry.event("medium", "memory_repaired", float(number), float(machine.memory.repairs))
        damaged = machine.store.scrub(_SCRUBBED_RECORDS)
        if damaged:
            machine.telemetry.event("medium", "storage_corrupt", float(damaged), float(machine.store.damaged))

    def _react(self, reaction: Reaction) -> None:
        machine = self._machine
        if reaction is Reaction.cycle_camera:
            machine.board.switch(Load.accelerator)
            self._camera_off = True
        elif reaction is Reaction.end_observation:
            machine.enter(PayloadMode.standby)
        elif reaction is Reaction.go_safe:
            self._go_safe(0.0)

    def _go_safe(self, reason: float) -> None:
        machine = self._machine
        if machine.mode is not PayloadMode.safe:
            machine.telemetry.event("high", "safe_mode_entered", float(machine.mode), reason)
            machine.enter(PayloadMode.safe)

    # Downlink

    def _downlink(self) -> list[bytes]:
        """Return the packets that are sent from the store; a time report at the commanded interval of frames."""
        machine = self._machine
        takes = machine.board.downlink_octets()
        sends_all = machine.mode in (PayloadMode.observing, PayloadMode.downlinking)
        kinds = StoreClass if sends_all else _SMALL_CLASSES
        if machine.time_exponent >= 0 and takes and self._sent_octets >= _FRAME_OCTETS << machine.time_exponent:
            self._sent_octets = 0
            machine.telemetry.send(
                "time_report", {"reported_ticks": machine.telemetry.ticks, "rate_exponent": machine.time_exponent}
            )
        packets = machine.store.take(takes, kinds)
        self._sent_octets += sum(map(len, packets))
        return packets
