"""The scene of a node's rays, kept up to date with the messages of the running simulation."""

from __future__ import annotations

from collections.abc import Sequence

import rospy
from geometry_msgs.msg import Pose as PoseMessage
from xtdrone_msgs.msg import SceneModels, SceneState

from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose
from xtdrone_sim.rays.scene import ActorInScene, RayScene, SceneAt
from xtdrone_worlds.worlds.sdf import load_world_file, read_world, world_file


class LiveRays:
    """A scene for rays, built when it is first needed."""

    def __init__(self, node: str) -> None:
        """Start with the empty world.

        Args:
            node: name in the log.
        """
        self._node = node
        self._world = "empty"
        self._fleet: Sequence[Vehicle] = ()
        self._rays: RayScene | None = None
        self._is_hopeless = False  # the world cannot be used
        self._models: SceneModels | None = None

    def begin(self, world: str, fleet: Sequence[Vehicle]) -> None:
        """Set the world and the vehicles.

        Args:
            world: name or file.
            fleet: all vehicles, which rays can hit.
        """
        self._world, self._fleet = world, fleet

    def add_vehicle(self, vehicle: Vehicle) -> None:
        """Add a vehicle that has joined.

        Raises:
            ValueError: its model cannot be used.
        """
        if self._rays is not None:
            self._rays.add_vehicle(vehicle)
        else:
            RayScene((), [vehicle])  # raises for this vehicle now; later it would end the rays of all
        self._fleet = [*self._fleet, vehicle]

    def remove_vehicle(self, vehicle: Vehicle) -> None:
        """Remove a vehicle that has left."""
        if self._rays is not None:
            self._rays.remove_vehicle(vehicle.name)
        self._fleet = [other for other in self._fleet if other.name != vehicle.name]

    def change(self, message: SceneModels) -> None:
        """Apply the models added and deleted since the start; called with each message of /xtdrone/models."""
        self._models = message
        if self._rays is not None:
            self._change(self._rays, message)

    def _change(self, rays: RayScene, message: SceneModels) -> None:
        """Use other models from now on; one that cannot be read is left out."""
        try:
            rays.change(read_world(message.sdf, world_file(self._world)).models, message.deleted)
        except ValueError as error:
            rospy.logwarn(f"{self._node}: a model is ignored by rays: {error}")

    def scene(self) -> RayScene | None:
        """Return the scene; None if rays cannot be cast in this world, which is logged once."""
        if self._rays is None and not self._is_hopeless:
            try:
                world = load_world_file(self._world)
                self._rays = RayScene(world.models, self._fleet, world.actors)
            except ValueError as error:
                self._is_hopeless = True
                rospy.logerr(
                    f"{self._node}: no measurements, because rays cannot be cast in the world {self._world}: {error}"
                )
                return None
            if self._models is not None:
                self._change(self._rays, self._models)
        return self._rays


def scene_of(message: SceneState) -> SceneAt:
    """Return the poses of a message."""
    links = {name: _pose(pose) for name, pose in zip(message.links, message.poses, strict=True)}
    actors = {
        name: ActorInScene(_pose(pose), phase)
        for name, pose, phase in zip(message.actors, message.actor_poses, message.actor_phases, strict=True)
    }
    return SceneAt(links, actors)


def _pose(message: PoseMessage) -> Pose:
    p, q = message.position, message.orientation
    return Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))
