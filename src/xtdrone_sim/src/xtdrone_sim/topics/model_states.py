"""True states of all models as Gazebo's message, and for programs that show them by the wall clock.

=====================  =======================  ======================================================================
/xtdrone/live_states   gazebo_msgs/ModelStates  as /gazebo/model_states; at most 30 in a wall second, while subscribed
=====================  =======================  ======================================================================

At full speed /gazebo/model_states, which keeps a rate in simulated time, has some hundred messages in a wall second:
far more than a browser draws. The live topic is not part of the lockstep: the simulation waits for no subscriber,
digests leave it out, and which ticks it shows depends on the machine. While time stands still it is published once a
second, for subscribers that come then; the world may then be one tick ahead of /clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist
from numpy.typing import NDArray

import xtdrone_lockstep as lockstep
from xtdrone_common.frames import to_xyzw
from xtdrone_sim.physics.vehicle_dynamics import rotate
from xtdrone_worlds.worlds.sdf import SdfModel


class ModelStatesMessage:
    """The true state of the ground plane, of all vehicles, and of the models in the world, in one reused message."""

    def __init__(self, names: Sequence[str], models: Sequence[SdfModel] = ()) -> None:
        """Create the message.

        Args:
            names: names of the vehicles; those of absent ones are empty.
            models: models of the world.
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


TOPIC = "/xtdrone/live_states"
PERIOD = 1.0 / 30.0
"""Wall seconds between two messages, at least."""
STANDING_PERIOD = 1.0
"""Likewise while simulated time stands still."""


class LiveStates:
    """Publishes the states of the tick at which they are due."""

    def __init__(self, states: Callable[[], ModelStates], clock: Callable[[], float] = time.monotonic) -> None:
        """Advertise the topic.

        Args:
            states: returns the current states.
            clock: wall time, s.
        """
        self._states = states
        self._clock = clock
        self._publisher = lockstep.UncountedPublisher(TOPIC, ModelStates, queue_size=1)
        self._published = -STANDING_PERIOD
        self._is_last = False  # whether the states of the latest tick have been published

    def ticked(self) -> None:
        """Publish the states of a new tick if they are due."""
        self._is_last = False
        self._publish(PERIOD)

    def stands(self) -> None:
        """Publish, while time stands still, the states of the last tick, and again for new subscribers."""
        self._publish(STANDING_PERIOD if self._is_last else PERIOD)

    def _publish(self, period: float) -> None:
        if not self._publisher.get_num_connections():
            return
        now = self._clock()
        if now - self._published < period:
            return
        self._published, self._is_last = now, True
        self._publisher.publish(self._states())
