"""Sleep of vehicles and bodies at rest; arming or a moving body within reach wakes a vehicle."""

from __future__ import annotations

from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.contacts.free_or_bullet import NEAR
from xtdrone_sim.physics.vehicle_dynamics import ABSENT, ASLEEP, TOUCHING

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
