"""A vision system for the tests: publishes a vehicle's true pose as VINS-Fusion would; ``vision_source.py iris_0``.

It joins the lockstep, and publishes the pose of /gazebo/model_states 30 times a second, with a little noise, as
the pose of the optical frame of a camera in the vehicle's middle that looks ahead.
"""

from __future__ import annotations

import random
import sys

import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import LINK_FROM_OPTICAL
from xtdrone_common.rotation import multiply

RATE = 30  # Hz
NOISE = 0.01  # m


def main(name: str) -> None:
    """Publish until the simulator ends."""
    rng = random.Random(1)
    lockstep.init_node("vision_source", rate=RATE)
    publisher = lockstep.Publisher("/vins_estimator/camera_pose", Odometry)
    seen: list[ModelStates] = []

    def look(states: ModelStates) -> None:
        seen[:] = [states]

    def see() -> None:
        if not seen or name not in seen[0].name:
            return
        message = Odometry()
        message.header.stamp = rospy.Time.now()
        message.header.frame_id = "world"
        pose = seen[0].pose[seen[0].name.index(name)]
        place, q = pose.position, pose.orientation
        w, x, y, z = multiply((q.w, q.x, q.y, q.z), LINK_FROM_OPTICAL)
        message.pose.pose.orientation = Quaternion(x, y, z, w)
        for axis in ("x", "y", "z"):
            setattr(message.pose.pose.position, axis, getattr(place, axis) + rng.gauss(0.0, NOISE))
        publisher.publish(message)

    lockstep.Subscriber("/gazebo/model_states", ModelStates, look)
    lockstep.start()
    lockstep.spin(see)


if __name__ == "__main__":
    main(sys.argv[1])
    sys.exit(lockstep.exit_status())
