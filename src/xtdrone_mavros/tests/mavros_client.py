"""A ROS program for test_mavros_node: uses the topics and services of /iris_0/mavros and prints its records as JSON."""

from __future__ import annotations

import json
import sys

import rospy
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import PositionTarget, State
from mavros_msgs.srv import CommandBool, SetMode
from sensor_msgs.msg import Imu

NS = "/iris_0/mavros"
LIMIT = 120.0  # s of wall time; only a broken run takes so long
VELOCITY = PositionTarget.IGNORE_PX | PositionTarget.IGNORE_PY | PositionTarget.IGNORE_PZ
VELOCITY |= PositionTarget.IGNORE_AFX | PositionTarget.IGNORE_AFY | PositionTarget.IGNORE_AFZ
POSITION = PositionTarget.IGNORE_VX | PositionTarget.IGNORE_VY | PositionTarget.IGNORE_VZ
POSITION |= PositionTarget.IGNORE_AFX | PositionTarget.IGNORE_AFY | PositionTarget.IGNORE_AFZ


def target(frame: int, mask: int) -> PositionTarget:
    """Return a setpoint with a distinct number in every field."""
    message = PositionTarget(coordinate_frame=frame, type_mask=mask, yaw=0.3, yaw_rate=0.4)
    message.position.x, message.position.y, message.position.z = 1.0, 2.0, 3.0
    message.velocity.x, message.velocity.y, message.velocity.z = 4.0, 5.0, 6.0
    return message


class _Connected(rospy.SubscribeListener):
    def __init__(self, messages):
        self._messages = messages

    def peer_subscribe(self, topic, publish, peer_publish):
        for message in self._messages:
            peer_publish(message)


def main() -> None:
    """Run the scenario."""
    rospy.init_node("client")
    state = State()
    while not state.connected:  # published before there is a connection, too
        state = rospy.wait_for_message(f"{NS}/state", State, LIMIT)
    pose = rospy.wait_for_message(f"{NS}/local_position/pose", PoseStamped, LIMIT)
    imu = Imu(linear_acceleration_covariance=[-1.0] + [0.0] * 8)
    while imu.linear_acceleration_covariance[0] < 0.0:  # its first accelerations may arrive after this topic
        imu = rospy.wait_for_message(f"{NS}/imu/data", Imu, LIMIT)
    arm = rospy.ServiceProxy(f"{NS}/cmd/arming", CommandBool)
    mode = rospy.ServiceProxy(f"{NS}/set_mode", SetMode)
    armed, disarmed = arm(True), arm(False)
    modes = [mode(custom_mode=name).mode_sent for name in ("OFFBOARD", "65536", "OFFBORD")]
    ignore_rate, ignore_yaw = PositionTarget.IGNORE_YAW_RATE, PositionTarget.IGNORE_YAW
    targets = [target(1, POSITION | ignore_rate), target(8, VELOCITY | ignore_yaw), target(9, POSITION | ignore_rate)]
    publisher = rospy.Publisher(f"{NS}/setpoint_raw/local", PositionTarget, _Connected(targets), queue_size=10)
    p, q, a = pose.pose.position, imu.orientation, imu.linear_acceleration
    result = {
        "state": [state.connected, state.armed, state.mode],
        "position": [p.x, p.y, p.z],
        "pose_age": rospy.get_time() - pose.header.stamp.to_sec(),
        "orientation": [q.w, q.x, q.y, q.z],
        "acceleration": [a.x, a.y, a.z],
        "arming": [[armed.success, armed.result], [disarmed.success, disarmed.result]],
        "modes": modes,
    }
    print(json.dumps(result), flush=True)
    sys.stdin.read()  # until the test has its results
    publisher.unregister()


if __name__ == "__main__":
    main()
