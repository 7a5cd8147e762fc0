"""The leg between two waypoints: lookahead point in turns and speed along it.

After PX4's FlightTaskAuto and PositionSmoothing.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.motion_planning.jerk_limited_velocity import stopping_speed, turning_speed
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import TAKEOFF_RAMPUP
from xtdrone_common.rotation_kernels import constrain

# CONTROL.leg_state: on the leg (or none), past the goal, before the start, beside the leg
_NO_LEG, _BEHIND, _AHEAD, _OFF = 0, 1, 2, 3
_LEAD = 5.0  # m, minimum lookahead distance in turns (L1 guidance)


@kernel
def _start_leg(c, s, e):
    """Start the leg to a new goal: from the previous goal if that led on to this one, else from the vehicle.

    The leg to a goal that stays, with another one after it, keeps its start.
    """
    onwards, same = True, True  # onwards: false for NaN, no onward waypoint
    for i in range(3):
        onwards = onwards and abs(c.leg_onward[i] - s.goal_position[i]) < 1e-3
        same = same and abs(c.leg_goal[i] - s.goal_position[i]) < 1e-3
    for i in range(3):
        if not same:
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
def update_internal_leg(c, s, e, radius):
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
    """Return the horizontal speed (m/s) at which to pass the goal towards way_onward; 0 to stop there.

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
def wanted_velocity(c, p, radius, cruise, height_speed):
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
def wanted_horizontal(c, p, radius, cruise):
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
