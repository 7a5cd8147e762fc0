"""Flight tasks of the AUTO modes: fly to a goal, land, descend without a position.

After PX4's FlightTaskAuto and FlightTaskDescend.
"""

from __future__ import annotations

from xtdrone_control.autopilot.flight_tasks.motion_planning.jerk_limited_velocity import stopping_speed
from xtdrone_control.autopilot.flight_tasks.motion_planning.lookahead_and_speed_on_legs import (
    update_internal_leg,
    wanted_horizontal,
    wanted_velocity,
)
from xtdrone_control.autopilot.flight_tasks.motion_planning.smoothing import (
    keep_path_at_vehicle,
    or_default,
    smooth,
    smooth_yaw,
    update_braking,
    vertical_limits,
)
from xtdrone_control.autopilot.state import TAKEOFF_RAMPUP
from xtdrone_control.kernel import kernel

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
