"""ROS node of the leader; its topics are listed in ``follower_nodes``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rospy
from geometry_msgs.msg import PoseStamped, Twist
from std_msgs.msg import Float32MultiArray, Int32MultiArray, MultiArrayDimension, String

import xtdrone_lockstep as lockstep
from xtdrone_common.programs.node_command_line import ArgumentError, run_program
from xtdrone_common.settings import Settings, setting
from xtdrone_control.communication.setpoint import yaw_of
from xtdrone_coordination.follower import RATE
from xtdrone_coordination.follower_nodes import (
    PATTERN_TOPIC,
    TOPOLOGY_TOPIC,
    check_number_of,
    class_parameter,
    count_of,
    options,
    subscribe_swarm,
)
from xtdrone_coordination.leader import CommandError, Leader, LeaderOptions
from xtdrone_coordination.patterns import Patterns, absolute_name


@dataclass(frozen=True)
class LeaderNodeSettings(Settings):
    """Settings of the node, beside those of the leader."""

    republish_rate: float = setting(RATE, above=0.0, unit="Hz", text="repetition of pattern and topology")


class LeaderNode:
    """Subscriptions and publications of the leader."""

    def __init__(self, kind: str, leader: Leader, *, republish_rate: float = RATE) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``iris``.
            leader: the leader.
            republish_rate: Hz, above 0 up to 30, of pattern and topology. They are latched and also published when they
                change; the repetition serves nodes that expect a stream.
        """
        self.leader = leader
        self._period = max(1, round(RATE / republish_rate))
        self._ticks = 0
        self._published = ""
        self._pose: PoseStamped | None = None
        self._twist = Twist()
        self._pattern = Float32MultiArray()
        self._topology = Int32MultiArray()
        vehicle = f"/xtdrone/{kind}_0"
        self._to_cmd = lockstep.Publisher(f"{vehicle}/cmd", String)
        self._to_velocity = lockstep.Publisher(f"{vehicle}/cmd_vel_flu", Twist)
        to_acceleration = lockstep.Publisher(f"{vehicle}/cmd_accel_flu", Twist)
        self._to_pose = lockstep.Publisher("/xtdrone/leader/pose", PoseStamped)
        self._to_pattern = lockstep.Publisher(PATTERN_TOPIC, Float32MultiArray, latch=True)
        self._to_topology = lockstep.Publisher(TOPOLOGY_TOPIC, Int32MultiArray, latch=True)
        lockstep.Subscriber("/xtdrone/leader/cmd", String, self._on_command)
        lockstep.Subscriber("/xtdrone/leader/cmd_vel_flu", Twist, self._on_velocity)
        lockstep.Subscriber("/xtdrone/leader/cmd_accel_flu", Twist, to_acceleration.publish)
        subscribe_swarm(kind, leader.swarm, on_leader_pose=self._on_pose)
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        """Restart, and clear the latched topics, so that no pattern of another flight is received."""
        if self._published:
            self._to_pattern.publish(Float32MultiArray())
            self._to_topology.publish(Int32MultiArray())
        self._ticks = 0
        self._published = ""
        self._pose = None
        self.leader.restart()

    def step(self) -> None:
        """Publish pose, command, pattern and topology as needed; call it at 30 Hz."""
        self._ticks += 1
        if self._pose is not None:
            self._to_pose.publish(self._pose)
            self._pose = None
        course = self.leader.update()
        if course is not None:
            linear = self._twist.linear
            (linear.x, linear.y, linear.z), self._twist.angular.z = course
            self._to_velocity.publish(self._twist)
        if self.leader.pattern != self._published:
            self._published = self.leader.pattern
            self._encode()
            self._ticks = 0
        if self._published and self._ticks % self._period == 0:
            self._to_pattern.publish(self._pattern)
            self._to_topology.publish(self._topology)
        self.leader.swarm.tick()

    def _encode(self) -> None:
        """Fill the messages of pattern and topology."""
        leader = self.leader
        assert leader.offsets is not None
        assert leader.adjacency is not None
        width, count = leader.count - 1, leader.count
        self._pattern.layout.dim = [
            MultiArrayDimension("axis", 3, 3 * width),
            MultiArrayDimension("follower", width, width),
        ]
        self._pattern.data = leader.offsets.T.ravel().tolist()
        self._topology.layout.dim = [
            MultiArrayDimension("listener", count, count * count),
            MultiArrayDimension("heard", count, count),
        ]
        self._topology.data = leader.adjacency.ravel().tolist()
        rospy.loginfo(f"leader: pattern {leader.pattern}, total distance {leader.distance:.2f} m")

    def _on_command(self, message: String) -> None:
        try:
            passed = self.leader.on_command(message.data)
        except CommandError as error:
            rospy.logwarn(str(error))
            return
        if passed is not None:
            self._to_cmd.publish(String(data=passed))

    def _on_velocity(self, message: Twist) -> None:
        v = message.linear
        self.leader.on_steering((v.x, v.y, v.z), message.angular.z)

    def _on_pose(self, message: PoseStamped) -> None:
        q = message.pose.orientation
        self.leader.yaw = yaw_of(q.x, q.y, q.z, q.w)
        self._pose = message


def run_leader(cls: type[Leader] = Leader) -> int:
    """Run a leader program with ``sys.argv``; return the exit status.

    Args:
        cls: the leader's class; the parameter ``~class`` replaces it, see ``follower_nodes.run_follower``.
    """

    def main(arguments: Sequence[str]) -> None:
        check_number_of(arguments, 2)
        kind, number = arguments
        count = count_of(kind, number)
        lockstep.init_node("leader", rate=RATE)
        rate = options(LeaderNodeSettings, {}).republish_rate
        file = rospy.get_param("~patterns", "")
        given = [absolute_name(name.strip()) for name in str(rospy.get_param("~given_patterns", "")).split(",")]
        folder = str(rospy.get_param("~cloud_folder", ""))
        try:
            patterns = Patterns(count, file or None, below=folder, given=given)
        except ValueError as error:
            raise ArgumentError(str(error)) from error
        chosen = class_parameter(cls, Leader)
        leader = chosen(count, patterns, options=options(LeaderOptions, {}), warn=rospy.logwarn)
        node = LeaderNode(kind, leader, republish_rate=rate)
        lockstep.start()
        lockstep.spin(node.step)

    return run_program(main, sys.argv, f"{Path(sys.argv[0]).name} TYPE NUM")
