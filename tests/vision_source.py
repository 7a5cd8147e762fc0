"""A vision system for the tests: the true pose of a vehicle as a SLAM node would give it, ``vision_source.py iris_0``.

It takes part in the lockstep, and publishes 30 times a second what /gazebo/model_states says, with a little noise.
"""

from __future__ import annotations

import random
import sys

import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped

from xtdrone_control import lockstep

RATE = 30  # Hz
NOISE = 0.01  # m


def main(name: str) -> None:
    """Publish until the simulator ends."""
    rng = random.Random(1)
    lockstep.init_node("vision_source", rate=RATE)
    publisher = lockstep.Publisher(f"/{name}/mavros/vision_pose/pose", PoseStamped)
    seen: list[ModelStates] = []

    def look(states: ModelStates) -> None:
        seen[:] = [states]

    def see() -> None:
        if not seen or name not in seen[0].name:
            return
        message = PoseStamped()
        message.header.stamp = rospy.Time.now()
        message.header.frame_id = "map"
        message.pose = seen[0].pose[seen[0].name.index(name)]
        for axis in ("x", "y", "z"):
            setattr(message.pose.position, axis, getattr(message.pose.position, axis) + rng.gauss(0.0, NOISE))
        publisher.publish(message)

    lockstep.Subscriber("/gazebo/model_states", ModelStates, look)
    lockstep.start()
    lockstep.spin(see)


if __name__ == "__main__":
    main(sys.argv[1])
    sys.exit(lockstep.exit_status())
