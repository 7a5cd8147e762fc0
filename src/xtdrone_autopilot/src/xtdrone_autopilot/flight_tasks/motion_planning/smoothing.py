"""The smoothed path of a vehicle: jerk-limited in position, slewed in heading (PX4: PositionSmoothing)."""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.motion_planning.jerk_limited_velocity import follow, plan
from xtdrone_autopilot.kernel import kernel
from xtdrone_common.geodesy.projection import GRAVITY
from xtdrone_common.rotation_kernels import constrain, wrap_pi

_WAIT_SPEED = 0.7  # m/s downwards, initial vertical speed of the smoothed path at takeoff, as in PX4
_YAW_TAU = 0.2  # s, time constant of the yaw rate feed-forward
_OVERSPEED = 1.3  # factor on the speed limits above which the vehicle brakes first


@kernel
def or_default(value, default):
    """Return ``value``, or ``default`` for NaN."""
    return default if math.isnan(value) else value


@kernel
def reset_smoothing(path, i, position, velocity, acceleration):
    """Restart the smoothed path of axis ``i`` from a state in local NED (m, m/s, m/s^2)."""
    path.position[i] = position
    path.velocity[i] = velocity
    path.acceleration[i] = acceleration
    path.direction[i] = 0.0
    for k in range(3):
        path.times[i, k] = 0.0


@kernel
def vertical_limits(c, s, e, p):
    """Return the largest vertical speed (m/s) and acceleration (m/s^2) of the path; lower at takeoff."""
    if c.unsmoothed_climb >= 0.0:
        return or_default(s.descend_speed, p.mpc_z_v_auto_dn), p.mpc_acc_down_max
    speed, accel = or_default(s.climb_speed, p.mpc_z_v_auto_up), p.mpc_acc_up_max
    if c.goal_from_ground and c.ground_z - e.position[2] < p.mpc_land_alt1:
        speed = or_default(s.climb_speed, p.mpc_tko_speed)
        accel = min(accel, p.mpc_tko_speed / max(p.mpc_tko_ramp_t, 1e-3))
        # keep the path at the vehicle's height, so that it does not start below the ground
        c.path.position[2] = e.position[2]
    return speed, accel


@kernel
def update_braking(c, p):
    """Start braking above ``_OVERSPEED`` times a speed limit; end it at standstill."""
    speed = math.hypot(c.path.velocity[0], c.path.velocity[1])
    down = c.path.velocity[2]
    if not c.braking:
        too_fast = speed > _OVERSPEED * p.mpc_xy_vel_max
        too_fast = too_fast or down > _OVERSPEED * p.mpc_z_vel_max_dn or down < -_OVERSPEED * p.mpc_z_vel_max_up
        c.braking = 1 if too_fast else 0
    elif abs(down) < 0.01 and speed < 0.01:
        c.braking = 0


@kernel
def _lag_stretch(c, e, p):
    """Return the time factor of the path, 0..1, which slows down for a vehicle that lags behind."""
    dx, dy = c.path.position[0] - e.position[0], c.path.position[1] - e.position[1]
    if dx * c.path.velocity[0] + dy * c.path.velocity[1] < 0.0:
        return 1.0
    return 1.0 - constrain(math.hypot(dx, dy) / p.mpc_xy_err_max, 0.0, 1.0)


@kernel
def smooth(c, s, e, p, wanted, dt):
    """Advance the smoothed path, replan it to the velocity ``wanted`` (tuple, m/s) and write it to the setpoint."""
    speed_z, accel_z = vertical_limits(c, s, e, p)
    accel_xy, jerk = p.mpc_acc_hor, p.mpc_jerk_auto
    c.speed_down = max(p.mpc_z_vel_max_dn, 1.2 * p.mpc_z_v_auto_dn)  # margin for height corrections
    if c.braking:
        wanted = (0.0, 0.0, 0.0)
        accel_xy = accel_z = jerk = GRAVITY
        speed_z = max(speed_z, abs(c.path.velocity[2]))
        c.speed_down = max(c.speed_down, abs(c.path.velocity[2]))
    step = dt * _lag_stretch(c, e, p)
    for i in range(3):
        follow(c.path, i, jerk, step)
        c.task_position[i] = c.path.position[i]
        c.task_velocity[i] = c.path.velocity[i]
        c.task_acceleration[i] = c.path.acceleration[i]
    plan(c.path, wanted, (p.mpc_xy_vel_max, p.mpc_xy_vel_max, speed_z), (accel_xy, accel_xy, accel_z), jerk)
    c.unsmoothed_climb = wanted[2]


@kernel
def smooth_yaw(c, wanted, p, dt):
    """Slew the heading to ``wanted`` (rad; NaN: keep it) at up to MPC_YAWRAUTO_MAX, with a yaw rate feed-forward."""
    limit = math.radians(p.mpc_yawrauto_max)
    turn = 0.0
    if not math.isnan(wanted):
        turn = constrain(wrap_pi(wanted - c.path.yaw), -limit * dt, limit * dt)
    c.path.yaw = wrap_pi(c.path.yaw + turn)
    c.path.yaw_rate += dt / (_YAW_TAU + dt) * (turn / dt - c.path.yaw_rate)
    c.task_yaw = c.path.yaw
    c.task_yaw_rate = constrain(c.path.yaw_rate, -limit, limit)


@kernel
def keep_path_at_vehicle(c, e):
    """Keep the smoothed path at the vehicle until the takeoff ramp starts."""
    for i in range(3):
        reset_smoothing(c.path, i, e.position[i], _WAIT_SPEED if i == 2 else 0.0, 0.0)
