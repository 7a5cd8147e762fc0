"""People of the world on topics.

===========================  ============================================  =========================================
/actor_<k>/cmd_motion        ros_actor_cmd_pose_plugin_msgs/ActorMotion    the k-th actor walks to (x, y) at v; see
                                                                           ``actors.Actors.send``
/xtdrone/scene               xtdrone_msgs/SceneState                       where they are
/gazebo/model_states         gazebo_msgs/ModelStates                       the same, after vehicles and models
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
    """The people of a simulator's world; all in the simulator's thread."""

    def __init__(self, actors: Sequence[SdfActor], now_us: Callable[[], int]) -> None:
        """Subscribe to their commands; after ``lockstep.host()``.

        Args:
            actors: the world's.
            now_us: returns the simulated time, microseconds.

        Raises:
            ValueError: a skin that nobody has.
        """
        skins = people.skins([actor.skin for actor in actors])
        self._actors = Actors(actors, [people.read(skin).stride for skin in skins])
        self._now_us = now_us
        for number in range(len(actors)):
            lockstep.Subscriber(f"/actor_{number}/cmd_motion", ActorMotion, partial(self._on_motion, number))

    def receive(self) -> None:
        """Take what has been sent to them; call it after each tick of the lockstep's server."""
        if self._actors.names:
            lockstep.host().receive()

    def _on_motion(self, number: int, message: ActorMotion) -> None:
        try:
            self._actors.send(number, message.x, message.y, message.v, self._now_us())
        except ValueError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"simulator: /actor_{number}/cmd_motion: {error}")

    def restart(self, time_us: int) -> None:
        """Let all begin anew."""
        self._actors.restart(time_us)

    def tell(self, scene: SceneState) -> None:
        """Add where they are to what cameras see."""
        states = self._actors.states(self._now_us())
        scene.actors = list(self._actors.names)
        scene.actor_poses = [_pose(state) for state in states]
        scene.actor_phases = [state.phase for state in states]

    def add_to(self, message: ModelStates) -> None:
        """Add them to Gazebo's models; twists are zero, as Gazebo's actors have none."""
        for name, state in zip(self._actors.names, self._actors.states(self._now_us()), strict=True):
            message.name.append(name)
            message.pose.append(_pose(state))
            message.twist.append(Twist())


def _pose(state: ActorState) -> Pose:
    half = 0.5 * state.yaw
    return Pose(Point(*state.position), Quaternion(0.0, 0.0, math.sin(half), math.cos(half)))
