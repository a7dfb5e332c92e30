CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
CREATE TABLE detections (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	packet_ticks BIGINT NOT NULL, 
	frame_number BIGINT NOT NULL, 
	image_quality SMALLINT NOT NULL, 
	count SMALLINT NOT NULL, 
	items BLOB NOT NULL, 
	CONSTRAINT pk_detections PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE events (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	severity SMALLINT NOT NULL, 
	event_id INTEGER NOT NULL, 
	frame_number BIGINT NOT NULL, 
	value_1 DOUBLE, 
	value_2 DOUBLE, 
	CONSTRAINT pk_events PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE files (
	sha256 VARCHAR(64) NOT NULL, 
	kind VARCHAR(32) NOT NULL, 
	name TEXT NOT NULL, 
	octets BIGINT NOT NULL, 
	received_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_files PRIMARY KEY (sha256)
);
CREATE TABLE frame_outcomes (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	packet_ticks BIGINT NOT NULL, 
	frame_number BIGINT NOT NULL, 
	estimator SMALLINT NOT NULL, 
	outcome SMALLINT NOT NULL, 
	reset_trigger SMALLINT NOT NULL, 
	detections SMALLINT NOT NULL, 
	candidate_pairs INTEGER NOT NULL, 
	pairs SMALLINT NOT NULL, 
	shift_east_m FLOAT, 
	shift_north_m FLOAT, 
	anchor_reads BIGINT NOT NULL, 
	CONSTRAINT pk_frame_outcomes PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE housekeeping (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	boot_count INTEGER NOT NULL, 
	mode SMALLINT NOT NULL, 
	frames_processed BIGINT NOT NULL, 
	frames_bad BIGINT NOT NULL, 
	detections_total BIGINT NOT NULL, 
	packets_sent BIGINT NOT NULL, 
	anchor_reads BIGINT NOT NULL, 
	events_sent BIGINT NOT NULL, 
	telecommands_accepted INTEGER NOT NULL, 
	telecommands_rejected INTEGER NOT NULL, 
	last_image_quality SMALLINT NOT NULL, 
	temperature_c DOUBLE NOT NULL, 
	bus_voltage_v DOUBLE NOT NULL, 
	power_w DOUBLE NOT NULL, 
	memory_used_kib BIGINT NOT NULL, 
	queue_depth INTEGER NOT NULL, 
	storage_used_permille INTEGER NOT NULL, 
	model_hash BIGINT NOT NULL, 
	parameters_hash BIGINT NOT NULL, 
	catalogue_hash BIGINT NOT NULL, 
	anchor_table_hash BIGINT NOT NULL, 
	clock_status SMALLINT NOT NULL, 
	watchdog_resets INTEGER NOT NULL, 
	CONSTRAINT pk_housekeeping PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE jobs (
	id VARCHAR(32) NOT NULL, 
	kind VARCHAR(32) NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	arguments JSON NOT NULL, 
	progress DOUBLE NOT NULL, 
	attempts INTEGER NOT NULL, 
	result JSON, 
	error TEXT, 
	created_utc_ns BIGINT NOT NULL, 
	started_utc_ns BIGINT, 
	finished_utc_ns BIGINT, 
	CONSTRAINT pk_jobs PRIMARY KEY (id)
);
CREATE INDEX ix_jobs_state ON jobs (state);
CREATE TABLE navigation_states (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	packet_ticks BIGINT NOT NULL, 
	frame_number BIGINT NOT NULL, 
	estimator SMALLINT NOT NULL, 
	outcome SMALLINT NOT NULL, 
	latitude_deg DOUBLE, 
	longitude_deg DOUBLE, 
	altitude_m DOUBLE, 
	velocity_x_m_s FLOAT, 
	velocity_y_m_s FLOAT, 
	velocity_z_m_s FLOAT, 
	sigma_r_m FLOAT, 
	sigma_t_m FLOAT, 
	sigma_n_m FLOAT, 
	nis FLOAT, 
	matched SMALLINT NOT NULL, 
	CONSTRAINT pk_navigation_states PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE packets (
	id INTEGER NOT NULL, 
	vehicle_id INTEGER NOT NULL, 
	apid SMALLINT NOT NULL, 
	sequence_count SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	digest BLOB NOT NULL, 
	octets BLOB NOT NULL, 
	CONSTRAINT pk_packets PRIMARY KEY (id), 
	CONSTRAINT uq_packets_vehicle_id_apid_ticks_sequence_count_digest UNIQUE (vehicle_id, apid, ticks, sequence_count, digest)
);
CREATE TABLE time_reports (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	reported_ticks BIGINT NOT NULL, 
	rate_exponent SMALLINT NOT NULL, 
	CONSTRAINT pk_time_reports PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE vehicles (
	id INTEGER NOT NULL, 
	ccsds_id INTEGER NOT NULL, 
	instance VARCHAR(96) NOT NULL, decoded_version SMALLINT, redecoding_version SMALLINT, redecoded_to BIGINT, redecode_until BIGINT, 
	CONSTRAINT pk_vehicles PRIMARY KEY (id), 
	CONSTRAINT uq_vehicles_ccsds_id_instance UNIQUE (ccsds_id, instance)
);
CREATE TABLE verifications (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	subtype SMALLINT NOT NULL, 
	request_id BIGINT NOT NULL, 
	step SMALLINT, 
	failure_code INTEGER, 
	CONSTRAINT pk_verifications PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE correlations (
	id INTEGER NOT NULL, 
	vehicle_id INTEGER NOT NULL, 
	method VARCHAR(32) NOT NULL, 
	boot_count INTEGER, 
	start_ticks BIGINT NOT NULL, 
	stop_ticks BIGINT NOT NULL, 
	reference_ticks BIGINT NOT NULL, 
	reference_utc_ns BIGINT NOT NULL, 
	drift_ppb DOUBLE NOT NULL, 
	residual_rms_ns DOUBLE, 
	points INTEGER NOT NULL, 
	superseded SMALLINT NOT NULL, 
	created_utc_ns BIGINT NOT NULL, residual_max_ns DOUBLE, rejected INTEGER DEFAULT '0' NOT NULL, 
	CONSTRAINT pk_correlations PRIMARY KEY (id), 
	CONSTRAINT fk_correlations_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id)
);
CREATE INDEX ix_correlations_vehicle_id ON correlations (vehicle_id);
CREATE TABLE ephemerides (
	id INTEGER NOT NULL, 
	file_sha256 VARCHAR(64) NOT NULL, 
	name TEXT NOT NULL, 
	object_name TEXT NOT NULL, 
	frame VARCHAR(16) NOT NULL, 
	start_utc_ns BIGINT NOT NULL, 
	stop_utc_ns BIGINT NOT NULL, 
	states INTEGER NOT NULL, 
	precedence INTEGER NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_ephemerides PRIMARY KEY (id), 
	CONSTRAINT fk_ephemerides_file_sha256_files FOREIGN KEY(file_sha256) REFERENCES files (sha256)
);
CREATE TABLE ingests (
	id INTEGER NOT NULL, 
	vehicle_id INTEGER, 
	file_sha256 VARCHAR(64) NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	error TEXT, 
	dictionary_version INTEGER NOT NULL, 
	received_utc_ns BIGINT NOT NULL, 
	finished_utc_ns BIGINT, 
	accounting JSON NOT NULL, 
	CONSTRAINT pk_ingests PRIMARY KEY (id), 
	CONSTRAINT fk_ingests_file_sha256_files FOREIGN KEY(file_sha256) REFERENCES files (sha256), 
	CONSTRAINT fk_ingests_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id)
);
CREATE INDEX ix_ingests_file_sha256 ON ingests (file_sha256);
CREATE INDEX ix_ingests_vehicle_id ON ingests (vehicle_id);
CREATE TABLE passes (
	id INTEGER NOT NULL, 
	vehicle_id INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	start_utc_ns BIGINT NOT NULL, 
	stop_utc_ns BIGINT NOT NULL, 
	archive_digest VARCHAR(64), 
	manifest JSON NOT NULL, 
	ephemeris_id INTEGER, 
	catalogue_sha256 VARCHAR(64), 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_passes PRIMARY KEY (id), 
	CONSTRAINT fk_passes_catalogue_sha256_files FOREIGN KEY(catalogue_sha256) REFERENCES files (sha256), 
	CONSTRAINT fk_passes_ephemeris_id_ephemerides FOREIGN KEY(ephemeris_id) REFERENCES ephemerides (id), 
	CONSTRAINT fk_passes_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id), 
	CONSTRAINT uq_passes_archive_digest UNIQUE (archive_digest)
);
CREATE INDEX ix_passes_vehicle_id_start_utc_ns ON passes (vehicle_id, start_utc_ns);
CREATE TABLE pass_frames (
	pass_id INTEGER NOT NULL, 
	frame_number BIGINT NOT NULL, 
	file_sha256 VARCHAR(64) NOT NULL, 
	CONSTRAINT pk_pass_frames PRIMARY KEY (pass_id, frame_number), 
	CONSTRAINT fk_pass_frames_file_sha256_files FOREIGN KEY(file_sha256) REFERENCES files (sha256), 
	CONSTRAINT fk_pass_frames_pass_id_passes FOREIGN KEY(pass_id) REFERENCES passes (id)
);
CREATE TABLE reports (
	id VARCHAR(32) NOT NULL, 
	pass_id INTEGER NOT NULL, 
	html_sha256 VARCHAR(64) NOT NULL, 
	json_sha256 VARCHAR(64) NOT NULL, 
	summary JSON NOT NULL, 
	created_utc_ns BIGINT NOT NULL, pdf_sha256 VARCHAR(64), 
	CONSTRAINT pk_reports PRIMARY KEY (id), 
	CONSTRAINT fk_reports_html_sha256_files FOREIGN KEY(html_sha256) REFERENCES files (sha256), 
	CONSTRAINT fk_reports_json_sha256_files FOREIGN KEY(json_sha256) REFERENCES files (sha256), 
	CONSTRAINT fk_reports_pass_id_passes FOREIGN KEY(pass_id) REFERENCES passes (id)
);
CREATE INDEX ix_reports_pass_id ON reports (pass_id);
CREATE TABLE users (
	id INTEGER NOT NULL, 
	name VARCHAR(64) NOT NULL, 
	role VARCHAR(16) NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_users PRIMARY KEY (id), 
	CONSTRAINT uq_users_name UNIQUE (name)
);
CREATE TABLE tokens (
	id INTEGER NOT NULL, 
	user_id INTEGER NOT NULL, 
	token_sha256 VARCHAR(64) NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	expires_utc_ns BIGINT, 
	revoked_utc_ns BIGINT, 
	CONSTRAINT pk_tokens PRIMARY KEY (id), 
	CONSTRAINT fk_tokens_user_id_users FOREIGN KEY(user_id) REFERENCES users (id), 
	CONSTRAINT uq_tokens_token_sha256 UNIQUE (token_sha256)
);
CREATE INDEX ix_tokens_user_id ON tokens (user_id);
CREATE TABLE audit (
	id INTEGER NOT NULL, 
	utc_ns BIGINT NOT NULL, 
	actor VARCHAR(64) NOT NULL, 
	action VARCHAR(48) NOT NULL, 
	target TEXT NOT NULL, 
	detail JSON NOT NULL, 
	CONSTRAINT pk_audit PRIMARY KEY (id)
);
CREATE INDEX ix_audit_utc_ns ON audit (utc_ns);
CREATE TABLE stream_edges (
	vehicle_id INTEGER NOT NULL, 
	file_sha256 VARCHAR(64) NOT NULL, 
	link JSON, 
	octets BIGINT NOT NULL, 
	head_loose INTEGER NOT NULL, 
	tail_loose INTEGER NOT NULL, 
	head_count SMALLINT, 
	tail_count SMALLINT, 
	CONSTRAINT pk_stream_edges PRIMARY KEY (vehicle_id, file_sha256), 
	CONSTRAINT fk_stream_edges_file_sha256_files FOREIGN KEY(file_sha256) REFERENCES files (sha256), 
	CONSTRAINT fk_stream_edges_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id)
);
CREATE TABLE feed (
	id INTEGER NOT NULL, 
	utc_ns BIGINT NOT NULL, 
	kind VARCHAR(32) NOT NULL, 
	payload JSON NOT NULL, 
	CONSTRAINT pk_feed PRIMARY KEY (id)
);
CREATE TABLE telecommands (
	id INTEGER NOT NULL, 
	vehicle_id INTEGER NOT NULL, 
	name VARCHAR(64) NOT NULL, 
	arguments JSON NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	critical SMALLINT NOT NULL, 
	timeout_s INTEGER NOT NULL, 
	requested_by VARCHAR(64) NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	decided_by VARCHAR(64), 
	decided_utc_ns BIGINT, 
	reason TEXT, 
	sequence_count SMALLINT, 
	request_id BIGINT, 
	octets BLOB, 
	sent_utc_ns BIGINT, 
	sent_after_ticks BIGINT, window_id INTEGER, carrier_id BIGINT, 
	CONSTRAINT pk_telecommands PRIMARY KEY (id), 
	CONSTRAINT fk_telecommands_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id)
);
CREATE INDEX ix_telecommands_state ON telecommands (state);
CREATE INDEX ix_telecommands_vehicle_id_request_id ON telecommands (vehicle_id, request_id);
CREATE TABLE windows (
	id INTEGER NOT NULL, 
	vehicle_id INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	start_utc_ns BIGINT NOT NULL, 
	stop_utc_ns BIGINT NOT NULL, 
	cadence_s DOUBLE NOT NULL, 
	decision VARCHAR(16) NOT NULL, 
	state VARCHAR(16) NOT NULL, 
	reason TEXT, 
	predecessor_id INTEGER, 
	ephemeris_id INTEGER, 
	pass_id INTEGER, 
	data_octets BIGINT NOT NULL, 
	predicted JSON NOT NULL, 
	version INTEGER NOT NULL, 
	created_by VARCHAR(64) NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	changed_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_windows PRIMARY KEY (id), 
	CONSTRAINT fk_windows_ephemeris_id_ephemerides FOREIGN KEY(ephemeris_id) REFERENCES ephemerides (id), 
	CONSTRAINT fk_windows_pass_id_passes FOREIGN KEY(pass_id) REFERENCES passes (id), 
	CONSTRAINT fk_windows_predecessor_id_windows FOREIGN KEY(predecessor_id) REFERENCES windows (id), 
	CONSTRAINT fk_windows_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id)
);
CREATE INDEX ix_windows_vehicle_id_start_utc_ns ON windows (vehicle_id, start_utc_ns);
CREATE INDEX ix_telecommands_window_id ON telecommands (window_id);
CREATE TABLE rollups (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	kind SMALLINT NOT NULL, 
	part SMALLINT NOT NULL, 
	level SMALLINT NOT NULL, 
	bucket BIGINT NOT NULL, 
	first_ticks BIGINT NOT NULL, 
	last_ticks BIGINT NOT NULL, 
	rows BIGINT NOT NULL, 
	statistics BLOB NOT NULL, 
	CONSTRAINT pk_rollups PRIMARY KEY (vehicle_id, dictionary_version, kind, part, level, bucket)
)
 WITHOUT ROWID

;
CREATE TABLE filter_states (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	packet_ticks BIGINT NOT NULL, 
	frame_number BIGINT NOT NULL, 
	"values" BLOB NOT NULL, 
	CONSTRAINT pk_filter_states PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE identifications (
	vehicle_id INTEGER NOT NULL, 
	dictionary_version SMALLINT NOT NULL, 
	ticks BIGINT NOT NULL, 
	packet_id BIGINT NOT NULL, 
	packet_ticks BIGINT NOT NULL, 
	frame_number BIGINT NOT NULL, 
	count SMALLINT NOT NULL, 
	items BLOB NOT NULL, 
	CONSTRAINT pk_identifications PRIMARY KEY (vehicle_id, dictionary_version, ticks, packet_id)
)
 WITHOUT ROWID

;
CREATE TABLE builds (
	digest VARCHAR(64) NOT NULL, 
	name TEXT NOT NULL, 
	version TEXT NOT NULL, 
	description TEXT NOT NULL, 
	kind VARCHAR(16) NOT NULL, 
	files JSON NOT NULL, 
	flight_code VARCHAR(64), 
	provenance JSON NOT NULL, 
	registered_by VARCHAR(64) NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_builds PRIMARY KEY (digest)
);
CREATE TABLE regression_archives (
	digest VARCHAR(64) NOT NULL, 
	name TEXT NOT NULL, 
	manifest_sha256 VARCHAR(64) NOT NULL, 
	frames INTEGER NOT NULL, 
	octets BIGINT NOT NULL, 
	pinned SMALLINT NOT NULL, 
	used_utc_ns BIGINT NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_regression_archives PRIMARY KEY (digest)
);
CREATE INDEX ix_regression_archives_used_utc_ns ON regression_archives (used_utc_ns);
CREATE TABLE replays (
	id VARCHAR(64) NOT NULL, 
	archive_digest VARCHAR(64) NOT NULL, 
	build_digest VARCHAR(64) NOT NULL, 
	outcome VARCHAR(16) NOT NULL, 
	detail TEXT NOT NULL, 
	downlink_sha256 VARCHAR(64), 
	performance_sha256 VARCHAR(64), 
	wall_s DOUBLE NOT NULL, 
	cpu_s DOUBLE NOT NULL, 
	peak_rss_mib DOUBLE NOT NULL, 
	isolation TEXT NOT NULL, 
	machine TEXT NOT NULL, 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_replays PRIMARY KEY (id)
);
CREATE INDEX ix_replays_archive_digest ON replays (archive_digest);
CREATE INDEX ix_replays_build_digest ON replays (build_digest);
CREATE TABLE regressions (
	id VARCHAR(32) NOT NULL, 
	baseline_digest VARCHAR(64) NOT NULL, 
	candidate_digest VARCHAR(64) NOT NULL, 
	verdict VARCHAR(16) NOT NULL, 
	result JSON NOT NULL, 
	html_sha256 VARCHAR(64), 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_regressions PRIMARY KEY (id)
);
CREATE TABLE receptions (
	vehicle_id INTEGER NOT NULL, 
	ticks BIGINT NOT NULL, 
	sequence_count SMALLINT NOT NULL, 
	station VARCHAR(64) NOT NULL, 
	earth_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_receptions PRIMARY KEY (vehicle_id, ticks, sequence_count, station), 
	CONSTRAINT fk_receptions_vehicle_id_vehicles FOREIGN KEY(vehicle_id) REFERENCES vehicles (id)
);
CREATE TABLE answers (
	"key" VARCHAR(64) NOT NULL, 
	request VARCHAR(64) NOT NULL, 
	answer JSON, 
	created_utc_ns BIGINT NOT NULL, 
	CONSTRAINT pk_answers PRIMARY KEY ("key")
);
