"""Contact states of all vehicles: FREE, TOUCHING or ASLEEP, by ``free_or_bullet`` and ``sleeping``."""

from __future__ import annotations

from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.contacts.free_or_bullet import mark_near
from xtdrone_sim.physics.contacts.sleeping import let_sleep


@kernel
def sort_contacts(plant, models, armed, steps, dt, wanted):
    """Fill ``wanted`` (n,) with the contact state of every vehicle; return the number of changes."""
    mark_near(plant, models, steps, dt, wanted)
    return let_sleep(plant, models, armed, wanted)
