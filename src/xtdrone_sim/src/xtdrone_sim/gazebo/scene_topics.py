"""Contribution to topics of the models that requests have moved, added or deleted."""

from __future__ import annotations

from dataclasses import replace

from gazebo_msgs.msg import LinkStates, ModelStates
from xtdrone_msgs.msg import SceneModels, SceneState

import xtdrone_lockstep as lockstep
from xtdrone_sim.gazebo.models_by_name import Models
from xtdrone_sim.gazebo.states import pose_message, twist_message
from xtdrone_worlds.worlds.sdf import load_world_file, write_world

TOPIC = "/xtdrone/models"


class ModelTopics:
    """Adds the models that have changed to the simulator's topics, and notifies cameras of new ones."""

    def __init__(self, models: Models) -> None:
        """Advertise the topic of the changes to the world's models.

        Args:
            models: all models.
        """
        self._models = models
        self._changes = lockstep.Publisher(TOPIC, SceneModels, latch=True)

    def announce(self) -> None:
        """Publish the models added and deleted since the start, for cameras; latched."""
        models = self._models
        world = replace(load_world_file("empty"), models=tuple(models.added.values()))
        names = [models.names[number] for number in sorted(models.deleted) if number < models.first_added]
        self._changes.publish(SceneModels(sdf=write_world(world), deleted=names))

    def complete(self, message: ModelStates) -> ModelStates:
        """Return the states of all models, given those of vehicles, the world's models at rest, and actors."""
        models = self._models
        first = 1 + models.vehicle_count
        for number, state in models.bodies():
            pose, twist = pose_message(state.pose), twist_message(state)
            if number in models.added:
                message.name.append(models.names[number])
                message.pose.append(pose)
                message.twist.append(twist)
            else:
                message.pose[first + number] = pose
                message.twist[first + number] = twist
        if not models.deleted:
            return message
        gone = {first + number for number in models.deleted if number < models.first_actor}
        rows = zip(message.name, message.pose, message.twist, strict=True)
        kept = [row for index, row in enumerate(rows) if index not in gone]
        return ModelStates(*(list(column) for column in zip(*kept, strict=True)))

    def add_to_scene(self, scene: SceneState) -> None:
        """Add the links of models that may have moved."""
        for name, state in self._models.links(still=False):
            scene.links.append(name)
            scene.poses.append(pose_message(state.pose))

    def add_to_links(self, message: LinkStates) -> None:
        """Add the links of all models."""
        for name, state in self._models.links(still=True):
            message.name.append(name)
            message.pose.append(pose_message(state.pose))
            message.twist.append(twist_message(state))
