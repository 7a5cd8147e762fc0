"""Motion of simplified vehicles: the step of one vehicle, and the loop over all of them. ENU, SI units."""

from __future__ import annotations

import math

import numpy as np

from xtdrone_swarm.kernel import kernel
from xtdrone_swarm.simplified.simplified_autopilot import OFFBOARD, fly, limit_length
from xtdrone_swarm.swarm_vehicles import ACCELERATION, HOLD, POSITION

VEHICLE = np.dtype(
    [
        ("position", "f8", 3),  # m
        ("velocity", "f8", 3),  # m/s
        ("yaw", "f8"),  # rad from east, counter-clockwise, -pi..pi
        ("armed", "i8"),
        ("mode", "i8"),  # of simplified_autopilot.py
        ("phase", "i8"),  # of the mode
        ("phase_steps", "i8"),  # since the phase began
        ("rest_steps", "i8"),  # on the ground, armed and without a climb command
        ("flown", "i8"),  # has left the ground since it was armed
        ("home", "f8", 3),  # m, where it was armed
        ("place", "f8", 3),  # m, position to hold or to fly to
        ("kind", "i8"),  # of the setpoint, see swarm_vehicles.py
        ("setpoint", "f8", 3),  # m, m/s or m/s^2
        ("sp_yaw", "f8"),  # rad; NaN: sp_yaw_rate applies
        ("sp_yaw_rate", "f8"),  # rad/s
        ("hovering", "i8"),  # the setpoint is a captured position, which further zero velocities do not change
        ("wanted", "f8", 3),  # m/s or m/s^2, commanded by the pilot in this step
        ("wanted_kind", "i8"),  # VELOCITY or ACCELERATION
    ],
    align=True,
)


@kernel
def lag(distance, dt, time_constant, limit, keep):
    """Return the velocity error that remains after ``dt``, and its integral, both as fractions of the error.

    The error d shrinks by d' = -min(d / time_constant, limit): a straight line, then an exponential.

    Args:
        distance: initial velocity error d, m/s, 0 or more.
        dt: time step, s.
        time_constant: time constant of the lag, s.
        limit: maximum acceleration, m/s^2.
        keep: exp(-dt / time_constant).
    """
    knee = limit * time_constant
    if distance <= knee:
        return keep, time_constant * (1.0 - keep)
    straight = (distance - knee) / limit
    if straight >= dt:
        return (distance - limit * dt) / distance, dt - 0.5 * limit * dt * dt / distance
    left = math.exp(-(dt - straight) / time_constant)
    covered = (distance - 0.5 * limit * straight) * straight + knee * time_constant * (1.0 - left)
    return knee * left / distance, covered / distance


@kernel
def follow_horizontal(v, m, kind, x, y, dt):
    """Advance the horizontal motion under a commanded velocity or acceleration (x, y)."""
    if kind == ACCELERATION:
        ax, ay = limit_length(x, y, m.acceleration[0]) if m.order == 2 else (x, y)
        ux, uy = limit_length(v.velocity[0] + ax * dt, v.velocity[1] + ay * dt, m.speed)
        v.position[0] += 0.5 * (v.velocity[0] + ux) * dt
        v.position[1] += 0.5 * (v.velocity[1] + uy) * dt
        v.velocity[0], v.velocity[1] = ux, uy
        return
    left, covered = 0.0, 0.0
    ex, ey = x - v.velocity[0], y - v.velocity[1]
    if m.order == 2:
        distance = math.sqrt(ex * ex + ey * ey)
        left, covered = lag(distance, dt, m.time_constant[0], m.acceleration[0], m.keep[0])
    v.position[0] += x * dt - ex * covered
    v.position[1] += y * dt - ey * covered
    v.velocity[0] = x - ex * left
    v.velocity[1] = y - ey * left


@kernel
def follow_vertical(v, m, kind, z, dt):
    """Advance the vertical motion under a commanded velocity or acceleration ``z``."""
    if kind == ACCELERATION:
        a = min(max(z, -m.acceleration[1]), m.acceleration[1]) if m.order == 2 else z
        u = min(max(v.velocity[2] + a * dt, -m.speed_down), m.speed_up)
        v.position[2] += 0.5 * (v.velocity[2] + u) * dt
        v.velocity[2] = u
        return
    left, covered = 0.0, 0.0
    e = z - v.velocity[2]
    if m.order == 2:
        left, covered = lag(abs(e), dt, m.time_constant[1], m.acceleration[1], m.keep[1])
    v.position[2] += z * dt - e * covered
    v.velocity[2] = z - e * left


@kernel
def wrap(angle):
    """Return an angle wrapped to -pi..pi, rad; an angle in this range is returned bit for bit."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def turn(v, m, dt):
    """Turn by the setpoint's yaw rate, or towards its heading."""
    rate = v.sp_yaw_rate
    if not math.isnan(v.sp_yaw):
        rate = m.yaw_gain * wrap(v.sp_yaw - v.yaw)
    if rate != 0.0:
        rate = min(max(rate, -m.yaw_rate), m.yaw_rate)
        v.yaw = wrap(v.yaw + rate * dt)


@kernel
def step_vehicle(v, m, delayed, number, dt):
    """Advance one vehicle by a base step.

    Args:
        v: ``VEHICLE`` record.
        m: ``MODEL`` record.
        delayed: ring buffer of its last commands (x, y, z, kind), shape (D, 4); D exceeds the larger delay in steps.
        number: number of the step.
        dt: base step, s.

        Returns:
            Whether mode or arming state has changed.
    """
    changed = fly(v, m, dt)
    row = number % len(delayed)
    delayed[row, 0], delayed[row, 1], delayed[row, 2] = v.wanted[0], v.wanted[1], v.wanted[2]
    delayed[row, 3] = v.wanted_kind
    if not v.armed:
        return changed
    flat = delayed[(number - m.delay[0]) % len(delayed)]
    upright = delayed[(number - m.delay[1]) % len(delayed)]
    if v.position[2] <= 0.0 and upright[2] <= 0.0:  # on the ground
        v.velocity[0] = v.velocity[1] = v.velocity[2] = 0.0
        return changed
    follow_horizontal(v, m, int(flat[3]), flat[0], flat[1], dt)
    follow_vertical(v, m, int(upright[3]), upright[2], dt)
    if v.position[2] <= 0.0:  # touchdown
        v.position[2] = 0.0
        v.velocity[0] = v.velocity[1] = v.velocity[2] = 0.0
    if v.mode == OFFBOARD:
        turn(v, m, dt)
    return changed


@kernel
def advance(vehicles, model, delayed, first, steps, dt, position, velocity, yaw):
    """Advance all vehicles by ``steps`` base steps and copy their state.

    Args:
        vehicles: ``VEHICLE`` records, shape (N,).
        model: ``MODEL`` record, shape (1,).
        delayed: ring buffers of the last commands, shape (N, D, 4).
        first: number of the first step.
        steps: number of steps.
        dt: base step, s.
        position, velocity, yaw: output arrays, m, m/s and rad, shapes (N, 3), (N, 3), (N,).

        Returns:
            Whether any mode or arming state has changed.
    """
    changed = False
    m = model[0]
    for i in range(len(vehicles)):
        v = vehicles[i]
        for number in range(first, first + steps):
            changed = step_vehicle(v, m, delayed[i], number, dt) or changed
        for k in range(3):
            position[i, k] = v.position[k]
            velocity[i, k] = v.velocity[k]
        yaw[i] = v.yaw
    return changed


@kernel
def capture(v):
    """Capture the current position and heading as the setpoint (HOVER)."""
    v.kind = POSITION
    v.hovering = 1
    w, z = math.cos(0.5 * v.yaw), math.sin(0.5 * v.yaw)
    v.sp_yaw = math.atan2(
        2.0 * w * z, w * w - z * z
    )  # through a quaternion as in ROS, so that the value is bit-identical
    v.sp_yaw_rate = 0.0
    for k in range(3):
        v.setpoint[k] = v.position[k]


@kernel
def set_one(v, kind, x, y, z, yaw, yaw_rate, dead_zone, dead_yaw_rate):
    """Set one vehicle's setpoint; a velocity or acceleration in the dead zone means HOVER.

    Args:
        v: ``VEHICLE`` record.
        kind: a kind of ``swarm_vehicles``; HOLD captures the current position.
        x, y, z: velocity, m/s, acceleration, m/s^2, or position, m; ENU.
        yaw: heading, rad; NaN: ``yaw_rate`` applies.
        yaw_rate: yaw rate, rad/s.
        dead_zone: largest component that means HOVER, m/s (m/s^2); negative: none.
        dead_yaw_rate: likewise for the yaw rate, rad/s.
    """
    small = abs(x) <= dead_zone and abs(y) <= dead_zone and abs(z) <= dead_zone and abs(yaw_rate) <= dead_yaw_rate
    if kind == HOLD or (kind != POSITION and small):
        if kind == HOLD or not v.hovering:
            capture(v)
        return
    v.kind = kind
    v.hovering = 0
    v.setpoint[0], v.setpoint[1], v.setpoint[2] = x, y, z
    v.sp_yaw, v.sp_yaw_rate = yaw, yaw_rate


@kernel
def set_at(vehicles, index, kind, x, y, z, yaw, yaw_rate, dead_zone, dead_yaw_rate):
    """Set the setpoint of vehicle ``index``; see :func:`set_one`."""
    set_one(vehicles[index], kind, x, y, z, yaw, yaw_rate, dead_zone, dead_yaw_rate)


@kernel
def set_many(vehicles, kind, vectors, given, dead_zone, dead_yaw_rate):
    """Set the setpoints of the ``given`` vehicles; see :func:`set_one`. Return the first invalid row, or -1."""
    for i in range(len(vehicles)):
        if not given[i]:
            continue
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        if not math.isfinite(x + y + z):
            return i
        set_one(vehicles[i], kind, x, y, z, math.nan, 0.0, dead_zone, dead_yaw_rate)
    return -1
