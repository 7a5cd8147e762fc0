"""The autopilot's data: one record a vehicle, as numpy structured arrays that numba kernels read and write.

Frames: ``local`` is NED with its origin at the estimator's origin, ``body`` is FRD. Quaternions are (w, x, y, z) and
turn body vectors into local ones. SI units, radians, seconds; times are simulated microseconds. A NaN in a setpoint
means "not controlled", PX4's contract for trajectory setpoints.

Who writes what: the simulator's sensor models (or a driver) write ``SENSORS``; the estimator kernel writes
``ESTIMATOR``; commander, navigator and the MAVLink receiver write ``SETPOINT``; the control kernels write ``CONTROL``;
the MAVLink door writes ``FAILURES``; the parameter store writes ``PARAMS``.
"""

from __future__ import annotations

import numpy as np

MAX_ROTORS = 8

# What the cascade follows (SETPOINT.task). Commander and navigator choose it from the flight mode.
TASK_IDLE = 0  # motors off (disarmed) or idling on the ground (armed)
TASK_TRAJECTORY = 1  # trajectory_* as given: OFFBOARD position, velocity, acceleration
TASK_GOTO = 2  # smoothed flight to goal_position: takeoff, loiter, return, mission
TASK_LAND = 3  # keep goal_position's xy, descend with PX4's land speeds
TASK_DESCEND = 4  # level attitude, descend at land speed: no horizontal estimate
TASK_STICKS = 5  # POSCTL: velocity from sticks, position hold when they are centred
TASK_ATTITUDE = 6  # attitude_q and thrust, yaw rate optional
TASK_RATES = 7  # body rates and thrust
TASK_ALTITUDE = 8  # ALTCTL: tilt and climb rate from sticks, height held when the throttle stick is centred
TASK_MANUAL = 9  # STABILIZED and MANUAL: tilt, yaw rate and thrust from raw sticks
TASK_ACRO = 10  # ACRO: body rates and thrust from raw sticks
TASK_ORBIT = 11  # ORBIT: a circle at goal_position's height
TASK_FOLLOW = 12  # AUTO.FOLLOW_TARGET: a place beside the target, seen from its course

# SETPOINT.orbit_yaw: MAVLink ORBIT_YAW_BEHAVIOUR
ORBIT_TO_CENTRE, ORBIT_INITIAL_HEADING, ORBIT_UNCONTROLLED, ORBIT_ALONG_CIRCLE = 0, 1, 2, 3

# Takeoff state machine (CONTROL.takeoff_state), after PX4's mc_pos_control/Takeoff.
TAKEOFF_DISARMED = 0
TAKEOFF_SPOOLUP = 1
TAKEOFF_READY = 2
TAKEOFF_RAMPUP = 3
TAKEOFF_FLIGHT = 4

# Frames of external vision (SENSORS.vision_frame, vision_velocity_frame)
VISION_NED = 0  # x to the north
VISION_FRD = 1  # level, x to wherever the vision system looked at its start
VISION_BODY = 2  # body FRD, velocity only

SENSORS = np.dtype(
    [
        ("time_us", "i8"),
        ("gyro", "f8", 3),  # rad/s, body
        ("accel", "f8", 3),  # m/s^2 specific force, body (about -9.8 in z at rest)
        ("mag_fresh", "i4"),  # 1 when mag is a new sample in this step
        ("mag", "f8", 3),  # gauss, body
        ("baro_fresh", "i4"),
        ("baro_pressure", "f8"),  # Pa
        ("baro_alt", "f8"),  # m, pressure altitude AMSL
        ("baro_temperature", "f8"),  # deg C
        ("gps_fresh", "i4"),
        ("gps_fix", "i4"),  # MAVLink GPS_FIX_TYPE: 3 = 3D
        ("gps_satellites", "i4"),
        ("gps_lat", "f8"),  # deg WGS84
        ("gps_lon", "f8"),  # deg
        ("gps_alt", "f8"),  # m AMSL
        ("gps_vel", "f8", 3),  # m/s NED
        ("gps_eph", "f8"),  # m, 1 sigma horizontal
        ("gps_epv", "f8"),  # m, 1 sigma vertical
        ("gps_speed_accuracy", "f8"),  # m/s, 1 sigma
        ("gps_hdop", "f8"),  # dilution of precision, horizontal
        ("gps_vdop", "f8"),
        ("imu_missing", "i4"),  # 1 when gyro or accel brought no sample in this step
        # The samples below come from the vehicle's own sensors or by MAVLink, at any time between two steps: whoever
        # brings one sets its flag, the estimator clears it.
        ("flow_fresh", "i4"),
        ("flow_quality", "i4"),  # 0..255
        ("flow_rate", "f8", 2),  # rad/s about body x and y, signs as in OPTICAL_FLOW_RAD, rotation included
        ("flow_gyro", "f8", 2),  # rad/s, the sensor's own rotation about body x and y over the same time; NaN: none
        ("range_fresh", "i4"),
        ("range_quality", "i4"),  # 0 bad .. 100 good, -1 unknown
        ("range_distance", "f8"),  # m along body z
        ("range_least", "f8"),  # m, what the sensor can measure
        ("range_largest", "f8"),
        ("vision_fresh", "i4"),
        ("vision_frame", "i4"),  # VISION_NED or VISION_FRD: what position and attitude are given in
        ("vision_velocity_frame", "i4"),  # VISION_NED, VISION_FRD or VISION_BODY
        ("vision_quality", "i4"),  # 0..100, -1 unknown
        ("vision_reset_counter", "i4"),
        ("vision_position", "f8", 3),  # m; NaN: none, as in the following
        ("vision_position_variance", "f8", 3),  # m^2
        ("vision_velocity", "f8", 3),  # m/s
        ("vision_velocity_variance", "f8", 3),
        ("vision_q", "f8", 4),  # (w, x, y, z) body FRD to the frame
        ("vision_yaw_variance", "f8"),  # rad^2
        # battery and motor controllers, 10 Hz
        ("battery_voltage", "f8"),  # V; 0: no battery
        ("battery_current", "f8"),  # A; -1: not measured
        ("esc_rpm", "f8", MAX_ROTORS),  # revolutions a minute
        ("esc_current", "f8", MAX_ROTORS),  # A
    ],
    align=True,
)

# What a unit does that was told to fail (FAILURES), MAVLink's FAILURE_TYPE.
FAILURE_OK, FAILURE_OFF, FAILURE_STUCK, FAILURE_GARBAGE, FAILURE_WRONG, FAILURE_SLOW = range(6)

# Failures that were asked for by MAV_CMD_INJECT_FAILURE, one FAILURE_* a unit. The MAVLink door writes them, the
# simulator's sensors and motors obey; a real vehicle has no use for them.
FAILURES = np.dtype(
    [
        ("gyro", "i4"),
        ("accel", "i4"),
        ("mag", "i4"),
        ("baro", "i4"),
        ("gps", "i4"),
        ("optical_flow", "i4"),
        ("vio", "i4"),
        ("distance_sensor", "i4"),
        ("battery", "i4"),
        ("rc_signal", "i4"),
        ("motor", "i4", MAX_ROTORS),
    ],
    align=True,
)

# error state: attitude 3, velocity 3, position 3, gyro bias 3, accelerometer bias 3, magnetometer bias 3
N_STATES = 18

# Sources of height, by EKF2_HGT_REF's numbers
HEIGHT_BARO, HEIGHT_GPS, HEIGHT_RANGE, HEIGHT_VISION = range(4)

ESTIMATOR = np.dtype(
    [
        ("initialised", "i4"),  # attitude aligned and origin known
        ("position_valid", "i4"),  # horizontal position usable
        ("altitude_valid", "i4"),
        ("q", "f8", 4),  # (w, x, y, z) body to local
        ("velocity", "f8", 3),  # m/s, local
        ("position", "f8", 3),  # m, local
        ("gyro_bias", "f8", 3),  # rad/s, body
        ("accel_bias", "f8", 3),  # m/s^2, body
        ("rates", "f8", 3),  # rad/s, body, bias removed and filtered for control
        ("angular_acceleration", "f8", 3),  # rad/s^2, body, filtered
        ("acceleration", "f8", 3),  # m/s^2, local, gravity removed
        ("velocity_dot", "f8", 3),  # m/s^2, local, filtered derivative of velocity for the controller
        ("P", "f8", (N_STATES, N_STATES)),
        ("since_predict", "f8"),  # s since the last covariance prediction
        ("delta_angle", "f8", 3),  # rad since then
        ("delta_velocity", "f8", 3),  # m/s since then, body
        ("samples", "i4"),  # IMU samples averaged for the first alignment
        ("accel_mean", "f8", 3),
        ("mag_mean", "f8", 3),
        ("mag_samples", "i4"),
        ("test_ratio_vel", "f8"),  # innovation test ratios, 1 = on the gate
        ("test_ratio_pos", "f8"),
        ("test_ratio_hgt", "f8"),
        ("test_ratio_mag", "f8"),
        ("innov_vel", "f8", 3),
        ("innov_pos", "f8", 3),
        ("innov_hgt", "f8"),
        ("innov_yaw", "f8"),
        ("time_last_gps_us", "i8"),
        ("time_last_pos_fuse_us", "i8"),
        ("origin_set", "i4"),
        ("origin_lat", "f8"),  # deg; the local frame's origin
        ("origin_lon", "f8"),
        ("origin_alt", "f8"),  # m AMSL
        ("reset_counter", "i4"),  # all resets of the state after the first fix
        # What can be relied on, 0 or 1; written 25 times a second.
        ("attitude_valid", "i4"),
        ("velocity_valid", "i4"),  # horizontal velocity
        ("global_valid", "i4"),  # position_valid, and the origin is known
        ("heading_good", "i4"),  # from north, and accurate
        ("dead_reckoning", "i4"),  # nothing has aided the horizontal state for a second
        ("terrain_valid", "i4"),  # height over ground known
        ("gps_good", "i4"),  # fixes come and have passed EKF2_GPS_CHECK for EKF2_REQ_GPS_H
        ("vision_good", "i4"),  # samples come, of sufficient quality
        ("flow_good", "i4"),
        ("range_good", "i4"),
        ("baro_good", "i4"),
        ("mag_good", "i4"),  # samples come, have the strength of the Earth's field and are not refused for good
        ("eph", "f8"),  # m, 1 sigma of the horizontal position
        ("epv", "f8"),  # m, of the vertical position
        ("evh", "f8"),  # m/s, of the horizontal velocity
        ("evv", "f8"),  # m/s, of the vertical velocity
        # What is fused now
        ("heading_aligned", "i4"),  # the local frame's x points north
        ("mag_used", "i4"),
        ("gps_used", "i4"),
        ("flow_used", "i4"),
        ("vision_position_used", "i4"),
        ("vision_velocity_used", "i4"),
        ("vision_yaw_used", "i4"),
        ("height_used", "i4", 4),  # by HEIGHT_*
        ("flags", "i4"),  # ESTIMATOR_STATUS_FLAGS
        ("fault_flags", "i4"),  # 1: the state is not finite, 2: no IMU samples, 4: magnetic disturbance
        # The last reset of each part and what it changed (new less old)
        ("reset_counter_xy", "i4"),
        ("reset_counter_vxy", "i4"),
        ("reset_counter_z", "i4"),
        ("reset_counter_vz", "i4"),
        ("reset_counter_heading", "i4"),
        ("delta_xy", "f8", 2),  # m
        ("delta_vxy", "f8", 2),  # m/s
        ("delta_z", "f8"),
        ("delta_vz", "f8"),
        ("delta_heading", "f8"),  # rad
        ("mag_bias", "f8", 3),  # gauss, body
        ("height_offset", "f8", 4),  # m, added to the down coordinate that each HEIGHT_* source measures
        ("vision_offset", "f8", 2),  # m, horizontal vision position less the local one while GPS sets the frame
        ("terrain", "f8"),  # m, down coordinate of the ground below
        ("terrain_variance", "f8"),
        ("last_position", "f8", 2),  # m, where the vehicle is taken to stay while nothing aids
        ("located", "i4"),  # position and velocity have been set
        ("vision_reset_counter", "i4"),
        ("test_ratio_gps_hgt", "f8"),
        ("test_ratio_baro", "f8"),
        ("test_ratio_flow", "f8"),
        ("test_ratio_range", "f8"),
        ("test_ratio_terrain", "f8"),
        ("test_ratio_vision_pos", "f8"),
        ("test_ratio_vision_vel", "f8"),
        ("test_ratio_vision_hgt", "f8"),
        ("test_ratio_vision_yaw", "f8"),
        ("innov_flow", "f8", 2),  # rad/s
        ("innov_range", "f8"),
        ("innov_vision_pos", "f8", 3),
        ("innov_vision_vel", "f8", 3),
        ("innov_vision_yaw", "f8"),
        ("time_aligned_us", "i8"),  # first attitude
        ("time_gps_fail_us", "i8"),
        ("time_imu_us", "i8"),  # last sample
        ("time_mag_us", "i8"),
        ("time_baro_us", "i8"),
        ("time_flow_us", "i8"),
        ("time_range_us", "i8"),
        ("time_vision_us", "i8"),
        ("time_last_vel_fuse_us", "i8"),
        ("time_last_hgt_fuse_us", "i8"),
        ("time_height_fuse_us", "i8", 4),
        ("time_heading_fuse_us", "i8"),
        ("time_gps_fuse_us", "i8"),
        ("time_flow_fuse_us", "i8"),
        ("time_terrain_fuse_us", "i8"),
        ("time_vision_fuse_us", "i8", 3),  # position, velocity, yaw
        ("in_air", "i4"),  # what the land detector said in the step before
        ("mag_fault", "i4"),  # refused again after its reset in the air: not used until the ground
        ("mag_resets", "i4"),  # resets of the heading that are left in the air
        ("field", "f8", 2),  # gauss, horizontal strength and downward part of the magnetic field, smoothed
        ("field_samples", "i4"),
        ("time_mag_disturbed_us", "i8"),  # last sample that was not of the Earth's strength
        # Vibration, see ``vibration``
        ("vibration", "f8", 3),  # coning of the gyroscope (rad^2), its and the accelerometer's jitter (rad/s, m/s^2)
        ("vibration_gyro", "f8", 3),  # rad/s, the sample before
        ("vibration_accel", "f8", 3),  # m/s^2, likewise
    ],
    align=True,
)

SETPOINT = np.dtype(
    [
        ("armed", "i4"),
        ("task", "i4"),
        ("task_changed", "i4"),  # set to 1 with every new task or goal; the kernel restarts its smoothing and clears it
        # TASK_TRAJECTORY
        ("position", "f8", 3),  # m, local; NaN = not controlled, as in the following
        ("velocity", "f8", 3),  # m/s, local
        ("acceleration", "f8", 3),  # m/s^2, local
        ("yaw", "f8"),  # rad, local
        ("yaw_rate", "f8"),  # rad/s
        # TASK_ATTITUDE and TASK_RATES
        ("attitude_q", "f8", 4),  # (w, x, y, z)
        ("rates", "f8", 3),  # rad/s, body
        ("thrust", "f8"),  # 0..1 collective, as in SET_ATTITUDE_TARGET
        # TASK_GOTO, TASK_LAND
        ("goal_position", "f8", 3),  # m, local
        ("goal_yaw", "f8"),  # rad; NaN keeps the heading
        ("cruise_speed", "f8"),  # m/s horizontal; NaN = MPC_XY_CRUISE
        ("climb_speed", "f8"),  # m/s upwards; NaN = MPC_Z_V_AUTO_UP (takeoff: MPC_TKO_SPEED)
        ("descend_speed", "f8"),  # m/s downwards; NaN = MPC_Z_V_AUTO_DN
        # by stick, each -1..1; body-heading frame: x forward, y right, z up (throttle, 0 = middle), yaw clockwise.
        # TASK_STICKS takes them past dead zone and expo, TASK_ALTITUDE z and yaw, TASK_MANUAL and TASK_ACRO none
        ("stick_x", "f8"),
        ("stick_y", "f8"),
        ("stick_z", "f8"),
        ("stick_yaw", "f8"),
        # TASK_GOTO
        ("onward_position", "f8", 3),  # m, local; where it goes on to from the goal without a stop, NaN to stop there
        ("goal_radius", "f8"),  # m from the goal at which the way onward begins; NaN = NAV_ACC_RAD
        # TASK_ORBIT
        ("orbit_centre", "f8", 2),  # m, local north and east
        ("orbit_radius", "f8"),  # m
        ("orbit_speed", "f8"),  # m/s along the circle, positive clockwise from above
        ("orbit_yaw", "i4"),  # ORBIT_*
        ("orbit_heading", "f8"),  # rad, when the orbit was commanded
        # TASK_FOLLOW
        ("target_position", "f8", 3),  # m, local, estimate at target_time; NaN while no target is known
        ("target_velocity", "f8", 3),  # m/s, local
        ("target_acceleration", "f8", 3),  # m/s^2, local
        ("target_time", "f8"),  # s, CONTROL.armed_time for which they hold
        ("home_z", "f8"),  # m, local: home's down coordinate when the mode began
        ("failed_rotors", "i4"),  # bit i: rotor i does not turn and gets no command
    ],
    align=True,
)

CONTROL = np.dtype(
    [
        ("takeoff_state", "i4"),
        ("tick", "i8"),  # steps since the start, which the slower loops count
        ("armed_time", "f8"),  # s since arming
        ("ramp_progress", "f8"),  # 0..1, how far the takeoff has ramped up
        ("ramp_speed", "f8"),  # m/s, upward speed limit while the takeoff ramps up
        ("want_takeoff", "i4"),  # the setpoint asks to leave the ground
        ("tilt_limit", "f8"),  # rad, moves slowly between MPC_TILTMAX_LND and MPC_TILTMAX_AIR
        ("throttle_min", "f8"),  # 0..1, least thrust by stick, moves slowly to MPC_MANTHR_MIN in the air
        ("throttle_max", "f8"),  # 0..1, largest thrust by stick, rises slowly after arming
        ("landed", "i4"),  # land detector
        ("maybe_landed", "i4"),
        ("ground_contact", "i4"),
        ("ground_contact_time", "f8"),  # s that each condition has held
        ("maybe_landed_time", "f8"),
        ("landed_time", "f8"),
        ("freefall", "i4"),
        ("freefall_time", "f8"),  # s
        ("least_thrust_time", "f8"),  # s at least thrust by stick
        ("since_maybe_landed", "f8"),  # s
        ("hover_thrust", "f8"),  # 0..1, by which accelerations become thrust: MPC_THR_HOVER, or the estimate in flight
        ("hover_estimate", "f8"),  # 0..1, filter of MPC_USE_HTE, and what belongs to it:
        ("hover_variance", "f8"),
        ("hover_noise", "f8"),  # m^2/s^4, of the acceleration
        ("hover_residual", "f8"),  # m/s^2, low-passed
        ("hover_test_ratio", "f8"),  # low-passed, signed
        ("hover_valid_time", "f8"),  # s for which the variance has been small
        ("hover_valid", "i4"),
        ("velocity_integral", "f8", 3),  # m/s^2
        ("rate_integral", "f8", 3),  # normalised torque
        ("saturation_pos", "i4", 3),  # allocator: torque axis cannot grow
        ("saturation_neg", "i4", 3),
        # smoothing of GOTO, LAND and STICKS
        ("last_task", "i4"),
        ("smooth_acceleration", "f8", 3),
        ("smooth_position", "f8", 3),
        ("smooth_velocity", "f8", 3),
        ("smooth_yaw", "f8"),
        ("smooth_times", "f8", (3, 3)),  # s of rising, constant and falling acceleration in the plan of each axis
        ("smooth_direction", "f8", 3),  # sign of the plan's first jerk
        ("smooth_yaw_rate", "f8"),  # rad/s, filtered slope of smooth_yaw
        ("unsmoothed_climb", "f8"),  # m/s downwards, wanted before smoothing
        ("braking", "i4"),  # far beyond the speed limits: stop with 1 g first
        ("turn_speed", "f8"),  # m/s, horizontal speed with which a turn was entered
        ("goal_from_ground", "i4"),  # the goal was set on the ground: a takeoff
        ("leg_start", "f8", 3),  # m, local: the leg that is flown, and its goal and what comes then
        ("leg_goal", "f8", 3),
        ("leg_onward", "f8", 3),
        ("way_start", "f8", 3),  # m, local: the same after detours back to the leg
        ("way_goal", "f8", 3),
        ("way_onward", "f8", 3),
        ("leg_state", "i4"),
        ("stick_acceleration", "f8", 2),  # m/s^2, local, under the jerk limit
        ("brake_boost", "f8"),
        ("hold_xy", "i4"),
        ("hold_z", "i4"),
        # FOLLOW: the target's filtered motion, and the vehicle's angle round it on a jerk-limited path
        ("followed_position", "f8", 3),  # m, local; NaN before the first estimate
        ("followed_velocity", "f8", 3),  # m/s, local
        ("followed_course", "f8"),  # rad from north, 0 until the target moves
        ("angle_position", "f8", (1,)),  # rad from north, of the direction from target to vehicle; not wrapped
        ("angle_velocity", "f8", (1,)),  # rad/s
        ("angle_acceleration", "f8", (1,)),  # rad/s^2
        ("angle_times", "f8", (1, 3)),  # the angle's plan, as smooth_times and smooth_direction
        ("angle_direction", "f8", (1,)),
        # what the task asks for; the position loop makes sp_* of it
        ("task_position", "f8", 3),
        ("task_velocity", "f8", 3),
        ("task_acceleration", "f8", 3),
        ("task_yaw", "f8"),
        ("task_yaw_rate", "f8"),
        ("speed_down", "f8"),  # m/s, largest sink rate that the task allows
        ("ground_z", "f8"),  # m, local: height at which the vehicle stood last
        # what the cascade follows now, for telemetry and logs
        ("sp_position", "f8", 3),  # m, local (NaN where not controlled)
        ("sp_velocity", "f8", 3),  # m/s, local
        ("sp_acceleration", "f8", 3),  # m/s^2, local
        ("sp_yaw", "f8"),
        ("sp_yaw_rate", "f8"),
        ("sp_thrust_vector", "f8", 3),  # normalised, local
        ("sp_q", "f8", 4),  # (w, x, y, z)
        ("sp_rates", "f8", 3),  # rad/s, body
        ("sp_thrust", "f8"),  # 0..1 collective
        ("sp_torque", "f8", 3),  # normalised
        ("actuators", "f8", MAX_ROTORS),  # 0..1 motor commands; 0 when disarmed
        # the estimator's resets that the smoothed path has followed, see ``reset_follower``
        ("resets_seen", "i4"),
        ("resets_seen_xy", "i4"),
        ("resets_seen_vxy", "i4"),
        ("resets_seen_z", "i4"),
        ("resets_seen_vz", "i4"),
        ("resets_seen_heading", "i4"),
    ],
    align=True,
)


def records(dtype: np.dtype, count: int) -> np.ndarray:
    """Return ``count`` zeroed records of ``dtype`` (shape (count,))."""
    return np.zeros(count, dtype=dtype)
