"""Position and velocity control, and takeoff: setpoints in the local frame to a thrust vector and an attitude.

The cascade of PX4 v1.14's mc_pos_control/PositionControl: P on position to a velocity, PID on velocity to an
acceleration, acceleration to a thrust vector within tilt and thrust limits, thrust vector and yaw to an attitude. A
takeoff (mc_pos_control/Takeoff) is a spool-up, a ramp of the upward speed limit, and flight.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.sensors import first_order_gain
from xtdrone_autopilot.state import TAKEOFF_DISARMED, TAKEOFF_FLIGHT, TAKEOFF_RAMPUP, TAKEOFF_READY, TAKEOFF_SPOOLUP
from xtdrone_common.geodesy.projection import GRAVITY
from xtdrone_common.rotation_kernels import constrain, from_axes, yaw_of

_NO_THRUST = 100.0  # m/s^2 downwards, which leaves no thrust
_TILT_SLEW = 0.2  # rad/s, slew rate of the tilt limit


@kernel
def update_takeoff(takeoff, c, armed, p, wants_takeoff, skip):
    """Update takeoff.state.

    Args:
        takeoff: ``TAKEOFF`` record.
        c: ``CONTROL`` record, read only.
        armed: whether the vehicle is armed.
        p: ``PARAMS`` record.
        wants_takeoff: whether the setpoint leads off the ground.
        skip: whether to skip the ramp, as the pilot sets the thrust directly.
    """
    if not armed:
        takeoff.state = TAKEOFF_DISARMED
        return
    if skip:
        takeoff.state = TAKEOFF_FLIGHT
        return
    if takeoff.state == TAKEOFF_DISARMED:
        takeoff.state = TAKEOFF_SPOOLUP if c.landing.landed else TAKEOFF_FLIGHT
    if takeoff.state == TAKEOFF_SPOOLUP and c.armed_time >= p.com_spoolup_time:
        takeoff.state = TAKEOFF_READY
    if takeoff.state == TAKEOFF_READY and wants_takeoff:
        takeoff.state = TAKEOFF_RAMPUP
        takeoff.ramp_progress = 0.0
    if takeoff.state == TAKEOFF_RAMPUP and takeoff.ramp_progress >= 1.0:
        takeoff.state = TAKEOFF_FLIGHT
    if takeoff.state == TAKEOFF_FLIGHT and c.landing.landed:
        takeoff.state = TAKEOFF_READY


@kernel
def update_ramp(takeoff, p, speed_up, dt):
    """Update takeoff.ramp_speed, the upward speed limit (m/s), which rises to ``speed_up`` within MPC_TKO_RAMP_T."""
    # start at the downward speed whose error cancels the hover thrust, so that thrust rises from zero
    start = -GRAVITY / max(p.mpc_z_vel_p_acc, 0.01)
    takeoff.ramp_speed = speed_up
    if takeoff.state < TAKEOFF_RAMPUP:
        takeoff.ramp_speed = start
    elif takeoff.state == TAKEOFF_RAMPUP:
        takeoff.ramp_progress = takeoff.ramp_progress + dt / p.mpc_tko_ramp_t if p.mpc_tko_ramp_t > dt else 1.0
        if takeoff.ramp_progress < 1.0:
            takeoff.ramp_speed = start + takeoff.ramp_progress * (speed_up - start)


@kernel
def _limit_horizontal(first_x, first_y, second_x, second_y, limit):
    """Return first + second limited to the norm ``limit``, with priority to first (PX4 ControlMath::constrainXY)."""
    sx, sy = first_x + second_x, first_y + second_y
    if sx * sx + sy * sy <= limit * limit:
        return sx, sy
    n1 = math.hypot(first_x, first_y)
    if n1 >= limit:
        return first_x / n1 * limit, first_y / n1 * limit
    n2 = math.hypot(second_x, second_y)
    if n2 < 1e-9:
        return first_x, first_y
    ux, uy = second_x / n2, second_y / n2
    along = ux * first_x + uy * first_y
    share = -along + math.sqrt(along * along - n1 * n1 + limit * limit)
    return first_x + ux * share, first_y + uy * share


@kernel
def differentiate_velocity(c, e, p, dt):
    """Update c.velocity_dot, low-passed by MPC_VELD_LP, ``dt`` s after the last call (PX4 BlockDerivative)."""
    gain = first_order_gain(p.mpc_veld_lp, dt)
    for i in range(3):
        slope = 0.0 if math.isnan(c.last_velocity[i]) else (e.velocity[i] - c.last_velocity[i]) / dt
        c.velocity_dot[i] += gain * (slope - c.velocity_dot[i])
        c.last_velocity[i] = e.velocity[i]


@kernel
def start_loops(c):
    """Copy the task's setpoint to c.sp_*, which the loops complete in place."""
    for i in range(3):
        c.sp_position[i] = c.task_position[i]
        c.sp_velocity[i] = c.task_velocity[i]
        c.sp_acceleration[i] = c.task_acceleration[i]
    c.sp_yaw = c.task_yaw
    c.sp_yaw_rate = c.task_yaw_rate


@kernel
def position_loop(c, e, p, speed_up, speed_down):
    """Update c.sp_velocity from c.sp_position (P) and the feed-forward in c.sp_velocity.

    NaN means "not controlled"; a velocity stays NaN if its position is NaN too. Horizontally the position error has
    priority over the feed-forward.
    """
    fx = (c.sp_position[0] - e.position[0]) * p.mpc_xy_p
    fy = (c.sp_position[1] - e.position[1]) * p.mpc_xy_p
    fz = (c.sp_position[2] - e.position[2]) * p.mpc_z_p
    vx, vy, vz = c.sp_velocity[0], c.sp_velocity[1], c.sp_velocity[2]
    x_controlled = not (math.isnan(fx) and math.isnan(vx))
    y_controlled = not (math.isnan(fy) and math.isnan(vy))
    fx, fy = 0.0 if math.isnan(fx) else fx, 0.0 if math.isnan(fy) else fy
    vx, vy = 0.0 if math.isnan(vx) else vx, 0.0 if math.isnan(vy) else vy
    vx, vy = _limit_horizontal(fx, fy, vx, vy, p.mpc_xy_vel_max)
    if x_controlled:
        c.sp_velocity[0] = vx
    if y_controlled:
        c.sp_velocity[1] = vy
    if not math.isnan(fz):
        vz = fz if math.isnan(vz) else fz + vz
    if not math.isnan(vz):
        # at the start of a takeoff the upper limit is below the lower one and has priority
        c.sp_velocity[2] = -speed_up if vz < -speed_up else min(vz, max(speed_down, -speed_up))


@kernel
def velocity_loop(c, e, p, dt, tilt_max, thrust_min):
    """Update c.sp_acceleration and c.sp_thrust_vector from c.sp_velocity (PID) and the acceleration feed-forward.

    Args:
        c, e, p: records.
        dt: time since the last call, s.
        tilt_max: largest tilt, rad.
        thrust_min: minimum collective thrust, 0..1.
    """
    integral = c.velocity_integral
    thrust_min, thrust_max = max(thrust_min, 1e-3), p.mpc_thr_max  # a zero vector would leave the attitude undefined
    error_x = _track_velocity(c, e, 0, p.mpc_xy_vel_p_acc, p.mpc_xy_vel_d_acc)
    error_y = _track_velocity(c, e, 1, p.mpc_xy_vel_p_acc, p.mpc_xy_vel_d_acc)
    error_z = _track_velocity(c, e, 2, p.mpc_z_vel_p_acc, p.mpc_z_vel_d_acc)
    _acceleration_to_thrust(c, tilt_max, thrust_min)
    thrust = c.sp_thrust_vector

    # vertical anti-windup: stop integrating upwards at full thrust and downwards at least thrust
    if (thrust[2] >= -thrust_min and error_z >= 0.0) or (thrust[2] <= -thrust_max and error_z <= 0.0):
        error_z = 0.0

    # vertical thrust has priority, except for a margin kept for the horizontal axes
    horizontal = math.hypot(thrust[0], thrust[1])
    allocated = min(horizontal, p.mpc_thr_xy_marg)
    vertical_limit = math.sqrt(max(thrust_max * thrust_max - allocated * allocated, 0.0))
    thrust[2] = max(thrust[2], -vertical_limit)
    horizontal_limit = math.sqrt(max(thrust_max * thrust_max - thrust[2] * thrust[2], 0.0))
    if horizontal > horizontal_limit:
        thrust[0] *= horizontal_limit / horizontal
        thrust[1] *= horizontal_limit / horizontal

    # horizontal tracking anti-windup: feed back the acceleration that was not produced
    # (L. Rundqwist, "Anti-reset windup for PID controllers", IFAC 1990)
    produced_x = thrust[0] * GRAVITY / c.hover_thrust
    produced_y = thrust[1] * GRAVITY / c.hover_thrust
    wanted = math.hypot(c.sp_acceleration[0], c.sp_acceleration[1])
    produced = math.hypot(produced_x, produced_y)
    if wanted > produced:
        gain = 2.0 / p.mpc_xy_vel_p_acc
        error_x -= gain * (c.sp_acceleration[0] - produced_x)
        error_y -= gain * (c.sp_acceleration[1] - produced_y)

    integral[0] += error_x * p.mpc_xy_vel_i_acc * dt
    integral[1] += error_y * p.mpc_xy_vel_i_acc * dt
    integral[2] = constrain(integral[2] + error_z * p.mpc_z_vel_i_acc * dt, -GRAVITY, GRAVITY)


@kernel
def _track_velocity(c, e, i, gain_p, gain_d):
    """Add the feedback of axis ``i`` to c.sp_acceleration; return its velocity error, 0 where it is not controlled."""
    error = c.sp_velocity[i] - e.velocity[i]
    acceleration = error * gain_p + c.velocity_integral[i] - c.velocity_dot[i] * gain_d
    c.sp_acceleration[i] = _add_ignoring_nan(c.sp_acceleration[i], acceleration)
    return 0.0 if math.isnan(error) else error


@kernel
def _add_ignoring_nan(value, addition):
    if math.isnan(addition):
        return 0.0 if math.isnan(value) else value
    return addition if math.isnan(value) else value + addition


@kernel
def _acceleration_to_thrust(c, tilt_max, thrust_min):
    """Convert c.sp_acceleration to c.sp_thrust_vector (normalised, local) by hover thrust, within the tilt limit."""
    ax, ay, az = c.sp_acceleration[0], c.sp_acceleration[1], c.sp_acceleration[2]
    # thrust is along body -z; in a level hover it balances gravity
    bx, by, bz = -ax, -ay, GRAVITY
    norm = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / norm, by / norm, bz / norm
    tilt = math.acos(constrain(bz, -1.0, 1.0))
    if tilt > tilt_max:
        horizontal = math.hypot(bx, by)
        bx *= math.sin(tilt_max) / horizontal
        by *= math.sin(tilt_max) / horizontal
        bz = math.cos(tilt_max)
    vertical = az * (c.hover_thrust / GRAVITY) - c.hover_thrust
    collective = min(vertical / bz, -thrust_min)
    c.sp_thrust_vector[0] = bx * collective
    c.sp_thrust_vector[1] = by * collective
    c.sp_thrust_vector[2] = bz * collective


@kernel
def thrust_to_attitude(c, e):
    """Update c.sp_q and c.sp_thrust from c.sp_thrust_vector and c.sp_yaw (PX4 ControlMath::thrustToAttitude)."""
    tx, ty, tz = c.sp_thrust_vector[0], c.sp_thrust_vector[1], c.sp_thrust_vector[2]
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    c.sp_thrust = norm
    z = (0.0, 0.0, 1.0) if norm < 1e-6 else (-tx / norm, -ty / norm, -tz / norm)
    yaw = yaw_of(e.q) if math.isnan(c.sp_yaw) else c.sp_yaw
    # body x: perpendicular to z, in the vertical plane of the heading
    yx, yy = -math.sin(yaw), math.cos(yaw)
    xx, xy, xz = yy * z[2], -yx * z[2], yx * z[1] - yy * z[0]
    if z[2] < 0.0:  # upside down: keep the nose on the heading
        xx, xy, xz = -xx, -xy, -xz
    n = math.sqrt(xx * xx + xy * xy + xz * xz)
    x = (xx / n, xy / n, xz / n)
    y = (z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0])
    q = from_axes(x, y, z)
    for i in range(4):
        c.sp_q[i] = q[i]


@kernel
def use_hover_thrust(c, estimate):
    """Use ``estimate`` (0..1) as hover thrust without a step in the thrust.

    As in PX4's PositionControl::updateHoverThrust, the velocity integral absorbs the difference.
    """
    before = c.hover_thrust
    if estimate == before or math.isnan(c.sp_acceleration[2]):
        return
    c.hover_thrust = estimate
    c.velocity_integral[2] += (c.sp_acceleration[2] - GRAVITY) * before / estimate + GRAVITY - c.sp_acceleration[2]


@kernel
def _suppress_thrust(c):
    """Replace the setpoint by a large downward acceleration, which gives no thrust; reset the velocity integrator."""
    for i in range(3):
        c.sp_position[i] = math.nan
        c.sp_velocity[i] = math.nan
        c.velocity_integral[i] = 0.0
    c.sp_acceleration[0], c.sp_acceleration[1], c.sp_acceleration[2] = 0.0, 0.0, _NO_THRUST
    c.sp_yaw = math.nan
    c.sp_yaw_rate = math.nan


@kernel
def control_position(c, e, p, dt):
    """Run the position and velocity loops: from the task's setpoint to an attitude and a thrust setpoint.

    The tilt is limited by MPC_TILTMAX_AIR in flight and by MPC_TILTMAX_LND before.
    """
    flying = c.takeoff.state == TAKEOFF_FLIGHT
    if not flying:
        c.hover_thrust = p.mpc_thr_hover
    elif p.mpc_use_hte > 0.5 and c.hover.valid:
        use_hover_thrust(c, c.hover.estimate)
    start_loops(c)
    if not flying:
        c.sp_acceleration[2] = math.nan  # the takeoff ramp alone lifts the vehicle
    if c.takeoff.state < TAKEOFF_RAMPUP or (flying and c.landing.ground_contact):
        _suppress_thrust(c)
    tilt = math.radians(p.mpc_tiltmax_air if flying else p.mpc_tiltmax_lnd)
    step = _TILT_SLEW * dt
    c.tilt_limit += min(max(tilt - c.tilt_limit, -step), step)
    update_ramp(c.takeoff, p, p.mpc_z_vel_max_up, dt)
    position_loop(c, e, p, min(c.takeoff.ramp_speed, p.mpc_z_vel_max_up), c.speed_down)
    velocity_loop(c, e, p, dt, c.tilt_limit, p.mpc_thr_min if flying else 0.0)
    thrust_to_attitude(c, e)
