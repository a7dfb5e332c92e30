"""The packet dictionary of the payload, version 1.

Everything that crosses the link is defined here and nowhere else; the ICD and the XTCE export are generated
from it.
"""

from __future__ import annotations

from tmtc.errors import UnknownPacket
from tmtc.packets import TYPE_TELECOMMAND
from tmtc.schema import Dictionary, Field, Group, PacketDefinition

Labels = tuple[tuple[int, str], ...]

APID_HOUSEKEEPING = 0x0A0
APID_DETECTIONS = 0x0A1
APID_NAVIGATION_STATE = 0x0A2
APID_FRAME_OUTCOME = 0x0A3
APID_EVENTS = 0x0A4
APID_TIME_REPORT = 0x0A5
APID_VERIFICATION = 0x0A6
APID_TEST = 0x0A7
APID_PARAMETERS = 0x0A8
APID_LARGE_DATA = 0x0A9
APID_COMMAND = 0x0A0

MODES: Labels = ((0, "safe"), (1, "standby"), (2, "observing"), (3, "downlinking"))
IMAGE_QUALITIES: Labels = ((0, "ok"), (1, "dark"), (2, "saturated"), (3, "uniform"), (4, "invalid"))
ESTIMATORS: Labels = ((0, "paper"), (1, "spherical"), (2, "anchored"))
OUTCOMES: Labels = (
    (0, "anchored"), (1, "multi"), (2, "single"), (3, "predicted"), (4, "missed"), (5, "rejected"),
    (6, "fixed"), (7, "coasted"), (8, "refused"), (9, "no_image"),
)  # fmt: skip
RESET_TRIGGERS: Labels = (
    (0, "none"), (1, "initialization"), (2, "time_gap"), (3, "manual_step"), (4, "safety_timeout"),
)  # fmt: skip
SIZE_CLASSES: Labels = ((-1, "none"), (0, "5-10 km"), (1, "10-15 km"), (2, "15-30 km"), (3, "3-5 km"))
CLOCK_STATES: Labels = ((0, "free_running"), (1, "synchronised"), (2, "suspect"))
EVENTS: Labels = (
    (1, "boot"), (2, "mode_changed"), (3, "observation_started"), (4, "observation_stopped"),
    (5, "activity_released"), (6, "table_loaded"), (7, "table_refused"), (8, "telecommand_rejected"),
    (9, "parameter_changed"),
    (16, "image_dark"), (17, "image_saturated"), (18, "image_uniform"), (19, "image_invalid"),
    (20, "camera_fault"), (21, "attitude_missing"), (22, "frame_skipped"),
    (32, "detector_timeout"), (33, "detector_error"), (34, "filter_reset"), (35, "filter_divergence"),
    (36, "fix_refused"), (37, "anchor_read"), (38, "estimator_error"),
    (48, "clock_jump"), (49, "clock_synchronised"), (50, "watchdog_reset"), (51, "model_hash_mismatch"),
    (52, "parameters_hash_mismatch"), (53, "catalogue_hash_mismatch"), (54, "anchor_table_hash_mismatch"),
    (55, "storage_full"), (56, "storage_corrupt"), (57, "state_recovered"), (58, "state_lost"),
    (64, "power_low"), (65, "temperature_high"), (66, "temperature_low"), (67, "memory_high"),
    (68, "queue_overflow"),
)  # fmt: skip
FAILURES: Labels = (
    (1, "unknown_packet"), (2, "bad_checksum"), (3, "bad_length"), (4, "value_out_of_range"),
    (5, "wrong_mode"), (6, "duplicate"), (7, "expired"), (8, "out_of_sequence"), (9, "unknown_function"),
    (10, "unknown_parameter"), (11, "storage_full"), (12, "schedule_full"), (13, "busy"),
    (14, "table_corrupt"), (15, "execution_error"), (16, "unknown_apid"), (17, "no_such_activity"),
)  # fmt: skip
FUNCTIONS: Labels = (
    (1, "set_mode"), (2, "start_observation"), (3, "stop_observation"), (4, "manual_step"),
    (5, "reset_estimators"), (6, "clear_store"), (7, "reboot"), (8, "check_tables"),
    (9, "synchronise_clock"), (10, "abort_uplink"), (11, "widen_estimate"),
)  # fmt: skip
TABLES: Labels = (
    (1, "anchor_ephemeris"), (2, "catalogue"), (3, "gravity"), (4, "parameters"), (5, "model"),
    (6, "thumbnail"), (7, "landmark_map"), (8, "orientation"), (9, "initial_state"), (10, "burns"),
)  # fmt: skip

_FRAME = (
    Field("frame_number", "u32", "Count of frames since the start of the observation"),
    Field("image_ticks", "u64", "On-board time at which the image was taken", "2^-16 s"),
)
_OCTETS = (Field("octet", "u8", "One octet of the part"),)


def _telemetry() -> tuple[PacketDefinition, ...]:
    return (
        PacketDefinition(
            "housekeeping", APID_HOUSEKEEPING, 3, 25, "Periodic state of the payload",
            (
                Field("structure_id", "u16", "Housekeeping structure, always 1", minimum=1, maximum=1),
                Field("boot_count", "u16", "Boots since manufacture"),
                Field("mode", "u8", "Mode of the payload", labels=MODES),
                Field("frames_processed", "u32", "Frames handed to the detector since boot"),
                Field("frames_bad", "u32", "Frames refused for their image quality since boot"),
                Field("detections_total", "u32", "Craters detected since boot"),
                Field("packets_sent", "u32", "Telemetry packets made since boot"),
                Field("anchor_reads", "u32", "Reads of the anchor ephemeris since boot, all estimators"),
                Field("events_sent", "u32", "Event packets made since boot"),
                Field("telecommands_accepted", "u16", "Telecommands accepted since boot"),
                Field("telecommands_rejected", "u16", "Telecommands rejected since boot"),
                Field("last_image_quality", "u8", "Verdict on the last image", labels=IMAGE_QUALITIES),
                Field(
                    "temperature_c", "i16", "Temperature of the processor board", "degC", scale=0.01,
                    saturate=True, warning=(-20.0, 60.0), alarm=(-40.0, 85.0),
                ),
                Field(
                    "bus_voltage_v", "u16", "Voltage of the supply bus", "V", scale=0.001, saturate=True,
                    warning=(11.0, 13.0), alarm=(10.0, 14.0),
                ),
                Field(
                    "power_w", "u16", "Power drawn by the payload", "W", scale=0.01, saturate=True,
                    warning=(0.0, 15.0), alarm=(0.0, 20.0),
                ),
                Field("memory_used_kib", "u32", "Memory in use", "KiB"),
                Field("queue_depth", "u16", "Telemetry packets waiting for downlink"),
                Field(
                    "storage_used_permille", "u16", "Packet store in use", "1/1000", maximum=1000,
                    warning=(0.0, 800.0), alarm=(0.0, 950.0),
                ),
                Field("model_hash", "u32", "First 32 bits of the SHA-256 of the detector model"),
                Field("parameters_hash", "u32", "First 32 bits of the SHA-256 of the parameter table"),
                Field("catalogue_hash", "u32", "First 32 bits of the SHA-256 of the catalogue table"),
                Field("anchor_table_hash", "u32", "First 32 bits of the SHA-256 of the anchor ephemeris"),
                Field("clock_status", "u8", "State of the on-board clock", labels=CLOCK_STATES),
                Field("watchdog_resets", "u16", "Resets by the watchdog since manufacture"),
            ),
        ),
        PacketDefinition(
            "detections", APID_DETECTIONS, 129, 1, "Craters detected in one frame",
            (
                *_FRAME,
                Field("image_quality", "u8", "Verdict on the image", labels=IMAGE_QUALITIES),
                Field("count", "u8", "Number of detections that follow"),
            ),
            Group(
                "count",
                (
                    Field("u_px", "u16", "Centre, rightwards, pixel centres at integers", "px", scale=1 / 64),
                    Field("v_px", "u16", "Centre, downwards, pixel centres at integers", "px", scale=1 / 64),
                    Field("diameter_px", "u16", "Apparent diameter", "px", scale=1 / 64, saturate=True),
                    Field("score", "u8", "Confidence", scale=1 / 255, minimum=0.0, maximum=1.0),
                    Field("size_class", "i8", "Size class by the on-board range", labels=SIZE_CLASSES),
                    Field(
                        "sigma_px", "u8", "Standard deviation of the centre, each axis", "px", scale=1 / 64,
                        missing=255, saturate=True,
                    ),
                ),
            ),
        ),
        PacketDefinition(
            "navigation_state", APID_NAVIGATION_STATE, 129, 2, "Position of one estimator after one frame",
            (
                *_FRAME,
                Field("estimator", "u8", "Which estimator speaks", labels=ESTIMATORS),
                Field("outcome", "u8", "How the state came about", labels=OUTCOMES),
                Field("latitude_deg", "f64", "Latitude, mean-Earth frame", "deg"),
                Field("longitude_deg", "f64", "Longitude, mean-Earth frame", "deg"),
                Field("altitude_m", "f64", "Height above the 1737.4 km sphere", "m"),
                Field("velocity_icrf_m_s", "f32", "Velocity, ICRF axes; NaN if not estimated", "m/s", size=3),
                Field("sigma_rtn_m", "f32", "Standard deviations: radial, transverse, normal", "m", size=3),
                Field("nis", "f32", "Normalised innovation squared of the last update, NaN without one"),
                Field("matched", "u8", "Detections used", saturate=True),
            ),
        ),
        PacketDefinition(
            "frame_outcome", APID_FRAME_OUTCOME, 129, 3, "What one estimator did with one frame",
            (
                *_FRAME,
                Field("estimator", "u8", "Which estimator speaks", labels=ESTIMATORS),
                Field("outcome", "u8", "Outcome of the frame", labels=OUTCOMES),
                Field("reset_trigger", "u8", "Why the estimator was re-anchored", labels=RESET_TRIGGERS),
                Field("detections", "u8", "Detections offered", saturate=True),
                Field("candidate_pairs", "u16", "Pairs that passed the motion bounds", saturate=True),
                Field("pairs", "u8", "Pairs used in the solution", saturate=True),
                Field("shift_east_m", "f32", "Ground shift since the frame before, NaN without one", "m"),
                Field("shift_north_m", "f32", "Ground shift since the frame before, NaN without one", "m"),
                Field("anchor_reads", "u32", "Reads of the anchor ephemeris by this estimator so far"),
            ),
        ),
        PacketDefinition(
            "filter_state", APID_NAVIGATION_STATE, 129, 4, "Orbit of the navigation filter with its covariance",
            (
                *_FRAME,
                Field("position_icrf_m", "f64", "Position, Moon-centred ICRF axes", "m", size=3),
                Field("velocity_icrf_m_s", "f64", "Velocity, ICRF axes", "m/s", size=3),
                Field("acceleration_rtn_m_s2", "f32", "Empirical acceleration, R, T, N", "m/s^2", size=3),
                Field(
                    "covariance", "f32", "Covariance of the nine numbers above, lower triangle by rows", size=45
                ),
            ),
        ),
        PacketDefinition(
            "identifications", APID_FRAME_OUTCOME, 129, 5, "Which crater each used detection was taken for",
            (*_FRAME, Field("count", "u8", "Number of pairs that follow")),
            Group(
                "count",
                (
                    Field("detection", "u8", "Place in the detections of the same frame, from 0"),
                    Field("crater_id", "u32", "Identity in the on-board catalogue"),
                ),
            ),
        ),
        *(
            PacketDefinition(
                f"event_{severity}", APID_EVENTS, 5, subtype, f"Event report, {meaning}",
                (
                    Field("event_id", "u16", "What happened", labels=EVENTS),
                    Field("frame_number", "u32", "Frame during which it happened"),
                    Field("value_1", "f64", "First value that goes with the event"),
                    Field("value_2", "f64", "Second value that goes with the event"),
                ),
            )
            for subtype, severity, meaning in (
                (1, "info", "informative"),
                (2, "low", "low severity"),
                (3, "medium", "medium severity"),
                (4, "high", "high severity"),
            )
        ),
        PacketDefinition(
            "time_report", APID_TIME_REPORT, 9, 2, "On-board time at a reference instant",
            (
                Field("reported_ticks", "u64", "On-board time at the reference instant", "2^-16 s"),
                Field("rate_exponent", "u8", "One report every 2^n transfer frames", maximum=8),
            ),
        ),
        *(_verification(*row) for row in _VERIFICATION),
        PacketDefinition("connection_report", APID_TEST, 17, 2, "Answer to a connection test", ()),
        PacketDefinition(
            "parameter_report", APID_PARAMETERS, 20, 2, "Value of one on-board parameter",
            (
                Field("parameter_id", "u16", "Number of the parameter"),
                Field("value", "f64", "Its value"),
            ),
        ),
        *(
            PacketDefinition(
                f"large_data_{part}", APID_LARGE_DATA, 13, subtype, f"Large data downlink, {part} part",
                (
                    Field("transaction", "u16", "Number of the transfer"),
                    Field("part", "u16", "Number of the part, from 1"),
                    Field("table", "u8", "What is transferred", labels=TABLES),
                    Field("count", "u16", "Octets that follow"),
                ),
                Group("count", _OCTETS),
            )
            for subtype, part in ((1, "first"), (2, "middle"), (3, "last"))
        ),
    )  # fmt: skip


_VERIFICATION = (
    (1, "verification_accepted", "Telecommand accepted", False, False),
    (2, "verification_not_accepted", "Telecommand failed acceptance", False, True),
    (3, "verification_started", "Execution started", False, False),
    (4, "verification_not_started", "Execution failed to start", False, True),
    (5, "verification_progress", "Execution went a step further", True, False),
    (6, "verification_progress_failed", "Execution failed in a step", True, True),
    (7, "verification_completed", "Execution completed", False, False),
    (8, "verification_not_completed", "Execution failed to complete", False, True),
    (10, "verification_not_routed", "Telecommand could not be routed", False, True),
)


def _verification(subtype: int, name: str, text: str, step: bool, failure: bool) -> PacketDefinition:
    fields = [Field("request_id", "u32", "First four octets of the telecommand packet")]
    if step:
        fields.append(Field("step", "u8", "Number of the step, from 1"))
    if failure:
        fields.append(Field("failure_code", "u16", "Why", labels=FAILURES))
    return PacketDefinition(name, APID_VERIFICATION, 1, subtype, text, tuple(fields))


def _telecommands() -> tuple[PacketDefinition, ...]:
    structure = Field("structure_id", "u16", "Housekeeping structure", minimum=1, maximum=1)
    event = Field("event_id", "u16", "Event", labels=EVENTS)
    parameter = Field("parameter_id", "u16", "Number of the parameter")

    def command(
        name: str,
        service: int,
        subtype: int,
        text: str,
        fields: tuple[Field, ...] = (),
        group: Group | None = None,
    ) -> PacketDefinition:
        return PacketDefinition(
            name, APID_COMMAND, service, subtype, text, fields, group, packet_type=TYPE_TELECOMMAND
        )

    return (
        command("enable_housekeeping", 3, 5, "Send the structure periodically", (structure,)),
        command("disable_housekeeping", 3, 6, "Stop sending the structure", (structure,)),
        command("request_housekeeping", 3, 27, "Send the structure once", (structure,)),
        command(
            "set_housekeeping_interval", 3, 31, "Change how often the structure is sent",
            (structure, Field("interval_s", "u16", "Time between packets", "s", minimum=1, maximum=3600)),
        ),
        command("enable_event", 5, 5, "Report this event", (event,)),
        command("disable_event", 5, 6, "Do not report this event", (event,)),
        command(
            "perform_function", 8, 1, "Perform a function of the payload",
            (
                Field("function_id", "u16", "Function", labels=FUNCTIONS),
                Field("argument_1", "f64", "First argument (mode, duration in s, table number, m), else 0"),
                Field("argument_2", "f64", "Second argument (cadence in s, m/s), else 0"),
            ),
        ),
        command(
            "set_time_report_rate", 9, 1, "Change how often time is reported",
            (Field("rate_exponent", "u8", "One report every 2^n transfer frames", maximum=8),),
        ),
        command("enable_schedule", 11, 1, "Release the activities of the schedule"),
        command("disable_schedule", 11, 2, "Hold the activities of the schedule"),
        command("reset_schedule", 11, 3, "Delete all activities"),
        command(
            "insert_activity", 11, 4, "Release a telecommand at an on-board time",
            (
                Field("release_ticks", "u64", "On-board time of release", "2^-16 s", maximum=2.0**48 - 1),
                Field("count", "u16", "Octets of the telecommand packet that follows"),
            ),
            Group("count", _OCTETS),
        ),
        command(
            "delete_activity", 11, 5, "Delete an activity",
            (Field("request_id", "u32", "First four octets of the scheduled telecommand packet"),),
        ),
        *(
            command(
                f"uplink_{part}", 13, subtype, f"Large data uplink, {part} part",
                (
                    Field("transaction", "u16", "Number of the transfer"),
                    Field("part", "u16", "Number of the part, from 1"),
                    Field("table", "u8", "What is transferred", labels=TABLES),
                    Field("count", "u16", "Octets that follow"),
                ),
                Group("count", _OCTETS),
            )
            for subtype, part in ((9, "first"), (10, "middle"), (11, "last"))
        ),
        command(
            "replay_store", 15, 9, "Send again what was stored between two on-board times",
            (
                Field("start_ticks", "u64", "From", "2^-16 s", maximum=2.0**48 - 1),
                Field("stop_ticks", "u64", "To, excluded", "2^-16 s", maximum=2.0**48 - 1),
            ),
        ),
        command(
            "delete_store", 15, 11, "Delete what was stored before an on-board time",
            (Field("stop_ticks", "u64", "Up to, excluded", "2^-16 s", maximum=2.0**48 - 1),),
        ),
        command("test_connection", 17, 1, "Answer with a connection report"),
        command("request_parameter", 20, 1, "Report the value of a parameter", (parameter,)),
        command(
            "set_parameter", 20, 3, "Change a parameter",
            (parameter, Field("value", "f64", "New value")),
        ),
    )  # fmt: skip


DICTIONARY = Dictionary(version=1, telemetry=_telemetry(), telecommands=_telecommands())

_VERSIONS = {DICTIONARY.version: DICTIONARY}


def dictionary_version(version: int) -> Dictionary:
    """The dictionary of that version; old versions stay here so that their packets stay decodable."""
    try:
        return _VERSIONS[version]
    except KeyError:
        known = ", ".join(str(v) for v in _VERSIONS)
        raise UnknownPacket(f"dictionary: expected version {known}, found {version}") from None
