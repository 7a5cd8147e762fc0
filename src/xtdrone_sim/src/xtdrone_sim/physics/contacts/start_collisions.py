"""Start poses of vehicles: the body's pose, and a check that it is free."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.fleet import StartPose
from xtdrone_common.frames import to_xyzw
from xtdrone_common.rotation import Quaternion, Vector, from_euler, rotate
from xtdrone_sim.physics.bodies.obstacles import Obstacles
from xtdrone_sim.physics.quiet_pybullet import BulletClient, connect, pybullet
from xtdrone_sim.rays.solid_ground import SolidGround

_GAP = 0.001  # m between a spawned body and the ground
_TOLERANCE = 0.01  # m; Bullet resolves an overlap this small without a jump


class StartError(ValueError):
    """A start that is not free; the message names the vehicle, the other object, and the depth of the overlap."""


def body_pose(pose: StartPose, height: float) -> tuple[Vector, Quaternion]:
    """Return position, m ENU, and attitude of a body of ``height``, m, whose lowest point is at ``pose``."""
    q = from_euler(pose.roll, pose.pitch, pose.yaw)
    x, y, z = rotate(q, 0.0, 0.0, 0.5 * height + _GAP)
    return (pose.x + x, pose.y + y, pose.z + z), q


def check_starts(
    plant: NDArray[np.void],
    models: NDArray[np.void],
    names: Sequence[str],
    obstacles: Obstacles,
    owners: Sequence[str],
    which: Sequence[int] | None = None,
) -> None:
    """Check that vehicles start above the ground and not inside an obstacle or another vehicle.

    Args:
        plant: (n,) ``PLANT``, the vehicles.
        models: (n,) ``MODEL``.
        names: names of the vehicles; those with an empty name are absent.
        obstacles: shapes of the world's models.
        owners: names of these models.
        which: indices of the vehicles to check; None: all.

    Raises:
        StartError: a vehicle overlaps something by more than a centimetre.
    """
    there = [i for i, name in enumerate(names) if name]
    ground = SolidGround(obstacles.shapes)
    for i in there if which is None else which:
        _check_ground(plant[i], models[i], names[i])
        if ground.has_terrain:
            _check_terrain(plant[i], models[i], names[i], ground)
    pairs = [(i, j) for i in (there if which is None else which) for j in there if j != i and (which or j < i)]
    near = [(i, j) for i, j in pairs if _are_near(plant, models, i, j)]
    beside = {i: obstacles.around(plant[i]["position"], float(models[i]["radius"])) for i in which or there}
    if not near and not any(beside.values()):
        return
    client = connect()  # a separate world, so that the contacts of the flight's stay unchanged
    try:
        overlaps = _Overlaps(client, plant, models)
        for i, shapes in beside.items():
            for shape in shapes:
                depth = overlaps.between(overlaps.vehicle(i), obstacles.create(client, shape))
                _check(depth, plant[i], names[i], repr(owners[obstacles.owners[shape]]))
        for i, j in near:
            _check(overlaps.between(overlaps.vehicle(i), overlaps.vehicle(j)), plant[i], names[i], names[j])
    finally:
        client.disconnect()


def _check_ground(v: np.void, m: np.void, name: str) -> None:
    q = v["q"].tolist()
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    half = sum(0.5 * float(side) * abs(rotate(q, *axis)[2]) for side, axis in zip(m["box"], axes, strict=True))
    _check(half - float(v["position"][2]), v, name, "the ground")


def _check_terrain(v: np.void, m: np.void, name: str, ground: SolidGround) -> None:
    """Check that a vehicle is above the heightmaps below its box."""
    signs = np.array([(a, b, c) for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
    corners = np.array([rotate(v["q"].tolist(), *corner) for corner in (signs * m["box"]).tolist()]) + v["position"]
    lowest = float(corners[:, 2].min())
    check_height(ground, np.vstack([corners[:, :2], v["position"][None, :2]]), lowest, name, _GAP)


def check_height(ground: SolidGround, places: NDArray[np.float64], height: float, name: str, gap: float = 0.0) -> None:
    """Check that a vehicle or robot starts above the heightmaps of a world.

    Args:
        ground: ground of the world.
        places: (n, 2) m, map, points below it.
        height: height of its lowest point, m.
        name: name of the vehicle or robot.
        gap: height of that point above the given start, m.

    Raises:
        StartError: it does not; the message gives the lowest allowed height.
    """
    most = float(ground.terrain(places).max())
    if most - height > _TOLERANCE:
        x, y = places[-1].tolist()
        least = math.ceil(100.0 * most) / 100.0
        raise StartError(
            f"{name}: the start is not free: at {x:.2f} {y:.2f} m, z = {height - gap:.2f} m is below the terrain; "
            f"at least {least:.2f} m is allowed"
        )


def _are_near(plant: NDArray[np.void], models: NDArray[np.void], i: int, j: int) -> bool:
    distance = math.dist(plant[i]["position"].tolist(), plant[j]["position"].tolist())
    return distance < float(models[i]["radius"] + models[j]["radius"])


def _check(depth: float, v: np.void, name: str, other: str) -> None:
    if depth > _TOLERANCE:
        place = " ".join(f"{part:.2f}" for part in v["position"].tolist())
        where = "below" if other == "the ground" else "inside"
        raise StartError(
            f"{name}: the start is not free: its body, centred at {place} m, is {depth:.2f} m {where} {other}"
        )


class _Overlaps:
    """Vehicles' collision boxes in a separate Bullet world."""

    def __init__(self, client: BulletClient, plant: NDArray[np.void], models: NDArray[np.void]) -> None:
        self._client, self._plant, self._models = client, plant, models
        self._bodies: dict[int, int] = {}

    def vehicle(self, i: int) -> int:
        """Return the body of vehicle ``i``."""
        if i not in self._bodies:
            shape = self._client.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=(0.5 * self._models[i]["box"]).tolist()
            )
            v = self._plant[i]
            self._bodies[i] = self._client.createMultiBody(
                1.0, shape, basePosition=v["position"].tolist(), baseOrientation=to_xyzw(v["q"].tolist())
            )
        return self._bodies[i]

    def between(self, a: int, b: int) -> float:
        """Return the penetration depth of two bodies, m; 0 if they are apart."""
        points = self._client.getClosestPoints(a, b, 0.0)
        return max((-float(point[8]) for point in points), default=0.0)
