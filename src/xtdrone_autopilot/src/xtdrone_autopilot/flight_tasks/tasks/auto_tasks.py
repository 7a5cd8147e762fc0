"""Flight tasks of the AUTO modes: fly to a goal, land, descend without a position, orbit.

After PX4's FlightTaskAuto, FlightTaskDescend and FlightTaskOrbit. The flight to a goal that moves is planned in its
frame, in which it stands still: PX4 v1.14 flies to each new position of a landing target as to a goal at rest, and
therefore lags behind a moving one; its later vision_target_estimator also provides the target's velocity, as here.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.motion_planning.jerk_limited_velocity import stopping_speed
from xtdrone_autopilot.flight_tasks.motion_planning.lookahead_and_speed_on_legs import (
    update_internal_leg,
    wanted_horizontal,
    wanted_velocity,
)
from xtdrone_autopilot.flight_tasks.motion_planning.smoothing import (
    keep_path_at_vehicle,
    or_default,
    smooth,
    smooth_yaw,
    update_braking,
    vertical_limits,
)
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import ORBIT_ALONG_CIRCLE, ORBIT_INITIAL_HEADING, ORBIT_UNCONTROLLED, TAKEOFF_RAMPUP

_TAKEOFF_CLIMB = 0.3  # m/s, climb rate above which a takeoff starts


@kernel
def _goal_radius(s, p):
    return max(or_default(s.goal_radius, p.nav_acc_rad), 0.05)


@kernel
def goto_task(c, s, e, p, dt):
    """Fly to goal_position on a smoothed path, without a stop if there is an onward_position."""
    radius = _goal_radius(s, p)
    cruise = min(or_default(s.cruise_speed, p.mpc_xy_cruise), p.mpc_xy_vel_max)
    update_internal_leg(c, s, e, radius)
    if c.takeoff.state < TAKEOFF_RAMPUP:
        keep_path_at_vehicle(c, e)
    update_braking(c, p)
    speed_z, accel_z = vertical_limits(c, s, e, p)
    distance = abs(c.way_goal[2] - c.path.position[2])
    height_speed = min(speed_z, stopping_speed(distance, accel_z, p.mpc_jerk_auto, 0.0))
    wanted = wanted_velocity(c, p, radius, cruise, height_speed)
    c.want_takeoff = 1 if wanted[2] < -_TAKEOFF_CLIMB else 0
    smooth(c, s, e, p, wanted, dt)
    smooth_yaw(c, s.goal_yaw, p, dt)


@kernel
def landing_speed(height, p):
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
    cruise = min(or_default(s.cruise_speed, p.mpc_xy_cruise), p.mpc_xy_vel_max)
    update_internal_leg(c, s, e, radius)
    if c.takeoff.state < TAKEOFF_RAMPUP:
        keep_path_at_vehicle(c, e)
    update_braking(c, p)
    x, y = wanted_horizontal(c, p, radius, cruise)
    smooth(c, s, e, p, (x, y, landing_speed(s.goal_position[2] - e.position[2], p)), dt)
    smooth_yaw(c, s.goal_yaw, p, dt)


@kernel
def descend_task(c, p):
    """Descend with a level attitude, without a horizontal estimate."""
    c.task_acceleration[0] = 0.0
    c.task_acceleration[1] = 0.0
    c.task_velocity[2] = p.mpc_land_speed
    c.task_yaw_rate = 0.0


@kernel
def move_with_goal(c, s, dt):
    """Move goal, legs and smoothed path with the goal's motion; the path's velocity is then relative to the goal.

    A change of the goal's velocity leaves the velocity over ground unchanged.
    """
    for i in range(2):
        if s.goal_velocity[i] != c.goal_velocity[i]:
            c.path.velocity[i] -= s.goal_velocity[i] - c.goal_velocity[i]
            c.goal_velocity[i] = s.goal_velocity[i]
        if c.goal_velocity[i] != 0.0:
            moved = c.goal_velocity[i] * dt
            s.goal_position[i] += moved
            c.path.position[i] += moved
            c.leg_start[i] += moved
            c.leg_goal[i] += moved
            c.leg_onward[i] += moved
            c.way_start[i] += moved
            c.way_goal[i] += moved
            c.way_onward[i] += moved


@kernel
def add_goal_velocity(c):
    """Convert the velocity of the trajectory setpoint back to a velocity over ground."""
    for i in range(2):
        if c.goal_velocity[i] != 0.0:
            c.task_velocity[i] += c.goal_velocity[i]


_NAN = math.nan


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
        smooth_yaw(c, heading, p, dt)
