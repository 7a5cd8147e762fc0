"""Node that holds the gimbals of vehicles at an angle and publishes the poses of their cameras.

For each vehicle ``T`` (as ``typhoon_h480_0``):

===================================  ===========================  ====================================================
topic                                type                         meaning
===================================  ===========================  ====================================================
/xtdrone/T/gimbal_cmd                geometry_msgs/Vector3        in: roll, pitch, yaw, degrees; negative pitch is down
/T/mavros/local_position/pose        geometry_msgs/PoseStamped    in
/T/mavros/mount_control/orientation  geometry_msgs/Quaternion     in: gimbal attitude
/gazebo/link_states                  gazebo_msgs/LinkStates       in: with ``~source`` gazebo, instead of those two
/T/mavros/mount_control/command      mavros_msgs/MountControl     out: every step
/xtdrone/T/cam_pose                  geometry_msgs/PoseStamped    out: camera link in map, x forward, z up
===================================  ===========================  ====================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rospy
from gazebo_msgs.msg import LinkStates
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from mavros_msgs.msg import MountControl

import xtdrone_lockstep as lockstep
from xtdrone_common.cameras.camera_pose import camera_link_pose
from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_messages import is_pose
from xtdrone_common.settings import Settings, setting
from xtdrone_control.vehicle_topics import VehicleTopics

RATE = 30.0  # Hz
OFFSET = (0.041, 0.0, -0.122)  # of the typhoon's camera from base_link, m, FLU
_LARGEST_ANGLE = 180.0

Angles = tuple[float, float, float]


@dataclass(frozen=True)
class GimbalOptions(Settings):
    """Private parameters of the node, for all its vehicles."""

    roll: float = setting(0.0, low=-180.0, high=180.0, unit="deg", text="initial roll")
    pitch: float = setting(-60.0, low=-180.0, high=180.0, unit="deg", text="initial pitch, negative down")
    yaw: float = setting(0.0, low=-180.0, high=180.0, unit="deg", text="initial yaw")
    source: str = setting(
        "vehicle",
        choices=("vehicle", "gazebo"),
        text="camera pose: from the position and gimbal orientation reported by the vehicle, or the true pose",
    )
    camera_offset: tuple[float, float, float] = setting(
        OFFSET, low=-10.0, high=10.0, unit="m", text="camera position relative to base_link, FLU, for source vehicle"
    )
    link: str = setting("cgo3_camera_link", text="name of the camera's link, for source gazebo")

    @property
    def angles(self) -> Angles:
        """Initial roll, pitch and yaw, deg."""
        return self.roll, self.pitch, self.yaw


class GimbalControl:
    """Gimbal of one vehicle."""

    def __init__(self, name: str, options: GimbalOptions) -> None:
        """Declare the topics of vehicle ``name``."""
        self._name = name
        self._options = options
        self._angles = options.angles
        self._mount: tuple[float, float, float, float] | None = None  # w, x, y, z
        self._true: PoseStamped | None = None
        self._command = lockstep.Publisher(f"/{name}/mavros/mount_control/command", MountControl)
        self._cam_pose = lockstep.Publisher(f"/xtdrone/{name}/cam_pose", PoseStamped)
        lockstep.Subscriber(f"/xtdrone/{name}/gimbal_cmd", Vector3, self._on_command)
        if options.source == "vehicle":
            self._vehicle = VehicleTopics(name, "pose")
            lockstep.Subscriber(f"/{name}/mavros/mount_control/orientation", Quaternion, self._on_mount)
        lockstep.add_reset_hook(self._restart)

    def _restart(self) -> None:
        self._angles = self._options.angles
        self._mount = self._true = None

    # messages

    def _on_command(self, message: Vector3) -> None:
        angles = (message.x, message.y, message.z)
        if all(abs(angle) <= _LARGEST_ANGLE for angle in angles):  # false for NaN
            self._angles = angles
        else:
            rospy.logwarn_throttle(
                5.0, f"/xtdrone/{self._name}/gimbal_cmd: {angles} is not allowed, -180 to 180 deg each; it is ignored"
            )

    def _on_mount(self, message: Quaternion) -> None:
        entry = np.array([message.w, message.x, message.y, message.z])
        self._mount = entry.tolist() if is_pose(entry) else None

    def on_link_states(self, states: LinkStates, index: dict[str, int]) -> None:
        """Store the true pose of the camera link.

        Args:
            states: States of all links.
            index: Index of each link in ``states``, by name.
        """
        place = index.get(f"{self._name}::{self._options.link}")
        if place is not None:
            self._true = PoseStamped(pose=states.pose[place])
            self._true.header.stamp = rospy.Time.now()
            self._true.header.frame_id = "map"

    # steps

    def step(self) -> None:
        """Publish the gimbal command and the camera pose; call it at 30 Hz."""
        roll, pitch, yaw = self._angles
        command = MountControl(mode=MountControl.MAV_MOUNT_MODE_MAVLINK_TARGETING, roll=roll, pitch=pitch, yaw=yaw)
        command.header.stamp = rospy.Time.now()
        self._command.publish(command)
        pose = self._true if self._options.source == "gazebo" else self._estimated_pose()
        if pose is not None:
            self._cam_pose.publish(pose)

    def _estimated_pose(self) -> PoseStamped | None:
        """Return the camera pose from the last messages of the vehicle, None before the first."""
        pose = self._vehicle.pose
        if pose is None or self._mount is None:
            return None
        found = camera_link_pose(pose[:3].tolist(), pose[3:].tolist(), self._mount, self._options.camera_offset)
        message = PoseStamped(pose=Pose(Point(*found.position), Quaternion(*to_xyzw(found.orientation))))
        message.header.stamp = self._vehicle.stamp
        message.header.frame_id = "map"
        return message


class GimbalNode:
    """Gimbals of one or several vehicles in one process."""

    def __init__(self, kind: str, ids: Sequence[int], options: GimbalOptions) -> None:
        """Declare the topics.

        Args:
            kind: vehicle type, as ``typhoon_h480``.
            ids: numbers of the vehicles.
            options: shared by the vehicles.
        """
        self._gimbals = [GimbalControl(f"{kind}_{index}", options) for index in ids]
        if options.source == "gazebo":
            lockstep.Subscriber("/gazebo/link_states", LinkStates, self._on_links, queue_size=1)

    def _on_links(self, states: LinkStates) -> None:
        index = {name: i for i, name in enumerate(states.name)}
        for gimbal in self._gimbals:
            gimbal.on_link_states(states, index)

    def step(self) -> None:
        """Publish for every vehicle; call it at 30 Hz."""
        for gimbal in self._gimbals:
            gimbal.step()
