"""Names that vulture would report as unused although they are needed, each with the reason.

vulture reads the members' sources without their tests: code that only a test uses is dead too, unless it is listed
here. `./fognav check` runs it.
"""

# --- Fields of messages, reports and API answers: other programs and people read them. ---
_.extra_m  # answer to a dry run: how much farther a robot would drive, and how much longer
_.extra_s
_.earliest_s  # api: when a robot arrives
_.latest_s
_.waits_code  # api: why a mission by the clock waits
_.acknowledged_at  # api: since when somebody looks after an alert
_.translation_deviation_m  # report: of a trajectory, in `map from-log --json`
_.rotation_worst_deg
_.off_m  # report: of scans on each other, in `bench mapping --json`
_.off_deg
_.after_input  # the agent's replay: where a recording and its replay differ
_.control_p99_s  # messages: how regular the agent's loops are
(_.request_time, _.available_floors, _.lift_time)  # messages: Open-RMF's, of a lift
_.config_version  # messages: what a node has learned, and its next firmware
_.no_echo_us
_.area_entered  # the demo's report and lockstep's result
_.area_clearance_m
_.barrier_at_m  # records of drives with a real robot
_.operator_commands  # lockstep: fields of its result
_.hazard_at_m
_.pose_error_m
_.costmap_published  # messages: stamps of a trace, read by their names in fog_contracts.stages
_.plan_published
_.path_received
HOME_ASSISTANT  # channels: rows of the table for other people's programs, which no service of ours uses yet
# VDA 5050: what a fleet control sends beside what is used of it, and what it reads.
(_.blocking_type, _.start_node_id, _.end_node_id, _.orientation_type)
(_.node_states, _.edge_states, _.action_states, _.instant_action_states, _.action_result, _.last_node_sequence_id)
(_.operating_mode, _.new_base_request, _.omega, _.deviation_range, _.reference_state_header_id)
(_.control_points, _.knot_vector, _.degree, _.traversed_nodes, _.polyline, _.eta, _.penalty_factor, _.zone_descriptor)
(_.error_level, _.error_references, _.error_hint, _.reference_key, _.reference_value)
(_.info_type, _.info_level, _.info_descriptor, _.safety_state, _.active_emergency_stop, _.field_violation)
(_.state_of_charge, _.battery_voltage, _.battery_current)

# --- Names that a library calls or reads. ---
_.__signature__  # inspect and typer: what a command takes
_.__annotations__
_.env_name  # numba, which finds an environment by it
_.capture_signals  # uvicorn
_.handshake_complete  # uvicorn
_.should_exit
_.timeout_graceful_shutdown
_.daemon_threads  # http.server
_.do_GET
_.log_message
_.handle_error
_.pending_calls_threshold  # aiomqtt
_.get_source_stamp
_.FACTORY  # bases, lidars, debounce rules and cost layers are found by their entry points
_.DEFAULT  # same: profiles
_.add_localize
_.add_diff
_.add_from_log
_.format_commands
_.SIGNATURE
_.press_clean  # the emulated Roomba: tests press its button
_.switch_on  # same, held while it is switched on
_.pulse_wake_line  # the emulated Roomba: a pty has no control line, so tests pulse its pin themselves
_.RULE
_.LAYER
_.RplidarEmulator
_.DiffDriveEmulator
_.Ld19Emulator

# --- Protocols of devices, complete as in their data sheets. ---
_.NOT_CHARGING  # Roomba Open Interface
_.RECONDITIONING
_.FULL_CHARGING
_.TRICKLE
_.charging_state
_.requested_wheels_m_s
_.pause_stream
_.resume_stream
_.query_list
_.GOOD  # RPLidar
_.express_scan
_.express_us
_.standard_us
_.model
_.get_info
_.get_sample_rate

# --- For tests, of this repository and of packages that build on it. ---
_.start_mosquitto  # private servers
_.start_redis
_.start_router
_.scanning
_.seeking_dock
_.skipped_bytes
_.reveal  # the way to the value of a secret setting
_.get_code  # Python's import calls it
_.authenticate  # amqtt calls its plugins
_.topic_filtering
_.also_on  # verified when an archive is read; the folder keeps the description as it is
_.pause_writing  # asyncio calls its protocols
_.resume_writing
_.num_tickets  # ssl reads it
_.wall_to_floor_m2  # what a map changes, for people who read the answer
_.floor_to_wall_m2
_.newly_known_m2
_.no_longer_known_m2

# --- Commands whose names don't end in `_command`: the rows of fognav.__main__ name them. ---
map_check
map_clean
map_convert
map_export
map_from_plan
map_info
map_record
robot_add
robot_bringup
robot_check
robot_new
run_tests
zone_import
