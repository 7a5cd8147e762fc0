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

import xtdrone_lockstep as lockstep
from xtdrone_common.poses import Pose as VisualPose
from xtdrone_common.rotation import yaw_of
from xtdrone_worlds.worlds.actors import Actors, ActorState

_WARNING_PERIOD = 5.0  # wall s between two equal warnings


class ActorTopics:
    """Topics of the actors of a world; all methods are called in the simulator's thread.

    Attributes:
        names: names of all actors, in the order of the world.
    """

    def __init__(self, actors: Actors, now_us: Callable[[], int]) -> None:
        """Subscribe to the commands; called after ``lockstep.host()``.

        Args:
            actors: actors of the simulation.
            now_us: returns the simulated time, microseconds.
        """
        self._actors = actors
        self.names: Sequence[str] = actors.names
        self._now_us = now_us
        for number in range(len(actors.names)):
            lockstep.Subscriber(f"/actor_{number}/cmd_motion", ActorMotion, partial(self._on_motion, number))

    def _on_motion(self, number: int, message: ActorMotion) -> None:
        try:
            self._actors.send(number, message.x, message.y, message.v, self._now_us())
        except ValueError as error:
            rospy.logwarn_throttle(_WARNING_PERIOD, f"simulator: /actor_{number}/cmd_motion: {error}")

    def remove(self, number: int) -> None:
        """Remove an actor until the next restart."""
        self._actors.remove(number)

    def place(self, number: int, pose: VisualPose) -> None:
        """Place an actor upright at a pose; its current motion ends."""
        self._actors.place(number, pose.position, yaw_of(pose.orientation))

    def pose(self, number: int) -> VisualPose:
        """Return the pose of an actor in the world."""
        state = self._actors.states(self._now_us())[number]
        half = 0.5 * state.yaw
        return VisualPose(state.position, (math.cos(half), 0.0, 0.0, math.sin(half)))

    def _present(self) -> list[tuple[str, ActorState]]:
        return self._actors.present(self._now_us())

    def add_to_scene(self, scene: SceneState) -> None:
        """Add the actors to a scene message."""
        present = self._present()
        scene.actors = [name for name, _ in present]
        scene.actor_poses = [_pose(state) for _, state in present]
        scene.actor_phases = [state.phase for _, state in present]

    def add_to(self, message: ModelStates) -> None:
        """Add the actors to a Gazebo message; twists are zero, as those of Gazebo's actors."""
        for name, state in self._present():
            message.name.append(name)
            message.pose.append(_pose(state))
            message.twist.append(Twist())


def _pose(state: ActorState) -> Pose:
    half = 0.5 * state.yaw
    return Pose(Point(*state.position), Quaternion(0.0, 0.0, math.sin(half), math.cos(half)))
