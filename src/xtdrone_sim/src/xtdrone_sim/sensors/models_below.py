"""Models below vehicles, for sensors that look down; other vehicles and people are not seen."""

from __future__ import annotations

from typing import Any

import numpy as np

from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.casting import PLACE, THING
from xtdrone_sim.rays.scene import RayScene
from xtdrone_sim.rays.tree import NODE, SURFACE
from xtdrone_sim.vehicles.pose_arithmetic import compose
from xtdrone_sim.worlds.scene_at import SceneAt

_NOTHING = np.zeros(0, NODE), np.zeros(0, SURFACE), np.zeros(0, THING), np.zeros(0, PLACE)


class Below:
    """The models of a world as arrays for kernels.

    Attributes:
        arrays: trees, things and places, see ``casting.cast_rays``; empty if no vehicle looks down, or the world has no
            models.
        needed: whether a vehicle looks down.
    """

    def __init__(self, world: World, *, needed: bool) -> None:
        """Build the trees.

        Args:
            world: the models are those that stand in it at the time of ``update``.
            needed: whether a vehicle looks down.

        Raises:
            ValueError: an invalid mesh, or too many triangles.
        """
        self.arrays: tuple[Any, ...] = _NOTHING
        self._world = world
        self.needed = needed
        self._rays = RayScene(world.model.models) if needed and world.model.models else None
        self._there: tuple[tuple[int, ...], ...] = ((), ())
        self.update()

    def update(self) -> None:
        """Take over which models are there, and where those are that can move."""
        if not self.needed:
            return
        bodies = self._world.bodies.by_number
        there = tuple(self._world.standing), tuple(bodies)
        if there == self._there and not bodies:
            return
        if self._rays is None:
            self._rays = RayScene([])
        models = self._world.model.models
        if there != self._there:
            self._there = there
            deleted = [
                model.name for k, model in enumerate(models) if k not in self._world.standing and k not in bodies
            ]
            self._rays.change([body.model for k, body in bodies.items() if k >= len(models)], deleted)
        links = {
            f"{body.model.name}::{link.name}": compose(body.pose, link.pose)
            for body in bodies.values()
            for link in body.model.links
        }
        places = self._rays.places(SceneAt(links, {}))
        layout = self._rays.layout
        self.arrays = (*layout.trees, layout.things, places)
