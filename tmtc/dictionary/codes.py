"""Names of the codes that packets carry."""

Labels = tuple[tuple[int, str], ...]

MODES: Labels = ((0, "safe"), (1, "standby"), (2, "observing"), (3, "downlinking"))
IMAGE_QUALITIES: Labels = ((0, "ok"), (1, "dark"), (2, "saturated"), (3, "uniform"), (4, "invalid"))
ESTIMATORS: Labels = ((0, "paper"), (1, "spherical"), (2, "anchored"))
OUTCOMES: Labels = (
    (0, "anchored"), (1, "multi"), (2, "single"), (3, "predicted"), (4, "missed"), (5, "rejected"),
    (6, "fixed"), (7, "coasted"), (8, "refused"), (9, "no_image"),
)  # fmt: skip
RESET_TRIGGERS: Labels = (
    (0, "none"),
    (1, "initialization"),
    (2, "time_gap"),
    (3, "manual_step"),
    (4, "safety_timeout"),
)
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
    (10, "activity_expired"), (11, "activity_failed"), (12, "thumbnail_stored"), (13, "report_definition_changed"),
    (23, "image_streak"), (24, "camera_recovered"),
    (59, "memory_repaired"), (60, "safe_mode_entered"), (61, "table_hash_mismatch"), (62, "memory_unrepairable"),
    (69, "store_overwritten"), (70, "event_reporting_changed"),
    (39, "attitude_degraded"), (40, "attitude_restored"), (41, "map_offset"), (42, "detection_noise"),
)  # fmt: skip
FAILURES: Labels = (
    (1, "unknown_packet"), (2, "bad_checksum"), (3, "bad_length"), (4, "value_out_of_range"),
    (5, "wrong_mode"), (6, "duplicate"), (7, "expired"), (8, "out_of_sequence"), (9, "unknown_function"),
    (10, "unknown_parameter"), (11, "storage_full"), (12, "schedule_full"), (13, "busy"),
    (14, "table_corrupt"), (15, "execution_error"), (16, "unknown_apid"), (17, "no_such_activity"),
    (18, "unknown_structure"), (19, "structures_full"),
)  # fmt: skip
FUNCTIONS: Labels = (
    (1, "set_mode"), (2, "start_observation"), (3, "stop_observation"), (4, "manual_step"),
    (5, "reset_estimators"), (6, "clear_store"), (7, "reboot"), (8, "check_tables"),
    (9, "synchronise_clock"), (10, "abort_uplink"),
    (11, "widen_estimate"), (12, "resynchronise_commands"), (13, "downlink_thumbnail"), (14, "downlink_map"),
)  # fmt: skip
TABLES: Labels = (
    (1, "anchor_ephemeris"), (2, "catalogue"), (3, "gravity"), (4, "parameters"), (5, "model"),
    (6, "thumbnail"), (7, "landmark_map"),
    (8, "orientation"), (9, "initial_state"), (10, "burns"),
)  # fmt: skip

STORE_CLASSES: Labels = ((0, "critical"), (1, "housekeeping"), (2, "navigation"), (3, "detections"), (4, "bulk"))
# What report definitions of service 3 can be made of: the on-board data pool.
QUANTITIES: Labels = (
    (1, "mode"), (2, "boot_count"), (3, "frames_processed"), (4, "frames_bad"), (5, "detections_total"),
    (6, "packets_sent"), (7, "anchor_reads"), (8, "events_sent"), (9, "telecommands_accepted"),
    (10, "telecommands_rejected"), (11, "last_image_quality"), (12, "temperature_c"), (13, "bus_voltage_v"),
    (14, "power_w"), (15, "memory_used_kib"), (16, "queue_depth"), (17, "storage_used_permille"),
    (18, "clock_status"), (19, "watchdog_resets"), (20, "camera_temperature_c"), (21, "bus_current_a"),
    (22, "cpu_commands_ms"), (23, "cpu_detector_ms"), (24, "cpu_navigation_ms"), (25, "cpu_telemetry_ms"),
    (26, "cpu_monitoring_ms"), (27, "detector_latency_max_ms"), (28, "detector_timeouts"), (29, "activities"),
    (30, "memory_repairs"), (31, "storage_errors"), (32, "store_overwritten"), (33, "last_command_count"),
)  # fmt: skip
