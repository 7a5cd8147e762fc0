"""Flight tasks of ALTCTL and POSCTL: tilts, climb rates, velocities and accelerations by stick.

After PX4's FlightTaskManualAltitude, FlightTaskManualPosition and FlightTaskManualAcceleration.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.collision_prevention import prevent_collision
from xtdrone_autopilot.flight_tasks.motion_planning.jerk_limited_velocity import follow, plan_axis
from xtdrone_autopilot.flight_tasks.motion_planning.smoothing import reset_smoothing
from xtdrone_autopilot.flight_tasks.tasks.auto_tasks import landing_speed
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import TAKEOFF_RAMPUP
from xtdrone_common.geodesy.projection import GRAVITY
from xtdrone_common.rotation_kernels import constrain, yaw_of

_NAN = math.nan
_TAKEOFF_STICK = 0.3  # throttle stick above which a takeoff starts
_BRAKE_TAU = 0.8  # s, time constant of the braking factor with centred sticks
_LEAST_SPEED = 1e-3  # m/s, so that MPC_VEL_MANUAL may be 0
_YAW_STILL = 0.001  # rad/s, below which the heading is held


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
def _unsmoothed(p):
    """Return whether sticks command velocities without smoothing (MPC_POS_MODE 0), also the climb rate."""
    return p.mpc_pos_mode < 0.5


@kernel
def _slow(speed, largest):
    """Return whether a centred stick holds the place at ``speed``; a ``largest`` of 0 holds it at any."""
    return largest <= 0.0 or speed < largest


@kernel
def _stick_height(c, s, e, p, dt):
    """Command a climb rate by stick, jerk-limited; a centred stick brakes, then holds the height."""
    wanted = -s.stick_z * (p.mpc_z_vel_max_up if s.stick_z > 0.0 else p.mpc_z_vel_max_dn)
    height = c.ground_z - e.position[2]
    if wanted > 0.0:
        wanted = min(wanted, landing_speed(height, p))
    elif height < max(p.mpc_land_alt1, p.mpc_land_alt2):
        upper, lower = max(p.mpc_land_alt1, p.mpc_land_alt2), p.mpc_land_alt2
        share = constrain((height - lower) / max(upper - lower, 1e-3), 0.0, 1.0)
        wanted = max(wanted, -(p.mpc_tko_speed + share * (p.mpc_z_vel_max_up - p.mpc_tko_speed)))
    if c.takeoff.state < TAKEOFF_RAMPUP:
        reset_smoothing(c.path, 2, e.position[2], 0.0, 0.0)
    if _unsmoothed(p):
        reset_smoothing(c.path, 2, c.path.position[2], wanted, 0.0)
    else:
        accel = p.mpc_acc_up_max if wanted < c.path.velocity[2] else p.mpc_acc_down_max
        follow(c.path, 2, p.mpc_jerk_max, dt)
        plan_axis(c.path, 2, wanted, accel, p.mpc_jerk_max)
    still = wanted == 0.0 and abs(c.path.velocity[2]) < 1e-3
    if not still:
        c.hold_z = 0
    elif not c.hold_z and _slow(abs(e.velocity[2]), p.mpc_hold_max_z):
        c.hold_z = 1
        c.path.position[2] = e.position[2]
    _hold_over_ground(c, s, e, p)
    c.task_velocity[2] = c.path.velocity[2]
    c.task_acceleration[2] = _NAN if _unsmoothed(p) else c.path.acceleration[2]
    if c.hold_z:
        c.task_position[2] = c.path.position[2]
    c.want_takeoff = 1 if s.stick_z > _TAKEOFF_STICK else 0


@kernel
def _hold_over_ground(c, s, e, p):
    """Change the held height by MPC_ALT_MODE to follow the ground below."""
    follows = c.hold_z and e.terrain_valid and _wants_ground(c, s, e, p)
    if not follows:
        c.over_ground = 0
        return
    if not c.over_ground:
        c.over_ground = 1
        c.held_height = e.terrain - c.path.position[2]
    c.path.position[2] = e.terrain - c.held_height


@kernel
def _wants_ground(c, s, e, p):
    """Return whether MPC_ALT_MODE asks for the height above ground: 1 always, 2 while the vehicle stands."""
    mode = int(p.mpc_alt_mode)
    limit = p.mpc_hold_max_xy if c.over_ground else 0.5 * p.mpc_hold_max_xy
    stands = s.stick_x == 0.0 and s.stick_y == 0.0 and math.hypot(e.velocity[0], e.velocity[1]) <= limit
    return mode == 1 or (mode == 2 and stands)


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
def _speed_at_full_stick(p):
    return max(p.mpc_vel_manual, _LEAST_SPEED)


@kernel
def _stick_direction(s, p):
    """Return the horizontal sticks (tuple, at most 1 long), shortened by the speeds backwards and sideways."""
    x, y = _limit_to_unit(s.stick_x, s.stick_y)
    forward = _speed_at_full_stick(p)
    if p.mpc_vel_man_side >= 0.0:
        y *= p.mpc_vel_man_side / forward
    if x < 0.0 and p.mpc_vel_man_back >= 0.0:
        x *= p.mpc_vel_man_back / forward
    return x, y


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
    gain = 2.0 * p.mpc_acc_hor / _speed_at_full_stick(p) * c.brake_boost * shaped / speed
    return gain * c.path.velocity[0], gain * c.path.velocity[1]


@kernel
def _stick_accelerations(c, s, e, p, dt):
    """Integrate accelerations by stick to a velocity; hold the position at zero velocity (MPC_POS_MODE 4)."""
    x, y = _stick_direction(s, p)
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
def _collision_prevented(p):
    return p.cp_dist > 0.0


@kernel
def _stick_velocities(c, s, e, p, dt):
    """Command velocities by stick, jerk-limited with MPC_POS_MODE 3, at once with 0."""
    x, y = _stick_direction(s, p)
    x, y = _heading_to_local(c, e, x * p.mpc_vel_manual, y * p.mpc_vel_manual)
    if _collision_prevented(p):
        x, y = prevent_collision(c.obstacles, e, p, x, y)
    for i in range(2):
        wanted = x if i == 0 else y
        if _unsmoothed(p):
            reset_smoothing(c.path, i, c.path.position[i], wanted, 0.0)
            continue
        follow(c.path, i, p.mpc_jerk_max, dt)
        c.task_acceleration[i] = c.path.acceleration[i]
        plan_axis(c.path, i, wanted, p.mpc_acc_hor_max, p.mpc_jerk_max)
    if x != 0.0 or y != 0.0:
        c.hold_xy = 0
    elif not c.hold_xy and _slow(math.hypot(e.velocity[0], e.velocity[1]), p.mpc_hold_max_xy):
        c.hold_xy = 1
        c.path.position[0], c.path.position[1] = e.position[0], e.position[1]


@kernel
def sticks_task(c, s, e, p, dt):
    """Fly POSCTL: sticks command motion in the heading frame; centred sticks brake, then hold the position."""
    _stick_yaw(c, s, e, p, dt)
    if c.takeoff.state < TAKEOFF_RAMPUP:
        for i in range(2):
            reset_smoothing(c.path, i, e.position[i], 0.0, 0.0)
            c.stick_acceleration[i] = 0.0
    # PX4 v1.14 prevents no collision with MPC_POS_MODE 4; here the sticks command velocities then, as with 3
    if p.mpc_pos_mode >= 3.5 and not _collision_prevented(p):
        _stick_accelerations(c, s, e, p, dt)
    else:
        _stick_velocities(c, s, e, p, dt)
    for i in range(2):
        c.task_velocity[i] = c.path.velocity[i]
        if c.hold_xy:
            c.task_position[i] = c.path.position[i]
    _stick_height(c, s, e, p, dt)
