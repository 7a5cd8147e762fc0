"""The autopilot's data: one record per vehicle, as numpy structured arrays that numba kernels read and write.

Frames: ``local`` is NED with its origin at the estimator's origin, ``body`` is FRD. Quaternions are (w, x, y, z) and
rotate body vectors into the local frame. SI units, radians, seconds; times are simulated microseconds. NaN in a
setpoint means "not controlled", as in PX4's trajectory setpoints.

Kernels name the records of one vehicle by one letter:

* ``s``, in the estimator: ``SENSORS``, written by the simulator's sensor models, drivers and the MAVLink receiver.
* ``e``: ``ESTIMATOR``, written by the estimator.
* ``s``, in flight tasks and control: ``SETPOINT``, written by commander, navigator and the MAVLink receiver.
* ``c``: ``CONTROL``, written by flight tasks and control.
* ``p``: ``parameters.PARAMS``, written by the parameter store.
* ``work``: (2, N_STATES) scratch of the estimator's measurement updates.

``FAILURES`` is written by the MAVLink receiver and read by the simulator and the commander.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_ROTORS = 8

# Flight tasks (SETPOINT.task), chosen by commander and navigator from the flight mode.
TASK_IDLE = 0  # motors off (disarmed) or idling on the ground (armed)
TASK_TRAJECTORY = 1  # OFFBOARD position, velocity and acceleration, unchanged
TASK_GOTO = 2  # smoothed flight to goal_position: takeoff, loiter, return, mission
TASK_LAND = 3  # hold goal_position's xy, descend at PX4's landing speeds
TASK_DESCEND = 4  # without a horizontal estimate: level attitude, descend at landing speed
TASK_STICKS = 5  # POSCTL: velocity from sticks, position hold when centred
TASK_ATTITUDE = 6  # attitude_q and thrust, yaw rate optional
TASK_RATES = 7  # body rates and thrust
TASK_ALTITUDE = 8  # ALTCTL: tilt and climb rate from sticks, height hold when the throttle stick is centred
TASK_MANUAL = 9  # STABILIZED and MANUAL: tilt, yaw rate and thrust from raw sticks
TASK_ACRO = 10  # ACRO: body rates and thrust from raw sticks
TASK_ORBIT = 11  # ORBIT: a circle at goal_position's height
TASK_FOLLOW = 12  # AUTO.FOLLOW_TARGET: a position beside the target, relative to its course

# SETPOINT.orbit_yaw: MAVLink ORBIT_YAW_BEHAVIOUR
ORBIT_TO_CENTRE, ORBIT_INITIAL_HEADING, ORBIT_UNCONTROLLED, ORBIT_ALONG_CIRCLE = 0, 1, 2, 3

# Takeoff state machine (TAKEOFF.state), after PX4's mc_pos_control/Takeoff.
TAKEOFF_DISARMED = 0
TAKEOFF_SPOOLUP = 1
TAKEOFF_READY = 2
TAKEOFF_RAMPUP = 3
TAKEOFF_FLIGHT = 4

# Frames of external vision (SENSORS.vision_frame, vision_velocity_frame)
VISION_NED = 0  # x to the north
VISION_FRD = 1  # level, x along the vision system's initial heading
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
        ("imu_missing", "i4"),  # 1 when gyro or accel has no sample in this step
        # optical flow, range and vision: onboard or by MAVLink, at any time; the writer sets *_fresh, the estimator
        # clears it
        ("flow_fresh", "i4"),
        ("flow_quality", "i4"),  # 0..255
        ("flow_rate", "f8", 2),  # rad/s about body x and y, signs as in OPTICAL_FLOW_RAD, not rotation-compensated
        ("flow_gyro", "f8", 2),  # rad/s, the sensor's rotation about body x and y over the same time; NaN: none
        ("range_fresh", "i4"),
        ("range_quality", "i4"),  # 0 bad .. 100 good, -1 unknown
        ("range_distance", "f8"),  # m along body z
        ("range_least", "f8"),  # m, limits of the sensor
        ("range_largest", "f8"),
        ("vision_fresh", "i4"),
        ("vision_frame", "i4"),  # VISION_NED or VISION_FRD, of position and attitude
        ("vision_velocity_frame", "i4"),  # VISION_NED, VISION_FRD or VISION_BODY
        ("vision_quality", "i4"),  # 0..100, -1 unknown
        ("vision_reset_counter", "i4"),
        ("vision_position", "f8", 3),  # m; NaN: none, as in the fields below
        ("vision_position_variance", "f8", 3),  # m^2
        ("vision_velocity", "f8", 3),  # m/s
        ("vision_velocity_variance", "f8", 3),
        ("vision_q", "f8", 4),  # (w, x, y, z) body FRD to the frame
        ("vision_yaw_variance", "f8"),  # rad^2
        # battery and motor controllers, 10 Hz
        ("battery_voltage", "f8"),  # V; 0: no battery
        ("battery_current", "f8"),  # A; -1: not measured
        ("esc_rpm", "f8", MAX_ROTORS),  # revolutions per minute
        ("esc_current", "f8", MAX_ROTORS),  # A
    ],
    align=True,
)

# Failure types (FAILURES), MAVLink's FAILURE_TYPE.
FAILURE_OK, FAILURE_OFF, FAILURE_STUCK, FAILURE_GARBAGE, FAILURE_WRONG, FAILURE_SLOW = range(6)

# Failures injected by MAV_CMD_INJECT_FAILURE, one FAILURE_* per unit, applied by the simulator's sensors and motors.
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

# Height sources, numbered as in EKF2_HGT_REF
HEIGHT_BARO, HEIGHT_GPS, HEIGHT_RANGE, HEIGHT_VISION = range(4)

# The parts of ESTIMATOR that one module writes, or one kernel reads.

ORIGIN = np.dtype(  # aiding and origin: origin of the local frame
    [
        ("set", "i4"),
        ("preset", "i4"),  # lat, lon and alt are given before the first fix, which sets them
        ("lat", "f8"),  # deg
        ("lon", "f8"),
        ("alt", "f8"),  # m AMSL
    ],
    align=True,
)

ALIGNMENT = np.dtype(  # ekf: sums over the samples before the first attitude
    [
        ("samples", "i4"),  # number of IMU samples
        ("accel", "f8", 3),  # m/s^2, body
        ("mag_samples", "i4"),
        ("mag", "f8", 3),  # gauss, body
    ],
    align=True,
)

INCREMENTS = np.dtype(  # ekf: motion since the last prediction of the covariance
    [
        ("time", "f8"),  # s
        ("angle", "f8", 3),  # rad, body
        ("velocity", "f8", 3),  # m/s, body
    ],
    align=True,
)

FIELD = np.dtype(  # fusion: moving average of the magnetic field
    [
        ("strength", "f8"),  # gauss, horizontal
        ("down", "f8"),  # gauss
        ("samples", "i4"),
    ],
    align=True,
)

INNOVATIONS = np.dtype(  # fusion and aiding: last innovation of each measurement, measured minus predicted
    [
        ("vel", "f8", 3),  # GPS
        ("pos", "f8", 3),  # GPS
        ("hgt", "f8"),  # any height source
        ("yaw", "f8"),  # magnetometer
        ("flow", "f8", 2),  # rad/s
        ("range", "f8"),
        ("vision_pos", "f8", 3),
        ("vision_vel", "f8", 3),
        ("vision_yaw", "f8"),
    ],
    align=True,
)

TEST_RATIOS = np.dtype(  # fusion and aiding: last test ratio of each measurement; 1: at the gate
    [
        ("vel", "f8"),  # GPS
        ("pos", "f8"),  # GPS
        ("hgt", "f8"),  # any height source
        ("mag", "f8"),
        ("gps_hgt", "f8"),
        ("baro", "f8"),
        ("flow", "f8"),
        ("range", "f8"),
        ("terrain", "f8"),
        ("vision_pos", "f8"),
        ("vision_vel", "f8"),
        ("vision_hgt", "f8"),
        ("vision_yaw", "f8"),
    ],
    align=True,
)

RESETS = np.dtype(  # fusion and origin: counters of the resets of each part of the state
    [
        ("any", "i4"),
        ("xy", "i4"),
        ("vxy", "i4"),
        ("z", "i4"),
        ("vz", "i4"),
        ("heading", "i4"),
    ],
    align=True,
)

SHIFTS = np.dtype(  # fusion and move_origin: change of each part (new minus old) by its last reset
    [
        ("xy", "f8", 2),  # m, local
        ("vxy", "f8", 2),  # m/s, local
        ("z", "f8"),
        ("vz", "f8"),
        ("heading", "f8"),  # rad
    ],
    align=True,
)

VIBRATION = np.dtype(  # autopilot/sensors
    [
        ("metrics", "f8", 3),  # coning (rad^2), change of rates (rad/s) and of specific force (m/s^2) per sample
        ("last_gyro", "f8", 3),  # rad/s, previous sample
        ("last_accel", "f8", 3),  # m/s^2, previous sample
    ],
    align=True,
)

ESTIMATOR = np.dtype(
    [
        ("origin", ORIGIN),
        ("alignment", ALIGNMENT),
        ("increments", INCREMENTS),
        ("field", FIELD),
        ("innovation", INNOVATIONS),
        ("test_ratio", TEST_RATIOS),
        ("resets", RESETS),
        ("shifts", SHIFTS),
        ("vibration", VIBRATION),
        # ekf: state
        ("initialised", "i4"),  # attitude aligned and covariance set
        ("q", "f8", 4),  # (w, x, y, z) body to local
        ("velocity", "f8", 3),  # m/s, local
        ("position", "f8", 3),  # m, local
        ("gyro_bias", "f8", 3),  # rad/s, body
        ("accel_bias", "f8", 3),  # m/s^2, body
        ("mag_bias", "f8", 3),  # gauss, body
        ("P", "f8", (N_STATES, N_STATES)),
        # autopilot/sensors
        ("rates_memory", "f8", (2, 3)),  # rad/s, of the filter of rates
        ("rates", "f8", 3),  # rad/s, body, bias-corrected and filtered for control
        ("angular_acceleration", "f8", 3),  # rad/s^2, body, filtered
        ("acceleration", "f8", 3),  # ekf: m/s^2, local, gravity removed
        # aiding: validity, 0 or 1, updated at 25 Hz
        ("attitude_valid", "i4"),  # attitude usable
        ("velocity_valid", "i4"),  # horizontal velocity usable
        ("position_valid", "i4"),  # horizontal position usable
        ("altitude_valid", "i4"),  # height usable
        ("global_valid", "i4"),  # position_valid, with a known origin and a heading from north
        ("heading_good", "i4"),  # from north, and accurate
        ("dead_reckoning", "i4"),  # no source has aided the horizontal state for a second
        ("terrain_valid", "i4"),  # height above ground known
        ("gps_good", "i4"),  # fixes arrive and have passed EKF2_GPS_CHECK for EKF2_REQ_GPS_H
        ("vision_good", "i4"),  # samples of sufficient quality arrive
        ("flow_good", "i4"),
        ("range_good", "i4"),
        ("baro_good", "i4"),
        ("mag_good", "i4"),  # samples of the Earth's field strength arrive, and no fault is declared
        # aiding: accuracy
        ("eph", "f8"),  # m, 1 sigma of the horizontal position
        ("epv", "f8"),  # m, of the vertical position
        ("evh", "f8"),  # m/s, 1 sigma of the horizontal velocity
        ("evv", "f8"),  # m/s, of the vertical velocity
        # aiding: sources in use
        ("heading_aligned", "i4"),  # the local frame's x points north
        ("mag_used", "i4"),
        ("gps_used", "i4"),
        ("flow_used", "i4"),
        ("vision_position_used", "i4"),
        ("vision_velocity_used", "i4"),
        ("vision_yaw_used", "i4"),
        ("height_used", "i4", 4),  # by HEIGHT_*
        ("flags", "i4"),  # ESTIMATOR_STATUS_FLAGS
        ("fault_flags", "i4"),  # 1: state not finite, 2: no IMU samples, 4: magnetic disturbance
        # aiding: offsets, terrain and magnetometer
        ("height_offset", "f8", 4),  # m, added to the measured down coordinate of each HEIGHT_* source
        ("vision_offset", "f8", 2),  # m, horizontal vision position minus local position while GPS sets the frame
        ("terrain", "f8"),  # m, down coordinate of the ground below
        ("terrain_variance", "f8"),
        ("last_position", "f8", 2),  # m, position held while no source aids
        ("located", "i4"),  # position and velocity have been initialised by a source
        ("vision_reset_counter", "i4"),
        ("in_air", "i4"),  # the land detector's result of the previous step
        ("mag_fault", "i4"),  # rejected again after its reset in the air: not used until landing
        ("mag_resets", "i4"),  # heading resets still allowed in the air
        # aiding: times of the last samples and fusions; 0: never
        ("time_aligned_us", "i8"),  # first attitude
        ("time_gps_fail_us", "i8"),
        ("time_imu_us", "i8"),  # last sample
        ("time_mag_us", "i8"),
        ("time_mag_disturbed_us", "i8"),  # last sample without the Earth's field strength
        ("time_baro_us", "i8"),
        ("time_last_gps_us", "i8"),
        ("time_flow_us", "i8"),
        ("time_range_us", "i8"),
        ("time_vision_us", "i8"),
        ("time_last_pos_fuse_us", "i8"),
        ("time_last_vel_fuse_us", "i8"),
        ("time_last_hgt_fuse_us", "i8"),
        ("time_height_fuse_us", "i8", 4),
        ("time_heading_fuse_us", "i8"),
        ("time_gps_fuse_us", "i8"),
        ("time_flow_fuse_us", "i8"),
        ("time_terrain_fuse_us", "i8"),
        ("time_vision_fuse_us", "i8", 3),  # position, velocity, yaw
    ],
    align=True,
)

# The one record that kernels only read, except for task_changed and the goal_position of a goal that moves. Comments
# name the module that writes the fields.
SETPOINT = np.dtype(
    [
        ("armed", "i4"),  # commander/motors
        # commander and navigator
        ("task", "i4"),
        ("task_changed", "i4"),  # 1 with every new task or goal; cleared by the flight task, which restarts smoothing
        # TASK_TRAJECTORY: commander/offboard_setpoint from a client's setpoint, manual_flight for a blind descent
        ("position", "f8", 3),  # m, local; NaN: not controlled, as in the fields below
        ("velocity", "f8", 3),  # m/s, local
        ("acceleration", "f8", 3),  # m/s^2, local
        ("yaw", "f8"),  # rad, local
        ("yaw_rate", "f8"),  # rad/s
        # TASK_ATTITUDE and TASK_RATES: commander/offboard_setpoint
        ("attitude_q", "f8", 4),  # (w, x, y, z)
        ("rates", "f8", 3),  # rad/s, body
        ("thrust", "f8"),  # 0..1 collective, as in SET_ATTITUDE_TARGET
        # TASK_GOTO, TASK_LAND: auto_setpoint; speeds: navigator and mission
        ("goal_position", "f8", 3),  # m, local
        ("goal_yaw", "f8"),  # rad; NaN keeps the heading
        ("goal_velocity", "f8", 2),  # m/s, local; velocity of a goal, which the flight task carries along
        ("cruise_speed", "f8"),  # m/s horizontal; NaN: MPC_XY_CRUISE
        ("climb_speed", "f8"),  # m/s upwards; NaN: MPC_Z_V_AUTO_UP (takeoff: MPC_TKO_SPEED)
        ("descend_speed", "f8"),  # m/s downwards; NaN: MPC_Z_V_AUTO_DN
        # manual_flight: sticks, -1..1, heading frame: x forward, y right, z up (throttle, 0 in the middle), yaw
        # clockwise. Dead zone and expo are applied to all for TASK_STICKS, to z and yaw for TASK_ALTITUDE, to none for
        # TASK_MANUAL and TASK_ACRO.
        ("stick_x", "f8"),
        ("stick_y", "f8"),
        ("stick_z", "f8"),
        ("stick_yaw", "f8"),
        # TASK_GOTO: auto_setpoint
        ("onward_position", "f8", 3),  # m, local; next goal, reached without a stop at the current one; NaN: stop there
        ("goal_radius", "f8"),  # m, distance from the goal at which it is reached; NaN: NAV_ACC_RAD
        # TASK_ORBIT: orbit
        ("orbit_centre", "f8", 2),  # m, local north and east
        ("orbit_radius", "f8"),  # m
        ("orbit_speed", "f8"),  # m/s along the circle, positive clockwise from above
        ("orbit_yaw", "i4"),  # ORBIT_*
        ("orbit_heading", "f8"),  # rad, heading at the start of the orbit
        # TASK_FOLLOW: follow_target
        ("target_position", "f8", 3),  # m, local, estimate at target_time; NaN without a target
        ("target_velocity", "f8", 3),  # m/s, local
        ("target_acceleration", "f8", 3),  # m/s^2, local
        ("target_time", "f8"),  # s, CONTROL.armed_time of the estimate
        ("home_z", "f8"),  # m, local: home's down coordinate at the start of the mode
        # control allocation: failure_detector
        ("failed_rotors", "i4"),  # bit i: rotor i has failed and gets no command
    ],
    align=True,
)

# The parts of CONTROL that one module writes.

TAKEOFF = np.dtype(  # position_control
    [
        ("state", "i4"),  # TAKEOFF_*
        ("ramp_progress", "f8"),  # 0..1, progress of the takeoff ramp
        ("ramp_speed", "f8"),  # m/s, upward speed limit of the takeoff ramp
    ],
    align=True,
)

LANDING = np.dtype(  # land_detector
    [
        ("landed", "i4"),
        ("maybe_landed", "i4"),
        ("ground_contact", "i4"),
        ("ground_contact_time", "f8"),  # s for which each condition has held
        ("maybe_landed_time", "f8"),
        ("landed_time", "f8"),
        ("freefall", "i4"),
        ("freefall_time", "f8"),  # s
        ("least_thrust_time", "f8"),  # s at the minimum thrust
        ("since_maybe_landed", "f8"),  # s
    ],
    align=True,
)

HOVER = np.dtype(  # hover_thrust
    [
        ("estimate", "f8"),  # 0..1, state of the filter
        ("variance", "f8"),
        ("noise", "f8"),  # m^2/s^4, variance of the acceleration
        ("residual", "f8"),  # m/s^2, low-passed
        ("test_ratio", "f8"),  # low-passed, signed
        ("valid_time", "f8"),  # s for which the variance has been small
        ("valid", "i4"),
    ],
    align=True,
)

PATH = np.dtype(  # flight_tasks: smoothed path, see ``jerk_limited_velocity``
    [
        ("acceleration", "f8", 3),  # m/s^2, local
        ("position", "f8", 3),  # m, local
        ("velocity", "f8", 3),  # m/s, local
        ("times", "f8", (3, 3)),  # s of rising, constant and falling acceleration planned for each axis
        ("direction", "f8", 3),  # sign of the first jerk in the plan
        ("yaw", "f8"),  # rad
        ("yaw_rate", "f8"),  # rad/s, filtered slope of yaw
    ],
    align=True,
)

ANGLE = np.dtype(  # follow_task: jerk-limited angle of the vehicle around the target, with the one axis of a PATH
    [
        ("position", "f8", (1,)),  # rad from north, bearing of the vehicle from the target, not wrapped
        ("velocity", "f8", (1,)),  # rad/s
        ("acceleration", "f8", (1,)),  # rad/s^2
        ("times", "f8", (1, 3)),
        ("direction", "f8", (1,)),
    ],
    align=True,
)

FOLLOWED = np.dtype(  # follow_task: filtered motion of the target
    [
        ("position", "f8", 3),  # m, local; NaN before the first estimate
        ("velocity", "f8", 3),  # m/s, local
        ("course", "f8"),  # rad from north, 0 until the target moves
        ("angle", ANGLE),
    ],
    align=True,
)

OBSTACLE_BINS = 36  # directions of OBSTACLES, 10 degrees each, clockwise from the nose
OBSTACLE_UNKNOWN = 65535.0  # a distance that is not known

OBSTACLES = np.dtype(  # collision_prevention
    [
        ("distances", "f8", OBSTACLE_BINS),  # cm; OBSTACLE_UNKNOWN
        ("ranges", "f8", OBSTACLE_BINS),  # cm, largest range of the sensor of each distance
        ("times_us", "i8", OBSTACLE_BINS),  # arrival of each distance
        ("covered", "i4", OBSTACLE_BINS),  # 1: a sensor has seen this direction
        ("time_us", "i8"),  # arrival of the newest data
        ("least", "f8"),  # cm, smallest and largest range of all sensors
        ("largest", "f8"),
        ("active_us", "i8"),  # begin of collision prevention; -1: off
        ("warned_us", "i8"),  # last check for missing data
        ("hold", "i4"),  # 1: data are missing, requests the hold mode
    ],
    align=True,
)

CONTROL = np.dtype(
    [
        ("takeoff", TAKEOFF),
        ("landing", LANDING),
        ("hover", HOVER),
        ("path", PATH),
        ("followed", FOLLOWED),
        ("resets_seen", RESETS),  # by flight_tasks: the resets already applied to the smoothed path
        # autopilot
        ("tick", "i8"),  # steps since the start, from which the slower loops are timed
        ("armed_time", "f8"),  # s since arming
        ("tilt_limit", "f8"),  # rad, by position_control: slewed between MPC_TILTMAX_LND and MPC_TILTMAX_AIR
        # stick_control
        ("throttle_min", "f8"),  # 0..1, minimum thrust by stick, slewed to MPC_MANTHR_MIN in the air
        ("throttle_max", "f8"),  # 0..1, largest thrust by stick, slewed up after arming
        # autopilot and position_control
        ("hover_thrust", "f8"),  # 0..1, thrust in use for 1 g: MPC_THR_HOVER, or the estimate in flight
        # position_control, attitude_and_rate_control and control_allocator
        ("last_velocity", "f8", 3),  # m/s, local, at the last run of the position loop; NaN after a reset
        ("velocity_dot", "f8", 3),  # m/s^2, local, filtered derivative of velocity
        ("velocity_integral", "f8", 3),  # m/s^2
        ("rate_integral", "f8", 3),  # normalised torque
        ("saturation_pos", "i4", 3),  # 1: the torque about this axis cannot rise
        ("saturation_neg", "i4", 3),  # 1: it cannot fall
        # flight_tasks: GOTO and LAND
        ("last_task", "i4"),
        ("unsmoothed_climb", "f8"),  # m/s downwards, wanted speed before smoothing
        ("braking", "i4"),  # far above the speed limits: brake at 1 g first
        ("turn_speed", "f8"),  # m/s, horizontal speed at the entry of a turn
        ("goal_from_ground", "i4"),  # the goal was set on the ground: a takeoff
        ("leg_start", "f8", 3),  # m, local: commanded leg, its goal, and the next goal
        ("leg_goal", "f8", 3),
        ("leg_onward", "f8", 3),
        ("way_start", "f8", 3),  # m, local: the leg in use, which may lead back to the commanded one
        ("way_goal", "f8", 3),
        ("way_onward", "f8", 3),
        ("goal_velocity", "f8", 2),  # m/s, local: of the frame in which path.velocity and the legs are
        ("leg_state", "i4"),
        # flight_tasks: STICKS and ALTITUDE
        ("stick_acceleration", "f8", 2),  # m/s^2, local, jerk-limited; low-passed stick for ALTITUDE and MANUAL
        ("brake_boost", "f8"),  # factor of the drag, raised while the sticks are centred
        ("hold_xy", "i4"),  # 1: the current position is held
        ("hold_z", "i4"),
        ("over_ground", "i4"),  # 1: the held height is that above ground
        ("held_height", "f8"),  # m above ground
        ("obstacles", OBSTACLES),
        # flight_tasks: output, from which the position loop computes sp_*
        ("want_takeoff", "i4"),  # the task wants to leave the ground
        ("task_position", "f8", 3),
        ("task_velocity", "f8", 3),
        ("task_acceleration", "f8", 3),
        ("task_yaw", "f8"),
        ("task_yaw_rate", "f8"),
        ("speed_down", "f8"),  # m/s, largest sink rate of the task
        ("ground_z", "f8"),  # m, local: down coordinate at the last ground contact
        # setpoints of the control cascade, also for telemetry and logs
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
        ("actuators", "f8", MAX_ROTORS),  # 0..1 motor commands; 0 when disarmed, except for motor tests
    ],
    align=True,
)


def records(dtype: np.dtype, count: int) -> np.ndarray:
    """Return ``count`` zeroed records of ``dtype`` (shape (count,))."""
    return np.zeros(count, dtype=dtype)


@dataclass
class MotorTest:
    """A test of single motors of a disarmed vehicle.

    Attributes:
        outputs: motor commands, 0..1, shape (MAX_ROTORS,); NaN for a motor that stands still.
        end_us: simulated time of the end, microseconds.
    """

    outputs: NDArray[np.float64]
    end_us: int
