"""Fly vehicles with MAVROS's topics and services alone, as XTDrone's users' scripts do: ``offboard_script.py NAME...``.

Each vehicle is armed, takes off to 2 m above its start in OFFBOARD, and lands.
"""

from __future__ import annotations

import sys

import rospy
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import State
from mavros_msgs.srv import CommandBool, SetMode


class Copter:
    def __init__(self, name: str) -> None:
        self.pose: PoseStamped | None = None
        self.state = State()
        self.target = PoseStamped()
        rospy.Subscriber(f"{name}/mavros/local_position/pose", PoseStamped, self.on_pose)
        rospy.Subscriber(f"{name}/mavros/state", State, self.on_state)
        self.setpoint = rospy.Publisher(f"{name}/mavros/setpoint_position/local", PoseStamped, queue_size=1)
        self.arm = rospy.ServiceProxy(f"{name}/mavros/cmd/arming", CommandBool)
        self.set_mode = rospy.ServiceProxy(f"{name}/mavros/set_mode", SetMode)

    def on_pose(self, pose: PoseStamped) -> None:
        self.pose = pose

    def on_state(self, state: State) -> None:
        self.state = state

    def aim(self) -> None:
        position = self.pose.pose.position
        self.target.pose.position.x, self.target.pose.position.y = position.x, position.y
        self.target.pose.position.z = position.z + 2.0
        self.target.pose.orientation = self.pose.pose.orientation

    def in_offboard(self) -> bool:
        if self.state.mode != "OFFBOARD":
            self.set_mode(custom_mode="OFFBOARD")
        elif not self.state.armed:
            self.arm(True)
        return self.state.mode == "OFFBOARD" and self.state.armed

    def is_up(self) -> bool:
        return self.pose.pose.position.z > self.target.pose.position.z - 0.3

    def lands(self) -> bool:
        if self.state.mode != "AUTO.LAND":
            self.set_mode(custom_mode="AUTO.LAND")
        return not self.state.armed


def main(names: list[str]) -> None:
    rospy.init_node("offboard_script")
    copters = [Copter(name) for name in names]
    rate = rospy.Rate(20)

    def until_all(condition: str) -> None:
        turns = 0
        while not all([turns % 20 == 0 and getattr(copter, condition)() for copter in copters]):
            turns += 1
            for copter in copters:
                if copter.pose is not None:
                    copter.setpoint.publish(copter.target)
            rate.sleep()

    while not all(copter.state.connected and copter.pose is not None for copter in copters):
        rate.sleep()
    for copter in copters:
        copter.aim()
    for condition in ("in_offboard", "is_up", "lands"):
        until_all(condition)
    print("landed:", *names)


if __name__ == "__main__":
    main(rospy.myargv(sys.argv)[1:])
