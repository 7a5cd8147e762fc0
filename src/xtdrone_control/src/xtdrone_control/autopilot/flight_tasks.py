"""From what the flight mode wants (``SETPOINT``) to the trajectory set-points that the position controller follows.

One function a task, as PX4's flight tasks: OFFBOARD trajectories pass as they are, goals are approached on an
acceleration- and jerk-limited path, landing follows PX4's speed profile, sticks command velocities.
"""

from __future__ import annotations

import math

from .kernel import kernel
from .rotation import constrain, wrap_pi, yaw_of
from .state import (
    TAKEOFF_FLIGHT,
    TASK_DESCEND,
    TASK_GOTO,
    TASK_LAND,
    TASK_STICKS,
    TASK_TRAJECTORY,
)

_NAN = math.nan
_TRACKING_TIME = 0.3  # s, how fast the smoothed velocity follows its target inside the acceleration limit


@kernel
def _or_default(value, default):
    return default if math.isnan(value) else value


@kernel
def clear_setpoints(c):
    """Mark every axis of the trajectory set-point as not controlled."""
    for i in range(3):
        c.sp_position[i] = _NAN
        c.sp_velocity[i] = _NAN
        c.sp_acceleration[i] = _NAN
    c.sp_yaw = _NAN
    c.sp_yaw_rate = _NAN


@kernel
def restart_smoothing(c, e):
    """Start the smoothed path at the estimate."""
    for i in range(3):
        c.smooth_position[i] = e.position[i]
        c.smooth_velocity[i] = e.velocity[i]
        c.smooth_acceleration[i] = 0.0
    c.hold_xy = 0
    c.hold_z = 0


@kernel
def _advance_axis(c, i, target, accel_limit, jerk, dt):
    """Move the smoothed velocity and position of axis ``i`` towards the velocity ``target``."""
    wanted = constrain((target - c.smooth_velocity[i]) / _TRACKING_TIME, -accel_limit, accel_limit)
    c.smooth_acceleration[i] += constrain(wanted - c.smooth_acceleration[i], -jerk * dt, jerk * dt)
    before = c.smooth_velocity[i]
    c.smooth_velocity[i] = before + c.smooth_acceleration[i] * dt
    c.smooth_position[i] += 0.5 * (before + c.smooth_velocity[i]) * dt


@kernel
def _approach_speed(distance, accel, jerk, limit, final):
    """Return the speed from which ``distance`` suffices to slow down to ``final`` (m/s).

    PX4 trajectory::computeMaxSpeedFromDistance.
    """
    b = 4.0 * accel * accel / jerk
    speed = 0.5 * (-b + math.sqrt(b * b + 4.0 * (2.0 * accel * distance + final * final)))
    return min(max(speed, final), limit)


@kernel
def _speed_through(c, s, e, p):
    """Return the horizontal speed (m/s) at the goal, from where it goes on to onward_position; 0 to stop there.

    A circle of the acceptance radius joins the two legs, flown with a share of MPC_ACC_HOR (PX4
    trajectory::computeStartXYSpeedFromWaypoints). Where the height changes the vehicle stops.
    """
    ox, oy = s.onward_position[0] - s.goal_position[0], s.onward_position[1] - s.goal_position[1]
    gx, gy = s.goal_position[0] - c.smooth_position[0], s.goal_position[1] - c.smooth_position[1]
    onward, distance = math.hypot(ox, oy), math.hypot(gx, gy)
    # written so that NaN, no onward position, stops
    if not (onward >= s.goal_radius and onward > 1e-3 and distance > 1e-3):
        return 0.0
    if abs(s.goal_position[2] - e.position[2]) >= p.nav_mc_alt_rad:
        return 0.0
    if abs(s.onward_position[2] - s.goal_position[2]) >= p.nav_mc_alt_rad:
        return 0.0
    # tangent of half the angle between the legs, 1 for a right angle, infinite straight on
    cos = constrain((ox * gx + oy * gy) / (onward * distance), -1.0, 1.0)
    tan_half = math.sqrt((1.0 + cos) / max(1.0 - cos, 1e-9))
    return math.sqrt(p.mpc_xy_traj_p * p.mpc_acc_hor * s.goal_radius * tan_half)


@kernel
def _smooth_horizontal(c, s, e, p, dt):
    dx = s.goal_position[0] - c.smooth_position[0]
    dy = s.goal_position[1] - c.smooth_position[1]
    distance = math.hypot(dx, dy)
    cruise = min(_or_default(s.cruise_speed, p.mpc_xy_cruise), p.mpc_xy_vel_max)
    through = _speed_through(c, s, e, p) if s.task == TASK_GOTO else 0.0
    speed = _approach_speed(distance, p.mpc_acc_hor, p.mpc_jerk_auto, cruise, through)
    lag = math.hypot(c.smooth_position[0] - e.position[0], c.smooth_position[1] - e.position[1])
    speed *= constrain(1.0 - lag / p.mpc_xy_err_max, 0.0, 1.0)  # wait for a vehicle that cannot follow
    scale = speed / distance if distance > 1e-6 else 0.0
    _advance_axis(c, 0, dx * scale, p.mpc_acc_hor, p.mpc_jerk_auto, dt)
    _advance_axis(c, 1, dy * scale, p.mpc_acc_hor, p.mpc_jerk_auto, dt)


@kernel
def _smooth_vertical(c, s, e, p, dt):
    dz = s.goal_position[2] - c.smooth_position[2]
    up = min(_or_default(s.climb_speed, p.mpc_z_v_auto_up), p.mpc_z_vel_max_up)
    down = min(_or_default(s.descend_speed, p.mpc_z_v_auto_dn), p.mpc_z_vel_max_dn)
    limit = up if dz < 0.0 else down
    accel = p.mpc_acc_up_max if dz < 0.0 else p.mpc_acc_down_max
    speed = _approach_speed(abs(dz), accel, p.mpc_jerk_auto, limit, 0.0)
    lag = abs(c.smooth_position[2] - e.position[2])
    speed *= constrain(1.0 - lag / p.mpc_xy_err_max, 0.0, 1.0)
    _advance_axis(c, 2, math.copysign(speed, dz), accel, p.mpc_jerk_auto, dt)


@kernel
def _smooth_yaw(c, s, p, dt):
    if math.isnan(s.goal_yaw):
        return
    step = math.radians(p.mpc_yawrauto_max) * dt
    c.smooth_yaw = wrap_pi(c.smooth_yaw + constrain(wrap_pi(s.goal_yaw - c.smooth_yaw), -step, step))


@kernel
def trajectory_task(c, s, dt):
    """OFFBOARD: the given position, velocity and acceleration; the heading is held when only its rate is given."""
    for i in range(3):
        c.sp_position[i] = s.position[i]
        c.sp_velocity[i] = s.velocity[i]
        c.sp_acceleration[i] = s.acceleration[i]
    if not math.isnan(s.yaw):
        c.smooth_yaw = s.yaw
    elif not math.isnan(s.yaw_rate):
        c.smooth_yaw = wrap_pi(c.smooth_yaw + s.yaw_rate * dt)
    c.sp_yaw = c.smooth_yaw
    c.sp_yaw_rate = s.yaw_rate


@kernel
def goto_task(c, s, e, p, dt):
    """Fly to goal_position on a smoothed path; before the vehicle is off the ground, just climb."""
    _smooth_yaw(c, s, p, dt)
    c.sp_yaw = c.smooth_yaw
    c.sp_yaw_rate = 0.0
    if c.takeoff_state < TAKEOFF_FLIGHT:
        yaw = c.smooth_yaw
        restart_smoothing(c, e)
        c.smooth_yaw = yaw
        for i in range(2):
            c.sp_velocity[i] = 0.0
        rises = s.goal_position[2] < e.position[2] - 0.2
        c.sp_velocity[2] = -_or_default(s.climb_speed, p.mpc_tko_speed) if rises else 0.0
        return
    _smooth_horizontal(c, s, e, p, dt)
    _smooth_vertical(c, s, e, p, dt)
    for i in range(3):
        c.sp_position[i] = c.smooth_position[i]
        c.sp_velocity[i] = c.smooth_velocity[i]
        c.sp_acceleration[i] = c.smooth_acceleration[i]


@kernel
def _landing_speed(height, p):
    """Return PX4's descent speed (m/s) at ``height`` m: cruise descent over ALT1, MPC_LAND_SPEED under ALT2."""
    if height >= p.mpc_land_alt1:
        return p.mpc_z_v_auto_dn
    if height <= p.mpc_land_alt2:
        return p.mpc_land_speed
    share = (height - p.mpc_land_alt2) / (p.mpc_land_alt1 - p.mpc_land_alt2)
    return p.mpc_land_speed + share * (p.mpc_z_v_auto_dn - p.mpc_land_speed)


@kernel
def land_task(c, s, e, p, dt):
    """Stay over the goal's xy and descend; goal_position[2] is the height of the ground, as far as known."""
    _smooth_horizontal(c, s, e, p, dt)
    _smooth_yaw(c, s, p, dt)
    speed = _landing_speed(s.goal_position[2] - e.position[2], p)
    _advance_axis(c, 2, speed, p.mpc_acc_down_max, p.mpc_jerk_auto, dt)
    for i in range(2):
        c.sp_position[i] = c.smooth_position[i]
        c.sp_velocity[i] = c.smooth_velocity[i]
        c.sp_acceleration[i] = c.smooth_acceleration[i]
    c.sp_velocity[2] = c.smooth_velocity[2]
    c.smooth_position[2] = e.position[2]
    c.sp_yaw = c.smooth_yaw
    c.sp_yaw_rate = 0.0


@kernel
def descend_task(c, p):
    """Descend with a level attitude: nothing is known of the horizontal motion."""
    c.sp_acceleration[0] = 0.0
    c.sp_acceleration[1] = 0.0
    c.sp_velocity[2] = p.mpc_land_speed
    c.sp_yaw_rate = 0.0


@kernel
def sticks_task(c, s, e, p, dt):
    """POSCTL: sticks command a velocity in the heading's frame; a centred stick brakes and then holds position."""
    c.smooth_yaw = wrap_pi(c.smooth_yaw + s.stick_yaw * math.radians(p.mpc_man_y_max) * dt)
    cos, sin = math.cos(c.smooth_yaw), math.sin(c.smooth_yaw)
    norm = math.hypot(s.stick_x, s.stick_y)
    scale = p.mpc_vel_manual / max(norm, 1.0)
    target_x = scale * (cos * s.stick_x - sin * s.stick_y)
    target_y = scale * (sin * s.stick_x + cos * s.stick_y)
    centred = norm == 0.0
    if centred and math.hypot(e.velocity[0], e.velocity[1]) < p.mpc_hold_max_xy and not c.hold_xy:
        c.hold_xy = 1
        for i in range(2):
            c.smooth_position[i] = e.position[i]
            c.smooth_velocity[i] = e.velocity[i]
    if not centred:
        c.hold_xy = 0
    _advance_axis(c, 0, target_x, p.mpc_acc_hor, p.mpc_jerk_max, dt)
    _advance_axis(c, 1, target_y, p.mpc_acc_hor, p.mpc_jerk_max, dt)
    speed_z = -s.stick_z * (p.mpc_z_vel_max_up if s.stick_z > 0.0 else p.mpc_z_vel_max_dn)
    if s.stick_z == 0.0 and abs(e.velocity[2]) < p.mpc_hold_max_z and not c.hold_z:
        c.hold_z = 1
        c.smooth_position[2] = e.position[2]
        c.smooth_velocity[2] = e.velocity[2]
    if s.stick_z != 0.0:
        c.hold_z = 0
    accel_z = p.mpc_acc_up_max if s.stick_z > 0.0 else p.mpc_acc_down_max
    _advance_axis(c, 2, speed_z, accel_z, p.mpc_jerk_max, dt)
    for i in range(3):
        c.sp_velocity[i] = c.smooth_velocity[i]
        c.sp_acceleration[i] = c.smooth_acceleration[i]
    if c.hold_xy:
        c.sp_position[0] = c.smooth_position[0]
        c.sp_position[1] = c.smooth_position[1]
    if c.hold_z:
        c.sp_position[2] = c.smooth_position[2]
    c.sp_yaw = c.smooth_yaw
    c.sp_yaw_rate = s.stick_yaw * math.radians(p.mpc_man_y_max)


@kernel
def generate_setpoint(c, s, e, p, dt):
    """Fill the trajectory set-point of ``c`` for the present task."""
    if s.task_changed:
        if c.last_task != s.task:
            restart_smoothing(c, e)
            c.smooth_yaw = yaw_of(e.q)
        c.last_task = s.task
        s.task_changed = 0
    clear_setpoints(c)
    if s.task == TASK_TRAJECTORY:
        trajectory_task(c, s, dt)
    elif s.task == TASK_GOTO:
        goto_task(c, s, e, p, dt)
    elif s.task == TASK_LAND:
        land_task(c, s, e, p, dt)
    elif s.task == TASK_DESCEND:
        descend_task(c, p)
    elif s.task == TASK_STICKS:
        sticks_task(c, s, e, p, dt)
