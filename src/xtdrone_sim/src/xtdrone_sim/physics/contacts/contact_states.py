"""Contact states of all vehicles: FREE, TOUCHING or ASLEEP.

Kernels decide which vehicles Bullet integrates: those near the ground or each other. A vehicle at rest with its motors
off sleeps; arming or a moving body within reach wakes it.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_sim.kernel import kernel, kernel_that_allocates
from xtdrone_sim.physics.vehicle_dynamics import ABSENT, ASLEEP, FREE, LEAVING, LOST, TOUCHING

CHECK_STEPS = 5  # steps between two updates of the contact states; margins cover the motion in between
NEAR = 0.25  # m of clearance below which Bullet integrates a body
FAR = 0.40  # m of clearance above which the free-flight kernel does again
_CAUTION = 2.0  # factor on the acceleration by rotors at full speed, weight and drag: upper bound for a body
_FASTEST_SPIN = 20.0  # rad/s below which the drag of rotation is far less than this reserve


@kernel
def mark_near(plant, models, steps, dt, wanted):
    """Fill ``wanted`` (n,) with TOUCHING for vehicles near the ground or each other, with FREE for all others.

    Absent ones stay ABSENT, lost ones LOST, which those that are LEAVING become. Vehicles are spheres around the
    collision boxes, enlarged by the distance travelled until the next check.
    """
    count = plant.shape[0]
    for i in range(count):
        v, m = plant[i], models[i]
        if v.contact >= ABSENT:
            wanted[i] = ABSENT if v.contact == ABSENT else LOST
            continue
        reach = abs(v.velocity[2]) * steps * dt
        clearance = v.position[2] - m.radius - reach
        near = clearance < (NEAR if v.contact == FREE else FAR)
        wanted[i] = TOUCHING if near else FREE
    for i in range(count):
        v = plant[i]
        if v.contact >= ABSENT:
            continue
        for j in range(i):
            o = plant[j]
            if o.contact >= ABSENT:
                continue
            dx = v.position[0] - o.position[0]
            dy = v.position[1] - o.position[1]
            dz = v.position[2] - o.position[2]
            threshold = models[i].radius + models[j].radius + FAR + 10.0 * steps * dt
            squared = dx * dx + dy * dy + dz * dz
            if squared > threshold * threshold:
                continue
            rvx = v.velocity[0] - o.velocity[0]
            rvy = v.velocity[1] - o.velocity[1]
            rvz = v.velocity[2] - o.velocity[2]
            reach = math.sqrt(rvx * rvx + rvy * rvy + rvz * rvz) * steps * dt
            clearance = math.sqrt(squared) - models[i].radius - models[j].radius - reach
            if clearance < (NEAR if v.contact == FREE or o.contact == FREE else FAR):
                wanted[i] = TOUCHING
                wanted[j] = TOUCHING


@kernel
def _most_acceleration(v, m, gravity):
    """Return a bound of the acceleration within the next tenth of a second, m/s^2."""
    thrust = m.rotor_count * m.thrust_constant * m.max_speed * m.max_speed
    ax, ay, az = v.velocity[0] - v.wind[0], v.velocity[1] - v.wind[1], v.velocity[2] - v.wind[2]
    drag = m.linear_drag + m.rotor_count * m.drag_coefficient * m.max_speed
    return _CAUTION * (gravity + (thrust + drag * math.sqrt(ax * ax + ay * ay + az * az)) / m.mass)


@kernel_that_allocates
def stay_free(plant, models, steps, gravity, dt):
    """Return whether all vehicles are free and no contact check of the next ``steps``, 0.1 s at most, finds a change.

    With its speed v and a bound a of its acceleration, a body has moved at most v t + a t^2 / 2 after the time t, and
    its speed is at most v + a t. ``mark_near`` adds the distance travelled until the check that follows.
    """
    count = plant.shape[0]
    most = np.empty(count)
    time = steps * dt
    ahead = CHECK_STEPS * dt
    for i in range(count):
        v, m = plant[i], models[i]
        if v.contact == LEAVING:
            return False
        if v.contact >= ABSENT:
            continue
        spin = v.rates[0] * v.rates[0] + v.rates[1] * v.rates[1] + v.rates[2] * v.rates[2]
        if v.contact != FREE or not spin < _FASTEST_SPIN * _FASTEST_SPIN:
            return False
        most[i] = _most_acceleration(v, m, gravity)
        reach = abs(v.velocity[2]) * (time + ahead) + most[i] * time * (0.5 * time + ahead)
        if not v.position[2] - m.radius - reach > NEAR:
            return False
    for i in range(count):
        v = plant[i]
        if v.contact >= ABSENT:
            continue
        for j in range(i):
            o = plant[j]
            if o.contact >= ABSENT:
                continue
            dx = v.position[0] - o.position[0]
            dy = v.position[1] - o.position[1]
            dz = v.position[2] - o.position[2]
            rvx = v.velocity[0] - o.velocity[0]
            rvy = v.velocity[1] - o.velocity[1]
            rvz = v.velocity[2] - o.velocity[2]
            reach = math.sqrt(rvx * rvx + rvy * rvy + rvz * rvz) * (time + ahead)
            reach += (most[i] + most[j]) * time * (0.5 * time + ahead)
            least = models[i].radius + models[j].radius + NEAR + reach
            if not dx * dx + dy * dy + dz * dz > least * least:
                return False
    return True


REST_SPEED = 0.02  # m/s and rad/s below which a body with its motors off counts as at rest
REST_STEPS = 125  # steps at rest before it sleeps


@kernel
def let_sleep(plant, models, armed, wanted):
    """Set ``wanted`` (n,) to ASLEEP for vehicles at rest; return the number of changes."""
    changes = 0
    for i in range(plant.shape[0]):
        v = plant[i]
        if v.contact == ABSENT:
            continue
        if v.contact == ASLEEP:
            wanted[i] = TOUCHING if armed[i] or _disturbed(plant, models, i) else ASLEEP
        elif wanted[i] == TOUCHING and not armed[i] and v.still_steps >= REST_STEPS:
            wanted[i] = ASLEEP
        if wanted[i] != v.contact:
            changes += 1
    return changes


@kernel
def _disturbed(plant, models, i):
    """Return whether a moving body is within reach of the sleeping vehicle ``i``."""
    v = plant[i]
    for j in range(plant.shape[0]):
        o = plant[j]
        if j == i or o.contact == ASLEEP or o.contact >= ABSENT:
            continue
        dx = v.position[0] - o.position[0]
        dy = v.position[1] - o.position[1]
        dz = v.position[2] - o.position[2]
        reach = models[i].radius + models[j].radius + NEAR
        if dx * dx + dy * dy + dz * dz < reach * reach:
            return True
    return False


@kernel
def sort_contacts(plant, models, armed, steps, dt, wanted):
    """Fill ``wanted`` (n,) with the contact state of every vehicle; return the number of changes."""
    mark_near(plant, models, steps, dt, wanted)
    return let_sleep(plant, models, armed, wanted)
