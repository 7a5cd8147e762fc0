"""Node that follows people: publishes velocity and gimbal commands from tracks of people on the ground.

For each vehicle ``T`` (as ``typhoon_h480_0``):

=====================================  ==========================  ==================================================
topic                                  type                        meaning
=====================================  ==========================  ==================================================
/xtdrone/T/objects                     xtdrone_msgs/ObjectsOn..    in: tracks of the detection node
/T/mavros/local_position/pose          geometry_msgs/PoseStamped   in
/xtdrone/T/follow                      std_msgs/Int32              in: id of the track to follow; -1: stop
/xtdrone/T/cmd_vel_flu                 geometry_msgs/Twist         out: while following
/xtdrone/T/cmd                         std_msgs/String             out: OFFBOARD at the start, HOVER after a loss
/T/mavros/mount_control/command        mavros_msgs/MountControl    out: gimbal towards the person
/xtdrone/T/follow_state                std_msgs/String             out, latched: idle, following, searching, lost
=====================================  ==========================  ==================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import rospy
from geometry_msgs.msg import Twist
from mavros_msgs.msg import MountControl
from std_msgs.msg import Int32, String
from xtdrone_msgs.msg import ObjectsOnGround

import xtdrone_lockstep as lockstep
from xtdrone_common.rotation import yaw_of
from xtdrone_common.settings import Settings, setting
from xtdrone_control.vehicle_topics import VehicleTopics

from .person_following import ANY, FOLLOWING, FollowCommand, Following, FollowSettings, SeenTrack

RATE = 30.0  # Hz
_MOUNT_PERIOD = 0.2  # s between gimbal commands, each of which is a MAVLink command
_MOUNT_CHANGE = math.radians(0.5)


@dataclass(frozen=True)
class TrackingOptions(Settings):
    """Private parameters of the node, for all its vehicles.

    Attributes:
        following: distances, gains and limits.
    """

    wait: bool = setting(
        False, text="follow only the track named on /xtdrone/T/follow instead of the first person detected"
    )
    offboard: bool | None = setting(None, text="command OFFBOARD when following begins; default: the value of ``wait``")
    gimbal: bool = setting(True, text="point the gimbal at the person")
    following: FollowSettings = field(default_factory=FollowSettings)

    @property
    def commands_offboard(self) -> bool:
        """Whether to command OFFBOARD when following begins."""
        return self.wait if self.offboard is None else self.offboard


def read_options() -> TrackingOptions:
    """Read the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    following = FollowSettings.from_parameters(rospy.get_param)
    return TrackingOptions.from_parameters(rospy.get_param, following=following)


class HumanTracking:
    """Topics of one following vehicle."""

    def __init__(self, vehicle: str, options: TrackingOptions) -> None:
        """Declare the topics.

        Args:
            vehicle: name, as ``typhoon_h480_0``.
            options: Options of the node.
        """
        self.name = vehicle
        self._options = options
        self._restart()
        self._velocity = lockstep.Publisher(f"/xtdrone/{vehicle}/cmd_vel_flu", Twist)
        self._command = lockstep.Publisher(f"/xtdrone/{vehicle}/cmd", String)
        self._mount = lockstep.Publisher(f"/{vehicle}/mavros/mount_control/command", MountControl)
        self._state = lockstep.Publisher(f"/xtdrone/{vehicle}/follow_state", String, latch=True)
        self._vehicle = VehicleTopics(vehicle, "pose")
        lockstep.Subscriber(f"/xtdrone/{vehicle}/follow", Int32, self._on_follow)
        lockstep.Subscriber(f"/xtdrone/{vehicle}/objects", ObjectsOnGround, self._on_objects)
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        self._following = Following(self._options.following)
        if not self._options.wait:
            self._following.follow(ANY)
        self._offboard_sent = False
        self._pending_stop = FollowCommand()
        self._pointed: tuple[float, tuple[float, float]] | None = None
        self._published_state = ""

    def _on_follow(self, message: Int32) -> None:
        if message.data > 0:
            if message.data != self._following.target:
                self._following.follow(message.data)
                self._offboard_sent = False
        elif message.data == -1:
            self._pending_stop = self._following.stop()
            self._offboard_sent = False
        else:
            rospy.logwarn(f"/xtdrone/{self.name}/follow: {message.data} is not allowed, a track's id from 1, or -1")

    def _on_objects(self, message: ObjectsOnGround) -> None:
        time = message.header.stamp.to_sec()
        self._following.see(
            [
                SeenTrack(
                    entry.id,
                    time,
                    (entry.position.x, entry.position.y, entry.position.z),
                    (entry.velocity.x, entry.velocity.y),
                    entry.probability,
                )
                for entry in message.objects
                if entry.probability > 0.0
            ]
        )

    def step(self) -> None:
        """Publish the commands of one step; call it at 30 Hz."""
        if self._pending_stop.order:
            self._command.publish(String(self._pending_stop.order))
            self._pending_stop = FollowCommand()
        if (pose := self._vehicle.pose) is not None:
            x, y, z = pose[:3].tolist()
            self._execute(self._following.update(rospy.get_time(), (x, y, z), yaw_of(pose[3:].tolist())))
        if self._following.state != self._published_state:
            if self._published_state:
                rospy.loginfo(f"{self.name}: {self._following.state}, track {self._following.target}")
            self._published_state = self._following.state
            self._state.publish(String(self._published_state))

    def _execute(self, command: FollowCommand) -> None:
        if command.order:
            self._command.publish(String(command.order))
        if command.velocity is not None:
            if not self._offboard_sent and self._following.state == FOLLOWING:
                self._offboard_sent = True
                if self._options.commands_offboard:
                    self._command.publish(String("OFFBOARD"))
            twist = Twist()
            twist.linear.x, twist.linear.y, twist.linear.z = command.velocity
            twist.angular.z = command.yaw_rate
            self._velocity.publish(twist)
        if command.gimbal is not None and self._options.gimbal:
            self._point(command.gimbal)

    def _point(self, gimbal: tuple[float, float]) -> None:
        """FollowCommand the gimbal if the angles have changed noticeably."""
        now = rospy.get_time()
        if self._pointed is not None:
            then, last = self._pointed
            change = max(abs(a - b) for a, b in zip(gimbal, last, strict=True))
            if change < _MOUNT_CHANGE or 0.0 <= now - then < _MOUNT_PERIOD - 1e-6:
                return
        self._pointed = now, gimbal
        message = MountControl(mode=MountControl.MAV_MOUNT_MODE_MAVLINK_TARGETING)
        message.header.stamp = rospy.Time.now()
        message.pitch, message.yaw = math.degrees(gimbal[0]), math.degrees(gimbal[1])
        self._mount.publish(message)
