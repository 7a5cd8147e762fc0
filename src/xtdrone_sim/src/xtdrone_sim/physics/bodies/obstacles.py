"""Obstacles of a world: detection of nearby vehicles, and collision bodies in Bullet.

Axis-aligned boxes approximate the shapes until a vehicle is near. A grid of columns finds the boxes around a vehicle,
so the cost does not grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.frames import to_xyzw
from xtdrone_common.poses import Pose, compose
from xtdrone_sim.kernel import kernel
from xtdrone_sim.physics.quiet_pybullet import BulletClient, pybullet
from xtdrone_sim.physics.vehicle_dynamics import ABSENT, FREE, TOUCHING
from xtdrone_worlds.shapes.visual import Box, Cylinder, Geometry, Mesh, Sphere
from xtdrone_worlds.worlds.sdf import SdfModel
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of

_CELL = 8.0  # m, minimum side of a column
_MOST_CELLS = 512  # along each axis


@kernel
def mark_near_obstacles(plant, models, boxes, origin, cell, begins, items, limits, horizon, wanted):
    """Set ``wanted`` to TOUCHING for every vehicle that is near a box.

    Vehicles are spheres, enlarged by the distance that they can travel until the next check.

    Args:
        plant: (n,) ``PLANT``.
        models: (n,) ``MODEL``.
        boxes: (k, 6) lowest and highest corner, m.
        origin: (2,) corner of the grid, m.
        cell: side of a column, m.
        begins: (nx, ny + 1) start in ``items`` of the boxes of each column; they end at the start of the next column
            in the row.
        items: indices of boxes.
        limits: (2,) clearance, m, below which a vehicle in free flight, and one integrated by Bullet, counts as near.
        horizon: time until the next check, s.
        wanted: (n,) FREE, TOUCHING or ASLEEP; updated.

    Returns:
        Number of vehicles near a box.
    """
    near = 0
    rows, columns = begins.shape[0], begins.shape[1] - 1
    for i in range(plant.shape[0]):
        v = plant[i]
        if v.contact >= ABSENT:
            continue
        x, y, z = v.position[0], v.position[1], v.position[2]
        speed = math.sqrt(v.velocity[0] ** 2 + v.velocity[1] ** 2 + v.velocity[2] ** 2)
        reach = models[i].radius + speed * horizon + (limits[0] if v.contact == FREE else limits[1])
        # Positions may be huge: compare as floating point before converting to integers.
        ax, bx = (x - reach - origin[0]) / cell, (x + reach - origin[0]) / cell
        ay, by = (y - reach - origin[1]) / cell, (y + reach - origin[1]) / cell
        if not (ax < rows and bx >= 0.0 and ay < columns and by >= 0.0):
            continue
        found = False
        for row in range(int(max(ax, 0.0)), int(min(bx, rows - 1.0)) + 1):
            first, last = int(max(ay, 0.0)), int(min(by, columns - 1.0))
            for k in range(begins[row, first], begins[row, last + 1]):
                b = boxes[items[k]]
                dx = max(max(b[0] - x, x - b[3]), 0.0)
                dy = max(max(b[1] - y, y - b[4]), 0.0)
                dz = max(max(b[2] - z, z - b[5]), 0.0)
                if dx * dx + dy * dy + dz * dz < reach * reach:
                    found = True
                    break
            if found:
                break
        if found:
            wanted[i] = TOUCHING
            near += 1
    return near


class Obstacles:
    """Collision shapes of all static models in a world.

    Attributes:
        count: number of shapes.
        owners: number of the model of each shape.
    """

    def __init__(self, models: Mapping[int, SdfModel]) -> None:
        """Compute boxes and grid.

        Args:
            models: models by number.

        Raises:
            SdfError: a mesh file cannot be read.
        """
        self._shapes: list[tuple[Geometry, Pose]] = []
        self.owners: list[int] = []
        for number, model in models.items():
            for link in model.links:
                frame = compose(model.pose, link.pose)
                for collision in link.collisions:
                    self._shapes.append((collision.geometry, compose(frame, collision.pose)))
                    self.owners.append(number)
        self.count = len(self._shapes)
        boxes = [np.concatenate(box_of(geometry, pose)) for geometry, pose in self._shapes]
        self._boxes: NDArray[np.float64] = np.array(boxes, float).reshape(-1, 6)
        self._lay_grid()

    @property
    def shapes(self) -> Sequence[tuple[Geometry, Pose]]:
        """All shapes with their poses in the world."""
        return self._shapes

    def _lay_grid(self) -> None:
        boxes = self._boxes
        low = boxes[:, :2].min(axis=0) if self.count else np.zeros(2)
        high = boxes[:, 3:5].max(axis=0) if self.count else np.zeros(2)
        self._origin = low
        self._cell = max(_CELL, float((high - low).max()) / _MOST_CELLS)
        rows, columns = (np.floor((high - low) / self._cell).astype(int) + 1).tolist()
        members: list[list[list[int]]] = [[[] for _ in range(columns)] for _ in range(rows)]
        cells = np.floor((boxes[:, [0, 1, 3, 4]] - np.tile(low, 2)) / self._cell).astype(int).tolist()
        for number, (x0, y0, x1, y1) in enumerate(cells):
            for row in range(x0, x1 + 1):
                for column in range(y0, y1 + 1):
                    members[row][column].append(number)
        self._begins = np.zeros((rows, columns + 1), np.int64)
        items: list[int] = []
        for row in range(rows):
            for column in range(columns):
                self._begins[row, column] = len(items)
                items += members[row][column]
            self._begins[row, columns] = len(items)
        self._items = np.array(items, np.int64)

    def mark_near(
        self,
        plant: NDArray[np.void],
        models: NDArray[np.void],
        limits: NDArray[np.float64],
        horizon: float,
        wanted: NDArray[np.int64],
    ) -> int:
        """See ``mark_near_obstacles``."""
        return int(
            mark_near_obstacles(
                *(plant, models, self._boxes, self._origin, self._cell, self._begins, self._items),
                *(limits, horizon, wanted),
            )
        )

    def load(self, client: BulletClient, friction: float, restitution: float) -> dict[int, int]:
        """Create a Bullet body for each shape; return the number of the model by body."""
        owner_of = {}
        meshes: dict[Geometry, int] = {}
        for number, owner in enumerate(self.owners):
            body = self.create(client, number, meshes)
            client.changeDynamics(body, -1, lateralFriction=friction, restitution=restitution)
            owner_of[body] = owner
        return owner_of

    def create(self, client: BulletClient, number: int, meshes: dict[Geometry, int] | None = None) -> int:
        """Create the Bullet body of a shape.

        Args:
            client: the Bullet world.
            number: index of the shape.
            meshes: shapes created before, by geometry, for reuse; updated.
        """
        geometry, pose = self._shapes[number]
        known = {} if meshes is None else meshes
        if geometry not in known:
            known[geometry] = _shape(client, geometry)
        body = client.createMultiBody(
            0.0,
            known[geometry],
            basePosition=pose.position,
            baseOrientation=to_xyzw(pose.orientation),
            useMaximalCoordinates=True,
        )
        return int(body)

    def around(self, position: NDArray[np.float64], radius: float) -> list[int]:
        """Return the shapes whose boxes are within ``radius``, m, of ``position``, m ENU."""
        if not self.count:
            return []
        gap = np.maximum(np.maximum(self._boxes[:, :3] - position, position - self._boxes[:, 3:]), 0.0)
        found: list[int] = np.flatnonzero((gap * gap).sum(axis=1) < radius * radius).tolist()
        return found


def _shape(client: BulletClient, geometry: Geometry) -> int:
    """Return the id of a shape in Bullet; meshes stay concave."""
    if isinstance(geometry, Box):
        return int(client.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.5 * side for side in geometry.size]))
    if isinstance(geometry, Sphere):
        return int(client.createCollisionShape(pybullet.GEOM_SPHERE, radius=geometry.radius))
    if isinstance(geometry, Cylinder):
        return int(client.createCollisionShape(pybullet.GEOM_CYLINDER, radius=geometry.radius, height=geometry.length))
    return int(
        client.createCollisionShape(
            pybullet.GEOM_MESH,
            fileName=str(geometry.path),
            meshScale=geometry.scale,
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        )
    )


def shape_array(client: BulletClient, shapes: Sequence[tuple[Geometry, Pose]], *, hollow: bool) -> int:
    """Return the id of one shape in Bullet that is made of several, at most 16.

    Args:
        client: Bullet.
        shapes: shapes with their poses in the frame of the whole.
        hollow: whether meshes stay concave; otherwise their convex hulls are used.
    """
    kinds = {Box: pybullet.GEOM_BOX, Sphere: pybullet.GEOM_SPHERE, Cylinder: pybullet.GEOM_CYLINDER}
    forms = [form for form, _ in shapes]
    flag = pybullet.GEOM_FORCE_CONCAVE_TRIMESH if hollow else 0
    return int(
        client.createCollisionShapeArray(
            shapeTypes=[kinds.get(type(form), pybullet.GEOM_MESH) for form in forms],
            halfExtents=[[0.5 * side for side in form.size] if isinstance(form, Box) else [0.0] * 3 for form in forms],
            radii=[form.radius if isinstance(form, (Sphere, Cylinder)) else 0.0 for form in forms],
            lengths=[form.length if isinstance(form, Cylinder) else 0.0 for form in forms],
            fileNames=[str(form.path) if isinstance(form, Mesh) else "" for form in forms],
            meshScales=[form.scale if isinstance(form, Mesh) else (1.0, 1.0, 1.0) for form in forms],
            flags=[flag if isinstance(form, Mesh) else 0 for form in forms],
            collisionFramePositions=[pose.position for _, pose in shapes],
            collisionFrameOrientations=[to_xyzw(pose.orientation) for _, pose in shapes],
        )
    )
