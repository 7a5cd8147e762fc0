"""Conversion of the simulator's records to Gazebo's messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist
from numpy.typing import NDArray

from xtdrone_control.frames import to_xyzw
from xtdrone_sim.physics.vehicle_dynamics import rotate
from xtdrone_sim.worlds.sdf import SdfModel


class ModelStatesMessage:
    """The true state of the ground plane, of all vehicles, and of the models in the world, in one reused message."""

    def __init__(self, names: Sequence[str], models: Sequence[SdfModel] = ()) -> None:
        """Create the message.

        Args:
            names: names of the vehicles; those of absent ones are empty.
            models: of the world.
        """
        self._present = None if all(names) else np.array([bool(name) for name in names])
        names = [name for name in names if name]
        poses = [Pose(Point(*model.pose.position), Quaternion(*to_xyzw(model.pose.orientation))) for model in models]
        level = Pose(orientation=Quaternion(0.0, 0.0, 0.0, 1.0))
        self._message = ModelStates(
            ["ground_plane", *names, *(model.name for model in models)],
            [level, *(Pose() for _ in names), *poses],
            [Twist() for _ in range(1 + len(names) + len(models))],
        )
        self._size = len(self._message.name)

    def fill(self, plant: NDArray[np.void]) -> ModelStates:
        """Return the message for the current time; models added to it earlier are removed.

        Args:
            plant: (n,) ``PLANT``.

        Returns:
            Poses in the world frame (ENU, quaternion x, y, z, w) and twists in the world frame, as Gazebo gives them.
        """
        if self._present is not None:
            plant = plant[self._present]
        message = self._message
        for column in (message.name, message.pose, message.twist):
            del column[self._size :]
        vehicles = slice(1, 1 + len(plant))
        quaternions, rates = plant["q"], plant["rates"].tolist()
        positions, velocities = plant["position"].tolist(), plant["velocity"].tolist()
        for i, (pose, twist) in enumerate(zip(message.pose[vehicles], message.twist[vehicles], strict=True)):
            place, turn, linear, angular = pose.position, pose.orientation, twist.linear, twist.angular
            place.x, place.y, place.z = positions[i]
            turn.w, turn.x, turn.y, turn.z = quaternions[i].tolist()
            linear.x, linear.y, linear.z = velocities[i]
            angular.x, angular.y, angular.z = rotate(quaternions[i], *rates[i])
        return message
