"""Rigid-body and rotor dynamics of multicopters; each kernel handles one vehicle per call.

World frame ENU, body frame FLU, quaternions (w, x, y, z) body to world. Rotors are first-order lags with thrust
k w^2, reaction torque, in-plane drag and rolling moment (the model of PX4 SITL's Gazebo motor plugin; P. Martin,
E. Salaun, "The true role of accelerometer feedback in quadrotor control", ICRA 2010, for the drag).
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_autopilot.state import MAX_ROTORS
from xtdrone_common.rotation_kernels import integrate, rotate, rotate_inverse
from xtdrone_sim.kernel import kernel

FREE = 0  # integrated here
TOUCHING = 1  # near ground or another body: Bullet integrates
ASLEEP = 2  # at rest on the ground with motors off: not integrated
ABSENT = 3  # not in the world: a reserved place without a vehicle
LOST = 4  # taken out of the world: it stays at its last possible position, without collisions, until a reset
LEAVING = 5  # to be taken out by the next contact check; the states from ABSENT on are not integrated

FASTEST_TURN = 100.0
"""Limit of body rates, rad/s: far above those of flight, far below those at which a step of 4 ms becomes unstable."""
FARTHEST = 1e6
"""Limit of the sum of a state's numbers, in m, m/s and rad/s: far beyond all flights. Not finite ones exceed it too."""

PLANT = np.dtype(
    [
        ("position", "f8", 3),  # m, world
        ("velocity", "f8", 3),  # m/s, world
        ("q", "f8", 4),  # (w, x, y, z)
        ("rates", "f8", 3),  # rad/s, body
        ("acceleration", "f8", 3),  # m/s^2, world, mean over the last step, gravity included
        ("rotor_speed", "f8", MAX_ROTORS),  # rad/s, >= 0
        ("force", "f8", 3),  # N, world, without gravity
        ("torque", "f8", 3),  # N m, body
        ("wind", "f8", 3),  # m/s, world
        ("contact", "i8"),  # FREE, TOUCHING, ASLEEP, ABSENT, LOST or LEAVING
        ("still_steps", "i8"),  # steps at rest with motors off
    ],
    align=True,
)


@kernel
def rotor_lag(m, dt):
    """Return the shares of the difference to a higher and to a lower wanted speed that remain after ``dt``."""
    return math.exp(-dt / m.time_constant_up), math.exp(-dt / m.time_constant_down)


@kernel
def advance_rotors(v, m, lag, actuators, armed):
    """Advance the rotor speeds towards the motor commands (0..1); motors run down if disarmed or at NaN.

    ``lag``: of one step, see ``rotor_lag``.
    """
    keep_up, keep_down = lag
    for i in range(m.rotor_count):
        runs = armed and not math.isnan(actuators[i])
        wanted = min(m.input_scaling * actuators[i] + m.idle_speed, m.max_speed) if runs else 0.0
        speed = v.rotor_speed[i]
        v.rotor_speed[i] = wanted + (speed - wanted) * (keep_up if wanted > speed else keep_down)


@kernel
def rotor_wrench(v, m):
    """Set v.force (world) and v.torque (body) to the wrench of rotors and body drag at the current state."""
    ax, ay, _ = rotate_inverse(
        v.q, v.velocity[0] - v.wind[0], v.velocity[1] - v.wind[1], v.velocity[2] - v.wind[2]
    )  # fmt: skip
    fx, fy, fz = 0.0, 0.0, 0.0
    tx, ty, tz = 0.0, 0.0, 0.0
    for i in range(m.rotor_count):
        speed = v.rotor_speed[i]
        px, py, pz = m.rotor_position[i, 0], m.rotor_position[i, 1], m.rotor_position[i, 2]
        # air speed at the hub, in the rotor plane
        hx = ax + v.rates[1] * pz - v.rates[2] * py
        hy = ay + v.rates[2] * px - v.rates[0] * pz
        thrust = m.thrust_constant * speed * speed
        dx = -m.drag_coefficient * speed * hx
        dy = -m.drag_coefficient * speed * hy
        fx += dx
        fy += dy
        fz += thrust
        tx += py * thrust - pz * dy - m.rolling_moment_coefficient * speed * hx
        ty += pz * dx - px * thrust - m.rolling_moment_coefficient * speed * hy
        tz += px * dy - py * dx - m.rotor_direction[i] * m.moment_constant * thrust
    v.force[0], v.force[1], v.force[2] = rotate(v.q, fx, fy, fz)
    for i in range(3):
        v.force[i] -= m.linear_drag * (v.velocity[i] - v.wind[i])
    v.torque[0], v.torque[1], v.torque[2] = tx, ty, tz


@kernel
def _angular_acceleration(m, wx, wy, wz, torque):
    """Return the body angular acceleration by Euler's equations, rad/s^2."""
    ix, iy, iz = m.inertia[0], m.inertia[1], m.inertia[2]
    return (
        (torque[0] - (iz - iy) * wy * wz) / ix,
        (torque[1] - (ix - iz) * wz * wx) / iy,
        (torque[2] - (iy - ix) * wx * wy) / iz,
    )


@kernel
def _stop_at(v, position, q):
    """Stop a vehicle with an impossible state at a position (3-tuple), m, and attitude (4-tuple); it is LEAVING."""
    for i in range(3):
        v.position[i] = position[i]
        v.velocity[i] = v.rates[i] = v.acceleration[i] = v.force[i] = v.torque[i] = 0.0
    for i in range(4):
        v.q[i] = q[i]
    for i in range(MAX_ROTORS):
        v.rotor_speed[i] = 0.0
    v.contact = LEAVING


@kernel
def integrate_free(v, m, gravity, dt):
    """Advance a body in free flight by ``dt`` under v.force, v.torque and gravity (second order in dt).

    Body rates are limited to ``FASTEST_TURN``. A body whose state becomes impossible stops where it was, LEAVING.
    """
    position = v.position[0], v.position[1], v.position[2]
    q = v.q[0], v.q[1], v.q[2], v.q[3]
    for i in range(3):
        v.acceleration[i] = v.force[i] / m.mass
    v.acceleration[2] -= gravity
    for i in range(3):
        v.position[i] += v.velocity[i] * dt + 0.5 * v.acceleration[i] * dt * dt
        v.velocity[i] += v.acceleration[i] * dt
    wx, wy, wz = v.rates[0], v.rates[1], v.rates[2]
    bx, by, bz = _angular_acceleration(m, wx, wy, wz, v.torque)
    # middle of the step
    hx, hy, hz = wx + 0.5 * dt * bx, wy + 0.5 * dt * by, wz + 0.5 * dt * bz
    bx, by, bz = _angular_acceleration(m, hx, hy, hz, v.torque)
    v.rates[0] = wx + dt * bx
    v.rates[1] = wy + dt * by
    v.rates[2] = wz + dt * bz
    integrate(v.q, hx * dt, hy * dt, hz * dt)
    turn = v.rates[0] * v.rates[0] + v.rates[1] * v.rates[1] + v.rates[2] * v.rates[2]
    if turn > FASTEST_TURN * FASTEST_TURN:
        share = FASTEST_TURN / math.sqrt(turn)
        for i in range(3):
            v.rates[i] *= share
    total = abs(v.q[0]) + abs(v.q[1]) + abs(v.q[2]) + abs(v.q[3])
    for i in range(3):
        total += abs(v.position[i]) + abs(v.velocity[i]) + abs(v.rates[i])
    if not total < FARTHEST:  # true for NaN as well
        _stop_at(v, position, q)


@kernel
def step_vehicle(v, m, lag, actuators, armed, gravity, dt):
    """Advance one vehicle; return 1 if Bullet must integrate its motion, else 0. See ``step_all``, ``rotor_lag``."""
    if v.contact >= ABSENT or (v.contact == ASLEEP and not armed):
        return 0
    advance_rotors(v, m, lag, actuators, armed)
    rotor_wrench(v, m)
    if v.contact != FREE:
        return 1
    integrate_free(v, m, gravity, dt)
    return 0


@kernel
def step_all(plant, models, actuators, armed, gravity, dt):
    """Advance rotors and wrench of every vehicle, and the motion of those in free flight.

    Args:
        plant: (n,) ``PLANT``.
        models: (n,) ``MODEL``.
        actuators: (n, MAX_ROTORS) motor commands, 0..1.
        armed: (n,) non-zero when motors run.
        gravity: m/s^2.
        dt: s.

    Returns:
        Number of vehicles that Bullet must integrate (contact == TOUCHING).
    """
    touching = 0
    for i in range(plant.shape[0]):
        m = models[i]
        touching += step_vehicle(plant[i], m, rotor_lag(m, dt), actuators[i], armed[i], gravity, dt)
    return touching
