"""Flight task that follows a target (PX4 v1.14's FlightTaskAutoFollowTarget).

``SETPOINT.target_*`` is the estimate of the target's motion, see ``follow_target``. A second-order filter smooths it.
The vehicle flies at the distance FLW_TGT_DST from the filtered target and at the angle FLW_TGT_FA clockwise from its
course, and moves around the target to that angle on a jerk-limited path at up to FLW_TGT_MAX_VEL.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.flight_tasks.motion_planning.jerk_limited_velocity import follow, plan_axis, stopping_speed
from xtdrone_autopilot.kernel import kernel
from xtdrone_common.rotation_kernels import wrap_pi

_NAN = math.nan
_FREQUENCY, _DAMPING = 1.0, 0.7071  # rad/s and damping ratio of the filter of the target's motion
_COURSE_SPEED = 1.0  # m/s, minimum velocity that defines a course
_MAX_JERK, _MAX_ACCELERATION = 4.0, 2.0  # m/s^3 and m/s^2, along the circle around the target
_LEAST_DISTANCE = 1.0  # m, minimum of FLW_TGT_DST; parameters may be out of range
_HEIGHT_WINDOW = 3.0  # m, largest height error at which the vehicle moves horizontally
_LEAST_HEIGHT = 1.0  # m above ground, below which the vehicle only climbs
_ASCENT = 0.5  # m/s, climb rate near the ground
_FACING_DISTANCE = 1.0  # m, minimum distance from the target at which the vehicle faces it
_TAKEOFF_RISE, _TAKEOFF_CLIMB = 0.2, 0.3  # m and m/s, climb above which a takeoff starts
OVER_GROUND, OVER_TARGET = 1, 2  # FLW_TGT_ALT_M


@kernel
def start_following(followed):
    """Reset the filtered target and the angle; the target's course is north until it moves."""
    for i in range(3):
        followed.position[i] = _NAN
        followed.velocity[i] = 0.0
    followed.course = 0.0
    followed.angle.position[0] = 0.0
    followed.angle.velocity[0] = 0.0
    followed.angle.acceleration[0] = 0.0


@kernel
def _filter_target(followed, s, armed_time, dt):
    """Advance the filtered target by ``dt`` s; initialise it with the first estimate.

    The error is evaluated at the end of the step, so that a target of constant velocity is followed without lag.
    """
    age = armed_time - s.target_time
    for i in range(3):
        position = s.target_position[i] + (s.target_velocity[i] + 0.5 * s.target_acceleration[i] * age) * age
        velocity = s.target_velocity[i] + s.target_acceleration[i] * age
        if math.isnan(followed.position[i]):
            followed.position[i] = position
            followed.velocity[i] = velocity
            continue
        followed.position[i] += followed.velocity[i] * dt
        error, slip = position - followed.position[i], velocity - followed.velocity[i]
        followed.velocity[i] += (_FREQUENCY * error + 2.0 * _DAMPING * slip) * _FREQUENCY * dt
    _update_course(followed, s)


@kernel
def _update_course(followed, s):
    """Update the course from the filtered velocity, unless the target is slow, as the filter overshoots at a stop."""
    north, east = followed.velocity[0], followed.velocity[1]
    moves = math.hypot(s.target_velocity[0], s.target_velocity[1]) >= _COURSE_SPEED
    if moves and math.hypot(north, east) >= _COURSE_SPEED:
        followed.course = math.atan2(east, north)


@kernel
def _update_angle(followed, p, distance, dt):
    """Advance the angle around the target by ``dt`` s towards FLW_TGT_FA, in the shorter direction."""
    left = wrap_pi(followed.course + math.radians(p.flw_tgt_fa) - followed.angle.position[0])
    accel, jerk = _MAX_ACCELERATION / distance, _MAX_JERK / distance
    rate = min(stopping_speed(abs(left), accel, jerk, 0.0), max(p.flw_tgt_max_vel, 0.0) / distance)
    plan_axis(followed.angle, 0, math.copysign(rate, left), accel, jerk)
    follow(followed.angle, 0, jerk, dt)


@kernel
def _ground(s, e):
    """Return the down coordinate (m, local) of the ground if measured, else of home."""
    return e.terrain if e.terrain_valid else s.home_z


@kernel
def _wanted_height(c, s, e, p):
    """Return the commanded down coordinate (m, local) by FLW_TGT_ALT_M."""
    mode = int(p.flw_tgt_alt_m)
    if mode == OVER_GROUND:
        return _ground(s, e) - p.flw_tgt_ht
    if mode == OVER_TARGET:
        return c.followed.position[2] - p.flw_tgt_ht
    return s.home_z - p.flw_tgt_ht


@kernel
def _fly_beside_target(c, e, distance):
    """Write the horizontal setpoint: a point that moves on the circle around the target."""
    x, y = math.cos(c.followed.angle.position[0]), math.sin(c.followed.angle.position[0])
    along, faster = c.followed.angle.velocity[0] * distance, c.followed.angle.acceleration[0] * distance
    inwards = along * along / distance
    c.task_position[0] = c.followed.position[0] + x * distance
    c.task_position[1] = c.followed.position[1] + y * distance
    c.task_velocity[0] = c.followed.velocity[0] - y * along
    c.task_velocity[1] = c.followed.velocity[1] + x * along
    c.task_acceleration[0] = -x * inwards - y * faster
    c.task_acceleration[1] = -y * inwards + x * faster


@kernel
def _face_target(c, e):
    """Point the heading at the target, unless the vehicle is almost above it."""
    north, east = c.followed.position[0] - e.position[0], c.followed.position[1] - e.position[1]
    if math.hypot(north, east) > _FACING_DISTANCE:
        c.path.yaw = math.atan2(east, north)


@kernel
def _climb_first(c, e):
    """Climb slowly without horizontal motion, as the ground is near."""
    for i in range(2):
        c.task_position[i] = _NAN
        c.task_velocity[i] = 0.0
        c.task_acceleration[i] = _NAN
    c.task_position[2] = e.position[2]
    c.task_velocity[2] = -_ASCENT


@kernel
def follow_task(c, s, e, p, dt):
    """Keep distance, height and angle to the target and face it; stop without a target.

    Far from the commanded height the vehicle stops horizontally and first climbs or descends. PX4 instead leaves the
    last velocity in the setpoint.
    """
    if math.isnan(s.target_position[0]):
        for i in range(3):
            c.task_velocity[i] = 0.0
        c.task_yaw = c.path.yaw
        return
    distance = max(p.flw_tgt_dst, _LEAST_DISTANCE)
    _filter_target(c.followed, s, c.armed_time, dt)
    _update_angle(c.followed, p, distance, dt)
    _face_target(c, e)
    c.task_yaw = c.path.yaw
    c.task_position[2] = _wanted_height(c, s, e, p)
    if _ground(s, e) - e.position[2] < _LEAST_HEIGHT:
        _climb_first(c, e)
    elif abs(c.task_position[2] - e.position[2]) < _HEIGHT_WINDOW:
        _fly_beside_target(c, e, distance)
    else:
        c.task_position[0], c.task_position[1] = e.position[0], e.position[1]
    rises = c.task_position[2] < e.position[2] - _TAKEOFF_RISE or c.task_velocity[2] < -_TAKEOFF_CLIMB
    c.want_takeoff = 1 if rises else 0
