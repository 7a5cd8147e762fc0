"""Poses of the moving links of all vehicles: bodies, gimbals, landing gears, and those with cameras and lidars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose
from xtdrone_common.poses import rotate as rotate_by
from xtdrone_common.rotation import Vector
from xtdrone_common.rotation_kernels import exponential, multiply, rotate
from xtdrone_sim.kernel import kernel
from xtdrone_sim.vehicles.mounts.camera_and_gimbal_mounts import GimbalMount
from xtdrone_sim.vehicles.vehicle_model import VehicleModel

_BODY = -1  # as parent: this link is the vehicle's body
_STILL = -1  # as joint: not a joint of the gimbal

_TABLE = np.dtype(
    [
        ("vehicle", "i8"),
        ("parent", "i8"),  # index of the entry, or _BODY
        ("position", "f8", 3),  # m, parent's frame, joint at 0
        ("q", "f8", 4),  # (w, x, y, z)
        ("axis", "f8", 3),  # of the joint, parent's frame
        ("joint", "i8"),  # of the gimbal: 0 yaw, 1 roll, 2 pitch, or _STILL
        ("raised", "f8"),  # rad: the angle of a landing gear's joint when it is up, else 0
    ],
    align=True,
)

LINK = np.dtype(
    [
        ("position", "f8", 3),  # m, map
        ("q", "f8", 4),  # (w, x, y, z), link to map
        ("velocity", "f8", 3),  # m/s, map
        ("spin", "f8", 3),  # rad/s, map
    ],
    align=True,
)

_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # of the gimbal's joints


@kernel
def place_all(links, table, plant, gimbals, gears):
    """Fill ``links`` (m,) ``LINK`` of ``table`` (m,) ``_TABLE`` from vehicles', gimbals' and gears' records (n,)."""
    for i in range(table.shape[0]):
        t, link = table[i], links[i]
        v = plant[t.vehicle]
        if t.parent < 0:
            spin = rotate(v.q, v.rates[0], v.rates[1], v.rates[2])
            for k in range(3):
                link.position[k] = v.position[k]
                link.velocity[k] = v.velocity[k]
                link.spin[k] = spin[k]
            for k in range(4):
                link.q[k] = v.q[k]
            continue
        parent = links[t.parent]
        arm = rotate(parent.q, t.position[0], t.position[1], t.position[2])
        axis = rotate(parent.q, t.axis[0], t.axis[1], t.axis[2])
        q = multiply(parent.q, t.q)
        angle, rate = 0.0, 0.0
        if t.joint >= 0:
            g = gimbals[t.vehicle]
            angle, rate = g.joint[t.joint], g.joint_rate[t.joint]
        elif t.raised != 0.0:
            angle, rate = t.raised * gears[t.vehicle].raised, t.raised * gears[t.vehicle].rate
        if angle != 0.0:
            q = multiply(exponential(axis[0] * angle, axis[1] * angle, axis[2] * angle), q)
        px, py, pz = parent.spin[0], parent.spin[1], parent.spin[2]
        sweep = (py * arm[2] - pz * arm[1], pz * arm[0] - px * arm[2], px * arm[1] - py * arm[0])
        for k in range(3):
            link.position[k] = parent.position[k] + arm[k]
            link.velocity[k] = parent.velocity[k] + sweep[k]
            link.spin[k] = parent.spin[k] + rate * axis[k]
        for k in range(4):
            link.q[k] = q[k]


class Links:
    """The moving links of a fleet, and its links with cameras and lidars.

    Attributes:
        names: Gazebo's names, ``model::link``.
        vehicles: index of each link's vehicle.
        states: (m,) ``LINK`` of the last ``place``, in the order of ``names``.
    """

    def __init__(self, names: Sequence[str], models: Sequence[VehicleModel]) -> None:
        """Read the vehicles' descriptions.

        Args:
            names: names of the vehicles; those of absent ones are empty.
            models: one per vehicle.
        """
        self.names: list[str] = []
        self.vehicles: list[int] = []
        rows: list[tuple[object, ...]] = []
        for vehicle, (name, model) in enumerate(zip(names, models, strict=True)):
            if not name:
                continue
            entry: dict[str, int] = {}
            for link, parent, pose, joint in _entries(model):
                entry[link] = len(rows)
                raised, axis = _gear_joint(model, link, pose) if joint == _STILL else (0.0, _AXES[joint])
                above = _BODY if parent is None else entry[parent]
                rows.append((vehicle, above, pose.position, pose.orientation, axis, joint, raised))
                self.names.append(f"{name}::{link}")
                self.vehicles.append(vehicle)
        self._table = np.array(rows, _TABLE)
        self._numbers = {name: i for i, name in enumerate(self.names)}
        for name, model in zip(names, models, strict=True):
            if not name:
                continue
            self._numbers.setdefault(name, self._numbers[f"{name}::{model.urdf.root}"])
        self.states = np.zeros(len(rows), LINK)

    def place(self, plant: NDArray[np.void], gimbals: NDArray[np.void], gears: NDArray[np.void]) -> NDArray[np.void]:
        """Update and return the poses and velocities of all links.

        Args:
            plant: (n,) ``PLANT``.
            gimbals: (n,) ``gimbal.GIMBAL``.
            gears: (n,) ``landing_gear.GEAR``.

        Returns:
            (m,) ``LINK``, the same array at every call.
        """
        place_all(self.states, self._table, plant, gimbals, gears)
        return self.states

    def find(self, name: str) -> int | None:
        """Return the index of a link, or of a vehicle's body; None if unknown."""
        return self._numbers.get(name)


def _entries(model: VehicleModel) -> list[tuple[str, str | None, Pose, int]]:
    """Return name, parent, pose in the parent and gimbal joint of all tracked links, parents first."""
    urdf = model.urdf
    entries: list[tuple[str, str | None, Pose, int]] = []
    for link in urdf.moving:
        joint = urdf.holder(link.name)
        if joint is None:
            entries.append((link.name, None, Pose(), _STILL))
            continue
        carrier, pose = urdf.carrier(joint.parent)
        entries.append((link.name, carrier, compose(pose, joint.pose), _gimbal_joint(model.gimbal, joint.name)))
    known = {entry[0] for entry in entries}
    carriers = [camera.link for camera in model.cameras] + [lidar.link for lidar in model.lidars]
    for name in dict.fromkeys(carriers):
        if name not in known:  # fixed to a moving link
            entries.append((name, *urdf.carrier(name), _STILL))
    return entries


def _gimbal_joint(gimbal: GimbalMount | None, name: str) -> int:
    names = [joint.name for joint in gimbal.joints] if gimbal else []
    return names.index(name) if name in names else _STILL


def _gear_joint(model: VehicleModel, link: str, pose: Pose) -> tuple[float, Vector]:
    """Return angle when up (rad) and axis (parent's frame) of a link's joint of the landing gear; 0 for all others."""
    for joint in model.landing_gear:
        if joint.child == link:
            return joint.upper, rotate_by(pose.orientation, joint.axis)
    return 0.0, (0.0, 0.0, 0.0)
