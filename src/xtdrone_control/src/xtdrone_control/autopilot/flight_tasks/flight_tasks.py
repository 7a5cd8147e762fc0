"""Flight tasks: from the flight mode's goal (``SETPOINT``) to the trajectory setpoint of the position controller.

One function per task, after PX4 v1.14's flight tasks: OFFBOARD trajectories are passed on unchanged, goals are
approached on a jerk-limited path along the leg between two waypoints, landing follows PX4's speed profile, and sticks
command accelerations, velocities, tilts or climb rates. Each task writes task_position, task_velocity,
task_acceleration (NaN: not controlled), task_yaw, task_yaw_rate and want_takeoff of ``CONTROL``.
"""

from __future__ import annotations

import math

from xtdrone_control.autopilot.flight_tasks.follow_task import follow_task, start_following
from xtdrone_control.autopilot.flight_tasks.trajectory import follow, plan, plan_axis, stopping_speed, turning_speed
from xtdrone_control.autopilot.state import (
    ORBIT_ALONG_CIRCLE,
    ORBIT_INITIAL_HEADING,
    ORBIT_UNCONTROLLED,
    TAKEOFF_RAMPUP,
    TASK_ALTITUDE,
    TASK_DESCEND,
    TASK_FOLLOW,
    TASK_GOTO,
    TASK_LAND,
    TASK_ORBIT,
    TASK_STICKS,
    TASK_TRAJECTORY,
)
from xtdrone_control.geodesy.geo import GRAVITY
from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import constrain, wrap_pi, yaw_of

_NAN = math.nan
_NO_LEG, _BEHIND, _AHEAD, _OFF = (
    0,
    1,
    2,
    3,
)  # leg_state: on the leg (or none), past the goal, before the start, beside the leg
_LEAD = 5.0  # m, least lookahead distance in turns (L1 guidance)
_WAIT_SPEED = 0.7  # m/s downwards, initial vertical speed of the smoothed path at takeoff, as in PX4
_TAKEOFF_CLIMB = 0.3  # m/s, climb rate above which a takeoff starts
_TAKEOFF_STICK = 0.3  # throttle stick above which a takeoff starts
_YAW_TAU = 0.2  # s, time constant of the yaw rate feed-forward
_BRAKE_TAU = 0.8  # s, time constant of the braking factor with centred sticks
_YAW_STILL = 0.001  # rad/s, below which the heading is held
_OVERSPEED = 1.3  # factor on the speed limits above which the vehicle brakes first


@kernel
def _or_default(value, default):
    return default if math.isnan(value) else value


@kernel
def clear_task(c):
    """Mark every axis of the trajectory setpoint as not controlled."""
    for i in range(3):
        c.task_position[i] = _NAN
        c.task_velocity[i] = _NAN
        c.task_acceleration[i] = _NAN
    c.task_yaw = _NAN
    c.task_yaw_rate = _NAN


@kernel
def _reset_smoothing(path, i, position, velocity, acceleration):
    path.position[i] = position
    path.velocity[i] = velocity
    path.acceleration[i] = acceleration
    path.direction[i] = 0.0
    for k in range(3):
        path.times[i, k] = 0.0


# legs


@kernel
def _start_leg(c, s, e):
    """Start the leg to a new goal: from the previous goal if that led on to this one, else from the vehicle."""
    onwards = True  # false for NaN, no onward waypoint
    for i in range(3):
        onwards = onwards and abs(c.leg_onward[i] - s.goal_position[i]) < 1e-3
    for i in range(3):
        c.leg_start[i] = c.leg_goal[i] if onwards else e.position[i]
        c.leg_goal[i] = s.goal_position[i]
        c.leg_onward[i] = s.onward_position[i]
    c.goal_from_ground = 1 if c.takeoff.state < TAKEOFF_RAMPUP else 0


@kernel
def _leg_changed(c, s):
    for i in range(3):
        if not abs(c.leg_goal[i] - s.goal_position[i]) < 1e-3:
            return True
        # NaN in both is no change
        same = c.leg_onward[i] == s.onward_position[i] or (
            math.isnan(c.leg_onward[i]) and math.isnan(s.onward_position[i])
        )
        if not same:
            return True
    return False


@kernel
def _state_on_leg(c, e, radius):
    """Return the state on the leg, and the north and east (m, local) of the nearest point on its line."""
    dx, dy = c.leg_goal[0] - c.leg_start[0], c.leg_goal[1] - c.leg_start[1]
    length = math.hypot(dx, dy)
    if length < 1e-6:
        return _NO_LEG, 0.0, 0.0
    ux, uy = dx / length, dy / length
    fx, fy = e.position[0] - c.leg_start[0], e.position[1] - c.leg_start[1]
    along = fx * ux + fy * uy
    nx, ny = c.leg_start[0] + ux * along, c.leg_start[1] + uy * along
    if along > length:
        return _BEHIND, nx, ny
    if along < 0.0 and math.hypot(fx, fy) > radius:
        return _AHEAD, nx, ny
    if math.hypot(e.position[0] - nx, e.position[1] - ny) > radius:
        return _OFF, nx, ny
    return _NO_LEG, nx, ny


@kernel
def _update_internal_leg(c, s, e, radius):
    """Update way_*: the leg, or a leg back to it (PX4 FlightTaskAuto::_updateInternalWaypoints)."""
    changed = _leg_changed(c, s)
    if changed:
        _start_leg(c, s, e)
    state, nx, ny = _state_on_leg(c, e, radius)
    if not (changed or state != c.leg_state or state == _OFF):
        return
    c.leg_state = state
    for i in range(3):
        c.way_start[i] = e.position[i] if state != _NO_LEG else c.leg_start[i]
        if state in (_NO_LEG, _BEHIND):
            c.way_goal[i] = c.leg_goal[i]
            c.way_onward[i] = c.leg_onward[i]
        else:
            c.way_onward[i] = c.leg_goal[i]
            c.way_goal[i] = c.leg_start[i]
    if state == _OFF:
        c.way_goal[0], c.way_goal[1], c.way_goal[2] = nx, ny, c.leg_goal[2]


@kernel
def _turning(c, radius):
    """Return whether the smoothed path is in a turn: it moves, but not towards the goal."""
    vx, vy = c.path.velocity[0], c.path.velocity[1]
    gx, gy = c.way_goal[0] - c.path.position[0], c.way_goal[1] - c.path.position[1]
    speed, distance = math.hypot(vx, vy), math.hypot(gx, gy)
    return speed > 0.2 and distance > radius and vx * gx + vy * gy < 0.98 * speed * distance


@kernel
def _lead_point(c, radius):
    """Return the point (m, local) on the leg to steer to in a turn, ahead of the nearest point (L1 guidance)."""
    ux, uy, uz = c.way_goal[0] - c.way_start[0], c.way_goal[1] - c.way_start[1], c.way_goal[2] - c.way_start[2]
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    if length > 0.0:
        ux, uy, uz = ux / length, uy / length, uz / length
    fx = c.path.position[0] - c.way_start[0]
    fy = c.path.position[1] - c.way_start[1]
    fz = c.path.position[2] - c.way_start[2]
    along = fx * ux + fy * uy + fz * uz
    across2 = (fx - ux * along) ** 2 + (fy - uy * along) ** 2 + (fz - uz * along) ** 2
    lead = max(radius, _LEAD)
    ahead = along + math.sqrt(max(lead * lead - across2, 0.0))
    return c.way_start[0] + ux * ahead, c.way_start[1] + uy * ahead, c.way_start[2] + uz * ahead


@kernel
def _speed_through(c, p, radius, cruise):
    """Return the horizontal speed (m/s) at the goal on the way to way_onward; 0 to stop there.

    A circle within the acceptance radius joins the two legs, flown with the share MPC_XY_TRAJ_P of MPC_ACC_HOR (PX4
    trajectory::computeStartXYSpeedFromWaypoints). The vehicle stops at waypoints where the height changes.
    """
    ox, oy = c.way_onward[0] - c.way_goal[0], c.way_onward[1] - c.way_goal[1]
    gx, gy = c.way_goal[0] - c.path.position[0], c.way_goal[1] - c.path.position[1]
    onward, distance = math.hypot(ox, oy), math.hypot(gx, gy)
    # a comparison with NaN (no onward waypoint) is false: stop
    if not (onward >= radius and onward > 1e-3 and distance > 1e-6):
        return 0.0
    if abs(c.way_goal[2] - c.path.position[2]) >= p.nav_mc_alt_rad:
        return 0.0
    if abs(c.way_onward[2] - c.way_goal[2]) >= p.nav_mc_alt_rad:
        return 0.0
    # angle between the legs, pi for straight on
    angle = math.acos(constrain(-(ox * gx + oy * gy) / (onward * distance), -1.0, 1.0))
    leaving = min(cruise, stopping_speed(onward, p.mpc_acc_hor, p.mpc_jerk_auto, 0.0))
    return min(turning_speed(angle, p.mpc_xy_traj_p * p.mpc_acc_hor, radius), leaving, cruise)


@kernel
def _horizontal_speed(c, p, radius, cruise):
    distance = math.hypot(c.way_goal[0] - c.path.position[0], c.way_goal[1] - c.path.position[1])
    final = _speed_through(c, p, radius, cruise)
    speed = min(stopping_speed(distance, p.mpc_acc_hor, p.mpc_jerk_auto, final), cruise)
    if _turning(c, radius):
        return min(c.turn_speed, speed)
    c.turn_speed = speed
    return speed


@kernel
def _clamp(vx, vy, vz, speed_xy, speed_z):
    """Return the velocity scaled to the horizontal and vertical speed limits; small parts are scaled separately."""
    norm = math.hypot(vx, vy)
    if norm > speed_xy and norm > 1e-7:
        scale = speed_xy / norm
        vx, vy = vx * scale, vy * scale
        if not (speed_xy < 0.5 and norm < 0.5):
            vz *= scale
    norm = abs(vz)
    if norm > speed_z and norm > 1e-7:
        scale = speed_z / norm
        vz *= scale
        if not (speed_z < 0.5 and norm < 0.5):
            vx, vy = vx * scale, vy * scale
    return vx, vy, vz


@kernel
def _wanted_velocity(c, p, radius, cruise, height_speed):
    """Return the velocity (tuple, m/s, local) from the smoothed position to the goal."""
    speed = _horizontal_speed(c, p, radius, cruise)
    if _turning(c, radius):
        px, py, pz = _lead_point(c, radius)
    else:
        px, py, pz = c.way_goal[0], c.way_goal[1], c.way_goal[2]
    dx, dy, dz = px - c.path.position[0], py - c.path.position[1], pz - c.path.position[2]
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    if norm < 1e-9:
        return 0.0, 0.0, 0.0
    total = math.sqrt(speed * speed + height_speed * height_speed) / norm
    return _clamp(dx * total, dy * total, dz * total, speed, height_speed)


@kernel
def _wanted_horizontal(c, p, radius, cruise):
    """Return the horizontal velocity (tuple, m/s, local) from the smoothed position to the goal."""
    speed = _horizontal_speed(c, p, radius, cruise)
    if _turning(c, radius):
        px, py, _ = _lead_point(c, radius)
    else:
        px, py = c.way_goal[0], c.way_goal[1]
    dx, dy = px - c.path.position[0], py - c.path.position[1]
    norm = math.hypot(dx, dy)
    if norm < 1e-9:
        return 0.0, 0.0
    return dx / norm * speed, dy / norm * speed


# AUTO modes


@kernel
def _vertical_limits(c, s, e, p):
    """Return the largest vertical speed (m/s) and acceleration (m/s^2) of the path; lower at takeoff."""
    if c.unsmoothed_climb >= 0.0:
        return _or_default(s.descend_speed, p.mpc_z_v_auto_dn), p.mpc_acc_down_max
    speed, accel = _or_default(s.climb_speed, p.mpc_z_v_auto_up), p.mpc_acc_up_max
    if c.goal_from_ground and c.ground_z - e.position[2] < p.mpc_land_alt1:
        speed = _or_default(s.climb_speed, p.mpc_tko_speed)
        accel = min(accel, p.mpc_tko_speed / max(p.mpc_tko_ramp_t, 1e-3))
        # keep the path at the vehicle's height, so that it does not start below the ground
        c.path.position[2] = e.position[2]
    return speed, accel


@kernel
def _update_braking(c, p):
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
def _smooth(c, s, e, p, wanted, dt):
    """Advance the smoothed path, replan it to the velocity ``wanted`` (tuple, m/s) and write it to the setpoint."""
    speed_z, accel_z = _vertical_limits(c, s, e, p)
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
def _smooth_yaw(c, wanted, p, dt):
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
def _goal_radius(s, p):
    return max(_or_default(s.goal_radius, p.nav_acc_rad), 0.05)


@kernel
def _keep_path_at_vehicle(c, e):
    """Keep the smoothed path at the vehicle until the takeoff ramp starts."""
    for i in range(3):
        _reset_smoothing(c.path, i, e.position[i], _WAIT_SPEED if i == 2 else 0.0, 0.0)


@kernel
def goto_task(c, s, e, p, dt):
    """Fly to goal_position on a smoothed path, without a stop if there is an onward_position."""
    radius = _goal_radius(s, p)
    cruise = min(_or_default(s.cruise_speed, p.mpc_xy_cruise), p.mpc_xy_vel_max)
    _update_internal_leg(c, s, e, radius)
    if c.takeoff.state < TAKEOFF_RAMPUP:
        _keep_path_at_vehicle(c, e)
    _update_braking(c, p)
    speed_z, accel_z = _vertical_limits(c, s, e, p)
    distance = abs(c.way_goal[2] - c.path.position[2])
    height_speed = min(speed_z, stopping_speed(distance, accel_z, p.mpc_jerk_auto, 0.0))
    wanted = _wanted_velocity(c, p, radius, cruise, height_speed)
    c.want_takeoff = 1 if wanted[2] < -_TAKEOFF_CLIMB else 0
    _smooth(c, s, e, p, wanted, dt)
    _smooth_yaw(c, s.goal_yaw, p, dt)


@kernel
def _landing_speed(height, p):
    """Return PX4's descent speed (m/s) at ``height`` m: the largest above ALT1, MPC_LAND_SPEED below ALT2."""
    upper = max(p.mpc_land_alt1, p.mpc_land_alt2)
    if height >= upper:
        return p.mpc_z_vel_max_dn
    if height <= p.mpc_land_alt2:
        return p.mpc_land_speed
    share = (height - p.mpc_land_alt2) / (upper - p.mpc_land_alt2)
    return p.mpc_land_speed + share * (p.mpc_z_vel_max_dn - p.mpc_land_speed)


@kernel
def land_task(c, s, e, p, dt):
    """Descend at the goal's xy; goal_position[2] is the assumed down coordinate of the ground."""
    radius = _goal_radius(s, p)
    cruise = min(_or_default(s.cruise_speed, p.mpc_xy_cruise), p.mpc_xy_vel_max)
    _update_internal_leg(c, s, e, radius)
    if c.takeoff.state < TAKEOFF_RAMPUP:
        _keep_path_at_vehicle(c, e)
    _update_braking(c, p)
    x, y = _wanted_horizontal(c, p, radius, cruise)
    _smooth(c, s, e, p, (x, y, _landing_speed(s.goal_position[2] - e.position[2], p)), dt)
    _smooth_yaw(c, s.goal_yaw, p, dt)


@kernel
def descend_task(c, p):
    """Descend with a level attitude, without a horizontal estimate."""
    c.task_acceleration[0] = 0.0
    c.task_acceleration[1] = 0.0
    c.task_velocity[2] = p.mpc_land_speed
    c.task_yaw_rate = 0.0


@kernel
def _orbit_heading(s, x, y):
    """Return the heading (rad; NaN: not controlled) at the unit vector (x, y) from the centre to the vehicle."""
    if s.orbit_yaw == ORBIT_UNCONTROLLED:
        return _NAN
    if s.orbit_yaw == ORBIT_INITIAL_HEADING:
        return s.orbit_heading
    if s.orbit_yaw == ORBIT_ALONG_CIRCLE:
        sign = 1.0 if s.orbit_speed > 0.0 else -1.0
        return math.atan2(sign * x, -sign * y)
    return math.atan2(-y, -x)


@kernel
def orbit_task(c, s, e, p, dt):
    """Fly along the circle, returning to it at 1 m/s per metre (PX4 FlightTaskOrbit::generate_circle_setpoints)."""
    x, y = e.position[0] - s.orbit_centre[0], e.position[1] - s.orbit_centre[1]
    distance = math.hypot(x, y)
    x, y = (x / distance, y / distance) if distance > 1e-6 else (1.0, 0.0)
    pull = s.orbit_radius - distance
    c.task_velocity[0] = -y * s.orbit_speed + x * pull
    c.task_velocity[1] = x * s.orbit_speed + y * pull
    inwards = s.orbit_speed * s.orbit_speed / s.orbit_radius
    c.task_acceleration[0] = -x * inwards
    c.task_acceleration[1] = -y * inwards
    c.task_position[2] = s.goal_position[2]
    heading = _orbit_heading(s, x, y)
    if not math.isnan(heading):
        _smooth_yaw(c, heading, p, dt)


# OFFBOARD


@kernel
def trajectory_task(c, s, e):
    """Pass on OFFBOARD's position, velocity, acceleration, yaw and yaw rate.

    As in PX4, a yaw rate without a yaw leaves ``task_yaw`` NaN: the vehicle turns and holds no heading.
    """
    for i in range(3):
        c.task_position[i] = s.position[i]
        c.task_velocity[i] = s.velocity[i]
        c.task_acceleration[i] = s.acceleration[i]
    c.task_yaw = s.yaw
    c.task_yaw_rate = s.yaw_rate
    z, vz, az = s.position[2], s.velocity[2], s.acceleration[2]
    c.want_takeoff = 1 if z < e.position[2] or vz < 0.0 or az < 0.0 else 0


# stick modes


@kernel
def _stick_yaw(c, s, e, p, dt):
    """Command a low-passed yaw rate by stick; hold the heading when the stick is centred."""
    wanted = s.stick_yaw * math.radians(p.mpc_man_y_max)
    c.path.yaw_rate += dt / (p.mpc_man_y_tau + dt) * (wanted - c.path.yaw_rate)
    if abs(c.path.yaw_rate) > _YAW_STILL:
        c.path.yaw = _NAN
    elif math.isnan(c.path.yaw):
        c.path.yaw = yaw_of(e.q)
    c.task_yaw = c.path.yaw
    c.task_yaw_rate = c.path.yaw_rate


@kernel
def _stick_height(c, s, e, p, dt):
    """Command a jerk-limited climb rate by stick; a centred stick brakes, then holds the height."""
    wanted = -s.stick_z * (p.mpc_z_vel_max_up if s.stick_z > 0.0 else p.mpc_z_vel_max_dn)
    height = c.ground_z - e.position[2]
    if wanted > 0.0:
        wanted = min(wanted, _landing_speed(height, p))
    elif height < max(p.mpc_land_alt1, p.mpc_land_alt2):
        upper, lower = max(p.mpc_land_alt1, p.mpc_land_alt2), p.mpc_land_alt2
        share = constrain((height - lower) / max(upper - lower, 1e-3), 0.0, 1.0)
        wanted = max(wanted, -(p.mpc_tko_speed + share * (p.mpc_z_vel_max_up - p.mpc_tko_speed)))
    if c.takeoff.state < TAKEOFF_RAMPUP:
        _reset_smoothing(c.path, 2, e.position[2], 0.0, 0.0)
    accel = p.mpc_acc_up_max if wanted < c.path.velocity[2] else p.mpc_acc_down_max
    follow(c.path, 2, p.mpc_jerk_max, dt)
    plan_axis(c.path, 2, wanted, accel, p.mpc_jerk_max)
    still = wanted == 0.0 and abs(c.path.velocity[2]) < 1e-3
    if not still:
        c.hold_z = 0
    elif not c.hold_z and abs(e.velocity[2]) < p.mpc_hold_max_z:
        c.hold_z = 1
        c.path.position[2] = e.position[2]
    c.task_velocity[2] = c.path.velocity[2]
    c.task_acceleration[2] = c.path.acceleration[2]
    if c.hold_z:
        c.task_position[2] = c.path.position[2]
    c.want_takeoff = 1 if s.stick_z > _TAKEOFF_STICK else 0


@kernel
def _heading_to_local(c, e, x, y):
    """Return (x, y) of the heading frame rotated into the local frame, as a tuple."""
    yaw = yaw_of(e.q) if math.isnan(c.path.yaw) else c.path.yaw
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * x - sin * y, sin * x + cos * y


@kernel
def _limit_to_unit(x, y):
    norm = max(math.hypot(x, y), 1.0)
    return x / norm, y / norm


@kernel
def altitude_task(c, s, e, p, dt):
    """Fly ALTCTL: sticks command a tilt up to MPC_MAN_TILT_MAX and a climb rate."""
    _stick_yaw(c, s, e, p, dt)
    x, y = _limit_to_unit(s.stick_x, s.stick_y)
    keep = dt / (p.mc_man_tilt_tau + dt)
    c.stick_acceleration[0] += keep * (x - c.stick_acceleration[0])
    c.stick_acceleration[1] += keep * (y - c.stick_acceleration[1])
    most = math.tan(math.radians(min(p.mpc_man_tilt_max, 89.0))) * GRAVITY
    x, y = _heading_to_local(c, e, c.stick_acceleration[0], c.stick_acceleration[1])
    c.task_acceleration[0] = x * most
    c.task_acceleration[1] = y * most
    _stick_height(c, s, e, p, dt)


@kernel
def _drag(c, p, centred, dt):
    """Return the deceleration (tuple, m/s^2) that limits the speed, and brakes when the sticks are centred."""
    boost = max(2.0, math.sqrt(p.mpc_vel_manual)) if centred else 1.0
    c.brake_boost += dt / (_BRAKE_TAU + dt) * (boost - c.brake_boost)
    speed = math.hypot(c.path.velocity[0], c.path.velocity[1])
    if speed < 1e-9:
        return 0.0, 0.0
    shaped = speed if speed > 1.0 else math.sqrt(speed)  # stronger below 1 m/s, to reach standstill
    gain = 2.0 * p.mpc_acc_hor / p.mpc_vel_manual * c.brake_boost * shaped / speed
    return gain * c.path.velocity[0], gain * c.path.velocity[1]


@kernel
def _stick_accelerations(c, s, e, p, dt):
    """Integrate accelerations by stick to a velocity; hold the position at zero velocity (MPC_POS_MODE 4)."""
    x, y = _limit_to_unit(s.stick_x, s.stick_y)
    x, y = _heading_to_local(c, e, x, y)
    step = p.mpc_jerk_max * dt
    most = 2.0 * p.mpc_acc_hor  # twice the mean acceleration, because of the drag
    c.stick_acceleration[0] += constrain(x * most - c.stick_acceleration[0], -step, step)
    c.stick_acceleration[1] += constrain(y * most - c.stick_acceleration[1], -step, step)
    ax, ay = c.stick_acceleration[0], c.stick_acceleration[1]
    dx, dy = _drag(c, p, x == 0.0 and y == 0.0, dt)
    vx, vy = c.path.velocity[0], c.path.velocity[1]
    if ax * ax + ay * ay < 1e-7 and vx * vx + vy * vy < (dx * dx + dy * dy) * dt * dt:
        dx = dy = vx = vy = 0.0
    ax, ay = ax - dx, ay - dy
    largest = math.tan(math.radians(p.mpc_tiltmax_air)) * GRAVITY
    norm = math.hypot(ax, ay)
    if norm > largest:
        ax, ay = ax * largest / norm, ay * largest / norm
    vx, vy = vx + ax * dt, vy + ay * dt
    moving = vx * vx + vy * vy > 1e-7
    if moving and c.hold_xy:
        c.hold_xy = 0
        vx, vy = c.sp_velocity[0], c.sp_velocity[1]  # continue the velocity of the position loop
    elif not moving and not c.hold_xy:
        c.hold_xy = 1
        c.path.position[0], c.path.position[1] = e.position[0], e.position[1]
    c.path.velocity[0], c.path.velocity[1] = vx, vy
    c.task_acceleration[0], c.task_acceleration[1] = ax, ay


@kernel
def _stick_velocities(c, s, e, p, dt):
    """Command jerk-limited velocities by stick (MPC_POS_MODE other than 4)."""
    x, y = _limit_to_unit(s.stick_x, s.stick_y)
    x, y = _heading_to_local(c, e, x, y)
    for i in range(2):
        follow(c.path, i, p.mpc_jerk_max, dt)
        c.task_acceleration[i] = c.path.acceleration[i]
    plan_axis(c.path, 0, x * p.mpc_vel_manual, p.mpc_acc_hor, p.mpc_jerk_max)
    plan_axis(c.path, 1, y * p.mpc_vel_manual, p.mpc_acc_hor, p.mpc_jerk_max)
    if x != 0.0 or y != 0.0:
        c.hold_xy = 0
    elif not c.hold_xy and math.hypot(e.velocity[0], e.velocity[1]) < p.mpc_hold_max_xy:
        c.hold_xy = 1
        c.path.position[0], c.path.position[1] = e.position[0], e.position[1]


@kernel
def sticks_task(c, s, e, p, dt):
    """Fly POSCTL: sticks command motion in the heading frame; centred sticks brake, then hold the position."""
    _stick_yaw(c, s, e, p, dt)
    if c.takeoff.state < TAKEOFF_RAMPUP:
        for i in range(2):
            _reset_smoothing(c.path, i, e.position[i], 0.0, 0.0)
            c.stick_acceleration[i] = 0.0
    if p.mpc_pos_mode >= 3.5:
        _stick_accelerations(c, s, e, p, dt)
    else:
        _stick_velocities(c, s, e, p, dt)
    for i in range(2):
        c.task_velocity[i] = c.path.velocity[i]
        if c.hold_xy:
            c.task_position[i] = c.path.position[i]
    _stick_height(c, s, e, p, dt)


@kernel
def _is_goal_task(task):
    return task in (TASK_GOTO, TASK_LAND)


@kernel
def _start_task(c, s, e):
    """Initialise a task of a new kind from the vehicle's state, or from the last setpoint of a smoothed task."""
    continues = _is_goal_task(c.last_task) or c.last_task in (TASK_STICKS, TASK_ALTITUDE, TASK_ORBIT)
    for i in range(3):
        x, v, a = c.task_position[i], c.task_velocity[i], c.task_acceleration[i]
        if not continues or math.isnan(x):
            x = e.position[i]
        if not continues or math.isnan(v):
            v = e.velocity[i]
        if not continues or math.isnan(a):
            a = 0.0
        _reset_smoothing(c.path, i, x, v, a)
    heading = c.task_yaw
    c.path.yaw = heading if continues and not math.isnan(heading) else yaw_of(e.q)
    c.path.yaw_rate = 0.0
    c.braking = 0
    c.hold_xy = 0
    c.hold_z = 0
    c.brake_boost = 1.0
    c.unsmoothed_climb = 0.0
    c.leg_state = -1
    start_following(c.followed)
    for i in range(2):
        c.stick_acceleration[i] = 0.0
    for i in range(3):
        c.leg_start[i] = e.position[i]
        c.leg_goal[i] = _NAN
        c.leg_onward[i] = _NAN


@kernel
def generate_setpoint(c, s, e, p, dt):
    """Update the trajectory setpoint in ``c`` by the present task, ``dt`` s after the last call."""
    if s.task_changed and c.last_task != s.task:
        if not (_is_goal_task(c.last_task) and _is_goal_task(s.task)):
            _start_task(c, s, e)
        c.last_task = s.task
    clear_task(c)
    c.want_takeoff = 0
    c.speed_down = p.mpc_z_vel_max_dn
    if s.task == TASK_TRAJECTORY:
        trajectory_task(c, s, e)
    elif s.task == TASK_GOTO:
        goto_task(c, s, e, p, dt)
    elif s.task == TASK_LAND:
        land_task(c, s, e, p, dt)
    elif s.task == TASK_ORBIT:
        orbit_task(c, s, e, p, dt)
    elif s.task == TASK_FOLLOW:
        follow_task(c, s, e, p, dt)
    elif s.task == TASK_DESCEND:
        descend_task(c, p)
    elif s.task == TASK_STICKS:
        sticks_task(c, s, e, p, dt)
    elif s.task == TASK_ALTITUDE:
        altitude_task(c, s, e, p, dt)
    s.task_changed = 0
