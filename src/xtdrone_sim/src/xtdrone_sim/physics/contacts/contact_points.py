"""Contact points of vehicles, as Bullet finds them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

GROUND = -1
"""The ground, as the other body of a contact."""


class Contact(NamedTuple):
    """A contact point of a vehicle.

    Attributes:
        other: the other body: numbered as in ``World.collisions``, or ``GROUND``.
        position: (3,) m, world.
        normal: (3,) unit vector into the vehicle, world.
        force: (3,) on the vehicle, friction included, N, world.
        depth: penetration, m.
    """

    other: int
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    force: NDArray[np.float64]
    depth: float
