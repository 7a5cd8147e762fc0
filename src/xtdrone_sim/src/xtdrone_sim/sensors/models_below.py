"""Objects below vehicles, for downward-looking sensors: models, other vehicles, people."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose
from xtdrone_common.rotation import rotate_all_inverse
from xtdrone_sim.physics.vehicle_dynamics import ABSENT
from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.casting import PLACE, THING
from xtdrone_sim.rays.scene import RayScene, SceneAt
from xtdrone_sim.rays.tree import NODE, NOTHING, SURFACE
from xtdrone_sim.sensors.vehicles_and_people_below import Others

_NOTHING = np.zeros(0, NODE), np.zeros(0, SURFACE), np.zeros(0, THING), np.zeros(0, PLACE)

Array = NDArray[np.float64]


class Below:
    """Everything in a world as arrays for kernels.

    Attributes:
        arrays: trees, objects and places, see ``casting.cast_rays``, empty if no vehicle looks down or nothing can be
            seen; then (n,) the number of each vehicle's own surfaces, and (k, 3) the velocity, m/s, map, of the
            surfaces of each number, where the last static ones may be missing.
        needed: whether a vehicle looks down.
    """

    def __init__(self, world: World, others: Others, *, needed: bool) -> None:
        """Build the trees.

        Args:
            world: world with its models at the time of ``update``.
            others: vehicles and people.
            needed: whether a vehicle looks down.

        Raises:
            ValueError: an invalid mesh, or too many triangles.
        """
        self._own = np.full(len(world.plant), NOTHING)
        self.arrays: tuple[Any, ...] = (*_NOTHING, self._own, np.zeros((0, 3)))
        self._world, self._others = world, others
        self.needed = needed
        self._rays = RayScene(world.model.models) if needed and world.model.models else None
        self._with: tuple[Any, ...] | None = None  # the fleet that the trees hold
        self._there: tuple[tuple[int, ...], ...] = ((), ())
        self._seen = False  # whether others are in ``arrays``
        if needed:
            self._update_models()

    @property
    def sees_others(self) -> bool:
        """Whether a vehicle looks down and there are others to see, so that each sample needs an ``update``."""
        return self.needed and self._others.any

    def update(self, time_us: int) -> None:
        """Update the objects and their poses.

        Args:
            time_us: simulated time, microseconds; used for people.
        """
        if not self.needed:
            return
        if self.sees_others and self._is_anything_below(time_us):
            self._update_others(time_us)
        else:
            self._update_models()

    def _is_anything_below(self, time_us: int) -> bool:
        """Return whether another vehicle or a person may be on the axis of one that looks down."""
        plant, models = self._world.plant, self._world.models
        reach = np.maximum(models["range_largest"], models["flow_largest"])
        looking = np.flatnonzero((reach > 0.0) & (plant["contact"] != ABSENT))
        middles, radii = self._others.spheres(time_us)
        for i in looking.tolist():
            x, y, z = rotate_all_inverse(plant["q"][i], middles - plant["position"][i]).T
            near = (np.hypot(x, y) < radii) & (-z + radii > 0.0) & (-z - radii < reach[i])
            near[i] = False
            if near.any():
                return True
        return False

    def _update_others(self, time_us: int) -> None:
        """Place models, vehicles and people."""
        fleet = self._others.fleet
        if self._with != fleet:
            self._with = fleet
            there = [vehicle for vehicle in fleet if vehicle is not None]
            self._rays = RayScene(self._world.model.models, there, self._others.people)
            self._there = ((), ())
        rays = self._follow_models()
        links, speeds = self._bodies()
        scene = self._others.scene(time_us)
        places = rays.places(SceneAt({**scene.links, **links}, scene.actors))
        self._own[:] = [NOTHING if vehicle is None else rays.number(vehicle.name) for vehicle in fleet]
        self._fill(rays, places, {**speeds, **self._others.velocities(time_us)})
        self._seen = True

    def _update_models(self) -> None:
        """Place models only; do nothing while they are at rest."""
        bodies = self._world.bodies.models
        there = tuple(self._world.standing), tuple(bodies)
        if there == self._there and not bodies and not self._seen:
            return
        rays = self._follow_models()
        links, speeds = self._bodies()
        self._fill(rays, rays.places(SceneAt(links, {})), speeds)
        self._seen = False

    def _follow_models(self) -> RayScene:
        """Return the scene of the rays with the current models."""
        if self._rays is None:
            self._rays = RayScene([])
        models, bodies = self._world.model.models, self._world.bodies.models
        there = tuple(self._world.standing), tuple(bodies)
        if there != self._there:
            self._there = there
            deleted = [
                model.name for k, model in enumerate(models) if k not in self._world.standing and k not in bodies
            ]
            self._rays.change([body.model for k, body in bodies.items() if k >= len(models)], deleted)
        return self._rays

    def _bodies(self) -> tuple[dict[str, Pose], dict[str, Array]]:
        """Return the poses of the links of models that can move, and the models' velocities, by name."""
        bodies = self._world.bodies.models.values()
        links = {
            f"{body.model.name}::{link.name}": compose(body.pose, link.pose)
            for body in bodies
            for link in body.model.links
        }
        return links, {body.model.name: np.array(body.velocity) for body in bodies}

    def _fill(self, rays: RayScene, places: NDArray[np.void], speeds: dict[str, Array]) -> None:
        layout = rays.layout
        numbers = [rays.number(name) for name in speeds]
        velocities = np.zeros((len(rays.owners), 3))
        for number, velocity in zip(numbers, speeds.values(), strict=True):
            velocities[number] = velocity
        self.arrays = (*layout.trees, layout.things, places, self._own, velocities)
