"""Topics of the actors in a world.

===========================  ============================================  =========================================
/actor_<k>/cmd_motion        ros_actor_cmd_pose_plugin_msgs/ActorMotion    the k-th actor walks to (x, y) at v; see
                                                                           ``actors.Actors.send``
/xtdrone/scene               xtdrone_msgs/SceneState                       poses and walk phases
/gazebo/model_states         gazebo_msgs/ModelStates                       poses, after vehicles and models
===========================  ============================================  =========================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, Pose, Quaternion, Twist
from ros_actor_cmd_pose_plugin_msgs.msg import ActorMotion
from xtdrone_msgs.msg import SceneState

from xtdrone_control import lockstep
from xtdrone_sim.worlds import people
from xtdrone_sim.worlds.actors import Actors, ActorState
from xtdrone_sim.worlds.sdf import SdfActor

_WARNING_PERIOD = 5.0  # wall s between two equal warnings


class ActorTopics:
    """Topics of the actors of a world; all methods are called in the simulator's thread."""

    def __init__(self, actors: Sequence[SdfActor], now_us: Callable[[], int]) -> None:
        """Subscribe to the commands; called after ``lockstep.host()``.

        Args:
            actors: actors of the world.
            now_us: returns the simulated time, microseconds.

        Raises:
            ValueError: a skin is unknown.
        """
        skins = people.skins([actor.skin for actor in actors])
        self._actors = Actors(actors, [people.read(skin).stride for skin in skins])
        self._now_us = now_us
        for number in range(len(actors)):
            lockstep.Subscriber(f"/actor_{number}/cmd_motion", ActorMotion, partial(self._on_motion, number))

    def receive(self) -> None:
        """Process the received commands; called after each tick of the lockstep server."""
        if self._actors.names:
            lockstep.host().receive()

    def _on_motion(self, number: int, message: ActorMotion) -> None:
        try:
            self._actors.send(number, message.x, message.y, message.v, self._now_us())
        except ValueError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"simulator: /actor_{number}/cmd_motion: {error}")

    def restart(self, time_us: int) -> None:
        """Restart all actors at a simulated time, microseconds."""
        self._actors.restart(time_us)

    def add_to_scene(self, scene: SceneState) -> None:
        """Add the actors to a scene message."""
        states = self._actors.states(self._now_us())
        scene.actors = list(self._actors.names)
        scene.actor_poses = [_pose(state) for state in states]
        scene.actor_phases = [state.phase for state in states]

    def add_to(self, message: ModelStates) -> None:
        """Add the actors to a Gazebo message; twists are zero, as those of Gazebo's actors."""
        for name, state in zip(self._actors.names, self._actors.states(self._now_us()), strict=True):
            message.name.append(name)
            message.pose.append(_pose(state))
            message.twist.append(Twist())


def _pose(state: ActorState) -> Pose:
    half = 0.5 * state.yaw
    return Pose(Point(*state.position), Quaternion(0.0, 0.0, math.sin(half), math.cos(half)))
