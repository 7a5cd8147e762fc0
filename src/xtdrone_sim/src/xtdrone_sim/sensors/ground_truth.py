"""Ground truth with exact stamps: the data of /gazebo/model_states, with one topic per model.

=================================  ==================  ==========================================================
published, while subscribed
/xtdrone/T/ground_truth/odom       nav_msgs/Odometry   of vehicles and actors, at the rate of /gazebo/model_states
=================================  ==================  ==========================================================

Poses are in ``map`` (ENU, quaternion x, y, z, w), twists in the body frame (FLU), as nav_msgs/Odometry requires; all
covariances are zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Pose, Twist, Vector3
from nav_msgs.msg import Odometry

import xtdrone_lockstep as lockstep
from xtdrone_common.poses import conjugate, rotate


def topic(name: str) -> str:
    """Return the ground-truth topic of a model."""
    return f"/xtdrone/{name}/ground_truth/odom"


class GroundTruth:
    """Ground-truth topics of all vehicles and actors."""

    def __init__(self, names: Sequence[str]) -> None:
        """Advertise the topics of these models."""
        self._publishers: dict[str, lockstep.Publisher] = {}
        self._messages: dict[str, Odometry] = {}
        self.update(names)

    def update(self, names: Sequence[str]) -> None:
        """Serve these models: advertise the topics of new ones, and close those of models that have left."""
        for name in [name for name in self._publishers if name not in names]:
            self._publishers.pop(name).unregister()
        for name in names:
            if name not in self._publishers:
                self._publishers[name], self._messages[name] = lockstep.Publisher(topic(name), Odometry), _empty(name)

    @property
    def wanted(self) -> bool:
        """Whether any topic has a subscriber."""
        return any(publisher.get_num_connections() for publisher in self._publishers.values())

    def publish(self, states: ModelStates, time_us: int) -> None:
        """Publish ``states``, taken at ``time_us`` (microseconds), on the topics with subscribers."""
        places = {name: i for i, name in enumerate(states.name)}
        stamp = rospy.Time(time_us // 1_000_000, time_us % 1_000_000 * 1000)
        for name, publisher in self._publishers.items():
            i = places.get(name)
            if i is None or not publisher.get_num_connections():
                continue
            message = self._messages[name]
            message.header.stamp = stamp
            message.pose.pose = states.pose[i]
            message.twist.twist = in_body(states.pose[i], states.twist[i])
            publisher.publish(message)


def _empty(name: str) -> Odometry:
    message = Odometry(child_frame_id=f"{name}/base_link")
    message.header.frame_id = "map"
    return message


def in_body(pose: Pose, twist: Twist) -> Twist:
    """Return a twist, given in the world frame, in the frame of a body with this pose."""
    q, linear, angular = pose.orientation, twist.linear, twist.angular
    inverse = conjugate((q.w, q.x, q.y, q.z))
    return Twist(
        Vector3(*rotate(inverse, (linear.x, linear.y, linear.z))),
        Vector3(*rotate(inverse, (angular.x, angular.y, angular.z))),
    )
