"""Jerk-limited smoothing of a velocity setpoint, and the largest speeds before a stop or a turn.

The profile of PX4's motion_planning library: in each axis the acceleration rises, stays constant and falls, so that the
wanted velocity is reached in the minimum time within the limits of acceleration and jerk. Faster axes are stretched to
the duration of the slowest. A record ``PATH`` holds the state (position, velocity, acceleration) and the
plan that is followed until the next call of ``plan`` (times, direction).
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel
from xtdrone_common.rotation_kernels import constrain

_EPSILON = 1.1920929e-07  # PX4's FLT_EPSILON


@kernel
def stopping_speed(distance, accel, jerk, final):
    """Return the largest speed, m/s, from which the vehicle can slow down to ``final`` m/s within ``distance`` m.

    From v^2 + (4 a^2 / j) v = 2 a d + v_final^2: braking at ``accel`` m/s^2, with the rise of the deceleration at
    ``jerk`` m/s^3 counted twice as a margin.
    """
    b = 4.0 * accel * accel / jerk
    c = 2.0 * accel * distance + final * final
    return max(0.5 * (-b + math.sqrt(b * b + 4.0 * c)), final)


@kernel
def turning_speed(angle, accel, radius):
    """Return the speed, m/s, on the circle tangent to both legs ``radius`` m from the corner, at ``accel`` m/s^2.

    ``angle`` (rad) is the angle between the legs, pi for straight on.
    """
    return math.sqrt(accel * radius * math.tan(0.5 * min(angle, math.pi - _EPSILON)))


@kernel
def _sign(value):
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else 0.0


@kernel
def _direction(a, v, wanted, jerk):
    """Return the sign of the first jerk, towards ``wanted`` from the velocity after the acceleration has reached 0."""
    settled = v
    if abs(a) > _EPSILON:
        time = abs(a) / jerk
        settled = v + a * time - 0.5 * _sign(a) * jerk * time * time
    direction = _sign(wanted - settled)
    return _sign(a) if direction == 0.0 else direction


@kernel
def _saturate(a, j, time, accel):
    """Return ``time`` limited so that the acceleration, from ``a`` at jerk ``j``, stays within ``accel``."""
    reached = a + j * time
    if reached > accel:
        return (accel - a) / j
    if reached < -accel:
        return (-accel - a) / j
    return time


@kernel
def _rise_time(a, dv, j, accel):
    """Return the duration of the jerk ``j`` for a velocity change of ``dv`` in the minimum time."""
    delta = 2.0 * a * a + 4.0 * j * dv
    if delta < 0.0:
        return 0.0
    root = 0.5 * math.sqrt(delta)
    plus, minus = (-a + root) / j, (-a - root) / j
    time = 0.0
    if plus >= 0.0 and a / j + plus >= 0.0:
        time = plus
    elif minus >= 0.0 and a / j + minus >= 0.0:
        time = minus
    return max(_saturate(a, j, time, accel), 0.0)


@kernel
def _rise_time_within(total, a, dv, j, accel):
    """Return the duration of the jerk ``j`` for a velocity change of ``dv`` in ``total`` s."""
    b = j * total - a
    delta = total * total * j * j + 2.0 * total * a * j - a * a - 4.0 * j * dv
    if delta < 0.0:
        return 0.0
    root = math.sqrt(delta)
    plus, minus = max((b - root) / (2.0 * j), 0.0), max((b + root) / (2.0 * j), 0.0)
    time = 0.0
    if a / j + plus >= 0.0 and a / j + 2.0 * plus <= total:
        time = plus
    elif a / j + minus >= 0.0 and a / j + 2.0 * minus <= total:
        time = minus
    return _saturate(a, j, time, accel)


@kernel
def plan_axis(path, i, wanted, accel, jerk):
    """Plan axis ``i`` independently to the velocity ``wanted``, m/s; return the duration of the plan, s."""
    a, v = path.acceleration[i], path.velocity[i]
    direction = _direction(a, v, wanted, jerk)
    times = path.times[i]
    path.direction[i] = direction
    if direction == 0.0:
        times[0] = times[1] = times[2] = 0.0
        return 0.0
    j, dv = direction * jerk, wanted - v
    rise = _rise_time(a, dv, j, accel)
    fall = max(a / j + rise, 0.0)
    level = 0.0
    top = a + j * rise
    if abs(top) > _EPSILON:
        gained = 0.5 * j * (rise * rise - fall * fall) + j * rise * fall + a * (rise + fall)
        level = max((dv - gained) / top, 0.0)
    times[0], times[1], times[2] = rise, level, fall
    return rise + level + fall


@kernel
def _stretch_axis(path, i, wanted, accel, jerk, total):
    """Replan axis ``i`` for the duration ``total``, s."""
    direction = path.direction[i]
    if direction == 0.0:
        return
    a, j = path.acceleration[i], direction * jerk
    rise = _rise_time_within(total, a, wanted - path.velocity[i], j, accel)
    fall = max(a / j + rise, 0.0)
    path.times[i, 0] = rise
    path.times[i, 1] = max(total - rise - fall, 0.0)
    path.times[i, 2] = fall


@kernel
def plan(path, wanted, speeds, accels, jerk):
    """Plan all axes from the current state to the velocities ``wanted``, reached at the same time.

    Args:
        path: ``PATH`` record.
        wanted, speeds, accels: 3-tuples: velocities (m/s), largest speeds (m/s) and accelerations (m/s^2).
        jerk: largest jerk, m/s^3.
    """
    x, y, z = (
        constrain(wanted[0], -speeds[0], speeds[0]),
        constrain(wanted[1], -speeds[1], speeds[1]),
        constrain(wanted[2], -speeds[2], speeds[2]),
    )
    tx, ty, tz = (
        plan_axis(path, 0, x, accels[0], jerk),
        plan_axis(path, 1, y, accels[1], jerk),
        plan_axis(path, 2, z, accels[2], jerk),
    )
    longest = max(tx, ty, tz)
    if longest <= _EPSILON:
        return
    if tx < longest:
        _stretch_axis(path, 0, x, accels[0], jerk, longest)
    if ty < longest:
        _stretch_axis(path, 1, y, accels[1], jerk, longest)
    if tz < longest:
        _stretch_axis(path, 2, z, accels[2], jerk, longest)


@kernel
def _coast(path, i, j, time):
    """Advance axis ``i`` by ``time`` s at the constant jerk ``j``."""
    a, v = path.acceleration[i], path.velocity[i]
    path.acceleration[i] = a + j * time
    path.velocity[i] = v + a * time + 0.5 * j * time * time
    path.position[i] += v * time + 0.5 * a * time * time + j * time * time * time / 6.0


@kernel
def follow(path, i, jerk, dt):
    """Advance axis ``i`` along its plan by ``dt`` s."""
    times = path.times[i]
    j = path.direction[i] * jerk
    time = min(dt, times[0])
    _coast(path, i, j, time)
    rest = dt - time
    if rest > 0.0:
        time = min(rest, times[1])
        _coast(path, i, 0.0, time)
        rest -= time
    if rest > 0.0:
        time = min(rest, times[2])
        _coast(path, i, -j, time)
        rest -= time
    if rest > 0.0:
        path.acceleration[i] = 0.0
        _coast(path, i, 0.0, rest)
