"""Logged messages of PX4 v1.14: their fields and binary layout.

Names, types and order follow PX4's ``msg/*.msg``. In memory, and therefore in a log, PX4 sorts the fields of a message
by descending size, with nested messages last, and pads the message to a multiple of eight bytes.
"""

from __future__ import annotations

import re

import numpy as np

from .ulog_format import TYPES, Field, Format

# fields of each message in declaration order; type[n] is an array
_MESSAGES: dict[str, str] = {
    "actuator_armed": (
        "uint64 timestamp, bool armed, bool prearmed, bool ready_to_arm, bool lockdown, bool manual_lockdown, "
        "bool force_failsafe, bool in_esc_calibration_mode"
    ),
    "actuator_motors": "uint64 timestamp, uint64 timestamp_sample, uint16 reversible_flags, float32[12] control",
    "actuator_outputs": "uint64 timestamp, uint32 noutputs, float32[16] output",
    "battery_status": (
        "uint64 timestamp, bool connected, float32 voltage_v, float32 voltage_filtered_v, float32 current_a, "
        "float32 current_filtered_a, float32 current_average_a, float32 discharged_mah, float32 remaining, "
        "float32 scale, float32 time_remaining_s, float32 temperature, uint8 cell_count, uint8 source, "
        "uint8 priority, uint16 capacity, uint16 cycle_count, uint16 average_time_to_empty, uint16 serial_number, "
        "uint16 manufacture_date, uint16 state_of_health, uint16 max_error, uint8 id, uint16 interface_error, "
        "float32[14] voltage_cell_v, float32 max_cell_voltage_delta, bool is_powering_off, bool is_required, "
        "uint16 faults, uint32 custom_faults, uint8 warning, uint8 mode, float32 average_power, "
        "float32 available_energy, float32 full_charge_capacity_wh, float32 remaining_capacity_wh, "
        "float32 design_capacity, uint16 average_time_to_full, uint16 over_discharge_count, float32 nominal_voltage"
    ),
    "estimator_innovations": (
        "uint64 timestamp, uint64 timestamp_sample, float32[2] gps_hvel, float32 gps_vvel, float32[2] gps_hpos, "
        "float32 gps_vpos, float32[2] ev_hvel, float32 ev_vvel, float32[2] ev_hpos, float32 ev_vpos, "
        "float32 rng_vpos, float32 baro_vpos, float32[2] aux_hvel, float32 aux_vvel, float32[2] flow, "
        "float32[2] terr_flow, float32 heading, float32[3] mag_field, float32[3] gravity, float32[2] drag, "
        "float32 airspeed, float32 beta, float32 hagl, float32 hagl_rate"
    ),
    "estimator_states": (
        "uint64 timestamp, uint64 timestamp_sample, float32[24] states, uint8 n_states, float32[24] covariances"
    ),
    "estimator_status": (
        "uint64 timestamp, uint64 timestamp_sample, float32[3] output_tracking_error, uint16 gps_check_fail_flags, "
        "uint64 control_mode_flags, uint32 filter_fault_flags, float32 pos_horiz_accuracy, "
        "float32 pos_vert_accuracy, uint16 innovation_check_flags, float32 mag_test_ratio, float32 vel_test_ratio, "
        "float32 pos_test_ratio, float32 hgt_test_ratio, float32 tas_test_ratio, float32 hagl_test_ratio, "
        "float32 beta_test_ratio, uint16 solution_status_flags, uint8 reset_count_vel_ne, uint8 reset_count_vel_d, "
        "uint8 reset_count_pos_ne, uint8 reset_count_pod_d, uint8 reset_count_quat, float32 time_slip, "
        "bool pre_flt_fail_innov_heading, bool pre_flt_fail_innov_vel_horiz, bool pre_flt_fail_innov_vel_vert, "
        "bool pre_flt_fail_innov_height, bool pre_flt_fail_mag_field_disturbed, uint32 accel_device_id, "
        "uint32 gyro_device_id, uint32 baro_device_id, uint32 mag_device_id, uint8 health_flags, "
        "uint8 timeout_flags, float32 mag_inclination_deg, float32 mag_inclination_ref_deg, "
        "float32 mag_strength_gs, float32 mag_strength_ref_gs"
    ),
    "estimator_status_flags": (
        "uint64 timestamp, uint64 timestamp_sample, uint32 control_status_changes, bool cs_tilt_align, "
        "bool cs_yaw_align, bool cs_gps, bool cs_opt_flow, bool cs_mag_hdg, bool cs_mag_3d, bool cs_mag_dec, "
        "bool cs_in_air, bool cs_wind, bool cs_baro_hgt, bool cs_rng_hgt, bool cs_gps_hgt, bool cs_ev_pos, "
        "bool cs_ev_yaw, bool cs_ev_hgt, bool cs_fuse_beta, bool cs_mag_field_disturbed, bool cs_fixed_wing, "
        "bool cs_mag_fault, bool cs_fuse_aspd, bool cs_gnd_effect, bool cs_rng_stuck, bool cs_gps_yaw, "
        "bool cs_mag_aligned_in_flight, bool cs_ev_vel, bool cs_synthetic_mag_z, bool cs_vehicle_at_rest, "
        "bool cs_gps_yaw_fault, bool cs_rng_fault, bool cs_inertial_dead_reckoning, bool cs_wind_dead_reckoning, "
        "bool cs_rng_kin_consistent, bool cs_fake_pos, bool cs_fake_hgt, bool cs_gravity_vector, "
        "uint32 fault_status_changes, bool fs_bad_mag_x, bool fs_bad_mag_y, bool fs_bad_mag_z, bool fs_bad_hdg, "
        "bool fs_bad_mag_decl, bool fs_bad_airspeed, bool fs_bad_sideslip, bool fs_bad_optflow_x, "
        "bool fs_bad_optflow_y, bool fs_bad_vel_n, bool fs_bad_vel_e, bool fs_bad_vel_d, bool fs_bad_pos_n, "
        "bool fs_bad_pos_e, bool fs_bad_pos_d, bool fs_bad_acc_bias, bool fs_bad_acc_vertical, "
        "bool fs_bad_acc_clipping, uint32 innovation_fault_status_changes, bool reject_hor_vel, "
        "bool reject_ver_vel, bool reject_hor_pos, bool reject_ver_pos, bool reject_yaw, bool reject_airspeed, "
        "bool reject_sideslip, bool reject_hagl, bool reject_optflow_x, bool reject_optflow_y"
    ),
    "failsafe_flags": (
        "uint64 timestamp, uint32 mode_req_angular_velocity, uint32 mode_req_attitude, uint32 mode_req_local_alt, "
        "uint32 mode_req_local_position, uint32 mode_req_local_position_relaxed, uint32 mode_req_global_position, "
        "uint32 mode_req_mission, uint32 mode_req_offboard_signal, uint32 mode_req_home_position, "
        "uint32 mode_req_wind_and_flight_time_compliance, uint32 mode_req_prevent_arming, "
        "uint32 mode_req_manual_control, uint32 mode_req_other, bool angular_velocity_invalid, "
        "bool attitude_invalid, bool local_altitude_invalid, bool local_position_invalid, "
        "bool local_position_invalid_relaxed, bool local_velocity_invalid, bool global_position_invalid, "
        "bool auto_mission_missing, bool offboard_control_signal_lost, bool home_position_invalid, "
        "bool manual_control_signal_lost, bool gcs_connection_lost, uint8 battery_warning, "
        "bool battery_low_remaining_time, bool battery_unhealthy, bool primary_geofence_breached, "
        "bool mission_failure, bool vtol_fixed_wing_system_failure, bool wind_limit_exceeded, "
        "bool flight_time_limit_exceeded, bool local_position_accuracy_low, bool fd_critical_failure, "
        "bool fd_esc_arming_failure, bool fd_imbalanced_prop, bool fd_motor_failure"
    ),
    "failure_detector_status": (
        "uint64 timestamp, bool fd_roll, bool fd_pitch, bool fd_alt, bool fd_ext, bool fd_arm_escs, "
        "bool fd_battery, bool fd_imbalanced_prop, bool fd_motor, float32 imbalanced_prop_metric, "
        "uint16 motor_failure_mask"
    ),
    "home_position": (
        "uint64 timestamp, float64 lat, float64 lon, float32 alt, float32 x, float32 y, float32 z, float32 yaw, "
        "bool valid_alt, bool valid_hpos, bool valid_lpos, bool manual_home, uint32 update_count"
    ),
    "hover_thrust_estimate": (
        "uint64 timestamp, uint64 timestamp_sample, float32 hover_thrust, float32 hover_thrust_var, "
        "float32 accel_innov, float32 accel_innov_var, float32 accel_innov_test_ratio, float32 accel_noise_var, "
        "bool valid"
    ),
    "logger_status": (
        "uint64 timestamp, uint8 type, uint8 backend, float32 total_written_kb, float32 write_rate_kb_s, "
        "uint32 dropouts, uint32 message_gaps, uint32 buffer_used_bytes, uint32 buffer_size_bytes, uint8 num_messages"
    ),
    "manual_control_setpoint": (
        "uint64 timestamp, uint64 timestamp_sample, bool valid, uint8 data_source, float32 roll, float32 pitch, "
        "float32 yaw, float32 throttle, float32 flaps, float32 aux1, float32 aux2, float32 aux3, float32 aux4, "
        "float32 aux5, float32 aux6, bool sticks_moving"
    ),
    "mission_result": (
        "uint64 timestamp, uint32 instance_count, int32 seq_reached, uint16 seq_current, uint16 seq_total, "
        "bool valid, bool warning, bool finished, bool failure, bool stay_in_failsafe, bool flight_termination, "
        "bool item_do_jump_changed, uint16 item_changed_index, uint16 item_do_jump_remaining, uint8 execution_mode"
    ),
    "offboard_control_mode": (
        "uint64 timestamp, bool position, bool velocity, bool acceleration, bool attitude, bool body_rate, "
        "bool thrust_and_torque, bool direct_actuator"
    ),
    "parameter_update": (
        "uint64 timestamp, uint32 instance, uint32 get_count, uint32 set_count, uint32 find_count, "
        "uint32 export_count, uint16 active, uint16 changed, uint16 custom_default"
    ),
    "position_setpoint": (
        "uint64 timestamp, bool valid, uint8 type, float32 vx, float32 vy, float32 vz, float64 lat, float64 lon, "
        "float32 alt, float32 yaw, bool yaw_valid, float32 yawspeed, bool yawspeed_valid, int8 landing_gear, "
        "float32 loiter_radius, bool loiter_direction_counter_clockwise, float32 acceptance_radius, "
        "float32 cruising_speed, bool gliding_enabled, float32 cruising_throttle, bool disable_weather_vane"
    ),
    "position_setpoint_triplet": (
        "uint64 timestamp, position_setpoint previous, position_setpoint current, position_setpoint next"
    ),
    "rate_ctrl_status": (
        "uint64 timestamp, float32 rollspeed_integ, float32 pitchspeed_integ, float32 yawspeed_integ, "
        "float32 wheel_rate_integ"
    ),
    "sensor_combined": (
        "uint64 timestamp, float32[3] gyro_rad, uint32 gyro_integral_dt, int32 accelerometer_timestamp_relative, "
        "float32[3] accelerometer_m_s2, uint32 accelerometer_integral_dt, uint8 accelerometer_clipping, "
        "uint8 gyro_clipping, uint8 accel_calibration_count, uint8 gyro_calibration_count"
    ),
    "sensor_gps": (
        "uint64 timestamp, uint64 timestamp_sample, uint32 device_id, int32 lat, int32 lon, int32 alt, "
        "int32 alt_ellipsoid, float32 s_variance_m_s, float32 c_variance_rad, uint8 fix_type, float32 eph, "
        "float32 epv, float32 hdop, float32 vdop, int32 noise_per_ms, uint16 automatic_gain_control, "
        "uint8 jamming_state, int32 jamming_indicator, uint8 spoofing_state, float32 vel_m_s, float32 vel_n_m_s, "
        "float32 vel_e_m_s, float32 vel_d_m_s, float32 cog_rad, bool vel_ned_valid, int32 timestamp_time_relative, "
        "uint64 time_utc_usec, uint8 satellites_used, float32 heading, float32 heading_offset, "
        "float32 heading_accuracy, float32 rtcm_injection_rate, uint8 selected_rtcm_instance, bool rtcm_crc_failed, "
        "uint8 rtcm_msg_used"
    ),
    "takeoff_status": "uint64 timestamp, uint8 takeoff_state, float32 tilt_limit",
    "trajectory_setpoint": (
        "uint64 timestamp, float32[3] position, float32[3] velocity, float32[3] acceleration, float32[3] jerk, "
        "float32 yaw, float32 yawspeed"
    ),
    "vehicle_acceleration": "uint64 timestamp, uint64 timestamp_sample, float32[3] xyz",
    "vehicle_air_data": (
        "uint64 timestamp, uint64 timestamp_sample, uint32 baro_device_id, float32 baro_alt_meter, "
        "float32 baro_temp_celcius, float32 baro_pressure_pa, float32 rho, uint8 calibration_count"
    ),
    "vehicle_angular_velocity": "uint64 timestamp, uint64 timestamp_sample, float32[3] xyz, float32[3] xyz_derivative",
    "vehicle_attitude": (
        "uint64 timestamp, uint64 timestamp_sample, float32[4] q, float32[4] delta_q_reset, uint8 quat_reset_counter"
    ),
    "vehicle_attitude_setpoint": (
        "uint64 timestamp, float32 roll_body, float32 pitch_body, float32 yaw_body, float32 yaw_sp_move_rate, "
        "float32[4] q_d, float32[3] thrust_body, bool reset_integral, bool fw_control_yaw_wheel"
    ),
    "vehicle_command": (
        "uint64 timestamp, float32 param1, float32 param2, float32 param3, float32 param4, float64 param5, "
        "float64 param6, float32 param7, uint32 command, uint8 target_system, uint8 target_component, "
        "uint8 source_system, uint8 source_component, uint8 confirmation, bool from_external"
    ),
    "vehicle_command_ack": (
        "uint64 timestamp, uint32 command, uint8 result, uint8 result_param1, int32 result_param2, "
        "uint8 target_system, uint8 target_component, bool from_external"
    ),
    "vehicle_control_mode": (
        "uint64 timestamp, bool flag_armed, bool flag_multicopter_position_control_enabled, "
        "bool flag_control_manual_enabled, bool flag_control_auto_enabled, bool flag_control_offboard_enabled, "
        "bool flag_control_rates_enabled, bool flag_control_attitude_enabled, "
        "bool flag_control_acceleration_enabled, bool flag_control_velocity_enabled, "
        "bool flag_control_position_enabled, bool flag_control_altitude_enabled, "
        "bool flag_control_climb_rate_enabled, bool flag_control_termination_enabled"
    ),
    "vehicle_global_position": (
        "uint64 timestamp, uint64 timestamp_sample, float64 lat, float64 lon, float32 alt, float32 alt_ellipsoid, "
        "float32 delta_alt, uint8 lat_lon_reset_counter, uint8 alt_reset_counter, float32 eph, float32 epv, "
        "float32 terrain_alt, bool terrain_alt_valid, bool dead_reckoning"
    ),
    "vehicle_land_detected": (
        "uint64 timestamp, bool freefall, bool ground_contact, bool maybe_landed, bool landed, "
        "bool in_ground_effect, bool in_descend, bool has_low_throttle, bool vertical_movement, "
        "bool horizontal_movement, bool rotational_movement, bool close_to_ground_or_skipped_check, bool at_rest"
    ),
    "vehicle_local_position": (
        "uint64 timestamp, uint64 timestamp_sample, bool xy_valid, bool z_valid, bool v_xy_valid, bool v_z_valid, "
        "float32 x, float32 y, float32 z, float32[2] delta_xy, uint8 xy_reset_counter, float32 delta_z, "
        "uint8 z_reset_counter, float32 vx, float32 vy, float32 vz, float32 z_deriv, float32[2] delta_vxy, "
        "uint8 vxy_reset_counter, float32 delta_vz, uint8 vz_reset_counter, float32 ax, float32 ay, float32 az, "
        "float32 heading, float32 delta_heading, uint8 heading_reset_counter, bool heading_good_for_control, "
        "bool xy_global, bool z_global, uint64 ref_timestamp, float64 ref_lat, float64 ref_lon, float32 ref_alt, "
        "float32 dist_bottom, bool dist_bottom_valid, uint8 dist_bottom_sensor_bitfield, float32 eph, float32 epv, "
        "float32 evh, float32 evv, bool dead_reckoning, float32 vxy_max, float32 vz_max, float32 hagl_min, "
        "float32 hagl_max"
    ),
    "vehicle_local_position_setpoint": (
        "uint64 timestamp, float32 x, float32 y, float32 z, float32 yaw, float32 yawspeed, float32 vx, float32 vy, "
        "float32 vz, float32[3] acceleration, float32[3] jerk, float32[3] thrust"
    ),
    "vehicle_magnetometer": (
        "uint64 timestamp, uint64 timestamp_sample, uint32 device_id, float32[3] magnetometer_ga, "
        "uint8 calibration_count"
    ),
    "vehicle_rates_setpoint": (
        "uint64 timestamp, float32 roll, float32 pitch, float32 yaw, float32[3] thrust_body, bool reset_integral"
    ),
    "vehicle_status": (
        "uint64 timestamp, uint64 armed_time, uint64 takeoff_time, uint8 arming_state, uint8 latest_arming_reason, "
        "uint8 latest_disarming_reason, uint64 nav_state_timestamp, uint8 nav_state_user_intention, "
        "uint8 nav_state, uint16 failure_detector_status, uint8 hil_state, uint8 vehicle_type, bool failsafe, "
        "bool failsafe_and_user_took_over, bool gcs_connection_lost, uint8 gcs_connection_lost_counter, "
        "bool high_latency_data_link_lost, bool is_vtol, bool is_vtol_tailsitter, bool in_transition_mode, "
        "bool in_transition_to_fw, uint8 system_type, uint8 system_id, uint8 component_id, "
        "bool safety_button_available, bool safety_off, bool power_input_valid, bool usb_connected, "
        "bool open_drone_id_system_present, bool open_drone_id_system_healthy, bool parachute_system_present, "
        "bool parachute_system_healthy, bool avoidance_system_required, bool avoidance_system_valid, "
        "bool rc_calibration_in_progress, bool calibration_enabled, bool pre_flight_checks_pass"
    ),
    "vehicle_thrust_setpoint": "uint64 timestamp, uint64 timestamp_sample, float32[3] xyz",
    "vehicle_torque_setpoint": "uint64 timestamp, uint64 timestamp_sample, float32[3] xyz",
}

# topics that share another topic's message type
_ALIASES = {
    "vehicle_gps_position": "sensor_gps",
    "estimator_innovation_test_ratios": "estimator_innovations",
    "vehicle_angular_velocity_groundtruth": "vehicle_angular_velocity",
    "vehicle_attitude_groundtruth": "vehicle_attitude",
    "vehicle_local_position_groundtruth": "vehicle_local_position",
}

_C_TYPES = {"float32": "float", "float64": "double", "bool": "bool", "char": "char"}
_ENTRY = re.compile(r"(\w+?)(?:\[(\d+)\])? (\w+)")
_WORD = 8  # bytes, PX4's alignment of message sizes


def _field(text: str) -> Field:
    match = _ENTRY.fullmatch(text)
    assert match is not None, text
    kind, length, name = match.groups()
    if kind not in _MESSAGES:
        kind = _C_TYPES.get(kind, f"{kind}_t")
    return Field(kind, int(length or 0), name)


def _size(field: Field) -> int:
    """Return the element size by which PX4 sorts the fields; 0 for a nested message."""
    return np.dtype(TYPES[field.type]).itemsize if field.type in TYPES else 0


def message_format(name: str) -> Format:
    """Return the format in which PX4 v1.14 logs topic ``name``.

    Raises:
        KeyError: the topic is not logged.
    """
    fields = [_field(text) for text in _MESSAGES[_ALIASES.get(name, name)].split(", ")]
    fields.sort(key=_size, reverse=True)  # stable, like PX4's message generator
    nested = tuple(message_format(kind) for kind in dict.fromkeys(f.type for f in fields if f.type not in TYPES))
    size = Format(name, tuple(fields), nested).inner_dtype.itemsize
    if size % _WORD:
        fields.append(Field("uint8_t", _WORD - size % _WORD, "_padding0"))
    return Format(name, tuple(fields), nested)
