"""ROS node between EGO-Planner and a vehicle: publishes the camera's pose, and forwards the planner's setpoints.

For a vehicle ``T`` (as ``iris_0``):

=================================  ==============================  ===================================================
topic                              type                            meaning
=================================  ==============================  ===================================================
/T/mavros/local_position/pose      geometry_msgs/PoseStamped       in, or another by ``~pose``
/T/camera_pose                     geometry_msgs/PoseStamped       out: the optical frame in ``world``, for depth images
/xtdrone/T/planning/pos_cmd        quadrotor_msgs/PositionCommand  in: position, velocity, acceleration, yaw, yaw rate
/T/mavros/setpoint_raw/local       mavros_msgs/PositionTarget      out: the same, one turn (16.7 ms) later at most
=================================  ==============================  ===================================================

``world`` is ``map``. The camera looks ahead from the vehicle's centre, as in upstream's program of this name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import rospy
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3
from mavros_msgs.msg import PositionTarget
from quadrotor_msgs.msg import PositionCommand

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import LINK_FROM_OPTICAL
from xtdrone_common.rotation import multiply
from xtdrone_common.settings import Settings, setting

RATE = 60.0  # Hz

_FRAME = "world"


@dataclass(frozen=True)
class TransferSettings(Settings):
    """Which topics are used."""

    pose: str = setting("mavros/local_position/pose", text="topic of the vehicle's pose, below its name")
    command: str = setting("planning/pos_cmd", text="topic of the planner's commands, below /xtdrone/ and its name")


def optical_pose(pose: PoseStamped) -> PoseStamped | None:
    """Return the pose of the optical frame (x right, y down, z ahead) of a camera at the vehicle's centre.

    Args:
        pose: Pose of base_link (FLU) in map.

    Returns:
        The pose in ``world`` at the same time; None if a number is not finite.
    """
    p, q = pose.pose.position, pose.pose.orientation
    if not all(map(math.isfinite, (p.x, p.y, p.z, q.x, q.y, q.z, q.w))):
        return None
    w, x, y, z = multiply((q.w, q.x, q.y, q.z), LINK_FROM_OPTICAL)
    found = PoseStamped()
    found.header.stamp, found.header.frame_id = pose.header.stamp, _FRAME
    found.pose.position = Point(p.x, p.y, p.z)
    found.pose.orientation = Quaternion(x, y, z, w)
    return found


def setpoint_of(command: PositionCommand, stamp: rospy.Time) -> PositionTarget | None:
    """Return the setpoint of a command, ENU; None if its trajectory is not ready or a number is not finite.

    Args:
        command: Command of EGO-Planner in ``world``.
        stamp: Stamp of the setpoint.
    """
    vectors = command.position, command.velocity, command.acceleration
    numbers = [value for vector in vectors for value in (vector.x, vector.y, vector.z)]
    is_ready = command.trajectory_flag == PositionCommand.TRAJECTORY_STATUS_READY
    if not is_ready or not all(map(math.isfinite, (*numbers, command.yaw, command.yaw_dot))):
        return None
    target = PositionTarget(coordinate_frame=PositionTarget.FRAME_LOCAL_NED)
    target.header.stamp, target.header.frame_id = stamp, "map"
    target.position = Point(*numbers[:3])
    target.velocity = Vector3(*numbers[3:6])
    target.acceleration_or_force = Vector3(*numbers[6:])
    target.yaw, target.yaw_rate = command.yaw, command.yaw_dot
    return target


class EgoTransfer:
    """Topics of one vehicle."""

    def __init__(self, name: str) -> None:
        """Declare the topics.

        Raises:
            SettingError: a parameter is not allowed.
        """
        settings = TransferSettings.from_parameters(rospy.get_param)
        self._name = name
        self._camera = lockstep.Publisher(f"/{name}/camera_pose", PoseStamped)
        self._setpoint = lockstep.Publisher(f"/{name}/mavros/setpoint_raw/local", PositionTarget)
        lockstep.Subscriber(f"/{name}/{settings.pose}", PoseStamped, self._on_pose)
        lockstep.Subscriber(f"/xtdrone/{name}/{settings.command}", PositionCommand, self._on_command)
        lockstep.add_reset_hook(self._forget)
        self._forget()

    def _forget(self) -> None:
        """Begin again, because simulated time was reset."""
        self._pose: PoseStamped | None = None
        self._command: PositionCommand | None = None

    def _on_pose(self, message: PoseStamped) -> None:
        self._pose = message

    def _on_command(self, message: PositionCommand) -> None:
        self._command = message

    def step(self) -> None:
        """Publish new setpoints; if the planner is silent, the autopilot's failsafe takes over."""
        pose, command = self._pose, self._command
        self._pose = self._command = None
        if pose is not None and (camera := optical_pose(pose)) is not None:
            self._camera.publish(camera)
        if command is None:
            return
        setpoint = setpoint_of(command, rospy.Time.now())
        if setpoint is None:
            rospy.logwarn_throttle(
                5.0, f"{self._name}: command dropped: its trajectory is not ready, or a number is not finite"
            )
        else:
            self._setpoint.publish(setpoint)
