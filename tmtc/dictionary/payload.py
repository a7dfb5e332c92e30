"""The packet dictionary of the payload.

Everything that crosses the link is defined here; the ICD and the XTCE export are generated from it. A new version only
adds packets, so that it decodes the telemetry of older payloads.
"""

from tmtc.dictionary import codes
from tmtc.dictionary.fields import HOUSEKEEPING_FIELDS, Field
from tmtc.dictionary.schema import Dictionary, Group, PacketDefinition
from tmtc.packets.space_packets import TYPE_TELECOMMAND

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
APID_PERFORMANCE = 0x0AA
APID_REPORTS = 0x0AB
APID_SCHEDULE = 0x0AC
APID_STORE = 0x0AD
APID_COMMAND = 0x0A0

_FRAME = (
    Field("frame_number", "u32", "Count of frames since the start of the observation"),
    Field("image_ticks", "u64", "On-board time at which the image was taken", "2^-16 s"),
)
_OCTETS = (Field("octet", "u8", "One octet of the part"),)
_PART = (
    Field("transaction", "u16", "Number of the transfer"),
    Field("part", "u16", "Number of the part, from 1"),
    Field("table", "u8", "What is transferred", labels=codes.TABLES),
    Field("count", "u16", "Octets that follow"),
)


_HOUSEKEEPING = PacketDefinition(
    "housekeeping", APID_HOUSEKEEPING, 3, 25, "Periodic state of the payload", HOUSEKEEPING_FIELDS
)

_FRAME_PACKETS = (
    PacketDefinition(
        "detections", APID_DETECTIONS, 129, 1, "Craters detected in one frame",
        (
            *_FRAME,
            Field("image_quality", "u8", "Verdict on the image", labels=codes.IMAGE_QUALITIES),
            Field("count", "u8", "Number of detections that follow"),
        ),
        Group(
            "count",
            (
                Field("u_px", "u16", "Centre, rightwards, pixel centres at integers", "px", scale=1 / 64),
                Field("v_px", "u16", "Centre, downwards, pixel centres at integers", "px", scale=1 / 64),
                Field("diameter_px", "u16", "Apparent diameter", "px", scale=1 / 64, saturate=True),
                Field("score", "u8", "Confidence", scale=1 / 255, minimum=0.0, maximum=1.0),
                Field("size_class", "i8", "Size class by the on-board range", labels=codes.SIZE_CLASSES),
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
            Field("estimator", "u8", "Which estimator speaks", labels=codes.ESTIMATORS),
            Field("outcome", "u8", "How the state came about", labels=codes.OUTCOMES),
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
            Field("estimator", "u8", "Which estimator speaks", labels=codes.ESTIMATORS),
            Field("outcome", "u8", "Outcome of the frame", labels=codes.OUTCOMES),
            Field("reset_trigger", "u8", "Why the estimator was re-anchored", labels=codes.RESET_TRIGGERS),
            Field("detections", "u8", "Detections offered", saturate=True),
            Field("candidate_pairs", "u16", "Pairs that passed the motion bounds", saturate=True),
            Field("pairs", "u8", "Pairs used in the solution", saturate=True),
            Field("shift_east_m", "f32", "Ground shift since the frame before, NaN without one", "m"),
            Field("shift_north_m", "f32", "Ground shift since the frame before, NaN without one", "m"),
            Field("anchor_reads", "u32", "Reads of the anchor ephemeris by this estimator so far"),
        ),
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
        fields.append(Field("failure_code", "u16", "Why", labels=codes.FAILURES))
    return PacketDefinition(name, APID_VERIFICATION, 1, subtype, text, tuple(fields))


_REPORTS = (
    *(
        PacketDefinition(
            f"event_{severity}", APID_EVENTS, 5, subtype, f"Event report, {meaning}",
            (
                Field("event_id", "u16", "What happened", labels=codes.EVENTS),
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
            f"large_data_{part}", APID_LARGE_DATA, 13, subtype, f"Large data downlink, {part} part", _PART,
            Group("count", _OCTETS),
        )
        for subtype, part in ((1, "first"), (2, "middle"), (3, "last"))
    ),
)  # fmt: skip


def _command(
    name: str, service: int, subtype: int, text: str, fields: tuple[Field, ...] = (), group: Group | None = None
) -> PacketDefinition:
    return PacketDefinition(name, APID_COMMAND, service, subtype, text, fields, group, packet_type=TYPE_TELECOMMAND)


structure = Field("structure_id", "u16", "Housekeeping structure", minimum=1, maximum=31)
event = Field("event_id", "u16", "Event", labels=codes.EVENTS)
parameter = Field("parameter_id", "u16", "Number of the parameter")
_QUANTITY = Field("quantity", "u16", "Quantity of the data pool", labels=codes.QUANTITIES)
_STRUCTURE = Field("structure_id", "u16", "Housekeeping structure, defined by telecommand", minimum=16, maximum=31)

_TELECOMMANDS = (
    _command("enable_housekeeping", 3, 5, "Send the structure periodically", (structure,)),
    _command("disable_housekeeping", 3, 6, "Stop sending the structure", (structure,)),
    _command("request_housekeeping", 3, 27, "Send the structure once", (structure,)),
    _command(
        "set_housekeeping_interval", 3, 31, "Change how often the structure is sent",
        (structure, Field("interval_s", "u16", "Time between packets", "s", minimum=1, maximum=3600)),
    ),
    _command("enable_event", 5, 5, "Report this event", (event,)),
    _command("disable_event", 5, 6, "Do not report this event", (event,)),
    _command(
        "perform_function", 8, 1, "Perform a function of the payload",
        (
            Field("function_id", "u16", "Function", labels=codes.FUNCTIONS),
            Field("argument_1", "f64", "First argument (mode, duration in s, table number, m), else 0"),
            Field("argument_2", "f64", "Second argument (cadence in s, m/s), else 0"),
        ),
    ),
    _command(
        "set_time_report_rate", 9, 1, "Change how often time is reported",
        (Field("rate_exponent", "u8", "One report every 2^n transfer frames", maximum=8),),
    ),
    _command("enable_schedule", 11, 1, "Release the activities of the schedule"),
    _command("disable_schedule", 11, 2, "Hold the activities of the schedule"),
    _command("reset_schedule", 11, 3, "Delete all activities"),
    _command(
        "insert_activity", 11, 4, "Release a telecommand at an on-board time",
        (
            Field("release_ticks", "u64", "On-board time of release", "2^-16 s", maximum=2.0**48 - 1),
            Field("count", "u16", "Octets of the telecommand packet that follows"),
        ),
        Group("count", _OCTETS),
    ),
    _command(
        "delete_activity", 11, 5, "Delete an activity",
        (Field("request_id", "u32", "First four octets of the scheduled telecommand packet"),),
    ),
    *(
        _command(
            f"uplink_{part}", 13, subtype, f"Large data uplink, {part} part", _PART, Group("count", _OCTETS)
        )
        for subtype, part in ((9, "first"), (10, "middle"), (11, "last"))
    ),
    _command(
        "replay_store", 15, 9, "Send again what was stored between two on-board times",
        (
            Field("start_ticks", "u64", "From", "2^-16 s", maximum=2.0**48 - 1),
            Field("stop_ticks", "u64", "To, excluded", "2^-16 s", maximum=2.0**48 - 1),
        ),
    ),
    _command(
        "delete_store", 15, 11, "Delete what was stored before an on-board time",
        (Field("stop_ticks", "u64", "Up to, excluded", "2^-16 s", maximum=2.0**48 - 1),),
    ),
    _command("test_connection", 17, 1, "Answer with a connection report"),
    _command("request_parameter", 20, 1, "Report the value of a parameter", (parameter,)),
    _command(
        "set_parameter", 20, 3, "Change a parameter",
        (parameter, Field("value", "f64", "New value")),
    ),
    _command(
        "create_housekeeping", 3, 1, "Define a housekeeping structure",
        (
            _STRUCTURE,
            Field("interval_s", "u16", "Time between packets, 0 for on request only", "s", maximum=3600),
            Field("count", "u8", "Number of quantities that follow", minimum=1, maximum=32),
        ),
        Group("count", (_QUANTITY,)),
    ),
    _command("delete_housekeeping", 3, 3, "Delete a defined structure", (_STRUCTURE,)),
    _command("report_housekeeping_definition", 3, 9, "Report what a defined structure holds", (_STRUCTURE,)),
    _command("report_disabled_events", 5, 7, "Report which events are not reported"),
    _command("report_schedule", 11, 17, "Report the activities of the schedule"),
    _command("report_store", 15, 18, "Report the contents of the packet store"),
)  # fmt: skip


_MILLISECONDS = "Processor time a step, mean since the last report"


_FILTER_PACKETS = (
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
    PacketDefinition(
        "landmarks", APID_DETECTIONS, 129, 6, "Craters that the payload mapped itself, new or improved",
        (*_FRAME, Field("count", "u8", "Number of landmarks that follow")),
        Group(
            "count",
            (
                Field("landmark_id", "u32", "Identity, as in the pairs of fixes"),
                Field("latitude_deg", "f64", "Latitude of the centre, mean-Earth frame", "deg"),
                Field("longitude_deg", "f64", "Longitude of the centre, mean-Earth frame", "deg"),
                Field("height_m", "f32", "Height of the rim above the 1737.4 km sphere", "m"),
                Field("diameter_m", "f32", "Diameter", "m"),
                Field("sigma_east_m", "f32", "Standard deviation to the east", "m"),
                Field("sigma_north_m", "f32", "Standard deviation to the north", "m"),
                Field("sigma_up_m", "f32", "Standard deviation upwards", "m"),
                Field("sightings", "u8", "Frames in which it was seen", saturate=True),
                Field("passes", "u8", "Passes on which it was mapped", saturate=True),
            ),
        ),
    ),
)  # fmt: skip


_PERFORMANCE = PacketDefinition(
    "performance", APID_PERFORMANCE, 3, 25, "Periodic state of the machine",
    (
        Field("structure_id", "u16", "Housekeeping structure, always 2", minimum=2, maximum=2),
        *(
            Field(f"cpu_{stage}_ms", "f32", f"{_MILLISECONDS}: {meaning}", "ms")
            for stage, meaning in (
                ("commands", "telecommands and schedule"),
                ("detector", "image preparation and detector"),
                ("navigation", "estimators"),
                ("telemetry", "packets and store"),
                ("monitoring", "monitoring and memory scrubbing"),
            )
        ),
        Field("detector_latency_max_ms", "f32", "Longest run of the detector since the last report", "ms"),
        Field("detector_timeouts", "u16", "Runs of the detector that took too long, since boot"),
        Field(
            "camera_temperature_c", "i16", "Temperature of the camera", "degC", scale=0.01, saturate=True,
            warning=(-20.0, 50.0), alarm=(-30.0, 60.0),
        ),
        Field("bus_current_a", "u16", "Current drawn from the bus", "A", scale=0.001, saturate=True),
        *(
            Field(f"queue_{name}", "u16", f"Packets of class {name} waiting for downlink", saturate=True)
            for _, name in codes.STORE_CLASSES
        ),
        *(
            Field(f"store_{name}_permille", "u16", f"Store of class {name} in use", "1/1000", maximum=1000)
            for _, name in codes.STORE_CLASSES
        ),
        Field("store_overwritten", "u32", "Packets lost from the store before they were sent, since boot"),
        Field("storage_errors", "u16", "Damaged packets found in the store since boot", saturate=True),
        Field("memory_repairs", "u16", "Regions of memory restored since boot", saturate=True),
        Field("activities", "u8", "Activities in the schedule"),
        Field("last_command_count", "u16", "Sequence count of the newest telecommand, 65535 if none"),
    ),
)  # fmt: skip


_MACHINE_PACKETS = (
    _PERFORMANCE,
    PacketDefinition(
        "housekeeping_report", APID_REPORTS, 3, 25, "Values of a structure that was defined by telecommand",
        (_STRUCTURE, Field("count", "u8", "Number of quantities that follow")),
        Group("count", (_QUANTITY, Field("value", "f64", "Its value"))),
    ),
    PacketDefinition(
        "housekeeping_definition", APID_REPORTS, 3, 10, "What a defined structure holds",
        (
            _STRUCTURE,
            Field("interval_s", "u16", "Time between packets, 0 if not sent periodically", "s"),
            Field("count", "u8", "Number of quantities that follow"),
        ),
        Group("count", (_QUANTITY,)),
    ),
    PacketDefinition(
        "disabled_events", APID_EVENTS, 5, 8, "Events that are not reported",
        (Field("count", "u8", "Number of events that follow"),),
        Group("count", (Field("event_id", "u16", "Event", labels=codes.EVENTS),)),
    ),
    PacketDefinition(
        "schedule_report", APID_SCHEDULE, 11, 13, "Activities of the schedule, by release time",
        (
            Field("enabled", "u8", "Whether activities are released", maximum=1),
            Field("count", "u8", "Number of activities that follow"),
        ),
        Group(
            "count",
            (
                Field("release_ticks", "u64", "On-board time of release", "2^-16 s", maximum=2.0**48 - 1),
                Field("request_id", "u32", "First four octets of the scheduled telecommand packet"),
            ),
        ),
    ),
    PacketDefinition(
        "store_report", APID_STORE, 15, 19, "Contents of the packet store",
        (Field("count", "u8", "Number of classes that follow"),),
        Group(
            "count",
            (
                Field("store_class", "u8", "Class", labels=codes.STORE_CLASSES),
                Field("packets", "u32", "Packets kept"),
                Field("unsent", "u32", "Packets among them that wait for downlink"),
                Field("octets", "u32", "Octets in use"),
                Field(
                    "oldest_ticks", "u64", "On-board time of the oldest packet, 0 if none", "2^-16 s",
                    maximum=2.0**48 - 1,
                ),
                Field(
                    "newest_ticks", "u64", "On-board time of the newest packet, 0 if none", "2^-16 s",
                    maximum=2.0**48 - 1,
                ),
            ),
        ),
    ),
)  # fmt: skip


_FILTER_ESTIMATE = PacketDefinition(
    "filter_estimate", APID_NAVIGATION_STATE, 129, 7,
    "Estimate of the navigation filter after a frame with its covariance; sent in place of filter_state",
    (
        *_FRAME,
        Field("position_icrf_m", "f64", "Position, Moon-centred ICRF axes", "m", size=3),
        Field("velocity_icrf_m_s", "f64", "Velocity, Moon-centred ICRF axes", "m/s", size=3),
        Field(
            "acceleration_rtn_m_s2", "f32", "Empirical acceleration, radial, transverse, normal", "m/s^2",
            size=3,
        ),
        # Single precision changes the NEES by 1e-7 of its value, half precision of correlations by 1e-3;
        # the smoother takes differences of successive covariances.
        Field(
            "covariance", "f32",
            "Covariance of the nine numbers above, in their order and axes: upper triangle by rows",
            "products of m, m/s, m/s^2", size=45,
        ),
        Field(
            "innovation_degrees", "u16",
            "Degrees of freedom of the normalised innovation squared of this frame, 0 without a fix",
        ),
    ),
)  # fmt: skip


_IMAGE_REPORT = PacketDefinition(
    "image_report", APID_DETECTIONS, 129, 10, "Checksums of one image and of what came with it",
    (
        *_FRAME,
        Field("width_px", "u16", "Columns of the image, 0 without an image", "px"),
        Field("height_px", "u16", "Rows of the image", "px"),
        Field("image_crc", "u32", "CRC-32 of the pixels, row by row"),
        Field(
            "inputs_crc", "u32",
            "CRC-32 of the attitude message, binary64, most significant octet first",
        ),
    ),
)  # fmt: skip


DICTIONARY = Dictionary(
    version=7,
    telemetry=(
        _HOUSEKEEPING,
        *_FRAME_PACKETS,
        *_REPORTS,
        *_FILTER_PACKETS,
        *_MACHINE_PACKETS,
        _FILTER_ESTIMATE,
        _IMAGE_REPORT,
    ),
    telecommands=_TELECOMMANDS,
)


STRUCTURES: dict[int, PacketDefinition] = {
    int(first.minimum or 0): one
    for one in DICTIONARY.telemetry
    for first in one.fields[:1]
    if first.name == "structure_id" and first.minimum == first.maximum
}
"""Housekeeping structures that every build sends, by number; the data pool has their fields."""

DRAWN = ("temperature_c", "bus_voltage_v", "power_w", "memory_used_kib", "queue_depth", "storage_used_permille")
"""Parameters of these structures that reports draw over time."""
