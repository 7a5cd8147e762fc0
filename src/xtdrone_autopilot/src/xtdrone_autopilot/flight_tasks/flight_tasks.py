"""Flight tasks: from the flight mode's goal (``SETPOINT``) to the trajectory setpoint of the position controller.

One function per task, after PX4 v1.14's flight tasks: OFFBOARD trajectories are passed on unchanged, goals are
approached on a jerk-limited path along the leg between two waypoints, landing follows PX4's speed profile, and sticks
command accelerations, velocities, tilts or climb rates. Each task writes task_position, task_velocity,
task_acceleration (NaN: not controlled), task_yaw, task_yaw_rate and want_takeoff of ``CONTROL``.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.collision_prevention import start_prevention
from xtdrone_autopilot.flight_tasks.motion_planning.smoothing import reset_smoothing
from xtdrone_autopilot.flight_tasks.tasks.auto_tasks import (
    add_goal_velocity,
    descend_task,
    goto_task,
    land_task,
    move_with_goal,
    orbit_task,
)
from xtdrone_autopilot.flight_tasks.tasks.follow_task import follow_task, start_following
from xtdrone_autopilot.flight_tasks.tasks.manual_tasks import altitude_task, sticks_task
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import (
    TASK_ALTITUDE,
    TASK_DESCEND,
    TASK_FOLLOW,
    TASK_GOTO,
    TASK_LAND,
    TASK_ORBIT,
    TASK_STICKS,
    TASK_TRAJECTORY,
)
from xtdrone_common.rotation_kernels import wrap_pi, yaw_of

_NAN = math.nan


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
        reset_smoothing(c.path, i, x, v, a)
    heading = c.task_yaw
    c.path.yaw = heading if continues and not math.isnan(heading) else yaw_of(e.q)
    c.path.yaw_rate = 0.0
    c.braking = 0
    c.hold_xy = 0
    c.hold_z = 0
    c.over_ground = 0
    c.brake_boost = 1.0
    c.unsmoothed_climb = 0.0
    c.leg_state = -1
    start_following(c.followed)
    if s.task == TASK_STICKS:
        start_prevention(c.obstacles, e.time_imu_us)
    for i in range(2):
        c.stick_acceleration[i] = 0.0
        c.goal_velocity[i] = 0.0
    for i in range(3):
        c.leg_start[i] = e.position[i]
        c.leg_goal[i] = _NAN
        c.leg_onward[i] = _NAN


@kernel
def generate_setpoint(c, s, e, p, dt):
    """Update the trajectory setpoint in ``c`` by the current task, ``dt`` s after the last call."""
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
        move_with_goal(c, s, dt)
        goto_task(c, s, e, p, dt)
        add_goal_velocity(c)
    elif s.task == TASK_LAND:
        move_with_goal(c, s, dt)
        land_task(c, s, e, p, dt)
        add_goal_velocity(c)
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


@kernel
def follow_resets(path, last_velocity, seen, resets, shifts):
    """Shift the smoothed path by the estimator's resets since the last call; restart the velocity's derivative.

    As in PX4's flight tasks a held position or smoothed path moves with the estimate, so that a reset causes no motion.
    Goals and OFFBOARD setpoints are not shifted; the vehicle flies to them on its smoothed path.

    Args:
        path: ``PATH`` record.
        last_velocity: m/s, local, shape (3,), set to NaN by a reset of the velocity.
        seen: ``RESETS`` record of the resets already applied.
        resets: ``RESETS`` record of the estimator.
        shifts: its ``SHIFTS`` record.
    """
    if seen.any == resets.any:
        return
    seen.any = resets.any
    if seen.xy != resets.xy:
        seen.xy = resets.xy
        for i in range(2):
            path.position[i] += shifts.xy[i]
    if seen.vxy != resets.vxy:
        seen.vxy = resets.vxy
        for i in range(2):
            path.velocity[i] += shifts.vxy[i]
            last_velocity[i] = math.nan
    if seen.z != resets.z:
        seen.z = resets.z
        path.position[2] += shifts.z
    if seen.vz != resets.vz:
        seen.vz = resets.vz
        path.velocity[2] += shifts.vz
        last_velocity[2] = math.nan
    if seen.heading != resets.heading:
        seen.heading = resets.heading
        path.yaw = wrap_pi(path.yaw + shifts.heading)
