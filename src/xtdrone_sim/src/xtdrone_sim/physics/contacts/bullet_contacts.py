"""Contacts of vehicles in Bullet: ground and bodies with their friction, and the contact points that Bullet finds.

Bullet multiplies the friction and the restitution of two bodies in contact. Both are those of the world's file, for
ground, vehicles and models alike; a landing slides and bounces accordingly.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.frames import to_xyzw
from xtdrone_sim.physics.quiet_pybullet import BulletClient, pybullet
from xtdrone_worlds.worlds.sdf import SdfWorld

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


def create_ground(client: BulletClient, world: SdfWorld) -> int:
    """Return Bullet's body of the ground, the plane z = 0."""
    ground = int(client.createMultiBody(0.0, client.createCollisionShape(pybullet.GEOM_PLANE)))
    client.changeDynamics(ground, -1, lateralFriction=world.friction, restitution=world.restitution)
    return ground


def create_vehicle(client: BulletClient, world: SdfWorld, v: np.void, m: np.void) -> int:
    """Return Bullet's body of a vehicle, a box at its current pose.

    Args:
        client: Bullet.
        world: provides friction and restitution.
        v, m: ``PLANT`` and ``MODEL`` of the vehicle.
    """
    shape = client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=(0.5 * m["box"]).tolist())
    place, turn = v["position"].tolist(), to_xyzw(v["q"].tolist())
    body = int(client.createMultiBody(float(m["mass"]), shape, basePosition=place, baseOrientation=turn))
    client.changeDynamics(
        body,
        -1,
        localInertiaDiagonal=m["inertia"].tolist(),
        linearDamping=0.0,
        angularDamping=0.0,
        lateralFriction=world.friction,
        restitution=world.restitution,
        activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
    )
    return body


def contact_points(client: BulletClient, body: int, index_of: Mapping[int, int]) -> list[Contact]:
    """Return the contact points of a vehicle in the last step of Bullet.

    Args:
        client: Bullet.
        body: Bullet's body of the vehicle.
        index_of: numbers of the other bodies, as in ``World.collisions``, by Bullet's.
    """
    found = []
    for point in client.getContactPoints(body):
        if point[8] > 0.0:
            continue
        is_first = point[1] == body
        sign = 1.0 if is_first else -1.0  # the normal points from the second body to the first
        normal = sign * np.array(point[7])
        friction = sign * (point[10] * np.array(point[11]) + point[12] * np.array(point[13]))
        other = index_of.get(point[2] if is_first else point[1], GROUND)
        place = np.array(point[5 if is_first else 6])
        found.append(Contact(other, place, normal, point[9] * normal + friction, -float(point[8])))
    return found
